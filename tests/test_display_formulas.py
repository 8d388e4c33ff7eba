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
    assert sorted(formulas[3].split(" and ")) == ["not x_3", "x_0", "x_1", "x_2"]
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


# -- conditions that only count ---------------------------------------------------------------------------


def counting_model(count: int, values: int) -> SymbolicModel:
    features = [fp.Feature(f"c{k}", range(values)) for k in range(count)]
    return fp.compile_model(Model("parts", features, [fp.Action("wait", {})]))


def labelled(symbolic: SymbolicModel, value: Any) -> Diagram:
    """The condition that `value` of the counts of values holds, made state by state."""
    manager, model = symbolic.manager, symbolic.model
    result = manager.constant(0)
    for numbers in product(*(range(len(f.values)) for f in model.features)):
        if value([numbers.count(v) for v in range(len(model.features[0].values))]):
            cell = manager.constant(1)
            for k, v in enumerate(numbers):
                cell = cell & manager.indicator(symbolic.now(k), [v])
            result = result | cell
    return result


@pytest.mark.parametrize(
    ("count", "values", "condition", "expected"),
    [
        (6, 2, lambda k: k[1] == 3, "exactly 3 of c0 .. c5 == 0"),
        (6, 2, lambda k: k[0] >= 2, "at least 2 of c0 .. c5 == 0"),
        (6, 2, lambda k: 2 <= k[1] <= 3, "3 to 4 of c0 .. c5 == 0"),
        (5, 3, lambda k: k == [2, 2, 1], "exactly 2 of c0 .. c4 == 1 and exactly 1 of c0 .. c4 == 2"),
        (5, 3, lambda k: k == [3, 2, 0], "exactly 3 of c0 .. c4 == 0 and exactly 2 of c0 .. c4 == 1"),
        (5, 3, lambda k: k[2] <= 3 and k[2] >= 1, "1 to 3 of c0 .. c4 == 2"),
    ],
)
def test_what_only_counts_is_said_by_counting(
    count: int, values: int, condition: Any, expected: str
) -> None:
    symbolic = counting_model(count, values)
    found = formula(symbolic, labelled(symbolic, condition))
    assert found is not None
    for state in states_of(symbolic.model):
        counts = [list(state.values()).count(v) for v in range(values)]
        assert found.holds(state) is condition(counts)
    assert text(found, names_of(symbolic)) == expected


def test_what_is_not_symmetric_is_not_counted() -> None:
    from factored_polca.display.symmetry import count_vectors

    symbolic = counting_model(5, 2)
    manager = symbolic.manager
    some = labelled(symbolic, lambda k: k[0] == 2)
    first = manager.indicator(symbolic.now(0), [0])
    for condition in (some & first, some | first, first, some ^ manager.indicator(symbolic.now(4), [1])):
        nodes = read_nodes(condition)
        assert count_vectors(nodes, [2] * len(nodes.support), Budget(10**6)) is None


@pytest.mark.parametrize("seed", range(40))
def test_symmetry_is_found_exactly_where_all_exchanges_leave_a_condition_as_it_is(seed: int) -> None:
    """Random conditions of count vectors, some of them spoilt at one state, against all permutations."""
    import random
    from itertools import permutations

    from factored_polca.display.symmetry import count_vectors

    draw = random.Random(seed)
    count, values = 4, draw.choice((2, 3))
    symbolic = counting_model(count, values)
    vectors = [v for v in product(range(count + 1), repeat=values) if sum(v) == count]
    chosen = set(draw.sample(vectors, draw.randint(1, len(vectors) - 1)))
    table = {
        point: tuple(point.count(v) for v in range(values)) in chosen
        for point in product(range(values), repeat=count)
    }
    if seed % 2:
        spoilt = draw.choice(list(table))
        table[spoilt] = not table[spoilt]
    condition = symbolic.manager.constant(0)
    for point, true in table.items():
        if true:
            cell = symbolic.manager.constant(1)
            for k, v in enumerate(point):
                cell = cell & symbolic.manager.indicator(symbolic.now(k), [v])
            condition = condition | cell
    nodes = read_nodes(condition)
    symmetric = all(
        table[point] == table[tuple(point[k] for k in order)]
        for point in table
        for order in permutations(range(count))
    )
    if len(nodes.support) < count:
        return
    found = count_vectors(nodes, [values] * count, Budget(10**6))
    assert (found is not None) is symmetric
    if symmetric:
        assert found == {
            tuple(point.count(v) for v in range(values)) for point, true in table.items() if true
        }


def test_blocks_of_interchangeable_parts_are_told_by_counting() -> None:
    """`components`: what counts is how many parts are in which condition; C(17, 2) = 136 blocks of 3^15."""
    symbolic = fp.compile_model(fp.load_domain("components", {"size": 15}).model)
    partition = fp.minimise(fp.flat_process(symbolic)).partition
    assert partition.blocks == 136
    formulas = list(block_formulas(partition, 4))
    assert formulas[1:3] == [
        "exactly 14 of c_0 .. c_14 == ok and exactly 1 of c_0 .. c_14 == degraded",
        "exactly 14 of c_0 .. c_14 == ok and exactly 1 of c_0 .. c_14 == failed",
    ]
    assert "no short formula" not in "".join(formulas)
