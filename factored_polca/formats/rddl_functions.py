"""The functions of RDDL's expressions, on rationals.

Where the value is rational it is exact.  Those of `exp`, `ln`, `log`, `sqrt` and `pow` mostly are not: they
are rounded to `DIGITS` significant decimal digits, so the relative error is below 10^(1 - DIGITS), and the
reader warns of it.  `round` goes to the nearest whole number, halves to the even one, as in pyRDDLGym.
"""

from __future__ import annotations

import decimal
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from factored_polca.models.scalars import Undefined, apply_operator

DIGITS: Final = 20
_LARGEST: Final = 200
"""Largest absolute value of the decimal exponent of an irrational result."""
_CONTEXT: Final = decimal.Context(
    prec=2 * DIGITS + 10, Emax=10**6, Emin=-(10**6), traps=[decimal.InvalidOperation, decimal.Overflow]
)


class NoValue(Exception):
    """A term that has no value, such as a division by zero."""


@dataclass(frozen=True, slots=True)
class Result:
    """A value, and whether it was rounded."""

    value: Fraction
    rounded: bool = False


def _decimal(value: Fraction) -> decimal.Decimal:
    return _CONTEXT.divide(decimal.Decimal(value.numerator), decimal.Decimal(value.denominator))


def _rounded(value: decimal.Decimal) -> Result:
    if value and abs(value.adjusted()) > _LARGEST:
        raise NoValue(f"a number beyond 10^{_LARGEST}")
    return Result(Fraction(decimal.Context(prec=DIGITS).plus(value)), True)


def _exponential(x: Fraction) -> Result:
    if x == 0:
        return Result(Fraction(1))
    if abs(x) > 3 * _LARGEST:
        raise NoValue(f"exp of {'' if x > 0 else '-'}{3 * _LARGEST} and beyond")
    return _rounded(_CONTEXT.exp(_decimal(x)))


def _logarithm(x: Fraction) -> Result:
    if x <= 0:
        raise NoValue("the logarithm of a number that is not positive")
    return Result(Fraction(0)) if x == 1 else _rounded(_CONTEXT.ln(_decimal(x)))


def _logarithm_to(x: Fraction, base: Fraction) -> Result:
    if x <= 0 or base <= 0 or base == 1:
        raise NoValue("log needs a positive number and a positive base that is not 1")
    for exponent in range(-64, 65):
        if base**exponent == x:
            return Result(Fraction(exponent))
    return _rounded(_CONTEXT.divide(_CONTEXT.ln(_decimal(x)), _CONTEXT.ln(_decimal(base))))


def _root(x: Fraction) -> Result:
    if x < 0:
        raise NoValue("the square root of a negative number")
    root = Fraction(math.isqrt(x.numerator), math.isqrt(x.denominator))
    return Result(root) if root * root == x else _rounded(_CONTEXT.sqrt(_decimal(x)))


def _power(x: Fraction, exponent: Fraction) -> Result:
    if exponent.denominator == 1:
        return Result(_operator("power", x, exponent))
    if x < 0 or (x == 0 and exponent < 0):
        raise NoValue("a power that is no real number")
    if x == 0:
        return Result(Fraction(0))
    if exponent == Fraction(1, 2):
        return _root(x)
    if abs(_CONTEXT.multiply(_decimal(exponent), _CONTEXT.ln(_decimal(x)))) > 3 * _LARGEST:
        raise NoValue(f"a number beyond 10^{_LARGEST}")
    return _rounded(_CONTEXT.power(_decimal(x), _decimal(exponent)))


def _operator(name: str, *arguments: Fraction) -> Fraction:
    result = apply_operator(name, arguments)
    if isinstance(result, Undefined):
        raise NoValue(result.reason)
    assert isinstance(result, Fraction)
    return result


def _truncated_remainder(a: Fraction, b: Fraction) -> Result:
    if not b:
        raise NoValue("division by zero")
    return Result(a - b * math.trunc(a / b))


def _exactly(function: Callable[..., Fraction | int]) -> Callable[..., Result]:
    return lambda *arguments: Result(Fraction(function(*arguments)))


FUNCTIONS: Final[Mapping[str, tuple[int, Callable[..., Result]]]] = {
    "abs": (1, _exactly(abs)),
    "sgn": (1, _exactly(lambda x: (x > 0) - (x < 0))),
    "round": (1, _exactly(round)),
    "floor": (1, _exactly(math.floor)),
    "ceil": (1, _exactly(math.ceil)),
    "div": (2, _exactly(lambda a, b: _operator("floor_divide", a, b))),
    "mod": (2, _exactly(lambda a, b: _operator("modulo", a, b))),
    "fmod": (2, _truncated_remainder),
    "pow": (2, _power),
    "exp": (1, _exponential),
    "ln": (1, _logarithm),
    "log": (2, _logarithm_to),
    "sqrt": (1, _root),
}
"""Name -> (number of arguments, function); `min` and `max` are operators."""


def applied(name: str, arguments: Sequence[Fraction]) -> Result:
    """The value of function `name`.

    Raises:
        NoValue: there is none.
    """
    try:
        return FUNCTIONS[name][1](*arguments)
    except (ArithmeticError, decimal.DecimalException) as error:
        raise NoValue(f"{name} has no value there ({type(error).__name__})") from None
