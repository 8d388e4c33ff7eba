"""Compile expressions to diagrams, bottom-up, exactly.

Each distinct sub-expression becomes one diagram whose leaves number entries of a value table:
rationals, truth values, names, distributions, and `Undefined`s with their reasons.  An operator
numbers the distinct tuples of its arguments' leaves and is computed once for each, in Python, on
exact values; so nothing is ever a table over all parents, and a value that is undefined only
where a conditional does not look does no harm.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Final, Union

import numpy as np

from factored_polca.diagrams import Diagram, Manager, choose, combine, leaves, relabel
from factored_polca.models.errors import LimitReached
from factored_polca.models.expressions import (
    Conditional,
    Constant,
    Expression,
    Lottery,
    Operation,
    Parameter,
    Reference,
    Switch,
    parts_first,
)
from factored_polca.models.features import Feature, position
from factored_polca.models.model import Observation
from factored_polca.models.rational_functions import RationalFunction
from factored_polca.models.scalars import Scalar, Undefined, apply_operator, describe, scalar


@dataclass(frozen=True, slots=True)
class Distribution:
    """Values with their positive probabilities, which sum to 1.

    `kinds` are the values' types: without them {true: 1} would equal {1: 1}.
    """

    outcomes: tuple[tuple[Scalar, Fraction], ...]
    kinds: tuple[type, ...]


MAXIMUM_TABLE: Final = 250_000
"""Different values of all expressions of a model; each takes a place in a table, and leaves of diagrams."""

TableValue = Union[Scalar, Distribution, Undefined]

Variable = Union[Feature, Observation]
"""What an expression may refer to."""


@dataclass
class ValueTable:
    """Numbers for values; `True`, 1 and "1" are three values."""

    values: list[TableValue] = field(default_factory=list)
    numbers: dict[tuple[type, TableValue], int] = field(default_factory=dict)

    def add(self, value: TableValue) -> int:
        """The number of `value`, a new one if need be."""
        key = (type(value), value)
        if key not in self.numbers:
            if len(self.values) >= MAXIMUM_TABLE:
                raise LimitReached(
                    f"the model's expressions take more than {MAXIMUM_TABLE:,} different values, as a "
                    "product of many factors does: split sums into terms, or use fewer features in one",
                    "compiling the model",
                )
            self.numbers[key] = len(self.values)
            self.values.append(value)
        return self.numbers[key]


class ExpressionCompiler:
    """Compiles expressions over the variables of one manager; remembers what it compiled."""

    def __init__(
        self,
        manager: Manager,
        variables: Sequence[Variable],
        levels: Mapping[Reference, int],
        parameters: Mapping[str, Fraction],
    ) -> None:
        self.manager = manager
        self.variables = {variable.name: variable for variable in variables}
        self.levels = levels
        self.parameters = parameters
        self.table = ValueTable()
        self._memo: dict[Expression, Diagram] = {}
        self._folds: dict[tuple[str, int, int], Diagram] = {}

    def compile(self, expression: Expression) -> Diagram:
        """The diagram of `expression`; its leaves number entries of `table`."""
        for part in parts_first(expression):
            if part not in self._memo:
                self._memo[part] = self._part(part)
        return self._memo[expression]

    def value(self, number: int) -> TableValue:
        """The entry of the value table behind a leaf."""
        return self.table.values[number]

    def condition(self, expression: Expression) -> tuple[Diagram, Diagram]:
        """A condition as (where it is true, where it is no truth value)."""
        diagram = self.compile(expression)
        true = self._where(diagram, lambda value: value is True)
        strange = self._where(diagram, lambda value: not isinstance(value, bool))
        return true, strange

    def _where(self, diagram: Diagram, test: Callable[[TableValue], bool]) -> Diagram:
        images = np.array([test(value) for value in self.table.values], dtype=np.uint64)
        return relabel(diagram, images, diagram.leaf_type)

    def map(self, diagrams: Sequence[Diagram], function: Callable[..., TableValue]) -> Diagram:
        """Apply a function of exact values pointwise."""
        values = self.table.values
        if all(diagram.is_constant for diagram in diagrams):
            return self._constant(function(*(values[int(diagram.value)] for diagram in diagrams)))
        numbered, results = combine(diagrams, lambda *numbers: function(*(values[i] for i in numbers)))
        images = np.array([self.table.add(result) for result in results], dtype=np.uint64)
        return relabel(numbered, images, numbered.leaf_type)

    def _constant(self, value: TableValue) -> Diagram:
        return self.manager.constant(self.table.add(value))

    def _part(self, e: Expression) -> Diagram:
        match e:
            case Constant():
                return self._constant(e.value)
            case Parameter():
                return self._constant(self.parameters[e.name])
            case Reference():
                return self._reference(e)
            case Operation():
                name = e.operator
                if name in ("and", "or") or len(e.arguments) > 2:
                    return self._fold(name, [self._memo[a] for a in e.arguments])
                arguments = [self._memo[a] for a in e.arguments]
                return self.map(arguments, lambda *values: _operate(name, values))
            case Conditional():
                return self._conditional(e)
            case Switch():
                return self._switch(e)
            case Lottery():
                parts = [self._memo[part] for pair in e.outcomes for part in pair]
                return self.map(parts, lambda *values: _distribution(values))
        raise TypeError(f"{type(e).__name__} is no expression")

    def _fold(self, name: str, arguments: Sequence[Diagram]) -> Diagram:
        """An associative operator, two arguments at a time from the left.

        Conditions that begin alike share what they begin with; long sums would keep too much alive.
        """
        result = arguments[0]
        for argument in arguments[1:]:
            key = (name, id(result), id(argument))  # `_memo` and `_folds` keep both alive
            known = self._folds.get(key)
            if known is None:
                known = self.map([result, argument], lambda a, b: _operate(name, (a, b)))
                if name in ("and", "or"):
                    self._folds[key] = known
            result = known
        return result

    def _reference(self, reference: Reference) -> Diagram:
        values = self.variables[reference.name].values
        level = self.levels[reference]
        if len(values) == 1:
            return self._constant(scalar(values[0]))
        return self.manager.variable(level, [self._constant(scalar(value)) for value in values])

    def _conditional(self, e: Conditional) -> Diagram:
        true, strange = self.condition(e.condition)
        result = choose(true, self._memo[e.then], self._memo[e.otherwise])
        if strange == self.manager.constant(0):
            return result
        reasons = self.map([self._memo[e.condition]], _not_a_condition)
        return choose(strange, reasons, result)

    def _switch(self, e: Switch) -> Diagram:
        values = self.variables[e.reference.name].values
        level = self.levels[e.reference]
        missing = self._constant(Undefined(f"the switch over {e.reference.name!r} has no such case"))
        otherwise = missing if e.otherwise is None else self._memo[e.otherwise]
        cases: dict[Expression, list[int]] = {}
        for value, case in e.cases:
            index = position(values, value)
            if index is not None:
                cases.setdefault(case, []).append(index)
        parts = {case: self._memo[case] for case in cases}
        if len(cases) > 2 and min(d.level for d in (otherwise, *parts.values())) > level:
            children = [otherwise] * len(values)
            for case, indices in cases.items():
                for index in indices:
                    children[index] = parts[case]
            return self.manager.variable(level, children)
        result = otherwise
        for case, indices in cases.items():
            result = choose(self.manager.indicator(level, indices), self._memo[case], result)
        return result


def _operate(name: str, values: Sequence[TableValue]) -> TableValue:
    for value in values:
        if isinstance(value, Distribution):
            return Undefined("a distribution where a value is needed")
    return apply_operator(name, values)  # type: ignore[arg-type]


def _not_a_condition(value: TableValue) -> TableValue:
    if isinstance(value, (bool, Undefined)):
        return value
    shown = "a distribution" if isinstance(value, Distribution) else describe(value)
    return Undefined(f"a condition must be true or false, not {shown}")


def _distribution(values: Sequence[Any]) -> TableValue:
    """The distribution of alternating values and probabilities."""
    chances: dict[tuple[type, Scalar], Fraction] = {}
    total = Fraction(0)
    for value, chance in zip(values[::2], values[1::2], strict=True):
        if isinstance(chance, Undefined):
            return chance
        if not isinstance(chance, Fraction):
            shown = "a distribution" if isinstance(chance, Distribution) else describe(chance)
            return Undefined(f"a probability must be a number, not {shown}")
        if not isinstance(chance, RationalFunction) and chance < 0:  # else a condition on parameters
            return Undefined(f"a probability is {describe(chance)}")
        total += chance
        if chance == 0:
            continue
        if isinstance(value, Undefined):
            return value
        if isinstance(value, Distribution):
            return Undefined("a distribution inside a distribution")
        key = (type(value), value)
        chances[key] = chances.get(key, Fraction(0)) + chance
    if total != 1:
        return Undefined(f"the probabilities sum to {describe(total)}")
    outcomes = tuple((value, chance) for (_, value), chance in chances.items())
    return Distribution(outcomes, tuple(kind for kind, _ in chances))


def row_of(variable: Variable, value: TableValue) -> tuple[Fraction, ...] | Undefined:
    """The probability of each value of `variable` that a table value stands for."""
    if isinstance(value, Undefined):
        return value
    outcomes = value.outcomes if isinstance(value, Distribution) else ((value, Fraction(1)),)
    row = [Fraction(0)] * len(variable.values)
    for outcome, chance in outcomes:
        index = position(variable.values, outcome)
        if index is None:
            return Undefined(f"{describe(outcome)} is no value of {variable.name!r}")
        row[index] += chance
    return tuple(row)


def used(diagram: Diagram) -> set[int]:
    """The entries of the value table that a compiled diagram uses."""
    return {int(leaf) for leaf in leaves(diagram)}
