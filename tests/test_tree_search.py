"""HSVI2 and SARSOP from inside: every belief, vector and choice of the search against the expansion.

What is true comes from `small_pomdps.bracket`, backups are written from the definition on the arrays of
the POMDP itself, and the prepared problem is put together again and compared with them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from small_pomdps import (
    CASES,
    SEEDS,
    TOLERANCE,
    bracket,
    extremes,
    moves,
    random_mdp,
    random_pomdp,
    sensed,
    tiger,
)

from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.models.errors import ModelError
from factored_polca.solvers import tree_search
from factored_polca.solvers.belief_tree import (
    AT,
    CHOICE_UPPER,
    CLASS,
    COUNT,
    FIRST_CHOICE,
    FIRST_LINK,
    GROWING,
    LOWER,
    NODES,
    OF_CLASS,
    OPTION,
    START,
    UPPER,
    VECTORS,
    Tree,
    size_in_bytes,
)
from factored_polca.solvers.hsvi import STYLE as HSVI
from factored_polca.solvers.hsvi import solve_hsvi
from factored_polca.solvers.pomdp_choose import TURNS
from factored_polca.solvers.pomdp_problem import Problem, prepare
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.sarsop import STYLE as SARSOP
from factored_polca.solvers.sarsop import solve_sarsop
from factored_polca.solvers.tree_search import MEMORY_LIMIT, Search, run_search


def roomy(seed: int) -> ArrayPOMDP:
    """20 states of one class, where the search also evaluates policies; each move is one of three."""
    random = np.random.default_rng(seed)
    rows = np.zeros((3, 20, 20))
    for row in rows.reshape(-1, 20):
        row[random.permutation(20)[:3]] = random.permutation([0.5, 0.3, 0.2])
    shows = np.full((20, 3), 0.1)
    shows[np.arange(20), np.arange(20) % 3] = 0.8
    rewards = random.integers(-5, 6, (3, 20)).astype(float)
    return array_pomdp(sensed(rows, shows), rewards, np.full(20, 0.05), 0.6)


GAP = 1e-4
NAMES = (
    "random 4",
    "random 17",
    "random 36",
    "random 39",
    "random 52",
    "random 65",
    "dense 313",
    "dense 323",
)
POMDPS = {case.name: case.pomdp for case in CASES if case.name in NAMES} | {"roomy": roomy(0)}
SOLVERS = {"HSVI2": solve_hsvi, "SARSOP": solve_sarsop, "turns": partial(run_search, style=TURNS)}
STYLES = {"HSVI2": HSVI, "SARSOP": SARSOP, "turns": TURNS}

each_style = pytest.mark.parametrize("style", STYLES)
each_problem = pytest.mark.parametrize("name", NAMES)
each_search = pytest.mark.parametrize("name", [*NAMES, "roomy"])


def corners(pomdp: ArrayPOMDP) -> np.ndarray:
    """Every single state that is not terminal [n, s]."""
    return np.eye(pomdp.states)[~pomdp.terminal]


def ulps(problem: Problem) -> float:
    """How far apart sums over the same numbers in another order may be."""
    return 1e-13 * max(1.0, problem.value_span)


@cache
def searched(name: str, style: str) -> Search:
    """A search of some trials with roots at all corners, its lists tidied often."""
    pomdp, trials = POMDPS[name], 200 if name == "roomy" else 60
    often = replace(STYLES[style], batch=10, evaluate_every=20, tidy_factor=1.0)
    run = Search(prepare(pomdp, corners(pomdp)), Demand(gap=1e-6, iterations=trials), often, MEMORY_LIMIT)
    assert run.run() in ("converged", "iteration limit")
    assert (run.evaluator is not None) == (name == "roomy")
    return run


def stored_beliefs(problem: Problem, tree: Tree) -> np.ndarray:
    """[n, s] the beliefs of all nodes, over the original states."""
    beliefs = np.zeros((int(tree.counts[NODES]), problem.original.states))
    for n, row in enumerate(beliefs):
        here = slice(int(tree.node[n, START]), int(tree.node[n, START] + tree.node[n, COUNT]))
        offset = problem.arrays.offset[tree.node[n, CLASS]]
        row[problem.states[offset + tree.entry_state[here]]] = tree.entry_weight[here]
    return beliefs


def stored_vectors(problem: Problem, tree: Tree) -> np.ndarray:
    """[m, s] all vectors, those no longer listed too, over the original states; others -> nan."""
    vectors = np.full((int(tree.counts[VECTORS]), problem.original.states), np.nan)
    for m, row in enumerate(vectors):
        y, at = int(tree.vector[m, OF_CLASS]), int(tree.vector[m, AT])
        mine = slice(int(problem.arrays.offset[y]), int(problem.arrays.offset[y + 1]))
        row[problem.states[mine]] = tree.number[at : at + problem.size(y)]
    return vectors


def random_beliefs(problem: Problem, y: int, count: int) -> np.ndarray:
    """[n, s] beliefs over class y: corners, and sparse and dense random ones."""
    random, size = np.random.default_rng(y), problem.size(y)
    rows = np.vstack([np.eye(size), random.dirichlet(np.full(size, 0.4), count)])
    return np.array([problem.belief(y, row) for row in rows])


def worth_of(pomdp: ArrayPOMDP, policy: AlphaVectors, action: int, belief: np.ndarray) -> float:
    """One step of an action, then V: from the definition."""
    after = sum(policy.value(belief @ matrix) for matrix in moves(pomdp)[action])
    return float(belief @ pomdp.rewards[action] + pomdp.discount * after)


# -- bounds ----------------------------------------------------------------------------------------


@each_style
@each_search
def test_bounds_hold_at_every_belief_that_was_met(name, style):
    run = searched(name, style)
    beliefs = stored_beliefs(run.problem, run.tree)
    np.testing.assert_allclose(beliefs.sum(axis=1), 1.0, rtol=0, atol=1e-12)
    low, high = bracket(POMDPS[name], beliefs, most=30_000)
    bounds = run.tree.bound[: len(beliefs)]
    assert np.all(bounds[:, UPPER] >= low)
    assert np.all(bounds[:, LOWER] <= high)


@each_style
@each_problem
def test_bounds_hold_for_every_choice_that_was_met(name, style):
    run, pomdp = searched(name, style), POMDPS[name]
    tree, problem = run.tree, run.problem
    beliefs = stored_beliefs(problem, tree)
    opened = np.flatnonzero(tree.node[: len(beliefs), FIRST_CHOICE] >= 0)[:50]
    for action in range(len(pomdp.actions)):
        after = [beliefs[opened] @ matrix for matrix in moves(pomdp)[action]]
        low = beliefs[opened] @ pomdp.rewards[action]
        for part in after:
            mass = part.sum(axis=1)
            here = mass > 0
            if here.any():
                low[here] += (
                    pomdp.discount
                    * mass[here]
                    * bracket(pomdp, part[here] / mass[here, None], most=10_000)[0]
                )
        for row, n in enumerate(opened.tolist()):
            options = problem.option_range(int(tree.node[n, CLASS]))
            for j in options:
                if problem.option_action[j] == action:
                    place = tree.node[n, FIRST_CHOICE] + j - options.start
                    assert tree.choice[place, CHOICE_UPPER] >= low[row] - TOLERANCE


@each_style
@each_search
def test_every_vector_ever_made_is_a_lower_bound_everywhere(name, style):
    run, pomdp = searched(name, style), POMDPS[name]
    vectors = stored_vectors(run.problem, run.tree)
    for y in range(run.problem.classes):
        beliefs = random_beliefs(run.problem, y, 25)
        _, high = bracket(pomdp, beliefs, most=30_000)
        mine = np.nan_to_num(vectors[run.tree.vector[: len(vectors), OF_CLASS] == y])
        assert np.all(beliefs @ mine.T <= high[:, None])


@each_style
@each_search
def test_the_returned_set_never_promises_more_than_one_step_ahead(name, style):
    # V <= r + discount * V after it, for the action that the policy takes: so it earns at least V.
    run, pomdp = searched(name, style), POMDPS[name]
    policy = run.solution("iteration limit").policy
    for y in range(run.problem.classes):
        for belief in random_beliefs(run.problem, y, 25):
            action = policy.action(belief)
            assert policy.value(belief) <= worth_of(pomdp, policy, action, belief) + ulps(run.problem)


@each_style
@each_search
def test_links_lead_to_vectors_of_the_next_class_and_add_up(name, style):
    # alpha = r_j + discount * sum_k M_k alpha_k, or less (first vectors are rounded down).
    run = searched(name, style)
    problem, tree = run.problem, run.tree
    for m in range(int(tree.counts[VECTORS])):
        link, j = int(tree.vector[m, FIRST_LINK]), int(tree.vector[m, OPTION])
        y = int(tree.vector[m, OF_CLASS])
        assert j in problem.option_range(y)
        if link < 0:
            continue
        expected = problem.reward(j).copy()
        for place, k in enumerate(problem.branch_range(j)):
            follower = int(tree.links[link + place])
            assert tree.vector[follower, OF_CLASS] == problem.arrays.branch_target[k]
            at = int(tree.vector[follower, AT])
            size = problem.size(int(problem.arrays.branch_target[k]))
            expected += problem.discount * (problem.matrices[k] @ tree.number[at : at + size])
        at = int(tree.vector[m, AT])
        assert np.all(tree.number[at : at + problem.size(y)] <= expected + ulps(problem))


# -- roots -----------------------------------------------------------------------------------------


@each_style
@each_problem
def test_the_gap_is_reached_at_every_root(name, style):
    pomdp = POMDPS[name]
    roots = np.vstack([corners(pomdp), np.where(pomdp.terminal, 0, 1) / (~pomdp.terminal).sum()])
    problem = prepare(pomdp, roots)
    found = SOLVERS[style](problem, Demand(gap=GAP))
    assert found.status == "converged"
    assert np.all(found.root_upper - found.root_lower <= GAP)
    assert "every root" in found.guarantee.text
    beliefs = np.array([problem.belief(root.y, root.belief) for root in problem.roots])
    low, high = bracket(pomdp, beliefs)
    assert np.all(found.root_lower <= high)
    assert np.all(found.root_upper >= low)
    assert isinstance(found.policy, AlphaVectors)
    assert np.all(found.policy.values(beliefs) >= found.root_lower)
    assert np.all(found.policy.values(beliefs) <= high)


@each_style
def test_the_4x3_maze_is_solved_to_a_millionth(style):
    maze = next(case for case in CASES if case.name == "4x3.95")
    found = SOLVERS[style](prepare(maze.pomdp), Demand(gap=1e-6))
    assert found.converged
    assert found.upper - found.lower <= 1e-6
    assert found.lower <= maze.truth[1]
    assert found.upper >= maze.truth[0]


@each_style
@pytest.mark.parametrize("flagged", [True, False])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_corners_are_worth_what_they_are_when_all_is_seen(seed, flagged, style):
    pomdp = random_mdp(seed, 0.9, flagged=flagged).pomdp
    problem = prepare(pomdp, corners(pomdp))
    found = SOLVERS[style](problem, Demand(gap=1e-6))
    values = extremes(pomdp)[1]  # value iteration; 0.9^300 of it is left
    for root, lower, upper in zip(problem.roots, found.root_lower, found.root_upper, strict=True):
        truth = float(problem.belief(root.y, root.belief) @ values)
        assert lower <= truth + TOLERANCE
        assert upper >= truth - 1e-10
        assert upper - lower <= 1e-6


@each_style
def test_roots_that_repeat_change_nothing(style):
    pomdp = POMDPS["random 17"]
    once = SOLVERS[style](prepare(pomdp, corners(pomdp)), Demand(gap=GAP))
    twice = SOLVERS[style](
        prepare(pomdp, np.vstack([corners(pomdp), pomdp.initial, corners(pomdp)])), Demand(gap=GAP)
    )
    assert (once.lower, once.upper, once.vectors) == (twice.lower, twice.upper, twice.vectors)


# -- limits and going on ---------------------------------------------------------------------------


def same(one: POMDPSolution, two: POMDPSolution) -> bool:
    """Whether two solutions agree in bounds and in every number of the policy."""
    assert isinstance(one.policy, AlphaVectors)
    assert isinstance(two.policy, AlphaVectors)
    pairs = zip(one.policy.sets, two.policy.sets, strict=True)
    return (one.lower, one.upper, one.iterations) == (two.lower, two.upper, two.iterations) and all(
        np.array_equal(a.vectors, b.vectors) and np.array_equal(a.actions, b.actions) for a, b in pairs
    )


@each_style
@each_problem
def test_going_on_after_some_batches_is_one_run(name, style):
    problem, demand = prepare(POMDPS[name]), Demand(gap=1e-9, seed=3)
    whole = Search(problem, demand, STYLES[style], MEMORY_LIMIT)
    status = whole.run(60)
    parts = Search(problem, demand, STYLES[style], MEMORY_LIMIT)
    for trials in (20, 20, 40, 60):
        last = parts.run(trials)
    assert last == status
    assert same(whole.solution(status), parts.solution(last))


@each_style
def test_going_on_after_an_interrupt_gets_there(style):
    told = itertools.count()

    def progress(lower: float, upper: float) -> None:
        if next(told) % 7 == 6:
            raise KeyboardInterrupt

    problem = prepare(tiger(0.9))
    plain = SOLVERS[style](problem, Demand(gap=1e-6))
    status, stops = "interrupted", 0
    run = uninterrupted(Search, problem, Demand(gap=1e-6, progress=progress), STYLES[style], MEMORY_LIMIT)
    while status == "interrupted" and stops < 100:
        status, stops = uninterrupted(run.run), stops + 1
        found = uninterrupted(run.solution, status)
        assert found.lower <= plain.upper
        assert found.upper >= plain.lower
    assert stops > 1
    assert found.converged


def uninterrupted(work: Callable[..., Any], *given: object) -> Any:
    """What `work` returns; it must not let a KeyboardInterrupt out (pytest would end)."""
    with suppress(KeyboardInterrupt):
        return work(*given)
    raise AssertionError("KeyboardInterrupt came out")


def wide(seed: int, states: int, actions: int, observations: int) -> ArrayPOMDP:
    """Dense moves and observations: beliefs multiply fast."""
    random = np.random.default_rng(seed)
    rows = random.dirichlet(np.full(states, 0.2), size=(actions, states))
    shows = random.dirichlet(np.full(observations, 0.4), size=states)
    rewards = random.normal(size=(actions, states))
    return array_pomdp(sensed(rows, shows), rewards, np.full(states, 1 / states), 0.95)


class Clock:
    """Stands in for the module `time`: every look at it takes `step` seconds."""

    def __init__(self, step: float) -> None:
        self.now, self.step = 0.0, step

    def perf_counter(self) -> float:
        self.now += self.step
        return self.now


@each_style
@pytest.mark.parametrize("size", [(16, 4, 12), (12, 5, 12)])
def test_the_result_does_not_depend_on_the_speed_of_the_machine(size, style, monkeypatch):
    # Trials run in slices of about 0.1 s; arrays that fill up inside one must not show in the result.
    problem = prepare(wide(0, *size))
    results = []
    for step in (1e-9, 1.0):
        monkeypatch.setattr(tree_search, "time", Clock(step))
        run = Search(problem, Demand(gap=1e-6, iterations=40), STYLES[style], MEMORY_LIMIT)
        results.append(run.solution(run.run()))
        assert run.tree.counts[NODES] > 1024  # the arrays had to grow
        for name, count in GROWING.items():  # but not to more than is of use
            room = 4 * int(run.tree.counts[count]) + 100 * int(run.least[count]) + (1 << 15)
            assert len(getattr(run.tree, name)) <= room
    assert same(*results)


@each_style
def test_arrays_that_grew_hold_what_they_held(style):
    pomdp = wide(1, 5, 3, 24)
    pomdp = replace(pomdp, discount=0.5)
    run = Search(prepare(pomdp), Demand(gap=1e-9, iterations=120), STYLES[style], MEMORY_LIMIT)
    found = run.solution(run.run())
    beliefs = stored_beliefs(run.problem, run.tree)
    assert len(beliefs) > 1024
    np.testing.assert_allclose(beliefs.sum(axis=1), 1.0, rtol=0, atol=1e-12)
    some = np.append(run.roots, np.random.default_rng(0).permutation(len(beliefs))[:60])
    low, high = bracket(pomdp, beliefs[some], most=150_000)
    assert np.all(run.tree.bound[some, UPPER] >= low)
    assert np.all(run.tree.bound[some, LOWER] <= high)
    assert found.lower <= high[0]
    assert found.upper >= low[0]


@each_style
def test_little_memory_ends_a_run_with_bounds(style):
    problem = prepare(tiger(0.95))
    found = run_search(problem, Demand(gap=1e-9), STYLES[style], memory_limit=1)
    assert found.status == "memory limit"
    assert found.iterations == 0
    assert found.lower <= 19.371368 <= found.upper
    wider = prepare(wide(0, 8, 4, 24))
    start = size_in_bytes(Search(wider, Demand(), STYLES[style], MEMORY_LIMIT).tree)
    found = run_search(wider, Demand(gap=1e-9), STYLES[style], memory_limit=2 * start)
    assert found.status == "memory limit"
    assert found.iterations > 0


def test_a_discount_of_one_and_a_gap_of_nothing_are_refused():
    with pytest.raises(ModelError, match=r"discount below 1.*horizon"):
        solve_sarsop(prepare(tiger(1.0)))
    with pytest.raises(ModelError, match=r"must be positive"):
        solve_hsvi(prepare(tiger(0.9)), Demand(gap=0.0))


@each_style
def test_a_discount_near_one_reaches_a_gap_that_doubles_can_hold(style):
    # Rounding of values near 1e5 is some 1e-8 here; beliefs merged need not cost more.
    found = SOLVERS[style](prepare(tiger(0.998)), Demand(gap=1e-6, iterations=4000))
    assert found.converged


# -- shapes of problems ----------------------------------------------------------------------------


@each_style
def test_branches_that_a_root_cannot_see_still_continue(style):
    # From state 0 the sensor never shows o1; at the corner of state 0 that branch has no child.
    look = [np.diag([1.0, 0.0, 0.5]), np.diag([0.0, 1.0, 0.5])]
    leave = [np.full((3, 3), 1 / 3), np.zeros((3, 3))]
    rewards = np.array([[0.0, 0.0, 0.0], [4.0, -6.0, 1.0]])
    pomdp = array_pomdp([look, leave], rewards, np.eye(3)[0], 0.5)
    only = SOLVERS[style](prepare(pomdp), Demand(gap=1e-6))
    every = np.vstack([np.eye(3), np.random.default_rng(0).dirichlet(np.ones(3), 30)])
    low, high = bracket(pomdp, every)
    assert only.lower <= high[0]
    assert only.upper >= low[0]
    assert np.all(only.policy.values(every) <= high)  # sound where the search never was
    found = SOLVERS[style](prepare(pomdp, np.eye(3)), Demand(gap=1e-6))
    assert np.all(found.policy.values(every[:3]) >= low[:3] - 1e-6)


@each_style
def test_probabilities_at_the_edge_of_floats_do_no_harm(style):
    tiny = 1e-310
    rows = [np.array([[1.0, tiny, 0.0], [0.5, 0.5 - 1e-200, 1e-200], [0.0, tiny, 1.0]])]
    rows.append(rows[0][::-1].copy())
    shows = np.array([[1.0, tiny], [1e-160, 1.0], [0.5, 0.5]])
    rewards = np.array([[1.0, 0.0, -2.0], [-1.0, 3.0, 0.5]])
    pomdp = array_pomdp(sensed(rows, shows), rewards, np.array([0.3, 0.3, 0.4]), 0.5)
    found = SOLVERS[style](prepare(pomdp, np.eye(3)), Demand(gap=1e-6))
    rounded = [np.where(row < 1e-100, 0.0, row) for row in rows]
    plain = array_pomdp(sensed(rounded, np.round(shows, 100)), rewards, pomdp.initial, 0.5)
    low, high = bracket(plain, np.vstack([pomdp.initial, np.eye(3)]))
    assert found.converged
    assert found.lower <= high[0]
    assert found.upper >= low[0]
    assert np.all(np.isfinite(found.root_lower) & np.isfinite(found.root_upper))


def corridor(rooms: int) -> ArrayPOMDP:
    """A robot sees its room; one of two hidden states of the world decides what each exit pays.

    Walking right shows nothing; looking is right in 3 of 4 cases; the last room ends the run.
    """
    states = 2 * rooms
    room, world = np.arange(states) // 2, np.arange(states) % 2
    ends = room == rooms - 1
    right, stay = np.zeros((states, states)), np.diag(np.where(ends, 0.0, 1.0))
    right[np.flatnonzero(~ends), np.flatnonzero(~ends) + 2] = 1.0
    sensor = np.where(world[:, None] == np.arange(2)[None, :], 0.75, 0.25)
    looks = [stay * sensor[None, :, o] for o in range(2)]
    pays = np.where(world == 0, 1.0, -1.0)
    rewards = np.array([np.full(states, -0.1), np.full(states, -0.25), pays, -pays])
    over = np.zeros((states, states))
    over[np.flatnonzero(~ends), -1] = 1.0
    rewards[2:] *= np.minimum(room, 3)
    rewards[:, ends] = 0.0
    initial = np.where(room == 0, 0.5, 0.0)
    return array_pomdp(
        [[right], looks, [over], [over.copy()]], rewards, initial, 0.6, terminal=ends, observed=room
    )


@each_style
def test_many_classes_are_searched_each_in_its_own_beliefs(style):
    pomdp = corridor(20)
    problem = prepare(pomdp, corners(pomdp))
    assert problem.classes == 19
    assert max(problem.size(y) for y in range(problem.classes)) == 2
    found = SOLVERS[style](problem, Demand(gap=1e-6))
    beliefs = np.array([problem.belief(root.y, root.belief) for root in problem.roots])
    low, high = bracket(pomdp, beliefs)
    assert found.converged
    assert np.all(found.root_lower <= high)
    assert np.all(found.root_upper >= low)
    assert np.all(high - low < 1e-6)


@each_style
@pytest.mark.parametrize("seed", SEEDS[:4])
def test_a_discount_of_nothing_needs_no_search(seed, style):
    pomdp = random_pomdp(seed, discount=0.0)
    problem = prepare(pomdp, corners(pomdp))
    found = SOLVERS[style](problem, Demand(gap=1e-9))
    for root, lower, upper in zip(problem.roots, found.root_lower, found.root_upper, strict=True):
        best = float((pomdp.rewards @ problem.belief(root.y, root.belief)).max())
        assert lower - 1e-12 <= best <= upper + 1e-12
    assert found.converged


# -- the prepared problem --------------------------------------------------------------------------

PREPARED = [(seed, dense) for seed in (*SEEDS, 1, 5, 13, 20, 41, 59) for dense in (False, True)]


@pytest.mark.parametrize(("seed", "dense"), PREPARED)
def test_branches_add_up_to_the_kernel(seed, dense):
    pomdp = random_pomdp(seed, dense=dense)
    problem = prepare(pomdp, corners(pomdp))
    bounds = problem.arrays.offset
    for y in range(problem.classes):
        mine = problem.states[bounds[y] : bounds[y + 1]]
        assert np.all(pomdp.observed[mine] == problem.seen[y])
        assert np.all(np.diff(mine) > 0)
        for j in problem.option_range(y):
            action = int(problem.option_action[j])
            assert np.array_equal(problem.reward(j), pomdp.rewards[action, mine])
            met: set[tuple[int, int]] = set()
            for k in problem.branch_range(j):
                target = int(problem.arrays.branch_target[k])
                there = problem.states[bounds[target] : bounds[target + 1]]
                parts = [
                    pomdp.kernel[action][o].toarray()[np.ix_(mine, there)] for o in problem.observed_as[k]
                ]
                np.testing.assert_allclose(problem.matrices[k].toarray(), sum(parts), rtol=1e-14, atol=0)
                assert all(part.any() for part in parts)
                for part in parts:  # those that were merged are proportional
                    share = part.sum() / sum(parts).sum()
                    np.testing.assert_allclose(part, share * sum(parts), rtol=1e-11, atol=0)
                pairs = {(o, target) for o in problem.observed_as[k]}
                assert not pairs & met
                met |= pairs
            for o, matrix in enumerate(pomdp.kernel[action]):
                for target in range(problem.classes):
                    there = problem.states[bounds[target] : bounds[target + 1]]
                    assert matrix.toarray()[np.ix_(mine, there)].any() == ((o, target) in met)


@pytest.mark.parametrize(("seed", "dense"), PREPARED)
def test_states_that_are_left_out_are_worth_nothing(seed, dense):
    pomdp = random_pomdp(seed, dense=dense)
    problem = prepare(pomdp, corners(pomdp))
    gone = np.setdiff1d(np.arange(pomdp.states), problem.states)
    worst, best = extremes(pomdp)
    np.testing.assert_allclose(worst[gone], 0.0, atol=1e-12)
    np.testing.assert_allclose(best[gone], 0.0, atol=1e-12)
    rest = pomdp.initial[problem.states].sum()
    assert abs(sum(root.weight for root in problem.roots) - rest) < 1e-12
    assert all(abs(root.belief.sum() - 1) < 1e-12 for root in problem.roots)
    whole = sum(root.weight * problem.belief(root.y, root.belief) for root in problem.roots)
    np.testing.assert_allclose(whole[problem.states], pomdp.initial[problem.states], atol=1e-15)


@pytest.mark.parametrize(("seed", "dense"), PREPARED)
def test_an_action_without_an_option_is_the_double_of_one(seed, dense):
    pomdp = random_pomdp(seed, dense=dense)
    problem = prepare(pomdp, corners(pomdp))
    plain = prepare(pomdp, corners(pomdp), merge=False)
    assert plain.options == problem.classes * len(pomdp.actions)
    assert all(len(group) == 1 for group in plain.observed_as)
    for y in range(problem.classes):
        wanted = {signature(plain, j) for j in plain.option_range(y)}
        kept = [signature(problem, j) for j in problem.option_range(y)]
        assert set(kept) == wanted
        assert len(kept) == len(set(kept))


def signature(problem: Problem, j: int) -> tuple[object, ...]:
    """Rewards of an option and, for each next class, its branches added up by direction."""
    branches: dict[tuple[int, tuple[float, ...]], float] = {}
    for k in problem.branch_range(j):
        matrix = problem.matrices[k].toarray().ravel()
        mass = float(matrix.sum())
        key = (int(problem.arrays.branch_target[k]), tuple(np.round(matrix / mass, 9).tolist()))
        branches[key] = branches.get(key, 0.0) + mass
    return (
        tuple(problem.reward(j).tolist()),
        tuple(sorted((key, round(mass, 9)) for key, mass in branches.items())),
    )


@each_style
@each_problem
def test_merging_actions_and_observations_changes_no_value(name, style):
    pomdp = POMDPS[name]
    roots = corners(pomdp)
    one = SOLVERS[style](prepare(pomdp, roots), Demand(gap=GAP))
    two = SOLVERS[style](prepare(pomdp, roots, merge=False), Demand(gap=GAP))
    assert one.converged
    assert two.converged
    assert np.all(one.root_lower <= two.root_upper)
    assert np.all(two.root_lower <= one.root_upper)


def test_nearly_proportional_observations_do_not_spoil_the_upper_bound():
    # Two readings that differ by 1e-12 are worth discount * 1e-12 / 2 to him who must then choose.
    p = 0.5 + 0.95e-12 / 4
    look = [np.zeros((5, 5)), np.zeros((5, 5))]
    look[0][[0, 1], [2, 3]], look[1][[0, 1], [2, 3]] = (p, 1 - p), (1 - p, p)
    look[0][[2, 3], 4] = 1.0
    choose = np.zeros((5, 5))
    choose[:4, 4] = 1.0
    rewards = np.array([[0, 0, -1, -1, 0], [-1, -1, 1, -1, 0], [-1, -1, -1, 1, 0]], dtype=float)
    initial = np.array([0.5, 0.5, 0.0, 0.0, 0.0])
    pomdp = array_pomdp(
        [look, [choose], [choose.copy()]], rewards, initial, 0.5, terminal=np.arange(5) == 4
    )
    value = 0.5 * (p - (1 - p))
    for solver in SOLVERS.values():
        assert solver(prepare(pomdp), Demand(gap=1e-6)).upper >= value - 1e-16
