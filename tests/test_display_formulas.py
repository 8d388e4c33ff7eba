"""Formulas of blocks: true on exactly their states, by enumeration; prime, irredundant, short."""

from __future__ import annotations

from itertools import product
from typing import Any

import pytest
from random_models import random_model

import factored_polca as fp
from factored_polca.diagrams import Diagram, at, choose
from factored_polca.display.covers import Budget, Condition, Cube, TooLong, cover
from factored_polca.display.formulas import FALSE, TRUE, Membership, formula, names_of, size, text
from factored_polca.display.nodes import read_nodes
from factored_polca.display.partition_view import block_formulas
from factored_polca.explicit.enumeration import condition_memo
from factored_polca.models import Model
from factored_polca.models.language import parse
from factored_polca.models.model import resolve
from factored_polca.symbolic import SymbolicModel


def states_of(model: Model) -> list[dict[str, Any]]:
    names = [feature.name for feature in model.features]
    return [
        dict(zip(names, values, strict=True)) for values in product(*(f.values for f in model.features))
    ]


def block_of(symbolic: SymbolicModel, diagram: Diagram, state: dict[str, Any]) -> int:
    features = enumerate(symbolic.model.features)
    return int(at(diagram, {symbolic.now(k): f.index(state[f.name]) for k, f in features}))  # type: ignore[misc]


@pytest.mark.parametrize("seed", range(30))
def test_formulas_are_true_on_exactly_the_states_of_their_block(seed: int) -> None:
    """The text, read by the language's parser and evaluated state by state by the explicit reading."""
    model = random_model(seed, max_states=96)
    symbolic = fp.compile_model(model)
    partition = fp.minimise(fp.flat_process(symbolic)).partition
    states, names = states_of(model), names_of(symbolic)
    for block in range(partition.blocks):
        found = formula(symbolic, partition.indicator(block))
        assert found is not None
        told = condition_memo(model, resolve(model, parse(text(found, names))))
        inside = 0
        for state in states:
            expected = block_of(symbolic, partition.diagram, state) == block
            assert found.holds(state) is expected
            assert told({(name, False): value for name, value in state.items()}) is expected
            inside += expected
        assert inside == partition.sizes[block]


@pytest.mark.parametrize("seed", range(20))
def test_covers_are_exact_prime_and_irredundant(seed: int) -> None:
    model = random_model(seed, max_states=64)
    symbolic = fp.compile_model(model)
    partition = fp.minimise(fp.flat_process(symbolic)).partition
    for block in range(min(partition.blocks, 6)):
        nodes = read_nodes(partition.indicator(block))
        features = {symbolic.now(k): f for k, f in enumerate(model.features)}
        sizes = [len(features[level].values) for level in nodes.support]
        cubes = cover(Condition(nodes, sizes, 1, Budget(10**7)))
        points = list(product(*(range(n) for n in sizes)))
        truth = {p for p in points if value_at(nodes, p) == 1}

        def members(cube: Cube, points: list[Any] = points) -> set[Any]:
            return {p for p in points if all(v in s for v, s in zip(p, cube, strict=True))}

        assert set().union(*map(members, cubes)) == truth
        for number, cube in enumerate(cubes):
            others = set().union(*(members(c) for k, c in enumerate(cubes) if k != number))
            assert not members(cube) <= others, "a cube can be left out"
            for place, n in enumerate(sizes):
                for value in set(range(n)) - cube[place]:
                    wider = (*cube[:place], cube[place] | {value}, *cube[place + 1 :])
                    assert not members(wider) <= truth, "a cube can be made larger"


def value_at(nodes: Any, point: tuple[int, ...]) -> int:
    place = {level: k for k, level in enumerate(nodes.support)}
    node = nodes.root
    while nodes.children[node]:
        node = nodes.children[node][point[place[nodes.levels[node]]]]
    return int(nodes.leaves[node])


def small_model() -> SymbolicModel:
    x, name = fp.Feature("x", range(6)), fp.Feature("name", ["red", "dark red", "x", "true", "or"])
    flags = [fp.boolean(f"f{k}") for k in range(4)]
    return fp.compile_model(Model("small", [x, name, *flags], [fp.Action("wait", {})]))


def said(symbolic: SymbolicModel, condition: str) -> str:
    """The formula of a condition that is given as text."""
    from factored_polca.symbolic.model import compile_condition

    expression = resolve(symbolic.model, parse(condition))
    diagram = compile_condition(symbolic, expression, (), symbolic.manager.constant(1))
    found = formula(symbolic, diagram)
    assert found is not None
    return text(found, names_of(symbolic))


@pytest.mark.parametrize(
    ("condition", "expected"),
    [
        ("x == 0 or x == 1 or x == 2", "x <= 2"),
        ("x >= 4", "x >= 4"),
        ("x > 0 and x < 4", "1 <= x <= 3"),
        ("x == 0 or x == 5", "x in {0, 5}"),
        ("x != 3", "x != 3"),
        ("f0 and not f1 or f0 and f1 and x == 2", None),
        ("(f0 or f1) and (f2 or f3)", "(f0 or f1) and (f2 or f3)"),
        ("not (f0 and f1 and f2 and f3)", "not f0 or not f1 or not f2 or not f3"),
        ('name == red or name == "dark red"', 'name in {red, "dark red"}'),
        ('name == "x" or name == "true"', 'name in {"x", "true"}'),
        ('name == "or"', 'name == "or"'),
        ("true", "true"),
        ("false", "false"),
        ("f0 or not f0", "true"),
    ],
)
def test_formulas_read_well(condition: str, expected: str | None) -> None:
    """Expected texts are written by hand; None: only that fewer tests are needed than in the condition."""
    symbolic = small_model()
    found = said(symbolic, condition)
    if expected is None:
        assert found.count("f") < condition.count("f")
    else:
        assert found in (expected, " and ".join(reversed(expected.split(" and "))))


def test_the_shortest_of_cover_and_complement_is_taken() -> None:
    symbolic = small_model()
    # all but one cell: five cubes, but its complement is one
    found = said(symbolic, "not (x == 2 and name == red and f0 and f1)")
    assert set(found.split(" or ")) == {"x != 2", "name != red", "not f0", "not f1"}


def test_of_2_to_the_40_states_each_block_has_its_formula() -> None:
    """`linear`: block k has x_0 .. x_{k-1} true and x_k false, 2^(39-k) states (Boutilier et al. 2000)."""
    symbolic = fp.compile_model(fp.load_domain("linear", {"size": 40}).model)
    partition = fp.minimise(fp.flat_process(symbolic)).partition
    assert partition.sizes == [2 ** (39 - k) for k in range(40)] + [1]
    formulas = list(block_formulas(partition, 5))
    assert formulas[0] == "not x_0"
    assert formulas[3] == "x_0 and x_1 and x_2 and not x_3"
    shown = partition._repr_html_()
    assert "1,099,511,627,776 states in 41 blocks" in shown
    assert "549,755,813,888" in shown
    assert "… 11 more blocks of 1,024 states" in shown


def test_a_parity_has_no_short_formula_and_its_block_shows_a_state() -> None:
    flags = [fp.boolean(f"f{k}") for k in range(20)]
    symbolic = fp.compile_model(Model("parity", flags, [fp.Action("wait", {})]))
    manager = symbolic.manager
    odd = manager.constant(0)
    for k in range(20):
        odd = odd ^ manager.indicator(symbolic.now(k), [1])
    assert formula(symbolic, odd) is None
    from factored_polca.minimisation import partition_from

    first = next(block_formulas(partition_from(symbolic, odd)))
    assert first.startswith("no short formula; such as f0=")
    with pytest.raises(TooLong):
        cover(Condition(read_nodes(odd), [2] * 20, 1, Budget(10**6)))


def test_the_budget_ends_the_work() -> None:
    symbolic = small_model()
    manager = symbolic.manager
    some = choose(
        manager.indicator(symbolic.now(0), [1, 3]),
        manager.indicator(symbolic.now(1), [0]),
        manager.constant(0),
    )
    assert formula(symbolic, some, Budget(1)) is None
    assert formula(symbolic, some, Budget(10_000)) is not None


def test_only_present_features_make_a_formula() -> None:
    symbolic = small_model()
    with pytest.raises(ValueError, match="present features"):
        formula(symbolic, symbolic.manager.indicator(symbolic.next(0), [1]))


def test_sizes_of_formulas() -> None:
    test = Membership(fp.Feature("x", range(3)), frozenset({1}))
    assert size(test) > size(TRUE) == size(FALSE) == 0
