"""Choices read off a string of bytes; where it ends, every choice is the first.

So generators end, a shorter string makes a simpler input, and one string makes one input.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

T = TypeVar("T")


class Choices:
    """A string of bytes that decides."""

    __slots__ = ("_at", "_data")

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def below(self, count: int) -> int:
        """A number from 0 to count - 1."""
        value, at = 0, self._at
        size = 1 if count <= 64 else 2 if count <= 1 << 14 else 4
        value = int.from_bytes(self._data[at : at + size], "big")
        self._at = at + size
        return value % count

    def one(self, things: Sequence[T]) -> T:
        """One of `things`."""
        return things[self.below(len(things))]

    def rarely(self, of: int = 16) -> bool:
        """True in one of `of` cases; false where the string has ended."""
        return self.below(of) == of - 1

    def some(self, least: int, most: int) -> range:
        """A range over least to most numbers."""
        return range(least + self.below(most - least + 1))

    @property
    def ended(self) -> bool:
        """Whether the string has ended."""
        return self._at >= len(self._data)
