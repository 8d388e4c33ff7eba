"""RDDL on the command line: one file or two, in any case of letters, wherever a model is taken."""

from __future__ import annotations

import json
from fractions import Fraction as F
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pyRDDLGym")

from rddl_texts import BOX, LIFT, SERVERS, WALK

from factored_polca.cli import main
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.formats import rddl_process, read
from factored_polca.formats.files import parts


def split(text: str, folder: Path, names: tuple[str, str]) -> str:
    """The domain and the rest as two files; the argument that names both."""
    cut = text.index("non-fluents n")
    for name, part in zip(names, (text[:cut], text[cut:]), strict=True):
        (folder / name).write_text(part, encoding="utf-8")
    return "+".join(str(folder / name) for name in names)


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert main([*arguments, "--json"]) == 0, capsys.readouterr().err
    return dict(json.loads(capsys.readouterr().out))


def test_two_files_are_one_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "a.rddl+b"  # a plus sign in a folder's name does no harm
    folder.mkdir()
    both = split(SERVERS, folder, ("Domain.RDDL", "one.rddl"))
    (folder / "whole.Rddl").write_text(SERVERS, encoding="utf-8")
    assert read(both).model == read(folder / "whole.Rddl").model
    swapped = "+".join(reversed([str(part) for part in parts(both)]))
    assert read(swapped).model == read(both).model
    data = printed(capsys, "info", both)
    assert (data["states"], data["horizon"], data["discount"]) == (8, 3, "9/10")
    assert main(["check", both]) == 0
    assert capsys.readouterr().out == "Domain.RDDL+one.rddl: no fault found (8 states)\n"


def test_one_of_two_files_alone_says_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = split(SERVERS, tmp_path, ("d.rddl", "i.rddl"))
    for path, block in zip(parts(both), ("instance", "domain"), strict=True):
        assert main(["info", str(path)]) == 2
        error = capsys.readouterr().err
        assert error == (
            f"error: {path}: the text has no {block} block (name both files: DOMAIN.rddl+INSTANCE.rddl)\n"
        )
    (tmp_path / "i.rddl").unlink()
    assert main(["info", both]) == 2
    assert f"{tmp_path / 'i.rddl'}: there is no such file" in capsys.readouterr().err
    assert main(["info", str(tmp_path / "d.rddl"), "--set", "CRASH=1"]) == 2
    assert "RDDL has no parameters to set (CRASH)" in capsys.readouterr().err


def test_without_pyrddlgym_one_message_and_the_status_two(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "m.rddl").write_text(SERVERS, encoding="utf-8")
    monkeypatch.setattr(rddl_process.importlib.util, "find_spec", lambda name: None)
    assert main(["solve", str(tmp_path / "m.rddl")]) == 2
    assert capsys.readouterr().err == (
        f"error: {tmp_path / 'm.rddl'}: RDDL is parsed by pyRDDLGym, which is not installed "
        "(pip install 'factored-polca[rddl]')\n"
    )


def value(text: str, horizon: int, gamma: F) -> F:
    """The optimal value of the start over `horizon` steps, by backward induction over its arrays."""
    from factored_polca.formats.rddl import read_rddl_with_warnings

    mdp = enumerate_model(read_rddl_with_warnings([text])[0])
    values = [F(0)] * mdp.states
    for _ in range(horizon):
        values = [
            max(
                (
                    mdp.rewards[a][s] + gamma * sum(q * values[t] for t, q in mdp.rows[a][s].items())
                    for a in range(len(mdp.actions))
                    if mdp.applicable[a][s]
                ),
                default=F(0),
            )
            for s in range(mdp.states)
        ]
    return sum((q * v for q, v in zip(mdp.initial, values, strict=True)), F(0))


def test_the_horizon_is_solved_for_and_can_be_overridden(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = WALK.replace("horizon = 3; discount = 0.9;", "horizon = 5; discount = 1.0;")
    path = tmp_path / "walk.rddl"
    path.write_text(text, encoding="utf-8")
    data = printed(capsys, "solve", str(path))
    assert (data["horizon"], data["discount"]) == (5, "1")
    assert data["lower"] <= float(value(text, 5, F(1))) <= data["upper"]
    assert main(["plan", str(path)]) == 2
    assert "remove it and give a discount (plan --discount D)" in capsys.readouterr().err
    assert main(["plan", str(path), "--discount", "0.5", "--json"]) == 0
    caught = capsys.readouterr()
    assert (
        "walk.rddl: planned without end at discount 1/2, in place of the model's discount 1 over 5 steps"
        in " ".join(caught.err.split())
    )
    # from the start: -1, then with 3/4 at p2 one more -1 and the goal; else -1 for ever
    lost = F(-1) / (1 - F(1, 2))
    assert json.loads(caught.out)["value"] == pytest.approx(
        float(-1 + F(1, 2) * (F(3, 4) * -1 + F(1, 4) * lost)), abs=1e-9
    )


def test_a_partially_observed_horizon_is_solved_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "box.rddl"
    path.write_text(BOX.replace("horizon = 3;", "horizon = 2;"), encoding="utf-8")
    data = printed(capsys, "solve", str(path))
    assert (data["horizon"], data["observability"]) == (2, "partial")
    # It is empty at first.  Waiting twice is worth 0; emptying after a wait 0.9 (0.3 * 5 - 0.7 * 3) < 0;
    # shaking and, where it is heard (0.24 full, 0.14 not), emptying -0.5 + 0.9 (0.24 * 5 - 0.14 * 3) > 0.
    best = -F(1, 2) + F(9, 10) * (F(24, 100) * 5 - F(14, 100) * 3)
    assert data["lower"] - 1e-9 <= float(best) <= data["upper"] + 1e-9
    assert best > 0


def test_converting_keeps_the_model(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = split(LIFT, tmp_path, ("d.rddl", "i.rddl"))
    expected = enumerate_model(read(both).model)
    for name in ("lift.toml", "lift.spudd", "lift.pomdpx"):
        assert main(["convert", both, str(tmp_path / name), "-q"]) == 0
        capsys.readouterr()
        found = enumerate_model(read(tmp_path / name).model)
        assert (found.rows, found.rewards, found.initial) == (
            expected.rows,
            expected.rewards,
            expected.initial,
        )
    assert main(["convert", both, str(tmp_path / "out.rddl")]) == 2
    assert "RDDL is read, not written" in capsys.readouterr().err


def test_minimising_needs_neither_horizon_nor_discount(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "life.rddl"
    from rddl_texts import LIFE

    path.write_text(LIFE, encoding="utf-8")
    data = printed(capsys, "minimise", str(path), "--actions", "noop")
    # with three or four alive all live on or are born, with fewer none: only how many live matters
    assert (data["states"], data["blocks"]) == (16, 5)
    assert printed(capsys, "minimise", str(path), "--actions", "noop,set(c)")["blocks"] == 5
