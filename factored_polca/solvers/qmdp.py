"""QMDP: the POMDP as if its state were seen from the next step on (Littman, Cassandra & Kaelbling 1995).

    Q(i, j) = r_j(i) + gamma * sum over branches k of j, i' of M_k(i, i') V(i'),
    V(i)    = max over the options j of i's class of Q(i, j).

Seeing the state can only help, so Q*(b, j) <= sum over i of b(i) Q(i, j) at every belief b over the
class, and max over j bounds V*(b) from above.  The policy that takes the best j never takes an option
for what it reveals.  With min in place of max, V is what the worst policy earns that sees the state:
every policy earns at least that.

The fully observed process is an MDP over the kept states and one sink of value 0 for the mass that a
row misses; its bounds, rounding included, come from `solve_mdp`.

Letters as in `pomdp_problem`; p is a pair (j, i), at reward_start[j] + i as in `Arrays.rewards`; rho is
the largest sum of a row, 1 but for rounding or below.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import ArrayMDP, FloatArray, IntArray, SparseMatrix
from factored_polca.models.errors import ModelError
from factored_polca.solvers.choose import solve_mdp
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Bounds, Demand, POMDPSolution
from factored_polca.solvers.result import Guarantee, MDPSolution, Status

UNIT: Final = 2.0**-53

EPSILON: Final = 1e-9
"""The gap, as a share of the largest value, to which the fully observed process is solved."""


LEAST_REST: Final = 1e-10
"""1 - gamma must be more than this: else rounding is larger than any bound."""


@dataclass(frozen=True)
class ObservedProcess:
    """The pairs of a `Problem` with their transitions summed over the branches."""

    rows: SparseMatrix  # [p, i] CSR, rows may miss mass
    rewards: FloatArray  # [p]
    pair: IntArray  # [option within the class, i], -1: the class has fewer options
    widest: int  # the most entries of a row, counted branch by branch
    discount: float

    @property
    def states(self) -> int:
        """The number of kept states."""
        return int(self.rows.shape[1])

    @cached_property
    def sums(self) -> FloatArray:
        """[p] the mass of each row."""
        return np.asarray(self.rows @ np.ones(self.states), dtype=np.float64)

    @cached_property
    def rest(self) -> float:
        """A lower bound on 1 - gamma * rho: a backup moves a constant c to at most (1 - rest) c."""
        largest = float(self.sums.max(initial=0.0)) * (1 + 1e-14)
        return (1 - self.discount * max(1.0, largest)) * (1 - 8 * UNIT)

    def error(self, values: FloatArray) -> float:
        """What rounding may do to one backup from numbers as large as `values`.

        Holds for sums in any order over the entries of a row, however split into branches (Higham
        2002, section 3.1), the summing of `rows` included.
        """
        reward = float(np.abs(self.rewards).max(initial=0.0))
        size = float(np.abs(values).max(initial=0.0))
        return (self.widest + 16) * UNIT * (reward + size) * 1.001

    def backup(self, values: FloatArray) -> FloatArray:
        """r + gamma P V [p] from V [i]."""
        return np.asarray(self.rewards + self.discount * (self.rows @ values), dtype=np.float64)

    def mdp(self, sign: float = 1.0) -> ArrayMDP:
        """The process as an MDP with rewards times `sign`; the last state is the sink."""
        S = self.states
        missing = np.maximum(1.0 - self.sums, 0.0)
        transitions = []
        rewards = np.zeros((len(self.pair), S + 1))
        applicable = np.zeros((len(self.pair), S + 1), dtype=np.bool_)
        for number, pairs in enumerate(self.pair):
            here = np.flatnonzero(pairs >= 0)
            chosen = pairs[here]
            rewards[number, here] = sign * self.rewards[chosen]
            applicable[number, here] = True
            rows = self.rows[chosen]
            lost = np.flatnonzero(missing[chosen] > 0)
            owner = np.repeat(here, np.diff(rows.indptr))
            entries = np.concatenate([rows.data, missing[chosen][lost]])
            place = (
                np.concatenate([owner, here[lost]]),
                np.concatenate([rows.indices, np.full(len(lost), S)]),
            )
            transitions.append(csr_array((entries, place), shape=(S + 1, S + 1)))
        names = tuple(f"option {number}" for number in range(len(self.pair)))
        terminal = np.arange(S + 1) == S
        return ArrayMDP(names, tuple(transitions), rewards, applicable, terminal, self.discount)


def observed_process(problem: Problem) -> ObservedProcess:
    """The fully observed process of `problem`.

    Raises:
        ModelError: no discount below 1.
    """
    known = problem.cache.get("observed process")
    if isinstance(known, ObservedProcess):
        return known
    a, S = problem.arrays, len(problem.states)
    sizes = np.diff(a.offset)
    branch, state = branch_rows(problem)
    lengths = np.append(np.diff(a.row_start), 0)[: len(branch)]
    owner = np.repeat(a.reward_start[problem.branch_option[branch]] + state, lengths)
    column = a.column + np.repeat(a.offset[a.branch_target[branch]], lengths)
    rows = csr_array((a.probability, (owner, column)), shape=(len(a.rewards), S))
    rows.sum_duplicates()
    pair = np.full((int(np.diff(a.first_option).max(initial=0)), S), -1, dtype=np.int64)
    for j, y in enumerate(problem.option_class.tolist()):
        places = np.arange(sizes[y])
        pair[j - a.first_option[y], a.offset[y] + places] = a.reward_start[j] + places
    widest = int(np.bincount(owner).max(initial=0))
    process = ObservedProcess(rows, a.rewards, pair, widest, problem.discount)
    if not process.rest > LEAST_REST:
        raise ModelError(
            f"the discount is {problem.discount}: this solver's horizon is infinite and needs a discount "
            "below 1; lower it or give a finite horizon to a solver that takes one"
        )
    problem.cache["observed process"] = process
    return process


def branch_rows(problem: Problem) -> tuple[IntArray, IntArray]:
    """The branch, and the state within its class, of each place in `Arrays.row_start`.

    The last place of a branch (where its last row ends) is no row; its state is n_y.
    """
    count = np.diff(problem.arrays.offset)[problem.option_class][problem.branch_option] + 1
    branch = np.repeat(np.arange(problem.branches), count)
    return branch, np.arange(len(branch)) - problem.arrays.branch_rows[branch]


def corner_values(problem: Problem, vectors: FloatArray) -> FloatArray:
    """max over the options j of the class of Q(i, j), by state [i], from `vectors` [p]."""
    a = problem.arrays
    best = np.zeros(len(problem.states))
    for y in range(problem.classes):
        block = option_vectors(problem, vectors, y)
        best[a.offset[y] : a.offset[y + 1]] = block.max(axis=0)
    return best


def option_vectors(problem: Problem, vectors: FloatArray, y: int) -> FloatArray:
    """The part of `vectors` [p] for class y, as [option within the class, n_y] (a view)."""
    options = problem.option_range(y)
    start = int(problem.arrays.reward_start[options.start])
    size = problem.size(y)
    return vectors[start : start + len(options) * size].reshape(len(options), size)


def _solve(problem: Problem, demand: Demand | None, name: str, sign: float) -> MDPSolution:
    """The fully observed process with rewards times `sign`, over [i, sink]."""
    known = problem.cache.get(name)
    if isinstance(known, MDPSolution):
        return known
    demand = Demand() if demand is None else demand
    found = solve_mdp(
        observed_process(problem).mdp(sign),
        epsilon=EPSILON,
        deadline=demand.deadline,
        progress=_progress(problem, demand),
    )
    if found.converged:
        problem.cache[name] = found
    return found


def _progress(problem: Problem, demand: Demand) -> Callable[[int, float], None] | None:
    report = demand.progress
    if report is None:
        return None
    low, high = problem.reward_range
    rest = 1 - problem.discount
    lower, upper = min(low, 0.0) / rest, max(high, 0.0) / rest
    return lambda iterations, gap: report(lower, upper)


@dataclass(frozen=True)
class ObservedBound:
    """QMDP's vectors [p], an upper bound whatever the `status`."""

    vectors: FloatArray
    iterations: int
    status: Status


def qmdp_bound(problem: Problem, demand: Demand | None = None) -> ObservedBound:
    """Q from above, and why the solver of the fully observed process stopped.

    Raises:
        ModelError: no discount below 1.
    """
    process = observed_process(problem)
    if problem.classes == 0:
        return ObservedBound(np.zeros(0), 0, "converged")
    found = _solve(problem, demand, "best observed", 1.0)
    upper = found.upper[:-1]
    error = process.error(upper)
    vectors = process.backup(upper) + error * (1 + 1 / process.rest)
    return ObservedBound(vectors, found.iterations, found.status)


def qmdp_vectors(problem: Problem, demand: Demand | None = None) -> FloatArray:
    """Q [p], laid out as `problem.arrays.rewards`, from above: Q*(b, j) <= b . Q(., j).

    Raises:
        ModelError: no discount below 1.
        KeyboardInterrupt: Ctrl-C.
    """
    found = qmdp_bound(problem, demand)
    if found.status == "interrupted":
        raise KeyboardInterrupt
    return found.vectors


def worst_at_roots(problem: Problem, demand: Demand | None = None) -> tuple[FloatArray, Status]:
    """[root] at most what any policy of the POMDP earns, and why the solver stopped.

    Raises:
        ModelError: no discount below 1.
    """
    process = observed_process(problem)
    if problem.classes == 0:
        return np.zeros(0), "converged"
    found = _solve(problem, demand, "worst observed", -1.0)
    worst = -found.upper[:-1]
    below = process.error(worst) / process.rest + margin(problem, worst)
    offset = problem.arrays.offset
    values = [float(worst[offset[r.y] : offset[r.y + 1]] @ r.belief) for r in problem.roots]
    return np.array(values) - below, found.status


def margin(problem: Problem, values: FloatArray) -> float:
    """What rounding may do to the products of `values` with a belief, and to their sum at b0."""
    size = float(np.abs(values).max(initial=0.0))
    widest = int(np.diff(problem.arrays.offset).max(initial=0))
    return (widest + len(problem.roots) + 8) * UNIT * size * 1.001


def root_upper(problem: Problem, vectors: FloatArray) -> FloatArray:
    """[root] max over j of b . q_j from `vectors` [p], moved up by what rounding may do."""
    best = [float((option_vectors(problem, vectors, r.y) @ r.belief).max()) for r in problem.roots]
    return np.array(best) + margin(problem, vectors)


def solve_qmdp(problem: Problem, demand: Demand | None = None) -> POMDPSolution:
    """QMDP as a solver: its policy, its bound from above, the worst policy's value from below.

    "converged" says that the fully observed process was solved to within `EPSILON`.

    Raises:
        ModelError: no discount below 1.
    """
    began = time.perf_counter()
    found = qmdp_bound(problem, demand)
    words = "the policy is greedy for the fully observed process; what it earns is not known"
    return option_solution(
        problem, demand, found.vectors, "QMDP", found.status, found.iterations, words, began
    )


def option_solution(
    problem: Problem,
    demand: Demand | None,
    vectors: FloatArray,
    method: str,
    status: Status,
    iterations: int,
    words: str,
    began: float,
) -> POMDPSolution:
    """A heuristic policy from upper bounds `vectors` [p] on Q*; `began` is of `time.perf_counter()`."""
    blocks = [option_vectors(problem, vectors, y) for y in range(problem.classes)]
    actions = [problem.option_action[list(problem.option_range(y))] for y in range(problem.classes)]
    limits = Demand(deadline=0.0) if status == "interrupted" else demand
    lower, last = worst_at_roots(problem, limits)
    upper = root_upper(problem, vectors)
    low, high = problem.combine(lower), problem.combine(upper)
    seconds = time.perf_counter() - began
    return POMDPSolution(
        lower=low,
        upper=high,
        value=high,
        policy=problem.policy(blocks, actions, "heuristic"),
        root_lower=lower,
        root_upper=upper,
        status=last if status == "converged" else status,
        guarantee=Guarantee("heuristic", f"{words}; at least `lower`, what the worst policy earns"),
        method=method,
        vectors=problem.options,
        iterations=iterations,
        seconds=seconds,
        history=(Bounds(seconds, low, high),),
        note=f"{method}: `upper` bounds the optimal value, and is the method's own estimate",
    )
