"""Values of expressions, and the operators on them: a table, with a row for each operator.

A value is a rational, a truth value or a name; what has no value is `Undefined`, with a reason.
Where parameters stay symbols numbers may be rational functions of them, and the operators of the field,
`FIELD`, are the only ones that take these.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Final, Union

from factored_polca.models.rational_functions import RationalFunction

Value = Union[bool, int, str]
"""A value of a feature."""

Scalar = Union[Fraction, bool, str]
"""A value of an expression: integers are rationals here."""

MAXIMUM_BITS: Final = 13_000
"""Largest numerator or denominator, in bits: fewer than the 4300 digits that Python prints."""

MAXIMUM_EXPONENT: Final = 1_000
"""Largest absolute value of an exponent."""


@dataclass(frozen=True, slots=True)
class Undefined:
    """The result of an expression that has no value, and why."""

    reason: str


def scalar(value: Value) -> Scalar:
    """The expression value that stands for feature value `value`."""
    if isinstance(value, (bool, str)):
        return value
    return Fraction(value)


def same(a: Scalar, b: Scalar) -> bool:
    """Whether two values of one kind are equal (`True` is not the number 1)."""
    return type(a) is type(b) and a == b


def describe(value: Scalar | Undefined) -> str:
    """`value` as a person would write it."""
    if isinstance(value, Undefined):
        return f"undefined ({value.reason})"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, RationalFunction):
        text = str(value)
        return text if len(text) <= 200 else f"a function of {', '.join(value.parameters)}"
    if isinstance(value, Fraction) and max(abs(value.numerator), value.denominator) >= 10**40:
        return "a number of more than 40 digits"
    return str(value)


def _number(value: Fraction) -> Fraction | Undefined:
    if isinstance(value, RationalFunction):  # which has limits of its own
        return value
    if max(value.numerator.bit_length(), value.denominator.bit_length()) > MAXIMUM_BITS:
        return Undefined(f"a number of more than {MAXIMUM_BITS} bits")
    return value


def _add(a: Fraction, b: Fraction) -> Fraction | Undefined:
    return _number(a + b)


def _multiply(a: Fraction, b: Fraction) -> Fraction | Undefined:
    return _number(a * b)


def _divide(a: Fraction, b: Fraction) -> Fraction | Undefined:
    if b == 0:
        return Undefined("division by zero")
    if isinstance(b, RationalFunction):
        b.field.divided_by(b)
    return _number(a / b)


def _floor_divide(a: Fraction, b: Fraction) -> Fraction | Undefined:
    if b == 0:
        return Undefined("division by zero")
    return Fraction(a // b)


def _modulo(a: Fraction, b: Fraction) -> Fraction | Undefined:
    if b == 0:
        return Undefined("division by zero")
    return _number(a % b)


def _power(a: Fraction, b: Fraction) -> Fraction | Undefined:
    if isinstance(b, RationalFunction):
        return Undefined(f"the exponent {describe(b)} depends on a parameter that stays a symbol")
    if b.denominator != 1 or abs(b.numerator) > MAXIMUM_EXPONENT:
        return Undefined(f"an exponent must be an integer of at most {MAXIMUM_EXPONENT}")
    if a == 0 and b < 0:
        return Undefined("division by zero")
    if isinstance(a, RationalFunction):
        if b < 0:
            a.field.divided_by(a)
        return a ** int(b)  # type: ignore[no-any-return]
    bits = max(a.numerator.bit_length(), a.denominator.bit_length())
    if bits * abs(b.numerator) > MAXIMUM_BITS:
        return Undefined(f"a number of more than {MAXIMUM_BITS} bits")
    return Fraction(a ** int(b))


@dataclass(frozen=True, slots=True)
class Operator:
    """A row of the operator table.

    `kind` says what the arguments are: "number", "order" (numbers, gives a truth value),
    "equality" (two values of one kind, gives a truth value) or "logic".
    `associative` operators take any number of arguments from two on.
    """

    name: str
    symbol: str
    kind: str
    arity: int
    associative: bool = False
    function: Callable[..., Any] | None = None


OPERATORS: Final[Mapping[str, Operator]] = {
    row.name: row
    for row in (
        Operator("add", "+", "number", 2, True, _add),
        Operator("multiply", "*", "number", 2, True, _multiply),
        Operator("divide", "/", "number", 2, False, _divide),
        Operator("floor_divide", "//", "number", 2, False, _floor_divide),
        Operator("modulo", "%", "number", 2, False, _modulo),
        Operator("power", "**", "number", 2, False, _power),
        Operator("negate", "-", "number", 1, False, lambda a: -a),
        Operator("absolute", "abs", "number", 1, False, abs),
        Operator("minimum", "min", "number", 2, True, min),
        Operator("maximum", "max", "number", 2, True, max),
        Operator("equal", "==", "equality", 2, False, lambda a, b: a == b),
        Operator("not_equal", "!=", "equality", 2, False, lambda a, b: a != b),
        Operator("less", "<", "order", 2, False, lambda a, b: a < b),
        Operator("less_equal", "<=", "order", 2, False, lambda a, b: a <= b),
        Operator("greater", ">", "order", 2, False, lambda a, b: a > b),
        Operator("greater_equal", ">=", "order", 2, False, lambda a, b: a >= b),
        Operator("and", "and", "logic", 2, True),
        Operator("or", "or", "logic", 2, True),
        Operator("not", "not", "logic", 1),
    )
}


FIELD: Final = frozenset({"add", "multiply", "divide", "power", "negate"})
"""The operators of a field."""


def _kind(value: Scalar) -> str:
    if isinstance(value, bool):
        return "a truth value"
    return "a number" if isinstance(value, Fraction) else "a name"


def _logic(name: str, values: Iterable[Scalar | Undefined]) -> bool | Undefined:
    decides = name == "or"
    for value in values:
        if isinstance(value, Undefined):
            return value
        if not isinstance(value, bool):
            return Undefined(f"'{name}' needs truth values, not {_kind(value)} ({describe(value)})")
        if name == "not":
            return not value
        if value is decides:
            return decides
    return not decides


def apply_operator(name: str, values: Iterable[Scalar | Undefined]) -> Scalar | Undefined:
    """The value of operator `name` on `values`; `Undefined` where it has none.

    `and` and `or` read from left to right and stop at the first value that decides.
    """
    row = OPERATORS[name]
    if row.kind == "logic":
        return _logic(name, values)
    arguments: list[Scalar] = []
    for value in values:
        if isinstance(value, Undefined):
            return value
        arguments.append(value)
    if name not in FIELD:
        for value in arguments:
            if isinstance(value, RationalFunction):
                names = ", ".join(value.parameters)
                return Undefined(
                    f"'{row.symbol}' of {describe(value)}, which depends on {names}: a parameter that "
                    "stays a symbol may stand in + - * / and integer powers only"
                )
    if row.kind == "equality":
        a, b = arguments
        if type(a) is not type(b):
            left, right = f"{_kind(a)} ({describe(a)})", f"{_kind(b)} ({describe(b)})"
            return Undefined(f"'{row.symbol}' compares {left} with {right}")
    else:
        for value in arguments:
            if not isinstance(value, Fraction):
                shown = f"{_kind(value)} ({describe(value)})"
                return Undefined(f"'{row.symbol}' needs numbers, not {shown}")
    function = row.function
    assert function is not None
    result: Scalar | Undefined
    if not row.associative:
        result = function(*arguments)
    else:
        result = arguments[0]
        for value in arguments[1:]:
            result = function(result, value)
            if isinstance(result, Undefined):
                return result
    return result
