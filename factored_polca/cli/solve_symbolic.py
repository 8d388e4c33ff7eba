"""`solve` without a list of states, for partially observed models: alpha-vectors as diagrams."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from factored_polca.cli.commands import compile_kernels, limits
from factored_polca.cli.output import Output, big, escape, make_table, seconds
from factored_polca.cli.solve_report import (
    conclude,
    described,
    note_policy,
    shown,
    status_text,
    value_text,
)
from factored_polca.cli.source import Source, UsageError

if TYPE_CHECKING:
    from factored_polca.cli.solve import Task

SYMBOLIC: Final = "symbolic"


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
    show = shown(source, output)

    def progress(lower: float, upper: float) -> None:
        show(f"the value lies in {lower:.6g} .. {upper:.6g}, gap {upper - lower:.3g}")

    gap = 1e-3 if task.gap is None else task.gap
    with output.progress(f"solving {source.name} on diagrams"):
        found = solve_symbolic(symbolic, task.demand(gap, progress))
    data = described(task, found, gap, found.lower) | {
        "note": "; ".join(part for part in (reason, found.note) if part),
        "vectors": found.vectors,
        "nodes": found.policy.nodes,
        "beliefs": found.beliefs,
        "seen": found.seen,
        "backups": found.backups,
        "projections": found.projections,
        "compile_seconds": compile_seconds,
        "build_seconds": build_seconds,
    }

    def save(kept: dict[str, Any], path: str) -> None:
        save_alpha_policy(found.policy, path, kept)

    return conclude(data, save, source, arguments, output, print_found)


def print_found(data: Mapping[str, Any], arguments: argparse.Namespace, output: Output) -> None:
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
    note_policy(arguments, output)
