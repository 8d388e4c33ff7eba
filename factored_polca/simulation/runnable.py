"""What can be run: plans as the planner makes them, plans made ready or loaded, and flat policies."""

from __future__ import annotations

from typing import TypeAlias

from factored_polca.hierarchy import HierarchicalPlan, PomdpPlan
from factored_polca.hierarchy.executable import ExecutablePlan, executable
from factored_polca.hierarchy.policy_file import FlatPolicy
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan, executable_pomdp

AnyPlan: TypeAlias = HierarchicalPlan | PomdpPlan | ExecutablePlan | ExecutablePomdpPlan | FlatPolicy


def runnable(plan: object) -> ExecutablePlan | ExecutablePomdpPlan | FlatPolicy:
    """What runs a plan or policy.

    Raises:
        TypeError: neither of them.
    """
    if isinstance(plan, HierarchicalPlan):
        return executable(plan)
    if isinstance(plan, PomdpPlan):
        return executable_pomdp(plan)
    if isinstance(plan, (ExecutablePlan, ExecutablePomdpPlan, FlatPolicy)):
        return plan
    raise TypeError(
        f"{type(plan).__name__} can't be run; what can: a plan that `plan` made or `load_plan` read, "
        "or a FlatPolicy"
    )
