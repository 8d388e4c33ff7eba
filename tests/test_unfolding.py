"""Unfolding reachable beliefs: closed forms, published values, and brute force on random POMDPs."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from tree_brackets import bracket, cheese, grid_4x3, line, line_value, machine, random_pomdp, tiger

from factored_polca.explicit.policy_graph import PolicyGraph, evaluate, value
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.models.errors import ModelError
from factored_polca.solvers.belief_graph import BeliefGraph
from factored_polca.solvers.controllers import Controllers
from factored_polca.solvers.graph_bounds import sawtooth
from factored_polca.solvers.pomdp_problem import prepare
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.unfolding import merge_distance, solve_by_unfolding

SEEDS = range(60)


def earned(solution: POMDPSolution, pomdp: ArrayPOMDP) -> float:
    """What the policy graph earns from b0, by its evaluation on the original arrays."""
    assert isinstance(solution.policy, PolicyGraph)
    return value(solution.policy, pomdp, evaluate(solution.policy, pomdp), pomdp.initial)


def check(solution: POMDPSolution, pomdp: ArrayPOMDP) -> None:
    """What holds of every solution, whatever its status."""
    assert solution.lower <= solution.value <= solution.upper
    assert np.all(solution.root_lower <= solution.root_upper)
    rounding = 1e-9 * max(1.0, abs(solution.lower))
    assert solution.lower <= earned(solution, pomdp) + rounding
    assert earned(solution, pomdp) <= solution.upper + rounding
    lows, highs = [b.lower for b in solution.history], [b.upper for b in solution.history]
    assert lows == sorted(lows)
    assert highs == sorted(highs, reverse=True)


# Values: SOLVERS table of the reference problems (two or more independent programs agree).
PUBLISHED = [(tiger(0.95), 19.371368), (tiger(0.75), 1.933439), (cheese(), 3.486207)]


@pytest.mark.parametrize(("pomdp", "known"), PUBLISHED, ids=["tiger.95", "tiger.aaai", "cheese"])
def test_published_values_come_out_with_a_certified_gap(pomdp, known):
    solution = solve_by_unfolding(prepare(pomdp), Demand(gap=1e-6))
    check(solution, pomdp)
    assert solution.status == "converged"
    assert solution.gap <= 1e-6
    assert abs(solution.value - known) <= 2e-6
    assert "all;" in solution.note


def test_4x3_does_not_close_and_converges_all_the_same():
    pomdp = grid_4x3()
    solution = solve_by_unfolding(prepare(pomdp), Demand(gap=1e-6))
    check(solution, pomdp)
    assert solution.status == "converged"
    assert solution.gap <= 1e-6
    assert abs(solution.value - 1.88990) <= 3e-5  # published with five digits
    assert "not all" in solution.note


@pytest.mark.parametrize("seed", SEEDS)
def test_bounds_bracket_the_value_of_random_pomdps(seed):
    pomdp = random_pomdp(seed)
    low, high = bracket(pomdp, pomdp.initial)
    solution = solve_by_unfolding(prepare(pomdp), Demand(gap=1e-7), beliefs=400)
    check(solution, pomdp)
    assert solution.lower <= high + 1e-9
    assert solution.upper >= low - 1e-9
    assert solution.status in ("converged", "iteration limit")
    if solution.status == "converged":
        assert solution.gap <= 1e-7


@pytest.mark.parametrize("seed", range(8))
def test_every_root_is_bracketed(seed):
    pomdp = random_pomdp(100 + seed, most=4)
    roots = np.vstack([np.eye(pomdp.states), np.full(pomdp.states, 1 / pomdp.states)])
    problem = prepare(pomdp, roots)
    solution = solve_by_unfolding(problem, Demand(gap=1e-6))
    check(solution, pomdp)
    for root, lower, upper in zip(problem.roots, solution.root_lower, solution.root_upper, strict=True):
        low, high = bracket(pomdp, problem.belief(root.y, root.belief), 1e-2)
        assert lower <= high + 1e-9
        assert upper >= low - 1e-9
        if solution.converged:
            assert upper - lower <= 1e-6


@pytest.mark.parametrize("discount", [0.5, 0.9, 0.99])
def test_a_machine_that_breaks_unseen_is_replaced_in_time(discount):
    pomdp, known = machine(discount)
    solution = solve_by_unfolding(prepare(pomdp), Demand(gap=1e-6))
    check(solution, pomdp)
    assert solution.converged
    assert solution.lower - 1e-9 <= known <= solution.upper + 1e-9


@pytest.mark.parametrize("flagged", [True, False])
def test_a_state_that_is_seen_gives_the_value_of_the_mdp(flagged):
    pomdp = line(6, 0.9, flagged=flagged)
    solution = solve_by_unfolding(prepare(pomdp), Demand(gap=1e-8))
    check(solution, pomdp)
    assert solution.lower - 1e-9 <= line_value(6, 0.9) <= solution.upper + 1e-9
    assert solution.gap <= 1e-8


def test_without_a_future_the_best_reward_counts():
    pomdp = replace(tiger(0.95), discount=0.0, initial=np.array([0.02, 0.98]))
    solution = solve_by_unfolding(prepare(pomdp), Demand(gap=1e-9))
    assert solution.converged
    assert abs(solution.value - (0.98 * 10 - 0.02 * 100)) <= 1e-9


def test_one_state_and_one_action():
    pomdp = array_pomdp([[np.eye(1)]], np.array([[3.0]]), np.ones(1), 0.9)
    solution = solve_by_unfolding(prepare(pomdp), Demand(gap=1e-8))
    check(solution, pomdp)
    assert abs(solution.value - 30.0) <= 1e-8


def test_mass_that_ends_is_lost():
    # 2 a step until the end, which comes with probability 0.25: 2 / (1 - 0.9 * 0.75)
    rows = np.array([[0.75, 0.25], [0.0, 0.0]])
    terminal = np.array([False, True])
    pomdp = array_pomdp([[rows]], np.array([[2.0, 0.0]]), np.array([1.0, 0.0]), 0.9, terminal=terminal)
    solution = solve_by_unfolding(prepare(pomdp), Demand(gap=1e-8))
    check(solution, pomdp)
    assert solution.lower <= 2 / (1 - 0.9 * 0.75) <= solution.upper
    assert solution.gap <= 1e-8


def test_a_problem_without_rewards_is_worth_nothing():
    pomdp = replace(tiger(0.95), rewards=np.zeros((3, 2)))
    solution = solve_by_unfolding(prepare(pomdp), Demand())
    assert (solution.lower, solution.value, solution.upper) == (0.0, 0.0, 0.0)
    assert solution.converged
    assert earned(solution, pomdp) == 0.0


def test_a_start_in_a_dead_state_has_a_node_to_go_to():
    # State 2 is dead without being terminal, and is seen as what no other state is seen as.
    rows = np.array([[0.5, 0.5, 0.0], [0.5, 0.25, 0.25], [0.0, 0.0, 1.0]])
    rewards = np.array([[1.0, -2.0, 0.0], [0.5, 0.0, 0.0]])
    pomdp = array_pomdp([[rows], [rows]], rewards, np.full(3, 1 / 3), 0.5, observed=np.array([0, 0, 1]))
    solution = solve_by_unfolding(prepare(pomdp), Demand(gap=1e-8))
    check(solution, pomdp)
    low, high = bracket(pomdp, pomdp.initial, 1e-4)
    assert low - 1e-9 <= solution.value <= high + 1e-9
    assert isinstance(solution.policy, PolicyGraph)
    assert np.all(solution.policy.start >= 0)
    for node, successors in enumerate(solution.policy.successors):
        assert np.all(successors[:, 1] == node)  # nothing matters any more


def test_a_coarse_merge_widens_the_bounds_honestly():
    exact = solve_by_unfolding(prepare(tiger(0.75)), Demand(gap=1e-6))
    coarse = solve_by_unfolding(prepare(tiger(0.75)), Demand(gap=1e-6), merge=1e-3)
    check(coarse, tiger(0.75))
    assert coarse.status == "rounding limit"
    assert coarse.lower <= exact.value <= coarse.upper
    assert coarse.gap > 1e-6
    assert "merged within 0.001" in coarse.note


@pytest.mark.parametrize("merge", [0.3, 0.05, 1e-2, 1e-4])
@pytest.mark.parametrize("seed", range(12))
def test_any_merge_distance_is_sound(seed, merge):
    pomdp = random_pomdp(200 + seed, most=3)
    low, high = bracket(pomdp, pomdp.initial)
    solution = solve_by_unfolding(prepare(pomdp), Demand(gap=1e-7), merge=merge, beliefs=300)
    check(solution, pomdp)
    assert solution.lower <= high + 1e-9
    assert solution.upper >= low - 1e-9


def test_the_merge_distance_spends_an_eighth_of_the_gap():
    problem = prepare(tiger(0.95))
    distance = merge_distance(problem, 1e-6)
    assert distance * 110 / (2 * 0.05**2) == pytest.approx(1e-6 / 8)


def test_limits_keep_true_bounds():
    for limits in ({"beliefs": 5}, {"beliefs": 1}):
        solution = solve_by_unfolding(prepare(tiger(0.95)), Demand(gap=1e-6), **limits)
        check(solution, tiger(0.95))
        assert solution.status == "iteration limit"
        assert solution.lower <= 19.371368 <= solution.upper
    for iterations in (0, 1, 3):
        solution = solve_by_unfolding(prepare(tiger(0.95)), Demand(gap=1e-6, iterations=iterations))
        check(solution, tiger(0.95))
        assert solution.status == "iteration limit"
        assert solution.iterations == iterations
        assert solution.lower <= 19.371368 <= solution.upper


def test_a_deadline_that_has_passed_keeps_true_bounds():
    solution = solve_by_unfolding(prepare(grid_4x3()), Demand(gap=1e-6, deadline=time.monotonic()))
    check(solution, grid_4x3())
    assert solution.status == "time limit"
    assert solution.lower <= 1.8899 <= solution.upper


@pytest.mark.parametrize("calls", [1, 2, 6, 12])
def test_an_interrupt_keeps_what_was_found(calls):
    seen = []

    def progress(lower: float, upper: float) -> None:
        seen.append((lower, upper))
        if len(seen) == calls:
            raise KeyboardInterrupt

    solution = solve_by_unfolding(prepare(grid_4x3()), Demand(gap=1e-6, progress=progress))
    check(solution, grid_4x3())
    assert solution.status == "interrupted"
    assert solution.lower >= seen[-1][0]
    assert solution.lower <= 1.8899 <= solution.upper


def test_equal_demands_give_equal_results():
    one, other = (solve_by_unfolding(prepare(grid_4x3()), Demand(gap=1e-4)) for _ in range(2))
    assert (one.lower, one.upper, one.vectors, one.note) == (
        other.lower,
        other.upper,
        other.vectors,
        other.note,
    )
    for left, right in zip(one.policy.successors, other.policy.successors, strict=True):
        assert np.array_equal(left, right)


def test_a_discount_of_one_is_refused():
    with pytest.raises(ModelError, match="discount"):
        solve_by_unfolding(prepare(replace(tiger(0.95), discount=1.0)), Demand())
    with pytest.raises(ModelError, match="positive"):
        solve_by_unfolding(prepare(tiger(0.95)), Demand(), merge=0.0)


def test_unobservable_pairs_have_no_successor_and_all_others_have_one():
    solution = solve_by_unfolding(prepare(cheese()), Demand(gap=1e-6))
    pomdp, graph = cheese(), solution.policy
    beliefs = {(int(graph.start[0]), pomdp.initial.tobytes()): pomdp.initial}
    waiting = list(beliefs)
    while waiting:
        key = waiting.pop()
        node, belief = key[0], beliefs[key]
        for o, matrix in enumerate(pomdp.kernel[int(graph.actions[node])]):
            mass = belief @ matrix
            after = int(graph.successors[node][o, 0])
            assert (after >= 0) == (mass.sum() > 0)
            if after >= 0:
                new = np.round(mass / mass.sum(), 12)
                if (after, new.tobytes()) not in beliefs:
                    beliefs[(after, new.tobytes())] = new
                    waiting.append((after, new.tobytes()))


@pytest.mark.parametrize("seed", range(6))
def test_edges_lead_to_the_nearest_kept_belief(seed):
    problem = prepare(random_pomdp(300 + seed))
    graph = BeliefGraph(problem, 1e-3)
    while len(graph.frontier) and graph.count < 200:
        graph.expand(graph.frontier)
    if problem.classes == 0 or graph.expansions == 0:
        return
    edges = graph.edges()
    by_node = {}
    for y in range(problem.classes):
        for node, belief in zip(graph.ids(y), graph.beliefs(y), strict=True):
            by_node[int(node)] = (y, belief)
    for place, node in enumerate(edges.nodes.tolist()):
        y, belief = by_node[node]
        for pair in range(int(edges.first_pair[place]), int(edges.first_pair[place + 1])):
            j = int(edges.options[pair])
            assert edges.rewards[pair] == pytest.approx(belief @ problem.reward(j))
            row = slice(edges.moves.indptr[pair], edges.moves.indptr[pair + 1])
            found = dict(zip(edges.places[row].tolist(), edges.moves.indices[row].tolist(), strict=True))
            for number, k in enumerate(problem.branch_range(j)):
                mass = belief @ problem.matrices[k].toarray()
                assert (number in found) == (mass.sum() > 0)
                if number in found:
                    target, near = by_node[found[number]]
                    assert target == problem.arrays.branch_target[k]
                    assert np.abs(mass / mass.sum() - near).sum() <= graph.widest <= 1e-3 + 1e-12


def test_merging_finds_near_beliefs_and_keeps_far_ones():
    problem = prepare(replace(tiger(0.95), initial=np.array([0.3, 0.7])))
    roots = np.array([[0.3 + 4e-5, 0.7 - 4e-5], [0.3 + 2e-4, 0.7 - 2e-4], [0.9, 0.1]])
    graph = BeliefGraph(prepare(problem.original, roots), 1e-4)
    assert graph.roots[0] == graph.roots[1]
    assert len(set(graph.roots)) == 3
    assert graph.widest == pytest.approx(8e-5, rel=1e-6)


def test_the_sawtooth_is_its_definition():
    random = np.random.default_rng(5)
    beliefs, points = random.dirichlet(np.ones(3), 30), random.dirichlet(np.full(3, 0.4), 20)
    points[points < 0.05] = 0.0
    points /= points.sum(axis=1, keepdims=True)
    corners, drops = random.normal(size=3), np.sort(random.normal(size=20) - 0.5)
    values = random.normal(size=30) + 1.0
    expected = []
    for belief, known in zip(beliefs, values, strict=True):
        best = known
        for point, drop in zip(points, drops, strict=True):
            share = min(belief[i] / point[i] for i in range(3) if point[i] > 0)
            best = min(best, belief @ corners + share * min(drop, 0.0))
        expected.append(min(best, belief @ corners))
    sawtooth(beliefs, values, points, drops, corners)
    assert np.allclose(values, expected, atol=1e-12)


@pytest.mark.parametrize("seed", range(6))
def test_controllers_are_worth_what_their_policy_graph_is(seed):
    pomdp = random_pomdp(400 + seed)
    problem = prepare(pomdp)
    if problem.classes == 0:
        return
    random = np.random.default_rng(seed)
    width = int(np.diff(problem.arrays.first_branch).max())
    options = np.array(
        [random.choice(problem.option_range(y)) for y in range(problem.classes) for _ in range(3)]
    )
    successors = np.full((len(options), width), -1, dtype=np.int64)
    for n, j in enumerate(options.tolist()):
        for place, k in enumerate(problem.branch_range(j)):
            successors[n, place] = 3 * problem.arrays.branch_target[k] + random.integers(3)
    controllers = Controllers(problem, options, successors)
    assert controllers.complete
    start = np.zeros(controllers.start[-1])
    vectors = controllers.from_below(controllers.sweeps(start, 200, 1e-12, Demand()))
    values = evaluate(controllers.graph({}), pomdp)
    for y, (numbers, block) in enumerate(controllers.by_class(vectors)):
        states = problem.states[problem.arrays.offset[y] : problem.arrays.offset[y + 1]]
        exact = values[np.ix_(numbers, states)]
        assert np.all(block <= exact + 1e-12)
        assert np.allclose(block, exact, atol=1e-8)
