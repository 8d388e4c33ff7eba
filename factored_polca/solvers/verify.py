"""What can be wrong with a solution, whoever made it: types, shapes, bounds in order, a policy that fits.

Cheap checks without solving anything: what they pass may still be wrong, as a bound that does not hold;
`factored_polca.testing.check_solver` looks for that on problems whose values are known.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, get_args

import numpy as np

from factored_polca.explicit.alpha_vectors import AlphaVectors, StagedVectors
from factored_polca.explicit.arrays import ArrayMDP, FloatArray
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.solvers.pomdp_problem import prepare
from factored_polca.solvers.pomdp_result import POMDPSolution
from factored_polca.solvers.result import Guarantee, GuaranteeKind, MDPSolution, Status

SLACK: Final = 1e-9
"""Rounding that is let pass, as a share of max(1, |value|)."""


def pomdp_faults(found: object, pomdp: ArrayPOMDP, roots: FloatArray | None = None) -> list[str]:
    """What is wrong with the solution of a partially observed problem; empty: nothing that shows."""
    if not isinstance(found, POMDPSolution):
        return [f"it is {_kind(found)}, not a POMDPSolution"]
    return [
        *_wrong_words(found),
        *_wrong_bounds(found, pomdp),
        *_wrong_roots(found, pomdp, roots),
        *policy_faults(found.policy, pomdp),
    ]


def mdp_faults(found: object, mdp: ArrayMDP) -> list[str]:
    """What is wrong with the solution of a fully observed problem; empty: nothing that shows."""
    if not isinstance(found, MDPSolution):
        return [f"it is {_kind(found)}, not an MDPSolution"]
    count, states = len(mdp.actions), mdp.states
    wanted = {
        "values": (states,), "lower": (states,), "upper": (states,), "q_values": (count, states),
        "policy": (states,), "dead_ends": (states,),
    }  # fmt: skip
    faults = [*_wrong_words(found)]
    for name, shape in wanted.items():
        array = getattr(found, name)
        if not isinstance(array, np.ndarray) or array.shape != shape:
            faults.append(f"{name} is {_kind(array)}, not an array of the shape {shape}")
    if faults:
        return faults
    return [*_wrong_values(found, mdp), *_wrong_choices(found, mdp)]


def _kind(thing: Any) -> str:
    return f"an array of the shape {thing.shape}" if isinstance(thing, np.ndarray) else type(thing).__name__


def _slack(*numbers: float) -> float:
    return SLACK * max([1.0, *(abs(number) for number in numbers if np.isfinite(number))])


def _wrong_words(found: POMDPSolution | MDPSolution) -> Iterator[str]:
    if found.status not in get_args(Status):
        yield f"the status is {found.status!r}, none of {', '.join(get_args(Status))}"
    if not isinstance(found.guarantee, Guarantee) or found.guarantee.kind not in get_args(GuaranteeKind):
        yield f"the guarantee is none of the kinds {', '.join(get_args(GuaranteeKind))}"
    if not isinstance(found.method, str):
        yield f"the method is {_kind(found.method)}, not a text"


def _wrong_bounds(found: POMDPSolution, pomdp: ArrayPOMDP) -> Iterator[str]:
    numbers = {"lower": found.lower, "upper": found.upper, "value": found.value}
    for name, number in numbers.items():
        if not isinstance(number, int | float) or np.isnan(number):
            yield f"{name} is {number!r}, not a number"
            return
    slack = _slack(*numbers.values())
    if found.lower > found.upper + slack:
        yield f"the lower bound {found.lower:g} is above the upper bound {found.upper:g}"
    elif not found.lower - slack <= found.value <= found.upper + slack:
        yield f"the value {found.value:g} is not between the bounds {found.lower:g} and {found.upper:g}"
    if pomdp.discount < 1:
        least = float(pomdp.rewards.min(initial=0.0)) / (1 - pomdp.discount)
        largest = float(pomdp.rewards.max(initial=0.0)) / (1 - pomdp.discount)
        if found.lower > largest + _slack(largest):
            yield f"the lower bound {found.lower:g} is above all that rewards allow, {largest:g}"
        if found.upper < least - _slack(least):
            yield f"the upper bound {found.upper:g} is below all that rewards allow, {least:g}"


def _wrong_roots(found: POMDPSolution, pomdp: ArrayPOMDP, roots: FloatArray | None) -> Iterator[str]:
    wanted = (len(prepare(pomdp, roots).roots),)
    for name in ("root_lower", "root_upper"):
        array = getattr(found, name)
        if not isinstance(array, np.ndarray) or array.shape != wanted:
            yield (
                f"{name} is {_kind(array)}, not an array of the shape {wanted}: one for each different "
                "part (by what is seen) of the initial belief and of the roots, in this order"
            )
            return
        if np.isnan(array).any():
            yield f"{name} has an entry that is not a number"
            return
    worst = float((found.root_lower - found.root_upper).max(initial=-np.inf))
    if worst > _slack(*found.root_upper.tolist()):
        yield f"at a root the lower bound is {worst:g} above the upper one"


def policy_faults(policy: object, pomdp: ArrayPOMDP) -> list[str]:
    """What is wrong with a policy for a partially observed problem."""
    if isinstance(policy, AlphaVectors):
        return [*_wrong_vectors(policy, pomdp)]
    if isinstance(policy, StagedVectors):
        return [fault for stage in policy.stages for fault in _wrong_vectors(stage, pomdp)]
    if isinstance(policy, PolicyGraph):
        return [*_wrong_graph(policy, pomdp)]
    if isinstance(policy, EntropyPolicy):
        return []
    return [
        f"the policy is {_kind(policy)}, none of AlphaVectors, StagedVectors, PolicyGraph and EntropyPolicy"
    ]


def _wrong_vectors(policy: AlphaVectors, pomdp: ArrayPOMDP) -> Iterator[str]:
    if policy.states != pomdp.states:
        yield f"the policy is for {policy.states} states, not for {pomdp.states}"
        return
    known = np.zeros(pomdp.states, dtype=np.int64)
    for y, part in enumerate(policy.sets):
        count = len(part.states)
        if len(part.states) and not (part.states.min() >= 0 and part.states.max() < pomdp.states):
            yield f"set {y} of the policy has a state outside 0 .. {pomdp.states - 1}"
            return
        if part.vectors.ndim != 2 or part.vectors.shape[1] != count or not len(part.vectors):
            yield f"set {y} of the policy has {_kind(part.vectors)}, not vectors [n, {count}], n from 1 on"
            return
        if len(part.actions) != len(part.vectors):
            yield f"set {y} of the policy has {len(part.actions)} actions for {len(part.vectors)} vectors"
            return
        if not np.isfinite(part.vectors).all():
            yield f"set {y} of the policy has a vector that is not finite"
        if not np.isin(part.actions, np.arange(len(pomdp.actions))).all():
            yield f"set {y} of the policy has an action outside 0 .. {len(pomdp.actions) - 1}"
        live = part.states[~pomdp.terminal[part.states]]
        if len(np.unique(pomdp.observed[live])) > 1:
            yield f"set {y} of the policy joins states that are seen to differ: one set for each `observed`"
        np.add.at(known, part.states, 1)
    if (known > 1).any():
        yield f"state {int(known.argmax())} is in more than one set of the policy"


def _wrong_graph(policy: PolicyGraph, pomdp: ArrayPOMDP) -> Iterator[str]:
    width = int(pomdp.observed.max()) + 1
    if len(policy.successors) != policy.nodes:
        yield f"the policy graph has {len(policy.successors)} tables for {policy.nodes} nodes"
        return
    if not np.isin(policy.actions, np.arange(len(pomdp.actions))).all():
        yield f"the policy graph has an action outside 0 .. {len(pomdp.actions) - 1}"
        return
    for node, table in enumerate(policy.successors):
        wanted = (len(pomdp.kernel[int(policy.actions[node])]), width)
        if table.shape != wanted:
            yield f"node {node} of the policy graph has {_kind(table)}, not {wanted} [o, y]"
            return
        if table.size and not (table.min() >= -1 and table.max() < policy.nodes):
            yield f"node {node} of the policy graph leads outside -1 .. {policy.nodes - 1}"
            return
    if policy.start.shape != (width,) or not (
        -1 <= policy.start.min() <= policy.start.max() < policy.nodes
    ):
        yield f"the policy graph's start is {_kind(policy.start)}, not {(width,)} [y] of node numbers"


def _wrong_values(found: MDPSolution, mdp: ArrayMDP) -> Iterator[str]:
    live = ~found.dead_ends.astype(np.bool_)
    for name in ("values", "lower", "upper"):
        if np.isnan(getattr(found, name)[live]).any():
            yield f"{name} has an entry that is not a number"
            return
    lower, values, upper = found.lower[live], found.values[live], found.upper[live]
    slack = _slack(*values.tolist())
    if (lower > upper + slack).any():
        state = int(np.flatnonzero(live)[(lower - upper).argmax()])
        yield (
            f"in state {state} the lower bound {found.lower[state]:g} is above the upper bound "
            f"{found.upper[state]:g}"
        )
    elif ((values < lower - slack) | (values > upper + slack)).any():
        state = int(np.flatnonzero(live)[((values < lower - slack) | (values > upper + slack)).argmax()])
        yield f"in state {state} the value {found.values[state]:g} is not between the bounds"
    wrong = mdp.terminal & ((found.lower > slack) | (found.upper < -slack))
    if wrong.any():
        yield f"the terminal state {int(wrong.argmax())} has a value other than 0"


def _wrong_choices(found: MDPSolution, mdp: ArrayMDP) -> Iterator[str]:
    policy, count = found.policy, len(mdp.actions)
    if not np.issubdtype(policy.dtype, np.integer):
        yield f"the policy has entries of the type {policy.dtype}, not whole numbers"
        return
    if len(policy) and not (policy.min() >= -1 and policy.max() < count):
        yield f"the policy has an action outside -1 .. {count - 1}"
        return
    chosen = np.flatnonzero(policy >= 0)
    wrong = chosen[~mdp.applicable[policy[chosen], chosen]]
    if len(wrong):
        state = int(wrong[0])
        yield f"in state {state} the policy takes {mdp.actions[policy[state]]!r}, which is not applicable"
    idle = (policy < 0) & ~mdp.terminal & ~found.dead_ends.astype(np.bool_)
    if idle.any():
        yield f"in state {int(idle.argmax())} the policy has no action, though it is no dead end"
