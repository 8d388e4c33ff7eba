"""A plan as plain data: what `plan --json` prints and plan files keep."""

from __future__ import annotations

from typing import Any

from factored_polca.hierarchy.irrelevance import KINDS, value_classes
from factored_polca.hierarchy.merging import approximation_report, merging_report, merging_text
from factored_polca.hierarchy.plan import HierarchicalPlan, total_counts
from factored_polca.hierarchy.solved import SolvedTask
from factored_polca.minimisation.reduction import InterchangeableReduction


def plan_report(plan: HierarchicalPlan) -> dict[str, Any]:
    """Figures of a plan: the tasks children first, the polled policy's value, the flat optimum."""
    total = total_counts(plan.solved)
    return {
        "model": plan.model.name,
        "states": plan.model.states,
        "value": plan.polled.value,
        "value_bounds": [plan.polled.lower, plan.polled.upper],
        "flat_value": None if plan.flat is None else plan.flat.value,
        "flat_blocks": None if plan.flat is None else plan.flat.blocks,
        "flat_note": plan.flat_note,
        "guarantee": guarantee(plan),
        **merging_report(plan.root.approximation, plan.certified),
        "tasks": [
            {
                "name": solved.task.name,
                "actions": list(solved.task.actions),
                "blocks": solved.reduction.partition.blocks,
                "q_values": solved.counts.q_values,
                "q_applicable": solved.counts.q_applicable,
                "q_classes": solved.counts.q_classes,
                "q_classes_shared": solved.counts.q_classes_shared,
                "value_classes": classes_by_kind(solved),
                "value": solved.value,
                "solver": solved.solution.method,
                "gap": solved.solution.gap,
                "ties": solved.solution.ties,
                "dead_end_states": solved.dead_end_states,
                "collision_bound": solved.reduction.minimisation.collision_bound,
                "seconds": solved.seconds,
                **approximation_report(solved.approximation),
            }
            for solved in plan.solved
        ],
        "totals": {
            "q_values": total.q_values,
            "q_applicable": total.q_applicable,
            "q_classes": total.q_classes,
            "q_classes_shared": total.q_classes_shared,
        },
        "warnings": list(plan.warnings),
        "order": list(plan.symbolic.order),
        "seconds": plan.seconds,
    }


def classes_by_kind(solved: SolvedTask) -> dict[str, int]:
    """How many classes of equal Q-values, equal values and actions, equal actions a task's states have."""
    exchanged = isinstance(solved.reduction, InterchangeableReduction)
    return {kind: value_classes(solved, kind).classes for kind in KINDS if not (exchanged and kind == "q")}


def guarantee(plan: HierarchicalPlan) -> str:
    """How far the value may be trusted, in words."""
    width = plan.polled.upper - plan.polled.lower
    gap = max(solved.solution.gap for solved in plan.solved)
    chance = sum(solved.reduction.minimisation.collision_bound for solved in plan.solved)
    if plan.root.approximation is not None:
        return merging_text(plan.root.approximation, plan.certified)
    return (
        f"recursively optimal (each task given its children's policies, solver gaps up to {gap:.1g}); the "
        f"policy's value lies in bounds {width:.1g} wide; each partition exact but for a chance "
        f"below {max(chance, 1e-300):.1g}"
    )
