"""`solve` without a list of states, for partially observed models: alpha-vectors as diagrams."""

from __future__ import annotations

import argparse
import math
import time
from typing import TYPE_CHECKING, Any, Final

from factored_polca.cli.commands import compile_kernels, limits
from factored_polca.cli.memory import peak_memory_bytes
from factored_polca.cli.output import Output, big, escape, finite, make_table, seconds
from factored_polca.cli.solve_report import status_text, value_text
from factored_polca.cli.source import Source, UsageError

if TYPE_CHECKING:
    from factored_polca.cli.solve import Task
    from factored_polca.structured.pomdp_solution import SymbolicSolution

SYMBOLIC: Final = "symbolic"
QUIET_SECONDS: Final = 0.1
"""Least time between two progress messages."""


def refuse(source: Source, task: Task) -> None:
    """Refuse what this solver can't do.

    Raises:
        UsageError: a fully observed model, or a horizon.
    """
    if task.model.observability == "full":
        raise UsageError(
            f"{SYMBOLIC} solves partially observed models; {source.name} is fully observed: use --solver "
            "auto, vi, pi or mpi"
        )
    if task.model.horizon is not None:
        raise UsageError(
            f"{source.name} has a horizon of {task.model.horizon} steps, and {SYMBOLIC} has none: use "
            "--solver auto or exact, or --horizon infinite"
        )


def may_be_symbolic(task: Task) -> bool:
    """Whether a model is solved on diagrams where its states are too many to list."""
    partial = task.model.observability == "partial"
    return partial and task.solver == "auto" and task.model.horizon is None


def solve_on_diagrams(
    task: Task, source: Source, arguments: argparse.Namespace, output: Output, reason: str = ""
) -> int:
    """Solve a model on diagrams, print bounds and what they mean, write the policy.

    `reason` says why it is solved in this way, where nobody asked for it.
    """
    from factored_polca.hierarchy.alpha_policy_file import save_alpha_policy
    from factored_polca.structured.pomdp_solution import solve_symbolic
    from factored_polca.symbolic import compile_model

    refuse(source, task)
    compile_seconds = compile_kernels(output)
    began = time.perf_counter()
    with source.located(), output.progress(f"compiling {source.name}"):
        symbolic = compile_model(task.model, memory_limit=limits(arguments)[0])
    build_seconds = time.perf_counter() - began
    last = 0.0

    def progress(lower: float, upper: float) -> None:
        nonlocal last
        if time.monotonic() - last >= QUIET_SECONDS:
            last = time.monotonic()
            text = f"the value lies in {lower:.6g} .. {upper:.6g}, gap {upper - lower:.3g}"
            output.update(f"solving {source.name}: {text}")

    gap = 1e-3 if task.gap is None else task.gap
    with output.progress(f"solving {source.name} on diagrams"):
        found = solve_symbolic(symbolic, task.demand(gap, progress))
    data = described(task, found, gap, reason) | {
        "compile_seconds": compile_seconds,
        "build_seconds": build_seconds,
        "parse_seconds": source.parse_seconds,
    }
    if arguments.output is not None:
        kept = {name: item for name, item in data.items() if not name.endswith("seconds")}
        save_alpha_policy(found.policy, arguments.output, finite(kept))
    data["total_seconds"] = time.perf_counter() - arguments.began
    data["peak_memory_bytes"] = peak_memory_bytes()
    data["warnings"] = [str(warning) for warning in source.warnings]
    if arguments.json:
        output.result(data)
    else:
        print_found(data, arguments, output)
    return {"interrupted": 130, "memory limit": 3}.get(found.status, 0)


def described(task: Task, found: SymbolicSolution, gap: float, reason: str) -> dict[str, Any]:
    """What was found, in numbers and words."""
    return {
        "model": task.model.name,
        "observability": task.model.observability,
        "discount": str(task.model.discount),
        "horizon": None,
        "states": task.model.states,
        "reachable_states": None,  # no state is listed
        "actions": len(task.model.actions),
        "observations": None,
        "blocks": None,
        "solver": task.solver,
        "method": found.method,
        "gap_wanted": gap,
        "lower": found.lower,
        "upper": found.upper,
        "value": found.lower,
        "gap": found.gap,
        "status": found.status,
        "guarantee": found.guarantee.text,
        "guarantee_kind": found.guarantee.kind,
        "note": "; ".join(part for part in (reason, found.note) if part),
        "vectors": found.vectors,
        "nodes": found.policy.nodes,
        "beliefs": found.beliefs,
        "seen": found.seen,
        "backups": found.backups,
        "projections": found.projections,
        "iterations": found.iterations,
        "seed": task.seed,
        "seconds": found.seconds,
    }


def print_found(data: dict[str, Any], arguments: argparse.Namespace, output: Output) -> None:
    """The figures for people."""
    table = make_table(f"{data['model']}, solved", {"": "left", " ": "right"})
    table.show_header = False
    table.add_row("method", escape(data["method"]))
    table.add_row("states, none listed", big(data["states"]))
    table.add_row("actions", f"{data['actions']:,}")
    table.add_row("discount", data["discount"])
    table.add_row("alpha-vectors of the policy", f"{data['vectors']:,}")
    table.add_row("their nodes", f"{data['nodes']:,}")
    table.add_row("beliefs met", f"{data['beliefs']:,}")
    table.add_row("trials", f"{data['iterations']:,}")
    table.add_row("time", seconds(data["seconds"]))
    table.add_row("peak memory", f"{data['peak_memory_bytes'] / 2**20:,.0f} MiB")
    output.table(table)
    output.line(f"value from the start: {value_text(data)}")
    output.line(f"status: {escape(status_text(data, arguments))}")
    output.line(f"guarantee: {escape(data['guarantee'])}")
    output.line(f"note: {escape(data['note'])}")
    if not math.isfinite(data["gap"]):
        return
    if arguments.output is None:
        output.note("-o FILE keeps the policy, and factored-polca simulate FILE runs it")
    else:
        output.note(
            f"policy written to {arguments.output}; try: factored-polca simulate {arguments.output}"
        )
