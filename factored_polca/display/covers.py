"""Covers of a condition by cubes, as small as they get without a search over all of them.

A *cube* is a set of values S_i for each feature i that the condition tests, read as "x_i in S_i for all i";
a *cover* is a set of cubes whose union is the condition.  Here covers are

    prime         no S_i of a cube can take a further value without leaving the condition;
    irredundant   no cube can be left out,

as the two-level minimisers of switching theory make them (Brayton et al. 1984, "expand" and "irredundant"):

    1. the paths of the diagram to its true leaf are a cover of disjoint cubes;
    2. each is expanded, feature by feature, from the first and from the last: S_i takes every value v such
       that the cube with S_i = {v} lies inside the condition;
    3. of the primes found, the fewest that cover all cells (a *cell* is a product of classes of values that
       no cube tells apart): by trial where there are few primes, else greedily, and then without those that
       the others cover.

All work is counted, and given up beyond a budget.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, product
from typing import Final, TypeAlias

from factored_polca.display.nodes import Nodes

Cube: TypeAlias = tuple[frozenset[int], ...]
"""[feature tested] the values that it may have."""

MOST_PATHS: Final = 400
MOST_CELLS: Final = 20_000
FEW_PRIMES: Final = 12


class TooLong(Exception):
    """The condition has no cover that is found within the budget."""


class Budget:
    """Steps that may be taken; one for all the covers of a table."""

    def __init__(self, steps: int) -> None:
        self.left = steps

    def take(self, steps: int) -> None:
        """Take steps.

        Raises:
            TooLong: none are left.
        """
        self.left -= steps
        if self.left < 0:
            raise TooLong


class Condition:
    """A condition as a diagram: true where the leaf is `true`; `sizes` [feature] numbers of values."""

    def __init__(self, nodes: Nodes, sizes: Sequence[int], true: int, budget: Budget) -> None:
        self.nodes, self.sizes, self.budget = nodes, tuple(sizes), budget
        self.place = {level: k for k, level in enumerate(nodes.support)}
        self.holds = [leaf == true if leaf is not None else False for leaf in nodes.leaves]

    def paths(self) -> int:
        """How many paths lead to true, those that differ in values only at one node counted once."""
        self.budget.take(len(self.nodes.levels))
        counts: list[int] = []
        for node, below in enumerate(self.nodes.children):
            counts.append(sum(counts[c] for c in set(below)) if below else int(self.holds[node]))
        return counts[-1]

    def path_cubes(self) -> list[Cube]:
        """Disjoint cubes that cover the condition."""
        full = [frozenset(range(size)) for size in self.sizes]
        found: list[Cube] = []
        stack = [(self.nodes.root, tuple(full))]
        while stack:
            node, cube = stack.pop()
            self.budget.take(1)
            if not self.nodes.children[node]:
                if self.holds[node]:
                    found.append(cube)
                continue
            place = self.place[self.nodes.levels[node]]
            for child, values in reversed(self.nodes.groups(node)):
                stack.append((child, (*cube[:place], frozenset(values), *cube[place + 1 :])))
        return found

    def contains(self, cube: Cube) -> bool:
        """Whether the condition holds everywhere in a cube."""
        nodes = self.nodes
        self.budget.take(len(nodes.levels))
        inside: list[bool] = []
        for node, below in enumerate(nodes.children):
            if below:
                inside.append(all(inside[below[v]] for v in cube[self.place[nodes.levels[node]]]))
            else:
                inside.append(self.holds[node])
        return inside[-1]

    def expanded(self, cube: Cube, order: Sequence[int]) -> Cube:
        """A prime cube around a cube inside the condition."""
        for place in order:
            mine, size = cube[place], self.sizes[place]
            if len(mine) == size:
                continue
            more = {
                v
                for v in range(size)
                if v not in mine and self.contains((*cube[:place], frozenset({v}), *cube[place + 1 :]))
            }
            cube = (*cube[:place], mine | more, *cube[place + 1 :])
        return cube


def cover(condition: Condition) -> list[Cube]:
    """A prime and irredundant cover; no cube where the condition never holds.

    Raises:
        TooLong: too many paths, or no step is left.
    """
    if condition.paths() > MOST_PATHS:
        raise TooLong
    start = condition.path_cubes()
    order = range(len(condition.sizes))
    primes: dict[Cube, None] = {}
    for cube in start:
        for direction in (order, order[::-1]):
            primes[condition.expanded(cube, direction)] = None
    return _fewest(list(primes), start, condition)


def literals(cube: Cube, sizes: Sequence[int]) -> int:
    """How many features a cube restricts."""
    return sum(len(values) < size for values, size in zip(cube, sizes, strict=True))


def _fewest(primes: list[Cube], start: Sequence[Cube], condition: Condition) -> list[Cube]:
    primes.sort(key=lambda cube: literals(cube, condition.sizes))
    cells = list(_cells(primes, start, condition))
    inside = [
        {k for k, cell in enumerate(cells) if all(v in s for v, s in zip(cell, cube, strict=True))}
        for cube in primes
    ]
    condition.budget.take(len(cells) * len(primes))
    everything = set(range(len(cells)))
    if len(primes) <= FEW_PRIMES:
        for count in range(len(primes) + 1):
            best: tuple[int, ...] | None = None
            for some in combinations(range(len(primes)), count):
                if set().union(*(inside[k] for k in some)) == everything:
                    cost = sum(literals(primes[k], condition.sizes) for k in some)
                    if best is None or cost < sum(literals(primes[k], condition.sizes) for k in best):
                        best = some
            if best is not None:
                return [primes[k] for k in best]
    chosen: list[int] = []
    left = set(everything)
    while left:
        taken = max(range(len(primes)), key=lambda k: len(inside[k] & left))
        chosen.append(taken)
        left -= inside[taken]
    for k in sorted(chosen, key=lambda k: -literals(primes[k], condition.sizes)):
        others = [j for j in chosen if j != k]
        if set().union(*(inside[j] for j in others)) == everything:
            chosen = others
    return [primes[k] for k in sorted(chosen)]


def _cells(
    primes: Sequence[Cube], start: Sequence[Cube], condition: Condition
) -> Iterator[tuple[int, ...]]:
    """A value of each feature for each cell inside the condition."""
    classes: list[dict[tuple[bool, ...], int]] = []
    for place, size in enumerate(condition.sizes):
        first: dict[tuple[bool, ...], int] = {}
        for value in range(size):
            first.setdefault(tuple(value in cube[place] for cube in (*primes, *start)), value)
        classes.append(first)
    count = 0
    for cube in start:
        inside = [[v for v in found.values() if v in cube[k]] for k, found in enumerate(classes)]
        for cell in product(*inside):
            count += 1
            if count > MOST_CELLS:
                raise TooLong
            yield cell
