"""Kernels that walk one diagram: collect its nodes, rebuild it, evaluate, count, find states.

`collect` lists the nodes children first, in the order in which a depth-first search that takes the
children in order leaves them; so the leaves appear in order of first occurrence, and each node's
scratch word holds its number in the list.  A stale scratch word is harmless: it counts only where
the list confirms it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.field import field_add, field_multiply
from factored_polca.diagrams.jit import int64, kernel, lean_kernel
from factored_polca.diagrams.nodes import DONE, FULL, Int32Array, Int64Array, find_or_add

UInt64Array = npt.NDArray[np.uint64]


@lean_kernel
def collect(pool: Int32Array, arity: Int32Array, root: int, nodes: Int32Array, stack: Int32Array) -> int:
    """Write the nodes under `root` to `nodes`, children first; answer how many."""
    leaf_level = len(arity) - 1
    count = 0
    stack[0] = root
    stack[1] = 0
    sp = 1
    while sp > 0:
        node = int64(stack[2 * sp - 2])
        k = stack[2 * sp - 1]
        level = pool[node]
        if level < leaf_level and k < arity[level]:
            stack[2 * sp - 1] = k + 1
            child = int64(pool[node + 2 + k])
            number = int64(pool[child + 1])
            if number < 0 or number >= count or nodes[number] != child:
                stack[2 * sp] = child
                stack[2 * sp + 1] = 0
                sp += 1
            continue
        pool[node + 1] = count
        nodes[count] = node
        count += 1
        sp -= 1
    return count


@lean_kernel
def rebuild(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array,
    nodes: Int32Array, changed: Int64Array, fixed: Int32Array, level_map: Int32Array,
    images: Int32Array, words: Int32Array, progress: Int64Array,
) -> int:  # fmt: skip
    """Rebuild the inner nodes number `changed` of a collected diagram, children first.

    `images` holds what each other node becomes, and receives what these become.  Where `fixed[level]`
    is not -1 that child is taken; other nodes move to `level_map[level]`.
    """
    while progress[0] < len(changed):
        number = changed[progress[0]]
        node = int64(nodes[number])
        level = pool[node]
        if fixed[level] >= 0:
            images[number] = images[pool[pool[node + 2 + fixed[level]] + 1]]
        else:
            for k in range(arity[level]):
                words[k] = images[pool[pool[node + 2 + k] + 1]]
            r = find_or_add(pool, head, unique, arity, int64(level_map[level]), words, 0)
            if r < 0:
                return FULL
            images[number] = r
        progress[0] += 1
    return DONE


@lean_kernel
def evaluate(
    pool: Int32Array, arity: Int32Array, root: int, states: Int32Array, columns: Int32Array,
    out: Int32Array,
) -> int:  # fmt: skip
    """The leaf of each state; `states[row, columns[level]]` is the value at a level.

    Answers the number of rows done: fewer than there are where a row has no such column or value.
    """
    leaf_level = len(arity) - 1
    width = states.shape[1]
    for row in range(len(states)):
        node = int64(root)
        level = pool[node]
        while level < leaf_level:
            column = int64(columns[level])
            if column < 0 or column >= width:
                return row
            value = int64(states[row, column])
            if value < 0 or value >= arity[level]:
                return row
            node = int64(pool[node + 2 + value])
            level = pool[node]
        out[row] = node
    return len(states)


@kernel
def first_states(
    pool: Int32Array, arity: Int32Array, root: int, nodes: Int32Array, stack: Int32Array,
    states: Int32Array,
) -> int:  # fmt: skip
    """The lexicographically first state of each leaf, in order of first occurrence."""
    leaf_level = len(arity) - 1
    path = np.zeros(leaf_level, np.int32)
    count = 0
    found = 0
    stack[0] = root
    stack[1] = 0
    sp = 1
    while sp > 0:
        node = int64(stack[2 * sp - 2])
        k = stack[2 * sp - 1]
        level = pool[node]
        if level < leaf_level and k < arity[level]:
            stack[2 * sp - 1] = k + 1
            path[level] = k
            child = int64(pool[node + 2 + k])
            number = int64(pool[child + 1])
            if number < 0 or number >= count or nodes[number] != child:
                stack[2 * sp] = child
                stack[2 * sp + 1] = 0
                sp += 1
            continue
        if level == leaf_level:
            for i in range(leaf_level):
                states[found, i] = path[i]
            found += 1
        else:
            path[level] = 0
        pool[node + 1] = count
        nodes[count] = node
        count += 1
        sp -= 1
    return found


@lean_kernel
def count_states(
    pool: Int32Array, arity: Int32Array, nodes: Int32Array, count: int,
    above: UInt64Array, above_inverse: UInt64Array, prime: np.uint64, inverse: np.uint64,
    totals: UInt64Array,
) -> None:  # fmt: skip
    """Number of states (mod p, Montgomery form) that pass through each node, from the root down.

    `above[i]` is the product of the numbers of values of levels 0..i-1 and `above_inverse` its
    inverse; a level that counts nothing has factor 1.
    """
    leaf_level = len(arity) - 1
    for i in range(count):
        totals[i] = 0
    totals[count - 1] = above[pool[nodes[count - 1]]]
    for j in range(count):
        i = count - 1 - j
        node = int64(nodes[i])
        level = pool[node]
        if level == leaf_level:
            continue
        share = field_multiply(totals[i], above_inverse[level + 1], prime, inverse)
        for k in range(arity[level]):
            child = int64(pool[node + 2 + k])
            passed = field_multiply(share, above[pool[child]], prime, inverse)
            number = pool[child + 1]
            totals[number] = field_add(totals[number], passed, prime)
