"""HSVI2, heuristic search value iteration (Smith & Simmons 2005).

Trials go down to the branch with the largest excess gap, P(k) (u - l - eps gamma^-d), and back up both
bounds on the way back; each trial's width is a share of the gap at the root.  What is shared with
SARSOP, and what was added to both, is told in `tree_search`.
"""

from __future__ import annotations

from typing import Final

from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.tree_search import Style, run_search

STYLE: Final = Style("HSVI2", sarsop=False)


def solve_hsvi(problem: Problem, demand: Demand | None = None) -> POMDPSolution:
    """Bounds on V* at the roots and a policy that earns the lower one; `iterations` counts trials.

    Raises:
        ModelError: no discount below 1, or a gap that is not positive.
    """
    return run_search(problem, Demand() if demand is None else demand, STYLE)
