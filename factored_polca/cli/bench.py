"""The command `bench`: the benchmark as a table."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.table import Table

from factored_polca.bench.cases import Case, chosen
from factored_polca.bench.runner import Row, run_cases
from factored_polca.bench.storm import storm_peers
from factored_polca.bench.table import HEADINGS, cells, growths, heading, markdown, notes
from factored_polca.cli.output import Output, escape
from factored_polca.cli.source import UsageError
from factored_polca.formats.files import write_text


def bench(arguments: argparse.Namespace, output: Output) -> int:
    """Run the cases that were asked for."""
    try:
        cases = chosen(arguments.case, arguments.quick, arguments.large)
    except ValueError as error:
        raise UsageError(str(error)) from None
    if arguments.list:
        return list_cases(cases, output)
    if not cases:
        raise UsageError("no case is left; drop --quick, or ask for --large")
    peers = [] if arguments.no_peer else storm_peers()
    if not peers and not arguments.no_peer:
        output.note("without a peer: stormpy is not installed (pip install 'factored-polca[storm]')")
    with output.progress("benchmark"):
        rows = run_cases(
            cases, repeat=arguments.repeat, seconds=arguments.time, peers=peers,
            told=lambda case, number: output.update(f"{number} of {len(cases)}: {case.name}"),
        )  # fmt: skip
    if arguments.output:
        write_text(Path(arguments.output), lambda: markdown(rows))
    if output.as_json:
        output.result({"machine": heading(), "rows": [row.data() for row in rows], "growth": growths(rows)})
    else:
        show(rows, output)
        if arguments.output:
            output.note(f"written to {arguments.output}")
    return 0


def list_cases(cases: list[Case], output: Output) -> int:
    """The cases, one a line."""
    if output.as_json:
        output.result({"cases": [case.name for case in cases]})
        return 0
    for case in cases:
        settings = "".join(f" --set {name}={value}" for name, value in case.settings.items())
        extra = " --interchangeable" if case.interchangeable else ""
        output.line(escape(f"{case.name:<36}minimise {case.domain}{settings}{extra}"))
    return 0


def show(rows: list[Row], output: Output) -> None:
    """The table for people."""
    output.line(escape(heading()))
    peers = any(row.peers for row in rows)
    headings = HEADINGS if peers else HEADINGS[:8]
    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    for name in headings:
        table.add_column(name, justify="left" if name in ("case", "peer") else "right", no_wrap=True)
    for row in rows:
        table.add_row(*(escape(cell) for cell in cells(row)[: len(headings)]))
    output.table(table)
    for note in notes(rows)[: 3 if peers else 2]:
        output.line(escape(note))
    for line in growths(rows):
        output.line(escape(f"growth of {line}"))
