"""Policy evaluation inside the search: what HSVI2 and SARSOP take from point-based policy iteration.

The vectors that are best at the opened beliefs are backed up there once more, become the nodes of a
finite-state controller, and are replaced by what that controller earns (`pool_iteration`).  This takes
the place of a hundred rounds of backups along trials.  The new vectors link to one another.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.belief_tree import (
    AT,
    CLASS,
    COUNT,
    FIRST_CHOICE,
    FIRST_LINK,
    LINKS,
    NEWEST_VECTOR,
    NODES,
    NUMBERS,
    OF_CLASS,
    OLDER,
    OPTION,
    START,
    VECTORS,
    Tree,
    for_vectors,
    grown,
)
from factored_polca.solvers.controllers import Controllers
from factored_polca.solvers.delayed import DelayedBound
from factored_polca.solvers.perseus import explored_further, improving_backups
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.solvers.pool_iteration import Certified, Run

ROUNDS: Final = 3
"""Rounds of backups and evaluation at a time, at most."""
SETTLED: Final = 0.01
"""Rounds go on while the lower bound at b0 rises by more than this share of the gap."""
EXPLORED: Final = 0.5
"""Further beliefs met by running the policies at hand, as a share of those opened."""
NARROW: Final = 16
"""States of a class up to which trials alone are quicker."""


class Evaluator:
    """Evaluates the vectors of a tree as controllers."""

    def __init__(self, problem: Problem, demand: Demand, above: DelayedBound) -> None:
        self.problem = problem
        self.run = Run(problem, replace(demand, progress=None, iterations=None), above)

    def evaluated(self, tree: Tree, gap: float) -> Certified:
        """The controllers backed up at the opened beliefs; `gap` at the roots tells how exact to be."""
        run = self.run
        run.gamma = [self._listed(tree, y) for y in range(self.problem.classes)]
        opened = ((y, b) for y in range(self.problem.classes) for b in self._opened(tree, y))
        run.set_pool(run.pool.extended(opened, run.limit))
        run.set_pool(explored_further(run, int((1 + EXPLORED) * run.pool.count), ruled=True))
        run.last_gain = 0.1 * gap
        for _ in range(ROUNDS):
            before = self.problem.combine(run.last.root_lower)
            run.iterate(improving_backups)
            if self.problem.combine(run.last.root_lower) < before + SETTLED * gap:
                break
        return run.last

    def _opened(self, tree: Tree, y: int) -> FloatArray:
        """The beliefs [m, n_y] of class y that have been opened."""
        count = int(tree.counts[NODES])
        mine = np.flatnonzero((tree.node[:count, FIRST_CHOICE] >= 0) & (tree.node[:count, CLASS] == y))
        beliefs = np.zeros((len(mine), self.problem.size(y)))
        for row, node in enumerate(mine.tolist()):
            here = slice(int(tree.node[node, START]), int(tree.node[node, START] + tree.node[node, COUNT]))
            beliefs[row, tree.entry_state[here]] = tree.entry_weight[here]
        return beliefs

    def _listed(self, tree: Tree, y: int) -> tuple[FloatArray, IntArray]:
        """The vectors [n, n_y] in the list of class y, with their options [n]."""
        numbers, m = [], int(tree.head[y, NEWEST_VECTOR])
        while m >= 0:
            numbers.append(m)
            m = int(tree.vector[m, OLDER])
        places = tree.vector[numbers, AT][:, None] + np.arange(self.problem.size(y))[None, :]
        return tree.number[places], tree.vector[numbers, OPTION]


def with_controllers(tree: Tree, least: IntArray, controllers: Controllers, vectors: FloatArray) -> Tree:
    """`tree` with the vectors [x] of `controllers`, which must be complete, appended."""
    problem, count = controllers.problem, controllers.count
    tree = grown(tree, for_vectors(least) * count)
    base, at, link = (int(tree.counts[name]) for name in (VECTORS, NUMBERS, LINKS))
    tree.number[at : at + len(vectors)] = vectors
    first_branch = problem.arrays.first_branch
    branches = np.diff(first_branch)[controllers.options]
    links = link + np.concatenate([[0], np.cumsum(branches)])
    present = np.arange(controllers.successors.shape[1])[None, :] < branches[:, None]
    tree.links[link : links[-1]] = base + controllers.successors[present]
    rows = tree.vector[base : base + count]
    rows[:, OF_CLASS], rows[:, OPTION] = controllers.classes, controllers.options
    rows[:, AT], rows[:, FIRST_LINK] = at + controllers.start[:-1], links[:-1]
    # From here on Ctrl-C finds the tree in order at any moment: the lists come last.
    tree.counts[LINKS], tree.counts[NUMBERS] = links[-1], at + len(vectors)
    tree.counts[VECTORS] = base + count
    for n, y in enumerate(controllers.classes.tolist()):
        rows[n, OLDER] = tree.head[y, NEWEST_VECTOR]
        tree.head[y, NEWEST_VECTOR] = base + n
    return tree
