"""PolCA over a task hierarchy: checks, the model of a subtask, the plan, and its file."""

from factored_polca.hierarchy.check import planning_order, task_graph
from factored_polca.hierarchy.counts import QValueCounts, count_q_values, total_counts
from factored_polca.hierarchy.options import Options
from factored_polca.hierarchy.plan import HierarchicalPlan, plan, plan_mdp
from factored_polca.hierarchy.pomdp_plan import PomdpPlan, plan_pomdp
from factored_polca.hierarchy.pomdp_solved import SolvedPomdpTask
from factored_polca.hierarchy.solved import SolvedTask

__all__ = [
    "HierarchicalPlan",
    "Options",
    "PomdpPlan",
    "QValueCounts",
    "SolvedPomdpTask",
    "SolvedTask",
    "count_q_values",
    "plan",
    "plan_mdp",
    "plan_pomdp",
    "planning_order",
    "task_graph",
    "total_counts",
]
