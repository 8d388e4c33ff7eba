"""Solvers of POMDPs that are programs on the PATH: pomdp-solve and APPL's pomdpsol.

    factored-polca solve tiger --solver factored_polca.external.programs:PomdpSolve
    factored-polca plan nursebot --solver factored_polca.external.programs:Sarsop

- `PomdpSolve`: exact value iteration by incremental pruning (Cassandra's pomdp-solve 5), over all beliefs.
- `Sarsop`: SARSOP (Kurniawati, Hsu & Lee 2008; pomdpsol of APPL), from the initial belief and the roots.

The program is started without a shell in a temporary folder, on a file written from the arrays, and ended,
with what it started, after a time limit: the demand's deadline, or `seconds`. Only its policy is used: its
vectors are read back, brought to the original states and evaluated here, so that no bound is taken on
trust (`factored_polca.solvers.proposal`).  The bounds that pomdpsol prints stand in the note, as its claim.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import ParseError, fromstring

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.external.array_files import Layout, lay_out
from factored_polca.models.errors import LimitReached, ModelError
from factored_polca.solvers.pomdp_problem import prepare
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.proposal import alpha_vectors, solution_of_policy
from factored_polca.solvers.tree_search import nothing_to_gain

SECONDS: Final = 600.0
GRACE_SECONDS: Final = 5.0
"""How long a program that was told its limit may take to write what it has."""
SHARE: Final = 0.7
"""Share of the time left that is the program's; what it found is evaluated in the rest."""
LARGEST_FILE: Final = 1 << 28


@dataclass(frozen=True)
class PomdpSolve:
    """pomdp-solve as a `PomdpSolver`."""

    program: str = "pomdp-solve"
    seconds: float = SECONDS

    def __call__(self, pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None) -> POMDPSolution:
        """See the module's docstring.

        Raises:
            ModelError: the program is not there, failed, or wrote what can't be read.
            LimitReached: it wrote nothing within its time.
        """

        def command(path: Path, seconds: float) -> list[str]:
            delta = demand.gap * (1 - pomdp.discount) / (2 * max(pomdp.discount, 0.1))
            return [
                "-pomdp", path.name, "-o", "found", "-method", "incprune", "-stop_criteria", "bellman",
                "-stop_delta", f"{delta:.12g}", "-time_limit", str(max(1, int(seconds))),
            ]  # fmt: skip

        everywhere = prepare(pomdp, roots).roots[:1]
        starts = [pomdp.initial] if everywhere else []
        return _solved(self.program, self.seconds, pomdp, demand, roots, starts, command, _read_alpha)


@dataclass(frozen=True)
class Sarsop:
    """APPL's pomdpsol as a `PomdpSolver`."""

    program: str = "pomdpsol"
    seconds: float = SECONDS

    def __call__(self, pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None) -> POMDPSolution:
        """See the module's docstring.

        Raises:
            ModelError: the program is not there, failed, or wrote what can't be read.
            LimitReached: it wrote nothing within its time.
        """
        problem = prepare(pomdp, roots)
        starts = [problem.belief(root.y, root.belief) for root in problem.roots]
        share = 1.0 if len(starts) == 1 else pomdp.discount / max(1, len(starts))

        def command(path: Path, seconds: float) -> list[str]:
            return [
                "--timeout", str(max(1, int(seconds))), "--precision", f"{demand.gap * share / 2:.12g}",
                "--output", "found.policy", path.name,
            ]  # fmt: skip

        return _solved(self.program, self.seconds, pomdp, demand, roots, starts, command, _read_policy)


Read = Callable[[Path, int], tuple[FloatArray, IntArray]]

_NUMBER: Final = r"(-?[0-9.]+(?:e[-+]?[0-9]+)?)"
_BOUNDS: Final = re.compile(
    rf"^ *{_NUMBER} +\d+ +\d+ +{_NUMBER} +{_NUMBER} +{_NUMBER} +\d+ +\d+ *$", re.MULTILINE
)
"""A line of pomdpsol's table: time, trials, backups, lower and upper bound, precision, vectors, beliefs."""


def claim(printed: str) -> str:
    """What pomdpsol says of the value at the start: words for a note, "" if it says nothing.

    It is the program's word, of its own arithmetic: it goes into no bound of ours.
    """
    found = _BOUNDS.findall(printed)
    return (
        f"; it claims {float(found[-1][1]):.9g} .. {float(found[-1][2]):.9g} at the start" if found else ""
    )


def _solved(
    program: str,
    seconds: float,
    pomdp: ArrayPOMDP,
    demand: Demand,
    roots: FloatArray | None,
    starts: Sequence[FloatArray],
    command: Callable[[Path, float], list[str]],
    read: Read,
) -> POMDPSolution:
    began = time.perf_counter()
    found = shutil.which(program)
    if found is None:
        raise ModelError(f"{program} is not on the PATH: install it, or use a solver of ours")
    if not pomdp.discount < 1:
        raise ModelError(f"{program} is used for a discount below 1 only")
    if not starts:
        return nothing_to_gain(prepare(pomdp, roots), program)
    layout: Layout = lay_out(pomdp, starts)
    limit = min(seconds, SHARE * demand.seconds_left)
    with tempfile.TemporaryDirectory(prefix="factored_polca_") as name:
        folder = Path(name)
        path = folder / "problem.pomdp"
        path.write_text(layout.text, encoding="ascii")
        printed, late = run([found, *command(path, limit)], folder, limit + GRACE_SECONDS)
        try:
            table, actions = read(folder, layout.states)
        except FileNotFoundError:
            said = printed.strip()[-300:] or "nothing"
            if late or limit <= 0:
                raise LimitReached(f"{program} wrote no policy within {limit:.3g} s", "solve") from None
            raise ModelError(f"{program} wrote no policy; it said: {said}") from None
        except ValueError as error:
            raise ModelError(f"{program} wrote a policy that can't be read: {error}") from error
    policy = alpha_vectors(pomdp, layout.vectors(table), actions)
    return solution_of_policy(
        pomdp, policy, method=program, demand=demand, roots=roots, seconds=time.perf_counter() - began,
        status="time limit" if demand.seconds_left <= 0 else "iteration limit",
        note=f"{len(table)} vectors by {program}" + (f", ended after {limit:.3g} s" if late else "")
        + (claim(printed) if len(starts) == 1 else ""),
    )  # fmt: skip


def run(command: Sequence[str], folder: Path, seconds: float) -> tuple[str, bool]:
    """What a program prints, and whether it had to be ended; it and what it started end with the call."""
    with (folder / "printed").open("w+", encoding="utf-8", errors="replace") as printed:
        process = subprocess.Popen(
            list(command), cwd=folder, stdin=subprocess.DEVNULL, stdout=printed, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip
        late = False
        try:
            process.wait(timeout=max(0.0, seconds))
        except subprocess.TimeoutExpired:
            late = True
        finally:
            _end(process)
        size = printed.seek(0, os.SEEK_END)
        printed.seek(max(0, size - 4000))
        return printed.read(), late


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a program's whole session."""
    with contextlib.suppress(ProcessLookupError, PermissionError):  # it has ended
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _text(path: Path) -> str:
    if path.is_symlink() or not path.is_file():
        raise FileNotFoundError(path)
    if path.stat().st_size > LARGEST_FILE:
        raise ValueError(f"it has more than {LARGEST_FILE:,} bytes")
    return path.read_text(encoding="utf-8", errors="replace")


def _read_alpha(folder: Path, states: int) -> tuple[FloatArray, IntArray]:
    """The vectors of found.alpha: lines with an action, then with a number for each state."""
    lines = [line.split() for line in _text(folder / "found.alpha").splitlines()]
    lines = [line for line in lines if line]
    if not lines or len(lines) % 2:
        raise ValueError("an action without numbers, or no vector at all")
    actions = [_whole(line[0]) for line in lines[::2] if len(line) == 1]
    if len(actions) != len(lines) // 2:
        raise ValueError("an action's line holds more than a number")
    return _table(lines[1::2], states), np.array(actions, dtype=np.int64)


def _read_policy(folder: Path, states: int) -> tuple[FloatArray, IntArray]:
    """The vectors of found.policy: the elements Vector and SparseVector of POMDPX's policy files."""
    try:
        root = fromstring(_text(folder / "found.policy"))
    except (ParseError, DefusedXmlException) as error:
        raise ValueError(str(error)) from error
    rows: list[list[str]] = []
    actions: list[int] = []
    for vector in root.iter():
        if vector.tag == "Vector":
            rows.append((vector.text or "").split())
        elif vector.tag == "SparseVector":
            row = ["0"] * states
            for entry in vector.iter("Entry"):
                words = (entry.text or "").split()
                if len(words) != 2 or not 0 <= _whole(words[0]) < states:
                    raise ValueError(f"an entry that is no place and number: {' '.join(words)[:60]!r}")
                row[_whole(words[0])] = words[1]
            rows.append(row)
        else:
            continue
        actions.append(_whole(vector.get("action", "")))
    if not rows:
        raise ValueError("no vectors")
    return _table(rows, states), np.array(actions, dtype=np.int64)


def _whole(text: str) -> int:
    if re.fullmatch(r"[0-9]{1,9}", text) is None:
        raise ValueError(f"{text[:60]!r} is no whole number")
    return int(text)


def _table(rows: Sequence[Sequence[str]], states: int) -> FloatArray:
    wrong = next((len(row) for row in rows if len(row) != states), None)
    if wrong is not None:
        raise ValueError(f"a vector of {wrong} numbers for {states} states")
    table = np.array([[float(word) for word in row] for row in rows], dtype=np.float64)
    if not np.isfinite(table).all():
        raise ValueError("a number that is not finite")
    return table
