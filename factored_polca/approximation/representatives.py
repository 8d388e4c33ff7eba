"""Shared representatives of rows of probabilities, and of rewards, within a distance of each.

The distance of two rows is their total variation, d(p, q) = sum_v max(0, p_v - q_v), half the sum of
|p_v - q_v|: the largest difference of the probabilities of any event.  A representative of a set of rows is
within epsilon of each, sums to exactly 1, and is positive only where *all* of them are: what is impossible
stays impossible, so a set of states that nothing leaves is left by nothing afterwards.

Finding the fewest representatives is a covering problem (NP-hard; Gonzalez 1985 for centres).  Candidates
for a set are tried in this order: the sure outcome (a row that is 1 somewhere), rows of the set, their
mean, the last two with what is not possible for all moved to the most likely outcome.  Sets are then
joined greedily, those that stand for most rows first.  Numbers on a line are covered optimally, from the
least up."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from factored_polca.symbolic.rows import Row

MOST_CANDIDATES: Final = 12
"""Rows of one set that are tried as its representative."""


def distance(p: Row, q: Row) -> Fraction:
    """Total variation, from 0 to 1."""
    return sum((a - b for a, b in zip(p, q, strict=True) if a > b), Fraction(0))


def sure(size: int, value: int) -> Row:
    """The row of the outcome `value`."""
    return tuple(Fraction(int(v == value)) for v in range(size))


def stands_for(candidate: Row, row: Row, epsilon: Fraction) -> bool:
    """Whether a representative is within epsilon of a row and positive only where it is."""
    if any(c and not q for c, q in zip(candidate, row, strict=True)):
        return False
    return distance(candidate, row) <= epsilon


@dataclass
class Representatives:
    """Finds rows that stand for sets of rows; what has been found is remembered."""

    rows: Sequence[Row]
    epsilon: Fraction
    known: dict[frozenset[int], Row | None] = field(default_factory=dict)

    def of(self, members: frozenset[int]) -> Row | None:
        """A row that stands for all of `members`, numbers of rows; None where none was found."""
        if members not in self.known:
            self.known[members] = self._found(members)
        return self.known[members]

    def accepts(self, candidate: Row, members: Iterable[int]) -> bool:
        """Whether a row stands for each of `members`."""
        return all(stands_for(candidate, self.rows[m], self.epsilon) for m in members)

    def _found(self, members: frozenset[int]) -> Row | None:
        rows = [self.rows[m] for m in sorted(members)]
        common = [all(row[v] for row in rows) for v in range(len(rows[0]))]
        if not any(common):
            return None
        mean = [sum((row[v] for row in rows), Fraction(0)) / len(rows) for v in range(len(common))]
        likely = max(range(len(common)), key=lambda v: (common[v], mean[v]))
        candidates = [sure(len(common), likely)]
        candidates += [moved(row, common, likely) for row in rows[:MOST_CANDIDATES]]
        candidates.append(moved(tuple(mean), common, likely))
        return next((c for c in candidates if self.accepts(c, members)), None)

    def joined(self, sets: Iterable[frozenset[int]]) -> dict[frozenset[int], Row]:
        """A representative for each of some sets that have one, shared where that is possible."""
        clusters: list[tuple[set[int], Row]] = []
        result: dict[frozenset[int], int] = {}
        for members in sorted(set(sets), key=lambda s: (-len(s), sorted(s))):
            own = self.of(members)
            assert own is not None, "a set without a representative"
            result[members] = self._place(clusters, members, own)
        return {members: clusters[number][1] for members, number in result.items()}

    def _place(self, clusters: list[tuple[set[int], Row]], members: frozenset[int], own: Row) -> int:
        for number, (inside, row) in enumerate(clusters):
            if row == own or self.accepts(row, members):
                inside |= members
                return number
        for number, (inside, row) in enumerate(clusters):
            if distance(row, own) <= 2 * self.epsilon:
                better = self.of(frozenset(inside | members))
                if better is not None:
                    clusters[number] = (inside | members, better)
                    return number
        clusters.append((set(members), own))
        return len(clusters) - 1


def moved(row: Row, common: Sequence[bool], likely: int) -> Row:
    """A row with the probability of what is not common to all moved to one outcome."""
    kept = [q if inside else Fraction(0) for q, inside in zip(row, common, strict=True)]
    kept[likely] += 1 - sum(kept, Fraction(0))
    return tuple(kept)


def cover(values: Iterable[Fraction], radius: Fraction) -> dict[Fraction, Fraction]:
    """For each number the representative that stands for it, the fewest that are within `radius`.

    A number alone stands for itself, several are stood for by the middle of the least and the largest.
    """
    ordered = sorted(set(values))
    result: dict[Fraction, Fraction] = {}
    start = 0
    for end in range(1, len(ordered) + 1):
        if end == len(ordered) or ordered[end] - ordered[start] > 2 * radius:
            middle = (ordered[start] + ordered[end - 1]) / 2
            result |= dict.fromkeys(ordered[start:end], middle)
            start = end
    return result
