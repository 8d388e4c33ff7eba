"""A plan as plain data: what `plan --json` prints and plan files keep."""

from __future__ import annotations

from typing import Any

from factored_polca.hierarchy.counts import total_counts
from factored_polca.hierarchy.irrelevance import KINDS, value_classes
from factored_polca.hierarchy.merging import approximation_report, merging_report, merging_text
from factored_polca.hierarchy.plan import HierarchicalPlan
from factored_polca.hierarchy.solved import AnySolvedTask, StructuredTask
from factored_polca.minimisation.reduction import InterchangeableReduction


def plan_report(plan: HierarchicalPlan) -> dict[str, Any]:
    """Figures of a plan: the tasks children first, the polled policy's value, the flat optimum."""
    total = total_counts(plan.solved)
    return {
        "model": plan.model.name,
        "states": plan.model.states,
        "status": plan.status,
        "value": plan.polled.value,
        "value_bounds": [plan.polled.lower, plan.polled.upper],
        "flat_value": None if plan.flat is None else plan.flat.value,
        "flat_value_bounds": None if plan.flat is None else [plan.flat.lower, plan.flat.upper],
        "flat_blocks": None if plan.flat is None else plan.flat.blocks,
        "flat_note": plan.flat_note,
        "guarantee": guarantee(plan),
        **merging_report(plan.root.approximation, plan.certified),
        "tasks": [
            {
                "name": solved.task.name,
                "actions": list(solved.task.actions),
                "blocks": solved.blocks,
                "q_values": None if solved.counts is None else solved.counts.q_values,
                "q_applicable": None if solved.counts is None else solved.counts.q_applicable,
                "q_classes": None if solved.counts is None else solved.counts.q_classes,
                "q_classes_shared": None if solved.counts is None else solved.counts.q_classes_shared,
                "value_classes": classes_by_kind(solved),
                "value": solved.value,
                "solver": solved.method,
                "status": solved.status,
                "gap": solved.gap,
                "ties": solved.ties,
                "dead_end_states": solved.dead_end_states,
                "collision_bound": collision_bound(solved),
                "seconds": solved.seconds,
                "nodes": solved.solution.nodes if isinstance(solved, StructuredTask) else None,
                "note": solved.solution.note if isinstance(solved, StructuredTask) else "",
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


def classes_by_kind(solved: AnySolvedTask) -> dict[str, int]:
    """How many classes of equal Q-values, equal values and actions, equal actions a task's states have."""
    if isinstance(solved, StructuredTask):
        return {}
    exchanged = isinstance(solved.reduction, InterchangeableReduction)
    return {kind: value_classes(solved, kind).classes for kind in KINDS if not (exchanged and kind == "q")}


def guarantee(plan: HierarchicalPlan) -> str:
    """How far the value may be trusted, in words."""
    width = plan.polled.upper - plan.polled.lower
    gap = max(solved.gap for solved in plan.solved)
    bounds = [collision_bound(solved) for solved in plan.solved]
    chance = sum(bound for bound in bounds if bound is not None)
    if plan.root.approximation is not None:
        return merging_text(plan.root.approximation, plan.certified)
    names = [solved.task.name for solved in plan.solved if isinstance(solved, StructuredTask)]
    partitions = f"each partition exact but for a chance below {max(chance, 1e-300):.1g}"
    if len(names) == len(plan.solved):
        partitions = "no partition was needed: structured value iteration on diagrams"
    elif names:
        partitions += f"; without one, by structured value iteration on diagrams: {', '.join(names)}"
    return (
        f"recursively optimal (each task given its children's policies, solver gaps up to {gap:.1g}); the "
        f"policy's value lies in bounds {width:.1g} wide; {partitions}"
    )


def collision_bound(solved: AnySolvedTask) -> float | None:
    """The chance that the partition of a task is too coarse; None where there is no partition."""
    if isinstance(solved, StructuredTask):
        return None
    return solved.reduction.minimisation.collision_bound
