"""SARSOP, successive approximations of the reachable space under optimal policies (Kurniawati, Hsu & Lee
2008).

Trials carry targets for both bounds down and end where a node can neither raise the lower bound at the
root, as far as a learnt prediction can tell, nor widen its gap.  What is shared with HSVI2, and what
was added to both, is told in `tree_search`.  Options that are worse than the lower bound, and all
beliefs behind them, drop out of the search as the bounds tighten.
"""

from __future__ import annotations

from typing import Final

from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.tree_search import Style, run_search

STYLE: Final = Style("SARSOP", sarsop=True)


def solve_sarsop(problem: Problem, demand: Demand | None = None) -> POMDPSolution:
    """Bounds on V* at the roots and a policy that earns the lower one; `iterations` counts trials.

    Raises:
        ModelError: no discount below 1, or a gap that is not positive.
    """
    return run_search(problem, Demand() if demand is None else demand, STYLE)
