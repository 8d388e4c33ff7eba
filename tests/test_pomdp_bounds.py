"""Blind policies, QMDP, FIB and the delayed bound: closed forms, and brute force on random problems.

The oracle expands the tree of actions and observations from the arrays of the POMDP itself, with the
least and the largest reward for ever at its leaves; it shares nothing with the solvers.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.models.errors import ModelError
from factored_polca.solvers.blind import blind_vectors, solve_blind
from factored_polca.solvers.delayed import delayed_bound
from factored_polca.solvers.fast_informed import (
    corner_values,
    fast_informed,
    fast_informed_vectors,
    solve_fib,
)
from factored_polca.solvers.pomdp_problem import Problem, prepare
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.qmdp import option_vectors, qmdp_vectors, solve_qmdp

NEAR = 1e-6
"""Fixed points are reached to 1e-9 of the largest value, some 200."""

SOLVERS = (solve_blind, solve_qmdp, solve_fib)


def bracket(pomdp: ArrayPOMDP, beliefs: np.ndarray, depth: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds on V* [n] of unnormalised beliefs [n, s], whose class is seen, by full expansion."""
    n = len(beliefs)
    if depth == 0:
        mass = beliefs[:, ~pomdp.terminal].sum(axis=1) / (1 - pomdp.discount)
        return mass * min(0.0, pomdp.rewards.min()), mass * max(0.0, pomdp.rewards.max())
    children, counts = [], []
    for row in pomdp.kernel:
        before = len(children)
        for matrix in row:
            after = beliefs @ matrix.toarray()
            children += [np.where(pomdp.observed == y, after, 0.0) for y in np.unique(pomdp.observed)]
        counts.append(len(children) - before)
    low, high = (part.reshape(-1, n) for part in bracket(pomdp, np.vstack(children), depth - 1))
    gains, at = [], 0
    for a, count in enumerate(counts):
        reward = beliefs @ pomdp.rewards[a]
        gains.append([reward + pomdp.discount * part[at : at + count].sum(axis=0) for part in (low, high)])
        at += count
    return np.max([g[0] for g in gains], axis=0), np.max([g[1] for g in gains], axis=0)


def truth(pomdp: ArrayPOMDP, belief: np.ndarray, depth: int = 0) -> tuple[float, float]:
    """Bounds on V* at a belief [s] whose class is not seen yet."""
    if depth == 0:
        widest = sum(len(row) for row in pomdp.kernel) * len(np.unique(pomdp.observed))
        depth = max(2, int(np.log(8_000) / np.log(max(widest, 2))))
    parts = np.array([np.where(pomdp.observed == y, belief, 0.0) for y in np.unique(pomdp.observed)])
    low, high = bracket(pomdp, parts, depth)
    return float(low.sum()) - 1e-9, float(high.sum()) + 1e-9


def random_problem(seed: int) -> ArrayPOMDP:
    """1 to 5 states, 1 to 3 actions; often terminal or dead states, classes, equal observations."""
    random = np.random.default_rng(seed)
    S, A = int(random.integers(1, 6)), int(random.integers(1, 4))
    terminal = random.random(S) < random.choice([0.0, 0.25])
    terminal[0] = False
    rewards = np.round(random.normal(size=(A, S)), 2) - random.choice([0.0, 1.0])
    kernel = []
    for _ in range(A):
        O = int(random.integers(1, 4))
        row = random.dirichlet(np.full(S * O, 0.4), size=S)
        row[random.random(row.shape) < 0.4] = 0.0
        row[row.sum(axis=1) == 0, 0] = 1.0
        row = np.round(row / row.sum(axis=1, keepdims=True) * 64)
        row[row.sum(axis=1) == 0, 0] = 1.0
        matrices = (row / row.sum(axis=1, keepdims=True)).reshape(S, O, S).transpose(1, 0, 2).copy()
        matrices[:, terminal, :] = 0.0
        if random.random() < 0.3:  # proportional observations
            share = random.random()
            matrices = np.concatenate([matrices[:1] * share, matrices[1:], matrices[:1] * (1 - share)])
        kernel.append(list(matrices))
    if S > 2 and random.random() < 0.3:  # a dead state that is not terminal
        rewards[:, S - 1] = 0.0
        for row in kernel:
            for matrix in row:
                matrix[S - 1] = 0.0
            row[0][S - 1, S - 1] = 0.0 if terminal[S - 1] else 1.0
    rewards[:, terminal] = 0.0
    if A > 1 and random.random() < 0.2:  # one action twice
        rewards[1], kernel[1] = rewards[0], [matrix.copy() for matrix in kernel[0]]
    observed = random.integers(0, 2, size=S) if random.random() < 0.4 else np.zeros(S, dtype=np.int64)
    initial = random.dirichlet(np.ones(S))
    discount = float(random.choice([0.0, 0.3, 0.6, 0.9]))
    return array_pomdp(kernel, rewards, initial, discount, terminal=terminal, observed=observed)


def tiger(discount: float, accuracy: float = 0.85) -> ArrayPOMDP:
    """Listen, open left, open right; opening puts the tiger behind a door at random."""
    heard = np.array([[accuracy, 1 - accuracy], [1 - accuracy, accuracy]])
    listen = [np.diag(heard[:, 0]), np.diag(heard[:, 1])]
    reset = [np.full((2, 2), 0.25), np.full((2, 2), 0.25)]
    rewards = np.array([[-1.0, -1.0], [-100.0, 10.0], [10.0, -100.0]])
    return array_pomdp([listen, reset, reset], rewards, np.array([0.5, 0.5]), discount)


def uppers(problem: Problem) -> tuple[float, float, float]:
    """QMDP, FIB and the delayed bound at b0."""
    delayed = delayed_bound(problem, tolerance=1e-9)
    late = problem.combine([delayed.value(root.y, root.belief) for root in problem.roots])
    return solve_qmdp(problem).upper, solve_fib(problem).upper, late


def test_tiger_has_its_closed_forms():
    # QMDP: the right door each step, 10 / (1 - g); at b0 listening is best, -1 + g * 200 = 189.
    # FIB: x = 10 + g l behind the right door, l = -1 + g x listening, as opening is worth less.
    # Delayed: u = -1 + g l at b0, l = -1 + g x, x = 10 + g u, so u = (10 g^2 - 1 - g) / (1 - g^3).
    g = 0.95
    qmdp, fib, late = uppers(prepare(tiger(g)))
    assert qmdp == pytest.approx(189, abs=NEAR)
    assert fib == pytest.approx(-1 + g * (10 - g) / (1 - g * g), abs=NEAR)
    assert late == pytest.approx((10 * g * g - 1 - g) / (1 - g**3), abs=NEAR)


@pytest.mark.parametrize(("discount", "value"), [(0.95, 19.371368), (0.75, 1.933439)])
def test_bounds_contain_the_known_value_of_tiger(discount, value):
    # tiger.95 and tiger.aaai, on which pomdp-solve and SARSOP agree
    problem = prepare(tiger(discount))
    assert solve_blind(problem).lower == pytest.approx(-1 / (1 - discount), abs=NEAR)  # listens for ever
    for upper in uppers(problem):
        assert upper >= value


@pytest.mark.parametrize("seed", range(60))
def test_bounds_bracket_brute_force_and_come_in_order(seed):
    pomdp = random_problem(seed)
    problem = prepare(pomdp)
    low, high = truth(pomdp, pomdp.initial)
    for solve in SOLVERS:
        found = solve(problem)
        assert found.lower <= high
        assert found.upper >= low
        assert found.lower <= found.value <= found.upper
        assert found.status in ("converged", "rounding limit")
        assert problem.combine(found.root_upper) == pytest.approx(found.upper)
    qmdp, fib, late = uppers(problem)
    assert late <= fib + 1e-8
    assert fib <= qmdp + 1e-8
    assert late >= low


@pytest.mark.parametrize("seed", range(0, 60, 3))
def test_vectors_and_points_bound_every_belief(seed):
    pomdp = random_problem(seed)
    problem = prepare(pomdp, np.eye(pomdp.states))
    if problem.classes == 0:
        return
    fib = fast_informed_vectors(problem)
    late = delayed_bound(problem, tolerance=1e-9)
    blind, _ = blind_vectors(problem)
    assert np.all(late.vectors <= fib + 1e-7)
    assert np.all(fib <= qmdp_vectors(problem))
    assert np.allclose(late.corner_values, corner_values(problem, late.vectors))
    random = np.random.default_rng(seed)
    beliefs = [(int(late.points.y[n]), late.belief(n)) for n in range(min(late.count, 8))]
    beliefs += [(y, random.dirichlet(np.ones(problem.size(y)))) for y in range(problem.classes)]
    for number, (y, belief) in enumerate(beliefs):
        low, high = truth(pomdp, problem.belief(y, belief))
        assert (blind[y] @ belief).max() <= high
        assert (option_vectors(problem, fib, y) @ belief).max() >= low
        assert late.value(y, belief) >= low
        assert late.value(y, belief) <= (option_vectors(problem, fib, y) @ belief).max() + 1e-7
        if number < min(late.count, 8):
            assert late.point_values[number] >= low


@pytest.mark.parametrize("seed", range(0, 60, 7))
def test_merging_actions_and_observations_changes_no_bound(seed):
    pomdp = random_problem(seed)
    merged, plain = prepare(pomdp), prepare(pomdp, merge=False)
    assert uppers(merged) == pytest.approx(uppers(plain), abs=NEAR)
    assert solve_blind(merged).lower == pytest.approx(solve_blind(plain).lower, abs=NEAR)


def seen_chain(discount: float, how: str) -> ArrayPOMDP:
    """Two states, seen by observation or by class: stay (1 or 0 a step) or swap (-0.5)."""
    stay, swap = np.eye(2), np.eye(2)[::-1]
    rewards = np.array([[1.0, 0.0], [-0.5, -0.5]])
    start = np.array([0.0, 1.0])
    if how == "class":
        return array_pomdp([[stay], [swap]], rewards, start, discount, observed=np.array([0, 1]))
    kernel = [[m * np.array([1, 0]), m * np.array([0, 1])] for m in (stay, swap)]
    return array_pomdp(kernel, rewards, start, discount)


@pytest.mark.parametrize("how", ["class", "observation"])
def test_where_the_state_is_seen_all_upper_bounds_are_exact(how):
    g = 0.8  # swap once, then stay: -0.5 + g / (1 - g)
    exact = -0.5 + g / (1 - g)
    assert uppers(prepare(seen_chain(g, how))) == pytest.approx((exact,) * 3, abs=NEAR)


def test_the_best_choice_by_class_is_found_where_no_single_action_is_good():
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    rewards = np.array([[1.0, 0.0], [0.0, 1.0]])  # a0 pays in class 0, a1 in class 1
    pomdp = array_pomdp([[swap], [swap]], rewards, np.array([1.0, 0.0]), 0.9, observed=np.array([0, 1]))
    found = solve_blind(prepare(pomdp))
    assert found.lower == pytest.approx(10, abs=NEAR)
    assert found.upper == pytest.approx(10, abs=NEAR)
    assert found.policy.choose(np.eye(2)).tolist() == [0, 1]


def test_a_merged_action_is_followed_as_the_option_it_was_merged_into():
    # class 0: a0 waits; a1 and a2 both go on to class 1, where a2 pays 1 a step and the others 0
    wait, go = np.eye(2), np.array([[0.0, 1.0], [0.0, 1.0]])
    rewards = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    observed = np.array([0, 1])
    problem = prepare(
        array_pomdp([[wait], [go], [go]], rewards, np.array([1.0, 0.0]), 0.5, observed=observed)
    )
    assert problem.option_action.tolist() == [0, 1, 0, 2]
    vectors, options = blind_vectors(problem)
    assert vectors[0][:, 0] == pytest.approx([0, 0, 1], abs=NEAR)  # a2 for ever: 0 + g / (1 - g)
    assert options[0].tolist() == [0, 1, 1]
    found = solve_blind(problem)
    assert found.policy.choose(np.eye(2)).tolist() == [1, 2]


def test_negative_rewards_that_end_are_bounded_by_what_is_lost_at_best():
    # leaving costs 5, waiting 1 a step and ends with probability 1/2: -1 / (1 - g / 2)
    wait = np.array([[0.5, 0.5], [0.0, 0.0]])
    leave = np.array([[0.0, 1.0], [0.0, 0.0]])
    pomdp = array_pomdp(
        [[wait], [leave]],
        np.array([[-1.0, 0.0], [-5.0, 0.0]]),
        np.array([1.0, 0.0]),
        0.9,
        terminal=np.array([False, True]),
    )
    problem = prepare(pomdp)
    value = -1 / (1 - 0.45)
    assert uppers(problem) == pytest.approx((value,) * 3, abs=NEAR)
    assert solve_blind(problem).lower == pytest.approx(value, abs=NEAR)
    assert solve_fib(problem).lower == pytest.approx(-5, abs=NEAR)  # the worst policy leaves


def test_a_start_in_an_ended_state_counts_for_nothing():
    pomdp = array_pomdp(
        [[np.diag([1.0, 0.0])]],
        np.array([[2.0, 0.0]]),
        np.array([0.25, 0.75]),
        0.5,
        terminal=np.array([False, True]),
    )
    for solve in SOLVERS:
        found = solve(prepare(pomdp))
        assert (found.lower, found.upper) == pytest.approx((1, 1), abs=NEAR)


def test_one_state_and_one_action_give_the_geometric_sum():
    pomdp = array_pomdp([[np.ones((1, 1))]], np.array([[-3.0]]), np.ones(1), 0.75)
    for solve in SOLVERS:
        found = solve(prepare(pomdp))
        assert (found.lower, found.upper) == pytest.approx((-12, -12), abs=NEAR)
        assert found.lower <= -12 <= found.upper
    assert delayed_bound(prepare(pomdp), tolerance=1e-9).corner_values == pytest.approx([-12], abs=NEAR)


def test_without_a_future_each_bound_is_the_best_reward():
    problem = prepare(tiger(0.0))
    assert uppers(problem) == pytest.approx((-1, -1, -1), abs=NEAR)
    assert solve_blind(problem).lower == pytest.approx(-1, abs=NEAR)


def test_where_every_state_is_dead_the_value_is_zero():
    pomdp = array_pomdp([[np.eye(2)]], np.zeros((1, 2)), np.array([0.5, 0.5]), 0.9)
    problem = prepare(pomdp)
    for solve in SOLVERS:
        found = solve(problem)
        assert (found.lower, found.value, found.upper, found.status) == (0, 0, 0, "converged")
        assert found.policy.choose(np.eye(2)).tolist() == [0, 0]
    assert delayed_bound(problem).count == 0
    assert len(fast_informed_vectors(problem)) == 0
    assert blind_vectors(problem) == ([], [])


@pytest.mark.parametrize(
    "solve", [*SOLVERS, blind_vectors, qmdp_vectors, fast_informed_vectors, delayed_bound]
)
def test_a_discount_of_one_is_refused(solve):
    with pytest.raises(ModelError, match=r"discount is 1\.0.*below 1"):
        solve(prepare(tiger(1.0)))


def test_policies_take_the_original_action_numbers():
    # a0 and a1 are the same, a2 pays in state 1 only
    rewards = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 3.0]])
    pomdp = array_pomdp([[np.eye(2)]] * 3, rewards, np.array([0.5, 0.5]), 0.5)
    problem = prepare(pomdp)
    for solve in SOLVERS:
        assert solve(problem).policy.choose(np.eye(2)).tolist() == [0, 2]


@pytest.mark.parametrize("solve", SOLVERS)
def test_limits_stop_early_with_bounds_that_hold(solve):
    late = solve(prepare(tiger(0.95)), Demand(deadline=0.0))
    assert late.status == "time limit"
    assert late.lower <= 19.371368 <= late.upper
    one = solve_fib(prepare(tiger(0.95)), Demand(iterations=1))
    assert one.status == "iteration limit"
    assert 87.17 < one.upper <= 189 + NEAR


@pytest.mark.parametrize("solve", SOLVERS)
def test_interrupting_returns_the_bounds_so_far(solve):
    def interrupt(lower: float, upper: float) -> None:
        assert lower <= 19.371368 <= upper
        raise KeyboardInterrupt

    demand = Demand(progress=interrupt)
    found: POMDPSolution = solve(prepare(tiger(0.95)), demand)
    assert found.status == "interrupted"
    assert found.lower <= 19.371368 <= found.upper
    with pytest.raises(KeyboardInterrupt):
        fast_informed_vectors(prepare(tiger(0.95)), demand=demand)
    assert delayed_bound(prepare(tiger(0.95)), demand=demand).status == "interrupted"


def test_every_sweep_from_an_upper_bound_is_one():
    pomdp = random_problem(5)
    problem = prepare(pomdp)
    low, _ = truth(pomdp, pomdp.initial)
    largest = max(0.0, float(pomdp.rewards.max())) / (1 - pomdp.discount)
    start = np.full(len(problem.arrays.rewards), largest)
    before = start
    for sweeps in range(6):
        after = fast_informed_vectors(problem, start, sweeps=sweeps)
        assert np.all(after <= before + 1e-12)
        late = delayed_bound(problem, start, sweeps=sweeps)
        assert late.sweeps == sweeps
        for vectors in (after, late.vectors):
            worth = [(option_vectors(problem, vectors, r.y) @ r.belief).max() for r in problem.roots]
            assert problem.combine(worth) >= low
        before = after


def test_the_delayed_bound_stops_after_the_terms_it_is_given():
    late = delayed_bound(prepare(tiger(0.95)), terms=1)
    assert (late.sweeps, late.status) == (0, "iteration limit")
    assert late.value(0, np.array([0.5, 0.5])) >= 49.605  # the fixed point, see above


def test_the_points_are_the_beliefs_one_step_after_a_known_state():
    late = delayed_bound(prepare(tiger(0.95)))
    beliefs = sorted(tuple(late.belief(n)) for n in range(late.count))
    assert beliefs == [(0, 1), (0.5, 0.5), (1, 0)]


def test_interpreted_and_compiled_sweeps_agree():
    # four copies of tiger that are told apart by class: too many terms for the interpreted sweep
    one, copies = tiger(0.9), 4
    kernel = [[np.kron(np.eye(copies), m.toarray()) for m in row] for row in one.kernel]
    many = array_pomdp(
        kernel,
        np.tile(one.rewards, copies),
        np.full(2 * copies, 0.5 / copies),
        0.9,
        observed=np.repeat(np.arange(copies), 2),
    )
    small, large = fast_informed(prepare(one)), fast_informed(prepare(many))
    assert corner_values(prepare(many), large.vectors) == pytest.approx(
        np.tile(corner_values(prepare(one), small.vectors), copies), abs=1e-9
    )
    assert uppers(prepare(many)) == pytest.approx(uppers(prepare(one)), abs=NEAR)


def test_solving_again_with_the_same_demand_gives_the_same_result():
    for solve in SOLVERS:
        first, second = (solve(prepare(random_problem(17))) for _ in range(2))
        assert replace(
            first, seconds=0, history=(), policy=None, root_lower=None, root_upper=None
        ) == replace(second, seconds=0, history=(), policy=None, root_lower=None, root_upper=None)
