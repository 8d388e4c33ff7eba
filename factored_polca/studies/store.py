"""The store of a study: one SQLite file that holds what is to be run and what came of it.

    runs          key, place in the grid (null: no longer in it), parameters
    results       key, status, message, stage, figures, times, memory, who ran it and when
    launches      each call that ran some of the study: versions, commit, machine, arguments, date
    supervisors   each process that supervised runs: versions, machine, seconds of loading kernels

One process writes (`store_lock`), others may read meanwhile (write-ahead log).  A result is written in one
transaction, on disk before the next run is looked at (synchronous=FULL): whatever is killed, and when, a
result is there whole or not at all, and a run whose result is there is not run again.

Parameters and figures are JSON; a row of `rows()` has them as columns.
"""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Literal

from factored_polca.models import ModelError
from factored_polca.studies.grid import Run
from factored_polca.studies.limits import Limits

Status = Literal["ok", "timeout", "memout", "error"]
STATUSES: Final[tuple[Status, ...]] = ("ok", "timeout", "memout", "error")

APPLICATION: Final = 0x46504F53
"""Marks the file as a study's store (SQLite's application_id)."""
VERSION: Final = 1

SCHEMA: Final = """
CREATE TABLE about (name TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE runs (key TEXT PRIMARY KEY, place INTEGER, parameters TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE launches (number INTEGER PRIMARY KEY, date TEXT NOT NULL, provenance TEXT NOT NULL);
CREATE TABLE supervisors (number INTEGER PRIMARY KEY, provenance TEXT NOT NULL UNIQUE);
CREATE TABLE results (
    key TEXT PRIMARY KEY REFERENCES runs, launch INTEGER NOT NULL REFERENCES launches,
    supervisor INTEGER REFERENCES supervisors, status TEXT NOT NULL, message TEXT NOT NULL,
    detail TEXT NOT NULL, stage TEXT NOT NULL, figures TEXT NOT NULL, started TEXT NOT NULL,
    finished TEXT NOT NULL, wall_seconds REAL NOT NULL, cpu_seconds REAL NOT NULL,
    peak_memory_bytes INTEGER NOT NULL, base_memory_bytes INTEGER NOT NULL,
    time_limit_seconds REAL, memory_limit_bytes INTEGER
) WITHOUT ROWID;
"""

RESULT_COLUMNS: Final = (
    "status", "message", "detail", "stage", "wall_seconds", "cpu_seconds", "peak_memory_bytes",
    "base_memory_bytes", "time_limit_seconds", "memory_limit_bytes", "started", "finished",
)  # fmt: skip


@dataclass(frozen=True)
class Counts:
    """How many runs of the grid have which status, and how many have none yet; results beyond the grid."""

    planned: int
    by_status: Mapping[str, int]
    beyond: int

    @property
    def left(self) -> int:
        """Runs of the grid without a result."""
        return self.planned - sum(self.by_status.values())


class Store:
    """An open store.  Only who holds the lock of its file may call what writes."""

    def __init__(self, path: Path, *, writing: bool = False) -> None:
        """Open the store; one that is not there is made, if `writing`.

        Raises:
            ModelError: there is none, or the file is something else.
        """
        self.path = path
        if not writing and not path.is_file():
            raise ModelError(f"{path}: there is no such store; `study run` makes it")
        try:
            # opened for writing to read, too: what a killed writer has left in the log must be replayed
            self._connection = sqlite3.connect(path, isolation_level=None, timeout=30)
            self._connection.row_factory = sqlite3.Row
            self._prepare(writing)
        except sqlite3.DatabaseError as error:
            raise ModelError(f"{path}: no store of a study, or a damaged one: {error}") from None

    def _prepare(self, writing: bool) -> None:
        connection = self._connection
        (tables,) = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
        if writing and not tables:
            connection.execute("PRAGMA journal_mode=WAL")
            connection.executescript(
                f"BEGIN IMMEDIATE; PRAGMA application_id={APPLICATION}; PRAGMA user_version={VERSION}; "
                f"{SCHEMA} COMMIT;"
            )
        (application,) = connection.execute("PRAGMA application_id").fetchone()
        (version,) = connection.execute("PRAGMA user_version").fetchone()
        if application != APPLICATION:
            self.close()
            raise ModelError(f"{self.path}: no store of a study; name another file")
        if version != VERSION:
            self.close()
            raise ModelError(f"{self.path}: a store of version {version}; this program reads {VERSION}")
        if writing:
            connection.execute("PRAGMA synchronous=FULL")
        else:
            connection.execute("PRAGMA query_only=ON")

    def close(self) -> None:
        """Close it."""
        self._connection.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # -- writing --

    def launch(self, name: str, runs: Sequence[Run], provenance: Mapping[str, Any]) -> int:
        """Note that the study is run (again): its grid takes the place of the one before."""
        with self._connection:
            self._connection.execute("BEGIN IMMEDIATE")
            self._connection.execute("INSERT OR REPLACE INTO about VALUES ('name', ?)", (name,))
            self._connection.execute("UPDATE runs SET place = NULL")
            self._connection.executemany(
                "INSERT INTO runs VALUES (?, ?, ?) ON CONFLICT (key) DO UPDATE SET place = excluded.place",
                ((run.key, place, json.dumps(run.parameters())) for place, run in enumerate(runs)),
            )
            found = self._connection.execute(
                "INSERT INTO launches (date, provenance) VALUES (?, ?)",
                (provenance["date"], json.dumps(provenance)),
            )
        number = found.lastrowid
        assert number is not None, "a row was inserted"
        return number

    def record(self, launch: int, run: Run, limits: Limits, outcome: Mapping[str, Any]) -> None:
        """Write the result of a run, in the place of an earlier one if there is one."""
        with self._connection:
            self._connection.execute("BEGIN IMMEDIATE")
            self._connection.execute(
                f"INSERT OR REPLACE INTO results VALUES ({', '.join('?' * 16)})",
                (
                    run.key, launch, self._supervisor(outcome.get("supervisor")), outcome["status"],
                    outcome["message"], outcome.get("detail", ""), outcome["stage"],
                    json.dumps(outcome["figures"]), outcome["started"], outcome["finished"],
                    outcome["wall_seconds"], outcome["cpu_seconds"], outcome["peak_memory_bytes"],
                    outcome["base_memory_bytes"], limits.seconds, limits.memory_bytes,
                ),
            )  # fmt: skip

    def _supervisor(self, provenance: Mapping[str, Any] | None) -> int | None:
        if provenance is None:
            return None
        text = json.dumps(provenance, sort_keys=True)
        self._connection.execute("INSERT OR IGNORE INTO supervisors (provenance) VALUES (?)", (text,))
        (number,) = self._connection.execute(
            "SELECT number FROM supervisors WHERE provenance = ?", (text,)
        ).fetchone()
        return int(number)

    # -- reading --

    @property
    def name(self) -> str:
        """What the study is called."""
        row = self._connection.execute("SELECT value FROM about WHERE name = 'name'").fetchone()
        return self.path.stem if row is None else str(row[0])

    def counts(self) -> Counts:
        """How far the study is."""
        query = """SELECT results.status, runs.place IS NULL FROM runs LEFT JOIN results USING (key)"""
        rows = self._connection.execute(query).fetchall()
        found = Counter(status for status, gone in rows if status is not None and not gone)
        return Counts(
            sum(not gone for _, gone in rows),
            {status: found[status] for status in STATUSES},
            sum(status is not None and gone for status, gone in rows),
        )

    def planned(self) -> dict[tuple[str, str], int]:
        """How many runs the grid has of each pair of work and model, in the grid's order."""
        query = """SELECT json_extract(parameters, '$.work'), json_extract(parameters, '$.model'), count(*)
            FROM runs WHERE place IS NOT NULL GROUP BY 1, 2 ORDER BY min(place)"""
        return {(work, model): count for work, model, count in self._connection.execute(query)}

    def statuses(self) -> list[tuple[dict[str, Any], str | None]]:
        """The parameters of each run of the grid, with the status of its result if there is one."""
        query = """SELECT runs.parameters, results.status FROM runs LEFT JOIN results USING (key)
            WHERE place IS NOT NULL ORDER BY place"""
        return [(json.loads(text), status) for text, status in self._connection.execute(query)]

    def by_key(self) -> dict[str, str]:
        """The status of each run of the grid that has a result."""
        query = "SELECT key, status FROM results JOIN runs USING (key) WHERE place IS NOT NULL"
        return {str(key): str(status) for key, status in self._connection.execute(query)}

    def finished(self, limits: Limits, retry: Collection[str] = ()) -> set[str]:
        """The keys of runs that need not be run again.

        One that has reached its limit is to be run again where the limit is higher now, one with a status
        in `retry` in any case.
        """
        rows = self._connection.execute(
            "SELECT key, status, time_limit_seconds, memory_limit_bytes FROM results"
        ).fetchall()
        done = set()
        for key, status, seconds, memory in rows:
            raised = (status == "timeout" and is_higher(limits.seconds, seconds)) or (
                status == "memout" and is_higher(limits.memory_bytes, memory)
            )
            if not raised and status not in retry:
                done.add(str(key))
        return done

    def launches(self) -> list[dict[str, Any]]:
        """The calls that ran some of the study, with the number of results that stand from each."""
        query = """SELECT launches.provenance, count(results.key) FROM launches
            LEFT JOIN results ON results.launch = launches.number GROUP BY number ORDER BY number"""
        return [json.loads(text) | {"results": count} for text, count in self._connection.execute(query)]

    def supervisors(self) -> list[dict[str, Any]]:
        """The processes that supervised runs."""
        rows = self._connection.execute("SELECT provenance FROM supervisors ORDER BY number")
        return [json.loads(text) for (text,) in rows]

    def rows(self, *, everything: bool = False) -> list[dict[str, Any]]:
        """One row for each run of the grid that has a result, in the grid's order, with equal columns.

        `everything`: also results of runs that are no longer in the grid, after the others.
        """
        query = f"""SELECT runs.key, runs.parameters, results.*, supervisors.provenance, launches.provenance
            AS launched FROM results JOIN runs USING (key) JOIN launches ON launches.number = launch
            LEFT JOIN supervisors ON supervisors.number = supervisor
            {"" if everything else "WHERE place IS NOT NULL"} ORDER BY place IS NULL, place"""
        return same_columns(row_of(found) for found in self._connection.execute(query))


def is_higher(now: float | None, before: float | None) -> bool:
    """Whether a limit is higher than it was; None is no limit."""
    return before is not None and (now is None or now > before)


def row_of(found: Mapping[str, Any] | sqlite3.Row) -> dict[str, Any]:
    """A result as one flat row."""
    parameters, figures = json.loads(found["parameters"]), json.loads(found["figures"])
    told = json.loads(found["provenance"] or found["launched"])
    row: dict[str, Any] = {
        "key": found["key"], "work": parameters["work"], "model": parameters["model"],
        "fingerprint": parameters["fingerprint"],
    }  # fmt: skip
    row |= {f"set.{name}": number_of(value) for name, value in parameters["set"].items()}
    row |= {f"option.{name}": value for name, value in parameters["options"].items()}
    row |= {"seed": parameters["seed"]}
    row |= {name: found[name] for name in RESULT_COLUMNS}
    row |= {name if name not in row else f"figure.{name}": value for name, value in figures.items()}
    row |= {
        "host": told["machine"]["host"], "processor": told["machine"]["processor"], "commit": told["commit"]
    }  # fmt: skip
    return row | {f"version.{name}": value for name, value in told["versions"].items()}


def number_of(value: Any) -> Any:
    """A parameter's text as a number where it is one that reads back the same."""
    if isinstance(value, str):
        for kind in (int, float):
            try:
                number = kind(value)
            except ValueError:
                continue
            if str(number) == value:
                return number
    return value


def same_columns(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows with all columns that any has, None where one lacks it; alike columns stand together."""
    found = list(rows)
    names = dict.fromkeys(name for row in found for name in row)

    def group(name: str) -> int:
        if name in ("key", "work", "model", "fingerprint"):
            return 0
        if name.startswith(("set.", "option.")) or name == "seed":
            return 1 + name.startswith("option.") + 2 * (name == "seed")
        if name.startswith("version.") or name in ("host", "processor", "commit"):
            return 6
        return 4 + (name not in RESULT_COLUMNS)

    ordered = sorted(names, key=group)
    return [{name: row.get(name) for name in ordered} for row in found]
