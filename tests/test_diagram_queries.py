"""Questions to diagrams against brute force over all states."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from diagram_tables import FLOAT, INDEX, SIZES, from_table, random_table, states, tabulate

from factored_polca.diagrams import (
    MERSENNE_61,
    Diagram,
    Field,
    LeafType,
    Manager,
    at,
    evaluate_states,
    leaves,
    node_count,
    restrict,
    states_for_leaves,
    states_of_leaves,
)

Sizes = tuple[int, ...]
FIELD = Field()
TYPES: dict[str, tuple[LeafType, list[Any]]] = {
    "index": (INDEX, [0, 1, 2, 2**64 - 1]),
    "float": (FLOAT, [0.0, float("inf"), -1.5, 1e-310]),
    "field": (FIELD, [0, 1, MERSENNE_61 - 1, 77]),
}
each_size = pytest.mark.parametrize("sizes", SIZES, ids=str)
each_type = pytest.mark.parametrize("kind", TYPES)


def drawn(sizes: Sizes, kind: str, seed: int) -> tuple[Any, Diagram]:
    leaf_type, values = TYPES[kind]
    random = np.random.default_rng([seed, *sizes])
    table = random_table(random, sizes, values)
    return table, from_table(Manager(sizes, first_nodes=1), table, leaf_type)


def distinct(table: Any, sizes: Sizes) -> list[Any]:
    """The values by first occurrence."""
    return list(dict.fromkeys(table[s] for s in states(sizes)))


@each_size
@each_type
def test_leaves_appear_by_first_occurrence(sizes: Sizes, kind: str) -> None:
    for seed in range(8):
        table, diagram = drawn(sizes, kind, seed)
        assert leaves(diagram) == distinct(table, sizes)


@each_size
@each_type
def test_evaluating_many_states_finds_each_value(sizes: Sizes, kind: str) -> None:
    for seed in range(4):
        table, diagram = drawn(sizes, kind, seed)
        listed = np.array(list(states(sizes)), dtype=np.int64).reshape(table.size, len(sizes))
        # Columns in another order, with one that nobody reads.
        columns = [len(sizes) - i for i in range(len(sizes))]
        shuffled = np.full((len(listed), len(sizes) + 1), -9)
        shuffled[:, columns] = listed
        payloads = evaluate_states(diagram, shuffled, columns)
        decoded = [diagram.leaf_type.decode(int(p)) for p in payloads]
        assert decoded == [table[s] for s in states(sizes)]
        assert decoded == [at(diagram, dict(enumerate(s))) for s in states(sizes)]


def test_evaluating_refuses_states_that_do_not_exist() -> None:
    manager = Manager([2, 3])
    diagram = from_table(manager, tabulate([2, 3], lambda s: 3 * s[0] + s[1]))
    for table, columns in (
        ([[0, 3]], [0, 1]), ([[2, 0]], [0, 1]), ([[-1, 0]], [0, 1]), ([[0, 0]], [0, 2]),
        ([[0, 0]], [0, -1]),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"row 0, .* lacks a column or has a value out of range"):
            evaluate_states(diagram, np.array(table), columns)
    for table, columns in (([[0, 0]], [0]), ([0, 0], [0, 1])):
        with pytest.raises(ValueError, match="columns one for each of 2 levels"):
            evaluate_states(diagram, np.array(table), columns)
    # A level that is not tested needs no column and no sensible value.
    low = manager.indicator(1, [2])
    assert evaluate_states(low, np.array([[2], [0]]), [7, 0]).tolist() == [1, 0]
    assert evaluate_states(low, np.empty((0, 2)), [0, 1]).tolist() == []
    with pytest.raises(ValueError, match="value 3 at level 1, which has 3 values"):
        at(low, {1: 3})
    with pytest.raises(KeyError):
        at(low, {0: 1})


@each_size
def test_node_count_counts_distinct_cofactors(sizes: Sizes) -> None:
    # A reduced diagram has a node for each distinct cofactor by a prefix of values that depends on
    # the next variable, and one for each leaf (Bryant 1986).
    for seed in range(8):
        table, diagram = drawn(sizes, "index", seed)
        nodes: set[tuple[int, tuple[Any, ...]]] = set()
        for level in range(len(sizes) + 1):
            for prefix in states(sizes[:level]):
                if level == len(sizes):
                    nodes.add((level, (table[prefix],)))
                    continue
                parts = [tuple(np.ravel(table[(*prefix, v)])) for v in range(sizes[level])]
                if any(part != parts[0] for part in parts):
                    nodes.add((level, tuple(parts)))
        assert node_count(diagram) == len(nodes)


@each_size
@each_type
def test_states_of_leaves_are_counted(sizes: Sizes, kind: str) -> None:
    for seed in range(6):
        table, diagram = drawn(sizes, kind, seed)
        order = distinct(table, sizes)
        expected = [sum(table[s] == value for s in states(sizes)) for value in order]
        assert states_of_leaves(diagram, range(len(sizes))) == expected


def test_levels_that_are_not_counted_count_once_and_must_not_be_tested() -> None:
    manager = Manager([2, 7, 3, 7])
    diagram = from_table(manager, tabulate([2, 7, 3, 7], lambda s: int(s[0] == 1 and s[2] == 2)))
    assert states_of_leaves(diagram, [0, 2]) == [5, 1]
    assert states_of_leaves(diagram, [0, 1, 2]) == [35, 7]
    assert states_of_leaves(manager.constant(4), [1, 3]) == [49]
    assert states_of_leaves(manager.constant(4), []) == [1]
    with pytest.raises(ValueError, match=r"tests levels \[2\]"):
        states_of_leaves(diagram, [0, 1])


def test_huge_counts_are_exact() -> None:
    # A sum mod 3 of 80 three-valued variables splits 3^80 states evenly; one state is set apart.
    count = 80
    manager = Manager([3] * count)
    classes = [manager.constant(v) for v in range(3)]
    for level in reversed(range(1, count)):
        classes = [
            manager.variable(level, [classes[(total + v) % 3] for v in range(3)]) for total in range(3)
        ]
    thirds = manager.variable(0, classes)
    assert states_of_leaves(thirds, range(count)) == [3**79] * 3
    single = manager.constant(1)
    for level in reversed(range(count)):
        single = manager.indicator(level, [2]) & single
    assert states_of_leaves(single, range(count)) == [3**80 - 1, 1]
    assert states_for_leaves(single).tolist() == [[0] * 80, [2] * 80]
    wide = Manager([1000] * 200)
    bit = wide.indicator(199, [5])
    assert states_of_leaves(bit, range(200)) == [999 * 1000**199, 1000**199]


@each_size
@each_type
def test_states_for_leaves_are_the_lexicographically_first(sizes: Sizes, kind: str) -> None:
    for seed in range(8):
        table, diagram = drawn(sizes, kind, seed)
        order = distinct(table, sizes)
        expected = [min(s for s in states(sizes) if table[s] == value) for value in order]
        found = states_for_leaves(diagram)
        assert found.shape == (len(order), len(sizes))
        assert [tuple(s) for s in found.tolist()] == expected


def test_queries_between_other_operations_see_their_own_diagram() -> None:
    # Scratch words of one walk must not mislead the next one over shared nodes.
    table, diagram = drawn((4, 1, 3, 2), "index", 3)
    sizes = diagram.manager.sizes
    for level, size in enumerate(sizes):
        for value in range(size):
            part = restrict(diagram, {level: value})
            states_for_leaves(part)
            for asked in (diagram, part):
                assert states_of_leaves(asked, range(4)) == [
                    sum(at(asked, dict(enumerate(s))) == leaf for s in states(sizes))
                    for leaf in leaves(asked)
                ]
    assert leaves(diagram) == distinct(table, sizes)
