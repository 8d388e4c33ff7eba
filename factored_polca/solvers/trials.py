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

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.belief_tree import (
    BASE,
    BINS,
    CHOICES,
    CLASS,
    COUNT,
    FIRST_CHOICE,
    LINKS,
    LOG,
    LOWER,
    NUMBERS,
    REWARD,
    START,
    TRIALS,
    UPPER,
    VECTORS,
    Tree,
)
from factored_polca.solvers.compiled import kernel
from factored_polca.solvers.pomdp_problem import Arrays
from factored_polca.solvers.tree_bounds import (
    back_up,
    refresh_lower,
    refresh_upper,
    settle,
)

PHASE, DEPTH, NODE, EPSILON, ALLOWED, LOWER_TARGET, UPPER_TARGET = range(7)
"""A trial's own state, which outlasts a call so that one which ran out of room goes on where it was: what
comes next, the length of `Tree.path`, the node to go on from, the trial's width, the width allowed at the
node, SARSOP's targets."""
TRIAL_STATE: Final = 7
AT_REST, DOWN, BACK = range(3)

# Of numpy's type: numba compiles a kernel anew for each literal that it is called with.
LOWER_SIDE: Final = np.int64(LOWER)
UPPER_SIDE: Final = np.int64(UPPER)

LEARNING: Final = 0.1
"""How much the newest lower bound counts in the mean of its bin, at least."""


@kernel
def has_room(t: Tree, least: IntArray) -> bool:
    """Whether one more node can be opened and backed up."""
    return bool(
        t.counts[VECTORS] + least[VECTORS] <= len(t.vector)
        and t.counts[NUMBERS] + least[NUMBERS] <= len(t.number)
        and t.counts[LINKS] + least[LINKS] <= len(t.links)
        and t.counts[LOG] + least[LOG] <= len(t.log)
        and t.counts[CHOICES] + least[CHOICES] <= len(t.choice)
    )


@kernel
def excess_branch(a: Arrays, t: Tree, j: int, c: int, allowed: float, any_gap: bool) -> int:
    """The place of the child with the largest P(k) (u - l - allowed), if positive; else -1.

    With `any_gap`, where no gap is wider than allowed, the child with the largest P(k) (u - l).
    """
    best, place, second, spare = 0.0, -1, 0.0, -1
    h = t.first_child[c]
    for _ in range(a.first_branch[j], a.first_branch[j + 1]):
        m = t.child[h]
        if m >= 0:
            refresh_lower(t, m)
            gap = t.bound[m, UPPER] - t.bound[m, LOWER]
            if t.chance[h] * (gap - allowed) > best:
                best, place = t.chance[h] * (gap - allowed), h
            if t.chance[h] * gap > second:
                second, spare = t.chance[h] * gap, h
        h += 1
    return spare if place < 0 and any_gap else place


@kernel
def known_lower(a: Arrays, t: Tree, j: int, c: int, discount: float) -> float:
    """The lower bound of an expanded choice from those of its children as they are."""
    total = 0.0
    h = t.first_child[c]
    for _ in range(a.first_branch[j], a.first_branch[j + 1]):
        if t.child[h] >= 0:
            total += t.chance[h] * t.bound[t.child[h], LOWER]
        h += 1
    return float(t.choice[c, REWARD] + discount * total)


@kernel
def way_back(a: Arrays, t: Tree, trial: FloatArray, discount: float, fine: float, least: IntArray) -> bool:
    """Back up the nodes of `t.path` from the trial's depth up to the root; False: more room is needed."""
    threshold = trial[EPSILON] * fine
    while trial[DEPTH] > 0:
        n = t.path[int(trial[DEPTH]) - 1]
        if not has_room(t, least) or settle(a, t, n, discount, threshold, least) < 0:
            return False
        back_up(a, t, n, discount, threshold * 1e-3)
        trial[DEPTH] -= 1
    trial[PHASE] = AT_REST
    t.counts[TRIALS] += 1
    return True


@kernel
def predicted(a: Arrays, t: Tree, n: int) -> float:
    """The value to expect of a node: the mean of lower bounds in its bin, this node's now among them.

    Bins are by what the corners gave for the node, and by its normalised entropy.
    """
    low, high = t.bins[BINS, 0, 0], t.bins[BINS, 0, 1]
    by_value = int((t.bound[n, BASE] - low) / (high - low) * BINS) if high > low else 0
    entropy = 0.0
    for e in range(t.node[n, START], t.node[n, START] + t.node[n, COUNT]):
        entropy -= t.entry_weight[e] * math.log(t.entry_weight[e])
    size = a.offset[t.node[n, CLASS] + 1] - a.offset[t.node[n, CLASS]]
    by_entropy = int(entropy / math.log(size) * BINS) if size > 1 else 0
    i, k = min(max(by_value, 0), BINS - 1), min(max(by_entropy, 0), BINS - 1)
    t.bins[i, k, 1] += 1.0
    t.bins[i, k, 0] += (t.bound[n, LOWER] - t.bins[i, k, 0]) * max(1.0 / t.bins[i, k, 1], LEARNING)
    return float(t.bins[i, k, 0])


@kernel
def passed_on(
    a: Arrays, t: Tree, j: int, c: int, place: int, target: float, discount: float, side: int
) -> float:
    """What the child at `place` must be worth for the choice to reach `target`, the others at `side`."""
    rest = target - t.choice[c, REWARD]
    h = t.first_child[c]
    for _ in range(a.first_branch[j], a.first_branch[j + 1]):
        if t.child[h] >= 0 and h != place:
            rest -= discount * t.chance[h] * t.bound[t.child[h], side]
        h += 1
    return float(rest / (discount * t.chance[place]))


@kernel
def descend(
    a: Arrays, t: Tree, trial: FloatArray, discount: float, fine: float, sarsop: bool, least: IntArray
) -> bool:
    """The way down of a trial into `t.path`; False: more room is needed, then it goes on from there."""
    threshold = trial[EPSILON] * fine
    while True:
        n = int(trial[NODE])
        if not has_room(t, least):
            return False
        j = settle(a, t, n, discount, threshold, least)
        if j < 0:
            return False
        t.path[int(trial[DEPTH])] = n
        trial[DEPTH] += 1
        if discount == 0.0 or int(trial[DEPTH]) == len(t.path):
            return True
        c = t.node[n, FIRST_CHOICE] + j - a.first_option[t.node[n, CLASS]]
        if sarsop:
            refresh_lower(t, n)
            expected = predicted(a, t, n)
            narrow = t.bound[n, UPPER] <= max(trial[UPPER_TARGET], t.bound[n, LOWER] + trial[ALLOWED])
            if narrow and trial[DEPTH] > 1 and expected <= trial[LOWER_TARGET]:
                return True
        place = excess_branch(a, t, j, c, trial[ALLOWED] / discount, sarsop)
        if place < 0:
            return True
        if sarsop:
            worth = max(t.bound[n, LOWER], known_lower(a, t, j, c, discount))
            lower_target = max(trial[LOWER_TARGET], worth)
            upper_target = max(trial[UPPER_TARGET], worth + trial[ALLOWED])
            trial[LOWER_TARGET] = passed_on(a, t, j, c, place, lower_target, discount, int(LOWER_SIDE))
            trial[UPPER_TARGET] = passed_on(a, t, j, c, place, upper_target, discount, int(UPPER_SIDE))
        trial[ALLOWED] /= discount
        trial[NODE] = t.child[place]


ALL_CLOSE, USED_UP, NO_ROOM, TO_TIDY = range(4)


@kernel
def search(
    a: Arrays,
    t: Tree,
    trial: FloatArray,
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
    full, the trial under way goes on with the next call; TO_TIDY: there are `tidy_at` vectors.
    """
    for _ in range(trials):
        if trial[PHASE] == AT_REST:
            widest, root = -1.0, -1
            for n in roots:
                refresh_lower(t, n)
                refresh_upper(t, n)
                if t.bound[n, UPPER] - t.bound[n, LOWER] > widest:
                    widest, root = t.bound[n, UPPER] - t.bound[n, LOWER], n
            if widest <= gap:
                return ALL_CLOSE
            epsilon = max(gap, share * widest)
            trial[PHASE], trial[DEPTH], trial[NODE] = DOWN, 0.0, root
            trial[EPSILON], trial[ALLOWED] = epsilon, epsilon
            trial[LOWER_TARGET], trial[UPPER_TARGET] = t.bound[root, LOWER], t.bound[root, LOWER] + epsilon
        if trial[PHASE] == DOWN:
            if not descend(a, t, trial, discount, fine, sarsop, least):
                return NO_ROOM
            trial[PHASE] = BACK
        if not way_back(a, t, trial, discount, fine, least):
            return NO_ROOM
        if t.counts[VECTORS] >= tidy_at:
            return TO_TIDY
    return USED_UP
