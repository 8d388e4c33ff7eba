"""A plan of a partially observed model as plain data: what `plan --json` prints and plan files keep."""

from __future__ import annotations

from typing import Any

from factored_polca.hierarchy.merging import approximation_report, merging_report, merging_text
from factored_polca.hierarchy.parameters import mdp_parameters, pomdp_parameters, unreduced_parameters
from factored_polca.hierarchy.plan import HierarchicalPlan
from factored_polca.hierarchy.pomdp_plan import PomdpPlan
from factored_polca.hierarchy.pomdp_solved import SolvedPomdpTask
from factored_polca.hierarchy.solved import StructuredTask
from factored_polca.hierarchy.symbolic_task import AnySolvedPomdpTask, SymbolicPomdpTask


def pomdp_plan_report(
    plan: PomdpPlan, polca: HierarchicalPlan | None = None, *, list_states: bool = True
) -> dict[str, Any]:
    """Figures of a plan: the tasks children first, and what no policy can exceed.

    `polca` is the same hierarchy planned as if the state were seen, for its number of parameters.  The
    number without abstraction takes listing all states, which `list_states` may forbid.
    """
    processes = [solved.process for solved in plan.solved]
    none = unreduced_parameters(plan.symbolic, processes) if list_states else None
    tasks = [
        task_report(solved)
        | {
            "parameters": {
                "none": None if none is None else none[number],
                "polca": None if polca is None else polca_parameters(polca, solved.task.name),
                "polca_plus": task_parameters(solved),
            }
        }
        for number, solved in enumerate(plan.solved)
    ]
    return {
        "model": plan.model.name,
        "states": plan.model.states,
        "method": "PolCA+",
        "status": plan.status,
        "discount": float(plan.model.discount),
        "flat_upper": plan.flat.upper,
        "flat_blocks": plan.flat.blocks,
        "flat_note": plan.flat.note,
        "guarantee": guarantee(plan),
        **merging_report(plan.root.approximation, plan.certified),
        "tasks": tasks,
        "totals": {"parameters": {key: total(tasks, key) for key in ("none", "polca", "polca_plus")}},
        "warnings": list(plan.warnings),
        "order": list(plan.symbolic.order),
        "seconds": plan.seconds,
    }


def polca_parameters(polca: HierarchicalPlan, name: str) -> int | None:
    """The parameters of one task as PolCA sees it; None where it was solved without a quotient."""
    solved = polca.task(name)
    if isinstance(solved, StructuredTask):
        return None
    return mdp_parameters(solved.reduction.quotient.mdp)


def total(tasks: list[dict[str, Any]], key: str) -> int | None:
    """The parameters of all tasks, None where those of one are not known."""
    counts = [task["parameters"][key] for task in tasks]
    return None if None in counts else sum(counts)


def task_parameters(solved: AnySolvedPomdpTask) -> int | None:
    """The parameters of one task's model; None where it was solved without a quotient."""
    if isinstance(solved, SymbolicPomdpTask):
        return None
    return pomdp_parameters(solved.reduction.pomdp_quotient.pomdp)


def task_report(solved: AnySolvedPomdpTask) -> dict[str, Any]:
    """Figures of one task; those of blocks are None where it was solved without a quotient."""
    solution = solved.solution
    return {
        "name": solved.task.name,
        "actions": list(solved.task.actions),
        **quotient_report(solved),
        "observes": None if solved.task.observes is None else list(solved.task.observes),
        "lower": solved.lower,
        "upper": solved.upper,
        "corner_gap": solved.corner_gap,
        "solver": solution.method,
        "status": solution.status,
        "guarantee": task_guarantee(solved),
        "vectors": solution.vectors,
        "iterations": solution.iterations,
        "seconds": solved.seconds,
        **approximation_report(solved.approximation),
    }


def quotient_report(solved: AnySolvedPomdpTask) -> dict[str, Any]:
    """What a task's report says of its quotient, or why there is none."""
    if isinstance(solved, SymbolicPomdpTask):
        left_out = dict.fromkeys(("blocks", "observations", "ties", "collision_bound", "minimise_seconds"))
        note = "; ".join(part for part in (solved.reason, solved.solution.note) if part)
        return left_out | {"nodes": solved.solution.policy.nodes, "note": note}
    quotient = solved.reduction.pomdp_quotient
    before, after = quotient.observations_before, quotient.observations_after
    return {
        "blocks": solved.reduction.partition.blocks,
        "observations": {
            name: {"before": before[c], "after": after[c]} for c, name in enumerate(solved.task.actions)
        },
        "ties": solved.ties,
        "collision_bound": solved.reduction.minimisation.collision_bound,
        "minimise_seconds": solved.minimise_seconds,
        "nodes": None,
        "note": "",
    }


def task_guarantee(solved: AnySolvedPomdpTask) -> str:
    """How far the bounds of a task may be trusted, in words."""
    text = solved.solution.guarantee.text
    if solved.task.observes is None:
        return text
    return f"{text}; with all that it will observe the task can earn more than it plans to"


def guarantee(plan: PomdpPlan) -> str:
    """How far the values may be trusted, in words."""
    reduced = [solved for solved in plan.solved if isinstance(solved, SolvedPomdpTask)]
    chance = sum(solved.reduction.minimisation.collision_bound for solved in reduced)
    if plan.root.approximation is not None:
        return merging_text(plan.root.approximation, plan.certified)
    certified = plan.certified is not None and plan.certified.polled_lower is not None
    text = (
        "each task's bounds hold in its own model, given what its children do where they are certain; what "
        f"the polled policy earns is measured{' and certified' if certified else ''}"
    )
    if reduced:
        text += f"; each partition exact but for a chance below {max(chance, 1e-300):.1g}"
    names = [solved.task.name for solved in plan.solved if isinstance(solved, SymbolicPomdpTask)]
    if names:
        text += f"; solved on diagrams, without a quotient: {', '.join(names)}"
    return text
