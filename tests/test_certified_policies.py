"""Certified bounds on what policies over beliefs earn, against the same beliefs followed by enumeration.

`ByHand` shares nothing with the code under test but the plan's numbers: beliefs are over all states.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from belief_plans import NAMES, ByHand, planned
from random_pomdps import random_pomdp
from test_polca_plus import random_hierarchy
from tree_brackets import random_pomdp as random_arrays
from tree_brackets import tiger

from factored_polca import library
from factored_polca.approximation.defects import overestimate
from factored_polca.cli import main
from factored_polca.control.certify import certify_plan, polled_bounds
from factored_polca.explicit.alpha_vectors import AlphaSet, AlphaVectors
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.hierarchy import Options, PomdpPlan, plan_pomdp
from factored_polca.hierarchy.pomdp_executable import executable_pomdp
from factored_polca.models import ModelError
from factored_polca.models.model import replace_fields
from factored_polca.simulation.measure import measure
from factored_polca.solvers.policy_bounds import PolicyBounds, bound_policy
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand

SEEDS = range(70)
MOST = 500
"""Beliefs at a depth beyond which the enumeration stops."""


def followed(
    choose: Callable[[np.ndarray], int],
    kernel: np.ndarray,
    rewards: np.ndarray,
    initial: np.ndarray,
    split: Callable[[list[tuple[np.ndarray, float]]], list[tuple[np.ndarray, float]]],
    discount: float,
    steps: int,
) -> tuple[float, float]:
    """Bounds on what a policy earns: all beliefs for some steps, then the least and the largest reward.

    kernel [a, o, s, t], rewards [a, s], initial [s].
    """
    total, weight, frontier = 0.0, 1.0, split([(initial, 1.0)])
    for _ in range(steps):
        if len(frontier) > MOST:
            break
        following = []
        for belief, chance in frontier:
            action = choose(belief)
            total += weight * chance * float(rewards[action] @ belief)
            for after in belief @ kernel[action]:
                if after.sum() > 1e-15:
                    following.append((after / after.sum(), chance * after.sum()))
        frontier, weight = split(following), weight * discount
    rest = weight * sum(chance for _, chance in frontier) / (1 - discount)
    return total + rest * min(rewards.min(), 0.0), total + rest * max(rewards.max(), 0.0)


@cache
def hierarchy(seed: int) -> PomdpPlan | None:
    """The plan of a random hierarchy, None where it is refused."""
    model = random_pomdp(seed, actions=(2, 3), max_states=12, channels=(0, 2))
    model = replace_fields(model, discount=Fraction(1 + seed % 3, 4))
    try:
        return plan_pomdp(model, random_hierarchy(seed, model), Options(trials=8, gap=1e-2))
    except ModelError:
        return None


@cache
def many_followed(seed: int) -> PolicyBounds:
    found = hierarchy(seed)
    assert found is not None
    return polled_bounds(executable_pomdp(found), beliefs=300)[0]


@pytest.mark.parametrize("seed", SEEDS)
def test_the_bounds_of_random_hierarchies_hold_the_value_by_enumeration(seed: int) -> None:
    found = hierarchy(seed)
    if found is None:
        return
    plan = executable_pomdp(found)
    by_hand = ByHand(plan)
    low, high = followed(
        by_hand.action, by_hand.kernel, by_hand.rewards, by_hand.initial, by_hand.split,
        float(found.model.discount), 16,
    )  # fmt: skip
    slack = 1e-8 * max(1.0, float(np.abs(by_hand.rewards).max()))
    before = (-np.inf, np.inf)
    for bounds in (*(polled_bounds(plan, beliefs=n)[0] for n in (0, 5)), many_followed(seed)):
        assert bounds.lower <= high + slack
        assert low <= bounds.upper + slack
        assert bounds.lower >= before[0] - slack  # following more beliefs makes no bound worse
        assert bounds.upper <= before[1] + slack
        before = bounds.lower, bounds.upper
    certain = certify_plan(found, plan, beliefs=5)
    assert certain.polled_lower is not None
    assert certain.polled_upper is not None
    assert certain.polled_lower <= high + slack
    assert low <= certain.polled_upper + slack


def test_the_random_hierarchies_try_the_bounds() -> None:
    plans = [hierarchy(seed) for seed in SEEDS]
    results = [many_followed(seed) for seed, plan in zip(SEEDS, plans, strict=True) if plan is not None]
    assert len(results) >= 60
    assert sum(found.closed for found in results) >= 10
    assert sum(not found.closed for found in results) >= 10
    assert sum(found.upper - found.lower <= 1e-3 for found in results) >= 40
    assert sum(plan is not None and len(plan.solved) > 1 for plan in plans) >= 40


@pytest.mark.parametrize("name", NAMES)
def test_the_bounds_of_small_plans_hold_the_value_by_enumeration(name: str) -> None:
    plan = planned(name)
    by_hand = ByHand(plan)
    low, high = followed(
        by_hand.action, by_hand.kernel, by_hand.rewards, by_hand.initial, by_hand.split,
        float(plan.model.discount), 60,
    )  # fmt: skip
    found, _ = polled_bounds(plan)
    assert found.lower <= high + 1e-8
    assert low <= found.upper + 1e-8
    assert found.lower <= found.upper


# Kaelbling, Littman & Cassandra's tiger and McCallum's cheese maze: several solvers agree (SOLVERS' table).
@pytest.mark.parametrize(("name", "value"), [("tiger", 19.371368), ("cheese", 3.486207)])
def test_flat_plans_that_close_are_certified_as_worth_the_optimum(name: str, value: float) -> None:
    found = plan_pomdp(library.load(name).model, options=Options(gap=1e-6, trials=None))
    certain = certify_plan(found)
    assert certain.polled_lower == pytest.approx(value, abs=3e-6)
    assert certain.polled_upper == pytest.approx(value, abs=3e-6)
    assert "none left" in certain.note


@pytest.mark.parametrize("name", ["meds", "cheese_taxi", "part_painting"])
def test_shipped_hierarchies_earn_in_episodes_what_is_certified(name: str) -> None:
    domain = library.load(name)
    found = plan_pomdp(domain.model, domain.tasks)
    plan = executable_pomdp(found)
    certain, runs = certify_plan(found, plan), measure(plan, episodes=300, child_episodes=1).runs[plan.root]
    assert certain.polled_lower is not None
    assert certain.polled_upper is not None
    assert certain.polled_upper - certain.polled_lower <= 1e-4
    # Five standard errors and what the episodes leave out: one run in a million misses them by chance.
    slack = 5 * runs.standard_error + runs.truncation
    assert certain.polled_lower - slack <= runs.mean <= certain.polled_upper + slack


# -- arrays ---------------------------------------------------------------------------------------


def random_policy(seed: int, pomdp: ArrayPOMDP) -> AlphaVectors:
    """Random vectors and actions, by what is seen."""
    random = np.random.default_rng(seed)
    sets = []
    for y in range(int(pomdp.observed.max()) + 1):
        states = np.flatnonzero(pomdp.observed == y)
        count = int(random.integers(1, 6))
        actions = random.integers(0, len(pomdp.actions), count)
        sets.append(AlphaSet(states, random.normal(size=(count, len(states))), actions))
    return AlphaVectors(pomdp.states, tuple(part for part in sets if len(part.states)))


def by_enumeration(pomdp: ArrayPOMDP, policy: AlphaVectors) -> tuple[float, float]:
    """Bounds on what a policy earns, all its beliefs being followed."""
    labels = np.unique(pomdp.observed)

    def split(beliefs: list[tuple[np.ndarray, float]]) -> list[tuple[np.ndarray, float]]:
        parts = [
            (np.where((pomdp.observed == y) & ~pomdp.terminal, belief, 0.0), chance)
            for belief, chance in beliefs
            for y in labels
        ]
        return [(p / p.sum(), chance * float(p.sum())) for p, chance in parts if p.sum() > 0]

    width = max(len(row) for row in pomdp.kernel)
    kernel = np.zeros((len(pomdp.actions), width, pomdp.states, pomdp.states))
    for a, row in enumerate(pomdp.kernel):
        for o, matrix in enumerate(row):
            kernel[a, o] = matrix.toarray()
    return followed(policy.action, kernel, pomdp.rewards, pomdp.initial, split, pomdp.discount, 30)


@pytest.mark.parametrize("seed", range(40))
def test_any_policy_is_worth_what_its_bounds_say(seed: int) -> None:
    pomdp = random_arrays(seed, discount=0.6)
    policy = random_policy(seed, pomdp)
    low, high = by_enumeration(pomdp, policy)
    slack = 1e-9 * max(1.0, float(np.abs(pomdp.rewards).max()))
    for beliefs in (0, 1, 10, 400):
        found = bound_policy(pomdp, policy.choose, beliefs=beliefs)
        assert found.lower <= high + slack
        assert low <= found.upper + slack


@pytest.mark.parametrize("seed", range(60))
def test_what_vectors_promise_is_at_most_so_much_too_much(seed: int) -> None:
    """Vectors of a solver, in another process than the one that they were found in, and of no solver."""
    pomdp = random_arrays(seed, discount=0.6)
    policy = random_policy(seed, pomdp)
    if seed % 2:
        other = random_arrays(seed, discount=0.5)
        solved = solve_pomdp(other, "sarsop", demand=Demand(gap=1e-3, iterations=10)).policy
        assert isinstance(solved, AlphaVectors)
        policy = solved  # which may lack states that were not reached
    if seed % 5 == 0:
        policy = AlphaVectors(pomdp.states, policy.sets[:-1])
    less = overestimate(pomdp, policy, np.arange(pomdp.states), lambda: None)
    assert less is not None
    _, high = by_enumeration(pomdp, policy)
    slack = 1e-9 * max(1.0, float(np.abs(pomdp.rewards).max()))
    live = np.where(pomdp.terminal, 0.0, pomdp.initial)
    parts = [np.where(pomdp.observed == y, live, 0.0) for y in np.unique(pomdp.observed)]
    for e in less:
        promised = sum(policy.value(part) - float(part @ e) for part in parts)
        assert promised <= high + slack


def test_vectors_of_a_solver_promise_little_too_much_in_their_own_process() -> None:
    pomdp = tiger(0.95)
    solved = solve_pomdp(pomdp, "sarsop", demand=Demand(gap=1e-3)).policy
    assert isinstance(solved, AlphaVectors)
    less = overestimate(pomdp, solved, np.arange(2), lambda: None)
    assert less is not None
    assert float(less.max(axis=1).min()) <= 5  # rewards are from -100 to 10, the lemma knows only these


def test_a_cycle_of_beliefs_is_solved_exactly() -> None:
    """Two rooms changed at each step, reward 1 and 0 by turns: 1 / (1 - gamma^2)."""
    swap = np.array([[0.0, 1.0], [1.0, 0.0]])
    pomdp = array_pomdp(  # another action, worth less, and never taken
        [[swap], [np.eye(2)]], np.array([[1.0, 0.0], [-1.0, -1.0]]), np.array([1.0, 0.0]), 0.9
    )
    found = bound_policy(pomdp, lambda beliefs: np.zeros(len(beliefs), dtype=np.int64))
    assert (found.followed, found.left, found.closed) == (2, 0, True)
    assert found.lower <= 1 / (1 - 0.81) <= found.upper
    assert found.upper - found.lower <= 1e-7


def test_opening_doors_without_listening_is_worth_minus_forty_five_a_step() -> None:
    pomdp = tiger(0.95)
    found = bound_policy(pomdp, lambda beliefs: np.ones(len(beliefs), dtype=np.int64))
    assert found.followed == 1
    assert found.lower == pytest.approx(-45 / 0.05, abs=1e-6)
    assert found.upper == pytest.approx(-45 / 0.05, abs=1e-6)


def test_what_has_ended_earns_nothing_and_all_may_have_ended() -> None:
    stop = np.array([[0.0, 1.0], [0.0, 0.0]])
    pomdp = array_pomdp(
        [[stop]], np.array([[3.0, 0.0]]), np.array([0.5, 0.5]), 0.9, terminal=np.array([False, True])
    )
    first = lambda beliefs: np.zeros(len(beliefs), dtype=np.int64)  # noqa: E731
    found = bound_policy(pomdp, first)
    assert found.lower == pytest.approx(1.5, abs=1e-9)
    over = bound_policy(replace(pomdp, initial=np.array([0.0, 1.0])), first)
    assert (over.lower, over.upper, over.closed) == (0, 0, True)


def test_what_has_no_bounds_is_refused_or_said() -> None:
    pomdp = tiger(0.95)
    with pytest.raises(ModelError, match="discount below 1"):
        bound_policy(replace(pomdp, discount=1.0), lambda beliefs: np.zeros(len(beliefs), dtype=np.int64))
    with pytest.raises(ModelError, match="no action"):
        bound_policy(pomdp, lambda beliefs: np.full(len(beliefs), -1))
    domain = library.load("meds")
    certain = certify_plan(plan_pomdp(domain.model, domain.tasks), block_limit=1)
    assert certain.polled_lower is None
    assert "more than 1 blocks" in certain.note
    late = certify_plan(plan_pomdp(domain.model, domain.tasks), deadline=0.0)
    assert late.polled_lower is None
    assert "time limit" in late.note


def test_the_command_names_what_is_certified(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "meds", "--json", "--episodes", "50"]) == 0
    data = json.loads(capsys.readouterr().out)
    certain = data["certified"]
    assert certain["polled_lower"] <= certain["polled_upper"] <= certain["optimum_upper"]
    assert certain["loss_bound"] == pytest.approx(certain["optimum_upper"] - certain["polled_lower"])
    assert main(["plan", "meds", "--quiet", "--episodes", "50"]) == 0
    assert "certified: the hierarchical policy earns 29.954 .. 29.954" in capsys.readouterr().out
