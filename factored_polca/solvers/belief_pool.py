"""Pools of beliefs by class: where point-based methods back up, and how such pools grow.

Two ways to grow:

- *Farthest successors* (PBVI; Pineau, Gordon & Thrun 2003, section 4): from each belief of the pool
  simulate each option once; of the successors keep the one farthest in L1 from the pool.
- *Exploration* (Perseus; Spaan & Vlassis 2005, section 3.1): run from the roots, and collect what is met.
  Options are drawn at random, or by a rule that the caller gives.

Successors are drawn given that the process goes on: a dead state's value is known.  Beliefs that agree
when rounded to `DIGITS` digits are one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.batched_backup import posteriors, steps
from factored_polca.solvers.pomdp_problem import Problem

DIGITS: Final = 7
DISTANCES: Final = 2**22
"""Distances computed at a time: 32 MB."""

Rule: TypeAlias = Callable[[int, FloatArray], IntArray]
"""(class, beliefs [m, n_y]) -> options [m]."""


@dataclass(frozen=True)
class BeliefPool:
    """Distinct beliefs of each class; the roots come first."""

    beliefs: tuple[FloatArray, ...]  # [y] arrays [m_y, n_y], rows sum to 1

    @property
    def count(self) -> int:
        """The number of beliefs."""
        return sum(map(len, self.beliefs))

    def extended(self, found: Iterable[tuple[int, FloatArray]], limit: int | None = None) -> BeliefPool:
        """The pool and those of `found` (class, belief) that are new, in order, up to `limit` in all."""
        known = {(y, _key(belief)) for y, rows in enumerate(self.beliefs) for belief in rows}
        fresh: list[list[FloatArray]] = [[] for _ in self.beliefs]
        room = np.inf if limit is None else limit - self.count
        for y, belief in found:
            key = (y, _key(belief))
            if room <= 0:
                break
            if key not in known:
                known.add(key)
                fresh[y].append(belief)
                room -= 1
        return BeliefPool(
            tuple(
                np.vstack([old, *new]) if new else old for old, new in zip(self.beliefs, fresh, strict=True)
            )
        )


def _key(belief: FloatArray) -> bytes:
    return (np.round(belief, DIGITS) + 0.0).tobytes()  # + 0.0: no negative zeros


def root_pool(problem: Problem) -> BeliefPool:
    """The roots of `problem`, by class."""
    empty = BeliefPool(tuple(np.zeros((0, problem.size(y))) for y in range(problem.classes)))
    return empty.extended((root.y, root.belief) for root in problem.roots)


def simulate(
    problem: Problem, y: int, beliefs: FloatArray, options: IntArray, draws: FloatArray
) -> tuple[IntArray, list[FloatArray]]:
    """A successor of each of `beliefs` [m, n_y] by its option, drawn by `draws` [m] in [0, 1).

    Returns the next classes [m], -1 where the process ends for sure, and the beliefs over them.
    """
    classes = np.full(len(beliefs), -1)
    after: list[FloatArray] = [np.zeros(0)] * len(beliefs)
    for j in np.unique(options).tolist():
        mine = np.flatnonzero(options == j)
        branches = problem.branch_range(j)
        if not len(branches):
            continue
        chances = beliefs[mine] @ np.stack([steps(problem)[k].chance for k in branches], axis=1)
        levels = np.cumsum(chances, axis=1)
        drawn = (levels <= draws[mine, None] * levels[:, -1:]).sum(axis=1)  # past the last: it ends
        for place, k in enumerate(branches):
            those = mine[drawn == place]
            if len(those):
                step = steps(problem)[k]
                compact = posteriors(step, beliefs[those])
                full = np.zeros((len(those), problem.size(step.target)))
                full[:, step.columns] = compact / compact.sum(axis=1, keepdims=True)
                classes[those] = step.target
                for row, belief in zip(those.tolist(), full, strict=True):
                    after[row] = belief
    return classes, after


def farthest_successors(
    problem: Problem,
    pool: BeliefPool,
    rng: np.random.Generator,
    limit: int | None = None,
    poll: Callable[[], None] | None = None,
) -> BeliefPool:
    """The pool and, for each of its beliefs, the farthest of its simulated successors, if it is new.

    Where `limit` beliefs in all do not leave room for all of them, the farthest ones are taken.
    `poll` is called now and then, and may raise.
    """
    owners, classes, beliefs = _all_successors(problem, pool, rng)
    distances = np.zeros(len(owners))
    for y in np.unique(classes).tolist():
        mine = np.flatnonzero(classes == y)
        if poll is not None:
            poll()
        distances[mine] = _distances(np.array([beliefs[i] for i in mine]), pool.beliefs[y])
    order = np.lexsort((np.arange(len(owners)), -distances, owners))
    first = order[np.unique(owners[order], return_index=True)[1]] if len(order) else order
    first = first[distances[first] > 0]
    first = first[np.argsort(-distances[first], kind="stable")]
    return pool.extended(((int(classes[i]), beliefs[i]) for i in first.tolist()), limit)


def _all_successors(
    problem: Problem, pool: BeliefPool, rng: np.random.Generator
) -> tuple[IntArray, IntArray, list[FloatArray]]:
    """One successor for each belief and option: its owner (numbered over the pool), class and belief."""
    owners: list[int] = []
    classes: list[int] = []
    beliefs: list[FloatArray] = []
    first = 0
    for y, rows in enumerate(pool.beliefs):
        for j in problem.option_range(y):
            chosen = np.full(len(rows), j)
            targets, after = simulate(problem, y, rows, chosen, rng.random(len(rows)))
            for row in np.flatnonzero(targets >= 0).tolist():
                owners.append(first + row)
                classes.append(int(targets[row]))
                beliefs.append(after[row])
        first += len(rows)
    return np.array(owners, dtype=np.int64), np.array(classes, dtype=np.int64), beliefs


def _distances(beliefs: FloatArray, others: FloatArray) -> FloatArray:
    """The L1 distance [m] of each belief to the nearest of `others`; 2, the largest, if there are none."""
    from scipy.spatial.distance import cdist  # takes long to import

    result = np.full(len(beliefs), 2.0)
    if len(others) == 0:
        return result
    length = max(1, DISTANCES // len(others))
    for start in range(0, len(beliefs), length):
        part = slice(start, start + length)
        result[part] = cdist(beliefs[part], others, "cityblock").min(axis=1)
    return result


def explored(
    problem: Problem,
    pool: BeliefPool,
    rng: np.random.Generator,
    *,
    limit: int,
    runs: int,
    depth: int,
    rules: Sequence[Rule] = (),
    random: float = 1.0,
) -> BeliefPool:
    """The pool and what `runs` runs of at most `depth` steps from the roots meet, up to `limit` in all.

    At each step a run draws its option uniformly with the chance `random`; else it follows one of
    `rules`, dealt out to the runs in turn.
    """
    starts = rng.integers(len(problem.roots), size=runs)
    classes = np.array([problem.roots[r].y for r in starts], dtype=np.int64)
    beliefs = [problem.roots[r].belief for r in starts]
    rule = np.arange(runs) % max(1, len(rules))
    met: list[tuple[int, FloatArray]] = []
    for _ in range(depth):
        wild = (rng.random(runs) < random) | (not rules)
        draws, fate = rng.random(runs), rng.random(runs)
        after, next_beliefs = np.full(runs, -1), beliefs.copy()
        for y in np.unique(classes[classes >= 0]).tolist():
            mine = np.flatnonzero(classes == y)
            here = np.array([beliefs[i] for i in mine])
            own = problem.option_range(y)
            options = own.start + (draws[mine] * len(own)).astype(np.int64)
            for number, choose in enumerate(rules):
                led = (rule[mine] == number) & ~wild[mine]
                if led.any():
                    options[led] = choose(y, here[led])
            after[mine], reached = simulate(problem, y, here, options, fate[mine])
            for i, belief in zip(mine.tolist(), reached, strict=True):
                next_beliefs[i] = belief
        classes, beliefs = after, next_beliefs
        met.extend((int(classes[i]), beliefs[i]) for i in np.flatnonzero(classes >= 0).tolist())
        if not np.any(classes >= 0):
            break
    return pool.extended(met, limit)
