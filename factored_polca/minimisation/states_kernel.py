"""States and what can come of actions in them, listed one after the other, as kernels.

The row of value numbers is [features now, features next, channels].  States are numbered in one of two
ways: all of the product, by their place in lexicographic order, or as they are found, by `table` [number,
feature] and a hash table `slots` of numbers plus 1, none there being 0.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.jit import inline, int64, late_lean_kernel
from factored_polca.diagrams.nodes import DONE, Int32Array, Int64Array, mix, payload
from factored_polca.minimisation.draws_kernel import leaf_at, next_outcome

Int32Table = npt.NDArray[np.int32]
FloatArray = npt.NDArray[np.float64]

TABLE, OUTPUT, PARTIAL = 3, 4, 5
"""What the kernels answer beside DONE: no room for more states; none for more entries; the action
`state[ACTION]` does not apply in the state `state[STATE]` though it should."""

STATE, STATES, ENTRIES, ACTION = range(4)
"""Places in `state`: the state to go on with, the states there are, the entries written, an action."""

_S32 = np.uint64(32)
_ZERO = np.uint64(0)


@inline
def slot_of(row: Int32Array, offset: int, count: int, table: Int32Table, slots: Int32Array) -> int:
    """The slot of the state row[offset : offset + count], or the free one where it belongs."""
    h = np.uint64(0x9E3779B97F4A7C15)
    for k in range(count):
        h = mix(h, row[offset + k])
    mask = len(slots) - 1
    i = int64(h >> _S32) & mask
    while slots[i] != 0:
        number = slots[i] - 1
        same = True
        for k in range(count):
            if table[number, k] != row[offset + k]:
                same = False
                break
        if same:
            break
        i = (i + 1) & mask
    return i


@late_lean_kernel
def number_state(
    row: Int32Array, offset: int, count: int, table: Int32Table, slots: Int32Array, state: Int64Array
) -> int:  # fmt: skip
    """The number of a state, a new one where it is met for the first time; -1 if there is no room."""
    i = slot_of(row, offset, count, table, slots)
    if slots[i] == 0:
        new = state[STATES]
        if new >= len(table) or 2 * (new + 1) > len(slots):
            return int64(-1)
        for k in range(count):
            table[new, k] = row[offset + k]
        slots[i] = new + 1
        state[STATES] += 1
    return int64(slots[i]) - 1


@late_lean_kernel
def place_states(table: Int32Table, states: int, slots: Int32Array) -> None:
    """Fill the empty table `slots` with so many states."""
    for number in range(states):
        slots[slot_of(table[number], 0, table.shape[1], table, slots)] = number + 1


@late_lean_kernel
def list_outcomes(
    pool: Int32Array, leaf_level: int, columns: Int32Array, terminal: int, apps: Int32Array, total: int,
    first_draw: Int64Array, roots: Int32Array, targets: Int32Array, bases: Int64Array, start: Int64Array,
    value: Int32Array, chance: FloatArray, sizes: Int64Array, strides: Int64Array, nulls: Int32Array,
    table: Int32Table, slots: Int32Array, row: Int32Array, entry: Int64Array, ends: Int64Array,
    products: FloatArray, action: Int32Array, source: Int32Array, target: Int32Array,
    probability: FloatArray, seen: Int32Table, state: Int64Array,
) -> int:  # fmt: skip
    """Write what can come of each action in each state from `state[STATE]` on, until there are no more.

    Without `slots` all states of the product are listed.  A state that there is no room for is begun anew.
    """
    count = len(sizes)
    channels = len(nulls)
    found = len(slots) > 0
    while state[STATE] < state[STATES]:
        x = state[STATE]
        at = state[ENTRIES]
        for k in range(count):
            row[k] = table[x, k] if found else np.int32((x // strides[k]) % sizes[k])
        if payload(pool, leaf_at(pool, leaf_level, columns, terminal, row)) != _ZERO:
            state[STATE] += 1
            continue
        for a in range(len(apps)):
            if payload(pool, leaf_at(pool, leaf_level, columns, apps[a], row)) == _ZERO:
                if total != 0:
                    state[ACTION] = a
                    return PARTIAL
                continue
            for k in range(count):
                row[count + k] = row[k]
            for k in range(channels):
                row[2 * count + k] = nulls[k]
            low = first_draw[a]
            high = first_draw[a + 1]
            products[low] = 1.0
            d = next_outcome(
                pool, leaf_level, columns, roots, targets, bases, start, value, low, high, int64(1), row,
                entry, ends,
            )  # fmt: skip
            while d >= 0:
                for i in range(d, high):
                    products[i + 1] = products[i] * chance[entry[i]]
                if at == len(target):
                    return OUTPUT
                if found:
                    y = number_state(row, count, count, table, slots, state)
                    if y < 0:
                        return TABLE
                else:
                    y = int64(0)
                    for k in range(count):
                        y += strides[k] * row[count + k]
                action[at] = a
                source[at] = x
                target[at] = y
                probability[at] = products[high]
                for k in range(channels):
                    seen[at, k] = row[2 * count + k]
                at += 1
                d = next_outcome(
                    pool, leaf_level, columns, roots, targets, bases, start, value, low, high, int64(0),
                    row, entry, ends,
                )  # fmt: skip
        state[ENTRIES] = at
        state[STATE] += 1
    return DONE
