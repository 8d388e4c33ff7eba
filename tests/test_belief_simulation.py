"""Simulated plans of partially observed models against exact values, over blocks and one by one.

`ByHand.expected_return` follows all beliefs that the polled plan can reach; tiger's optimum, 19.3714, is
that of Cassandra's tiger at discount 0.95 (README.md has its bounds).
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from belief_plans import ByHand, planned

from factored_polca import library
from factored_polca.control import ChosenTracker, DiagramTracker, ParticleTracker, Tracker
from factored_polca.control.answers import answers, can_end
from factored_polca.control.belief_controller import BeliefController, plan_tracker
from factored_polca.control.belief_policies import MostLikelyPolicy
from factored_polca.control.block_tracker import BlockTracker
from factored_polca.control.likeliest import LikeliestController, likeliest_tracker
from factored_polca.hierarchy import Options, plan_mdp, plan_pomdp
from factored_polca.hierarchy.executable import executable
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan, executable_pomdp
from factored_polca.models import ModelError, Task, TaskHierarchy, flat_task
from factored_polca.simulation import belief_episodes
from factored_polca.simulation.belief_episodes import run_one_by_one
from factored_polca.simulation.belief_runs import BeliefRuns, run_on_blocks
from factored_polca.simulation.measure import measure


def root_runs(plan: ExecutablePomdpPlan, tracker: Tracker | None = None, **asked: int) -> BeliefRuns:
    chosen = None if tracker is None else ChosenTracker(tracker, "forced")
    return measure(plan, child_episodes=1, chosen=chosen, **asked).runs[plan.root]


def assert_near(runs: BeliefRuns, value: float) -> None:
    """Within four standard errors: wrong once in 16,000 seeds, and the seed is fixed."""
    assert abs(runs.mean - value) <= 4 * runs.standard_error + 1e-9


def test_tiger_earns_its_optimum() -> None:
    tiger = library.load("tiger").model
    found = plan_pomdp(tiger, flat_task(tiger), Options(gap=1e-3, flat_block_limit=None))
    runs = root_runs(executable_pomdp(found), episodes=3000, seed=1)
    assert_near(runs, 19.3714)
    assert runs.standard_error < 0.6


@pytest.mark.parametrize(
    ("name", "steps"), [("tiger", 12), ("meds", 12), ("cheese_taxi", 10), ("corridor", 9), ("finish", 6)]
)
def test_what_is_earned_is_what_all_reachable_beliefs_earn(name: str, steps: int) -> None:
    plan = planned(name)
    assert_near(root_runs(plan, episodes=4000, steps=steps, seed=2), ByHand(plan).expected_return(steps))


@pytest.mark.parametrize("name", ["tiger", "meds", "cheese_taxi", "corridor", "finish"])
def test_beliefs_as_diagrams_lead_through_the_same_episodes(name: str) -> None:
    plan = planned(name)
    blocks = root_runs(plan, episodes=30, steps=12, seed=3)
    diagrams = root_runs(plan, DiagramTracker(plan.symbolic), episodes=30, steps=12, seed=3)
    assert diagrams.returns == pytest.approx(blocks.returns, abs=1e-9)
    assert diagrams.cumulative == pytest.approx(blocks.cumulative, abs=1e-9)
    np.testing.assert_array_equal(diagrams.counts, blocks.counts)
    assert (diagrams.ended, diagrams.steps, diagrams.resets) == (blocks.ended, 12, 0)


@pytest.mark.parametrize("name", ["meds", "finish"])
def test_particles_earn_about_as_much(name: str) -> None:
    plan = planned(name)
    tracker = ParticleTracker(plan.symbolic, 2000, on_impossible="reset")
    assert_near(root_runs(plan, tracker, episodes=150, steps=8, seed=4), ByHand(plan).expected_return(8))


def test_a_sample_that_has_lost_the_true_state_starts_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """One particle can't hold 33 states: an exact observation soon contradicts it."""
    monkeypatch.setattr("factored_polca.control.particle_tracker.TRIES", (1,))
    plan = planned("cheese_taxi")
    tracker = ParticleTracker(plan.symbolic, 1, on_impossible="reset")
    runs = root_runs(plan, tracker, episodes=20, steps=10, seed=5)
    assert runs.resets > 0
    assert runs.counts.sum() == 200


def test_episodes_are_run_in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    plan, told = planned("finish"), list[tuple[int, int]]()
    controller = BeliefController(plan)
    monkeypatch.setattr(belief_episodes, "BELIEF_NUMBERS", 7 * belief_episodes.DIAGRAM_NUMBERS)
    runs = run_one_by_one(
        DiagramTracker(plan.symbolic), lambda belief: controller.poll(belief).number,
        episodes=20, steps=6, progress=lambda first, step: told.append((first, step)),
    )  # fmt: skip
    assert runs.episodes == 20
    assert sorted({first for first, _ in told}) == [0, 7, 14]
    assert runs.counts.sum() <= 120


def test_measuring_falls_back_to_one_by_one_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    plan, told = planned("corridor"), list[str]()
    monkeypatch.setattr(
        "factored_polca.simulation.measure.plan_tracker",
        lambda plan, **options: ChosenTracker(DiagramTracker(plan.symbolic), "no blocks today"),
    )
    found = measure(plan, steps=5, progress=lambda task, first, step: told.append(task))
    assert found.tracker.kind == "diagram"
    assert set(found.runs) == {"Root"}
    assert found.runs["Root"].episodes == belief_episodes.EPISODES
    assert set(told) == {"Root"}


@pytest.mark.parametrize(("episodes", "steps"), [(0, 5), (5, 0)])
def test_at_least_one_episode_and_step(episodes: int, steps: int) -> None:
    plan = planned("meds")
    for tracker in (None, DiagramTracker(plan.symbolic)):
        with pytest.raises(ValueError, match="at least 1"):
            root_runs(plan, tracker, episodes=episodes, steps=steps)


def test_a_policy_without_an_action_is_an_error() -> None:
    plan = planned("meds")
    with pytest.raises(ModelError, match="no action"):
        run_one_by_one(DiagramTracker(plan.symbolic), lambda belief: -1, episodes=2, steps=2)


@pytest.mark.parametrize("name", ["meds", "cheese_taxi", "finish"])
def test_policies_of_states_run_the_same_over_blocks_and_as_diagrams(name: str) -> None:
    base = planned(name)
    plan = executable(
        plan_mdp(base.model, base.tasks, Options(assume_observed=True, flat_block_limit=None))
    )
    blocks, controller = likeliest_tracker(plan).tracker, LikeliestController(plan)
    assert isinstance(blocks, BlockTracker)
    asked = {"episodes": 40, "steps": 10, "seed": 6}
    many = run_on_blocks(blocks, MostLikelyPolicy(plan.policy, blocks), **asked)
    single = run_one_by_one(blocks, lambda belief: controller.poll(belief).number, **asked)
    assert single.returns == pytest.approx(many.returns, abs=1e-9)
    np.testing.assert_array_equal(single.counts, many.counts)


# -- what may be observed --------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["meds", "cheese_taxi", "corridor", "finish"])
def test_what_may_be_observed_is_what_the_kernel_says(name: str) -> None:
    """sum over s, t of b(s) K_a(s; t, o), by what is seen of t and whether it is terminal."""
    plan = planned(name)
    by_hand, model = ByHand(plan), plan.model
    exact = by_hand.exact
    start = DiagramTracker(plan.symbolic).start({"place": 1} if name == "finish" else {})
    over_states = start.at(by_hand.digits)
    trackers = [plan_tracker(plan).tracker, DiagramTracker(plan.symbolic)]
    trackers.append(ParticleTracker(plan.symbolic, 40_000))
    for tracker in trackers:
        belief = tracker.start({"place": 1} if name == "finish" else {})
        assert can_end(belief) == (name == "finish")
        for action in range(len(model.actions)):
            expected: dict[tuple[object, ...], float] = {}
            for o, values in enumerate(exact.observations):
                after = over_states @ by_hand.kernel[action, o]
                for t in np.flatnonzero(after > 0).tolist():
                    sensed = [values[j] for j in tracker.reader.sensed[action]]
                    seen = [exact.state_values[t][i] for i in tracker.reader.observed]
                    key = (*sensed, *seen, bool(by_hand.terminal[t]))
                    expected[key] = expected.get(key, 0.0) + float(after[t])
            found = answers(belief, action)
            assert found is not None
            assert [a.probability for a in found] == sorted((a.probability for a in found), reverse=True)
            mine = {(*a.observation.values(), a.ended): a.probability for a in found}
            slack = 4 * math.sqrt(0.25 / 40_000) if tracker.guarantee == "statistical" else 1e-9
            for key in {*expected, *mine}:
                assert abs(mine.get(key, 0.0) - expected.get(key, 0.0)) <= slack


def test_too_much_is_not_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = planned("meds")
    monkeypatch.setattr("factored_polca.control.answers.COMBINATIONS", 3)
    for tracker in (plan_tracker(plan).tracker, DiagramTracker(plan.symbolic)):
        assert answers(tracker.start({}), 0) is None  # four words
        assert answers(tracker.start({}), 1) is not None  # nothing is sensed


def test_a_task_is_measured_also_where_its_child_does_what_it_never_does_when_certain() -> None:
    """At corners `Open` opens a door at once, and so `Wait` knows of no listening; polled it listens."""
    tiger = library.load("tiger").model
    names = [action.name for action in tiger.actions]
    listen = names.index("listen")
    above = [Task("Root", ["Wait", "open_left"]), Task("Wait", ["Open", "open_left"])]
    tasks = TaskHierarchy([*above, Task("Open", names)])
    plan = executable_pomdp(plan_pomdp(tiger, tasks, Options(flat_block_limit=None)))
    assert listen not in plan.process("Wait").rewards
    assert sorted(plan.rewards("Wait")) == [0, 1, 2]
    runs = measure(plan, episodes=4000, child_episodes=4000).runs
    # Polling leads to Open's own policy in both, which is the optimum of tiger.
    assert_near(runs["Root"], 19.3714)
    assert_near(runs["Wait"], 19.3714)
