"""What people see: progress on stderr, tables on stdout, and with --json one object and nothing else."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.status import Status
from rich.table import Table


class Output:
    """Where a command writes."""

    def __init__(self, as_json: bool, quiet: bool) -> None:
        self.as_json, self.quiet = as_json, quiet
        self.out = Console(highlight=False, soft_wrap=False)
        self.err = Console(stderr=True, highlight=False)
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
        """Print the one JSON object."""
        json.dump(finite(data), sys.stdout, allow_nan=False)
        sys.stdout.write("\n")

    def table(self, table: Table) -> None:
        """Print a table on stdout."""
        self.out.print(table)

    def line(self, text: str = "") -> None:
        """Print a line on stdout; `text` may hold markup."""
        self.out.print(text, soft_wrap=True)


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
    text = f"{number:,}"
    return (
        text if len(text) <= 27 else f"{number:.4e}" if number < 10**300 else f"10^{len(str(number)) - 1}"
    )


def seconds(value: float) -> str:
    """A duration."""
    return f"{value * 1000:.0f} ms" if value < 1 else f"{value:.1f} s"


def make_table(title: str, columns: Mapping[str, str]) -> Table:
    """An empty table; `columns` maps headings to "left" or "right"."""
    table = Table(title=escape(title), title_justify="left", title_style="bold", header_style="bold")
    for heading, side in columns.items():
        right = side == "right"
        one_line = right or heading in ("task", "actions")
        table.add_column(heading, justify="right" if right else "left", no_wrap=one_line)
    return table
