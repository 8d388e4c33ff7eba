"""The tighter informed bound (TIB; Krale, Koops, Junges, Simao & Jansen 2025, arXiv 2502.06523): the
POMDP as if its state became known one step late, for the joint kernel, by class, with lost mass.

*The points.*  Row i of a branch's matrix M_k is p(k | i) b_{i,k}: what is known after the branch when
i was the state before it.  With the corners e_i they form a finite set of points n, belief b_n over
class y_n; equal ones are one.  For any belief b over the class of the option j and a branch k of j,

    b M_k = sum over i of b(i) p(k | i) b_{i,k}.

*The bound.*  Q solves, at each point n and for each option j of its class,

    Q(b, j) = b . r_j + gamma * sum over branches k of j of
                  max over options j' of k's target of sum over i of b(i) p(k | i) Q(b_{i,k}, j')   (G)

with b = b_n; (G) at any other b defines Q(b, j) from the points', and U(b) = max_j Q(b, j).

*Sound at every step.*  Q*(., j') is positively homogeneous and convex.  So if Q(b_n, j') >= Q*(b_n, j')
at all points, then V*(b M_k) = max_j' Q*(b M_k, j') is at most the max in (G), and (G) gives a number
>= Q*(b, j) again.  This holds component by component: updates in place from an upper bound are sound
whenever they stop.  Rows that miss mass need nothing special: V* is 0 there, and (G) adds nothing.

*Tighter than FIB.*  Start from Q(b_n, j) = b_n . q_j with FIB's fixed point q = H q.  The sum over i in
(G) then equals (b M_k) . q_j', and a max over j' of a sum over i is at most the sum of the maxima:
the first step does not rise, and by monotony no later one does.

*Rounding.*  Each component is computed with an error of at most e (the sums over i and i', and the
normalising of b_{i,k}); beliefs merged as equal may be a distance d apart in L1, which changes Q* by at
most d * max |Q*|.  As for FIB (e + d max |Q*|) / (1 - gamma rho) is added at the end.

Letters as in `pomdp_problem`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.compiled import kernel
from factored_polca.solvers.evaluation import TimeIsUp
from factored_polca.solvers.fast_informed import fast_informed
from factored_polca.solvers.pomdp_problem import Arrays, Problem
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.solvers.qmdp import UNIT, branch_rows, observed_process
from factored_polca.solvers.result import Status

DIGITS: Final = 12
"""Beliefs that agree to so many decimals are one point."""

CHUNK: Final = 2_000_000
"""Terms after which a sweep lets Python look at the clock."""

TERMS: Final = 10_000_000_000
"""Terms of all sweeps together after which they stop: some ten seconds."""


class Points(NamedTuple):
    """The points and their Q-values as flat arrays, for kernels; the first are the corners, by state.

    `reached` and `mass` stand beside `Arrays.row_start`: row i of branch k, at branch_rows[k] + i, leads
    to the point `reached` with the probability `mass` = p(k | i) (0: to none).
    """

    start: IntArray  # [n + 1] the belief of point n is column, weight [start[n] : start[n + 1]]
    column: IntArray  # [entry] state within the class
    weight: FloatArray  # [entry]
    y: IntArray  # [n] class
    q_start: IntArray  # [n + 1] Q(b_n, .) is q[q_start[n] : q_start[n + 1]], by option of the class
    q: FloatArray
    reached: IntArray
    mass: FloatArray


@kernel
def _option_value(
    arrays: Arrays,
    points: Points,
    discount: float,
    j: int,
    columns: IntArray,
    weights: FloatArray,
    sums: FloatArray,
) -> float:
    """(G) for one option at the belief `columns`, `weights`; `sums` is working space."""
    reward = 0.0
    for entry in range(len(columns)):
        reward += weights[entry] * arrays.rewards[arrays.reward_start[j] + columns[entry]]
    total = 0.0
    for k in range(arrays.first_branch[j], arrays.first_branch[j + 1]):
        y = arrays.branch_target[k]
        options = arrays.first_option[y + 1] - arrays.first_option[y]
        sums[:options] = 0.0
        met = False
        for entry in range(len(columns)):
            at = arrays.branch_rows[k] + columns[entry]
            weight = weights[entry] * points.mass[at]
            if weight > 0:
                met = True
                place = points.q_start[points.reached[at]]
                for other in range(options):
                    sums[other] += weight * points.q[place + other]
        if met:
            best = sums[0]
            for other in range(1, options):
                best = max(best, sums[other])
            total += best
    return float(reward + discount * total)


@kernel
def _sweep(
    arrays: Arrays, points: Points, discount: float, first: int, last: int, sums: FloatArray
) -> float:
    """(G) in place at the points first .. last - 1; the largest change."""
    largest = 0.0
    for n in range(first, last):
        here = slice(points.start[n], points.start[n + 1])
        y = points.y[n]
        for j in range(arrays.first_option[y], arrays.first_option[y + 1]):
            place = points.q_start[n] + j - arrays.first_option[y]
            new = _option_value(arrays, points, discount, j, points.column[here], points.weight[here], sums)
            largest = max(largest, abs(new - points.q[place]))
            points.q[place] = new
    return largest


@kernel
def delayed_value(
    arrays: Arrays,
    points: Points,
    discount: float,
    y: int,
    columns: IntArray,
    weights: FloatArray,
    sums: FloatArray,
) -> float:
    """U at the belief with `weights` at `columns` of class y, without `DelayedBound.error`.

    `sums` is working space, as long as the most options of a class.
    """
    best = -np.inf
    for j in range(arrays.first_option[y], arrays.first_option[y + 1]):
        best = max(best, _option_value(arrays, points, discount, j, columns, weights, sums))
    return best


@dataclass(frozen=True)
class DelayedBound:
    """Upper bounds Q(b_n, j) >= Q*(b_n, j) at finitely many points, and by (G) everywhere."""

    problem: Problem
    points: Points
    error: float  # what rounding may do to `delayed_value`: add it
    sweeps: int
    status: Status

    @property
    def count(self) -> int:
        """The number of points, corners included."""
        return len(self.points.y)

    @property
    def vectors(self) -> FloatArray:
        """[p] Q(e_i, j) laid out as `Arrays.rewards`: Q*(b, j) <= b . vectors_j, as of FIB."""
        a, points = self.problem.arrays, self.points
        result = np.zeros(len(a.rewards))
        for j, y in enumerate(self.problem.option_class.tolist()):
            size = self.problem.size(y)
            corners = np.arange(a.offset[y], a.offset[y + 1])
            own = points.q[points.q_start[corners] + j - a.first_option[y]]
            result[a.reward_start[j] : a.reward_start[j] + size] = own
        return result

    @property
    def point_values(self) -> FloatArray:
        """[n] max over j of Q(b_n, j), at least V*(b_n)."""
        if self.count == 0:
            return np.zeros(0)
        best: FloatArray = np.maximum.reduceat(self.points.q, self.points.q_start[:-1])
        return best

    @property
    def corner_values(self) -> FloatArray:
        """[i] U at the corners."""
        return self.point_values[: len(self.problem.states)]

    def belief(self, n: int) -> FloatArray:
        """b_n [n_y], dense."""
        points = self.points
        here = slice(int(points.start[n]), int(points.start[n + 1]))
        result = np.zeros(self.problem.size(int(points.y[n])))
        result[points.column[here]] = points.weight[here]
        return result

    def value(self, y: int, belief: FloatArray) -> float:
        """U at a belief [n_y] over class y; at least V* there."""
        columns = np.flatnonzero(belief)
        a = self.problem.arrays
        sums = np.zeros(int(np.diff(a.first_option).max()))
        weights = np.ascontiguousarray(belief[columns])
        worth = delayed_value(a, self.points, self.problem.discount, y, columns, weights, sums)
        return float(worth) + self.error * float(weights.sum())


def delayed_bound(
    problem: Problem,
    start: FloatArray | None = None,
    *,
    tolerance: float = 1e-4,
    sweeps: int | None = None,
    terms: int = TERMS,
    demand: Demand | None = None,
) -> DelayedBound:
    """The bound by sweeps in place until the fixed point is within `tolerance` * max(1, max |Q|).

    `start` [p]: vectors with Q*(b, j) <= b . start_j, by default FIB's.  Stops early after `sweeps`
    sweeps or `terms` terms of (G), at the demand's deadline, or on Ctrl-C (its other limits are the
    caller's).  The bound holds in each case; with no sweep at all it is `start` one step ahead.

    Raises:
        ModelError: no discount below 1.
    """
    demand = Demand() if demand is None else demand
    process = observed_process(problem)
    first: Status = "converged"
    if start is None:
        known = fast_informed(problem, tolerance=0.1 * tolerance, demand=demand)
        start, first = known.vectors, known.status
    table = _point_table(problem)
    points = table.points(problem, start)
    error = _error(problem, table.apart)
    ratio = (1 - process.rest) / process.rest
    scale = max(1.0, float(np.abs(points.q).max(initial=0.0)))
    before = points.q + 2 * error
    goals = (tolerance * scale, 2 * error)
    done, status = 0, first
    if first != "interrupted":
        done, status = _iterate(problem, points, goals, ratio, (sweeps, terms), demand)
    points.q[:] += error * 1.01 / process.rest + 4 * UNIT * np.abs(points.q)
    np.minimum(points.q, before, out=points.q)
    return DelayedBound(problem, points, error, done, status)


def _iterate(
    problem: Problem,
    points: Points,
    goals: tuple[float, float],
    ratio: float,
    limits: tuple[int | None, int],
    demand: Demand,
) -> tuple[int, Status]:
    """Sweeps in place until `goals` (distance, or change in the noise) or `limits` (sweeps, terms)."""
    sums = np.zeros(int(np.diff(problem.arrays.first_option).max(initial=0)))
    parts = _chunks(problem, points)
    wanted, noise = goals
    sweeps = spent = 0
    try:
        while True:
            _report(problem, points, demand)
            if limits[0] is not None and sweeps >= limits[0]:
                return sweeps, "iteration limit"
            change = 0.0
            for first, last, size in parts:
                demand.poll()
                if spent + size > limits[1]:
                    return sweeps, "iteration limit"
                spent += size
                moved = _sweep(problem.arrays, points, problem.discount, first, last, sums)
                change = max(change, moved)
            sweeps += 1
            if change * ratio <= wanted:
                return sweeps, "converged"
            if change <= noise:
                return sweeps, "rounding limit"
    except TimeIsUp:
        return sweeps, "time limit"
    except KeyboardInterrupt:
        return sweeps, "interrupted"


def _report(problem: Problem, points: Points, demand: Demand) -> None:
    if demand.progress is None:
        return
    offset = problem.arrays.offset
    best = np.maximum.reduceat(points.q, points.q_start[:-1]) if len(points.y) else np.zeros(0)
    upper = [float(best[offset[r.y] : offset[r.y + 1]] @ r.belief) for r in problem.roots]
    low = min(problem.reward_range[0], 0.0) / (1 - problem.discount)
    demand.progress(low, problem.combine(upper))


def _chunks(problem: Problem, points: Points) -> list[tuple[int, int, int]]:
    """(first, last, terms) for ranges of points that take about `CHUNK` terms each."""
    a = problem.arrays
    options = np.diff(a.first_option)
    mine = problem.option_class[problem.branch_option]
    load = np.bincount(mine, weights=options[a.branch_target], minlength=problem.classes)
    total = np.cumsum(np.diff(points.start) * (load[points.y] + 1)).astype(np.int64)
    ends = np.flatnonzero(np.diff(total // CHUNK, append=-1)) + 1
    bounds = [0, *ends.tolist()]
    before = np.concatenate([[0], total])
    return [(first, last, int(before[last] - before[first])) for first, last in pairwise(bounds)]


def _error(problem: Problem, apart: float) -> float:
    """What rounding and merging may do to one evaluation of (G)."""
    a, process = problem.arrays, observed_process(problem)
    span = float(np.abs(a.rewards).max(initial=0.0)) / process.rest
    widest = int(np.diff(a.offset).max(initial=0)) + int(np.diff(a.first_branch).max(initial=0))
    return ((widest + 32) * UNIT * 3 + apart) * span * 1.001


@dataclass(frozen=True)
class _PointTable:
    """The points without their values; `apart` is the largest L1 distance of merged beliefs."""

    lengths: IntArray
    column: IntArray
    weight: FloatArray
    y: IntArray
    reached: IntArray
    mass: FloatArray
    apart: float

    def points(self, problem: Problem, vectors: FloatArray) -> Points:
        """The points with Q(b_n, j) = b_n . vectors_j."""
        a = problem.arrays
        options = np.diff(a.first_option)[self.y]
        q_start = np.concatenate([[0], np.cumsum(options)]).astype(np.int64)
        q = np.zeros(int(q_start[-1]))
        owner = np.repeat(np.arange(len(self.y)), self.lengths)
        for number in range(int(options.max(initial=0))):
            here = np.flatnonzero(options[owner] > number)
            n = owner[here]
            place = a.reward_start[a.first_option[self.y[n]] + number] + self.column[here]
            q += np.bincount(
                q_start[n] + number, weights=self.weight[here] * vectors[place], minlength=len(q)
            )
        start = np.concatenate([[0], np.cumsum(self.lengths)]).astype(np.int64)
        return Points(start, self.column, self.weight, self.y, q_start, q, self.reached, self.mass)


def _point_table(problem: Problem) -> _PointTable:
    """The corners, and the different normalised rows of all branches."""
    a, S = problem.arrays, len(problem.states)
    sizes = np.diff(a.offset)
    branch, _ = branch_rows(problem)
    length = np.append(np.diff(a.row_start), 0)[: len(branch)]
    target = a.branch_target[branch]
    full = np.flatnonzero(length)
    mass, reached = np.zeros(len(branch)), np.zeros(len(branch), dtype=np.int64)
    if len(full):
        mass[full] = np.add.reduceat(a.probability, a.row_start[full])
    classes = [np.repeat(np.arange(problem.classes), sizes)]
    lengths, weight = [np.ones(S, dtype=np.int64)], [np.ones(S)]
    column = [np.arange(S) - a.offset[classes[0]]]
    count, apart = S, 0.0
    for entries in np.unique(length[full]).tolist():
        rows = np.flatnonzero(length == entries)
        places = a.row_start[rows][:, None] + np.arange(entries)
        columns, weights = a.column[places], a.probability[places] / mass[rows][:, None]
        if entries == 1:
            reached[rows] = a.offset[target[rows]] + columns[:, 0]
            continue
        first, number = _different(target[rows], columns, weights)
        reached[rows] = count + number
        apart = max(apart, float(np.abs(weights - weights[first[number]]).sum(axis=1).max()))
        classes.append(target[rows][first])
        lengths.append(np.full(len(first), entries, dtype=np.int64))
        column.append(columns[first].reshape(-1))
        weight.append(weights[first].reshape(-1))
        count += len(first)
    return _PointTable(
        np.concatenate(lengths),
        np.concatenate(column),
        np.concatenate(weight),
        np.concatenate(classes),
        reached,
        mass,
        apart,
    )


def _different(target: IntArray, columns: IntArray, weights: FloatArray) -> tuple[IntArray, IntArray]:
    """The different ones among beliefs [row, entry]: the first row of each, and each row's number."""
    decimals = np.round(weights * 10**DIGITS).astype(np.int64)
    keys = np.hstack([target[:, None], columns, decimals])
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return first, number.reshape(-1)
