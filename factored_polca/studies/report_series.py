"""What a report compares: contenders on instances, and how results grow with a parameter.

    instance     what is solved: model, parameters, seed
    contender    how: the work, the solver, and the options in which runs of the study differ

Two contenders are compared on the instances that both have.  A series is what one contender did on one
model as one numeric parameter (its size) grows while all others stay; several seeds give several results
for a size.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any, Final

from factored_polca.studies.fits import FEWEST, Growth, growth
from factored_polca.studies.store import STATUSES, Store

LONGEST_NAME: Final = 44
LEFT: Final = "left"
"""The status of a run without a result."""

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Pair:
    """Two contenders on the instances that both have a result for."""

    first: str
    second: str
    rows: tuple[tuple[Row, Row], ...]


@dataclass(frozen=True)
class Series:
    """One contender on one model as a parameter grows; `rows` are those that ended well."""

    contender: str
    model: str
    others: str  # parameters that stay, in words
    parameter: str
    rows: tuple[Row, ...]

    def points(self, quantity: str) -> list[tuple[float, float]]:
        """(size, quantity) of each result that has the quantity."""
        return [
            (float(row[f"set.{self.parameter}"]), float(row[quantity]))
            for row in self.rows
            if is_number(row.get(quantity))
        ]

    def growth(self, quantity: str) -> Growth | None:
        """The curves through them."""
        return growth(self.points(quantity))


@dataclass(frozen=True)
class Comparison:
    """The results of a study, sorted for its report."""

    name: str
    rows: tuple[Row, ...]  # with the columns `contender`, `instance`
    planned: tuple[tuple[str, str, str], ...]  # (contender, model, status) of each run of the grid

    @cached_property
    def contenders(self) -> tuple[str, ...]:
        """Their names, in the grid's order."""
        return tuple(dict.fromkeys(contender for contender, _, _ in self.planned))

    def coverage(self) -> dict[tuple[str, str], dict[str, int]]:
        """How many runs of each contender and model have which status."""
        found: dict[tuple[str, str], dict[str, int]] = {}
        for contender, model, status in self.planned:
            counts = found.setdefault((contender, model), dict.fromkeys((*STATUSES, LEFT), 0))
            counts[status] += 1
        return found

    def pairs(self) -> tuple[Pair, ...]:
        """Contenders two by two, those with most instances in common first."""
        by_contender: dict[str, dict[str, Row]] = {}
        for row in self.rows:
            by_contender.setdefault(row["contender"], {})[row["instance"]] = row
        found = []
        for first, second in combinations(by_contender, 2):
            mine, other = by_contender[first], by_contender[second]
            rows = tuple((mine[i], other[i]) for i in mine if i in other)
            if rows:
                found.append(Pair(first, second, rows))
        return tuple(sorted(found, key=lambda pair: -len(pair.rows)))

    def series(self) -> tuple[Series, ...]:
        """All series with enough sizes for a curve."""
        found: dict[tuple[str, str, str, str], list[Row]] = {}
        for row in self.rows:
            settings = {name[4:]: row[name] for name in row if name.startswith("set.")}
            given = {name: value for name, value in settings.items() if value is not None}
            for name, value in given.items():
                if row["status"] == "ok" and is_number(value):
                    others = {key: item for key, item in given.items() if key != name}
                    found.setdefault((row["contender"], row["model"], in_words(others), name), []).append(
                        row
                    )
        return tuple(
            Series(*key, tuple(rows))
            for key, rows in found.items()
            if len({row[f"set.{key[3]}"] for row in rows}) >= FEWEST
        )


def compare(store: Store) -> Comparison:
    """The results of a store, sorted."""
    planned = store.statuses()
    options: dict[str, list[dict[str, Any]]] = {}
    for parameters, _ in planned:
        options.setdefault(parameters["work"], []).append(parameters["options"])
    varied = {work: differing(given) for work, given in options.items()}
    rows = tuple(
        {
            **row,
            "contender": contender_of(row["work"], options_of(row), varied.get(row["work"], ())),
            "instance": instance_of(row),
        }
        for row in store.rows()
    )
    return Comparison(
        store.name,
        rows,
        tuple(
            (contender_of(p["work"], p["options"], varied[p["work"]]), p["model"], status or LEFT)
            for p, status in planned
        ),
    )


def differing(options: Sequence[Mapping[str, Any]]) -> list[str]:
    """The options whose values differ from run to run, missing ones included."""
    names = dict.fromkeys(name for given in options for name in given)
    return [name for name in names if len({repr(given.get(name)) for given in options}) > 1]


def options_of(row: Row) -> dict[str, Any]:
    """The options of a result's row."""
    return {n[7:]: value for n, value in row.items() if n.startswith("option.") and value is not None}


def contender_of(work: str, options: Mapping[str, Any], varied: Sequence[str]) -> str:
    """The name of a contender."""
    given = {name: options[name] for name in varied if name in options and name != "solver"}
    return " ".join(part for part in (work, str(options.get("solver", "")), in_words(given)) if part)


def instance_of(row: Row) -> str:
    """What a run works on, in words."""
    settings = {n[4:]: v for n, v in row.items() if n.startswith("set.") and v is not None}
    return f"{row['model']} {row['fingerprint']} {in_words(settings)} seed {row['seed']}"


def in_words(settings: Mapping[str, Any]) -> str:
    """`size=4, slip=0.1`."""
    shown = {n: str(v).lower() if isinstance(v, bool) else v for n, v in settings.items()}
    return ", ".join(f"{name}={value}" for name, value in sorted(shown.items()))


def is_number(value: Any) -> bool:
    """Whether a value can be drawn on an axis."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def brief(name: str, longest: int = LONGEST_NAME) -> str:
    """A name that fits into a legend: the middle of a long one is left out."""
    name = "".join(c if c.isprintable() else "?" for c in name)
    if len(name) <= longest:
        return name
    return f"{name[: longest - longest // 3 - 1]}…{name[-(longest // 3) :]}"


def seconds_of(row: Row) -> float:
    """Seconds of the work itself; where it doesn't tell, those of the whole process."""
    return float(row["seconds"] if is_number(row.get("seconds")) else row["wall_seconds"])


def best_of(rows: Iterable[Row]) -> list[float]:
    """The seconds of those that ended well, ascending."""
    return sorted(seconds_of(row) for row in rows if row["status"] == "ok")
