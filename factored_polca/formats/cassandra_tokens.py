"""Tokens of Cassandra's format: words, numbers, `:` and `*`; `#` starts a comment.

A word is a run of letters, digits, `_`, `-` and `.` that is not a number.  The original scanner has
words that begin with a letter, without `.` (Cassandra 1999).  A sign may stand apart from its number.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from typing import Final, NamedTuple

from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import Constant

MAXIMUM_LENGTH: Final = 40_000_000
"""Characters in one file."""
MAXIMUM_NAME: Final = 255
"""Characters in one name."""

_SPACE: Final = r"(?:\s+|#[^\n]*|\ufeff)*+"  # possessive: what follows never splits it anew
_UNSIGNED: Final = r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?(?![\w.\-])"
_GAP: Final = re.compile(_SPACE)
_TOKEN: Final = re.compile(
    rf"{_SPACE}(?:(?P<number>(?:[+-][ \t]*)?{_UNSIGNED})|(?P<word>\w[\w.\-]*)|(?P<symbol>[:*]))"
)
_INDEX: Final = re.compile(rf":{_SPACE}(\w[\w.\-]*|\*)")
_ONE: Final = re.compile(rf"[+-]?{_UNSIGNED}")
_LONGEST_RUN: Final = 1024
_HEADER: Final = re.compile(
    rf"(?:discount|values|states|actions|observations|start|[TOR]){_SPACE}:"
    rf"|start(?!\w){_SPACE}(?:include|exclude){_SPACE}:"
)


class Token(NamedTuple):
    """A piece of the text: its kind (number, word, symbol, end), the text and where it starts."""

    kind: str
    text: str
    start: int

    def __str__(self) -> str:
        if self.kind == "end":
            return "the end of the file"
        return repr(self.text if len(self.text) <= 40 else f"{self.text[:40]}...")


class Tokens:
    """The text read from left to right, one token ahead of the reader."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.token = Token("end", "", 0)
        if len(text) > MAXIMUM_LENGTH:
            raise self.error(f"a file of more than {MAXIMUM_LENGTH} characters", 0)
        self.token = self._scan(0)

    def _scan(self, start: int) -> Token:
        match = _TOKEN.match(self.text, start)
        if match is None:
            gap = _GAP.match(self.text, start)
            start = start if gap is None else gap.end()
            if start == len(self.text):
                return Token("end", "", start)
            raise self.error(
                f"unexpected character {self.text[start]!r}", start,
                "names are made of letters, digits, '_', '-' and '.'; '#' starts a comment",
            )  # fmt: skip
        kind = match.lastgroup or ""
        text = match.group(kind)
        if kind == "word" and len(text) > MAXIMUM_NAME:
            raise self.error(f"a name of more than {MAXIMUM_NAME} characters", match.start(kind))
        return Token(kind, text, match.start(kind))

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

    def at_header(self) -> bool:
        """Whether the next token begins a section or an entry, or is the end."""
        if self.token.kind == "end":
            return True
        return self.token.kind == "word" and _HEADER.match(self.text, self.token.start) is not None

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

    def after_colon(self) -> Token:
        """Pass the next token, a colon, and the one after it, which is given."""
        match = _INDEX.match(self.text, self.token.start)
        if match is None or len(match.group(1)) > MAXIMUM_NAME:
            self.take()
            return self.take()
        self.token = self._scan(match.end())
        return Token("index", match.group(1), match.start(1))

    def numbers(
        self, count: int, known: dict[str, Constant], value: Callable[[Token], Constant]
    ) -> list[Constant]:
        """Pass the next numbers, at most `count`; fewer where something else follows them.

        `value` gives what a number stands for, or raises; `known` is where it keeps its answers, by
        the text.
        """
        found: list[Constant] = []
        while len(found) < count and self.token.kind == "number":
            start = self.token.start
            run = _run(min(count - len(found), _LONGEST_RUN)).match(self.text, start)
            if run is None:  # a sign apart from its number
                found.append(value(self.take()))
                continue
            try:
                found += [known[text] for text in run.group().split()]
            except KeyError:
                for match in _ONE.finditer(self.text, start, run.end()):
                    found.append(value(Token("number", match.group(), match.start())))
            self.token = self._scan(run.end())
        return found


@cache
def _run(most: int) -> re.Pattern[str]:
    """At least one number and at most `most`, with white space between them."""
    return re.compile(rf"[+-]?{_UNSIGNED}(?:\s+[+-]?{_UNSIGNED}){{0,{most - 1}}}")
