"""The value of one policy, by a sparse factorisation or by sweeps; and when to stop.

For a policy pi on the free nodes:  (I - discount * P_pi) v = R_pi.  Expected numbers of steps are
values too: reward 1 a step, discount 1.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csc_array, eye_array
from scipy.sparse.linalg import splu

from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.solvers.graph import distance_order
from factored_polca.solvers.interrupts import raise_held_interrupt
from factored_polca.solvers.pairs import Pairs
from factored_polca.solvers.sweeps import backup, initial_choice

FACTORISATION_LIMIT = 1500
"""Nodes up to which sparse LU is the first choice: beyond, fill-in can take it all."""

EVALUATIONS = 100
PASSES = 2000


class TimeIsUp(Exception):
    """The deadline has passed: a signal between the loops of one solver."""


@dataclass(frozen=True)
class StopRule:
    """When to stop: `gap <= epsilon * max(1, max |V|)`, or one of the limits.

    `deadline` is a reading of `time.monotonic()`.  `progress(iterations, gap)` is called between
    passes; it may raise KeyboardInterrupt.
    """

    epsilon: float = 1e-9
    deadline: float | None = None
    iterations: int | None = None
    progress: Callable[[int, float], None] | None = field(default=None, compare=False)

    def poll(self) -> None:
        """Raises `TimeIsUp` once the deadline has passed, KeyboardInterrupt where Ctrl-C waits."""
        raise_held_interrupt()
        if self.deadline is not None and time.monotonic() >= self.deadline:
            raise TimeIsUp

    def target(self, values: FloatArray) -> float:
        """The gap at which `values` count as converged."""
        return self.epsilon * max(1.0, float(np.abs(values).max(initial=0.0)))


def evaluate_by_factorisation(pairs: Pairs, policy: IntArray, reward: FloatArray) -> FloatArray | None:
    """The value of `policy` [node] with `reward` [p], by sparse LU; None if the system is singular."""
    free = pairs.free
    values = np.zeros(pairs.nodes)
    if len(free) == 0:
        return values
    chosen = policy[free]
    rows = pairs.matrix[chosen][:, free]
    system = csc_array(eye_array(len(free)) - pairs.discount * rows)
    try:
        solution = splu(system).solve(reward[chosen])
    except RuntimeError:  # exactly singular
        return None
    if not np.all(np.isfinite(solution)):
        return None
    values[free] = solution
    return values


def greedy_choice(pairs: Pairs, q: FloatArray, keep: IntArray, margin: float) -> IntArray:
    """For each node the first pair with the largest `q`, or `keep`'s where that is within `margin`."""
    free = pairs.free
    result = keep.copy()
    if len(free) == 0:
        return result
    best = np.maximum.reduceat(q, pairs.start[free])
    better = best > q[keep[free]] + margin
    if not np.any(better):
        return result
    position = np.where(
        q == np.repeat(best, np.diff(pairs.start)[free]), np.arange(pairs.count), pairs.count
    )
    first = np.minimum.reduceat(position, pairs.start[free])
    result[free[better]] = first[better]
    return result


def first_policy(pairs: Pairs) -> IntArray:
    """The pair of each node to start from: the first one, or at discount 1 one that makes progress.

    Progress: among the pairs with a successor nearer to a node of fixed value (or that stay in a
    collapsed component), the one with the largest probability of such successors.
    """
    policy = initial_choice(pairs)
    if pairs.discount < 1 or len(pairs.free) == 0:
        return policy
    ends = np.diff(pairs.row) == 0
    target = np.diff(pairs.start) == 0
    target[pairs.owner[ends]] = True
    rank = distance_order(pairs, target, np.ones(pairs.count, dtype=np.bool_))
    nearer = rank[pairs.successor] < rank[pairs.owner[pairs.pair_of_entry]]
    progress = np.bincount(pairs.pair_of_entry, pairs.probability * nearer, minlength=pairs.count)
    progress[target[pairs.owner]] = 0.0
    progress[ends] = 2.0
    return greedy_choice(pairs, progress.astype(np.float64), policy, 0.0)


def expected_steps(pairs: Pairs, policy: IntArray, stop: StopRule) -> FloatArray | None:
    """Expected steps of `policy` [node] until a fixed node, approximately: w - P_pi w is about 1.

    None if the policy need not end, or takes so long that `PASSES` passes can't tell.

    Raises:
        TimeIsUp: the deadline has passed.
    """
    if len(pairs.free) <= FACTORISATION_LIMIT:
        return evaluate_by_factorisation(pairs, policy, np.ones(pairs.count))
    own = pairs.select(policy[pairs.free])
    ones, w, choice = np.ones(own.count), np.zeros(pairs.nodes), initial_choice(own)
    for k in range(PASSES):
        stop.poll()
        _, growth = backup(own, w, w, choice, reward=ones, backward=k % 2 == 0)
        if growth <= 0.25:
            out = np.zeros(pairs.nodes)
            _, growth = backup(own, w, out, choice, reward=ones)
            if growth <= 0.5:
                return w
            w = out
    return None


def longest_paths(
    pairs: Pairs, near: BoolArray, choice: IntArray, stop: StopRule, start: FloatArray | None
) -> FloatArray | None:
    """Expected steps until a fixed node, the largest over the pairs in `near`, approximately.

    `choice` [node] is a policy inside `near`, which contains no end component.  None if rounding got
    in the way.

    Raises:
        TimeIsUp: the deadline has passed.
    """
    if len(pairs.free) <= FACTORISATION_LIMIT:
        return _longest_by_factorisation(pairs, near, choice, stop)
    return _longest_by_sweeps(pairs, near, stop, start)


def _longest_by_factorisation(
    pairs: Pairs, near: BoolArray, choice: IntArray, stop: StopRule
) -> FloatArray | None:
    ones = np.ones(pairs.count)
    policy = choice
    for _ in range(EVALUATIONS):
        stop.poll()
        w = evaluate_by_factorisation(pairs, policy, ones)
        if w is None or np.any(w[pairs.free] < 0.5):
            return None
        q = np.where(near, pairs.matrix @ w, -np.inf)
        new = greedy_choice(pairs, q, policy, 1e-6)
        if np.array_equal(new, policy):
            return w
        policy = new
    return None


def _longest_by_sweeps(
    pairs: Pairs, near: BoolArray, stop: StopRule, start: FloatArray | None
) -> FloatArray:
    """Gauss-Seidel from below until another step adds at most a half anywhere.

    Ends because the pairs in `near` contain no end component (the caller sees to that).
    """
    reward = np.where(near, 1.0, -np.inf)
    w = np.zeros(pairs.nodes) if start is None else start.copy()
    out, choice = np.zeros(pairs.nodes), initial_choice(pairs)
    sweep = 0
    while True:
        sweep += 1
        stop.poll()
        _, growth = backup(pairs, w, w, choice, reward=reward, backward=sweep % 2 == 0)
        if growth <= 0.25:
            _, growth = backup(pairs, w, out, choice, reward=reward)
            if growth <= 0.5:
                return w
            w, out = out, w
