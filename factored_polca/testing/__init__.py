"""A conformance kit for the tests of other packages: what models, solvers, policies, reductions must keep.

    from factored_polca.testing import check_solver

    def test_my_solver():
        check_solver(my_solver)

Each function raises AssertionError with what is wrong and where; none needs a test framework.
"""

from factored_polca.testing.models import check_model
from factored_polca.testing.policies import check_policy
from factored_polca.testing.problems import KnownMDP, KnownPOMDP, known_mdps, known_pomdps
from factored_polca.testing.reductions import check_reduction
from factored_polca.testing.solvers import check_mdp_solver, check_solver

__all__ = [
    "KnownMDP", "KnownPOMDP", "check_mdp_solver", "check_model", "check_policy", "check_reduction",
    "check_solver", "known_mdps", "known_pomdps",
]  # fmt: skip
