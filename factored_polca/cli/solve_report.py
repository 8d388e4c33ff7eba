"""What `solve` keeps and says of what it found, whichever way it solved."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, Protocol

from factored_polca.cli.memory import peak_memory_bytes
from factored_polca.cli.output import Output, big, escape, finite, make_table, seconds
from factored_polca.cli.source import Source

if TYPE_CHECKING:
    from factored_polca.cli.solve import Task
    from factored_polca.solvers.result import Guarantee, Status

QUIET_SECONDS: Final = 0.1
"""Least time between two progress messages."""
EXIT: Final[Mapping[str, int]] = {"interrupted": 130, "memory limit": 3}
"""Exit statuses of what did not end by itself; of all else 0."""

Print = Callable[[Mapping[str, Any], argparse.Namespace, Output], None]


class Solution(Protocol):
    """What every way of solving finds; bounds are on the optimal value from the start."""

    @property
    def lower(self) -> float: ...
    @property
    def upper(self) -> float: ...
    @property
    def gap(self) -> float: ...
    @property
    def status(self) -> Status: ...
    @property
    def guarantee(self) -> Guarantee: ...
    @property
    def method(self) -> str: ...
    @property
    def iterations(self) -> int: ...
    @property
    def seconds(self) -> float: ...
    @property
    def note(self) -> str: ...


def shown(source: Source, output: Output) -> Callable[[str], None]:
    """Shows how far the solving is, not more often than every `QUIET_SECONDS`."""
    last = -math.inf

    def show(text: str) -> None:
        nonlocal last
        if time.monotonic() - last >= QUIET_SECONDS:
            last = time.monotonic()
            output.update(f"solving {source.name}: {text}")

    return show


def described(task: Task, found: Solution, gap: float | None, value: float) -> dict[str, Any]:
    """The model, what was asked for (`gap`), and what was found: what all ways have in common."""
    return {
        "model": task.model.name,
        "observability": task.model.observability,
        "discount": str(task.model.discount),
        "horizon": task.model.horizon,
        "states": task.model.states,
        "reachable_states": None,
        "actions": len(task.model.actions),
        "observations": None,
        "blocks": None,
        "solver": task.solver,
        "method": found.method,
        "gap_wanted": gap,
        "lower": found.lower,
        "upper": found.upper,
        "value": value,
        "gap": found.gap,
        "status": found.status,
        "guarantee": found.guarantee.text,
        "guarantee_kind": found.guarantee.kind,
        "note": found.note,
        "vectors": None,
        "iterations": found.iterations,
        "seed": task.seed,
        "seconds": found.seconds,
        "build_seconds": 0.0,
    }


def conclude(
    data: dict[str, Any],
    save: Callable[[Any, str], None],
    source: Source,
    arguments: argparse.Namespace,
    output: Output,
    printed: Print,
) -> int:
    """Write the policy, by `save` of what is kept and the path; tell what was found; the exit status."""
    if arguments.output is not None:
        save(finite({k: v for k, v in data.items() if not k.endswith("seconds")}), arguments.output)
    data["parse_seconds"] = source.parse_seconds
    data["total_seconds"] = time.perf_counter() - arguments.began
    data["peak_memory_bytes"] = peak_memory_bytes()
    data["warnings"] = [str(warning) for warning in source.warnings]
    if arguments.json:
        output.result(data)
    else:
        printed(data, arguments, output)
    return EXIT.get(data["status"], 0)


def note_policy(arguments: argparse.Namespace, output: Output) -> None:
    """Where the policy is, or how to keep it."""
    if arguments.output is None:
        output.note("-o FILE keeps the policy, and factored-polca simulate FILE runs it")
    else:
        output.note(
            f"policy written to {arguments.output}; try: factored-polca simulate {arguments.output}"
        )


def print_solution(data: Mapping[str, Any], arguments: argparse.Namespace, output: Output) -> None:
    """The figures of `solve`."""
    table = make_table(f"{data['model']}, solved", {"": "left", " ": "right"})
    table.show_header = False
    table.add_row("method", escape(data["method"]))
    table.add_row("states", big(data["states"]))
    listed = data["reachable_states"] is not None
    if listed and data["reachable_states"] != data["states"]:
        table.add_row("of them reachable", f"{data['reachable_states']:,}")
    if data["blocks"] is not None:
        table.add_row("blocks", f"{data['blocks']:,}")
    table.add_row("actions", f"{data['actions']:,}")
    if data["observations"] is not None:
        table.add_row("observations", f"{data['observations']:,}")
    steps = "" if data["horizon"] is None else f", {data['horizon']:,} steps"
    table.add_row("discount", f"{data['discount']}{steps}")
    if data["vectors"] is not None:
        table.add_row("size of the policy", f"{data['vectors']:,}")
    table.add_row("iterations", f"{data['iterations']:,}")
    table.add_row("time", seconds(data["seconds"]))
    if listed:
        table.add_row("states listed in", seconds(data["build_seconds"]))
    table.add_row("kernels loaded or compiled", seconds(data["compile_seconds"]))
    table.add_row("peak memory", f"{data['peak_memory_bytes'] / 2**20:,.0f} MiB")
    output.table(table)
    output.line(f"value from the start: {value_text(data)}")
    output.line(f"status: {escape(status_text(data, arguments))}")
    output.line(f"guarantee: {escape(data['guarantee'])}")
    if data["note"]:
        output.line(f"note: {escape(data['note'])}")
    note_policy(arguments, output)


def value_text(data: Mapping[str, Any]) -> str:
    """The bounds, with as many digits as they are sure of."""
    lower, upper, gap = data["lower"], data["upper"], data["gap"]
    if upper == -math.inf:
        return "[bold]none[/]: from the start a dead end can't be avoided"
    if not (math.isfinite(lower) and math.isfinite(upper)):
        return f"[bold]not bounded yet[/]: between {lower:g} and {upper:g}"
    size = max(abs(lower), abs(upper), 1e-300)
    if gap <= 1e-9 * max(size, 1.0):
        return f"[bold]{data['value']:.9g}[/] (bounds {gap:.1g} wide)"
    scale = 10.0 ** min(12, max(0, 1 - math.floor(math.log10(gap))))
    low, high = math.floor(lower * scale) / scale, math.ceil(upper * scale) / scale
    said = f"between [bold]{low:.12g}[/] and [bold]{high:.12g}[/] (gap {gap:.2g})"
    if data["guarantee_kind"] == "heuristic":
        said += f"; {data['method']}'s own estimate is {data['value']:.6g}"
    return said


def status_text(data: Mapping[str, Any], arguments: argparse.Namespace) -> str:
    """Why the solver stopped, and what would get further."""
    wanted, gap = data["gap_wanted"], data["gap"]
    further = "; more time, another --solver or a wider --gap would end it" if wanted is not None else ""
    match data["status"]:
        case "converged" if data["horizon"] is not None:
            return f"done, all {data['horizon']:,} steps"
        case "converged" if wanted is None or gap <= wanted:
            reached = "" if wanted is None else f", the gap is at most the {wanted:g} asked for"
            return f"done{reached}"
        case "converged":
            return f"done: {data['method']} has no more to do; its bounds are no closer than that"
        case "time limit":
            return f"stopped after {arguments.time:g} s (--time), with the best so far{further}"
        case "iteration limit" if arguments.iterations is not None:
            return f"stopped after {arguments.iterations} iterations (--iterations){further}"
        case "iteration limit":
            return "done: there is no more to do, and the gap is wider than asked for; try --solver auto"
        case "rounding limit":
            return "stopped where floating-point numbers can't tighten the bounds further"
        case "interrupted":
            return f"interrupted by Ctrl-C, with the best so far{further}"
        case status:
            return f"stopped: {status}, with the best so far; another --solver may need less"
