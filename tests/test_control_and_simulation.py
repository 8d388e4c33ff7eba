"""Execution: the controller's polls, and simulation against exact values and exact rows."""

from __future__ import annotations

import math

import numpy as np
import pytest
from random_models import random_model, random_tasks

from factored_polca import library
from factored_polca.control import Controller
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.hierarchy import plan
from factored_polca.hierarchy.executable import ExecutablePlan, executable
from factored_polca.models import Action, Feature, Model, ModelError, Task, TaskHierarchy, boolean
from factored_polca.simulation import Sampler, default_steps, simulate
from factored_polca.symbolic import compile_model


def planned(name: str, **parameters: str) -> tuple[ExecutablePlan, float]:
    domain = library.load(name, parameters)
    found = plan(domain.model, domain.tasks)
    return executable(found), found.polled.value


@pytest.mark.parametrize("name", ["taxi", "toy"])
def test_polling_and_the_composed_policy_agree_at_every_state(name: str) -> None:
    policy, _ = planned(name, **({"size": "3"} if name == "taxi" else {}))
    assert_polls_agree(policy)


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4, 6, 7])
def test_polling_and_the_composed_policy_agree_on_random_hierarchies(seed: int) -> None:
    model = random_model(seed, features=(2, 3), max_states=36)
    assert_polls_agree(executable(plan(model, random_tasks(seed, model))))


def assert_polls_agree(policy: ExecutablePlan) -> None:
    model, controller = policy.model, Controller(policy)
    mdp = enumerate_model(model)
    names = [feature.name for feature in model.features]
    rows = [
        [feature.index(value) for feature, value in zip(model.features, values, strict=True)]
        for values in mdp.state_values
    ]
    taken = controller.actions(np.array(rows, dtype=np.int32))
    total = dict.fromkeys(policy.policies, 0)
    for s, values in enumerate(mdp.state_values):
        decision = controller.poll(dict(zip(names, values, strict=True)))
        expected = model.actions[taken[s]].name if taken[s] >= 0 else None
        assert decision.action == expected
        assert decision.path[0].task == policy.root
        for poll, following in zip(decision.path, decision.path[1:], strict=False):
            assert poll.action == following.task
        assert decision.path[-1].action == decision.action
        total[policy.root] += 1
    assert sum(policy.policies[policy.root].partition.sizes) == total[policy.root]


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ({"x": 0, "y": 0, "passenger": "R"}, "no value for destination"),
        ({"x": 0, "y": 0, "passenger": "R", "destination": "B", "z": 1}, "no feature 'z'"),
        ({"x": 7, "y": 0, "passenger": "R", "destination": "B"}, "x has no value 7; it has 0, 1, 2"),
        ({"x": True, "y": 0, "passenger": "R", "destination": "B"}, "x has no value True"),
    ],
)
def test_a_wrong_state_is_refused(state: dict[str, object], said: str) -> None:
    policy, _ = planned("taxi", size="3")
    with pytest.raises(ModelError, match=said):
        Controller(policy).poll(state)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("taxi", {"size": "4", "slip": "true"}),
        ("toy", {}),
        ("workshop", {"size": "2"}),
        ("sysadmin", {"size": "3"}),
    ],
)
def test_the_simulated_mean_is_the_exact_value(name: str, parameters: dict[str, str]) -> None:
    policy, value = planned(name, **parameters)
    found = simulate(policy, episodes=4000, seed=11)
    slack = 4 * found.standard_error + (found.truncation if math.isfinite(found.truncation) else 0)
    assert abs(found.mean - value) <= slack + 1e-12


def test_the_same_seed_gives_the_same_returns() -> None:
    policy, _ = planned("taxi", size="3", slip="true")
    first = simulate(policy, episodes=200, seed=3)
    assert (first.returns == simulate(policy, episodes=200, seed=3).returns).all()
    assert (first.returns != simulate(policy, episodes=200, seed=4).returns).any()


def test_episodes_end_where_the_policy_ends() -> None:
    policy, _ = planned("taxi", size="3")
    found = simulate(policy, episodes=300, seed=0)
    assert found.ended == 300
    assert found.truncation == 0


def test_an_endless_run_says_what_was_cut_off() -> None:
    policy, _ = planned("sysadmin", size="2")
    found = simulate(policy, episodes=50, steps=10, seed=0)
    assert found.ended == 0
    assert found.truncation >= 0.95**10


def test_default_steps_leave_a_millionth() -> None:
    steps = default_steps(0.95)
    assert 0.95**steps / 0.05 <= 1e-6 < 0.95 ** (steps - 1) / 0.05
    assert default_steps(1.0) == 10_000
    assert default_steps(0.0) == 1


@pytest.mark.parametrize(("episodes", "steps"), [(0, None), (-1, 5), (5, 0)])
def test_fewer_than_one_is_refused(episodes: int, steps: int | None) -> None:
    policy, _ = planned("toy")
    with pytest.raises(ValueError, match="at least 1"):
        simulate(policy, episodes=episodes, steps=steps)


def synchronic_model() -> Model:
    """y' depends on x', z' on y' and x: each joint outcome has its own probability."""
    x, y, z = Feature("x", range(3)), Feature("y", range(3)), boolean("z")
    mix = Action(
        "mix",
        {
            z: "bernoulli(0.3) if y' == x else bernoulli(0.8)",
            x: "{0: 0.5, 1: 0.3, 2: 0.2}",
            y: "{x': 0.7, 0: 0.3} if z else x'",
        },
        rewards="x' + y' / 3",
    )
    return Model(
        "synchronic", [z, y, x], [mix], initial={x: "{0: 0.25, 2: 0.75}", y: "x", z: "bernoulli(0.9)"}
    )


def test_sampled_transitions_have_the_exact_frequencies() -> None:
    model = synchronic_model()
    exact = enumerate_model(model)
    symbolic = compile_model(model)
    sampler, generator = Sampler(symbolic), np.random.default_rng(5)
    count = 40_000
    index = {tuple(values): number for number, values in enumerate(exact.state_values)}

    def numbers(states: np.ndarray) -> np.ndarray:
        return np.array(
            [index[tuple(f.values[v] for f, v in zip(model.features, row, strict=True))] for row in states]
        )

    started = np.bincount(numbers(sampler.initial(count, generator)), minlength=exact.states)
    for number, chance in enumerate(exact.initial):
        assert_frequency(int(started[number]), count, float(chance))
    for s in (0, 4, 11, 17):
        values = exact.state_values[s]
        row = [f.index(v) for f, v in zip(model.features, values, strict=True)]
        states = np.tile(np.array(row, dtype=np.int32), (count, 1))
        following, rewards = sampler.step(states, np.zeros(count, dtype=np.int64), generator)
        seen = np.bincount(numbers(following), minlength=exact.states)
        for t in range(exact.states):
            assert_frequency(int(seen[t]), count, float(exact.rows[0][s].get(t, 0)))
        spread = rewards.std() / math.sqrt(count)
        assert abs(rewards.mean() - float(exact.rewards[0][s])) <= 4.5 * spread


def assert_frequency(seen: int, count: int, chance: float) -> None:
    assert abs(seen - count * chance) <= 4.5 * math.sqrt(count * chance * (1 - chance))


def test_no_action_means_no_change_and_no_reward() -> None:
    model = synchronic_model()
    sampler = Sampler(compile_model(model))
    states = np.zeros((4, 3), dtype=np.int32)
    following, rewards = sampler.step(states, np.full(4, -1), np.random.default_rng(0))
    assert (following == states).all()
    assert (rewards == 0).all()


def test_a_subtask_may_be_left_before_it_ends() -> None:
    # the root prefers its own jump as soon as x reaches 1, though `walk` would go on to 3
    x = Feature("x", range(5))
    model = Model(
        "leave",
        [x],
        [
            Action("step", {x: "min(x + 1, 4)"}, rewards=-1),
            Action("jump", {x: "4"}, applicable="x == 1", rewards=-1),
        ],
        terminal="x == 4",
        initial={x: "{0: 1}"},
    )
    tasks = TaskHierarchy(
        [Task("root", ["walk", "jump"]), Task("walk", ["step"], terminal="x == 3", pseudo_rewards=-1)]
    )
    found = plan(model, tasks)
    controller = Controller(executable(found))
    assert [poll.task for poll in controller.poll({"x": 0}).path] == ["root", "walk"]
    assert [poll.action for poll in controller.poll({"x": 1}).path] == ["jump"]
    assert found.polled.value == pytest.approx(-1 - 0.95)
