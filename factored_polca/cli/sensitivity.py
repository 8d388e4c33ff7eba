"""The command `sensitivity`: one minimisation, many settings of the parameters."""

from __future__ import annotations

import argparse
import csv
import io
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from factored_polca.cli.commands import (
    compile_kernels,
    limits,
    refuse_unwritable,
    report_warnings,
)
from factored_polca.cli.memory import peak_memory_bytes
from factored_polca.cli.output import Output, big, escape, make_table, seconds
from factored_polca.cli.source import Source, UsageError, load

if TYPE_CHECKING:
    from fractions import Fraction

    from factored_polca.models import Model
    from factored_polca.parametric import ParametricProcess, ParametricQuotient
    from factored_polca.parametric.sensitivity import Sensitivity

MAXIMUM_SETTINGS: Final = 1_000_000
ROWS_SHOWN: Final = 11
PICTURES: Final = (".png", ".svg")


def sensitivity(arguments: argparse.Namespace, output: Output) -> int:
    """Minimise with parameters as symbols, solve at each setting, print, draw or list the values."""
    from factored_polca.parametric import reduce_parametric
    from factored_polca.parametric.sensitivity import grid, spaced
    from factored_polca.parametric.sensitivity import sensitivity as study

    ranges = checked_ranges(arguments)
    source = load(arguments.model, arguments.set, keep=tuple(ranges))
    refuse_unsolvable(source)
    report_warnings(source, output)
    partial = source.model.observability == "partial"
    compile_seconds = compile_kernels(output, arguments.solver if partial else None)
    memory, deadline = limits(arguments)
    began = time.process_time()
    with source.located(), output.progress(f"minimising {source.name} with {', '.join(ranges)} as symbols"):
        process = opened(source, tuple(ranges), arguments, memory, deadline)
        quotient = reduce_parametric(
            process,
            seed=arguments.seed,
            progress=lambda number, blocks: output.update(
                f"minimising {source.name}: round {number}, {blocks:,} blocks"
            ),
        )
    minimise_seconds = time.process_time() - began
    settings = grid({name: spaced(*row) for name, row in ranges.items()})
    with output.progress(f"solving {source.name} at {len(settings):,} settings"):
        found = study(
            quotient, settings, gap=arguments.gap, method=arguments.solver, deadline=deadline,
            seed=arguments.seed,
            progress=lambda done, count: output.update(f"{done:,} of {count:,} settings solved"),
        )  # fmt: skip
    if arguments.output is not None:
        write(found, arguments.output, source.name)
    data = figures(source, found, len(settings))
    data |= {
        "minimise_seconds": minimise_seconds,
        "compile_seconds": compile_seconds,
        "parse_seconds": source.parse_seconds,
        "total_seconds": time.perf_counter() - arguments.began,
        "peak_memory_bytes": peak_memory_bytes(),
        "output": arguments.output,
    }
    if arguments.json:
        output.result({**data, "points": rows(found)})
    else:
        show(data, found, output)
    return 130 if found.stopped == "interrupted" else 0


def checked_ranges(arguments: argparse.Namespace) -> dict[str, tuple[Fraction, Fraction, int]]:
    """The ranges by parameter.

    Raises:
        UsageError: a parameter twice, too many settings, or an output that nothing is known to write.
    """
    ranges: dict[str, tuple[Fraction, Fraction, int]] = {}
    for name, low, high, count in arguments.set_range:
        if name in ranges:
            raise UsageError(f"--set-range is given twice for {name}")
        ranges[name] = low, high, count
    total = math.prod(count for _, _, count in ranges.values())
    if total > MAXIMUM_SETTINGS:
        raise UsageError(f"the ranges make {total:,} settings; at most {MAXIMUM_SETTINGS:,} are solved")
    if arguments.output is not None:
        extension = Path(arguments.output).suffix.lower()
        if extension not in (*PICTURES, ".csv"):
            listed = ", ".join((*PICTURES, ".csv"))
            raise UsageError(f"{arguments.output}: the extension must be one of {listed}")
        if extension != ".csv":
            if len(ranges) > 2:
                raise UsageError(f"{len(ranges)} ranges can't be drawn: write them as .csv")
            refuse_without_matplotlib()
        refuse_unwritable(arguments.output)
    return ranges


def refuse_without_matplotlib() -> None:
    """Find out before the work that nothing can be drawn.

    Raises:
        UsageError: matplotlib is not installed.
    """
    from factored_polca.display.extras import MissingLibrary, library

    try:
        library("matplotlib.figure", "viz", "drawing")
    except MissingLibrary as error:
        raise UsageError(str(error)) from None


def refuse_unsolvable(source: Source) -> None:
    """Refuse a model that is only defined for some steps.

    Raises:
        UsageError: it has a horizon.
    """
    if source.model.horizon is not None:
        raise UsageError(
            f"{source.name} has a horizon of {source.model.horizon} steps, and sensitivity solves for an "
            "infinite one: leave the horizon out of the model"
        )


def opened(
    source: Source,
    names: tuple[str, ...],
    arguments: argparse.Namespace,
    memory: int | None,
    deadline: float | None,
) -> ParametricProcess:
    """The flat process of a model with parameters as symbols, as the arguments limit it."""
    from factored_polca.minimisation import flat_process
    from factored_polca.parametric import compile_parametric, parametric_process
    from factored_polca.symbolic.reach import reachable_states

    symbolic = compile_parametric(
        source.model, names, order=arguments.order, memory_limit=memory, deadline=deadline
    )
    reachable = reachable_states(symbolic).diagram if arguments.reachable else None
    return parametric_process(flat_process(symbolic, None, reachable))


def kept_symbols(model: Model, names: tuple[str, ...] | None) -> dict[str, Fraction] | None:
    """The symbols of the parameters that `--keep-parameters` names; None without that option."""
    from factored_polca.models.rational_functions import FunctionField
    from factored_polca.parametric.process import kept_parameters

    if names is None:
        return None
    kept = kept_parameters(model, names or None)
    field = FunctionField(kept)
    return {name: field.symbol(name) for name in kept}


def parameter_data(process: ParametricProcess) -> dict[str, Any]:
    """The parameters that stay symbols, and the conditions on them, as plain data."""
    from factored_polca.parametric.conditions import region_text

    return {
        "parameters": {name: str(value) for name, value in process.nominal.items()},
        "conditions": [str(condition) for condition in process.conditions],
        "region": region_text(process.conditions),
    }


def figures(source: Source, found: Sensitivity, settings: int) -> dict[str, Any]:
    """What was done, in numbers."""
    quotient: ParametricQuotient = found.quotient
    instantiate, solve = found.mean_microseconds()
    good = found.admissible
    return {
        "model": source.model.name,
        "states": source.model.states,
        "blocks": quotient.partition.blocks,
        "collision_bound": quotient.minimisation.collision_bound,
        "observability": source.model.observability,
        **parameter_data(quotient.process),
        "operations": quotient.program.registers,
        "settings": settings,
        "solved": len(good),
        "refused": len(found.points) - len(good),
        "from_last_policy": sum(point.warm for point in good),
        "policies": None if quotient.partial else len(found.policies),
        "stopped": found.stopped,
        "widest_gap": max((point.upper - point.lower for point in good), default=None),
        "least": min((point.value for point in good), default=None),
        "greatest": max((point.value for point in good), default=None),
        "instantiate_microseconds": instantiate,
        "solve_microseconds": solve,
    }


def rows(found: Sensitivity) -> list[dict[str, Any]]:
    """The points as plain data."""
    return [
        {
            **{name: float(point.setting[name]) for name in found.parameters},
            "value": point.value,
            "lower": point.lower,
            "upper": point.upper,
            "policy": None if point.policy < 0 else point.policy,
            "refused": point.refused,
        }
        for point in found.points
    ]


def write(found: Sensitivity, path: str, name: str) -> None:
    """Draw the points, or list them as CSV; the file appears whole or not at all."""
    from factored_polca.formats.files import write_bytes, write_text

    if Path(path).suffix.lower() == ".csv":
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*found.parameters, "value", "lower", "upper", "policy", "refused"])
        for row in rows(found):
            keys = (*found.parameters, "value", "lower", "upper", "policy", "refused")
            writer.writerow(["" if row[key] is None else row[key] for key in keys])
        write_text(path, text.getvalue)
        return
    from factored_polca.display.sensitivity_plot import picture

    write_bytes(path, lambda: picture(found, name, Path(path).suffix.lower()[1:]))


def show(data: dict[str, Any], found: Sensitivity, output: Output) -> None:
    """The figures and some of the points, for people."""
    table = make_table(f"{data['model']}, value by parameter", {"": "left", " ": "left"})
    table.show_header = False
    table.add_row("states", big(data["states"]))
    table.add_row("blocks", f"{data['blocks']:,}")
    table.add_row("symbols", escape(", ".join(data["parameters"])))
    table.add_row("admissible", escape("; ".join(data["region"]) or "everywhere"))
    refused = f", {data['refused']:,} not admissible" if data["refused"] else ""
    table.add_row("settings", f"{data['solved']:,} solved of {data['settings']:,}{refused}")
    if data["policies"] is not None:
        table.add_row("optimal policies", f"{data['policies']:,}")
    if data["solved"]:
        table.add_row("value from the start", f"{data['least']:.6g} to {data['greatest']:.6g}")
        table.add_row("widest bounds", f"{data['widest_gap']:.2g}")
        table.add_row("minimised once in", seconds(data["minimise_seconds"]))
        table.add_row(
            "for each setting",
            f"{data['instantiate_microseconds']:,.0f} us to set, "
            f"{data['solve_microseconds']:,.0f} us to solve",
        )
    output.table(table)
    columns = dict.fromkeys(found.parameters, "right") | {"value": "right"}
    if data["policies"] is not None:
        columns["policy"] = "right"
    points = make_table("some of the settings", columns)
    count = len(found.points)
    places = sorted(
        {round(k * (count - 1) / max(1, ROWS_SHOWN - 1)) for k in range(min(count, ROWS_SHOWN))}
    )
    for point in (found.points[place] for place in places):
        cells = [f"{float(point.setting[name]):.6g}" for name in found.parameters]
        cells.append("not admissible" if point.refused else f"{point.value:.6f}")
        if data["policies"] is not None:
            cells.append("" if point.policy < 0 else str(point.policy))
        points.add_row(*cells)
    if count:
        output.table(points)
    for text in list(dict.fromkeys(point.refused for point in found.points if point.refused))[:5]:
        output.note(f"not admissible where {text}")
    if data["stopped"]:
        output.warn(f"stopped ({data['stopped']}) after {count:,} of {data['settings']:,} settings")
