"""Unfolding only those beliefs that matter for the bounds at the roots.

U: bounds from above at all nodes, from a given bound at each belief and the sawtooth (`graph_bounds`).
L: the maximum of the vectors of finite-state controllers (`controllers`), at first blind ones.

Each round:

1.  U is solved over the expanded nodes and lowered by the sawtooth at the frontier of the greedy policy.
2.  With L at the frontier, the best policy over the expanded nodes is found.  Each node that it visits
    gets a controller of its own: the policy's option, handing over on each branch to the next node's own
    controller, at the frontier to the one that is best there; where the branch can't be observed from the
    node's belief, to the one that is best where the branch leads from the uniform belief.  Controllers
    are replaced in place, so that older ones which hand over to them take part in what was gained, and
    all are evaluated again.  That may lower L somewhere: the best controllers for the roots are kept.
3.  The frontier nodes whose occupancy times gap is largest are expanded.

Letters as in `pomdp_problem`.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.belief_graph import BeliefGraph, Edges
from factored_polca.solvers.controllers import Controllers
from factored_polca.solvers.graph_bounds import sawtooth, solve_edges
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.solvers.qmdp import corner_values, option_vectors

SHARE: Final = 0.8
"""Of what expanding could gain, the share that is expanded in one round."""
TEETH: Final = 4
"""How often in a round the sawtooth may change the policy that is greedy for U."""
BLOCK: Final = 2**22
"""Products of beliefs and vectors that are held at a time."""
SWEEPS: Final = 400


class Search:
    """The bounds over a belief graph that grows; `round` improves them."""

    def __init__(
        self,
        problem: Problem,
        graph: BeliefGraph,
        option_bound: FloatArray,
        controllers: Controllers,
        vectors: FloatArray,
        demand: Demand,
    ) -> None:
        self.problem, self.graph, self.demand = problem, graph, demand
        self.roots = np.array(graph.roots, dtype=np.int64)
        self.option_bound = option_bound  # [p] b . q_j >= Q*(b, j)
        self.corners = corner_values(problem, option_bound)  # [i] from above
        self.upper = np.zeros(0)  # [node]
        self.gains = np.zeros(0)  # [node] occupancy times gap at the greedy frontier, else 0
        self.controllers = controllers
        self.vectors = vectors  # [x] of `controllers`
        self.owned = np.zeros(0, dtype=np.int64)  # [node] its own controller, -1: none
        self.lower = np.zeros(0)  # [node]
        self.best = np.zeros(0, dtype=np.int64)  # [node] the controller behind `lower`

    def round(self) -> None:
        """Better bounds.

        Raises:
            TimeIsUp: the deadline passed.
        """
        self._enlarge()
        edges = self.graph.edges()
        for _ in range(TEETH):
            self.upper, chain = solve_edges(edges, self.upper, self.problem.discount, self.demand)
            visits = chain.visits(self.roots)
            visits[edges.nodes] = 0.0
            frontier = np.flatnonzero(visits > 0)
            before = self.upper[frontier]
            self._sawtooth(edges, frontier)
            if visits[frontier] @ (before - self.upper[frontier]) <= 0.1 * self.demand.gap:
                break
        self._improve(edges)
        self._look()
        self.gains = visits * np.maximum(self.upper - self.lower, 0.0)

    def wanted(self) -> IntArray:
        """The frontier nodes that gain most, the best first."""
        order = np.argsort(-self.gains, kind="stable")
        running = np.cumsum(self.gains[order])
        count = int(np.searchsorted(running, SHARE * running[-1])) + 1
        chosen = order[:count]
        return chosen[self.gains[chosen] > 0]

    def root_upper(self) -> FloatArray:
        """U [root], but for widening and rounding."""
        return self.upper[self.roots]

    def _enlarge(self) -> None:
        """Room and first bounds for nodes that are new."""
        old, new = len(self.upper), self.graph.count
        self.upper = np.concatenate([self.upper, np.zeros(new - old)])
        self.owned = np.concatenate([self.owned, np.full(new - old, -1, dtype=np.int64)])
        for y in range(self.problem.classes):
            ids = self.graph.ids(y)
            fresh = ids >= old
            if fresh.any():
                bound = option_vectors(self.problem, self.option_bound, y)
                self.upper[ids[fresh]] = (self.graph.beliefs(y)[fresh] @ bound.T).max(axis=1)
        self._look()

    def _sawtooth(self, edges: Edges, frontier: IntArray) -> None:
        """Lower U at `frontier`."""
        offset = self.problem.arrays.offset
        classes = self.graph.node_class[frontier]
        for y in np.unique(classes).tolist():
            corners = self.corners[offset[y] : offset[y + 1]]
            points = edges.nodes[self.graph.node_class[edges.nodes] == y]
            if len(points) == 0:
                continue
            beliefs = self.graph.rows(y, points)
            sure = np.flatnonzero(beliefs.max(axis=1) == 1.0)
            np.minimum.at(corners, beliefs[sure].argmax(axis=1), self.upper[points[sure]])
            drops = self.upper[points] - beliefs @ corners
            order = np.argsort(drops, kind="stable")
            mine = frontier[classes == y]
            values = self.upper[mine]
            sawtooth(self.graph.rows(y, mine), values, beliefs[order], drops[order], corners)
            self.upper[mine] = values

    def _look(self) -> None:
        """L and the best controller at every node."""
        self.lower, self.best = np.zeros(self.graph.count), np.zeros(self.graph.count, dtype=np.int64)
        for y, (numbers, vectors) in enumerate(self.controllers.by_class(self.vectors)):
            ids, beliefs = self.graph.ids(y), self.graph.beliefs(y)
            step = max(1, BLOCK // len(vectors))
            for first in range(0, len(ids), step):
                worth = beliefs[first : first + step] @ vectors.T
                winner = worth.argmax(axis=1)
                self.lower[ids[first : first + step]] = worth[np.arange(len(worth)), winner]
                self.best[ids[first : first + step]] = numbers[winner]

    def _improve(self, edges: Edges) -> None:
        """Controllers for the policy that is best for L over the expanded nodes; all are evaluated."""
        _, chain = solve_edges(edges, self.lower, self.problem.discount, self.demand, above=False)
        visited = chain.visits(self.roots)[edges.nodes] > 0
        nodes, pairs = edges.nodes[visited], chain.policy[visited]
        old = self.controllers
        new = self.owned[nodes] < 0
        self.owned[nodes[new]] = old.count + np.arange(int(new.sum()))
        following = np.where(self.owned >= 0, self.owned, self.best)
        following[edges.nodes[~visited]] = self.best[edges.nodes[~visited]]
        table = follow_edges(edges, pairs, following, self._usual()[edges.options[pairs]])
        more = np.full((int(new.sum()), table.shape[1]), -1, dtype=np.int64)
        options = np.concatenate([old.options, np.zeros(len(more), dtype=np.int64)])
        successors = np.vstack([old.successors, more])
        options[self.owned[nodes]] = edges.options[pairs]
        successors[self.owned[nodes]] = table
        self.controllers = Controllers(self.problem, options, successors)
        goal = 1e-3 * self.demand.gap * (1 - self.problem.discount)
        start = self._starts(nodes[new], old)
        self.vectors = self.controllers.evaluated(start, SWEEPS, goal, self.demand)

    def _starts(self, nodes: IntArray, old: Controllers) -> FloatArray:
        """[x] where sweeps start: new controllers, those of `nodes`, as the best old vectors there."""
        parts = [self.vectors]
        for number in self.best[nodes].tolist():
            parts.append(self.vectors[old.start[number] : old.start[number + 1]])
        return np.concatenate(parts)

    def _usual(self) -> IntArray:
        """[j, branch] the controller that is best where the branch leads from the uniform belief."""
        problem = self.problem
        parts = self.controllers.by_class(self.vectors)
        table = np.full((problem.options, self.controllers.successors.shape[1]), -1, dtype=np.int64)
        for j in range(problem.options):
            for place, k in enumerate(problem.branch_range(j)):
                numbers, vectors = parts[int(problem.arrays.branch_target[k])]
                mass = np.asarray(problem.matrices[k].sum(axis=0))
                table[j, place] = numbers[(vectors @ mass).argmax()]
        return table


def follow_edges(edges: Edges, pairs: IntArray, following: IntArray, table: IntArray) -> IntArray:
    """`table` [n, branch] with `following` [node] of the next node for each edge of `pairs` [n]."""
    table = table.copy()
    moves = edges.moves
    counts = np.diff(moves.indptr)[pairs]
    inside = np.repeat(moves.indptr[pairs] - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())
    table[np.repeat(np.arange(len(pairs)), counts), edges.places[inside]] = following[moves.indices[inside]]
    return table
