"""The page about PRISM is true: its program is read, its commands print what it shows."""

from __future__ import annotations

import re
import shlex
from importlib.util import find_spec
from pathlib import Path

import pytest
from test_readme import comparable

from factored_polca.cli import main

PAGE = (Path(__file__).resolve().parent.parent / "docs/formats/prism.md").read_text(encoding="utf-8")


@pytest.mark.skipif(find_spec("stormpy") is None, reason="needs the extra `storm`")
def test_its_commands_print_what_it_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    (program,) = re.findall(r"^```prism\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    (tmp_path / "workers.prism").write_text(program, encoding="utf-8")
    ran = 0
    for block in re.findall(r"^```console\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, _, expected = part.partition("\n")
            name, *arguments = shlex.split(command)
            assert name == "factored-polca"
            assert main(arguments) == 0, command
            assert comparable(capsys.readouterr().out) == comparable(expected), command
            ran += 1
    assert ran == 3
    assert (tmp_path / "workers.toml").is_file()
