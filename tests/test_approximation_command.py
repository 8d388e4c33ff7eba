"""--epsilon and --loss: what commands print and keep of merged states, the search, plan files, the plot."""

from __future__ import annotations

import json
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from belief_plans import ByHand, corridor, corridor_tasks

from factored_polca.approximation.search import LADDER, Trial, candidates, largest_within
from factored_polca.cli import main
from factored_polca.control.belief_controller import BeliefController, plan_tracker
from factored_polca.diagrams import evaluate_states
from factored_polca.hierarchy import Options, plan_mdp, plan_pomdp
from factored_polca.hierarchy.executable import executable
from factored_polca.hierarchy.loss_search import plan_within_loss
from factored_polca.hierarchy.plan_file import load_plan, save_plan
from factored_polca.hierarchy.pomdp_executable import executable_pomdp
from factored_polca.hierarchy.pomdp_plan_file import load_pomdp_plan, save_pomdp_plan
from factored_polca.hierarchy.pomdp_report import pomdp_plan_report
from factored_polca.hierarchy.report import plan_report
from factored_polca.hierarchy.trade_off import TradeOff, trade_off
from factored_polca.library import load
from factored_polca.models import ModelError
from factored_polca.symbolic import compile_model


def printed(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert main([*arguments, "--json", "--quiet"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


# -- the search ------------------------------------------------------------------------------------


@pytest.mark.parametrize("good", range(6))
def test_the_search_finds_the_largest_number_that_is_good_enough(good: int) -> None:
    numbers = [Fraction(n, 10) for n in range(5)]
    found, tried = largest_within(numbers, 1.0, lambda e: Trial(e, 1, 0.5 if e * 10 < good else 2.0))
    assert (None if found is None else found.epsilon) == (numbers[good - 1] if good else None)
    assert len(tried) <= 3  # bisection of five
    assert [trial.epsilon for trial in tried] == sorted(trial.epsilon for trial in tried)


def test_where_the_state_is_not_seen_only_distances_of_rows_matter() -> None:
    tiger = compile_model(load("tiger").model)
    # the tiger is behind either door once one was opened; it is heard rightly with 0.85
    expected = {0, Fraction(1, 2), Fraction(15, 100), Fraction(70, 100), Fraction(35, 100)}
    assert expected <= set(candidates(tiger, seen=False))
    assert candidates(tiger, seen=True) == [0, *LADDER]
    assert list(LADDER) == sorted(LADDER)
    assert (LADDER[0], LADDER[-1]) == (Fraction(1, 10_000), Fraction(7, 10))


def test_no_task_of_the_plan_that_is_found_loses_more_than_allowed() -> None:
    taxi = load("taxi", {"size": "3", "slip": "true"})
    found, tried = plan_within_loss(taxi.model, 0.05, options=Options(flat_block_limit=None))
    chosen = {one.approximation.epsilon for one in found.solved if one.approximation is not None}
    assert len(chosen) == 1
    (epsilon,) = chosen
    assert max(one.approximation.loss for one in found.solved if one.approximation is not None) <= 0.05
    assert epsilon == max(trial.epsilon for trial in tried if trial.loss <= 0.05)
    assert any(trial.loss > 0.05 for trial in tried)


def test_a_loss_that_nothing_keeps_is_refused() -> None:
    tiger = load("tiger")
    with pytest.raises(ModelError, match="exact abstraction bounds the tasks' losses by"):
        plan_within_loss(tiger.model, 1e-9, tiger.tasks, Options(gap=1.0))


# -- commands --------------------------------------------------------------------------------------


def test_plan_names_epsilon_bounds_and_measured_losses(capsys: pytest.CaptureFixture[str]) -> None:
    data = printed(capsys, "plan", "taxi", "--set", "slip=true", "--epsilon", "1/20")
    assert data["merge_within"] == "0.05"
    exact = (
        0.569467784  # the optimum of slippery Taxi, by exact abstraction and by enumeration of its states
    )
    certain = data["certified"]
    assert certain["polled_lower"] <= data["value"] <= certain["polled_upper"]
    assert exact <= certain["optimum_upper"] + 1e-9
    assert certain["loss_bound"] >= data["flat_value"] - data["value"]
    assert data["flat_value"] == pytest.approx(exact, abs=1e-8)
    for task in data["tasks"]:
        found = task["approximation"]
        assert found["epsilon"] == 0.05
        assert found["measured_loss"] <= found["loss_bound"] + 1e-9
        assert found["lower"] <= found["upper"] <= found["optimum_upper"] + 1e-9
    assert "merged" in data["guarantee"]
    assert main(["plan", "taxi", "--set", "slip=true", "--epsilon", "0.05", "--no-flat", "--quiet"]) == 0
    text = capsys.readouterr().out
    assert "loses at most" in text
    assert "states within 0.05 merged" in text


def test_minimise_tells_what_planning_on_the_blocks_loses(capsys: pytest.CaptureFixture[str]) -> None:
    exact = printed(capsys, "minimise", "taxi", "--set", "size=3")
    data = printed(capsys, "minimise", "taxi", "--set", "size=3", "--epsilon", "0.05")
    assert data["blocks"] < exact["blocks"]
    assert data["policy_lower"] <= data["optimum_upper"]
    assert 0 <= data["loss_bound"] <= data["optimum_upper"] - data["policy_lower"] + 1e-9
    found = printed(capsys, "minimise", "taxi", "--set", "size=3", "--loss", "1")
    assert found["loss_bound"] <= 1
    assert found["epsilon"] == max(one["epsilon"] for one in found["tried"] if one["loss_bound"] <= 1)
    partial = printed(capsys, "minimise", "tiger", "--epsilon", "0.1")
    assert (partial["policy_lower"], partial["loss_bound"]) == (None, 0)  # no row of Tiger is that near
    assert main(["minimise", "taxi", "--epsilon", "0.02", "--quiet"]) == 0
    assert "planning on them loses at most" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["plan", "taxi", "--epsilon", "1"], "from 0 to below 1"),
        (["plan", "taxi", "--epsilon", "x"], "from 0 to below 1"),
        (["plan", "taxi", "--epsilon", "0.1", "--loss", "1"], "not allowed with"),
        (["plan", "taxi", "--loss", "-1"], "not a positive number"),
        (["plan", "taxi", "--epsilon", "0.1", "--interchangeable"], "by name"),
        (["minimise", "taxi", "--epsilon", "0.1", "--certify"], "by name"),
        (["minimise", "taxi", "--set", "discount=1", "--epsilon", "0.1"], "discount 1"),
        (["plan", "taxi", "--set", "discount=1", "--loss", "1"], "discount 1"),
    ],
)
def test_what_makes_no_sense_is_refused(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with suppress(SystemExit):  # argparse's
        assert main(arguments) == 2
    assert said in " ".join(capsys.readouterr().err.split())


def test_limits_end_in_their_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "taxi", "--epsilon", "0.05", "--time", "0.01", "--quiet"]) == 3
    assert main(["minimise", "expon", "--set", "size=30", "--epsilon", "0.0001", "--time", "1", "-q"]) == 3
    assert "limit" in capsys.readouterr().err


# -- plan files ------------------------------------------------------------------------------------


def test_a_plan_file_keeps_what_is_certain_and_acts_alike(tmp_path: Path) -> None:
    taxi = load("taxi", {"slip": "true"})
    found = plan_mdp(taxi.model, taxi.tasks, Options(merge_within="1/30", flat_block_limit=None))
    report = plan_report(found)
    save_plan(executable(found, report), tmp_path / "taxi.plan")
    again = load_plan(tmp_path / "taxi.plan")
    assert again.report["certified"] == report["certified"]
    assert again.report["merge_within"] == "1/30"
    sizes = [len(feature.values) for feature in taxi.model.features]
    states = np.array(list(np.ndindex(*sizes)), dtype=np.int32)
    one, other = (
        evaluate_states(p, states, s.columns())
        for p, s in ((found.root.policy, found.symbolic), (again.policy, again.symbolic))
    )
    assert (one == other).all()


def test_a_belief_plan_tracks_with_the_model_itself_and_keeps_its_merged_quotients(tmp_path: Path) -> None:
    nursebot = load("nursebot")
    found = plan_pomdp(
        nursebot.model, nursebot.tasks, Options(merge_within="0.06", flat_block_limit=None, trials=5)
    )
    fresh = executable_pomdp(found, pomdp_plan_report(found))
    save_pomdp_plan(fresh, tmp_path / "nurse.plan")
    again = load_pomdp_plan(tmp_path / "nurse.plan")
    assert again.report["merge_within"] == "0.06"
    for name in ("Remind", "Act"):
        one, other = fresh.quotient(name).pomdp, again.quotient(name).pomdp
        assert (one.rewards == other.rewards).all()
        for rows, others in zip(one.kernel, other.kernel, strict=True):
            assert all(abs(a - b).max() <= 1e-15 for a, b in zip(rows, others, strict=True))
    assert found.task("Act").reduction.process.symbolic.actions != found.symbolic.actions
    assert all(partition.symbolic is found.symbolic for partition in fresh.partitions)


def test_polling_a_merged_plan_follows_the_beliefs_of_the_model_itself() -> None:
    found = plan_pomdp(
        corridor(), corridor_tasks(), Options(merge_within="0.1", flat_block_limit=None, trials=20)
    )
    plan = executable_pomdp(found, pomdp_plan_report(found))
    by_hand = ByHand(plan)  # by enumeration of the model
    chosen = plan_tracker(plan).tracker
    controller, belief, known = BeliefController(plan), chosen.start({}), by_hand.initial
    for number in range(12):
        decision = controller.poll(belief)
        assert decision.number == by_hand.action(known)
        shown = number % 3 if decision.action == "look" else 0
        seen = {"glimmer": ["dark", "bright", "dark"][shown]} if decision.action == "look" else {}
        belief = belief.after(decision.number, seen)
        (o,) = [
            o
            for o, values in enumerate(by_hand.exact.observations)
            if values == (seen.get("glimmer", "none"),)
        ]
        known = known @ by_hand.kernel[decision.number, o]
        known = known / known.sum()


# -- the plot --------------------------------------------------------------------------------------


def test_fewer_blocks_are_bought_with_a_loss_that_the_table_and_the_plot_show() -> None:
    coffee = load("coffee")
    points = trade_off(coffee.model, coffee.tasks, ["0.01", "0.05"])
    assert points[0].blocks > points[1].blocks
    for point in points:
        assert point.loss is not None
        assert point.measured is not None
        assert point.measured <= point.loss + 1e-9
        assert point.root_loss <= point.task_loss
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    from matplotlib import pyplot

    from factored_polca.display.trade_off import plot_trade_off

    lost = TradeOff(0.1, 3, 3, 1.0, 1.0, None, None, None)
    ax = plot_trade_off({"coffee": [*points, lost]})
    lines = {line.get_label(): line.get_xydata() for line in ax.lines}
    assert [x for x, _ in lines["coffee, at most"]] == [point.blocks for point in points]
    measured = [max(point.measured / abs(point.optimum), 1e-6) for point in points]  # type: ignore[operator, arg-type]
    assert [y for _, y in lines["coffee, measured"]] == pytest.approx(measured)
    assert "share" in ax.get_ylabel()
    pyplot.close("all")
