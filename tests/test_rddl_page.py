"""docs/formats/rddl.md is true: its model is read, its commands print what it shows."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

pytest.importorskip("pyRDDLGym")

from test_readme import comparable

from factored_polca.cli import main

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "formats" / "rddl.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def test_the_commands_print_what_the_page_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    (model,) = blocks("rddl")
    name = model.partition("\n")[0].removeprefix("// ")
    (tmp_path / name).write_text(model, encoding="utf-8")
    commands = 0
    for block in blocks("console"):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, _, expected = part.partition("\n")
            program, *arguments = shlex.split(command)
            assert program == "factored-polca"
            assert main(arguments) == 0, command
            assert comparable(capsys.readouterr().out) == comparable(expected), command
            commands += 1
    assert commands == 3


def test_every_competition_domain_has_a_line() -> None:
    lines = re.findall(r"^\| (20\d\d) (\w+) (P?O?MDP) \| (\w+)", PAGE, re.MULTILINE)
    assert len(lines) == len(set(lines)) == 32
    assert {read for _, _, _, read in lines} == {"yes"}
