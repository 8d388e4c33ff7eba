"""The effect of a command on each variable: one joint lottery as a network of conditional ones.

A command has outcomes k = 1..K with probabilities p_k; outcome k gives variable x_i the value f_ik(x), or
leaves it as it is. So the next values depend on each other. With the variables in one order for the whole
action,

    P(x_i' = v | x, x_1' .. x_{i-1}') = sum of w_k over the k with f_ik(x) = v / sum of all w_k,
    w_k = p_k [x_1' = f_1k(x)] ... [x_{i-1}' = f_{i-1,k}(x)]

which is the chain rule: "synchronic" arcs from the variables before x_i to x_i, and no further feature. A
variable that every outcome gives the same value needs none; nor does the first of the others. Where the
denominator is 0 nothing leads, and the quotient, which has no value there, does no harm. While the f_1k,
f_2k, ... are constants, the condition is a decision over x_1', x_2', ... whose leaves are lotteries.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from factored_polca.models.expressions import (
    ONE,
    ZERO,
    Conditional,
    Constant,
    Expression,
    Lottery,
    Reference,
    Switch,
    operation,
)
from factored_polca.models.features import Feature
from factored_polca.models.scalars import Value

Outcome = tuple[Expression, Mapping[str, Expression]]
"""A probability, and the next values of some variables; the others persist."""


def effects_of(outcomes: Sequence[Outcome], features: Sequence[Feature]) -> dict[str, Expression]:
    """The effect on each variable that some outcome changes; their order is that of `features`."""
    assigned = {name for _, updates in outcomes for name in updates}
    changed = [feature for feature in features if feature.name in assigned]
    columns = {f.name: [updates.get(f.name, Reference(f.name)) for _, updates in outcomes] for f in changed}
    effects = {name: column[0] for name, column in columns.items() if len(set(column)) == 1}
    varying = [feature for feature in changed if feature.name not in effects]
    rows = _merged([chance for chance, _ in outcomes], [columns[f.name] for f in varying])
    tested: list[Feature] = []  # by decisions
    for index, feature in enumerate(varying):
        if not index:
            effects[feature.name] = _row([row[0] for _, row in rows], [w for w, _ in rows], normalised=True)
        else:
            effects[feature.name] = _decision(tested, rows, 0, index, Reference(feature.name))
        if len(tested) == index and all(_value(row[index], feature) is not None for _, row in rows):
            tested.append(feature)
        else:
            rows = [(_where(_comes(feature, row[index]), weight), row) for weight, row in rows]
    return {f.name: effects[f.name] for f in changed if effects[f.name] != Reference(f.name)}


Rows = Sequence[tuple[Expression, tuple[Expression, ...]]]


def _decision(
    tested: Sequence[Feature], rows: Rows, depth: int, index: int, rest: Expression
) -> Expression:
    """The distribution of variable `index`: a decision over the next values of those tested, then a row."""
    if depth == len(tested):
        return _row([row[index] for _, row in rows], [weight for weight, _ in rows], normalised=False)
    feature = tested[depth]
    cases: dict[Expression, list[tuple[Expression, tuple[Expression, ...]]]] = {}
    for weight, row in rows:
        cases.setdefault(row[depth], []).append((weight, row))
    branches = []
    for value, group in cases.items():
        known = _value(value, feature)
        assert known is not None
        branches.append((known, _decision(tested, group, depth + 1, index, rest)))
    if len({branch for _, branch in branches}) == 1:
        return branches[0][1]
    return Switch(Reference(feature.name, primed=True), tuple(branches), rest)


def _value(expression: Expression, feature: Feature) -> Value | None:
    """The value of `feature` that a constant is; None for others."""
    if not isinstance(expression, Constant):
        return None
    index = feature.index(expression.value)
    return None if index is None else feature.values[index]


def _comes(feature: Feature, value: Expression) -> Expression:
    return operation("equal", Reference(feature.name, primed=True), value)


def _merged(
    chances: Sequence[Expression], columns: Sequence[Sequence[Expression]]
) -> list[tuple[Expression, tuple[Expression, ...]]]:
    """Outcomes that do the same taken together."""
    found: dict[tuple[Expression, ...], Expression] = {}
    for chance, row in zip(chances, zip(*columns, strict=True), strict=True) if columns else ():
        found[row] = found[row] + chance if row in found else chance
    return [(chance, row) for row, chance in found.items()]


def _row(values: Sequence[Expression], weights: Sequence[Expression], *, normalised: bool) -> Expression:
    """The distribution with these values and weights; weights that do not sum to 1 are divided."""
    sums: dict[Expression, list[Expression]] = {}
    for value, weight in zip(values, weights, strict=True):
        sums.setdefault(value, []).append(weight)
    if len(sums) == 1:
        return values[0]
    shares = [(value, _sum(parts)) for value, parts in sums.items() if parts != [ZERO]]
    if normalised:
        return Lottery(tuple(shares))
    total = _sum(weights)
    return Lottery(tuple((value, operation("divide", share, total)) for value, share in shares))


def _sum(parts: Sequence[Expression]) -> Expression:
    return operation("add", *parts) if len(parts) > 1 else parts[0]


def _where(condition: Expression, weight: Expression) -> Expression:
    if weight == ZERO:
        return ZERO
    if isinstance(condition, Constant):
        return weight if condition.value is True else ZERO
    if isinstance(weight, Conditional) and weight.otherwise == ZERO:
        return Conditional(operation("and", weight.condition, condition), weight.then, ZERO)
    return Conditional(condition, weight, ZERO)


def product(left: Sequence[Outcome], right: Sequence[Outcome]) -> list[Outcome]:
    """The outcomes of two commands that run together."""
    return [
        (p if q == ONE else q if p == ONE else operation("multiply", p, q), {**a, **b})
        for p, a in left
        for q, b in right
    ]
