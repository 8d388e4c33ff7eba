"""The command `study`: new, run, status, report, export; what it prints and refuses."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from factored_polca.cli import main
from factored_polca.studies.store_lock import StoreLock

TESTS = Path(__file__).resolve().parent
STUDY = """seconds = 20
[[grid]]
work = "study_functions:square"
set.n = "0..4"
[[grid]]
work = "study_functions:broken"
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with a study, which is the current one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COLUMNS", raising=False)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TESTS), str(TESTS.parent)]))
    (tmp_path / "squares.toml").write_text(STUDY)
    return tmp_path


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    assert main(["study", *arguments, "--json"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("\n") == 1
    return json.loads(printed)


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The message with which a command exits with the status 2."""
    assert main(["study", *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    return " ".join(printed.err.split())


def test_a_study_from_new_to_report(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "new", "mine"]) == 0
    assert "study run mine.toml" in capsys.readouterr().out
    assert "mine.toml is there already" in refused(capsys, "new", "mine.toml")
    assert main(["study", "run", "squares.toml", "--jobs", "2", "-q"]) == 0
    table = capsys.readouterr().out
    assert "squares: 6 of 6 runs ended" in table
    rows = [line.split() for line in table.splitlines()]
    assert rows[3][:7] == ["study_functions:square", "5", "5", "-", "-", "-", "-"]
    assert rows[4][:7] == ["study_functions:broken", "1", "-", "-", "-", "1", "-"]
    assert "1 x error: RuntimeError: it is <broken>" in table
    told = run_json(capsys, "status", "squares.sqlite")
    assert told == run_json(capsys, "status", "squares.toml")
    assert (told["runs"], told["left"], told["ok"], told["error"], told["running"]) == (6, 0, 5, 1, None)
    assert main(["study", "export", "squares.toml", "out.csv"]) == 0
    assert "6 results written to out.csv" in capsys.readouterr().out
    with (folder / "out.csv").open(newline="") as file:
        found = list(csv.DictReader(file))
    assert [row["square"] for row in found] == ["0", "1", "4", "9", "16", ""]
    pytest.importorskip("matplotlib")
    page = run_json(capsys, "report", "squares.toml")["page"]
    assert page == str(Path("squares-report") / "index.html")
    assert "RuntimeError: it is &lt;broken&gt;" in Path(page).read_text(encoding="utf-8")
    assert main(["study", "report", "squares.sqlite", "-o", "elsewhere", "-q"]) == 0
    assert (folder / "elsewhere" / "coverage.png").exists()


def test_a_changed_study_runs_only_what_is_new(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_json(capsys, "run", "squares.toml")
    (folder / "squares.toml").write_text(STUDY.replace("0..4", "3..6"))
    told = run_json(capsys, "status", "squares.toml")
    assert (told["runs"], told["left"]) == (6, 0)  # as it was run last
    told = run_json(capsys, "run", "squares.toml", "--retry", "error")
    assert (told["runs"], told["ok"], told["error"], told["beyond_the_grid"]) == (5, 4, 1, 3)


def test_a_second_run_of_a_store_says_so_and_stops(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lock = StoreLock(folder / "squares.sqlite")
    try:
        message = refused(capsys, "run", "squares.toml")
        assert f"the process {os.getpid()} on " in message
        assert "is writing it" in message
    finally:
        lock.release()
    assert main(["study", "run", "squares.toml", "-q"]) == 0


def started(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "factored_polca", "study", "run", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_two_processes_on_one_store(folder: Path) -> None:
    (folder / "squares.toml").write_text('[[grid]]\nwork = "study_functions:asleep"\nset.started = "pid"\n')
    first = started("squares.toml")
    try:
        end = time.monotonic() + 60
        while not (folder / "pid").exists():
            assert time.monotonic() < end
            time.sleep(0.02)
        second = started("squares.toml")
        _, said = second.communicate(timeout=60)
        assert second.returncode == 2
        assert f"the process {first.pid} on " in " ".join(said.split())
        first.send_signal(signal.SIGINT)
        printed, said = first.communicate(timeout=60)
        assert first.returncode == 130
        assert "0 of 1 runs ended" in printed
        assert "goes on from here" in said
        assert "one run is left" in printed
    finally:
        first.kill()
        first.wait()
    assert not (folder / "squares.sqlite.lock").exists()


def test_what_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "there is no such store" in refused(capsys, "status", "gone.sqlite")
    assert "there is no such store" in refused(capsys, "report", "squares.toml")
    assert "is a folder" in refused(capsys, "status", ".")
    assert "there is no such file" in refused(capsys, "run", "gone.toml")
    (folder / "squares.toml").write_text(STUDY.replace("seconds", "secs"))
    assert "squares.toml:1:1: secs: unknown key 'secs'" in refused(capsys, "run", "squares.toml")
    assert main(["study", "run", "squares.toml", "--retry", "odd"]) == 2
    assert "none of ok, timeout" in capsys.readouterr().err


def test_more_memory_than_the_machine_has_is_warned_of(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "squares.toml").write_text('memory = "900 TB"\n' + STUDY)
    assert main(["study", "run", "squares.toml", "--jobs", "3", "-q"]) == 0
    assert "3 runs at a time may take" in " ".join(capsys.readouterr().err.split())
