"""What PBVI and Perseus share: backups at a pool of beliefs, and the value of the controllers they make.

*Policy evaluation* (Ji, Parr, Li, Liao & Carin 2007; Hansen 1998).  A backed-up vector is a node of a
finite-state controller: it takes its option, and after each branch goes to the node that is the best
at the posterior of the belief it was backed up at.  Solving for the nodes' value takes the place of
some hundred rounds of backups.

The nodes' vectors, certified as `controllers` says, form the returned policy: at each belief it takes
the option of the best vector alpha.  As alpha is at most its own backup by vectors of the set, V <= Q(.,
that option) for V the maximum over the set, so this policy earns at least V.  (Of the plain set that
point-based backups leave behind this is not so: vectors that others were built on have been dropped.)
Where a later controller is better at some roots only, the union of the two is kept: it has this property
as well.

Gamma holds, of the evaluated nodes, the plain backups and the old vectors, those that are the best at
some belief of B.  So values at B never fall.  All are lower bounds of V* everywhere.

The upper bound is fixed: that of delayed observation (`factored_polca.solvers.delayed`).

Letters as in `pomdp_problem` and `batched_backup`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.batched_backup import best_vectors, choices, evaluated, projected, winners
from factored_polca.solvers.belief_pool import BeliefPool, root_pool
from factored_polca.solvers.blind import blind_vectors
from factored_polca.solvers.controllers import Controllers, blind_controllers, joined
from factored_polca.solvers.delayed import DelayedBound, delayed_bound
from factored_polca.solvers.evaluation import TimeIsUp
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Bounds, Demand, POMDPSolution
from factored_polca.solvers.qmdp import margin, observed_process
from factored_polca.solvers.result import Guarantee, Status

POOL: Final = 8192
"""Beliefs in the largest pool, where memory allows."""

NUMBERS: Final = 2**24
"""Numbers in the largest pool, and entries of its controllers: 128 MB, and about thrice that."""

ROUNDS: Final = 6
"""Most iterations with a pool that will still grow."""

LAST_ROUNDS: Final = 60
"""Most iterations with the largest pool."""

PRECISION: Final = 0.02
"""Controllers are evaluated to within this share of the last rise of the values."""

SETTLED: Final = 0.01
"""A pool is worked on while values rise by more than this share of the largest gap at a root."""


class Nodes(NamedTuple):
    """Distinct backups at beliefs of one class."""

    beliefs: FloatArray  # [n, n_y] where each was made
    options: IntArray  # [n]
    vectors: FloatArray  # [n, n_y]


class Certified(NamedTuple):
    """A controller with its vectors [x], certified: a policy that earns at least their maximum."""

    controllers: Controllers
    vectors: FloatArray  # [x]
    root_lower: FloatArray  # [root]


Update: TypeAlias = Callable[["Run", int], Nodes]
"""(run, class) -> the backups of one iteration for a class with beliefs in the pool."""


class Run:
    """The working state of one run of PBVI or Perseus."""

    def __init__(self, problem: Problem, demand: Demand | None, above: DelayedBound | None = None) -> None:
        """`above` is the bound with delayed observations, where it has been computed already."""
        self.began = time.perf_counter()
        self.problem = problem
        self.demand = Demand() if demand is None else demand
        self.process = observed_process(problem)  # refuses a discount of 1
        self.rng = np.random.default_rng(self.demand.seed)
        self.status: Status | None = None
        self.iterations = 0
        self.history: list[Bounds] = []
        self.limit = _limit(problem)
        self.last_gain = problem.value_span
        self._bounds_at_first(above)
        self.values: list[FloatArray] = []
        self.set_pool(root_pool(problem))

    def _bounds_at_first(self, above: DelayedBound | None) -> None:
        problem = self.problem
        blocks, options = blind_vectors(problem, self.demand)
        self.gamma = list(zip(blocks, options, strict=True))
        self.blind = blind_controllers(problem, options)
        self.blind_vectors = np.concatenate([block[m] for m in range(len(blocks[0])) for block in blocks])
        self.best = self.last = self._certified(self.blind, self.blind_vectors)
        limits = Demand(deadline=self.demand.deadline, progress=self.demand.progress)
        bound = delayed_bound(problem, demand=limits) if above is None else above
        if bound.status == "interrupted":
            self.status = bound.status
        values = np.array([bound.value(root.y, root.belief) for root in problem.roots])
        self.upper_vectors = bound.vectors
        self.root_upper = values + margin(problem, bound.vectors) + problem.slack

    @property
    def vectors(self) -> list[FloatArray]:
        """Gamma's vectors by class."""
        return [vectors for vectors, _ in self.gamma]

    @property
    def gap(self) -> float:
        """The largest gap at a root."""
        return float(np.max(self.root_upper - self.best.root_lower, initial=0.0))

    @property
    def enough(self) -> float:
        """A rise of the values at the pool that counts as none: what is left is below half the gap."""
        return max(self.demand.gap * self.process.rest / 2, 1e-13 * self.problem.value_span)

    def backed_up(self, y: int, beliefs: FloatArray) -> Nodes:
        """The distinct backups of Gamma at `beliefs` [m, n_y] over class y."""
        found = choices(self.problem, self.vectors, y, beliefs, self.demand.poll)
        table = np.column_stack([found.options, found.winners])
        first = np.sort(np.unique(table, axis=0, return_index=True)[1])
        options, won = found.options[first], found.winners[first]
        return Nodes(beliefs[first], options, projected(self.problem, self.vectors, y, options, won))

    def set_pool(self, pool: BeliefPool) -> None:
        """Go on with a pool that contains the present one."""
        self.pool = pool
        self._select(self.gamma)

    def settle(self, update: Update, last: bool) -> None:
        """Iterate until the values at the pool no longer rise by much, or the run has to stop."""
        for _ in range(LAST_ROUNDS if last else ROUNDS):
            self.iterate(update)
            target = self.enough if last else max(self.enough, SETTLED * self.gap)
            if self.status is not None or self.last_gain <= target:
                return

    def report(self) -> None:
        """Note the bounds, see whether to stop, and tell the caller."""
        lower = self.problem.combine(self.best.root_lower)
        upper = self.problem.combine(self.root_upper)
        self.history.append(Bounds(time.perf_counter() - self.began, lower, upper))
        if self.status is None and self.gap <= self.demand.gap:
            self.status = "converged"
        elif self.demand.iterations is not None and self.iterations >= self.demand.iterations:
            self.status = self.status or "iteration limit"
        if self.demand.progress is not None:
            self.demand.progress(lower, upper)
        if self.status is None:
            self.demand.poll()

    def iterate(self, update: Update) -> None:
        """One round of backups, and their evaluation."""
        fresh = [update(self, y) if len(rows) else None for y, rows in enumerate(self.pool.beliefs)]
        certified = self.last = self.evaluated(fresh)
        candidates = []
        blocks = certified.controllers.by_class(certified.vectors)
        for nodes, own, (numbers, sure) in zip(fresh, self.gamma, blocks, strict=True):
            vectors, options = [sure, own[0]], [certified.controllers.options[numbers], own[1]]
            if nodes is not None:
                vectors.append(nodes.vectors)
                options.append(nodes.options)
            candidates.append((np.vstack(vectors), np.concatenate(options)))
        before = self.values
        self._select(candidates)
        rises = [np.max(new - old, initial=0.0) for new, old in zip(self.values, before, strict=True)]
        self.last_gain = float(max(rises, default=0.0))
        self._keep_if_better(certified)
        self.iterations += 1
        self.report()

    def evaluated(self, fresh: Sequence[Nodes | None]) -> Certified:
        """The nodes as controllers, certified, with blind policies for classes that have none."""
        problem, count = self.problem, self.blind.count
        sets = [
            block if nodes is None else nodes.vectors
            for nodes, (_, block) in zip(fresh, self.blind.by_class(self.blind_vectors), strict=True)
        ]
        lengths = [0 if nodes is None else len(nodes.options) for nodes in fresh]
        first = count + np.cumsum([0, *lengths])[:-1]
        stride = np.ones(problem.classes, dtype=np.int64)
        for y, nodes in enumerate(fresh):
            if nodes is None:  # blind policy m in class y is controller m Y + y
                first[y], stride[y] = y, problem.classes
        successors = np.full((count + sum(lengths), self.blind.successors.shape[1]), -1, dtype=np.int64)
        successors[:count] = self.blind.successors
        for y, nodes in enumerate(fresh):
            if nodes is not None:
                self.demand.poll()
                won = winners(problem, sets, y, nodes.beliefs, nodes.options)
                mine = slice(int(first[y]), int(first[y]) + lengths[y])
                successors[mine, : won.shape[1]] = self._numbered(nodes.options, won, first, stride)
        options = [self.blind.options, *(nodes.options for nodes in fresh if nodes is not None)]
        start = [self.blind_vectors, *(nodes.vectors.ravel() for nodes in fresh if nodes is not None)]
        controllers = Controllers(problem, np.concatenate(options), successors)
        needed = np.arange(len(successors)) >= count
        for y in np.flatnonzero([nodes is None for nodes in fresh]).tolist():
            needed[y : count : problem.classes] = True
        return self._solved(controllers, np.concatenate(start), np.flatnonzero(needed))

    def _numbered(self, options: IntArray, won: IntArray, first: IntArray, stride: IntArray) -> IntArray:
        """Winners [n, branch], places within the branches' next classes, as numbers of controllers."""
        a = self.problem.arrays
        branches = np.where(won >= 0, a.first_branch[options][:, None] + np.arange(won.shape[1]), 0)
        target = a.branch_target[branches] if len(a.branch_target) else branches
        return np.where(won >= 0, first[target] + stride[target] * won, -1)

    def _solved(self, controllers: Controllers, start: FloatArray, needed: IntArray) -> Certified:
        """The `needed` ones of the controllers and those that they reach, certified."""
        kept, old = controllers.reached(needed)
        goal = max(1e-12 * self.problem.value_span, PRECISION * self.last_gain)
        return self._certified(kept, evaluated(kept, _vectors(controllers, start, old), goal, self.demand))

    def _certified(self, controllers: Controllers, vectors: FloatArray) -> Certified:
        lower = controllers.best(vectors)[0] - margin(self.problem, vectors) - self.problem.slack
        return Certified(controllers, vectors, lower)

    def _select(self, candidates: Sequence[tuple[FloatArray, IntArray]]) -> None:
        """Keep of the candidates (vectors, options) by class those that are best somewhere in the pool."""
        gamma, values = [], []
        for (vectors, options), beliefs in zip(candidates, self.pool.beliefs, strict=True):
            if len(beliefs) == 0:
                gamma.append((vectors, options))
                values.append(np.zeros(0))
                continue
            places, worth = best_vectors(beliefs, vectors)
            kept = np.unique(places)
            gamma.append((vectors[kept], options[kept]))
            values.append(worth)
        self.gamma, self.values = gamma, values

    def _keep_if_better(self, found: Certified) -> None:
        """Make `found` the policy to return, joined with the former one where that is better."""
        if not np.any(found.root_lower > self.best.root_lower + 1e-12 * self.problem.value_span):
            return
        controllers, vectors = found.controllers, found.vectors
        if np.any(found.root_lower < self.best.root_lower):
            controllers = joined([controllers, self.best.controllers])
            vectors = np.concatenate([vectors, self.best.vectors])
        useful = []
        blocks = controllers.by_class(vectors)
        for (numbers, block), beliefs in zip(blocks, self.pool.beliefs, strict=True):
            useful.append(numbers[best_vectors(beliefs, block)[0]] if len(beliefs) else numbers)
        owners = controllers.best(vectors)[1]
        kept, old = controllers.reached(np.unique(np.concatenate([owners, *useful])))
        better = self._certified(kept, _vectors(controllers, vectors, old))
        # The best vector at each root is kept, so what was shown of it still holds.
        self.best = better._replace(root_lower=np.maximum(better.root_lower, self.best.root_lower))

    def solution(self, method: str, why: str) -> POMDPSolution:
        """What has been reached; `why` says what a status of None means."""
        problem, best = self.problem, self.best
        lower, upper = problem.combine(best.root_lower), problem.combine(self.root_upper)
        blocks = best.controllers.by_class(best.vectors)
        actions = [problem.option_action[best.controllers.options[numbers]] for numbers, _ in blocks]
        count = best.controllers.count
        reached = (
            f"the policy earns at least `lower`, the optimum is at most `upper`: {upper - lower:.3g} apart"
        )
        return POMDPSolution(
            lower=lower,
            upper=upper,
            value=lower,
            policy=problem.policy([block for _, block in blocks], actions, "lower"),
            root_lower=best.root_lower,
            root_upper=self.root_upper,
            status=self.status or "iteration limit",
            guarantee=Guarantee("bounds", f"{reached}, rounding included ({self.status or why})"),
            method=method,
            vectors=count,
            iterations=self.iterations,
            seconds=time.perf_counter() - self.began,
            history=tuple(self.history),
            note=f"{self.pool.count} beliefs, {count} vectors; upper bound: delayed observation, fixed",
        )


def _vectors(controllers: Controllers, vectors: FloatArray, numbers: IntArray) -> FloatArray:
    """The vectors of the controllers `numbers` [n], one behind the other, out of all [x]."""
    start = controllers.start
    return np.concatenate([vectors[start[n] : start[n + 1]] for n in numbers.tolist()])


def _limit(problem: Problem) -> int:
    """Beliefs in the largest pool, so that it and its controllers do not take too much memory."""
    widest = max(problem.size(y) for y in range(problem.classes))
    entries = max(1, len(problem.arrays.probability) // problem.options)
    return max(64, min(POOL, NUMBERS // widest, NUMBERS // entries))


def solve_with(
    problem: Problem, demand: Demand | None, method: str, work: Callable[[Run], str]
) -> POMDPSolution:
    """Run `work` until it returns why it stopped, or the demand, the deadline or Ctrl-C stops it."""
    if problem.classes == 0:
        observed_process(problem)  # refuses a discount of 1
        return _nothing(problem, method)
    try:
        run = Run(problem, demand)
    except KeyboardInterrupt:  # bounds to return, as simple as they come at once
        run = Run(problem, replace(demand or Demand(), progress=None, deadline=0.0))
        run.status = "interrupted"
    why = "interrupted before the first iteration"
    try:
        run.report()
        if run.status is None:
            why = work(run)
    except TimeIsUp:
        run.status = "time limit"
    except KeyboardInterrupt:
        run.status = "interrupted"
    return run.solution(method, why)


def _nothing(problem: Problem, method: str) -> POMDPSolution:
    none = np.zeros(len(problem.roots))
    return POMDPSolution(
        lower=0.0,
        upper=0.0,
        value=0.0,
        policy=problem.policy([], [], "exact"),
        root_lower=none,
        root_upper=none,
        status="converged",
        guarantee=Guarantee("exact", "every state is worth 0 under every policy"),
        method=method,
        vectors=0,
        iterations=0,
        seconds=0.0,
        history=(Bounds(0.0, 0.0, 0.0),),
    )
