"""docs/formats/rddl.md is true: its model is read, its commands print what it shows."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytest.importorskip("pyRDDLGym")

from pages import run_page

PAGE = Path(__file__).resolve().parent.parent / "docs" / "formats" / "rddl.md"


def test_the_commands_print_what_the_page_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    assert run_page(PAGE, capsys) == 3


def test_every_competition_domain_has_a_line() -> None:
    text = PAGE.read_text(encoding="utf-8")
    lines = re.findall(r"^\| (20\d\d) (\w+) (P?O?MDP) \| (\w+)", text, re.MULTILINE)
    assert len(lines) == len(set(lines)) == 32
    assert {read for _, _, _, read in lines} == {"yes"}
