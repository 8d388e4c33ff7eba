"""The graph of the beliefs that can be reached from the roots, unfolded as far as asked.

A *node* is a belief over one class.  An expanded node has a *pair* (node, option) for each option of its
class; a pair has an *edge* for each branch that can be observed, with its probability and the node that
stands for the next belief.  Beliefs are made nodes by *merging*: a belief within the L1 distance
`merge` of a node becomes that node.  `widest` is the largest distance that any merged belief was moved
by, what rounding may have done to it included.

Near ones are found by sorting a projection w . b, 0 <= w <= 1: beliefs at distance d are at most d apart
in it.  Only neighbours in that order are compared; whether they are merged is decided by the distance
itself, and a pair that escapes the search costs a node, not soundness.

Letters as in `pomdp_problem`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray, SparseMatrix
from factored_polca.solvers.pomdp_problem import Problem

UNIT: Final = 2.0**-53
DENSE: Final = 2**20
"""Entries of a class's matrices up to which they are kept dense."""
BLOCK: Final = 2**22
"""Numbers that next beliefs may take at a time."""
NEVER: Final = 1e-250
"""Branches less likely than this are left out."""


@dataclass(frozen=True)
class Edges:
    """The pairs of the expanded nodes and their edges."""

    nodes: IntArray  # [e] the expanded nodes
    first_pair: IntArray  # [e + 1]
    options: IntArray  # [p] the option of each pair
    rewards: FloatArray  # [p] b . r_j
    moves: SparseMatrix  # CSR [p, node], the probabilities
    places: IntArray  # [edge of `moves`] the place of its branch among the option's

    def q_values(self, values: FloatArray, discount: float) -> FloatArray:
        """[p] rewards plus what comes after, from values [node]."""
        return np.asarray(self.rewards + discount * (self.moves @ values), dtype=np.float64)

    def best(self, q_values: FloatArray) -> FloatArray:
        """[e] the largest of each node's q-values [p]."""
        return np.asarray(np.maximum.reduceat(q_values, self.first_pair[:-1]), dtype=np.float64)

    def first_best(self, q_values: FloatArray) -> IntArray:
        """[e] the first pair of each node with its largest q-value."""
        best = self.best(q_values)
        counts = np.diff(self.first_pair)
        hits = np.flatnonzero(q_values >= np.repeat(best, counts))
        owner = np.repeat(np.arange(len(counts)), counts)[hits]
        return hits[np.unique(owner, return_index=True)[1]]


class _Class:
    """The beliefs over one class, and what its options do to them."""

    def __init__(self, problem: Problem, y: int, weights: FloatArray) -> None:
        size, options = problem.size(y), problem.option_range(y)
        self.options = options
        self.rewards = np.array([problem.reward(j) for j in options]).T  # [i, j]
        self.branches = range(
            int(problem.arrays.first_branch[options.start]), int(problem.arrays.first_branch[options.stop])
        )
        self.targets = problem.arrays.branch_target[self.branches.start : self.branches.stop]
        widths = np.diff(problem.arrays.offset)[self.targets]
        self.stop = np.cumsum(widths).tolist()
        self.columns = int(widths.sum())
        self.place = np.asarray(problem.arrays.first_branch)[options.start : options.stop + 1]
        self.place = self.place - self.branches.start
        self.matrix = _side_by_side([problem.matrices[k] for k in self.branches], size)
        self.weights = weights
        self.beliefs = np.zeros((16, size))
        self.ids = np.zeros(16, dtype=np.int64)
        self.count = 0
        self.order = np.zeros(0)  # the projections, ascending
        self.rows = np.zeros(0, dtype=np.int64)  # the rows of `beliefs` in that order

    def next_beliefs(self, beliefs: FloatArray) -> list[FloatArray]:
        """For each branch the next beliefs [m, n_y'], times their probabilities."""
        products = np.asarray(beliefs @ self.matrix)
        return [products[:, start:stop] for start, stop in zip([0, *self.stop], self.stop, strict=False)]

    def append(self, beliefs: FloatArray, first_id: int) -> None:
        """New nodes [m, n_y], numbered from `first_id`."""
        total = self.count + len(beliefs)
        if total > len(self.ids):
            more = max(total, 2 * len(self.ids)) - len(self.ids)
            self.beliefs = np.vstack([self.beliefs, np.zeros((more, self.beliefs.shape[1]))])
            self.ids = np.concatenate([self.ids, np.zeros(more, dtype=np.int64)])
        self.beliefs[self.count : total] = beliefs
        self.ids[self.count : total] = np.arange(first_id, first_id + len(beliefs))
        self.count = total


def _side_by_side(matrices: Sequence[SparseMatrix], rows: int) -> SparseMatrix | FloatArray:
    """[M_k M_k' ...], dense where small."""
    columns = sum(int(matrix.shape[1]) for matrix in matrices)
    if rows * columns <= DENSE:
        return np.hstack([np.zeros((rows, 0)), *[matrix.toarray() for matrix in matrices]])
    start = np.concatenate([[0], np.cumsum([matrix.shape[1] for matrix in matrices])])
    cells = [matrix.tocoo() for matrix in matrices]
    row = np.concatenate([cell.row for cell in cells])
    column = np.concatenate([cell.col + at for cell, at in zip(cells, start, strict=False)])
    return csr_array((np.concatenate([cell.data for cell in cells]), (row, column)), shape=(rows, columns))


class BeliefGraph:
    """See the module's docstring; `widest` and the arrays grow as nodes are expanded."""

    def __init__(self, problem: Problem, merge: float) -> None:
        self.problem, self.merge = problem, merge
        generator = np.random.default_rng(0)  # any weights are sound; fixed ones make results repeatable
        self.classes = [
            _Class(problem, y, generator.random(problem.size(y))) for y in range(problem.classes)
        ]
        self.count = 0
        self.widest = 0.0
        self.node_class = np.zeros(16, dtype=np.int64)
        self.node_row = np.zeros(16, dtype=np.int64)
        self.expanded: BoolArray = np.zeros(16, dtype=np.bool_)
        self.expansions = 0
        self._parts: list[tuple[Any, ...]] = []
        self._edges: Edges | None = None
        places: list[IntArray] = []
        for y in range(problem.classes):
            beliefs = [root.belief for root in problem.roots if root.y == y]
            places.append(self._place(y, np.array(beliefs)) if beliefs else np.zeros(0, dtype=np.int64))
        taken = [0] * problem.classes
        self.roots: list[int] = []  # [root] the node that stands for it
        for root in problem.roots:
            self.roots.append(int(places[root.y][taken[root.y]]))
            taken[root.y] += 1

    @property
    def frontier(self) -> IntArray:
        """The nodes that are not expanded."""
        return np.flatnonzero(~self.expanded[: self.count])

    def beliefs(self, y: int) -> FloatArray:
        """The beliefs [m, n_y] of class y, in the order of `ids`."""
        return self.classes[y].beliefs[: self.classes[y].count]

    def ids(self, y: int) -> IntArray:
        """The nodes [m] of class y."""
        return self.classes[y].ids[: self.classes[y].count]

    def rows(self, y: int, nodes: IntArray) -> FloatArray:
        """The beliefs [m, n_y] of some nodes of class y."""
        found: FloatArray = self.classes[y].beliefs[self.node_row[nodes]]
        return found

    def room(self, limit: int) -> int:
        """How many nodes can be expanded for sure before there are more than `limit` nodes."""
        most = max((len(own.branches) for own in self.classes), default=1)
        return max(0, (limit - self.count) // max(most, 1))

    def expand(self, nodes: IntArray) -> None:
        """Give `nodes` (distinct, not expanded) their pairs and edges."""
        for y in np.unique(self.node_class[nodes]).tolist():
            mine = nodes[self.node_class[nodes] == y]
            step = max(1, BLOCK // max(1, self.classes[y].columns))
            for first in range(0, len(mine), step):
                self._expand(y, mine[first : first + step])
        self.expansions += len(nodes)
        self._edges = None

    def _expand(self, y: int, nodes: IntArray) -> None:
        own = self.classes[y]
        beliefs = own.beliefs[self.node_row[nodes]]
        parts = own.next_beliefs(beliefs)
        chances = np.zeros((len(nodes), len(parts)))
        for place, part in enumerate(parts):
            part.sum(axis=1, out=chances[:, place])
        possible = chances > NEVER
        children = np.full(possible.shape, -1, dtype=np.int64)
        for target in np.unique(own.targets).tolist():
            mine = np.flatnonzero(own.targets == target)
            owner, which = np.nonzero(possible[:, mine])
            size = self.problem.size(target)
            stacked = np.stack([parts[place] for place in mine.tolist()], axis=1)  # [m, branch, i]
            found = stacked[owner, which].reshape(len(owner), size)
            found = found / chances[owner, mine[which]][:, None]
            children[owner, mine[which]] = self._place(target, found)
        running = np.zeros((len(nodes), len(parts) + 1), dtype=np.int64)
        np.cumsum(possible, axis=1, out=running[:, 1:])
        lengths = running[:, own.place[1:]] - running[:, own.place[:-1]]
        options = np.tile(np.arange(own.options.start, own.options.stop), len(nodes))
        rewards = beliefs @ own.rewards
        places = np.arange(len(parts)) - np.repeat(own.place[:-1], np.diff(own.place))
        places = np.broadcast_to(places, possible.shape)[possible]
        self.expanded[nodes] = True
        new = (nodes, options, rewards.ravel(), lengths.ravel(), chances[possible], children[possible])
        self._parts.append((*new, places))

    def _place(self, y: int, beliefs: FloatArray) -> IntArray:
        """The nodes [m] that stand for beliefs [m, n_y] over class y, new ones where none is near."""
        own = self.classes[y]
        keys = beliefs @ own.weights
        if len(beliefs) == 0:
            return np.zeros(0, dtype=np.int64)
        everything = np.concatenate([own.order, keys])
        order = np.argsort(everything, kind="stable")
        ordered = everything[order]
        starts = np.flatnonzero(np.diff(ordered, prepend=-np.inf) > self.merge + 8 * UNIT)
        # `own.rows` are below own.count, the new ones follow: the least of a run is its oldest.
        rows = np.concatenate([own.rows, own.count + np.arange(len(beliefs))])[order]
        oldest = np.repeat(np.minimum.reduceat(rows, starts), np.diff(starts, append=len(rows)))
        stands = np.zeros(len(beliefs), dtype=np.int64)
        new = rows >= own.count
        stands[rows[new] - own.count] = oldest[new]
        is_new, at = self._distances(own, beliefs, stands)
        numbers = own.count + np.cumsum(is_new) - 1
        final = np.where(is_new, numbers, 0)
        late = ~is_new & (stands >= own.count)
        final[~is_new] = stands[~is_new]
        final[late] = numbers[stands[late] - own.count]
        self.widest = max(self.widest, at)
        first_id = self.count
        fresh = beliefs[is_new]
        self._number(y, own.count, len(fresh))
        keep = ~new | np.concatenate([np.zeros(own.count, np.bool_), is_new])[rows]
        own.order = ordered[keep]
        renumbered = np.concatenate([np.arange(own.count), numbers])
        own.rows = renumbered[rows[keep]]
        own.append(fresh, first_id)
        result: IntArray = own.ids[final]
        return result

    def _distances(self, own: _Class, beliefs: FloatArray, stands: IntArray) -> tuple[BoolArray, float]:
        """Which of `beliefs` are nodes of their own, and how far the others were moved at most.

        `stands` [m] proposes a row for each: an older one, or own.count + the place of a new one.  A
        proposal that is too far off is replaced by the first near row, or dropped.
        """
        numbers = np.arange(len(beliefs))
        is_new = stands == own.count + numbers
        others = np.flatnonzero(~is_new)
        pool = np.where(
            (stands[others] < own.count)[:, None],
            own.beliefs[np.minimum(stands[others], max(own.count - 1, 0))],
            beliefs[np.maximum(stands[others] - own.count, 0)],
        )
        distance = np.abs(pool - beliefs[others]).sum(axis=1)
        far = distance > self.merge
        widest = float(distance[~far].max(initial=0.0))
        for number in others[far].tolist():
            near = np.abs(own.beliefs[: own.count] - beliefs[number]).sum(axis=1)
            hits = np.flatnonzero(near <= self.merge)
            if len(hits):
                stands[number] = hits[0]
                widest = max(widest, float(near[hits[0]]))
            else:
                is_new[number] = True
        return is_new, widest + (beliefs.shape[1] + 8) * 4 * UNIT

    def _number(self, y: int, first_row: int, count: int) -> None:
        total = self.count + count
        if total > len(self.node_class):
            more = np.zeros(max(total, 2 * len(self.node_class)) - len(self.node_class), dtype=np.int64)
            self.node_class = np.concatenate([self.node_class, more])
            self.node_row = np.concatenate([self.node_row, more])
            self.expanded = np.concatenate([self.expanded, more.astype(np.bool_)])
        self.node_class[self.count : total] = y
        self.node_row[self.count : total] = np.arange(first_row, first_row + count)
        self.count = total

    def edges(self) -> Edges:
        """All pairs and edges so far."""
        if self._edges is None or self._edges.moves.shape[1] != self.count:
            joined = tuple(np.concatenate(parts) for parts in zip(*self._parts, strict=True))
            self._parts = [joined]
            nodes, options, rewards, lengths, chances, children, places = joined
            counts = np.diff(self.problem.arrays.first_option)[self.node_class[nodes]]
            pointers = np.concatenate([[0], np.cumsum(lengths)])
            moves = csr_array((chances, children, pointers), shape=(len(options), self.count))
            first_pair = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
            self._edges = Edges(nodes, first_pair, options, rewards, moves, places)
        return self._edges
