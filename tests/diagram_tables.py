"""Diagrams made from tables of values and read back as tables: the brute force of the kernel's tests.

A table is a numpy array of objects with one axis for each level.  Diagrams are made by branching
alone and read by following one path for each state, so no operation under test is involved.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import FLOAT, INDEX, Diagram, LeafType, Manager, at

Table = npt.NDArray[Any]

SIZES: tuple[tuple[int, ...], ...] = (
    (), (1,), (5,), (2, 3), (1, 2, 5), (4, 1, 3, 2), (3, 1, 1, 2, 2), (2, 2, 2, 2, 2, 2),
)  # fmt: skip


def states(sizes: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """All states in lexicographic order."""
    return itertools.product(*(range(size) for size in sizes))


def from_table(manager: Manager, table: Table, leaf_type: LeafType = INDEX) -> Diagram:
    """The diagram of a table."""

    def build(state: tuple[int, ...]) -> Diagram:
        level = len(state)
        if level == manager.leaf_level:
            return manager.constant(table[state], leaf_type)
        return manager.variable(level, [build((*state, v)) for v in range(manager.sizes[level])])

    return build(())


def to_table(diagram: Diagram) -> Table:
    """The table of a diagram."""
    return tabulate(diagram.manager.sizes, lambda state: at(diagram, dict(enumerate(state))))


def tabulate(sizes: Sequence[int], function: Callable[[tuple[int, ...]], Any]) -> Table:
    """The table of a function of states."""
    table = np.empty(tuple(sizes), dtype=object)
    for state in states(sizes):
        table[state] = function(state)
    return table


def random_table(random: np.random.Generator, sizes: Sequence[int], values: Sequence[Any]) -> Table:
    """A random function of about two thirds of the variables."""
    shape = [size if random.random() < 0.67 else 1 for size in sizes]
    chosen = random.integers(0, len(values), size=shape)
    table = np.empty(tuple(sizes), dtype=object)
    for state, number in np.ndenumerate(np.broadcast_to(chosen, tuple(sizes))):
        table[state] = values[number]
    return table


def floats(random: np.random.Generator, count: int) -> list[float]:
    """Some floats, the awkward ones among them."""
    return [0.0, 1.0, float("inf"), float("-inf"), *random.normal(size=count).tolist()]


def assert_table(diagram: Diagram, expected: Table) -> None:
    """Compare a diagram with a table, state by state, and check the store."""
    found = to_table(diagram)
    same = all(found[s] == expected[s] for s in states(diagram.manager.sizes))
    assert same, (diagram, found.tolist(), expected.tolist())
    diagram.manager.assert_consistent()


__all__ = [
    "FLOAT", "INDEX", "SIZES", "Table", "assert_table", "floats", "from_table", "random_table", "states",
    "tabulate", "to_table",
]  # fmt: skip
