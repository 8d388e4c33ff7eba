"""The command `plan` where the state is not seen: what it prints, in numbers and for people."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factored_polca.cli import main
from factored_polca.diagrams import evaluate_states
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.hierarchy import Options, plan_pomdp
from factored_polca.hierarchy.parameters import unreduced_parameters
from factored_polca.library import load
from factored_polca.minimisation import unreduced

TIGER = 19.371368  # several solvers agree, to 5e-7


def planned(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert main(["plan", *arguments, "--json", "--quiet"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_the_root_s_value_is_measured_and_stands_beside_its_bounds(
    capsys: pytest.CaptureFixture[str],
) -> None:
    data = planned(capsys, "tiger", "--gap", "1e-6", "--trials", "1000", "--episodes", "2000")
    assert data["lower"] <= TIGER + 1e-6
    assert data["upper"] >= TIGER - 1e-6
    assert data["upper"] - data["lower"] <= 1e-6
    assert abs(data["value"] - TIGER) <= 4 * data["standard_error"] + data["truncation"]
    assert data["episodes"] == data["measured"]["flat"]["episodes"] == 2000
    assert data["flat_upper"] >= TIGER
    assert (data["tracker"], data["method"]) == ("blocks", "PolCA+")
    assert sum(data["action_counts"].values()) == 2000 * data["steps"]  # no episode ends


def test_each_task_has_bounds_observations_parameters_and_what_it_took(
    capsys: pytest.CaptureFixture[str],
) -> None:
    data = planned(capsys, "meds", "--episodes", "50")
    move, act = data["tasks"]
    assert (move["name"], act["name"]) == ("Move", "Act")
    # ClarifyTask is answered by one of four words; what follows a trip is noise, one word.
    assert move["observations"]["ClarifyTask"] == {"before": 4, "after": 4}
    assert move["observations"]["GoToKitchen"] == {"before": 1, "after": 1}
    for task in (move, act):
        assert task["lower"] <= task["upper"]
        assert task["corner_gap"] >= 0
        assert {"solver", "status", "guarantee", "vectors", "iterations", "ties", "seconds"} <= set(task)
        assert task["observes"] is None
    # By hand.  Move, three wishes: ClarifyTask 3 x 4 entries, the trips 3 x 3 each, and no reward is 0.
    assert move["parameters"] == {
        "none": 12 + 9 + 9 + 9,
        "polca": 3 + 9 + 9 + 9,
        "polca_plus": 12 + 9 + 9 + 9,
    }
    assert data["totals"]["parameters"]["none"] == move["parameters"]["none"] + act["parameters"]["none"]
    # The root is measured; Move has no task below, so that its bounds hold as they are.
    assert set(data["measured"]) == {"Act"}


def test_for_people_it_says_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "meds", "--episodes", "50", "--quiet"]) == 0
    printed = capsys.readouterr().out
    for words in (
        "as planned",
        "corner gap",
        "measured",
        "the hierarchical policy earns",
        "tracker: blocks",
    ):
        assert words in printed


def test_the_same_seed_gives_the_same_figures(capsys: pytest.CaptureFixture[str]) -> None:
    def figures(seed: str) -> dict[str, Any]:
        data = planned(capsys, "cheese_taxi", "--episodes", "50", "--seed", seed)
        tasks = [{k: v for k, v in t.items() if not k.endswith("seconds")} for t in data["tasks"]]
        return {"value": data["value"], "tasks": tasks, "counts": data["action_counts"]}

    assert figures("3") == figures("3")


def test_polca_may_be_run_where_the_state_is_not_seen(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    data = planned(capsys, "meds", "--polca", "-o", str(tmp_path / "meds.polca"))
    # Who sees the wish serves it at each step: 10 / (1 - 0.95).
    assert data["value"] == pytest.approx(200)
    assert main(["simulate", str(tmp_path / "meds.polca"), "--episodes", "300", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    # It never asks, and each guess is right with chance 1/3: (10 - 2 * 50) / 3 / (1 - 0.95).
    assert abs(found["mean"] + 600) <= 4 * found["standard_error"] + found["truncation"]
    assert found["action_counts"]["ClarifyTask"] == 0


def test_a_wrong_solver_and_a_wrong_gap_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "tiger", "--solver", "vi"]) == 2
    assert "there are auto" in capsys.readouterr().err
    assert main(["plan", "tiger", "--gap", "-1"]) == 2
    assert main(["plan", "taxi", "--solver", "sarsop"]) == 2
    assert "value iteration" in capsys.readouterr().err


def test_unreduced_parameters_are_those_of_the_listed_kernel() -> None:
    domain = load("part_painting", {})
    found = plan_pomdp(domain.model, domain.tasks, Options(trials=20))
    processes = [solved.reduction.process for solved in found.solved]
    counts = unreduced_parameters(found.symbolic, processes)
    assert counts is not None
    listed = unreduced(found.symbolic)
    pomdp: ArrayPOMDP = listed.pomdp
    root = found.solved[-1]
    names = [action.name for action in domain.model.actions]
    total = 0
    for action in root.task.actions:
        for s in range(pomdp.states):
            if pomdp.terminal[s]:
                continue
            if action in names:
                a = names.index(action)
            else:
                digits = listed.states[s : s + 1]
                policy = found.task(action).policy
                a = int(evaluate_states(policy, digits, found.symbolic.columns())[0])
            total += sum(int(np.count_nonzero(m[[s]].toarray())) for m in pomdp.kernel[a])
            total += int(pomdp.rewards[a, s] != 0)
    assert counts[-1] == total
