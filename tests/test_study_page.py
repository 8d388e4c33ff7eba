"""docs/studies.md is true: its study is run, its commands print what it says, its Python does too."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from factored_polca.cli import main
from factored_polca.studies import read_study
from factored_polca.studies.grid import OPTIONS

PAGE = (Path(__file__).resolve().parent.parent / "docs" / "studies.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def comparable(text: str) -> list[str]:
    """Lines without durations, and with single blanks."""
    text = re.sub(r"[\d.]+ \.\. [\d.]+ *$", "SPAN", text, flags=re.MULTILINE)
    lines = [re.sub(r"─+", "─", re.sub(r"\s+", " ", line)).strip() for line in text.splitlines()]
    return [line for line in lines if line]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with the page's study, which is the current one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    (study,) = blocks("toml")
    (tmp_path / "blocks.toml").write_text(study, encoding="utf-8")
    return tmp_path


def test_the_commands_print_what_it_says(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    (block,) = blocks("console")
    parts = re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]
    assert len(parts) == 3
    for part in parts:
        command, _, expected = part.partition("\n")
        program, *arguments = shlex.split(command)
        assert program == "factored-polca"
        assert main(arguments) == 0, command
        assert comparable(capsys.readouterr().out) == comparable(expected), command
    assert len((folder / "blocks.csv").read_text().splitlines()) == 1 + 18


def test_the_python_example_does_what_its_comments_say(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = blocks("python")
    exec(compile(code, "studies.md", "exec"), {"__name__": "page"})
    printed = capsys.readouterr().out.splitlines()
    assert printed == re.findall(r"^print\(.*\)  # (.*)$", code, re.MULTILINE)
    assert (folder / "squares.sqlite").is_file()


def test_the_cluster_s_table_is_read(folder: Path) -> None:
    (indented,) = re.findall(r"^    \[cluster\]\n(?:    .*\n)+", PAGE, re.MULTILINE)
    study = (folder / "blocks.toml").read_text() + re.sub(r"^    ", "", indented, flags=re.MULTILINE)
    (folder / "blocks.toml").write_text(study)
    cluster = read_study("blocks.toml").cluster
    assert cluster is not None
    assert (cluster.provider, cluster.workers, cluster.nodes) == ("slurm", 8, 4)


def test_its_table_of_keys_is_whole() -> None:
    for work, options in OPTIONS.items():
        (row,) = re.findall(rf"^\| of `{work}` \| (.*) \|$", PAGE, re.MULTILINE)
        assert set(re.findall(r"`(\w+)`", row)) == set(options)
