"""The words of a policy file of pomdp-solve, each with its place; the text is not trusted."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from factored_polca.models.errors import Fault, ModelError

MAXIMUM_LENGTH: Final = 200_000_000
"""Characters of one file."""
LONGEST: Final = 60
"""Characters of one word."""

_WORD: Final = re.compile(r"\S+")
_INTEGER: Final = re.compile(r"[0-9]{1,9}\Z")
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,4})?\Z")


@dataclass(frozen=True)
class Word:
    """A word and where it stands, counted from 1."""

    text: str
    line: int
    column: int

    def error(self, message: str, hint: str = "") -> ModelError:
        """The error for a fault at this word."""
        return ModelError([Fault(message, hint=hint, line=self.line, column=self.column)])

    def shown(self) -> str:
        """The word as a message repeats it."""
        return repr(self.text if len(self.text) <= LONGEST else f"{self.text[:LONGEST]}...")

    def integer(self, what: str, count: int) -> int:
        """The number of one of `count` things, from 0.

        Raises:
            ModelError: it is none.
        """
        if not _INTEGER.match(self.text) or int(self.text) >= count:
            raise self.error(f"{self.shown()} is no {what}", f"{what}s are 0 to {count - 1}")
        return int(self.text)

    def number(self) -> float:
        """A finite number.

        Raises:
            ModelError: it is none.
        """
        value = float(self.text) if len(self.text) <= LONGEST and _NUMBER.match(self.text) else math.nan
        if not math.isfinite(value):
            raise self.error(f"{self.shown()} is no finite decimal number")
        return value


def lines_of(text: str) -> Iterator[list[Word]]:
    """The words of each line that has some.

    Raises:
        ModelError: a text of more than `MAXIMUM_LENGTH` characters.
    """
    if len(text) > MAXIMUM_LENGTH:
        raise ModelError([Fault(f"a file of more than {MAXIMUM_LENGTH} characters", line=1, column=1)])
    for number, line in enumerate(text.split("\n"), 1):
        words = [Word(m.group(), number, m.start() + 1) for m in _WORD.finditer(line)]
        if words:
            yield words
