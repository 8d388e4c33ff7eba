"""Reachable states: both backends agree with enumeration's closure, and large sets are counted exactly."""

from __future__ import annotations

import time
from fractions import Fraction
from random import Random

import pytest
from compiled_cases import Case, case, chunks, compiled

from factored_polca.diagrams import INDEX, Aborted, MemoryLimit, sum_out
from factored_polca.explicit.reachability import reachable_states as explicit_closure
from factored_polca.library import load
from factored_polca.models import Action, Constant, Feature, Model, conditional, lottery
from factored_polca.symbolic import SymbolicModel, boolean_sets, compile_model, reachable_states
from factored_polca.symbolic.boolean_sets import BooleanSets
from factored_polca.symbolic.reach import initial_support, transition_relation

BACKENDS = ("dd", "kernel")


def agrees(found: Case, actions: list[str] | None, backend: str) -> None:
    exact = found.exact if actions is None else found.exact.restrict(actions)
    expected = explicit_closure(exact)
    reached = reachable_states(found.symbolic, actions, backend)  # type: ignore[arg-type]
    assert found.at(reached.diagram) == [int(inside) for inside in expected], (found.seed, backend)
    assert reached.states == sum(expected)
    assert reached.backend == backend


@chunks(140)
@pytest.mark.parametrize("backend", BACKENDS)
def test_the_reachable_set_is_the_closure_that_enumeration_finds(backend: str, seeds: range) -> None:
    for seed in seeds:
        agrees(case(seed), None, backend)


@chunks(60)
@pytest.mark.parametrize("backend", BACKENDS)
def test_the_closure_under_some_actions_is_that_of_enumeration(backend: str, seeds: range) -> None:
    for seed in seeds:
        found = case(seed)
        actions = [action.name for action in found.model.actions]
        agrees(found, Random(seed).sample(actions, len(actions) - 1), backend)


@chunks(40)
def test_the_pure_python_library_finds_the_same_set(seeds: range, monkeypatch: pytest.MonkeyPatch) -> None:
    load_library = boolean_sets._load
    monkeypatch.setattr(boolean_sets, "_load", lambda _: load_library("dd.autoref"))
    for seed in seeds:
        agrees(case(seed), None, "dd")


@pytest.mark.parametrize("library", ["dd.autoref", None])
def test_a_set_survives_the_way_to_a_bdd_and_back(library: str | None) -> None:
    for seed in range(30):
        found, random = case(seed), Random(seed)
        sets = BooleanSets(found.symbolic, library)
        diagram = found.diagram([random.randrange(2) for _ in range(found.exact.states)], INDEX)
        valid = sets.valid(found.symbolic.now_levels)
        function = sets.from_diagram(diagram) & valid
        assert sets.to_diagram(function) == diagram
        assert sets.to_diagram(valid & ~function) == ~diagram
        # Codes without a value are in no set: the counts agree.
        bits = sum(len(sets.bits[level]) for level in found.symbolic.now_levels)
        assert sets.bdd.count(function, bits) == sum(found.at(diagram)) if bits else True


def test_only_the_leaves_0_and_1_make_a_set() -> None:
    found = case(0)
    numbered = found.diagram(range(found.exact.states), INDEX)
    with pytest.raises(ValueError, match="leaves 0 and 1"):
        BooleanSets(found.symbolic).from_diagram(numbered)


def chain(length: int) -> SymbolicModel:
    """A counter 0 .. length-1 that stops at the end: `length` steps reach everything."""
    n = Feature("n", range(length))
    step = Action("step", {n: conditional(n.now < length - 1, n.now + 1, n.now)})
    return compile_model(Model("chain", [n], [step], initial={n: Constant(0)}))


@pytest.mark.parametrize("backend", BACKENDS)
def test_iterations_count_breadth_first_steps(backend: str) -> None:
    reached = reachable_states(chain(5), backend=backend)  # type: ignore[arg-type]
    # 1, 2, 3, 4 are found one a step; the fifth step finds nothing.
    assert (reached.states, reached.iterations) == (5, 5)


def test_terminal_and_inapplicable_states_lead_nowhere() -> None:
    n = Feature("n", range(6))
    step = Action("step", {n: n.now + 1}, applicable=n.now < 4)
    start = {n: Constant(0)}
    for terminal, expected in ((n.now.is_(2), 3), (False, 5)):
        found = compiled(Model("counter", [n], [step], terminal=terminal, initial=start))
        for backend in BACKENDS:
            assert reachable_states(found.symbolic, backend=backend).states == expected  # type: ignore[arg-type]


@pytest.mark.parametrize("backend", BACKENDS)
def test_large_sets_are_counted_exactly(backend: str) -> None:
    components = compile_model(load("components", {"size": 40}).model)
    assert reachable_states(components, backend=backend).states == 3**40  # type: ignore[arg-type]
    # From all false only runs of true bits from the bottom can be reached.
    linear = compile_model(load("linear", {"size": 12}).model)
    assert reachable_states(linear, backend=backend).states == 13  # type: ignore[arg-type]


def test_the_pure_python_library_copes_with_more_levels_than_the_recursion_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    load_library = boolean_sets._load
    monkeypatch.setattr(boolean_sets, "_load", lambda _: load_library("dd.autoref"))
    bits = [Feature(f"b{i}", range(2)) for i in range(600)]
    flip = Action("flip", {bits[0]: 1 - bits[0].now, bits[-1]: bits[0].now})
    model = Model("deep", bits, [flip], initial={bit: Constant(0) for bit in bits})
    # (0, 0) -> (1, 0) -> (0, 1) -> (1, 0)
    assert reachable_states(compile_model(model, order="file")).states == 3


def test_a_transition_relation_is_kept_in_parts() -> None:
    symbolic = compile_model(load("components", {"size": 120}).model)
    relation = transition_relation(symbolic, symbolic.actions[0])
    assert len(relation.clusters) > 1
    drawn = [level for cluster in relation.clusters for level in cluster.drawn]
    quantified = [level for cluster in relation.clusters for level in cluster.quantified]
    assert sorted(drawn) == [symbolic.next(i) for i in sorted(range(120), key=symbolic.next)]
    assert sorted(quantified) == sorted(symbolic.now_levels)


def test_the_support_of_the_initial_belief_is_where_it_is_positive() -> None:
    for seed in range(40):
        found = case(seed)
        start = found.at(initial_support(found.symbolic))
        assert start == [int(chance > 0) for chance in found.exact.initial], seed


def test_summing_out_a_condition_is_its_disjunction() -> None:
    found = case(3)
    size = len(found.model.features[0].values)
    level = found.symbolic.now(0)
    condition = found.diagram([int(s % 5 == 0) for s in range(found.exact.states)], INDEX)
    rest = found.exact.states // size
    values = found.at(condition)
    expected = [max(values[v * rest + s % rest] for v in range(size)) for s in range(found.exact.states)]
    assert found.at(sum_out(condition, level)) == expected


def test_unknown_names_are_refused_with_those_there_are() -> None:
    symbolic = chain(3)
    with pytest.raises(KeyError, match="there are step"):
        reachable_states(symbolic, ["jump"])
    with pytest.raises(ValueError, match="there are dd, kernel"):
        reachable_states(symbolic, backend="bdd")  # type: ignore[arg-type]


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_passed_deadline_stops_the_search(backend: str) -> None:
    symbolic = chain(50)
    symbolic.manager.deadline = time.monotonic() - 1
    with pytest.raises(Aborted, match="time limit"):
        reachable_states(symbolic, backend=backend)  # type: ignore[arg-type]


def test_too_little_memory_for_the_library_is_the_manager_s_error(monkeypatch: pytest.MonkeyPatch) -> None:
    # Pairs x_i = y_i, all x above all y: 2^18 nodes wherever a set of such states is kept.
    first = [Feature(f"x{i}", range(2)) for i in range(18)]
    second = [Feature(f"y{i}", range(2)) for i in range(18)]
    effects = {x: lottery([(Constant(0), Fraction(1, 2)), (Constant(1), Fraction(1, 2))]) for x in first}
    copies = {y: x.next for x, y in zip(first, second, strict=True)}
    start = {feature: Constant(0) for feature in (*first, *second)}
    model = Model("pairs", [*first, *second], [Action("toss", {**effects, **copies})], initial=start)
    symbolic = compile_model(model, order="file")
    monkeypatch.setattr(boolean_sets, "LEAST_MEMORY", 0)
    if boolean_sets.BooleanSets(symbolic).library == "dd.cudd":  # autoref knows no limit
        symbolic.manager.memory_limit = 1 << 22
        with pytest.raises(MemoryLimit, match="4 MiB"):
            reachable_states(symbolic)
