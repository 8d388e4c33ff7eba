"""The fast informed bound (Hauskrecht 2000) on tables: the first upper bound, tighter than QMDP.

With Q_a at first those of QMDP, and y, x, W_o as in `pomdp_model`,

    Q_a(y, x) <- min(Q_a(y, x),  R_a + discount * sum over o of max over a' of
                                 sum over x' of P(x' | x) W_o(x, x') Q_a'(y', x')).

QMDP lets the next action depend on the next state; here it may depend on what is observed only.  Each
iterate bounds Q*_a at the corners: the value of beginning with a is convex, so that it is at most the mean
of its values at the corners, and Q_a . b bounds it at any belief b.  So one may stop at any time, and a
pointwise minimum of two bounds is one.  Where nothing ends and each Q_a fell by d at least, each falls by
discount * d / (1 - discount) more (MacQueen 1966).  What rounding may be off by is added at each backup.

Actions with equal distributions of most features sum these out together.  A table has a cell for each value
of the hidden features, and one is kept for each action and each y that the start can reach.  Actions whose
Q_a is nowhere above that of another one are left out of the maximum.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import prod
from typing import Final

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import Diagram
from factored_polca.models import LimitReached
from factored_polca.structured.pomdp_bounds import SWEEPS, FirstBounds
from factored_polca.structured.pomdp_cells import (
    BETWEEN,
    CELLS,
    Table,
    TooManyCells,
    eliminate,
    merged_diagram,
    step_tables,
    table_of,
)
from factored_polca.structured.pomdp_model import UNIT, Seen

FloatArray = npt.NDArray[np.float64]

BATCH: Final = -1
"""The axis of a table that runs over actions a'."""

WORTH: Final = 1e-3
"""Sweeps go on while they may gain this share of the range of values."""

NUMBERS: Final = 1 << 24
"""Entries of all Q_a, at most."""

PLACES: Final = 2_000
"""Pairs of an action and a y, up to which the bound is computed."""


@dataclass(frozen=True, eq=False)
class Member:
    """An action: W_o of its outcomes, and what is summed out only after they are multiplied in."""

    action: int
    outcomes: list[Table]
    late: dict[int, Table]


@dataclass(frozen=True, eq=False)
class Group:
    """Actions at one y that lead to `then` and sum the same distributions, `early`, out of Q_a' first."""

    then: Seen
    changed: tuple[int, ...]
    synchronic: bool
    early: dict[int, Table]
    members: list[Member]


def _name(then: Seen, level: int, table: Table) -> tuple[object, ...]:
    """Equal for equal distributions."""
    return (then, level, table.axes, table.values.tobytes())


class InformedBound:
    """Q_a at each y that is met, from those of another bound on.

    Raises:
        TooManyCells: too many cells, or values of what is seen.
    """

    def __init__(self, first: FirstBounds, starts: Sequence[Seen], quality: Sequence[Diagram]) -> None:
        self.first, self.pomdp = first, first.pomdp
        pomdp = first.pomdp
        self.axes = tuple(sorted(pomdp.symbolic.now(k) for k in pomdp.hidden))
        self.shape = tuple(pomdp.manager.sizes[axis] for axis in self.axes)
        self.actions = range(pomdp.actions)
        self.seen = self._reached(starts)
        self.groups = {y: self._groups_at(y) for y in self.seen}
        self.live: dict[Seen, npt.NDArray[np.bool_]] = {}
        self.q: dict[Seen, FloatArray] = {}  # [y][action, cell...]
        for y in self.seen:
            self.live[y] = table_of(pomdp.at(y, pomdp.live), self.axes).values > 0
            self.q[y] = np.stack([table_of(pomdp.at(y, d), self.axes).values for d in quality])

    def _reached(self, starts: Sequence[Seen]) -> list[Seen]:
        """The values of what is seen that the start can lead to."""
        cells = prod(self.shape)
        found, waiting = dict.fromkeys(starts), list(starts)
        while waiting:
            y = waiting.pop()
            numbers = len(found) * cells * self.pomdp.actions
            if len(found) * cells > CELLS or len(found) * self.pomdp.actions > PLACES or numbers > NUMBERS:
                raise TooManyCells
            for action in self.actions:
                self.first.poll()
                for outcome in self.pomdp.step(y, action).outcomes:
                    if outcome.seen not in found:
                        found[outcome.seen] = None
                        waiting.append(outcome.seen)
        return list(found)

    def sweep(self, deadline: float) -> float:
        """One iteration at every y, or as much of it as there is time for; the largest change."""
        useful = {y: self._useful(y) for y in self.seen}
        after = {y: q.copy() for y, q in self.q.items()}
        least, most = np.inf, 0.0
        for y, then_groups in self.groups.items():
            totals = [table_of(self.pomdp.step(y, a).reward, self.axes).values for a in self.actions]
            for group in then_groups:
                for member, best in self._best(group, useful[group.then], deadline):
                    totals[member.action] = totals[member.action] + self.pomdp.discount * best
                if time.monotonic() > deadline:
                    self.q = after
                    return float("inf")
            for action, total in enumerate(totals):
                error = self.pomdp.backup_error(self.pomdp.step(y, action), self.first.size)
                change = np.where(self.live[y], self.q[y][action] - total - error, 0.0)
                least, most = min(least, float(change.min())), max(most, float(change.max()))
                after[y][action] -= np.maximum(change, 0.0)
        self.q = after
        slack = 64 * UNIT * self.first.size
        if not self.first.ends and least > slack:
            moved = self.pomdp.discount * self.first.shift(least - slack)
            self.q = {y: q - moved for y, q in self.q.items()}
        return most

    def _useful(self, y: Seen) -> list[int]:
        """The actions whose Q is somewhere above that of each other one."""
        q = self.q[y].reshape(self.pomdp.actions, -1)
        kept: list[int] = []
        for action in range(len(q)):
            if any((q[other] >= q[action]).all() for other in kept):
                continue
            kept = [other for other in kept if not (q[action] >= q[other]).all()] + [action]
        return kept

    def _best(
        self, group: Group, useful: Sequence[int], deadline: float
    ) -> Iterator[tuple[Member, FloatArray]]:
        """For each member the sum over its outcomes of max over a' of the regression of W_o Q_a'."""
        now = self.pomdp.symbolic.now
        moved = {now(k): self.pomdp.symbolic.next(k) for k in group.changed}
        best = [np.full((len(m.outcomes), *self.shape), -np.inf) for m in group.members]
        size = self._at_once(group)
        for begin in range(0, len(useful), size):
            self.first.poll()
            if time.monotonic() > deadline:
                return
            batch = self.q[group.then][useful[begin : begin + size]]
            function = Table((BATCH, *self.axes), batch).moved(moved)
            function = eliminate(function, group.early, group.synchronic)
            for member, found in zip(group.members, best, strict=True):
                for number, weight in enumerate(member.outcomes):
                    after = eliminate(weight * function, member.late, group.synchronic)
                    largest = after.over((BATCH, *self.axes)).max(axis=0)
                    found[number] = np.maximum(found[number], largest)
        for member, found in zip(group.members, best, strict=True):
            yield member, found.sum(axis=0)

    # -- what is shared --------------------------------------------------------------------------

    def _groups_at(self, y: Seen) -> list[Group]:
        """The actions at one y by where they lead and what they can sum out together."""
        pomdp, symbolic = self.pomdp, self.pomdp.symbolic
        steps = [pomdp.step(y, a) for a in self.actions]
        tables = [step_tables(pomdp, step) for step in steps]
        counts = Counter(
            _name(then, level, table)
            for _, weights in tables
            for then, by_level in weights.items()
            for level, table in by_level.items()
        )
        found: dict[tuple[object, ...], Group] = {}
        for step, (outcomes, weights) in zip(steps, tables, strict=True):
            synchronic = symbolic.actions[step.action].synchronic
            for then, by_level in weights.items():
                mine = [w for o, w in zip(step.outcomes, outcomes, strict=True) if o.seen == then]
                read = {axis for weight in mine for axis in weight.axes}
                names = {level: _name(then, level, table) for level, table in by_level.items()}
                most = max((counts[name] for name in names.values()), default=0)
                early = {
                    level: table
                    for level, table in by_level.items()
                    if not synchronic and level not in read and counts[names[level]] == most
                }
                late = {level: table for level, table in by_level.items() if level not in early}
                key = (then, synchronic, step.changed, *(names[level] for level in sorted(early)))
                group = found.setdefault(key, Group(then, step.changed, synchronic, early, []))
                group.members.append(Member(step.action, mine, late))
        return list(found.values())

    def _at_once(self, group: Group) -> int:
        """How many tables are regressed side by side."""
        sizes = self.pomdp.manager.sizes
        widest = max((sizes[self.pomdp.symbolic.next(k)] for k in group.changed), default=1)
        return max(1, BETWEEN // (4 * widest * prod(self.shape)))

    def improve(self, seconds: float, worth: float) -> None:
        """Sweeps while a further one may lower some Q by more than `worth`, and there is time."""
        deadline = time.monotonic() + seconds
        discount = self.pomdp.discount
        for _ in range(SWEEPS):
            if self.sweep(deadline) * discount <= worth * (1 - discount) or time.monotonic() > deadline:
                break

    def diagrams(self, seen: Seen, nodes: int, width: float) -> list[Diagram]:
        """Q_a at one y as diagrams of at most so many nodes, leaves merged upwards."""
        manager = self.pomdp.manager
        tables = (Table(self.axes, q) for q in self.q[seen])
        return [merged_diagram(manager, table, width, nodes, "up")[0] for table in tables]


def informed_bound(
    first: FirstBounds, starts: Sequence[Seen], quality: Sequence[Diagram], seconds: float
) -> InformedBound | None:
    """The bound after so many seconds at most; None where there are too many cells for it."""
    try:
        found = InformedBound(first, starts, quality)
        found.improve(seconds, WORTH * (first.ceiling - first.floor))
    except (TooManyCells, LimitReached):
        return None
    return found
