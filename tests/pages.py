"""Pages of documentation that are true: their blocks are run in their order, in an empty folder.

    console      commands, and what each prints, compared as in README; a line `error: ...` at the end is
                 what a command that fails says
    python       run; a comment behind a `print` at a line's start is what it prints; where the first line
                 is a comment with the name of a file, as in `# qmdp.py`, it is that file too
    others       a block whose first line is a comment with the name of a file, as in `# lamp.toml` or
                 `<!-- lamp.pomdpx -->`, is that file

Blocks of the kinds `text` and `output` are shown only.
"""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from test_readme import comparable

from factored_polca.cli import main

_FILE = re.compile(r"(?:#|//|<!--) (\w[\w.+-]*\.\w+)(?: -->)?\n")


def run_page(page: Path, capsys: pytest.CaptureFixture[str]) -> int:
    """Run the blocks of `page` in the current folder; how many commands and programs there were."""
    ran = 0
    text = page.read_text(encoding="utf-8")
    for kind, block in re.findall(r"^```(\w+)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        if kind == "console":
            ran += run_commands(block, capsys)
            continue
        if kind not in ("text", "output") and (name := _FILE.match(block)):
            # a document type must come first in XML, and comments after it are fine
            Path(name[1]).write_text(block, encoding="utf-8")
        if kind == "python":
            run_code(block, capsys)
            ran += 1
    return ran


def run_commands(block: str, capsys: pytest.CaptureFixture[str]) -> int:
    """Run the commands of a block and compare what they print."""
    parts = re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]
    for part in parts:
        command, _, expected = part.partition("\n")
        program, *arguments = shlex.split(command)
        assert program == "factored-polca"
        fails = expected.startswith("error: ")
        assert main(arguments) == (2 if fails else 0), command
        printed = capsys.readouterr()
        assert comparable(printed.err if fails else printed.out) == comparable(expected), command
    return len(parts)


def run_code(block: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Run a program and compare what it prints with its comments."""
    exec(compile(block, "page", "exec"), {"__name__": "page"})
    printed = capsys.readouterr().out.splitlines()
    expected = re.findall(r"^print\(.*?\)(?:  # (.*))?$", block, re.MULTILINE)
    assert len(printed) == len(expected)
    for line, comment in zip(printed, expected, strict=True):
        assert comment in ("", line)
