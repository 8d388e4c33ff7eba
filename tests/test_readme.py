"""README.md is true: its files and commands are run, its outputs compared.

Times and rounding errors differ from machine to machine: durations, numbers like 3e-12, the lengths of
rules and the blanks between columns are left out of the comparison, and so is how large diagrams were on
the way, which the kernel may change.
"""

from __future__ import annotations

import io
import re
import shlex
import sys
from pathlib import Path

import pytest

from factored_polca.cli import main

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def comparable(text: str) -> list[str]:
    text = re.sub(r"\b\d+(\.\d+)? (ms|s)\b", "TIME", text)
    text = re.sub(r"\b\d+(\.\d+)?e-\d+\b", "TINY", text)
    text = re.sub(r"\b\d[\d,]* MiB\b", "SIZE", text)
    text = re.sub(r"^diagram nodes \(peak\) .*$", "diagram nodes (peak) SIZE", text, flags=re.MULTILINE)
    lines = [re.sub(r"─+", "─", re.sub(r"\s+", " ", line)).strip() for line in text.splitlines()]
    return [line for line in lines if line]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with the README's model, which is the current one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    (model,) = blocks("toml")
    (tmp_path / "courier.toml").write_text(model, encoding="utf-8")
    return tmp_path


def test_it_opens_with_what_it_is_for_and_the_two_commands() -> None:
    commands = re.findall(r"^ {4}(.+)$", README, re.MULTILINE)[:2]
    assert commands == [
        "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/factored-polca plan nursebot",
        "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/pytest",
    ]
    assert README.index(commands[0]) < 1200


def test_the_commands_print_what_it_says(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ran = 0
    for block in blocks("console"):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, _, expected = part.partition("\n")
            program, *arguments = shlex.split(command)
            assert program == "factored-polca"
            assert main(arguments) == 0, command
            assert comparable(capsys.readouterr().out) == comparable(expected), command
            ran += 1
    assert ran >= 4


def test_the_dialogue_goes_as_it_says(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (block,) = blocks("dialogue")
    commands = re.findall(r"^\$ factored-polca (.+)$", block, re.MULTILINE)
    expected = re.sub(r"^\$ .+\n", "", block, flags=re.MULTILINE)
    typed = re.findall(r"^\S.*\S> (.+)$", expected, re.MULTILINE)
    for command in commands:
        capsys.readouterr()
        monkeypatch.setattr(sys, "stdin", io.StringIO("".join(f"{line}\n" for line in typed)))
        assert main(shlex.split(command)) == 0, command
    assert comparable(capsys.readouterr().out) == comparable(expected)


def test_the_nursing_robot_s_table_has_the_counts_that_it_shows(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Counts are exact; what is searched and simulated may differ with the machine in its last digits."""
    (shown,) = blocks("output")
    assert shown.startswith("$ factored-polca plan nursebot\n")
    assert main(["plan", "nursebot", "--episodes", "2", "-q"]) == 0
    printed = capsys.readouterr().out
    row = re.compile(r"^(\w+) +(\d+) +(\d+) +(\d+ -> \d+) +([\d,]+) +([\d,]+) +([\d,]+) ", re.MULTILINE)
    ours, theirs = row.findall(printed), row.findall(shown)
    assert [r[0] for r in theirs] == ["Remind", "Contact", "Move", "Inform", "Assist", "Rest", "Act"]
    children = [r for r in theirs if r[0] not in ("Assist", "Act")]  # the others hang on their policies
    assert [r for r in ours if r[0] not in ("Assist", "Act")] == children
    (upper,) = re.findall(r"no policy earns more than (\S+)", shown)
    assert f"no policy earns more than {upper}" in printed


def test_the_python_examples_do_what_their_comments_say(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for code, prints in zip(blocks("python"), (4,), strict=True):
        exec(compile(code, "README.md", "exec"), {"__name__": "readme"})
        printed = capsys.readouterr().out.splitlines()
        expected = re.findall(r"^print\(.*?\)(?:  # (.*))?$", code, re.MULTILINE)
        assert len(printed) == len(expected) == prints
        for line, comment in zip(printed, expected, strict=True):
            assert comment.partition(":")[0] in ("", line)
    assert (folder / "courier.polca").is_file()


def test_both_examples_are_one_model(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Their value, by hand: a move succeeds with chance p, so k moves weigh z^k = E[gamma^time].

    From cell c there are c moves, a `take`, nine moves and a `drop`: the steps cost 1 each and the
    last brings 20, so V = mean over c of -(1 - w)/(1 - gamma) + 20 w/gamma with w = gamma^2 z^(c+9).
    """
    gamma, p = 0.95, 0.9
    z = gamma * p / (1 - gamma * (1 - p))
    weights = [gamma**2 * z ** (c + 9) for c in range(10)]
    value = sum(-(1 - w) / (1 - gamma) + 20 * w / gamma for w in weights) / 10
    assert f"value of the hierarchical policy from the start: {value:.9g}" in README
    assert f"{value:.6f}, flat {value:.6f}" in README


def test_every_command_is_in_its_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    listed = set(re.findall(r"^    ([a-z]+)(?: |$)", capsys.readouterr().out, re.MULTILINE))
    assert {"domains", "plan"} <= listed
    assert set(re.findall(r"^\| `([a-z]+)", README, re.MULTILINE)) == listed


def test_its_picture_shows_every_layer() -> None:
    (picture,) = blocks("text")
    layers = {path.parent.name for path in (ROOT / "factored_polca").glob("*/__init__.py")}
    assert {layer for layer in layers if layer not in picture} == set()


def test_the_files_it_names_are_there() -> None:
    named = re.findall(r"\b((?:tests|factored_polca|domains)/[\w/]+\.\w+)", README)
    assert named
    for name in {*named, "CITATION.cff", "CONTRIBUTING.md", "CHANGELOG.md", "LICENSE"}:
        assert (ROOT / name).is_file(), name
