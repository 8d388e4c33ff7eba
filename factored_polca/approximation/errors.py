"""How far a snapped process is from the process itself, block by block.

For choice c, which stands for primitive p at x, and for all states x of a block,

    r_c(x) = |R_p(x) - R_p^(x)|,
    d_c(x) = sum_i  max over x'  d(P_p(x_i' | x, x'), P_p^(x_i' | x, x'))  (+ the same for each channel),

d the total variation of two rows.  The total variation of products of rows is at most the sum over their
factors (replace one factor after the other), so d_c bounds that of T_c(x, .) and, with the channels, of the
joint row T_c(x, .) O_c(. | ., x), and of what they send to any blocks.  All of it is found on diagrams.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from factored_polca.approximation.representatives import distance, sure
from factored_polca.diagrams import FLOAT, Diagram, apply, choose, combine, max_out, pairs, relabel, support
from factored_polca.diagrams.operations import leaf_payloads
from factored_polca.explicit.arrays import FloatArray
from factored_polca.minimisation import DecisionProcess, Partition
from factored_polca.symbolic import NumericView, RowDiagram

MARGIN: Final = 1e-12
"""Relative, for sums of rounded numbers."""


@dataclass(frozen=True)
class Errors:
    """The largest r_c(x) and d_c(x) in each block, and the range of the process's own rewards."""

    rewards: FloatArray  # [choice, block]
    rows: FloatArray  # [choice, block]
    least: float
    largest: float

    @property
    def reward_span(self) -> float:
        """The largest difference of rewards, that of having ended being 0."""
        return max(self.largest, 0.0) - min(self.least, 0.0)


def process_errors(process: DecisionProcess, snapped: DecisionProcess, partition: Partition) -> Errors:
    """The errors of `snapped`, made from `process`, in the blocks of a partition."""
    work = _Errors(process, snapped)
    rewards, rows = [], []
    least, largest = np.inf, -np.inf
    for choice in process.choices:
        app = choice.app if process.reachable is None else choice.app & process.reachable
        zero = work.numbers.zero
        gains = lost = own = zero
        for p in choice.primitives:
            where = choice.where(p) & app
            gains = choose(where, work.reward_error(p), gains)
            lost = choose(where, work.row_error(p), lost)
            own = choose(where, work.numbers.total(process.rewards[p]), own)
        rewards.append(block_maximum(partition, gains))
        rows.append(np.minimum(block_maximum(partition, lost), 1.0))
        largest = max(largest, float(block_maximum(partition, own).max(initial=-np.inf)))
        least = min(least, -float(block_maximum(partition, zero - own).max(initial=-np.inf)))
    return Errors(np.stack(rewards), np.stack(rows), least, largest)


def block_maximum(partition: Partition, diagram: Diagram) -> FloatArray:
    """The largest value of a float diagram over present features in each block [block]."""
    manager = partition.symbolic.manager
    _, first, second = pairs(partition.diagram, diagram)
    block = leaf_payloads(manager, first).astype(np.int64)
    value = leaf_payloads(manager, second).view(np.float64)
    result = np.full(partition.blocks, -np.inf)
    inside = block < partition.blocks
    np.maximum.at(result, block[inside], value[inside])
    return result


class _Errors:
    def __init__(self, process: DecisionProcess, snapped: DecisionProcess) -> None:
        self.process, self.snapped = process, snapped
        self.numbers = NumericView(process.symbolic)
        self.symbolic = process.symbolic
        self._rows: dict[int, Diagram] = {}
        self._distances: dict[tuple[int, ...], tuple[object, Diagram]] = {}

    def reward_error(self, primitive: int) -> Diagram:
        """r over x for a primitive."""
        mine, other = self.process.rewards[primitive], self.snapped.rewards[primitive]
        if all(a is b for a, b in zip(mine, other, strict=True)):
            return self.numbers.zero
        a, b = self.numbers.total(mine), self.numbers.total(other)
        size = apply("maximum", apply("maximum", a, b), self.numbers.zero - apply("minimum", a, b))
        margin = size * self.symbolic.manager.constant(MARGIN, FLOAT)
        return apply("maximum", a - b, b - a) + margin

    def row_error(self, primitive: int) -> Diagram:
        """d over x for a primitive."""
        if primitive in self._rows:
            return self._rows[primitive]
        mine, other = (p.symbolic.actions[primitive] for p in (self.process, self.snapped))
        total = self.numbers.zero
        for feature in mine.rows:
            total = total + self._largest(self._row_distance(feature, mine.rows, other.rows))
        for channel in self.process.channels or ():
            if channel in mine.observations:
                a, b = mine.observations[channel], other.observations[channel]
                total = total + self._largest(self._distance(a, b))
        total = total * self.symbolic.manager.constant(1 + MARGIN, FLOAT)
        self._rows[primitive] = total
        return total

    def _largest(self, distances: Diagram) -> Diagram:
        """The largest over next features of a function of (x, x')."""
        for level in reversed(support(distances)):
            if level % 2:
                distances = max_out(distances, level)
        return distances

    def _row_distance(
        self, feature: int, mine: Mapping[int, RowDiagram], other: Mapping[int, RowDiagram]
    ) -> Diagram:
        if feature in other:
            return self._distance(mine[feature], other[feature])
        manager, level = self.symbolic.manager, self.symbolic.now(feature)
        size = manager.sizes[level]
        still = manager.variable(level, [manager.constant(v) for v in range(size)])
        return self._distance(
            mine[feature], RowDiagram(feature, still, tuple(sure(size, v) for v in range(size)))
        )

    def _distance(self, a: RowDiagram, b: RowDiagram) -> Diagram:
        key = (id(a.diagram), id(a.rows), id(b.diagram), id(b.rows))
        if key not in self._distances:
            diagram, values = combine([a.diagram, b.diagram], lambda i, j: distance(a.rows[i], b.rows[j]))
            floats = np.array([np.nextafter(float(v), 2.0) if v else 0.0 for v in values])
            self._distances[key] = ((a, b), relabel(diagram, floats, FLOAT))
        return self._distances[key][1]
