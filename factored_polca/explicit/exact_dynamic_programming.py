"""Policy evaluation and optimal values in exact rationals, for small MDPs.

Values are rationals, or minus infinity at *lost* states: dead ends (neither terminal nor an
applicable action) and states that cannot avoid them surely.  Terminal states have the value 0.

Optimal values come from policy iteration (Howard 1960) that changes an action only where another
is strictly better, so exact ties cannot make it circle.  With gamma = 1 it starts from a policy that
ends surely; the strict improvements of such a policy also end surely unless there is a circle of
positive mean reward (Bertsekas & Tsitsiklis 1991).  Staying for ever in a set of states with rewards
0 is worth 0 and counts as an end.  Circles of mean reward 0 whose rewards are not all 0 have no
defined value; they are not looked for, and the result is then the best among the other policies.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, TypeAlias

from factored_polca.explicit.elimination import SingularSystem, solve
from factored_polca.explicit.exact_mdp import ExactMDP, Row

ExactValue: TypeAlias = Fraction | float
"""A rational, or `LOST`."""

LOST: Final = -math.inf
"""The value of a state that cannot avoid a dead end."""

NO_ACTION: Final = -1


@dataclass(frozen=True)
class ExactSolution:
    """Optimal values, and an optimal policy (`NO_ACTION` at terminal and lost states)."""

    values: tuple[ExactValue, ...]  # [s]
    policy: tuple[int, ...]  # [s]


def lost_states(mdp: ExactMDP) -> tuple[bool, ...]:
    """The states from which no policy avoids a dead end surely."""
    lost = [False] * mdp.states
    while True:
        grown = [
            not mdp.terminal[s] and not any(_is_safe(mdp, a, s, lost) for a in range(len(mdp.actions)))
            for s in range(mdp.states)
        ]
        if grown == lost:
            return tuple(lost)
        lost = grown


def _is_safe(mdp: ExactMDP, a: int, s: int, lost: Sequence[bool]) -> bool:
    return mdp.applicable[a][s] and not any(lost[t] for t in mdp.rows[a][s])


def action_values(mdp: ExactMDP, values: Sequence[ExactValue]) -> tuple[tuple[ExactValue, ...], ...]:
    """Q [a][s] for the continuation `values`; `LOST` where a does not apply or may enter a lost state."""
    return tuple(
        tuple(_action_value(mdp, values, a, s) for s in range(mdp.states)) for a in range(len(mdp.actions))
    )


def _action_value(mdp: ExactMDP, values: Sequence[ExactValue], a: int, s: int) -> ExactValue:
    if not mdp.applicable[a][s]:
        return LOST
    total = mdp.rewards[a][s]
    for t, chance in mdp.rows[a][s].items():
        value = values[t]
        if not isinstance(value, Fraction):
            return LOST
        total += mdp.discount * chance * value
    return total


def evaluate_policy(mdp: ExactMDP, policy: Sequence[int]) -> tuple[ExactValue, ...]:
    """V [s] of `policy[s]`, an action's number, or -1 for none, which is a dead end unless s is terminal.

    With gamma = 1 a closed set of states with rewards 0 has the value 0.

    Raises:
        ValueError: another length, an action that does not apply, or at gamma = 1 a policy that stays
            for ever where rewards are not 0, so that its value is infinite or undefined.
    """
    if len(policy) != mdp.states:
        raise ValueError(f"the policy has {len(policy)} entries for {mdp.states} states")
    rows: list[Row] = [{} for _ in policy]
    rewards = [Fraction(0)] * mdp.states
    dead = [False] * mdp.states
    for s, a in enumerate(policy):
        if mdp.terminal[s]:
            continue
        if a < 0:
            dead[s] = True
        elif not mdp.applicable[a][s]:
            raise ValueError(
                f"the policy chooses {mdp.actions[a]!r} at state {s} {mdp.state_values[s]}, "
                "where it does not apply"
            )
        else:
            rows[s], rewards[s] = mdp.rows[a][s], mdp.rewards[a][s]
    lost = _backward_closure(rows, dead)
    worthless = list(mdp.terminal)
    if mdp.discount == 1:
        # States that can never meet a reward again are worth 0.
        worthless = [not hit for hit in _backward_closure(rows, [bool(r) for r in rewards])]
    return _solve_chain(mdp, rows, rewards, lost, worthless)


def _backward_closure(rows: Sequence[Row], start: Sequence[bool]) -> list[bool]:
    """The states from which one of `start` can be reached, these included."""
    before: list[list[int]] = [[] for _ in rows]
    for s, row in enumerate(rows):
        for t in row:
            before[t].append(s)
    hit = list(start)
    waiting = [s for s, inside in enumerate(start) if inside]
    while waiting:
        for s in before[waiting.pop()]:
            if not hit[s]:
                hit[s] = True
                waiting.append(s)
    return hit


def _solve_chain(
    mdp: ExactMDP,
    rows: Sequence[Row],
    rewards: Sequence[Fraction],
    lost: Sequence[bool],
    worthless: Sequence[bool],
) -> tuple[ExactValue, ...]:
    unknown = [s for s in range(mdp.states) if not lost[s] and not worthless[s]]
    column = {s: i for i, s in enumerate(unknown)}
    matrix: list[dict[int, Fraction]] = []
    for s in unknown:
        equation = {column[s]: Fraction(1)}
        for t, chance in rows[s].items():
            if t in column:
                entry = equation.get(column[t], Fraction(0)) - mdp.discount * chance
                equation[column[t]] = entry
        matrix.append(equation)
    try:
        solution = solve(matrix, [rewards[s] for s in unknown])
    except SingularSystem as error:
        raise ValueError(
            "with discount 1 the policy stays for ever in states whose rewards are not all 0: its value "
            "is infinite or undefined; give a discount below 1 or a policy that ends"
        ) from error
    values: list[ExactValue] = [LOST if gone else Fraction(0) for gone in lost]
    for s, value in zip(unknown, solution, strict=True):
        values[s] = value
    return tuple(values)


def optimal_solution(mdp: ExactMDP) -> ExactSolution:
    """Optimal values and a policy; with gamma < 1 the first best action in the MDP's order.

    Raises:
        ValueError: at gamma = 1, a state that no policy surely leads to an end, or an infinite value.
    """
    lost = lost_states(mdp)
    if mdp.discount == 1:
        resting = _resting_actions(mdp)
        policy = _ending_policy(mdp, lost, resting)
    else:
        resting = [NO_ACTION] * mdp.states
        policy = [_first_safe(mdp, s, lost) for s in range(mdp.states)]
    while True:
        values = evaluate_policy(mdp, policy)
        improved = [_improve(mdp, values, s, a, resting[s]) for s, a in enumerate(policy)]
        if improved == policy:
            break
        policy = improved
    if mdp.discount < 1:
        q = action_values(mdp, values)
        for s, value in enumerate(values):
            if policy[s] != NO_ACTION:
                policy[s] = next(a for a in range(len(q)) if q[a][s] == value)
    return ExactSolution(values, tuple(policy))


def _first_safe(mdp: ExactMDP, s: int, lost: Sequence[bool]) -> int:
    if mdp.terminal[s]:
        return NO_ACTION
    return next((a for a in range(len(mdp.actions)) if _is_safe(mdp, a, s, lost)), NO_ACTION)


def _improve(mdp: ExactMDP, values: Sequence[ExactValue], s: int, chosen: int, resting: int) -> int:
    """A strictly better action at s than `chosen` if there is one."""
    if chosen == NO_ACTION:
        return NO_ACTION
    best, value = chosen, values[s]
    for a in range(len(mdp.actions)):
        q = _action_value(mdp, values, a, s)
        if q > value:
            best, value = a, q
    return resting if resting != NO_ACTION and value < 0 else best


def _resting_actions(mdp: ExactMDP) -> list[int]:
    """For each state an action with which it can stay for ever among rewards 0, or `NO_ACTION`."""

    def rests(a: int, s: int, inside: Sequence[bool]) -> bool:
        return mdp.applicable[a][s] and not mdp.rewards[a][s] and all(inside[t] for t in mdp.rows[a][s])

    resting = [True] * mdp.states
    while True:
        actions = [NO_ACTION] * mdp.states
        for s in range(mdp.states):
            if resting[s] and not mdp.terminal[s]:
                actions[s] = next((a for a in range(len(mdp.actions)) if rests(a, s, resting)), NO_ACTION)
        kept = [mdp.terminal[s] or actions[s] != NO_ACTION for s in range(mdp.states)]
        if kept == resting:
            return actions
        resting = kept


def _ending_policy(mdp: ExactMDP, lost: Sequence[bool], resting: Sequence[int]) -> list[int]:
    """A policy that surely ends, or rests, wherever it starts outside `lost`."""
    goal = [mdp.terminal[s] or resting[s] != NO_ACTION for s in range(mdp.states)]
    policy = list(resting)
    reached = list(goal)
    allowed = [not gone for gone in lost]
    grew = True
    while grew:
        grew = False
        for s in range(mdp.states):
            if reached[s] or not allowed[s]:
                continue
            for a, rows in enumerate(mdp.rows):
                inside = mdp.applicable[a][s] and all(allowed[t] for t in rows[s])
                if inside and any(reached[t] for t in rows[s]):
                    policy[s], reached[s], grew = a, True, True
                    break
    stuck = [s for s in range(mdp.states) if allowed[s] and not reached[s]]
    if stuck:
        raise ValueError(
            f"with discount 1 no policy surely ends from state {stuck[0]} {mdp.state_values[stuck[0]]}; "
            "give a discount below 1"
        )
    return policy
