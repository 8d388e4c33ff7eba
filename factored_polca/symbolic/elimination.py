"""Variable elimination on factors that are diagrams.

The variables are summed out of a product of factors one by one, that one first whose factors together have
the fewest variables; factors that do not have it wait (variable elimination: Zhang & Poole 1996; on
diagrams: Hoey, St-Aubin, Hu & Boutilier 1999).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import reduce

from factored_polca.diagrams import Diagram, cofactors, node_count, sum_out, weighted_sum
from factored_polca.symbolic.factors import Factor

Fits = Callable[[Diagram], Diagram]
"""Answers its argument, or raises where that is too large."""


def eliminate(live: list[Factor], levels: Collection[int], fits: Fits) -> list[Factor]:
    """Sum `levels` out of the product of `live`."""
    width = {level: _width(live, level) for level in levels}
    while width:
        level = min(width, key=lambda level: (width[level], level))
        del width[level]
        touched = [factor for factor in live if level in factor.scope]
        live = [factor for factor in live if level not in factor.scope]
        if not touched:
            continue
        live.append(_sum_product(touched, level, fits))
        for other in live[-1].scope & width.keys():
            width[other] = _width(live, other)
    return live


def joined(factors: Sequence[Factor], fits: Fits) -> list[Factor]:
    """The same product with factors that share variables multiplied together."""
    groups: dict[int, list[Factor]] = {}
    owner: dict[int, int] = {}  # level -> group
    for number, factor in enumerate(factors):
        groups[number] = [factor]
        for group in sorted({owner[level] for level in factor.scope if level in owner}):
            groups[number] += groups.pop(group)
        owner.update((level, number) for member in groups[number] for level in member.scope)
    result = []
    for members in groups.values():
        together = sorted((member.diagram for member in members), key=node_count)
        scope = members[0].scope.union(*(member.scope for member in members))
        result.append(Factor(reduce(lambda a, b: fits(a * b), together), scope))
    return result


def _sum_product(touched: list[Factor], level: int, fits: Fits) -> Factor:
    """The sum over one variable of a product of factors."""
    scope = frozenset().union(*(factor.scope for factor in touched)) - {level}
    ordered = sorted((factor.diagram for factor in touched), key=node_count)
    if len(ordered) == 1:
        return Factor(fits(sum_out(ordered[0], level)), scope)
    seen = [cofactors(diagram, level) for diagram in ordered]
    weights = [reduce(lambda a, b: fits(a * b), parts) for parts in zip(*seen[:-1], strict=True)]
    return Factor(fits(weighted_sum(weights, seen[-1])), scope)


def _width(factors: Sequence[Factor], level: int) -> int:
    """How many variables the factors of a variable have."""
    return len(set().union(*(factor.scope for factor in factors if level in factor.scope)))
