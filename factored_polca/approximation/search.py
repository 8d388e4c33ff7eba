"""The largest epsilon whose bound on the loss is small enough, by bisection over numbers that matter.

Where the state is not seen only rows and rewards are merged, and nothing changes but at the distances of
rows from each other, half of them, and from sure outcomes.  Where it is seen values are merged as well,
and any epsilon may matter: a ladder of numbers, a few for each power of ten, is taken in their place.

As a rule bounds grow with epsilon, and bisection takes that for granted; what was tried is told.  The
answer is the largest number tried whose bound is small enough."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations
from typing import Final

from factored_polca.approximation.representatives import distance
from factored_polca.symbolic import SymbolicModel
from factored_polca.symbolic.rows import Row

LADDER: Final = tuple(
    Fraction(digits, 10**power) for power in (5, 4, 3, 2) for digits in (10, 15, 20, 30, 40, 50, 70)
)
"""0.0001, 0.00015, ..., 0.7."""

MOST_ROWS: Final = 100
"""Distinct rows of a feature or channel of which all pairs are compared."""


@dataclass(frozen=True)
class Trial:
    """An epsilon that was tried: the blocks, of all tasks, and the largest bound on the loss of one."""

    epsilon: Fraction
    blocks: int
    loss: float


def candidates(symbolic: SymbolicModel, *, seen: bool) -> list[Fraction]:
    """Numbers at which merging may change, ascending, 0 first; `seen` where the state is."""
    if seen:
        return [Fraction(0), *LADDER]
    found: set[Fraction] = {Fraction(0)}
    by_variable: dict[tuple[str, int], set[Row]] = {}
    for action in symbolic.actions:
        for kind, diagrams in (("x", action.rows), ("o", action.observations)):
            for number, diagram in diagrams.items():
                by_variable.setdefault((kind, number), set()).update(diagram.rows)
    for rows in by_variable.values():
        some = sorted(rows)[:MOST_ROWS]
        found |= {1 - max(row) for row in some}
        for p, q in combinations(some, 2):
            found |= {distance(p, q), distance(p, q) / 2}
    return sorted(value for value in found if value < 1)


def largest_within(
    numbers: Sequence[Fraction], loss: float, attempt: Callable[[Fraction], Trial]
) -> tuple[Trial | None, tuple[Trial, ...]]:
    """The trial of the largest of `numbers`, ascending, whose bound is at most `loss`, and all trials made.

    None where not even the least of them has such a bound.
    """
    tried: dict[Fraction, Trial] = {}

    def good(number: Fraction) -> bool:
        tried[number] = attempt(number)
        return tried[number].loss <= loss

    low, high = -1, len(numbers)  # numbers[low] is good, numbers[high] is not
    while high - low > 1:
        middle = (low + high) // 2
        if good(numbers[middle]):
            low = middle
        else:
            high = middle
    made = tuple(tried[number] for number in sorted(tried))
    return (None if low < 0 else tried[numbers[low]]), made
