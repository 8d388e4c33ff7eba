"""Studies as TOML files.

    name = "growth"                 # heads the report; the file's name if not given
    seconds = 60                    # limits of each run
    memory = "2 GB"
    jobs = 2                        # runs at a time

    [[grid]]                        # one or more products of runs
    work = "minimise"               # minimise, plan, solve, or package.module:function
    model = ["linear", "expon"]     # shipped domains, or files beside this one; a list is an axis
    set.size = [4, 8, 12]           # parameters of the model, as --set gives them
    seed = "0..2"                   # a range, its end included

    [cluster]                       # where runs are done by Parsl (factored_polca.studies.cluster)

Other keys of a grid are options of its work (`factored_polca.studies.grid.OPTIONS`).  Reading is strict: an
unknown key or a value that is not right is a `ModelError` with file, line and column, all faults at once.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from factored_polca.formats.positions import Positions, scan
from factored_polca.formats.toml_text import Decimal, load, toml_string
from factored_polca.models import Fault, ModelError
from factored_polca.studies.cluster import Cluster, read_cluster
from factored_polca.studies.study import LIMITS, Study

MAXIMUM_BYTES: Final = 1 << 20
KEYS: Final = ("name", "seconds", "memory", "jobs", "store", "grid", "cluster")
MOST_JOBS: Final = 1024
UNITS: Final = {
    "": 1, "k": 10**3, "m": 10**6, "g": 10**9, "t": 10**12, "ki": 2**10, "mi": 2**20, "gi": 2**30,
    "ti": 2**40,
}  # fmt: skip


def read_study(path: str | Path, *, store: str | Path | None = None) -> Study:
    """The study that the file `path` describes; its store lies beside it unless `store` is given.

    Raises:
        ModelError: no such file, or something in it is not right.
    """
    path = Path(path)
    text = _text(path)
    try:
        return make_study(text, path, store)
    except ModelError as error:
        positions = scan(text)
        raise ModelError(_located(fault, positions) for fault in error.faults).in_file(str(path)) from None


def _text(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            data = stream.read(MAXIMUM_BYTES + 1)
    except FileNotFoundError:
        hint = "factored-polca study new FILE.toml writes one to start from"
        raise ModelError([Fault("there is no such file", hint=hint, file=str(path))]) from None
    except (OSError, ValueError) as error:
        raise ModelError([Fault(f"the file can't be read: {error}", file=str(path))]) from None
    if len(data) > MAXIMUM_BYTES:
        message = f"the file has more than {MAXIMUM_BYTES:,} bytes, the most that is read"
        raise ModelError([Fault(message, file=str(path))])
    try:
        return data.decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise ModelError([Fault(f"no UTF-8 at byte {error.start}", file=str(path))]) from None


def _located(fault: Fault, positions: Positions) -> Fault:
    """A fault with the line and column of what its path names, of the key where it is unknown."""
    if fault.line or not fault.path:
        return fault
    unknown = fault.message.startswith(("unknown key", "there is no", "set is"))
    line, column = (positions.of_key if unknown else positions.of_value)(fault.path)
    return replace(fault, line=line, column=column)


def make_study(text: str, path: Path, store: str | Path | None) -> Study:
    """The study of a text that stands in the file `path`; faults name their places by paths.

    Raises:
        ModelError: something is not right.
    """
    table = load(text)
    faults: list[Fault] = []

    def refuse(key: str, rule: str) -> None:
        faults.append(Fault(f"{key} is {shown(table[key])}", (key,), f"it must be {rule}"))

    for key in table:
        if key not in KEYS:
            faults.append(Fault(f"unknown key {key!r}", (key,), f"the keys are {', '.join(KEYS)}"))
    name = table.get("name", path.stem)
    if not isinstance(name, str) or not name or len(name) > 200 or not name.isprintable():
        refuse("name", "a text of at most 200 characters")
    seconds = limit_seconds(table.get("seconds", LIMITS.seconds))
    if seconds is None:
        refuse("seconds", "a positive number of seconds")
    memory = limit_bytes(table.get("memory", LIMITS.memory_bytes))
    if memory is None:
        refuse("memory", 'a size such as "2 GB" or "500 MiB"')
    jobs = table.get("jobs", 1)
    if isinstance(jobs, bool) or not isinstance(jobs, int) or not 1 <= jobs <= MOST_JOBS:
        refuse("jobs", f"a whole number from 1 to {MOST_JOBS}")
    place = table.get("store", path.with_suffix(".sqlite").name)
    if not isinstance(place, str) or not place or not place.isprintable():
        refuse("store", "the name of a file")
    grids = table.get("grid", [])
    if not isinstance(grids, list) or not all(isinstance(grid, dict) for grid in grids) or not grids:
        message = "there is no grid" if "grid" not in table else "grid is no table"
        faults.append(Fault(message, ("grid",), "write [[grid]], and below it work = ... and model = ..."))
    cluster: Cluster | None = None
    if "cluster" in table:
        try:
            cluster = read_cluster(numbers(table["cluster"]))
        except ModelError as error:
            faults += error.faults
    if faults:
        raise ModelError(faults)
    return Study(
        name,
        [numbers(grid) for grid in grids],
        seconds=seconds,
        memory_bytes=memory,
        store=path.parent / place if store is None else store,
        folder=path.parent,
        jobs=jobs,
        cluster=cluster,
    )


def numbers(value: Any) -> Any:
    """TOML data with numbers that have a point as floats; parameters of models keep their digits."""
    if isinstance(value, Decimal):
        return float(value.text)
    if isinstance(value, list):
        return [numbers(item) for item in value]
    if isinstance(value, Mapping):
        return {key: digits(item) if key == "set" else numbers(item) for key, item in value.items()}
    return value


def digits(value: Any) -> Any:
    """TOML data with numbers that have a point as they were written."""
    if isinstance(value, Decimal):
        return value.text
    if isinstance(value, list):
        return [digits(item) for item in value]
    return {key: digits(item) for key, item in value.items()} if isinstance(value, Mapping) else value


def shown(value: Any) -> str:
    """A value of a TOML file in a message."""
    return value.text if isinstance(value, Decimal) else repr(value)[:60]


def limit_seconds(value: Any) -> float | None:
    """A limit of time; None where it is none."""
    if isinstance(value, Decimal):
        value = float(value.text)
    if isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < 1e9:
        return float(value)
    return None


def limit_bytes(value: Any) -> int | None:
    """A limit of memory, a number of bytes or a text with a unit; None where it is none."""
    if isinstance(value, int) and not isinstance(value, bool) and 0 < value < 1 << 60:
        return value
    match = re.fullmatch(r"\s*([0-9]{1,15}(?:\.[0-9]{1,9})?)\s*([kmgt]i?)?b?\s*", str(value).lower())
    if not isinstance(value, str) or match is None or float(match[1]) <= 0:
        return None
    return int(float(match[1]) * UNITS[match[2] or ""])


TEMPLATE: Final = """# A study: what is to be run, each run in a process of its own.
#   factored-polca study run {file}       runs what has no result yet; it may be stopped at any moment
#   factored-polca study status {file}    how far it is
#   factored-polca study report {file}    a page with tables and plots

name = {name}
seconds = 60                      # a run that takes longer is recorded as "timeout"
memory = "2 GB"                   # more memory, all its processes together: "memout"
jobs = 1                          # runs at a time; more of them slow one another down
# store = "results.sqlite"        # where results are kept; beside this file if not given

# A grid is a product: each list is an axis, and each combination one run.
[[grid]]
work = "minimise"                 # minimise, plan, solve, or package.module:function
model = ["linear", "expon"]       # shipped domains (factored-polca domains), or files beside this one
set.size = [4, 5, 6, 7, 8]        # a parameter of the models, as --set gives it
seed = "0..2"                     # a list, or a range with its end

[[grid]]
work = "solve"
model = ["tiger", "meds"]
solver = ["sarsop", "hsvi"]       # options as on the command line: gap, iterations, horizon, ...
gap = 0.01

# Without this table all runs are done on this machine.
# [cluster]                       # Parsl; pip install 'factored-polca[cluster]'
# provider = "local"              # local, slurm or kubernetes
# workers = 2                     # on each node
"""


def template(name: str, file: str) -> str:
    """A commented study to start from."""
    return TEMPLATE.format(name=toml_string(name), file=file)
