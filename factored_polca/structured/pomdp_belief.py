"""Beliefs over the hidden features, for planning: products of marginals where that is exact.

A belief is a value y of the observed features, a distribution m_k for each hidden feature k and, where
hidden features are correlated, one joint distribution over those, the *cluster*, as a diagram.

Let b be a product.  For an outcome o of an action the numbers

    P(o | b) = b . L_o,   L_o = regression of W_o,        P(o, x_k' = v | b) = b . D_kv,
    D_kv = regression of W_o [x_k' = v]

are expectations of diagrams that do not depend on b: they give the marginals of the belief that follows,
whatever b is.  That belief is the product of its marginals if no two of its features are connected: in the
graph that joins all features, now and next, that one factor P(x_k' | .), or one factor of W_o, reads,
features that are known being left out.  Otherwise it is formed by variable elimination, as a diagram, if
that has at most `CLUSTER_NODES` nodes.  Else it is *projected* on the product of its marginals (Boyen &
Koller 1998): another belief than the one that follows, which is said (`exact`).

Leaves of joint distributions are rounded to 45 bits, and beliefs that agree to 45 bits in each number are
taken for equal: `BELIEF_ERROR` bounds the relative error of all that.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Final

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import (
    FLOAT,
    Diagram,
    move,
    node_count,
    restrict,
    support,
)
from factored_polca.diagrams.operations import Walk
from factored_polca.models import LimitReached
from factored_polca.structured.alpha_forest import Forest, Remembered
from factored_polca.structured.pomdp_model import FactoredPOMDP, Outcome, Seen, Step
from factored_polca.structured.pomdp_point import KEPT_BITS, PointBelief, rounded_bits
from factored_polca.structured.pomdp_tables import OutcomeTable, StepTable
from factored_polca.symbolic import RowDiagram
from factored_polca.symbolic.elimination import eliminate, joined
from factored_polca.symbolic.factors import Factor, restricted

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

CLUSTER_NODES: Final = 5_000
"""Nodes that a joint distribution of correlated features, or what comes before it, may have."""

STARTS: Final = 10_000
"""Values of the observed features at the start."""

BELIEF_ERROR: Final = 1e-12
"""The L1 distance of a belief that was computed, and looked up, from the exact one that follows another."""


class TooLarge(RuntimeError):
    """A belief, or what comes between two, has too many nodes."""


@dataclass(frozen=True, eq=False)
class Follow:
    """What follows a belief under an outcome: its probability, and the belief, or its projection."""

    probability: float
    belief: PointBelief
    exact: bool


class BeliefSpace:
    """Beliefs of a model, and what follows them."""

    def __init__(self, pomdp: FactoredPOMDP, *, cluster_nodes: int = CLUSTER_NODES) -> None:
        self.pomdp, self.cluster_nodes = pomdp, cluster_nodes
        symbolic = pomdp.symbolic
        levels = pomdp.manager.leaf_level
        self.offset: IntArray = np.zeros(levels + 1, dtype=np.int64)
        sizes = []
        begin = 0
        for k in pomdp.hidden:
            self.offset[symbolic.now(k)] = begin
            sizes.append(len(pomdp.features[k].values))
            begin += sizes[-1]
        self.entries = begin
        self.groups: IntArray = np.concatenate([[0], np.cumsum(sizes)])[:-1].astype(np.int64)
        self.place = {k: n for n, k in enumerate(pomdp.hidden)}
        self.table = Remembered()
        self.unit = Forest(pomdp.manager)
        self.unit.add(pomdp.one)
        self.levels: IntArray = np.array(sorted(symbolic.now(k) for k in pomdp.hidden), dtype=np.int64)
        self._feature_at = {symbolic.now(k): k for k in pomdp.hidden}
        self._feature_at |= {symbolic.next(k): k for k in pomdp.hidden}
        self._tables: dict[tuple[Seen, int], StepTable] = {}
        self.projections = 0

    def tables(self, seen: Seen, action: int) -> StepTable:
        """The expectations of an action at one y."""
        key = (seen, action)
        if key not in self._tables:
            self._tables[key] = StepTable(self, self.pomdp.step(seen, action))
        return self._tables[key]

    def tokens(self, step: Step, levels: Sequence[int]) -> frozenset[int]:
        """Levels as 2 n (now) and 2 n + 1 (next, or a feature that the step leaves alone)."""
        now = self.pomdp.symbolic.now
        found = set()
        for level in levels:
            k = self._feature_at[level]
            later = level != now(k) or k not in step.changed
            found.add(2 * self.place[k] + later)
        return frozenset(found)

    def clustered(self, belief: PointBelief) -> IntArray:
        """Whether each of `levels` is of the cluster."""
        return np.isin(self.levels, belief.cluster).astype(np.int64)

    def expectations(self, belief: PointBelief, forest: Forest, since: int = 0) -> FloatArray:
        """The expectations of the diagrams of a forest, from number `since` on."""
        if belief.joint is None:
            return forest.under_product(self.offset, belief.marginals, since)
        return forest.under_joint(
            belief.joint, belief.ways, self.offset, belief.marginals, self.table, since
        )

    # -- what follows ----------------------------------------------------------------------------

    def follow(self, belief: PointBelief, action: int) -> tuple[float, list[Follow | None]]:
        """The expected reward of an action, and what follows under each outcome, None being impossible."""
        table = self.tables(belief.seen, action)
        numbers = self.expectations(belief, table.forest)
        found = [self._follow(belief, table.step, part, numbers) for part in table.outcomes]
        return float(numbers[0]), found

    def _follow(
        self, belief: PointBelief, step: Step, part: OutcomeTable, numbers: FloatArray
    ) -> Follow | None:
        probability = float(numbers[part.likelihood])
        if not probability > 0.0:
            return None
        after = belief.marginals.copy()
        if len(part.entries):
            fresh = numbers[part.roots]
            totals = np.add.reduceat(fresh, part.groups)
            if not (totals > 0).all():
                return None  # an impossible outcome whose probability is a rounding error
            after[part.entries] = fresh / np.repeat(totals, part.sizes)
        then = part.outcome.seen
        projected = PointBelief(then, after)
        known = np.concatenate([self._known(belief.marginals), self._known(after)]).tobytes()
        if not belief.cluster and self._is_product(part, known):
            return Follow(probability, projected, True)
        exact = None
        try:
            if belief.cluster or known not in part.crowded:
                exact = self._joint(belief, step, part.outcome)
                return None if exact is None else Follow(exact[0], exact[1], True)
        except TooLarge:
            if not belief.cluster:
                part.crowded.add(known)
        self.projections += 1
        return Follow(probability, projected, False)

    def _known(self, marginals: FloatArray) -> npt.NDArray[np.bool_]:
        """Whether each hidden feature has one value."""
        if not len(self.groups):
            return np.empty(0, dtype=np.bool_)
        result: npt.NDArray[np.bool_] = np.add.reduceat((marginals > 0).astype(np.int64), self.groups) == 1
        return result

    def _is_product(self, part: OutcomeTable, known: bytes) -> bool:
        """Whether what follows a product is the product of its marginals; `known` features now and next."""
        if known not in part.product:
            before, after = np.frombuffer(known, dtype=np.bool_).reshape(2, -1)
            part.product[known] = self._unconnected(part, before, after)
        return part.product[known]

    def _unconnected(
        self, part: OutcomeTable, before: npt.NDArray[np.bool_], after: npt.NDArray[np.bool_]
    ) -> bool:
        groups: list[set[int]] = []
        for scope in part.scopes:
            one = {t for t in scope if not (after[t // 2] if t % 2 else before[t // 2])}
            joins = [group for group in groups if group & one]
            groups = [group for group in groups if not group & one]
            groups.append(one.union(*joins))
        return all(sum(t % 2 for t in group) <= 1 for group in groups)

    # -- joint distributions ---------------------------------------------------------------------

    def _fits(self, diagram: Diagram) -> Diagram:
        if node_count(diagram) > self.cluster_nodes:
            raise TooLarge
        return diagram

    def factors(self, belief: PointBelief) -> Iterator[Factor]:
        """The belief as factors over the present variables."""
        manager, symbolic = self.pomdp.manager, self.pomdp.symbolic
        for k in self.pomdp.hidden:
            level = symbolic.now(k)
            if level in belief.cluster:
                continue
            begin = int(self.offset[level])
            values = belief.marginals[begin : begin + manager.sizes[level]]
            parts = [manager.constant(float(value), FLOAT) for value in values]
            yield Factor(manager.variable(level, parts), frozenset([level]))
        if belief.diagram is not None:
            yield Factor(belief.diagram, frozenset(belief.cluster))

    def _joint(self, belief: PointBelief, step: Step, outcome: Outcome) -> tuple[float, PointBelief] | None:
        """The probability of an outcome and the belief that follows, by variable elimination."""
        pomdp, symbolic = self.pomdp, self.pomdp.symbolic
        live = list(self.factors(belief))
        for k in step.changed:
            weights = step.weights[outcome.seen, k]
            whole = self._fits(pomdp.branch(symbolic.next(k), weights))
            live.append(Factor(whole, frozenset(support(whole)) | {symbolic.next(k)}))
        live += [Factor(part, frozenset(support(part))) for part in outcome.parts]
        live = eliminate(live, {symbolic.now(k) for k in step.changed}, self._fits)
        levels = {symbolic.next(k): symbolic.now(k) for k in step.changed}
        moved = [
            Factor(move(f.diagram, levels), frozenset(levels.get(level, level) for level in f.scope))
            for f in live
        ]
        return self._finished(outcome.seen, moved)

    def _finished(self, seen: Seen, factors: list[Factor]) -> tuple[float, PointBelief] | None:
        """The belief proportional to a product of factors over the present variables, and their sum."""
        marginals = np.zeros(self.entries)
        chance = 1.0
        correlated: list[Factor] = []
        for factor in joined(factors, self._fits):
            if not factor.scope:
                chance *= float(factor.diagram.value)
                continue
            total = factor.sums.total
            chance *= total
            if not chance > 0.0:
                return None
            fixed: dict[int, int] = {}
            rest = []
            for level in sorted(factor.scope):
                begin, size = int(self.offset[level]), self.pomdp.manager.sizes[level]
                one = factor.sums.marginal(level)
                one = np.maximum(one, 0.0)
                one /= one.sum()
                marginals[begin : begin + size] = one
                if np.count_nonzero(one) == 1:
                    fixed[level] = int(one.argmax())
                elif level in support(factor.diagram):
                    rest.append(level)
            if len(rest) > 1:
                correlated.append(Factor(restrict(factor.diagram, fixed), frozenset(rest)))
        if not chance > 0.0:
            return None
        if not correlated:
            return chance, PointBelief(seen, marginals)
        scope = frozenset().union(*(factor.scope for factor in correlated))
        product = reduce(lambda a, b: self._fits(a * b), [self._scaled(f) for f in correlated])
        return chance, self._clustered(seen, marginals, product, scope)

    def _scaled(self, factor: Factor) -> Diagram:
        """A factor with the sum 1 over its scope, its leaves rounded."""
        total = Factor(factor.diagram, factor.scope).sums.total
        factor.diagram.manager.safe_point()
        walk = Walk(factor.diagram)
        values = walk.leaf_payloads().view(np.float64) / total
        rounded = (rounded_bits(values) << KEPT_BITS).view(np.float64)
        return self._fits(walk.with_leaves(rounded, FLOAT))

    def _clustered(
        self, seen: Seen, marginals: FloatArray, diagram: Diagram, scope: frozenset[int]
    ) -> PointBelief:
        cluster = tuple(sorted(scope))
        joint = Forest(self.pomdp.manager)
        joint.add(diagram)
        sizes = [size if level in scope else 1 for level, size in enumerate(self.pomdp.manager.sizes)]
        ways = np.concatenate([np.cumprod([1.0, *sizes]), [1.0]])
        return PointBelief(seen, marginals, cluster, diagram, joint, ways)

    # -- beliefs that others track ---------------------------------------------------------------

    def of_factors(self, factors: Sequence[Factor]) -> PointBelief:
        """A belief given as factors over the present variables, those of observed features known.

        Raises:
            LimitReached: too many nodes.
        """
        known: dict[int, int] = {}
        for i in self.pomdp.observed:
            level = self.pomdp.symbolic.now(i)
            owner = next(factor for factor in factors if level in factor.scope)
            known[level] = int(owner.sums.marginal(level).argmax())
        rest = [restricted(factor, known) for factor in factors]
        seen = tuple(known[self.pomdp.symbolic.now(i)] for i in self.pomdp.observed)
        try:
            found = self._finished(seen, [factor for factor in rest if factor.scope])
        except TooLarge:
            raise LimitReached(
                f"a belief has more than {self.cluster_nodes:,} nodes as one diagram", "belief"
            ) from None
        assert found is not None, "beliefs sum to 1"
        return found[1]

    def of_marginals(self, marginals: Mapping[str, FloatArray]) -> PointBelief:
        """The product of the distributions of the features [name]."""
        features = self.pomdp.features
        seen = tuple(int(np.argmax(marginals[features[i].name])) for i in self.pomdp.observed)
        parts = [np.asarray(marginals[features[k].name], dtype=np.float64) for k in self.pomdp.hidden]
        return PointBelief(seen, np.concatenate([np.empty(0), *(part / part.sum() for part in parts)]))

    def corner(self, state: Sequence[int]) -> PointBelief:
        """The belief that is sure of a state, given by its value at each level."""
        symbolic = self.pomdp.symbolic
        marginals = np.zeros(self.entries)
        for level in self.levels.tolist():
            marginals[self.offset[level] + int(state[level])] = 1.0
        return PointBelief(tuple(int(state[symbolic.now(i)]) for i in self.pomdp.observed), marginals)

    # -- the start -------------------------------------------------------------------------------

    def starts(
        self, rows: Mapping[int, RowDiagram] | None = None, most: int = STARTS
    ) -> list[tuple[float, PointBelief]]:
        """The initial belief: the probability of each value of what is seen, and the belief there.

        Mass at terminal states is left out.  `rows`, over next variables, take the place of the model's.

        Raises:
            LimitReached: the initial belief is too large, or has too many values of what is seen.
        """
        pomdp, symbolic = self.pomdp, self.pomdp.symbolic
        initial = symbolic.initial if rows is None else rows
        levels = {symbolic.next(i): symbolic.now(i) for i in initial}
        found: list[tuple[float, PointBelief]] = []
        alive = pomdp.numbers.shift(pomdp.live)

        def extend(places: Sequence[int], fixed: dict[int, int], live: list[Diagram]) -> None:
            if any(diagram == pomdp.zero for diagram in live):
                return
            if places:
                i, *rest = places
                for v in range(len(initial[i].rows[0])):
                    now = {**fixed, symbolic.next(i): v}
                    part = pomdp.chance(initial[i], v)
                    extend(
                        rest,
                        now,
                        [restrict(d, {symbolic.next(i): v}) for d in [*live, restrict(part, fixed)]],
                    )
                return
            if len(found) >= most:
                raise LimitReached(
                    f"at the start more than {most:,} values may be seen of "
                    f"{', '.join(pomdp.features[i].name for i in pomdp.observed)}; "
                    "solving on diagrams lists them",
                    "initial belief",
                )
            factors = [Factor(d, frozenset(support(d))) for d in live]
            for k in pomdp.hidden:
                parts = [
                    restrict(pomdp.chance(initial[k], v), fixed) for v in range(len(initial[k].rows[0]))
                ]
                whole = pomdp.branch(symbolic.next(k), parts)
                factors.append(Factor(whole, frozenset(support(whole)) | {symbolic.next(k)}))
            moved = [
                Factor(move(f.diagram, levels), frozenset(levels[level] for level in f.scope))
                for f in factors
            ]
            seen = tuple(fixed[symbolic.next(i)] for i in pomdp.observed)
            part_of_it = self._finished(seen, moved)
            if part_of_it is not None:
                found.append(part_of_it)

        try:
            extend(pomdp.observed, {}, [alive])
        except TooLarge:
            raise LimitReached(
                f"the initial belief has more than {self.cluster_nodes:,} nodes as a diagram",
                "initial belief",
            ) from None
        return found
