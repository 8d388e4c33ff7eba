"""Bounds on a partly unfolded belief graph, and where they are still loose.

With values at the frontier held fixed, those of the expanded nodes solve

    U(b) = max over options j of b . r_j + gamma * sum over edges P(b, k) U(b_k)            (U = T U)

by policy iteration, each policy evaluated by one linear system over the expanded nodes; by sweeps where
that is too large.  If u approximates the solution and d = max(0, max(T u - u)), then
u + d / (1 - gamma rho) is above it (rho >= 1 bounds the sums of rows).

*Sawtooth* (Hauskrecht 2000).  V* is convex, so a point with V*(b_p) <= U_p and bounds c at the corners
give, with phi = min over i with b_p(i) > 0 of b(i) / b_p(i),

    V*(b) <= c . b + phi * (U_p - c . b_p).

*Occupancy* x: the discounted number of visits from the roots under the policy that is greedy for U.
As U - L at the roots is at most the sum over the frontier of x (U - L), a frontier node's term says what
expanding it may gain (as in LAO*; Hansen & Zilberstein 2001).

Letters: e expanded node, p pair, rows of `values` by node; see `belief_graph`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from scipy.sparse import csc_array, csr_array, eye_array
from scipy.sparse.linalg import splu

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.belief_graph import Edges
from factored_polca.solvers.compiled import kernel
from factored_polca.solvers.pomdp_result import Demand

DENSE: Final = 150
"""Expanded nodes up to which a dense solve is quickest."""
FACTORISATION_LIMIT: Final = 4_000
"""Expanded nodes up to which systems are factorised."""
POLICIES: Final = 60
SWEEPS: Final = 2_000
ROUNDING: Final = 1e-13
"""What counts as no improvement, as a share of the largest value over 1 - gamma."""


@dataclass(frozen=True)
class Chain:
    """The expanded nodes under one pair for each."""

    edges: Edges
    policy: IntArray  # [e] the pair
    discount: float

    @cached_property
    def rows(self) -> Any:
        """CSR [e, node], the probabilities of the chosen pairs."""
        return self.edges.moves[self.policy]

    @cached_property
    def _inside(self) -> csr_array:
        """gamma * the probabilities between expanded nodes, CSR [e, e]."""
        count = len(self.policy)
        position = np.full(self.rows.shape[1], -1, dtype=np.int64)
        position[self.edges.nodes] = np.arange(count)
        column = position[self.rows.indices]
        row = np.repeat(np.arange(count), np.diff(self.rows.indptr))
        keep = column >= 0
        entries = self.discount * self.rows.data[keep]
        return csr_array((entries, (row[keep], column[keep])), shape=(count, count))

    def _solve(self, right: FloatArray, transposed: bool) -> FloatArray:
        count = len(self.policy)
        inside = self._inside
        if count <= DENSE:
            system = np.eye(count) - inside.toarray()
            return np.linalg.solve(system.T if transposed else system, right)
        system = csc_array(eye_array(count) - inside)
        solution: FloatArray = splu(system).solve(right, trans="T" if transposed else "N")
        return solution

    def values(self, values: FloatArray) -> FloatArray:
        """[e] what the policy earns, the frontier being worth `values` [node]."""
        outside = values.copy()
        outside[self.edges.nodes] = 0.0
        known = self.edges.rewards[self.policy] + self.discount * (self.rows @ outside)
        return self._solve(known, False)

    def visits(self, roots: IntArray) -> FloatArray:
        """x [node], one visit to each of `roots` at the start; 0 where no path leads."""
        start = np.zeros(self.rows.shape[1])
        np.add.at(start, roots, 1.0)
        first = start[self.edges.nodes]
        if len(self.policy) <= FACTORISATION_LIMIT:
            inner = np.maximum(self._solve(first, True), 0.0)
        else:
            across, inner, current = csr_array(self._inside.T), first.copy(), first
            while float(current.sum()) > 1e-10:
                current = across @ current
                inner += current
        total: FloatArray = self.discount * (csr_array(self.rows.T) @ inner) + start
        total[self.edges.nodes] = inner
        return np.where(total > 1e-14, total, 0.0)


def solve_edges(
    edges: Edges, values: FloatArray, discount: float, demand: Demand, *, above: bool = True
) -> tuple[FloatArray, Chain]:
    """The values [node] and the greedy policy, with `values` [node] at the frontier.

    At expanded nodes `values` are where to start from, bounds already if many nodes make sweeps
    necessary.  `above`: the result is not below the solution, but for rounding; else only close to it.

    Raises:
        TimeIsUp: the deadline passed.
    """
    sums = np.asarray(edges.moves.sum(axis=1))
    rest = 1 - discount * max(1.0, float(sums.max(initial=0.0)) * (1 + 1e-14))
    values, nodes = values.copy(), edges.nodes
    if len(nodes) > FACTORISATION_LIMIT:
        chain = _sweep(edges, values, discount, rest, demand, above)
        return values, chain
    policy = edges.first_best(edges.q_values(values, discount))
    for _ in range(POLICIES):
        demand.poll()
        chain = Chain(edges, policy, discount)
        values[nodes] = chain.values(values)
        q = edges.q_values(values, discount)
        best = edges.best(q)
        better = best > q[policy] + ROUNDING * max(1.0, float(np.abs(values).max())) / rest
        if not better.any():
            break
        policy = np.where(better, edges.first_best(q), policy)
    if above:
        values[nodes] += max(0.0, float(np.max(best - values[nodes]))) / rest
    return values, chain


def _sweep(
    edges: Edges, values: FloatArray, discount: float, rest: float, demand: Demand, above: bool
) -> Chain:
    """Backups of `values` in place, each as good a bound as the last."""
    nodes = edges.nodes
    for _ in range(SWEEPS):
        demand.poll()
        new = edges.best(edges.q_values(values, discount))
        new = np.minimum(values[nodes], new) if above else np.maximum(values[nodes], new)
        change = float(np.max(np.abs(values[nodes] - new)))
        values[nodes] = new
        if change <= 0.01 * demand.gap * rest:
            break
    return Chain(edges, edges.first_best(edges.q_values(values, discount)), discount)


@kernel
def sawtooth(
    beliefs: FloatArray, values: FloatArray, points: FloatArray, drops: FloatArray, corners: FloatArray
) -> None:
    """Lower `values` [f] at `beliefs` [f, i] to the sawtooth of `points` [p, i] and `corners` [i].

    `drops` [p] is U_p - c . b_p, ascending: the strongest come first.
    """
    size = beliefs.shape[1]
    for f in range(len(beliefs)):
        base = 0.0
        for i in range(size):
            base += corners[i] * beliefs[f, i]
        best = min(0.0, values[f] - base)
        for p in range(len(points)):
            drop = drops[p]
            if drop >= best:  # phi is at most 1: no later point can do better
                break
            enough = best / drop
            share = 1.0
            for i in range(size):
                weight = points[p, i]
                if weight > 0.0 and beliefs[f, i] < share * weight:
                    share = beliefs[f, i] / weight
                    if share <= enough:
                        break
            if share > enough:
                best = share * drop
        values[f] = min(values[f], base + best)
