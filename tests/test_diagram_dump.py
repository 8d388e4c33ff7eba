"""Dumping and loading diagrams: round trips, and arrays that are no diagrams."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from diagram_tables import FLOAT, INDEX, SIZES, assert_table, from_table, random_table, tabulate

from factored_polca.diagrams import MERSENNE_61, Field, LeafType, Manager, at, dump, load

FIELD = Field()
TYPES: dict[str, tuple[LeafType, list[Any]]] = {
    "index": (INDEX, [0, 1, 2, 2**64 - 1]),
    "float": (FLOAT, [0.0, float("inf"), -1.5, 1e-310]),
    "field": (FIELD, [0, 1, MERSENNE_61 - 1, 77]),
}


@pytest.mark.parametrize("sizes", SIZES, ids=str)
@pytest.mark.parametrize("kind", TYPES)
def test_a_dumped_diagram_loads_as_itself_here_and_elsewhere(kind: str, sizes: tuple[int, ...]) -> None:
    leaf_type, values = TYPES[kind]
    for seed in range(5):
        manager = Manager(sizes, first_nodes=1)
        table = random_table(np.random.default_rng([seed, *sizes]), sizes, values)
        diagram = from_table(manager, table, leaf_type)
        arrays = dump(diagram)
        assert load(manager, arrays, leaf_type) == diagram
        other = Manager(sizes, first_nodes=1)
        other.constant(12345)  # node numbers differ there
        assert_table(load(other, arrays, leaf_type), table)


def sample() -> dict[str, Any]:
    manager = Manager((3, 2, 2))
    return dump(from_table(manager, tabulate((3, 2, 2), lambda s: s[0] * s[1] + s[2])))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"levels": None}, "'levels' is missing"),
        ({"leaves": None}, "'leaves' is missing"),
        ({"levels": []}, "levels that the model has not"),
        ({"levels": [-1]}, "levels that the model has not"),
        ({"levels": [4]}, "levels that the model has not"),
        ({"levels": [2**32]}, "levels that the model has not"),
        ({"levels": [[3]]}, "must be a list of integers"),
        ({"levels": [0.5]}, "must be a list of integers"),
        ({"levels": ["a"]}, "must be a list of integers"),
        ({"children": []}, "do not fit together"),
        ({"leaves": [1]}, "do not fit together"),
        ({"levels": [3, 2], "children": [0, 1], "leaves": [7]}, "not ordered"),
        ({"levels": [3, 2], "children": [0, -1], "leaves": [7]}, "not ordered"),
        ({"levels": [3, 2, 2], "children": [0, 0, 0, 1], "leaves": [7]}, "not ordered"),
        ({"levels": [3, 2, 1], "children": [0, 0, 0, 2**40], "leaves": [7]}, "not ordered"),
    ],
)
def test_arrays_that_are_no_diagram_are_refused(changes: dict[str, Any], message: str) -> None:
    arrays = {**sample(), **{k: None if v is None else np.array(v) for k, v in changes.items()}}
    with pytest.raises(ValueError, match=message):
        load(Manager((3, 2, 2)), {k: v for k, v in arrays.items() if v is not None}, INDEX)


def test_leaves_that_the_type_has_not_are_refused_or_made_canonical() -> None:
    manager = Manager((2,))
    one = {"levels": np.array([1]), "children": np.array([], dtype=np.int32)}
    with pytest.raises(ValueError, match="less than the prime"):
        load(manager, {**one, "leaves": np.array([MERSENNE_61], dtype=np.uint64)}, FIELD)
    minus_zero = np.array([-0.0]).view(np.uint64)
    assert load(manager, {**one, "leaves": minus_zero}, FLOAT) == manager.constant(0.0, FLOAT)


def test_redundant_and_repeated_nodes_are_reduced_away() -> None:
    # Two leaves 5, two nodes that test nothing: the constant 5.
    arrays = {
        "levels": np.array([2, 2, 1, 0]),
        "children": np.array([0, 1, 2, 2]),
        "leaves": np.array([5, 5], dtype=np.uint64),
    }
    manager = Manager((2, 2))
    assert load(manager, arrays, INDEX) == manager.constant(5)
    manager.assert_consistent()


def test_no_corruption_of_the_arrays_ever_breaks_the_store() -> None:
    random = np.random.default_rng(11)
    manager = Manager((3, 2, 2), first_nodes=1)
    good = sample()
    refused = 0
    for _ in range(3000):
        arrays = {name: array.copy() for name, array in good.items()}
        for _ in range(int(random.integers(1, 4))):
            name = str(random.choice(["levels", "children", "leaves"]))
            array = arrays[name]
            change = int(random.integers(5))
            if change == 0 and len(array):
                at_place = int(random.integers(len(array)))
                array[at_place] = int(random.integers(0, len(good["levels"]) + 2))
            elif change == 1 and len(array) and name != "leaves":
                extremes = [-1, 2**31 - 1, -(2**31), 65_536]
                array[int(random.integers(len(array)))] = extremes[int(random.integers(4))]
            elif change == 2:
                arrays[name] = array[: int(random.integers(len(array) + 1))]
            elif change == 3:
                arrays[name] = np.concatenate([array, array[:2]])
            else:
                random.shuffle(array)
        try:
            diagram = load(manager, arrays, INDEX)
        except ValueError:
            refused += 1
            continue
        values = [at(diagram, {0: x, 1: y, 2: z}) for x in range(3) for y in range(2) for z in range(2)]
        assert set(values) <= {int(v) for v in arrays["leaves"]}
    manager.assert_consistent()
    assert 0 < refused < 3000
    assert load(manager, good, INDEX) == from_table(
        manager, tabulate((3, 2, 2), lambda s: s[0] * s[1] + s[2])
    )
