"""The first bounds of a partially observed model, as diagrams over the whole state.

*Lower.*  A blind policy repeats one action.  From a constant below every return,

    alpha <- max(alpha, R_a + discount * R_a[alpha]),

each iterate being a lower bound of what the policy earns from each state (Hauskrecht 1997; Smith & Simmons
2005), so that one may stop at any time.

*Upper.*  If the state were seen after each action (QMDP; Littman, Cassandra & Kaelbling 1995) one could
earn

    Q_a = R_a + discount * R_a[V],     V <- min(V, max over a of Q_a),

from a constant V above every return on; again each iterate is a bound.

Without terminal states a bound may be moved by a constant: with d the least (largest) value of H V - V,
V + d / (1 - discount) is a lower (upper) bound too (MacQueen 1966), and fulfils the same inequality.

Both hold with rounding: what an iterate may be off by is added to, or taken from, each leaf.  Leaves are
merged upwards in upper bounds, and downwards in lower ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from typing import Final

from factored_polca.diagrams import (
    FLOAT,
    Aborted,
    Diagram,
    Manager,
    MemoryLimit,
    apply,
    choose,
    leaves,
    node_count,
)
from factored_polca.structured.pomdp_model import UNIT, FactoredPOMDP
from factored_polca.structured.rounding import Direction, round_leaves, round_to_size

SWEEPS: Final = 2_000
"""Iterations of a bound."""

Poll = Callable[[], None]


@dataclass(frozen=True)
class Sizes:
    """How large diagrams may grow: nodes of one, and the width within which leaves are merged."""

    nodes: int
    width: float


class FirstBounds:
    """The bounds of a model; see the module's docstring."""

    def __init__(self, pomdp: FactoredPOMDP, sizes: Sizes, poll: Poll) -> None:
        self.pomdp, self.sizes, self.poll = pomdp, sizes, poll
        symbolic = pomdp.symbolic
        values = [float(v) for a in range(pomdp.actions) for v in leaves(pomdp.reward(a))]
        self.ends = symbolic.terminal != pomdp.manager.constant(0)
        least, most = min(values), max(values)
        if self.ends:
            least, most = min(least, 0.0), max(most, 0.0)
        margin = 1 + 64 * UNIT / (1 - pomdp.discount)
        self.size = max(abs(least), abs(most)) / (1 - pomdp.discount) * margin
        slack = 64 * UNIT * self.size
        self.floor = least / (1 - pomdp.discount) - slack
        self.ceiling = most / (1 - pomdp.discount) + slack
        self.errors = [self._rounding(a) for a in range(pomdp.actions)]
        self.kinds = self._equal_dynamics()

    def _rounding(self, action: int) -> float:
        compiled = self.pomdp.symbolic.actions[action]
        features = self.pomdp.features
        steps = sum(len(features[k].values) + 2 for k in compiled.rows) + len(compiled.rewards)
        return (4 * steps + 32) * UNIT * self.size

    def _equal_dynamics(self) -> list[int]:
        """For each action the first one with the same transitions."""
        known: dict[tuple[tuple[int, int], ...], int] = {}
        found = []
        for a, action in enumerate(self.pomdp.symbolic.actions):
            key = tuple(sorted((k, id(row.diagram)) for k, row in action.rows.items()))
            rows = tuple((k, id(action.rows[k].rows)) for k, _ in key)
            found.append(known.setdefault((*key, *rows), a))
        return found

    def merged(self, diagram: Diagram, width: float, direction: Direction) -> Diagram:
        """A diagram with leaves merged, and small enough."""
        rounded = round_leaves(diagram, width, direction).diagram
        if node_count(rounded) > self.sizes.nodes:
            rounded = round_to_size(
                diagram, nodes=self.sizes.nodes, width=width, direction=direction
            ).diagram
        return rounded

    def backed_up(self, action: int, value: Diagram, regressed: dict[int, Diagram], sign: float) -> Diagram:
        """R_a + discount * R_a[V], moved by the rounding error to the side of `sign`, 0 where terminal."""
        pomdp = self.pomdp
        kind = self.kinds[action]
        if kind not in regressed:
            after = pomdp.numbers.regress(action, value)
            regressed[kind] = after * pomdp.manager.constant(pomdp.discount, FLOAT)
        error = pomdp.manager.constant(sign * self.errors[action], FLOAT)
        total = pomdp.reward(action) + regressed[kind] + error
        return choose(pomdp.symbolic.terminal, pomdp.zero, total)

    # -- lower -----------------------------------------------------------------------------------

    def shift(self, difference: float) -> float:
        """What may be added to V where H V - V has this extreme: difference / (1 - discount).

        Terminal states stay at 0: with them a bound is never moved closer.
        """
        return difference / (1 - self.pomdp.discount)

    def constant(self, value: float) -> Diagram:
        """A value at every state that is not terminal."""
        pomdp = self.pomdp
        return choose(pomdp.symbolic.terminal, pomdp.zero, pomdp.manager.constant(value, FLOAT))

    def blind(self, deadline: float) -> list[tuple[int, Diagram]]:
        """An alpha-vector for each action, over all states; of the first ones only where time is short."""
        pomdp = self.pomdp
        found: list[tuple[int, Diagram]] = []
        for action in range(pomdp.actions):
            if found and time.monotonic() > deadline:
                break
            twins = (a for a, _ in found if self.kinds[a] == self.kinds[action])
            if any(pomdp.reward(a) == pomdp.reward(action) for a in twins):
                continue
            alpha = self.constant(self.floor)
            with limited(pomdp.manager, deadline):
                alpha = self._repeat(action, alpha)
            if all(alpha != other for _, other in found):
                found.append((action, alpha))
        return found

    def _repeat(self, action: int, alpha: Diagram) -> Diagram:
        """Better and better bounds of what an action earns for ever, until little changes or time is up."""
        width = self.ceiling - self.floor
        try:
            for _ in range(SWEEPS):
                self.poll()
                width = max(self.sizes.width, width * self.pomdp.discount / 4)
                after = self.backed_up(action, alpha, {}, -1.0)
                least, most = extremes(after - alpha)
                if not self.ends and least > 0:
                    lifted = self.shift(least - 64 * UNIT * self.size)
                    alpha = self.pomdp.shifted_by(alpha, max(0.0, lifted))
                    after = self.pomdp.shifted_by(after, max(0.0, lifted * self.pomdp.discount))
                before, alpha = alpha, apply("maximum", alpha, self.merged(after, width * 0.01, "down"))
                if alpha == before or most - (0 if self.ends else least) <= self.sizes.width:
                    break
        except (Aborted, MemoryLimit):
            self.poll()
        return alpha

    # -- upper -----------------------------------------------------------------------------------

    def qmdp(self, deadline: float) -> list[Diagram]:
        """Q_a for each action: bounds of the optimal value of beginning with it.

        Where time or memory ends it before any are there, those of the constant bound.
        """
        quality = [self.constant(self.ceiling)] * self.pomdp.actions
        value = quality[0]
        with limited(self.pomdp.manager, deadline):
            try:
                for _ in range(SWEEPS):
                    self.poll()
                    regressed: dict[int, Diagram] = {}
                    backed = [self.backed_up(a, value, regressed, 1.0) for a in range(self.pomdp.actions)]
                    best = reduce(lambda a, b: apply("maximum", a, b), backed)
                    least, most = extremes(best - value)
                    quality = backed
                    if not self.ends and most < 0:
                        moved = self.shift(most + 64 * UNIT * self.size)
                        by = min(0.0, moved)
                        value = self.pomdp.shifted_by(value, by)
                        best = self.pomdp.shifted_by(best, by * self.pomdp.discount)
                        quality = [self.pomdp.shifted_by(q, by * self.pomdp.discount) for q in backed]
                    change = -least if self.ends else most - least
                    lower = apply("minimum", value, best)
                    lower = self.merged(lower, max(0.0, min(change / 4, self.sizes.width * 50)), "up")
                    lower = apply("minimum", value, lower)
                    if lower == value or change <= self.sizes.width:
                        break
                    value = lower
            except (Aborted, MemoryLimit):
                self.poll()
        return [self.merged(q, self.sizes.width, "up") for q in quality]


def extremes(diagram: Diagram) -> tuple[float, float]:
    """The least and the largest value of a float diagram."""
    values = [float(value) for value in leaves(diagram)]
    return min(values), max(values)


@contextmanager
def limited(manager: Manager, deadline: float) -> Iterator[None]:
    """Inside, the manager's operations end at a deadline, if not before."""
    before = manager.deadline
    manager.deadline = deadline if before is None else min(before, deadline)
    try:
        yield
    finally:
        manager.deadline = before
