"""Simulation of flat policies: means against values in closed form or by linear systems."""

from __future__ import annotations

import math

import numpy as np
import pytest

from factored_polca.explicit.alpha_vectors import AlphaSet, AlphaVectors, StagedVectors
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.policy_graph import PolicyGraph, evaluate, value
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.models import ModelError
from factored_polca.simulation import Simulation, pomdp, simulate_policy
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand

LISTEN, OPEN_LEFT, OPEN_RIGHT = 0, 1, 2


def tiger(discount: float) -> ArrayPOMDP:
    """Kaelbling, Littman & Cassandra (1998): 85 % right, -1, 10 or -100; states: tiger left, right."""
    hear = np.array([[0.85, 0.15], [0.15, 0.85]])
    listen = [np.diag(hear[:, o]) for o in range(2)]
    opened = [np.full((2, 2), 0.25) for _ in range(2)]
    rewards = np.array([[-1.0, -1.0], [-100.0, 10.0], [10.0, -100.0]])
    return array_pomdp([listen, opened, opened], rewards, np.array([0.5, 0.5]), discount)


def vectors(states: int, *sets: tuple[list[int], list[list[float]], list[int]]) -> AlphaVectors:
    """Alpha vectors from (states, vectors, actions)."""
    parts = [AlphaSet(np.array(s), np.array(v, dtype=float), np.array(a)) for s, v, a in sets]
    return AlphaVectors(states, tuple(parts))


def assert_close(found: Simulation, expected: float) -> None:
    """Within four standard errors, and what was cut off."""
    assert found.standard_error >= 0
    assert abs(found.mean - expected) <= 4 * found.standard_error + found.truncation + 1e-9


def two_growls(discount: float) -> float:
    """The value in the tiger problem of opening once one door has two growls more than the other.

    V0 and V1 are the values at a difference of 0 and 1; a second growl of the same side comes with the
    chance q = 0.85^2 + 0.15^2 / (0.85 + 0.15), and the other door is then opened.
    """
    q = 0.85**2 + 0.15**2
    opened = (10 * 0.85**2 - 100 * 0.15**2) / q
    g = discount
    # V0 = -1 + g V1,  V1 = -1 + g (q (opened + g V0) + (1 - q) V0)
    return (-1 - g + g * g * q * opened) / (1 - g * g * (q * g + 1 - q))


def test_the_optimal_policy_of_the_tiger_earns_its_value() -> None:
    problem = tiger(0.95)
    solution = solve_pomdp(problem, "sarsop", demand=Demand(gap=1e-3))
    found = simulate_policy(problem, solution.policy, episodes=3000, seed=4)
    assert_close(found, 19.371368)  # SOLVERS.md: several solvers agree
    assert two_growls(0.95) == pytest.approx(19.371368, abs=1e-6)
    assert found.mean >= solution.lower - 4 * found.standard_error
    assert found.ended == 0
    assert found.truncation == pytest.approx(0.95**found.steps / 0.05 * 100)


def test_a_policy_over_entropy_bins_earns_what_it_must() -> None:
    """Normalised entropies: 1 at the start, 0.61 after a growl, 0.195 after two: bins 4, 3 and 0."""
    actions = np.full((2, 5), LISTEN)
    actions[0, 0], actions[1, 0] = OPEN_RIGHT, OPEN_LEFT
    found = simulate_policy(tiger(0.9), EntropyPolicy(actions), episodes=3000, seed=5)
    assert_close(found, two_growls(0.9))


def test_a_policy_graph_earns_what_it_must() -> None:
    """Listen, then open the door that growled not, for ever: V = -1 + g (-6.5 + g V)."""
    go_on = np.array([[0], [0]])
    graph = PolicyGraph(
        np.array([LISTEN, OPEN_RIGHT, OPEN_LEFT]), (np.array([[1], [2]]), go_on, go_on), np.array([0])
    )
    found = simulate_policy(tiger(0.8), graph, episodes=4000, seed=6)
    assert_close(found, (-1 - 0.8 * 6.5) / (1 - 0.64))


def staged_tiger() -> StagedVectors:
    last = vectors(2, ([0, 1], [[-1, -1], [-100, 10], [10, -100]], [LISTEN, OPEN_LEFT, OPEN_RIGHT]))
    listen = vectors(2, ([0, 1], [[-1, -1]], [LISTEN]))
    return StagedVectors((last, listen, listen))


def test_a_staged_policy_runs_for_just_its_steps() -> None:
    """Listen twice; open where both growls agree, else listen: -2 + 0.7225 10 - 0.0225 100 - 0.255."""
    found = simulate_policy(tiger(1.0), staged_tiger(), episodes=4000, seed=7)
    assert_close(found, 2.72)
    assert (found.steps, found.truncation) == (3, 0.0)
    assert simulate_policy(tiger(1.0), staged_tiger(), episodes=5, steps=3).steps == 3
    with pytest.raises(ModelError, match="for 3 steps"):
        simulate_policy(tiger(1.0), staged_tiger(), episodes=5, steps=2)


def random_pomdp(random: np.random.Generator) -> ArrayPOMDP:
    """A random POMDP with two classes, a terminal state, and different observations by action."""
    states, kernel = 5, []
    terminal = np.arange(states) == 4
    for observations in (1, 2, 3):
        weights = random.dirichlet(np.full(states * observations, 0.5), size=states)
        weights[terminal] = 0
        kernel.append(list(weights.reshape(states, observations, states).transpose(1, 0, 2)))
    rewards = random.integers(-5, 6, (3, states)) * ~terminal
    observed = np.array([0, 2, 0, 2, 0])
    return array_pomdp(
        kernel, rewards, random.dirichlet(np.ones(states)), 0.8, terminal=terminal, observed=observed
    )


@pytest.mark.parametrize("seed", range(6))
def test_random_graphs_earn_what_the_linear_system_says(seed: int) -> None:
    random = np.random.default_rng(seed)
    problem = random_pomdp(random)
    actions = random.integers(0, 3, 4)
    tables = tuple(random.integers(0, 4, (int(action) + 1, 3)) for action in actions)
    graph = PolicyGraph(actions, tables, random.integers(0, 4, 3))
    expected = value(graph, problem, evaluate(graph, problem), problem.initial)
    assert_close(simulate_policy(problem, graph, episodes=3000, seed=seed), expected)


@pytest.mark.parametrize("seed", range(4))
def test_beliefs_and_graphs_agree_where_actions_follow_from_what_is_seen(seed: int) -> None:
    """One vector for each class: the policy is the graph whose node is the class; draws are the same."""
    problem = random_pomdp(np.random.default_rng(seed))
    policy = vectors(5, ([0, 2], [[0, 0]], [1]), ([1, 3], [[0, 0]], [2]))
    table = np.array([0, -1, 1])
    graph = PolicyGraph(np.array([1, 2]), (np.tile(table, (2, 1)), np.tile(table, (3, 1))), table)
    by_belief = simulate_policy(problem, policy, episodes=300, seed=seed)
    by_node = simulate_policy(problem, graph, episodes=300, seed=seed)
    np.testing.assert_array_equal(by_belief.returns, by_node.returns)


def test_what_is_seen_at_the_start_narrows_the_belief() -> None:
    """The hidden half of the state is known from the seen one; action 1 pays where it is 1."""
    stay = np.eye(4)  # states (seen, hidden): 00 01 10 11
    hidden = np.array([0, 1, 0, 1])
    rewards = np.array([hidden == 0, hidden == 1], dtype=float)
    problem = array_pomdp(
        [[stay], [stay]], rewards, np.array([0.5, 0, 0, 0.5]), 0.5, observed=np.array([0, 0, 1, 1])
    )
    both = [[1.0, 0.0], [0.0, 1.0]]
    found = simulate_policy(
        problem, vectors(4, ([0, 1], both, [0, 1]), ([2, 3], both, [0, 1])), episodes=50, steps=4
    )
    assert found.returns.tolist() == [1 + 0.5 + 0.25 + 0.125] * 50


def test_what_is_seen_after_a_step_narrows_the_belief() -> None:
    """A blind step leads to 0 or to 1, which are told apart; action s pays in state s."""
    kernel = np.array([[0.5, 0.5], [0.5, 0.5]])
    problem = array_pomdp(
        [[kernel], [kernel]], np.eye(2), np.array([0.5, 0.5]), 0.5, observed=np.array([0, 1])
    )
    policy = EntropyPolicy(np.array([[0], [1]]))
    assert simulate_policy(problem, policy, episodes=50, steps=2).returns.tolist() == [1.5] * 50


def test_an_episode_that_goes_on_is_known_to_go_on() -> None:
    """Each step ends with the chance 0.9; what is left is in state 1, where only action 1 pays."""
    step = np.array([[0, 0.1, 0.9], [0, 0.1, 0.9], [0, 0, 0]])
    rewards = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    problem = array_pomdp(
        [[step], [step]], rewards, np.array([1.0, 0, 0]), 0.5, terminal=np.array([False, False, True])
    )
    policy = EntropyPolicy(np.array([[0], [1], [0]]))
    found = simulate_policy(problem, policy, episodes=4000, seed=8)
    assert_close(found, 1 + 0.05 / (1 - 0.05))
    assert found.ended == 4000
    assert found.truncation == 0


def test_nothing_happens_from_a_terminal_start() -> None:
    none = np.zeros((1, 1))
    problem = array_pomdp([[none]], none, np.ones(1), 0.9, terminal=np.array([True]))
    for policy in (vectors(1), EntropyPolicy(np.array([[0]])), StatePolicy(np.array([[-1]]))):
        found = simulate_policy(problem, policy, episodes=3)
        assert (found.mean, found.ended, found.truncation) == (0, 3, 0)


def chain(applies: bool = True) -> ArrayPOMDP:
    """From state 0 on to the terminal 2 with the chance 1/4, at -1 a step; action 1 leads into 1."""
    try_it = np.array([[0.75, 0, 0.25], [0, 0, 0], [0, 0, 0]])
    lose = np.array([[0, float(applies), 0], [0, 0, 0], [0, 0, 0]])
    found = array_pomdp(
        [[np.eye(3)], [np.eye(3)]], np.zeros((2, 3)), np.array([1.0, 0, 0]), 0.9, observed=np.arange(3)
    )
    return ArrayPOMDP(
        found.actions, found.observations, tuple((type(found.kernel[0][0])(m),) for m in (try_it, lose)),
        np.array([[-1.0, 0, 0], [-5.0, 0, 0]]), np.array([False, False, True]), found.observed,
        found.initial, 0.9,
    )  # fmt: skip


def test_a_policy_of_states_earns_what_it_must() -> None:
    """V = -1 + 0.9 0.75 V."""
    found = simulate_policy(chain(), StatePolicy(np.array([[0, -1, -1]])), episodes=4000, seed=9)
    assert_close(found, -1 / (1 - 0.9 * 0.75))
    assert found.ended == 4000


def test_a_dead_end_ends_an_episode() -> None:
    found = simulate_policy(chain(), StatePolicy(np.array([[1, -1, -1]])), episodes=10)
    assert (found.mean, found.ended, found.truncation) == (-5, 10, 0)


def test_an_action_that_does_not_apply_is_refused() -> None:
    with pytest.raises(ModelError, match="'a1' where it does not apply"):
        simulate_policy(chain(applies=False), StatePolicy(np.array([[1, -1, -1]])), episodes=10)


def test_a_staged_policy_of_states_takes_its_stages_in_order() -> None:
    """Rewards 1, 10 and 100 of three actions, the last row first."""
    stay = [[np.eye(1)]] * 3
    problem = array_pomdp(stay, np.array([[1.0], [10.0], [100.0]]), np.ones(1), 0.5)
    policy = StatePolicy(np.array([[0], [1], [2]]), staged=True)
    found = simulate_policy(problem, policy, episodes=2)
    assert found.returns.tolist() == [100 + 5 + 0.25] * 2
    assert found.truncation == 0
    with pytest.raises(ModelError, match="for 3 steps"):
        simulate_policy(problem, policy, steps=4)


def test_a_graph_that_does_not_know_what_to_do_is_refused() -> None:
    unknown = PolicyGraph(np.array([LISTEN]), (np.array([[0], [-1]]),), np.array([0]))
    with pytest.raises(ModelError, match="no node"):
        simulate_policy(tiger(0.9), unknown, episodes=20)
    unknown = PolicyGraph(np.array([LISTEN]), (np.array([[0], [0]]),), np.array([-1]))
    with pytest.raises(ModelError, match="no node"):
        simulate_policy(tiger(0.9), unknown, episodes=20)


def test_a_graph_without_a_node_ends_where_nothing_is_ever_earned() -> None:
    """State 1 is not terminal but worthless, and is told from state 0."""
    leave = np.array([[0.5, 0.5], [0.0, 1.0]])
    problem = array_pomdp(
        [[leave]], np.array([[1.0, 0.0]]), np.array([1.0, 0]), 0.9, observed=np.array([0, 1])
    )
    graph = PolicyGraph(np.array([0]), (np.array([[0, -1]]),), np.array([0, -1]))
    found = simulate_policy(problem, graph, episodes=3000, seed=10)
    assert_close(found, 1 / (1 - 0.45))
    assert found.ended == 3000


def test_discount_zero_is_one_step_and_one_state_needs_no_draws() -> None:
    problem = array_pomdp([[np.eye(1)]], np.array([[3.0]]), np.ones(1), 0.0)
    found = simulate_policy(problem, vectors(1, ([0], [[3.0]], [0])), episodes=4)
    assert (found.steps, found.mean, found.standard_error) == (1, 3.0, 0.0)
    assert simulate_policy(problem, vectors(1, ([0], [[3.0]], [0])), episodes=1).mean == 3.0
    assert math.isnan(simulate_policy(problem, vectors(1, ([0], [[3.0]], [0])), episodes=1).standard_error)


def test_the_same_seed_gives_the_same_returns() -> None:
    runs = [simulate_policy(tiger(0.5), staged_tiger(), episodes=60, seed=s).returns for s in (1, 1, 2)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert np.any(runs[0] != runs[2])


def test_episodes_are_run_in_chunks_that_fit_into_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pomdp, "BELIEF_NUMBERS", 2 * 700)  # 700 beliefs over two states
    found = simulate_policy(tiger(1.0), staged_tiger(), episodes=2000, seed=11)
    assert len(found.returns) == found.episodes == 2000
    assert_close(found, 2.72)


@pytest.mark.parametrize("wrong", [{"episodes": 0}, {"steps": 0}])
def test_fewer_than_one_episode_or_step_is_refused(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        simulate_policy(tiger(0.9), staged_tiger(), **wrong)  # type: ignore[arg-type]
