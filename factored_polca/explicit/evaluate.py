"""The value of an expression in one state, read off its definition.

The semantics are those of `factored_polca.models.expressions`.  Evaluation is partial and lazy: only
the chosen branch of a conditional or switch is read, `and` and `or` stop at the first argument that
decides, and the value of a lottery's outcome is not read where its probability is 0.

An *assignment* gives the values of references: its keys are pairs (name, primed), or references.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from types import MappingProxyType
from typing import Any, Final, TypeAlias

from factored_polca.models.expressions import (
    Conditional,
    Constant,
    Expression,
    Lottery,
    Operation,
    Parameter,
    Reference,
    Switch,
)
from factored_polca.models.features import position
from factored_polca.models.scalars import Scalar, Undefined, Value, apply_operator, describe, same, scalar

Assignment: TypeAlias = Mapping[Any, Value]
"""(name, primed) or `Reference` -> value."""

NO_PARAMETERS: Final[Mapping[str, Fraction]] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Distribution:
    """What a lottery means: distinct values with their positive probabilities.

    The probabilities need not sum to 1: `distribution` checks that for the row of a feature.
    """

    outcomes: tuple[tuple[Scalar, Fraction], ...]

    def probability(self, value: Scalar) -> Fraction:
        """The probability of `value`, 0 if it is no outcome."""
        return next((chance for known, chance in self.outcomes if same(known, value)), Fraction(0))


def evaluate(
    expression: Expression,
    assignment: Assignment,
    parameters: Mapping[str, Fraction] = NO_PARAMETERS,
) -> Scalar | Undefined | Distribution:
    """The value of `expression` under `assignment`, with the model's `parameters`.

    Raises:
        TypeError: `expression` is not one of the seven node classes.
    """
    while True:  # a chosen branch is read by going round, so long chains need no deep recursion
        match expression:
            case Constant():
                return expression.value
            case Reference():
                return _look_up(expression, assignment)
            case Parameter():
                if expression.name not in parameters:
                    return Undefined(f"the parameter {expression.name!r} has no value here")
                return parameters[expression.name]
            case Conditional():
                test = evaluate(expression.condition, assignment, parameters)
                if isinstance(test, Undefined):
                    return test
                if not isinstance(test, bool):
                    return Undefined(f"a condition must be true or false, not {_shown(test)}")
                expression = expression.then if test else expression.otherwise
            case Switch():
                case = _case(expression, assignment)
                if isinstance(case, Undefined):
                    return case
                expression = case
            case Lottery():
                return _lottery(expression, assignment, parameters)
            case Operation():
                values: list[Scalar | Undefined] = []
                for argument in expression.arguments:
                    value = evaluate(argument, assignment, parameters)
                    if isinstance(value, Distribution):
                        value = Undefined("a distribution can't be an operand")
                    values.append(value)
                    if isinstance(value, Undefined) or _decides(expression.operator, value):
                        break
                return _operate(expression.operator, values)
            case _:
                raise TypeError(f"{type(expression).__name__} is no expression")


def distribution(
    expression: Expression,
    values: Sequence[Value],
    assignment: Assignment,
    parameters: Mapping[str, Fraction] = NO_PARAMETERS,
) -> tuple[Fraction, ...] | Undefined:
    """The row that `expression` gives over `values`; a plain value has probability 1.

    `Undefined`, with the reason, where a value of positive probability is none of `values`, a
    probability is negative, or the row does not sum to exactly 1.
    """
    result = evaluate(expression, assignment, parameters)
    if isinstance(result, Undefined):
        return result
    if not isinstance(result, Distribution):
        result = Distribution(((result, Fraction(1)),))
    row = [Fraction(0)] * len(values)
    for value, chance in result.outcomes:
        index = position(tuple(values), value)
        if index is None:
            listed = ", ".join(describe(scalar(known)) for known in values)
            return Undefined(f"{describe(value)} is none of the values {listed}")
        row[index] += chance
    total = sum(row, Fraction(0))
    if total != 1:
        return Undefined(f"the probabilities sum to {total}, not to 1")
    return tuple(row)


def _shown(value: Scalar | Distribution) -> str:
    return "a distribution" if isinstance(value, Distribution) else describe(value)


def _look_up(reference: Reference, assignment: Assignment) -> Scalar | Undefined:
    for key in ((reference.name, reference.primed), reference):
        if key in assignment:
            return scalar(assignment[key])
    return Undefined(f"{reference.name}{chr(39) * reference.primed} has no value here")


def _case(switch: Switch, assignment: Assignment) -> Expression | Undefined:
    value = _look_up(switch.reference, assignment)
    if isinstance(value, Undefined):
        return value
    for known, case in switch.cases:
        if same(scalar(known), value):
            return case
    if switch.otherwise is None:
        return Undefined(f"the switch over {switch.reference.name} has no case for {describe(value)}")
    return switch.otherwise


def _lottery(
    lottery: Lottery, assignment: Assignment, parameters: Mapping[str, Fraction]
) -> Distribution | Undefined:
    outcomes: list[tuple[Scalar, Fraction]] = []
    for outcome, probability in lottery.outcomes:
        chance = evaluate(probability, assignment, parameters)
        if isinstance(chance, Undefined):
            return chance
        if not isinstance(chance, Fraction):
            return Undefined(f"a probability must be a number, not {_shown(chance)}")
        if chance < 0:
            return Undefined(f"the probability {chance} is negative")
        if chance == 0:
            continue
        value = evaluate(outcome, assignment, parameters)
        if isinstance(value, Undefined):
            return value
        if isinstance(value, Distribution):
            return Undefined("an outcome of a distribution must be a value, not a distribution")
        known = next((i for i, (other, _) in enumerate(outcomes) if same(other, value)), None)
        if known is None:
            outcomes.append((value, chance))
        else:
            outcomes[known] = (value, outcomes[known][1] + chance)
    return Distribution(tuple(outcomes))


def _decides(operator: str, value: Scalar) -> bool:
    return (operator == "and" and value is False) or (operator == "or" and value is True)


def _operate(operator: str, values: list[Scalar | Undefined]) -> Scalar | Undefined:
    if values and isinstance(values[-1], Undefined):
        return values[-1]
    return apply_operator(operator, values)
