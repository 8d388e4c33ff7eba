"""PolCA against the unreduced arrays: recursive optimality (DESIGN 5), values, policies, refusals.

The oracle is `factored_polca.explicit`: it builds each subtask's MDP over all states in rationals,
given the children's policies that the planner returned, and knows nothing of diagrams.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from random_models import random_model, random_tasks

from factored_polca import library
from factored_polca.diagrams import evaluate_states
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_dynamic_programming import evaluate_policy, optimal_solution
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.explicit.subtask import subtask_mdp
from factored_polca.hierarchy import (
    HierarchicalPlan,
    Options,
    plan,
    plan_mdp,
    planning_order,
    total_counts,
)
from factored_polca.models import Action, Feature, Model, ModelError, Task, TaskHierarchy

TIE = 1e-9


def state_numbers(model: Model, mdp: ExactMDP) -> np.ndarray:
    """The oracle's states as value numbers [state, feature]."""
    rows = [
        [feature.index(value) for feature, value in zip(model.features, values, strict=True)]
        for values in mdp.state_values
    ]
    return np.array(rows, dtype=np.int32)


def primitive_policies(found: HierarchicalPlan, states: np.ndarray) -> dict[str, list[int]]:
    """Each task's policy by state: number of the model's action, -1 where undefined."""
    symbolic = found.symbolic
    result = {}
    for solved in found.solved:
        leaf = evaluate_states(solved.policy, states, symbolic.columns()).astype(np.int64)
        result[solved.task.name] = np.where(leaf < len(symbolic.actions), leaf, -1).tolist()
    return result


def assert_recursively_optimal(model: Model, tasks: TaskHierarchy, found: HierarchicalPlan) -> None:
    flat = enumerate_model(model)
    states = state_numbers(model, flat)
    policies = primitive_policies(found, states)
    for solved in found.solved:
        name = solved.task.name
        mdp = subtask_mdp(model, tasks, name, policies)
        blocks = solved.reduction.project_states(states)
        values = solved.solution.values[blocks]
        choices = solved.solution.policy[blocks]
        arrays = mdp.to_arrays()
        assert (arrays.applicable == solved.reduction.quotient.mdp.applicable[:, blocks]).all()
        assert (arrays.terminal == solved.reduction.quotient.mdp.terminal[blocks]).all()
        safe = np.isfinite(values)
        with np.errstate(invalid="ignore"):
            q = np.array(
                [
                    arrays.rewards[a] + arrays.discount * _expected(arrays.transitions[a], values)
                    for a in range(len(arrays.actions))
                ]
            )
        q[~arrays.applicable] = -np.inf
        best = q.max(axis=0, initial=-np.inf)
        inner = safe & ~arrays.terminal
        scale = np.maximum(1, np.abs(best[inner]))
        allowed = TIE * scale + 4 * solved.solution.gap
        assert (np.abs(best[inner] - values[inner]) <= allowed).all(), f"{name}: Bellman residual"
        taken = q[choices[inner], np.flatnonzero(inner)]
        assert (best[inner] - taken <= allowed).all(), f"{name}: the policy is not greedy"
        assert (values[arrays.terminal] == 0).all()
        lost = ~safe
        assert (best[lost & ~arrays.terminal] == -np.inf).all(), f"{name}: a dead end that is none"
        for s in np.flatnonzero(inner):
            choice = mdp.actions[choices[s]]
            expected = (
                policies[choice][s] if choice in policies else [a.name for a in model.actions].index(choice)
            )
            assert policies[name][s] == expected


def _expected(matrix: object, values: np.ndarray) -> np.ndarray:
    """Rows times values, where 0 times minus infinity is 0."""
    finite = np.where(np.isfinite(values), values, 0.0)
    result = matrix @ finite  # type: ignore[operator]
    lost = (~np.isfinite(values)).astype(float)
    result[(matrix @ lost) > 0] = -np.inf  # type: ignore[operator]
    return result


def exact_polled_value(model: Model, tasks: TaskHierarchy, found: HierarchicalPlan) -> Fraction:
    """The value of the polled policy at b0, by elimination in rationals on all states."""
    flat = enumerate_model(model)
    root = found.root.task
    over = enumerate_model(model, terminal=_either(model.terminal, root.terminal))
    policy = primitive_policies(found, state_numbers(model, flat))[root.name]
    values = evaluate_policy(over, policy)
    total = Fraction(0)
    for chance, value in zip(flat.initial, values, strict=True):
        if chance:
            assert isinstance(value, Fraction)
            total += chance * value
    return total


def _either(a: object, b: object) -> object:
    return a | b  # type: ignore[operator]


@pytest.mark.parametrize("seed", range(50))
def test_random_hierarchies_are_recursively_optimal(seed: int) -> None:
    model = random_model(seed, features=(2, 3), max_states=48)
    tasks = random_tasks(seed, model)
    try:
        found = plan(model, tasks, Options(seed=seed))
    except ModelError as error:
        assert_refused_with_reason(model, tasks, str(error))
        return
    assert_recursively_optimal(model, tasks, found)
    exact = exact_polled_value(model, tasks, found)
    assert abs(found.polled.value - float(exact)) <= 1e-9 * max(1, abs(float(exact)))
    assert found.polled.lower <= float(exact) + 1e-12
    assert float(exact) <= found.polled.upper + 1e-12
    if not found.root.task.has_pseudo_reward:
        assert abs(found.root.value - float(exact)) <= 1e-9 * max(1, abs(float(exact)))
    if str(found.root.task.terminal) == "false":
        assert found.flat is not None
        assert found.polled.lower <= found.flat.upper


def assert_refused_with_reason(model: Model, tasks: TaskHierarchy, message: str) -> None:
    """A refusal is right only if brute force finds its reason too."""
    policies: dict[str, list[int]] = {}
    names = [action.name for action in model.actions]
    for task in planning_order(tasks):
        mdp = subtask_mdp(model, tasks, task.name, policies)
        if f"{task.name!r} has nothing to optimise" in message:
            numbers = [(a, s) for a in range(len(mdp.actions)) for s in range(mdp.states)]
            rewards = {mdp.rewards[a][s] for a, s in numbers if mdp.applicable[a][s]}
            assert len(rewards) == 1
            reached = {t for rows in mdp.rows for row in rows for t in row}
            assert rewards == {0} or not any(mdp.terminal[t] for t in reached)
            return
        solution = optimal_solution(mdp)
        policies[task.name] = [
            -1
            if a < 0
            else policies[mdp.actions[a]][s]
            if mdp.actions[a] in policies
            else names.index(mdp.actions[a])
            for s, a in enumerate(solution.policy)
        ]
    assert "can run into" in message
    assert any(q and v == float("-inf") for q, v in zip(mdp.initial, solution.values, strict=True))


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("toy", {}),
        ("taxi", {}),
        ("taxi", {"slip": "true", "size": "4"}),
        ("workshop", {"size": "1"}),
        ("linear", {"size": "5"}),
        ("components", {"size": "3"}),
        ("sysadmin", {"size": "4"}),
        ("expon", {"size": "4"}),
    ],
)
def test_shipped_domains_are_recursively_optimal(name: str, parameters: dict[str, str]) -> None:
    domain = library.load(name, parameters)
    found = plan(domain.model, domain.tasks)
    assert_recursively_optimal(domain.model, found.tasks, found)
    assert found.flat is not None
    assert found.polled.value <= found.flat.value + 1e-9 * max(1, abs(found.flat.value))


@pytest.mark.parametrize("slip", ["false", "true"])
def test_the_taxi_hierarchy_costs_nothing(slip: str) -> None:
    domain = library.load("taxi", {"slip": slip})
    found = plan(domain.model, domain.tasks)
    assert found.model.states == 600
    assert found.flat is not None
    assert found.flat.blocks == 501  # DESIGN 5
    assert found.polled.value == pytest.approx(found.flat.value, abs=1e-6)


def test_taxi_needs_fewer_q_values_than_maxq() -> None:
    # 632: Dietterich 2000 with his hand-made abstraction; 1520 blocks x actions: DESIGN 5.
    counts = total_counts(plan_domain("taxi").solved)
    assert counts.q_values == 1520
    assert counts.q_classes_shared < 632
    assert counts.q_classes_shared <= counts.q_classes <= counts.q_applicable <= counts.q_values


def test_taxi2_needs_fewer_q_values_than_maxq() -> None:
    # MAXQ's 632 recounted for 25 targets: 4*25*25 + 25 + 625 + 100 + 4 + 100 + 8.
    assert 4 * 25 * 25 + 25 + 625 + 100 + 4 + 100 + 8 == 3362
    found = plan_domain("taxi", anywhere="true")
    assert total_counts(found.solved).q_classes_shared < 3362
    assert found.flat is not None
    assert found.polled.value == pytest.approx(found.flat.value, abs=1e-6)


def plan_domain(name: str, **parameters: str) -> HierarchicalPlan:
    domain = library.load(name, parameters)
    return plan(domain.model, domain.tasks)


@pytest.mark.parametrize("seed", range(12))
def test_classes_of_q_values_equal_brute_force(seed: int) -> None:
    model = random_model(seed, features=(2, 3), max_states=48)
    found = plan(model)
    (solved,) = found.solved
    quotient = solved.reduction.quotient
    by_action = 0
    shared = set()
    pairs = 0
    for c in range(len(model.actions)):
        classes = set()
        for b in range(solved.reduction.partition.blocks):
            if quotient.mdp.applicable[c, b]:
                pairs += 1
                row = tuple(sorted(quotient.exact_row(c, b).items()))
                classes.add((row, quotient.exact_reward(c, b)))
        by_action += len(classes)
        shared |= classes
    counts = solved.counts
    assert (counts.q_applicable, counts.q_classes, counts.q_classes_shared) == (
        pairs,
        by_action,
        len(shared),
    )


def test_a_model_without_tasks_is_planned_flat() -> None:
    domain = library.load("linear", {"size": "6"})
    found = plan(domain.model)
    assert [solved.task.name for solved in found.solved] == ["flat"]
    assert found.flat is not None
    assert found.flat.value == found.root.value


def corridor(**changes: object) -> Model:
    x = Feature("x", range(4))
    settings: dict[str, object] = {
        "rewards": "-1",
        "terminal": "x == 3",
        "initial": {x: "{0: 1}"},
        **changes,
    }
    moves = [
        Action("right", {x: "min(x + 1, 3)"}),
        Action("left", {x: "max(x - 1, 0)"}),
    ]
    return Model("corridor", [x], moves, **settings)  # type: ignore[arg-type]


def test_the_corridor_has_its_closed_form_value() -> None:
    # three steps of -1 at discount 0.95
    found = plan(corridor())
    assert found.polled.value == pytest.approx(-(1 + 0.95 + 0.95**2), abs=1e-12)


@pytest.mark.parametrize("reward", ["0", "-1", "3.5"])
def test_a_task_with_one_constant_reward_and_no_end_is_refused(reward: str) -> None:
    model = corridor(terminal="false", rewards=reward)
    with pytest.raises(ModelError, match="nothing to optimise"):
        plan(model)


def test_a_task_with_reward_zero_is_refused_even_if_it_ends() -> None:
    with pytest.raises(ModelError, match="nothing to optimise"):
        plan(corridor(rewards="0"))


def test_one_constant_reward_before_an_end_is_enough() -> None:
    assert plan(corridor(rewards="-2")).polled.value < 0


def test_a_pseudo_reward_takes_the_place_of_the_reward_or_adds_to_it() -> None:
    model = corridor()
    alone = Task("T", ["right", "left"], pseudo_rewards="-2")
    added = Task("T", ["right", "left"], pseudo_rewards="-2", adds_reward=True)
    steps = 1 + 0.95 + 0.95**2
    for task, reward in ((alone, -2), (added, -3)):
        found = plan(model, TaskHierarchy([task]))
        assert found.root.value == pytest.approx(reward * steps, abs=1e-12)
        assert found.polled.value == pytest.approx(-steps, abs=1e-12)


def test_a_child_that_has_ended_is_not_applicable() -> None:
    # `there` ends at x == 2; from there the root must go on with its own action.
    there = Task("there", ["right", "left"], terminal="x == 2", pseudo_rewards="-1")
    root = Task("root", ["there", "right"])
    found = plan(corridor(rewards="-1 if x < 2 else -5"), TaskHierarchy([root, there]))
    partition = found.task("root").reduction.partition
    applicable = found.task("root").reduction.quotient.mdp.applicable
    at_two = found.task("root").reduction.block({"x": 2})
    assert at_two is not None
    assert partition.blocks == applicable.shape[1]
    assert applicable[:, at_two].tolist() == [False, True]
    assert found.polled.value == pytest.approx(-1 - 0.95 - 5 * 0.95**2, abs=1e-12)


def trap(start: str) -> Model:
    """x = 2 is a dead end: not terminal, and nothing is applicable there."""
    x = Feature("x", range(4))
    moves = [
        Action("risk", {x: "{2: 0.5, 3: 0.5}"}, applicable="x < 2"),
        Action("safe", {x: "{3: 1} if x == 0 else {2: 1}"}, applicable="x < 2"),
    ]
    return Model("trap", [x], moves, rewards="1 if x' == 3 else -1", terminal="x == 3", initial={x: start})


def test_a_dead_end_is_avoided_where_it_can_be() -> None:
    found = plan(trap("{0: 1}"))
    assert found.polled.value == pytest.approx(1)
    assert found.solved[0].dead_end_states == 2
    assert any("2 states" in warning for warning in found.warnings)


def test_a_start_that_cannot_avoid_a_dead_end_is_an_error() -> None:
    with pytest.raises(ModelError, match=r"x=1.*can run into"):
        plan(trap("{0: 0.5, 1: 0.5}"))


def test_polca_takes_a_partially_observed_model_only_where_told_to_suppose_it_seen() -> None:
    model = corridor(observability="partial")
    with pytest.raises(ModelError, match="partially observed"):
        plan_mdp(model)
    seen = plan_mdp(model, options=Options(assume_observed=True))
    assert seen.polled.value == plan_mdp(corridor()).polled.value


def test_an_unknown_solver_is_refused_with_a_list() -> None:
    tasks = TaskHierarchy([Task("T", ["right", "left"], solver="magic")])
    with pytest.raises(ModelError, match="policy iteration"):
        plan(corridor(), tasks)


@pytest.mark.parametrize("solver", ["vi", "pi", "mpi", "value_iteration"])
def test_every_solver_finds_the_taxi_value(solver: str) -> None:
    domain = library.load("taxi", {"size": "4"})
    reference = plan(domain.model, domain.tasks).polled.value
    assert plan(domain.model, domain.tasks, Options(solver=solver)).polled.value == pytest.approx(
        reference, abs=1e-8
    )


def test_seeds_and_orders_do_not_change_the_plan() -> None:
    domain = library.load("taxi", {"size": "3"})
    reference = plan(domain.model, domain.tasks)
    for options in (Options(seed=7), Options(order="file"), Options(order="force")):
        found = plan(domain.model, domain.tasks, options)
        assert found.polled.value == pytest.approx(reference.polled.value, abs=1e-10)
        assert [s.reduction.partition.blocks for s in found.solved] == [
            s.reduction.partition.blocks for s in reference.solved
        ]


def test_a_restriction_to_reachable_states_keeps_the_value() -> None:
    domain = library.load("taxi", {"size": "4"})
    everywhere = plan(domain.model, domain.tasks)
    restricted = plan(domain.model, domain.tasks, Options(reachable=True))
    assert restricted.polled.value == pytest.approx(everywhere.polled.value, abs=1e-10)
    for a, b in zip(restricted.solved, everywhere.solved, strict=True):
        assert a.reduction.partition.blocks <= b.reduction.partition.blocks


def test_plans_and_what_belongs_to_them_are_short_in_messages() -> None:
    taxi = library.load("taxi")
    found = plan_mdp(taxi.model, taxi.tasks)
    assert repr(found).startswith("<HierarchicalPlan of taxi: 7 tasks, worth 3.857")
    assert repr(found.root) == f"<SolvedTask Root: 55 blocks, worth {found.root.value:.6g}>"
    assert repr(found.root.reduction) == "<Reduction of taxi: 55 blocks>"
    assert all(len(repr(one)) < 200 for one in (found, *found.solved, found.symbolic))
