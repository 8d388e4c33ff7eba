"""Splitting the blocks of a partition where a sparse function tells their states apart, as a kernel.

P is a partition, an index diagram x -> block; f a field diagram.  The distinct pairs (P(x), f(x)) are the
new blocks.  Where f is 0 nothing is visited: the cost is that of f's support, not of P.

    T      = the pair (P, f) where f != 0, 0 elsewhere;
    m(b)   = share of the states that lie in block b; parts are the leaves of T;
    block b, of which T touches parts t_1 .. t_k, keeps its number on what is untouched, and each t_j gets
             a number of its own; if nothing is untouched, m(b) = sum of m(t_j), its largest part keeps it;
    r      a random field element for each block: V = r o P;
    D'     = D' + the change of V, for the next pass.

The share of a node is the sum over its parents of their share over the number of their variable's values:
m(root) = 1.  It is kept in GF(p), where it is exact but for a multiple of p: were the number of states
that stay untouched divisible by the random prime, two blocks would be taken for one, which the next
confirming pass finds.  Which part is the largest is decided in floats, as nothing depends on it but time.

    numbers   [blocks, elements of `fresh` used, passes, blocks allowed, steps when last looked around]
    work      [stage, nodes of T, 1 if a block was split, nodes rebuilt, T numbered, T as a change]
    live      the nodes of P, of D (this pass), of D' (the next)
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.apply import apply_binary
from factored_polca.diagrams.field import field_add, field_multiply, field_subtract
from factored_polca.diagrams.jit import inner_kernel, int64, lean_kernel
from factored_polca.diagrams.nodes import DONE, FULL, Int32Array, Int64Array, find_or_add, payload
from factored_polca.diagrams.walk import collect

UInt64Array = npt.NDArray[np.uint64]

ROOM = 16
"""What `run_split` answers, beside what resumable kernels answer, where it needs more room for blocks or
more fresh elements."""

BLOCKS, USED, PASSES, ALLOWED, LOOKED = range(5)
"""Places in `numbers`."""

STAGE, NODES, SPLIT, REBUILT, NUMBERED, CHANGE = range(6)
"""Places in `work`."""

PARTITION, DIFFERENCE, NEXT = range(3)
"""Places in `live`."""

PAIR_ROW, OVERRIDE_ROW, ADD_ROW = range(3)
"""Rows of `operators`."""

_LOW = np.uint64(0xFFFFFFFF)
_S32 = np.uint64(32)
_ZERO = np.uint64(0)


@lean_kernel
def shares(
    pool: Int32Array, arity: Int32Array, nodes: Int32Array, count: int, inverses: UInt64Array,
    field: UInt64Array, one: np.uint64, exact: UInt64Array, rough: npt.NDArray[np.float64],
) -> None:  # fmt: skip
    """The share of the states that pass through each node, mod p and as a float; the last is the root.

    `inverses[level]` is 1 / arity[level] in the field; nodes have their numbers in the scratch words.
    """
    leaf_level = len(arity) - 1
    for i in range(count):
        exact[i] = _ZERO
        rough[i] = 0.0
    exact[count - 1] = one
    rough[count - 1] = 1.0
    for j in range(count):
        i = count - 1 - j
        node = int64(nodes[i])
        level = pool[node]
        if level == leaf_level:
            continue
        share = field_multiply(exact[i], inverses[level], field[0], field[1])
        part = rough[i] / arity[level]
        for k in range(arity[level]):
            number = pool[pool[node + 2 + k] + 1]
            exact[number] = field_add(exact[number], share, field[0])
            rough[number] += part


@inner_kernel
def number_parts(
    pool: Int32Array, nodes: Int32Array, count: int, leaf_level: int, field: UInt64Array,
    exact: UInt64Array, rough: npt.NDArray[np.float64], numbers: Int64Array, elements: UInt64Array,
    block_shares: UInt64Array, touched: UInt64Array, largest: Int32Array, fresh: UInt64Array,
    new_blocks: Int32Array, changes: UInt64Array,
) -> int:  # fmt: skip
    """Number the parts, the leaves of T: 1 if a block was split, 0 if none, -1 if there is no room.

    `new_blocks[i]` is the block of leaf node i plus 1, `changes[i]` how its element changes.  `touched` and
    `largest` are zero outside of here [block].
    """
    parts = 0
    for i in range(count):
        if pool[nodes[i]] == leaf_level:
            parts += 1
    if numbers[BLOCKS] + parts > len(elements) or numbers[USED] + parts > len(fresh):
        return -1
    for i in range(count):
        leaf = int64(nodes[i])
        if pool[leaf] != leaf_level:
            continue
        key = payload(pool, leaf)
        if key == _ZERO:
            continue
        block = int64(payload(pool, int64(key >> _S32)))
        touched[block] = field_add(touched[block], exact[i], field[0])
        if largest[block] == 0 or rough[i] > rough[largest[block] - 1]:
            largest[block] = i + 1
    split = 0
    for i in range(count):
        leaf = int64(nodes[i])
        if pool[leaf] != leaf_level:
            continue
        new_blocks[i] = 0
        changes[i] = _ZERO
        key = payload(pool, leaf)
        if key == _ZERO:
            continue
        block = int64(payload(pool, int64(key >> _S32)))
        if touched[block] == block_shares[block] and largest[block] == i + 1:
            new_blocks[i] = block + 1
            continue
        new = numbers[BLOCKS]
        numbers[BLOCKS] += 1
        elements[new] = fresh[numbers[USED]]
        numbers[USED] += 1
        block_shares[new] = exact[i]
        new_blocks[i] = new + 1
        changes[i] = field_subtract(elements[new], elements[block], field[0])
        split = 1
    for i in range(count):
        leaf = int64(nodes[i])
        if pool[leaf] != leaf_level:
            continue
        key = payload(pool, leaf)
        if key == _ZERO:
            continue
        block = int64(payload(pool, int64(key >> _S32)))
        if new_blocks[i] != block + 1:
            block_shares[block] = field_subtract(block_shares[block], exact[i], field[0])
        touched[block] = _ZERO
        largest[block] = 0
    return split


@inner_kernel
def rebuild_with(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array, nodes: Int32Array,
    count: int, new_blocks: Int32Array, changes: UInt64Array, which: int, images: Int32Array,
    words: Int32Array, work: Int64Array,
) -> int:  # fmt: skip
    """T with other leaves: `new_blocks` (which 0) or `changes` (1), from node `work[REBUILT]` on."""
    leaf_level = len(arity) - 1
    while work[REBUILT] < count:
        i = work[REBUILT]
        node = int64(nodes[i])
        level = pool[node]
        if level == leaf_level:
            value = np.uint64(new_blocks[i]) if which == 0 else changes[i]
            words[0] = np.int32(value & _LOW)
            words[1] = np.int32(value >> _S32)
        else:
            for k in range(arity[level]):
                words[k] = images[pool[pool[node + 2 + k] + 1]]
        made = find_or_add(pool, head, unique, arity, int64(level), words, 0)
        if made < 0:
            return FULL
        images[i] = made
        work[REBUILT] += 1
    work[REBUILT] = 0
    return DONE


@inner_kernel
def run_split(
    pool: Int32Array, head: Int64Array, unique: Int64Array, arity: Int32Array, cache: Int32Array,
    stack: Int32Array, results: Int32Array, words: Int32Array, by: int, operators: npt.NDArray[np.int64],
    field: UInt64Array, one: np.uint64, inverses: UInt64Array, live: Int32Array, numbers: Int64Array,
    elements: UInt64Array, block_shares: UInt64Array, touched: UInt64Array, largest: Int32Array,
    fresh: UInt64Array, nodes: Int32Array, images: Int32Array, new_blocks: Int32Array,
    exact: UInt64Array, changes: UInt64Array, rough: npt.NDArray[np.float64],
    state: Int64Array, work: Int64Array,
) -> int:  # fmt: skip
    """Split the blocks by the field diagram `by`; `work[STAGE]` is 0 at the start, and at the end.

    `work[SPLIT]` becomes 1 where a block is split, and is else left as it is.  `nodes` .. `rough` have
    room for every node of the store.
    """
    leaf_level = len(arity) - 1
    if work[STAGE] == 0:
        if pool[by] == leaf_level:
            return DONE
        stack[0] = live[PARTITION]
        stack[1] = by
        stack[2] = -1
        stack[3] = 0
        state[0] = 1
        state[1] = 0
        work[STAGE] = 1
    if work[STAGE] == 1:
        code = apply_binary(
            pool, head, unique, arity, cache, operators[PAIR_ROW], field, stack, results, state
        )
        if code != DONE:
            return code
        work[NUMBERED] = results[0]
        work[STAGE] = 2
    if work[STAGE] == 2:
        if len(nodes) <= head[1]:
            return ROOM
        count = collect(pool, arity, int64(work[NUMBERED]), nodes, stack)
        shares(pool, arity, nodes, count, inverses, field, one, exact, rough)
        split = number_parts(
            pool, nodes, count, leaf_level, field, exact, rough, numbers, elements, block_shares,
            touched, largest, fresh, new_blocks, changes,
        )  # fmt: skip
        if split < 0:
            return ROOM
        if split == 0:
            work[STAGE] = 0
            return DONE
        work[NODES] = count
        work[REBUILT] = 0
        work[STAGE] = 3
    if work[STAGE] == 3:
        code = rebuild_with(
            pool, head, unique, arity, nodes, int64(work[NODES]), new_blocks, changes, int64(0), images,
            words, work,
        )  # fmt: skip
        if code != DONE:
            return code
        work[NUMBERED] = images[work[NODES] - 1]
        work[STAGE] = 4
    if work[STAGE] == 4:
        code = rebuild_with(
            pool, head, unique, arity, nodes, int64(work[NODES]), new_blocks, changes, int64(1), images,
            words, work,
        )  # fmt: skip
        if code != DONE:
            return code
        work[CHANGE] = images[work[NODES] - 1]
        stack[0] = work[NUMBERED]
        stack[1] = live[PARTITION]
        stack[2] = -1
        stack[3] = 0
        state[0] = 1
        state[1] = 0
        work[STAGE] = 5
    if work[STAGE] == 5:
        code = apply_binary(
            pool, head, unique, arity, cache, operators[OVERRIDE_ROW], field, stack, results, state
        )
        if code != DONE:
            return code
        live[PARTITION] = results[0]
        work[SPLIT] = 1
        stack[0] = live[NEXT]
        stack[1] = work[CHANGE]
        stack[2] = -1
        stack[3] = 0
        state[0] = 1
        state[1] = 0
        work[STAGE] = 6
    code = apply_binary(pool, head, unique, arity, cache, operators[ADD_ROW], field, stack, results, state)
    if code != DONE:
        return code
    live[NEXT] = results[0]
    work[STAGE] = 0
    return DONE
