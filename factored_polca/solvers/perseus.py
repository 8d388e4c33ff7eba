"""Perseus: randomised point-based value iteration (Spaan & Vlassis 2005), with policy evaluation.

The pool B is met on random runs from the roots.  One iteration, class by class:

    1. U := the beliefs of B.
    2. Back up the present Gamma at a few beliefs drawn from U (a batch, for the matrix products' sake).
    3. Drop from U these, and all whose value the new vectors reach; go to 2 while U is not empty.

So the value of every belief rises or stays, though few are backed up.  The nodes are then evaluated and
certified as for PBVI (`factored_polca.solvers.pbvi`).

When the values settle B is doubled, by runs that take random options, or those of the largest upper
bound, or those of Gamma's best vector: uniformly random runs alone seldom get deep into a problem.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.batched_backup import best_vectors
from factored_polca.solvers.belief_pool import BeliefPool, explored
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.pool_iteration import Nodes, Run, solve_with
from factored_polca.solvers.qmdp import option_vectors

START: Final = 256
"""Beliefs in the first pool."""

BATCH: Final = 32
"""Beliefs backed up at a time, and more where many are left: an eighth of them."""

DEPTH: Final = 100
"""Most steps of a run."""

SHARE: Final = 0.01
"""Runs end where the discount has left this share of a reward."""

TRIES: Final = 4
"""Sets of runs before the pool is taken as it is."""

WILD: Final = 0.2
"""Share of random options in runs that follow a rule."""


def solve_perseus(problem: Problem, demand: Demand | None = None) -> POMDPSolution:
    """Perseus with policy evaluation.

    `demand.iterations` counts iterations as the module's docstring says.  Without limits the run ends,
    with the status "iteration limit", when at `POOL` beliefs (fewer for very large classes) or at a pool
    that runs no longer extend the values no longer rise, or after `LAST_ROUNDS` iterations (both in
    `pool_iteration`).

    Raises:
        ModelError: no discount below 1.
    """
    return solve_with(problem, demand, "Perseus", _explore_and_settle)


def _explore_and_settle(run: Run) -> str:
    run.set_pool(explored_further(run, START, ruled=False))
    while True:
        full = run.pool.count >= run.limit
        run.settle(improving_backups, full)
        if run.status is not None:
            return ""
        before = run.pool.count
        if not full:
            run.set_pool(explored_further(run, 2 * before, ruled=True))
        if run.pool.count == before:
            run.settle(improving_backups, True)
            return f"values at the largest pool, {before} beliefs, no longer rise"


def explored_further(run: Run, limit: int, *, ruled: bool) -> BeliefPool:
    """The run's pool, with beliefs that runs from the roots meet up to `limit` in all."""
    problem, pool = run.problem, run.pool
    limit = min(limit, run.limit)
    discount = problem.discount
    depth = 1 if discount == 0 else min(DEPTH, 1 + int(np.log(SHARE) / np.log(discount)))

    def largest_upper_bound(y: int, beliefs: FloatArray) -> IntArray:
        worth = best_vectors(beliefs, option_vectors(problem, run.upper_vectors, y))[0]
        return problem.option_range(y).start + worth

    def best_of_gamma(y: int, beliefs: FloatArray) -> IntArray:
        vectors, options = run.gamma[y]
        return options[best_vectors(beliefs, vectors)[0]]

    rules = (largest_upper_bound, best_of_gamma) if ruled else ()
    for _ in range(TRIES):
        runs = 2 + 2 * (limit - pool.count) // depth
        run.demand.poll()
        pool = explored(
            problem, pool, run.rng, limit=limit, runs=runs, depth=depth, rules=rules, random=WILD
        )
        if pool.count >= limit:
            break
    return pool


def improving_backups(run: Run, y: int) -> Nodes:
    """Backups at beliefs of class y: drawn until each has been, or has had its value reached again."""
    beliefs, values = run.pool.beliefs[y], run.values[y]
    left = run.rng.permutation(len(beliefs))
    parts: list[Nodes] = []
    while len(left):
        batch = left[: max(BATCH, len(left) // 8)]
        parts.append(run.backed_up(y, beliefs[batch]))
        left = left[len(batch) :]
        left = left[best_vectors(beliefs[left], parts[-1].vectors)[1] < values[left]]
    return Nodes(*(np.concatenate(column) for column in zip(*parts, strict=True)))
