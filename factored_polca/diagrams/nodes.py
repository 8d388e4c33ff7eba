"""The node store: one int32 pool, hash-consed; kernels that find, add, rehash and compact nodes.

A node is its offset in `pool`.  Its record is

    pool[n]      the level, 0 at the top; `len(arity) - 1` for a leaf
    pool[n + 1]  scratch: the node's number in the last traversal that met it
    pool[n + 2:] the children, one for each value of the level's variable; for a leaf the two halves
                 of its 64-bit payload

A slot of the unique table holds a node in its lower half and bits of the node's hash in the upper, so
that a search looks at the pool only where the hash agrees.

Children are made before parents and compaction keeps the order, so a child's offset is always less
than its parent's.  `head` holds [end of the pool, number of nodes, steps done].  A full pool or
unique table is answered with -1; the caller grows it and goes on where it was.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.jit import inline, int64, kernel, lean_kernel

Int32Array = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]

FIRST = 4
"""Offset of the first node; smaller numbers are free to mean other things."""

DONE, FULL, YIELDED, INVALID = 0, 1, 2, 3
"""What a resumable kernel answers: finished; the store is full; its budget of steps is used up; a
condition has a leaf that is neither 0 nor 1."""

STEPS = 1 << 21
"""Steps that a resumable kernel takes before it hands control back, so that Ctrl-C is seen."""

_K1 = np.uint64(0x9E3779B97F4A7C15)
_K2 = np.uint64(0xC2B2AE3D27D4EB4F)
_S29 = np.uint64(29)
_S32 = np.uint64(32)
_NODE = np.int64(0xFFFFFFFF)


@inline
def mix(h: np.uint64, word: int) -> np.uint64:
    """Hash state `h` with one more 32-bit word."""
    h = (h ^ np.uint64(np.uint32(word))) * _K2
    return h ^ (h >> _S29)


@inline
def find_or_add(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array,
    level: int, words: Int32Array, base: int,
) -> Any:  # fmt: skip
    """The node at `level` with children (or payload halves) words[base:]; -1 if there is no room.

    It becomes part of each kernel that calls it: a call would count references to five arrays.
    """
    d = arity[level]
    if level < len(arity) - 1:
        first = words[base]
        same = True
        for k in range(1, d):
            if words[base + k] != first:
                same = False
                break
        if same:
            return int64(first)
    h = np.uint64(level + 1) * _K1
    for k in range(d):
        h = mix(h, words[base + k])
    mask = len(unique) - 1
    i = int64(h >> _S32) & mask
    tag = int64(h << _S32)
    while True:
        entry = unique[i]
        if entry == 0:
            break
        n = entry & _NODE
        if entry - n == tag and pool[n] == level:
            same = True
            for k in range(d):
                if pool[n + 2 + k] != words[base + k]:
                    same = False
                    break
            if same:
                return n
        i = (i + 1) & mask
    n = head[0]
    if n + 2 + d > len(pool) or 2 * head[1] >= len(unique):
        return int64(-1)
    pool[n] = level
    pool[n + 1] = 0
    for k in range(d):
        pool[n + 2 + k] = words[base + k]
    unique[i] = tag | n
    head[0] = n + 2 + d
    head[1] += 1
    return n


@lean_kernel
def add_node(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array, level: int, words: Int32Array
) -> int:  # fmt: skip
    """`find_or_add` for callers in Python."""
    return int64(find_or_add(pool, head, unique, arity, level, words, 0))


@lean_kernel
def rehash(pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array) -> None:
    """Fill the empty table `unique` with every node of the pool."""
    mask = len(unique) - 1
    n = int64(FIRST)
    while n < head[0]:
        level = pool[n]
        d = arity[level]
        h = np.uint64(level + 1) * _K1
        for k in range(d):
            h = mix(h, pool[n + 2 + k])
        i = int64(h >> _S32) & mask
        while unique[i] != 0:
            i = (i + 1) & mask
        unique[i] = int64(h << _S32) | n
        n += 2 + d


@kernel
def make_leaves(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array,
    payloads: npt.NDArray[np.uint64], out: Int32Array, start: int,
) -> int:  # fmt: skip
    """Write the leaf of each payload from `start` on to `out`; answer how many are done."""
    words = np.empty(2, np.int32)
    for i in range(start, len(payloads)):
        words[0] = np.int32(payloads[i] & np.uint64(0xFFFFFFFF))
        words[1] = np.int32(payloads[i] >> _S32)
        n = find_or_add(pool, head, unique, arity, len(arity) - 1, words, 0)
        if n < 0:
            return i
        out[i] = n
    return len(payloads)


@inline
def payload(pool: Int32Array, leaf: int) -> np.uint64:
    """The 64 bits of a leaf."""
    low = np.uint64(np.uint32(pool[leaf + 2]))
    return low | (np.uint64(np.uint32(pool[leaf + 3])) << _S32)


@lean_kernel
def compact(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array,
    roots: Int32Array, stack: Int32Array,
) -> None:  # fmt: skip
    """Drop every node that no root reaches, move the others down, renumber `roots`, rehash.

    Marks and new offsets are kept in the scratch word: 0 for a dead node.  All of it is one kernel,
    so that Ctrl-C can't come between and leave roots or table behind.
    """
    leaf_level = len(arity) - 1
    n = int64(FIRST)
    while n < head[0]:
        pool[n + 1] = 0
        n += 2 + arity[pool[n]]
    for i in range(len(roots)):
        if roots[i] == 0 or pool[roots[i] + 1] != 0:
            continue
        pool[roots[i] + 1] = 1
        stack[0] = roots[i]
        stack[1] = 0
        sp = 1
        while sp > 0:
            node = int64(stack[2 * sp - 2])
            k = stack[2 * sp - 1]
            if pool[node] == leaf_level or k == arity[pool[node]]:
                sp -= 1
                continue
            stack[2 * sp - 1] = k + 1
            child = pool[node + 2 + k]
            if pool[child + 1] == 0:
                pool[child + 1] = 1
                stack[2 * sp] = child
                stack[2 * sp + 1] = 0
                sp += 1
    n = int64(FIRST)
    new = int64(FIRST)
    while n < head[0]:
        size = 2 + arity[pool[n]]
        if pool[n + 1] != 0:
            pool[n + 1] = new
            new += size
        n += size
    for i in range(len(roots)):
        if roots[i] != 0:
            roots[i] = pool[roots[i] + 1]
    n = int64(FIRST)
    while n < head[0]:
        size = 2 + arity[pool[n]]
        if pool[n + 1] != 0 and pool[n] != leaf_level:
            for k in range(2, size):
                pool[n + k] = pool[pool[n + k] + 1]
        n += size
    n = int64(FIRST)
    count = 0
    end = head[0]
    while n < end:
        size = 2 + arity[pool[n]]
        target = int64(pool[n + 1])
        if target != 0:
            for k in range(size):
                pool[target + k] = pool[n + k]
            count += 1
        n += size
    head[0] = new
    head[1] = count
    for i in range(len(unique)):
        unique[i] = 0
    rehash(pool, head, unique, arity)


@lean_kernel
def insert_all(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array,
    levels: Int32Array, first: Int64Array, children: Int32Array,
    out: Int32Array, words: Int32Array, progress: Int64Array,
) -> int:  # fmt: skip
    """Add listed nodes, children first; leaves (the last level) are given in `out` already."""
    leaf_level = len(arity) - 1
    while progress[0] < len(levels):
        i = progress[0]
        if levels[i] < leaf_level:
            for k in range(arity[levels[i]]):
                words[k] = out[children[first[i] + k]]
            r = find_or_add(pool, head, unique, arity, int64(levels[i]), words, 0)
            if r < 0:
                return FULL
            out[i] = r
        progress[0] += 1
    return DONE
