"""The beliefs of the search in compiled code: finding or making a node, its choices, their children.

A child's belief is b M_k divided by its mass P(k).  Nodes are found through a hash table of their class
and of their entries rounded to multiples of 1 / GRID; two beliefs on the two sides of a rounding border
become two nodes, which costs time and nothing else.  Bits are mixed as in SplitMix64 (Steele, Lea &
Flood 2014).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from factored_polca.solvers.belief_tree import (
    BASE,
    BEST,
    BINS,
    CHILDREN,
    CHOICE_UPPER,
    CHOICES,
    CLASS,
    COUNT,
    ENTRIES,
    FIRST_CHOICE,
    LOG_MARK,
    LOWER,
    MERGE,
    NODES,
    REWARD,
    SAME_HASH,
    START,
    UPPER,
    VECTOR_MARK,
    Tree,
)
from factored_polca.solvers.compiled import kernel
from factored_polca.solvers.pomdp_problem import Arrays

GRID: Final = 1e9


@kernel
def posterior(a: Arrays, t: Tree, n: int, k: int, rows: int) -> tuple[float, int]:
    """b_n M_k into `t.dense`; its mass, and how many entries `t.touched` lists."""
    mass, count = 0.0, 0
    at = a.branch_rows[k]
    for e in range(t.node[n, START], t.node[n, START] + t.node[n, COUNT]):
        w = t.entry_weight[e]
        row = at + t.entry_state[e]
        for q in range(a.row_start[row], a.row_start[row + 1]):
            s = a.column[q]
            p = w * a.probability[q]
            if t.dense[s] == 0.0 and p > 0.0:
                t.touched[count] = s
                count += 1
            t.dense[s] += p
            mass += p
    return mass, count


@kernel
def mixed(s: int, weight: float) -> int:
    """The bits of one entry of a belief, scattered; a belief's code is their sum, in any order."""
    bits = np.uint64(np.int64(math.floor(weight * GRID + 0.5))) + np.uint64(s) * np.uint64(
        0x9E3779B97F4A7C15
    )
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))  # type: ignore[return-value]


@kernel
def find_or_add(a: Arrays, t: Tree, y: int, mass: float, count: int) -> int:
    """The node of the belief in `t.dense` (over `t.touched`), made if there is none; clears `t.dense`."""
    code = np.uint64(y + 1)
    for e in range(count):
        s = t.touched[e]
        t.dense[s] /= mass
        code += mixed(s, t.dense[s])
    slot = np.int64(code & np.uint64(len(t.bucket) - 1))
    found = t.bucket[slot]
    while found >= 0:
        if t.node[found, CLASS] == y and t.node[found, COUNT] == count:
            distance, start = 0.0, t.node[found, START]
            for e in range(start, start + count):
                distance += abs(t.entry_weight[e] - t.dense[t.entry_state[e]])
            if distance <= MERGE:
                t.bins[BINS, 1, 0] = max(t.bins[BINS, 1, 0], distance)
                break
        found = t.node[found, SAME_HASH]
    if found < 0:
        found = t.counts[NODES]
        t.counts[NODES] += 1
        start = t.counts[ENTRIES]
        t.counts[ENTRIES] += count
        base = 0.0
        for e in range(count):
            s = t.touched[e]
            t.entry_state[start + e] = s
            t.entry_weight[start + e] = t.dense[s]
            base += t.dense[s] * t.corner[a.offset[y] + s]
        t.node[found, CLASS] = y
        t.node[found, START] = start
        t.node[found, COUNT] = count
        t.bound[found, BASE] = base
        t.bound[found, UPPER] = base
        t.bound[found, LOWER] = -np.inf
        t.node[found, BEST] = -1
        t.node[found, VECTOR_MARK] = -1
        t.node[found, LOG_MARK] = -1
        t.node[found, FIRST_CHOICE] = -1
        t.node[found, SAME_HASH] = t.bucket[slot]
        t.bucket[slot] = found
    for e in range(count):
        t.dense[t.touched[e]] = 0.0
    return int(found)


@kernel
def open_node(a: Arrays, t: Tree, n: int) -> None:
    """Give a node its choices."""
    y = t.node[n, CLASS]
    first = t.counts[CHOICES]
    low, high = a.first_option[y], a.first_option[y + 1]
    t.counts[CHOICES] += high - low
    t.node[n, FIRST_CHOICE] = first
    for j in range(low, high):
        at = a.reward_start[j]
        reward, bound = 0.0, 0.0
        for e in range(t.node[n, START], t.node[n, START] + t.node[n, COUNT]):
            reward += t.entry_weight[e] * a.rewards[at + t.entry_state[e]]
            bound += t.entry_weight[e] * t.option_bound[at + t.entry_state[e]]
        c = first + j - low
        t.choice[c, REWARD] = reward
        t.choice[c, CHOICE_UPPER] = bound
        t.first_child[c] = -1


@kernel
def expand(a: Arrays, t: Tree, n: int, j: int, c: int) -> None:
    """Make the children of a choice."""
    first = t.counts[CHILDREN]
    low, high = a.first_branch[j], a.first_branch[j + 1]
    t.counts[CHILDREN] += high - low
    t.first_child[c] = first
    for k in range(low, high):
        mass, count = posterior(a, t, n, k, 0)
        h = first + k - low
        t.chance[h] = mass
        t.child[h] = find_or_add(a, t, a.branch_target[k], mass, count) if mass > 0.0 else -1


@kernel
def rehash(t: Tree) -> None:
    """Fill the (larger, empty) hash table anew."""
    for n in range(t.counts[NODES]):
        code = np.uint64(t.node[n, CLASS] + 1)
        for e in range(t.node[n, START], t.node[n, START] + t.node[n, COUNT]):
            code += mixed(t.entry_state[e], t.entry_weight[e])
        slot = np.int64(code & np.uint64(len(t.bucket) - 1))
        t.node[n, SAME_HASH] = t.bucket[slot]
        t.bucket[slot] = n
