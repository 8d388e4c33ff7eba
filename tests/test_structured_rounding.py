"""Leaves of float diagrams merged within an error: against tables, and against exact arithmetic."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest
from diagram_tables import FLOAT, from_table, random_table, states, to_table

from factored_polca.diagrams import Diagram, Manager, leaves, node_count
from factored_polca.structured.rounding import (
    Direction,
    difference_above,
    fits,
    group,
    round_leaves,
    round_to_size,
)

SIZES = (3, 2, 4, 2)
DIRECTIONS: tuple[Direction, ...] = ("down", "middle", "up")


def random_diagram(seed: int, values: int = 20) -> Diagram:
    random = np.random.default_rng(seed)
    pool = [*random.normal(size=values).tolist(), 0.1, 0.1 + 2**-55, 1 / 3, -math.inf, math.inf]
    return from_table(Manager(SIZES), random_table(random, SIZES, pool), FLOAT)


def fewest_groups(values: list[Fraction], width: Fraction) -> int:
    """The fewest intervals of a width that cover sorted values, by dynamic programming."""
    best = [0]
    for end in range(1, len(values) + 1):
        starts = [s for s in range(end) if values[end - 1] - values[s] <= width]
        best.append(min(best[s] for s in starts) + 1)
    return best[-1]


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_rounding_keeps_to_its_error_and_direction_at_every_state(direction: Direction) -> None:
    for seed in range(40):
        diagram = random_diagram(seed)
        before = to_table(diagram)
        for width in (0.0, 2**-54, 0.05, 0.4, 100.0):
            found = round_leaves(diagram, width, direction)
            after = to_table(found.diagram)
            largest = Fraction(0)
            for state in states(SIZES):
                old, new = before[state], after[state]
                if math.isinf(old):
                    assert new == old
                    continue
                exact = Fraction(new) - Fraction(old)
                largest = max(largest, abs(exact))
                assert exact <= 0 or direction != "down"
                assert exact >= 0 or direction != "up"
            assert largest <= Fraction(found.error) <= largest * (1 + Fraction(1, 2**52))
            limit = width / 2 if direction == "middle" else width
            assert found.error <= limit + 2**-52
            assert found.leaves >= len(leaves(found.diagram))  # middles of two groups may coincide
            found.diagram.manager.assert_consistent()


def test_no_grouping_of_the_width_has_fewer_groups() -> None:
    random = np.random.default_rng(3)
    for _ in range(60):
        values = sorted(Fraction(int(n), 8) for n in set(random.integers(0, 60, size=15).tolist()))
        width = Fraction(int(random.integers(0, 40)), 8)
        floats = np.array([float(v) for v in values])
        starts = group(floats, float(width))
        fewest = fewest_groups(values, width)
        assert len(starts) == fewest
        assert fits(floats.tolist(), float(width), fewest)
        assert not fits(floats.tolist(), float(width), fewest - 1)
        ends = [*starts[1:].tolist(), len(floats)]
        assert all(floats[e - 1] - floats[s] <= width for s, e in zip(starts.tolist(), ends, strict=True))


def test_groups_do_not_reach_over_infinities() -> None:
    values = np.array([-math.inf, -1.0, -0.5, 3.0, math.inf])
    assert group(values, 0.5).tolist() == [0, 1, 3, 4]
    assert group(values, 1e308).tolist() == [0, 1, 4]
    assert group(np.empty(0), 1.0).tolist() == []


def test_the_least_width_is_chosen_for_a_number_of_leaves() -> None:
    for seed in range(30):
        diagram = random_diagram(seed)
        old = [v for v in leaves(diagram) if math.isfinite(v)]
        infinite = len(leaves(diagram)) - len(old)
        exact = sorted(Fraction(v) for v in old)
        for count in (1, 2, 5, 9, 100):
            found = round_to_size(diagram, leaves=count + infinite)
            assert found.leaves <= count + infinite
            apart = sorted({b - a for i, a in enumerate(exact) for b in exact[i:]})
            least = next(w for w in apart if fewest_groups(exact, w) <= count)
            assert abs(Fraction(found.width) - least) <= Fraction(1, 2**50)
            again = round_leaves(diagram, found.width)
            assert again.diagram == found.diagram
            assert again.error == found.error


def test_a_number_of_nodes_is_reached_with_a_width_near_the_least() -> None:
    for seed in range(30):
        diagram = random_diagram(seed)
        size = node_count(diagram)
        for nodes in (size, size * 3 // 4, size // 2, size // 4):
            found = round_to_size(diagram, nodes=max(1, nodes))
            coarsest = round_leaves(diagram, 1e6)
            if node_count(coarsest.diagram) <= nodes:
                assert node_count(found.diagram) <= nodes
            else:
                assert found.diagram == coarsest.diagram
        assert round_to_size(diagram, nodes=size).error == 0.0


def test_a_width_that_is_given_is_the_least_one() -> None:
    diagram = random_diagram(1)
    found = round_to_size(diagram, leaves=1000, nodes=1000, width=0.3, direction="up")
    assert found.diagram == round_leaves(diagram, 0.3, "up").diagram


def test_differences_are_rounded_up_only_where_they_are_inexact() -> None:
    random = np.random.default_rng(7)
    large = random.normal(size=2000) * 10.0 ** random.integers(-8, 8, size=2000)
    small = random.normal(size=2000) * 10.0 ** random.integers(-8, 8, size=2000)
    for a, b, found in zip(large.tolist(), small.tolist(), difference_above(large, small), strict=True):
        exact = Fraction(a) - Fraction(b)
        assert Fraction(float(found)) >= exact
        assert Fraction(float(np.nextafter(found, -np.inf))) < exact


def test_what_is_no_width_or_no_number_is_refused() -> None:
    manager = Manager((2,))
    diagram = manager.variable(0, [manager.constant(1.0, FLOAT), manager.constant(2.0, FLOAT)])
    for width in (-1.0, math.nan):
        with pytest.raises(ValueError, match="width of 0 or more"):
            round_leaves(diagram, width)
        with pytest.raises(ValueError, match="width of 0 or more"):
            round_to_size(diagram, leaves=1, width=width)
    with pytest.raises(ValueError, match="at least one node"):
        round_to_size(diagram, nodes=0)
    with pytest.raises(ValueError, match="there are down, middle, up"):
        round_leaves(diagram, 1.0, "sideways")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="float leaves"):
        round_leaves(manager.indicator(0, [1]), 1.0)
    with pytest.raises(ValueError, match="no number"):
        round_leaves(manager.constant(math.nan, FLOAT), 1.0)


def test_distinct_neighbouring_floats_are_kept_apart_by_width_zero() -> None:
    values = np.nextafter(np.ones(4), np.inf) * np.array([1.0, 1.0, 2.0, 2.0])
    assert all(a <= b for a, b in pairwise(group(np.sort(values), 0.0)))
    assert len(group(np.array([1.0, np.nextafter(1.0, 2.0)]), 0.0)) == 2
