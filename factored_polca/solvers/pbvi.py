"""Point-based value iteration (PBVI; Pineau, Gordon & Thrun 2003), sped up by policy evaluation.

    1. B := the root beliefs, Gamma := blind policies.
    2. Back up Gamma at all of B, until the values at B no longer rise by much.
    3. Add to B, for each belief, the farthest of its simulated successors; go to 2.

Step 2 and the policy that is returned are told in `pool_iteration`.
"""

from __future__ import annotations

from typing import Final

from factored_polca.solvers.belief_pool import farthest_successors
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.pool_iteration import Nodes, Run, solve_with

TRIES: Final = 3
"""Draws of successors none of which is new before a pool counts as closed."""


def solve_pbvi(problem: Problem, demand: Demand | None = None) -> POMDPSolution:
    """PBVI with policy evaluation.

    `demand.iterations` counts rounds of backups at the whole pool, each with its evaluation.  Without
    limits the run ends, with the status "iteration limit", when at `POOL` beliefs (fewer for very large
    classes) or at a pool that no successor extends the values no longer rise, or after `LAST_ROUNDS`
    rounds there (both in `pool_iteration`).

    Raises:
        ModelError: no discount below 1.
    """
    return solve_with(problem, demand, "PBVI", _double)


def _double(run: Run) -> str:
    """Settle and double the pool in turn."""
    while True:
        bigger = run.pool
        for _ in range(TRIES if run.pool.count < run.limit else 0):
            bigger = farthest_successors(run.problem, run.pool, run.rng, run.limit, run.demand.poll)
            if bigger.count > run.pool.count:
                break
        last = bigger.count == run.pool.count
        run.settle(_back_up_all, last)
        if run.status is not None:
            return ""
        if last:
            return f"values at the largest pool, {run.pool.count} beliefs, no longer rise"
        run.set_pool(bigger)


def _back_up_all(run: Run, y: int) -> Nodes:
    return run.backed_up(y, run.pool.beliefs[y])
