"""The expectation of a float diagram over states under the initial belief."""

from __future__ import annotations

import math

from factored_polca.diagrams import Diagram, MemoryLimit, cofactors, relabel, support, weighted_sum
from factored_polca.minimisation.outcomes import parents_first
from factored_polca.structured.bellman import UNIT
from factored_polca.symbolic import NumericView


def expected_at_start(numbers: NumericView, value: Diagram, largest: float) -> tuple[float, float]:
    """sum_x b0(x) V(x), and a bound on its rounding error where |V| <= `largest` or V is infinite.

    b0 is a product of rows over the first time slice, which has the next variables; they are summed out
    children first.  What has probability 0 does not count, infinite or not.  NaN where memory is short.
    """
    symbolic = numbers.symbolic
    rows = symbolic.initial
    try:
        current = numbers.shift(value)
        for feature in reversed(parents_first(rows)):
            level = symbolic.next(feature)
            if level not in support(current):
                continue
            row = rows[feature]
            weights = [
                relabel(row.diagram, numbers.stored([r[v] for r in row.rows]), numbers.leaf_type)
                for v in range(len(row.rows[0]))
            ]
            current = weighted_sum(weights, cofactors(current, level), normalised=True)
    except MemoryLimit:
        return math.nan, math.inf
    sizes = sum(len(feature.values) + 1 for feature in symbolic.model.features)
    return float(current.value), 2 * (sizes + 2) * UNIT * largest
