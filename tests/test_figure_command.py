"""The command `figure`: tables, JSON, drawings, and what it refuses."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factored_polca.cli import main
from factored_polca.studies.drawing import draw_parameters, draw_perturbations, draw_rewards
from factored_polca.studies.parameters import ParameterStudy, TaskParameters
from factored_polca.studies.perturbations import PerturbationStudy, PerturbedRun
from factored_polca.studies.rewards import Difference, Earned, RewardStudy

PNG = b"\x89PNG\r\n\x1a\n"
QUICK = ["--episodes", "10", "--steps", "10", "--trials", "5", "--flat-trials", "5"]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is the current one."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("COLUMNS", raising=False)
    return tmp_path


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str) -> Any:
    assert main(["figure", *arguments, "--json"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("\n") == 1
    return json.loads(printed)


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The message with which a command exits with the status 2."""
    assert main(["figure", *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    return " ".join(printed.err.split())


# -- tables and JSON -------------------------------------------------------------------------------


def test_figure_4a_prints_its_table_and_draws(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["figure", "4a", "meds", "-o", "a.png", "-q"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    # By hand: CheckMeds 3 rows of 3 and 3 rewards, ClarifyTask 3 rows of 4 and 3, Move asks for who wants
    # his medicine, 4 and 1, and serves the two others, 6 and 2.
    assert ["Act", str(12 + 15 + 13)] == next(line[:2] for line in lines if line[:1] == ["Act"])
    assert (folder / "a.png").read_bytes().startswith(PNG)
    assert [path.name for path in folder.iterdir()] == ["a.png"]


def test_figure_4a_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    data = run_json(capsys, "4a", "meds", "--set", "accuracy=1")
    assert {"figure", "model", "states", "tasks", "totals", "notes", "seconds"} <= set(data)
    for reading in ("none", "polca", "polca_plus"):
        assert data["totals"][reading] == sum(task[reading] for task in data["tasks"])


def test_figure_4b_prints_rewards_differences_and_actions(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["figure", "4b", "meds", *QUICK, "-o", "b.PNG"]) == 0
    printed = capsys.readouterr().out
    for part in ("PolCA+ - PolCA", "PolCA - QMDP", "SARSOP - PolCA+", "reward in 10 steps", "ClarifyTask"):
        assert part in printed
    assert (folder / "b.PNG").read_bytes().startswith(PNG)


def test_figure_4b_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    data = run_json(capsys, "4b", "meds", *QUICK)
    assert [one["name"] for one in data["policies"]] == ["PolCA+", "PolCA", "QMDP", "SARSOP"]
    for one in data["policies"]:
        assert sum(one["action_counts"].values()) == pytest.approx(10)
        assert len(one["cumulative"]) == len(one["cumulative_error"]) == data["steps"] == 10
        assert one["cumulative"][-1] == one["cumulative_end"]
    known = [one["name"] for one in data["policies"] if one["lower"] is not None]
    assert known == ["QMDP", "SARSOP"]  # the only ones with bounds on the model's optimum
    means = {one["name"]: one["mean"] for one in data["policies"]}
    assert data["order_holds"] == (means["PolCA+"] > means["PolCA"] > means["QMDP"])


def test_json_may_be_asked_for_before_the_figures_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["figure", "--json", "4a", "meds"]) == 0
    assert json.loads(capsys.readouterr().out)["figure"] == "4a"


def test_one_episode_has_no_errors_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    data = run_json(capsys, "4b", "meds", *QUICK, "--episodes", "1")
    assert data["policies"][0]["standard_error"] is None
    assert not data["order_is_clear"]


def test_perturbed_numbers_are_compared(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    quick = ["--episodes", "5", "--steps", "5", "--trials", "1"]
    assert main(["figure", "4b", "--perturbations", "2", *quick, "-o", "p.png"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "of 2 (5 episodes each)" in printed
    assert (folder / "p.png").read_bytes().startswith(PNG)
    data = run_json(
        capsys, "4b", "nursebot", "--perturbations", "1", "--perturbation", "1/10", *quick
    )  # fmt: skip
    assert data["perturbation"] == 0.1
    assert [run["seed"] for run in data["runs"]] == [1]
    assert 0 <= data["clear"] <= data["held"] <= data["perturbations"] == 1


def test_table_1_prints_twenty_rows_and_the_count(capsys: pytest.CaptureFixture[str]) -> None:
    data = run_json(capsys, "table1", "--trials", "1", "--flat-trials", "2")
    assert [row["row"] for row in data["rows"]] == list(range(1, 21))
    assert data["equal"] == sum(row["equal"] for row in data["rows"])
    assert data["goals"] == 4
    assert main(["figure", "table1", "--trials", "1", "--flat-trials", "2"]) == 0
    printed = capsys.readouterr().out
    assert f"{data['equal']} of 20 actions equal" in printed
    assert f"rows with reward 50 {data['goals_equal']} of 4" in printed
    for row in data["rows"]:
        assert (f"\n{row['row']}: believes robot_location=" in printed) == (not row["equal"])


# -- drawings --------------------------------------------------------------------------------------


def axes() -> Any:
    from matplotlib.figure import Figure

    return Figure().add_subplot()


def test_bars_stand_for_the_counts_that_are_known() -> None:
    tasks = (TaskParameters("low", 400, 20, 50), TaskParameters("top", 900, None, 70))
    ax = axes()
    assert draw_parameters(ParameterStudy("m", 10, tasks, (), 0.0), ax) is ax
    heights = sorted(patch.get_height() for patch in ax.patches)
    assert heights == [20, 50, 70, 120, 400, 900, 1300]  # all of PolCA is not known
    assert ax.get_yscale() == "log"
    assert [label.get_text() for label in ax.get_xticklabels()] == ["low", "top", "all"]


def test_curves_and_their_bands_are_drawn_and_named() -> None:
    def earned(name: str, slope: float) -> Earned:
        curve = slope * np.arange(1.0, 6.0)
        return Earned(
            name, np.zeros(3), 0.0, 0.0, curve, np.full(5, 0.5), np.zeros(2), 0.0, 0.0, None, None, None
        )

    both = (earned("PolCA+", 2.0), earned("QMDP", 2.01))
    ax = axes()
    assert draw_rewards(RewardStudy("m", 0.9, 3, 5, 0, ("a", "b"), both, (), 4), ax) is ax
    assert [line.get_label() for line in ax.lines[:2]] == ["PolCA+", "QMDP"]
    assert ax.lines[0].get_ydata().tolist() == [2, 4, 6, 8, 10]
    assert len(ax.collections) == 2
    names = {text.get_text(): text.xy[1] for text in ax.texts}
    low, high = ax.get_ylim()
    assert names["QMDP"] - names["PolCA+"] > 0.05 * (high - low)  # the names do not overlap


def test_differences_are_drawn_for_each_seed() -> None:
    apart = (Difference("PolCA+", "PolCA", 5.0, 1.0), Difference("PolCA", "QMDP", -1.0, 2.0))
    runs = tuple(PerturbedRun(n, (3.0, 2.0, 2.5), (1.0,) * 3, (3.0, 2.0, 1.0), apart) for n in (1, 2))
    study = PerturbationStudy("m", 0.2, 10, 5, runs)  # type: ignore[arg-type]
    ax = axes()
    assert draw_perturbations(study, ax) is ax
    assert [c.get_label() for c in ax.containers] == ["PolCA+ − PolCA", "PolCA − QMDP"]
    assert (study.held, study.cumulative_held, study.clear, study.refuted) == (0, 2, 0, 0)


def test_a_drawing_appears_whole_or_not_at_all(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import os

    (folder / "a.png").write_text("before")

    def fails(*_: Any) -> None:
        raise OSError("the disk is full")

    monkeypatch.setattr(os, "replace", fails)
    assert "the disk is full" in refused(capsys, "4a", "meds", "-q", "-o", "a.png")
    assert (folder / "a.png").read_text() == "before"
    assert [path.name for path in folder.iterdir()] == ["a.png"]


def test_equal_studies_make_equal_files(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("one.png", "two.png"):
        assert main(["figure", "4a", "meds", "-q", "-o", name]) == 0
    assert (folder / "one.png").read_bytes() == (folder / "two.png").read_bytes()


# -- what is refused -------------------------------------------------------------------------------


def test_without_matplotlib_it_is_said_how_to_get_it(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "pip install 'factored-polca[viz]'" in refused(capsys, "4a", "meds", "-o", "a.png")
    assert list(folder.iterdir()) == []
    assert main(["figure", "4a", "meds", "-q"]) == 0  # tables need none


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["4a", "meds", "-o", "a.svg"], "a file that ends in .png"),
        (["4a", "meds", "-o", "nowhere/a.png"], "there is no folder"),
        (["4a", "taxi"], "fully observed"),
        (["4b", "taxi"], "fully observed"),
        (["4a", "nosuch"], "no such file and no shipped domain"),
        (["4b", "meds", "--perturbations", "2"], "nursebot has"),
        (["4b", "x.toml", "--perturbations", "2"], "takes a shipped domain"),
        (["4b", "--perturbations", "2", "--set", "perturbation=1/10"], "is set for each run"),
        (["4b", "meds", "--perturbation", "0.1"], "goes with --perturbations"),
        (["4b", "--perturbations", "1", "--perturbation", "0.9"], "from 0 to 1/2"),
        (["4b", "meds", "--episodes", "0"], "at least 1"),
        (["table1", "--set", "patients=2"], "no action 'gotoPatientRoom'"),
        (["5a"], "invalid choice"),
        ([], "required"),
    ],
)
def test_wrong_use_is_refused_with_what_would_be_right(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said in refused(capsys, *arguments)
