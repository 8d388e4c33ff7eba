"""Classes of equal Q-values, of equal values and actions, and of equal actions, against exact rationals."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from random_models import random_model, random_tasks

from factored_polca import library
from factored_polca.control import Controller
from factored_polca.diagrams import evaluate_states
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_dynamic_programming import (
    action_values,
    evaluate_policy,
    optimal_solution,
)
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.hierarchy import HierarchicalPlan, Options, plan
from factored_polca.hierarchy.executable import composed_policy, executable
from factored_polca.hierarchy.irrelevance import KINDS, executable_by_classes, value_classes
from factored_polca.hierarchy.plan_file import load_plan, save_plan
from factored_polca.models import Action, Feature, Model, ModelError, boolean
from factored_polca.simulation import simulate

CHUNKS = [range(start, start + 10) for start in range(0, 100, 10)]


def numbers(model: Model, mdp: ExactMDP) -> np.ndarray:
    """The oracle's states as value numbers [state, feature]."""
    rows = [
        [feature.index(value) for feature, value in zip(model.features, values, strict=True)]
        for values in mdp.state_values
    ]
    return np.array(rows, dtype=np.int32)


def flat(seed: int) -> tuple[Model, HierarchicalPlan, ExactMDP] | None:
    """A random model planned flat, and its enumeration; None where a dead end can't be avoided."""
    model = random_model(seed, max_states=60)
    try:
        return model, plan(model), enumerate_model(model)
    except ModelError:
        return None


def same(labels: list[object]) -> list[int]:
    """Labels as numbers by first occurrence."""
    known: dict[object, int] = {}
    return [known.setdefault(label, len(known)) for label in labels]


@pytest.mark.parametrize("seeds", CHUNKS, ids=lambda r: f"{r.start}-{r.stop - 1}")
def test_classes_are_those_of_exact_values(seeds: range) -> None:
    for seed in seeds:
        case = flat(seed)
        if case is None:
            continue
        model, found, mdp = case
        exact = optimal_solution(mdp)
        q = action_values(mdp, exact.values)
        states = numbers(model, mdp)
        first = []
        for s in range(mdp.states):
            best = exact.values[s]
            open_ = mdp.terminal[s] or not isinstance(best, Fraction)
            first.append(-1 if open_ else next(a for a in range(len(q)) if q[a][s] == best))
        wanted: dict[str, list[object]] = {
            "q": [(mdp.terminal[s], tuple(row[s] for row in q)) for s in range(mdp.states)],
            "value": [(mdp.terminal[s], exact.values[s], first[s]) for s in range(mdp.states)],
            "action": [(mdp.terminal[s], first[s]) for s in range(mdp.states)],
        }
        for s in range(mdp.states):
            if mdp.terminal[s]:
                wanted["q"][s] = "ended"
        for kind in KINDS:
            classes = value_classes(found.root, kind)
            partition = classes.policy.partition
            leaf = evaluate_states(partition.diagram, states, found.symbolic.columns()).astype(np.int64)
            assert same(leaf.tolist()) == same(wanted[kind]), (seed, kind)
            assert partition.blocks == len(set(wanted[kind])), (seed, kind)
            assert [int(classes.policy.choice[c]) for c in leaf] == first, (seed, kind)
            assert sum(partition.sizes) == mdp.states
            if kind == "action":
                assert classes.lower is classes.upper is None
                continue
            assert classes.lower is not None
            assert classes.upper is not None
            for s, c in enumerate(leaf.tolist()):
                if isinstance(exact.values[s], Fraction):
                    assert Fraction(classes.lower[c]) <= exact.values[s] <= Fraction(classes.upper[c])
                else:
                    assert classes.lower[c] == classes.upper[c] == -math.inf
            if kind == "q":
                assert classes.q_values is not None
                for a, row in enumerate(q):
                    for s, c in enumerate(leaf.tolist()):
                        if not mdp.terminal[s]:
                            assert classes.q_values[a, c] == pytest.approx(float(row[s]), abs=1e-7)


@pytest.mark.parametrize("seeds", CHUNKS, ids=lambda r: f"{r.start}-{r.stop - 1}")
def test_the_lifted_policy_earns_the_optimum_from_every_state(seeds: range) -> None:
    for seed in seeds:
        case = flat(seed)
        if case is None:
            continue
        model, found, mdp = case
        exact, states = optimal_solution(mdp), numbers(model, mdp)
        for kind in KINDS:
            policy = executable_by_classes(found, kind)
            assert composed_policy(policy.symbolic, policy.tasks, policy.policies) == policy.policy
            taken = Controller(policy).actions(states)
            earned = evaluate_policy(mdp, taken.tolist())
            for s in range(mdp.states):
                if isinstance(exact.values[s], Fraction):
                    assert float(earned[s]) == pytest.approx(float(exact.values[s]), abs=1e-7), (seed, s)


@pytest.mark.parametrize("kind", KINDS)
def test_hierarchies_over_classes_do_the_same_and_survive_a_file(kind: str, tmp_path: Path) -> None:
    done = 0
    for seed in range(40):
        model = random_model(seed, max_states=60)
        try:
            found = plan(model, random_tasks(seed, model))
        except ModelError:
            continue
        done += 1
        path = tmp_path / "plan.polca"
        save_plan(executable_by_classes(found, kind), path)  # type: ignore[arg-type]
        back = load_plan(path)
        states = numbers(model, enumerate_model(model))
        expected = Controller(executable(found)).actions(states)
        assert (Controller(back).actions(states) == expected).all()
        for name, values in zip(model.features, states[0], strict=True):
            assert values < len(name.values)
        state = {f.name: f.values[v] for f, v in zip(model.features, states[-1], strict=True)}
        assert Controller(back).poll(state).action == Controller(executable(found)).poll(state).action
    assert done > 25


@pytest.mark.parametrize("within", [0.0, 0.5, 3.0, 100.0])
def test_values_taken_for_equal_lie_no_further_apart_than_asked_for(within: float) -> None:
    found = plan(library.load("taxi", {"size": "3"}).model)
    solution = found.root.solution
    for kind in ("q", "value"):
        classes = value_classes(found.root, kind, within)  # type: ignore[arg-type]
        for c in range(classes.classes):
            mine = classes.class_of_block == c
            rows = [solution.values, *solution.q_values] if kind == "q" else [solution.values]
            for row in rows:
                values = row[mine]
                if np.isfinite(values).all() and not found.root.reduction.mdp.terminal[mine].any():
                    assert np.ptp(values) <= within
            assert len(set(solution.policy[mine].tolist())) == 1
        assert classes.width <= within + 2 * solution.gap
    if within == 0.0:
        assert value_classes(found.root, "q", 0.0).classes >= value_classes(found.root, "q").classes


def test_factory_like_models_hold_few_values() -> None:
    """A counter that is painted when full: 2 x 11 blocks, with 11 values of each kind at most."""
    level, idle = Feature("level", range(11)), boolean("idle")
    model = Model(
        "fill", [level, idle],
        [
            Action("fill", {level: "{min(level + 1, 10): 0.9, level: 0.1}", idle: "not idle"}),
            Action("wait", {idle: "not idle"}),
        ],
        rewards=["-1 if idle else -1"], terminal=level.is_(10), initial={level: 0, idle: True},
        discount="0.9",
    )  # fmt: skip
    found = plan(model)
    assert found.root.reduction.partition.blocks == 11
    q, value, action = (value_classes(found.root, kind) for kind in KINDS)
    # V(l) = -1 + 0.9 (0.9 V(l + 1) + 0.1 V(l)): 10 values below the end, all by filling.
    assert (q.classes, value.classes, action.classes) == (11, 11, 2)
    expected = [0.0]
    for _ in range(10):
        expected.append((-1 + 0.81 * expected[-1]) / 0.91)
    assert value.lower is not None
    assert sorted(value.lower.tolist()) == pytest.approx(sorted(expected))
    assert action.policy.partition.nodes < q.policy.partition.nodes


def test_bad_arguments_are_refused() -> None:
    found = plan(library.load("taxi", {"size": "2"}).model)
    with pytest.raises(ValueError, match="kind is one of q, value, action"):
        value_classes(found.root, "model")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least 0"):
        value_classes(found.root, "q", -1.0)
    with pytest.raises(ValueError, match="hold no values"):
        value_classes(found.root, "action").value()
    hidden = plan(library.load("tiger").model)
    with pytest.raises(TypeError, match="whose state is seen"):
        value_classes(hidden.root, "q")  # type: ignore[arg-type]


def test_exchanged_actions_have_classes_by_value_and_action_only() -> None:
    model = library.load("sysadmin", {"size": "4"}).model
    found = plan(model, options=Options(interchangeable=True))
    named = plan(model)
    with pytest.raises(ModelError, match="interchangeable"):
        value_classes(found.root, "q")
    states = numbers(model, enumerate_model(model))
    for kind in ("value", "action"):
        mine = executable_by_classes(found, kind)  # type: ignore[arg-type]
        assert (Controller(mine).actions(states) == Controller(executable(found)).actions(states)).all()
    by_value = value_classes(found.root, "value")
    middle = evaluate_states(by_value.value(), states, found.symbolic.columns())
    optimum = named.root.solution.values[named.root.reduction.project_states(states)]
    np.testing.assert_allclose(np.asarray(middle).view(np.float64), optimum, atol=1e-6)


def test_a_plan_over_classes_is_simulated_alike() -> None:
    domain = library.load("taxi")
    found = plan(domain.model, domain.tasks)
    one, other = executable(found), executable_by_classes(found, "action")
    assert simulate(one, episodes=200, seed=3).mean == simulate(other, episodes=200, seed=3).mean
    assert sum(p.partition.blocks for p in other.policies.values()) < sum(
        p.partition.blocks for p in one.policies.values()
    )
