"""Conditions that only count: how many of some features have each value, not which ones.

A condition f over features x_1 .. x_n with the same values is *symmetric* if exchanging two neighbours
never changes it,

    f(.., x_i = a, x_{i+1} = b, ..) = f(.., x_i = b, x_{i+1} = a, ..)   for all i and a < b,

which the nodes of its reduced diagram show.  Then f is a set of *count vectors* (k_v), k_v the number of
features with value v, sum k_v = n; there are (n + d - 1 over d - 1) of them for d values, each read off at
one state.  A block of n interchangeable parts is such a condition, and often a single count vector.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise
from math import comb
from typing import Final

from factored_polca.display.covers import Budget
from factored_polca.display.nodes import Nodes

FEWEST: Final = 4
"""Features from which counting says more than a cover."""

MOST_VECTORS: Final = 5_000

Counts = tuple[int, ...]
"""[value] the number of features that have it."""


def count_vectors(nodes: Nodes, sizes: Sequence[int], budget: Budget) -> set[Counts] | None:
    """The count vectors at which a symmetric condition holds; None: it is not symmetric.

    Args:
        sizes: the number of values of each level that is tested.

    Raises:
        TooLong: no step is left.
    """
    n, d = len(sizes), sizes[0] if sizes else 0
    if n < FEWEST or len(set(sizes)) != 1 or comb(n + d - 1, d - 1) > MOST_VECTORS:
        return None
    place = {level: k for k, level in enumerate(nodes.support)}
    if not _symmetric(nodes, place, d, budget):
        return None
    return {counts for counts in _vectors(n, d) if _holds(nodes, place, counts, budget)}


def _symmetric(nodes: Nodes, place: dict[int, int], d: int, budget: Budget) -> bool:
    """Whether each exchange of neighbours leaves each node's function as it is.

    As the diagram is reduced, a function is its node; below a node at place i the functions of
    x_i = a, x_{i+1} = b and x_i = b, x_{i+1} = a are one node or two.
    """
    at = [place.get(level, len(place)) for level in nodes.levels]

    def step(node: int, i: int, value: int) -> int:
        return nodes.children[node][value] if at[node] == i else node

    for node, below in enumerate(nodes.children):
        budget.take(d * d)
        if not below:
            continue
        i = at[node]
        if i + 1 < len(place):
            for a, b in combinations(range(d), 2):
                if step(step(node, i, a), i + 1, b) != step(step(node, i, b), i + 1, a):
                    return False
        # nodes that skip place i - 1 do not depend on it: with a symmetric whole they depend on nothing
        for child in set(below):
            if nodes.children[child] and at[child] > i + 1:
                return False
    return at[nodes.root] == 0


def _vectors(n: int, d: int) -> Iterator[Counts]:
    """All count vectors of n features with d values."""
    for bars in combinations(range(n + d - 1), d - 1):
        yield tuple(b - a - 1 for a, b in pairwise((-1, *bars, n + d - 1)))


def _holds(nodes: Nodes, place: dict[int, int], counts: Counts, budget: Budget) -> bool:
    values = [value for value, many in enumerate(counts) for _ in range(many)]
    budget.take(len(values))
    node = nodes.root
    while nodes.children[node]:
        node = nodes.children[node][values[place[nodes.levels[node]]]]
    return nodes.leaves[node] == 1


def one_value(vectors: set[Counts], n: int, d: int) -> tuple[int, int, int] | None:
    """A value and bounds (v, low, high) such that the vectors are all those with low <= k_v <= high."""
    for value in range(d):
        found = sorted({counts[value] for counts in vectors})
        low, high = found[0], found[-1]
        ways = sum(comb(n - k + d - 2, d - 2) if d > 1 else 1 for k in range(low, high + 1))
        if found == list(range(low, high + 1)) and len(vectors) == ways:
            return value, low, high
    return None
