"""Where a setting of the parameters makes sense: the admissible region, as a list of conditions.

    0 <= f(t) <= 1    for each probability f that occurs in a row of an applicable action, or in b0;
    g(t) != 0         for each g that an expression divides by, or that is a denominator.

Rows sum to 1 as functions, so of a row with two entries, f and 1 - f, one condition is enough.  A division
counts wherever it stands, in a branch that is never taken, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

from factored_polca.diagrams import Diagram, choose, leaves
from factored_polca.minimisation import DecisionProcess
from factored_polca.models.rational_functions import (
    FunctionField,
    Polynomial,
    RationalFunction,
    functions_in,
    polynomial_text,
)
from factored_polca.parametric.substitution import rows_of
from factored_polca.symbolic import RowDiagram
from factored_polca.symbolic.rows import Row


@dataclass(frozen=True)
class Condition:
    """What a setting must meet; `path` is a place in the model that asks for it."""

    function: RationalFunction
    kind: Literal["probability", "nonzero"]
    path: tuple[str, ...] = ()

    def holds(self, values: Mapping[str, Fraction]) -> bool:
        """Whether it does at a setting of all parameters."""
        try:
            value = self.function.at(values)
        except ZeroDivisionError:
            return False
        return 0 <= value <= 1 if self.kind == "probability" else value != 0

    def __str__(self) -> str:
        if self.kind == "probability":
            return f"0 <= {self.function} <= 1"
        positive = self.function.over[0][1] > 0
        return f"{self.function if positive else -self.function} != 0"

    def interval(self) -> tuple[str, Fraction, Fraction] | None:
        """The parameter and its bounds, where that is all there is to it: of a linear function of one."""
        function = self.function
        names = function.parameters
        if self.kind != "probability" or len(names) != 1 or function.degree > 1:
            return None
        if any(any(exponents) for exponents, _ in function.under):
            return None
        at_zero, at_one = (function.at(dict.fromkeys(function.field.names, Fraction(t))) for t in (0, 1))
        slope = at_one - at_zero
        ends = sorted(((0 - at_zero) / slope, (1 - at_zero) / slope))
        return names[0], ends[0], ends[1]

    @property
    def key(self) -> object:
        """Equal for conditions that are met by the same settings, as far as is easily seen."""
        if self.kind == "nonzero":
            return self.kind, self.function.over
        complement = 1 - self.function
        return self.kind, frozenset([self.function, complement])


def region_text(conditions: Sequence[Condition]) -> list[str]:
    """The admissible region for people: one interval for each parameter where that is all, and the rest."""
    intervals: dict[str, tuple[Fraction, Fraction]] = {}
    rest: list[str] = []
    for condition in conditions:
        found = condition.interval()
        if found is None:
            rest.append(str(condition))
            continue
        name, low, high = found
        known = intervals.get(name, (low, high))
        intervals[name] = max(low, known[0]), min(high, known[1])
    return [f"{low} <= {name} <= {high}" for name, (low, high) in intervals.items()] + rest


def conditions_of(process: DecisionProcess, field: FunctionField) -> tuple[Condition, ...]:
    """The conditions of a process over a model compiled with symbols: divisors, then probabilities."""
    found: dict[object, Condition] = {}
    numbers = list(_numbers(process))
    denominators: dict[Polynomial, RationalFunction] = {}
    for divisor in field.divisors.values():
        _polynomial(field, divisor.over, denominators)
    for value, _ in numbers:
        _polynomial(field, value.under, denominators)
    for function in denominators.values():
        condition = Condition(function, "nonzero", ("parameters",))
        found.setdefault(condition.key, condition)
    for row, path in _rows(process):
        for value in functions_in(row):
            condition = Condition(value, "probability", path)
            known = found.setdefault(condition.key, condition)
            if len(str(condition)) < len(str(known)):
                found[condition.key] = condition
    return tuple(found.values())


def _polynomial(
    field: FunctionField, polynomial: Polynomial, found: dict[Polynomial, RationalFunction]
) -> None:
    """Remember a polynomial that must not be 0, as a function, unless it is constant."""
    if polynomial in found or not any(any(exponents) for exponents, _ in polynomial):
        return
    total: Fraction = Fraction(0)
    for exponents, coefficient in polynomial:
        term: Fraction = Fraction(coefficient)
        for name, exponent in zip(field.names, exponents, strict=True):
            term = term * field.symbol(name) ** exponent
        total = total + term
    assert isinstance(total, RationalFunction), polynomial_text(field.names, polynomial)
    found[polynomial] = total


def _rows(process: DecisionProcess) -> Iterator[tuple[Row, tuple[str, ...]]]:
    """The rows that occur where their action applies, and those of b0, each with its place."""
    symbolic = process.symbolic
    features, channels = symbolic.model.features, symbolic.model.observations
    everywhere = symbolic.manager.constant(1)
    for primitive, row in rows_of(process):
        action = symbolic.actions[primitive]
        sensed = action.observations.get(row.feature) is row
        name = channels[row.feature].name if sensed else features[row.feature].name
        part = "senses" if sensed else "effects"
        where = action.app if process.reachable is None else action.app & process.reachable
        for found in _occurring(row, where):
            yield found, ("actions", action.name, part, name)
    for feature, row in symbolic.initial.items():
        for found in _occurring(row, everywhere):
            yield found, ("initial", features[feature].name)


def _occurring(row: RowDiagram, where: Diagram) -> Sequence[Row]:
    """The rows of a diagram that occur in `where`."""
    if not functions_in(q for r in row.rows for q in r):
        return ()
    nowhere = len(row.rows)
    met = leaves(choose(where, row.diagram, where.manager.constant(nowhere)))
    return [row.rows[int(number)] for number in sorted(map(int, met)) if int(number) != nowhere]


def _numbers(process: DecisionProcess) -> Iterator[tuple[RationalFunction, tuple[str, ...]]]:
    """The functions among the numbers of a process, each with its place."""
    for row, path in _rows(process):
        for value in functions_in(row):
            yield value, path
    for terms in process.rewards.values():
        for term in terms:
            for value in functions_in(term.values):
                yield value, ("reward",)
