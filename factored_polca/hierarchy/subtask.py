"""A subtask as a decision process: step 2 of PolCA, "parameterise" (the paper's Eqs. 6-9).

    T(s, a, s') = T(s, p, s')           R(s, a) = R_h(s, p)           for a primitive a = p
    T(s, c, s') = T(s, pi_c(s), s')     R(s, c) = R_h(s, pi_c(s))     for a child c with policy pi_c

one step, not the whole run of the child.  R_h is the task's local reward, defined for every
primitive below the task.  A child is not applicable where its policy is undefined: where it has
ended, and where it has a dead end.
"""

from __future__ import annotations

from collections.abc import Mapping

from factored_polca.diagrams import Diagram, Field, leaves, pairs
from factored_polca.diagrams.operations import leaf_payloads
from factored_polca.hierarchy.solved import SolvedTask
from factored_polca.minimisation import Choice, DecisionProcess
from factored_polca.minimisation.criterion import ProcessView, policy_primitives
from factored_polca.models import Fault, Model, ModelError, Task
from factored_polca.models.expressions import ZERO, Expression
from factored_polca.symbolic import (
    NumericView,
    SymbolicModel,
    Term,
    compile_condition,
    compile_term,
)


def subtask_process(
    symbolic: SymbolicModel, task: Task, children: Mapping[str, SolvedTask], reachable: Diagram | None
) -> DecisionProcess:
    """The decision process of `task`, given its children solved.

    Raises:
        ModelError: a condition or reward that is undefined somewhere, or a reward that leaves the
            task nothing to optimise.
    """
    manager = symbolic.manager
    path = ("tasks", task.name)
    everywhere = manager.constant(1)
    ends = compile_condition(symbolic, task.terminal, (*path, "terminal"), ~symbolic.terminal)
    terminal = ends | symbolic.terminal
    live = ~terminal & (everywhere if reachable is None else reachable)
    numbers = {action.name: index for index, action in enumerate(symbolic.actions)}
    choices = []
    for name in task.actions:
        if name in numbers:
            primitive = numbers[name]
            choices.append(Choice(name, symbolic.actions[primitive].app & live, (primitive,)))
        else:
            child = children[name]
            app = child.defined & live
            below = policy_primitives(child.policy, app, len(symbolic.actions))
            choices.append(Choice(name, app, below, child.policy))
    primitives = sorted({p for choice in choices for p in choice.primitives})
    rewards = {p: local_reward(symbolic, task, p, live) for p in primitives}
    process = DecisionProcess(symbolic, tuple(choices), terminal, rewards, reachable)
    refuse_without_purpose(task, process)
    return process


def local_expressions(model: Model, task: Task, action: int) -> list[tuple[Expression, tuple[str, ...]]]:
    """The terms of the local reward of `task` for one action, with their places."""
    path = ("tasks", task.name, "pseudo_reward")
    primitive = model.actions[action]
    own: list[tuple[Expression, tuple[str, ...]]]
    own = [(e, (*path, str(i))) for i, e in enumerate(task.pseudo_rewards)]
    for name, terms in task.pseudo_rewards_of:
        if name == primitive.name:
            own += [(e, (*path, name)) for e in terms]
    return own


def local_reward(symbolic: SymbolicModel, task: Task, action: int, where: Diagram) -> tuple[Term, ...]:
    """The local reward of `task` for action number `action`, as terms."""
    outer = symbolic.actions[action].rewards
    if not task.has_pseudo_reward:
        return outer
    own = tuple(
        compile_term(symbolic, e, path, action, where & symbolic.actions[action].app)
        for e, path in local_expressions(symbolic.model, task, action)
        if e != ZERO
    )
    return (*outer, *own) if task.adds_reward else own


def constant_reward(process: DecisionProcess) -> bool | None:
    """Whether all applicable pairs (state, choice) have one reward: None no, else whether it is not 0.

    Rewards are compared modulo 2^61 - 1, so a constant may be seen where rewards differ by a multiple
    of it; no model that a person writes has such rewards.
    """
    field = Field()
    view = ProcessView(process, NumericView(process.symbolic, field))
    values: set[int] = set()
    for choice in process.choices:
        reward, app = view.reward(choice), view.app(choice)
        if app == process.symbolic.manager.constant(0):
            continue
        _, first, second = pairs(app, reward)
        where = leaf_payloads(app.manager, first) == 1
        values |= {int(p) for p in leaf_payloads(app.manager, second[where])}
        if len(values) > 1:
            return None
    return values != {0} if values else None


def refuse_without_purpose(task: Task, process: DecisionProcess) -> None:
    """Refuse a task whose local reward gives it nothing to optimise (DESIGN 5; the paper's 4.1).

    Raises:
        ModelError: the local reward is one constant over all applicable pairs, and it is 0 or no
            state is terminal.
    """
    found = constant_reward(process)
    if found is None:
        return
    has_end = 1 in leaves(process.terminal)
    if not found or not has_end:
        what = "one constant" if found else "0"
        end = "" if has_end else " and the task never ends"
        raise ModelError(
            [
                Fault(
                    f"task {task.name!r} has nothing to optimise: its reward is {what} for every action "
                    f"in every state{end}",
                    ("tasks", task.name, "pseudo_reward"),
                    'give it a pseudo_reward, for example "-1" a step until its terminal condition holds',
                )
            ]
        )
