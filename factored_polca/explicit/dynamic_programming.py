"""Plain dynamic programming in floating point, the oracle for the solvers.

    V(s) = max over applicable a of  R(s, a) + gamma * sum over t of T(s, a, t) V(t)

(Bellman 1957).  Terminal states have the value 0.  A *dead end* (neither terminal nor an applicable
action) has the value minus infinity, and so has every action that may enter such a state; a state
all of whose actions have it is lost too, whatever the discount.  `exact_dynamic_programming` is the
same in rationals.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.sparse import eye_array
from scipy.sparse.linalg import spsolve

from factored_polca.explicit.arrays import ArrayMDP, BoolArray, FloatArray
from factored_polca.models.errors import LimitReached

MAXIMUM_ITERATIONS: Final = 1_000_000


def lost_states(mdp: ArrayMDP) -> BoolArray:
    """[s], the states from which no policy avoids a dead end surely."""
    lost: BoolArray = ~mdp.terminal & ~mdp.applicable.any(axis=0)
    while True:
        safe = safe_actions(mdp, lost)
        grown: BoolArray = ~mdp.terminal & ~safe.any(axis=0)
        if np.array_equal(grown, lost):
            return lost
        lost = grown


def safe_actions(mdp: ArrayMDP, lost: BoolArray) -> BoolArray:
    """[a, s], the applicable actions that surely avoid the states `lost`."""
    safe = mdp.applicable.copy()
    for a, matrix in enumerate(mdp.transitions):
        safe[a] &= (matrix @ lost.astype(np.float64)) == 0
    return safe


def action_values(mdp: ArrayMDP, values: FloatArray) -> FloatArray:
    """[a, s], Q(s, a) for the continuation `values`; minus infinity where a does not apply."""
    lost = np.isneginf(values)
    finite = np.where(lost, 0.0, values)
    backed = np.stack([matrix @ finite for matrix in mdp.transitions])
    q: FloatArray = np.where(safe_actions(mdp, lost), mdp.rewards + mdp.discount * backed, -np.inf)
    return q


def value_iteration(
    mdp: ArrayMDP, tolerance: float = 1e-11, maximum_iterations: int = MAXIMUM_ITERATIONS
) -> FloatArray:
    """V [s] by value iteration from 0.

    With gamma < 1 the result is within `tolerance` of V (up to rounding).  With gamma = 1 it stops
    when a step changes less than `tolerance`, which bounds nothing: use it there only where every
    policy ends surely, or as a plausibility check.

    Raises:
        LimitReached: no convergence within `maximum_iterations`.
    """
    lost = lost_states(mdp)
    values: FloatArray = np.where(lost, -np.inf, 0.0)
    gamma = mdp.discount
    enough = tolerance if gamma == 1 else tolerance * (1 - gamma) / max(gamma, 1e-300)
    for _ in range(maximum_iterations):
        improved = np.where(mdp.terminal, 0.0, action_values(mdp, values).max(axis=0, initial=-np.inf))
        change = np.abs(improved[~lost] - values[~lost]).max(initial=0.0)
        values = improved
        # Below a few units in the last place the change is rounding noise and no longer shrinks.
        noise = 4 * np.spacing(np.abs(values[~lost]).max(initial=0.0))
        if change <= max(enough, noise):
            return values
    raise LimitReached(
        f"value iteration did not converge in {maximum_iterations} iterations", "value iteration", values
    )


def greedy_policy(q: FloatArray, tolerance: float = 1e-9) -> tuple[int, ...]:
    """At each state the first action within `tolerance` * max(1, |Q|) of the best; -1 if all are -inf."""
    best = q.max(axis=0, initial=-np.inf)
    with np.errstate(invalid="ignore"):
        near = q >= best - tolerance * np.maximum(1.0, np.abs(best))
    near &= np.isfinite(q)
    return tuple(int(column.argmax()) if column.any() else -1 for column in near.T)


def evaluate_policy(mdp: ArrayMDP, policy: Sequence[int]) -> FloatArray:
    """V [s] of the policy `policy[s]` (an action's number, or -1 for none) by one sparse solve.

    Raises:
        ValueError: the policy has another length, chooses an action that does not apply, or (gamma = 1)
            the equations are singular.
    """
    if len(policy) != mdp.states:
        raise ValueError(f"the policy has {len(policy)} entries for {mdp.states} states")
    one_action = _chain(mdp, policy)
    lost = lost_states(one_action)
    system = eye_array(mdp.states, format="csr") - mdp.discount * one_action.transitions[0]
    # A lost state's equation is V = 0, so that what the others solve stays finite.
    keep = np.where(lost, 0.0, 1.0)
    identity = eye_array(mdp.states, format="csr")
    system = identity - (identity - system).multiply(keep[:, None]).tocsr()
    values: FloatArray = np.atleast_1d(spsolve(system.tocsc(), one_action.rewards[0] * keep))
    if not np.isfinite(values).all():
        raise ValueError("the policy has no finite value: with discount 1 it may never end")
    return np.where(lost, -np.inf, values)


def _chain(mdp: ArrayMDP, policy: Sequence[int]) -> ArrayMDP:
    """The MDP whose only action is what `policy` chooses."""
    states = mdp.states
    rewards, applicable = np.zeros((1, states)), np.zeros((1, states), dtype=np.bool_)
    chosen = np.array(policy)
    chosen[mdp.terminal] = -1
    total = None
    for a, matrix in enumerate(mdp.transitions):
        here = chosen == a
        if (here & ~mdp.applicable[a]).any():
            s = int(np.argmax(here & ~mdp.applicable[a]))
            raise ValueError(f"the policy chooses {mdp.actions[a]!r} at state {s}, where it does not apply")
        part = matrix.multiply(here.astype(np.float64)[:, None]).tocsr()
        total = part if total is None else total + part
        rewards[0, here] = mdp.rewards[a, here]
        applicable[0, here] = True
    return ArrayMDP(("chosen",), (total,), rewards, applicable, mdp.terminal, mdp.discount)
