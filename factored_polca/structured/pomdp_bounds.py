"""The first bounds of a partially observed model, as diagrams over the whole state.

*Lower.*  A blind policy repeats one action.  From a constant below every return,

    alpha <- max(alpha, R_a + discount * R_a[alpha]),

each iterate being a lower bound of what the policy earns from each state (Hauskrecht 1997; Smith & Simmons
2005), so that one may stop at any time.

*Upper.*  If the state were seen after each action (QMDP; Littman, Cassandra & Kaelbling 1995) one could earn

    Q_a = R_a + discount * R_a[V],     V <- min(V, max over a of Q_a),

from a constant V above every return on; again each iterate is a bound.  If it were seen one step late (the
fast informed bound; Hauskrecht 2000), for one y at a time,

    Q_a(y, .) <- R_a + discount * sum over outcomes o of max over a' of R_a[W_o Q_a'(y', .)].

Both hold with rounding: what an iterate may be off by is added to, or taken from, each leaf.  Leaves are
merged upwards in upper bounds, and downwards in lower ones.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Final

from factored_polca.diagrams import FLOAT, Diagram, apply, choose, leaves, node_count
from factored_polca.structured.pomdp_model import UNIT, FactoredPOMDP, largest
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
        ends = symbolic.terminal != pomdp.manager.constant(0)
        least, most = min(values), max(values)
        if ends:
            least, most = min(least, 0.0), max(most, 0.0)
        margin = 1 + 64 * UNIT / (1 - pomdp.discount)
        self.size = max(abs(least), abs(most)) / (1 - pomdp.discount) * margin
        slack = 64 * UNIT * self.size
        self.floor = least / (1 - pomdp.discount) - slack
        self.ceiling = most / (1 - pomdp.discount) + slack
        self._error = [self._rounding(a) for a in range(pomdp.actions)]
        self._kinds = self._equal_dynamics()

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
        kind = self._kinds[action]
        if kind not in regressed:
            after = pomdp.numbers.regress(action, value)
            regressed[kind] = after * pomdp.manager.constant(pomdp.discount, FLOAT)
        error = pomdp.manager.constant(sign * self._error[action], FLOAT)
        total = pomdp.reward(action) + regressed[kind] + error
        return choose(pomdp.symbolic.terminal, pomdp.zero, total)

    # -- lower -----------------------------------------------------------------------------------

    def blind(self, deadline: float) -> list[tuple[int, Diagram]]:
        """An alpha-vector for each action, of all states, and that of the constant as long as time is short."""
        pomdp = self.pomdp
        found: list[tuple[int, Diagram]] = []
        seen: list[Diagram] = []
        for action in range(pomdp.actions):
            alpha = choose(
                pomdp.symbolic.terminal, pomdp.zero, pomdp.manager.constant(self.floor, FLOAT)
            )
            twin = next(
                (
                    a
                    for a, _ in found
                    if self._kinds[a] == self._kinds[action] and pomdp.reward(a) == pomdp.reward(action)
                ),
                None,
            )
            if twin is not None:
                continue
            width = self.ceiling - self.floor
            for _ in range(SWEEPS):
                self.poll()
                if time.monotonic() > deadline and found:
                    break
                width = max(self.sizes.width, width * pomdp.discount / 4)
                next_alpha = apply("maximum", alpha, self.backed_up(action, alpha, {}, -1.0))
                next_alpha = apply("maximum", alpha, self.merged(next_alpha, width * 0.01, "down"))
                change = largest(next_alpha - alpha)
                alpha = next_alpha
                if change <= self.sizes.width:
                    break
            if all(alpha != other for other in seen):
                found.append((action, alpha))
                seen.append(alpha)
        return found

    # -- upper -----------------------------------------------------------------------------------

    def qmdp(self, deadline: float) -> list[Diagram]:
        """Q_a for each action: bounds of the optimal value of beginning with it."""
        pomdp = self.pomdp
        value = choose(pomdp.symbolic.terminal, pomdp.zero, pomdp.manager.constant(self.ceiling, FLOAT))
        for _ in range(SWEEPS):
            self.poll()
            if time.monotonic() > deadline:
                break
            regressed: dict[int, Diagram] = {}
            best = reduce(
                lambda a, b: apply("maximum", a, b),
                (self.backed_up(a, value, regressed, 1.0) for a in range(pomdp.actions)),
            )
            lower = apply("minimum", value, best)
            change = largest(value - lower)
            lower = self.merged(lower, min(change / 4, self.sizes.width * 50) if change else 0.0, "up")
            lower = apply("minimum", value, lower)
            if lower == value:
                break
            value = lower
            if change <= self.sizes.width:
                break
        regressed = {}
        return [
            self.merged(self.backed_up(a, value, regressed, 1.0), self.sizes.width, "up")
            for a in range(pomdp.actions)
        ]
