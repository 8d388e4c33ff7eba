"""Upper bounds: base bounds Q_a that are linear in the belief, and the values of explored beliefs.

At a belief b with known Q_a and points b_j of value at most v_j, for any phi <= min over x, b_j(x) > 0, of
b(x) / b_j(x): b - phi b_j is a measure, and V* is convex and positively homogeneous, hence

    V*(b) <= phi v_j + V*(b - phi b_j) <= phi v_j + max over a of (Q_a . b - phi Q_a . b_j).

With Q_a for all actions alike this is the sawtooth bound (Hauskrecht 2000); here it rests on any maximum of
linear bounds.  For products phi is the product of the features' least ratios.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import Diagram, node_count
from factored_polca.diagrams.jit import late_kernel
from factored_polca.structured.alpha_forest import Forest, pair_ratio
from factored_polca.structured.pomdp_belief import BeliefSpace
from factored_polca.structured.pomdp_informed import InformedBound
from factored_polca.structured.pomdp_model import Seen
from factored_polca.structured.pomdp_point import PointBelief
from factored_polca.structured.rounding import round_to_size

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Int32Array = npt.NDArray[np.int32]
BoolArray = npt.NDArray[np.bool_]

BASE_NODES = 2_000
"""Nodes of a base bound at one y."""

INFORMED_NODES = 5_000
"""The same of one that was found on tables, which has as many values as cells."""

SHRUNK = 1 - 1e-12
"""What a computed ratio is multiplied by, to be below the exact one."""

LOOKED_BACK = 2_000
"""Changes of points that a belief catches up with, the latest ones."""


@late_kernel
def sawtooth(
    marginals: FloatArray, quality: FloatArray, points: FloatArray, values: FloatArray, base: FloatArray,
    groups: IntArray, chosen: IntArray, product: BoolArray, shrunk: float,
) -> float:  # fmt: skip
    """The least bound at a product belief by those of the chosen points that are products.

    `groups` has an end after the last feature.
    """
    best = np.inf
    for j in chosen:
        if not product[j]:
            continue
        phi = shrunk
        for g in range(len(groups) - 1):
            least = np.inf
            for e in range(groups[g], groups[g + 1]):
                p = points[j, e]
                if p > 0.0:
                    least = min(least, marginals[e] / p)
            phi *= least
            if phi == 0.0:
                break
        if phi <= 0.0:
            continue
        rest = -np.inf
        for a in range(len(quality)):
            rest = max(rest, quality[a] - phi * base[j, a])
        best = min(best, phi * values[j] + rest)
    return best


@late_kernel
def joint_sawtooth(
    marginals: FloatArray, quality: FloatArray, points: FloatArray, values: FloatArray, base: FloatArray,
    chosen: IntArray, all_of_them: bool, product: BoolArray, shrunk: float,
    order: IntArray, in_a: IntArray, in_b: IntArray, a_root: int, b_roots: IntArray,
    a_levels: Int32Array, a_first: Int32Array, a_children: Int32Array, a_value: FloatArray,
    b_levels: Int32Array, b_first: Int32Array, b_children: Int32Array, b_value: FloatArray,
    sizes: Int32Array, offset: IntArray, keys: IntArray, found: FloatArray, stamp: int,
) -> float:  # fmt: skip
    """The same by those that are no products, or by all, at any belief."""
    best = np.inf
    for j in chosen:
        if product[j] and not all_of_them:
            continue
        phi = shrunk * pair_ratio(
            a_root, b_roots[j], order, in_a, in_b[j], a_levels, a_first, a_children, a_value,
            b_levels, b_first, b_children, b_value, sizes, offset, marginals, points[j],
            keys, found, stamp + j * (len(order) + 1) * len(b_levels) * len(a_levels),
        )  # fmt: skip
        if phi <= 0.0 or phi == np.inf:
            continue
        rest = -np.inf
        for a in range(len(quality)):
            rest = max(rest, quality[a] - phi * base[j, a])
        best = min(best, phi * values[j] + rest)
    return best


class PointSet:
    """The explored beliefs at one y, and the base bounds there.

    `log` lists the points as they came or were bettered: a belief looks at what is new to it.
    """

    def __init__(self, space: BeliefSpace, forest: Forest) -> None:
        self.space, self.forest = space, forest
        self.groups: IntArray = np.append(space.groups, space.entries)
        actions = len(forest)
        self.count = 0
        self.points: FloatArray = np.zeros((8, space.entries))
        self.base: FloatArray = np.zeros((8, actions))
        self.values: FloatArray = np.zeros(8)
        self.product: BoolArray = np.zeros(8, dtype=np.bool_)
        self.clustered: IntArray = np.zeros((8, len(space.levels)), dtype=np.int64)
        self.joint_roots: IntArray = np.zeros(8, dtype=np.int64)
        self.joints = Forest(space.pomdp.manager)
        self.joints.add(space.pomdp.one)
        self.log: list[int] = []
        self.joint_points = 0

    def add(self, belief: PointBelief, quality: FloatArray, value: float) -> int:
        """One more point; its number."""
        if self.count == len(self.values):
            for name in ("points", "base", "values", "product", "clustered", "joint_roots"):
                array = getattr(self, name)
                setattr(self, name, np.concatenate([array, np.zeros_like(array)]))
        j = self.count
        self.points[j], self.base[j], self.values[j] = belief.marginals, quality, value
        self.product[j] = belief.diagram is None
        self.clustered[j] = self.space.clustered(belief)
        self.joint_roots[j] = 0
        if belief.diagram is not None:
            self.joints.add(belief.diagram)
            self.joint_roots[j] = self.joints.roots[-1]
            self.joint_points += 1
        self.count += 1
        self.log.append(j)
        return j

    def lower_to(self, number: int, value: float) -> None:
        """A better value of a point."""
        self.values[number] = value
        self.log.append(number)

    def bound(self, belief: PointBelief, quality: FloatArray, since: int) -> float:
        """The least bound by the points in the log from `since` on; infinity without any."""
        news = self.log[max(since, len(self.log) - LOOKED_BACK) :]
        if not news:
            return float("inf")
        chosen = np.unique(np.array(news, dtype=np.int64))
        found = float("inf")
        if belief.joint is None:
            found = sawtooth(
                belief.marginals, quality, self.points, self.values, self.base, self.groups,
                chosen, self.product, SHRUNK,
            )  # fmt: skip
            if not self.joint_points:
                return found
        space = self.space
        a, b = belief.joint or space.unit, self.joints
        states = (len(space.levels) + 1) * len(a.levels) * len(b.levels)
        stamp = space.table.next_pass(self.count * states)
        joint = joint_sawtooth(
            belief.marginals, quality, self.points, self.values, self.base,
            chosen, belief.joint is not None, self.product, SHRUNK,
            space.levels, space.clustered(belief), self.clustered, a.roots[0], self.joint_roots,
            a.levels, a.first, a.children, a.value, b.levels, b.first, b.children, b.value,
            a.sizes, space.offset, space.table.keys, space.table.found, stamp,
        )  # fmt: skip
        return min(found, joint)


class UpperBound:
    """The points at every y; `quality` [action] are diagrams over the whole state.

    Where an `informed` bound was computed, its Q_a take their place.
    """

    def __init__(
        self,
        space: BeliefSpace,
        quality: list[Diagram],
        size: float,
        informed: InformedBound | None = None,
        width: float = 0.0,
    ) -> None:
        self.space, self.quality, self.size = space, quality, size
        self.informed, self.width = informed, width
        self.sets: dict[Seen, PointSet] = {}

    def at(self, seen: Seen) -> PointSet:
        """The points at one y."""
        if seen not in self.sets:
            forest = Forest(self.space.pomdp.manager)
            forest.add_all(self.base(seen))
            self.sets[seen] = PointSet(self.space, forest)
        return self.sets[seen]

    def base(self, seen: Seen) -> list[Diagram]:
        """Q_a [action] at one y."""
        if self.informed is not None and seen in self.informed.q:
            return self.informed.diagrams(seen, INFORMED_NODES, self.width)
        slices = [self.space.pomdp.at(seen, diagram) for diagram in self.quality]
        return [self._small(diagram) for diagram in slices]

    def _small(self, diagram: Diagram) -> Diagram:
        """A base bound at one y with leaves merged upwards where it has too many nodes."""
        if node_count(diagram) <= BASE_NODES:
            return diagram
        return round_to_size(diagram, nodes=BASE_NODES, direction="up").diagram
