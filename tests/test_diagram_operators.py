"""Every row of the operator table against its textbook definition, on all functions of two variables."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from diagram_tables import FLOAT, INDEX, from_table, random_table, tabulate, to_table

from factored_polca.diagrams import (
    MERSENNE_61,
    OPERATORS,
    Diagram,
    Field,
    LeafType,
    Manager,
    apply,
    evaluate_states,
    random_prime,
    relabel,
)
from factored_polca.diagrams.operators import OperatorRow

P = MERSENNE_61
FIELD = Field()
OTHER = Field(2**61 - 31)
INF = math.inf

TEXTBOOK: dict[tuple[str, str], Callable[[Any, Any], Any]] = {
    ("plus", "field"): lambda a, b: a + b,
    ("minus", "field"): lambda a, b: a - b,
    ("times", "field"): lambda a, b: a * b,
    ("plus", "float"): lambda a, b: a + b,
    ("minus", "float"): lambda a, b: a - b,
    ("times", "float"): lambda a, b: 0.0 if 0 in (a, b) else a * b,
    ("minimum", "float"): lambda a, b: a if a <= b else b,
    ("maximum", "float"): lambda a, b: a if a >= b else b,
    ("less", "float"): lambda a, b: int(a < b),
    ("and", "boolean"): lambda a, b: int(bool(a) and bool(b)),
    ("or", "boolean"): lambda a, b: int(bool(a) or bool(b)),
    ("xor", "boolean"): lambda a, b: int(bool(a) is not bool(b)),
    ("difference", "boolean"): lambda a, b: int(bool(a) and not bool(b)),
    ("equal", "any"): lambda a, b: int(a == b),
}

LEAF_SETS: dict[str, list[tuple[LeafType, tuple[Any, ...]]]] = {
    "field": [(FIELD, (0, 1, P - 1)), (FIELD, (2, P - 2, 2**60 + 12345)), (OTHER, (0, 1, OTHER.prime - 1))],
    "float": [(FLOAT, (0.0, 1.0, -2.5)), (FLOAT, (INF, -INF, 0.0)), (FLOAT, (-0.0, 0.1, INF))],
    "boolean": [(INDEX, (0, 1))],
}
LEAF_SETS["any"] = [*LEAF_SETS["field"][:1], *LEAF_SETS["float"][:2], (INDEX, (0, 1, 7))]

CASES = [
    (row, leaf_type, values)
    for row in OPERATORS.values()
    for leaf_type, values in LEAF_SETS[row.kind]
]  # fmt: skip


def named(case: object) -> str | None:
    return f"{case.name}-{case.kind}" if isinstance(case, OperatorRow) else None


def result_type(row: OperatorRow, leaf_type: LeafType) -> LeafType:
    return INDEX if row.gives == "boolean" else leaf_type


def payload(value: Any, leaf_type: LeafType) -> int:
    """The expected payload, by the definition of each leaf type."""
    if isinstance(leaf_type, Field):
        return int(value) * 2**64 % leaf_type.prime
    if leaf_type == FLOAT:
        canonical = np.nan if math.isnan(value) else (value if value else 0.0)
        return int(np.float64(canonical).view(np.uint64))
    return int(value)


def test_the_table_of_operators_is_the_textbook() -> None:
    assert set(OPERATORS) == set(TEXTBOOK)


def all_pairs(row: OperatorRow, leaf_type: LeafType, values: Sequence[Any], sizes: tuple[int, int]) -> None:
    """One apply for all pairs of functions: two variables on top choose the functions.

    The diagrams are (i, j, x, y) -> f_i(x, y) and (i, j, x, y) -> f_j(x, y), where f_i is the i-th
    function by its values written as a number in base len(values).
    """
    points, base = sizes[0] * sizes[1], len(values)
    functions = base**points
    manager = Manager((functions, functions, *sizes))
    digits = np.array(list(itertools.product(range(base), repeat=points)), dtype=np.int64)

    def point(digit: Sequence[int]) -> Diagram:
        rows = [digit[x * sizes[1] : (x + 1) * sizes[1]] for x in range(sizes[0])]
        return manager.variable(2, [manager.variable(3, [leaf[int(v)] for v in row]) for row in rows])

    leaf = [manager.constant(value, leaf_type) for value in values]
    each = [point(digit) for digit in digits]
    result = apply(row.name, manager.variable(0, each), manager.variable(1, each))
    assert result.leaf_type == result_type(row, leaf_type)

    definition = TEXTBOOK[row.name, row.kind]
    expected = np.array(
        [[payload(definition(a, b), result.leaf_type) for b in values] for a in values], dtype=np.uint64
    )
    for start in range(0, functions, 64):
        i, j, k = np.meshgrid(
            np.arange(start, min(start + 64, functions)), np.arange(functions), np.arange(points),
            indexing="ij",
        )  # fmt: skip
        i, j, k = i.ravel(), j.ravel(), k.ravel()
        where = np.stack([i, j, k // sizes[1], k % sizes[1]], axis=1)
        found = evaluate_states(result, where, [0, 1, 2, 3])
        assert (found == expected[digits[i, k], digits[j, k]]).all()


@pytest.mark.parametrize(("row", "leaf_type", "values"), CASES, ids=named)
def test_operator_matches_its_definition_on_all_pairs_of_functions_of_two_bits(
    row: OperatorRow, leaf_type: LeafType, values: tuple[Any, ...]
) -> None:
    all_pairs(row, leaf_type, values, (2, 2))


@pytest.mark.parametrize("row", OPERATORS.values(), ids=named)
def test_operator_matches_its_definition_on_all_pairs_with_three_valued_variables(row: OperatorRow) -> None:
    leaf_type, values = LEAF_SETS[row.kind][0]
    all_pairs(row, leaf_type, values[:2], (3, 3) if row.kind == "boolean" else (3, 2))


@pytest.mark.parametrize(("row", "leaf_type", "values"), CASES, ids=named)
def test_row_matches_its_definition_on_pairs_of_leaves(
    row: OperatorRow, leaf_type: LeafType, values: tuple[Any, ...]
) -> None:
    manager = Manager([2])
    kind = result_type(row, leaf_type)
    for a, b in itertools.product(values, repeat=2):
        found = apply(row.name, manager.constant(a, leaf_type), manager.constant(b, leaf_type))
        for definition in (row.definition, TEXTBOOK[row.name, row.kind]):
            assert payload(definition(a, b), kind) == payload_of(found)


def payload_of(diagram: Diagram) -> int:
    return int(evaluate_states(diagram, np.zeros((1, 1), dtype=np.int32), [0])[0])


@pytest.mark.parametrize(("row", "leaf_type", "values"), CASES, ids=named)
def test_identities_absorbing_elements_and_symmetry_hold_as_the_row_says(
    row: OperatorRow, leaf_type: LeafType, values: tuple[Any, ...]
) -> None:
    generator = np.random.default_rng(3)
    manager = Manager([2, 3, 2])
    kind = result_type(row, leaf_type)
    for _ in range(20):
        a = from_table(manager, random_table(generator, manager.sizes, values), leaf_type)
        b = from_table(manager, random_table(generator, manager.sizes, values), leaf_type)
        for side, identity in (("left", row.left_identity), ("right", row.right_identity)):
            if identity is not None:
                e = manager.constant(identity, leaf_type)
                assert (apply(row.name, e, a) if side == "left" else apply(row.name, a, e)) == a
        for side, absorbing in (("left", row.left_absorbing), ("right", row.right_absorbing)):
            if absorbing is not None:
                e = manager.constant(absorbing, leaf_type)
                assert (apply(row.name, e, a) if side == "left" else apply(row.name, a, e)) == e
        if row.commutes:
            assert apply(row.name, a, b) == apply(row.name, b, a)
        if row.same == "argument":
            assert apply(row.name, a, a) == a
        elif row.same is not None:
            assert apply(row.name, a, a) == manager.constant(row.same, kind)


def test_a_row_that_claims_no_law_breaks_it_or_leaves_it_to_the_leaves() -> None:
    manager = Manager([2])
    one, infinite = manager.constant(1.0, FLOAT), manager.constant(INF, FLOAT)
    assert math.isnan(float(apply("minus", infinite, infinite).value))
    assert apply("minus", one, one) == manager.constant(0.0, FLOAT)
    assert apply("difference", manager.constant(0), manager.constant(1)) == manager.constant(0)
    assert apply("difference", manager.constant(1), manager.constant(0)) == manager.constant(1)


def test_minus_zero_is_zero_and_there_is_one_nan() -> None:
    manager = Manager([2])
    zero = manager.constant(0.0, FLOAT)
    assert manager.constant(-0.0, FLOAT) == zero
    minus, tiny = manager.constant(-1.0, FLOAT), manager.constant(1e-300, FLOAT)
    assert apply("times", apply("times", minus, tiny), tiny) == zero  # underflows to -0.0
    assert math.copysign(1.0, float(apply("times", minus, zero).value)) == 1.0
    infinite = manager.constant(INF, FLOAT)
    nan = apply("minus", infinite, infinite)
    assert nan == manager.constant(math.nan, FLOAT)
    assert nan == relabel(manager.constant(0), np.array([-math.nan]), FLOAT)


def test_operators_on_diagrams_are_the_rows() -> None:
    manager = Manager([2, 2])
    a, b = manager.indicator(0, [1]), manager.indicator(1, [1])
    for found, definition in (
        (a & b, lambda x, y: x & y), (a | b, lambda x, y: x | y), (a ^ b, lambda x, y: x ^ y),
        (~a, lambda x, _: 1 - x), (a.equals(b), lambda x, y: int(x == y)),
    ):  # fmt: skip
        assert (to_table(found) == tabulate([2, 2], lambda s, d=definition: d(*s))).all()
    for leaf_type, modulus in ((FLOAT, None), (FIELD, P)):
        x = from_table(manager, tabulate([2, 2], lambda s: s[0] + 2), leaf_type)
        y = from_table(manager, tabulate([2, 2], lambda s: s[1] + 5), leaf_type)
        for found, definition in (
            (x + y, lambda s, t: s + t + 7), (x - y, lambda s, t: s - t - 3),
            (x * y, lambda s, t: (s + 2) * (t + 5)),
        ):  # fmt: skip
            expected = tabulate(
                [2, 2], lambda s, d=definition, m=modulus: d(*s) if m is None else d(*s) % m
            )
            assert (to_table(found) == expected).all()


def test_results_of_one_operator_never_answer_for_another() -> None:
    manager = Manager([3, 3])
    generator = np.random.default_rng(8)
    tables = [random_table(generator, manager.sizes, [0, 1, 2]) for _ in range(2)]
    types: dict[str, list[LeafType]] = {"field": [FIELD, OTHER], "float": [FLOAT]}
    for _ in range(2):
        for (name, kind), definition in TEXTBOOK.items():
            for leaf_type in types.get(kind, [INDEX]):
                s, t = (table % 2 if kind == "boolean" else table for table in tables)
                expected = np.frompyfunc(definition, 2, 1)(s, t)
                if isinstance(leaf_type, Field):
                    expected = expected % leaf_type.prime
                result = apply(name, from_table(manager, s, leaf_type), from_table(manager, t, leaf_type))
                assert (to_table(result) == expected).all(), (name, kind)


def test_a_hundred_fields_do_not_share_results() -> None:
    # Nodes are shared between fields: stored forms are just numbers; only the key tells them apart.
    manager = Manager([2])

    generator = random.Random(4)
    for prime in [random_prime(generator) for _ in range(100)]:
        field = Field(prime)
        stored = np.array([2**59 + 1, 2**59 + 3], dtype=np.uint64)
        a = relabel(manager.indicator(0, [1]), stored, field)
        b = relabel(manager.indicator(0, [0]), stored, field)
        expected = int(stored[0]) * int(stored[1]) * pow(2**64, -1, prime) % prime
        assert payload_of(a * b) == expected


def test_an_operator_for_other_leaves_is_refused_with_what_there_is() -> None:
    manager = Manager([2])
    a, x = manager.constant(1), manager.constant(1.0, FLOAT)
    with pytest.raises(
        ValueError, match=r"no operator 'plus' on boolean leaves; there are and, difference"
    ):
        apply("plus", a, a)
    with pytest.raises(ValueError, match="float leaves where index leaves are needed"):
        apply("and", a, x)
    with pytest.raises(ValueError, match="two managers"):
        apply("and", a, Manager([2]).constant(1))
    with pytest.raises(ValueError, match="GF"):
        apply("plus", manager.constant(1, FIELD), manager.constant(1, OTHER))


@pytest.mark.parametrize("name", ["and", "or", "xor", "difference"])
def test_a_boolean_operator_refuses_leaves_that_are_no_conditions(name: str) -> None:
    manager = Manager([2, 2])
    a = from_table(manager, np.array([[2, 3], [3, 2]], dtype=object))
    b = from_table(manager, np.array([[4, 4], [5, 5]], dtype=object))
    with pytest.raises(ValueError, match="a condition needs leaves 0 and 1"):
        apply(name, a, b)
    assert (manager.indicator(0, [1]) & manager.indicator(0, [0])) == manager.constant(0)
