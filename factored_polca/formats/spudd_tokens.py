"""Tokens of SPUDD's language: words, numbers, brackets, operators, primes; `//` starts a comment.

A word is a run of letters, digits, `_`, `-` and `.` that is not a number.  SPUDD's own scanner takes
letters, digits and `_` only; Symbolic Perseus also takes `-` and `.` (Hoey et al. 1999; Poupart 2008).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.language import number

MAXIMUM_LENGTH: Final = 20_000_000
"""Characters in one file."""
MAXIMUM_NAME: Final = 255
"""Characters in one name."""

_TOKEN: Final = re.compile(
    r"""(?P<space>(?:\s+|//[^\n]*|\ufeff)+)
      | (?P<number>-?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?(?![\w.\-]))
      | (?P<word>\w[\w.\-]*)
      | (?P<symbol>[()\[\]'+*/$\#!:@-])""",
    re.VERBOSE,
)


@dataclass(frozen=True, slots=True)
class Token:
    """A piece of the text: its kind (number, word, symbol, end), the text and where it starts."""

    kind: str
    text: str
    start: int

    def __str__(self) -> str:
        return repr(self.text) if self.kind != "end" else "the end of the file"


class Tokens:
    """The text read from left to right, one token ahead of the reader."""

    def __init__(self, text: str) -> None:
        self.text = text
        if len(text) > MAXIMUM_LENGTH:
            raise self.error(f"a file of more than {MAXIMUM_LENGTH} characters", 0)
        self.token = self._scan(0)

    def _scan(self, start: int) -> Token:
        match = _TOKEN.match(self.text, start)
        if match is not None and match.lastgroup == "space":
            start = match.end()
            match = _TOKEN.match(self.text, start)
        if match is None:
            if start >= len(self.text):
                return Token("end", "", len(self.text))
            raise self.error(
                f"unexpected character {self.text[start]!r}", start,
                "names are made of letters, digits, '_', '-' and '.'",
            )  # fmt: skip
        kind = match.lastgroup or ""
        if kind == "word" and match.end() - start > MAXIMUM_NAME:
            raise self.error(f"a name of more than {MAXIMUM_NAME} characters", start)
        return Token(kind, match.group(), start)

    def fault(self, message: str, start: int, hint: str = "", severity: str = "error") -> Fault:
        """A fault at character `start` of the text."""
        line = self.text.count("\n", 0, start) + 1
        column = start - (self.text.rfind("\n", 0, start) + 1) + 1
        return Fault(message, hint=hint, line=line, column=column, severity=severity)

    def error(self, message: str, start: int | None = None, hint: str = "") -> ModelError:
        """The error for a fault at character `start`, by default at the next token."""
        return ModelError([self.fault(message, self.token.start if start is None else start, hint)])

    def take(self) -> Token:
        """The next token, which is passed."""
        token = self.token
        if token.kind != "end":
            self.token = self._scan(token.start + len(token.text))
        return token

    def at(self, text: str) -> bool:
        """Whether the next token is the symbol or word `text`."""
        return self.token.text == text and self.token.kind in ("symbol", "word")

    def accept(self, text: str) -> bool:
        """Pass the next token if it is `text`."""
        if self.at(text):
            self.take()
            return True
        return False

    def expect(self, text: str, where: str) -> None:
        """Pass the next token, which must be `text`.

        Raises:
            ModelError: it is not.
        """
        if not self.accept(text):
            raise self.error(f"expected {text!r} {where}, found {self.token}")

    def name(self, what: str, *, numeric: bool = False) -> Token:
        """Pass the next token, which must be a name (or, if `numeric`, a number used as one).

        Raises:
            ModelError: it is not.
        """
        if self.token.kind != "word" and not (numeric and self.token.kind == "number"):
            raise self.error(f"expected {what}, found {self.token}")
        return self.take()

    def number(self, what: str) -> Fraction:
        """Pass the next token, which must be a number; the exact rational that it denotes.

        Raises:
            ModelError: it is no number, or has too many digits.
        """
        token = self.token
        if token.kind != "number":
            raise self.error(f"expected {what}, found {token}")
        try:
            value = number(token.text)
        except ValueError as problem:
            raise self.error(str(problem)) from None
        self.take()
        return value
