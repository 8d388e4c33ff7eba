"""Refining a partition of states that are listed one by one, as kernels.

M is a matrix over a field, [x, y]; P a partition of the numbers x; V = r o P with a random r_k for each
block k.  Then f = M V is a random linear form of what the rows of M send to the blocks, and a pass splits
the blocks by f.  D, the change of V, is not 0 only for what got another block, so that a pass looks at the
columns of those alone and splits by M D: where f was equal, it differs where M D does.

    order        the states, block by block; place[order[i]] = i
    begin, end   where a block's states stand in `order`
    changed      the states whose V has changed, delta by how much
    acc          M D of the states touched, those with an entry in a column looked at

The touched states of a block, sorted by M D, are parts; so are all others, together.  The largest part
keeps the block's number and its element, the others are what has changed next (Hopcroft 1971; Paige &
Tarjan 1987; Valmari & Franceschinis 2010): after the first pass a state is among the changed no more often
than log2 of the number of states.

`list_weights` makes M: the sum over choices c of s_c T_c(x, y), s_c random, with T_c(x, .) zero where c
does not apply.  Where two states differ in some T_c V, they agree in the sum with a chance of 1/p over s
(Schwartz 1980; Zippel 1979).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.field import field_add, field_multiply, field_subtract
from factored_polca.diagrams.jit import int64, late_lean_kernel
from factored_polca.diagrams.nodes import DONE, STEPS, YIELDED, Int32Array, Int64Array, payload
from factored_polca.minimisation.draws_kernel import leaf_at, next_outcome

UInt64Array = npt.NDArray[np.uint64]

SHORT = 3
"""What `list_weights` answers, beside DONE and YIELDED, where the arrays of entries are too short."""

STATE, ENTRIES = range(2)
"""Places in `list_weights`' `state`: the next state, the entries so far."""

CHANGED, BLOCKS, PASSES = range(3)
"""Places in `refine_listed`'s `state`: the states that have changed, the blocks, the passes done."""

_ZERO = np.uint64(0)
_SHORT_PIECE = 12


@late_lean_kernel
def list_weights(
    pool: Int32Array, leaf_level: int, columns: Int32Array, field: UInt64Array,
    apps: Int32Array, policies: Int32Array, primitives: Int64Array, local: Int64Array,
    factors: UInt64Array, first_draw: Int64Array, roots: Int32Array, targets: Int32Array,
    bases: Int64Array, start: Int64Array, value: Int32Array, residue: UInt64Array,
    features: Int64Array, sizes: Int64Array, strides: Int64Array, stride_of: Int64Array, count: int,
    states: int,
    row: Int32Array, entry: Int64Array, ends: Int64Array, weights: UInt64Array, codes: Int64Array,
    first: Int64Array, target: Int32Array, weight: UInt64Array, stamp: Int32Array, state: Int64Array,
) -> int:  # fmt: skip
    """The rows of M from state `state[STATE]` on: `target` and `weight` from `first[x]` to `first[x + 1]`.

    State x has the value number (x // strides[i]) % sizes[i] of feature features[i], of `count` in all; the
    draw into column `count` + i is the next value of feature i, which adds stride_of[i] times its number.
    Choice c applies where the diagram apps[c] is 1, and is the action that the diagram policies[c] says, or
    primitives[c] where that is 0; its draws are those from first_draw[local[action]] on.  `stamp` [state]
    is negative at the start.
    """
    pause_at = state[ENTRIES] + STEPS
    while state[STATE] < states:
        x = state[STATE]
        if state[ENTRIES] > pause_at:
            return YIELDED
        begin = state[ENTRIES]
        at = begin
        for i in range(len(features)):
            row[features[i]] = np.int32((x // strides[i]) % sizes[i])
        for c in range(len(apps)):
            if payload(pool, leaf_at(pool, leaf_level, columns, apps[c], row)) == _ZERO:
                continue
            action = primitives[c]
            if policies[c] != 0:
                action = int64(payload(pool, leaf_at(pool, leaf_level, columns, policies[c], row)))
            p = local[action]
            for i in range(len(features)):
                row[count + features[i]] = row[features[i]]
            low = first_draw[p]
            high = first_draw[p + 1]
            weights[low] = factors[c]
            codes[low] = x
            d = next_outcome(
                pool, leaf_level, columns, roots, targets, bases, start, value, low, high, int64(1), row,
                entry, ends,
            )  # fmt: skip
            while d >= 0:
                while d < high:
                    weights[d + 1] = field_multiply(weights[d], residue[entry[d]], field[0], field[1])
                    i = int64(targets[d]) - count
                    codes[d + 1] = codes[d] + stride_of[i] * (int64(row[targets[d]]) - row[i])
                    d += 1
                y = codes[high]
                position = int64(stamp[y])
                if position >= begin and position < at and target[position] == y:
                    weight[position] = field_add(weight[position], weights[high], field[0])
                else:
                    if at == len(target):
                        return SHORT
                    stamp[y] = at
                    target[at] = y
                    weight[at] = weights[high]
                    at += 1
                d = next_outcome(
                    pool, leaf_level, columns, roots, targets, bases, start, value, low, high, int64(0),
                    row, entry, ends,
                )  # fmt: skip
        state[ENTRIES] = at
        state[STATE] += 1
        first[x + 1] = at
    return DONE


@late_lean_kernel
def transpose(
    first: Int64Array, target: Int32Array, weight: UInt64Array, column_first: Int64Array,
    source: Int32Array, column_weight: UInt64Array,
) -> None:  # fmt: skip
    """Entries by column; `column_first` is zero at the start and has two places more than columns."""
    states = len(first) - 1
    for e in range(first[states]):
        column_first[target[e] + 2] += 1
    for y in range(states):
        column_first[y + 2] += column_first[y + 1]
    for x in range(states):
        for e in range(first[x], first[x + 1]):
            at = column_first[target[e] + 1]
            source[at] = x
            column_weight[at] = weight[e]
            column_first[target[e] + 1] = at + 1


@late_lean_kernel
def sort_by(keys: UInt64Array, items: Int32Array, low: int, high: int, stack: Int64Array) -> None:
    """Sort items[low:high] by their keys: quicksort in three parts, since many keys are alike."""
    stack[0] = low
    stack[1] = high
    depth = 1
    while depth > 0:
        depth -= 1
        a = stack[2 * depth]
        b = stack[2 * depth + 1]
        while b - a > _SHORT_PIECE:
            pivot = keys[items[(a + b) >> 1]]
            less = a
            more = b
            i = a
            while i < more:
                item = items[i]
                key = keys[item]
                if key < pivot:
                    items[i] = items[less]
                    items[less] = item
                    less += 1
                    i += 1
                elif key > pivot:
                    more -= 1
                    items[i] = items[more]
                    items[more] = item
                else:
                    i += 1
            if less - a < b - more:  # the longer one waits
                stack[2 * depth] = more
                stack[2 * depth + 1] = b
                b = less
            else:
                stack[2 * depth] = a
                stack[2 * depth + 1] = less
                a = more
            depth += 1
        for i in range(a + 1, b):
            item = items[i]
            key = keys[item]
            j = i
            while j > a and keys[items[j - 1]] > key:
                items[j] = items[j - 1]
                j -= 1
            items[j] = item


@late_lean_kernel
def refine_listed(
    column_first: Int64Array, source: Int32Array, weight: UInt64Array, field: UInt64Array,
    order: Int32Array, place: Int32Array, begin: Int32Array, end: Int32Array, block: Int32Array,
    elements: UInt64Array, changed: Int32Array, delta: UInt64Array, acc: UInt64Array, met: Int32Array,
    touched: Int32Array, hits: Int32Array, blocks_hit: Int32Array, stack: Int64Array, state: Int64Array,
    allowed: int, passes: int,
) -> int:  # fmt: skip
    """Passes until nothing changes, `passes` are done or there are more than `allowed` blocks.

    Between two calls `met`, `hits` and `acc` are zero.
    """
    budget = STEPS
    while state[CHANGED] > 0 and state[PASSES] < passes and state[BLOCKS] <= allowed:
        if budget < 0:
            return YIELDED
        count = 0
        for i in range(state[CHANGED]):
            y = changed[i]
            for e in range(column_first[y], column_first[y + 1]):
                x = source[e]
                part = field_multiply(weight[e], delta[i], field[0], field[1])
                if met[x] == 0:
                    met[x] = 1
                    touched[count] = x
                    count += 1
                acc[x] = field_add(acc[x], part, field[0])
            budget -= 1 + column_first[y + 1] - column_first[y]
        number_hit = 0
        for i in range(count):
            x = touched[i]
            met[x] = 0
            if acc[x] == _ZERO:
                continue
            b = block[x]
            if hits[b] == 0:
                blocks_hit[number_hit] = b
                number_hit += 1
            p = place[x]
            q = begin[b] + hits[b]
            other = order[q]
            order[q] = x
            order[p] = other
            place[x] = q
            place[other] = p
            hits[b] += 1
        fresh = 0
        for i in range(number_hit):
            b = blocks_hit[i]
            low = int64(begin[b])
            middle = low + hits[b]
            high = int64(end[b])
            hits[b] = 0
            sort_by(acc, order, low, middle, stack)
            kept = middle
            longest = high - middle
            a = low
            while a < middle:
                key = acc[order[a]]
                z = a
                while z < middle and acc[order[z]] == key:
                    place[order[z]] = z
                    z += 1
                if z - a > longest:
                    longest = z - a
                    kept = a
                a = z
            a = low
            while a < high:
                z = high
                if a < middle:
                    key = acc[order[a]]
                    z = a
                    while z < middle and acc[order[z]] == key:
                        z += 1
                if a == kept:
                    begin[b] = a
                    end[b] = z
                else:
                    new = state[BLOCKS]
                    state[BLOCKS] += 1
                    begin[new] = a
                    end[new] = z
                    change = field_subtract(elements[new], elements[b], field[0])
                    for j in range(a, z):
                        x = order[j]
                        block[x] = new
                        changed[fresh] = x
                        delta[fresh] = change
                        fresh += 1
                a = z
        for i in range(count):
            acc[touched[i]] = _ZERO
        state[CHANGED] = fresh
        state[PASSES] += 1
    return DONE
