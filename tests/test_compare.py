"""Paired comparisons: differences in closed form, pairing, refusals; traces are simulated episodes."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from belief_plans import corridor

import factored_polca as fp
from factored_polca.cli import main
from factored_polca.control import ChosenTracker, DiagramTracker
from factored_polca.explicit.alpha_vectors import AlphaSet, AlphaVectors
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.hierarchy.policy_file import FlatPolicy, save_policy
from factored_polca.minimisation.flat_model import flat_model
from factored_polca.models import Model, ModelError
from factored_polca.simulation import comparison as module
from factored_polca.simulation.comparison import Comparison, compare, model_difference
from factored_polca.simulation.trace import trace


def walk(first: str = "2", second: str = "5") -> Model:
    """Step once, with success 1/2 to the end, `safe` earning 2 a try and `bold` 5 a success only."""
    done = fp.boolean("done")
    half = {done: fp.lottery({True: "1/2", False: "1/2"})}
    return Model(
        "walk",
        [done],
        [
            fp.Action("safe", half, rewards=first),
            fp.Action("bold", half, rewards=f"{second} if done' else 0"),
        ],
        terminal="done",
        initial={done: False},
        discount="1/2",
    )


def plan_that(action: str, model: Model | None = None) -> Any:
    model = walk() if model is None else model
    return fp.executable(fp.plan(model, fp.TaskHierarchy([fp.Task("only", [action])])))  # type: ignore[arg-type]


def test_the_difference_of_two_plans_has_its_closed_form() -> None:
    """From the start safe is worth V = 2 + V/4 = 8/3, bold W = 5/2 + W/4 = 10/3.

    Both end after the same T steps, T having chance 2^-T, so an episode's difference is
    sum_{t<T} 2 / 2^t - 5 / 2^(T-1) = 4 (1 - 2^-T) - 10 * 2^-T = 4 - 14 * 2^-T.
    """
    found = compare(plan_that("safe"), plan_that("bold"), episodes=4000, seed=5, steps=60)
    possible = {4 - 14 * 2.0**-t for t in range(1, 61)}
    assert all(min(abs(d - p) for p in possible) < 1e-12 for d in found.differences.tolist())
    expected = 8 / 3 - 10 / 3
    # variance of 14 * 2^-T: 196 (E[4^-T] - E[2^-T]^2) = 196 (1/7 - 1/9)
    error = math.sqrt(196 * (1 / 7 - 1 / 9) / 4000)
    assert found.mean == pytest.approx(expected, abs=4 * error)
    assert found.standard_error == pytest.approx(error, rel=0.05)
    low, high = found.interval
    assert low < expected < high
    assert high - low == pytest.approx(2 * 1.9606 * found.standard_error, rel=1e-3)  # t for 3999: 1.9606
    # 4 - 14 * 2^-T is negative for T = 1 only
    assert found.losses == pytest.approx(2000, abs=4 * math.sqrt(1000))
    assert found.wins + found.losses == 4000
    assert found.ties == 0
    assert found.truncation < 1e-15


def test_a_plan_ties_with_itself_in_every_episode() -> None:
    found = compare(plan_that("bold"), plan_that("bold"), episodes=50, seed=1)
    assert (found.wins, found.ties, found.losses) == (0, 50, 0)
    assert found.mean == found.standard_error == 0
    assert found.interval == (0, 0)


def test_pairing_shares_what_is_drawn() -> None:
    """Episodes end at the same step under both: unpaired runs vary more.

    Var[4 (1 - 2^-T)] + Var[10 * 2^-T] = (16 + 100) (1/7 - 1/9), against 196 of the same paired: here
    pairing costs, since the two returns move against each other; the error says so.
    """
    found = compare(plan_that("safe"), plan_that("bold"), episodes=4000, seed=5, steps=60)
    spread = 1 / 7 - 1 / 9
    assert found.unpaired_standard_error == pytest.approx(math.sqrt(116 * spread / 4000), rel=0.05)
    same = compare(plan_that("safe"), plan_that("safe", walk()), episodes=100, seed=5)
    assert same.standard_error == 0 < same.unpaired_standard_error


def test_the_first_chunk_is_the_simulation_with_that_seed() -> None:
    plan = plan_that("bold")
    found = compare(plan, plan, episodes=30, seed=7)
    assert found.first_returns.tolist() == fp.simulate(plan, episodes=30, seed=7).returns.tolist()


def test_chunks_draw_the_same_for_both_and_anew_for_each(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = plan_that("safe"), plan_that("bold")
    whole = compare(first, second, episodes=40, seed=3)
    monkeypatch.setattr(module, "BELIEF_NUMBERS", 10)
    parts = compare(first, second, episodes=40, seed=3)
    possible = {4 - 14 * 2.0**-t for t in range(1, 61)}
    assert all(min(abs(d - p) for p in possible) < 1e-4 for d in parts.differences.tolist())
    assert parts.first_returns[:10].tolist() != parts.first_returns[10:20].tolist()
    assert len(parts.first_returns) == len(whole.first_returns) == 40


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (walk(), walk("3"), "action 'safe' has another reward"),
        (walk(), corridor(), "one has the features done, the other place, lamp"),
    ],
)
def test_plans_of_different_models_are_refused(first: Model, second: Model, expected: str) -> None:
    assert expected in str(model_difference(first, second))
    assert model_difference(first, first) is None


def test_differences_of_models_are_named() -> None:
    model = walk()
    x = fp.Feature("done", [False, True], observed=True)

    def changed(**parts: Any) -> Model:
        given = {
            "features": model.features, "actions": model.actions, "terminal": model.terminal,
            "initial": model.initial, "discount": model.discount,
        }  # fmt: skip
        given |= parts
        return Model("other", given.pop("features"), given.pop("actions"), **given)

    assert model_difference(model, changed()) is None  # the name does not count
    assert model_difference(model, changed(discount="0.9")) == "they differ in discount"
    assert model_difference(model, changed(rewards=["1"])) == "they differ in rewards"
    assert model_difference(model, changed(terminal="not done")) == "they differ in terminal"
    assert model_difference(model, changed(initial={x: True})) == "they differ at the start"
    assert "whether it is seen" in str(model_difference(model, changed(features=[x])))
    swapped = [model.actions[1], model.actions[0]]
    assert "the actions safe, bold, the other bold, safe" in str(
        model_difference(model, changed(actions=swapped))
    )
    slower = [
        fp.Action("safe", {x: fp.lottery({True: "1/3", False: "2/3"})}, rewards="2"),
        model.actions[1],
    ]
    assert model_difference(model, changed(actions=slower)) == "action 'safe' has another effect on 'done'"
    with pytest.raises(ModelError, match="only plans of one model are compared"):
        compare(plan_that("safe"), plan_that("safe", walk("3")))


def test_a_model_that_is_written_and_read_is_the_same_model() -> None:
    from factored_polca.formats import read_native, write_native

    for name in fp.domains():
        model = fp.load_domain(name).model
        assert model_difference(model, read_native(write_native(model, None)).model) is None, name


def test_wrong_numbers_are_refused() -> None:
    plan = plan_that("safe")
    for wrong in ({"episodes": 0}, {"steps": 0}, {"level": 1.0}):
        with pytest.raises(ValueError, match=r"at least 1|probability"):
            compare(plan, plan, **wrong)  # type: ignore[arg-type]


def test_plans_fresh_from_the_planner_are_run_as_they_are() -> None:
    model = walk()
    made = fp.plan(model, fp.TaskHierarchy([fp.Task("only", ["safe"])]))
    found = compare(made, fp.executable(made), episodes=5)  # type: ignore[arg-type]
    assert found.ties == 5
    assert trace(made, steps=3).steps[0].action == "safe"
    with pytest.raises(TypeError, match="Model can't be run; what can: a plan"):
        compare(model, made)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="has no trace"):
        trace(tiger_policies()["blind"])


def test_one_episode_has_no_error() -> None:
    found = compare(plan_that("safe"), plan_that("bold"), episodes=1)
    assert math.isnan(found.standard_error)
    assert all(map(math.isnan, found.interval))


def test_rounding_is_no_win() -> None:
    a, b = np.array([1.0, 1e6, 2.0]), np.array([1.0 + 1e-12, 1e6 + 1e-5, 1.0])
    found = Comparison("a", "b", a, b, 0.95, 10, 0, 0.0)
    assert (found.wins, found.ties, found.losses) == (1, 2, 0)


# -- where the state is not seen ---------------------------------------------------------------------


def tiger_policies() -> dict[str, FlatPolicy]:
    """Listening for ever, as a policy graph and by vectors; opening a door blindly."""
    flat = flat_model(fp.compile_model(fp.load_domain("tiger").model))
    names = list(flat.pomdp.actions)
    listen, left = names.index("listen"), names.index("open_left")
    stay = tuple(np.zeros((len(o), 1), dtype=np.int64) for o in (flat.pomdp.observations[listen],))
    one = np.array([listen])
    vectors = AlphaSet(np.arange(2), np.array([[-20.0, -20.0]]), one)
    blind = AlphaSet(np.arange(2), np.array([[0.0, 0.0]]), np.array([left]))
    return {
        "graph": FlatPolicy(flat, PolicyGraph(one, stay, np.array([0]))),
        "vectors": FlatPolicy(flat, AlphaVectors(2, (vectors,))),
        "blind": FlatPolicy(flat, AlphaVectors(2, (blind,))),
    }


def test_listening_for_ever_beats_opening_blindly() -> None:
    """Listening costs 1 a step: -(1 - g^n) / (1 - g); a door opened blindly -45 on average (10 or -100)."""
    made = tiger_policies()
    found = compare(made["vectors"], made["blind"], episodes=400, steps=20, seed=2)
    gamma = 0.95
    weight = (1 - gamma**20) / (1 - gamma)
    assert found.first_returns.tolist() == pytest.approx([-weight] * 400)
    deviation = 55 * math.sqrt((1 - gamma**40) / (1 - gamma**2))  # of independent +-55 around -45
    assert found.mean == pytest.approx((-1 + 45) * weight, abs=4 * deviation / 20)
    same = compare(made["graph"], made["vectors"], episodes=50, steps=10, seed=1)
    assert same.ties == 50


@pytest.mark.parametrize("method", ["auto", "sarsop"], ids=["policy graph", "vectors"])
def test_equal_policies_of_two_kinds_tie(method: str) -> None:
    """The tiger's optimal policy as a graph, as vectors over states, and as a plan of one task."""
    model = fp.load_domain("tiger").model
    flat = flat_model(fp.compile_model(model))
    solution = fp.solve_pomdp(flat.pomdp, method, demand=fp.Demand(gap=1e-3))
    plan = fp.executable_pomdp(fp.plan(model))  # type: ignore[arg-type]
    found = compare(plan, FlatPolicy(flat, solution.policy), episodes=300, steps=40, seed=4)
    assert found.ties == 300
    assert found.unpaired_standard_error > 0


def test_observed_features_and_ends_are_tracked_by_listed_policies() -> None:
    """The place is seen and episodes end: a plan and a flat policy of the same vectors tie."""
    model = corridor(ending=True)
    symbolic = fp.compile_model(model)
    plan = fp.plan(model)
    flat = flat_model(symbolic, reachable=False)
    task = plan.root
    blocks = task.reduction.project_states(flat.states)
    sets = []
    for part in task.belief_policy.sets:  # type: ignore[union-attr]
        place = {int(block): k for k, block in enumerate(part.states.tolist())}
        mine = [s for s, block in enumerate(blocks.tolist()) if block in place]
        columns = part.vectors[:, [place[int(blocks[s])] for s in mine]]
        sets.append(AlphaSet(np.array(mine), columns, part.actions))
    lifted = AlphaVectors(len(flat.states), tuple(sets))
    found = compare(
        fp.executable_pomdp(plan), FlatPolicy(flat, lifted), episodes=300, seed=6, steps=50  # type: ignore[arg-type]
    )  # fmt: skip
    assert found.ties == 300
    assert found.unpaired_standard_error > 0


def test_beliefs_that_are_tracked_one_by_one_lead_to_the_same_episodes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two exact trackers, over blocks and as diagrams, earn the same in each episode."""
    plan = fp.executable_pomdp(fp.plan(fp.load_domain("tiger").model))  # type: ignore[arg-type]
    kinds = [module.plan_tracker(plan), ChosenTracker(DiagramTracker(plan.symbolic), "")]
    monkeypatch.setattr(module, "plan_tracker", lambda *_, **__: kinds[0])
    monkeypatch.setattr(module, "episodes_at_once", lambda _: 5)
    first = module.runner_of(plan, 0)
    kinds[0] = kinds[1]
    second = module.runner_of(plan, 0)
    assert (first.slow, second.slow) == (False, True)
    for seed in (4, 9):
        assert first.run(5, 15, seed).returns.tolist() == pytest.approx(
            second.run(5, 15, seed).returns.tolist()
        )
    one_by_one = compare(plan, plan, episodes=12, steps=15, seed=4)
    assert one_by_one.ties == 12


def test_a_plan_as_if_the_state_were_seen_is_compared_at_the_likeliest_state() -> None:
    """PolCA in the tiger problem opens the likelier door at once: 10 * 0.5 - 100 * 0.5 = -45 a step."""
    model = fp.load_domain("tiger").model
    seen = fp.executable(fp.plan(model, None, fp.Options(assume_observed=True)))  # type: ignore[arg-type]
    plus = fp.executable_pomdp(fp.plan(model))  # type: ignore[arg-type]
    found = compare(plus, seen, episodes=400, steps=10, seed=3)
    weight = (1 - 0.95**10) / 0.05
    deviation = 55 * math.sqrt((1 - 0.95**20) / (1 - 0.95**2))
    assert float(found.second_returns.mean()) == pytest.approx(-45 * weight, abs=4 * deviation / 20)
    assert found.interval[0] > 0
    episode = trace(seen, steps=4, seed=1)
    assert {step.action for step in episode.steps} <= {"open_left", "open_right"}
    assert len(episode.steps) == 4
    assert episode.belief_over_time("tiger")[1:] == pytest.approx(np.full((4, 2), 0.5))


def test_policies_of_states_are_compared_with_plans() -> None:
    domain = fp.load_domain("taxi")
    plan = fp.executable(fp.plan(domain.model, domain.tasks))  # type: ignore[arg-type]
    flat = flat_model(fp.compile_model(domain.model))
    best = FlatPolicy(flat, StatePolicy(fp.solve_mdp(flat.to_mdp()).policy[None, :]))
    found = compare(plan, best, episodes=200, seed=1)
    # both are worth 3.857 (README), and Taxi is deterministic: each start has one optimal return
    assert found.ties == 200


def test_a_policy_for_a_horizon_runs_for_its_steps() -> None:
    model = fp.load_domain("tiger").model
    flat = flat_model(fp.compile_model(model))
    staged = {h: FlatPolicy(flat, fp.solve_pomdp(flat.pomdp, "exact", horizon=h).policy) for h in (2, 3)}
    found = compare(staged[2], staged[2], episodes=10)
    assert found.steps == 2
    assert found.first_returns.tolist() == pytest.approx([-1.95] * 10)  # listens twice
    assert found.truncation == 0
    with pytest.raises(ModelError, match="here these are 2 and 3"):
        compare(staged[2], staged[3])
    with pytest.raises(ModelError, match="here these are 2 and 5"):
        compare(staged[2], staged[2], steps=5)


# -- traces ---------------------------------------------------------------------------------------------


def test_a_trace_is_the_simulation_s_episode() -> None:
    domain = fp.load_domain("taxi")
    plan = fp.executable(fp.plan(domain.model, domain.tasks))  # type: ignore[arg-type]
    for seed in range(3):
        found = trace(plan, steps=100, seed=seed)
        assert found.ended
        earned = fp.simulate(plan, episodes=1, steps=100, seed=seed).returns[0]
        assert found.discounted_return == pytest.approx(earned)
        assert found.steps[-1].action == "Putdown"
        assert found.state["passenger"] == "delivered"
        shown = found._repr_html_()
        assert "Root &gt; Get" in shown
        assert "ended" in shown


def test_a_trace_over_beliefs_follows_bayes_rule() -> None:
    plan = fp.executable_pomdp(fp.plan(fp.load_domain("tiger").model))  # type: ignore[arg-type]
    found = trace(plan, steps=12, seed=3)
    assert len(found.steps) == 12
    odds = 1.0  # of the tiger being left
    for step in found.steps:
        assert step.beliefs["tiger"][0] == pytest.approx(odds / (1 + odds))
        assert step.observation is not None
        if step.action == "listen":
            odds *= 0.85 / 0.15 if step.observation["growl"] == "left" else 0.15 / 0.85
        else:
            assert max(odds, 1 / odds) == pytest.approx((0.85 / 0.15) ** 2)
            odds = 1.0
    assert found.beliefs["tiger"][0] == pytest.approx(odds / (1 + odds))
    over_time = found.belief_over_time("tiger")
    assert over_time.shape == (13, 2)
    assert over_time.sum(axis=1) == pytest.approx(np.ones(13))
    with pytest.raises(KeyError, match="there are tiger"):
        found.belief_over_time("door")
    assert "tiger: left 50 %" in found._repr_html_()
    with pytest.raises(ValueError, match="at least 1"):
        trace(plan, steps=0)


# -- the command ------------------------------------------------------------------------------------------


def test_the_command_prints_difference_interval_and_counts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fp.save_plan(plan_that("safe"), "safe.polca")
    fp.save_plan(plan_that("bold"), "bold.polca")
    asked = ["compare", "safe.polca", "bold.polca", "--episodes", "4000", "--steps", "60", "--seed", "5"]
    assert main([*asked, "-q"]) == 0
    printed = capsys.readouterr().out
    assert "4,000 episodes of at most 60 steps" in printed
    assert "difference -0.6" in printed
    assert "95% confidence interval: -0." in printed
    assert "bold.polca earns more" in printed
    assert "as much in 0, less in " in printed
    assert main([*asked, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    expected = compare(plan_that("safe"), plan_that("bold"), episodes=4000, steps=60, seed=5)
    assert data["mean_difference"] == expected.mean
    assert data["interval"] == list(expected.interval)
    assert (data["wins"], data["ties"], data["losses"]) == (expected.wins, expected.ties, expected.losses)


def test_the_command_refuses_with_a_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    fp.save_plan(plan_that("safe"), "a.polca")
    fp.save_plan(plan_that("safe", walk("3")), "b.polca")
    assert main(["compare", "a.polca", "b.polca"]) == 2
    assert "action 'safe' has another reward" in capsys.readouterr().err
    assert main(["compare", "a.polca", "none.polca"]) == 2
    assert "none.polca" in capsys.readouterr().err
    save_policy(tiger_policies()["vectors"], "tiger.policy")
    assert main(["compare", "tiger.policy", "tiger.policy", "--episodes", "20", "-q"]) == 0
    assert "both earn the same in each episode" in capsys.readouterr().out
