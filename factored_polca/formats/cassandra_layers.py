"""Tables written as layers: entries with wildcards, of which the last that matches counts.

A table is a function of indices (i_1, ..., i_k, j).  A layer fixes some of i_1..i_k, the others are
`ANY`, and sets either one cell, j = `column`, or the whole row, all j.  `slices` splits the layers of
a table by i_d, `folded` makes the row of what is left when i_1..i_k are decided.  Nothing is expanded
over the values of an index that no layer names: they share one slice.

A layer *covers* a slice if it sets every cell of it; what stands before such a layer is dropped.
The work is counted in `Steps`, a step being one layer or cell looked at once.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count
from typing import Final, NamedTuple

from factored_polca.models.expressions import ZERO, Constant

MAXIMUM_STEPS: Final = 20_000_000
"""Layers and cells looked at for one file."""
ANY: Final = -1
"""The index that a wildcard gives."""


class StepLimit(Exception):
    """The work needs more steps than allowed."""


@dataclass
class Steps:
    """The count of the work done so far, and how far it may go."""

    used: int = 0
    deadline: int = field(default_factory=lambda: MAXIMUM_STEPS)

    def count(self, steps: int) -> None:
        """Count `steps`.

        Raises:
            StepLimit: there are too many.
        """
        self.used += steps
        if self.used > self.deadline:
            raise StepLimit

    @contextmanager
    def at_most(self, steps: int) -> Iterator[None]:
        """Within it, only `steps` more are allowed."""
        self.deadline = min(MAXIMUM_STEPS, self.used + steps)
        try:
            yield
        finally:
            self.deadline = MAXIMUM_STEPS


@dataclass(frozen=True, slots=True)
class Row:
    """A function of the last index: `cells` where they say, `default` elsewhere.

    In a row of an identity matrix, the same for all rows, `diagonal` stands where the last index
    equals the one before it.
    """

    default: Constant
    cells: Mapping[int, Constant]
    diagonal: Constant | None = None


class Layer(NamedTuple):
    """One entry: the indices i_1..i_k it is for, the column, and the number, or the whole row.

    `start` is where the entry begins in the file.
    """

    indices: tuple[int, ...]
    column: int
    content: Constant | Row
    start: int

    def covers(self, depth: int) -> bool:
        """Whether it sets every cell of what is left when the first `depth` indices are decided."""
        return isinstance(self.content, Row) and all(i == ANY for i in self.indices[depth:])


@dataclass(frozen=True)
class Slices:
    """Layers by one index: where those of each value that a layer names stand, and those of all others."""

    layers: Sequence[Layer]
    depth: int
    positions: Mapping[int, Sequence[int]]  # by value, wildcards left out
    wild: Sequence[int]
    steps: Steps

    def named(self) -> Iterator[tuple[int, list[Layer]]]:
        """Each value that a layer names, with its slice, in the order of the values.

        Raises:
            StepLimit: too much work.
        """
        for value, own in sorted(self.positions.items()):
            wild = self.wild
            if self.layers[own[0]].covers(self.depth + 1):
                wild = wild[bisect_left(wild, own[0]) :]
            self.steps.count(len(own) + len(wild))
            yield value, [self.layers[position] for position in sorted([*own, *wild])]

    def others(self) -> list[Layer]:
        """The slice of all values that no layer names."""
        self.steps.count(len(self.wild))
        return [self.layers[position] for position in self.wild]

    def first_other(self) -> int:
        """The least value that no layer names."""
        return next(value for value in count() if value not in self.positions)


def slices(layers: Sequence[Layer], depth: int, steps: Steps) -> Slices:
    """`layers` by their index number `depth` (from 0), each slice cut before its last covering layer.

    Raises:
        StepLimit: too much work.
    """
    positions: dict[int, list[int]] = {}
    wild: list[int] = []
    steps.count(len(layers))
    for position, layer in enumerate(layers):
        value = layer.indices[depth]
        covering = layer.covers(depth + 1)
        if value != ANY:
            if covering or value not in positions:
                positions[value] = [position]
            else:
                positions[value].append(position)
        elif covering:  # earlier layers count for no value any more
            wild = [position]
            positions.clear()
        else:
            wild.append(position)
    return Slices(layers, depth, positions, wild, steps)


def diagonal(layers: Sequence[Layer]) -> Constant | None:
    """What the identity matrix that `layers` begin with has in its diagonal, None if there is none."""
    first = layers[0].content if layers else None
    return first.diagonal if isinstance(first, Row) else None


def with_rows(layers: Sequence[Layer], size: int, steps: Steps) -> Sequence[Layer]:
    """`layers`, with a layer for each of the `size` rows of the identity matrix that they begin with.

    Raises:
        StepLimit: too much work.
    """
    one = diagonal(layers)
    if one is None:
        return layers
    steps.count(size)
    first = layers[0]
    rows = [
        Layer((*first.indices[:-1], number), ANY, Row(ZERO, {number: one}), first.start)
        for number in range(size)
    ]
    return [*rows, *layers[1:]]


def folded(layers: Sequence[Layer], steps: Steps) -> Row:
    """The row that `layers`, all of whose indices but the last are decided, make; 0 where none is.

    Raises:
        StepLimit: too much work.
    """
    first = layers[0].content if layers else ZERO
    row = first if isinstance(first, Row) else Row(ZERO, {})
    rest = layers[1:] if isinstance(first, Row) else layers
    steps.count(len(rest) + len(row.cells) + 1)
    if not rest:
        return row
    cells = dict(row.cells)
    for layer in rest:
        if isinstance(layer.content, Row):  # a covering layer is the first of its slice
            raise AssertionError("slices cut before the last covering layer")
        cells[layer.column] = layer.content
    return Row(row.default, cells)
