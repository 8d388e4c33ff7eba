"""The augmented MDP: closed forms where its summaries lose nothing, and that it is repeatable."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from factored_polca.explicit.entropy_policy import EntropyPolicy, entropy_bins
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.models.errors import ModelError
from factored_polca.solvers.augmented_mdp import solve_amdp
from factored_polca.solvers.pomdp_problem import prepare
from factored_polca.solvers.pomdp_result import Demand


def random_dynamics(seed: int, S: int, A: int) -> tuple[np.ndarray, np.ndarray]:
    """Transitions [a, s, t] and rewards [a, s] without symmetry."""
    random = np.random.default_rng(seed)
    return random.dirichlet(np.ones(S), size=(A, S)), random.normal(size=(A, S))


def best_policy(
    transitions: np.ndarray, rewards: np.ndarray, discount: float
) -> tuple[list[int], np.ndarray]:
    """The optimum of the MDP, by trying every deterministic policy."""
    A, S, _ = transitions.shape
    states = np.arange(S)
    found, best = [], np.full(S, -np.inf)
    for policy in itertools.product(range(A), repeat=S):
        rows, gains = transitions[list(policy), states], rewards[list(policy), states]
        value = np.linalg.solve(np.eye(S) - discount * rows, gains)
        if np.all(value >= best - 1e-12):
            found, best = list(policy), value
    return found, best


def tiger() -> ArrayPOMDP:
    """tiger.95: listening is right with probability 0.85."""
    listen = [np.diag([0.85, 0.15]), np.diag([0.15, 0.85])]
    reset = [np.full((2, 2), 0.5)]
    rewards = np.array([[-1.0, -1.0], [-100.0, 10.0], [10.0, -100.0]])
    return array_pomdp([listen, reset, reset], rewards, np.array([0.5, 0.5]), 0.95)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("how", ["observation", "class"])
def test_with_perfect_observations_it_plans_the_optimum_of_the_mdp(seed, how):
    S, A, discount = 4, 3, 0.9
    transitions, rewards = random_dynamics(seed, S, A)
    start = np.eye(S)[seed % S]
    if how == "class":
        kernel = [[transitions[a]] for a in range(A)]
        pomdp = array_pomdp(kernel, rewards, start, discount, observed=np.arange(S))
    else:
        kernel = [[transitions[a] * np.eye(S)[o] for o in range(S)] for a in range(A)]
        pomdp = array_pomdp(kernel, rewards, start, discount)
    found = solve_amdp(prepare(pomdp), runs=3, steps=3)
    policy, value = best_policy(transitions, rewards, discount)
    assert found.policy.choose(np.eye(S)).tolist() == policy
    assert found.value == pytest.approx(float(start @ value), abs=1e-6)
    assert found.lower <= float(start @ value) <= found.upper
    assert found.status == "converged"


def test_a_single_summary_earns_the_mean_reward():
    # nothing is seen and the belief stays uniform: a0 pays 1 on average, a1 pays 0.75
    rewards = np.array([[2.0, 0.0], [0.75, 0.75]])
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    pomdp = array_pomdp([[swap], [swap]], rewards, np.array([0.5, 0.5]), 0.8)
    found = solve_amdp(prepare(pomdp), runs=2, steps=4)
    assert found.value == pytest.approx(5, abs=1e-6)
    assert found.policy.action(np.array([0.5, 0.5])) == 0


def test_mass_that_ends_earns_nothing_more():
    # 1 a step, going on with probability 1/2: 1 / (1 - 0.9 / 2)
    pomdp = array_pomdp(
        [[np.array([[0.5, 0.5], [0.0, 0.0]])]],
        np.array([[1.0, 0.0]]),
        np.array([1.0, 0.0]),
        0.9,
        terminal=np.array([False, True]),
    )
    found = solve_amdp(prepare(pomdp), runs=2, steps=3)
    assert found.value == pytest.approx(1 / 0.55, abs=1e-6)
    assert found.policy.choose(np.eye(2)).tolist() == [0, 0]


def test_without_a_future_the_best_reward_counts():
    transitions, rewards = random_dynamics(3, 3, 2)
    pomdp = array_pomdp([[m] for m in transitions], rewards, np.array([0.2, 0.3, 0.5]), 0.0)
    found = solve_amdp(prepare(pomdp), bins=20, runs=1, steps=1, rounds=1)
    assert found.value == pytest.approx((rewards @ pomdp.initial).max(), abs=1e-9)


def test_tiger_listens_when_in_doubt_and_opens_when_sure():
    found = solve_amdp(prepare(tiger()))
    beliefs = np.array([[0.5, 0.5], [0.99, 0.01], [0.01, 0.99]])
    assert found.policy.choose(beliefs).tolist() == [0, 2, 1]
    assert found.lower <= 19.371368 <= found.upper  # V*, on which pomdp-solve and SARSOP agree
    assert found.lower <= found.value <= found.upper
    assert found.guarantee.kind == "heuristic"
    assert found.vectors == 2 * 5


def test_the_plan_uses_the_bins_of_the_policy_it_returns():
    # of 3 states one is never reached; the entropy is still taken over 3: bins must agree on that
    stay = np.eye(3)
    rewards = np.array([[1.0, 0.0, 0.0], [0.7, 0.6, 0.0]])
    pomdp = array_pomdp([[stay], [stay]], rewards, np.array([0.6, 0.4, 0.0]), 0.5)
    found = solve_amdp(prepare(pomdp), bins=7, runs=1, steps=2)
    assert isinstance(found.policy, EntropyPolicy)
    here = found.policy.actions[0, entropy_bins(pomdp.initial[None, :], 7)[0]]
    assert here == 1  # 0.66 on average, a0 gives 0.6
    assert found.value == pytest.approx(1.32, abs=1e-6)
    # a bin without a sample takes the action of the nearest one that has one
    assert found.policy.actions[0].tolist() == [1] * 7


def test_the_same_seed_gives_the_same_result_and_policies_take_original_numbers():
    transitions, rewards = random_dynamics(8, 4, 2)
    random = np.random.default_rng(8)
    blur = random.dirichlet(np.ones(2), size=4)
    seen = [transitions[0] * blur[:, o] for o in range(2)]
    other = [transitions[1] * blur[:, o] for o in range(2)]
    rewards = np.array([rewards[0], rewards[0], rewards[1]])  # a1 is a0 again
    pomdp = array_pomdp([seen, seen, other], rewards, np.full(4, 0.25), 0.9)
    first, second = (solve_amdp(prepare(pomdp), Demand(seed=5)) for _ in range(2))
    assert np.array_equal(first.policy.actions, second.policy.actions)
    assert (first.value, first.iterations) == (second.value, second.iterations)
    assert set(np.unique(first.policy.actions)) <= {0, 2}
    assert first.lower <= first.value <= first.upper


def test_limits_stop_early_with_bounds_that_hold():
    late = solve_amdp(prepare(tiger()), Demand(deadline=0.0))
    assert late.status == "time limit"
    assert late.lower <= 19.371368 <= late.upper
    assert "before the first plan" in late.note
    assert late.policy.choose(np.eye(2)).tolist() == [2, 1]  # QMDP's
    few = solve_amdp(prepare(tiger()), Demand(iterations=1))
    assert few.status == "iteration limit"
    assert few.iterations < 100

    def interrupt(lower: float, upper: float) -> None:
        raise KeyboardInterrupt

    stopped = solve_amdp(prepare(tiger()), Demand(progress=interrupt))
    assert stopped.status == "interrupted"
    assert stopped.lower <= 19.371368 <= stopped.upper


def test_where_every_state_is_dead_the_value_is_zero():
    pomdp = array_pomdp([[np.eye(2)]], np.zeros((1, 2)), np.array([0.5, 0.5]), 0.9)
    found = solve_amdp(prepare(pomdp))
    assert (found.lower, found.value, found.upper) == (0, 0, 0)
    assert found.policy.choose(np.eye(2)).tolist() == [0, 0]


@pytest.mark.parametrize("wrong", [{"bins": 0}, {"runs": 0}, {"steps": 0}, {"rounds": 0}])
def test_numbers_below_one_are_refused(wrong):
    with pytest.raises(ModelError, match="at least 1"):
        solve_amdp(prepare(tiger()), **wrong)


def test_a_discount_of_one_is_refused():
    pomdp = array_pomdp([[np.eye(1)]], np.ones((1, 1)), np.ones(1), 1.0)
    with pytest.raises(ModelError, match="below 1"):
        solve_amdp(prepare(pomdp))
