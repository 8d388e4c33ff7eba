"""Solvers of explicit problems; one algorithm a file, nothing here knows diagrams.

`solve_mdp` (in `choose`) is the entry for fully observed problems: `preparation` removes what has no
finite value, an algorithm (`value_iteration`, `policy_iteration`) runs over `pairs`, `bounds` says
how far its answer can be off, and `greedy` turns it into a policy.
"""

from factored_polca.solvers.choose import METHODS, solve_mdp
from factored_polca.solvers.result import Guarantee, MDPSolution

__all__ = ["METHODS", "Guarantee", "MDPSolution", "solve_mdp"]
