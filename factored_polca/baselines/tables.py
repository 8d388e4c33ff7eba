"""Tables of stored values, and what counts as one.

A learner's function of (pair p, state s) is stored under an index:

    index[p, s] = n        the value is entry n of the table, shared by all (p, s) with that index
    index[p, s] = NONE     the value is known to be 0 and not stored

so a state abstraction made by hand is an index, and a table without abstraction gives each live (p, s)
an entry of its own.  `size` counts the entries that are allocated; those that learning has updated are
counted beside them, for a learner may never come to some of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from factored_polca.baselines.process import IndexArray
from factored_polca.baselines.task_graph import NONE, by_state
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.solvers.compiled import kernel


class TableArrays(NamedTuple):
    """A table while it is learned; `values` and `visits` change."""

    entries: IndexArray  # [row, s]
    values: FloatArray  # [entry]
    visits: IntArray  # [entry], how often each was updated


@dataclass(frozen=True, eq=False)
class Table:
    """Where the values of one function are stored."""

    name: str
    index: IndexArray  # [row, s]
    size: int

    def empty(self) -> TableArrays:
        """The table before learning: all zeros."""
        # One entry more than there are: the arrays of a table without entries stay indexable.
        return TableArrays(self.index, np.zeros(self.size + 1), np.zeros(self.size + 1, dtype=np.int64))


class Numbering:
    """Hands out the entries of a table."""

    def __init__(self, states: int) -> None:
        self.states = states
        self.size = 0

    def entries(self, where: BoolArray, *features: IntArray | BoolArray) -> IndexArray:
        """[s], a new entry for each combination of the features' values that occurs in `where`."""
        index = np.full(self.states, NONE, dtype=np.int32)
        if not where.any():
            return index
        if not features:
            index[where] = self.size
            self.size += 1
            return index
        columns = np.stack([feature[where].astype(np.int64) for feature in features])
        kinds, number = np.unique(columns, axis=1, return_inverse=True)
        index[where] = self.size + number.reshape(-1)
        self.size += kinds.shape[1]
        return index

    def none(self) -> IndexArray:
        """[s], nothing stored."""
        return np.full(self.states, NONE, dtype=np.int32)

    def table(self, name: str, rows: Sequence[IndexArray]) -> Table:
        """The table of the entries handed out so far."""
        return Table(name, by_state(np.array(rows, dtype=np.int32)), self.size)


def full_table(name: str, rows: int, live: BoolArray) -> Table:
    """A table without abstraction: an entry for each row and live state."""
    numbering, states = Numbering(len(live)), np.arange(len(live))
    return numbering.table(name, [numbering.entries(live, states) for _ in range(rows)])


@kernel
def stored(table: TableArrays, row: int, state: int) -> float:
    """A value; 0 where it is not stored."""
    entry = table.entries[row, state]
    return table.values[entry] if entry >= 0 else 0.0


@kernel
def update(table: TableArrays, row: int, state: int, target: float, power: float) -> None:
    """Move a stored value towards `target` by the rate (1 + updates before)^-power."""
    entry = table.entries[row, state]
    if entry >= 0:
        rate = (1.0 + table.visits[entry]) ** -power
        table.values[entry] += rate * (target - table.values[entry])
        table.visits[entry] += 1
