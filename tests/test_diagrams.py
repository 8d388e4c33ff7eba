"""Operations on diagrams against brute force over all states, on random functions of mixed variables."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from diagram_tables import (
    FLOAT,
    INDEX,
    SIZES,
    Table,
    assert_table,
    floats,
    from_table,
    random_table,
    states,
    tabulate,
)

from factored_polca.diagrams import (
    MERSENNE_61,
    Diagram,
    Field,
    LeafType,
    Manager,
    apply,
    argmax,
    argmax_out,
    choose,
    cofactors,
    combine,
    max_out,
    move,
    pairs,
    relabel,
    renumber,
    restrict,
    substitute_leaves,
    sum_out,
    support,
    weighted_sum,
)
from factored_polca.diagrams.operations import Walk, leaf_payloads

P = MERSENNE_61
FIELD = Field()
TYPES: list[LeafType] = [INDEX, FLOAT, FIELD]

Sizes = tuple[int, ...]
each_size = pytest.mark.parametrize("sizes", SIZES, ids=str)


def cases(sizes: Sizes, count: int = 6) -> Iterator[tuple[Manager, np.random.Generator]]:
    """Fresh managers, tiny ones, so that they grow under way, and seeded generators."""
    for seed in range(count):
        yield Manager(sizes, first_nodes=1), np.random.default_rng([seed, *sizes])


def values_of(leaf_type: LeafType, random: np.random.Generator) -> list[Any]:
    """Some leaf values."""
    if leaf_type == FLOAT:
        return floats(random, 3)
    if leaf_type == INDEX:
        return [0, 1, 2, 7]
    return [0, 1, P - 1, int(random.integers(2, P))]


def drawn(
    manager: Manager, random: np.random.Generator, leaf_type: LeafType, values: list[Any] | None = None
) -> tuple[Table, Diagram]:
    """A random table and its diagram."""
    chosen = values_of(leaf_type, random) if values is None else values
    table = random_table(random, manager.sizes, chosen)
    return table, from_table(manager, table, leaf_type)


def close(found: float, expected: float) -> bool:
    """Equal but for rounding: the sums below add a few terms of size about 1 in another order."""
    return found == expected or abs(found - expected) <= 1e-12


@each_size
def test_a_diagram_made_by_branching_has_the_values_of_its_table(sizes: Sizes) -> None:
    for manager, random in cases(sizes):
        for leaf_type in TYPES:
            table, diagram = drawn(manager, random, leaf_type)
            assert_table(diagram, table)


@each_size
def test_equal_functions_are_equal_diagrams_and_different_ones_are_not(sizes: Sizes) -> None:
    for manager, random in cases(sizes):
        made = [drawn(manager, random, INDEX, [0, 1]) for _ in range(8)]
        for (s, a), (t, b) in itertools.product(made, repeat=2):
            assert (a == b) == bool((s == t).all())
            equal = tabulate(sizes, lambda x, s=s, t=t: int(s[x] == t[x]))
            assert_table(a.equals(b), equal)


@each_size
@pytest.mark.parametrize("leaf_type", TYPES, ids=["index", "float", "field"])
def test_choose_takes_each_state_from_the_right_side(sizes: Sizes, leaf_type: LeafType) -> None:
    for manager, random in cases(sizes):
        c, condition = drawn(manager, random, INDEX, [0, 1])
        t, then = drawn(manager, random, leaf_type)
        o, otherwise = drawn(manager, random, leaf_type)
        expected = tabulate(sizes, lambda s, c=c, t=t, o=o: t[s] if c[s] else o[s])
        result = choose(condition, then, otherwise)
        assert result.leaf_type == leaf_type
        assert_table(result, expected)


def test_choose_between_conditions_is_boolean_logic() -> None:
    manager = Manager([2, 2, 2])
    a, b, c = (manager.indicator(i, [1]) for i in range(3))
    true, false = manager.constant(1), manager.constant(0)
    assert choose(a, true, false) == a
    assert choose(a, false, true) == ~a
    assert choose(a, b, false) == a & b
    assert choose(a, true, b) == a | b
    assert choose(a, b, c) == (a & b) | (~a & c)
    assert choose(a, b, b) == b


def test_choose_refuses_a_condition_with_other_leaves() -> None:
    manager = Manager([3, 2])
    three = from_table(manager, tabulate([3, 2], lambda s: s[0]))
    a, b = manager.indicator(1, [0]), manager.indicator(1, [1])
    with pytest.raises(ValueError, match="a condition needs leaves 0 and 1; make one"):
        choose(three, a, b)
    with pytest.raises(ValueError, match="leaves 0 and 1"):
        choose(manager.constant(2), a, b)
    with pytest.raises(ValueError, match="float leaves where index leaves"):
        choose(manager.constant(1.0, FLOAT), a, b)
    assert choose(a, a, b) == a | b


@each_size
def test_restrict_and_cofactors_match_substitution(sizes: Sizes) -> None:
    for manager, random in cases(sizes):
        for leaf_type in TYPES:
            table, diagram = drawn(manager, random, leaf_type)
            fixed = {i: int(random.integers(size)) for i, size in enumerate(sizes) if random.random() < 0.5}

            def substituted(s: tuple[int, ...], f: dict[int, int] = fixed, t: Table = table) -> Any:
                return t[tuple(f.get(i, v) for i, v in enumerate(s))]

            result = restrict(diagram, fixed)
            assert_table(result, tabulate(sizes, substituted))
            assert not set(support(result)) & set(fixed)
            for level in range(len(sizes)):
                for v, part in enumerate(cofactors(diagram, level)):
                    assert_table(part, tabulate(sizes, lambda s, l=level, v=v: substituted(s, {l: v})))


@each_size
def test_summing_and_maximising_out_match_brute_force(sizes: Sizes) -> None:
    def reduced(table: Table, level: int, reduction: Callable[[list[Any]], Any]) -> Table:
        def at_state(s: tuple[int, ...]) -> Any:
            return reduction([table[(*s[:level], v, *s[level + 1 :])] for v in range(sizes[level])])

        return tabulate(sizes, at_state)

    for manager, random in cases(sizes, 4):
        b, condition = drawn(manager, random, INDEX, [0, 1])
        t, elements = drawn(manager, random, FIELD)
        f, numbers = drawn(manager, random, FLOAT, [0.0, 0.5, -1.5, 3.0, math.inf])
        for level in range(len(sizes)):
            assert_table(sum_out(condition, level), reduced(b, level, max))
            assert_table(sum_out(elements, level), reduced(t, level, lambda column: sum(column) % P))
            assert_table(sum_out(numbers, level), reduced(f, level, sum))  # halves add exactly
            assert_table(max_out(numbers, level), reduced(f, level, max))
            assert_table(argmax_out(numbers, level), reduced(f, level, lambda c: c.index(max(c))))


@each_size
def test_argmax_names_the_first_largest_candidate(sizes: Sizes) -> None:
    for manager, random in cases(sizes):
        made = [drawn(manager, random, FLOAT, [0.0, 1.0, -math.inf]) for _ in range(4)]

        def first(s: tuple[int, ...], made: list[tuple[Table, Diagram]] = made) -> int:
            here = [table[s] for table, _ in made]
            return here.index(max(here))

        assert_table(argmax([diagram for _, diagram in made]), tabulate(sizes, first))
    assert argmax([manager.constant(-math.inf, FLOAT)] * 3) == manager.constant(0)


@each_size
def test_a_weighted_sum_in_a_field_is_the_sum_of_products(sizes: Sizes) -> None:
    for manager, random in cases(sizes):
        for count in (1, 2, 3, 9):
            weights = [drawn(manager, random, FIELD, [0, 1, P - 2]) for _ in range(count)]
            terms = [drawn(manager, random, FIELD, [0, 0, 0, 5, P - 1]) for _ in range(count)]
            if count == 3:
                weights = [drawn(manager, random, FIELD) for _ in range(count)]
                terms = [drawn(manager, random, FIELD) for _ in range(count)]

            def total(s: tuple[int, ...], w: Any = weights, t: Any = terms) -> int:
                return sum(a[s] * b[s] for (a, _), (b, _) in zip(w, t, strict=True)) % P

            result = weighted_sum([d for _, d in weights], [d for _, d in terms])
            assert_table(result, tabulate(sizes, total))


def distributions(random: np.random.Generator, sizes: Sizes, count: int, p: int | None) -> list[Table]:
    """Weights that sum to 1 everywhere, many of them 0 or 1."""
    table = random_table(random, sizes, range(4))
    rows: list[list[Any]] = []
    for number in range(4):
        row = [0] * count
        row[int(random.integers(count))] = 1
        if number > 1 and count > 1:
            share = int(random.integers(1, 8))
            i, j = (int(n) for n in random.choice(count, size=2, replace=False))
            row = [0] * count
            row[i], row[j] = (share / 8, 1 - share / 8) if p is None else (share, (1 - share) % p)
        rows.append(row)
    return [tabulate(sizes, lambda s, v=v: rows[table[s]][v]) for v in range(count)]


@each_size
@pytest.mark.parametrize("leaf_type", [FLOAT, FIELD], ids=["float", "field"])
def test_a_normalised_weighted_sum_is_the_expectation(sizes: Sizes, leaf_type: LeafType) -> None:
    p = P if leaf_type == FIELD else None
    for manager, random in cases(sizes):
        for count in (1, 2, 5):
            weights = distributions(random, sizes, count, p)
            values = [0.0, 1.5, -2.25] if p is None else [0, 5, P - 3]
            terms = [drawn(manager, random, leaf_type, values) for _ in range(count)]
            handles = [from_table(manager, w, leaf_type) for w in weights]

            def mean(s: tuple[int, ...], w: Any = weights, t: Any = terms) -> Any:
                total = sum(a[s] * b[s] for a, (b, _) in zip(w, t, strict=True))
                return total if p is None else total % p  # eighths times quarters are exact

            for normalised in (True, False):
                result = weighted_sum(handles, [d for _, d in terms], normalised=normalised)
                assert_table(result, tabulate(sizes, mean))


def test_a_weight_of_zero_makes_infinity_not_count() -> None:
    manager = Manager([2])
    bit = relabel(manager.indicator(0, [1]), np.array([0.0, 1.0]), FLOAT)
    rest = relabel(manager.indicator(0, [0]), np.array([0.0, 1.0]), FLOAT)
    minus, one = manager.constant(-math.inf, FLOAT), manager.constant(1.0, FLOAT)
    for normalised in (True, False):
        result = weighted_sum([bit, rest], [minus, one], normalised=normalised)
        assert_table(result, np.array([1.0, -math.inf], dtype=object))


def test_weighted_sums_of_many_float_terms_agree_up_to_rounding() -> None:
    manager, random = Manager((3, 2, 2), first_nodes=1), np.random.default_rng(4)
    weights = [drawn(manager, random, FLOAT, [0.25, 0.1, 1.0, 0.0]) for _ in range(40)]
    terms = [drawn(manager, random, FLOAT, random.normal(size=5).tolist()) for _ in range(40)]
    result = weighted_sum([d for _, d in weights], [d for _, d in terms])
    for s in states(manager.sizes):
        expected = math.fsum(a[s] * b[s] for (a, _), (b, _) in zip(weights, terms, strict=True))
        assert close(float(restrict(result, dict(enumerate(s))).value), expected)


@pytest.mark.parametrize("count", [7, 8, 100, 3000])
def test_term_lists_longer_than_the_cache_can_hold_are_summed_too(count: int) -> None:
    # The smallest store's ring holds 64 words, 16 a key: 7 terms fit, 8 do not.
    manager, random = Manager((2, 3, 2), first_nodes=1), np.random.default_rng(count)
    some = [drawn(manager, random, FIELD) for _ in range(10)]
    chosen = [(some[int(i)], some[int(j)]) for i, j in random.integers(0, 10, size=(count, 2))]
    result = weighted_sum([w for (_, w), _ in chosen], [t for _, (_, t) in chosen])
    expected = tabulate(manager.sizes, lambda s: sum(w[s] * t[s] for (w, _), (t, _) in chosen) % P)
    assert_table(result, expected)


def test_the_cache_of_sums_keeps_apart_fields_and_kinds_of_sums() -> None:
    manager, other = Manager([2]), Field(2**61 - 31)
    stored = np.array([0, 2**60], dtype=np.uint64)
    for field in (FIELD, other, FIELD):
        bit = relabel(manager.indicator(0, [1]), stored, field)
        expected = 2**120 * pow(2**64, -1, field.prime) % field.prime
        for _ in range(2):
            result = weighted_sum([bit, bit], [bit, bit])
            assert Walk(result).leaf_payloads().tolist() == [0, 2 * expected % field.prime]
    # Weights 1 and 1 of equal terms: 2 r in general; the normalised sum may take r unseen.
    one = relabel(manager.indicator(0, [0, 1]), stored, FIELD)
    assert one.is_constant
    bit = substitute_leaves(manager.indicator(0, [1]), lambda v: v + 3, FIELD)
    unit = manager.constant(1, FIELD)
    assert_table(weighted_sum([unit, unit], [bit, bit]), np.array([6, 8], dtype=object))


def test_a_weighted_sum_refuses_what_does_not_fit() -> None:
    manager = Manager([2])
    x = manager.constant(1.0, FLOAT)
    with pytest.raises(ValueError, match="2 weights for 1 terms"):
        weighted_sum([x, x], [x])
    with pytest.raises(ValueError, match="at least one diagram"):
        weighted_sum([], [])
    with pytest.raises(ValueError, match="index leaves where float"):
        weighted_sum([x], [manager.constant(1)])


@each_size
def test_relabel_and_substitute_replace_leaves(sizes: Sizes) -> None:
    for manager, random in cases(sizes):
        table, diagram = drawn(manager, random, INDEX, [0, 1, 2, 7])
        images = random.normal(size=8)
        images[2] = images[7]  # merges leaves
        assert_table(relabel(diagram, images, FLOAT), tabulate(sizes, lambda s, t=table, i=images: i[t[s]]))
        assert_table(
            substitute_leaves(diagram, lambda v: v // 2), tabulate(sizes, lambda s, t=table: t[s] // 2)
        )
        assert_table(
            substitute_leaves(diagram, lambda v: v / 2, FLOAT),
            tabulate(sizes, lambda s, t=table: t[s] / 2),
        )
        f, elements = drawn(manager, random, FIELD)
        assert_table(
            substitute_leaves(elements, lambda v: v % 5, INDEX), tabulate(sizes, lambda s, f=f: f[s] % 5)
        )
        stored = np.array([FIELD.encode(v) for v in (3, 4, 5, 0, 0, 0, 0, 6)], dtype=np.uint64)
        assert_table(
            relabel(diagram, stored, FIELD),
            tabulate(sizes, lambda s, t=table: (3, 4, 5, 0, 0, 0, 0, 6)[t[s]]),
        )


def test_substituting_by_a_function_that_uses_the_manager_is_safe() -> None:
    manager = Manager((2, 3), first_nodes=1)
    table = tabulate((2, 3), lambda s: 3 * s[0] + s[1])
    diagram = from_table(manager, table)

    def function(value: int) -> int:
        manager.collect_garbage()
        from_table(manager, tabulate((2, 3), lambda s: s[0] + value))
        return value + 1

    assert_table(substitute_leaves(diagram, function), table + 1)


@each_size
def test_renumbering_counts_leaves_by_first_occurrence(sizes: Sizes) -> None:
    for manager, random in cases(sizes):
        for leaf_type in TYPES:
            table, diagram = drawn(manager, random, leaf_type)
            order: list[Any] = []
            for s in states(sizes):  # lexicographic order is depth-first order
                if table[s] not in order:
                    order.append(table[s])
            numbered, old = renumber(diagram)
            assert [leaf_type.decode(int(v)) for v in old] == order
            assert_table(numbered, tabulate(sizes, lambda s, t=table, o=order: o.index(t[s])))


@each_size
def test_pairs_are_numbered_by_first_occurrence(sizes: Sizes) -> None:
    for manager, random in cases(sizes):
        s, a = drawn(manager, random, INDEX)
        t, b = drawn(manager, random, FLOAT)
        for x, y, left, right in ((a, b, s, t), (a, a, s, s), (b, a, t, s)):
            order: list[tuple[Any, Any]] = []
            for state in states(sizes):
                if (left[state], right[state]) not in order:
                    order.append((left[state], right[state]))
            numbered, first, second = pairs(x, y)
            found = list(
                zip(
                    (x.leaf_type.decode(int(p)) for p in leaf_payloads(manager, first)),
                    (y.leaf_type.decode(int(p)) for p in leaf_payloads(manager, second)),
                    strict=True,
                )
            )
            assert found == order
            expected = tabulate(sizes, lambda q, o=order, l=left, r=right: o.index((l[q], r[q])))
            assert_table(numbered, expected)
            manager.collect_garbage()  # pairs of nodes that moved must not be found again


@each_size
def test_combine_applies_any_function_of_several_leaves(sizes: Sizes) -> None:
    for manager, random in cases(sizes):
        made = [drawn(manager, random, INDEX, [0, 1, 5]) for _ in range(3)]
        result, values = combine([d for _, d in made], lambda a, b, c: (a + b, min(b, c)))
        assert len(set(values)) == len(values)
        expected = tabulate(sizes, lambda s, m=made: (m[0][0][s] + m[1][0][s], min(m[1][0][s], m[2][0][s])))
        numbers = tabulate(sizes, lambda s, v=values, e=expected: v.index(e[s]))
        assert_table(result, numbers)


def test_combine_keeps_true_and_one_and_their_order_apart() -> None:
    manager = Manager([4])
    diagram = from_table(manager, np.array([3, 1, 0, 2], dtype=object))
    answers: dict[int, Any] = {3: True, 1: 1, 0: 1.0, 2: True}
    result, values = combine([diagram], lambda v: answers[v])
    assert [(type(v), v) for v in values] == [(bool, True), (int, 1), (float, 1.0)]
    assert_table(result, np.array([0, 1, 2, 0], dtype=object))
    with pytest.raises(ValueError, match="at least one diagram"):
        combine([], lambda: 0)


def test_moving_levels_renames_variables() -> None:
    manager, random = Manager((2, 2, 3, 3, 2, 2), first_nodes=1), np.random.default_rng(0)
    for _ in range(10):
        table = random_table(random, (2, 3, 2), [0, 1, 2])
        diagram = from_table(manager, tabulate(manager.sizes, lambda s, t=table: t[s[0], s[2], s[4]]))
        moved = move(diagram, {0: 1, 2: 3, 4: 5})
        assert_table(moved, tabulate(manager.sizes, lambda s, t=table: t[s[1], s[3], s[5]]))
        assert move(moved, {1: 0, 3: 2, 5: 4}) == diagram
        for leaf_type in (FLOAT, FIELD):
            typed = substitute_leaves(diagram, lambda v: 3 * v, leaf_type)
            assert move(typed, {0: 1, 2: 3, 4: 5}) == substitute_leaves(moved, lambda v: 3 * v, leaf_type)
    both = manager.indicator(0, [0]) & manager.indicator(1, [1])
    for levels, message in (
        ({0: 1, 1: 0}, "keep their order"), ({0: 1}, "keep their order"), ({1: 2}, "different numbers"),
        ({0: 9}, "level 9; levels are 0 to 5"), ({-1: 0}, "level -1"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            move(both, levels)


@each_size
def test_support_names_exactly_the_variables_that_matter(sizes: Sizes) -> None:
    for manager, random in cases(sizes):
        table, diagram = drawn(manager, random, INDEX)
        expected = [
            level
            for level in range(len(sizes))
            if any(table[s] != table[(*s[:level], 0, *s[level + 1 :])] for s in states(sizes))
        ]
        assert support(diagram) == expected
        assert diagram.is_constant == (not expected)
        assert diagram.level == (expected[0] if expected else len(sizes))


def test_variables_and_indicators_branch_as_told_and_refuse_the_rest() -> None:
    manager = Manager([2, 3])
    zero, one = manager.constant(0), manager.constant(1)
    assert_table(manager.indicator(1, [0, 2]), tabulate((2, 3), lambda s: int(s[1] != 1)))
    low = manager.variable(1, [zero, one, zero])
    assert_table(manager.variable(0, [low, one]), tabulate((2, 3), lambda s: int(s[0] or s[1] == 1)))
    assert manager.variable(0, [low, low]) == low
    for level, children, message in (
        (1, [zero, one], "2 children at level 1, which has 3"),
        (1, [low, zero, zero], "must be below"),
        (0, [manager.indicator(0, [0]), one], "must be below"),
        (2, [zero, one], "level 2; levels are 0 to 1"),
        (-1, [zero, one, zero], "level -1"),
        (0, [zero, manager.constant(1.0, FLOAT)], "float leaves where index"),
        (0, [zero, Manager([2, 3]).constant(0)], "two managers"),
        (0, [Manager([2, 3]).constant(0)] * 2, "another manager"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            manager.variable(level, children)


def test_leaves_outside_their_type_are_refused() -> None:
    manager = Manager([2])
    for value in (-1, 0.5, 2**64):
        with pytest.raises(ValueError, match="index leaves are integers"):
            manager.constant(value)
    assert manager.constant(2**64 - 1).value == 2**64 - 1
    bit = manager.indicator(0, [1])
    with pytest.raises(ValueError, match="non-negative integers"):
        relabel(bit, np.array([0.5, 1.0]), INDEX)
    with pytest.raises(ValueError, match="non-negative integers"):
        relabel(bit, np.array([-1, 1]), INDEX)
    with pytest.raises(ValueError, match="less than the prime"):
        relabel(bit, np.array([P, 1], dtype=np.uint64), FIELD)
    with pytest.raises(ValueError, match="value 2 at level 0"):
        restrict(bit, {0: 2})
    with pytest.raises(ValueError, match="level 1; levels are 0 to 0"):
        restrict(bit, {1: 0})
    with pytest.raises(ValueError, match="not constant"):
        _ = bit.value
    with pytest.raises(ValueError, match="index leaves"):
        relabel(manager.constant(1.0, FLOAT), np.array([0, 1]), INDEX)


def test_diagrams_show_what_they_are() -> None:
    manager = Manager([2])
    assert repr(manager.constant(0.5, FLOAT)) == "<Diagram: constant 0.5 (float)>"
    assert repr(manager.indicator(0, [1])) == "<Diagram: top level 0, index leaves>"
    assert "1 levels" in repr(manager)
    assert manager.constant(3) != "3"
    assert manager.constant(0) != manager.constant(0.0, FLOAT)
    assert apply("plus", manager.constant(P - 1, FIELD), manager.constant(3, FIELD)).value == 2
