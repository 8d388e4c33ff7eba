"""Factors of a belief: float diagrams, each over variables of its own, and sums of their products.

A factor f is a function of the variables in its *scope*, whether its diagram tests them or not.  The
product of factors that share no variables sums to the product of their sums.  The sum over a set of
states, or over each block of a partition, needs those factors only that have variables of it, with
their other variables summed out; it runs down the diagrams of the partition and of the factors at once.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import FLOAT, Diagram, leaves, pairs, restrict, sum_out, support
from factored_polca.diagrams.operations import Walk, leaf_payloads

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MERGED: Final = 1e-14
"""Relative distance below which neighbouring leaves become one."""


@dataclass(frozen=True, eq=False)
class Factor:
    """A float diagram as a function of the variables at the levels `scope`, tested or not."""

    diagram: Diagram
    scope: frozenset[int]

    @cached_property
    def sums(self) -> Sums:
        """Its sums over the scope."""
        return Sums(self.diagram, self.scope)


def restricted(factor: Factor, values: Mapping[int, int]) -> Factor:
    """A factor where some levels have given values, which it is no function of any more."""
    if not factor.scope & values.keys():
        return factor
    return Factor(restrict(factor.diagram, values), factor.scope - values.keys())


def merge(diagram: Diagram, total: float) -> Diagram:
    """`diagram` divided by `total`, leaves within `MERGED` of their neighbour being one."""
    diagram.manager.safe_point()
    walk = Walk(diagram)
    values = walk.leaf_payloads().view(np.float64) / total
    order = np.argsort(values)
    ascending = values[order]
    apart = np.diff(ascending, prepend=-1.0) > MERGED * ascending
    images = np.empty(len(values))
    images[order] = ascending[np.flatnonzero(apart)][np.cumsum(apart) - 1]
    return walk.with_leaves(images, FLOAT)


def mass(condition: Diagram, factors: Sequence[Factor]) -> float:
    """The sum over a condition of the product of those factors that have variables of it."""
    masses = push_down(condition, factors)
    return float(masses[1]) if len(masses) > 1 else 0.0


def push_down(labels: Diagram, factors: Sequence[Factor]) -> FloatArray:
    """The sum for each leaf [leaf] of an index diagram over states, of the factors that it has to do with.

    Every level that `labels` tests belongs to one of `factors`, which share none.  What a factor is over
    and above is summed out first.
    """
    tested = set(support(labels))
    parts = []
    for factor in factors:
        if not factor.scope & tested:
            continue
        diagram = factor.diagram
        for level in sorted(factor.scope - tested, reverse=True):
            diagram = sum_out(diagram, level)
        parts.append(Factor(diagram, factor.scope & tested))
    largest = max(int(leaf) for leaf in leaves(labels))
    if len(parts) != 1:
        return _walk_down(labels, parts, largest + 1)
    numbered, first, second = pairs(labels, parts[0].diagram)
    label = leaf_payloads(labels.manager, first).astype(np.int64)
    value = leaf_payloads(labels.manager, second).view(np.float64)
    counts = Sums(numbered, parts[0].scope).leaf_counts()
    return np.bincount(label, value * counts, minlength=largest + 1).astype(np.float64, copy=False)


def _walk_down(labels: Diagram, factors: Sequence[Factor], count: int) -> FloatArray:
    """`push_down` level by level: the sums that reach each node of `labels` and of the factors at once.

    A factor that has come to a leaf multiplies by it and is -1 from there on.
    """
    manager = labels.manager
    pool, leaf_level = manager.pool, manager.leaf_level
    owner = {level: number for number, factor in enumerate(factors) for level in factor.scope}
    here: dict[tuple[int, ...], float] = {(*(f.diagram.node for f in factors), labels.node): 1.0}
    for level in sorted(owner):
        mine = owner[level]
        after: dict[tuple[int, ...], float] = {}
        for key, sum_here in here.items():
            node, label = key[mine], key[-1]
            for value in range(manager.sizes[level]):
                total, child = sum_here, node
                if node >= 0 and pool[node] == level:
                    child = int(pool[node + 2 + value])
                if child >= 0 and pool[child] == leaf_level:
                    total *= float(leaf_payloads(manager, np.array([child])).view(np.float64)[0])
                    child = -1
                if total == 0.0:
                    continue
                below = int(pool[label + 2 + value]) if pool[label] == level else label
                target = (*key[:mine], child, *key[mine + 1 : -1], below)
                after[target] = after.get(target, 0.0) + total
        here = after
    result = np.zeros(count)
    for key, total in here.items():
        result[int(leaf_payloads(manager, np.array([key[-1]]))[0])] += total
    return result


class Sums:
    """Sums of a diagram over the variables at the levels `scope`, among which are all that it tests.

    `below[q]` is the sum under node q over the variables from its level on, `above[q]` the number of
    ways to reach it from the root.  A level that an edge skips counts with its number of values.
    """

    def __init__(self, diagram: Diagram, scope: Collection[int]) -> None:
        manager = diagram.manager
        walk = Walk(diagram)
        count = len(walk.nodes)
        payloads = walk.leaf_payloads()  # which numbers the nodes again
        self._levels = walk.levels.astype(np.int64)
        self._sizes = [size if level in scope else 1 for level, size in enumerate(manager.sizes)]
        self._before = np.cumprod([1.0, *self._sizes])  # [level] states of the levels above
        self.below = np.zeros(count)
        if diagram.leaf_type == FLOAT:
            self.below[walk.is_leaf] = payloads.view(np.float64)
        self._is_leaf = walk.is_leaf
        self._at: dict[int, tuple[IntArray, Any]] = {}  # level -> its nodes [k], their children [k, value]
        for level in np.unique(self._levels[~walk.is_leaf]).tolist():
            mine = np.flatnonzero(self._levels == level)
            words = walk.nodes[mine].astype(np.int64)[:, None] + 2 + np.arange(manager.sizes[level])
            self._at[level] = (mine, manager.pool[manager.pool[words] + 1].astype(np.int64))
        for level in sorted(self._at, reverse=True):
            mine, children = self._at[level]
            self.below[mine] = (self.below[children] * self._gap(level, children)).sum(axis=1)
        self.total = float(self.below[-1] * self._before[self._levels[-1]])

    def _gap(self, level: int, children: IntArray) -> FloatArray:
        """The number of ways that the levels between `level` and its children may go."""
        result: FloatArray = self._before[self._levels[children]] / self._before[level + 1]
        return result

    @cached_property
    def above(self) -> FloatArray:
        """The number of ways to each node [node]."""
        result = np.zeros(len(self._levels))
        result[-1] = self._before[self._levels[-1]]
        for level in sorted(self._at):
            mine, children = self._at[level]
            np.add.at(result, children, result[mine][:, None] * self._gap(level, children))
        return result

    def leaf_counts(self) -> FloatArray:
        """The number of states of each leaf, by first occurrence."""
        return self.above[self._is_leaf]

    def marginal(self, level: int) -> FloatArray:
        """The sum for each value of the variable at `level`; what skips it is spread evenly."""
        size = self._sizes[level]
        result = np.zeros(size)
        if level in self._at:
            mine, children = self._at[level]
            passing = self.below[children] * self._gap(level, children)
            result = (self.above[mine][:, None] * passing).sum(axis=0)
        rest = self.total - float(result.sum())
        return result + (rest / size if rest > 1e-12 * self.total else 0.0)
