"""Row diagrams and terms: an index diagram together with the exact things its leaves number."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import networkx as nx
import numpy as np

from factored_polca.diagrams import INDEX, Diagram, choose, cofactors, combine, leaves, relabel

Row = tuple[Fraction, ...]
"""The probability of each value of a feature."""


@dataclass(frozen=True)
class RowDiagram:
    """P(x_i' | parents): `diagram` maps parents to the number of a row, `rows[number]` is the row.

    `feature` is the number of the feature, or of the channel where the row is of an observation;
    `parents_next` are the features whose next values are read.
    """

    feature: int
    diagram: Diagram
    rows: tuple[Row, ...]
    parents_next: tuple[int, ...] = ()


@dataclass(frozen=True)
class Term:
    """A function of x (and x') with exact values: `diagram` maps it to the number of one of `values`."""

    diagram: Diagram
    values: tuple[Fraction, ...]


def elimination_order(positions: Sequence[int], rows: Mapping[int, RowDiagram]) -> tuple[int, ...]:
    """All features, those nobody's next value depends on first; `positions` [feature] break ties.

    Raises:
        networkx.NetworkXUnfeasible: next values depend on each other in a circle.
    """
    graph = nx.DiGraph()
    graph.add_nodes_from(range(len(positions)))
    for row in rows.values():
        graph.add_edges_from((row.feature, parent) for parent in row.parents_next)
    return tuple(nx.lexicographical_topological_sort(graph, key=lambda i: -positions[i]))


def as_number(value: object) -> Fraction:
    """The rational behind an entry of a value table: a condition counts 0 or 1, others as they are."""
    if isinstance(value, bool):
        return Fraction(int(value))
    return value if isinstance(value, Fraction) else Fraction(0)


def numbered(diagram: Diagram, value: Callable[[int], Any]) -> Term:
    """A term from an index diagram and the exact value of each of its leaves."""
    found: dict[Fraction, int] = {}
    entries = [int(leaf) for leaf in leaves(diagram)]
    images = np.zeros(max(entries) + 1, dtype=np.uint64)
    for entry in entries:
        images[entry] = found.setdefault(value(entry), len(found))
    return Term(relabel(diagram, images, INDEX), tuple(found))


def possible(row: RowDiagram, level: int) -> Diagram:
    """The condition P(x_i' | parents) > 0 over x_i', which stands at `level`, and the parents."""
    manager = row.diagram.manager
    result = manager.constant(0)
    for value in range(len(row.rows[0])):
        # never negative; a function of parameters that stay symbols counts as possible
        positive = np.array([bool(r[value]) for r in row.rows], dtype=np.uint64)
        here = relabel(row.diagram, positive, INDEX)
        result = choose(manager.indicator(level, [value]), here, result)
    return result


def mean(term: Term, level: int, row: RowDiagram) -> Term:
    """The expectation of a term over the variable at `level`, which is distributed as `row` says."""

    def weigh(number: int, *entries: int) -> Fraction:
        pairs = zip(row.rows[number], entries, strict=True)
        return sum((q * term.values[e] for q, e in pairs if q), Fraction(0))

    diagram, values = combine([row.diagram, *cofactors(term.diagram, level)], weigh)
    return Term(diagram, tuple(values))
