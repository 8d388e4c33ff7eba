"""Exact backups and finite horizons against brute force over the tree of actions and observations."""

import time
from itertools import pairwise

import numpy as np
import pytest

from factored_polca.explicit.alpha_expansion import enumerate_vectors, forward_value, forward_values
from factored_polca.explicit.alpha_vectors import AlphaVectors, StagedVectors
from factored_polca.explicit.arrays import FloatArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.models.errors import LimitReached, ModelError
from factored_polca.solvers import pruning
from factored_polca.solvers.exact_backup import backup
from factored_polca.solvers.finite_horizon import METHODS, Method, solve_finite_horizon
from factored_polca.solvers.pomdp_problem import Problem, prepare
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.solvers.witness import witness_backup

CLOSE = 1e-9
"""Brute force sums a few thousand products of numbers below 100."""


def random_pomdp(number: int) -> ArrayPOMDP:
    """At most 6 states, some terminal, some told apart by sight; thirds; actions and observations twice."""
    generator = np.random.default_rng(1000 + number)
    states = int(generator.integers(1, 7))
    actions = int(generator.integers(1, 4))
    terminal = generator.random(states) < (0.25 if states > 1 else 0.0)
    observed = (
        generator.integers(0, 2, size=states) if number % 3 == 0 else np.zeros(states, dtype=np.int64)
    )
    kernel, rewards = [], []
    for _ in range(actions):
        count = int(generator.integers(1, 4))
        joint = np.zeros((count, states, states))
        for s in np.flatnonzero(~terminal):
            for _ in range(3):  # three places with a third each, perhaps the same one twice
                joint[generator.integers(count), s, generator.integers(states)] += 1 / 3
        matrices = list(joint)
        if count == 2 and number % 4 == 0:  # one observation split into two that say the same
            matrices = [matrices[0], 0.25 * matrices[1], 0.75 * matrices[1]]
        kernel.append(matrices)
        rewards.append(np.where(terminal, 0, generator.integers(-4, 5, size=states)))
    if number % 5 == 0:
        kernel.append(kernel[0])
        rewards.append(rewards[0])
    return array_pomdp(
        kernel,
        np.array(rewards, dtype=np.float64),
        generator.dirichlet(np.ones(states)),
        (0.95, 0.5, 1.0, 0.0)[int(generator.integers(0, 4)) if number % 2 else 0],
        terminal=terminal,
        observed=observed,
    )


def whole(pomdp: ArrayPOMDP) -> Problem:
    """Prepared with a root at every corner, so that no state is left out for being out of reach."""
    return prepare(pomdp, np.eye(pomdp.states))


def some_beliefs(pomdp: ArrayPOMDP, count: int = 5) -> FloatArray:
    generator = np.random.default_rng(5)
    return np.vstack([pomdp.initial, generator.dirichlet(np.full(pomdp.states, 0.7), size=count)])


def short_horizon(pomdp: ArrayPOMDP) -> int:
    """2 to 4 steps: as many as keep the tree of brute force below some thousand nodes."""
    nodes = sum(len(row) for row in pomdp.kernel) * len(np.unique(pomdp.observed))
    return 4 if nodes <= 6 else 3 if nodes <= 18 else 2


def tiger() -> ArrayPOMDP:
    """Cassandra, Kaelbling & Littman 1994: listen -1 (right with 0.85), open 10 or -100; discount 0.95."""
    hear = [np.diag([0.85, 0.15]), np.diag([0.15, 0.85])]
    reset = [np.full((2, 2), 0.25), np.full((2, 2), 0.25)]
    rewards = np.array([[-1.0, -1], [-100, 10], [10, -100]])
    return array_pomdp([hear, reset, reset], rewards, np.array([0.5, 0.5]), 0.95)


def earned(pomdp: ArrayPOMDP, policy: StagedVectors, mass: FloatArray, step: int = 0) -> float:
    """What the policy earns from a belief (or a part of one, not normalised), by brute force."""
    total = 0.0
    if step == policy.horizon:
        return total
    for y in np.unique(pomdp.observed):
        here = np.where((pomdp.observed == y) & ~pomdp.terminal, mass, 0.0)
        if here.sum() > 0:
            action = int(policy.choose(here[None, :] / here.sum(), step)[0])
            total += float(here @ pomdp.rewards[action])
            later = (earned(pomdp, policy, here @ m, step + 1) for m in pomdp.kernel[action])
            total += pomdp.discount * sum(later)
    return total


@pytest.mark.parametrize("block", range(10))
def test_vector_sets_agree_with_forward_expansion(block: int) -> None:
    for number in range(10 * block, 10 * block + 10):
        pomdp = random_pomdp(number)
        horizon = short_horizon(pomdp)
        problem = whole(pomdp)
        beliefs = some_beliefs(pomdp)
        truth = forward_values(pomdp, beliefs, horizon)
        solution = solve_finite_horizon(problem, horizon, Demand())
        assert isinstance(solution.policy, StagedVectors)
        assert np.allclose(solution.policy.stages[-1].values(beliefs), truth, atol=CLOSE, rtol=0)
        assert solution.status == "converged"
        assert solution.guarantee.kind == "exact"
        assert solution.lower <= truth[0] + 1e-13 * abs(truth[0])
        assert truth[0] <= solution.upper + 1e-13 * abs(truth[0])
        assert solution.lower <= solution.value <= solution.upper
        assert solution.upper - solution.lower <= 1e-6
        parts = zip(problem.roots, solution.root_lower, solution.root_upper, strict=True)
        for root, lower, upper in parts:
            value = forward_value(pomdp, problem.belief(root.y, root.belief), horizon)
            assert lower - 1e-12 <= value <= upper + 1e-12
        assert earned(pomdp, solution.policy, pomdp.initial) == pytest.approx(truth[0], abs=1e-7)


@pytest.mark.parametrize("number", range(12))
def test_both_ways_of_brute_force_agree(number: int) -> None:
    pomdp = random_pomdp(number)
    beliefs = some_beliefs(pomdp)
    vectors = enumerate_vectors(pomdp, 2)
    assert np.allclose(vectors.values(beliefs), forward_values(pomdp, beliefs, 2), atol=CLOSE, rtol=0)


@pytest.mark.parametrize("block", range(5))
def test_witness_and_incremental_pruning_find_the_same_value(block: int) -> None:
    for number in range(8 * block, 8 * block + 8):
        problem = whole(random_pomdp(number))
        one = [np.zeros((1, problem.size(y))) for y in range(problem.classes)]
        two = one
        for _ in range(3):
            first, second = backup(problem, one), witness_backup(problem, two)
            one, two = first.sets, second.sets
            for y in range(problem.classes):
                points = np.random.default_rng(1).dirichlet(np.ones(problem.size(y)), size=200)
                same = (points @ one[y].T).max(axis=1), (points @ two[y].T).max(axis=1)
                assert np.allclose(*same, atol=CLOSE, rtol=0)
                assert len(one[y]) == len(two[y])


@pytest.mark.parametrize("update", [backup, witness_backup])
@pytest.mark.parametrize("number", range(8))
def test_every_vector_is_its_option_followed_by_its_successors(update, number: int) -> None:  # type: ignore[no-untyped-def]
    problem = whole(random_pomdp(3 * number))
    sets = [np.zeros((1, problem.size(y))) for y in range(problem.classes)]
    for _ in range(3):
        new = update(problem, sets)
        for y, part in enumerate(new.classes):
            assert part.witnesses.shape == part.vectors.shape
            assert np.allclose(part.witnesses.sum(axis=1), 1)
            best = (part.witnesses @ part.vectors.T).max(axis=1)
            assert np.allclose(np.einsum("ni,ni->n", part.witnesses, part.vectors), best, atol=1e-10)
            for vector, j, successors in zip(part.vectors, part.options, part.successors, strict=True):
                assert j in problem.option_range(y)
                expected = problem.reward(int(j)).copy()
                branches = problem.branch_range(int(j))
                for k, n in zip(branches, successors, strict=False):
                    target = int(problem.arrays.branch_target[k])
                    expected += problem.discount * (problem.matrices[k] @ sets[target][n])
                assert np.all(successors[len(branches) :] == -1)
                assert np.allclose(vector, expected, atol=1e-12, rtol=0)
        sets = new.sets


def test_the_tiger_is_worth_what_short_plans_give() -> None:
    pomdp = tiger()
    corner, middle = np.array([1.0, 0.0]), np.array([0.5, 0.5])
    # one step: listen where nothing is known, else open the right door
    # two: listen twice; open the right door, then listen (9.05 > 8.5, listen and open)
    # three: two listens agree with 0.745, then a door pays 10 * 0.7225 - 100 * 0.0225 over that;
    #        else (0.255) a third listen.  -1 - 0.95 + 0.9025 * (7.225 - 2.25 - 0.255) = 2.3098
    for horizon, at_corner, at_middle in ((1, 10.0, -1.0), (2, 9.05, -1.95), (3, 8.1475, 2.3098)):
        for method in METHODS:
            policy = solve_finite_horizon(whole(pomdp), horizon, Demand(), method=method).policy
            assert isinstance(policy, StagedVectors)
            assert policy.value(corner) == pytest.approx(at_corner, abs=1e-12)
            assert policy.value(middle) == pytest.approx(at_middle, abs=1e-12)


def test_the_tiger_has_three_vectors_for_one_step_and_five_for_two() -> None:
    # one: a vector for each action.  Two: after a door nothing is known, so listen: 2 vectors; after
    # listening, the 9 pairs of one-step plans give 3 more somewhere (open on what was heard, wait on
    # either side, or both): by enumeration, each useful vector wins at one of a fine grid of beliefs.
    grid = np.linspace(0, 1, 200_001)
    beliefs = np.column_stack([grid, 1 - grid])
    for horizon in (1, 2):
        part = enumerate_vectors(tiger(), horizon).sets[0]
        winners = np.unique((beliefs @ part.vectors.T).argmax(axis=1))
        solution = solve_finite_horizon(whole(tiger()), horizon, Demand())
        assert solution.vectors == len(winners)


@pytest.mark.parametrize("method", METHODS)
def test_without_a_discount_rewards_add_up(method: Method) -> None:
    pomdp = array_pomdp([[np.ones((1, 1))]], np.array([[3.0]]), np.ones(1), 1.0)
    solution = solve_finite_horizon(prepare(pomdp), 7, Demand(), method=method)
    assert solution.value == 21
    assert solution.lower <= 21 <= solution.upper
    assert solution.upper - solution.lower <= 1e-12
    assert solution.vectors == 1


def test_with_discount_0_only_the_first_reward_counts() -> None:
    rewards = np.array([[1.0, -1], [0, 0]])
    pomdp = array_pomdp([[np.eye(2)], [np.eye(2)]], rewards, np.array([0.3, 0.7]), 0.0)
    for horizon in (1, 4):
        solution = solve_finite_horizon(whole(pomdp), horizon, Demand())
        assert solution.value == 0
        policy = solution.policy
        assert isinstance(policy, StagedVectors)
        assert policy.value(np.array([0.8, 0.2])) == pytest.approx(0.6)


@pytest.mark.parametrize("method", METHODS)
def test_a_problem_without_live_states_is_worth_nothing(method: Method) -> None:
    pomdp = array_pomdp(
        [[np.zeros((2, 2))]], np.zeros((1, 2)), np.array([0.5, 0.5]), 0.9, terminal=np.array([True, True])
    )
    problem = prepare(pomdp)
    assert problem.classes == 0
    assert backup(problem, []).count == 0
    solution = solve_finite_horizon(problem, 3, Demand(), method=method)
    assert solution.lower == solution.value == solution.upper == 0
    assert isinstance(solution.policy, StagedVectors)
    assert solution.policy.horizon == 3
    assert solution.policy.choose(np.eye(2)).tolist() == [0, 0]


def test_an_action_that_ends_at_once_has_no_branches() -> None:
    # stop for 5, or wait for 1 and stay: with h steps to go wait h - 1 times, then stop
    wait, stop = np.array([[1.0, 0], [0, 0]]), np.array([[0.0, 1], [0, 0]])
    rewards = np.array([[1.0, 0], [5, 0]])
    pomdp = array_pomdp(
        [[wait], [stop]], rewards, np.array([1.0, 0]), 1.0, terminal=np.array([False, True])
    )
    solution = solve_finite_horizon(prepare(pomdp), 4, Demand())
    assert solution.value == 8
    policy = solution.policy
    assert isinstance(policy, StagedVectors)
    assert [int(policy.choose(pomdp.initial[None, :], step)[0]) for step in range(4)] == [0, 0, 0, 1]


@pytest.mark.parametrize("number", range(20))
@pytest.mark.parametrize("done", [0, 1, 2])
def test_a_limit_leaves_bounds_that_hold_and_a_policy_that_earns_the_lower_one(
    number: int, done: int
) -> None:
    pomdp = random_pomdp(number)
    horizon = max(short_horizon(pomdp), done + 1)
    truth = forward_value(pomdp, pomdp.initial, horizon)
    solution = solve_finite_horizon(whole(pomdp), horizon, Demand(iterations=done))
    assert solution.status == "iteration limit"
    assert solution.iterations == done
    assert solution.guarantee.kind == "bounds"
    assert solution.lower <= truth + 1e-12
    assert truth <= solution.upper + 1e-12
    policy = solution.policy
    assert isinstance(policy, StagedVectors)
    assert policy.horizon == horizon
    assert earned(pomdp, policy, pomdp.initial) >= solution.lower - 1e-12
    assert policy.value(pomdp.initial) == pytest.approx(solution.value, abs=1e-9)
    for step in range(horizon):  # what each stage promises, it earns
        left = StagedVectors(policy.stages[: horizon - step])
        for belief in np.eye(pomdp.states)[~pomdp.terminal]:
            assert earned(pomdp, left, belief) >= left.value(belief) - 1e-7


def test_time_and_ctrl_c_are_told_apart() -> None:
    problem = whole(tiger())
    late = solve_finite_horizon(problem, 5, Demand(deadline=time.monotonic() - 1))
    assert late.status == "time limit"
    calls: list[tuple[float, float]] = []

    def interrupt(lower: float, upper: float) -> None:
        calls.append((lower, upper))
        if len(calls) == 3:
            raise KeyboardInterrupt

    stopped = solve_finite_horizon(problem, 5, Demand(progress=interrupt))
    assert stopped.status == "interrupted"
    assert stopped.iterations == 3
    truth = forward_value(tiger(), np.array([0.5, 0.5]), 5)
    for solution in (late, stopped):
        assert solution.lower <= truth <= solution.upper
    assert calls == [(entry.lower, entry.upper) for entry in stopped.history]


def test_sets_too_large_to_prune_stop_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pruning, "SUMS", 20)
    solution = solve_finite_horizon(whole(tiger()), 6, Demand())
    assert solution.status == "iteration limit"
    assert "too many to prune" in solution.note
    assert 0 < solution.iterations < 6
    truth = forward_value(tiger(), np.array([0.5, 0.5]), 6)
    assert solution.lower <= truth <= solution.upper


def test_bounds_only_tighten_on_the_way() -> None:
    for number in range(0, 30, 3):
        pomdp = random_pomdp(number)
        history = solve_finite_horizon(whole(pomdp), 5, Demand()).history
        assert len(history) == 5
        for before, after in pairwise(history):
            assert before.lower <= after.lower
            assert after.upper <= before.upper


@pytest.mark.parametrize("number", range(10))
@pytest.mark.parametrize("update", [backup, witness_backup])
def test_the_error_of_a_backup_covers_what_a_coarse_tolerance_costs(update, number: int) -> None:  # type: ignore[no-untyped-def]
    problem = whole(random_pomdp(number))
    sets = [np.zeros((1, problem.size(y))) for y in range(problem.classes)]
    sets = backup(problem, backup(problem, sets).sets).sets
    exact, coarse = backup(problem, sets), update(problem, sets, tolerance=0.02)
    for y in range(problem.classes):
        points = np.random.default_rng(2).dirichlet(np.ones(problem.size(y)), size=300)
        truth = (points @ exact.sets[y].T).max(axis=1)
        found = (points @ coarse.sets[y].T).max(axis=1)
        assert np.all(found <= truth + 1e-9)
        assert np.all(truth <= found + coarse.error)


def test_equal_demands_give_equal_results() -> None:
    for number in (0, 3, 7):
        problem = whole(random_pomdp(number))
        one, two = (solve_finite_horizon(problem, 4, Demand()) for _ in range(2))
        assert (one.lower, one.value, one.upper, one.vectors) == (
            two.lower,
            two.value,
            two.upper,
            two.vectors,
        )
        for first, second in zip(stages(one.policy), stages(two.policy), strict=True):
            for a, b in zip(first.sets, second.sets, strict=True):
                assert np.array_equal(a.vectors, b.vectors)
                assert np.array_equal(a.actions, b.actions)


def stages(policy: object) -> tuple[AlphaVectors, ...]:
    assert isinstance(policy, StagedVectors)
    return policy.stages


def test_a_horizon_below_1_and_an_unknown_method_are_refused() -> None:
    problem = whole(tiger())
    with pytest.raises(ModelError, match="at least 1"):
        solve_finite_horizon(problem, 0, Demand())
    with pytest.raises(ModelError, match="incremental pruning, witness"):
        solve_finite_horizon(problem, 1, Demand(), method="magic")  # type: ignore[arg-type]


def test_enumeration_stops_at_its_limit() -> None:
    with pytest.raises(LimitReached, match="more than 100"):
        enumerate_vectors(tiger(), 4, limit=100)
