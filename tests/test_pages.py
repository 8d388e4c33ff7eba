"""The tutorial and the how-to pages are true: their blocks are run in their order, in an empty folder.

    toml       a model; it is written to NAME.toml, NAME being its name
    console    commands, and what each prints, compared as in README
    python     run; a comment behind a `print` at a line's start is what it prints.  A block that begins
               with `# NAME.py` is written to that file as well

Other blocks are shown only: shells, and outputs that hang on simulation or are too wide to be compared.
"""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pytest
from test_readme import comparable

from factored_polca.cli import main

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGES = [DOCS / "tutorial.md", *sorted((DOCS / "howto").glob("*.md"))]


def run_commands(block: str, capsys: pytest.CaptureFixture[str]) -> None:
    for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
        command, _, expected = part.partition("\n")
        program, *arguments = shlex.split(command)
        assert program == "factored-polca"
        assert main(arguments) == 0, command
        assert told(capsys.readouterr().out) == told(expected), command


def told(text: str) -> list[str]:
    """What a command printed, but for how large its diagrams were on the way: the kernel's affair."""
    return [line for line in comparable(text) if not line.startswith("diagram nodes (peak)")]


def run_code(block: str, capsys: pytest.CaptureFixture[str]) -> None:
    name = re.match(r"# (\w+\.py)\n", block)
    if name:
        Path(name[1]).write_text(block, encoding="utf-8")
    exec(compile(block, "page", "exec"), {"__name__": "page"})
    printed = capsys.readouterr().out.splitlines()
    expected = re.findall(r"^print\(.*?\)(?:  # (.*))?$", block, re.MULTILINE)
    assert len(printed) == len(expected)
    for line, comment in zip(printed, expected, strict=True):
        assert comment in ("", line)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_does_what_it_says(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)
    ran = 0
    text = page.read_text(encoding="utf-8")
    for kind, block in re.findall(r"^```(\w+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        if kind == "toml":
            (name,) = re.findall(r'^name = "(\w+)"', block, re.MULTILINE)
            Path(f"{name}.toml").write_text(block, encoding="utf-8")
        elif kind == "console":
            run_commands(block, capsys)
        elif kind == "python":
            run_code(block, capsys)
        ran += kind in ("console", "python")
    for module in set(sys.modules) - before:
        if getattr(sys.modules[module], "__file__", None) == str(tmp_path / f"{module}.py"):
            del sys.modules[module]
    assert ran
