"""The work that a text from a stranger may cause, counted: tokens read, arithmetic on long numbers.

Counting takes the place of a clock: the same text is read or refused on every machine.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Final

MAXIMUM_STEPS: Final = 20_000_000
"""Steps for one file."""
LONG: Final = 256
"""Bits of a number up to which an operation is one step; n times as many take n² steps."""


@dataclass(slots=True)
class Work:
    """The steps counted so far."""

    used: int = 0

    def count(self, steps: int) -> bool:
        """Count `steps`; whether the limit is kept."""
        self.used += steps
        return self.used <= MAXIMUM_STEPS

    @property
    def exceeded(self) -> bool:
        """Whether the limit is passed."""
        return self.used > MAXIMUM_STEPS


def steps_of(value: Fraction) -> int:
    """What an operation that gives `value` counts."""
    bits = max(value.numerator.bit_length(), value.denominator.bit_length())
    return 1 if bits <= LONG else (bits // LONG) ** 2
