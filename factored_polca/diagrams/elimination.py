"""Variables taken out of a diagram: summed, maximised, or the value that attains the maximum."""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

from factored_polca.diagrams.diagram import Diagram
from factored_polca.diagrams.leaves import FLOAT, INDEX
from factored_polca.diagrams.manager import require
from factored_polca.diagrams.operations import apply, choose, cofactors


def sum_out(diagram: Diagram, level: int) -> Diagram:
    """The sum over the values of the variable at `level`; for conditions their disjunction."""
    name = "or" if diagram.leaf_type == INDEX else "plus"
    return reduce(lambda a, b: apply(name, a, b), cofactors(diagram, level))


def max_out(diagram: Diagram, level: int) -> Diagram:
    """The maximum over the values of the variable at `level` (float leaves)."""
    return reduce(lambda a, b: apply("maximum", a, b), cofactors(diagram, level))


def argmax_out(diagram: Diagram, level: int) -> Diagram:
    """The first value of the variable at `level` that attains the maximum (float leaves)."""
    return argmax(cofactors(diagram, level))


def argmax(candidates: Sequence[Diagram]) -> Diagram:
    """The index of the first of several float diagrams that is largest, pointwise."""
    manager = require(candidates, FLOAT)
    best, index = candidates[0], manager.constant(0)
    for number, candidate in enumerate(candidates[1:], start=1):
        better = apply("less", best, candidate)
        index = choose(better, manager.constant(number), index)
        best = choose(better, candidate, best)
    return index
