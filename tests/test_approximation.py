"""Approximate abstraction: what is merged is near, and what is certified holds, against brute force.

The oracle is `factored_polca.explicit`: all states in rationals, policies evaluated on them; beliefs of
partially observed models are followed one by one (`small_pomdps`).  It knows nothing of diagrams.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import combinations
from random import Random

import numpy as np
import pytest
from random_models import random_model, random_tasks
from random_pomdps import random_pomdp
from small_pomdps import bracket, different, extremes

from factored_polca import library
from factored_polca.approximation.approximate import (
    approximate,
    bounded_optimum,
    certify_mdp,
    certify_pomdp,
)
from factored_polca.approximation.bracket import bracketed
from factored_polca.approximation.certificate import certify_policy
from factored_polca.approximation.representatives import Representatives, cover, distance
from factored_polca.approximation.snap import as_epsilon, drop_parents, snap
from factored_polca.diagrams import Aborted, evaluate_states
from factored_polca.explicit import dynamic_programming
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.explicit.subtask import subtask_mdp
from factored_polca.hierarchy import Options, plan_mdp
from factored_polca.minimisation import DecisionProcess, Partition, flat_process, reduce
from factored_polca.models import Action, Feature, LimitReached, Model, ModelError, disjunction
from factored_polca.models.model import replace_fields
from factored_polca.solvers import solve_mdp
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.symbolic import RowDiagram, SymbolicModel, compile_model

ORACLE = 1e-9
"""Value iteration of the oracle is within 1e-11, sums of its values within this."""

EPSILONS = ("0.02", "0.1", "0.3")
SEEDS = range(100)

MOST_BELIEFS = 1_000

PURPOSELESS = (36,)

# -- representatives -------------------------------------------------------------------------------


def random_rows(random: Random, count: int, size: int) -> list[tuple[Fraction, ...]]:
    rows = []
    for _ in range(count):
        weights = [random.choice((0, 1, 1, 2, 5, 20)) for _ in range(size)]
        weights[random.randrange(size)] += 1
        rows.append(tuple(Fraction(w, sum(weights)) for w in weights))
    return list(dict.fromkeys(rows))


@pytest.mark.parametrize("seed", range(20))
def test_representatives_stand_for_all_rows_of_their_sets(seed: int) -> None:
    random = Random(seed)
    rows, epsilon = random_rows(random, 12, random.randint(2, 4)), Fraction(random.choice(EPSILONS))
    find = Representatives(rows, epsilon)
    sets = [frozenset((n,)) for n in range(len(rows))]
    sets += [s for s in map(frozenset, combinations(range(len(rows)), 2)) if find.of(s) is not None]
    shared = find.joined(sets)
    assert set(shared) == set(sets)
    for members, row in shared.items():
        assert sum(row) == 1
        for number in members:
            differences = [abs(a - b) for a, b in zip(row, rows[number], strict=True)]
            assert sum(differences) / 2 <= epsilon  # total variation from its other definition
            assert all(b for a, b in zip(row, rows[number], strict=True) if a)


def test_the_distance_of_rows_is_the_largest_difference_of_an_event() -> None:
    for p, q in combinations(random_rows(Random(1), 12, 4), 2):
        events = [[v for v in range(4) if mask >> v & 1] for mask in range(16)]
        assert distance(p, q) == max(abs(sum(p[v] - q[v] for v in e)) for e in events)


@pytest.mark.parametrize("seed", range(20))
def test_numbers_are_covered_by_the_fewest_representatives(seed: int) -> None:
    random = Random(seed)
    values = sorted({Fraction(random.randint(0, 40), 7) for _ in range(7)})
    radius = Fraction(random.randint(0, 9), 10)
    found = cover(values, radius)
    assert all(abs(value - image) <= radius for value, image in found.items())
    fewest = min(  # over all ways to cut the sorted numbers into runs, each within 2 * radius
        len(cuts) + 1
        for k in range(len(values))
        for cuts in combinations(range(1, len(values)), k)
        if all(
            run[-1] - run[0] <= 2 * radius
            for a, b in zip((0, *cuts), (*cuts, len(values)), strict=True)
            for run in [values[a:b]]
        )
    )
    assert len(set(found.values())) == fewest


def test_a_parent_is_dropped_where_it_never_matters_by_more_than_epsilon() -> None:
    x, y, z = Feature("x", range(2)), Feature("y", range(2)), Feature("z", range(2))
    effect = (
        "({0: 0.5, 1: 0.5} if y == 0 else {0: 0.52, 1: 0.48}) if z == 0 "
        "else ({0: 0.1, 1: 0.9} if y == 0 else {0: 0.13, 1: 0.87})"
    )
    model = Model("near", [x, y, z], [Action("a", {x: effect})], rewards="x", discount="0.9")
    symbolic = compile_model(model)
    assert snap(symbolic, "0.014").parents == 0  # the mean of the farther two is 0.015 from each
    assert snap(symbolic, "0.015").parents == 1
    assert reduce(flat_process(symbolic)).partition.blocks == 8
    near = snap(symbolic, "0.015")
    assert reduce(near.process(flat_process(symbolic))).partition.blocks == 4
    constant, _, dropped = drop_parents(symbolic.actions[0].rows[0].diagram, lambda _: True)
    assert constant.is_constant
    assert dropped == 2


@pytest.mark.parametrize("wrong", ["-0.1", 1, "x", float("nan"), float("inf"), "1/0"])
def test_an_epsilon_that_is_no_distance_is_refused(wrong: object) -> None:
    with pytest.raises(ModelError, match="must be from 0 to below 1"):
        as_epsilon(wrong)  # type: ignore[arg-type]


# -- snapped models --------------------------------------------------------------------------------


def row_at(symbolic: SymbolicModel, row: RowDiagram | None, feature: int, pair: np.ndarray) -> list[tuple]:
    """The rows of a feature at pairs (x, x') [pair, 2n]; None persists."""
    if row is None:
        size = len(symbolic.model.features[feature].values)
        return [tuple(Fraction(int(v == now)) for v in range(size)) for now in pair[:, feature].tolist()]
    numbers = evaluate_states(row.diagram, pair, symbolic.columns()).astype(int)
    return [row.rows[n] for n in numbers.tolist()]


@pytest.mark.parametrize("seed", range(0, 60, 3))
@pytest.mark.parametrize("partial", [False, True])
def test_snapped_rows_and_rewards_stay_within_epsilon(seed: int, partial: bool) -> None:
    model = random_pomdp(seed) if partial else random_model(seed, max_states=48)
    symbolic, epsilon = compile_model(model), Fraction(EPSILONS[seed % 3])
    snapped = snap(symbolic, epsilon)
    process = flat_process(symbolic)
    near = snapped.process(process)
    assert near.terminal == process.terminal
    sizes = [len(feature.values) for feature in model.features]
    states = np.array(list(np.ndindex(*sizes)), dtype=np.int32)
    pairs = np.array([[*a, *b] for a in states for b in states], dtype=np.int32)
    for number, (before, after) in enumerate(zip(symbolic.actions, near.symbolic.actions, strict=True)):
        assert before.app == after.app
        assert set(after.rows) <= set(before.rows)
        compared = [(before.rows[i], after.rows.get(i), i) for i in before.rows]
        compared += [(before.observations[j], after.observations[j], j) for j in before.observations]
        for old, new, feature in compared:
            olds, news = (row_at(symbolic, r, feature, pairs) for r in (old, new))
            for p, q in set(zip(olds, news, strict=True)):
                assert sum(q) == 1
                assert sum(abs(a - b) for a, b in zip(p, q, strict=True)) / 2 <= epsilon
                assert all(a for a, b in zip(p, q, strict=True) if b)
        for old, new in zip(process.rewards[number], near.rewards[number], strict=True):
            a, b = (evaluate_states(t.diagram, states, symbolic.columns()).astype(int) for t in (old, new))
            used = [old.values[n] for n in a]
            radius = epsilon * (1 - model.discount) * (max(used) - min(used))
            assert all(abs(old.values[i] - new.values[j]) <= radius for i, j in zip(a, b, strict=True))


def nearby(model: Model, seed: int) -> Model:
    """The model with a discount up to 0.9, but one in ten as it is: iterating far takes the oracle long."""
    return model if seed % 10 == 0 else replace_fields(model, discount=min(model.discount, Fraction(9, 10)))


# -- policies of fully observed models against all states ------------------------------------------


def state_numbers(model: Model, mdp: ExactMDP) -> np.ndarray:
    rows = [
        [feature.index(value) for feature, value in zip(model.features, values, strict=True)]
        for values in mdp.state_values
    ]
    return np.array(rows, dtype=np.int32)


def worth(initial: np.ndarray, values: np.ndarray) -> float:
    here = initial > 0
    return float(initial[here] @ values[here])


@pytest.mark.parametrize("seed", SEEDS)
def test_the_bounds_of_random_mdps_hold(seed: int) -> None:
    model = nearby(random_model(seed, max_states=40), seed)
    epsilon = EPSILONS[seed % 3]
    symbolic = compile_model(model)
    process = flat_process(symbolic)
    exact = enumerate_model(model)
    arrays, states = exact.to_arrays(), state_numbers(model, exact)
    initial = np.array([float(q) for q in exact.initial])
    best = worth(initial, dynamic_programming.value_iteration(arrays))
    found = approximate(process, snap(symbolic, epsilon), seed=seed)
    solution = solve_mdp(found.mdp)
    taken = evaluate_states(found.lift_policy(solution.policy), states, symbolic.columns()).astype(np.int64)
    taken = np.where(taken < len(arrays.actions), taken, -1)
    earned = worth(initial, dynamic_programming.evaluate_policy(arrays, taken.tolist()))
    slack = ORACLE * max(1.0, abs(best))
    one_step = certify_mdp(found, solution.policy, steps=1, seed=seed)
    further = certify_mdp(found, solution.policy, steps=10, seed=seed)
    by_errors = certify_mdp(found, solution.policy, class_limit=0, seed=seed)
    assert by_errors.classes is None
    assert further.classes is not None
    for certain in (one_step, further, by_errors):
        assert certain.lower - slack <= earned <= certain.upper + slack
        assert best <= certain.optimum + slack
        assert best - earned <= certain.loss + slack
    assert abs(best - earned) <= 2 * one_step.model_error + (slack if found.stable else np.inf)
    assert bounded_optimum(found, steps=10, seed=seed) >= best - slack
    assert found.partition.blocks <= reduce(process).partition.blocks


@pytest.mark.parametrize("seed", range(0, 100, 5))
def test_bounds_of_a_coarse_partition_and_a_bad_policy_hold(seed: int) -> None:
    """Any partition that respects the masks, any policy on it: here the masks alone, choices at random."""
    from factored_polca.approximation.aggregate import masks

    model = random_model(seed, max_states=48)
    symbolic = compile_model(model)
    process, exact = flat_process(symbolic), enumerate_model(model)
    arrays, states = exact.to_arrays(), state_numbers(model, exact)
    initial = np.array([float(q) for q in exact.initial])
    partition, random = masks(process), Random(seed)
    block = evaluate_states(partition.diagram, states, symbolic.columns()).astype(np.int64)
    first = [int(np.argmax(block == b)) for b in range(partition.blocks)]
    options = [[a for a in range(len(arrays.actions)) if arrays.applicable[a, s]] for s in first]
    policy = np.array([random.choice(a) if a else -1 for a in options])
    values = dynamic_programming.evaluate_policy(arrays, policy[block].tolist())
    best = worth(initial, dynamic_programming.value_iteration(arrays))
    earned, slack = worth(initial, values), ORACLE * max(1.0, float(np.abs(values).max()))
    widths = []
    for steps in (1, 2, 30):
        certain = certify_policy(process, partition, policy, steps=steps)
        assert certain.lower - slack <= earned <= certain.upper + slack
        assert best <= certain.optimum + slack
        assert best - earned <= certain.loss + slack
        widths.append(certain.upper - certain.lower)
    assert widths == sorted(widths, reverse=True)
    assert widths[-1] <= 2e-3 * max(1.0, abs(earned))  # every state apart at last, or narrow before


def test_epsilon_zero_is_exact_abstraction() -> None:
    for seed in range(0, 30, 3):
        model = random_model(seed, max_states=96)
        symbolic = compile_model(model)
        process = flat_process(symbolic)
        found, exact = approximate(process, snap(symbolic, 0)), reduce(process)
        assert found.partition.diagram == exact.partition.diagram
        certain = certify_mdp(found, solve_mdp(found.mdp).policy)
        assert certain.loss <= 1e-6 * max(1.0, abs(certain.optimum))
        assert certain.model_error == 0


def test_a_dead_end_that_a_merged_policy_may_meet_is_not_hidden() -> None:
    """A step in a hundred of `run` falls into a pit where nothing applies; `walk` is slow and safe."""
    place = Feature("place", ["start", "goal", "pit"])
    alive = "place != pit"
    model = Model(
        "pit",
        [place],
        [
            Action(
                "run", {place: "{goal: 0.99, pit: 0.01} if place == start else place"}, applicable=alive
            ),
            Action(
                "walk", {place: "{goal: 0.5, start: 0.5} if place == start else place"}, applicable=alive
            ),
        ],
        rewards="-1",
        terminal="place == goal",
        initial={place: "start"},
        discount="0.9",
    )
    symbolic = compile_model(model)
    process = flat_process(symbolic)
    for epsilon, low in (("0.001", -2.0), ("0.05", -np.inf)):
        found = approximate(process, snap(symbolic, epsilon))
        solution = solve_mdp(found.mdp)
        for limit in (100, 0):
            certain = certify_mdp(found, solution.policy, class_limit=limit)
            # safe: V = -1 + 0.9 * 0.5 V, so V = -1 / 0.55
            assert certain.optimum >= -1 / 0.55 - 1e-9
            assert certain.lower >= low if np.isfinite(low) else certain.lower == -np.inf
            assert np.isfinite(certain.loss) == np.isfinite(low)


def test_nothing_is_lost_where_there_is_nothing_to_choose() -> None:
    """The root of the taxi has one task to call in each state: the loss is 0 however coarse the blocks."""
    taxi = library.load("taxi", {"slip": "true"})
    exact = plan_mdp(taxi.model, taxi.tasks, Options(flat_block_limit=None))
    found = plan_mdp(taxi.model, taxi.tasks, Options(merge_within="0.05", flat_block_limit=None))
    assert exact.root.reduction.partition.blocks >= 5 * found.root.reduction.partition.blocks
    assert found.root.approximation is not None
    assert found.root.approximation.loss == 0


# -- hierarchies -----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(0, 60, 4))
def test_the_bounds_of_random_hierarchies_hold(seed: int) -> None:
    model = nearby(random_model(seed, max_states=64), seed)
    tasks = random_tasks(seed, model)
    options = Options(merge_within=EPSILONS[seed // 2 % 3], flat_block_limit=1000, seed=seed)
    if seed in PURPOSELESS:  # with other policies of its children the root earns one constant
        with pytest.raises(ModelError, match="has nothing to optimise"):
            plan_mdp(model, tasks, options)
        return
    found = plan_mdp(model, tasks, options)
    flat = enumerate_model(model)
    states, columns = state_numbers(model, flat), found.symbolic.columns()
    initial = np.array([float(q) for q in flat.initial])
    none = len(model.actions)
    policies = {}
    for solved in found.solved:
        taken = evaluate_states(solved.policy, states, columns).astype(np.int64)
        policies[solved.task.name] = np.where(taken < none, taken, -1).tolist()
    for solved in found.solved:
        # the task given its children's policies, and beside it the same with primitives to follow its own
        arrays = subtask_mdp(model, tasks, solved.task.name, policies).to_arrays()
        blocks = solved.reduction.project_states(states)
        choices = solved.solution.policy[blocks].tolist()
        best = worth(initial, dynamic_programming.value_iteration(arrays))
        earned = worth(initial, dynamic_programming.evaluate_policy(arrays, choices))
        certain = solved.approximation
        assert certain is not None
        slack = ORACLE * max(1.0, abs(best) if np.isfinite(best) else 1.0)
        assert certain.lower - slack <= earned <= certain.upper + slack
        assert best <= certain.optimum + slack
        if np.isfinite(best):
            assert best - earned <= certain.loss + slack
            assert certain.measured_loss == pytest.approx(best - earned, abs=1e-7 * max(1.0, abs(best)))
    over = enumerate_model(model, terminal=disjunction([model.terminal, found.root.task.terminal]))
    arrays = over.to_arrays()
    polled = dynamic_programming.evaluate_policy(arrays, policies[found.root.task.name])
    earned, best = worth(initial, polled), worth(initial, dynamic_programming.value_iteration(arrays))
    assert found.certified is not None
    assert found.certified.polled_lower is not None
    assert found.certified.polled_upper is not None
    assert found.certified.optimum_upper is not None
    assert found.certified.loss is not None
    slack = ORACLE * max(1.0, abs(best))
    assert found.certified.polled_lower - slack <= earned <= found.certified.polled_upper + slack
    assert best <= found.certified.optimum_upper + slack
    assert best - earned <= found.certified.loss + slack
    assert found.polled.value == pytest.approx(earned, abs=1e-7 * max(1.0, abs(earned)))


# -- partially observed models ---------------------------------------------------------------------


def followed(
    pomdp: ArrayPOMDP, block: np.ndarray, blocks: int, policy: object, depth: int
) -> tuple[float, float]:
    """Bounds on what a policy over blocks earns from b0, every belief over states being followed.

    Beliefs are those of the model itself; after `depth` steps, or where there are too many beliefs, the
    worst and the best policies go on that see the state.
    """
    worst, best = extremes(pomdp)
    live = [(pomdp.observed == y) & ~pomdp.terminal for y in np.unique(pomdp.observed)]
    beliefs = np.array([pomdp.initial * mine for mine in live])
    beliefs = beliefs[beliefs.sum(axis=1) > 0]
    low = high = 0.0
    branches = len(live) * max(len(row) for row in pomdp.kernel)
    step = 0
    while step < depth and len(beliefs) and len(beliefs) * branches <= MOST_BELIEFS:
        projected = np.zeros((len(beliefs), blocks))
        np.add.at(projected.T, block, beliefs.T)
        sums = projected.sum(axis=1, keepdims=True)
        actions = policy.choose(projected / sums).tolist()  # type: ignore[attr-defined]
        gain = sum(float(b @ pomdp.rewards[a]) for b, a in zip(beliefs, actions, strict=True))
        low, high = low + pomdp.discount**step * gain, high + pomdp.discount**step * gain
        step += 1
        after = [
            (belief @ matrix.toarray()) * mine
            for belief, a in zip(beliefs, actions, strict=True)
            for matrix in pomdp.kernel[a]
            for mine in live
        ]
        beliefs = np.array([b for b in after if b.sum() > 0]).reshape(-1, pomdp.states)
        if len(beliefs):  # equal posteriors are one, weighed by their chances
            chances = beliefs.sum(axis=1)
            distinct, numbers = different(beliefs / chances[:, None])
            beliefs = distinct * np.bincount(numbers, chances, len(distinct))[:, None]
    rest = pomdp.discount**step * beliefs.sum(axis=0)
    return low + float(rest @ worst), high + float(rest @ best)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_bounds_of_random_pomdps_hold(seed: int) -> None:
    model = replace_fields(random_pomdp(seed, max_states=8, channels=(0, 2)), discount=Fraction(1, 3))
    symbolic = compile_model(model)
    process = flat_process(symbolic)
    pomdp = enumerate_pomdp(model).to_arrays()
    states = np.array(list(np.ndindex(*(len(f.values) for f in model.features))), dtype=np.int32)
    found = approximate(process, snap(symbolic, EPSILONS[seed % 3]), seed=seed)
    solution = solve_pomdp(found.pomdp_quotient.pomdp, "sarsop", demand=Demand(gap=1e-3, iterations=30))
    certain = certify_pomdp(found, solution)
    block = found.project_states(states)
    low, high = followed(pomdp, block, found.partition.blocks, solution.policy, 12)
    optimum_low, optimum_high = bracket(pomdp, pomdp.initial[None, :], most=MOST_BELIEFS)
    slack = 1e-8 * max(1.0, float(np.abs(pomdp.rewards).max()))
    tighter = bracketed(found, solution, certain, block_limit=100, beliefs=20, trials=5)
    assert tighter.loss <= certain.loss
    for bounds in (certain, tighter):
        assert bounds.lower <= high + slack
        assert low <= bounds.upper + slack
        assert float(optimum_low[0]) <= bounds.optimum + slack
        assert float(optimum_low[0]) - high <= bounds.loss + slack
    assert low <= float(optimum_high[0]) + slack  # the oracle agrees with itself


# -- limits ----------------------------------------------------------------------------------------


def test_at_discount_one_nothing_is_promised() -> None:
    model = replace_fields(random_model(3), discount=Fraction(1))
    with pytest.raises(ModelError, match="discount 1"):
        plan_mdp(model, options=Options(merge_within="0.1"))
    process = flat_process(compile_model(random_model(3)))
    ended = replace_fields(model, discount=Fraction(1))
    symbolic = replace(process.symbolic, model=ended)
    trivial = Partition(symbolic, process.terminal, 1)
    with pytest.raises(ValueError, match="discount"):
        certify_policy(_with(process, symbolic), trivial, np.array([0]))


def _with(process: DecisionProcess, symbolic: SymbolicModel) -> DecisionProcess:
    return replace(process, symbolic=symbolic)


def test_too_many_blocks_and_no_time_are_named() -> None:
    taxi = library.load("taxi")
    with pytest.raises(LimitReached, match="more than 3 blocks"):
        plan_mdp(taxi.model, taxi.tasks, Options(merge_within="0.05", block_limit=3))
    with pytest.raises((LimitReached, Aborted), match="time limit"):
        plan_mdp(taxi.model, taxi.tasks, Options(merge_within="0.05", deadline=0.0))
