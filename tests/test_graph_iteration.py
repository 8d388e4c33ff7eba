"""Policy iteration on policy graphs: published vector sets, closed forms, brute force at any belief."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog
from tree_brackets import bracket, cheese, grid_4x3, line, line_value, machine, random_pomdp, tiger

from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.models.errors import ModelError
from factored_polca.solvers.bellman_residual import excess
from factored_polca.solvers.graph_iteration import solve_by_graph_iteration
from factored_polca.solvers.pomdp_problem import prepare
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution

SEEDS = range(40)


def check(solution: POMDPSolution, pomdp: ArrayPOMDP) -> None:
    """What holds of every solution, whatever its status."""
    assert solution.lower <= solution.value <= solution.upper
    assert np.all(solution.root_lower <= solution.root_upper)
    lows, highs = [b.lower for b in solution.history], [b.upper for b in solution.history]
    assert lows == sorted(lows)
    assert highs == sorted(highs, reverse=True)
    assert isinstance(solution.policy, AlphaVectors)
    assert solution.policy.value(pomdp.initial) >= solution.lower - 1e-12 * max(1.0, abs(solution.lower))
    assert solution.vectors == solution.policy.count


# Values and numbers of vectors: the reference table (two or more independent programs agree).
PUBLISHED = [(tiger(0.95), 19.371368, 9), (tiger(0.75), 1.933439, 9), (cheese(), 3.486207, 14)]


@pytest.mark.parametrize(("pomdp", "known", "vectors"), PUBLISHED, ids=["tiger.95", "tiger.aaai", "cheese"])
def test_published_values_and_vector_sets_come_out(pomdp, known, vectors):
    solution = solve_by_graph_iteration(prepare(pomdp), Demand(gap=1e-6))
    check(solution, pomdp)
    assert solution.status == "converged"
    assert solution.gap <= 1e-6
    assert abs(solution.value - known) <= 2e-6
    assert solution.vectors == vectors


@pytest.mark.parametrize("seed", SEEDS)
def test_the_vectors_are_optimal_at_any_belief(seed):
    pomdp = random_pomdp(seed)
    problem = prepare(pomdp, np.eye(pomdp.states))
    solution = solve_by_graph_iteration(problem, Demand(gap=1e-7))
    check(solution, pomdp)
    assert solution.converged
    for root, lower, upper in zip(problem.roots, solution.root_lower, solution.root_upper, strict=True):
        low, high = bracket(pomdp, problem.belief(root.y, root.belief))
        assert upper - lower <= 1e-7
        assert lower <= high + 1e-9
        assert upper >= low - 1e-9
    for belief in np.random.default_rng(seed).dirichlet(np.full(pomdp.states, 0.5), 4):
        low, high = bracket(pomdp, belief)
        assert low - 2e-7 <= solution.policy.value(belief) <= high + 1e-9


@pytest.mark.parametrize("seed", range(12))
def test_the_policy_earns_the_maximum_of_the_vectors(seed):
    # V_pi >= V if V(b) <= r(b, pi(b)) + discount * (V after it) at every belief over one class.
    pomdp = random_pomdp(500 + seed, discount=0.8, most=4)
    policy = solve_by_graph_iteration(prepare(pomdp), Demand(gap=1e-7)).policy
    for belief in np.random.default_rng(seed).dirichlet(np.full(pomdp.states, 0.6), 100):
        for y in np.unique(pomdp.observed):
            part = belief * ((pomdp.observed == y) & ~pomdp.terminal)
            if part.sum() > 0:
                action = policy.action(part / part.sum())
                after = sum(policy.value(part @ matrix.toarray()) for matrix in pomdp.kernel[action])
                earned = part @ pomdp.rewards[action] + pomdp.discount * after
                assert earned >= policy.value(part) - 1e-8


@pytest.mark.parametrize("discount", [0.5, 0.9, 0.97])
def test_a_machine_that_breaks_unseen_is_replaced_in_time(discount):
    pomdp, known = machine(discount)
    solution = solve_by_graph_iteration(prepare(pomdp), Demand(gap=1e-6))
    check(solution, pomdp)
    assert solution.converged
    assert solution.lower - 1e-9 <= known <= solution.upper + 1e-9


@pytest.mark.parametrize("flagged", [True, False])
def test_a_state_that_is_seen_gives_the_value_of_the_mdp(flagged):
    pomdp = line(6, 0.9, flagged=flagged)
    solution = solve_by_graph_iteration(prepare(pomdp), Demand(gap=1e-8))
    check(solution, pomdp)
    assert solution.lower - 1e-9 <= line_value(6, 0.9) <= solution.upper + 1e-9
    assert solution.gap <= 1e-8
    corners = solution.policy.choose(np.eye(6))
    assert np.all(corners[:5] == 1)  # always to the right


def test_without_a_future_the_best_reward_counts():
    pomdp = replace(tiger(0.95), discount=0.0, initial=np.array([0.02, 0.98]))
    solution = solve_by_graph_iteration(prepare(pomdp), Demand(gap=1e-9))
    assert solution.converged
    assert abs(solution.value - (0.98 * 10 - 0.02 * 100)) <= 1e-9
    assert solution.vectors == 3


def test_one_state_and_one_action():
    pomdp = array_pomdp([[np.eye(1)]], np.array([[3.0]]), np.ones(1), 0.9)
    solution = solve_by_graph_iteration(prepare(pomdp), Demand(gap=1e-8))
    check(solution, pomdp)
    assert abs(solution.value - 30.0) <= 1e-8
    assert solution.vectors == 1


def test_a_problem_without_rewards_is_worth_nothing():
    pomdp = replace(tiger(0.95), rewards=np.zeros((3, 2)))
    solution = solve_by_graph_iteration(prepare(pomdp), Demand())
    assert (solution.lower, solution.value, solution.upper, solution.vectors) == (0.0, 0.0, 0.0, 0)
    assert solution.converged
    assert solution.policy.action(pomdp.initial) == 0


def test_limits_keep_true_bounds():
    for iterations in (0, 1, 2):
        solution = solve_by_graph_iteration(prepare(tiger(0.95)), Demand(gap=1e-9, iterations=iterations))
        check(solution, tiger(0.95))
        assert solution.iterations == iterations
        assert solution.status == "iteration limit"
        assert solution.lower <= 19.371369
        assert solution.upper >= 19.371367
    solution = solve_by_graph_iteration(prepare(grid_4x3()), Demand(gap=1e-6, iterations=1))
    check(solution, grid_4x3())
    assert solution.status == "iteration limit"
    assert solution.lower <= 1.8899 <= solution.upper


def test_a_deadline_that_has_passed_keeps_true_bounds():
    solution = solve_by_graph_iteration(prepare(cheese()), Demand(gap=1e-6, deadline=time.monotonic()))
    check(solution, cheese())
    assert solution.status == "time limit"
    assert solution.lower <= 3.486207 <= solution.upper


@pytest.mark.parametrize("calls", [1, 2, 3])
def test_an_interrupt_keeps_what_was_found(calls):
    seen = []

    def progress(lower: float, upper: float) -> None:
        seen.append((lower, upper))
        if len(seen) == calls:
            raise KeyboardInterrupt

    solution = solve_by_graph_iteration(prepare(cheese()), Demand(gap=1e-6, progress=progress))
    check(solution, cheese())
    assert solution.status == "interrupted"
    assert solution.lower <= 3.486207 <= solution.upper


def test_a_gap_below_rounding_ends_with_the_rounding_limit():
    solution = solve_by_graph_iteration(prepare(tiger(0.95)), Demand(gap=1e-15))
    check(solution, tiger(0.95))
    assert solution.status == "rounding limit"
    assert solution.gap <= 1e-6


def test_equal_demands_give_equal_results():
    one, other = (solve_by_graph_iteration(prepare(cheese()), Demand(gap=1e-6)) for _ in range(2))
    assert (one.lower, one.upper, one.note) == (other.lower, other.upper, other.note)
    for left, right in zip(one.policy.sets, other.policy.sets, strict=True):
        assert np.array_equal(left.vectors, right.vectors)


def test_a_discount_of_one_is_refused():
    with pytest.raises(ModelError, match="discount"):
        solve_by_graph_iteration(prepare(replace(tiger(0.95), discount=1.0)), Demand())


@pytest.mark.parametrize("states", [1, 2, 3, 5])
@pytest.mark.parametrize("seed", range(5))
def test_the_excess_is_the_largest_over_all_beliefs(states, seed):
    random = np.random.default_rng(seed)
    new, old = random.normal(size=(6, states)), random.normal(size=(8, states))
    known = -np.inf
    for vector in new:  # max t over b, t with t <= (vector - u) . b for each u
        limits = np.hstack([-(vector - old), np.ones((len(old), 1))])
        sums = np.append(np.ones(states), 0.0)[None, :]
        free = [(0, None)] * states + [(None, None)]
        objective = np.append(np.zeros(states), -1.0)
        known = max(known, -linprog(objective, limits, np.zeros(len(old)), sums, [1.0], free).fun)
    found = excess(new, old, np.eye(states), -10.0)
    assert known - 1e-9 <= found <= known + 1e-8


def test_the_excess_over_itself_is_rounding():
    vectors = np.random.default_rng(1).normal(size=(12, 4)) * 100
    assert 0.0 <= excess(vectors, vectors, np.eye(4)) <= 1e-11
