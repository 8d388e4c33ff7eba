"""Solvers of fully observed problems against closed forms, exact rationals and a linear program.

The oracle below works in `Fraction`s on lists, by definition: every deterministic policy, every chain.
It shares nothing with the solvers.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import ArrayMDP
from factored_polca.models.errors import ModelError
from factored_polca.solvers import METHODS, MDPSolution, evaluation, solve_mdp

MINUS_INFINITY = float("-inf")
Row = dict[int, Fraction]


class Exact:
    """An MDP in rationals: `rows[s][a]` is a row or None where not applicable."""

    def __init__(self, rows, rewards, terminal, discount):
        self.rows: list[list[Row | None]] = rows
        self.rewards: list[list[Fraction]] = rewards
        self.terminal: list[bool] = terminal
        self.discount = Fraction(discount)

    @property
    def states(self) -> int:
        return len(self.rows)

    def arrays(self) -> ArrayMDP:
        S, A = self.states, len(self.rows[0])
        transitions = []
        for a in range(A):
            dense = np.zeros((S, S))
            for s in range(S):
                for t, p in (self.rows[s][a] or {}).items():
                    dense[s, t] = float(p)
            transitions.append(csr_array(dense))
        applicable = np.array([[self.rows[s][a] is not None for s in range(S)] for a in range(A)])
        rewards = np.array([[float(self.rewards[s][a]) for s in range(S)] for a in range(A)])
        names = tuple(f"a{a}" for a in range(A))
        terminal = np.array(self.terminal)
        return ArrayMDP(
            names, tuple(transitions), rewards * applicable, applicable, terminal, float(self.discount)
        )

    def choices(self, s: int) -> list[int]:
        return [a for a, row in enumerate(self.rows[s]) if row is not None]

    def policies(self) -> Iterator[list[int]]:
        yield from map(list, itertools.product(*[self.choices(s) or [-1] for s in range(self.states)]))


def solve_linear(matrix, right):
    """Gauss-Jordan in rationals."""
    n = len(right)
    m = [[*row, b] for row, b in zip(matrix, right, strict=True)]
    for i in range(n):
        pivot = next(r for r in range(i, n) if m[r][i] != 0)
        m[i], m[pivot] = m[pivot], m[i]
        m[i] = [x / m[i][i] for x in m[i]]
        for r in range(n):
            if r != i and m[r][i] != 0:
                m[r] = [x - m[r][i] * y for x, y in zip(m[r], m[i], strict=True)]
    return [row[n] for row in m]


def reachable(chain: list[Row], s: int) -> set[int]:
    seen, todo = {s}, [s]
    while todo:
        for t in chain[todo.pop()]:
            if t not in seen:
                seen.add(t)
                todo.append(t)
    return seen


def policy_value(exact: Exact, policy: list[int]) -> tuple[list, list[Fraction]]:
    """(the value of `policy` in each state, the mean rewards of its recurrent classes that are not 0
    throughout); without discount a class that earns something is worth minus infinity here."""
    S = exact.states
    chain = [exact.rows[s][policy[s]] if policy[s] >= 0 else {} for s in range(S)]
    reward = [exact.rewards[s][policy[s]] if policy[s] >= 0 else Fraction(0) for s in range(S)]
    reach = [reachable(chain, s) for s in range(S)]
    lost, means, fixed = set(), [], set()
    for s in range(S):
        if not chain[s]:
            fixed.add(s)
            if not exact.terminal[s]:
                lost.add(s)
        elif exact.discount == 1 and all(s in reach[t] for t in reach[s]):
            members = sorted(reach[s])
            fixed.add(s)
            if any(reward[t] != 0 for t in members):
                lost.add(s)
                means.append(mean_reward(chain, reward, members))
    free = [s for s in range(S) if s not in fixed and not (reach[s] & lost)]
    matrix = [
        [(1 if s == t else 0) - exact.discount * chain[s].get(t, Fraction(0)) for t in free] for s in free
    ]
    solved = dict(zip(free, solve_linear(matrix, [reward[s] for s in free]), strict=True))
    values = [MINUS_INFINITY if reach[s] & lost else solved.get(s, Fraction(0)) for s in range(S)]
    return values, means


def mean_reward(chain: list[Row], reward: list[Fraction], members: list[int]) -> Fraction:
    """Sum of stationary probabilities times rewards of a recurrent class."""
    n = len(members)
    matrix = [[chain[s].get(t, Fraction(0)) - (1 if s == t else 0) for s in members] for t in members[:-1]]
    shares = solve_linear([*matrix, [Fraction(1)] * n], [Fraction(0)] * (n - 1) + [Fraction(1)])
    return sum((p * reward[s] for p, s in zip(shares, members, strict=True)), Fraction(0))


def optimum(exact: Exact) -> tuple[list, list[Fraction]]:
    """The best value of each state over all deterministic policies, and all mean rewards met."""
    best = [MINUS_INFINITY] * exact.states
    means = []
    for policy in exact.policies():
        values, found = policy_value(exact, policy)
        best = [max(b, v) for b, v in zip(best, values, strict=True)]
        means += found
    return best, means


def random_exact(seed: int, discount, rewards, *, states=4, actions=3, exits=0.0) -> Exact:
    """Random rows with denominators that float64 can't hold; one or two terminal states at the end."""
    g = np.random.default_rng(seed)
    terminals = int(g.integers(0 if discount != 1 else 1, 3))
    rows, values = [], []
    for s in range(states):
        rows.append([])
        values.append([])
        for _ in range(actions):
            if s >= states - terminals or g.random() < 0.25:
                rows[-1].append(None)
                values[-1].append(Fraction(0))
                continue
            count = int(g.integers(1, 4))
            targets = g.choice(states, size=min(count, states), replace=False)
            weights = [int(x) for x in g.integers(1, 8, size=len(targets))]
            total = sum(weights)
            rows[-1].append({int(t): Fraction(w, total) for t, w in zip(targets, weights, strict=True)})
            leaves = any(int(t) >= states - terminals for t in targets)
            low, high = (-4, 5) if exits and leaves else rewards
            values[-1].append(Fraction(int(g.integers(low, high)), int(g.integers(1, 4))))
    terminal = [s >= states - terminals for s in range(states)]
    return Exact(rows, values, terminal, discount)


DISCOUNTS = (Fraction(1, 2), Fraction(9, 10), Fraction(99, 100), Fraction(0))


@cache
def discounted_case(seed: int):
    exact = random_exact(seed, DISCOUNTS[seed % 4], (-5, 6))
    return exact, *optimum(exact)


@cache
def total_case(seed: int):
    """Costs inside, anything on the way out: no loop earns; a third of the cases have free moves."""
    exact = random_exact(seed, 1, (-2 if seed % 3 == 0 else -4, 1), exits=1.0)
    return exact, *optimum(exact)


@cache
def mixed_case(seed: int):
    """Rewards of both signs; in a quarter the differences of a potential, whose mean on a loop is 0."""
    exact = random_exact(seed, 1, (-3, 3))
    if seed % 4 == 0:
        height = [Fraction(s * s + 1, 3) for s in range(exact.states)]
        for s, a in itertools.product(range(exact.states), range(3)):
            arrival = sum((p * height[t] for t, p in (exact.rows[s][a] or {}).items()), Fraction(0))
            exact.rewards[s][a] = height[s] - arrival if exact.rows[s][a] else Fraction(0)
    return exact, *optimum(exact)


@pytest.fixture(params=[*METHODS, "value iteration by sweeps"])
def method(request, monkeypatch):
    """Each algorithm; once more with the size limit that sends every evaluation to the sweeps."""
    if request.param.endswith("by sweeps"):
        monkeypatch.setattr(evaluation, "FACTORISATION_LIMIT", 0)
        return "value iteration"
    return request.param


def check_against(solution: MDPSolution, exact: Exact, truth: list) -> None:
    for s, value in enumerate(truth):
        if value == MINUS_INFINITY:
            assert solution.dead_ends[s]
            assert solution.values[s] == solution.lower[s] == solution.upper[s] == MINUS_INFINITY
            assert solution.policy[s] == -1
        else:
            assert not solution.dead_ends[s]
            # exact comparison of rationals: the bounds include rounding
            assert Fraction(solution.lower[s]) <= value <= Fraction(solution.upper[s])
            assert (solution.policy[s] == -1) == exact.terminal[s]
    reached, _ = policy_value(exact, [int(a) for a in solution.policy])
    for s, value in enumerate(truth):
        if value != MINUS_INFINITY:
            assert value - reached[s] <= solution.policy_loss_bound


def check_converged(solution: MDPSolution, epsilon: float = 1e-9) -> None:
    alive = ~solution.dead_ends
    scale = max(1.0, np.abs(solution.values[alive]).max(initial=0.0))
    assert solution.status == "converged"
    assert solution.converged
    assert solution.gap <= epsilon * scale
    assert solution.guarantee.kind == "bounds"
    assert np.all(solution.lower[alive] <= solution.values[alive])
    assert np.all(solution.values[alive] <= solution.upper[alive])
    assert np.max(solution.upper[alive] - solution.lower[alive], initial=0.0) == solution.gap


def test_bounds_enclose_the_exact_optimum_of_random_discounted_problems(method):
    for seed in range(80):
        exact, truth, _ = discounted_case(seed)
        solution = solve_mdp(exact.arrays(), method)
        check_converged(solution)
        check_against(solution, exact, truth)
        # a policy chosen among ties of 1e-9 |Q| + gap loses at most that much a step, for ever
        finite = solution.q_values[np.isfinite(solution.q_values)]
        step = 1e-9 * np.abs(finite).max(initial=1.0) + 3 * solution.gap
        assert solution.policy_loss_bound <= step / (1 - float(exact.discount))


def test_bounds_enclose_the_exact_optimum_of_random_problems_without_discount(method):
    for seed in range(80):
        exact, truth, _ = total_case(seed)
        solution = solve_mdp(exact.arrays(), method)
        check_converged(solution)
        check_against(solution, exact, truth)
        assert solution.policy_loss_bound <= 1e-5


def test_problems_without_a_finite_value_are_refused_with_the_right_reason():
    met = set()
    for seed in range(80):
        exact, truth, means = mixed_case(seed)
        if not means or max(means) < 0:
            met.add("solved")
            solution = solve_mdp(exact.arrays())
            check_converged(solution)
            check_against(solution, exact, truth)
            continue
        reason = "infinite" if max(means) > 0 else "undefined"
        met.add(reason)
        with pytest.raises(ModelError, match=reason):
            solve_mdp(exact.arrays())
    assert met == {"solved", "infinite", "undefined"}


def test_larger_discounted_problems_agree_with_the_linear_program(method):
    g = np.random.default_rng(7)
    S, A, discount = 60, 4, 0.9
    rows = g.dirichlet(np.full(S, 0.05), size=(A, S))
    rewards = g.normal(size=(A, S))
    mdp = array_mdp(rows, rewards, discount=discount)
    constraints = np.concatenate([discount * rows[a] - np.eye(S) for a in range(A)])
    program = linprog(np.ones(S), A_ub=constraints, b_ub=-rewards.reshape(-1), bounds=(None, None))
    solution = solve_mdp(mdp, method)
    check_converged(solution)
    # HiGHS works to 1e-7 by default
    np.testing.assert_allclose(solution.values, program.x, atol=1e-5)


def array_mdp(rows, rewards, *, terminal=(), discount=1.0, applicable=None) -> ArrayMDP:
    """From dense rows [a, s, t] and rewards [a, s]; terminal states lose their rows."""
    rows, rewards = np.array(rows, dtype=float), np.array(rewards, dtype=float)
    A, S, _ = rows.shape
    ends = np.zeros(S, dtype=bool)
    ends[list(terminal)] = True
    usable = np.ones((A, S), dtype=bool) if applicable is None else np.array(applicable, dtype=bool)
    usable = usable & ~ends
    transitions = tuple(csr_array(rows[a] * usable[a][:, None]) for a in range(A))
    return ArrayMDP(tuple(f"a{a}" for a in range(A)), transitions, rewards * usable, usable, ends, discount)


def chain_mdp(n: int, forward: float, backward: float, rewards, discount: float) -> ArrayMDP:
    """A walk on 0..n, both ends terminal."""
    rows = np.zeros((1, n + 1, n + 1))
    for i in range(1, n):
        rows[0, i, i + 1], rows[0, i, i - 1] = forward, backward
    return array_mdp(rows, [rewards], terminal=(0, n), discount=discount)


def test_two_state_chain_has_its_closed_form(method):
    """V = (I - g P)^-1 R for P = [[1-p, p], [q, 1-q]]; the determinant is (1-g)(1-g(1-p-q))."""
    p, q, g, r0, r1 = 0.3, 0.2, 0.95, 1.0, -2.0
    determinant = (1 - g) * (1 - g * (1 - p - q))
    expected = [
        ((1 - g * (1 - q)) * r0 + g * p * r1) / determinant,
        (g * q * r0 + (1 - g * (1 - p)) * r1) / determinant,
    ]
    solution = solve_mdp(array_mdp([[[1 - p, p], [q, 1 - q]]], [[r0, r1]], discount=g), method)
    np.testing.assert_allclose(solution.values, expected, rtol=1e-9)


@pytest.mark.parametrize("p", [0.5, 0.45])
def test_gamblers_ruin_has_its_closed_form(method, p):
    """Feller I, XIV.2: success from i with n to reach is i/n, or (1-(q/p)^i) / (1-(q/p)^n)."""
    n = 30
    rewards = np.zeros(n + 1)
    rewards[n - 1] = p
    i = np.arange(n + 1)
    ratio = (1 - p) / p
    expected = i / n if p == 0.5 else (1 - ratio**i) / (1 - ratio**n)
    solution = solve_mdp(chain_mdp(n, p, 1 - p, rewards, 1.0), method)
    check_converged(solution)
    np.testing.assert_allclose(solution.values[1:n], expected[1:n], atol=1e-9)
    assert np.all(solution.lower[1:n] <= expected[1:n] + 1e-15)
    assert np.all(solution.upper[1:n] >= expected[1:n] - 1e-15)


def test_expected_duration_of_a_fair_game_is_its_closed_form(method):
    """Feller I, XIV.3: i (n - i) steps."""
    n = 40
    solution = solve_mdp(chain_mdp(n, 0.5, 0.5, -np.ones(n + 1), 1.0), method)
    i = np.arange(n + 1)
    np.testing.assert_allclose(solution.values, -i * (n - i), atol=1e-7)


def test_discounted_random_walk_has_its_closed_form(method):
    """V(i) = (x^i - y^i) / (x^n - y^n), x and y the roots of g p z^2 - z + g q = 0."""
    n, p, g = 20, 0.6, 0.97
    root = np.sqrt(1 - 4 * g * g * p * (1 - p))
    x, y = (1 + root) / (2 * g * p), (1 - root) / (2 * g * p)
    i = np.arange(n + 1)
    expected = (x**i - y**i) / (x**n - y**n)
    rewards = np.zeros(n + 1)
    rewards[n - 1] = g * p  # what the next state is worth on arrival
    solution = solve_mdp(chain_mdp(n, p, 1 - p, rewards, g), method)
    np.testing.assert_allclose(solution.values[1:n], expected[1:n], atol=1e-8)


def test_bold_play_is_optimal_in_the_unfair_casino(method):
    """Dubins & Savage 1965: at p < 1/2 bold play; from 1, 2, 3 of 4: p^2, p, p + q p."""
    p = 0.4
    rows, rewards, usable = np.zeros((2, 5, 5)), np.zeros((2, 5)), np.zeros((2, 5))
    for stake in (1, 2):
        for i in range(1, 4):
            if stake <= i <= 4 - stake:
                rows[stake - 1, i, i + stake], rows[stake - 1, i, i - stake] = p, 1 - p
                usable[stake - 1, i] = 1
                rewards[stake - 1, i] = p * (i + stake == 4)
    solution = solve_mdp(array_mdp(rows, rewards, terminal=(0, 4), applicable=usable), method)
    np.testing.assert_allclose(solution.values, [0, p * p, p, p + (1 - p) * p, 0], atol=1e-9)
    assert solution.policy.tolist() == [-1, 0, 1, 0, -1]
    assert solution.q_values[1, 1] == MINUS_INFINITY  # staking 2 of 1 is not applicable


@pytest.mark.parametrize("success", [1.0, 0.8])
def test_shortest_paths_on_a_grid_are_manhattan_distances(method, success):
    """Moves succeed with probability p, else nothing happens: the expected steps are distance / p."""
    w = 7
    rows, rewards = np.zeros((4, w * w, w * w)), -np.ones((4, w * w))
    for a, (dx, dy) in enumerate(((1, 0), (-1, 0), (0, 1), (0, -1))):
        for x, y in itertools.product(range(w), range(w)):
            there = min(max(x + dx, 0), w - 1) * w + min(max(y + dy, 0), w - 1)
            rows[a, x * w + y, there] += success
            rows[a, x * w + y, x * w + y] += 1 - success
    solution = solve_mdp(array_mdp(rows, rewards, terminal=(0,)), method)
    check_converged(solution)
    expected = [-(x + y) / success for x, y in itertools.product(range(w), range(w))]
    np.testing.assert_allclose(solution.values, expected, atol=1e-8)
    # inside, both steps towards the corner are as good: (w-1)^2 states; the first in order is x - 1
    assert solution.ties == (w - 1) ** 2
    assert solution.policy[w + 1 :].reshape(-1).tolist()[0] == 1


def test_dead_ends_spread_backwards_and_no_further(method):
    # 0 -> 1 -> 2 (stuck); 3 may go to {2 or 4} or to 4 only; 4 terminal; 5 only to {2 or 4}
    rows, usable = np.zeros((2, 6, 6)), np.ones((2, 6))
    rows[:, 0, 1] = rows[:, 1, 2] = 1
    usable[:, 2] = 0
    rows[0, 3, 2], rows[0, 3, 4] = 1e-12, 1 - 1e-12
    rows[1, 3, 4] = 1
    rows[:, 5, 2] = rows[:, 5, 4] = 0.5
    rewards = np.array([[5, 5, 0, 100, 0, 5], [5, 5, 0, -1, 0, 5]], dtype=float)
    for discount in (0.9, 1.0):
        mdp = array_mdp(rows, rewards, terminal=(4,), discount=discount, applicable=usable)
        solution = solve_mdp(mdp, method)
        assert solution.dead_ends.tolist() == [True, True, True, False, False, True]
        np.testing.assert_allclose(solution.values[[3, 4]], [-1, 0], atol=1e-9)
        assert solution.q_values[0, 3] == MINUS_INFINITY
        assert solution.policy.tolist() == [-1, -1, -1, 1, -1, -1]
        assert np.isfinite(solution.gap)


def test_a_state_that_can_only_lose_for_ever_is_a_dead_end_without_discount(method):
    # 0 loops at -1; 1 may join it (free) or end at -5; 2 reaches 0 with probability 1/2
    rows = np.zeros((2, 4, 4))
    rows[:, 0, 0] = 1
    rows[0, 1, 0] = rows[1, 1, 3] = 1
    rows[:, 2, 0] = rows[:, 2, 3] = 0.5
    rewards = np.array([[-1, 0, 9, 0], [-1, -5, 9, 0]], dtype=float)
    solution = solve_mdp(array_mdp(rows, rewards, terminal=(3,)), method)
    assert solution.dead_ends.tolist() == [True, False, True, False]
    assert solution.values[1] == pytest.approx(-5)
    discounted = solve_mdp(array_mdp(rows, rewards, terminal=(3,), discount=0.5), method)
    assert not discounted.dead_ends.any()
    # -1/(1-g) = -2 at 0; at 2: 9 + g/2 * -2
    np.testing.assert_allclose(discounted.values, [-2, -1, 8.5, 0], atol=1e-9)


def test_staying_at_no_cost_is_worth_nothing_and_is_chosen_where_leaving_costs(method):
    # 0 and 1 swap for free, or leave at -1; nothing to gain
    rows = np.zeros((2, 3, 3))
    rows[0, 0, 2] = rows[0, 1, 2] = rows[1, 0, 1] = rows[1, 1, 0] = 1
    rewards = np.array([[-1, -1, 0], [0, 0, 0]], dtype=float)
    solution = solve_mdp(array_mdp(rows, rewards, terminal=(2,)), method)
    np.testing.assert_allclose(solution.values, 0, atol=1e-9)
    assert solution.policy.tolist() == [1, 1, -1]
    np.testing.assert_allclose(solution.q_values[:, :2], [[-1, -1], [0, 0]], atol=1e-9)
    assert solution.policy_loss_bound <= 1e-8


def test_a_free_component_is_crossed_to_the_exit_that_pays(method):
    # 0 - 1 - 2 - 3 joined by free moves (a0 left, a1 right); only 3 has the exit a2, worth 7
    rows, usable = np.zeros((3, 5, 5)), np.ones((3, 5))
    for s in range(4):
        rows[0, s, max(s - 1, 0)] = rows[1, s, min(s + 1, 3)] = 1
    rows[2, 3, 4] = 1
    usable[2, :3] = 0
    rewards = np.zeros((3, 5))
    rewards[2, 3] = 7
    solution = solve_mdp(array_mdp(rows, rewards, terminal=(4,), applicable=usable), method)
    np.testing.assert_allclose(solution.values[:4], 7, atol=1e-8)
    # a0 is first in order and as good everywhere, but never leaves
    assert solution.policy.tolist() == [1, 1, 1, 2, -1]
    assert solution.ties == 4
    assert solution.policy_loss_bound <= 1e-7


def test_a_nearly_free_loop_does_not_trap_the_policy(method):
    # waiting (first in order) costs 1e-12 a step, less than the tolerance of ties; leaving costs 1
    rows = [[[1, 0], [0, 1]], [[0, 1], [0, 1]]]
    solution = solve_mdp(array_mdp(rows, [[-1e-12, 0], [-1, 0]], terminal=(1,)), method)
    assert solution.ties == 1
    assert solution.policy.tolist() == [1, -1]
    assert solution.values[0] == pytest.approx(-1, abs=1e-8)
    assert solution.policy_loss_bound <= 1e-7


def test_ties_go_to_the_first_action_in_order(method):
    rows = [[[1.0]], [[1.0]], [[1.0]]]
    # a1 and a2 differ by less than 1e-9; a0 is worse
    solution = solve_mdp(array_mdp(rows, [[0.5], [1.0], [1.0 + 1e-13]], discount=0.5), method)
    assert solution.policy.tolist() == [1]
    assert solution.ties == 1
    clear = solve_mdp(array_mdp(rows, [[0.5], [1.0], [1.1]], discount=0.5), method)
    assert clear.policy.tolist() == [2]
    assert clear.ties == 0


def test_a_loop_that_earns_is_refused_and_its_states_are_named():
    rows = [[[0, 1, 0], [1, 0, 0], [0, 0, 1]], [[0, 0, 1]] * 3]
    mdp = array_mdp(rows, [[3, -1, 0], [0, 0, 0]], terminal=(2,))
    with pytest.raises(ModelError, match=r"infinite at discount 1.*room=kitchen0; room=kitchen1"):
        solve_mdp(mdp, describe=lambda s: f"room=kitchen{s}")
    with pytest.raises(ModelError, match=r"mean reward of 0.*state 0; state 1"):
        solve_mdp(array_mdp(rows, [[1, -1, 0], [0, 0, 0]], terminal=(2,)))
    fine = solve_mdp(array_mdp(rows, [[1, -1.5, 0], [0, 0, 0]], terminal=(2,)))
    np.testing.assert_allclose(fine.values, [1, 0, 0], atol=1e-9)


def test_a_long_cycle_of_mixed_rewards_is_judged_by_its_mean():
    """The mean of a ring is the sum of its rewards over its length; slow for relative iteration."""
    n = 120
    ring = np.zeros((2, n + 1, n + 1))
    for i in range(n):
        ring[0, i, (i + 1) % n] = 1
        ring[1, i, n] = 1
    for total, reason in ((1e-3, "infinite"), (0.0, "undefined")):
        rewards = np.zeros((2, n + 1))
        rewards[0, : n // 2], rewards[0, n // 2 : n] = 0.25, -0.25
        rewards[0, 0] += total
        with pytest.raises(ModelError, match=reason):
            solve_mdp(array_mdp(ring, rewards, terminal=(n,)))
    rewards[0, 0] = 0.25 - 1e-3
    solution = solve_mdp(array_mdp(ring, rewards, terminal=(n,)))
    # best from the start of the ring: collect the first half, then leave for 0
    assert solution.values[0] == pytest.approx(n // 2 * 0.25 - 1e-3, abs=1e-9)


def test_a_problem_without_choices_is_solved(method):
    nothing = array_mdp(np.zeros((1, 2, 2)), np.zeros((1, 2)), terminal=(0, 1))
    solution = solve_mdp(nothing, method)
    check_converged(solution)
    assert solution.values.tolist() == [0, 0]
    assert solution.policy.tolist() == [-1, -1]
    stuck = array_mdp(np.zeros((1, 2, 2)), np.zeros((1, 2)), applicable=np.zeros((1, 2)), discount=0.9)
    assert solve_mdp(stuck, method).dead_ends.all()


def test_the_same_problem_gives_the_same_bits_twice(method):
    mdp = discounted_case(3)[0].arrays()
    one, two = solve_mdp(mdp, method), solve_mdp(mdp, method)
    for name in ("values", "lower", "upper", "q_values", "policy"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert (one.gap, one.ties, one.iterations) == (two.gap, two.ties, two.iterations)


def slow_problem(discount: float) -> ArrayMDP:
    """A long walk with two gaits, each the better one in places; the ends are terminal."""
    n = 60
    rows, rewards = np.zeros((2, n + 1, n + 1)), np.zeros((2, n + 1))
    for a, forward in enumerate((0.5, 0.6)):
        for i in range(1, n):
            rows[a, i, i + 1], rows[a, i, i - 1] = forward, 1 - forward
            rewards[a, i] = -1 - a * (i % 7) / 5
    return array_mdp(rows, rewards, terminal=(0, n), discount=discount)


@pytest.mark.parametrize("discount", [0.999, 1.0])
def test_an_interrupted_solver_returns_the_bounds_so_far(method, discount):
    truth = solve_mdp(slow_problem(discount), "policy iteration")

    def interrupt(iterations: int, gap: float) -> None:
        if iterations >= 1:
            raise KeyboardInterrupt

    solution = solve_mdp(slow_problem(discount), method, progress=interrupt)
    assert solution.status == "interrupted"
    assert np.all(solution.lower <= truth.upper)
    assert np.all(solution.upper >= truth.lower)
    assert (solution.guarantee.kind == "bounds") == bool(np.isfinite(solution.gap))


@pytest.mark.parametrize("discount", [0.999, 1.0])
def test_limits_stop_with_their_status_and_valid_bounds(method, discount):
    truth = solve_mdp(slow_problem(discount), "policy iteration")
    late = solve_mdp(slow_problem(discount), method, deadline=time.monotonic() - 1)
    assert late.status == "time limit"
    short = solve_mdp(slow_problem(discount), method, iterations=1)
    assert short.status in ("iteration limit", "converged")
    for solution in (late, short):
        assert np.all(solution.lower <= truth.upper)
        assert np.all(solution.upper >= truth.lower)


def test_bounds_only_tighten_with_more_iterations():
    mdp = discounted_case(2)[0].arrays()
    for name in ("value iteration", "modified policy iteration"):
        runs = [solve_mdp(mdp, name, iterations=k) for k in range(1, 12)]
        for before, after in itertools.pairwise(runs):
            assert np.all(after.lower >= before.lower)
            assert np.all(after.upper <= before.upper)


def test_what_float64_cannot_reach_is_said(method):
    solution = solve_mdp(slow_problem(0.999), method, epsilon=1e-300)
    assert solution.status == "rounding limit"
    assert 0 < solution.gap < 1e-6


def test_faulty_arrays_are_refused_with_all_faults():
    good = array_mdp([[[0.5, 0.5], [0, 1]]], [[1, 0]], discount=0.9)

    short = csr_array(np.array([[0.5, 0.4], [0, 1]]))
    negative = csr_array(np.array([[1.5, -0.5], [0, 1]]))
    for changes, message in (
        ({"discount": 1.5}, "discount is 1.5"),
        ({"rewards": np.zeros((2, 2))}, "rewards has the shape"),
        ({"rewards": np.array([[np.nan, 0]])}, "reward of 'a0' in state 0 is nan"),
        ({"transitions": (short,)}, "row of state 0 sums to 0.9"),
        ({"transitions": (negative,)}, "state 0 has the probability -0.5"),
        ({"transitions": ()}, "0 transition arrays for 1 actions"),
        ({"transitions": (csr_array((3, 3)),)}, "shape"),
        ({"applicable": np.array([[True, False]])}, "row of state 1 sums to 1.0"),
        ({"terminal": np.array([False, True])}, "applicable in the terminal state 1"),
    ):
        with pytest.raises(ModelError, match=message):
            solve_mdp(replace(good, **changes))
    with pytest.raises(ModelError) as both:
        solve_mdp(replace(good, discount=-1, transitions=(short,)))
    assert len(both.value.faults) == 2
    with pytest.raises(ModelError, match="there are auto, value iteration"):
        solve_mdp(good, "newton")
    with pytest.raises(ModelError, match="must be positive"):
        solve_mdp(good, epsilon=0)


def test_the_kernels_give_the_same_from_the_compile_cache_in_another_process():
    """Numba loads cached kernels by another path than the one that compiles them."""
    program = (
        "import numpy as np; from scipy.sparse import csr_array\n"
        "from factored_polca.explicit.arrays import ArrayMDP\n"
        "from factored_polca.solvers import solve_mdp\n"
        "rows = csr_array(np.array([[.5, .5, 0], [0, .5, .5], [0, 0, 0]]))\n"
        "ends = np.array([False, False, True])\n"
        "mdp = ArrayMDP(('go',), (rows,), np.array([[-1., -1., 0]]), ~ends[None], ends, 1.0)\n"
        "print(solve_mdp(mdp, 'value iteration').values.tolist())\n"
    )
    root = str(Path(__file__).parent.parent)
    environment = {**os.environ, "PYTHONPATH": root}
    runs = [
        subprocess.run(
            [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
        ).stdout
        for _ in range(2)
    ]
    assert runs[0] == runs[1]
    # two geometric waits of mean 2
    np.testing.assert_allclose(numbers_in(runs[0]), [-4, -2, 0], atol=1e-8)


def numbers_in(text: str) -> list[float]:
    return [float(part) for part in text.strip().strip("[]").split(",")]
