"""Sound bounds on V* from any approximate V, rounding included.

Letters: T the Bellman operator, d = T V - V, w a weight for each node (0 where the value is fixed).

Discount < 1 (MacQueen 1966; Puterman 1994, theorem 6.6.3).  With rows that sum to 1,
T(V + c) = T V + discount * c, hence

    T V + discount * c_low  <=  V*  <=  T V + discount * c_high,
    c_low = min d / (1 - discount),   c_high = max d / (1 - discount),

where the min and max also range over 0 if some nodes have a fixed value (they can't be shifted).

Discount 1 (after `preparation`: L <= T_pi L for a proper pi gives L <= V*, and U >= T U gives
U >= V*).  Take L = V - k_low * w and U = V + k_high * w.  With drop(p) = w(i) - sum_t P(t|p) w(t):

    L:  V(i) - Q(p) <= k_low * drop(p)    for the pair p that a proper policy takes,
    U:  Q(p) - V(i) <= k_high * drop(p)   for every pair p of i.

w is the largest expected number of steps over the pairs whose Q is near the best; there drop is
near 1, elsewhere V(i) - Q(p) is large.  Both inequalities are checked after w was found, so nothing
depends on how.  The pairs being near-optimal, they contain no end component: going round one loses
reward, so some pair on it is far from the best.

Rounding.  The true MDP is taken to have rows that sum to exactly 1, of which the arrays are the
nearest float64 (each number off by at most one unit in the last place; what rows miss 1 by is
added).  A row of k entries then gives Q with an error of at most

    e = (k + 16) * 2^-53 * (max |R| + discount * max |V|) + (max miss of a row sum) * max |V|,

by the standard bound for sums of products (Higham 2002, section 3.1); d is widened by e on both
sides before use, and results are moved outwards by one unit in the last place of max |V|.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.solvers.end_components import maximal_end_components
from factored_polca.solvers.evaluation import StopRule, longest_paths
from factored_polca.solvers.pairs import Pairs

UNIT = 2.0**-53
MINIMUM_DROP = 0.25
NEARNESS_ATTEMPTS = 30


@dataclass(frozen=True)
class Rounding:
    """The error e of a backup over `pairs`; see the module's docstring."""

    pairs: Pairs

    @cached_property
    def _constants(self) -> tuple[int, float, float]:
        pairs = self.pairs
        if pairs.count == 0:
            return 0, 0.0, 0.0
        length = np.diff(pairs.row)
        sums = np.asarray(pairs.matrix @ np.ones(pairs.nodes))[length > 0]
        miss = float(np.abs(sums - 1).max()) if len(sums) else 0.0
        return int(length.max()), float(np.abs(pairs.reward).max()), miss

    @property
    def row_miss(self) -> float:
        """The most that the sum of a row misses 1 by."""
        return self._constants[2]

    def error(self, values: FloatArray, reward: float | None = None) -> float:
        """e for one backup of `values`; `reward` replaces max |R|."""
        length, largest, miss = self._constants
        size = float(np.abs(values).max(initial=0.0))
        largest = largest if reward is None else reward
        return (length + 16) * UNIT * (largest + self.pairs.discount * size) * 1.001 + miss * size


@dataclass(frozen=True)
class Interval:
    """lower <= V* <= upper, node by node."""

    lower: FloatArray
    upper: FloatArray

    @property
    def gap(self) -> float:
        """The largest upper - lower."""
        return float(np.max(self.upper - self.lower, initial=0.0))

    def tightened(self, other: Interval) -> Interval:
        """What both know together; never wider than either."""
        return Interval(np.maximum(self.lower, other.lower), np.minimum(self.upper, other.upper))

    def middle(self, otherwise: FloatArray) -> FloatArray:
        """The middle where both ends are finite, else `otherwise` clipped to the interval."""
        finite = np.isfinite(self.lower) & np.isfinite(self.upper)
        clipped = np.clip(otherwise, self.lower, self.upper)
        with np.errstate(invalid="ignore"):
            return np.where(finite, self.lower + 0.5 * (self.upper - self.lower), clipped)


def prior_interval(pairs: Pairs) -> Interval:
    """What the rewards alone say: R_min / (1 - discount) and R_max / (1 - discount), 0 included.

    At discount 1 only a side on which no reward lies is known (0); the other is infinite.
    """
    low = float(pairs.reward.min(initial=0.0))
    high = float(pairs.reward.max(initial=0.0))
    rest = 1.0 - pairs.discount
    outward = 1.0 + 8 * UNIT + 4 * UNIT / rest if rest else 1.0
    below = low * outward / rest if rest else (0.0 if low == 0 else -np.inf)
    above = high * outward / rest if rest else (0.0 if high == 0 else np.inf)
    lower, upper = np.zeros(pairs.nodes), np.zeros(pairs.nodes)
    lower[pairs.free], upper[pairs.free] = below, above
    return Interval(lower, upper)


def shifts(rounding: Rounding, low: float, high: float, error: float) -> tuple[float, float]:
    """c_low and c_high at discount < 1 from the extremes of d over the free nodes, moved outwards."""
    pairs = rounding.pairs
    if len(pairs.free) < pairs.nodes:
        low, high = min(low, 0.0), max(high, 0.0)
    low, high = low - error, high + error
    rest = 1.0 - pairs.discount
    doubt = (4 * UNIT + rounding.row_miss) / rest
    return (low - abs(low) * doubt) / rest, (high + abs(high) * doubt) / rest


def discounted_interval(
    rounding: Rounding, backed_up: FloatArray, low: float, high: float, error: float
) -> Interval:
    """The bounds at discount < 1 from T V = `backed_up` and the extremes of d."""
    pairs = rounding.pairs
    c_low, c_high = shifts(rounding, low, high, error)
    slack = error + 4 * UNIT * (float(np.abs(backed_up).max(initial=0.0)) + abs(c_low) + abs(c_high))
    lower, upper = np.zeros(pairs.nodes), np.zeros(pairs.nodes)
    lower[pairs.free] = backed_up[pairs.free] + pairs.discount * c_low - slack
    upper[pairs.free] = backed_up[pairs.free] + pairs.discount * c_high + slack
    return Interval(lower, upper)


def value_from_below(rounding: Rounding, policy: IntArray, w: FloatArray) -> FloatArray | None:
    """L = -c * w with L <= T_pi L for the proper `policy` [node], at discount 1, so L <= V*.

    `w` [node] are about the policy's expected steps; None if they prove nothing.
    """
    pairs = rounding.pairs
    taken = policy[pairs.free]
    if np.any(w < 0):
        return None
    drop = (w[pairs.owner] - pairs.matrix @ w)[taken] - rounding.error(w, 0.0)
    if np.any(drop < MINIMUM_DROP):
        return None
    cost = float(np.max(-pairs.reward[taken] / drop, initial=0.0))
    return -(cost * (1 + 8 * UNIT)) * w


@dataclass(frozen=True)
class TotalRewardBounds:
    """A certificate at discount 1, with the weights to start the next one from."""

    interval: Interval
    weights: FloatArray


def total_reward_interval(
    rounding: Rounding,
    values: FloatArray,
    choice: IntArray,
    stop: StopRule,
    weights: FloatArray | None = None,
) -> TotalRewardBounds | None:
    """The bounds at discount 1 around `values`; `choice` [node] is the best pair at each.

    None if no weight was found: then `values` are still too far from V*.

    Raises:
        TimeIsUp: the deadline has passed.
    """
    pairs = rounding.pairs
    error = rounding.error(values)
    slack = values[pairs.owner] - pairs.q_values(values)
    residual = float(np.abs(slack[choice[pairs.free]]).max(initial=0.0))
    nearness = 4 * (residual + error)
    w = weights
    for _ in range(NEARNESS_ATTEMPTS):
        near = slack <= nearness
        near[choice[pairs.free]] = True
        if maximal_end_components(pairs, near).count:
            return None
        w = longest_paths(pairs, near, choice, stop, w)
        if w is None:
            return None
        doubt = rounding.error(w, 0.0) + UNIT * float(w.max(initial=0.0))
        drop = w[pairs.owner] - pairs.matrix @ w - doubt
        factors = _factors(pairs, slack, drop, choice, error)
        if factors is not None:
            return TotalRewardBounds(_around(values, w, *factors), w)
        if np.all(near):
            return None
        nearness = max(10 * nearness, 4 * (residual + error) * float(w.max()))
    return None


def _factors(
    pairs: Pairs, slack: FloatArray, drop: FloatArray, choice: IntArray, error: float
) -> tuple[float, float] | None:
    """k_low and k_high, or None if there are none."""
    taken = choice[pairs.free]
    if np.any(drop[taken] < MINIMUM_DROP):
        return None
    k_low = float(np.max((slack[taken] + error) / drop[taken], initial=0.0))
    excess = error - slack
    steep = drop >= MINIMUM_DROP
    k_high = float(np.max(excess[steep] / drop[steep], initial=0.0)) * (1 + 8 * UNIT)
    flat = k_high * drop[~steep]
    if np.any(excess[~steep] > flat - 8 * UNIT * np.abs(flat)):
        return None
    return k_low * (1 + 8 * UNIT), k_high


def _around(values: FloatArray, w: FloatArray, k_low: float, k_high: float) -> Interval:
    outward = 4 * UNIT * (np.abs(values) + (k_low + k_high) * w)
    return Interval(values - k_low * w - outward, values + k_high * w + outward)


def policy_drop(pairs: Pairs, values: FloatArray, fixed: BoolArray, w: FloatArray) -> float | None:
    """b such that V_pi >= V - b everywhere, at discount 1, for the policy whose pairs `pairs` are.

    `pairs` has one pair for each state that is not in `fixed`, where V_pi is 0; `w` are the expected
    steps to `fixed`.  None if `w` proves nothing.
    """
    rounding = Rounding(pairs)
    error = rounding.error(values)
    loss = values[pairs.owner] - pairs.q_values(values) + error
    drop = w[pairs.owner] - pairs.matrix @ w - rounding.error(w, 0.0)
    if np.any(drop < MINIMUM_DROP):
        return None
    k = float(np.max(loss / drop, initial=0.0))
    above = float(np.max(values[fixed], initial=0.0))
    return (above + k * float(w.max(initial=0.0))) * (1 + 8 * UNIT)
