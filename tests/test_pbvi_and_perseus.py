"""PBVI and Perseus, and the batched backups and belief pools they share.

Backups are compared with loops written from the definition, bounds with the tree of all futures, and
policies with what they earn in that tree; none of it uses the solvers.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.models.errors import ModelError
from factored_polca.solvers.batched_backup import backup, choices, q_values
from factored_polca.solvers.belief_pool import (
    BeliefPool,
    explored,
    farthest_successors,
    root_pool,
    simulate,
)
from factored_polca.solvers.pbvi import solve_pbvi
from factored_polca.solvers.perseus import improving_backups, solve_perseus
from factored_polca.solvers.pomdp_problem import Problem, prepare
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.pool_iteration import Run

SOLVERS = (solve_pbvi, solve_perseus)
TIGER = 19.371368  # pomdp-solve and APPL SARSOP agree (Cassandra's tiger.95)


def random_pomdp(seed: int, discount: float = 0.6) -> ArrayPOMDP:
    """Up to 6 states in up to 3 classes, some terminal or dead, 1 to 3 actions and observations."""
    random = np.random.default_rng(seed)
    S, A = int(random.integers(1, 7)), int(random.integers(1, 4))
    terminal = random.random(S) < random.choice([0.0, 0.3])
    terminal[0] = False
    dead = ~terminal & (random.random(S) < 0.1)
    dead[0] = False
    rewards = np.round(random.normal(size=(A, S)), 2)
    rewards[:, terminal | dead] = 0.0
    kernel = []
    for _ in range(A):
        O = int(random.integers(1, 4))
        row = random.dirichlet(np.full(S * O, 0.4), size=S)
        row[random.random(row.shape) < 0.3] = 0.0
        row[row.sum(axis=1) == 0, 0] = 1.0
        row = (row / row.sum(axis=1, keepdims=True)).reshape(S, O, S)
        row[dead] = 0.0
        row[dead, 0, dead] = 1.0
        row[terminal] = 0.0
        kernel.append([row[:, o, :] for o in range(O)])
    observed = random.integers(0, random.integers(1, 4), size=S)
    initial = random.dirichlet(np.ones(S)) * ~terminal
    if seed % 2:  # other classes are met later
        initial = initial * (observed == observed[0])
    return array_pomdp(
        kernel, rewards, initial / initial.sum(), discount, terminal=terminal, observed=observed
    )


def tiger(discount: float = 0.95) -> ArrayPOMDP:
    """Listen (right with 0.85, costs 1), or open a door (-100 the tiger's, +10 the other; reset)."""
    listen = [np.diag([0.85, 0.15]), np.diag([0.15, 0.85])]
    reset = [np.full((2, 2), 0.25), np.full((2, 2), 0.25)]
    rewards = np.array([[-1.0, -1.0], [-100.0, 10.0], [10.0, -100.0]])
    return array_pomdp([listen, reset, reset], rewards, np.array([0.5, 0.5]), discount)


def chain(sides: int, discount: float = 0.9, *, seen: bool = True) -> ArrayPOMDP:
    """`sides` cells in a row, all seen: step right (-1) or wait (-0.5); +10 and the end after the last."""
    S = sides + 1
    terminal = np.arange(S) == sides
    right, wait = np.diag(np.ones(sides), 1), np.diag(np.where(terminal, 0.0, 1.0))
    rewards = np.array([np.where(terminal, 0.0, -1.0), np.where(terminal, 0.0, -0.5)])
    rewards[0, sides - 1] = 10.0
    observed = np.arange(S) if seen else np.zeros(S, dtype=np.int64)
    return array_pomdp(
        [[right], [wait]], rewards, np.eye(S)[0], discount, terminal=terminal, observed=observed
    )


def futures(pomdp: ArrayPOMDP, belief: np.ndarray, action: int) -> list[np.ndarray]:
    """The parts (not normalised) of the next belief that what is seen and observed tells apart."""
    after = [belief @ matrix.toarray() for matrix in pomdp.kernel[action]]
    parts = [np.where(pomdp.observed == y, part, 0.0) for part in after for y in np.unique(pomdp.observed)]
    return [part for part in parts if part[~pomdp.terminal].sum() > 0]


def tail(pomdp: ArrayPOMDP, belief: np.ndarray) -> np.ndarray:
    """The least and the largest that is still to come."""
    mass = float(belief[~pomdp.terminal].sum())
    ends = np.array([min(0.0, pomdp.rewards.min()), max(0.0, pomdp.rewards.max())])
    return mass * ends / (1 - pomdp.discount)


def best_return(pomdp: ArrayPOMDP, belief: np.ndarray, depth: int) -> np.ndarray:
    """Bounds [2] on V* at a belief over one class, from all actions and observations of `depth` steps."""
    if depth == 0:
        return tail(pomdp, belief)
    gains = []
    for action in range(len(pomdp.actions)):
        later = sum(
            (best_return(pomdp, part, depth - 1) for part in futures(pomdp, belief, action)), np.zeros(2)
        )
        gains.append(belief @ pomdp.rewards[action] + pomdp.discount * later)
    return np.max(gains, axis=0)


def earned(pomdp: ArrayPOMDP, found: POMDPSolution, belief: np.ndarray, depth: int) -> np.ndarray:
    """Bounds [2] on what the found policy earns from a belief over one class."""
    if depth == 0:
        return tail(pomdp, belief)
    action = found.policy.choose(belief[None, :] / belief.sum())[0]
    later = sum(
        (earned(pomdp, found, part, depth - 1) for part in futures(pomdp, belief, action)), np.zeros(2)
    )
    return belief @ pomdp.rewards[action] + pomdp.discount * later


def starts(pomdp: ArrayPOMDP) -> list[np.ndarray]:
    """b0 by what is seen of it, not normalised."""
    parts = [np.where(pomdp.observed == y, pomdp.initial, 0.0) for y in np.unique(pomdp.observed)]
    return [part for part in parts if part.sum() > 0]


def some_sets(problem: Problem, random: np.random.Generator) -> list[np.ndarray]:
    return [
        random.normal(size=(int(random.integers(1, 6)), problem.size(y))) for y in range(problem.classes)
    ]


def some_beliefs(size: int, random: np.random.Generator, count: int = 9) -> np.ndarray:
    beliefs = random.dirichlet(np.full(size, 0.5), size=count)
    beliefs[random.random(beliefs.shape) < 0.3] = 0.0  # corners and faces, where posteriors vanish
    beliefs[beliefs.sum(axis=1) == 0, 0] = 1.0
    return np.vstack([beliefs / beliefs.sum(axis=1, keepdims=True), np.eye(size)])


def q_by_definition(problem: Problem, sets: list[np.ndarray], belief: np.ndarray, j: int) -> float:
    total = float(belief @ problem.reward(j))
    for k in problem.branch_range(j):
        after = belief @ problem.matrices[k].toarray()
        alphas = sets[int(problem.arrays.branch_target[k])]
        total += problem.discount * max(float(after @ alpha) for alpha in alphas)
    return total


def backup_by_definition(
    problem: Problem, sets: list[np.ndarray], belief: np.ndarray, j: int
) -> np.ndarray:
    """The backed-up vector of option j; at a posterior 0 the winner of the uniform belief's posterior."""
    total = problem.reward(j).copy()
    for k in problem.branch_range(j):
        matrix = problem.matrices[k].toarray()
        after = belief @ matrix
        if after.sum() == 0:
            after = matrix.sum(axis=0)
        alphas = sets[int(problem.arrays.branch_target[k])]
        winner = int(np.argmax([float(after @ alpha) for alpha in alphas]))
        total += problem.discount * matrix @ alphas[winner]
    return total


@pytest.mark.parametrize("seed", range(40))
def test_a_batched_backup_agrees_with_loops_from_the_definition(seed: int) -> None:
    problem = prepare(random_pomdp(seed, 0.9), merge=seed % 2 == 0)
    random = np.random.default_rng(seed)
    sets = some_sets(problem, random)
    for y in range(problem.classes):
        beliefs = some_beliefs(problem.size(y), random)
        vectors, options = backup(problem, sets, y, beliefs)
        table = q_values(problem, sets, y, beliefs)
        for b, belief in enumerate(beliefs):
            wanted = [q_by_definition(problem, sets, belief, j) for j in problem.option_range(y)]
            assert table[b] == pytest.approx(wanted, abs=1e-12)
            near = np.array(wanted) >= max(wanted) - 1e-12 * max(1.0, abs(max(wanted)))
            assert options[b] - problem.option_range(y).start == int(np.argmax(near))
            alpha = backup_by_definition(problem, sets, belief, int(options[b]))
            assert vectors[b] == pytest.approx(alpha, abs=1e-12)
            assert vectors[b] @ belief == pytest.approx(max(wanted), abs=1e-12)


def test_backups_do_not_depend_on_how_beliefs_are_cut_into_chunks() -> None:
    problem = prepare(tiger())
    beliefs = np.random.default_rng(0).dirichlet([1.0, 1.0], size=100_000)
    sets = [np.random.default_rng(1).normal(size=(7, 2))]
    vectors, options = backup(problem, sets, 0, beliefs)
    for at in (0, 31_999, 65_536, 99_999):
        one, option = backup(problem, sets, 0, beliefs[at : at + 1])
        assert vectors[at] == pytest.approx(one[0], abs=1e-13)
        assert options[at] == option[0]


def test_sparse_and_dense_branches_give_the_same_backup() -> None:
    random = np.random.default_rng(5)
    S = 40  # one action moves on a permutation (sparse), the other anywhere (dense)
    moves = np.eye(S)[random.permutation(S)]
    kernel = [[moves * 0.25, moves * 0.75], [random.dirichlet(np.ones(S), size=S)]]
    pomdp = array_pomdp(kernel, random.normal(size=(2, S)), np.full(S, 1 / S), 0.9)
    problem = prepare(pomdp, merge=False)
    sets = [random.normal(size=(6, S))]
    beliefs = some_beliefs(S, random)
    table = q_values(problem, sets, 0, beliefs)
    for b, belief in enumerate(beliefs):
        assert table[b] == pytest.approx([q_by_definition(problem, sets, belief, j) for j in (0, 1)])


def test_of_equal_vectors_the_first_and_of_equal_options_the_lowest_wins() -> None:
    listen = [np.diag([0.85, 0.15]), np.diag([0.15, 0.85])]
    pomdp = array_pomdp([listen, listen], np.ones((2, 2)), np.array([0.5, 0.5]), 0.9)
    problem = prepare(pomdp, merge=False)
    sets = [np.array([[0.0, 0.0], [1.0, 2.0], [1.0, 2.0 + 1e-14], [1.0, 2.0]])]
    found = choices(problem, sets, 0, np.array([[0.5, 0.5], [1.0, 0.0], [0.3, 0.7]]))
    assert found.options.tolist() == [0, 0, 0]
    assert np.all(found.winners == 1)


def test_a_pool_takes_each_belief_once_up_to_its_limit() -> None:
    empty = BeliefPool((np.zeros((0, 2)), np.zeros((0, 1))))
    one, other = np.array([0.5, 0.5]), np.array([0.25, 0.75])
    found = [(0, one), (0, one + 1e-12), (1, np.ones(1)), (0, other)]
    assert [len(rows) for rows in empty.extended(found).beliefs] == [2, 1]
    assert empty.extended(found, limit=2).count == 2
    assert empty.extended(found).extended(found).count == 3


def test_successors_are_drawn_by_their_chance_given_that_the_process_goes_on() -> None:
    # From state 0: ends with 0.5, stays with 0.1 (observation 0) or 0.4 (observation 1).
    stay = [np.array([[0.1, 0.0], [0.0, 0.0]]), np.array([[0.4, 0.5], [0.0, 0.0]])]
    end = [np.array([[0.0, 1.0], [0.0, 0.0]]), np.zeros((2, 2))]
    pomdp = array_pomdp(
        [stay, end], np.array([[1.0, 0.0], [2.0, 0.0]]), np.array([1.0, 0.0]), 0.9,
        terminal=np.array([False, True]),
    )  # fmt: skip
    problem = prepare(pomdp, merge=False)
    beliefs = np.ones((4, 1))
    classes, after = simulate(problem, 0, beliefs, np.array([0, 0, 1, 0]), np.array([0.0, 0.9, 0.5, 0.19]))
    assert classes.tolist() == [0, 0, -1, 0]
    assert [part.tolist() for part in after] == [[1.0], [1.0], [], [1.0]]


def test_pbvi_adds_the_farthest_successor_of_each_belief() -> None:
    problem = prepare(tiger())
    pool = farthest_successors(problem, root_pool(problem), np.random.default_rng(0))
    assert pool.count == 2  # opening a door leads back to (0.5, 0.5): only listening is news
    assert sorted(np.round(pool.beliefs[0][1], 9).tolist()) == [0.15, 0.85]


def test_exploration_depends_on_the_seed_alone() -> None:
    problem = prepare(tiger())
    pools = [
        explored(problem, root_pool(problem), np.random.default_rng(seed), limit=50, runs=5, depth=20)
        for seed in (1, 1, 2)
    ]
    assert np.array_equal(pools[0].beliefs[0], pools[1].beliefs[0])
    assert not np.array_equal(pools[0].beliefs[0], pools[2].beliefs[0])
    assert np.allclose(pools[0].beliefs[0].sum(axis=1), 1.0)


@pytest.mark.parametrize("solve", SOLVERS)
@pytest.mark.parametrize("seed", range(100, 120))
def test_bounds_hold_and_the_policy_earns_the_lower_one(solve, seed: int) -> None:
    pomdp = random_pomdp(seed)
    found = solve(prepare(pomdp), Demand(gap=1e-3, iterations=9, seed=seed))
    depth = 3 if len(pomdp.actions) * max(len(row) for row in pomdp.kernel) > 4 else 5
    low, high = np.sum([best_return(pomdp, part, depth) for part in starts(pomdp)], axis=0)
    assert found.lower <= high + 1e-12
    assert found.upper >= low - 1e-12
    assert found.lower <= found.value <= found.upper
    assert found.policy.meaning in ("lower", "exact")
    most = np.sum([earned(pomdp, found, part, 4) for part in starts(pomdp)], axis=0)[1]
    assert found.lower <= most + 1e-9


@pytest.mark.parametrize("solve", SOLVERS)
@pytest.mark.parametrize("seed", range(200, 215))
def test_each_vector_is_at_most_a_backup_of_the_set_by_its_own_action(solve, seed: int) -> None:
    """Then V(b) <= Q(b, a(b)) everywhere, and by induction the policy earns V."""
    pomdp = random_pomdp(seed, 0.9)
    found = solve(prepare(pomdp), Demand(gap=1e-9, iterations=7, seed=seed))
    random = np.random.default_rng(seed)
    for part in found.policy.sets:
        for inside in some_beliefs(len(part.states), random):
            belief = np.zeros(pomdp.states)
            belief[part.states] = inside
            action = int(found.policy.choose(belief[None, :])[0])
            ahead = sum(found.policy.value(after) for after in futures(pomdp, belief, action))
            q = belief @ pomdp.rewards[action] + pomdp.discount * ahead
            assert found.policy.value(belief) <= q + 1e-7


def hall_and_room() -> ArrayPOMDP:
    """From the hall (seen) to the room (seen) for ever, where the second action pays 1."""
    go = np.array([[0.0, 1.0], [0.0, 1.0]])
    rewards = np.array([[0.5, 0.0], [0.0, 1.0]])
    return array_pomdp([[go], [go]], rewards, np.array([1.0, 0.0]), 0.9, observed=np.array([0, 1]))


@pytest.mark.parametrize("pomdp", [hall_and_room(), *(random_pomdp(seed, 0.9) for seed in range(300, 311))])
def test_controllers_stay_within_the_branches_classes_and_below_their_backups(
    pomdp: ArrayPOMDP, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = prepare(pomdp)
    run = Run(problem, Demand())
    monkeypatch.setattr(run, "_keep_if_better", lambda found: setattr(run, "best", found))
    for _ in range(4):  # at first only the roots' classes have nodes: blind policies serve the others
        run.iterate(lambda own, y: own.backed_up(y, own.pool.beliefs[y]))
        found = run.best.controllers
        rows = [run.best.vectors[a:b] for a, b in zip(found.start, found.start[1:], strict=False)]
        for n, j in enumerate(found.options.tolist()):
            total = problem.reward(j).copy()
            for place, k in enumerate(problem.branch_range(j)):
                follower = int(found.successors[n, place])
                target = int(problem.option_class[found.options[follower]])
                assert target == problem.arrays.branch_target[k]
                total += problem.discount * problem.matrices[k] @ rows[follower]
            assert np.all(rows[n] <= total + 1e-12)
        run.set_pool(farthest_successors(problem, run.pool, run.rng))


@pytest.mark.parametrize("solve", SOLVERS)
@pytest.mark.parametrize("seed", [400, 401, 402, 414, 432, 438, 444, 461, 462, 463])
def test_the_policy_is_worth_the_lower_bound_at_every_root(solve, seed: int) -> None:
    pomdp = random_pomdp(seed, 0.95)
    corners = np.eye(pomdp.states)[~pomdp.terminal]
    problem = prepare(pomdp, corners)  # from 414 on, some round is better at one root and worse at another
    for iterations in (2, 4, 6):
        found = solve(problem, Demand(gap=1e-9, iterations=iterations, seed=seed))
        for root, lower in zip(problem.roots, found.root_lower, strict=True):
            assert found.policy.value(problem.belief(root.y, root.belief)) >= lower
        assert found.lower == pytest.approx(problem.combine(found.root_lower), abs=1e-12)


def test_perseus_reaches_with_few_backups_all_values_that_backups_reach() -> None:
    random = np.random.default_rng(0)
    S = 60  # action a pays 1 in state a, and nothing moves: each corner needs a vector of its own
    guess = array_pomdp([[np.eye(S)]] * S, np.eye(S), np.full(S, 1 / S), 0.9)
    for problem, beliefs, most in (
        (prepare(tiger()), random.dirichlet([1.0, 1.0], size=600), 60),
        (prepare(guess), np.vstack([np.eye(S), random.dirichlet(np.full(S, 0.02), size=300)]), 120),
    ):
        run = Run(problem, Demand())
        run.set_pool(run.pool.extended((0, belief) for belief in beliefs))
        for _ in range(3):
            pool, nodes = run.pool.beliefs[0], improving_backups(run, 0)
            reached = (pool @ nodes.vectors.T).max(axis=1)
            own = np.sum(backup(problem, run.vectors, 0, pool)[0] * pool, axis=1)
            assert np.all(reached >= np.minimum(run.values[0], own) - 1e-9)
            assert len(nodes.options) <= most
            run.iterate(improving_backups)


@pytest.mark.parametrize("solve", SOLVERS)
def test_tiger_is_solved_from_below(solve) -> None:
    found = solve(prepare(tiger()))
    assert TIGER - 1e-3 <= found.lower <= TIGER + 1e-6
    assert found.upper >= TIGER
    assert found.status == "iteration limit"  # the fixed upper bound leaves a gap: it is not "converged"
    assert "no longer rise" in found.guarantee.text


@pytest.mark.parametrize("solve", SOLVERS)
def test_corners_as_roots_are_solved_too(solve) -> None:
    found = solve(prepare(tiger(), np.eye(2)))
    beside = 10 + 0.95 * TIGER  # open the right door at once
    assert found.root_lower == pytest.approx([TIGER, beside, beside], abs=1e-5)
    assert np.all(found.root_upper >= np.array([TIGER, beside, beside]) - 1e-5)


@pytest.mark.parametrize("solve", SOLVERS)
def test_values_at_the_pool_never_fall_and_bounds_only_tighten(solve) -> None:
    found = solve(prepare(random_pomdp(7, 0.95)), Demand(iterations=14, gap=0.0))
    for before, after in zip(found.history, found.history[1:], strict=False):
        assert after.lower >= before.lower
        assert after.upper <= before.upper
        assert after.seconds >= before.seconds
    assert found.history[-1].lower == found.lower


@pytest.mark.parametrize("seed", range(6))
def test_each_iteration_raises_or_keeps_the_value_of_each_belief(seed: int) -> None:
    problem = prepare(random_pomdp(seed, 0.95))
    run = Run(problem, Demand(seed=seed))
    run.set_pool(explored(problem, run.pool, run.rng, limit=60, runs=20, depth=8))
    for _ in range(8):
        before = run.values
        run.iterate(lambda own, y: own.backed_up(y, own.pool.beliefs[y]))
        for old, new in zip(before, run.values, strict=True):
            assert np.all(new >= old - 1e-12)


@pytest.mark.parametrize("solve", SOLVERS)
def test_the_same_seed_gives_the_same_result(solve) -> None:
    first, second = (solve(prepare(random_pomdp(11, 0.9)), Demand(iterations=10, seed=3)) for _ in range(2))
    assert (first.lower, first.upper, first.vectors) == (second.lower, second.upper, second.vectors)
    for one, other in zip(first.policy.sets, second.policy.sets, strict=True):
        assert np.array_equal(one.vectors, other.vectors)
        assert np.array_equal(one.actions, other.actions)
    assert [b.lower for b in first.history] == [b.lower for b in second.history]


@pytest.mark.parametrize("solve", SOLVERS)
def test_a_fully_observed_problem_is_solved_to_its_optimum(solve) -> None:
    found = solve(prepare(chain(6)), Demand(gap=1e-9))
    wanted = -sum(0.9**t for t in range(5)) + 10 * 0.9**5  # five steps of -1, then 10
    assert found.converged
    assert found.lower <= wanted + 1e-12
    assert found.value == pytest.approx(wanted, abs=1e-9)
    assert found.policy.choose(np.eye(7)[:6]).tolist() == [0] * 6


@pytest.mark.parametrize("solve", SOLVERS)
def test_a_blind_walk_of_known_steps_is_solved_to_its_optimum(solve) -> None:
    found = solve(prepare(chain(6, seen=False)), Demand(gap=1e-9))
    assert found.converged
    assert found.value == pytest.approx(-sum(0.9**t for t in range(5)) + 10 * 0.9**5, abs=1e-9)


@pytest.mark.parametrize("solve", SOLVERS)
def test_one_state_and_one_action_are_worth_the_geometric_series(solve) -> None:
    pomdp = array_pomdp([[np.ones((1, 1))]], np.array([[3.0]]), np.ones(1), 0.75)
    found = solve(prepare(pomdp))
    assert found.converged
    assert found.value == pytest.approx(12.0, abs=1e-6)


@pytest.mark.parametrize("solve", SOLVERS)
def test_without_a_future_the_best_reward_is_the_value(solve) -> None:
    found = solve(prepare(tiger(0.0)))
    assert found.converged
    assert found.value == pytest.approx(-1.0, abs=1e-6)


@pytest.mark.parametrize("solve", SOLVERS)
def test_where_all_states_are_dead_the_value_is_0(solve) -> None:
    pomdp = array_pomdp([[np.eye(2)]], np.zeros((1, 2)), np.array([0.5, 0.5]), 0.9)
    found = solve(prepare(pomdp))
    assert (found.lower, found.upper, found.status) == (0.0, 0.0, "converged")
    assert found.policy.value(pomdp.initial) == 0.0


@pytest.mark.parametrize("solve", SOLVERS)
def test_a_discount_of_1_is_refused(solve) -> None:
    with pytest.raises(ModelError, match="discount"):
        solve(prepare(replace(tiger(), discount=1.0)))


@pytest.mark.parametrize("solve", SOLVERS)
def test_limits_stop_the_run_and_say_so(solve) -> None:
    for count in (0, 3):
        found = solve(prepare(tiger()), Demand(iterations=count))
        assert (found.status, found.iterations) == ("iteration limit", count)
        assert found.lower <= TIGER <= found.upper
    late = solve(prepare(tiger()), Demand(deadline=time.monotonic() - 1))
    assert late.status == "time limit"
    assert late.lower <= TIGER <= late.upper
    wide = solve(prepare(tiger()), Demand(gap=1e6))
    assert (wide.status, wide.iterations) == ("converged", 0)


@pytest.mark.parametrize("solve", SOLVERS)
def test_an_interruption_returns_what_there_is(solve) -> None:
    seen: list[float] = []

    def progress(lower: float, upper: float) -> None:
        seen.append(lower)
        if lower > 0:
            raise KeyboardInterrupt

    found = solve(prepare(tiger()), Demand(progress=progress))
    assert found.status == "interrupted"
    assert 0 < found.lower <= TIGER + 1e-6
    assert found.lower == seen[-1] == found.history[-1].lower
