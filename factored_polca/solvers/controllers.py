"""Finite-state controllers over a prepared problem: their vectors by linear algebra, bounded from below.

A controller n lives in one class y, takes one option j_n of that class, and on branch k of the option
hands over to the controller succ(n, k), which lives in the branch's next class.  What it earns solves

    alpha_n = r_j + gamma * sum over branches k of j of M_k alpha_{succ(n, k)}          (alpha = T alpha)

(Hansen 1998); alpha_n . b <= V*(b) at every belief b over the class.  A branch without a successor
(-1) counts as the value 0.

*Certificate.*  Let v approximate alpha, T v be computed with an error of at most e, and
c = (max(0, max(v - T v)) + e) / (1 - gamma rho), rho >= 1 bounding the sums of rows.  Then
T(v - c) >= v - c, so v - c <= alpha.

Letters as in `pomdp_problem`; vectors of all controllers lie one behind the other, [x].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray, SparseMatrix
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Demand

UNIT: Final = 2.0**-53
DENSE: Final = 300
"""Unknowns up to which a dense solve is quickest."""


@dataclass(frozen=True)
class Controllers:
    """See the module's docstring."""

    problem: Problem
    options: IntArray  # [n] the option j_n
    successors: IntArray  # [n, branch of the option], -1: none, or fewer branches

    @property
    def count(self) -> int:
        """The number of controllers."""
        return len(self.options)

    @cached_property
    def classes(self) -> IntArray:
        """[n] the class that each controller lives in."""
        return self.problem.option_class[self.options]

    @cached_property
    def start(self) -> IntArray:
        """[n + 1] where the vector of each controller begins."""
        sizes = np.diff(self.problem.arrays.offset)[self.classes]
        return np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)

    @cached_property
    def rewards(self) -> FloatArray:
        """[x] r_j of each controller."""
        first = self.problem.arrays.reward_start[self.options]
        shift = np.repeat(first - self.start[:-1], np.diff(self.start))
        found: FloatArray = self.problem.arrays.rewards[shift + np.arange(self.start[-1])]
        return found

    @cached_property
    def moves(self) -> SparseMatrix:
        """gamma times the matrices M_k as one CSR [x, x]."""
        a = self.problem.arrays
        rows, columns, entries = [], [], []
        for j in np.unique(self.options).tolist():
            mine = np.flatnonzero(self.options == j)
            for place, k in enumerate(self.problem.branch_range(j)):
                next_one = self.successors[mine, place]
                known = next_one >= 0
                if not known.any():
                    continue
                at = int(a.branch_rows[k])
                pointers = a.row_start[at : at + self.problem.size(int(self.problem.option_class[j])) + 1]
                inside = slice(int(pointers[0]), int(pointers[-1]))
                row = np.repeat(np.arange(len(pointers) - 1), np.diff(pointers))
                rows.append((self.start[mine[known]][:, None] + row).ravel())
                columns.append((self.start[next_one[known]][:, None] + a.column[inside]).ravel())
                entries.append(np.tile(self.problem.discount * a.probability[inside], int(known.sum())))
        size = int(self.start[-1])
        if not rows:
            return csr_array((size, size))
        place_of = (np.concatenate(rows), np.concatenate(columns))
        return csr_array((np.concatenate(entries), place_of), shape=(size, size))

    def rest(self) -> float:
        """A lower bound on 1 - gamma rho."""
        sums = np.asarray(self.moves.sum(axis=1))
        largest = max(self.problem.discount, float(sums.max(initial=0.0)) * (1 + 1e-14))
        return (1 - largest) * (1 - 8 * UNIT)

    def error(self, vectors: FloatArray) -> float:
        """What rounding may do to one backup."""
        widest = int(np.diff(self.moves.indptr).max(initial=0))
        size = float(np.abs(vectors).max(initial=0.0)) + float(np.abs(self.rewards).max(initial=0.0))
        return (widest + 16) * UNIT * size * 1.001

    def backup(self, vectors: FloatArray) -> FloatArray:
        """T v [x]."""
        return np.asarray(self.rewards + self.moves @ vectors, dtype=np.float64)

    def sweeps(self, vectors: FloatArray, count: int, goal: float, demand: Demand) -> FloatArray:
        """Up to `count` backups, until none changes a number by more than `goal`."""
        for number in range(count):
            new = self.backup(vectors)
            change = float(np.abs(new - vectors).max(initial=0.0))
            vectors = new
            if change <= goal or (number % 64 == 63 and demand.seconds_left <= 0):
                break
        return vectors

    def evaluated(self, start: FloatArray, count: int, goal: float, demand: Demand) -> FloatArray:
        """alpha [x], not yet from below: solved where that is cheap, else `sweeps` from `start`."""
        size = int(self.start[-1])
        if size > DENSE:
            return self.sweeps(start, count, goal, demand)
        solution: FloatArray = np.linalg.solve(np.eye(size) - self.moves.toarray(), self.rewards)
        return solution

    def from_below(self, vectors: FloatArray) -> FloatArray:
        """`vectors` [x] moved down until they certainly are at most alpha."""
        fall = max(0.0, float(np.max(vectors - self.backup(vectors), initial=0.0)))
        shift = (fall + self.error(vectors)) / self.rest()
        return vectors - shift * (1 + 8 * UNIT) - 4 * UNIT * np.abs(vectors)

    def by_class(self, vectors: FloatArray) -> list[tuple[IntArray, FloatArray]]:
        """For each class the controllers [m] and their vectors [m, n_y]."""
        parts = []
        for y in range(self.problem.classes):
            mine = np.flatnonzero(self.classes == y)
            places = self.start[mine][:, None] + np.arange(self.problem.size(y))
            parts.append((mine, vectors[places]))
        return parts

    def best(self, vectors: FloatArray) -> tuple[FloatArray, IntArray]:
        """[root] the largest of the vectors [x] at each root's belief, and whose it is.

        Every root's class must have a controller.
        """
        values, owners = [], []
        parts = self.by_class(vectors)
        for root in self.problem.roots:
            numbers, block = parts[root.y]
            worth = block @ root.belief
            owners.append(int(numbers[worth.argmax()]))
            values.append(float(worth.max()))
        return np.array(values), np.array(owners, dtype=np.int64)

    @cached_property
    def _targets(self) -> IntArray:
        """[n, branch] the class that each branch leads to, -1: the option has fewer branches."""
        a = self.problem.arrays
        branches = a.first_branch[self.options][:, None] + np.arange(self.successors.shape[1])
        real = branches < a.first_branch[self.options + 1][:, None]
        targets: IntArray = np.append(a.branch_target, -1)[np.where(real, branches, -1)]
        return targets

    @property
    def complete(self) -> bool:
        """Whether every branch has a successor."""
        return not np.any((self.successors < 0) & (self._targets >= 0))

    def completed(self) -> Controllers:
        """Where a branch has no successor, the first controller of its class, if there is one."""
        first = np.full(self.problem.classes + 1, -1, dtype=np.int64)  # the last place is for no branch
        classes, where = np.unique(self.classes, return_index=True)
        first[classes] = where
        successors = np.where(self.successors < 0, first[self._targets], self.successors)
        return Controllers(self.problem, self.options, successors)

    def reached(self, first: IntArray) -> tuple[Controllers, IntArray]:
        """The part that can be reached from the controllers `first`, and their old numbers [n]."""
        keep = np.zeros(self.count, dtype=np.bool_)
        layer = np.unique(first)
        while len(layer):
            keep[layer] = True
            following = self.successors[layer].ravel()
            layer = np.unique(following[following >= 0])
            layer = layer[~keep[layer]]
        old = np.flatnonzero(keep)
        new = np.full(self.count + 1, -1, dtype=np.int64)  # the last place answers for -1
        new[old] = np.arange(len(old))
        return Controllers(self.problem, self.options[old], new[self.successors[old]]), old

    def graph(self, start: dict[int, int]) -> PolicyGraph:
        """As a policy graph over the original POMDP; `start` gives the first controller by class.

        What only dead states can show leads back to the controller itself: nothing matters there.
        """
        problem, original = self.problem, self.problem.original
        width = int(original.observed.max()) + 1
        actions = problem.option_action[self.options]
        shown = {j: _shown_when_dead(problem, j) for j in np.unique(self.options).tolist()}
        tables = []
        for number, j in enumerate(self.options.tolist()):
            table = np.full((len(original.kernel[int(actions[number])]), width), -1, dtype=np.int64)
            table[shown[j]] = number
            for place, k in enumerate(problem.branch_range(j)):
                if self.successors[number, place] >= 0:
                    seen = int(problem.seen[problem.arrays.branch_target[k]])
                    table[list(problem.observed_as[k]), seen] = self.successors[number, place]
            tables.append(table)
        first = np.full(width, -1, dtype=np.int64)
        if self.count:
            dead = _dead_states(problem)
            first[original.observed[dead & (original.initial > 0)]] = 0
        for y, number in start.items():
            first[int(problem.seen[y])] = number
        return PolicyGraph(actions, tuple(tables), first)


def _dead_states(problem: Problem) -> BoolArray:
    """[s] not kept though the process goes on (of those that can be reached: dead)."""
    gone = ~problem.original.terminal
    gone[problem.states] = False
    return gone


def _shown_when_dead(problem: Problem, j: int) -> tuple[IntArray, IntArray]:
    """The pairs (observation, number of `observed`) with which option j's action may lead to a dead state.

    From the option's class, or from where all has been dead already.
    """
    dead = _dead_states(problem)
    if not dead.any():
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    bounds, y = problem.arrays.offset, int(problem.option_class[j])
    states = np.concatenate([problem.states[bounds[y] : bounds[y + 1]], np.flatnonzero(dead)])
    observations, seen = [], []
    for number, matrix in enumerate(problem.original.kernel[int(problem.option_action[j])]):
        mass = np.asarray(matrix[states, :].sum(axis=0)) * dead
        found = np.unique(problem.original.observed[mass > 0])
        observations.append(np.full(len(found), number))
        seen.append(found)
    return np.concatenate(observations), np.concatenate(seen)


def idle_graph(problem: Problem) -> PolicyGraph:
    """One node that takes the first action for ever: for problems without a state that matters."""
    pomdp = problem.original
    width = int(pomdp.observed.max()) + 1
    table = np.zeros((len(pomdp.kernel[0]), width), dtype=np.int64)
    return PolicyGraph(np.zeros(1, dtype=np.int64), (table,), np.zeros(width, dtype=np.int64))


def simplest_bounds(problem: Problem) -> tuple[FloatArray, Controllers, FloatArray]:
    """Bounds without any work: U [root]; a controller for each class, with vectors [x] from below.

    No reward is above the largest or below the least, for ever.
    """
    least, largest = problem.reward_range
    rest = 1 - problem.discount
    # rows sum to 1 within 1e-9, which a crude bound can afford
    upper = largest / rest + 1e-8 * abs(largest) / rest**2
    controllers = blind_controllers(problem, list(problem.arrays.first_option[:-1, None]))
    vectors = controllers.from_below(np.full(controllers.start[-1], least / rest))
    return np.full(len(problem.roots), upper), controllers, vectors


def blind_controllers(problem: Problem, options: Sequence[IntArray]) -> Controllers:
    """For each m a controller in each class y that takes option `options[y][m]` there for ever."""
    policies, classes = len(options[0]), problem.classes
    chosen = np.array(options, dtype=np.int64).T.ravel()  # [m, y]
    width = int(np.diff(problem.arrays.first_branch).max(initial=0))
    successors = np.full((policies * classes, width), -1, dtype=np.int64)
    for number, j in enumerate(chosen.tolist()):
        first = number - number % classes
        for place, k in enumerate(problem.branch_range(j)):
            successors[number, place] = first + problem.arrays.branch_target[k]
    return Controllers(problem, chosen, successors)


def joined(parts: Sequence[Controllers]) -> Controllers:
    """Several groups of controllers of one problem as one, the numbers of the later ones moved up."""
    successors, first = [], 0
    for part in parts:
        successors.append(np.where(part.successors >= 0, part.successors + first, -1))
        first += part.count
    options = np.concatenate([part.options for part in parts])
    return Controllers(parts[0].problem, options, np.vstack(successors))
