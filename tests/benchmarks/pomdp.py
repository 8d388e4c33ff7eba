"""Time the POMDP solvers, beside other programs where they are there: `python tests/benchmarks/pomdp.py`.

    python tests/benchmarks/pomdp.py [--problems NAME,...] [--solvers NAME,...] [--seconds 20] [--gap 1e-6]
                                     [--no-peers] [--no-compile]

Every solver runs on every problem in a process of its own: its kernels are loaded ("kernels s", not part
of anything else; a run in which some more were compiled is done again), then it works on the problem
until upper - lower <= gap or until `--seconds` have gone.  Runs shorter than half
a second are repeated and the median is given.  All seconds are the processor's, of one thread, since
the machine may be shared.  "model s" is reading, compiling to diagrams and listing the arrays.

The bounds after some seconds are those that had been reached then.  A "!" marks bounds that do not
contain the reference value.  Last come the seconds that compiling each solver's kernels takes.

The files of other people lie in the folder FACTORED_POLCA_DATA; RockSample is the domain `rocksample`.
Other programs are started from the PATH on a file that is written from the arrays:

- pomdpsol, SARSOP (Kurniawati, Hsu & Lee 2008; APPL): its own clock for the bounds over time; on
  Hallway.pomdpx and RockSample_7_8.pomdpx instead (mixed observability) where the folder has them;
- zmdp, HSVI2 (Smith & Simmons 2005): the same, its clock scaled from the wall's to the processor's;
- pomdp-solve, exact value iteration (Cassandra): stops where the Bellman residual shows the gap; only
  for problems of at most a hundred states.

Their seconds to the gap are those of the whole process, reading the file included.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any, Final

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

SOLVERS: Final = ("auto", "exact", "pbvi", "perseus", "hsvi", "sarsop")
MARKS: Final = (1.0, 5.0, 20.0)
"""Seconds after which bounds are shown, and the limit."""


@dataclass(frozen=True)
class Source:
    """Where a problem comes from, and what V*(b0) is known to be."""

    file: str = ""  # in the data folder
    size: int = 0  # of RockSample
    rocks: int = 0
    least: float = float("-inf")  # V* lies in [least, most]
    most: float = float("inf")


# Two or more programs agree on these values.
PROBLEMS: Final[Mapping[str, Source]] = {
    "tiger.95": Source("tiger.95.POMDP", least=19.371367, most=19.371369),
    "tiger.aaai": Source("tiger.aaai.POMDP", least=1.933438, most=1.933440),
    "cheese.95": Source("cheese.95.POMDP", least=3.486206, most=3.486208),
    "shuttle.95": Source("shuttle.95.POMDP", least=32.889724, most=32.889726),
    "4x3.95": Source("4x3.95.POMDP", least=1.88987, most=1.889905),
    "Hallway": Source("Hallway.pomdpx", least=0.9905, most=1.2053),
    "RockSample[4,4]": Source(size=4, rocks=4),
    "RockSample[7,8]": Source(size=7, rocks=8, least=21.1, most=24.6),
}

Record = tuple[float, float, float]
"""Processor seconds, lower and upper bound."""


@dataclass(frozen=True)
class Row:
    """What one program did on one problem."""

    problem: str
    solver: str
    status: str
    records: list[Record]
    reached: float | None = None  # processor seconds to the gap
    kernels: float | None = None
    building: float | None = None
    vectors: str = ""
    mebibytes: int | None = None

    def at(self, seconds: float) -> Record | None:
        """The last record of the first `seconds`."""
        done = [record for record in self.records if record[0] <= seconds * 1.02]
        return done[-1] if done else None


# -- ours ----------------------------------------------------------------------------------------------


def available(name: str) -> bool:
    """Whether the problem's file, if it needs one, is in the data folder."""
    return not PROBLEMS[name].file or data_file(PROBLEMS[name].file) is not None


def data_file(name: str) -> Path | None:
    """A file of the data folder, if it is there."""
    folder = os.environ.get("FACTORED_POLCA_DATA")
    path = Path(folder) / name if folder else None
    return path if path is not None and path.exists() else None


def arrays_of(name: str) -> Any:
    """The problem as an `ArrayPOMDP`."""
    from factored_polca import library
    from factored_polca.formats import read
    from factored_polca.minimisation.unreduced import unreduced_pomdp
    from factored_polca.symbolic import compile_model

    source = PROBLEMS[name]
    path = data_file(source.file) if source.file else None
    if path is not None:
        model = read(path).model
    else:
        model = library.load("rocksample", {"size": source.size, "rocks": source.rocks}).model
    return unreduced_pomdp(compile_model(model), reachable=True)


class Watch:
    """Notes the bounds as they come, and asks to end after `limit` processor seconds, again each second."""

    def __init__(self, limit: float) -> None:
        self.limit, self.records = limit, list[Record]()
        self.began = time.process_time()

    @property
    def seconds(self) -> float:
        """Processor seconds since this was made."""
        return time.process_time() - self.began

    def __call__(self, lower: float, upper: float) -> None:
        """To be called with the bounds at b0."""
        self.records.append((self.seconds, lower, upper))
        if self.seconds > self.limit:
            self.limit = self.seconds + 1.0
            raise KeyboardInterrupt


def solve(pomdp: Any, solver: str, gap: float, seconds: float) -> tuple[Any, Watch]:
    """The solution, or None where the run was broken off before there was one."""
    from factored_polca.solvers.pomdp_choose import solve_pomdp
    from factored_polca.solvers.pomdp_result import Demand

    watch = Watch(seconds)
    late = time.monotonic() + 5 * seconds + 10  # if the processor is not ours, or nothing is reported
    try:
        found = solve_pomdp(pomdp, solver, demand=Demand(gap=gap, deadline=late, progress=watch))
    except KeyboardInterrupt:
        return None, watch
    watch.records.append((watch.seconds, found.lower, found.upper))
    return found, watch


def load_kernels(solver: str) -> float:
    """Processor seconds until the solver's kernels are compiled or loaded."""
    from factored_polca.solvers.warm_pomdp import warm_up

    began = time.process_time()
    warm_up(solver)
    return time.process_time() - began


def load_model_kernels() -> None:
    """Have the kernels that compile a model loaded."""
    from factored_polca import library
    from factored_polca.minimisation.unreduced import unreduced_pomdp
    from factored_polca.symbolic import compile_model

    model = library.load("rocksample", {"size": 2, "rocks": 1}).model
    unreduced_pomdp(compile_model(model), reachable=True)


def run_case(problem: str, solver: str, gap: float, seconds: float) -> dict[str, Any]:
    """One case, in this process."""
    from factored_polca.solvers.compiled import watch_compiling

    kernels = load_kernels(solver)
    load_model_kernels()
    began = time.process_time()
    pomdp = arrays_of(problem)
    building = time.process_time() - began
    with watch_compiling() as compiling:
        found, watch = solve(pomdp, solver, gap, seconds)
    if compiling.seconds:  # something that warming up had left
        found, watch = solve(pomdp, solver, gap, seconds)
    times = [watch.records[-1][0] if found is not None else watch.seconds]
    while found is not None and found.converged and len(times) < 7 and sum(times) < 0.5:
        times.append(solve(pomdp, solver, gap, seconds)[1].records[-1][0])
    return {
        "records": watch.records,
        "status": "time limit" if found is None or found.status == "interrupted" else found.status,
        "reached": median(times) if found is not None and found.gap <= gap else None,
        "vectors": "" if found is None else f"{found.vectors} ({found.method})",
        "kernels": kernels, "building": building,
        "mebibytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }  # fmt: skip


def in_process(arguments: Iterable[object], **environment: str) -> Any:
    """What this script prints, as JSON, for the arguments, in a fresh process."""
    command = [sys.executable, __file__, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **environment})
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


# -- other programs ------------------------------------------------------------------------------------


def write_problem(pomdp: Any, path: Path) -> str:
    """Write the arrays in Cassandra's format; why that can't be done, or ""."""
    from factored_polca.formats.cassandra import write_factored
    from factored_polca.formats.cassandra_factoring import factored
    from factored_polca.models import ModelError

    try:
        path.write_text(write_factored(factored(pomdp, as_mdp=False)), encoding="ascii")
    except ModelError as error:
        return error.faults[0].message
    return ""


def start(
    command: list[str], folder: Path, limit: float, processor: float | None = None
) -> tuple[str, float, float]:
    """What the program prints, and its seconds of processor and wall; killed after `processor` seconds
    of the first, by default 2 limits and a minute, and after 4 limits and a minute of the second."""
    most = int(2 * limit + 60 if processor is None else processor + 1)

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (most, most))

    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    with (folder / "printed").open("w+", encoding="utf-8", errors="replace") as printed:
        process = subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=printed, stderr=subprocess.STDOUT,
            preexec_fn=limited,
        )  # fmt: skip
        try:
            process.wait(4 * limit + 60)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    text = (folder / "printed").read_text(encoding="utf-8", errors="replace")
    return text, used, time.perf_counter() - began


NUMBER: Final = r"(-?[0-9.]+(?:e[-+]?[0-9]+)?)"


def run_pomdpsol(program: str, file: Path, pomdp: Any, gap: float, seconds: float, name: str) -> Row:
    """SARSOP."""
    command = [
        program,
        "--precision",
        str(gap),
        "--timeout",
        f"{seconds:.0f}",
        "--output",
        "policy",
        str(file),
    ]
    text, used, _ = start(command, file.parent, seconds)
    line = rf"^ *{NUMBER} +\d+ +\d+ +{NUMBER} +{NUMBER} +{NUMBER} +(\d+) +\d+ *$"
    found = re.findall(line, text, re.MULTILINE)
    records = [(float(row[0]), float(row[1]), float(row[2])) for row in found]
    reached = used if "target precision reached" in text else None
    vectors = found[-1][4] if found else ""
    return Row(name, "pomdpsol", status_of(records, reached), records, reached, vectors=vectors)


def run_zmdp(program: str, file: Path, pomdp: Any, gap: float, seconds: float, name: str) -> Row:
    """HSVI2.  Its limit counts the wall's seconds, so it is ended from outside; it notes bounds at once."""
    command = [
        program, "benchmark", "-s", "hsvi", "-p", str(gap), "-t", f"{40 * seconds:.0f}",
        "--useTimeWithoutHeuristic", "0", "--evaluationFirstEpochWallclockSeconds", "1e9",
        "--evaluationTrialsPerEpoch", "1", str(file),
    ]  # fmt: skip
    _, used, wall = start(command, file.parent, 10 * seconds, processor=seconds)
    plot = file.parent / "bounds.plot"
    lines = plot.read_text(encoding="utf-8").splitlines() if plot.exists() else []
    rows = [line.split() for line in lines if line and not line.startswith("#")]
    share = min(1.0, used / wall)
    records = [(float(row[0]) * share, float(row[1]), float(row[2])) for row in rows if len(row) > 3]
    reached = used if records and used < seconds and records[-1][2] - records[-1][1] < 10 * gap else None
    return Row(name, "zmdp", status_of(records, reached), records, reached)


def run_pomdp_solve(program: str, file: Path, pomdp: Any, gap: float, seconds: float, name: str) -> Row:
    """Exact value iteration; a Bellman residual r bounds the error by discount r / (1 - discount)."""
    from factored_polca.formats.alpha_file import read_alpha

    ratio = pomdp.discount / (1 - pomdp.discount)
    command = [
        program, "-pomdp", str(file), "-o", "found", "-stop_criteria", "bellman",
        "-stop_delta", f"{gap / (2 * ratio):.3g}", "-time_limit", f"{seconds:.0f}",
    ]  # fmt: skip
    text, used, _ = start(command, file.parent, seconds)
    residuals = re.findall(r"(\d+) vectors in .*\(err=(.*)\)", text)
    alphas = file.parent / "found.alpha"
    if "Solution found" not in text or not alphas.exists() or not residuals:
        epochs = re.findall(r"Epoch: *(\d+)", text)
        return Row(name, "pomdp-solve", f"time limit in epoch {epochs[-1] if epochs else 0}", [])
    value = read_alpha(alphas.read_text(encoding="ascii"), pomdp).value(pomdp.initial)
    error = float(residuals[-1][1]) * ratio
    record = (used, value - error, value + error)
    reached = used if 2 * error <= gap * 1.01 else None
    return Row(
        name, "pomdp-solve", status_of([record], reached), [record], reached, vectors=residuals[-1][0]
    )


def status_of(records: list[Record], reached: float | None) -> str:
    """In the words of ours."""
    return "converged" if reached is not None else "time limit" if records else "nothing found"


PEERS: Final = {"pomdpsol": run_pomdpsol, "zmdp": run_zmdp, "pomdp-solve": run_pomdp_solve}


def run_peers(name: str, gap: float, seconds: float, leave_out: list[str]) -> Iterator[Row]:
    """What the programs on the PATH do on a problem."""
    programs = {peer: path for peer in PEERS if (path := shutil.which(peer))}
    if not programs:
        return
    pomdp = arrays_of(name)
    for peer, program in programs.items():
        if peer == "pomdp-solve" and pomdp.states > 100:
            leave_out.append(f"pomdp-solve on {name}: {pomdp.states} states")
            continue
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "problem.pomdp"
            own = data_file(re.sub(r"\W+", "_", name).strip("_") + ".pomdpx")
            if peer == "pomdpsol" and own is not None:
                file = Path(shutil.copy(own, folder))
            elif reason := write_problem(pomdp, file):
                leave_out.append(f"{peer} on {name}: {reason}")
                continue
            yield PEERS[peer](program, file, pomdp, gap, seconds, name)


# -- the table -----------------------------------------------------------------------------------------


def cells(row: Row, marks: list[float]) -> str:
    """One line of the table."""
    source = PROBLEMS[row.problem]

    def shown(record: Record | None) -> str:
        if record is None:
            return "-"
        doubt = 1e-5 * max(1.0, abs(record[1]))  # programs print six digits
        wrong = record[1] > source.most + doubt or record[2] < source.least - doubt
        return f"{record[1]:.6g} .. {record[2]:.6g}{' !' if wrong else ''}"

    def number(value: float | None, form: str) -> str:
        return "-" if value is None else format(value, form)

    bounds = [shown(row.at(mark)) for mark in marks]
    last = [shown(row.records[-1] if row.records else None)]
    reached = [number(row.reached, ".4f"), *(last * len(marks) if row.reached is not None else bounds)]
    ends = [row.status, row.vectors or "-", number(row.mebibytes, "d")]
    starts = [row.problem, row.solver, number(row.kernels, ".2f"), number(row.building, ".2f")]
    return " | ".join([*starts, *reached, *ends])


def ratios(rows: list[Row]) -> Iterator[str]:
    """Their seconds to the gap beside ours, where both reached it."""
    reached = {(row.problem, row.solver): row.reached for row in rows if row.reached is not None}
    for problem in dict.fromkeys(row.problem for row in rows):
        ours = {solver: s for solver in SOLVERS if (s := reached.get((problem, solver))) is not None}
        theirs = {peer: s for peer in PEERS if (s := reached.get((problem, peer))) is not None}
        if not ours or not theirs:
            continue
        best = min(ours, key=ours.__getitem__)
        for solver in dict.fromkeys(["auto" if "auto" in ours else best, best]):
            compared = (f"{peer} {s:.3f} s ({ours[solver] / s:.3g})" for peer, s in theirs.items())
            yield f"{problem}: {solver} {ours[solver]:.4f} s; {', '.join(compared)}"


def machine() -> str:
    """When and where this runs."""
    import numba
    import numpy as np

    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = re.findall(r"^model name\s*: (.*)$", info.read_text(encoding="utf-8"), re.MULTILINE)
        name = models[0] if models else name
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return (
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {name}, {os.cpu_count()} cpus{load}, "
        f"Python {platform.python_version()}, numpy {np.__version__}, numba {numba.__version__}"
    )


def compile_seconds(solvers: list[str]) -> Iterator[str]:
    """Seconds of each solver's kernels with an empty cache, and from the cache."""
    for solver in solvers:
        with tempfile.TemporaryDirectory() as empty:
            taken = [in_process(["--warm", solver], NUMBA_CACHE_DIR=empty) for _ in range(2)]
        yield f"{solver}: {taken[0]:.1f} compiled, {taken[1]:.2f} loaded"


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", default=",".join(PROBLEMS), help="some of them; put [n,k] in quotes")
    parser.add_argument("--solvers", default=",".join(SOLVERS))
    parser.add_argument("--seconds", type=float, default=20.0, help="limit of each run")
    parser.add_argument("--gap", type=float, default=1e-6)
    parser.add_argument("--no-peers", action="store_true", help="only our solvers")
    parser.add_argument("--no-compile", action="store_true", help="do not time the compiler")
    parser.add_argument("--case", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--warm", help=argparse.SUPPRESS)
    return parser.parse_args()


def main() -> None:
    """Print the table."""
    given = arguments()
    if given.case:
        print(json.dumps(run_case(*given.case, given.gap, given.seconds)))
        return
    if given.warm:
        print(json.dumps(load_kernels(given.warm)))
        return
    wanted = [name for name in PROBLEMS if name in given.problems]
    solvers = [name for name in given.solvers.split(",") if name]
    leave_out = [f"{name}: {PROBLEMS[name].file} is not there" for name in wanted if not available(name)]
    leave_out += [] if given.no_peers else [f"{p}: not on the PATH" for p in PEERS if not shutil.which(p)]
    marks = sorted({mark for mark in MARKS if mark < given.seconds} | {given.seconds})
    print(machine())
    print(f"processor seconds, one thread; gap {given.gap:g}; limit {given.seconds:g} s a run")
    heads = [f"bounds at {mark:g} s" for mark in marks]
    print(" | ".join([
        "problem", "solver", "kernels s", "model s", "gap reached s", *heads, "status", "vectors", "peak MiB",  # noqa: E501
    ]))  # fmt: skip
    rows = []
    for name in filter(available, wanted):
        for solver in solvers:
            case = ["--case", name, solver, "--gap", given.gap, "--seconds", given.seconds]
            fields = in_process(case)
            fields["records"] = [tuple(record) for record in fields["records"]]
            rows.append(Row(name, solver, **fields))
            print(cells(rows[-1], marks), flush=True)
        for row in () if given.no_peers else run_peers(name, given.gap, given.seconds, leave_out):
            rows.append(row)
            print(cells(row, marks), flush=True)
    for line in leave_out:
        print(f"left out: {line}")
    print("seconds to the gap, ours beside theirs (ours / theirs):")
    print("\n".join(ratios(rows)) or "no problem was brought to the gap by both")
    if not given.no_compile:
        print("seconds of kernels, empty cache first: " + "; ".join(compile_seconds(solvers)))


if __name__ == "__main__":
    main()
