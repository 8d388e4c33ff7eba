"""Trials of HSVI2 and SARSOP, compiled.

Both go down from a root: at each node the option of the largest upper bound, then the branch with the
largest share of the excess gap, and back up both bounds on the way back.

HSVI2 (Smith & Simmons 2005) goes on while some branch has P(k) (u - l - eps gamma^-(d+1)) > 0.
SARSOP (Kurniawati, Hsu & Lee 2008) hands targets down, L for the lower and U for the upper bound at
the root, and goes on while the gap is too wide for them, or while the value predicted for the node
(the mean of lower bounds seen in its bin of initial upper bound and entropy) would raise the lower
bound above L.
"""

from __future__ import annotations

import math
from typing import Final

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.belief_tree import BINS, CHOICES, LINKS, LOG, NUMBERS, TRIALS, VECTORS, Tree
from factored_polca.solvers.compiled import kernel
from factored_polca.solvers.pomdp_problem import Arrays
from factored_polca.solvers.tree_bounds import (
    back_up,
    lower_of_choice,
    refresh_lower,
    refresh_upper,
    settle,
)

LEARNING: Final = 0.1
"""How much the newest lower bound counts in the mean of its bin, at least."""


@kernel
def has_room(t: Tree, least: IntArray) -> bool:
    """Whether one more node can be opened and backed up."""
    return bool(
        t.counts[VECTORS] + least[VECTORS] <= len(t.vector_class)
        and t.counts[NUMBERS] + least[NUMBERS] <= len(t.number)
        and t.counts[LINKS] + least[LINKS] <= len(t.links)
        and t.counts[LOG] + least[LOG] <= len(t.log_node)
        and t.counts[CHOICES] + least[CHOICES] <= len(t.choice_upper)
    )


@kernel
def excess_branch(a: Arrays, t: Tree, n: int, j: int, allowed: float) -> tuple[int, int, float]:
    """(child place, child, weighted excess) of the branch with the largest excess gap."""
    best, place, child = 0.0, -1, -1
    h = t.first_child[t.first_choice[n] + j - a.first_option[t.node_class[n]]]
    for _ in range(a.first_branch[j], a.first_branch[j + 1]):
        m = t.child[h]
        if m >= 0:
            refresh_lower(t, m)
            excess = t.chance[h] * (t.upper[m] - t.lower[m] - allowed)
            if excess > best:
                best, place, child = excess, h, m
        h += 1
    return place, child, best


@kernel
def way_back(a: Arrays, t: Tree, depth: int, discount: float, threshold: float, least: IntArray) -> bool:
    """Back up the nodes of `t.path` from `depth` up to the root; False: it ended for want of room."""
    whole = True
    while depth >= 0 and has_room(t, least):
        n = t.path[depth]
        whole = settle(a, t, n, discount, threshold, least) >= 0 and whole
        back_up(a, t, n, discount, threshold * 1e-3)
        depth -= 1
    t.counts[TRIALS] += 1
    return whole and depth < 0


@kernel
def hsvi_trial(
    a: Arrays, t: Tree, root: int, discount: float, epsilon: float, threshold: float, least: IntArray
) -> bool:
    """One trial of HSVI2 with the width `epsilon` at the root; False: it ended early for want of room."""
    depth, n, allowed = 0, root, epsilon
    while has_room(t, least):
        j = settle(a, t, n, discount, threshold, least)
        if j < 0:
            break
        t.path[depth] = n
        depth += 1
        if discount == 0.0 or depth == len(t.path):
            return way_back(a, t, depth - 1, discount, threshold, least)
        allowed /= discount
        _, child, _ = excess_branch(a, t, n, j, allowed)
        if child < 0:
            return way_back(a, t, depth - 1, discount, threshold, least)
        n = child
    way_back(a, t, depth - 1, discount, threshold, least)
    return False


@kernel
def bin_of(a: Arrays, t: Tree, n: int) -> tuple[int, int]:
    """The bin of a node by what the corners gave for it, and by its normalised entropy."""
    y = t.node_class[n]
    low, high = t.span[0], t.span[1]
    by_value = int((t.base[n] - low) / (high - low) * BINS) if high > low else 0
    entropy = 0.0
    for e in range(t.entry_start[n], t.entry_start[n] + t.entry_count[n]):
        entropy -= t.entry_weight[e] * math.log(t.entry_weight[e])
    size = a.offset[y + 1] - a.offset[y]
    by_entropy = int(entropy / math.log(size) * BINS) if size > 1 else 0
    return min(max(by_value, 0), BINS - 1), min(max(by_entropy, 0), BINS - 1)


@kernel
def predicted(a: Arrays, t: Tree, n: int) -> float:
    """The value to expect of a node: the mean of lower bounds in its bin; its upper bound if empty."""
    i, k = bin_of(a, t, n)
    return float(t.bins[i, k, 0] if t.bins[i, k, 1] > 0.0 else t.upper[n])


@kernel
def learn(a: Arrays, t: Tree, n: int) -> None:
    """Move the mean of a node's bin towards its lower bound."""
    i, k = bin_of(a, t, n)
    t.bins[i, k, 1] += 1.0
    t.bins[i, k, 0] += (t.lower[n] - t.bins[i, k, 0]) * max(1.0 / t.bins[i, k, 1], LEARNING)


@kernel
def sarsop_trial(
    a: Arrays, t: Tree, root: int, discount: float, epsilon: float, threshold: float, least: IntArray
) -> bool:
    """One trial of SARSOP with the width `epsilon` at the root; False: it ended early for want of room."""
    depth, n, allowed = 0, root, epsilon
    lower_target, upper_target = t.lower[root], t.lower[root] + epsilon
    while has_room(t, least):
        j = settle(a, t, n, discount, threshold, least)
        if j < 0:
            break
        t.path[depth] = n
        depth += 1
        refresh_lower(t, n)
        learn(a, t, n)
        done = predicted(a, t, n) <= lower_target and depth > 1
        if done and t.upper[n] <= max(upper_target, t.lower[n] + allowed):
            return way_back(a, t, depth - 1, discount, threshold, least)
        if discount == 0.0 or depth == len(t.path):
            return way_back(a, t, depth - 1, discount, threshold, least)
        c = t.first_choice[n] + j - a.first_option[t.node_class[n]]
        worth = max(t.lower[n], lower_of_choice(a, t, j, c, discount))
        lower_target, upper_target = max(lower_target, worth), max(upper_target, worth + allowed)
        allowed /= discount
        place, child, _ = excess_branch(a, t, n, j, allowed)
        if child < 0:  # no gap is too wide; a lower bound may still be worth raising
            place, child, _ = excess_branch(a, t, n, j, 0.0)
        if child < 0:
            return way_back(a, t, depth - 1, discount, threshold, least)
        lower_target = passed_on(a, t, j, c, place, lower_target, discount, t.lower)
        upper_target = passed_on(a, t, j, c, place, upper_target, discount, t.upper)
        n = child
    way_back(a, t, depth - 1, discount, threshold, least)
    return False


@kernel
def passed_on(
    a: Arrays, t: Tree, j: int, c: int, place: int, target: float, discount: float, bound: FloatArray
) -> float:
    """What the child at `place` must be worth for the choice to reach `target`, the others at `bound`."""
    rest = target - t.choice_reward[c]
    h = t.first_child[c]
    for _ in range(a.first_branch[j], a.first_branch[j + 1]):
        if t.child[h] >= 0 and h != place:
            rest -= discount * t.chance[h] * bound[t.child[h]]
        h += 1
    return float(rest / (discount * t.chance[place]))


ALL_CLOSE, USED_UP, NO_ROOM, TO_TIDY = range(4)


@kernel
def search(
    a: Arrays,
    t: Tree,
    roots: IntArray,
    discount: float,
    gap: float,
    share: float,
    fine: float,
    sarsop: bool,
    trials: int,
    tidy_at: int,
    least: IntArray,
) -> int:
    """Up to `trials` trials, each at the root with the widest gap, a trial's width `share` of it.

    Ends with ALL_CLOSE: all gaps are at most `gap`; USED_UP: that was the last; NO_ROOM: arrays are
    full; TO_TIDY: there are `tidy_at` vectors.
    """
    for _ in range(trials):
        widest, root = -1.0, -1
        for n in roots:
            refresh_lower(t, n)
            refresh_upper(t, n)
            if t.upper[n] - t.lower[n] > widest:
                widest, root = t.upper[n] - t.lower[n], n
        if widest <= gap:
            return ALL_CLOSE
        epsilon = max(gap, share * widest)
        if sarsop:
            whole = sarsop_trial(a, t, root, discount, epsilon, epsilon * fine, least)
        else:
            whole = hsvi_trial(a, t, root, discount, epsilon, epsilon * fine, least)
        if not whole:
            return NO_ROOM
        if t.counts[VECTORS] >= tidy_at:
            return TO_TIDY
    return USED_UP
