"""Value iteration on diagrams against exact rationals over all states, on random models.

The oracle is `factored_polca.explicit`: it enumerates the model from its expressions and knows nothing of
diagrams.  Bounds are compared as rationals, without any tolerance.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from random_models import random_model

from factored_polca import library
from factored_polca.diagrams import evaluate_states, leaves
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_dynamic_programming import evaluate_policy, optimal_solution
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.minimisation import DecisionProcess, flat_process, reduce
from factored_polca.models import Action, Feature, LimitReached, Model, ModelError
from factored_polca.solvers import solve_mdp
from factored_polca.structured.dead_ends import find_safety
from factored_polca.structured.policy_sweeps import PolicySweep
from factored_polca.structured.solution import StructuredSolution
from factored_polca.structured.value_iteration import structured_value_iteration
from factored_polca.symbolic import compile_model, reachable_states


def state_numbers(mdp: ExactMDP) -> np.ndarray:
    """The oracle's states as value numbers [state, feature]."""
    rows = [
        [feature.index(value) for feature, value in zip(mdp.features, values, strict=True)]
        for values in mdp.state_values
    ]
    return np.array(rows, dtype=np.int32)


def reached(mdp: ExactMDP) -> set[int]:
    """The states that the start leads to under the actions of `mdp`."""
    found = {s for s in range(mdp.states) if mdp.initial[s]}
    waiting = list(found)
    while waiting:
        s = waiting.pop()
        for rows in mdp.rows:
            new = set(rows[s]) - found
            found |= new
            waiting += new
    return found


def assert_bounds_hold(
    found: StructuredSolution, mdp: ExactMDP, inside: set[int] | None = None
) -> tuple[Fraction | float, ...]:
    """Every bound that `found` promises, at every state and at the start; answers V*."""
    symbolic = found.process.symbolic
    states, columns = state_numbers(mdp), symbolic.columns()
    values = evaluate_states(found.values, states, columns).view(np.float64).tolist()
    choices = evaluate_states(found.choices, states, columns).astype(int).tolist()
    primitive = evaluate_states(found.policy, states, columns).astype(int).tolist()
    none, names = len(mdp.actions), [action.name for action in symbolic.actions]
    policy = [-1 if choice == none else choice for choice in choices]
    exact = optimal_solution(mdp).values
    counted = set(range(mdp.states)) if inside is None else inside
    radius, loss = Fraction(found.radius), Fraction(found.policy_loss)
    for s in counted:
        if mdp.terminal[s]:
            assert (values[s], policy[s]) == (0.0, -1)
        elif exact[s] == -math.inf:
            assert (values[s], policy[s]) == (-math.inf, -1)
        else:
            assert abs(Fraction(values[s]) - exact[s]) <= radius
            assert mdp.applicable[policy[s]][s]
            assert names[primitive[s]] == mdp.actions[policy[s]]
    kept = [policy[s] if s in counted else -1 for s in range(mdp.states)]
    earned = evaluate_policy(mdp, kept)
    for s in counted:
        if policy[s] >= 0:
            assert earned[s] >= Fraction(values[s]) - radius - loss
    start = [s for s in range(mdp.states) if mdp.initial[s]]
    if any(exact[s] == -math.inf for s in start):
        assert found.lower == found.upper == -math.inf
    else:
        best = sum(mdp.initial[s] * exact[s] for s in start)
        got = sum(mdp.initial[s] * earned[s] for s in start)
        assert Fraction(found.lower) <= best <= Fraction(found.upper)
        assert found.lower <= found.value <= found.upper
        assert Fraction(found.policy_lower) <= got <= Fraction(found.upper)
    return exact


def solved(model: Model, **options: object) -> StructuredSolution:
    return structured_value_iteration(flat_process(compile_model(model)), **options)  # type: ignore[arg-type]


SEEDS = range(60)


@pytest.mark.parametrize("seed", SEEDS)
def test_bounds_hold_on_random_models(seed: int) -> None:
    model = random_model(seed, max_states=54)
    mdp = enumerate_model(model)
    found = solved(model)
    exact = assert_bounds_hold(found, mdp)
    assert found.status == "converged"
    finite = [abs(v) for v in exact if v != -math.inf]
    assert found.gap <= 1e-9 * max(1.0, 2 * float(max(finite)))


@pytest.mark.parametrize("seed", range(60, 100))
def test_bounds_hold_however_early_it_stops_and_however_coarse_the_diagrams(seed: int) -> None:
    model = random_model(seed, max_states=48)
    mdp = enumerate_model(model)
    symbolic = compile_model(model)
    process = flat_process(symbolic)
    for iterations in (0, 1, 2, 5):
        found = structured_value_iteration(process, iterations=iterations)
        assert found.iterations <= iterations
        assert_bounds_hold(found, mdp)
    for nodes in (1, 4, 9):
        assert_bounds_hold(structured_value_iteration(process, node_limit=nodes), mdp)
    assert_bounds_hold(structured_value_iteration(process, epsilon=0.5, absolute=True), mdp)


@pytest.mark.parametrize("seed", range(100, 130))
def test_dead_ends_are_worth_minus_infinity_and_avoided(seed: int) -> None:
    """With some of the actions only, states without an applicable one come up."""
    model = random_model(seed, max_states=48, actions=(3, 4))
    names = [action.name for action in model.actions][: 1 + (seed % 4 == 0)]
    mdp = enumerate_model(model).restrict(names)
    found = structured_value_iteration(flat_process(compile_model(model), names))
    primitives = {action.name: n for n, action in enumerate(model.actions)}
    assert [found.process.symbolic.actions[primitives[n]].name for n in names] == list(mdp.actions)
    assert_bounds_hold(found, mdp)


def test_the_models_of_the_dead_end_test_have_dead_ends() -> None:
    lost = 0
    for seed in range(100, 130):
        model = random_model(seed, max_states=48, actions=(3, 4))
        names = [action.name for action in model.actions][: 1 + (seed % 4 == 0)]
        lost += find_safety(flat_process(compile_model(model), names)).lost.is_constant is False
    assert lost >= 5


@pytest.mark.parametrize("seed", range(130, 150))
def test_a_restriction_to_reachable_states_leaves_their_values(seed: int) -> None:
    model = random_model(seed, max_states=48)
    symbolic = compile_model(model)
    process = flat_process(symbolic, reachable=reachable_states(symbolic).diagram)
    mdp = enumerate_model(model)
    assert_bounds_hold(structured_value_iteration(process), mdp, reached(mdp))


def far_off() -> Model:
    """A state that is left for a dead end with a probability that no float holds."""
    x = Feature("x", range(3))
    tiny = Fraction(1, 10**400)
    risk = Action("risk", {x: "{1: 1 - t, 2: t} if x == 0 else x"}, applicable="x != 2", rewards="1")
    wait = Action("wait", {}, applicable="x == 0")
    return Model(
        "far",
        [x],
        [risk, wait],
        terminal="x == 1",
        discount="0.9",
        initial={x: "0"},
        parameters={"t": tiny},
    )


def test_a_dead_end_counts_however_unlikely_it_is() -> None:
    found = solved(far_off())
    assert found.value == pytest.approx(0.0, abs=1e-9)
    assert sorted(leaves(found.values)) == [-math.inf, 0.0]


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("toy", {}),
        ("components", {"size": "6"}),
        ("expon", {}),
        ("linear", {}),
        ("sysadmin", {"size": "6"}),
        ("taxi", {}),
        ("taxi", {"slip": "true"}),
        ("workshop", {"size": "4"}),
    ],
)
def test_values_agree_with_the_quotients(name: str, parameters: dict[str, str]) -> None:
    symbolic = compile_model(library.load(name, parameters).model)
    process = flat_process(symbolic)
    reduction = reduce(process)
    quotient = solve_mdp(reduction.mdp)
    found = structured_value_iteration(process)
    assert found.status == "converged"
    representatives = reduction.partition.representatives
    columns = list(range(symbolic.manager.leaf_level))
    values = evaluate_states(found.values, representatives, columns).view(np.float64)
    free = ~reduction.mdp.terminal
    assert np.abs(values - quotient.values)[free].max() <= found.radius + quotient.gap
    assert found.radius <= 1e-6


def abstract_process(model: Model) -> tuple[DecisionProcess, ExactMDP]:
    """A process one of whose choices is a policy, in both readings."""
    symbolic = compile_model(model)
    flat = flat_process(symbolic)
    child = structured_value_iteration(flat)
    mdp = enumerate_model(model)
    states = state_numbers(mdp)
    taken = evaluate_states(child.policy, states, symbolic.columns()).astype(int)
    policy = np.where(taken < len(symbolic.actions), taken, -1).tolist()
    first = flat.choices[0]
    below = tuple(sorted({p for p in policy if p >= 0}))
    choice = replace(first, name="child", app=child.defined, primitives=below, policy=child.policy)
    both = mdp.with_abstract_actions({"child": policy}).restrict([mdp.actions[0], "child"])
    return replace(flat, choices=(first, choice)), both


@pytest.mark.parametrize("seed", range(150, 165))
def test_a_choice_may_be_the_policy_of_a_child(seed: int) -> None:
    model = random_model(seed, max_states=48)
    process, mdp = abstract_process(model)
    found = structured_value_iteration(process)
    states, columns = state_numbers(mdp), process.symbolic.columns()
    values = evaluate_states(found.values, states, columns).view(np.float64).tolist()
    exact = optimal_solution(mdp).values
    for s in range(mdp.states):
        if exact[s] == -math.inf:
            assert values[s] == -math.inf
        else:
            assert abs(Fraction(values[s]) - exact[s]) <= Fraction(found.radius)


@pytest.mark.parametrize("seed", range(165, 180))
def test_both_ways_to_sweep_a_policy_agree_with_the_definition(seed: int) -> None:
    from factored_polca.structured.bellman import Bellman

    model = random_model(seed, max_states=48, synchronic=False)
    process = flat_process(compile_model(model))
    bellman = Bellman(process)
    found = structured_value_iteration(process, iterations=2)
    mdp = enumerate_model(model)
    states, columns = state_numbers(mdp), process.symbolic.columns()
    value = bellman.masked(found.values)
    before = evaluate_states(value, states, columns).view(np.float64).tolist()
    policy = evaluate_states(found.choices, states, columns).astype(int).tolist()
    sweep = PolicySweep(bellman, found.policy)
    kinds = []
    for _ in range(5):
        after = evaluate_states(sweep.apply(value, may_merge=True), states, columns).view(np.float64)
        kinds.append(sweep.prepared is not None)
        for s in range(mdp.states):
            expected = Fraction(0)
            if policy[s] < len(mdp.actions):
                row = mdp.rows[policy[s]][s]
                ahead = sum(q * Fraction(before[t]) for t, q in row.items())
                expected = mdp.rewards[policy[s]][s] + mdp.discount * ahead
            error = Fraction(bellman.error(max(map(abs, before))))
            assert abs(Fraction(float(after[s])) - expected) <= error
    assert kinds == [False, False, True, True, True]


# -- limits -------------------------------------------------------------------------------------


def test_a_deadline_leaves_bounds_that_hold() -> None:
    model = library.load("taxi", {"slip": "true"}).model
    process = flat_process(compile_model(model))
    exact = structured_value_iteration(process)
    found = structured_value_iteration(process, deadline=time.monotonic() + 0.2)
    assert found.status in ("time limit", "converged")
    assert found.lower <= exact.lower
    assert exact.upper <= found.upper
    assert process.symbolic.manager.deadline is None


def test_interrupts_leave_bounds_that_hold() -> None:
    model = random_model(3, max_states=72)
    mdp = enumerate_model(model)

    for stop in (1, 2, 3):

        def interrupt(sweeps: int, gap: float, nodes: int, stop: int = stop) -> None:
            if sweeps == stop:
                raise KeyboardInterrupt

        found = solved(model, progress=interrupt)
        assert found.status == "interrupted"
        assert found.iterations == stop
        assert_bounds_hold(found, mdp)


def test_an_abort_by_another_thread_leaves_a_policy() -> None:
    process = flat_process(compile_model(library.load("workshop", {}).model))
    timer = threading.Timer(0.5, process.symbolic.manager.abort)
    timer.start()
    found = structured_value_iteration(process)
    timer.join()
    assert found.status == "time limit"
    assert found.lower <= 21.1923059 <= found.upper  # its optimum by the quotient


def test_short_memory_ends_in_bounds_that_hold() -> None:
    model = library.load("sysadmin", {"size": "9"}).model
    roomy = structured_value_iteration(flat_process(compile_model(model)))
    symbolic = compile_model(model)
    symbolic.manager.memory_limit = symbolic.manager.bytes + (1 << 12)
    found = structured_value_iteration(flat_process(symbolic))
    assert found.status == "memory limit"
    assert found.lower <= roomy.upper
    assert roomy.lower <= found.upper
    assert math.isfinite(found.upper)


def test_memory_for_not_even_the_rewards_is_a_limit() -> None:
    features = [Feature(f"x{i}", range(2)) for i in range(16)]  # 2^16 rewards
    rewards = [f"{2**i} * x{i}" for i in range(16)]
    symbolic = compile_model(Model("m", features, [Action("stay", {})], discount="0.9", rewards=rewards))
    symbolic.manager.memory_limit = symbolic.manager.bytes
    with pytest.raises(LimitReached, match="before its first sweep"):
        structured_value_iteration(flat_process(symbolic))


def test_what_has_no_bounds_is_refused_with_the_reason() -> None:
    x = Feature("x", range(2))
    stay = Action("stay", {})
    with pytest.raises(ModelError, match="discount 1"):
        solved(Model("m", [x], [stay], discount=1, rewards="-1", terminal="x == 1"))
    with pytest.raises(ModelError, match="finite horizon"):
        solved(Model("m", [x], [stay], discount="0.9", horizon=3))
    with pytest.raises(ModelError, match="whose state is seen"):
        solved(library.load("tiger", {}).model)
    with pytest.raises(ModelError, match="epsilon"):
        solved(Model("m", [x], [stay], discount="0.9"), epsilon=0.0)
    with pytest.raises(ModelError, match="beyond 10"):
        solved(Model("m", [x], [stay], discount="0.9", rewards="x * 10**250"))


def test_a_discount_of_zero_needs_one_sweep() -> None:
    x = Feature("x", range(3))
    found = solved(Model("m", [x], [Action("stay", {})], discount=0, rewards="x / 3", initial={x: "2"}))
    assert found.iterations == 1
    assert found.value == pytest.approx(2 / 3, abs=1e-15)


def test_ties_fall_to_the_first_choice() -> None:
    x = Feature("x", range(2))
    slow, quick = Action("slow", {x: "1 - x"}), Action("quick", {x: "1 - x"})
    found = solved(Model("m", [x], [slow, quick], discount="0.9", rewards="x"))
    assert leaves(found.choices) == [0]
