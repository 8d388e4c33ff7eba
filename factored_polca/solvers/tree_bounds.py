"""The bounds of the search in compiled code: sawtooth points, backups of both bounds, sweeps.

Upper bounds: the sawtooth of the corners and the logged points p (Hauskrecht 2000),

    u(b) <= c . b + min over p of min over s in supp(b_p) of b(s) / b_p(s) * (u(p) - c . b_p),

and u(b) <= max over j of (b . r_j + gamma * sum over k P(k) u(b_k)).  Only the best option's children
are brought up to date, until the best option stays the best: bounds that are out of date are still
bounds.  Lower bounds: vectors, backed up at the node (Smallwood & Sondik 1973),

    alpha = r_j + gamma * sum over k of M_k alpha_k,   alpha_k the best vector at the child b_k.

An option whose upper bound lies below the node's lower bound is never looked at again.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.belief_tree import (
    AT,
    BACKUPS,
    BASE,
    BEST,
    CHILDREN,
    CHOICE_UPPER,
    CLASS,
    COUNT,
    ENTRIES,
    FIRST_CHOICE,
    FIRST_LINK,
    LINKS,
    LOG,
    LOG_MARK,
    LOGGED,
    LOGGED_BEFORE,
    LOWER,
    NEWEST_LOG,
    NEWEST_VECTOR,
    NODES,
    NUMBERS,
    OF_CLASS,
    OLDER,
    OLDEST_VECTOR,
    OPTION,
    REWARD,
    START,
    UPPER,
    VECTOR_MARK,
    VECTORS,
    Tree,
)
from factored_polca.solvers.compiled import kernel
from factored_polca.solvers.pomdp_problem import Arrays
from factored_polca.solvers.tree_beliefs import expand, open_node

# Numbers of numpy's types: numba compiles a kernel anew for each literal that it is called with.
REFRESH: Final = np.bool_(True)
NONE: Final = np.int64(-1)


@kernel
def refresh_lower(t: Tree, n: int) -> None:
    """Look at the vectors that are newer than the last one this node has seen."""
    y = t.node[n, CLASS]
    newest = t.head[y, NEWEST_VECTOR]
    m = newest
    start, end = t.node[n, START], t.node[n, START] + t.node[n, COUNT]
    while m > t.node[n, VECTOR_MARK]:
        at = t.vector[m, AT]
        worth = 0.0
        for e in range(start, end):
            worth += t.entry_weight[e] * t.number[at + t.entry_state[e]]
        if worth > t.bound[n, LOWER] or t.node[n, BEST] < 0:
            t.bound[n, LOWER] = worth
            t.node[n, BEST] = m
        m = t.vector[m, OLDER]
    t.node[n, VECTOR_MARK] = newest


@kernel
def refresh_upper(t: Tree, n: int) -> None:
    """Look at the points that were logged since this node looked last."""
    y = t.node[n, CLASS]
    newest = t.head[y, NEWEST_LOG]
    g = newest
    if g <= t.node[n, LOG_MARK]:
        return
    start, end = t.node[n, START], t.node[n, START] + t.node[n, COUNT]
    for e in range(start, end):
        t.dense[t.entry_state[e]] = t.entry_weight[e]
    best = t.bound[n, UPPER] - t.bound[n, BASE]
    while g > t.node[n, LOG_MARK]:
        p = t.log[g, LOGGED]
        drop = t.bound[p, UPPER] - t.bound[p, BASE]
        if drop < best and t.node[p, COUNT] <= t.node[n, COUNT]:
            ratio = 1.0
            for e in range(t.node[p, START], t.node[p, START] + t.node[p, COUNT]):
                share = t.dense[t.entry_state[e]]
                if share < ratio * t.entry_weight[e]:
                    ratio = share / t.entry_weight[e]
                    if ratio * drop >= best:
                        break
            best = min(best, ratio * drop)
        g = t.log[g, LOGGED_BEFORE]
    t.node[n, LOG_MARK] = newest
    t.bound[n, UPPER] = min(t.bound[n, UPPER], t.bound[n, BASE] + best)
    for e in range(start, end):
        t.dense[t.entry_state[e]] = 0.0


@kernel
def best_choice(a: Arrays, t: Tree, n: int) -> int:
    """The option with the largest upper bound, the first of equals."""
    y = t.node[n, CLASS]
    best = a.first_option[y]
    for j in range(a.first_option[y] + 1, a.first_option[y + 1]):
        shift = j - a.first_option[y]
        if (
            t.choice[t.node[n, FIRST_CHOICE] + shift, CHOICE_UPPER]
            > t.choice[t.node[n, FIRST_CHOICE] + best - a.first_option[y], CHOICE_UPPER]
        ):
            best = j
    return int(best)


@kernel
def log_point(t: Tree, n: int) -> None:
    """Note that the upper bound of a node has fallen."""
    y = t.node[n, CLASS]
    g = t.counts[LOG]
    t.counts[LOG] += 1
    t.log[g, LOGGED] = n
    t.log[g, LOGGED_BEFORE] = t.head[y, NEWEST_LOG]
    t.head[y, NEWEST_LOG] = g


@kernel
def choice_value(a: Arrays, t: Tree, j: int, c: int, discount: float, refresh: bool) -> float:
    """Bring the upper bound of an expanded choice up to date."""
    total = 0.0
    h = t.first_child[c]
    for _ in range(a.first_branch[j], a.first_branch[j + 1]):
        if t.child[h] >= 0:
            if refresh:
                refresh_upper(t, t.child[h])
            total += t.chance[h] * t.bound[t.child[h], UPPER]
        h += 1
    value = min(t.choice[c, CHOICE_UPPER], t.choice[c, REWARD] + discount * total)
    t.choice[c, CHOICE_UPPER] = value
    return float(value)


@kernel
def settle(a: Arrays, t: Tree, n: int, discount: float, threshold: float, least: IntArray) -> int:
    """Lower the upper bound of a node as far as its best option allows; that option, -1: no room."""
    if t.node[n, FIRST_CHOICE] < 0:
        open_node(a, t, n)
    low = a.first_option[t.node[n, CLASS]]
    while True:
        j = best_choice(a, t, n)
        c = t.node[n, FIRST_CHOICE] + j - low
        if t.first_child[c] < 0:
            if (
                t.counts[NODES] + least[NODES] > len(t.bound)
                or t.counts[ENTRIES] + least[ENTRIES] > len(t.entry_state)
                or t.counts[CHILDREN] + least[CHILDREN] > len(t.child)
            ):
                return -1
            expand(a, t, n, j, c)
        choice_value(a, t, j, c, discount, bool(REFRESH))
        if best_choice(a, t, n) == j:
            break
    value = t.choice[c, CHOICE_UPPER]
    if value < t.bound[n, UPPER]:
        before = t.bound[n, UPPER]
        t.bound[n, UPPER] = value
        if before - value > threshold:
            log_point(t, n)
    return j


@kernel
def lower_of_choice(a: Arrays, t: Tree, j: int, c: int, discount: float) -> float:
    """The lower bound of an expanded choice, its children brought up to date."""
    total = 0.0
    h = t.first_child[c]
    for _ in range(a.first_branch[j], a.first_branch[j + 1]):
        if t.child[h] >= 0:
            refresh_lower(t, t.child[h])
            total += t.chance[h] * t.bound[t.child[h], LOWER]
        h += 1
    return float(t.choice[c, REWARD] + discount * total)


@kernel
def back_up(a: Arrays, t: Tree, n: int, discount: float, least_gain: float) -> None:
    """Add the vector of the best expanded option where it is worth more than what is known."""
    y = t.node[n, CLASS]
    refresh_lower(t, n)
    low = a.first_option[y]
    best, option = t.bound[n, LOWER] + least_gain, int(NONE)
    for j in range(low, a.first_option[y + 1]):
        c = t.node[n, FIRST_CHOICE] + j - low
        if t.first_child[c] >= 0 and t.choice[c, CHOICE_UPPER] > best:
            worth = lower_of_choice(a, t, j, c, discount)
            if worth > best:
                best, option = worth, j
    t.counts[BACKUPS] += 1
    if option >= 0:
        add_vector(a, t, n, option, t.node[n, FIRST_CHOICE] + option - low, discount)


@kernel
def add_vector(a: Arrays, t: Tree, n: int, j: int, c: int, discount: float) -> None:
    """Append r_j + gamma * sum_k M_k alpha_k, the alpha_k from the children of choice c of node n."""
    y = t.node[n, CLASS]
    size = a.offset[y + 1] - a.offset[y]
    m, start, link = t.counts[VECTORS], t.counts[NUMBERS], t.counts[LINKS]
    t.counts[VECTORS] += 1
    t.counts[NUMBERS] += size
    t.counts[LINKS] += a.first_branch[j + 1] - a.first_branch[j]
    for s in range(size):
        t.other[s] = 0.0
    h = t.first_child[c]
    for k in range(a.first_branch[j], a.first_branch[j + 1]):
        follower = (
            t.node[t.child[h], BEST] if t.child[h] >= 0 else t.head[a.branch_target[k], OLDEST_VECTOR]
        )
        t.links[link] = follower
        at = t.vector[follower, AT]
        rows = a.branch_rows[k]
        for s in range(size):
            total = 0.0
            for q in range(a.row_start[rows + s], a.row_start[rows + s + 1]):
                total += a.probability[q] * t.number[at + a.column[q]]
            t.other[s] += total
        link += 1
        h += 1
    rewards = a.reward_start[j]
    for s in range(size):
        t.number[start + s] = a.rewards[rewards + s] + discount * t.other[s]
    t.vector[m, OF_CLASS] = y
    t.vector[m, OPTION] = j
    t.vector[m, AT] = start
    t.vector[m, FIRST_LINK] = link - (a.first_branch[j + 1] - a.first_branch[j])
    t.vector[m, OLDER] = t.head[y, NEWEST_VECTOR]
    t.head[y, NEWEST_VECTOR] = m
    refresh_lower(t, n)


@kernel
def sweep(a: Arrays, t: Tree, discount: float, threshold: float, refresh: bool) -> float:
    """Update the upper bounds of all opened nodes, the youngest first; the largest fall."""
    largest = 0.0
    for n in range(t.counts[NODES] - 1, -1, -1):
        if t.node[n, FIRST_CHOICE] < 0:
            continue
        y = t.node[n, CLASS]
        best = -np.inf
        for j in range(a.first_option[y], a.first_option[y + 1]):
            c = t.node[n, FIRST_CHOICE] + j - a.first_option[y]
            if t.first_child[c] >= 0 and t.choice[c, CHOICE_UPPER] > t.bound[n, LOWER]:
                choice_value(a, t, j, c, discount, refresh)
            best = max(best, t.choice[c, CHOICE_UPPER])
        fall = t.bound[n, UPPER] - best
        if fall > 0.0:
            t.bound[n, UPPER] = best
            largest = max(largest, fall)
            if fall > threshold and t.counts[LOG] < len(t.log):
                log_point(t, n)
    return largest


@kernel
def lower_corners(a: Arrays, t: Tree, nodes: IntArray) -> None:
    """Take over the upper bounds of the nodes that are single states, [i] (-1: none) as corners."""
    changed = False
    for i in range(len(nodes)):
        n = nodes[i]
        if n >= 0 and t.bound[n, UPPER] < t.corner[i]:
            t.corner[i] = t.bound[n, UPPER]
            changed = True
    if not changed:
        return
    for n in range(t.counts[NODES]):
        base = 0.0
        offset = a.offset[t.node[n, CLASS]]
        for e in range(t.node[n, START], t.node[n, START] + t.node[n, COUNT]):
            base += t.entry_weight[e] * t.corner[offset + t.entry_state[e]]
        t.bound[n, BASE] = base
        t.bound[n, UPPER] = min(t.bound[n, UPPER], base)


@kernel
def tidy(t: Tree, used: IntArray) -> None:
    """Take out of the lists the vectors that are best at no opened node, and repeated log entries.

    What is taken out stays stored: bounds and vectors made from it stay as they are.  `used` is scratch,
    at least as long as the nodes and the vectors, zero before and after.
    """
    vectors, nodes = t.counts[VECTORS], t.counts[NODES]
    for n in range(nodes):
        if t.node[n, FIRST_CHOICE] >= 0:
            refresh_lower(t, n)
            used[t.node[n, BEST]] = 1
    for y in range(len(t.head)):
        later, m = -1, t.head[y, NEWEST_VECTOR]
        while m >= 0:
            earlier = t.vector[m, OLDER]
            if used[m] == 1 or t.vector[m, FIRST_LINK] < 0 or later < 0:
                later = m
            else:
                t.vector[later, OLDER] = earlier
            m = earlier
    used[:vectors] = 0
    for y in range(len(t.head)):
        later, g = -1, t.head[y, NEWEST_LOG]
        while g >= 0:
            earlier = t.log[g, LOGGED_BEFORE]
            if used[t.log[g, LOGGED]] == 0:
                used[t.log[g, LOGGED]] = 1
                later = g
            else:
                t.log[later, LOGGED_BEFORE] = earlier
            g = earlier
    used[:nodes] = 0


@kernel
def raise_lower(
    a: Arrays, t: Tree, order: IntArray, before: FloatArray, discount: float, gain: float, least: IntArray
) -> int:
    """Perseus' randomised backups (Spaan & Vlassis 2005) over the opened nodes in `order`.

    A node whose bound has risen since `before` [n] was taken, by vectors backed up at others, is passed
    over.  The number of backups.
    """
    backups = 0
    for n in order:
        refresh_lower(t, n)
        if t.bound[n, LOWER] > before[n] + gain:
            continue
        if (
            t.counts[VECTORS] + least[VECTORS] > len(t.vector)
            or t.counts[NUMBERS] + least[NUMBERS] > len(t.number)
            or t.counts[LINKS] + least[LINKS] > len(t.links)
        ):
            break
        back_up(a, t, n, discount, gain)
        backups += 1
    return backups
