"""What people see: progress on stderr, tables on stdout, and with --json one object and nothing else."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import IO, Any

from rich import markup
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.status import Status
from rich.table import Table

from factored_polca.cli.memory import peak_memory_bytes

PIPE_WIDTH = 200
"""Columns of a table that goes to a file or a pipe, where nobody told COLUMNS."""


class Output:
    """Where a command writes; `children` says that it has others work for it, whose memory counts too."""

    def __init__(self, as_json: bool, quiet: bool, *, children: bool = False) -> None:
        self.as_json, self.quiet, self.children = as_json, quiet, children
        self.out, self.err = console(sys.stdout), console(sys.stderr)
        self._status: Status | None = None

    def note(self, text: str) -> None:
        """A line for people, on stderr."""
        if not self.quiet:
            self.err.print(escape(text), style="dim")

    def warn(self, text: str) -> None:
        """A warning, on stderr; said even when quiet."""
        self.err.print(f"[yellow]warning:[/] {escape(text)}")

    def error(self, text: str) -> None:
        """An error, on stderr."""
        self.err.print(f"[bold red]error:[/] {escape(text)}", soft_wrap=True)

    @contextmanager
    def progress(self, text: str) -> Iterator[None]:
        """Show a line that `update` changes, while the work goes on; only on a terminal."""
        if self.quiet or not self.err.is_terminal:
            if not self.quiet:
                self.err.print(escape(text), style="dim")
            yield
            return
        with self.err.status(escape(text)) as status:
            self._status = status
            try:
                yield
            finally:
                self._status = None

    def update(self, text: str) -> None:
        """Change the progress line."""
        if self._status is not None:
            self._status.update(escape(text))

    def result(self, data: Mapping[str, Any]) -> None:
        """Print the one JSON object; its integers are exact, however long.

        Every command's has `peak_memory_bytes`: that of its process, if the command says nothing else.
        """
        whole = {"peak_memory_bytes": self.peak_memory_bytes()} | dict(data)
        with any_integer():
            text = json.dumps(finite(whole), allow_nan=False)
        sys.stdout.write(text + "\n")

    def peak_memory_bytes(self) -> int:
        """The most memory that a process of the command has taken."""
        return peak_memory_bytes(children=self.children)

    def table(self, table: Table) -> None:
        """Print a table on stdout, wider than the terminal rather than with numbers cut."""
        wide = self.out.options.update(width=100_000)
        needed = Measurement.get(self.out, wide, table)
        if needed.minimum <= self.out.width:
            self.out.print(table)
        else:
            Console(file=self.out.file, highlight=False, emoji=False, width=needed.maximum).print(table)

    def line(self, text: str = "") -> None:
        """Print a line on stdout; `text` may hold markup."""
        self.out.print(text, soft_wrap=True)


def console(file: IO[str]) -> Console:
    """A console on `file` that shows text as it is, but for the markup that we write ourselves."""
    piped = not file.isatty() and "COLUMNS" not in os.environ
    return Console(file=file, highlight=False, emoji=False, width=PIPE_WIDTH if piped else None)


def escape(text: str) -> str:
    """`text` as it is to be seen: brackets are no markup, control characters are shown as escapes.

    Names in model files are other people's; they must not move the cursor or change the colours.
    """
    return markup.escape(printable(text))


def printable(text: str) -> str:
    """The same for text that is printed without markup."""
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


@contextmanager
def any_integer() -> Iterator[None]:
    """Lift Python's limit on the digits of an integer that is turned into text."""
    limit = sys.get_int_max_str_digits()
    sys.set_int_max_str_digits(0)
    try:
        yield
    finally:
        sys.set_int_max_str_digits(limit)


def finite(value: Any) -> Any:
    """`value` with numbers that JSON lacks (infinities, NaN) turned into null."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return value


def big(number: int) -> str:
    """A whole number with separators, or its size where it is very long."""
    if number < 10**20:
        return f"{number:,}"
    if number < 10**300:
        return f"{number:.4e}"
    return f"10^{math.log10(number):.1f}"


def seconds(value: float) -> str:
    """A duration."""
    return f"{value * 1000:.0f} ms" if value < 1 else f"{value:.1f} s"


def make_table(title: str, columns: Mapping[str, str]) -> Table:
    """An empty table; `columns` maps headings to "left" or "right".

    Only columns on the left give way where the terminal is narrow.
    """
    table = Table(
        title=escape(title), title_justify="left", title_style="bold", header_style="bold",
        box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True, show_edge=False,
    )  # fmt: skip
    for heading, side in columns.items():
        table.add_column(
            heading,
            justify="right" if side == "right" else "left",
            no_wrap=side == "right",
            overflow="fold",
        )
    return table
