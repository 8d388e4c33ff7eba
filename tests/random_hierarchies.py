"""Random valid task hierarchies over a model, deterministic in their seed."""

from __future__ import annotations

from collections.abc import Sequence
from random import Random

from random_dynamics import Reader, amount, told_apart

from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.subtask import local_rewards, primitives_below
from factored_polca.models import Constant, Model, Task, TaskHierarchy, disjunction
from factored_polca.models.expressions import Reference


def random_tasks(seed: int, model: Model) -> TaskHierarchy:
    """A random valid hierarchy of 2-4 tasks over `model`.

    Subtasks have terminal conditions and pseudo-rewards that differ among their non-terminal
    states; the root lists tasks and enough primitives that one applies at each non-terminal state.
    """
    random = Random(f"tasks {seed} {model.name}")
    names = [f"task{i}" for i in range(random.randint(1, 3))]
    primitives = [action.name for action in model.actions]
    tasks: list[Task] = []
    orphans: list[str] = []
    for name in names:
        chosen = random.sample(primitives, random.randint(min(2, len(primitives)), len(primitives)))
        below: list[str] = []
        if tasks and random.random() < 0.6:
            # A task that already has a parent may be taken again: it is then shared.
            below = [random.choice(orphans)] if orphans and random.random() < 0.7 else [tasks[0].name]
            chosen = chosen[: random.randint(1, len(chosen))]
        actions = random.sample(chosen + below, len(chosen + below))
        tasks.append(_random_subtask(random, model, TaskHierarchy([*tasks, Task(name, actions)]), name))
        orphans = [orphan for orphan in orphans if orphan not in below] + [name]
    if len(tasks) > 1 and random.random() < 0.4:
        orphans += [name for name in names if name not in orphans][:1]
    actions = orphans + _covering_actions(random, model)
    root = Task("root", random.sample(actions, len(actions)))
    return TaskHierarchy(random.sample([*tasks, root], len(tasks) + 1))


def _random_subtask(random: Random, model: Model, hierarchy: TaskHierarchy, name: str) -> Task:
    """The task called `name` with a terminal condition and pseudo-rewards that are not constant.

    They differ among its own primitives already, so they do whatever its children turn out to do.
    Primitives that hardly apply anywhere may not allow that: then it gets all primitives.
    """
    reader = Reader(random, told_apart(model.features), {f.name: f for f in model.features})
    draft = hierarchy.task(name)
    below = primitives_below(model, hierarchy, name)
    primitives = [action.name for action in model.actions]
    actions = draft.actions
    for attempt in range(400):
        if attempt == 40:
            actions = (*actions, *(a for a in primitives if a not in actions))
        references = [Reference(f.name) for f in random.sample(model.features, len(model.features))]
        terms = [reader.tree(references[:1], lambda: Constant(amount(random)))]
        if random.random() < 0.3:
            after = Reference(references[-1].name, primed=True)
            terms.append(reader.tree([after], lambda: Constant(amount(random))))
        of_actions = []
        if random.random() < 0.4:
            of_actions.append((random.choice(below), [Constant(amount(random))]))
        task = Task(
            name,
            actions,
            terminal=reader.condition(references[-1]),
            pseudo_rewards=terms,
            pseudo_rewards_of=of_actions,
            adds_reward=random.random() < 0.2,
        )
        if _has_something_to_optimise(model, task, [a for a in actions if a in primitives]):
            return task
    raise AssertionError(f"{model.name}: no reward differs among the non-terminal states")


def _has_something_to_optimise(model: Model, task: Task, actions: Sequence[str]) -> bool:
    """Whether the local reward takes two values at non-terminal states."""
    mdp = enumerate_model(
        model,
        actions=actions,
        terminal=disjunction([model.terminal, task.terminal]),
        rewards=local_rewards(model, task),
    )
    rewards = {
        mdp.rewards[a][s] for a in range(len(actions)) for s in range(mdp.states) if mdp.applicable[a][s]
    }
    return len(rewards) > 1


def _covering_actions(random: Random, model: Model) -> list[str]:
    """Primitive actions of which one applies at each non-terminal state."""
    mdp = enumerate_model(model)
    bare = {s for s in range(mdp.states) if not mdp.terminal[s]}
    chosen: list[str] = []
    for a in random.sample(range(len(mdp.actions)), len(mdp.actions)):
        covered = {s for s in bare if mdp.applicable[a][s]}
        if covered or not chosen:
            chosen.append(mdp.actions[a])
            bare -= covered
    return chosen
