"""Beliefs as decision diagrams over the state: exact, and without a partition.

A belief is a product of *factors*, diagrams over features of their own: as long as parts of the state are
independent nothing multiplies them out.  With L_i(x, x') = P_a(x_i' | parents) for the features i that
action a changes, the channels' factors w_j(x, x') = P_a(o_j | x', x) at the values received, and b_f,

    b'(x') = sum over x_i, i changed, of  prod_f b_f(x) prod_i L_i prod_j w_j    (then normalised).

Features that a does not change need no copy: wherever x_i' is read, x_i stands in its place.  An
observed feature is fixed to what is seen, and a factor by itself.  The present variables are summed out
one by one, that one first whose factors together test the fewest variables; factors that do not read it
wait (variable elimination, `factored_polca.symbolic.elimination`).  What
is left is multiplied together where it shares variables.

Sums in another order differ in their last bits, and a diagram tells such numbers apart.  So leaves that
are within `MERGED` of their neighbour, relatively, become one: states keep their beliefs up to a
relative error of a few times `MERGED` a step, while the diagram stays as small as the belief's structure.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt

from factored_polca.control.received import Received
from factored_polca.control.tracker import (
    NODE_LIMIT,
    TIE,
    Belief,
    FloatArray,
    OnImpossible,
    Rows,
    Tracker,
    limited_memory,
)
from factored_polca.diagrams import (
    FLOAT,
    Diagram,
    MemoryLimit,
    choose,
    cofactors,
    evaluate_states,
    leaves,
    move,
    node_count,
    relabel,
    states_for_leaves,
    support,
)
from factored_polca.minimisation import Partition
from factored_polca.models import LimitReached, ModelError, Value
from factored_polca.symbolic import NumericView, RowDiagram, SymbolicModel
from factored_polca.symbolic.elimination import eliminate, joined
from factored_polca.symbolic.factors import Factor, mass, merge, push_down, restricted

BYTES_PER_NODE: Final = 1_000
"""Room that an operation may take for each node of the limit: results, tables, what comes between."""


class DiagramTracker(Tracker):
    """Tracks the belief in each state as a product of diagrams; each has at most `node_limit` nodes."""

    kind: ClassVar[Literal["diagram"]] = "diagram"
    guarantee: ClassVar[Literal["exact"]] = "exact"

    def __init__(
        self,
        symbolic: SymbolicModel,
        *,
        node_limit: int = NODE_LIMIT,
        on_impossible: OnImpossible = "error",
    ) -> None:
        super().__init__(symbolic, on_impossible)
        self.node_limit = node_limit
        self.manager = symbolic.manager
        self.numbers = NumericView(symbolic)
        self.zero = self.manager.constant(0.0, FLOAT)
        self.one = self.manager.constant(1.0, FLOAT)
        self._effects: dict[tuple[int, int], tuple[Factor, list[Factor]]] = {}
        self._channels: dict[tuple[int, int, int], Factor] = {}

    def begin(self, initial: Rows, received: Received, *, narrow: bool = False) -> DiagramBelief:
        next_of = self.symbolic.next
        with self.limited():
            live = []
            for i, row in initial.items():
                parts = [self._chance(row, v) for v in range(len(row.rows[0]))]
                live.append(self._scoped(self.branch(next_of(i), parts), next_of(i)))
            return self.finish(live, initial, received)

    def step(self, belief: DiagramBelief, received: Received) -> DiagramBelief:
        """The belief after one action; see the module's docstring."""
        symbolic, action = self.symbolic, received.action
        changed = symbolic.actions[action].rows
        told = dict(zip(self.reader.observed, received.seen, strict=True))
        with self.limited():
            live = list(belief.factors)
            for i in changed:
                whole, parts = self.effect(action, i)
                live.append(parts[told[i]] if i in told else whole)
            sensed = zip(self.reader.sensed[action], received.values, strict=True)
            live += [self.channel(action, j, value) for j, value in sensed]
            fixed = {symbolic.next(i): value for i, value in told.items() if i in changed}
            live = [restricted(factor, fixed) for factor in live]
            live = eliminate(live, {symbolic.now(i) for i in changed}, self._fits)
            return self.finish(live, changed, received)

    def finish(self, live: list[Factor], changed: Collection[int], received: Received) -> DiagramBelief:
        """The belief proportional to the product of `live`, only what is as seen kept.

        `live` are over the next variables of `changed` features and the present ones of the others.
        """
        symbolic, manager = self.symbolic, self.manager
        levels = {symbolic.next(i): symbolic.now(i) for i in changed}
        moved = [
            Factor(move(f.diagram, levels), frozenset(levels.get(level, level) for level in f.scope))
            for f in live
        ]
        told = zip(self.reader.observed, received.seen, strict=True)
        fixed = {symbolic.now(i): value for i, value in told}
        factors = joined([restricted(f, fixed) for f in moved], self._fits)
        for level, value in fixed.items():
            known = choose(manager.indicator(level, [value]), self.one, self.zero)
            factors.append(Factor(known, frozenset([level])))
        wrong = ~symbolic.terminal if received.ended else symbolic.terminal
        if mass(wrong, factors):
            right = choose(wrong, self.zero, self.one)
            factors = joined([*factors, self._scoped(right)], self._fits)
        chance = 1.0
        normalised: list[Factor] = []
        for factor in factors:
            chance *= factor.sums.total
            if not chance > 0:
                raise self.impossible(received)
            normalised += self._normalised(factor)
        return DiagramBelief(
            tracker=self, likelihood=chance, ended=received.ended, factors=tuple(normalised)
        )  # fmt: skip

    def _normalised(self, factor: Factor) -> Iterator[Factor]:
        """A factor with the sum 1, what it does not test being factors of their own."""
        tested = frozenset(support(factor.diagram))
        scale = factor.sums.total
        for level in sorted(factor.scope - tested):
            size = self.manager.sizes[level]
            scale /= size
            yield Factor(self.manager.constant(1 / size, FLOAT), frozenset([level]))
        if tested:
            yield Factor(self._fits(merge(factor.diagram, scale)), tested)

    # -- factors ---------------------------------------------------------------------------------

    def branch(self, level: int, parts: Sequence[Diagram]) -> Diagram:
        """parts[v] where the variable at `level` has its value v; parts may test levels above."""
        result = parts[-1]
        for value, part in enumerate(parts[:-1]):
            result = choose(self.manager.indicator(level, [value]), part, result)
        return result

    def _scoped(self, diagram: Diagram, *levels: int) -> Factor:
        return Factor(self._fits(diagram), frozenset(support(diagram)) | set(levels))

    def _chance(self, row: RowDiagram, value: int) -> Diagram:
        """P(value | parents) of a row diagram."""
        return relabel(row.diagram, np.array([float(r[value]) for r in row.rows]), FLOAT)

    def _same(self, diagram: Diagram, action: int) -> Diagram:
        """A function of (x, x') with x_i in place of x_i' for features that the action leaves alone."""
        symbolic = self.symbolic
        tested = support(diagram)
        for i in range(len(symbolic.order)):
            if symbolic.next(i) in tested and i not in symbolic.actions[action].rows:
                diagram = self.branch(symbolic.now(i), cofactors(diagram, symbolic.next(i)))
        return diagram

    def effect(self, action: int, feature: int) -> tuple[Factor, list[Factor]]:
        """L_i, and L_i at each value of x_i'."""
        key = (action, feature)
        if key not in self._effects:
            parts = [self._same(part, action) for part in self.numbers.weights(action, feature)]
            level = self.symbolic.next(feature)
            whole = self._scoped(self.branch(level, parts), level)
            self._effects[key] = (whole, [self._scoped(part) for part in parts])
        return self._effects[key]

    def channel(self, action: int, channel: int, value: int) -> Factor:
        """P_a(o_j = value | x', x)."""
        key = (action, channel, value)
        if key not in self._channels:
            row = self.symbolic.actions[action].observations[channel]
            self._channels[key] = self._scoped(self._same(self._chance(row, value), action))
        return self._channels[key]

    # -- limits ----------------------------------------------------------------------------------

    def _fits(self, diagram: Diagram) -> Diagram:
        if node_count(diagram) > self.node_limit:
            raise LimitReached(
                f"a belief, or what comes between two, has more than {self.node_limit:,} nodes; "
                "raise node_limit or track particles",
                "tracking",
            )
        return diagram

    @contextmanager
    def limited(self) -> Iterator[None]:
        """Inside, the manager grows by what `node_limit` nodes need at most."""
        try:
            with limited_memory(self.manager, BYTES_PER_NODE * self.node_limit):
                yield
        except MemoryLimit as error:
            raise LimitReached(f"a belief as a diagram outgrew its memory: {error}", "tracking") from None


@dataclass(frozen=True, eq=False, kw_only=True)
class DiagramBelief(Belief):
    """A belief as a product of `factors` that sum to 1 and share no variables, of which they have all."""

    tracker: DiagramTracker
    factors: tuple[Factor, ...]

    @property
    def nodes(self) -> int:
        """The nodes of its diagrams."""
        return sum(node_count(factor.diagram) for factor in self.factors)

    def advance(self, received: Received) -> DiagramBelief:
        return self.tracker.step(self, received)

    def at(self, states: npt.NDArray[Any]) -> FloatArray:
        """The belief in each state, value numbers [state, feature]."""
        columns = self.tracker.symbolic.columns()
        result = np.ones(len(states))
        for factor in self.factors:
            result *= evaluate_states(factor.diagram, states, columns).view(np.float64)
        return result

    def project(self, partition: Partition) -> FloatArray:
        masses = push_down(partition.diagram, self.factors)
        if masses[partition.blocks :].any():
            raise ModelError("the partition leaves out states that the belief holds possible")
        return masses[: partition.blocks]

    def probability(self, condition: Diagram) -> float:
        return mass(condition, self.factors)

    def support_in(self, condition: Diagram) -> bool:
        return mass(~condition, self.factors) == 0.0

    def marginals(self) -> dict[str, FloatArray]:
        symbolic = self.tracker.symbolic
        at = {symbolic.now(i): feature.name for i, feature in enumerate(symbolic.model.features)}
        found = {at[level]: f.sums.marginal(level) for f in self.factors for level in f.scope}
        return {feature.name: found[feature.name] for feature in symbolic.model.features}

    def most_likely(self) -> dict[str, Value]:
        digits = np.zeros(self.tracker.manager.leaf_level, dtype=np.int64)
        for factor in self.factors:
            values = np.array(leaves(factor.diagram))
            states = states_for_leaves(factor.diagram)[values >= (1 - TIE) * values.max()]
            levels = sorted(factor.scope)
            digits[levels] = states[np.lexsort(states.T[::-1])[0]][levels]
        return self.tracker.state(digits[self.tracker.symbolic.now_levels])


def try_history(tracker: DiagramTracker, history: Sequence[Received]) -> int:
    """The most nodes of the beliefs along a history.

    Raises:
        LimitReached: there are more nodes than the tracker may have.
    """
    first, *rest = history
    belief = tracker.begin(tracker.symbolic.initial, first)
    largest = belief.nodes
    for received in rest:
        belief = tracker.step(belief, received)
        largest = max(largest, belief.nodes)
    return largest
