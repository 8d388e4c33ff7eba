"""What can come of drawing many variables in turn, listed on arrays of value numbers.

A *draw* fills one column of a table of states with a value that is distributed as a row diagram says,
given what stands in the other columns: a next feature after its synchronic parents, an observation
after the next state.  `outcomes` starts from the rows of a table and follows every value of positive
probability, so that the row s becomes

    all (x', o) with  chance = prod_i P(x_i' | parents) * prod_j P(o_j | x', x) > 0.

Rows of one probability 1 lengthen nothing.  The table is halved where it would outgrow `CELLS`, and
the halves are finished one after the other: the memory stays bounded whatever the number of outcomes.

A `Numbering` gives tuples of value numbers the numbers 0, 1, ... as they come.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import networkx as nx
import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import evaluate_states
from factored_polca.symbolic import RowDiagram

Int32Array = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]

CELLS: Final = 1 << 21
"""Size of the tables that are worked on at once: rows times columns."""

WORD: Final = 1 << 62
"""Tuples are packed into integers below this."""


@dataclass(frozen=True)
class Draw:
    """A variable to be drawn: its row diagram, its column, and the positive entries of each row."""

    row: RowDiagram
    column: int
    start: Int64Array  # [row number], one more at the end
    value: Int32Array  # flat, as are
    chance: FloatArray  # the probabilities


def make_draw(row: RowDiagram, column: int) -> Draw:
    """The draw of the variable of `row` into `column`."""
    entries = [[(v, float(q)) for v, q in enumerate(chances) if q] for chances in row.rows]
    return Draw(
        row,
        column,
        np.cumsum([0, *map(len, entries)]).astype(np.int64),
        np.array([v for found in entries for v, _ in found], dtype=np.int32),
        np.array([q for found in entries for _, q in found], dtype=np.float64),
    )


class FlatDraws:
    """Lists of draws, one list after the other, as `factored_polca.minimisation.draws_kernel` takes them.

    `first` [list] is the number of a list's first draw; the entries of all rows of all draws are `value`
    and `chance` [entry].
    """

    def __init__(self, lists: Sequence[Sequence[Draw]]) -> None:
        draws = [draw for listed in lists for draw in listed]
        self.first = np.cumsum([0, *map(len, lists)]).astype(np.int64)
        self.roots = np.array([draw.row.diagram.node for draw in draws], dtype=np.int32)
        self.targets = np.array([draw.column for draw in draws], dtype=np.int32)
        self.bases = np.cumsum([0, *(len(draw.start) for draw in draws)])[:-1].astype(np.int64)
        before = np.cumsum([0, *(len(draw.value) for draw in draws)])[:-1].tolist()
        starts = [draw.start + shift for draw, shift in zip(draws, before, strict=True)]
        self.start = np.concatenate([np.empty(0, dtype=np.int64), *starts])
        self.value = np.concatenate([np.empty(0, dtype=np.int32), *(draw.value for draw in draws)])
        self.chance = np.concatenate([np.empty(0), *(draw.chance for draw in draws)])


def parents_first(rows: Mapping[int, RowDiagram]) -> list[int]:
    """The features of `rows`, each after those whose next values it reads."""
    graph = nx.DiGraph()
    graph.add_nodes_from(rows)
    graph.add_edges_from((p, i) for i, row in rows.items() for p in row.parents_next if p in rows)
    return list(nx.lexicographical_topological_sort(graph))


def outcomes(
    draws: Sequence[Draw], columns: Sequence[int], table: Int32Array
) -> Iterator[tuple[Int64Array, Int32Array, FloatArray]]:
    """All outcomes of drawing `draws` in turn, in pieces: (row of the table [k], row now [k, column],
    probability [k]).

    Args:
        columns: for each level of the diagrams its column.
        table: value numbers [row, column]; it is not changed.
    """
    room = max(1, CELLS // table.shape[1])
    waiting = [(0, np.arange(len(table)), table.copy(), np.ones(len(table)))]
    while waiting:
        place, source, rows, chance = waiting.pop()
        while place < len(draws):
            draw = draws[place]
            chosen = evaluate_states(draw.row.diagram, rows, columns).astype(np.int64)
            first = draw.start[chosen]
            count = draw.start[chosen + 1] - first
            total = int(count.sum())
            if total > room and len(rows) > 1:
                half = len(rows) // 2
                waiting.append((place, source[half:], rows[half:], chance[half:]))
                source, rows, chance = source[:half], rows[:half], chance[:half]
                continue
            if total == len(rows):
                rows[:, draw.column] = draw.value[first]
            else:
                owner = np.repeat(np.arange(len(rows)), count)
                entry = np.arange(total) + (first - np.cumsum(count) + count)[owner]
                source, rows, chance = source[owner], rows[owner], chance[owner] * draw.chance[entry]
                rows[:, draw.column] = draw.value[entry]
            place += 1
        yield source, rows, chance


class Numbering:
    """Numbers for tuples of value numbers, given as they come; the order of tuples is lexicographic.

    `sizes` are the numbers of values.  Tuples are packed into as few integers as hold them.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        self.sizes = tuple(sizes)
        self.words: list[list[int]] = [[]]  # [word] the columns that it packs
        room = WORD
        for column, size in enumerate(sizes):
            if size > room:
                self.words.append([])
                room = WORD
            self.words[-1].append(column)
            room //= size
        self._known: dict[Any, int] = {}
        self._keys: list[Any] = []

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def count(self) -> int:
        """The number of tuples that there are."""
        return math.prod(self.sizes)

    def encode(self, digits: npt.NDArray[Any]) -> Int64Array:
        """Tuples [k, column] as packed integers [k, word]."""
        result = np.zeros((len(digits), len(self.words)), dtype=np.int64)
        for word, members in enumerate(self.words):
            for column in members:
                result[:, word] *= self.sizes[column]
                result[:, word] += digits[:, column]
        return result

    def decode(self, codes: Int64Array) -> Int32Array:
        """The tuples [k, column] of packed integers [k, word]."""
        result = np.empty((len(codes), len(self.sizes)), dtype=np.int32)
        for word, members in enumerate(self.words):
            rest = codes[:, word].copy()
            for column in reversed(members):
                rest, result[:, column] = np.divmod(rest, self.sizes[column])
        return result

    def number(self, digits: npt.NDArray[Any]) -> Int64Array:
        """The number of each tuple [k, column], a new one where it is met for the first time."""
        codes = self.encode(digits)
        keys: list[Any]
        if len(self.words) == 1:
            distinct, inverse = np.unique(codes[:, 0], return_inverse=True)
            keys = distinct.tolist()
        else:
            distinct, inverse = np.unique(codes, axis=0, return_inverse=True)
            keys = [tuple(code) for code in distinct.tolist()]
        for key in keys:
            if key not in self._known:
                self._known[key] = len(self._keys)
                self._keys.append(key)
        numbers = np.array([self._known[key] for key in keys], dtype=np.int64)
        return numbers[inverse.reshape(-1)]

    def tuples(self, start: int = 0) -> Int32Array:
        """The tuples numbered from `start` on [k, column]."""
        return self.decode(self._codes(start))

    def ranks(self) -> Int64Array:
        """[number] the place of each tuple in lexicographic order."""
        codes = self._codes(0)
        result = np.empty(len(codes), dtype=np.int64)
        result[np.lexsort(codes.T[::-1])] = np.arange(len(codes))
        return result

    def _codes(self, start: int) -> Int64Array:
        return np.array(self._keys[start:], dtype=np.int64).reshape(-1, len(self.words))
