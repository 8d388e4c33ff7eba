"""The beliefs of the search in compiled code: finding or making a node, its choices, their children.

A child's belief is b M_k divided by its mass P(k).  Nodes are found through a hash table of their class
and of their entries rounded to multiples of 1 / GRID; two beliefs on the two sides of a rounding border
become two nodes, which costs time and nothing else.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from factored_polca.solvers.belief_tree import CHILDREN, CHOICES, ENTRIES, MERGE, NODES, Tree
from factored_polca.solvers.compiled import kernel
from factored_polca.solvers.pomdp_problem import Arrays

GRID: Final = 1e9


@kernel
def posterior(a: Arrays, t: Tree, n: int, k: int, rows: int) -> tuple[float, int]:
    """b_n M_k into `t.dense`; its mass, and how many entries `t.touched` lists."""
    mass, count = 0.0, 0
    at = a.branch_rows[k]
    for e in range(t.entry_start[n], t.entry_start[n] + t.entry_count[n]):
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
def find_or_add(a: Arrays, t: Tree, y: int, mass: float, count: int) -> int:
    """The node of the belief in `t.dense` (over `t.touched`), made if there is none; clears `t.dense`."""
    t.touched[:count].sort()
    code = np.uint64(y + 1) * np.uint64(0x9E3779B97F4A7C15)
    for e in range(count):
        s = t.touched[e]
        t.dense[s] /= mass
        bits = np.uint64(np.int64(math.floor(t.dense[s] * GRID + 0.5))) + np.uint64(s) * np.uint64(
            0x632BE5AB
        )
        code = (code ^ bits) * np.uint64(0xD6E8FEB86659FD93)
        code = code ^ (code >> np.uint64(32))
    slot = np.int64(code & np.uint64(len(t.bucket) - 1))
    found = t.bucket[slot]
    while found >= 0:
        if t.node_class[found] == y and t.entry_count[found] == count:
            distance, start = 0.0, t.entry_start[found]
            for e in range(count):
                if t.entry_state[start + e] != t.touched[e]:
                    distance = 2.0
                    break
                distance += abs(t.entry_weight[start + e] - t.dense[t.touched[e]])
            if distance <= MERGE:
                break
        found = t.same_hash[found]
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
        t.node_class[found] = y
        t.entry_start[found] = start
        t.entry_count[found] = count
        t.base[found] = base
        t.upper[found] = base
        t.lower[found] = -np.inf
        t.best_vector[found] = -1
        t.vector_mark[found] = -1
        t.log_mark[found] = -1
        t.first_choice[found] = -1
        t.same_hash[found] = t.bucket[slot]
        t.bucket[slot] = found
    for e in range(count):
        t.dense[t.touched[e]] = 0.0
    return int(found)


@kernel
def open_node(a: Arrays, t: Tree, n: int) -> None:
    """Give a node its choices."""
    y = t.node_class[n]
    first = t.counts[CHOICES]
    low, high = a.first_option[y], a.first_option[y + 1]
    t.counts[CHOICES] += high - low
    t.first_choice[n] = first
    for j in range(low, high):
        at = a.reward_start[j]
        reward, bound = 0.0, 0.0
        for e in range(t.entry_start[n], t.entry_start[n] + t.entry_count[n]):
            reward += t.entry_weight[e] * a.rewards[at + t.entry_state[e]]
            bound += t.entry_weight[e] * t.option_bound[at + t.entry_state[e]]
        c = first + j - low
        t.choice_reward[c] = reward
        t.choice_upper[c] = bound
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
        code = np.uint64(t.node_class[n] + 1) * np.uint64(0x9E3779B97F4A7C15)
        for e in range(t.entry_start[n], t.entry_start[n] + t.entry_count[n]):
            s = t.entry_state[e]
            bits = np.uint64(np.int64(math.floor(t.entry_weight[e] * GRID + 0.5)))
            bits += np.uint64(s) * np.uint64(0x632BE5AB)
            code = (code ^ bits) * np.uint64(0xD6E8FEB86659FD93)
            code = code ^ (code >> np.uint64(32))
        slot = np.int64(code & np.uint64(len(t.bucket) - 1))
        t.same_hash[n] = t.bucket[slot]
        t.bucket[slot] = n
