"""PolCA over a task hierarchy: checks, the model of a subtask, the plan, and its file."""

from factored_polca.hierarchy.check import planning_order, task_graph
from factored_polca.hierarchy.counts import QValueCounts, count_q_values
from factored_polca.hierarchy.plan import HierarchicalPlan, Options, plan, total_counts
from factored_polca.hierarchy.solved import SolvedTask

__all__ = [
    "HierarchicalPlan",
    "Options",
    "QValueCounts",
    "SolvedTask",
    "count_q_values",
    "plan",
    "planning_order",
    "task_graph",
    "total_counts",
]
