"""Distributions as guarded commands: the cases of an effect, and the joint outcomes of several features.

An effect is a tree of conditions over x whose leaves are lotteries. `regions` gives its paths: the
conditions on the way and what is at the end; together they cover every state, and exclude each other. For
features that depend on each other's next values

    P(x_1' .. x_n' | x) = P(x_1' | x) P(x_2' | x, x_1') ...

is multiplied out, parents first: each outcome of x_1' is put into the effect of x_2', and where that
leaves conditions over x the region is divided.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from factored_polca.formats.prism_expressions import choose, logical
from factored_polca.models.errors import ModelError
from factored_polca.models.expressions import (
    ONE,
    ZERO,
    Conditional,
    Constant,
    Expression,
    Lottery,
    Operation,
    Reference,
    Switch,
    operation,
    parts_first,
    references,
)
from factored_polca.models.features import Feature, position
from factored_polca.models.scalars import Value, scalar

MAXIMUM_REGIONS: Final = 100_000
"""Commands and reward items of one model."""
MAXIMUM_OUTCOMES: Final = 10_000
"""Outcomes of one command."""


@dataclass(frozen=True)
class Known:
    """What holds in a region: the values that features may have there, and conditions."""

    values: tuple[tuple[str, tuple[Value, ...]], ...] = ()
    conditions: tuple[tuple[Expression, bool], ...] = ()

    def of(self, feature: Feature) -> tuple[Value, ...]:
        """The values that are left."""
        return dict(self.values).get(feature.name, feature.values)

    def singles(self) -> dict[Reference, Expression]:
        """The features that have one value."""
        return {Reference(name): Constant(scalar(v[0])) for name, v in self.values if len(v) == 1}

    def where(self, name: str, values: tuple[Value, ...]) -> Known:
        """And `name` has one of `values`."""
        return Known(tuple({**dict(self.values), name: values}.items()), self.conditions)

    def given(self, condition: Expression, holds: bool) -> Known:
        """And `condition` holds, or does not."""
        return Known(self.values, (*self.conditions, (condition, holds)))


Outcome = tuple[Expression, Mapping[str, Expression]]
"""A probability and next values."""


class Cases:
    """Makes regions; counts them all."""

    def __init__(self, features: Sequence[Feature]) -> None:
        self.features = {feature.name: feature for feature in features}
        self.count = 0

    def regions(self, e: Expression, known: Known) -> Iterator[tuple[Known, Expression]]:
        """The paths of an expression and what is at their ends, inside a region."""
        stack = [(known, e)]
        while stack:
            known, e = stack.pop()
            self.count += 1
            if self.count > MAXIMUM_REGIONS:
                raise ModelError(
                    f"written as PRISM's commands the model has more than {MAXIMUM_REGIONS:,} cases; "
                    "use a .toml file"
                )
            if isinstance(e, Conditional):
                condition = substitute(e.condition, known.singles())
                stack += [
                    (below, e.then if holds else e.otherwise)
                    for below, holds in self.split(known, condition)
                ]
            elif isinstance(e, Switch) and not e.reference.primed:
                feature = self.features[e.reference.name]
                groups: dict[Expression, list[Value]] = {}
                for value in known.of(feature):
                    groups.setdefault(case_of(e, value), []).append(value)
                if len(groups) == 1:
                    stack.append((known, next(iter(groups))))
                else:
                    stack += [
                        (known.where(feature.name, tuple(v)), part) for part, v in reversed(groups.items())
                    ]
            elif (inner := _decision_in(e)) is not None:
                stack.append((known, inner))
            else:
                yield known, substitute(e, known.singles())

    def split(self, known: Known, condition: Expression) -> list[tuple[Known, bool]]:
        """A region where a condition holds and where it does not; only one of them if it is decided."""
        if isinstance(condition, Constant) and isinstance(condition.value, bool):
            return [(known, condition.value)]
        for before, holds in known.conditions:
            if before == condition:
                return [(known, holds)]
        tested = _test(condition)
        if tested is not None and tested[0] in self.features:
            name, value = tested
            values = known.of(self.features[name])
            index = position(values, value)
            if index is None:
                return [(known, False)]
            if len(values) == 1:
                return [(known, True)]
            rest = values[:index] + values[index + 1 :]
            return [(known.where(name, rest), False), (known.where(name, (values[index],)), True)]
        return [(known.given(condition, False), False), (known.given(condition, True), True)]

    def joint(
        self, effects: Sequence[tuple[str, Expression]], known: Known
    ) -> list[tuple[Known, list[Outcome]]]:
        """Regions with joint outcomes of some features; each may read the next values of those before."""
        result: list[tuple[Known, list[Outcome]]] = [(known, [(ONE, {})])]
        for name, effect in effects:
            result = [part for region in result for part in self._extend(name, effect, region)]
        return result

    def _extend(
        self, name: str, effect: Expression, region: tuple[Known, list[Outcome]]
    ) -> list[tuple[Known, list[Outcome]]]:
        known, before = region
        parts: list[tuple[Known, list[Outcome]]] = [(known, [])]
        for chance, given in before:
            expression = substitute(effect, next_values(given))
            divided = []
            for inside, outcomes in parts:
                for below, end in self.regions(expression, inside):
                    added = [
                        (_times(chance, share), {**given, name: value})
                        for value, share in _row(end)
                        if share != ZERO
                    ]
                    if len(outcomes) + len(added) > MAXIMUM_OUTCOMES:
                        raise ModelError(
                            f"a command of PRISM would have more than {MAXIMUM_OUTCOMES:,} outcomes: "
                            "next values depend on each other too much; use a .toml file"
                        )
                    divided.append((below, [*outcomes, *added]))
            parts = divided
        return parts


def _decision_in(e: Expression) -> Expression | None:
    """A lottery one of whose probabilities is a conditional, as a conditional of lotteries."""
    if not isinstance(e, Lottery):
        return None
    for index, (value, chance) in enumerate(e.outcomes):
        if isinstance(chance, Conditional):
            before, after = e.outcomes[:index], e.outcomes[index + 1 :]
            then, otherwise = (
                Lottery((*before, (value, part), *after)) for part in (chance.then, chance.otherwise)
            )
            return Conditional(chance.condition, then, otherwise)
    return None


def next_values(values: Mapping[str, Expression]) -> dict[Reference, Expression]:
    return {Reference(name, primed=True): value for name, value in values.items()}


def _row(end: Expression) -> Sequence[tuple[Expression, Expression]]:
    return end.outcomes if isinstance(end, Lottery) else ((end, ONE),)


def _times(a: Expression, b: Expression) -> Expression:
    return b if a == ONE else a if b == ONE else operation("multiply", a, b)


def _test(condition: Expression) -> tuple[str, Value] | None:
    """The feature and value of a test such as x == 3, or of a truth-valued feature."""
    if isinstance(condition, Reference) and not condition.primed:
        return condition.name, True
    if isinstance(condition, Operation) and condition.operator == "equal":
        for a, b in (condition.arguments, condition.arguments[::-1]):
            if isinstance(a, Reference) and not a.primed and isinstance(b, Constant):
                value = b.value
                if isinstance(value, (bool, str)):
                    return a.name, value
                if value.denominator == 1:
                    return a.name, int(value)
    return None


def case_of(e: Switch, value: Value) -> Expression:
    """The case of a value."""
    for known, case in e.cases:
        if type(known) is type(value) and known == value:
            return case
    assert e.otherwise is not None, "checked models have complete switches"
    return e.otherwise


def substitute(e: Expression, values: Mapping[Reference, Expression]) -> Expression:
    """`e` with what stands for some references put in, folded where that decides."""
    if not values or not references(e) & set(values):
        return e
    new: dict[Expression, Expression] = {}
    for part in parts_first(e):
        match part:
            case Reference():
                new[part] = values.get(part, part)
            case Operation():
                parts = [new[a] for a in part.arguments]
                is_logical = part.operator in ("and", "or", "not")
                new[part] = (logical if is_logical else _operate)(part.operator, parts)
            case Conditional():
                new[part] = choose(new[part.condition], new[part.then], new[part.otherwise])
            case Lottery():
                new[part] = Lottery(tuple((new[v], new[q]) for v, q in part.outcomes))
            case Switch():
                new[part] = _switched(part, new)
            case _:
                new[part] = part
    return new[e]


def _operate(name: str, parts: Sequence[Expression]) -> Expression:
    return operation(name, *parts)


def _switched(e: Switch, new: Mapping[Expression, Expression]) -> Expression:
    reference = new[e.reference]
    if isinstance(reference, Reference):
        otherwise = None if e.otherwise is None else new[e.otherwise]
        return Switch(reference, tuple((value, new[case]) for value, case in e.cases), otherwise)
    if isinstance(reference, Constant):
        for value, case in e.cases:
            if Constant(scalar(value)) == reference:
                return new[case]
        if e.otherwise is not None:
            return new[e.otherwise]
    cases = [(value, new[case]) for value, case in e.cases]
    if e.otherwise is None:
        *cases, (_, result) = cases
    else:
        result = new[e.otherwise]
    for value, case in reversed(cases):
        result = choose(operation("equal", reference, Constant(scalar(value))), case, result)
    return result
