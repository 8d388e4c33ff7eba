"""Regression from the top down, node by node: the rows of the features to come go along.

    R_a[V](x) = sum over x' of prod_i P(x_i' | x) V(x')

Each changed feature's row is a diagram over its own level and those above, which selects entries (v, weight);
a weight is a diagram over the levels below, in most models a number.  A *context* holds for each changed
feature whose row looks above its own level, the *carried* ones, the node of that diagram, cofactored by the
values of the levels above:

    T(n, context)   what becomes of V's node n where the features above it have the values that led there.

At the level of a feature that persists, child u of n goes with the context cofactored by u.  At that of a
changed one the row that u selects gives  sum_v weight_v T(child v, context).  A row that has become that of
a feature that persists leaves the context, and so does one of a level that n skips; where nothing is left
that changes n or what is below, T(n, context) = n.

From the bottom up (`factored_polca.diagrams.weighted`) each node of V is regressed for all values of the
features above it; here only for those on paths to it.  Where V is sparse, as in the passes of the
minimisation, these are few.  And what is done at a node is linear in its children and in the entries of
rows, not in their product.

    frame     [child, entry, level; node, context ..], the latter two the key of the cache
    entries   CSR: row -> (value, number of its weight in `weights`)
    carried   level [carried feature of the action]; `identity` the row diagram of a feature that persists,
              0 if there is none with the same entries
    base      [level] the number of the changed feature's row 0; `fixed` the root of a row that is not
              carried, 0 if it is or there is none; `last` the lowest level of the latter
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.jit import int64, lean_kernel
from factored_polca.diagrams.nodes import (
    DONE,
    FIRST,
    FULL,
    STEPS,
    YIELDED,
    Int32Array,
    Int64Array,
    find_or_add,
    payload,
)
from factored_polca.diagrams.weighted import (
    NORMALISED,
    ONE,
    begin_sum,
    ring_insert,
    ring_lookup,
    run_weighted_sum,
)

FRAMES, FOUND, SUMMING = range(3)
"""Places in `down`: open frames, finished children, whether a sum is under way."""

HEADER = 3
"""Words of a frame before the node."""


def stride(width: int) -> int:
    """Words of a frame for an action with so many carried features; the key has an even number."""
    return HEADER + 2 * ((width + 2) // 2)


@lean_kernel
def run_descent(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array,
    slots: Int64Array, ring: Int32Array, ring_state: Int64Array,
    options: Int64Array, field: npt.NDArray[np.uint64],
    stack: Int32Array, terms: Int32Array, results: Int32Array, sum_state: Int64Array,
    key: int, width: int, carried: Int64Array, identity: Int32Array,
    fixed: Int32Array, base: Int64Array, last: int,
    entry_first: Int64Array, entry_value: Int32Array, entry_weight: Int32Array, weights: Int32Array,
    frames: Int32Array, found: Int32Array, down: Int64Array,
) -> int:  # fmt: skip
    """The regression of a node; the caller puts one frame of level -1, with the node and the rows' roots.

    `found[0]` is the result.  `key` is negative and belongs to the action and the field.
    """
    leaf_level = len(arity) - 1
    pairs = (width + 2) // 2
    size_of_frame = HEADER + 2 * pairs
    sp = down[FRAMES]
    rp = down[FOUND]
    budget = STEPS
    code = YIELDED
    while budget > 0:
        f = size_of_frame * (sp - 1)
        k = int64(frames[f])
        e = int64(frames[f + 1])
        level = int64(frames[f + 2])
        n = int64(frames[f + HEADER])
        size = int64(1) if level < 0 else int64(arity[level])
        if k == size:
            if level < 0:
                code = DONE
                break
            r = find_or_add(pool, head, unique, arity, level, found, rp - size)
            if r < 0:
                code = FULL
                break
            ring_insert(slots, ring, ring_state, frames, f + HEADER, pairs, key, r)
            rp -= size
            found[rp] = r
            rp += 1
            sp -= 1
            continue
        budget -= 1
        # the context of child k
        g = f + size_of_frame
        here = int64(-1)
        for j in range(width):
            c = int64(frames[f + HEADER + 1 + j])
            if c >= FIRST and pool[c] == level:
                c = int64(pool[c + 2 + k])
            frames[g + HEADER + 1 + j] = c
            if carried[j] == level:
                here = j
        at = level >= 0 and pool[n] == level
        child = int64(pool[n + 2 + k]) if at else n
        entries = int64(0)
        first = int64(0)
        c = int64(0)
        if here >= 0:
            c = int64(frames[g + HEADER + 1 + here])
            frames[g + HEADER + 1 + here] = 0
        elif at and fixed[level] != 0:
            c = int64(fixed[level])
            if pool[c] == level:
                c = int64(pool[c + 2 + k])
        if at and c != 0:
            row = base[level] + int64(payload(pool, c))
            first = entry_first[row]
            entries = entry_first[row + 1] - first
            if e < entries:
                child = int64(pool[n + 2 + entry_value[first + e]])
        if entries > 0 and e == entries:
            begin = rp - entries
            if down[SUMMING] == 0:
                for i in range(entries):
                    terms[2 * i] = weights[entry_weight[first + i]]
                    terms[2 * i + 1] = found[begin + i]
                if entries > 1 or terms[0] != options[ONE]:
                    begin_sum(stack, sum_state, entries, options[NORMALISED])
                    down[SUMMING] = 1
            if down[SUMMING] != 0:
                code = run_weighted_sum(
                    pool, head, unique, arity, slots, ring, ring_state, options, field, stack, terms,
                    results, sum_state,
                )  # fmt: skip
                if code != DONE:
                    break
                code = YIELDED
                head[2] += STEPS - sum_state[2]
                sum_state[2] = STEPS
                down[SUMMING] = 0
                found[begin] = results[0]
            rp = begin + 1
            frames[f] = k + 1
            frames[f + 1] = 0
            continue
        # the child, known or to be found
        r = int64(0)
        top = int64(pool[child])
        if top == leaf_level:
            r = child
        else:
            beneath = top
            live = top <= last
            for j in range(width):
                c = int64(frames[g + HEADER + 1 + j])
                if c == 0:
                    continue
                if c == identity[j] or carried[j] < beneath:
                    frames[g + HEADER + 1 + j] = 0
                    continue
                live = True
                if c >= FIRST:
                    top = min(top, int64(pool[c]))
            if not live:
                r = child
            else:
                frames[g + HEADER] = child
                if width % 2 == 0:
                    frames[g + HEADER + 1 + width] = 0
                r = ring_lookup(slots, ring, ring_state, frames, g + HEADER, pairs, key)
        if entries > 0:
            frames[f + 1] = e + 1
        else:
            frames[f] = k + 1
        if r != 0:
            found[rp] = r
            rp += 1
            continue
        frames[g] = 0
        frames[g + 1] = 0
        frames[g + 2] = top
        sp += 1
    down[FRAMES] = sp
    down[FOUND] = rp
    head[2] += STEPS - budget
    return code
