"""What `solve` and the simulation of its policies say to people."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from typing import Any

from factored_polca.cli.output import Output, big, escape, make_table, seconds


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
    if arguments.output is None:
        output.note("-o FILE keeps the policy, and factored-polca simulate FILE runs it")
    else:
        output.note(
            f"policy written to {arguments.output}; try: factored-polca simulate {arguments.output}"
        )


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
