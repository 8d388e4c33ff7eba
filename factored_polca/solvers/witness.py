"""The exact dynamic-programming update by the witness algorithm: a cross-check of incremental pruning.

For an option j with branches k and projections G_k (letters as in
`factored_polca.solvers.pomdp_problem`) a vector of Gamma_j is a choice of one vector from every G_k:

    alpha = r_j + sum over k of G_k[c_k]

Its *neighbours* differ in one c_k.  If a set of such vectors is not all of Gamma_j, then some neighbour
of one of them is better than the whole set at some belief; there the best vector, found branch by
branch, is missing.  So neighbours wait on an agenda, each is given up when no belief speaks for it, and
each belief found adds a vector and its neighbours (Cassandra, Kaelbling & Littman, "Acting optimally in
partially observable stochastic domains", AAAI 1994; Littman 1994).

Plain and slow on purpose: it shares the simplex method with incremental pruning (a whole game at once,
without constraint generation), and nothing else: sets are filtered by Lark's method here, whatever the
number of states.

Error: a vector is given up if it is better by at most e * scale.  Where each neighbour of the best
vector of the set gains at most that, the K branches together gain at most K times that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.exact_backup import Backup, ClassBackup, project
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pruning import TOLERANCE, scale_of
from factored_polca.solvers.simplex import game_value

TIE: Final = 0.125
"""Values at a belief that differ by less than this share of the tolerance are ties."""


def witness_backup(
    problem: Problem,
    sets: Sequence[FloatArray],
    *,
    discount: float | None = None,
    tolerance: float = TOLERANCE,
    poll: Callable[[], None] | None = None,
) -> Backup:
    """The same as `factored_polca.solvers.exact_backup.backup`, by the witness algorithm."""
    gamma = problem.discount if discount is None else discount
    run = _Run(tolerance, poll)
    classes = [_back_up_class(problem, sets, y, gamma, run) for y in range(problem.classes)]
    error = max((part.error for part in classes), default=0.0)
    return Backup(tuple(classes), error, run.programs)


class _Run:
    """What all games of a backup share."""

    def __init__(self, tolerance: float, poll: Callable[[], None] | None) -> None:
        self.tolerance, self.poll, self.programs = tolerance, poll, 0

    def witness(self, vector: FloatArray, others: FloatArray, limit: float) -> FloatArray | None:
        """A belief [i] at which `vector` is better than all `others` by more than `limit`, if any."""
        if np.any(np.all(vector <= others + limit, axis=1)):
            return None
        if self.poll is not None and self.programs % 64 == 0:
            self.poll()
        self.programs += 1
        value, belief, _ = game_value(vector - others)
        return belief if value > limit else None

    def filter(self, vectors: FloatArray) -> tuple[IntArray, FloatArray, float]:
        """Lark's method: indices [n] of the useful vectors, their witnesses [n, i], and the error."""
        limit = self.tolerance * scale_of(vectors)
        states = vectors.shape[1]
        waiting = list(range(len(vectors)))
        kept: list[int] = []
        witnesses: list[FloatArray] = []
        belief: FloatArray | None = np.full(states, 1 / states)
        while waiting:
            if kept:
                belief = self.witness(vectors[waiting[0]], vectors[kept], limit)
            if belief is None:
                waiting.pop(0)
                continue
            best = waiting[best_vector(vectors[waiting], belief, TIE * limit)]
            waiting.remove(best)
            kept.append(best)
            witnesses.append(belief)
        order = np.argsort(kept)
        error = limit if len(kept) < len(vectors) else 0.0
        return np.array(kept, dtype=np.int64)[order], np.array(witnesses)[order], error


def best_vector(vectors: FloatArray, belief: FloatArray, tie: float) -> int:
    """The index of the best of `vectors` [n, i]; of ties the lexicographically largest, then the first."""
    values = vectors @ belief
    best = np.flatnonzero(values >= values.max() - tie)
    for entries in vectors.T:
        if len(best) == 1:
            break
        here = entries[best]
        best = best[here >= here.max() - tie]
    return int(best[0])


def _back_up_class(
    problem: Problem, sets: Sequence[FloatArray], y: int, gamma: float, run: _Run
) -> ClassBackup:
    width = max(len(problem.branch_range(j)) for j in problem.option_range(y))
    vectors, options, successors, errors = [], [], [], []
    for j in problem.option_range(y):
        found, choices, error = _back_up_option(problem, sets, j, gamma, run)
        vectors.append(found)
        options.append(np.full(len(found), j, dtype=np.int64))
        padding = np.full((len(found), width - choices.shape[1]), -1, dtype=np.int64)
        successors.append(np.hstack([choices, padding]))
        errors.append(error)
    together = np.vstack(vectors)
    keep, witnesses, last = run.filter(together)
    return ClassBackup(
        together[keep],
        np.concatenate(options)[keep],
        np.vstack(successors)[keep],
        witnesses,
        max(errors) + last,
    )


def _back_up_option(
    problem: Problem, sets: Sequence[FloatArray], j: int, gamma: float, run: _Run
) -> tuple[FloatArray, IntArray, float]:
    """(vectors [n, n_y], the successor of each branch [n, p], error) of Gamma_j."""
    reward = problem.reward(j)
    projections, numbers, errors = [], [], [0.0]
    for k in problem.branch_range(j):
        vectors = project(problem, sets, k, gamma)
        keep, _, error = run.filter(vectors)
        projections.append(vectors[keep])
        numbers.append(keep)
        errors.append(error)
    limit = run.tolerance * max(1.0, sum(scale_of(part) for part in projections))
    chosen = _agenda(reward, projections, limit, run)
    table = np.array(chosen, dtype=np.int64).reshape(len(chosen), len(projections))
    successors = np.column_stack([table[:, :0], *(n[c] for n, c in zip(numbers, table.T, strict=True))])
    vectors = np.array([_vector(reward, projections, choice) for choice in chosen])
    whole = len(chosen) == math.prod(len(part) for part in projections)
    error = sum(errors) + (0.0 if whole else len(projections) * limit)
    return vectors, successors.astype(np.int64), error


def _agenda(
    reward: FloatArray, projections: Sequence[FloatArray], limit: float, run: _Run
) -> list[tuple[int, ...]]:
    """The choices of the vectors of Gamma_j."""
    states = len(reward)
    first = _best_choice(projections, np.full(states, 1 / states), TIE * limit)
    chosen, vectors = [first], _vector(reward, projections, first)[None, :]
    agenda = _neighbours(first, projections)
    seen = {first, *agenda}
    while agenda:
        choice = agenda[-1]
        belief = run.witness(_vector(reward, projections, choice), vectors, limit)
        if belief is None:
            agenda.pop()
            continue
        best = _best_choice(projections, belief, TIE * limit)
        if best in chosen:  # rounding: take the neighbour itself
            best = choice
        if best == choice:
            agenda.pop()
        chosen.append(best)
        vectors = np.vstack([vectors, _vector(reward, projections, best)])
        for neighbour in _neighbours(best, projections):
            if neighbour not in seen:
                seen.add(neighbour)
                agenda.append(neighbour)
        seen.add(best)
    return chosen


def _vector(reward: FloatArray, projections: Sequence[FloatArray], choice: tuple[int, ...]) -> FloatArray:
    total = reward.copy()
    for part, number in zip(projections, choice, strict=True):
        total += part[number]
    return total


def _best_choice(projections: Sequence[FloatArray], belief: FloatArray, tie: float) -> tuple[int, ...]:
    return tuple(best_vector(part, belief, tie) for part in projections)


def _neighbours(choice: tuple[int, ...], projections: Sequence[FloatArray]) -> list[tuple[int, ...]]:
    return [
        (*choice[:k], number, *choice[k + 1 :])
        for k, part in enumerate(projections)
        for number in range(len(part))
        if number != choice[k]
    ]
