"""The benchmark as one table, in Markdown or cell by cell, and how each family grows."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import factored_polca
from factored_polca.bench.runner import PeerRow, Row
from factored_polca.studies.fits import FEWEST, growth

HEADINGS = (
    "case", "states", "blocks", "rounds", "seconds", "of it compiling", "memory MiB", "nodes/s", "peer",
    "peer's blocks", "peer's seconds", "peer's MiB", "ratio of seconds",
)  # fmt: skip

NOTES = (
    "seconds: the processor's, of compiling the model to diagrams and minimising it, kernels loaded from "
    "disk; medians, each repetition in a fresh process",
    "memory: the largest resident set of the process; numpy, scipy and the loaded kernels take "
    "{before:,.0f} MiB of it before there is a model",
    "peer: the quicker one of Storm's two engines on the model written as a PRISM program; its seconds are "
    "of building and minimising, without starting and parsing; from all states, but dd tells no actions by "
    "name, and sparse has a state before the start; — where it was not asked",
)


def large(number: int) -> str:
    """A count, in powers of ten where it is long."""
    return f"{number:,}" if number < 10**9 else f"{float(number):.1e}" if number < 10**300 else "> 10^300"


def seconds_text(seconds: float) -> str:
    """Seconds with two digits that count."""
    return f"{seconds:.3f}" if seconds < 0.1 else f"{seconds:.2f}" if seconds < 10 else f"{seconds:.1f}"


def ratio_text(ratio: float) -> str:
    """A ratio with two digits, or as a whole number."""
    return f"{ratio:.2g}" if ratio < 10 else f"{ratio:,.0f}"


def mebibytes(size: int) -> str:
    """Bytes as MiB."""
    return f"{size / 2**20:,.0f}"


def cells(row: Row) -> tuple[str, ...]:
    """The cells of one row."""
    if row.problem:
        ours: tuple[str, ...] = (row.case.name, "", "", "", row.problem, "", "", "")
    else:
        ours = (
            row.case.name, large(row.states), f"{row.blocks:,}", f"{row.rounds:,}",
            seconds_text(row.seconds), seconds_text(row.compile), mebibytes(row.memory), f"{row.rate:,.0f}",
        )  # fmt: skip
    best = row.best_peer
    if best is not None and best.seconds is not None:
        ratio = "" if row.ratio is None else ratio_text(row.ratio)
        return (
            *ours, best.program, f"{best.blocks:,}", seconds_text(best.seconds),
            mebibytes(best.memory or 0), ratio,
        )  # fmt: skip
    if row.peers:
        return (*ours, *_failed(row.peers), "")
    return (*ours, "—", "", "", "", "")


def _failed(peers: Sequence[PeerRow]) -> tuple[str, str, str, str]:
    return ("; ".join(f"{peer.program}: {peer.problem}" for peer in peers), "", "", "")


def growths(rows: Sequence[Row]) -> list[str]:
    """How the seconds and blocks of each family grow, where it has points enough."""
    found = []
    families = dict.fromkeys(row.case.family for row in rows if row.case.family and not row.problem)
    for family in families:
        points = [row for row in rows if row.case.family == family and not row.problem]
        if len({row.case.size for row in points}) < FEWEST:
            continue
        seconds = growth([(row.case.size, row.seconds) for row in points])
        blocks = growth([(row.case.size, row.blocks) for row in points])
        work = growth([(row.blocks * row.actions, row.seconds) for row in points])
        if seconds is not None and blocks is not None:
            by_work = "" if work is None else f", seconds {work.power.text('(blocks x actions)')}"
            found.append(
                f"{family}: seconds {seconds.better.text()}, blocks {blocks.better.text()}{by_work}, "
                f"n from {min(row.case.size for row in points)} to {max(row.case.size for row in points)}"
            )
    return found


def heading() -> str:
    """What was run, where and when."""
    return (
        f"factored_polca {factored_polca.__version__}, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC, "
        f"{processor()}, {os.cpu_count()} processors, {platform.system()}, "
        f"Python {platform.python_version()}"
    )


def processor() -> str:
    """The processor's name, where the system tells it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def notes(rows: Sequence[Row]) -> list[str]:
    """What the columns mean."""
    before = max((row.before for row in rows if not row.problem), default=0) / 2**20
    return [note.format(before=before) for note in NOTES]


def markdown(rows: Sequence[Row]) -> str:
    """The table and what belongs to it, as a Markdown page's text."""
    lines = [heading(), "", "| " + " | ".join(HEADINGS) + " |"]
    lines.append("|---|" + "---:|" * 7 + "---|" + "---:|" * 4)
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in cells(row)) + " |" for row in rows]
    lines += ["", *(f"- {note}" for note in notes(rows))]
    grown = growths(rows)
    if grown:
        lines += ["", "Growth, fitted to the seconds and blocks of each family:", ""]
        lines += [f"- {line}" for line in grown]
    return "\n".join(lines) + "\n"
