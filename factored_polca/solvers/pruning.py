"""Pruning: the fewest of some vectors that have the same maximum over all beliefs.

A vector is *useful* if at some belief, its *witness*, it is above all others (White & Lark; White
1991).  All sets here are sums {l + r : l in left, r in right}, the cross-sums of incremental pruning
(Zhang & Liu 1996; Cassandra, Littman & Zhang 1997); a plain set has right = {0}.  The best vector at a
belief is the sum of the best of either side, so that n1 + n2 products search n1 * n2 vectors.

1.  States in which all vectors of a side are equal are left out: only the others tell vectors apart.
2.  None left: the first vector.  One: the largest number.  Two: `factored_polca.solvers.envelope`.
3.  Otherwise the best vectors at a pool of beliefs (corners, uniform, random with a fixed seed, earlier
    witnesses) survive, by one matrix product; all others are decided by linear programs in
    `factored_polca.solvers.constraint_generation`.

Ties at a belief go to the lexicographically largest vector, which is best beside the belief too (Littman
1994), then to the first.  Both answers carry their proof: a survivor its witness, a dropped vector a
mixture of survivors.  What rounding leaves open is solved once more from the start, then by HiGHS, and
kept if open still.  (Large programs need no HiGHS: up to 250 states it takes 5 to 30 times as long.)

Error: with tolerance e, the maximum of what is returned is at no belief more than e * scale below the
maximum of what was given, and never above; scale = max(1, max |l| + max |r|).

Letters: i states, n vectors, l and r indices into left and right, b a belief.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.models.errors import LimitReached
from factored_polca.solvers import constraint_generation as games
from factored_polca.solvers.envelope import envelope, envelope_of_sums
from factored_polca.solvers.simplex import game_value, game_value_by_highs

TOLERANCE: Final = 1e-12
"""What pruning may cost by default, as a share of the scale."""

HIGHS_ACCURACY: Final = 1e-8
"""How far HiGHS may be off, as a share of the scale: it overrules beyond that only."""

BURST: Final = 16
"""Sums that are looked at before the first poll; doubled as long as that takes less than PAUSE."""

PAUSE: Final = 0.02
"""Seconds between polls, about."""

SUMS: Final = 1 << 28
"""How many sums may be looked through: 1 GB of notes."""

ROOM: Final = 256

PRODUCT: Final = 1 << 18
"""Entries of the matrix product of beliefs and vectors at a time: 2 MB."""


@dataclass(frozen=True)
class Survivors:
    """The useful sums left[l] + right[r], by ascending (l, r)."""

    left: IntArray  # [n]
    right: IntArray  # [n]
    witnesses: FloatArray  # [n, i] a belief at which each is the best
    programs: int = 0  # linear programs that were solved
    error: float = 0.0  # how far their maximum may be below that of all sums


def scale_of(left: FloatArray, right: FloatArray | None = None) -> float:
    """The scale that the tolerance is a share of; see the module's docstring."""
    total = float(np.abs(left).max(initial=0.0))
    if right is not None:
        total += float(np.abs(right).max(initial=0.0))
    return max(1.0, total)


def prune(
    vectors: FloatArray,
    *,
    tolerance: float = TOLERANCE,
    beliefs: FloatArray | None = None,
    verify: bool = False,
    poll: Callable[[], None] | None = None,
) -> IntArray:
    """Indices, ascending, of a smallest set with the same maximum on the simplex as `vectors` [n, i].

    `beliefs` [p, i] join the pool; `poll` is called some 50 times a second and may raise;
    `verify` decides every vector again by HiGHS, slowly.  The error is in the module's docstring.
    """
    found = survivors(vectors, None, tolerance=tolerance, beliefs=beliefs, poll=poll).left
    return verified(vectors, found) if verify else found


def survivors(
    left: FloatArray,
    right: FloatArray | None = None,
    *,
    tolerance: float = TOLERANCE,
    beliefs: FloatArray | None = None,
    hints: FloatArray | None = None,
    poll: Callable[[], None] | None = None,
) -> Survivors:
    """The useful sums of `left` [n1, i] and `right` [n2, i] (None: only the zero).

    `beliefs` [p, i] join the pool; so do `hints` [n1, i] (for right = None), a belief for each vector
    at which it is likely to be good.  `poll` as for `prune`.

    Raises:
        LimitReached: more than `SUMS` sums.
    """
    left = np.ascontiguousarray(left, dtype=np.float64)
    states = left.shape[1]
    right = np.zeros((1, states)) if right is None else np.ascontiguousarray(right, dtype=np.float64)
    limit = tolerance * scale_of(left, right)
    moving = (left != left[0]).any(axis=0) | (right != right[0]).any(axis=0)
    width = int(moving.sum())
    if len(left) * len(right) > SUMS:
        raise LimitReached(f"{len(left)} x {len(right)} sums of vectors are too many to prune", "pruning")
    if width <= 2:
        return _few_states(left, right, moving, limit)
    pools = [base_beliefs(width)]
    for pool in (beliefs, hints):
        if pool is not None and len(pool):
            pools.append(_restricted(pool, moving))
    if width < states:
        left, right = np.ascontiguousarray(left[:, moving]), np.ascontiguousarray(right[:, moving])
    work = _Work(left, right, 0.5 * limit)
    work.mark(np.vstack(pools), 0 if hints is None else len(hints), poll)
    work.scan(poll)
    found = work.result()
    witnesses = np.zeros((len(found.left), states))
    witnesses[:, moving] = found.witnesses
    error = limit if len(found.left) < len(left) * len(right) else 0.0
    return Survivors(found.left, found.right, witnesses, found.programs, error)


def _few_states(left: FloatArray, right: FloatArray, moving: BoolArray, limit: float) -> Survivors:
    """Where at most two states tell the vectors apart."""
    places = np.flatnonzero(moving)
    witnesses = np.zeros((1, len(moving)))
    if len(places) < 2:
        s = int(places[0]) if len(places) else 0
        witnesses[0, s] = 1.0
        best = [np.array([rows[:, s].argmax()]) for rows in (left, right)]
        return Survivors(best[0], best[1], witnesses)
    if len(right) == 1:
        l, middles = envelope(left[:, places], limit)
        r = np.zeros_like(l)
    else:
        l, r, middles = envelope_of_sums(left[:, places], right[:, places], limit)
    witnesses = np.zeros((len(l), len(moving)))
    witnesses[:, places] = middles
    return Survivors(l, r, witnesses, 0, limit if len(l) < len(left) * len(right) else 0.0)


@lru_cache(maxsize=64)
def base_beliefs(i: int) -> FloatArray:
    """Beliefs [p, i] that every pool starts with: corners, uniform, random with a fixed seed."""
    generator = np.random.default_rng(i)
    inside = generator.dirichlet(np.full(i, 1.0), size=2 * i)
    near = generator.dirichlet(np.full(i, 0.3), size=2 * i)
    return np.vstack([np.eye(i), np.full((1, i), 1 / i), inside, near])


def _restricted(beliefs: FloatArray, moving: BoolArray) -> FloatArray:
    """Beliefs over the states that tell vectors apart (uniform where nothing is left)."""
    part = beliefs[:, moving]
    mass = part.sum(axis=1, keepdims=True)
    spread: FloatArray = np.where(mass > 0, part / np.where(mass > 0, mass, 1.0), 1 / part.shape[1])
    return spread


def verified(vectors: FloatArray, kept: IntArray) -> IntArray:
    """`kept`, a pruning of `vectors` [n, i], with every decision HiGHS contradicts put right."""
    slack = HIGHS_ACCURACY * scale_of(vectors)
    chosen = kept.tolist()
    for n in range(len(vectors)):
        others = [m for m in chosen if m != n]
        value = game_value_by_highs(vectors[n] - vectors[others])[0] if others else np.inf
        if n in chosen and value < -slack:
            chosen.remove(n)
        elif n not in chosen and value > slack:
            chosen.append(n)
    return np.array(sorted(chosen), dtype=np.int64)


class _Work:
    """The working state of one pruning; `tolerance` is absolute."""

    def __init__(self, left: FloatArray, right: FloatArray, tolerance: float) -> None:
        self.tolerance = tolerance
        n1, n2, i = len(left), len(right), left.shape[1]
        across = (np.ascontiguousarray(left.T), np.ascontiguousarray(right.T))
        self.sums = games.Sums(left, right, *across, np.full(n1, -1, dtype=np.int64))
        columns = 8 * i + 32
        self.game = games.Game(
            local=np.zeros(columns, dtype=np.int64),
            columns=np.zeros((i + 1, columns)),
            inverse=np.zeros((i + 1, i + 1)),
            basis=np.zeros(i, dtype=np.int64),
            costs=np.zeros(columns),
            out=np.zeros(i + 1),
            belief=np.zeros(i),
            w=np.zeros(i),
            left_values=np.zeros(n1),
            right_values=np.zeros(n2),
            block=np.zeros(games.WIDTH),
        )
        state = np.full((n1, n2), games.OPEN, dtype=np.int32)
        self.found = games.Found(state, np.zeros(0, dtype=np.int64), np.zeros((i, 0)), np.zeros((0, i)))
        self.progress = np.zeros(6, dtype=np.int64)

    def mark(self, beliefs: FloatArray, hints: int, poll: Callable[[], None] | None) -> None:
        """The best sums at `beliefs` [p, i] survive; the last ones are `hints` for the vectors."""
        best = []
        for rows in (self.sums.left, self.sums.right):
            out = np.zeros(len(beliefs), dtype=np.int64)
            step = max(1, PRODUCT // len(rows))
            for at in range(0, len(beliefs), step):
                if poll is not None and at:
                    poll()
                part = slice(at, at + step)
                games.best_rows(beliefs[part] @ rows.T, rows, 0.25 * self.tolerance, out[part])
            best.append(out)
        winners = best[0] * len(self.sums.right) + best[1]
        numbers, first, place = np.unique(winners, return_index=True, return_inverse=True)
        if hints:
            self.sums.hints[:] = place[-hints:]
        self.room(len(numbers))
        found = self.found
        found.state.reshape(-1)[numbers] = np.arange(len(numbers))
        found.kept[: len(numbers)] = numbers
        found.witnesses[: len(numbers)] = beliefs[first]
        found.across[:, : len(numbers)] = self.vectors(numbers).T
        few = min(len(numbers), len(beliefs[0]))
        self.game.local[:few] = np.arange(few)
        self.progress[games.SURVIVORS] = len(numbers)
        self.progress[games.COLUMNS] = few

    def room(self, more: int) -> None:
        """Room for `more` survivors."""
        found, i = self.found, len(self.game.basis)
        self.found = games.Found(
            found.state,
            np.concatenate([found.kept, np.zeros(more, dtype=np.int64)]),
            np.hstack([found.across, np.zeros((i, more))]),
            np.vstack([found.witnesses, np.zeros((more, i))]),
        )

    def vectors(self, numbers: IntArray) -> FloatArray:
        """The sums [n, i] with these numbers."""
        n2 = len(self.sums.right)
        total: FloatArray = self.sums.left[numbers // n2] + self.sums.right[numbers % n2]
        return total

    def scan(self, poll: Callable[[], None] | None) -> None:
        """Decide all others."""
        burst = BURST
        while True:
            stop = int(self.progress[games.LOOKS]) + burst
            start = time.perf_counter()
            code = games.scan(self.sums, self.found, self.game, self.progress, self.tolerance, stop)
            if code == games.DONE:
                break
            if code == games.FULL:
                self.room(ROOM + len(self.found.kept))
                continue
            if poll is not None:
                poll()
            burst = 2 * burst if time.perf_counter() - start < PAUSE else max(1, burst // 2)
        for number in np.flatnonzero(self.found.state.reshape(-1) == games.DOUBTFUL).tolist():
            self.settle(number)

    def settle(self, number: int) -> None:
        """Keep a doubtful sum, unless a mixture is found that holds it down (constraints generated)."""
        count = int(self.progress[games.SURVIVORS])
        matrix = self.vectors(np.array([number]))[0] - self.found.across[:, :count].T
        belief = np.zeros(0)
        for solve in (game_value, game_value_by_highs):
            chosen = [int(matrix.max(axis=1).argmin())]
            while True:
                _, belief, mixture = solve(matrix[chosen])
                if mixture.sum() > 0.5 and (mixture @ matrix[chosen]).max() <= 2 * self.tolerance:
                    return
                worst = int((matrix @ belief).argmin())
                if worst in chosen:
                    break
                chosen.append(worst)
        if count == len(self.found.kept):
            self.room(ROOM)
        n2 = len(self.sums.right)
        self.game.belief[:] = belief
        games.add_survivor(self.sums, self.found, self.game, self.progress, number // n2, number % n2)

    def result(self) -> Survivors:
        """The survivors in order."""
        count = int(self.progress[games.SURVIVORS])
        order = np.argsort(self.found.kept[:count])
        numbers = self.found.kept[order]
        n2 = len(self.sums.right)
        return Survivors(
            numbers // n2, numbers % n2, self.found.witnesses[order], int(self.progress[games.PROGRAMS])
        )
