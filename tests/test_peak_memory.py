"""Every command reports the most memory it took."""

from __future__ import annotations

import json
import resource
import sys
from pathlib import Path

import pytest

from factored_polca.cli import main
from factored_polca.cli.entry import MEMORY_NOTED, commands

LINES = {
    "domains": ["domains"],
    "new": ["new", "lamp"],
    "info": ["info", "toy"],
    "check": ["check", "toy"],
    "convert": ["convert", "tiger", "tiger.pomdp", "--no-tasks"],
    "minimise": ["minimise", "toy"],
    "plan": ["plan", "toy"],
    "solve": ["solve", "toy"],
    "act": ["act", "toy.polca", "--state", "door=red"],
    "run": ["run", "sightless.polca", "--auto", "--steps", "2"],
    "simulate": ["simulate", "toy.polca", "--episodes", "5"],
    "compare": ["compare", "toy.polca", "toy.polca", "--episodes", "5"],
    "figure": ["figure", "4a", "cheese_taxi", "--trials", "1"],
    "bench": ["bench", "--list"],
    "study": ["study", "new", "small.toml"],
    "sensitivity": ["sensitivity", "tiger", "--set-range", "accuracy=0.8..0.9:2"],
}
"""A line for each command; `bench` and `study` here only say what they would do."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Path:
    """An empty folder but for two plans."""
    monkeypatch.chdir(tmp_path)
    assert main(["plan", "toy", "-o", "toy.polca", "--quiet"]) == 0
    assert (
        main(["plan", "tiger", "-o", "sightless.polca", "--trials", "2", "--episodes", "2", "--quiet"]) == 0
    )
    capsys.readouterr()
    return tmp_path


def test_there_is_a_line_for_each_command() -> None:
    assert LINES.keys() == commands().keys()


def largest() -> int:
    """The largest resident set so far, of this process and those that it waited for, in bytes."""
    peaks = [resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return max(peaks) * (1 if sys.platform == "darwin" else 1024)


@pytest.mark.parametrize("command", LINES)
def test_every_command_reports_its_peak_memory(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    assert main([*LINES[command], "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert before <= data["peak_memory_bytes"] <= largest()


@pytest.mark.parametrize(
    "command", ["check", "convert", "simulate", "compare", "minimise", "plan", "solve"]
)
def test_for_people_too(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(LINES[command]) == 0
    printed = capsys.readouterr()
    place = printed.err if command in MEMORY_NOTED else printed.out
    assert "peak memory" in place
    assert "MiB" in place


def test_a_quiet_command_notes_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*LINES["simulate"], "--quiet"]) == 0
    assert capsys.readouterr().err == ""
