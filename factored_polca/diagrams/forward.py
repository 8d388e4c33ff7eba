"""Regression from the top down: a vector of weights over the nodes of V, pushed down level after level.

    R_a[V](x) = sum over x' of prod_i P(x_i' | x) V(x')

is what arrives at V's leaves, weighed with their values, when one unit of weight starts at V's root and at
a node of level i goes to child v with P(x_i' = v | x).  An *item* at level i is what that depends on for
some x_1 .. x_{i-1}: the vector of weights over nodes at or below level i, and the rows of the features to
come, as far as they are known.  Items that are equal, exactly, are one: they are the nodes of the result.

    bottom-up (`factored_polca.diagrams.weighted`):  sum over nodes of V of the size of their regressions
    top-down (here):                                 sum over items of the length of their vectors

n independent components in 3 conditions, V a function of how many are in each: some n^6 / 720 nodes against
n^5 / 20 entries, and entries are cheap, arrays in place of hash tables.  It needs rows that do not look
below their own level, and no synchronic arcs.

Letters: entries (number of a node, weight); `first[item]` where its entries begin; `rows[item]` the nodes
of the row diagrams of the carried features, those that look above their own level, as far as decided.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.field import field_add, field_multiply
from factored_polca.diagrams.jit import inline, int64, lean_kernel
from factored_polca.diagrams.nodes import DONE, FULL, Int32Array, Int64Array, find_or_add, payload

UInt64Array = npt.NDArray[np.uint64]

YIELDED = 2
SHORT = 3
"""What `push_level` answers beside DONE: the budget is used up; an array is too short."""

ITEM, VALUE, ITEMS, ENTRIES, BUDGET, STAMP = range(6)
"""Places in `state`: the item and value to go on with, items and entries of the next level so far, the
budget, and a number for the item under way."""

_ZERO = np.uint64(0)
_K1 = np.uint64(0x9E3779B97F4A7C15)
_K2 = np.uint64(0xC2B2AE3D27D4EB4F)
_S29 = np.uint64(29)
_S32 = np.uint64(32)


@inline
def entry_hash(number: int, weight: np.uint64) -> np.uint64:
    """What an entry adds to the hash of its vector."""
    h = (weight ^ (np.uint64(number + 1) * _K1)) * _K2
    h = (h ^ (h >> _S29)) * _K1
    return h ^ (h >> _S32)


@lean_kernel
def push_level(
    pool: Int32Array, leaf_level: int, level: int, size: int,
    node_level: Int32Array, first_child: Int64Array, children: Int32Array, zero: int,
    row: int, carried: int, table: UInt64Array, one: np.uint64, field: UInt64Array,
    first: Int64Array, numbers: Int32Array, weights: UInt64Array, rows: Int32Array, items: int,
    next_first: Int64Array, next_numbers: Int32Array, next_weights: UInt64Array, next_rows: Int32Array,
    child_items: Int32Array, hashes: UInt64Array, slots: Int32Array,
    sums: UInt64Array, stamps: Int64Array, met: Int32Array, taken: Int32Array, state: Int64Array,
) -> int:  # fmt: skip
    """Push the items of a level to those of the next, found or made.

    `row` is the node of this feature's row diagram, 0 where it persists, or -1 - j where it is the carried
    one number j; `table[size * r + v]` is P(v) of row r.  `zero` is the number of the leaf 0, -1 if V has
    none.  `child_items[size * item + value]` receives the next items.  `sums` [node of V] is zero between
    items, `stamps` tells in which item a node was met last; `met` has room for all nodes of V.
    """
    mask = len(slots) - 1
    while state[ITEM] < items:
        item = state[ITEM]
        begin = first[item]
        end = first[item + 1]
        here = False
        for e in range(begin, end):
            if node_level[numbers[e]] == level:
                here = True
                break
        while state[VALUE] < size:
            u = state[VALUE]
            if state[BUDGET] <= 0:
                return YIELDED
            # the rows that remain, and this feature's own
            changed_rows = False
            for j in range(carried):
                node = rows[item * carried + j]
                if node != 0 and pool[node] == level:
                    node = pool[node + 2 + u]
                    changed_rows = True
                taken[j] = node
            own = int64(-1)
            if row != 0:
                node = int64(row) if row > 0 else int64(taken[-1 - row])
                if node != 0 and pool[node] == level:
                    node = int64(pool[node + 2 + u])
                own = int64(payload(pool, node)) if node != 0 else int64(0)
                if row < 0:
                    taken[-1 - row] = 0
            if u > 0 and not changed_rows and not here:
                child_items[size * item + u] = child_items[size * item + u - 1]
                state[VALUE] += 1
                continue
            # the vector
            count = 0
            state[STAMP] += 1
            stamp = state[STAMP]
            for e in range(begin, end):
                n = int64(numbers[e])
                w = weights[e]
                if node_level[n] != level:
                    if stamps[n] != stamp:
                        stamps[n] = stamp
                        met[count] = n
                        count += 1
                    sums[n] = field_add(sums[n], w, field[0])
                    continue
                if own < 0:
                    c = int64(children[first_child[n] + u])
                    if c != zero:
                        if stamps[c] != stamp:
                            stamps[c] = stamp
                            met[count] = c
                            count += 1
                        sums[c] = field_add(sums[c], w, field[0])
                    continue
                for v in range(size):
                    p = table[size * own + v]
                    c = int64(children[first_child[n] + v])
                    if p == _ZERO or c == zero:
                        continue
                    if stamps[c] != stamp:
                        stamps[c] = stamp
                        met[count] = c
                        count += 1
                    part = w if p == one else field_multiply(w, p, field[0], field[1])
                    sums[c] = field_add(sums[c], part, field[0])
            state[BUDGET] -= 2 + end - begin
            kept = 0
            h = _ZERO
            for i in range(count):
                n = int64(met[i])
                if sums[n] == _ZERO:
                    continue
                met[kept] = n
                kept += 1
                h += entry_hash(n, sums[n])
            for j in range(carried):
                if kept == 0:
                    taken[j] = 0
                h += entry_hash(int64(-2 - j), np.uint64(taken[j]))
            h = (h ^ (h >> _S29)) * _K1
            # found, or new
            i = int64(h >> _S32) & mask
            found = int64(-1)
            while slots[i] != 0:
                other = int64(slots[i]) - 1
                if hashes[other] == h and next_first[other + 1] - next_first[other] == kept:
                    same = True
                    for e in range(next_first[other], next_first[other + 1]):
                        if sums[next_numbers[e]] != next_weights[e]:
                            same = False
                            break
                    for j in range(carried):
                        if next_rows[other * carried + j] != taken[j]:
                            same = False
                    if same:
                        found = other
                        break
                i = (i + 1) & mask
            if found < 0:
                new = state[ITEMS]
                at = state[ENTRIES]
                if 2 * (new + 1) >= len(slots) or new >= len(hashes) or at + kept > len(next_numbers):
                    for k in range(kept):
                        sums[met[k]] = _ZERO
                    return SHORT
                slots[i] = new + 1
                hashes[new] = h
                for k in range(kept):
                    next_numbers[at + k] = met[k]
                    next_weights[at + k] = sums[met[k]]
                for j in range(carried):
                    next_rows[new * carried + j] = taken[j]
                next_first[new + 1] = at + kept
                state[ITEMS] = new + 1
                state[ENTRIES] = at + kept
                found = new
            for k in range(kept):
                sums[met[k]] = _ZERO
            child_items[size * item + u] = found
            state[VALUE] += 1
        state[VALUE] = 0
        state[ITEM] += 1
    return DONE


@lean_kernel
def place_all(hashes: UInt64Array, items: int, slots: Int32Array) -> None:
    """Fill the empty table `slots` with all items."""
    mask = len(slots) - 1
    for item in range(items):
        i = int64(hashes[item] >> _S32) & mask
        while slots[i] != 0:
            i = (i + 1) & mask
        slots[i] = item + 1


@lean_kernel
def leaf_sums(
    first: Int64Array, numbers: Int32Array, weights: UInt64Array, items: int, values: UInt64Array,
    field: UInt64Array, results: UInt64Array,
) -> None:  # fmt: skip
    """What arrives at the leaves, weighed with their values [node of V]."""
    for item in range(items):
        total = _ZERO
        for e in range(first[item], first[item + 1]):
            part = field_multiply(weights[e], values[numbers[e]], field[0], field[1])
            total = field_add(total, part, field[0])
        results[item] = total


@lean_kernel
def join_level(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array, level: int,
    child_items: Int32Array, items: int, below: Int32Array, made: Int32Array, words: Int32Array,
    progress: Int64Array,
) -> Any:  # fmt: skip
    """The node of each item of a level, from the nodes `below` of the next level's items."""
    size = arity[level]
    while progress[0] < items:
        item = progress[0]
        for u in range(size):
            words[u] = below[child_items[size * item + u]]
        node = find_or_add(pool, head, unique, arity, int64(level), words, 0)
        if node < 0:
            return FULL
        made[item] = node
        progress[0] += 1
    return DONE
