"""The MDP that one task of a hierarchy solves, given the policies of its children.

For the task h: its states are the model's; it ends where the model ends or its own condition holds;
its actions are its primitives and one abstract action for each child (`exact_mdp`); its reward is the
model's, or its pseudo-rewards in place of the model's, or both where the task says so.  The reward
must be defined for every primitive below h, since a child may choose any of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from factored_polca.explicit.enumeration import MAXIMUM_STATES, enumerate_model
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.models.errors import ModelError
from factored_polca.models.expressions import Expression, disjunction
from factored_polca.models.model import Model
from factored_polca.models.tasks import Task, TaskHierarchy, resolve_tasks


def primitives_below(model: Model, hierarchy: TaskHierarchy, task: str) -> tuple[str, ...]:
    """The primitive actions that `task` or a task below it may choose, in the model's order.

    Raises:
        KeyError: an unknown task or action; the message lists those there are.
    """
    tasks = {known.name for known in hierarchy.tasks}
    found: set[str] = set()
    waiting, seen = [task], {task}
    while waiting:
        for name in hierarchy.task(waiting.pop()).actions:
            if name not in tasks:
                found.add(model.action(name).name)
            elif name not in seen:
                seen.add(name)
                waiting.append(name)
    return tuple(action.name for action in model.actions if action.name in found)


def local_rewards(model: Model, task: Task) -> dict[str, tuple[Expression, ...]]:
    """The terms of the task's local reward for each primitive action of the model."""
    own = dict(task.pseudo_rewards_of)
    terms: dict[str, tuple[Expression, ...]] = {}
    for action in model.actions:
        pseudo = (*task.pseudo_rewards, *own.get(action.name, ()))
        outer = (*model.rewards, *action.rewards)
        if not task.has_pseudo_reward:
            terms[action.name] = outer
        else:
            terms[action.name] = (*outer, *pseudo) if task.adds_reward else pseudo
    return terms


def subtask_mdp(
    model: Model,
    hierarchy: TaskHierarchy,
    task: str,
    policies: Mapping[str, Sequence[int]] | None = None,
    *,
    maximum_states: int = MAXIMUM_STATES,
) -> ExactMDP:
    """The exact MDP of `task`, its actions in the task's order.

    `policies[child][s]` is the number *among the model's actions* of the primitive that the child
    chooses at state s, or -1 where the child does not apply.

    Raises:
        ModelError: as `enumerate_model`, or a child without a policy.
        ValueError: a policy that chooses an action that is not below the task or does not apply.
        LimitReached: more than `maximum_states` states.
    """
    policies = policies or {}
    described = resolve_tasks(model, hierarchy).task(task)
    primitives = primitives_below(model, hierarchy, task)
    children = [name for name in described.actions if name not in primitives]
    for child in children:
        if child not in policies:
            raise ModelError(f"task {task!r}: the child {child!r} has no policy; solve it first")
    mdp = enumerate_model(
        model,
        actions=primitives,
        terminal=disjunction([model.terminal, described.terminal]),
        rewards=local_rewards(model, described),
        maximum_states=maximum_states,
    )
    numbers = {model.actions.index(model.action(name)): i for i, name in enumerate(primitives)}
    abstract: dict[str, list[int]] = {}
    for child in children:
        chosen = {a for s, a in enumerate(policies[child]) if a >= 0 and not mdp.terminal[s]}
        for a in chosen - set(numbers):
            raise ValueError(
                f"the policy of {child!r} chooses the action number {a}, which is not below {task!r}; "
                f"there are {', '.join(primitives)}"
            )
        abstract[child] = [numbers.get(a, -1) for a in policies[child]]
    return mdp.with_abstract_actions(abstract).restrict(described.actions)
