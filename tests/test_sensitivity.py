"""The value as a function of parameters: held against solving anew, closed forms, and published values."""

from __future__ import annotations

import csv
import io
import json
import time
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from parametric_models import parametric_mdp

from factored_polca import library
from factored_polca.cli import main
from factored_polca.minimisation import flat_process, reduce
from factored_polca.models import Action, Model, Parameter, boolean, conditional, lottery
from factored_polca.parametric import parametric_flat_process, reduce_parametric
from factored_polca.parametric.sensitivity import grid, sensitivity, spaced
from factored_polca.solvers.choose import solve_mdp
from factored_polca.symbolic import compile_model

LAMP = """
# lamp.toml
discount = 0.9
reward = "1 if on else 0"
[parameters]
p = 0.2
q = 0.5
[features]
on = "boolean"
[initial]
on = true
[actions.wait.effects]
on = "bernoulli(1 - p) if on else false"
[actions.switch]
reward = "-1/2"
[actions.switch.effects]
on = "bernoulli(q)"
"""


def lamp_value(p: float, q: float) -> float:
    """The optimal value of the lamp when it is on, by the two policies worth considering.

    On: wait.  Off: for ever dark, worth 0, or switch: v0 = -1/2 + 0.9 (q v1 + (1 - q) v0).
    """
    g = 0.9
    dark = 1 / (1 - g * (1 - p))
    # v1 = 1 + g ((1 - p) v1 + p v0), v0 = -1/2 + g (q v1 + (1 - q) v0)
    matrix = np.array([[1 - g * (1 - p), -g * p], [-g * q, 1 - g * (1 - q)]])
    v1, v0 = np.linalg.solve(matrix, np.array([1.0, -0.5]))
    # on, too, one may switch; for q <= 1 - p that is never better
    assert q <= 1 - p
    return max(dark, float(v1) if v0 > 0 else dark)


@pytest.fixture
def lamp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "lamp.toml"
    path.write_text(LAMP, encoding="utf-8")
    return path


@pytest.mark.parametrize("seed", range(20))
def test_each_value_is_that_of_the_model_at_the_setting(seed: int) -> None:
    model = parametric_mdp(seed)
    quotient = reduce_parametric(parametric_flat_process(model, ["p", "q"]))
    values = [Fraction(k, 10) for k in (0, 1, 3, 5, 8, 10)]
    found = sensitivity(quotient, grid({"p": values, "q": values[1:3]}))
    assert [point.setting["p"] for point in found.points[::2]] == values
    for point in found.points:
        instance = model.with_parameters({name: point.setting[name] for name in ("p", "q")})
        small = reduce(flat_process(compile_model(instance)))
        solution = solve_mdp(small.mdp)
        start = small.project_initial()
        expected = float(start @ np.where(start > 0, solution.values, 0.0))
        if np.isneginf(expected):
            assert np.isneginf(point.value)
        else:
            scale = max(1.0, abs(expected))
            assert point.value == pytest.approx(expected, rel=1e-9, abs=1e-9 * scale)
            assert point.lower - 1e-9 * scale <= expected <= point.upper + 1e-9 * scale


def test_policies_are_told_apart_and_followed() -> None:
    x = boolean("x")
    p = Parameter("p")
    model = Model(
        "m", [x],
        [Action("risk", {x: lottery({True: p, False: 1 - p})}), Action("safe", rewards=Fraction(1, 2))],
        rewards=[conditional(x, 1, 0)], parameters={"p": "1/3"},
    )  # fmt: skip
    quotient = reduce_parametric(parametric_flat_process(model))
    found = sensitivity(quotient, grid({"p": spaced(Fraction(0), Fraction(1), 1001)}))
    changes = [k for k in range(1000) if found.points[k].policy != found.points[k + 1].policy]
    assert len(found.policies) == len({point.policy for point in found.points})
    assert 1 <= len(changes) <= 4
    # all but the two ends, where a probability vanishes, and the first inside start from the last policy
    assert sum(point.warm for point in found.points) == 998
    instantiate, solve = found.mean_microseconds()
    assert instantiate > 0
    assert solve > 0


def test_the_tiger_at_known_accuracies() -> None:
    quotient = reduce_parametric(parametric_flat_process(library.load("tiger", keep=["accuracy"]).model))
    found = sensitivity(quotient, [{"accuracy": Fraction(text)} for text in ("1/2", "0.85", "1", "3/2")])
    half, known, sure, wrong = found.points
    # listening for ever costs 1 a step: -1 / (1 - 0.95), and a guess is worse: (10 - 100) / 2 a time
    assert half.lower - 1e-9 <= -20 <= half.upper + 1e-9
    # several solvers agree on 19.371368, as the domain says
    assert known.lower - 1e-6 <= 19.371368 <= known.upper + 1e-6
    # listen, open, for ever: (-1 + 0.95 * 10) / (1 - 0.95 ** 2)
    assert sure.lower - 1e-6 <= 8.5 / (1 - 0.95**2) <= sure.upper + 1e-6
    assert max(half.upper - half.lower, known.upper - known.lower) <= 1e-3
    assert "0 <= accuracy <= 1 does not hold" in wrong.refused
    assert np.isnan(wrong.value)
    assert found.admissible == found.points[:3]


def test_time_and_interruption_keep_what_was_done() -> None:
    quotient = reduce_parametric(parametric_flat_process(parametric_mdp(3), ["p"]))
    settings = grid({"p": spaced(Fraction(1, 10), Fraction(9, 10), 9)})
    late = sensitivity(quotient, settings, deadline=time.monotonic() - 1)
    assert (late.stopped, late.points) == ("time limit", ())

    def stop(done: int, _: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    broken = sensitivity(quotient, settings, progress=stop)
    assert broken.stopped == "interrupted"
    assert len(broken.points) == 3
    whole = sensitivity(quotient, settings)
    assert whole.stopped == ""
    assert whole.values[:3].tolist() == pytest.approx(broken.values.tolist())


# -- commands ----------------------------------------------------------------------------------


def run(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> dict:
    assert main([*arguments, "--json"]) == status
    return json.loads(capsys.readouterr().out)


def test_minimise_keeps_parameters(lamp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = run(capsys, "minimise", str(lamp), "--keep-parameters")
    assert data["blocks"] == 2
    assert data["parameters"] == {"p": "1/5", "q": "1/2"}
    assert sorted(data["region"]) == ["0 <= p <= 1", "0 <= q <= 1"]
    one = run(capsys, "minimise", str(lamp), "--keep-parameters=q")
    assert one["region"] == ["0 <= q <= 1"]
    assert main(["minimise", str(lamp), "--keep-parameters", "-q"]) == 0
    printed = capsys.readouterr().out
    assert "0 <= p <= 1; 0 <= q <= 1" in printed
    assert "symbols" in printed


def test_minimise_says_what_it_can_not_keep(lamp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["minimise", str(lamp), "--keep-parameters=r"]) == 2
    assert "the model's parameters are p, q" in capsys.readouterr().err
    assert main(["minimise", str(lamp), "--keep-parameters", "--certify"]) == 2
    assert "--certify" in capsys.readouterr().err
    lamp.write_text(LAMP.replace("bernoulli(q)", "bernoulli(min(q, 1))"), encoding="utf-8")
    assert main(["minimise", str(lamp), "--keep-parameters"]) == 2
    error = capsys.readouterr().err
    assert "lamp.toml:17" in error
    assert "'min' of q" in error
    assert main(["minimise", str(lamp), "--keep-parameters=p"]) == 0


def test_the_value_of_the_lamp_is_its_closed_form(lamp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = run(capsys, "sensitivity", str(lamp), "--set-range", "p=0..1/2:26", "--set-range", "q=0..1/2:6")
    assert data["settings"] == data["solved"] == 156
    assert data["blocks"] == 2
    for point in data["points"]:
        assert point["value"] == pytest.approx(lamp_value(point["p"], point["q"]), rel=1e-9)
        assert point["lower"] <= point["value"] <= point["upper"]


def test_settings_that_are_not_admissible_have_no_value(
    lamp: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = run(capsys, "sensitivity", str(lamp), "--set-range", "p=0.8..1.2:5")
    assert (data["solved"], data["refused"]) == (3, 2)
    assert [point["value"] is None for point in data["points"]] == [False, False, False, True, True]
    assert data["points"][-1]["refused"] == "0 <= p <= 1 does not hold"
    assert main(["sensitivity", str(lamp), "--set-range", "p=0.8..1.2:5"]) == 0
    printed = capsys.readouterr()
    assert "3 solved of 5, 2 not admissible" in printed.out
    assert "not admissible where 0 <= p <= 1 does not hold" in printed.err


def test_points_are_listed_and_drawn(lamp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, two = "p=0..1/2:11", "q=0..1/2:3"
    run(capsys, "sensitivity", str(lamp), "--set-range", one, "-o", "out.csv")
    rows = list(csv.DictReader(io.StringIO(Path("out.csv").read_text(encoding="utf-8"))))
    assert list(rows[0]) == ["p", "value", "lower", "upper", "policy", "refused"]
    assert len(rows) == 11
    assert float(rows[4]["value"]) == pytest.approx(lamp_value(0.2, 0.5), rel=1e-9)
    pytest.importorskip("matplotlib")
    for ranges, name in (([one], "curve.png"), ([one, two], "map.svg")):
        given = [part for text in ranges for part in ("--set-range", text)]
        run(capsys, "sensitivity", str(lamp), *given, "-o", name)
        start = Path(name).read_bytes()[:8]
        assert start.startswith(b"\x89PNG" if name.endswith("png") else b"<?xml")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set-range", "p=0.5"], "no range such as"),
        (["--set-range", "p=1..0"], "LOW must be below HIGH"),
        (["--set-range", "p=0..1:1"], "COUNT at least 2"),
        (["--set-range", "p=0..x"], "no range such as"),
        (["--set-range", "p=0..1/0"], "no range such as"),
        (["--set-range", "=0..1"], "no range such as"),
        (["--set-range", "p=0..1", "--set-range", "p=0..1"], "given twice for p"),
        (["--set-range", "p=0..1:2000", "--set-range", "q=0..1:2000"], "at most 1,000,000"),
        (["--set-range", "r=0..1"], "no parameter 'r'"),
        (["--set-range", "p=0..1", "-o", "a.pdf"], "the extension must be one of .png, .svg, .csv"),
        (["--set-range", "p=0..1", "-o", "nowhere/a.csv"], "nowhere"),
        ([], "--set-range"),
    ],
)
def test_bad_arguments_are_named(
    lamp: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(["sensitivity", str(lamp), *arguments]) == 2
    assert message in capsys.readouterr().err


def test_a_horizon_is_refused(lamp: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lamp.write_text("horizon = 5\n" + LAMP, encoding="utf-8")
    assert main(["sensitivity", str(lamp), "--set-range", "p=0..1"]) == 2
    assert "horizon of 5 steps" in capsys.readouterr().err


def test_limits_end_in_a_clear_error(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["sensitivity", "linear", "--set", "size=200", "--set-range", "success=0.1..0.9:3"]
    assert main([*arguments, "--memory", "1MB"]) == 3
    assert "limit reached" in capsys.readouterr().err
    assert main([*arguments, "--time", "0.001"]) == 3
    assert "limit reached" in capsys.readouterr().err


def test_a_domain_is_swept(capsys: pytest.CaptureFixture[str]) -> None:
    data = run(capsys, "sensitivity", "linear", "--set", "size=6", "--set-range", "success=0.1..1:10")
    for point in data["points"]:
        main(["solve", "linear", "--set", "size=6", "--set", f"success={point['success']}", "--json"])
        assert point["value"] == pytest.approx(json.loads(capsys.readouterr().out)["value"], rel=1e-7)
