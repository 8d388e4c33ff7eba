"""Polling over beliefs: one by one, many at once, by hand; ended children; the likeliest state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from belief_plans import NAMES, ByHand, corridor_tasks, planned

from factored_polca.control import BlockBelief, BlockTracker, DiagramTracker, ParticleTracker
from factored_polca.control.belief_controller import (
    BeliefController,
    block_state,
    plan_tracker,
    tracked_features,
)
from factored_polca.control.belief_policies import MostLikelyPolicy, PolledPolicy
from factored_polca.control.block_tracker import make_block_tracker
from factored_polca.control.likeliest import LikeliestController, likeliest_tracker
from factored_polca.control.particle_tracker import random_history
from factored_polca.control.polling import look_ahead
from factored_polca.control.tracker import Belief, Tracker, independent_belief
from factored_polca.explicit.alpha_vectors import AlphaSet, AlphaVectors
from factored_polca.hierarchy import Options, plan_mdp
from factored_polca.hierarchy.executable import ExecutablePlan, executable
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan
from factored_polca.models import ModelError


def along(tracker: Tracker, seed: int, steps: int = 10) -> list[Belief]:
    """The beliefs along an episode of random actions, before its end."""
    history = random_history(tracker.symbolic, steps, seed)
    features = [tracker.symbolic.model.features[i] for i in tracker.reader.observed]
    belief = tracker.start({f.name: f.values[v] for f, v in zip(features, history[0].seen, strict=True)})
    found = [belief]
    for received in history[1:]:
        if received.ended:
            break
        belief = belief.advance(received)
        found.append(belief)
    return found


def block_tracker(plan: ExecutablePomdpPlan) -> BlockTracker:
    tracker = plan_tracker(plan).tracker
    assert isinstance(tracker, BlockTracker)
    return tracker


def dense(beliefs: list[Belief], tracker: BlockTracker) -> np.ndarray:
    result = np.zeros((len(beliefs), tracker.partition.blocks))
    for row, belief in zip(result, beliefs, strict=True):
        assert isinstance(belief, BlockBelief)
        row[belief.blocks] = belief.weights
    return result


@pytest.mark.parametrize("name", NAMES)
def test_many_beliefs_at_once_get_the_actions_of_one_by_one(name: str) -> None:
    plan = planned(name)
    tracker, controller = block_tracker(plan), BeliefController(plan)
    beliefs = [belief for seed in range(15) for belief in along(tracker, seed)]
    polled = [controller.poll(belief) for belief in beliefs]
    batched = PolledPolicy(plan, tracker).choose(dense(beliefs, tracker))
    assert batched.tolist() == [decision.number for decision in polled]
    for decision in polled:
        assert plan.model.actions[decision.number].name == decision.action == decision.path[-1].action
        assert decision.path[0].task == plan.root
        for above, below in zip(decision.path[:-1], decision.path[1:], strict=True):
            assert above.action == below.task
    assert len({decision.number for decision in polled}) > 1


@pytest.mark.parametrize("name", NAMES)
def test_polling_does_what_the_vectors_say_over_all_states(name: str) -> None:
    plan = planned(name)
    by_hand, tracker = ByHand(plan), DiagramTracker(plan.symbolic)
    controller = BeliefController(plan)
    for seed in range(4):
        for belief in along(tracker, seed, 6):
            over_states = belief.at(by_hand.digits)  # type: ignore[attr-defined]
            assert controller.poll(belief).number == by_hand.action(over_states)


@pytest.mark.parametrize("name", ["meds", "corridor", "finish"])
def test_beliefs_as_diagrams_and_particles_are_polled_too(name: str) -> None:
    plan = planned(name)
    controller = BeliefController(plan)
    for exact, sampled in zip(
        along(DiagramTracker(plan.symbolic), 3),
        along(ParticleTracker(plan.symbolic, 20_000), 3),
        strict=True,
    ):
        assert controller.poll(exact).action in {action.name for action in plan.model.actions}
        mine, other = controller.poll(exact).path[0], controller.poll(sampled).path[0]
        assert mine.probability == pytest.approx(other.probability, abs=0.05)


def test_a_block_is_told_by_its_first_state_in_what_the_task_tells_apart() -> None:
    plan = planned("corridor")
    assert tracked_features(plan) == ["place", "lamp"]
    for task in plan.policies.values():
        for block in range(task.partition.blocks):
            state = block_state(task.partition, block)
            by_hand = ByHand(plan)
            (first,) = np.flatnonzero(
                (by_hand.digits == [state.get("place", 0), int(state.get("lamp", 0))]).all(axis=1)
            )
            assert by_hand.labels[task.name][first] == block


# -- children that have ended ----------------------------------------------------------------------


def always(plan: ExecutablePomdpPlan, child: str) -> ExecutablePomdpPlan:
    """The plan with a root that wants `child` whatever it believes, its values as they were."""
    root = plan.policies[plan.root]
    assert isinstance(root.policy, AlphaVectors)
    number = root.actions.index(child)
    sets = tuple(AlphaSet(p.states, p.vectors, np.full_like(p.actions, number)) for p in root.policy.sets)
    changed = replace(root, policy=AlphaVectors(root.policy.states, sets, root.policy.meaning))
    return replace(plan, policies={**plan.policies, plan.root: changed}, known=dict(plan.known))


def believing(plan: ExecutablePomdpPlan, tracker: Tracker, place: dict[int, str], lamp: str) -> Belief:
    rows = independent_belief(
        plan.symbolic, {"place": place, "lamp": {True: lamp, False: f"{1 - float(lamp):.2f}"}}
    )
    return tracker.start({}, initial=rows)


PLACES = [{0: "1"}, {0: "0.5", 1: "0.5"}, {0: "0.25", 1: "0.25", 2: "0.5"}, {1: "0.1", 2: "0.9"}]


@pytest.mark.parametrize("place", PLACES)
def test_a_child_that_has_surely_ended_is_passed_over_by_looking_ahead(place: dict[int, str]) -> None:
    plan = always(planned("corridor"), "Light")
    by_hand, tracker = ByHand(plan), block_tracker(plan)
    belief = believing(plan, tracker, place, "1")
    decision = BeliefController(plan).poll(belief)
    assert decision.path[0].looked_ahead
    assert not decision.path[0].ended

    over_states = DiagramTracker(plan.symbolic).start(
        {}, initial=independent_belief(plan.symbolic, {"place": place, "lamp": {True: 1}})
    ).at(by_hand.digits)  # type: ignore[attr-defined]  # fmt: skip
    root = plan.policies["Root"]
    expected = [by_hand.one_step("Root", over_states, action) for action in root.actions]
    found = look_ahead(plan, "Root", belief.project(root.partition))
    assert found == pytest.approx(expected, abs=1e-9)
    best = max(range(1, len(expected)), key=lambda number: expected[number])  # number 0 is Light
    assert decision.path[0].action == root.actions[best]
    batched = PolledPolicy(plan, tracker).choose(dense([belief], tracker))
    assert batched.tolist() == [decision.number]


def test_a_child_that_may_not_have_ended_is_asked() -> None:
    plan = always(planned("corridor"), "Light")
    decision = BeliefController(plan).poll(believing(plan, block_tracker(plan), {0: "1"}, "0.99"))
    assert [poll.task for poll in decision.path] == ["Root", "Light"]
    assert not any(poll.looked_ahead for poll in decision.path)


@pytest.mark.parametrize("child", ["Light", "Go"])
def test_where_all_children_have_ended_the_one_wanted_does_its_first_action(child: str) -> None:
    plan = always(planned("corridor", only_children=True), child)
    tracker = block_tracker(plan)
    belief = believing(plan, tracker, {2: "1"}, "1")
    decision = BeliefController(plan).poll(belief)
    assert [(poll.task, poll.ended, poll.looked_ahead) for poll in decision.path] == [
        ("Root", False, False),
        (child, True, False),
    ]
    assert decision.action == plan.policies[child].actions[0]
    assert PolledPolicy(plan, tracker).choose(dense([belief], tracker)).tolist() == [decision.number]


# -- the likeliest state ---------------------------------------------------------------------------


def planned_as_seen(name: str) -> ExecutablePlan:
    plan = planned(name)
    options = Options(assume_observed=True, flat_block_limit=None)
    return executable(plan_mdp(plan.model, plan.tasks, options))


@pytest.mark.parametrize("name", NAMES)
def test_a_policy_of_states_is_asked_at_the_likeliest_one(name: str) -> None:
    plan = planned_as_seen(name)
    tracker, controller = likeliest_tracker(plan).tracker, LikeliestController(plan)
    assert isinstance(tracker, BlockTracker)
    by_hand = ByHand(planned(name))
    policy = by_hand.at(plan.policy)
    blocks = by_hand.at(tracker.partition.diagram)
    beliefs = [belief for seed in range(10) for belief in along(tracker, seed)]
    found = [controller.poll(belief) for belief in beliefs]
    batched = MostLikelyPolicy(plan.policy, tracker).choose(dense(beliefs, tracker))
    assert batched.tolist() == [decision.number for decision in found]
    for row, decision in zip(dense(beliefs, tracker), found, strict=True):
        digits = [f.index(decision.state[f.name]) for f in plan.model.features]
        (state,) = np.flatnonzero((by_hand.digits == digits).all(axis=1))
        assert policy[state] == decision.number
        assert row[blocks[state]] >= (1 - 1e-9) * row.max()


def test_the_likeliest_state_of_a_diagram_is_exact() -> None:
    plan = planned_as_seen("corridor")
    controller, by_hand = LikeliestController(plan), ByHand(planned("corridor"))
    policy = by_hand.at(plan.policy)
    for belief in along(DiagramTracker(plan.symbolic), 5):
        over_states = belief.at(by_hand.digits)  # type: ignore[attr-defined]
        best = np.flatnonzero(over_states >= over_states.max() * (1 - 1e-9))
        assert controller.poll(belief).number in policy[best]


def test_where_the_policy_has_no_action_the_likeliest_action_is_taken() -> None:
    """With all children ended at the likeliest state; other states want something."""
    plan = planned("corridor", only_children=True)
    tasks = corridor_tasks(only_children=True, root_ends=True)
    seen = executable(plan_mdp(plan.model, tasks, Options(assume_observed=True, flat_block_limit=None)))
    none = len(plan.model.actions)
    by_hand = ByHand(plan)
    assert none in by_hand.at(seen.policy)  # lamp lit in the last place: Light and Go have ended
    rows = independent_belief(seen.symbolic, {"place": {2: "0.9", 1: "0.1"}, "lamp": {True: 1}})
    for tracker in (likeliest_tracker(seen).tracker, DiagramTracker(seen.symbolic)):
        decision = LikeliestController(seen).poll(tracker.start({}, initial=rows))
        assert decision.action == "step"
        sure = independent_belief(seen.symbolic, {"place": {2: 1}, "lamp": {True: 1}})
        nothing = LikeliestController(seen).poll(tracker.start({}, initial=sure))
        assert (nothing.action, nothing.number) == (None, -1)


def test_a_policy_that_divides_a_block_is_refused() -> None:
    plan = planned_as_seen("corridor")
    tracker = make_block_tracker(plan.symbolic)
    assert tracker.partition.blocks == 2  # the lamp; the place is never sensed
    with pytest.raises(ModelError, match="divides a block"):
        LikeliestController(plan).poll(tracker.start({}))
    with pytest.raises(ModelError, match="divides a block"):
        MostLikelyPolicy(plan.policy, tracker)
