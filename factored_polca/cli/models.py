"""The commands about models: domains, new, info, check, convert."""

from __future__ import annotations

import argparse
import os
import secrets
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from factored_polca import library
from factored_polca.cli.output import Output, big, escape, make_table
from factored_polca.cli.source import Source, UsageError, load
from factored_polca.models import Fault, Model, ModelError, TaskHierarchy, Value
from factored_polca.models.expressions import references


def domains(arguments: argparse.Namespace, output: Output) -> int:
    """List the shipped domains."""
    described = [library.describe(name) for name in library.domains()]
    if arguments.json:
        rows = [{"name": d.name, "summary": d.summary} for d in described]
        output.result({"domains": rows})
        return 0
    table = make_table("shipped domains", {"name": "left", "what it is": "left", "parameters": "left"})
    for d in described:
        parameters = ", ".join(f"{p.name}={show(p.default)}" for p in d.parameters)
        table.add_row(escape(d.name), escape(d.summary), escape(parameters))
    output.table(table)
    output.line(
        "factored-polca info NAME tells more; factored-polca plan NAME --set size=8 sets a parameter"
    )
    return 0


def show(value: object) -> str:
    """A value as it is written."""
    return str(value).lower() if isinstance(value, bool) else str(value)


def new(arguments: argparse.Namespace, output: Output) -> int:
    """Write a commented template."""
    from factored_polca.formats import template

    name = arguments.name
    if not name or not all(c.isalnum() or c in "-_" for c in name):
        raise UsageError(f"NAME may have letters, digits, - and _, not {name!r}")
    path = Path(f"{name}.toml")
    if path.exists():
        raise ModelError(f"{path} exists already; choose another name or remove it")
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        temporary.write_text(template(name), encoding="utf-8")
        os.link(temporary, path)
    except FileExistsError:
        raise ModelError(f"{path} exists already; choose another name or remove it") from None
    finally:
        temporary.unlink(missing_ok=True)
    if arguments.json:
        output.result({"file": str(path)})
    else:
        output.line(f"{escape(str(path))} written; try: factored-polca plan {escape(str(path))}")
    return 0


def info(arguments: argparse.Namespace, output: Output) -> int:
    """Describe a model or a domain."""
    source = load(arguments.model, arguments.set)
    model = source.model
    is_domain = source.name in library.domains() and not Path(arguments.model).is_file()
    described = library.describe(source.name) if is_domain else None
    data = model_data(model, source.tasks)
    if described is not None:
        data["documentation"] = described.documentation
        data["domain_parameters"] = [
            {"name": p.name, "default": show(p.default), "kind": p.kind, "documentation": p.documentation}
            for p in described.parameters
        ]
    if arguments.json:
        output.result(data)
        return 0
    if described is not None:
        output.line(escape(described.documentation.strip()))
        table = make_table(
            "parameters (--set NAME=VALUE)",
            {"name": "left", "default": "left", "kind": "left", "meaning": "left"},
        )
        for p in described.parameters:
            table.add_row(escape(p.name), escape(show(p.default)), escape(p.kind), escape(p.documentation))
        output.table(table)
    print_model(data, output)
    return 0


def model_data(model: Model, tasks: TaskHierarchy | None) -> dict[str, Any]:
    """A model's figures as plain data."""
    actions = [
        {
            "name": action.name,
            "changes": [name for name, _ in action.effects],
            "parents": sorted({shown_reference(r) for _, e in action.effects for r in references(e)}),
            "always_applicable": str(action.applicable) == "true",
            "senses": [name for name, _ in action.senses],
        }
        for action in model.actions
    ]
    return {
        "model": model.name,
        "description": model.description,
        "states": model.states,
        "observability": model.observability,
        "discount": str(model.discount),
        "horizon": model.horizon,
        "features": [
            {"name": f.name, "values": list(f.values), "observed": f.observed} for f in model.features
        ],
        "observations": [{"name": o.name, "values": list(o.values)} for o in model.observations],
        "actions": actions,
        "terminal": shorten(str(model.terminal)),
        "reward_terms": len(model.rewards) + sum(len(a.rewards) for a in model.actions),
        "parameters": {name: str(value) for name, value in model.parameters},
        "tasks": [
            {
                "name": t.name,
                "actions": list(t.actions),
                "terminal": shorten(str(t.terminal)),
                "pseudo_reward": t.has_pseudo_reward,
            }
            for t in (tasks.tasks if tasks else ())
        ],
    }


def shown_reference(reference: Any) -> str:
    """A reference as it is written."""
    return f"{reference.name}'" if reference.primed else str(reference.name)


def shorten(text: str, limit: int = 120) -> str:
    """The start of a long text."""
    return text if len(text) <= limit else text[: limit - 4] + " ..."


def values_text(values: list[Value]) -> str:
    """Values on one line."""
    shown = [show(v) for v in values]
    return ", ".join(shown if len(shown) <= 10 else [*shown[:6], "...", shown[-1]])


LONGEST_LIST = 40
"""Rows of a table before the rest is summed up."""


def print_model(data: dict[str, Any], output: Output) -> None:
    """A model's figures for people."""
    partial = data["observability"] != "full"
    steps = "" if data["horizon"] is None else f", {data['horizon']} steps"
    output.line(
        f"[bold]{escape(data['model'])}[/]: {big(data['states'])} states, "
        f"{counted(len(data['features']), 'feature')}, {counted(len(data['actions']), 'action')}, "
        f"{'partially' if partial else 'fully'} observed, discount {data['discount']}{steps}"
    )
    changed = Counter(name for action in data["actions"] for name in action["changes"])
    rows = [
        (
            f["name"],
            f"{len(f['values'])}: {values_text(f['values'])}",
            counted(changed[f["name"]], "action") + (", always seen" if f["observed"] else ""),
        )
        for f in data["features"]
    ]
    print_rows(output, "features", ("name", "values", "changed by"), rows)
    if partial:
        sensed = Counter(name for action in data["actions"] for name in action["senses"])
        rows = [
            (
                o["name"],
                f"{len(o['values'])}: {values_text(o['values'])}",
                counted(sensed[o["name"]], "action"),
            )
            for o in data["observations"]
        ]
        print_rows(output, "observations", ("name", "values", "sensed by"), rows)
        if not rows:
            output.line("no observations: blind")
    headings = ("name", "changes", "depends on", "senses") if partial else ("name", "changes", "depends on")
    rows_of_actions = [
        tuple(
            shorten(text, 60)
            for text in (a["name"], *(", ".join(a[k]) for k in ("changes", "parents", "senses")))
        )[: len(headings)]
        for a in data["actions"]
    ]
    print_rows(output, "actions", headings, rows_of_actions)
    tasks = [(t["name"], shorten(", ".join(t["actions"]), 60), t["terminal"]) for t in data["tasks"]]
    if tasks:
        print_rows(output, "tasks", ("name", "actions", "ends where"), tasks)
    if data["parameters"]:
        listed = ", ".join(f"{name} = {value}" for name, value in data["parameters"].items())
        output.line(f"parameters (--set NAME=VALUE): {escape(listed)}")


def counted(number: int, noun: str) -> str:
    """`1 action`, `2 actions`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def print_rows(
    output: Output, title: str, headings: tuple[str, ...], rows: Sequence[tuple[str, ...]]
) -> None:
    """A table of texts, the end of a long one left out."""
    table = make_table(title, dict.fromkeys(headings, "left"))
    for row in rows[:LONGEST_LIST]:
        table.add_row(*map(escape, row))
    if len(rows) > LONGEST_LIST:
        table.add_row(f"... {len(rows) - LONGEST_LIST} more", *[""] * (len(headings) - 1))
    output.table(table)


def check(arguments: argparse.Namespace, output: Output) -> int:
    """Check a model and its tasks completely."""
    from factored_polca.hierarchy.check import check_undiscounted, checked
    from factored_polca.symbolic import compile_model

    source = load(arguments.model, arguments.set)
    faults: list[Fault] = []
    try:
        symbolic = compile_model(source.model, deadline=deadline(arguments))
        faults += check_undiscounted(symbolic)
    except ModelError as error:
        faults += error.faults
    if source.tasks is not None:
        try:
            checked(source.model, source.tasks)
        except ModelError as error:
            faults += error.faults
    faults = list(source.locate(faults))
    if arguments.json:
        rows = [
            {"message": f.message, "path": list(f.path), "hint": f.hint, "line": f.line, "column": f.column}
            for f in faults
        ]
        output.result({"model": source.model.name, "ok": not faults, "faults": rows})
    elif not faults:
        output.line(f"{escape(source.name)}: no fault found ({big(source.model.states)} states)")
        for warning in source.warnings:
            output.warn(str(warning))
    if faults and not arguments.json:
        raise ModelError(faults)
    return 2 if faults else 0


def deadline(arguments: argparse.Namespace) -> float | None:
    """When `--time` is over, by the monotonic clock."""
    return None if arguments.time is None else time.monotonic() + arguments.time


FLAT = (".pomdp", ".mdp", ".npz")
"""Extensions of files that list states."""


def convert(arguments: argparse.Namespace, output: Output) -> int:
    """Read a model and write it, or its quotient, in another format."""
    from factored_polca.formats import write

    source = load(arguments.model, arguments.set)
    for warning in source.warnings:
        output.warn(str(warning))
    extension = Path(arguments.output).suffix.lower()
    tasks = None if arguments.no_tasks else source.tasks
    data: dict[str, Any] = {"file": arguments.output, "states": source.model.states}
    if tasks is not None and extension in FLAT and not arguments.minimise:
        held = f"a {extension} file can't hold tasks"
        raise ModelError([Fault(held, hint="leave them out: --no-tasks", file=arguments.output)])
    if arguments.minimise:
        if tasks is not None:
            output.note("a quotient has no tasks: they are left out")
        data |= write_quotient(source, arguments, extension, output)
    elif extension in FLAT:
        data |= write_flat(source, arguments, extension, output)
    else:
        write(source.model, arguments.output, tasks)
    if arguments.json:
        output.result(data)
    else:
        counts = [f"{big(data[key])} {key}" for key in ("blocks", "listed") if key in data]
        output.note(f"{arguments.output} written{''.join(f' ({text})' for text in counts)}")
    return 0


def write_flat(
    source: Source, arguments: argparse.Namespace, extension: str, output: Output
) -> dict[str, Any]:
    """Write a model state by state, those that the start can reach; how many."""
    from factored_polca.cli.commands import compile_kernels
    from factored_polca.formats.array_fields import pomdp_fields, write_npz
    from factored_polca.formats.cassandra import plainly_labelled, write_pomdp
    from factored_polca.formats.files import write_text
    from factored_polca.minimisation.flat_model import flat_model
    from factored_polca.symbolic import compile_model

    compile_kernels(output)
    with source.located():
        flat = flat_model(compile_model(source.model, deadline=deadline(arguments)))
    count = flat.pomdp.states
    if extension == ".npz":
        write_npz(pomdp_fields(flat.pomdp), arguments.output)
    else:
        texts = [flat.state_text(state) for state in range(count)]
        first = arguments.first_step and not flat.fully_observed
        name, pomdp = source.model.name, plainly_labelled(flat.pomdp, source.model)
        write_text(arguments.output, lambda: write_pomdp(pomdp, name, texts, first_step=first))
    return {"listed": count}


def write_quotient(
    source: Source, arguments: argparse.Namespace, extension: str, output: Output
) -> dict[str, Any]:
    """Write the quotient of a model, block by block; how many blocks."""
    from factored_polca.cli.commands import compile_kernels
    from factored_polca.formats import format_of, write
    from factored_polca.formats.cassandra import read_pomdp
    from factored_polca.minimisation import PomdpQuotient, flat_process, reduce
    from factored_polca.symbolic import compile_model

    if extension != ".npz":
        format_of(arguments.output)
    compile_kernels(output)
    with source.located(), output.progress(f"minimising {source.name}"):
        symbolic = compile_model(source.model, deadline=deadline(arguments))
        quotient = reduce(flat_process(symbolic)).quotient
    first = {"first_step": True} if arguments.first_step and isinstance(quotient, PomdpQuotient) else {}
    if extension == ".npz":
        quotient.to_npz(arguments.output)
    elif extension in FLAT:
        quotient.to_pomdp(arguments.output, **first)
    else:
        write(read_pomdp(quotient.to_pomdp_text(**first), source.model.name), arguments.output)
    return {"blocks": quotient.partition.blocks}
