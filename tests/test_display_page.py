"""docs/explore.md is true: its code is run, its outputs compared, its pictures made again."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

import factored_polca as fp
from factored_polca.cli import main
from factored_polca.hierarchy.policy_file import FlatPolicy
from factored_polca.minimisation.flat_model import flat_model

DOCS = Path(__file__).resolve().parent.parent / "docs"
PAGE = (DOCS / "explore.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def test_the_python_examples_print_what_their_comments_say(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("matplotlib")
    (output,) = blocks("output")
    for code in blocks("python"):
        exec(compile(code, "explore.md", "exec"), {"__name__": "explore"})
        printed = capsys.readouterr().out
        comments = re.findall(r"^print\(.*\)  # (.*)$", code, re.MULTILINE)
        assert printed.strip() == ("\n".join(comments) if comments else output.strip())


def test_the_commands_print_what_it_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (block,) = blocks("console")
    for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
        command, _, expected = part.partition("\n")
        program, *arguments = shlex.split(command)
        assert program == "factored-polca"
        assert main(arguments) == 0
        printed = capsys.readouterr().out
        if expected.strip():
            assert printed.strip() == expected.strip()


def pictures() -> dict[str, str]:
    taxi = fp.load_domain("taxi")
    found = fp.plan(taxi.model, taxi.tasks)
    flat = flat_model(fp.compile_model(fp.load_domain("tiger").model))
    solution = fp.solve_pomdp(flat.pomdp, demand=fp.Demand(gap=1e-3))
    return {
        "taxi_plan": found.to_svg(),
        "taxi_get": found.task("Get").to_svg(),
        "tiger_policy": FlatPolicy(flat, solution.policy).to_svg(),
    }


def test_its_pictures_are_those_of_today() -> None:
    for name, picture in pictures().items():
        stored = (DOCS / "explore" / f"{name}.svg").read_text(encoding="utf-8")
        assert f"explore/{name}.svg" in PAGE
        texts = [re.findall(r"<text[^>]*>([^<]*)</text>", one) for one in (stored, picture)]
        assert sorted(texts[0]) == sorted(texts[1]), name
