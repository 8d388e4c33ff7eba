"""Regression: the back-projection of a function V of the next state through an action,

    R_a[V](x) = sum_x' prod_i P_a(x_i' | x, x') V(x'),

exactly in GF(p), or in floats.  A `NumericView` holds one model's probabilities in one leaf type.
Without synchronic arcs the regression runs node by node (`factored_polca.diagrams.weighted`).  With
them, V moves to the next variables, and each next variable is summed out by one weighted sum,
children before their parents.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import (
    FLOAT,
    Diagram,
    Field,
    LeafType,
    choose,
    cofactors,
    move,
    relabel,
    support,
    weighted_sum,
)
from factored_polca.diagrams.manager import STEPS
from factored_polca.diagrams.operations import Walk, sum_options
from factored_polca.diagrams.weighted import run_regression
from factored_polca.symbolic.model import SymbolicModel
from factored_polca.symbolic.rows import Term

SHARED_SUM = 128
"""Terms up to which a sum's parts are kept: some n^3 / 6 nodes for n terms over a feature each."""


@dataclass
class Prepared:
    """The weights of one action as flat arrays for the kernel; remade after garbage collection."""

    handles: list[Diagram]
    first: npt.NDArray[np.int64]
    last_changed: int
    key: int
    collections: int = -1
    nodes: npt.NDArray[np.int32] = field(default_factory=lambda: np.empty(0, dtype=np.int32))


class NumericView:
    """The probabilities and rewards of a symbolic model as diagrams with leaves of one type.

    Raises (when a number is first used):
        ZeroDivisionError: a denominator is divisible by the field's prime.
    """

    def __init__(self, symbolic: SymbolicModel, leaf_type: LeafType = FLOAT) -> None:
        self.symbolic = symbolic
        self.manager = symbolic.manager
        self.leaf_type = leaf_type
        self.zero = self.manager.constant(0, leaf_type)
        self.one = self.manager.constant(1, leaf_type)
        self._weights: dict[tuple[int, int], list[Diagram]] = {}
        self._terms: dict[int, tuple[Term, Diagram]] = {}
        self._sums: dict[tuple[int, int], tuple[Diagram, Diagram, Diagram]] = {}
        self._prepared: dict[int, Prepared] = {}
        self._options: tuple[int, npt.NDArray[np.int64]] | None = None

    def stored(self, values: tuple[Fraction, ...] | list[Fraction]) -> npt.NDArray[Any]:
        """Exact values in the form that leaves hold."""
        if isinstance(self.leaf_type, Field):
            return np.array([self.leaf_type.rational(value) for value in values], dtype=np.uint64)
        return np.array([float(value) for value in values], dtype=np.float64)

    def term(self, term: Term) -> Diagram:
        """A term with its values as leaves."""
        key = id(term.diagram)  # actions share terms
        if key not in self._terms:
            self._terms[key] = (term, relabel(term.diagram, self.stored(term.values), self.leaf_type))
        return self._terms[key][1]

    def total(self, terms: Sequence[Term]) -> Diagram:
        """The sum of some terms; short sums that begin alike share what they begin with."""
        total = self.zero
        for term in terms:
            part = self.term(term)
            if len(terms) > SHARED_SUM:
                total = total + part
                continue
            path = (id(total), id(part))
            if path not in self._sums:
                self._sums[path] = (total, part, total + part)
            total = self._sums[path][2]
        return total

    def weights(self, action: int, feature: int) -> list[Diagram]:
        """P_a(x_i' = v | parents) for each v."""
        row = self.symbolic.actions[action].rows.get(feature)
        if row is None:
            return self.persisting(feature)
        key = (id(row.diagram), id(row.rows))  # actions share them
        if key not in self._weights:
            self._weights[key] = [
                relabel(row.diagram, self.stored([r[v] for r in row.rows]), self.leaf_type)
                for v in range(len(row.rows[0]))
            ]
        return self._weights[key]

    def persisting(self, feature: int) -> list[Diagram]:
        """P(x_i' = v | x_i) for each v where the feature stays what it is."""
        key = (-1, feature)
        if key not in self._weights:
            level = self.symbolic.now(feature)
            size = len(self.symbolic.model.features[feature].values)
            self._weights[key] = [
                choose(self.manager.indicator(level, [v]), self.one, self.zero) for v in range(size)
            ]
        return self._weights[key]

    def regress(self, action: int, value: Diagram) -> Diagram:
        """R_a[V] for V over the present variables, with no regard to where the action applies."""
        compiled = self.symbolic.actions[action]
        if not compiled.rows or value.is_constant:
            return value
        if compiled.synchronic:
            return self.expect(action, self.shift(value))
        return self.regress_nodes(self.prepared(action), value)

    def shift(self, value: Diagram) -> Diagram:
        """V over the next variables in place of the present ones."""
        levels = {2 * i: 2 * i + 1 for i in range(len(self.symbolic.order))}
        return move(value, levels)

    def expect(self, action: int, value: Diagram) -> Diagram:
        """The expectation of a function of (x, x') over x', given x and the action."""
        for feature in self.symbolic.actions[action].elimination:
            level = self.symbolic.next(feature)
            if level in support(value):
                parts = cofactors(value, level)
                value = weighted_sum(self.weights(action, feature), parts, normalised=True)
        return value

    def prepare(self, action: int, weights: Sequence[Sequence[Diagram]], name: Hashable) -> Prepared:
        """The regression with `weights` [feature][value] over x, each feature's summing to 1 everywhere.

        Only the features that the action changes may have other weights than what persists has.
        `name` tells results remembered from those of other weights.
        """
        handles: list[Diagram] = []
        first = np.zeros(self.manager.leaf_level + 1, dtype=np.int64)
        last = -1
        for feature, parts in enumerate(weights):
            first[self.symbolic.now(feature)] = len(handles)
            handles.extend(parts)
            if feature in self.symbolic.actions[action].rows:
                last = max(last, self.symbolic.now(feature))
        return Prepared(handles, first, last, self.regression_key(name))

    def regression_key(self, name: Hashable) -> int:
        """What tells remembered regressions with some weights from others."""
        return self.manager.cache_key("regression", name, self.leaf_type)

    def prepared(self, action: int) -> Prepared:
        """The regression through an action without synchronic arcs."""
        if action not in self._prepared:
            features = range(len(self.symbolic.model.features))
            self._prepared[action] = self.prepare(
                action, [self.weights(action, i) for i in features], (action, self.symbolic.variant)
            )
        return self._prepared[action]

    def regress_nodes(self, prepared: Prepared, value: Diagram) -> Diagram:
        """The regression of V, over the present variables, with prepared weights, node by node."""
        self.manager.safe_point()
        regression = NodeRegression(self, prepared, value)
        self.manager.run(regression.step)
        return regression.result

    def sum_options(self) -> npt.NDArray[np.int64]:
        """The options of normalised weighted sums, until the next collection."""
        if self._options is None or self._options[0] != self.manager.collections:
            self._options = (self.manager.collections, sum_options(self.manager, self.leaf_type, True))
        return self._options[1]


class NodeRegression:
    """A regression from the bottom up, in slices: call `step` until it answers DONE.

    No garbage may be collected, and no other weighted sum run, before it is done.
    """

    def __init__(self, numbers: NumericView, prepared: Prepared, value: Diagram) -> None:
        self.manager, self.leaf_type = numbers.manager, numbers.leaf_type
        manager = self.manager
        if prepared.collections != manager.collections:
            prepared.nodes = np.array([handle.node for handle in prepared.handles], dtype=np.int32)
            prepared.collections = manager.collections
        self.prepared = prepared
        self.options = numbers.sum_options()
        self.field = (
            self.leaf_type.parameters
            if isinstance(self.leaf_type, Field)
            else np.array([3, 1], dtype=np.uint64)
        )
        self.walk = Walk(value)
        self.regressed = np.empty(len(self.walk.nodes), dtype=np.int32)
        self.progress = np.zeros(2, dtype=np.int64)
        self.state = np.array([0, 0, STEPS], dtype=np.int64)

    def step(self) -> int:
        """One slice; what a resumable kernel answers."""
        m, walk, prepared = self.manager, self.walk, self.prepared
        return run_regression(
            m.pool, m.head, m.unique, m.arity, m.slots, m.ring, m.ring_state, self.options,
            self.field, m.stack, m.terms, m.results, self.state, m.cache, prepared.key,
            walk.nodes, len(walk.nodes), prepared.nodes, prepared.first, prepared.last_changed,
            self.regressed, self.progress,
        )  # fmt: skip

    @property
    def result(self) -> Diagram:
        """The regression, when it is done."""
        return self.manager.handle(int(self.regressed[-1]), self.leaf_type)
