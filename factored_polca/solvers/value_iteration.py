"""Interval value iteration, and modified policy iteration, which differs by one number.

One iteration is a Jacobi backup over all pairs (V -> T V, the best pair of each node, the extremes
of d = T V - V) followed by Gauss-Seidel passes: one over all pairs (value iteration), or
`policy_passes` over the best pair of each node only (Puterman & Shin 1978), each that many times
cheaper as there are actions.

Discount < 1: every backup gives bounds (`bounds.discounted_interval`); they are intersected with
those before, so they only tighten.  While it pays, V is moved to the middle of the new bounds
(Porteus 1975): this removes the slowest error, a constant.  A move is made only when the bounds are
at most `SHIFT_PROGRESS` times as wide as at the last move: so either there are infinitely many moves
and the width goes to 0, or finitely many and plain iteration contracts by the discount.

Discount 1: both start from below, at a multiple of the expected steps of a proper policy that
satisfies L <= T L.  Then the iterates rise to V*, and the greedy policies are proper.  (From above, a
loop that costs next to nothing would be followed down for as long as the rest costs.)  Where that
start is out of reach, value iteration starts from 0: it converges from anywhere once `preparation`
has done its work.  Upper bounds come from `bounds.total_reward_interval`, tried when the residual has
become small, and then for smaller ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.bounds import (
    Interval,
    Rounding,
    discounted_interval,
    prior_interval,
    total_reward_interval,
    value_from_below,
)
from factored_polca.solvers.evaluation import StopRule, TimeIsUp, expected_steps, first_policy
from factored_polca.solvers.pairs import Pairs
from factored_polca.solvers.result import Status
from factored_polca.solvers.sweeps import backup, initial_choice

POLICY_PASSES = 10
SHIFT_PROGRESS = 0.9
PATIENCE = 20
"""Backups at the level of rounding errors, none of which tightened the bounds, before giving up."""


@dataclass(frozen=True)
class Iterate:
    """Where an algorithm has got to, over the nodes of its pairs."""

    values: FloatArray  # [node]
    interval: Interval
    choice: IntArray  # [node] the best pair
    iterations: int
    status: Status

    @property
    def middle(self) -> FloatArray:
        """The middle of the interval, where it is finite."""
        return self.interval.middle(self.values)


def value_iteration(pairs: Pairs, stop: StopRule, start: FloatArray | None = None) -> Iterate:
    """Interval value iteration from `start` [node] (0 by default).

    Never raises for a limit: `status` tells which stopped it, the bounds hold all the same.
    """
    return _iterate(pairs, stop, start, 0)


def modified_policy_iteration(
    pairs: Pairs, stop: StopRule, start: FloatArray | None = None, policy_passes: int = POLICY_PASSES
) -> Iterate:
    """Value iteration with `policy_passes` cheap passes over the greedy policy after each backup.

    At discount 1 it is value iteration where no start from below is found, as there a greedy policy
    need not end.
    """
    return _iterate(pairs, stop, start, policy_passes)


def _iterate(pairs: Pairs, stop: StopRule, start: FloatArray | None, policy_passes: int) -> Iterate:
    state = _State(pairs, stop, start, policy_passes)
    try:
        if pairs.discount == 1 and start is None:
            state.start_from_below()
        while state.status is None:
            state.step()
        status = state.status
    except TimeIsUp:
        status = "time limit"
    except KeyboardInterrupt:
        status = "interrupted"
    return Iterate(state.values, state.interval, state.choice, state.iterations, status)


class _State:
    """The working state of one run.  `interval` is replaced, never changed: it holds at any time."""

    def __init__(self, pairs: Pairs, stop: StopRule, start: FloatArray | None, policy_passes: int) -> None:
        self.pairs = pairs
        self.stop = stop
        self.policy_passes = policy_passes
        self.rounding = Rounding(pairs)
        self.values = np.zeros(pairs.nodes) if start is None else start.astype(np.float64)
        self.out = np.zeros(pairs.nodes)
        self.choice = initial_choice(pairs)
        self.interval = prior_interval(pairs)
        self.iterations = 0
        self.status: Status | None = None
        self.shifted_gap = np.inf
        self.idle = 0
        self.weights: FloatArray | None = None
        self.attempt_below = np.inf

    def start_from_below(self) -> None:
        """Move to a value below V* at discount 1 and note it as a bound."""
        self._poll()
        policy = first_policy(self.pairs)
        w = expected_steps(self.pairs, policy, self.stop)
        below = None if w is None else value_from_below(self.rounding, policy, w)
        if below is None:
            self.policy_passes = 0
            return
        self.values = below
        self.interval = self.interval.tightened(Interval(below, np.full_like(below, np.inf)))

    def step(self) -> None:
        """One backup, the bounds it gives, and the passes before the next."""
        self._poll()
        if self.status is not None:
            return
        low, high = backup(self.pairs, self.values, self.out, self.choice)
        self.iterations += 1
        error = self.rounding.error(self.values)
        residual = max(abs(low), abs(high)) if low <= high else 0.0
        before = self.interval.gap
        if self.pairs.discount < 1:
            shift = self._discounted(low, high, error)
        else:
            shift = 0.0
            self._undiscounted(residual, error)
        self.values, self.out = self.out, self.values
        gap = self.interval.gap
        if gap <= self.stop.target(self.interval.middle(self.values)):
            self.status = "converged"
            return
        self.idle = self.idle + 1 if residual <= 2 * error and not gap < before else 0
        if self.idle >= PATIENCE:
            self.status = "rounding limit"
            return
        if shift:
            self.values[self.pairs.free] += shift
        self._passes()

    def _poll(self) -> None:
        if self.stop.progress is not None:
            self.stop.progress(self.iterations, self.interval.gap)
        self.stop.poll()
        if self.stop.iterations is not None and self.iterations >= self.stop.iterations:
            self.status = "iteration limit"

    def _discounted(self, low: float, high: float, error: float) -> float:
        if low > high:  # no free node
            return 0.0
        new = discounted_interval(self.rounding, self.out, low, high, error)
        self.interval = self.interval.tightened(new)
        if new.gap > SHIFT_PROGRESS * self.shifted_gap:
            return 0.0
        self.shifted_gap = new.gap
        first = self.pairs.free[0]
        return float(0.5 * (new.lower[first] + new.upper[first]) - self.out[first])

    def _undiscounted(self, residual: float, error: float) -> None:
        """Try for bounds when the residual is a fraction of what the last attempt needed."""
        target = self.stop.target(self.values)
        if self.attempt_below == np.inf:
            self.attempt_below = 0.1 * target
        if residual > self.attempt_below and residual > 2 * error:
            return
        found = total_reward_interval(self.rounding, self.values, self.choice, self.stop, self.weights)
        if found is None:
            self.attempt_below = 0.1 * min(residual, self.attempt_below)
            return
        self.weights = found.weights
        self.interval = self.interval.tightened(found.interval)
        excess = found.interval.gap / target if target > 0 else np.inf
        self.attempt_below = min(0.5 * residual, 0.5 * residual / max(excess, 1.0))

    def _passes(self) -> None:
        if self.policy_passes == 0:
            backup(self.pairs, self.values, self.values, self.choice, backward=self.iterations % 2 == 0)
            return
        policy = self.pairs.select(self.choice[self.pairs.free])
        ignored = initial_choice(policy)
        for k in range(self.policy_passes):
            self.stop.poll()
            backup(policy, self.values, self.values, ignored, backward=k % 2 == 0)
