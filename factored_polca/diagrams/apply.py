"""Binary operators on two diagrams, and the choice if-then-else, as resumable kernels.

The recursion on the two top nodes (Bryant 1986; Bahar et al. 1993 for several leaf values) is run
on an explicit stack, so that it can stop for more memory or for Ctrl-C and go on where it was:

    frame   a, b (and c), level, next child
    results the finished children of all open frames

An operator is a row of `OPERATORS`: its code, which leaf types it takes, identities, absorbing
elements, whether it commutes, and what it gives on equal arguments.  Kernels know no operator but
by these rows, except for `leaf_value`, which computes on two leaves.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.field import field_add, field_multiply, field_subtract
from factored_polca.diagrams.jit import inline, inner_kernel, int64, lean_kernel
from factored_polca.diagrams.nodes import (
    DONE,
    FULL,
    INVALID,
    STEPS,
    YIELDED,
    Int32Array,
    Int64Array,
    find_or_add,
    payload,
)

(
    FIELD_ADD, FIELD_SUBTRACT, FIELD_MULTIPLY,
    FLOAT_ADD, FLOAT_SUBTRACT, FLOAT_MULTIPLY, FLOAT_MINIMUM, FLOAT_MAXIMUM, FLOAT_LESS,
    AND, OR, XOR, DIFFERENCE, EQUAL, PAIR, OVERRIDE,
) = range(1, 17)  # fmt: skip
"""Operator codes.  OVERRIDE(a, b) is b where the index a is 0, else a - 1; its left identity is 0."""

PAIR_TOUCHED = 17
"""A key for the computed cache, not a code: PAIR with 0 as right absorbing element."""

CODE, LEFT_IDENTITY, RIGHT_IDENTITY, LEFT_ABSORBING, RIGHT_ABSORBING, COMMUTES, SAME, KEY = range(8)
"""Places in the row of integers that describes an operator to the kernel: nodes, or 0 for none.

`SAME`: -1 the argument itself, 0 no rule, else the node that op(a, a) gives; `KEY` marks entries of
the computed cache (the operator's code and the field)."""

_S32 = np.uint64(32)
_LOW = np.uint64(0xFFFFFFFF)
_ONE = np.uint64(1)
_ZERO = np.uint64(0)
_NAN = np.float64(np.nan).view(np.uint64)


@inline
def float_payload(value: float) -> np.uint64:
    """The payload of a float: without -0.0 and with one NaN."""
    if value != value:
        return _NAN
    return np.float64(value + 0.0).view(np.uint64)


@inner_kernel
def leaf_value(code: int, x: np.uint64, y: np.uint64, prime: np.uint64, inverse: np.uint64) -> np.uint64:
    """The payload of op(x, y) for payloads x, y; conditions need none, see `shortcut`."""
    if code == FIELD_ADD:
        return field_add(x, y, prime)
    if code == FIELD_SUBTRACT:
        return field_subtract(x, y, prime)
    if code == FIELD_MULTIPLY:
        return field_multiply(x, y, prime, inverse)
    a = np.uint64(x).view(np.float64)
    b = np.uint64(y).view(np.float64)
    if code == FLOAT_LESS:
        if a < b:
            return _ONE
        return _ZERO
    if code == FLOAT_ADD:
        a = a + b
    elif code == FLOAT_SUBTRACT:
        a = a - b
    elif code == FLOAT_MULTIPLY:
        a = a * b
    elif code == FLOAT_MINIMUM:
        a = min(a, b)
    else:
        a = max(a, b)
    return float_payload(a)


@inline
def shortcut(op: Int64Array, a: int, b: int) -> Any:
    """The node op(a, b) where the operator's row decides it, else 0.

    It decides all that a condition's leaves 0 and 1 can be.
    """
    if a == b and op[SAME] != 0:
        if op[SAME] < 0:
            return a
        return op[SAME]
    if a == op[LEFT_IDENTITY]:
        return b
    if b == op[RIGHT_IDENTITY]:
        return a
    if a == op[LEFT_ABSORBING]:
        return a
    if b == op[RIGHT_ABSORBING]:
        return b
    return int64(0)


@inline
def cache_index(key: int, a: int, b: int, mask: int) -> int:
    """Where the computed cache keeps op(a, b)."""
    h = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(b) * np.uint64(0xC2B2AE3D27D4EB4F)
    h = (h + np.uint64(key)) * np.uint64(0xD6E8FEB86659FD93)
    return int64(h >> np.uint64(32)) & mask


@lean_kernel
def apply_binary(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array, cache: Int32Array,
    op: Int64Array, field: npt.NDArray[np.uint64], stack: Int32Array, results: Int32Array,
    state: Int64Array,
) -> int:  # fmt: skip
    """Run op on the frames in `stack`.

    `state` is [frames, results]; the caller puts one frame whose level is -1, a pseudo-node with
    the pair of roots as its only child.
    """
    leaf_level = len(arity) - 1
    mask = (len(cache) >> 2) - 1
    key = op[KEY]
    code = op[CODE]
    sp = state[0]
    rp = state[1]
    budget = STEPS
    while sp > 0:
        f = 4 * (sp - 1)
        a = int64(stack[f])
        b = int64(stack[f + 1])
        level = int64(stack[f + 2])
        k = int64(stack[f + 3])
        if level < 0 and k == 1:
            break
        size = int64(1) if level < 0 else int64(arity[level])
        budget -= 1 + size - k
        if budget < 0:
            state[0] = sp
            state[1] = rp
            head[2] += STEPS
            return YIELDED
        split_a = level >= 0 and pool[a] == level
        split_b = level >= 0 and pool[b] == level
        down = False
        while k < size:
            x = int64(pool[a + 2 + k]) if split_a else a
            y = int64(pool[b + 2 + k]) if split_b else b
            r = shortcut(op, x, y)
            if r == 0:
                lx = pool[x]
                ly = pool[y]
                if lx == leaf_level and (ly == leaf_level or code == OVERRIDE):
                    if code == EQUAL:
                        value = _ZERO
                    elif AND <= code <= DIFFERENCE:
                        return INVALID
                    elif code == PAIR:
                        value = (np.uint64(x) << _S32) | np.uint64(y)
                    elif code == OVERRIDE:
                        value = payload(pool, x) - _ONE
                    else:
                        value = leaf_value(code, payload(pool, x), payload(pool, y), field[0], field[1])
                    results[rp] = np.int32(value & _LOW)
                    results[rp + 1] = np.int32(value >> _S32)
                    r = find_or_add(pool, head, unique, arity, leaf_level, results, rp)
                    if r < 0:
                        stack[f + 3] = k
                        state[0] = sp
                        state[1] = rp
                        head[2] += STEPS - budget
                        return FULL
                else:
                    if op[COMMUTES] != 0 and x > y:
                        x, y = y, x
                        lx, ly = ly, lx
                    i = 4 * cache_index(key, x, y, mask)
                    if cache[i] == x and cache[i + 1] == y and cache[i + 2] == key:
                        r = int64(cache[i + 3])
                    else:
                        stack[f + 3] = k + 1
                        stack[f + 4] = x
                        stack[f + 5] = y
                        stack[f + 6] = min(lx, ly)
                        stack[f + 7] = 0
                        sp += 1
                        down = True
                        break
            results[rp] = r
            rp += 1
            k += 1
        if down:
            continue
        if level < 0:
            stack[f + 3] = 1
            continue
        r = find_or_add(pool, head, unique, arity, level, results, rp - size)
        if r < 0:
            stack[f + 3] = k
            state[0] = sp
            state[1] = rp
            head[2] += STEPS - budget
            return FULL
        i = 4 * cache_index(key, a, b, mask)
        cache[i] = a
        cache[i + 1] = b
        cache[i + 2] = key
        cache[i + 3] = r
        rp -= size
        results[rp] = r
        rp += 1
        sp -= 1
    head[2] += STEPS - budget
    state[0] = sp
    state[1] = rp
    return DONE


@lean_kernel
def choose(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array, cache: Int32Array,
    true: int, false: int, stack: Int32Array, results: Int32Array, state: Int64Array,
) -> int:  # fmt: skip
    """If-then-else of three diagrams, the first with leaves `true` and `false`.

    Frames are [a, b, c, level, next child]; the cache has entries of five words in eight.
    """
    mask = (len(cache) >> 3) - 1
    sp = state[0]
    rp = state[1]
    budget = STEPS
    while sp > 0:
        budget -= 1
        if budget < 0:
            state[0] = sp
            state[1] = rp
            head[2] += STEPS
            return YIELDED
        f = 5 * (sp - 1)
        a = int64(stack[f])
        b = int64(stack[f + 1])
        c = int64(stack[f + 2])
        level = stack[f + 3]
        k = stack[f + 4]
        if level < 0:
            if k == 1:
                break
        elif k == arity[level]:
            r = find_or_add(pool, head, unique, arity, int64(level), results, rp - arity[level])
            if r < 0:
                state[0] = sp
                state[1] = rp
                head[2] += STEPS - budget
                return FULL
            i = 8 * (cache_index(c, a, b, mask))
            cache[i] = a
            cache[i + 1] = b
            cache[i + 2] = c
            cache[i + 3] = r
            rp -= arity[level]
            results[rp] = r
            rp += 1
            sp -= 1
            continue
        else:
            if pool[a] == level:
                a = int64(pool[a + 2 + k])
            if pool[b] == level:
                b = int64(pool[b + 2 + k])
            if pool[c] == level:
                c = int64(pool[c + 2 + k])
        r = int64(0)
        if a == true or b == c:
            r = b
        elif a == false:
            r = c
        elif pool[a] == len(arity) - 1:
            return INVALID
        elif b == true and c == false:
            r = a
        else:
            i = 8 * cache_index(c, a, b, mask)
            if cache[i] == a and cache[i + 1] == b and cache[i + 2] == c:
                r = int64(cache[i + 3])
            else:
                stack[f + 4] = k + 1
                stack[f + 5] = a
                stack[f + 6] = b
                stack[f + 7] = c
                stack[f + 8] = min(pool[a], min(pool[b], pool[c]))
                stack[f + 9] = 0
                sp += 1
                continue
        stack[f + 4] = k + 1
        results[rp] = r
        rp += 1
    head[2] += STEPS - budget
    state[0] = sp
    state[1] = rp
    return DONE
