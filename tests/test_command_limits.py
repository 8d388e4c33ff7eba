"""Limits of commands: memory and time end a command with a message and the exit status 3."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

import numpy as np
import pytest

from factored_polca.cli import main
from factored_polca.cli.memory import SLACK_BYTES, current_memory_bytes, memory_backstop
from factored_polca.diagrams import Manager, MemoryLimit
from factored_polca.diagrams.manager import available_memory

linux = pytest.mark.skipif(sys.platform != "linux", reason="the backstop is Linux's")
MIB = 1 << 20


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def little_more() -> int:
    """A limit that this process will soon reach."""
    return current_memory_bytes() + 8 * MIB


@linux
def test_the_backstop_lets_allocations_fail_and_goes_away() -> None:
    before = resource.getrlimit(resource.RLIMIT_DATA)
    limit = little_more()
    beyond = 8 * MIB + limit // 16 + SLACK_BYTES + 64 * MIB
    with memory_backstop(limit), pytest.raises(MemoryError):
        np.empty(beyond, dtype=np.uint8)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
    assert len(np.empty(beyond, dtype=np.uint8)) == beyond
    with memory_backstop(None):
        assert resource.getrlimit(resource.RLIMIT_DATA) == before


@linux
def test_diagrams_keep_within_what_the_process_may_take() -> None:
    payloads = np.arange(1 << 23, dtype=np.uint64)  # 16 bytes each as leaves
    limit = little_more()
    room = 8 * MIB + limit // 16 + SLACK_BYTES
    with memory_backstop(limit):
        assert available_memory() <= room + 32 * MIB  # some of it is what garbage leaves
        manager = Manager([2] * 40)
        assert manager.memory_limit <= (room + 32 * MIB) * 3 // 4
        with pytest.raises(MemoryLimit):
            manager.leaf_nodes(payloads)
    manager.assert_consistent()


@linux
def test_a_list_that_outgrows_the_memory_is_a_limit(capsys: pytest.CaptureFixture[str]) -> None:
    """4,096 states, from each of which each of 13 actions leads to thousands with positive probability."""
    limit = str(little_more())
    assert main(["solve", "sysadmin", "--set", "size=12", "--memory", limit, "--quiet"]) == 3
    assert "limit reached" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command",
    [
        ["check", "workshop"],
        ["minimise", "workshop"],
        ["plan", "workshop"],
        ["convert", "workshop", "out.npz", "--minimise"],
        ["convert", "workshop", "out.mdp", "--no-tasks"],
    ],
)
def test_time_that_is_over_is_a_limit(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command, "--time", "0.001", "--quiet"]) == 3
    assert "limit reached" in capsys.readouterr().err
    assert not list(Path().iterdir())
