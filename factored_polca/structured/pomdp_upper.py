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

from factored_polca.diagrams.jit import kernel
from factored_polca.structured.alpha_forest import Forest, pair_ratio
from factored_polca.structured.pomdp_belief import BeliefSpace, PointBelief
from factored_polca.structured.pomdp_model import Seen

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

SHRUNK = 1 - 1e-12
"""What a computed ratio is multiplied by, to be below the exact one."""

JOINT_POINTS = 200
"""Points with joint distributions that are compared with a belief, the latest ones."""


@kernel
def sawtooth(
    marginals: FloatArray, quality: FloatArray, points: FloatArray, values: FloatArray, base: FloatArray,
    groups: IntArray, count: int, usable: npt.NDArray[np.bool_], shrunk: float,
) -> float:  # fmt: skip
    """The least bound at a product belief by `count` points; `groups` has an end after the last."""
    best = np.inf
    for j in range(count):
        if not usable[j]:
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


class PointSet:
    """The explored beliefs at one y, and the base bounds there."""

    def __init__(self, space: BeliefSpace, forest: Forest) -> None:
        self.space, self.forest = space, forest
        self.groups: IntArray = np.append(space.groups, space.entries)
        actions = len(forest)
        self.count = 0
        self.points: FloatArray = np.zeros((8, space.entries))
        self.base: FloatArray = np.zeros((8, actions))
        self.values: FloatArray = np.zeros(8)
        self.product: npt.NDArray[np.bool_] = np.zeros(8, dtype=np.bool_)
        self.beliefs: list[PointBelief] = []
        self.changes = 0

    def add(self, belief: PointBelief, quality: FloatArray, value: float) -> int:
        """One more point; its number."""
        if self.count == len(self.values):
            self.points = np.concatenate([self.points, np.zeros_like(self.points)])
            self.base = np.concatenate([self.base, np.zeros_like(self.base)])
            self.values = np.concatenate([self.values, np.zeros_like(self.values)])
            self.product = np.concatenate([self.product, np.zeros_like(self.product)])
        j = self.count
        self.points[j], self.base[j], self.values[j] = belief.marginals, quality, value
        self.product[j] = not belief.cluster
        self.beliefs.append(belief)
        self.count += 1
        self.changes += 1
        return j

    def lower_to(self, number: int, value: float) -> None:
        """A better value of a point."""
        self.values[number] = value
        self.changes += 1

    def bound(self, belief: PointBelief, quality: FloatArray) -> float:
        """The least bound by the points; infinity without any."""
        found = np.inf
        if not belief.cluster and self.count:
            found = sawtooth(
                belief.marginals, quality, self.points, self.values, self.base, self.groups,
                self.count, self.product, SHRUNK,
            )  # fmt: skip
        if belief.cluster or not self.product[: self.count].all():
            found = min(found, self._by_pairs(belief, quality))
        return found

    def _by_pairs(self, belief: PointBelief, quality: FloatArray) -> float:
        """The same where the belief or a point has a joint distribution."""
        found = np.inf
        looked = 0
        for j in range(self.count - 1, -1, -1):
            point = self.beliefs[j]
            if not (belief.cluster or point.cluster):
                continue
            looked += 1
            if looked > JOINT_POINTS:
                break
            phi = self.ratio(belief, point) * SHRUNK
            if phi > 0.0:
                rest = float((quality - phi * self.base[j]).max())
                found = min(found, phi * float(self.values[j]) + rest)
        return found

    def ratio(self, belief: PointBelief, point: PointBelief) -> float:
        """The least belief / point."""
        space = self.space
        levels = sorted({*belief.cluster, *point.cluster})
        phi = 1.0
        clustered = set(levels)
        for k in space.pomdp.hidden:
            level = space.pomdp.symbolic.now(k)
            if level not in clustered:
                begin = int(space.offset[level])
                end = begin + space.pomdp.manager.sizes[level]
                there = point.marginals[begin:end]
                some = there > 0
                phi *= float((belief.marginals[begin:end][some] / there[some]).min())
                if phi == 0.0:
                    return 0.0
        a, b = belief.joint or space.unit, point.joint or space.unit
        stamp = space.table.next_pass((len(levels) + 1) * len(a.levels) * len(b.levels))
        order = np.array(levels, dtype=np.int64)
        in_a = np.array([level in belief.cluster for level in levels], dtype=np.int64)
        in_b = np.array([level in point.cluster for level in levels], dtype=np.int64)
        least = pair_ratio(
            0, a.roots[0], b.roots[0], order, in_a, in_b,
            a.levels, a.first, a.children, a.value, b.levels, b.first, b.children, b.value,
            a.sizes, space.offset, belief.marginals, point.marginals,
            space.table.keys, space.table.found, stamp,
        )  # fmt: skip
        return phi * least if least < np.inf else 0.0


class UpperBound:
    """The points at every y; `quality` [action] are diagrams over the whole state."""

    def __init__(self, space: BeliefSpace, quality: list, size: float) -> None:  # type: ignore[type-arg]
        self.space, self.quality, self.size = space, quality, size
        self.sets: dict[Seen, PointSet] = {}

    def at(self, seen: Seen) -> PointSet:
        """The points at one y."""
        if seen not in self.sets:
            forest = Forest(self.space.pomdp.manager)
            for diagram in self.quality:
                forest.add(self.space.pomdp.at(seen, diagram))
            self.sets[seen] = PointSet(self.space, forest)
        return self.sets[seen]
