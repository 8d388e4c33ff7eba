"""Numbers as decimals, for formats that have no others: exact where that is possible, rows that sum to 1.

A rational with a finite decimal expansion is written exactly, another one with `DIGITS` significant digits.
In a row of probabilities what rounding leaves of 1 is added to the largest, so that the decimals that are
written sum to exactly 1: a reader of exact numbers finds nothing to divide out.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Context, Decimal
from fractions import Fraction
from typing import Final

from factored_polca.formats.spudd_text import MAXIMUM_DIGITS, decimal_text

DIGITS: Final = 17
"""Significant digits of a rounded number: enough for every double."""

FLOAT_DIGITS: Final = 15
"""Significant digits of a probability that was computed with floats: those that any decimal keeps."""

_ROUNDED: Final = Context(prec=DIGITS)
_EXACT: Final = Context(prec=2 * MAXIMUM_DIGITS)


def number_text(value: Fraction) -> str:
    """`value` as a decimal; exact if it has a finite expansion of at most 400 characters."""
    return decimal_text(value) or _text(_rounded(value))


def row_texts(chances: Sequence[Fraction]) -> list[str]:
    """Probabilities that sum to 1 as decimals that sum to 1."""
    texts = [decimal_text(chance) for chance in chances]
    exact = [text for text in texts if text is not None]
    if len(exact) == len(texts):
        return exact
    return _closed([_rounded(chance) for chance in chances])


def float_row_texts(chances: Sequence[float]) -> list[str]:
    """Floats that sum to about 1 as decimals of `FLOAT_DIGITS` digits that sum to exactly 1.

    Floats have been through products and sums: 0.9 * 0.05 / 0.9 is 0.05 but for the last digits, which
    are left out.  What is written is read and written again as the same decimals.
    """
    return _closed([Decimal(f"{chance:.{FLOAT_DIGITS}g}") for chance in chances])


def float_text(value: float) -> str:
    """The shortest decimal that is read back as `value`."""
    return _text(Decimal(repr(value)))


def _rounded(value: Fraction) -> Decimal:
    return _ROUNDED.divide(Decimal(value.numerator), Decimal(value.denominator))


def _closed(numbers: list[Decimal]) -> list[str]:
    total = Decimal(0)
    for number in numbers:
        total = _EXACT.add(total, number)
    largest = max(range(len(numbers)), key=numbers.__getitem__)
    numbers[largest] = _EXACT.add(numbers[largest], _EXACT.subtract(Decimal(1), total))
    return [_text(number) for number in numbers]


def _text(number: Decimal) -> str:
    if number == 0:
        return "0"
    if number == number.to_integral_value() and abs(number) < 10**15:
        return str(int(number))
    return str(number)
