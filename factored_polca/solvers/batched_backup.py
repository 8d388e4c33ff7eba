"""Point-based backups of many beliefs at once, as matrix products.

For beliefs B [m, n_y] over class y, a value function with the vectors Gamma_y' [n, n_y'] for each class,
and branch k of option j with matrix M_k and next class y':

    P_k     = B M_k                                       posteriors, not normalised
    w_k(b)  = argmax over alpha in Gamma_y' of P_k(b) . alpha      the winner
    Q(b, j) = b . r_j + gamma * sum over k of j of P_k(b) . w_k(b)
    alpha_b = r_j + gamma * sum over k of j of M_k w_k(b)     for the j of the largest Q(b, j)

(Pineau, Gordon & Thrun 2003, section 3; with matrix products over the pool as in Spaan & Vlassis 2005,
section 4, for the joint kernel).  Only distinct winners of the best option are projected.

A branch that b gives no chance adds nothing to Q; its winner, which the vector still needs to be a
bound elsewhere, is that of the uniform belief's posterior.

Ties: the first of the vectors, and the lowest of the options, within `TIE` times the best.  So results
do not hang on how products are cut up.

With options and winners fixed, and the winners among the vectors themselves, backups have a fixed point:
what a finite-state controller earns (Hansen 1998; `factored_polca.solvers.controllers`).  `evaluated`
finds it by repeated backups; GMRES gets rid of the few slow modes of a large discount.

What all branches share is kept in `Problem.cache`: M_k without its empty columns, dense if more than
`DENSE` of it is filled.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple, cast

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.linalg import LinearOperator, gmres

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.controllers import Controllers
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Demand

TIE: Final = 1e-12
DENSE: Final = 0.1
"""Share of entries from which a dense product is the faster one (measured at 16 to 256 beliefs)."""

CHUNK: Final = 2**18
"""Numbers in the largest intermediate array: 2 MB, so that it stays in cache."""

KRYLOV: Final = 12
"""Directions that GMRES keeps at a time."""

SWEEPS: Final = 12
"""Backups before each of them: per step a quarter of the time, and mostly they do."""

CYCLES: Final = 8
"""Most restarts of GMRES in one evaluation."""

_CACHE: Final = "factored_polca.solvers.batched_backup"


class Step(NamedTuple):
    """A branch, ready for products."""

    target: int
    columns: IntArray  # [c] those of M_k with an entry
    matrix: Any  # [n_y, c], dense or CSR
    transposed: Any  # [c, n_y]
    chance: FloatArray  # [n_y] P(k | i), the rows' sums
    mean: FloatArray  # [c] the posterior of the uniform belief, n_y times


class Choices(NamedTuple):
    """The first half of a backup at each of m beliefs."""

    options: IntArray  # [m] the best option j
    winners: IntArray  # [m, widest] place in Gamma of the winner of each branch of j, in order; then -1
    values: FloatArray  # [m] Q(b, j), with the beliefs' mass


def steps(problem: Problem) -> Sequence[Step]:
    """[k] the branches of `problem`, made once."""
    found = problem.cache.get(_CACHE)
    if found is None:
        targets = problem.arrays.branch_target.tolist()
        found = tuple(_step(y, matrix) for y, matrix in zip(targets, problem.matrices, strict=True))
        problem.cache[_CACHE] = found
    return cast("Sequence[Step]", found)


def _step(target: int, matrix: Any) -> Step:
    columns = np.unique(matrix.indices).astype(np.int64)
    compact = csr_array(
        (matrix.data, np.searchsorted(columns, matrix.indices), matrix.indptr),
        shape=(matrix.shape[0], len(columns)),
    )
    chance = np.asarray(compact.sum(axis=1), dtype=np.float64)
    mean = np.asarray(compact.sum(axis=0), dtype=np.float64)
    if compact.nnz > DENSE * compact.shape[0] * compact.shape[1]:
        dense = compact.toarray()
        return Step(target, columns, dense, np.ascontiguousarray(dense.T), chance, mean)
    return Step(target, columns, compact, csr_array(compact.T), chance, mean)


def posteriors(step: Step, beliefs: FloatArray) -> FloatArray:
    """B M_k [m, c] on the columns of the branch."""
    if isinstance(step.matrix, np.ndarray):
        return beliefs @ step.matrix
    product: FloatArray = (step.transposed @ np.ascontiguousarray(beliefs.T)).T
    return product


def backup(
    problem: Problem, sets: Sequence[FloatArray], y: int, beliefs: FloatArray
) -> tuple[FloatArray, IntArray]:
    """The vectors [m, n_y] backed up at `beliefs` [m, n_y] over class y, and their options [m].

    `sets` [y'] are the vectors [n, n_y'] of each class, at least one in each.
    """
    found = choices(problem, sets, y, beliefs)
    return projected(problem, sets, y, found.options, found.winners), found.options


def choices(
    problem: Problem,
    sets: Sequence[FloatArray],
    y: int,
    beliefs: FloatArray,
    poll: Callable[[], None] | None = None,
) -> Choices:
    """The best option at each of `beliefs` [m, n_y], and the winners of its branches.

    `poll` is called now and then, and may raise.
    """
    options = problem.option_range(y)
    branches = [problem.branch_range(j) for j in options]
    m = len(beliefs)
    result = Choices(np.zeros(m, dtype=np.int64), np.full((m, widest(problem, y)), -1), np.zeros(m))
    for part in _chunks(problem, sets, y, m):
        if poll is not None:
            poll()
        q, best_by_branch = _tables(problem, sets, y, beliefs[part])
        best = first_of_best(q)
        result.options[part] = best + options.start
        result.values[part] = q[np.arange(len(q)), best]
        for place, own in enumerate(branches):
            mine = np.flatnonzero(best == place)
            at = own.start - branches[0].start
            result.winners[part.start + mine, : len(own)] = best_by_branch[mine, at : at + len(own)]
    return result


def winners(
    problem: Problem, sets: Sequence[FloatArray], y: int, beliefs: FloatArray, options: IntArray
) -> IntArray:
    """The winners [m, widest], as in `Choices`, at `beliefs` [m, n_y] with `options` [m] given."""
    result = np.full((len(beliefs), widest(problem, y)), -1)
    for j in np.unique(options).tolist():
        mine = np.flatnonzero(options == j)
        for place, k in enumerate(problem.branch_range(j)):
            step = steps(problem)[k]
            vectors = sets[step.target][:, step.columns]
            after = posteriors(step, beliefs[mine])
            after[after.sum(axis=1) <= 0] = step.mean
            result[mine, place] = best_vectors(after, vectors)[0]
    return result


def widest(problem: Problem, y: int) -> int:
    """The most branches of an option of class y."""
    return max((len(problem.branch_range(j)) for j in problem.option_range(y)), default=0)


def q_values(problem: Problem, sets: Sequence[FloatArray], y: int, beliefs: FloatArray) -> FloatArray:
    """Q(b, j) [m, options of y] one step ahead of the value function `sets`."""
    parts = _chunks(problem, sets, y, len(beliefs))
    tables = [_tables(problem, sets, y, beliefs[part])[0] for part in parts]
    return np.concatenate([np.zeros((0, len(problem.option_range(y)))), *tables])


def projected(
    problem: Problem, sets: Sequence[FloatArray], y: int, options: IntArray, winners: IntArray
) -> FloatArray:
    """r_j + gamma * sum over k of M_k w_k [m, n_y] for options j [m] of class y, winners w [m, widest]."""
    result = np.empty((len(options), problem.size(y)))
    for j in np.unique(options).tolist():
        mine = np.flatnonzero(options == j)
        total = np.zeros((len(mine), problem.size(y)))
        for place, k in enumerate(problem.branch_range(j)):
            step = steps(problem)[k]
            distinct, which = np.unique(winners[mine, place], return_inverse=True)
            vectors = np.ascontiguousarray(sets[step.target][distinct][:, step.columns].T)
            total += np.ascontiguousarray((step.matrix @ vectors).T)[which]
        result[mine] = problem.reward(j) + problem.discount * total
    return result


def evaluated(controllers: Controllers, start: FloatArray, goal: float, demand: Demand) -> FloatArray:
    """The vectors [x] of the controllers, from below, within about `goal` if that is soon reached.

    Backups and GMRES (Saad & Schultz 1986) in turn from `start` [x]; polls the demand's deadline.

    Raises:
        TimeIsUp: the deadline has passed.
    """
    moves, rest = controllers.moves, controllers.rest()

    def apply(vector: FloatArray) -> FloatArray:
        demand.poll()
        result: FloatArray = vector - moves @ vector
        return result

    system = LinearOperator(moves.shape, matvec=apply, dtype=np.float64)
    vectors = start
    for _ in range(CYCLES):
        for _ in range(SWEEPS):
            demand.poll()
            vectors = controllers.backup(vectors)
        change = controllers.backup(vectors) - vectors
        if float(np.abs(change).max(initial=0.0)) + controllers.error(vectors) <= goal * rest:
            break
        vectors = vectors + gmres(system, change, rtol=1e-12, restart=KRYLOV, maxiter=1)[0]
    return controllers.from_below(vectors)


def first_of_best(worth: FloatArray) -> IntArray:
    """The first column [m] of `worth` [m, n] that is within `TIE` times the best."""
    best = worth.max(axis=1)
    near: IntArray = (worth >= (best - TIE * np.abs(best))[:, None]).argmax(axis=1)
    return near


def best_vectors(beliefs: FloatArray, vectors: FloatArray) -> tuple[IntArray, FloatArray]:
    """The place of the best of `vectors` [n, n_y] at each of `beliefs` [m, n_y], and its worth there."""
    places = np.zeros(len(beliefs), dtype=np.int64)
    worth = np.zeros(len(beliefs))
    length = max(32, CHUNK // max(1, len(vectors)))
    for start in range(0, len(beliefs), length):
        part = slice(start, start + length)
        table = beliefs[part] @ vectors.T
        places[part] = first_of_best(table)
        worth[part] = table.max(axis=1)
    return places, worth


def _chunks(problem: Problem, sets: Sequence[FloatArray], y: int, m: int) -> Iterator[slice]:
    targets = {steps(problem)[k].target for j in problem.option_range(y) for k in problem.branch_range(j)}
    numbers = max([problem.size(y), *(max(len(sets[t]), problem.size(t)) for t in targets)])
    length = max(32, CHUNK // numbers)
    for start in range(0, m, length):
        yield slice(start, min(start + length, m))


def _tables(
    problem: Problem, sets: Sequence[FloatArray], y: int, beliefs: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Q(b, j) [m, option of y], and the winners [m, branch of y]."""
    options = problem.option_range(y)
    m = len(beliefs)
    q = np.empty((m, len(options)))
    won = np.empty((m, sum(len(problem.branch_range(j)) for j in options)), dtype=np.int64)
    place = 0
    for number, j in enumerate(options):
        future = np.zeros(m)
        for k in problem.branch_range(j):
            step = steps(problem)[k]
            vectors = sets[step.target][:, step.columns]
            likely = np.flatnonzero(beliefs @ step.chance > 0)
            if len(likely) < m:
                won[:, place] = first_of_best(step.mean[None, :] @ vectors.T)[0]
            if len(likely):
                worth = posteriors(step, beliefs if len(likely) == m else beliefs[likely]) @ vectors.T
                first = first_of_best(worth)
                won[likely, place] = first
                future[likely] += worth[np.arange(len(first)), first]
            place += 1
        q[:, number] = beliefs @ problem.reward(j) + problem.discount * future
    return q, won
