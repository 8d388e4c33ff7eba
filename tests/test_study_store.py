"""The store of a study, its lock, and its export: one result a run, kept; one writer."""

from __future__ import annotations

import csv
import os
import signal
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from factored_polca.models import ModelError
from factored_polca.studies import Run, Store
from factored_polca.studies.limits import Limits
from factored_polca.studies.provenance import now, provenance
from factored_polca.studies.store import Counts, number_of
from factored_polca.studies.store_lock import StoreLock, StoreLocked, is_locked, lock_path
from factored_polca.studies.study_export import csv_text, export, make_frame

LIMITS = Limits(10, 1000)
RUNS = [Run("minimise", "linear", "", (("size", str(n)),), (), 0) for n in range(4)]


def outcome(status: str = "ok", **figures: Any) -> dict[str, Any]:
    return {
        "status": status, "message": "", "stage": "done", "figures": figures, "started": now(),
        "finished": now(), "wall_seconds": 1.0, "cpu_seconds": 0.5, "peak_memory_bytes": 3,
        "base_memory_bytes": 2, "supervisor": provenance() | {"warm_seconds": {}},
    }  # fmt: skip


def launched(path: Path, runs: list[Run] = RUNS) -> tuple[Store, int]:
    store = Store(path, writing=True)
    return store, store.launch("s", runs, provenance() | {"arguments": []})


# -- the store -------------------------------------------------------------------------------------


def test_results_are_kept_one_for_each_run(tmp_path: Path) -> None:
    store, launch = launched(tmp_path / "s.sqlite")
    with store:
        store.record(launch, RUNS[2], LIMITS, outcome(blocks=3, states="8", note=None))
        store.record(launch, RUNS[0], LIMITS, outcome("timeout"))
        store.record(launch, RUNS[0], LIMITS, outcome("error"))
    with Store(tmp_path / "s.sqlite") as store:
        assert store.counts() == Counts(4, {"ok": 1, "timeout": 0, "memout": 0, "error": 1}, 0)
        assert store.counts().left == 2
        first, second = store.rows()
        assert (first["set.size"], first["status"], first["blocks"]) == (0, "error", None)
        assert (second["set.size"], second["status"], second["blocks"]) == (2, "ok", 3)
        assert list(first) == list(second)
        assert second["version.numpy"] == provenance()["versions"]["numpy"]
        assert second["host"] == provenance()["machine"]["host"]
        assert (second["key"], second["seed"]) == (RUNS[2].key, 0)


def test_results_of_runs_that_left_the_grid_are_kept_apart(tmp_path: Path) -> None:
    store, launch = launched(tmp_path / "s.sqlite")
    for run in RUNS:
        store.record(launch, run, LIMITS, outcome())
    store.launch("s", [RUNS[3], RUNS[1]], provenance() | {"arguments": []})
    assert store.counts() == Counts(2, {"ok": 2, "timeout": 0, "memout": 0, "error": 0}, 2)
    assert [row["set.size"] for row in store.rows()] == [3, 1]
    assert {row["set.size"] for row in store.rows(everything=True)} == {0, 1, 2, 3}
    assert [one["results"] for one in store.launches()] == [4, 0]
    store.close()


@pytest.mark.parametrize(
    ("status", "limits", "again"),
    [
        ("ok", Limits(99, 9999), False),
        ("error", Limits(99, 9999), False),
        ("timeout", LIMITS, False),
        ("timeout", Limits(9, 9999), False),
        ("timeout", Limits(11, 1000), True),
        ("timeout", Limits(None, 1000), True),
        ("memout", Limits(99, 1000), False),
        ("memout", Limits(1, 1001), True),
        ("memout", Limits(1, None), True),
    ],
)
def test_a_run_that_met_its_limit_is_due_again_where_that_is_higher(
    tmp_path: Path, status: str, limits: Limits, again: bool
) -> None:
    store, launch = launched(tmp_path / "s.sqlite")
    store.record(launch, RUNS[0], LIMITS, outcome(status))
    assert (RUNS[0].key not in store.finished(limits)) is again
    assert RUNS[0].key not in store.finished(limits, retry=(status,))
    store.close()


def test_other_files_are_no_stores(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="there is no such store"):
        Store(tmp_path / "gone.sqlite")
    assert not (tmp_path / "gone.sqlite").exists()
    (tmp_path / "text.sqlite").write_text("a text " * 1000)
    for writing in (False, True):
        with pytest.raises(ModelError, match="no store of a study"):
            Store(tmp_path / "text.sqlite", writing=writing)
    sqlite3.connect(tmp_path / "other.sqlite").execute("CREATE TABLE t (x)").connection.close()
    with pytest.raises(ModelError, match="no store of a study"):
        Store(tmp_path / "other.sqlite", writing=True)
    store, _ = launched(tmp_path / "new.sqlite")
    store.close()
    sqlite3.connect(tmp_path / "new.sqlite").execute("PRAGMA user_version=2").connection.close()
    with pytest.raises(ModelError, match="version 2"):
        Store(tmp_path / "new.sqlite")


def test_who_reads_does_not_write(tmp_path: Path) -> None:
    launched(tmp_path / "s.sqlite")[0].close()
    with Store(tmp_path / "s.sqlite") as store, pytest.raises(sqlite3.OperationalError):
        store.launch("s", [], provenance())


def test_numbers_of_parameters_are_numbers_where_they_read_back() -> None:
    texts = {
        "4": 4,
        "0.5": 0.5,
        "1/3": "1/3",
        "05": "05",
        "true": "true",
        "1e3": "1e3",
        "": "",
        "nan": None,
    }
    for text, value in texts.items():
        found = number_of(text)
        assert found == value or (text == "nan" and found != found)


# -- the lock --------------------------------------------------------------------------------------


HOLDER = """
import sys, time
from pathlib import Path
from factored_polca.studies.store_lock import StoreLock
lock = StoreLock(Path(sys.argv[1]))
print("locked", flush=True)
if sys.argv[2] == "fork":
    import os
    if os.fork() == 0:
        print("forked", flush=True)
        time.sleep(20)
        os._exit(0)
time.sleep(20)
"""


def holder(path: Path, how: str = "") -> subprocess.Popen[str]:
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(path), how], stdout=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    return process


def test_a_second_writer_is_told_who_the_first_is(tmp_path: Path) -> None:
    store = tmp_path / "s.sqlite"
    process = holder(store)
    try:
        assert is_locked(store)
        with pytest.raises(StoreLocked, match=f"the process {process.pid} on "):
            StoreLock(store)
    finally:
        process.kill()
        process.wait()


def test_the_lock_of_a_killed_process_is_taken_over(tmp_path: Path) -> None:
    store = tmp_path / "s.sqlite"
    process = holder(store, "fork")
    assert process.stdout is not None
    assert process.stdout.readline() == "forked\n"
    os.kill(process.pid, signal.SIGKILL)  # its child lives on, and has given its copy of the lock back
    process.wait()
    try:
        assert lock_path(store).exists()
        assert not is_locked(store)
        lock = StoreLock(store)
        assert is_locked(store)
        lock.release()
        assert not lock_path(store).exists()
    finally:
        os.killpg(process.pid, signal.SIGKILL)


def test_the_lock_goes_back_and_forth_between_threads(tmp_path: Path) -> None:
    """At each moment one of them has it: what it guards is never found in use."""
    used, refused, worked = [False], [0], [0]

    def work() -> None:
        for _ in range(15):
            try:
                lock = StoreLock(tmp_path / "s.sqlite")
            except StoreLocked:
                refused[0] += 1
                continue
            assert not used[0]
            used[0] = True
            worked[0] += 1
            used[0] = False
            lock.release()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert worked[0] + refused[0] == 60
    assert worked[0] >= 15


# -- export ----------------------------------------------------------------------------------------

ROWS = [
    {"key": "a", "states": "8", "value": float("inf"), "ok": True, "note": 'a "b", c\n', "mixed": 1},
    {"key": "b", "states": str(10**30), "value": None, "ok": None, "note": "ü", "mixed": "x"},
]


def test_csv_reads_back(tmp_path: Path) -> None:
    export(ROWS, tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text(encoding="utf-8") == csv_text(ROWS)
    with (tmp_path / "t.csv").open(newline="", encoding="utf-8") as file:
        first, second = csv.DictReader(file)
    assert first == {
        "key": "a",
        "states": "8",
        "value": "inf",
        "ok": "true",
        "note": 'a "b", c\n',
        "mixed": "1",
    }
    assert second["states"] == "1" + "0" * 30
    assert second["value"] == ""


def test_frames_and_parquet_read_back(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    rows = [*ROWS, {"key": "c", "states": "3", "value": 2.5, "ok": False, "note": None, "mixed": 2}]
    frame = make_frame(rows)
    assert frame["states"].tolist() == ["8", "1" + "0" * 30, "3"]  # beyond 64 bits: digits
    assert make_frame([rows[0], rows[2]])["states"].tolist() == [8, 3]
    export(rows, tmp_path / "t.parquet")
    back = pandas.read_parquet(tmp_path / "t.parquet")
    assert list(back.columns) == list(ROWS[0])
    assert back["value"].tolist()[::2] == [float("inf"), 2.5]
    assert back["mixed"].tolist() == ["1", "x", "2"]


def test_other_extensions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"\.csv or \.parquet"):
        export(ROWS, tmp_path / "t.xlsx")
    assert make_frame([]).empty if pytest.importorskip("pandas") else True
    assert csv_text([]) == ""
