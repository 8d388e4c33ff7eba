"""The command line on wrong input, at its limits, and interrupted: one message, a status, no traceback."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from factored_polca.cli import commands, main
from factored_polca.cli.argument_types import size
from factored_polca.cli.ctrl_c import ctrl_c_comes_again
from factored_polca.diagrams import MemoryLimit

ROOT = Path(__file__).resolve().parent.parent

TAXI_STATE = "x=0,y=0,passenger=R,destination=B"
GOOD = """name = "small"
discount = 0.9
reward = "level"
[features]
level = "0..3"
[actions.up]
effects.level = "{level + 1: 1/2, level: 1/2} if level < 3 else level"
"""

Fail = Callable[..., str]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a right model and a plan, which is the current one."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.toml").write_text(GOOD, encoding="utf-8")
    return tmp_path


@pytest.fixture
def fail(capsys: pytest.CaptureFixture[str], folder: Path) -> Fail:
    """Run a command that must fail with a status; answer its message.

    Nothing may be on stdout, nor a traceback anywhere, and no file may appear.
    """

    def run(status: int, *arguments: str) -> str:
        before = sorted(folder.iterdir())
        assert main(list(arguments)) == status
        captured = capsys.readouterr()
        assert captured.out == ""
        assert "Traceback" not in captured.err
        assert "a fault of factored-polca" not in captured.err
        assert captured.err.count("error: ") == 1
        assert sorted(folder.iterdir()) == before
        return captured.err

    return run


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("check", "none.toml"), ["none.toml", "no such file"]),
        (("plan", "taxy"), ["taxy", "no shipped domain", "taxi"]),
        (("plan", "folder/"), ["folder/", "no such file"]),
        (("minimise", "taxi", "--set", "size"), ["NAME=VALUE", "'size'"]),
        (("minimise", "taxi", "--set", "size=large"), ["'large'", "size", "integer"]),
        (("minimise", "taxi", "--set", "size=1"), ["size", "2"]),
        (("minimise", "taxi", "--set", "sise=4"), ["'sise'", "did you mean 'size'"]),
        (("minimise", "small.toml", "--set", "slip=0.1"), ["slip"]),
        (("minimise", "taxi", "--actions", "North,Nort"), ["'Nort'", "North", "Pickup"]),
        (("minimise", "taxi", "--actions", ""), ["--actions", "North"]),
        (("minimise", "taxi", "--memory", "much"), ["--memory", "2GB"]),
        (("minimise", "taxi", "--time", "-1"), ["--time", "positive"]),
        (("minimise", "taxi", "--seed", "x"), ["--seed", "whole number"]),
        (("minimise", "taxi", "--order", "best"), ["--order", "force"]),
        (("plan", "taxi", "--solver", "best"), ["--solver", "pi"]),
        (("plan", "taxi", "--tasks", "none.toml"), ["none.toml", "no such file"]),
        (("plan", "taxi", "--tasks", "small.toml"), ["small.toml", "tasks"]),
        (("plan", "small.toml", "-o", "none/plan.polca"), ["none/plan.polca", "no folder"]),
        (("plan", "small.toml", "-o", "."), [".", "is a folder"]),
        (("act", "none.polca", "--state", "x=1"), ["none.polca", "no such file"]),
        (("act", "small.toml", "--state", "x=1"), ["small.toml", "not a plan file"]),
        (("simulate", "none.polca"), ["none.polca", "no such file"]),
        (("simulate", "none.polca", "--episodes", "0"), ["--episodes", "at least 1"]),
        (("simulate", "none.polca", "--steps", "0"), ["--steps", "at least 1"]),
        (("convert", "taxi", "none/taxi.toml"), ["none/taxi.toml"]),
        (("convert", "taxi", "taxi.txt"), ["taxi.txt", ".toml", ".dat"]),
        (("convert", "taxi", "taxi.dat"), ["taxi.dat", "tasks"]),
        (("convert", "taxi", "taxi.pomdp"), ["taxi.pomdp", "tasks", "--no-tasks"]),
        (("convert", "taxi", "taxi.pomdpx"), ["taxi.pomdpx", "tasks", "--no-tasks"]),
        (("convert", "taxi", "taxi.txt", "--minimise"), ["taxi.txt", ".toml", ".dat"]),
        (("new", "../robot"), ["'../robot'", "letters"]),
        (("new", "small"), ["small.toml", "exists already"]),
        (("fly",), ["fly", "minimise"]),
        (("plan", "taxi", "--fly"), ["--fly"]),
        (("plan",), ["MODEL"]),
        ((), ["COMMAND"]),
    ],
)
def test_wrong_use_is_said_with_what_would_be_right(
    fail: Fail, arguments: tuple[str, ...], said: list[str]
) -> None:
    message = fail(2, *arguments)
    for part in said:
        assert part in message


@pytest.mark.parametrize(
    ("old", "new", "place", "said"),
    [
        ('"0..3"', '"0..3', "small.toml:5:", "TOML"),
        ("discount = 0.9", "discount = 1.5", "small.toml:2:", "discount"),
        ('reward = "level"', 'reward = "level +"', "small.toml:3:", "ends too early"),
        ('reward = "level"', 'reward = "levle"', "small.toml:3:", "level"),
        ("level: 1/2}", "level: 1/3}", "small.toml:7:", "5/6"),
        ("[actions.up]", "[actions.up]\ncolour = 3", "small.toml:7:", "colour"),
        ('"level"', "\"__import__('os')\"", "small.toml:3:", ""),
    ],
)
@pytest.mark.parametrize("command", ["check", "minimise", "plan"])
def test_a_fault_in_a_file_has_its_line(
    fail: Fail, folder: Path, command: str, old: str, new: str, place: str, said: str
) -> None:
    assert old in GOOD
    (folder / "small.toml").write_text(GOOD.replace(old, new), encoding="utf-8")
    message = fail(2, command, "small.toml")
    assert place in message
    assert said in message


def test_all_faults_are_said_at_once(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = GOOD.replace('"level"', '"lvl"').replace("level: 1/2}", "leve: 1/2}")
    (folder / "small.toml").write_text(text, encoding="utf-8")
    assert main(["check", "small.toml"]) == 2
    message = capsys.readouterr().err
    assert message.count("error: ") == 2
    assert "small.toml:3:" in message
    assert "small.toml:7:" in message


def test_check_with_json_lists_the_faults_it_finds(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "small.toml").write_text(GOOD.replace("level: 1/2}", "level: 1/3}"), encoding="utf-8")
    assert main(["check", "small.toml", "--json"]) == 2
    assert '"ok": false' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ("colour=red", ["'colour'", "passenger"]),
        ("x=0,y=0", ["passenger", "destination"]),
        (TAXI_STATE.replace("x=0", "x=9"), ["x", "'9'", "0, 1, 2, 3, 4"]),
        (TAXI_STATE + ",x=1", ["x twice"]),
        ("x", ["FEATURE=VALUE"]),
        ('x="0"', ["'0'"]),
        ('"x=0', ["FEATURE=VALUE"]),
        ("", ["FEATURE=VALUE"]),
    ],
)
def test_a_wrong_state_is_said(
    fail: Fail, capsys: pytest.CaptureFixture[str], state: str, said: list[str]
) -> None:
    assert main(["plan", "taxi", "-o", "taxi.polca", "-q", "--json", "--no-flat"]) == 0
    capsys.readouterr()
    message = fail_quietly(fail, "act", "taxi.polca", "--state", state)
    for part in said:
        assert part in message


def fail_quietly(fail: Fail, *arguments: str) -> str:
    """`fail` after another command's output was read."""
    return fail(2, *arguments)


@pytest.mark.parametrize("command", [("minimise",), ("plan",)])
def test_too_little_memory_is_a_limit(fail: Fail, command: tuple[str, ...]) -> None:
    message = fail(3, *command, "taxi", "--memory", "16MiB", "-q")
    assert "limit reached" in message
    assert "16 MiB" in message


@pytest.mark.parametrize("command", [("minimise",), ("plan", "--solver", "vi")])  # auto goes on on diagrams
def test_memory_that_runs_out_on_the_way_is_a_limit(
    fail: Fail, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    monkeypatch.setattr(commands, "current_memory_bytes", lambda: 0)
    message = fail(3, *command, "sysadmin", "--set", "size=12", "--memory", "2MiB", "-q")
    assert "limit reached" in message
    assert "memory limit of 2 MiB" in message


def test_a_memory_error_of_the_machine_is_a_limit(fail: Fail, monkeypatch: pytest.MonkeyPatch) -> None:
    def exhausted(*arguments: object) -> None:
        raise MemoryError

    monkeypatch.setattr(commands, "load", exhausted)
    assert "--memory" in fail(3, "minimise", "toy")


@pytest.mark.parametrize("command", ["minimise", "plan"])
def test_too_little_time_is_a_limit(fail: Fail, command: str) -> None:
    message = fail(3, command, "expon", "--set", "size=18", "--time", "1", "-q", "--json")
    assert "limit reached" in message
    assert "time limit" in message


def test_a_limit_reached_by_a_library_is_a_limit(fail: Fail, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: object) -> None:
        raise MemoryLimit("no room")

    monkeypatch.setattr(commands, "load", full)
    assert "limit reached: no room" in fail(3, "minimise", "toy")


def test_a_fault_of_our_own_is_said_without_a_traceback(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*arguments: object) -> None:
        raise ZeroDivisionError("by zero")

    monkeypatch.delenv("FACTORED_POLCA_TRACEBACK", raising=False)
    monkeypatch.setattr(commands, "load", broken)
    assert main(["minimise", "toy"]) == 1
    message = capsys.readouterr().err
    assert "ZeroDivisionError: by zero" in message
    assert "Traceback" not in message
    monkeypatch.setenv("FACTORED_POLCA_TRACEBACK", "1")
    assert main(["minimise", "toy"]) == 1
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "count"),
    [("2GB", 2 * 10**9), ("500MiB", 500 << 20), ("1.5k", 1500), ("4096", 4096), ("1 gib", 1 << 30)],
)
def test_sizes_are_read(text: str, count: int) -> None:
    assert size(text) == count


@pytest.mark.parametrize("arguments", [["minimise"], ["plan", "-o", "made.polca"]])
def test_ctrl_c_ends_a_long_minimisation_with_130(folder: Path, arguments: list[str]) -> None:
    """Numbers of 22 bits that are all different take some ten seconds; the signal comes in their midst."""
    command = [sys.executable, "-m", "factored_polca", *arguments, "expon", "--set", "size=22"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    before = sorted(folder.iterdir())
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "expon" in line and "tasks" not in line:
                break
        time.sleep(1.5)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert out == ""
    assert err.strip() == "interrupted"
    assert sorted(folder.iterdir()) == before


class Swallows:
    """What is raised while it goes away, C code swallows."""

    def __del__(self) -> None:
        raise KeyboardInterrupt


def swallow_and_work_on() -> None:
    with ctrl_c_comes_again():
        Swallows()
        time.sleep(10)


def swallow_and_fail() -> None:
    with ctrl_c_comes_again():
        Swallows()
        raise RuntimeError("no compiled object yet")


def test_ctrl_c_that_c_code_swallows_comes_again(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(KeyboardInterrupt):
        swallow_and_work_on()
    assert capsys.readouterr().err == ""


def test_an_error_after_ctrl_c_was_swallowed_is_its_consequence(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(KeyboardInterrupt) as caught:
        swallow_and_fail()
    assert isinstance(caught.value.__cause__, RuntimeError)
    time.sleep(0.1)  # it does not come a second time
    with pytest.raises(RuntimeError), ctrl_c_comes_again():
        raise RuntimeError("another fault")
    assert capsys.readouterr().err == ""


def test_ctrl_c_while_the_program_starts_ends_with_130() -> None:
    command = [sys.executable, "-X", "importtime", "-m", "factored_polca", "minimise", "toy"]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if line.rstrip().endswith("factored_polca.models.errors"):
                break
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 130
