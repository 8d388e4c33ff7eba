"""Regressions on tables, where a function's diagram would have about as many nodes as a table has cells.

Functions of many loosely coupled features (machines in a ring) have few equal values: after one regression
nearly every cell has its own, and a diagram is a table with pointers.  Where the features have at most
`CELLS` cells together, a regression then runs on tables, the axes of which are levels: the next variables
are summed out one by one,

    F(x, x') <- sum over v of P(x_k' = v | x, x') F(x, x' with x_k' = v),

each product being over the axes that it needs only.  The result becomes a diagram again after its leaves
were merged.  Nothing else is ever listed, and no transition matrix made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import FLOAT, Diagram, Manager, load, node_count, support
from factored_polca.diagrams.jit import int64, late_kernel
from factored_polca.structured.pomdp_model import FactoredPOMDP, Seen, Step
from factored_polca.structured.rounding import Direction, group

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Int32Array = npt.NDArray[np.int32]

CELLS: Final = 1 << 17
"""Cells of the features up to which tables are used."""

BETWEEN: Final = 1 << 21
"""Cells of a table on the way."""


class TooManyCells(RuntimeError):
    """A table on the way has more cells than it may."""


@dataclass(frozen=True, eq=False)
class Table:
    """A function of the variables at `axes`, ascending levels, as an array with one axis for each."""

    axes: tuple[int, ...]
    values: FloatArray

    def over(self, axes: Sequence[int]) -> FloatArray:
        """The array with an axis of length 1 for each of `axes`, ascending, that it has not."""
        sizes = dict(zip(self.axes, self.values.shape, strict=True))
        return self.values.reshape([sizes.get(axis, 1) for axis in axes])

    def moved(self, levels: Mapping[int, int]) -> Table:
        """The same function of other variables; their order stays."""
        return Table(tuple(levels.get(axis, axis) for axis in self.axes), self.values)

    def __mul__(self, other: Table) -> Table:
        axes = tuple(sorted({*self.axes, *other.axes}))
        return Table(axes, self.over(axes) * other.over(axes))

    def __add__(self, other: Table) -> Table:
        axes = tuple(sorted({*self.axes, *other.axes}))
        return Table(axes, self.over(axes) + other.over(axes))

    def summed(self, weight: Table, level: int) -> Table:
        """The sum over the variable at `level` of the product with `weight`."""
        axes = tuple(sorted({*self.axes, *weight.axes} - {level}))
        sizes = dict(zip(self.axes, self.values.shape, strict=True))
        sizes.update(zip(weight.axes, weight.values.shape, strict=True))
        if prod(sizes[axis] for axis in axes) > BETWEEN:
            raise TooManyCells
        total: Any = 0.0
        for v in range(sizes[level]):
            part = self._at(level, v).over(axes) * weight._at(level, v).over(axes)
            total = total + part
        return Table(axes, np.asarray(total, dtype=np.float64))

    def _at(self, level: int, value: int) -> Table:
        if level not in self.axes:
            return self
        place = self.axes.index(level)
        values: FloatArray = np.asarray(self.values.take(value, axis=place))
        return Table((*self.axes[:place], *self.axes[place + 1 :]), values)


@late_kernel
def spread(
    pool: Int32Array, root: int, axes: IntArray, sizes: IntArray, out: npt.NDArray[np.uint64]
) -> None:
    """The payload at each cell of the variables at `axes`, the last running fastest."""
    depth = len(axes)
    digits = np.zeros(depth, np.int64)
    nodes = np.zeros(depth + 1, np.int64)  # where the first `i` digits lead
    nodes[0] = root
    changed = 0
    for cell in range(len(out)):
        for i in range(changed, depth):
            node = nodes[i]
            if pool[node] == axes[i]:
                node = int64(pool[node + 2 + digits[i]])
            nodes[i + 1] = node
        leaf = nodes[depth]
        low = np.uint64(np.uint32(pool[leaf + 2]))
        high = np.uint64(np.uint32(pool[leaf + 3]))
        out[cell] = low | (high << np.uint64(32))
        changed = depth
        while changed > 0:
            changed -= 1
            digits[changed] += 1
            if digits[changed] < sizes[changed]:
                break
            digits[changed] = 0


def table_of(diagram: Diagram, axes: Sequence[int] | None = None) -> Table:
    """A float diagram as a table over the levels that it tests, or over more.

    Raises:
        TooManyCells: the table would be too large.
    """
    manager = diagram.manager
    levels = tuple(support(diagram) if axes is None else axes)
    sizes = [manager.sizes[level] for level in levels]
    if prod(sizes) > BETWEEN:
        raise TooManyCells
    out = np.empty(prod(sizes), dtype=np.uint64)
    spread(
        manager.pool,
        diagram.node,
        np.array(levels, dtype=np.int64),
        np.array(sizes, dtype=np.int64),
        out,
    )
    return Table(levels, out.view(np.float64).reshape(sizes))


def diagram_of(manager: Manager, table: Table) -> Diagram:
    """A table as a diagram."""
    values, ids = np.unique(table.values.ravel() + 0.0, return_inverse=True)
    levels: list[IntArray] = [np.full(len(values), manager.leaf_level)]
    children: list[IntArray] = []
    count = len(values)
    for axis, size in zip(reversed(table.axes), reversed(table.values.shape), strict=True):
        rows = ids.reshape(-1, size)
        redundant = (rows == rows[:, :1]).all(axis=1)
        ids = rows[:, 0].copy()
        inner = rows[~redundant]
        if len(inner):
            if count**size < 2**62:
                keys = inner[:, 0].astype(np.int64)
                for v in range(1, size):
                    keys = keys * count + inner[:, v]
                _, first, place = np.unique(keys, return_index=True, return_inverse=True)
            else:
                _, first, place = np.unique(inner, axis=0, return_index=True, return_inverse=True)
            ids[~redundant] = count + place.ravel()
            levels.append(np.full(len(first), axis))
            children.append(inner[first].ravel())
            count += len(first)
    if count == len(values):
        return manager.constant(float(values[0]), FLOAT)
    arrays = {
        "levels": np.concatenate(levels),
        "children": np.concatenate(children),
        "leaves": values.view(np.int64),
    }
    return load(manager, arrays, FLOAT)


def eliminate(function: Table, weights: Mapping[int, Table], synchronic: bool) -> Table:
    """Sum the variables at the levels of `weights` out, each with its distribution.

    Where there are no synchronic arcs, that one first which makes the smallest table; else in the order of
    `weights`.

    Raises:
        TooManyCells: a table on the way is too large.
    """
    waiting = list(weights)
    while waiting:
        level = waiting[0]
        if not synchronic:
            here = set(function.axes)
            level = min(waiting, key=lambda level: len(set(weights[level].axes) - here))
        waiting.remove(level)
        if level in function.axes:
            function = function.summed(weights[level], level)
    return function


def step_tables(pomdp: FactoredPOMDP, step: Step) -> tuple[list[Table], dict[Seen, dict[int, Table]]]:
    """W_o for each outcome of a step, and the distributions of the changed features at each y'."""
    symbolic = pomdp.symbolic
    weights: dict[Seen, dict[int, Table]] = {}
    for (then, k), parts in step.weights.items():
        level = symbolic.next(k)
        whole = pomdp.branch(level, parts)
        table = table_of(whole, sorted({*support(whole), level}))
        weights.setdefault(then, {})[level] = table
    for outcome in step.outcomes:
        weights.setdefault(outcome.seen, {})
    return [table_of(outcome.weight) for outcome in step.outcomes], weights


def merged_cells(values: FloatArray, width: float, leaves: int, direction: Direction) -> FloatArray:
    """Cells with values within `width`, or within more to have at most `leaves` values, made equal."""
    distinct, place = np.unique(values, return_inverse=True)
    if len(distinct) <= 2 * leaves:
        first = group(distinct, width)
    if len(distinct) > 2 * leaves or len(first) > leaves:
        bins = ((distinct - distinct[0]) * (leaves / (distinct[-1] - distinct[0]))).astype(np.int64)
        first = np.flatnonzero(np.diff(np.minimum(bins, leaves - 1), prepend=-1))
    last = np.append(first[1:], len(distinct)) - 1
    chosen = distinct[first] if direction == "down" else distinct[last]
    result: FloatArray = np.repeat(chosen, last - first + 1)[place.ravel()].reshape(values.shape)
    return result


def merged_diagram(
    manager: Manager, table: Table, width: float, nodes: int, direction: Direction
) -> tuple[Diagram, float]:
    """A table as a diagram of at most `nodes` nodes, leaves merged to one side, and the largest error."""
    distinct = len(np.unique(table.values))
    leaves = distinct if distinct <= nodes else max(1, nodes // 8)
    while True:
        values = merged_cells(table.values, width, leaves, direction)
        found = diagram_of(manager, Table(table.axes, values))
        count = node_count(found)
        if count <= nodes or leaves == 1:
            return found, float(np.abs(values - table.values).max(initial=0.0))
        leaves = max(1, min(leaves * 9 * nodes // (10 * count), nodes // 8))
