"""The exact dynamic-programming update of a value function of alpha-vectors, by incremental pruning.

With sets Gamma_y' the new sets are, for class y (letters as in `factored_polca.solvers.pomdp_problem`),

    G_k      = prune {gamma M_k alpha : alpha in Gamma_y'}                     for each branch k to y'
    Gamma_j  = r_j + prune(... prune(prune(G_k1 + G_k2) + G_k3) ...)           for each option j
    Gamma_y  = prune of the union of Gamma_j over the options of y

(Zhang & Liu 1996; Cassandra, Littman & Zhang, "Incremental pruning", UAI 1997), the two smallest sets
being summed first.  Each prune starts from the witnesses of the sets it is made of.

Error: what the prunes of an option may cost (`factored_polca.solvers.pruning`) adds up, that of the
union comes on top.  The new maximum is at no belief more than `Backup.error`, the largest such sum,
below the true one; it is never above, but for rounding.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pruning import TOLERANCE, Survivors, survivors


@dataclass(frozen=True)
class ClassBackup:
    """The new set of one class."""

    vectors: FloatArray  # [n, n_y]
    options: IntArray  # [n]
    successors: IntArray  # [n, p] the vector of `sets[y']` for the p-th branch of the option; -1: none
    witnesses: FloatArray  # [n, n_y] a belief where each is best
    error: float  # what pruning may have cost at any belief over this class


@dataclass(frozen=True)
class Backup:
    """A backup of every class; see the module's docstring."""

    classes: tuple[ClassBackup, ...]
    error: float  # how far pruning may have put the maximum below the true one, at any belief
    programs: int  # linear programs that were solved (their number may change with the pools)

    @property
    def sets(self) -> list[FloatArray]:
        """[y] the vectors [n, n_y], as the next backup takes them."""
        return [part.vectors for part in self.classes]

    @property
    def witnesses(self) -> list[FloatArray]:
        """[y] beliefs [n, n_y] for the pool of the next backup."""
        return [part.witnesses for part in self.classes]

    @property
    def count(self) -> int:
        """The number of vectors over all classes."""
        return sum(len(part.vectors) for part in self.classes)


@dataclass(frozen=True)
class _Set:
    """Vectors with the beliefs where they are best and what they were built from."""

    vectors: FloatArray  # [n, n_y]
    witnesses: FloatArray  # [n, n_y]
    successors: IntArray  # [n, p], -1 where the branch is not in yet
    error: float = 0.0


@dataclass
class _Run:
    """What all prunes of a backup share."""

    discount: float
    tolerance: float
    poll: Callable[[], None] | None
    programs: int = 0

    def prune(self, vectors: FloatArray, successors: IntArray, beliefs: FloatArray) -> _Set:
        """The useful ones of `vectors` [n, i]."""
        found = self._survivors(vectors, None, beliefs)
        return _Set(vectors[found.left], found.witnesses, successors[found.left], found.error)

    def sum(self, left: _Set, right: _Set) -> _Set:
        """The useful sums of two pruned sets, `left` not the larger one."""
        error = left.error + right.error
        if len(left.vectors) == 1:
            successors = np.maximum(left.successors, right.successors)
            return _Set(left.vectors + right.vectors, right.witnesses, successors, error)
        beliefs = np.vstack([left.witnesses, right.witnesses])
        found = self._survivors(left.vectors, right.vectors, beliefs)
        return _Set(
            left.vectors[found.left] + right.vectors[found.right],
            found.witnesses,
            np.maximum(left.successors[found.left], right.successors[found.right]),
            error + found.error,
        )

    def union(self, parts: Sequence[_Set], options: IntArray, beliefs: FloatArray) -> ClassBackup:
        """The useful ones of all options' vectors; `options` [n] are theirs, in order."""
        vectors = np.vstack([part.vectors for part in parts])
        successors = np.vstack([part.successors for part in parts])
        found = self._survivors(vectors, None, beliefs, np.vstack([part.witnesses for part in parts]))
        keep = found.left
        error = max(part.error for part in parts) + found.error
        return ClassBackup(vectors[keep], options[keep], successors[keep], found.witnesses, error)

    def _survivors(
        self,
        left: FloatArray,
        right: FloatArray | None,
        beliefs: FloatArray,
        hints: FloatArray | None = None,
    ) -> Survivors:
        if self.poll is not None:
            self.poll()
        found = survivors(
            left, right, tolerance=self.tolerance, beliefs=beliefs, hints=hints, poll=self.poll
        )
        self.programs += found.programs
        return found


def backup(
    problem: Problem,
    sets: Sequence[FloatArray],
    *,
    discount: float | None = None,
    tolerance: float = TOLERANCE,
    witnesses: Sequence[FloatArray] | None = None,
    poll: Callable[[], None] | None = None,
) -> Backup:
    """The new sets of every class from `sets` [y], arrays [n, n_y] with n >= 1.

    `discount` replaces the problem's; `witnesses` [y], beliefs [w, n_y], join the pools (those of the
    last backup are best); `poll` is called between steps and may raise.
    """
    run = _Run(problem.discount if discount is None else discount, tolerance, poll)
    classes = []
    for y in range(problem.classes):
        beliefs = np.zeros((0, problem.size(y))) if witnesses is None else witnesses[y]
        parts = [_back_up_option(problem, sets, y, j, run, beliefs) for j in problem.option_range(y)]
        options = np.repeat(np.array(problem.option_range(y)), [len(part.vectors) for part in parts])
        classes.append(run.union(parts, options, beliefs))
    error = max((part.error for part in classes), default=0.0)
    return Backup(tuple(classes), error, run.programs)


def _back_up_option(
    problem: Problem, sets: Sequence[FloatArray], y: int, j: int, run: _Run, beliefs: FloatArray
) -> _Set:
    """Gamma_j: the pruned cross-sum of the projections, plus the reward."""
    reward = problem.reward(j)
    width = max(len(problem.branch_range(other)) for other in problem.option_range(y))
    waiting: list[tuple[int, int, _Set]] = []
    for place, k in enumerate(problem.branch_range(j)):
        vectors = project(problem, sets, k, run.discount)
        successors = np.full((len(vectors), width), -1, dtype=np.int64)
        successors[:, place] = np.arange(len(vectors))
        part = run.prune(vectors, successors, beliefs)
        heapq.heappush(waiting, (len(part.vectors), place, part))
    number = width
    while len(waiting) > 1:
        left, right = heapq.heappop(waiting)[2], heapq.heappop(waiting)[2]
        total = run.sum(left, right)
        heapq.heappush(waiting, (len(total.vectors), number, total))
        number += 1
    if not waiting:
        uniform = np.full((1, len(reward)), 1 / len(reward))
        return _Set(reward[None, :].copy(), uniform, np.full((1, width), -1, dtype=np.int64))
    last = waiting[0][2]
    return _Set(last.vectors + reward, last.witnesses, last.successors, last.error)


def project(problem: Problem, sets: Sequence[FloatArray], k: int, discount: float) -> FloatArray:
    """discount * M_k alpha [n, n_y] for each alpha of the branch's class."""
    target = int(problem.arrays.branch_target[k])
    return np.ascontiguousarray((discount * (problem.matrices[k] @ sets[target].T)).T)
