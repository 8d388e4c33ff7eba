"""Solving a POMDP by unfolding the beliefs that can be reached from its roots.

The beliefs reachable from the roots, merged within an L1 distance d (`belief_graph`), form an MDP.

*Closed.*  If they are finitely many, that MDP is solved by policy iteration; v is its value.

*Widening.*  The optimal value is a maximum of alpha-vectors whose entries lie between Rmin / (1 - gamma)
and Rmax / (1 - gamma), so for beliefs of equal mass |V*(b) - V*(b')| <= L |b - b'|_1 with
L = (Rmax - Rmin) / (2 (1 - gamma)).  Let D be the largest excess of V* over v at a node.  At an expanded
node, b_k being the true next belief and n_k the node it was merged into,

    V*(b) = max_j b . r_j + gamma sum_k P_k V*(b_k) <= max_j b . r_j + gamma sum_k P_k (V*(n_k) + L d)
         <= v(b) + gamma (D + L d),                hence D <= gamma L d / (1 - gamma),

however often beliefs are merged along a path; a root that was merged itself adds L d at most.  So
V* <= v + L d / (1 - gamma) at the roots, where d is the largest distance that did occur: rounding where
the closure is exact.  A frontier node with U >= V* - D, and any convex combination of such bounds,
keeps the induction, so the same widening serves a graph that is not closed.

*Not closed.*  Frontier nodes get bounds: from above the fast informed bound and the sawtooth of the
expanded nodes, from below finite-state controllers, one for each expanded node that matters, evaluated
over all states.  Nodes are expanded by occupancy times gap (`graph_bounds`); options that are not greedy
for the upper bound are never followed.

*From below* all is certified on unmerged beliefs: the policy is a graph of controllers whose exact value
is a linear function of the belief (`controllers`).  In a closed graph a branch of probability 0 at its
node has no successor and counts 0.  After merging it may be met: each step's merging moves a mass of at
most d, which later steps carry on without growth, so that in step t at most t d meets such a branch, and

    gamma d S / (1 - gamma)^2,     S the largest |value| of any policy,

is what that may cost for ever.  Where it is too much, such branches get a successor after all.

Letters as in `pomdp_problem`; U and L bounds from above and below.
"""

from __future__ import annotations

import time
from typing import Final

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.models.errors import ModelError
from factored_polca.solvers.belief_graph import BeliefGraph
from factored_polca.solvers.blind import blind_vectors
from factored_polca.solvers.controllers import (
    Controllers,
    blind_controllers,
    idle_graph,
    joined,
    simplest_bounds,
)
from factored_polca.solvers.evaluation import TimeIsUp
from factored_polca.solvers.fast_informed import fast_informed_vectors
from factored_polca.solvers.graph_bounds import solve_edges
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Bounds, Demand, POMDPSolution
from factored_polca.solvers.qmdp import root_upper
from factored_polca.solvers.result import Guarantee, Status
from factored_polca.solvers.unfolding_search import Search, follow_edges

WITHOUT_BOUNDS: Final = 128
"""Beliefs up to which everything is expanded before bounds are asked for."""
MEMORY: Final = 50_000_000
"""Numbers that the beliefs may take."""
SWEEPS: Final = 20_000


def merge_distance(problem: Problem, gap: float) -> float:
    """The L1 distance at which merging widens the bounds by an eighth of `gap`; 1e-14 .. 1e-4."""
    least, largest = problem.reward_range
    wanted = gap * (1 - problem.discount) ** 2 / 4
    return max(1e-14, wanted / (largest - least)) if wanted < 1e-4 * (largest - least) else 1e-4


def solve_by_unfolding(
    problem: Problem,
    demand: Demand,
    *,
    beliefs: int = 20_000,
    merge: float | None = None,
    option_bound: FloatArray | None = None,
) -> POMDPSolution:
    """Certified bounds at the roots, and a policy graph for them, by unfolding reachable beliefs.

    `beliefs` limits the nodes of the belief graph, `demand.iterations` those that are expanded; either
    ends with "iteration limit".  `merge` is the L1 distance within which beliefs are merged, by default
    `merge_distance`; a larger one widens the bounds, which may end with "rounding limit".
    `option_bound` [p], laid out as `Arrays.rewards`, gives vectors q with Q*(b, j) <= b . q_j for the
    frontier; by default they are those of the fast informed bound.

    Raises:
        ModelError: no discount below 1, or `beliefs` or `merge` not positive.
    """
    if not problem.discount < 1:
        raise ModelError(
            f"the discount is {problem.discount}: unfolding looks infinitely far ahead and needs a "
            "discount below 1; lower it or give a finite horizon to a solver that takes one"
        )
    if beliefs < 1 or (merge is not None and not merge > 0):
        raise ModelError(f"`beliefs` and `merge` must be positive; they are {beliefs} and {merge}")
    run = _Run(problem, demand, beliefs, merge, option_bound)
    status: Status = "converged"
    if problem.classes:
        run.begin()
        try:
            status = run.go()
        except TimeIsUp:
            status = "time limit"
        except KeyboardInterrupt:
            status = "interrupted"
    return run.solution(status)


class _Run:
    """One run: its best bounds so far, and the controllers behind the lower ones."""

    def __init__(
        self,
        problem: Problem,
        demand: Demand,
        beliefs: int,
        merge: float | None,
        option_bound: FloatArray | None,
    ) -> None:
        self.began = time.perf_counter()
        self.problem, self.demand = problem, demand
        self.distance = merge_distance(problem, demand.gap) if merge is None else merge
        widest = int(np.diff(problem.arrays.offset).max(initial=1))
        self.limit = min(beliefs, max(1, MEMORY // widest))
        self.option_bound = option_bound
        self.count, self.expansions, self.widest = 0, 0, 0.0
        self.closed = False
        roots = len(problem.roots)
        self.lower, self.upper = np.full(roots, -np.inf), np.full(roots, np.inf)  # [root]
        self.policies: list[tuple[Controllers, int]] = []  # [root] its controller
        self.history: list[Bounds] = []

    def go(self) -> Status:
        """Unfold until a reason to stop.

        Raises:
            TimeIsUp: the deadline passed.
        """
        if self._done():  # rewards are all the same
            return "converged"
        graph = BeliefGraph(self.problem, self.distance)
        nodes = graph.frontier
        while len(nodes) and graph.count <= WITHOUT_BOUNDS and self._expand(graph, nodes):
            nodes = graph.frontier
        if len(nodes) == 0:
            return self._closed(graph)
        return self._search(graph)

    def _expand(self, graph: BeliefGraph, nodes: IntArray) -> bool:
        """Expand `nodes`; False if a limit keeps some from it."""
        self._report()
        self.demand.poll()
        room = graph.room(self.limit)
        if self.demand.iterations is not None:
            room = min(room, self.demand.iterations - graph.expansions)
        if room > 0:
            graph.expand(nodes[:room])
        self.count, self.expansions, self.widest = graph.count, graph.expansions, graph.widest
        return len(nodes) <= room

    def _closed(self, graph: BeliefGraph) -> Status:
        """All beliefs are expanded: the graph is an MDP."""
        edges, gamma = graph.edges(), self.problem.discount
        self.closed = True
        values, chain = solve_edges(edges, np.zeros(graph.count), gamma, self.demand)
        place = np.zeros(graph.count, dtype=np.int64)
        place[edges.nodes] = np.arange(len(edges.nodes))
        options = edges.options[chain.policy]
        width = int(np.diff(self.problem.arrays.first_branch).max(initial=0))
        nothing = np.full((len(options), width), -1, dtype=np.int64)
        table = follow_edges(edges, chain.policy, place, nothing)
        used, old = Controllers(self.problem, options, table).reached(place[graph.roots])
        first = np.searchsorted(old, place[graph.roots])
        lost = gamma * graph.widest * self.problem.value_span / (1 - gamma) ** 2
        if lost > self.demand.gap / 16:
            used = used.completed()
        if used.complete:
            lost = 0.0
        goal = 1e-3 * self.demand.gap * (1 - gamma)
        start = np.zeros(used.start[-1])
        vectors = used.from_below(used.evaluated(start, SWEEPS, goal, self.demand)) - lost
        numbers = zip(first.tolist(), self.problem.roots, strict=True)
        lower = [float(vectors[used.start[n] : used.start[n + 1]] @ root.belief) for n, root in numbers]
        done = self._note(values[graph.roots], np.array(lower), used, first)
        return "converged" if done else "rounding limit"

    def begin(self) -> None:
        """Some bounds at once."""
        upper, controllers, vectors = simplest_bounds(self.problem)
        self.policies = [(controllers, 0)] * len(upper)
        self._note(upper, *self._at_roots(controllers, vectors))

    def _search(self, graph: BeliefGraph) -> Status:
        """Expand what matters, between two-sided bounds."""
        problem, quiet = self.problem, Demand(self.demand.gap, self.demand.deadline)
        bound = self.option_bound
        if bound is None:
            bound = fast_informed_vectors(problem, demand=quiet)
        values, blind = blind_vectors(problem, quiet)
        controllers = blind_controllers(problem, blind)
        vectors = np.concatenate([part[m] for m in range(len(blind[0])) for part in values])
        self._note(root_upper(problem, bound), *self._at_roots(controllers, vectors))
        search = Search(problem, graph, bound, controllers, vectors, self.demand)
        limited = False
        while graph.expansions:
            before = float(np.sum(self.upper - self.lower))
            search.round()
            found = self._at_roots(search.controllers, search.vectors)
            if self._note(search.root_upper(), *found):
                return "converged"
            if limited:
                return "iteration limit"
            nodes = search.wanted()
            if len(nodes):
                limited = not self._expand(graph, nodes)
            elif before - float(np.sum(self.upper - self.lower)) <= 0.01 * self.demand.gap:
                return "rounding limit"
        return "converged" if self._done() else "iteration limit"

    @staticmethod
    def _at_roots(
        controllers: Controllers, vectors: FloatArray
    ) -> tuple[FloatArray, Controllers, IntArray]:
        """L [root] from below, by controllers with the vectors [x], and which [root]."""
        lower, first = controllers.best(controllers.from_below(vectors))
        return lower, controllers, first

    def _done(self) -> bool:
        return bool(np.all(self.upper - self.lower <= self.demand.gap))

    def _note(
        self, upper: FloatArray, lower: FloatArray, controllers: Controllers, first: IntArray
    ) -> bool:
        """Keep what is better at each root; whether that is good enough.

        `upper` is still to be moved up by what merging and rounding may do.
        """
        problem = self.problem
        least, largest = problem.reward_range
        widening = self.widest * (largest - least) / (2 * (1 - problem.discount) ** 2)
        self.upper = np.minimum(self.upper, upper + widening + 2 * problem.slack)
        for number in np.flatnonzero(lower > self.lower).tolist():
            self.policies[number] = (controllers, int(first[number]))
            self.lower[number] = lower[number]
        low, high = problem.combine(self.lower), problem.combine(self.upper)
        self.history.append(Bounds(time.perf_counter() - self.began, low, high))
        return self._done()

    def _report(self) -> None:
        if self.demand.progress is not None:
            self.demand.progress(self.history[-1].lower, self.history[-1].upper)

    def _policy(self) -> PolicyGraph:
        """The policy graph of the controllers behind the lower bounds at b0."""
        start: dict[int, int] = {}
        parts: list[Controllers] = []
        first = 0
        mine = [n for n, root in enumerate(self.problem.roots) if root.weight > 0]
        for controllers in {id(self.policies[n][0]): self.policies[n][0] for n in mine}.values():
            numbers = [n for n in mine if self.policies[n][0] is controllers]
            wanted = np.array([self.policies[n][1] for n in numbers], dtype=np.int64)
            part, old = controllers.reached(wanted)
            for n, place in zip(numbers, np.searchsorted(old, wanted).tolist(), strict=True):
                start[self.problem.roots[n].y] = first + place
            parts.append(part)
            first += part.count
        return joined(parts).graph(start) if parts else idle_graph(self.problem)

    def solution(self, status: Status) -> POMDPSolution:
        """What was found."""
        problem = self.problem
        low, high = problem.combine(self.lower), problem.combine(self.upper)
        policy = self._policy()
        kind = "all" if self.closed else f"{self.expansions} of them expanded, not all"
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
                "lower: exact value of the policy graph, rounded down; upper: the belief graph, widened by "
                f"{self.widest:.2g} in L1 distance of merged beliefs",
            ),
            method="unfolding",
            vectors=policy.nodes,
            iterations=self.expansions,
            seconds=time.perf_counter() - self.began,
            history=tuple(self.history),
            note=f"{self.count} beliefs reached, {kind}; merged within {self.distance:.2g} in L1 distance",
        )
