"""A subtask as a decision process: step 2 of PolCA, "parameterise" (the paper's Eqs. 6-9).

    T(s, a, s') = T(s, p, s')           R(s, a) = R_h(s, p)           for a primitive a = p
    T(s, c, s') = T(s, pi_c(s), s')     R(s, c) = R_h(s, pi_c(s))     for a child c with policy pi_c

one step, not the whole run of the child.  R_h is the task's local reward, defined for every
primitive below the task.  A child is not applicable where its policy is undefined: where it has
ended, and where it has a dead end.

Where the state is not seen, O(o, c, s') is set likewise (section 4.4): the kernel of c at s is the joint
one of pi_c(s), pi_c(s) being what the child does where it is certain of s.  There a child is applicable
everywhere, for its parent may not know whether it has ended.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from factored_polca.diagrams import Diagram
from factored_polca.explicit.arrays import ArrayMDP
from factored_polca.minimisation import Choice, DecisionProcess
from factored_polca.minimisation.criterion import policy_primitives
from factored_polca.models import Fault, Model, ModelError, Task
from factored_polca.models.expressions import ZERO, Expression
from factored_polca.symbolic import (
    SymbolicModel,
    Term,
    compile_condition,
    compile_term,
)


class Child(Protocol):
    """What a parent needs of a solved child: its policy, state -> primitive, and where that is defined."""

    @property
    def policy(self) -> Diagram:
        """State -> number of the primitive action."""

    @property
    def defined(self) -> Diagram:
        """Where `policy` counts."""


def subtask_process(
    symbolic: SymbolicModel,
    task: Task,
    children: Mapping[str, Child],
    reachable: Diagram | None,
    channels: tuple[int, ...] | None = None,
) -> DecisionProcess:
    """The decision process of `task`, given its children solved.

    `channels` are the numbers of the observations that it plans with, None where the state is seen.

    Raises:
        ModelError: a condition or reward that is undefined somewhere.
    """
    manager = symbolic.manager
    everywhere = manager.constant(1)
    terminal = ended_condition(symbolic, task)
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
    return DecisionProcess(symbolic, tuple(choices), terminal, rewards, reachable, channels)


def ended_condition(symbolic: SymbolicModel, task: Task) -> Diagram:
    """Where a task, or the model, has ended."""
    path = ("tasks", task.name, "terminal")
    return compile_condition(symbolic, task.terminal, path, ~symbolic.terminal) | symbolic.terminal


def planning_channels(model: Model, task: Task) -> tuple[int, ...]:
    """The numbers of the observations that a task plans with: those it lists in `observes`, or all."""
    if task.observes is None:
        return tuple(range(len(model.observations)))
    return tuple(j for j, channel in enumerate(model.observations) if channel.name in task.observes)


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


def refuse_without_purpose(task: Task, mdp: ArrayMDP) -> None:
    """Refuse a task whose local reward gives it nothing to optimise (DESIGN 5; the paper's 4.1).

    `mdp` is the task's quotient.

    Raises:
        ModelError: the local reward is one constant over all applicable pairs at non-terminal states,
            and it is 0 or no terminal state can be reached.
    """
    rewards = np.unique(mdp.rewards[mdp.applicable])
    if len(rewards) != 1:
        return
    ends = any((matrix @ mdp.terminal.astype(float)).any() for matrix in mdp.transitions)
    if rewards[0] != 0 and ends:
        return
    raise nothing_to_optimise(task, zero=rewards[0] == 0, ends=ends)


def nothing_to_optimise(task: Task, *, zero: bool, ends: bool) -> ModelError:
    """The error about a task whose local reward is one constant."""
    what = "0" if zero else "one constant"
    end = "" if ends else " and the task can never end"
    return ModelError(
        [
            Fault(
                f"task {task.name!r} has nothing to optimise: its reward is {what} for every action in "
                f"every state{end}",
                ("tasks", task.name, "pseudo_reward"),
                'give it a pseudo_reward, for example "-1" a step until its terminal condition holds',
            )
        ]
    )
