"""Every pair of formats: `convert` writes one from the other, `info` tells of each, in any case."""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path

import pytest

from factored_polca.cli import main
from factored_polca.formats import FORMATS, read, write
from factored_polca.models import Action, Feature, Model, Observation

EXTENSIONS = sorted(set(FORMATS) - {".prism", ".nm", ".pm", ".rddl"})  # those need extras


def lamp(observability: str) -> Model:
    """Two states: an MDP, or with a channel a POMDP; every format has all of it."""
    lit, light = Feature("lit", ["off", "on"]), Observation("light", ["dark", "bright"])
    senses = {light: "{bright: 0.75, dark: 0.25} if lit' == on else dark"}
    hidden = observability == "partial"
    return Model(
        "lamp",
        [lit],
        [
            Action("toggle", {lit: "{on: 0.5, off: 0.5}"}, rewards=-1, senses=senses if hidden else {}),
            Action("wait", senses=senses if hidden else {}),
        ],
        rewards="2 if lit == on else 0",
        initial={lit: "{off: 0.5, on: 0.5}"},
        discount="0.9",
        observability=observability,
        observations=[light] if hidden else [],
    )


def spelled(extension: str, count: int) -> str:
    """`extension` in small, large or mixed letters."""
    return (extension, extension.upper(), extension[:2].upper() + extension[2:])[count % 3]


PAIRS = [
    pytest.param(old, new, ("full", "partial")[count % 2], count, id=f"{old}-{new}")
    for count, (old, new) in enumerate(product(EXTENSIONS, EXTENSIONS))
    if not (new == ".mdp" and count % 2)
]


@pytest.mark.parametrize(("old", "new", "observability", "count"), PAIRS)
def test_each_format_is_written_from_each(
    old: str,
    new: str,
    observability: str,
    count: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    given, made = f"given{spelled(old, count)}", f"made{spelled(new, count + 1)}"
    write(lamp(observability), given)
    assert main(["convert", given, made, "--quiet"]) == 0
    for name in (given, made):
        capsys.readouterr()
        assert main(["info", name, "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert told["states"] == 2
        assert told["observability"] == observability
        assert told["discount"] == "9/10"
    model = read(made).model
    assert [action.name for action in model.actions] == ["toggle", "wait"]
    assert len(model.observations) == (observability == "partial")
