"""Policy iteration on policy graphs: certified bounds over the whole simplex, for an infinite horizon.

A policy graph is a set of controllers (`controllers`), each with the vector alpha_n that it earns;
V(b) = max over the controllers n of b's class of alpha_n . b <= V*(b).  One step (Hansen, "Solving POMDPs
by searching in policy space", UAI 1998):

1.  An exact backup (`exact_backup`) gives the vectors of T V, each with its option j and the vectors
    that its branches were backed up from.
2.  A vector with the option and the successors of a controller is that controller.  Any other becomes a
    new one; where it is nowhere below an old controller, that one's predecessors get the new one instead.
3.  Controllers that no vector of T V leads to are dropped; the rest is evaluated by one linear system.

Each step raises V everywhere, at least to T V, and as a rule much further than value iteration would.
In between, the same is done cheaply: the backups at the witnesses of the last exact backup alone, until
these give nothing new (point-based policy iteration; Ji, Parr, Li, Liao & Carin, AAAI 2007).

*Certificate.*  Pruning puts the computed T V at no belief more than delta below the true one.  Let
eps = max over all beliefs of (computed T V - V), 0 at least.  Then T V <= V + eps + delta, and as
T (V + c) <= T V + gamma rho c for a constant c (rho >= 1 bounds the sums of rows),

    V* <= V + c   with   c = (eps + delta) / (1 - gamma rho),      hence   V* <= T V + delta + gamma rho c.

eps is found by linear programs, from above (`bellman_residual`).

*The policy* takes the action of the best vector.  Its vectors are V's, pruned: V' >= V - tau.  As
alpha_n <= r + gamma sum_k M_k (V' + tau) for each of them, the policy earns at least
V' - gamma rho tau / (1 - gamma rho).

Letters as in `pomdp_problem`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.models.errors import LimitReached, ModelError
from factored_polca.solvers.bellman_residual import excess
from factored_polca.solvers.blind import blind_vectors
from factored_polca.solvers.controllers import UNIT, Controllers, blind_controllers, simplest_bounds
from factored_polca.solvers.evaluation import TimeIsUp
from factored_polca.solvers.exact_backup import Backup, backup
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Bounds, Demand, POMDPSolution
from factored_polca.solvers.pruning import TOLERANCE, prune, scale_of
from factored_polca.solvers.qmdp import qmdp_vectors, root_upper
from factored_polca.solvers.result import Guarantee, Status

SWEEPS: Final = 20_000
NOWHERE_BELOW: Final = 1e-13
"""What counts as not below, as a share of the largest entry; counted in delta."""
POINT_STEPS: Final = 50
"""Steps at the witnesses between two exact backups, at most."""


def solve_by_graph_iteration(problem: Problem, demand: Demand, *, everywhere: bool = True) -> POMDPSolution:
    """Alpha-vectors with a certificate over the whole simplex, by policy iteration on policy graphs.

    Stops where upper - lower <= `demand.gap` at every root and, with `everywhere`, at every belief.
    `demand.iterations` counts exact backups.  "rounding limit" says that an exact backup found nothing
    but rounding though the gap is wider.

    Raises:
        ModelError: no discount below 1.
    """
    if not problem.discount < 1:
        raise ModelError(
            f"the discount is {problem.discount}: the certificate divides by 1 - discount; lower the "
            "discount or give a finite horizon to a solver that takes one"
        )
    run = _Run(problem, demand, everywhere)
    status: Status = "converged"
    if problem.classes:
        run.begin()
        try:
            status = run.go()
        except TimeIsUp:
            status = "time limit"
        except LimitReached:  # a cross-sum of more vectors than memory holds
            status = "memory limit"
        except KeyboardInterrupt:
            status = "interrupted"
    return run.solution(status)


@dataclass(frozen=True)
class _Graph:
    """Controllers with their vectors from below, by class as backups take them."""

    controllers: Controllers
    vectors: FloatArray  # [x]
    numbers: tuple[IntArray, ...]  # [y] the controllers [m] of the class
    sets: tuple[FloatArray, ...]  # [y] their vectors [m, n_y]


def _graph(controllers: Controllers, vectors: FloatArray) -> _Graph:
    parts = controllers.by_class(vectors)
    return _Graph(controllers, vectors, tuple(p[0] for p in parts), tuple(p[1] for p in parts))


@dataclass(frozen=True)
class _New:
    """Backed-up vectors of a class with where they come from."""

    vectors: FloatArray  # [n, n_y]
    options: IntArray  # [n]
    successors: IntArray  # [n, branch] controllers


class _Run:
    """One run: the graph so far and the best bounds at the roots."""

    def __init__(self, problem: Problem, demand: Demand, everywhere: bool) -> None:
        self.began = time.perf_counter()
        self.problem, self.demand, self.everywhere = problem, demand, everywhere
        self.width = int(np.diff(problem.arrays.first_branch).max(initial=0))
        roots = len(problem.roots)
        self.lower, self.upper = np.full(roots, -np.inf), np.full(roots, np.inf)  # [root]
        self.graph: _Graph | None = None
        self.beliefs: list[FloatArray] = []  # [y] witnesses [w, n_y]
        self.history: list[Bounds] = []
        self.backups, self.steps, self.programs = 0, 0, 0
        self.distance = np.inf  # V* - V is at most this, anywhere
        sums = [np.asarray(matrix.sum(axis=1)) for matrix in problem.matrices]
        total = np.zeros((problem.options, int(np.diff(problem.arrays.offset).max(initial=0))))
        for k, part in enumerate(sums):
            total[problem.branch_option[k], : len(part)] += part
        self.ratio = problem.discount * max(1.0, float(total.max(initial=0.0)) * (1 + 1e-14))  # gamma rho
        self.rest = (1 - self.ratio) * (1 - 8 * UNIT)

    def begin(self) -> None:
        """Some bounds at once."""
        self.upper, controllers, vectors = simplest_bounds(self.problem)
        self.graph = _graph(controllers, vectors)
        self.beliefs = [
            np.array([r.belief for r in self.problem.roots if r.y == y]).reshape(-1, self.problem.size(y))
            for y in range(self.problem.classes)
        ]
        self._note()

    def go(self) -> Status:
        """Step until a reason to stop.

        Raises:
            TimeIsUp: the deadline passed.
        """
        quiet = Demand(self.demand.gap, self.demand.deadline)
        found = root_upper(self.problem, qmdp_vectors(self.problem, quiet))
        self.upper = np.minimum(self.upper, found)
        vectors, options = blind_vectors(self.problem, quiet)
        controllers = blind_controllers(self.problem, options)
        flat = np.concatenate([part[m] for m in range(len(options[0])) for part in vectors])
        self.graph = _graph(controllers, controllers.from_below(flat))
        self._note()
        while True:
            self._report()
            if self._done():
                return "converged"
            if self.demand.iterations is not None and self.backups >= self.demand.iterations:
                return "iteration limit"
            self.demand.poll()
            self._point_steps()
            self._report()
            if not self._exact_step():
                return "converged" if self._done() else "rounding limit"

    def _done(self) -> bool:
        at_roots = bool(np.all(self.upper - self.lower <= self.demand.gap))
        return at_roots and (self.distance <= self.demand.gap or not self.everywhere)

    def _exact_step(self) -> bool:
        """One exact backup: the certificate, and a better graph; whether anything was new."""
        old = self._current()
        found = backup(
            self.problem, old.sets, witnesses=self.beliefs, poll=self.demand.poll, tolerance=TOLERANCE
        )
        self.backups += 1
        self.programs += found.programs
        self.beliefs = [
            np.vstack([part.witnesses, *(r.belief[None, :] for r in self.problem.roots if r.y == y)])
            for y, part in enumerate(found.classes)
        ]
        if not self._certify(old, found):
            return False
        news = [
            _New(part.vectors, part.options, self._numbered(old, part.options, part.successors))
            for part in found.classes
        ]
        return self._improve(news, drop=True)

    def _certify(self, old: _Graph, found: Backup) -> bool:
        """What an exact backup says about the distance to V*; whether it is more than rounding."""
        scale = max(scale_of(part) for part in old.sets)
        delta = found.error + old.controllers.error(old.vectors) + NOWHERE_BELOW * scale
        eps = 0.0
        for before, part in zip(old.sets, found.classes, strict=True):
            eps = max(eps, excess(part.vectors, before, part.witnesses, eps, self.demand.poll))
        self.distance = min(self.distance, (eps + delta) / self.rest)
        best = [float((found.classes[r.y].vectors @ r.belief).max()) for r in self.problem.roots]
        self.upper = np.minimum(self.upper, np.array(best) + delta + self.ratio * (eps + delta) / self.rest)
        self._note()
        return eps > delta

    def _numbered(self, graph: _Graph, options: IntArray, successors: IntArray) -> IntArray:
        """Successors as controllers [n, branch] from rows of `graph.sets`."""
        a = self.problem.arrays
        table = np.full((len(options), self.width), -1, dtype=np.int64)
        for j in np.unique(options).tolist():
            mine = np.flatnonzero(options == j)
            for place, k in enumerate(self.problem.branch_range(j)):
                table[mine, place] = graph.numbers[int(a.branch_target[k])][successors[mine, place]]
        return table

    def _point_steps(self) -> None:
        """Backups at the witnesses alone, while these gain."""
        enough = 0.1 * self.demand.gap * self.rest
        for _ in range(POINT_STEPS):
            self.demand.poll()
            graph = self._current()
            gain, news = 0.0, []
            for y, beliefs in enumerate(self.beliefs):
                more, new = self._at_points(graph, y, beliefs)
                gain = max(gain, more)
                news.append(new)
            if gain <= enough or not self._improve(news, drop=False):
                return
            self.steps += 1

    def _at_points(self, graph: _Graph, y: int, beliefs: FloatArray) -> tuple[float, _New]:
        """The backups at beliefs [w, n_y] that are better than V there, and the largest gain."""
        problem = self.problem
        now = (beliefs @ graph.sets[y].T).max(axis=1)
        best, options = np.full(len(beliefs), -np.inf), np.zeros(len(beliefs), dtype=np.int64)
        successors = np.full((len(beliefs), self.width), -1, dtype=np.int64)
        for j in problem.option_range(y):
            worth = beliefs @ problem.reward(j)
            rows = np.full((len(beliefs), self.width), -1, dtype=np.int64)
            for place, k in enumerate(problem.branch_range(j)):
                target = int(problem.arrays.branch_target[k])
                values = np.asarray(beliefs @ problem.matrices[k]) @ graph.sets[target].T
                rows[:, place] = values.argmax(axis=1)
                worth = worth + problem.discount * values.max(axis=1)
            better = worth > best
            best = np.where(better, worth, best)
            options[better], successors[better] = j, rows[better]
        chosen = np.flatnonzero(best > now + 1e-12 * np.maximum(1.0, np.abs(now)))
        options, successors = options[chosen], successors[chosen]
        vectors = np.array([problem.reward(j) for j in options.tolist()]).reshape(-1, problem.size(y))
        for j in np.unique(options).tolist():
            mine = np.flatnonzero(options == j)
            for place, k in enumerate(problem.branch_range(j)):
                following = graph.sets[int(problem.arrays.branch_target[k])][successors[mine, place]]
                vectors[mine] += problem.discount * np.asarray(problem.matrices[k] @ following.T).T
        gain = float(np.max(best - now, initial=0.0))
        return gain, _New(vectors, options, self._numbered(graph, options, successors))

    def _improve(self, news: Sequence[_New], *, drop: bool) -> bool:
        """The graph with the controllers `news` [y]; False if there is none that is not in it.

        With `drop`, what neither they nor controllers reached from them are goes.
        """
        old = self._current()
        count = old.controllers.count
        keys = _keys(old.controllers.options, old.controllers.successors)
        known = dict(zip(reversed(keys), range(count - 1, -1, -1), strict=True))
        options, successors = [old.controllers.options], [old.controllers.successors]
        starts, first = [old.vectors], []
        replaced = np.arange(count + sum(len(new.options) for new in news))
        for y, new in enumerate(news):
            for n, key in enumerate(_keys(new.options, new.successors)):
                number = known.setdefault(key, count)
                first.append(number)
                if number < count:
                    continue
                count += 1
                options.append(new.options[n : n + 1])
                successors.append(new.successors[n : n + 1])
                starts.append(new.vectors[n])
                slack = NOWHERE_BELOW * scale_of(old.sets[y])
                lower = np.all(new.vectors[n] >= old.sets[y] - slack, axis=1)
                replaced[old.numbers[y][lower]] = number
        if count == old.controllers.count:
            return False
        replaced = np.append(replaced[:count], -1)  # the last place answers for -1
        everything = Controllers(self.problem, np.concatenate(options), replaced[np.vstack(successors)])
        wanted = np.unique(first) if drop else np.unique(replaced[:count])
        used, kept = everything.reached(wanted)
        flat = np.concatenate(starts)
        places = np.repeat(everything.start[kept] - used.start[:-1], np.diff(used.start))
        start = flat[places + np.arange(used.start[-1])]
        goal = 1e-3 * self.demand.gap * self.rest
        vectors = used.from_below(used.evaluated(start, SWEEPS, goal, self.demand))
        self.graph = _graph(used, vectors)
        self._note()
        return True

    def _current(self) -> _Graph:
        assert self.graph is not None
        return self.graph

    def _note(self, sets: Sequence[FloatArray] | None = None, tolerance: float = TOLERANCE) -> None:
        """The bounds at the roots as of now, for V pruned at `tolerance` (or still to be pruned)."""
        sets, loss = (self._current().sets, 1.0) if sets is None else (sets, self.ratio)
        roots = self.problem.roots
        values = np.array([float((sets[r.y] @ r.belief).max()) for r in roots])
        scale = max(scale_of(part) for part in self._current().sets)
        self.lower = values - loss * tolerance * scale / self.rest
        low, high = self.problem.combine(self.lower), self.problem.combine(self.upper)
        low = max([low, *(entry.lower for entry in self.history[-1:])])
        self.history.append(Bounds(time.perf_counter() - self.began, low, high))

    def _report(self) -> None:
        if self.demand.progress is not None:
            self.demand.progress(self.history[-1].lower, self.history[-1].upper)

    def _policy(self, status: Status) -> AlphaVectors:
        """The vectors, pruned if all went well; `lower` becomes what they say.

        Where the gap leaves room, an eighth of it goes into fewer vectors.
        """
        if self.graph is None:
            return self.problem.policy([], [], "lower")
        sets, numbers, tolerance = list(self.graph.sets), self.graph.numbers, 0.0
        if status == "converged":
            scale = max(scale_of(part) for part in sets)
            spare = float(np.min(self.demand.gap - (self.upper - self.lower)))
            spare = min(spare, self.demand.gap - self.distance) if self.everywhere else spare
            tolerance = max(TOLERANCE, min(1e-9, spare * self.rest / (8 * scale)))
            self.distance += tolerance * scale / self.rest
            keep = [prune(part, tolerance=tolerance) for part in sets]
            sets = [part[kept] for part, kept in zip(sets, keep, strict=True)]
            numbers = tuple(part[kept] for part, kept in zip(numbers, keep, strict=True))
        self._note(sets, tolerance)
        options = self.graph.controllers.options
        actions = [self.problem.option_action[options[part]] for part in numbers]
        return self.problem.policy(sets, actions, "lower")

    def solution(self, status: Status) -> POMDPSolution:
        """What was found."""
        policy = self._policy(status)
        low, high = self.problem.combine(self.lower), self.problem.combine(self.upper)
        # The last graph may be worse than an earlier one by rounding.
        history = tuple(replace(entry, lower=min(entry.lower, low)) for entry in self.history)
        nodes = 0 if self.graph is None else self.graph.controllers.count
        return POMDPSolution(
            lower=low,
            upper=high,
            value=low,
            policy=policy,
            root_lower=self.lower,
            root_upper=self.upper,
            status=status,
            guarantee=Guarantee(
                "bounds",
                "lower: the maximum of vectors that a policy graph earns; upper: that plus what an exact "
                "backup could still raise it by, for ever (Bellman residual over the whole simplex)",
            ),
            method="policy iteration on policy graphs",
            vectors=policy.count,
            iterations=self.backups,
            seconds=time.perf_counter() - self.began,
            history=history,
            note=(
                f"{self.backups} exact backups with {self.programs} linear programs, {self.steps} steps at "
                f"witnesses, {nodes} controllers; distance from the optimum at any belief: "
                f"{self.distance:.3g} at most"
            ),
        )


def _keys(options: IntArray, successors: IntArray) -> list[bytes]:
    table = np.ascontiguousarray(np.column_stack([options, successors]))
    return [row.tobytes() for row in table]
