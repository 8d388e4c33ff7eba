"""Dynamic programming on enumerated models against closed forms and all policies of small models."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from random_models import random_model

from factored_polca.explicit import dynamic_programming as floating
from factored_polca.explicit import exact_dynamic_programming as exact
from factored_polca.explicit.elimination import SingularSystem, solve
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.explicit.minimiser import minimise
from factored_polca.models import (
    Action,
    Feature,
    Model,
    boolean,
)

F = Fraction
SEEDS = range(60)
SMALL = {"features": (1, 3), "values": (2, 3), "actions": (1, 3), "max_states": 6}


def test_linear_systems_are_solved_exactly() -> None:
    # The Hilbert matrix H_ij = 1/(i+j+1) with H x = (1, 0, 0): the first column of its inverse is
    # (9, -36, 30).
    hilbert = [{j: F(1, i + j + 1) for j in range(3)} for i in range(3)]
    assert solve(hilbert, [F(1), F(0), F(0)]) == [9, -36, 30]
    with pytest.raises(SingularSystem):
        solve([{0: F(1), 1: F(2)}, {0: F(2), 1: F(4)}], [F(1), F(1)])


def test_a_two_state_chain_has_its_known_value() -> None:
    # From `up` one stays with 0.9, earning 1; `down` is absorbing: V(up) = 1 / (1 - 0.9 gamma).
    model = Model(
        "chain",
        [boolean("up")],
        [Action("go", {"up": "{true: 0.9, false: 0.1} if up else false"})],
        rewards="1 if up else 0",
        discount="0.5",
    )
    mdp = enumerate_model(model)
    assert exact.evaluate_policy(mdp, (0, 0)) == (0, F(20, 11))
    assert exact.optimal_solution(mdp) == exact.ExactSolution((F(0), F(20, 11)), (0, 0))
    assert np.allclose(floating.value_iteration(mdp.to_arrays()), [0, 20 / 11], atol=1e-11, rtol=0)
    assert np.allclose(floating.evaluate_policy(mdp.to_arrays(), (0, 0)), [0, 20 / 11], atol=1e-14)


@pytest.mark.parametrize("p", [F(2, 5), F(1, 3), F(1, 2)])
def test_gamblers_ruin_has_its_known_probabilities(p: Fraction) -> None:
    # Feller (1968), XIV.2: from i of N the gambler wins with (1 - r^i) / (1 - r^N), r = (1-p)/p.
    last = 6
    model = Model(
        "ruin",
        [Feature("x", range(last + 1))],
        [Action("bet", {"x": f"{{x + 1: {p}, x - 1: {1 - p}}}"}, rewards=f"1 if x' == {last} else 0")],
        terminal=f"x in {{0, {last}}}",
        discount=1,
    )
    mdp = enumerate_model(model)
    ratio = (1 - p) / p
    wins = [F(i, last) if ratio == 1 else (1 - ratio**i) / (1 - ratio**last) for i in range(1, last)]
    values = exact.evaluate_policy(mdp, [-1, *[0] * (last - 1), -1])
    assert list(values) == [0, *wins, 0]
    assert exact.optimal_solution(mdp).values == values
    wanted = [float(v) for v in values]
    # A change below 1e-14 leaves an error below 1e-14 / (1 - contraction), contraction < 0.91 here.
    assert np.allclose(floating.value_iteration(mdp.to_arrays(), 1e-14), wanted, atol=1e-12, rtol=0)


def _maze(discount: object = "0.9", **rewards: str) -> ExactMDP:
    """x = 0 ends; 3 is a dead end; `safe` steps down, `risky` may slip from 2 to 3; `stay` stays."""
    model = Model(
        "maze",
        [Feature("x", range(6))],
        [
            Action("risky", {"x": "{x - 1: 0.9, x + 1: 0.1}"}, applicable="x in {1, 2}"),
            Action("safe", {"x": "{x - 1: 0.5, x: 0.5}"}, applicable="x in {1, 2}", rewards="-1"),
            Action("stay", applicable="x in {1, 5}", rewards=rewards.get("stay", "-1")),
            Action("fall", {"x": "3"}, applicable="x == 4", rewards="1000"),
        ],
        terminal="x == 0",
        discount=discount,  # type: ignore[arg-type]
    )
    return enumerate_model(model)


def test_dead_ends_are_worth_minus_infinity_and_are_avoided() -> None:
    mdp = _maze()
    minus_infinity = float("-inf")
    # `risky` at 2 may enter 3, so only `safe` is left: V(2) = -1 + 0.45 (V(1) + V(2));
    # at 1 `risky` is best: V(1) = 0.09 V(2); at 5 one stays for ever: -1 / (1 - 0.9).
    v2 = F(-1) / (1 - F(45, 100) - F(45, 100) * F(9, 100))
    wanted = (F(0), F(9, 100) * v2, v2, minus_infinity, minus_infinity, F(-10))
    assert exact.optimal_solution(mdp) == exact.ExactSolution(wanted, (-1, 0, 1, -1, -1, 2))
    assert exact.lost_states(mdp) == (False, False, False, True, True, False)
    arrays = mdp.to_arrays()
    floats = floating.value_iteration(arrays)
    assert np.array_equal(np.isneginf(floats), [False, False, False, True, True, False])
    assert np.allclose(floats, [float(v) for v in wanted], atol=1e-10)
    assert floating.greedy_policy(floating.action_values(arrays, floats)) == (-1, 0, 1, -1, -1, 2)
    # A policy that is undefined at 1 loses 2 too, which may get there.
    assert exact.evaluate_policy(mdp, (-1, -1, 1, -1, 3, 2))[1:5] == (minus_infinity,) * 4
    assert np.isneginf(floating.evaluate_policy(arrays, (-1, -1, 1, -1, 3, 2))[1:5]).all()
    with pytest.raises(ValueError, match="'safe' at state 5"):
        exact.evaluate_policy(mdp, (-1, 0, 1, -1, -1, 1))
    with pytest.raises(ValueError, match="'safe' at state 5"):
        floating.evaluate_policy(arrays, (-1, 0, 1, -1, -1, 1))


def test_without_discount_resting_is_worth_nothing_and_circles_of_reward_are_refused() -> None:
    resting = exact.optimal_solution(_maze(1, stay="0"))
    # At 1 staying for ever is worth 0, and so it is at 5; at 2: V = -1 + 0.5 V.
    assert resting.values == (0, 0, F(-2), exact.LOST, exact.LOST, 0)
    assert resting.policy[1] in (0, 2)
    with pytest.raises(ValueError, match="no policy surely ends from state 5"):
        exact.optimal_solution(_maze(1, stay="-1"))
    with pytest.raises(ValueError, match="infinite or undefined"):
        exact.optimal_solution(_maze(1, stay="1 if x == 1 else 0"))


@pytest.mark.parametrize("seed", SEEDS[:15])
def test_no_policy_is_better_than_the_optimal_one(seed: int) -> None:
    mdp = enumerate_model(random_model(seed, **SMALL))  # type: ignore[arg-type]
    numbers = range(len(mdp.actions))
    choices = [[a for a in numbers if mdp.applicable[a][s]] or [-1] for s in range(mdp.states)]
    policies = list(product(*choices))[:200]
    best = exact.optimal_solution(mdp)
    for policy in policies:
        values = exact.evaluate_policy(mdp, policy)
        assert all(v <= w for v, w in zip(values, best.values, strict=True))
    assert exact.evaluate_policy(mdp, best.policy) == best.values


@pytest.mark.parametrize("seed", SEEDS[:20])
def test_exact_and_floating_values_satisfy_bellmans_equation(seed: int) -> None:
    mdp = enumerate_model(random_model(seed, max_states=48))
    best = exact.optimal_solution(mdp)
    q = exact.action_values(mdp, best.values)
    for s in range(mdp.states):
        if not mdp.terminal[s]:
            assert best.values[s] == max(q[a][s] for a in range(len(q)))
            assert best.policy[s] == min(a for a in range(len(q)) if q[a][s] == best.values[s])
    arrays = mdp.to_arrays()
    wanted = np.array([float(v) for v in best.values])
    # 1e-11 from the iteration, the rest for rounding at |V| up to 1000.
    assert np.allclose(floating.value_iteration(arrays), wanted, atol=1e-10, rtol=1e-12)
    assert np.allclose(floating.evaluate_policy(arrays, best.policy), wanted, atol=1e-10, rtol=1e-12)


@pytest.mark.parametrize("seed", SEEDS[:20])
def test_equivalent_states_have_equal_values(seed: int) -> None:
    mdp = enumerate_model(random_model(seed, max_states=48))
    values = exact.optimal_solution(mdp).values
    for members in minimise(mdp).members():
        assert len({values[s] for s in members}) == 1
