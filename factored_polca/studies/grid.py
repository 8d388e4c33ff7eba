"""What a study runs: works x models x parameters x options x seeds, each combination one run.

A `Grid` is one product.  Whatever of it is a list is an axis; a single value is a list of one.  A study may
have several grids; a combination that occurs in two of them is one run.

The key of a run is the hash (SHA-256) of everything that decides what it computes: the work, the model's
name and the hash of its file, the parameters, the options, the seed.  Limits are no part of it: a run that
has ended within them has the same result under others.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from typing import Any, Final, TypeAlias

from factored_polca import library
from factored_polca.formats import FORMATS
from factored_polca.models import Fault, ModelError
from factored_polca.studies.model_text import ModelText

Scalar: TypeAlias = str | int | float | bool
Settings: TypeAlias = tuple[tuple[str, Scalar], ...]

MAXIMUM_RUNS: Final = 100_000
"""Runs of one study."""
MAXIMUM_AXIS: Final = 10_000
"""Values of one axis."""
LONGEST_VALUE: Final = 1000

WORKS: Final = ("minimise", "plan", "solve")
REFERENCE: Final = re.compile(r"[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*:[A-Za-z_]\w*", re.ASCII)
MDP_SOLVERS: Final = ("auto", "vi", "pi", "mpi")
SOLVERS: Final = (
    "auto", "exact", "witness", "pbvi", "perseus", "hsvi", "sarsop", "qmdp", "fib", "blind", "amdp", "vi",
    "pi", "mpi",
)  # fmt: skip
ORDERS: Final = ("auto", "file", "force", "spectral")


class Refused(Exception):
    """A value is not right; the message is the rule."""


# -- options -----------------------------------------------------------------------------------------


def _counting(value: Scalar) -> int:
    if isinstance(value, int) and not isinstance(value, bool) and 1 <= value < 10**15:
        return value
    raise Refused("it must be a whole number from 1 on")


def _positive(value: Scalar) -> float:
    if isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value < math.inf:
        return float(value)
    raise Refused("it must be a positive number such as 0.001")


def _truth(value: Scalar) -> bool:
    if isinstance(value, bool):
        return value
    raise Refused("it must be true or false")


def _solver(value: Scalar) -> str:
    if isinstance(value, str) and (value in SOLVERS or REFERENCE.fullmatch(value)):
        return value
    raise Refused(f"it must be one of {', '.join(SOLVERS)}, or package.module:Name")


def _order(value: Scalar) -> str:
    if isinstance(value, str) and value in ORDERS:
        return value
    raise Refused(f"it must be one of {', '.join(ORDERS)}")


def _horizon(value: Scalar) -> Scalar:
    return value if value == "infinite" else _counting(value)


def _discount(value: Scalar) -> str:
    text = repr(value) if isinstance(value, float) else str(value)
    if re.fullmatch(r"[0-9]{0,30}\.?[0-9]{1,30}|[0-9]{1,30}/[0-9]{0,29}[1-9][0-9]{0,29}", text):
        exact = Fraction(text)
        if 0 <= exact <= 1:
            return str(exact)
    raise Refused('it must be a number from 0 to 1, such as 0.95 or "19/20"')


def seed(value: Scalar) -> int:
    """A seed.

    Raises:
        Refused: no whole number from 0 on.
    """
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 10**15:
        return value
    raise Refused('it must be a whole number from 0 on, a list of them, or a range such as "0..9"')


OPTIONS: Final[Mapping[str, Mapping[str, Callable[[Scalar], Scalar]]]] = {
    "minimise": {"order": _order, "reachable": _truth, "interchangeable": _truth},
    "plan": {
        "solver": _solver, "gap": _positive, "trials": _counting, "polca": _truth, "episodes": _counting,
        "flat": _truth, "order": _order, "reachable": _truth,
    },
    "solve": {
        "solver": _solver, "gap": _positive, "iterations": _counting, "horizon": _horizon,
        "discount": _discount, "stop_seconds": _positive,
    },
}  # fmt: skip
"""Work -> its options, each with what reads a value."""


# -- one run -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """One combination: what is run."""

    work: str
    model: str  # a shipped domain, or a file as the study names it; "" where a function needs none
    fingerprint: str  # of the file's text; "" for a domain
    settings: Settings
    options: Settings
    seed: int

    def parameters(self) -> dict[str, Any]:
        """What decides the result, as plain data."""
        return {
            "work": self.work,
            "model": self.model,
            "fingerprint": self.fingerprint,
            "set": dict(self.settings),
            "options": dict(self.options),
            "seed": self.seed,
        }

    @property
    def key(self) -> str:
        """The hash of the parameters, 32 hexadecimal digits."""
        text = json.dumps(self.parameters(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:32]

    def request(self, text: str | None, limits: Mapping[str, Any]) -> dict[str, Any]:
        """What a worker is sent: the parameters, the text of the model's file, and the limits."""
        return {**self.parameters(), "text": text, "limits": dict(limits)}

    def title(self) -> str:
        """The run in one line."""
        told = [f"{name}={value}" for name, value in (*self.settings, *self.options)]
        return " ".join([self.work, *([self.model] if self.model else []), *told, f"seed {self.seed}"])


# -- products of runs --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Grid:
    """A product of runs, checked; `make_grid` makes one."""

    work: str
    models: tuple[str, ...]
    settings: tuple[tuple[str, tuple[Scalar, ...]], ...]
    options: tuple[tuple[str, tuple[Scalar, ...]], ...]
    seeds: tuple[int, ...]

    @property
    def size(self) -> int:
        """How many runs it has."""
        axes = (self.models, self.seeds, *(values for _, values in (*self.settings, *self.options)))
        return math.prod(map(len, axes))

    def runs(self, files: Mapping[str, ModelText]) -> Iterator[Run]:
        """All combinations, the last axis (seeds) running fastest."""
        names = [name for name, _ in (*self.settings, *self.options)]
        count = len(self.settings)
        for model in self.models:
            fingerprint = files[model].fingerprint if model in files else ""
            axes = (values for _, values in (*self.settings, *self.options))
            for chosen, number in product(product(*axes), self.seeds):
                pairs = tuple(zip(names, chosen, strict=True))
                yield Run(
                    self.work, model, fingerprint, tuple(sorted(pairs[:count])),
                    tuple(sorted(pairs[count:])), number,
                )  # fmt: skip


def make_grid(table: Mapping[str, Any], path: tuple[str, ...] = ()) -> Grid:
    """A grid from plain data: `work`, `model`, `set` {name: value or values}, `seed`, and options.

    `path` is where it stands, for messages.

    Raises:
        ModelError: an unknown key, a value that is not right, or too many; all faults at once.
    """
    reader = _Reader(path)
    work = reader.work(table.get("work"))
    if not work:
        raise ModelError(reader.faults)  # what else is right depends on it
    custom = ":" in work
    known = {"work", "model", "set", "seed", *(() if custom else OPTIONS[work])}
    for key in table:
        if key not in known:
            reader.unknown(key, known, f"of {work}" if not custom else "of a function's grid")
    models = reader.axis("model", table.get("model"), _model)
    if not custom and not models and "model" not in table:
        reader.fault("there is no model", (), 'write model = "taxi", or a file, or a list of both')
    settings = reader.settings(table.get("set", {}), custom)
    options = tuple(
        (name, reader.axis(name, table[name], read))
        for name, read in ({} if custom else OPTIONS[work]).items()
        if name in table
    )
    seeds = reader.axis("seed", table.get("seed", 0), seed, ranges=True)
    grid = Grid(work, tuple(map(str, models)) or ("",), settings, options, tuple(map(int, seeds)))
    if not reader.faults:
        reader.check_parameters(grid)
    if not reader.faults and grid.size > MAXIMUM_RUNS:
        reader.fault(f"{grid.size:,} runs", (), f"a study has at most {MAXIMUM_RUNS:,}")
    if reader.faults:
        raise ModelError(reader.faults)
    return grid


def _model(value: Scalar) -> str:
    if isinstance(value, str) and value and len(value) <= LONGEST_VALUE and value.isprintable():
        return value
    raise Refused("it must be the name of a shipped domain or of a model file")


def _setting(value: Scalar) -> str:
    """A parameter of a model as `--set` writes it."""
    text = str(value).lower() if isinstance(value, bool) else str(value)
    if len(text) <= LONGEST_VALUE:
        return text
    raise Refused(f"it has more than {LONGEST_VALUE} characters")


def _argument(value: Scalar) -> Scalar:
    """An argument of somebody's function: itself."""
    return value


_RANGE: Final = re.compile(r"\s*([0-9]{1,12})\s*\.\.\s*([0-9]{1,12})\s*")


class _Reader:
    """Reads the parts of one grid, and gathers faults."""

    def __init__(self, path: tuple[str, ...]) -> None:
        self.path = path
        self.faults: list[Fault] = []

    def fault(self, message: str, where: tuple[str, ...], hint: str = "") -> None:
        self.faults.append(Fault(message, (*self.path, *where), hint))

    def unknown(self, key: str, known: Iterable[str], of: str, where: tuple[str, ...] = ()) -> None:
        near = difflib.get_close_matches(key, list(known), n=1)
        guess = f"did you mean {near[0]}? " if near else ""
        listed = ", ".join(sorted(known)) or "none"
        self.fault(f"unknown key {key!r}", (*where, key), f"{guess}the keys {of} are {listed}")

    def work(self, value: Any) -> str:
        if isinstance(value, str) and (value in WORKS or REFERENCE.fullmatch(value)):
            return value
        rule = f"it must be one of {', '.join(WORKS)}, or package.module:function"
        if value is None:
            self.fault("there is no work", (), f"write work = ...; {rule}")
        else:
            self.fault(f"work is {value!r}", ("work",), rule)
        return ""

    def axis(
        self, name: str, value: Any, read: Callable[[Scalar], Scalar], where: tuple[str, ...] = (), *,
        ranges: bool = False,
    ) -> tuple[Scalar, ...]:  # fmt: skip
        """The values of an axis, without repetitions."""
        path = (*where, name)
        if value is None:
            return ()
        found = expanded(value) if ranges else None
        single = found is None and isinstance(value, (str, int, float, Fraction))
        values = found if found is not None else [value] if single else value
        if not isinstance(values, (Sequence, range)) or isinstance(values, (str, bytes)):
            self.fault(f"{name} is {type(value).__name__}", path, "it must be a value or a list of values")
            return ()
        if not 1 <= len(values) <= MAXIMUM_AXIS:
            self.fault(f"{name} has {len(values):,} values", path, f"it must have 1 to {MAXIMUM_AXIS:,}")
            return ()
        result: dict[tuple[type, Scalar], Scalar] = {}
        for number, one in enumerate(values):
            place = (*path, str(number)) if found is None and not single else path
            if isinstance(one, Fraction):
                one = str(one)
            if not isinstance(one, (str, int, float)) or one != one:
                self.fault(f"{one!r}", place, "a text, a number, true or false")
                continue
            try:
                item = read(one)
                result[type(item), item] = item
            except Refused as refused:
                self.fault(f"{name} is {one!r}", place, str(refused))
        return tuple(result.values())

    def settings(self, table: Any, custom: bool) -> tuple[tuple[str, tuple[Scalar, ...]], ...]:
        if not isinstance(table, Mapping):
            self.fault("set is no table", ("set",), "write set.size = [4, 8]")
            return ()
        read: Callable[[Scalar], Scalar] = _argument if custom else _setting
        return tuple(
            (str(name), self.axis(str(name), value, read, ("set",), ranges=True))
            for name, value in table.items()
        )

    def check_parameters(self, grid: Grid) -> None:
        """Check what can be known of parameters and solvers before anything is run."""
        for number, model in enumerate(grid.models):
            if not model or is_file(model):
                continue
            place = ("model", str(number)) if len(grid.models) > 1 else ("model",)
            names = library.domains()
            if model not in names:
                near = difflib.get_close_matches(model, names, n=1)
                guess = f"did you mean {near[0]}? " if near else ""
                hint = f"{guess}domains are {', '.join(names)}; files end in {', '.join(FORMATS)}"
                self.fault(f"no domain and no file {model!r}", place, hint)
                continue
            known = {parameter.name for parameter in library.describe(model).parameters}
            for name, _ in grid.settings:
                told = any(fault.path == (*self.path, "set", name) for fault in self.faults)
                if name not in known and grid.work in WORKS and not told:
                    self.unknown(name, known, f"of {model}", ("set",))


def expanded(value: Any) -> range | None:
    """`"0..9"` as a range, its end included; None for anything else."""
    match = _RANGE.fullmatch(value) if isinstance(value, str) else None
    return None if match is None else range(int(match[1]), int(match[2]) + 1)


def is_file(model: str) -> bool:
    """Whether a study means a file by `model`: it has the extension of a format."""
    return model.lower().endswith(tuple(FORMATS))
