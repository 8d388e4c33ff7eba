"""The first bounds of `pomdp_bounds` on tables over the whole state, where these are small enough.

The iterations are the same; only at the end do the tables become diagrams, their leaves merged.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from math import prod

import numpy as np

from factored_polca.diagrams import Diagram, cofactors, support
from factored_polca.structured.pomdp_bounds import SWEEPS, FirstBounds
from factored_polca.structured.pomdp_cells import (
    CELLS,
    FloatArray,
    Table,
    TooManyCells,
    eliminate,
    merged_diagram,
    table_of,
)
from factored_polca.structured.pomdp_model import UNIT


class CellBounds:
    """Blind policies and QMDP on tables.

    Raises:
        TooManyCells: the states are too many for a table, or a table on the way is too large.
    """

    def __init__(self, first: FirstBounds) -> None:
        self.first, self.pomdp = first, first.pomdp
        symbolic = self.pomdp.symbolic
        features = range(len(symbolic.model.features))
        self.axes = tuple(sorted(symbolic.now(i) for i in features))
        self.shape = tuple(self.pomdp.manager.sizes[axis] for axis in self.axes)
        if prod(self.shape) > CELLS:
            raise TooManyCells
        self.live = table_of(self.pomdp.live, self.axes).values > 0
        self.rewards = [table_of(self.pomdp.reward(a), self.axes).values for a in range(self.pomdp.actions)]
        self.weights = [self._weights(a) for a in range(self.pomdp.actions)]

    def _weights(self, action: int) -> dict[int, Table]:
        """The distributions of the features that an action changes, by their next levels."""
        symbolic, pomdp = self.pomdp.symbolic, self.pomdp
        compiled = symbolic.actions[action]
        found = {}
        for i in compiled.elimination:
            if i not in compiled.rows:
                continue
            whole = pomdp.branch(symbolic.next(i), pomdp.numbers.weights(action, i))
            tested = set(support(whole))
            for j in range(len(symbolic.model.features)):
                if symbolic.next(j) in tested and j not in compiled.rows:
                    whole = pomdp.branch(symbolic.now(j), cofactors(whole, symbolic.next(j)))
            axes = sorted({*support(whole), symbolic.next(i)})
            found[symbolic.next(i)] = table_of(whole, axes)
        return found

    def backed_up(
        self, action: int, value: FloatArray, regressed: dict[int, FloatArray], sign: float
    ) -> FloatArray:
        """R_a + discount * R_a[V], moved by the rounding error to the side of `sign`, 0 where terminal."""
        kind = self.first.kinds[action]
        if kind not in regressed:
            weights = self.weights[kind]
            moved = {level - 1: level for level in weights}
            synchronic = self.pomdp.symbolic.actions[kind].synchronic
            after = eliminate(Table(self.axes, value).moved(moved), weights, synchronic)
            regressed[kind] = np.broadcast_to(after.over(self.axes), self.shape)
        error = sign * self.first.errors[action]
        found = self.rewards[action] + self.pomdp.discount * regressed[kind] + error
        return np.where(self.live, found, 0.0)

    def blind(self, deadline: float) -> list[tuple[int, Diagram]]:
        """See `FirstBounds.blind`."""
        first = self.first
        found: list[tuple[int, Diagram]] = []
        known: list[FloatArray] = []
        for action in range(self.pomdp.actions):
            if found and time.monotonic() > deadline:
                break
            alpha = np.where(self.live, first.floor, 0.0)
            for _ in range(SWEEPS):
                first.poll()
                after = self.backed_up(action, alpha, {}, -1.0)
                difference = after - alpha
                least, most = float(difference.min()), float(difference.max())
                if not first.ends and least > 0:
                    lifted = max(0.0, first.shift(least - 64 * UNIT * first.size))
                    alpha, after = alpha + lifted, after + lifted * self.pomdp.discount
                alpha = np.maximum(alpha, after)
                wide = most - (0 if first.ends else least)
                if wide <= first.sizes.width or time.monotonic() > deadline:
                    break
            if any(np.array_equal(alpha, other) for other in known):
                continue
            known.append(alpha)
            found.append((action, self._diagram(alpha, "down")))
        return found

    def qmdp(self, deadline: float) -> list[Diagram]:
        """See `FirstBounds.qmdp`."""
        first = self.first
        value = np.where(self.live, first.ceiling, 0.0)
        actions = range(self.pomdp.actions)
        quality = [value for _ in actions]
        for _ in range(SWEEPS):
            first.poll()
            regressed: dict[int, FloatArray] = {}
            quality = [self.backed_up(a, value, regressed, 1.0) for a in actions]
            best = np.max(quality, axis=0)
            difference = best - value
            least, most = float(difference.min()), float(difference.max())
            if not first.ends and most < 0:
                by = min(0.0, first.shift(most + 64 * UNIT * first.size))
                value, best = value + by, best + by * self.pomdp.discount
                quality = [q + by * self.pomdp.discount for q in quality]
            lower = np.minimum(value, best)
            change = -least if first.ends else most - least
            if change <= first.sizes.width or np.array_equal(lower, value):
                break
            if time.monotonic() > deadline:
                break
            value = lower
        made: list[Diagram] = []
        for action in actions:
            twin = next((a for a in range(action) if np.array_equal(quality[a], quality[action])), None)
            made.append(self._diagram(quality[action], "up") if twin is None else made[twin])
        return made

    def _diagram(self, values: FloatArray, direction: str) -> Diagram:
        sizes = self.first.sizes
        found, _ = merged_diagram(
            self.pomdp.manager, Table(self.axes, values), sizes.width, sizes.nodes,
            "down" if direction == "down" else "up",
        )  # fmt: skip
        return found


def first_bounds(
    first: FirstBounds,
    blind_seconds: float,
    qmdp_seconds: float,
    keep: Callable[[list[tuple[int, Diagram]]], None],
) -> tuple[list[Diagram], bool]:
    """Q_a for each action, and whether tables were used; `keep` is given the blind alpha-vectors before."""
    try:
        cells = CellBounds(first)
        keep(cells.blind(time.monotonic() + blind_seconds))
        return cells.qmdp(time.monotonic() + qmdp_seconds), True
    except TooManyCells:
        keep(first.blind(time.monotonic() + blind_seconds))
        return first.qmdp(time.monotonic() + qmdp_seconds), False
