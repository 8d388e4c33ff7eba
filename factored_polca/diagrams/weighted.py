"""The fused weighted sum  sum_v c_v r_v, and the regression of a diagram, as resumable kernels.

`run_weighted_sum` recurses on all 2m diagrams at once.  A frame owns a list of terms (c_j, r_j) on
the term stack.  Terms whose weight is the constant 0 are dropped; where the weights are known to
sum to 1 (a conditional distribution) and all r_j are one diagram, that diagram is the sum.  So
deterministic effects and persistence cost no arithmetic at all.

Terms with r_j = 0 are dropped too, so that a sum costs what its non-zero terms cost.  The weights of those
that stay need not sum to 1, which the frames below are told.  Where two or more stay that all have one r_j,
zeros stay with them, unless these are many: further down there may be branches on which only that r_j has
weight.

    frame   [base, terms, level, next child, whether the weights sum to 1]

Results are remembered by their terms in a lossy cache: a slot holds a position in a ring of words
where the key (m, mark, c_1, r_1, ..., c_m, r_m) was written; it is valid until the ring has come
round.  `mark` tells fields and the normalised from the general sum.

`run_regression` computes, for every node n of V from the leaves up,

    R(n) = sum_v P(x_i' = v | x) R(child_v(n)),        i the level of n,

the back-projection of V through one action without synchronic arcs (DESIGN 3).  A level that n
skips needs no sum, since the row sums to exactly 1.  Below the last level that the action changes
a node is its own regression.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.apply import cache_index, float_payload
from factored_polca.diagrams.field import field_add, field_multiply
from factored_polca.diagrams.jit import inline, inner_kernel, int64, lean_kernel
from factored_polca.diagrams.nodes import (
    DONE,
    FULL,
    STEPS,
    YIELDED,
    Int32Array,
    Int64Array,
    find_or_add,
    mix,
    payload,
)

ZERO, ONE, NORMALISED, MARK, IS_FLOAT, STEP = range(6)
"""Places in `options`: the leaves 0 and 1, whether the weights sum to 1, the mark, the leaf type, and the
bits of a float that sums of floats are rounded to multiples of (0: they are not)."""

_LOW = np.uint64(0xFFFFFFFF)
_S32 = np.uint64(32)


@inline
def ring_slot(terms: Int32Array, base: int, count: int, mark: int, mask: int) -> int:
    """Where the cache keeps the sum of `count` terms from `base` on."""
    h = np.uint64(mark + 17 * count) * np.uint64(0x9E3779B97F4A7C15)
    for j in range(2 * count):
        h = mix(h, terms[base + j])
    return int64(h >> _S32) & mask


@inline
def ring_lookup(
    slots: Int64Array, ring: Int32Array, ring_state: Int64Array, terms: Int32Array,
    base: int, count: int, mark: int,
) -> Any:  # fmt: skip
    """The remembered sum of the terms, or 0."""
    slot = 2 * ring_slot(terms, base, count, mark, (len(slots) >> 1) - 1)
    position = slots[slot] - 1
    if position < 0 or ring_state[0] - position > len(ring):
        return int64(0)
    at = position & (len(ring) - 1)
    if ring[at] != count or ring[at + 1] != mark:
        return int64(0)
    for j in range(2 * count):
        if ring[at + 2 + j] != terms[base + j]:
            return int64(0)
    return slots[slot + 1]


@inline
def ring_insert(
    slots: Int64Array, ring: Int32Array, ring_state: Int64Array, terms: Int32Array,
    base: int, count: int, mark: int, result: int,
) -> None:  # fmt: skip
    """Remember the sum of the terms; keys too long for the ring are not remembered."""
    size = 2 + 2 * count
    if 4 * size > len(ring):
        return
    at = ring_state[0] & (len(ring) - 1)
    if at + size > len(ring):
        ring_state[0] += len(ring) - at
        at = 0
    slot = 2 * ring_slot(terms, base, count, mark, (len(slots) >> 1) - 1)
    slots[slot] = ring_state[0] + 1
    slots[slot + 1] = result
    ring[at] = count
    ring[at + 1] = mark
    for j in range(2 * count):
        ring[at + 2 + j] = terms[base + j]
    ring_state[0] += size


@inline
def settle(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array,
    options: Int64Array, field: npt.NDArray[np.uint64], terms: Int32Array, base: int, count: int,
    normalised: int,
) -> tuple[int, int, int, int]:  # fmt: skip
    """Drop zero terms of a list.

    Answers (result or 0 or -1 for full, terms kept, top level, whether the weights kept sum to 1).
    """
    zero = options[ZERO]
    leaf_level = len(arity) - 1
    kept = 0
    top = leaf_level
    same = True
    first = int64(0)
    full = 0
    for j in range(count):
        c = int64(terms[base + 2 * j])
        if c == zero:
            continue
        r = int64(terms[base + 2 * j + 1])
        if r != zero:
            full += 1
            if first == 0:
                first = r
            elif r != first:
                same = False
        terms[base + 2 * kept] = c
        terms[base + 2 * kept + 1] = r
        kept += 1
    if full == 0:
        return zero, kept, top, normalised
    if normalised != 0 and same and full == kept:
        return first, kept, top, normalised
    if full < kept and (normalised == 0 or not same or full == 1 or 2 * full < kept):
        normalised = int64(0)
        listed = kept
        kept = 0
        for j in range(listed):
            if terms[base + 2 * j + 1] == zero:
                continue
            terms[base + 2 * kept] = terms[base + 2 * j]
            terms[base + 2 * kept + 1] = terms[base + 2 * j + 1]
            kept += 1
    if kept == 1 and terms[base] == options[ONE]:
        return int64(terms[base + 1]), kept, top, normalised
    for j in range(kept):
        top = min(top, min(pool[terms[base + 2 * j]], pool[terms[base + 2 * j + 1]]))
    if top < leaf_level:
        return int64(0), kept, top, normalised
    value = np.uint64(0)
    if options[IS_FLOAT] != 0:
        total = 0.0
        for j in range(kept):
            weight = np.uint64(payload(pool, terms[base + 2 * j])).view(np.float64)
            total += weight * np.uint64(payload(pool, terms[base + 2 * j + 1])).view(np.float64)
        if options[STEP] != 0:
            step = np.int64(options[STEP]).view(np.float64)
            total = np.rint(total / step) * step
        value = float_payload(total)
    else:
        for j in range(kept):
            product = field_multiply(
                payload(pool, terms[base + 2 * j]),
                payload(pool, terms[base + 2 * j + 1]),
                field[0],
                field[1],
            )
            value = field_add(value, product, field[0])
    free = base + 2 * count
    terms[free] = np.int32(value & _LOW)
    terms[free + 1] = np.int32(value >> _S32)
    return find_or_add(pool, head, unique, arity, leaf_level, terms, free), kept, top, normalised


@inline
def begin_sum(stack: Int32Array, state: Int64Array, count: int, normalised: int) -> None:
    """The frame of a sum of the first `count` terms, as `run_weighted_sum` takes it."""
    stack[0] = 0
    stack[1] = count
    stack[2] = -1
    stack[3] = 0
    stack[4] = normalised
    state[0] = 1
    state[1] = 0


@lean_kernel
def run_weighted_sum(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array,
    slots: Int64Array, ring: Int32Array, ring_state: Int64Array,
    options: Int64Array, field: npt.NDArray[np.uint64],
    stack: Int32Array, terms: Int32Array, results: Int32Array, state: Int64Array,
) -> int:  # fmt: skip
    """Sum the terms of the frames in `stack`.

    `state` is [frames, results, budget]; the caller puts one frame of level -1 with the terms, its last
    word `options[NORMALISED]`.
    """
    mark = options[MARK] - options[NORMALISED]
    sp = state[0]
    rp = state[1]
    budget = state[2]
    while sp > 0:
        if budget <= 0:
            state[0] = sp
            state[1] = rp
            state[2] = STEPS
            head[2] += STEPS
            return YIELDED
        f = 5 * (sp - 1)
        base = int64(stack[f])
        count = int64(stack[f + 1])
        budget -= count
        level = stack[f + 2]
        k = stack[f + 3]
        if level < 0:
            if k == 1:
                break
        elif k == arity[level]:
            r = find_or_add(pool, head, unique, arity, int64(level), results, rp - arity[level])
            if r < 0:
                state[0] = sp
                state[1] = rp
                state[2] = budget
                return FULL
            ring_insert(slots, ring, ring_state, terms, base, count, mark + stack[f + 4], r)
            rp -= arity[level]
            results[rp] = r
            rp += 1
            sp -= 1
            continue
        new = base + 2 * count
        for j in range(2 * count):
            node = int64(terms[base + j])
            if level >= 0 and pool[node] == level:
                node = int64(pool[node + 2 + k])
            terms[new + j] = node
        r, kept, top, normalised = settle(
            pool, head, unique, arity, options, field, terms, new, count, int64(stack[f + 4])
        )
        if r < 0:
            state[0] = sp
            state[1] = rp
            state[2] = budget
            return FULL
        if r == 0:
            r = ring_lookup(slots, ring, ring_state, terms, new, kept, mark + normalised)
        stack[f + 3] = k + 1
        if r == 0:
            stack[f + 5] = new
            stack[f + 6] = kept
            stack[f + 7] = top
            stack[f + 8] = 0
            stack[f + 9] = normalised
            sp += 1
            continue
        results[rp] = r
        rp += 1
    state[0] = sp
    state[1] = rp
    state[2] = budget
    return DONE


@inner_kernel
def collect_possible(
    pool: Int32Array, arity: Int32Array, root: int, nodes: Int32Array, stack: Int32Array,
    weights: Int32Array, first_weight: Int64Array, last_changed: int, zero: int,
) -> int:  # fmt: skip
    """As `walk.collect`, without nodes to which only impossible values lead, those whose weight is 0
    everywhere, and with none at all, answer 0, if then every leaf is 0."""
    count = 0
    some = False
    stack[0] = root
    stack[1] = 0
    sp = 1
    while sp > 0:
        node = int64(stack[2 * sp - 2])
        k = stack[2 * sp - 1]
        level = pool[node]
        if level <= last_changed and k < arity[level]:
            stack[2 * sp - 1] = k + 1
            if weights[first_weight[level] + k] == zero:
                continue
            child = int64(pool[node + 2 + k])
            number = int64(pool[child + 1])
            if number < 0 or number >= count or nodes[number] != child:
                stack[2 * sp] = child
                stack[2 * sp + 1] = 0
                sp += 1
            continue
        some = some or (level > last_changed and node != zero)
        pool[node + 1] = count
        nodes[count] = node
        count += 1
        sp -= 1
    return count if some else 0


@lean_kernel
def run_regression(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array,
    slots: Int64Array, ring: Int32Array, ring_state: Int64Array,
    options: Int64Array, field: npt.NDArray[np.uint64],
    stack: Int32Array, terms: Int32Array, results: Int32Array, state: Int64Array,
    cache: Int32Array, key: int, nodes: Int32Array, count: int, weights: Int32Array,
    first_weight: Int64Array, last_changed: int, regressed: Int32Array, progress: Int64Array,
) -> int:  # fmt: skip
    """Regress the `count` nodes in `nodes` (children first, numbered in their scratch words; those that
    no possible value leads to may be missing, see `collect_possible`).

    `weights[first_weight[i] + v]` is the diagram of P(x_i' = v | x).  `progress` is
    [next node, 1 if a sum is under way]; `cache` remembers regressions under `key` between calls.
    """
    mask = (len(cache) >> 2) - 1
    zero = np.int32(options[ZERO])
    while progress[0] < count:
        node = int64(nodes[progress[0]])
        level = pool[node]
        if level > last_changed:
            regressed[progress[0]] = node
            progress[0] += 1
            continue
        i = 4 * cache_index(key, node, 0, mask)
        if progress[1] == 0:
            if cache[i] == node and cache[i + 1] == 0 and cache[i + 2] == key:
                regressed[progress[0]] = cache[i + 3]
                progress[0] += 1
                continue
            d = arity[level]
            for v in range(d):
                weight = weights[first_weight[level] + v]
                terms[2 * v] = weight
                terms[2 * v + 1] = zero
                if weight != zero:
                    terms[2 * v + 1] = regressed[pool[pool[node + 2 + v] + 1]]
            begin_sum(stack, state, int64(d), options[NORMALISED])
            progress[1] = 1
        code = run_weighted_sum(
            pool, head, unique, arity, slots, ring, ring_state, options, field,
            stack, terms, results, state,
        )  # fmt: skip
        if code != DONE:
            return code
        progress[1] = 0
        regressed[progress[0]] = results[0]
        cache[i] = node
        cache[i + 1] = 0
        cache[i + 2] = key
        cache[i + 3] = results[0]
        progress[0] += 1
    head[2] += STEPS - state[2]
    state[2] = STEPS
    return DONE
