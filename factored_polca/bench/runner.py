"""Run cases, each in a process of its own, one after the other."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

from factored_polca.bench.cases import Case

ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


@dataclass(frozen=True)
class PeerRow:
    """What another program took for the same model, or why it gave nothing.

    `blocks` counts as that program does; `seconds` are the processor's, of building and minimising, without
    starting and parsing; `memory` is in bytes, the whole process.
    """

    program: str
    blocks: int | None
    seconds: float | None
    memory: int | None
    problem: str = ""


@dataclass(frozen=True)
class Row:
    """One case: medians over the repetitions; seconds are the processor's, memory in bytes."""

    case: Case
    states: int
    blocks: int
    rounds: int
    seconds: float
    compile: float
    kernels: float
    nodes: int
    memory: int
    before: int
    problem: str = ""
    peers: tuple[PeerRow, ...] = ()
    actions: int = 0

    @property
    def rate(self) -> float:
        """Diagram nodes made a second of minimising."""
        return self.nodes / self.seconds if self.seconds > 0 else 0.0

    @property
    def best_peer(self) -> PeerRow | None:
        """The quicker one of those that gave something."""
        done = [peer for peer in self.peers if peer.seconds is not None]
        return min(done, key=lambda peer: peer.seconds or 0.0, default=None)

    @property
    def ratio(self) -> float | None:
        """The best peer's seconds over ours."""
        best = self.best_peer
        return (
            None
            if best is None or best.seconds is None or not self.seconds
            else best.seconds / self.seconds
        )

    def data(self) -> dict[str, Any]:
        """For JSON."""
        fields = asdict(self)
        return {**fields, "rate": self.rate, "ratio": self.ratio}


Peer = Callable[[Case, float], Sequence[PeerRow]]
"""Runs a case, with a limit of seconds for each of its ways."""


def run_process(command: Sequence[str], given: object, seconds: float) -> dict[str, Any]:
    """The object that a process prints.

    Raises:
        TimeoutExpired: it took longer than `seconds`.
        CalledProcessError: it failed.
    """
    done = subprocess.run(
        [sys.executable, "-m", *command, json.dumps(given)], check=True, capture_output=True, text=True,
        timeout=seconds, env={**os.environ, **ONE_THREAD},
    )  # fmt: skip
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def reason(error: Exception) -> str:
    """Why a process gave nothing, in a few words."""
    if isinstance(error, subprocess.TimeoutExpired):
        return f"more than {error.timeout:.0f} s"
    if isinstance(error, subprocess.CalledProcessError):
        last = (error.stderr or "").strip().splitlines()
        return last[-1][:200] if last else f"exit status {error.returncode}"
    return str(error)


def run_case(case: Case, repeat: int, seconds: float, peers: Sequence[Peer]) -> Row:
    """One case, `repeat` times, and its peers once."""
    given = {
        "domain": case.domain,
        "settings": dict(case.settings),
        "denominator": case.denominator,
        "interchangeable": case.interchangeable,
    }
    others = tuple(row for peer in peers if case.engines for row in peer(case, seconds))
    try:
        runs = [run_process(["factored_polca.bench.one_run"], given, seconds) for _ in range(repeat)]
    except (subprocess.SubprocessError, ValueError) as error:
        return Row(case, 0, 0, 0, 0.0, 0.0, 0.0, 0, 0, 0, reason(error), others)

    def middle(name: str) -> float:
        return float(median(run[name] for run in runs))

    first = runs[0]
    return Row(
        case, int(first["states"]), first["blocks"], first["rounds"], middle("seconds"), middle("compile"),
        middle("kernels"), int(middle("nodes")), int(middle("memory")), int(middle("before")), "", others,
        first["actions"],
    )  # fmt: skip


def run_cases(
    cases: Sequence[Case],
    *,
    repeat: int = 3,
    seconds: float = 600.0,
    peers: Sequence[Peer] = (),
    told: Callable[[Case, int], None] | None = None,
) -> list[Row]:
    """All cases; `told` is called before each with its number."""
    rows = []
    for number, case in enumerate(cases, 1):
        if told is not None:
            told(case, number)
        rows.append(run_case(case, repeat, seconds, peers))
    return rows
