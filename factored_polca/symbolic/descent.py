"""What the regression from the top down, `factored_polca.diagrams.descent`, needs of several actions.

A row that looks at levels below its own is cut there: each of its nodes that stands below, reached from above,
is a row of its own, whose weights are diagrams over what is below.

Only *suited* actions go this way: those with few carried features, as the context is compared at every step,
in models in which some variable has many values.  With two or three values each the way from the bottom up
takes as many steps, and shorter ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import Diagram, Field
from factored_polca.diagrams.descent import HEADER, run_descent, stride
from factored_polca.diagrams.nodes import STEPS
from factored_polca.diagrams.operations import Walk, node, sum_options
from factored_polca.symbolic.regression import NumericView
from factored_polca.symbolic.rows import RowDiagram

Int32Array = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]


CARRIED = 4
"""Carried features up to which an action is suited."""

MANY = 8
"""Values of the largest variable from which on actions are suited."""


@dataclass(frozen=True)
class Cut:
    """A row diagram cut below its own level.

    `diagram` is over its own level and those above and has the numbers of rows as leaves; `paths[row]` are
    values of the levels that lead there, `exact[row]` the row where it is one of numbers.
    """

    level: int
    diagram: Diagram
    paths: tuple[dict[int, int], ...]
    exact: tuple[tuple[Fraction, ...] | None, ...]
    identity: Diagram | None
    carried: bool


def cut(row: RowDiagram, level: int) -> Cut:
    """A feature's row diagram, cut below the feature's level."""
    manager = row.diagram.manager
    walk = Walk(row.diagram)
    payloads = dict(zip(np.flatnonzero(walk.is_leaf).tolist(), walk.leaf_payloads().tolist(), strict=True))
    levels: list[int] = walk.levels.tolist()
    pool, nodes = manager.pool, walk.nodes.tolist()
    children = [
        pool[pool[n + 2 : n + 2 + manager.sizes[at]] + 1].tolist() if at <= level else []
        for n, at in zip(nodes, levels, strict=True)
    ]
    paths: dict[int, dict[int, int]] = {len(nodes) - 1: {}}
    for number in range(len(nodes) - 1, -1, -1):
        if number in paths:
            for value, child in enumerate(children[number]):
                if child not in paths:
                    paths[child] = {**paths[number], levels[number]: value}
    rows = [number for number in sorted(paths) if levels[number] > level]
    exact = tuple(row.rows[payloads[number]] if number in payloads else None for number in rows)
    parts = {number: manager.constant(place) for place, number in enumerate(rows)}
    for number in sorted(paths):
        if levels[number] <= level:
            parts[number] = node(manager, levels[number], [parts[child] for child in children[number]])
    units = {r.index(Fraction(1)): i for i, r in enumerate(exact) if r is not None and Fraction(1) in r}
    identity = None
    if len(units) == manager.sizes[level]:
        identity = node(manager, level, [manager.constant(units[value]) for value in range(len(units))])
    carried = any(levels[number] < level for number in paths)
    return Cut(level, parts[len(nodes) - 1], tuple(paths[r] for r in rows), exact, identity, carried)


Cuts = dict[tuple[int, int, int], Cut]
"""Cuts by feature and what tells its row diagram."""


class Descents:
    """Arrays over the primitive actions `actions`, in their order (-1: none); nodes are of the last `refresh`.

    `known` keeps the cuts from one field to the next.  `width[p]` is the number of carried features, -1
    where an action is not suited, `few[p]` whether it is and changes few features; `carried`, `roots` and `identity` are [p, carried feature],
    `fixed` and `base` [p, level].
    """

    def __init__(self, numbers: NumericView, actions: Sequence[int], known: Cuts) -> None:
        self.numbers, self.manager, self.actions = numbers, numbers.manager, tuple(actions)
        self.first_entries: list[int] = [0]
        self.values: list[int] = []
        self.numbers_of_weights: list[int] = []
        self.weights: list[Diagram] = []
        self.known = known
        self.bases: dict[int, int] = {}
        self.cuts = [self._cuts(action) for action in actions]
        self.width = np.array([sum(c.carried for c, _ in cuts) if cuts else -1 for cuts in self.cuts])
        self.few = [0 < len(cuts) <= CARRIED for cuts in self.cuts]
        shape = (len(actions), int(self.width.max(initial=0)))
        self.carried = np.zeros(shape, dtype=np.int64)
        self.roots = np.zeros(shape, dtype=np.int32)
        self.identity = np.zeros(shape, dtype=np.int32)
        levels = self.manager.leaf_level + 1
        self.fixed = np.zeros((len(actions), levels), dtype=np.int32)
        self.base = np.zeros((len(actions), levels), dtype=np.int64)
        self.last = np.full(len(actions), -1, dtype=np.int64)
        for p, cuts in enumerate(self.cuts):
            carried = [c.level for c, _ in cuts if c.carried]
            self.carried[p, : len(carried)] = carried
            for c, base in cuts:
                self.base[p, c.level] = base
                if not c.carried:
                    self.last[p] = c.level
        self.first = np.array(self.first_entries, dtype=np.int64)
        self.value = np.array(self.values, dtype=np.int32)
        self.weight = np.array(self.numbers_of_weights, dtype=np.int32)
        sizes = self.manager.sizes
        room = 2 * (sum(sizes) + max(sizes, default=1)) + 2
        self.frames = np.zeros(stride(shape[1]) * (self.manager.leaf_level + 3), dtype=np.int32)
        self.found = np.zeros(room, dtype=np.int32)
        self.down = np.zeros(3, dtype=np.int64)
        self.refresh()

    def refresh(self) -> None:
        """Nodes for handles, after a collection."""
        self.weight_nodes = np.array([0, *(w.node for w in self.weights)], dtype=np.int32)[1:]
        for p, cuts in enumerate(self.cuts):
            carried = [c for c, _ in cuts if c.carried]
            self.roots[p, : len(carried)] = [c.diagram.node for c in carried]
            self.identity[p, : len(carried)] = [
                0 if c.identity is None else c.identity.node for c in carried
            ]
            for c, _ in cuts:
                if not c.carried:
                    self.fixed[p, c.level] = c.diagram.node

    def regress(self, place: int, value: Diagram) -> Diagram:
        """The regression of a function of the features through the suited action at a place of `actions`."""
        manager, numbers = self.manager, self.numbers
        assert isinstance(numbers.leaf_type, Field) and self.width[place] >= 0
        manager.safe_point()
        self.refresh()
        self.begin(place, value.node)
        options, parameters = sum_options(manager, numbers.leaf_type, True), numbers.leaf_type.parameters
        key = numbers.regression_key(self.actions[place])
        sums = np.array([0, 0, STEPS], dtype=np.int64)

        def step() -> int:
            m = manager
            return run_descent(
                m.pool, m.head, m.unique, m.arity, m.slots, m.ring, m.ring_state, options, parameters,
                m.stack, m.terms, m.results, sums, key, int(self.width[place]), self.carried[place],
                self.identity[place], self.fixed[place], self.base[place], int(self.last[place]),
                self.first, self.value, self.weight, self.weight_nodes, self.frames, self.found, self.down,
            )  # fmt: skip

        manager.run(step)
        return manager.handle(int(self.found[0]), numbers.leaf_type)

    def begin(self, place: int, node: int) -> None:
        """The frame with which the kernel begins."""
        self.frames[:HEADER] = 0, 0, -1
        self.frames[HEADER] = node
        self.frames[HEADER + 1 : HEADER + 1 + self.width[place]] = self.roots[place, : self.width[place]]
        self.down[:] = 1, 0, 0

    def _cuts(self, action: int) -> list[tuple[Cut, int]]:
        """The changed features of an action, from the top, each with the number of its row 0."""
        if action < 0 or max(self.manager.sizes, default=0) < MANY:
            return []
        symbolic = self.numbers.symbolic
        rows = symbolic.actions[action].rows
        found = []
        for feature in sorted(rows, key=symbolic.now):
            key = feature, id(rows[feature].diagram), id(rows[feature].rows)  # actions share them
            if key not in self.known:
                self.known[key] = cut(rows[feature], symbolic.now(feature))
            found.append(self.known[key])
        if sum(c.carried for c in found) > CARRIED:
            return []
        for feature, c in zip(sorted(rows, key=symbolic.now), found, strict=True):
            if id(c) not in self.bases:
                self.bases[id(c)] = self._base(action, feature, c)
        return [(c, self.bases[id(c)]) for c in found]

    def _base(self, action: int, feature: int, cut: Cut) -> int:
        """List the entries of a feature's rows; the number of the first row."""
        weights = self.numbers.weights(action, feature)
        base = len(self.first_entries) - 1
        pool, zero = self.manager.pool, self.numbers.zero.node
        listed: dict[int, int] = {}  # by node: no garbage is collected meanwhile
        for path, exact in zip(cut.paths, cut.exact, strict=True):
            for value, weight in enumerate(weights):
                if exact is not None and not exact[value]:
                    continue
                part = weight.node
                while pool[part] <= cut.level:
                    part = int(pool[part + 2 + path.get(int(pool[part]), 0)])
                if part != zero:
                    if part not in listed:
                        listed[part] = len(self.weights)
                        self.weights.append(self.manager.handle(part, self.numbers.leaf_type))
                    self.values.append(value)
                    self.numbers_of_weights.append(listed[part])
            self.first_entries.append(len(self.values))
        return base
