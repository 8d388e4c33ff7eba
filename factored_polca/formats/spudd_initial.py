"""The initial belief of a SPUDD file: a tree, usually a product, divided by its sum.

Factors that share no variable are independent.  A group of factors over one variable is that
variable's distribution; a larger group stays a product of factors, with 1/Z for its sum Z.
Variables that are not mentioned are uniform.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import partial
from typing import Final

from factored_polca.formats.spudd_rows import Rows
from factored_polca.formats.spudd_trees import Assignment, Forest
from factored_polca.models.expressions import ONE, Constant, Expression, Operation, Reference, Switch
from factored_polca.models.features import Feature
from factored_polca.models.model import InitialBelief

MAXIMUM_FACTORS: Final = 10_000


def initial_belief(
    forest: Forest, tree: Expression, features: Sequence[Feature], rows: Rows
) -> tuple[InitialBelief, bool]:
    """The belief proportional to `tree`, and whether `tree` itself does not sum to 1.

    Raises:
        ValueError: a negative or undefined weight, or no state with a positive one.
        ExpansionLimit: the sum over a group of factors takes too long.
    """
    distributions: dict[str, Expression] = {}
    factors: list[Expression] = []
    covered = 0
    sums: list[Expression] = []
    for support, parts in _groups(forest, _factors(tree)):
        covered |= support
        members = forest.mentioned(support)
        whole = forest.operation("multiply", parts) if len(parts) > 1 else parts[0]
        total = forest.limited(partial(_sum, forest, whole, members))
        if _weight(total) == 0:
            raise ValueError("all weights are 0")
        sums.append(total)
        share = forest.operation("divide", (forest.constant(Fraction(1)), total))
        if len(members) == 1:
            name = members[0].name
            values = next(feature.values for feature in features if feature.name == name)
            weights = [forest.restrict(whole, members[0], value) for value in values]
            scaled = [_weight(forest.operation("multiply", (share, weight))) for weight in weights]
            distributions[name] = rows.point_or_lottery(list(zip(values, scaled, strict=True)))
        elif members:
            factors += [whole] if _weight(total) == 1 else [whole, share]
    for feature in features:
        if not covered & forest.bit(Reference(feature.name)):
            size = Fraction(len(feature.values))
            sums.append(forest.constant(size))
            distributions[feature.name] = rows.point_or_lottery([(v, 1 / size) for v in feature.values])
    ordered = [(f.name, distributions[f.name]) for f in features if f.name in distributions]
    whole_sum = forest.operation("multiply", sums) if len(sums) > 1 else sums[0]
    return InitialBelief(ordered, factors), whole_sum != ONE


def _factors(tree: Expression) -> list[Expression]:
    """The factors of a product of products; `[tree]` if it is none or has too many."""
    found: list[Expression] = []
    stack = [tree]
    while stack:
        part = stack.pop()
        if isinstance(part, Operation) and part.operator == "multiply":
            stack.extend(reversed(part.arguments))
        else:
            found.append(part)
        if len(found) + len(stack) > MAXIMUM_FACTORS:
            return [tree]
    return found


def _groups(forest: Forest, factors: Sequence[Expression]) -> list[tuple[int, list[Expression]]]:
    """The factors in groups that share no variable."""
    groups: list[tuple[int, list[Expression]]] = []
    for factor in factors:
        support, parts = forest.support(factor), [factor]
        forest.count(len(groups))
        apart = []
        for group in groups:
            if group[0] & support:
                support |= group[0]
                parts = [*group[1], *parts]
            else:
                apart.append(group)
        groups = [*apart, (support, parts)]
    return groups


def _weight(node: Expression) -> Fraction:
    if not (isinstance(node, Constant) and isinstance(node.value, Fraction)):
        raise ValueError("a weight is undefined: division by zero, or too many digits")
    if node.value < 0:
        raise ValueError("a weight is negative")
    return node.value


def _sum(forest: Forest, whole: Expression, members: Sequence[Reference]) -> Expression:
    """The sum of `whole` over the values of `members`: its mean times their number.

    The mean of a decision is the mean of its cases, however many other features they skip.
    """
    means: dict[int, Expression] = {}

    def leaf(rest: Expression, path: Assignment) -> Expression:
        return forest.constant(_weight(rest))

    def mean(e: Expression) -> Expression:
        if isinstance(e, Switch) and id(e) not in means:
            share = forest.constant(Fraction(1, len(e.cases)))
            total = forest.operation("add", [mean(case) for _, case in e.cases])
            means[id(e)] = forest.operation("multiply", (share, total))
        return means.get(id(e), e)

    result = mean(forest.expand(whole, leaf))
    for member in members:
        result = forest.operation("multiply", (forest.constant(Fraction(forest.size(member))), result))
    return result
