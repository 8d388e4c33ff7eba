"""The policy that a solution hands out: ties decided by the order of the actions, and its loss.

Among the actions of s with  Q(a, s) >= max Q - tau,  tau = 1e-9 * max(1, |max Q|) + gap, the first
in action order is taken; the solver's gap counts only if the solver converged (else it could let
anything pass).  So a change of the last bit of a value doesn't change the policy.

At discount 1 such a policy may go round for ever although each step is nearly optimal: a loop that
costs less than tau, or moves that earn 0 inside a collapsed component.  The chain of the policy is
checked: a closed class is in order if it is terminal or earns exactly 0 on every step and staying
there is optimal (within tau).  States that can't reach such a class switch to the first qualified
action that makes progress: that has a successor which comes earlier in a breadth-first search, over
qualified actions, from the states in order.  Where no qualified action leads there, a component in
which staying is optimal is stayed in.

The loss, with V the middle of the bounds and b from Q_V(pi(s), s) - V(s) (as in `bounds`, for the
operator of pi alone):  V_pi >= V - b, so V* - V_pi <= max (upper - V) + b.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.solvers.bounds import Rounding, policy_drop, shifts
from factored_polca.solvers.evaluation import StopRule, TimeIsUp, longest_paths
from factored_polca.solvers.graph import distance_order, strong_components
from factored_polca.solvers.pairs import Pairs
from factored_polca.solvers.preparation import Prepared
from factored_polca.solvers.sweeps import initial_choice

TIE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class GreedyPolicy:
    """`policy` [s] (-1: no action), `pair` [s] its pair in `Prepared.original`, and what it costs."""

    policy: IntArray
    pair: IntArray
    ties: int
    residual: float


def q_table(prepared: Prepared, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(Q [a, s], Q of the pairs of `prepared.original`) one step ahead of `values` [node]."""
    pairs = prepared.original
    mine = pairs.q_values(values[prepared.node])
    table = np.full((len(prepared.mdp.actions), prepared.mdp.states), -np.inf)
    table[pairs.action, pairs.state] = mine
    return table, mine


def greedy_policy(prepared: Prepared, values: FloatArray, q: FloatArray, gap: float) -> GreedyPolicy:
    """The tie-broken policy for `values` [node] and `q` [p] over `prepared.original`."""
    pairs, free = prepared.original, prepared.original.free
    policy = np.full(pairs.nodes, -1, dtype=np.int64)
    pair = initial_choice(pairs)
    if len(free) == 0:
        return GreedyPolicy(policy, pair, 0, 0.0)
    best = np.full(pairs.nodes, -np.inf)
    best[free] = np.maximum.reduceat(q, pairs.start[free])
    tolerance = TIE_TOLERANCE * np.maximum(1.0, np.abs(best)) + gap
    qualified = q >= (best - tolerance)[pairs.owner]
    pair[free] = _first_of(pairs, qualified)[free]
    if pairs.discount == 1:
        staying = (prepared.component >= 0) & (values[prepared.node] <= tolerance)
        pair = _proper(prepared, pair, qualified, staying)
    policy[free] = pairs.action[pair[free]]
    ties = int(np.sum(np.bincount(pairs.owner[qualified], minlength=pairs.nodes) > 1))
    residual = float(np.abs(best[free] - values[prepared.node][free]).max())
    return GreedyPolicy(policy, pair, ties, residual)


def _first_of(pairs: Pairs, mask: BoolArray) -> IntArray:
    """The first pair of each node that is in `mask`; `pairs.count` where there is none."""
    result = np.full(pairs.nodes, pairs.count, dtype=np.int64)
    position = np.where(mask, np.arange(pairs.count), pairs.count)
    result[pairs.free] = np.minimum.reduceat(position, pairs.start[pairs.free])
    return result


def _taken(pairs: Pairs, pair: IntArray) -> BoolArray:
    mask = np.zeros(pairs.count, dtype=np.bool_)
    mask[pair[pairs.free]] = True
    return mask


def _targets(pairs: Pairs, pair: IntArray, staying: BoolArray) -> BoolArray:
    """The states of closed classes that are in order under the policy `pair`; fixed states too."""
    taken = _taken(pairs, pair)
    label = strong_components(pairs, taken)
    own = np.repeat(label[pairs.owner], np.diff(pairs.row))
    leaving = np.bincount(pairs.pair_of_entry[label[pairs.successor] != own], minlength=pairs.count) > 0
    wrong = taken & (leaving | (pairs.reward != 0) | ~staying[pairs.owner])
    spoilt = np.zeros(pairs.nodes, dtype=np.bool_)
    spoilt[label[pairs.owner[wrong]]] = True
    return np.asarray(~spoilt[label], dtype=np.bool_)


def _proper(prepared: Prepared, pair: IntArray, qualified: BoolArray, staying: BoolArray) -> IntArray:
    """`pair` [s] repaired so that every state gets to a class in order with probability 1."""
    pairs = prepared.original
    target = _targets(pairs, pair, staying)
    good = distance_order(pairs, target, _taken(pairs, pair)) >= 0
    if np.all(good):
        return pair
    result, good = _make_progress(pairs, pair, qualified, good)
    stays = ~good & staying
    if np.any(stays):
        result[stays] = _first_of(pairs, _inside(prepared))[stays]
        result, good = _make_progress(pairs, result, qualified, good | stays)
    return result


def _make_progress(
    pairs: Pairs, pair: IntArray, qualified: BoolArray, good: BoolArray
) -> tuple[IntArray, BoolArray]:
    """The states outside `good` switched to their first qualified pair that comes nearer to it, and
    all the states that get there now."""
    rank = distance_order(pairs, good, qualified)
    nearer = rank[pairs.successor] < rank[pairs.owner[pairs.pair_of_entry]]
    nearer &= rank[pairs.successor] >= 0
    progress = qualified & (np.bincount(pairs.pair_of_entry[nearer], minlength=pairs.count) > 0)
    switched = ~good & (rank >= 0)
    return np.where(switched, _first_of(pairs, progress), pair), rank >= 0


def _inside(prepared: Prepared) -> BoolArray:
    """The pairs of reward 0 that can't leave their collapsed component."""
    pairs, label = prepared.original, prepared.component
    own = np.repeat(label[pairs.owner], np.diff(pairs.row))
    leaving = np.bincount(pairs.pair_of_entry[label[pairs.successor] != own], minlength=pairs.count) > 0
    return np.asarray((pairs.reward == 0) & (label[pairs.owner] >= 0) & ~leaving, dtype=np.bool_)


def policy_loss_bound(
    prepared: Prepared, values: FloatArray, upper: FloatArray, greedy: GreedyPolicy, stop: StopRule
) -> float:
    """A bound on V* - V_pi over all states that are no dead ends, given `values` and `upper` [node].

    Infinite where none can be given (`upper` is infinite, or time is up at discount 1).
    """
    pairs = prepared.original
    if len(pairs.free) == 0:
        return 0.0
    on_states = values[prepared.node]
    above = float(np.max((upper - values)[prepared.pairs.free], initial=0.0))
    taken = _taken(pairs, greedy.pair)
    if pairs.discount < 1:
        rounding = Rounding(pairs)
        d = (pairs.q_values(on_states) - on_states[pairs.owner])[taken]
        below = -shifts(rounding, float(d.min()), float(d.max()), rounding.error(on_states))[0]
        return max(0.0, above + below)
    try:
        drop = _undiscounted_drop(prepared, on_states, greedy, stop)
    except TimeIsUp:
        drop = None
    return np.inf if drop is None else max(0.0, above + drop)


def _undiscounted_drop(
    prepared: Prepared, values: FloatArray, greedy: GreedyPolicy, stop: StopRule
) -> float | None:
    pairs = prepared.original
    fixed = _targets(pairs, greedy.pair, prepared.component >= 0)
    taken = _taken(pairs, greedy.pair)
    if not np.all(distance_order(pairs, fixed, taken) >= 0):
        return None
    own = pairs.keep(taken & ~fixed[pairs.owner])
    w = longest_paths(own, np.ones(own.count, dtype=np.bool_), initial_choice(own), stop, None)
    return None if w is None else policy_drop(own, values, fixed, w)
