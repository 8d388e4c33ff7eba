"""The fast informed bound (FIB; Hauskrecht 2000, section 4.4), for the joint kernel and by class.

    q_j(i) = r_j(i) + gamma * sum over branches k of j of
                 max over options j' of k's target of sum over i' of M_k(i, i') q_j'(i')        (H q = q)

*Sound at every step.*  Suppose Q*(b, j) <= b . q_j for all beliefs b and options j.  Then

    Q*(b, j)  = b . r_j + gamma * sum_k V*(b M_k)
             <= b . r_j + gamma * sum_k max_j' sum_i b(i) sum_i' M_k(i, i') q_j'(i')
             <= sum_i b(i) (H q)_j(i),

as the max of a sum is at most the sum of the maxima.  This holds component by component, so updates in
place (Gauss-Seidel) are as good, and stopping early is sound.  What matters is that the *start* is an
upper bound; QMDP's vectors are one, also where mass is lost to dead states and rewards are negative.

*Rounding.*  If each component is computed with an error of at most e, q + e / (1 - gamma rho) stays an
upper bound by the same induction (rho: the largest sum of a row), so that is added at the end.

From QMDP's vectors, q >= H q, and the sweeps descend to the fixed point; one in which no component falls
by more than d leaves it at most d gamma rho / (1 - gamma rho) away.

Letters as in `pomdp_problem`; vectors [p] are laid out as `Arrays.rewards`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Final

import numpy as np

from factored_polca.explicit.arrays import FloatArray
from factored_polca.solvers.compiled import kernel, plain
from factored_polca.solvers.evaluation import TimeIsUp
from factored_polca.solvers.pomdp_problem import Arrays, Problem
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.qmdp import (
    UNIT,
    corner_values,
    observed_process,
    option_solution,
    qmdp_bound,
)
from factored_polca.solvers.result import Status

__all__ = ["FastInformed", "corner_values", "fast_informed", "fast_informed_vectors", "solve_fib"]

TINY: Final = 60
"""Terms of one sweep up to which the plain Python function takes less time than loading machine code."""


@kernel
def _sweep(arrays: Arrays, discount: float, vectors: FloatArray, backward: bool) -> float:
    """One pass in place over all options and states; the largest change."""
    largest = 0.0
    options = len(arrays.reward_start)
    for number in range(options):
        j = options - 1 - number if backward else number
        first, last = arrays.first_branch[j], arrays.first_branch[j + 1]
        start = arrays.reward_start[j]
        end = arrays.reward_start[j + 1] if j + 1 < options else len(arrays.rewards)
        for i in range(end - start):
            total = 0.0
            for k in range(first, last):
                at = arrays.branch_rows[k] + i
                low, high = arrays.row_start[at], arrays.row_start[at + 1]
                if low == high:
                    continue
                y = arrays.branch_target[k]
                best = -np.inf
                for other in range(arrays.first_option[y], arrays.first_option[y + 1]):
                    place = arrays.reward_start[other]
                    expected = 0.0
                    for entry in range(low, high):
                        expected += arrays.probability[entry] * vectors[place + arrays.column[entry]]
                    best = max(best, expected)
                total += best
            new = arrays.rewards[start + i] + discount * total
            largest = max(largest, abs(new - vectors[start + i]))
            vectors[start + i] = new
    return largest


@dataclass(frozen=True)
class FastInformed:
    """The vectors [p] after some sweeps, an upper bound whatever the `status`."""

    vectors: FloatArray
    sweeps: int
    distance: float  # to the fixed point, at most (where the start was QMDP's vectors)
    status: Status


def fast_informed(
    problem: Problem,
    start: FloatArray | None = None,
    *,
    tolerance: float = 1e-9,
    sweeps: int | None = None,
    demand: Demand | None = None,
) -> FastInformed:
    """FIB by sweeps in place until the fixed point is within `tolerance` * max(1, max |q|).

    `start` [p] must satisfy Q*(b, j) <= b . start_j for all b and j; by default it is QMDP's vectors.
    Stops early after `sweeps` sweeps, at the demand's deadline, or on Ctrl-C (its other limits are the
    caller's).

    Raises:
        ModelError: no discount below 1.
    """
    demand = Demand() if demand is None else demand
    process = observed_process(problem)
    first: Status = "converged"
    if start is None:
        known = qmdp_bound(problem, demand)
        start, first = known.vectors, known.status
    if first == "interrupted":
        return FastInformed(start, 0, np.inf, first)
    vectors = start.copy()
    error = process.error(vectors)
    goal = tolerance * max(1.0, float(np.abs(vectors).max(initial=0.0)))
    noise = 2 * error / process.rest
    done, distance, status = _iterate(problem, vectors, (goal, noise), sweeps, demand)
    vectors = np.minimum(vectors + error / process.rest + 4 * UNIT * np.abs(vectors), start)
    return FastInformed(vectors, done, distance + noise, first if status == "converged" else status)


def _iterate(
    problem: Problem,
    vectors: FloatArray,
    goals: tuple[float, float],
    limit: int | None,
    demand: Demand,
) -> tuple[int, float, Status]:
    """Sweeps in place until the distance to the fixed point is wanted, or rounding, or a limit is met."""
    rest = observed_process(problem).rest
    sweep = plain(_sweep) if _terms(problem) <= TINY else _sweep
    wanted, noise = goals
    sweeps, distance = 0, np.inf
    try:
        while True:
            _report(problem, demand, vectors)
            if limit is not None and sweeps >= limit:
                return sweeps, distance, "iteration limit"
            demand.poll()
            change = sweep(problem.arrays, problem.discount, vectors, sweeps % 2 == 1)
            sweeps += 1
            distance = change * (1 - rest) / rest
            if distance <= wanted:
                return sweeps, distance, "converged"
            if distance <= noise:
                return sweeps, distance, "rounding limit"
    except TimeIsUp:
        return sweeps, distance, "time limit"
    except KeyboardInterrupt:
        return sweeps, distance, "interrupted"


def _report(problem: Problem, demand: Demand, vectors: FloatArray) -> None:
    if demand.progress is not None:
        corners = corner_values(problem, vectors)
        offset = problem.arrays.offset
        upper = [float(corners[offset[r.y] : offset[r.y + 1]] @ r.belief) for r in problem.roots]
        low = problem.reward_range[0]
        demand.progress(min(low, 0.0) / (1 - problem.discount), problem.combine(upper))


def _terms(problem: Problem) -> int:
    options = np.diff(problem.arrays.first_option)[problem.arrays.branch_target]
    lengths = [matrix.nnz for matrix in problem.matrices] if problem.branches <= TINY else [TINY]
    return int(np.dot(options, lengths)) if len(lengths) == len(options) else TINY + 1


def fast_informed_vectors(
    problem: Problem,
    start: FloatArray | None = None,
    *,
    tolerance: float = 1e-9,
    sweeps: int | None = None,
    demand: Demand | None = None,
) -> FloatArray:
    """FIB's vectors q [p]: Q*(b, j) <= b . q_j at every belief b over j's class.

    `start` [p] must be such vectors too (QMDP's by default); see `fast_informed`.  `sweeps` limits their
    number.

    Raises:
        ModelError: no discount below 1.
        KeyboardInterrupt: Ctrl-C.
    """
    found = fast_informed(problem, start, tolerance=tolerance, sweeps=sweeps, demand=demand)
    if found.status == "interrupted":
        raise KeyboardInterrupt
    return found.vectors


def solve_fib(problem: Problem, demand: Demand | None = None) -> POMDPSolution:
    """The fast informed bound as a solver: greedy policy, bound from above, the worst policy from below.

    `demand.iterations` counts sweeps; "converged" says that the fixed point is within 1e-9 of its scale.

    Raises:
        ModelError: no discount below 1.
    """
    began = time.perf_counter()
    found = fast_informed(problem, sweeps=None if demand is None else demand.iterations, demand=demand)
    words = "the policy is greedy for the fast informed bound; what it earns is not known"
    return option_solution(problem, demand, found.vectors, "FIB", found.status, found.sweeps, words, began)
