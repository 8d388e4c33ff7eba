"""Models as environments of Gymnasium, and its toy texts as models."""

from __future__ import annotations

import warnings
from collections import Counter
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from factored_polca import library
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.external.gym_environment import ModelEnvironment
from factored_polca.external.toy_text import model_of
from factored_polca.minimisation import flat_process, reduce
from factored_polca.models import Action, Feature, Model, ModelError, boolean, lottery
from factored_polca.solvers import solve_mdp
from factored_polca.symbolic import compile_model
from factored_polca.testing import check_model

DOMAINS = ["taxi", "coffee", "tiger", "toy", "cheese", "meds", "rocksample", "nursebot", "twenty_questions"]


# -- models as environments ------------------------------------------------------------------------


@pytest.mark.parametrize("rewards", ["sampled", "expected"])
@pytest.mark.parametrize("name", DOMAINS)
def test_shipped_domains_pass_the_checker_of_gymnasium(name: str, rewards: Any) -> None:
    environment = ModelEnvironment(
        library.load(name).model, rewards=rewards, max_steps=50, render_mode="ansi"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*we recommend using.*|.*not been registered.*|.*spec.*")
        check_env(environment, skip_render_check=True)


def corridor(**changes: Any) -> Model:
    """Three cells, the last ends; a step on works in 3/4 of the cases; resting in cell 1 only."""
    cell = Feature("cell", range(3))
    step = lottery([(cell + 1, "3/4"), (cell.now, "1/4")])
    return Model(
        "corridor", [cell],
        [Action("on", {cell: step}, rewards="-1 if cell' == 1 else -2"),
         Action("rest", applicable="cell == 1", rewards="5")],
        terminal="cell == 2", initial={cell: 0}, discount="9/10", **changes,
    )  # fmt: skip


def test_terminal_states_terminate_and_masks_say_what_applies() -> None:
    environment = ModelEnvironment(corridor())
    seen, info = environment.reset(seed=1)
    assert seen.tolist() == [0]
    assert info["action_mask"].tolist() == [1, 0]
    seen, reward, terminated, truncated, info = environment.step(1)
    assert (seen.tolist(), reward, terminated, truncated) == ([0], 0.0, False, False)
    rewards = []
    while not terminated:
        seen, reward, terminated, truncated, info = environment.step(0)
        rewards.append((int(seen[0]), reward))
        assert not truncated
    assert seen.tolist() == [2]
    assert not info["action_mask"].any()
    assert all(reward == (-1.0 if cell == 1 else -2.0) for cell, reward in rewards)
    assert environment.step(0)[1:4] == (0.0, True, False)


def test_expected_rewards_are_those_of_the_state_and_the_action() -> None:
    environment = ModelEnvironment(corridor(), rewards="expected")
    environment.reset(seed=0)
    assert environment.step(0)[1] == pytest.approx(-1.25)


@pytest.mark.parametrize("rewards", ["sampled", "expected"])
def test_a_reward_that_no_float_holds_is_refused(rewards: Any) -> None:
    on = boolean("on")
    model = Model("huge", [on], [Action("go", {on: True})], rewards=[10**399], initial={on: False})
    environment = ModelEnvironment(model, rewards=rewards)
    environment.reset(seed=0)
    with pytest.raises(ModelError, match=r"there is a reward beyond 10\^200"):
        environment.step(0)


def test_a_horizon_and_dead_ends_truncate() -> None:
    environment = ModelEnvironment(corridor(horizon=2))
    environment.reset(seed=0)
    assert [environment.step(1)[3] for _ in range(2)] == [False, True]
    trap = boolean("trap")
    model = Model(
        "trap", [trap], [Action("go", {trap: True}, applicable="not trap")], initial={trap: False}
    )
    environment = ModelEnvironment(model)
    environment.reset(seed=0)
    _, _, terminated, truncated, info = environment.step(0)
    assert (terminated, truncated, info["dead_end"]) == (False, True, True)


def test_what_is_seen_of_a_hidden_state_is_channels_and_observed_features() -> None:
    tiger = ModelEnvironment(library.load("tiger").model)
    seen, _ = tiger.reset(seed=0)
    assert set(seen) == {channel.name for channel in tiger.model.observations}
    assert "tiger" not in seen
    rocks = ModelEnvironment(library.load("rocksample").model)
    seen, _ = rocks.reset(seed=0)
    observed = {feature.name for feature in rocks.model.features if feature.observed}
    assert observed
    assert set(seen) == observed | {channel.name for channel in rocks.model.observations}
    assert all(int(seen[name]) == rocks.model.feature(name).index(rocks.state[name]) for name in observed)


def test_equal_seeds_give_equal_episodes() -> None:
    def run(seed: int) -> list[Any]:
        environment = ModelEnvironment(library.load("rocksample").model)
        random = np.random.default_rng(0)
        found: list[Any] = [environment.reset(seed=seed)[0]]
        for _ in range(40):
            found.append(environment.step(int(random.integers(environment.action_space.n)))[:4])  # type: ignore[attr-defined]
        return found

    assert run(3) == run(3)
    assert run(3) != run(4)


def test_transitions_have_the_probabilities_of_the_model() -> None:
    """The share of 4,000 steps on that worked, 3/4, within five standard errors of 0.007."""
    environment = ModelEnvironment(corridor())
    environment.reset(seed=5)
    counts: Counter[int] = Counter()
    for _ in range(4000):
        environment.reset()
        counts[int(environment.step(0)[0][0])] += 1
    assert abs(counts[1] / 4000 - 0.75) < 0.035


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"rewards": "all"}, "sampled or expected"),
        ({"render_mode": "human"}, "ansi"),
        ({"max_steps": 0}, "1"),
    ],
)
def test_wrong_arguments_are_refused(arguments: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ModelEnvironment(corridor(), **arguments)


def test_a_step_needs_a_reset_and_an_action() -> None:
    environment = ModelEnvironment(corridor())
    with pytest.raises(RuntimeError, match="reset"):
        environment.step(0)
    environment.reset()
    with pytest.raises(ValueError, match="no action 7"):
        environment.step(7)


# -- toy texts as models ---------------------------------------------------------------------------


def oracle(table: Any, discount: float) -> dict[int, float]:
    """The optimal values by value iteration on P itself, in which a step that terminates ends."""
    values = dict.fromkeys(table, 0.0)
    for _ in range(3000):
        values = {
            s: max(
                sum(p * (r + (0.0 if ends else discount * values[t])) for p, t, r, ends in table[s][a])
                for a in table[s]
            )
            for s in table
        }
    return values


def made(name: str, **settings: Any) -> gymnasium.Env[Any, Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return gymnasium.make(name, **settings)


TEXTS = [
    ("Taxi-v4", {}),
    ("FrozenLake-v1", {}),
    ("FrozenLake-v1", {"map_name": "8x8", "is_slippery": False}),
    ("CliffWalking-v1", {}),
]


@pytest.mark.parametrize(("name", "settings"), TEXTS)
def test_toy_texts_have_the_values_of_their_tables(name: str, settings: Any) -> None:
    environment = made(name, **settings)
    found = model_of(environment, discount="19/20")
    inner: Any = environment.unwrapped
    assert found.probability_error <= 1e-15
    assert found.reward_error == 0
    values = oracle(inner.P, 0.95)
    expected = sum(p * values[s] for s, p in enumerate(inner.initial_state_distrib))
    reduction = reduce(flat_process(compile_model(found.model)))
    solution = solve_mdp(reduction.quotient.mdp)
    assert reduction.project_initial() @ solution.values == pytest.approx(expected, abs=1e-9)


def test_an_environment_without_a_registered_name_is_read_too() -> None:
    from gymnasium.envs.toy_text.taxi import TaxiEnv

    found = model_of(TaxiEnv(), discount="19/20", name="Taxi")
    assert found.model.states == 404  # 500 less those where the passenger stands at the destination, but 4
    assert found.unreachable == 96
    assert [feature.name for feature in found.model.features] == ["state"]
    assert sum(enumerate_model(found.model).terminal) == 4


class Table:
    """An environment with a table of its own."""

    def __init__(self, table: Any, start: Any) -> None:
        self.P, self.initial_state_distrib = table, start


BOTH_WAYS = {
    0: {0: [(0.5, 1, 1.0, False), (0.25, 1, 5.0, True), (0.25, 0, 0.0, False)], 1: [(1.0, 0, -1.0, False)]},
    1: {0: [(1.0, 0, 0.5, False)], 1: [(1.0, 1, 3.0, True)]},
}


def test_a_state_that_is_reached_both_ways_gets_a_feature_that_says_which() -> None:
    found = model_of(Table(BOTH_WAYS, [1.0, 0.0]), discount="9/10", action_names=["a", "b"])
    assert [feature.name for feature in found.model.features] == ["state", "done"]
    check_model(found.model)
    reduction = reduce(flat_process(compile_model(found.model)))
    values = solve_mdp(reduction.quotient.mdp).values
    assert reduction.project_initial() @ values == pytest.approx(oracle(BOTH_WAYS, 0.9)[0], abs=1e-9)


def test_a_toy_text_model_passes_the_kit_and_is_an_environment() -> None:
    model = model_of(made("FrozenLake-v1")).model
    check_model(model)
    check_env(ModelEnvironment(model, max_steps=20), skip_render_check=True)


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        (Table(None, None), "does not tell its dynamics"),
        (Table({0: {0: [(0.5, 0, 0.0, False)]}}, [1.0]), "sum to 0.5"),
        (Table({0: {0: [(1.0, 0, 0.0, False)]}}, [0.5]), "the start: the probabilities sum to 0.5"),
        (Table({0: {0: [(1.0, 0, 3.14159265, False)]}}, [1.0]), "give tolerance="),
    ],
)
def test_what_can_not_be_a_model_is_refused(environment: Any, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        model_of(environment)


def test_a_bound_on_what_rounding_changed_is_reported() -> None:
    table = {
        0: {0: [(1 / np.pi, 0, 1.0, True), (1 - 1 / np.pi, 1, 0.0, False)]},
        1: {0: [(1.0, 0, 0, True)]},
    }
    found = model_of(Table(table, [0.5, 0.5]), tolerance=1e-6)
    assert 0 < found.probability_error < 1e-7  # 1 / pi is within 1 / (113 * 10,000) of 113 / 355
