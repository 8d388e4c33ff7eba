"""Where things stand in a TOML text: a scan that maps key paths to lines and columns.

Python's `tomllib` gives values without their places, and an error without a place is little help.
`scan` walks over a text that `tomllib` has already accepted (TOML 1.0, toml.io) and records for
each key path where its key and its value begin.  Array elements are named by their index:
`reward = ["a", "b"]` has the paths ("reward",), ("reward", "0") and ("reward", "1").

Offsets count characters from 0; lines and columns count from 1.  The text has `\\n` line ends only.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

Path = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Place:
    """Offsets of a key, and of its value's content without the quotes; `quote` is how it is quoted.

    A table's content is its header's key; `quote` is empty for what is not a string.
    """

    key: int
    start: int
    end: int
    quote: str = ""


@dataclass(frozen=True)
class Positions:
    """The places of all keys of a TOML text."""

    text: str
    places: Mapping[Path, Place]
    newlines: tuple[int, ...]

    def line_column(self, offset: int) -> tuple[int, int]:
        """Line and column of the character at `offset`."""
        line = bisect_right(self.newlines, offset - 1)
        start = self.newlines[line - 1] + 1 if line else 0
        return line + 1, offset - start + 1

    def find(self, path: Path) -> Place | None:
        """The place of `path` or of the longest known path above it; None if there is none."""
        for length in range(len(path), 0, -1):
            if path[:length] in self.places:
                return self.places[path[:length]]
        return None

    def of_value(self, path: Path) -> tuple[int, int]:
        """Line and column of the first character of the value at `path`, (0, 0) if unknown."""
        place = self.find(path)
        return (0, 0) if place is None else self.line_column(place.start)

    def of_key(self, path: Path) -> tuple[int, int]:
        """Line and column of the key at `path`, (0, 0) if unknown."""
        place = self.find(path)
        return (0, 0) if place is None else self.line_column(place.key)

    def inside(self, path: Path, value: str, line: int, column: int) -> tuple[int, int]:
        """Where line `line`, column `column` of the string `value` at `path` stands in the file."""
        place = self.places.get(path)
        if place is None or not place.quote:
            return self.of_value(path)
        index = 0
        for _ in range(line - 1):
            index = value.find("\n", index) + 1
        return self.line_column(self._raw_offset(place, index + column - 1))

    def _raw_offset(self, place: Place, index: int) -> int:
        """The offset of character `index` of a decoded string; escapes are longer than what they mean."""
        if place.quote[0] == "'":
            return min(place.start + index, place.end)
        offset, decoded = place.start, 0
        for match in _ESCAPE.finditer(self.text, place.start, place.end):
            plain = match.start() - offset
            if decoded + plain > index:
                break
            length = 0 if _is_continuation(match.group()) else 1
            if decoded + plain == index and length:
                return match.start()
            decoded += plain + length
            offset = match.end()
        return min(offset + index - decoded, place.end)


def _is_continuation(escape: str) -> bool:
    """Whether `escape` is a backslash at the end of a line, which stands for nothing."""
    return escape[1] in " \t\n"


_ESCAPE: Final = re.compile(
    r"\\(?:[ \t]*\n[ \t\n]*|x[0-9a-fA-F]{2}|u[0-9a-fA-F]{4}|U[0-9a-fA-F]{8}|.)", re.DOTALL
)
_SHORT: Final = {"b": "\b", "t": "\t", "n": "\n", "f": "\f", "r": "\r", "e": "\x1b"}
_SPACE: Final = re.compile(r"[ \t]*")
_BLANK: Final = re.compile(r"(?:[ \t\n]+|#[^\n]*)*")
_BARE: Final = re.compile(r"[A-Za-z0-9_-]+")
_BASIC: Final = re.compile(r'"([^"\\\n]*(?:\\.[^"\\\n]*)*)"')
_LITERAL: Final = re.compile(r"'([^'\n]*)'")
_LONG_BASIC: Final = re.compile(r'\\.|"""("{0,2})', re.DOTALL)
_LONG_LITERAL: Final = re.compile(r"'''('{0,2})")
_SCALAR: Final = re.compile(r"[^,\]}\n#]+")


class _Stopped(Exception):
    """The text is not what `tomllib` accepts; what was found so far stands."""


def scan(text: str) -> Positions:
    """The places of all keys of `text`, which `tomllib` accepts and whose nesting is bounded.

    Never raises on other texts: it then holds what was found up to the first surprise.
    """
    scanner = _Scanner(text)
    with suppress(_Stopped):
        scanner.document()
    newlines = tuple(match.start() for match in re.finditer("\n", text))
    return Positions(text, scanner.places, newlines)


class _Scanner:
    def __init__(self, text: str) -> None:
        self.text = text
        self.at = 0
        self.places: dict[Path, Place] = {}
        self.counts: dict[Path, int] = {}  # arrays of tables: how many so far

    def skip(self, pattern: re.Pattern[str]) -> None:
        match = pattern.match(self.text, self.at)
        assert match is not None, "these patterns match the empty text"
        self.at = match.end()

    def take(self, pattern: re.Pattern[str]) -> re.Match[str]:
        match = pattern.match(self.text, self.at)
        if match is None:
            raise _Stopped
        self.at = match.end()
        return match

    def accept(self, symbol: str) -> bool:
        if self.text.startswith(symbol, self.at):
            self.at += len(symbol)
            return True
        return False

    def expect(self, symbol: str) -> None:
        if not self.accept(symbol):
            raise _Stopped

    def document(self) -> None:
        table: Path = ()
        self.skip(_BLANK)
        while self.at < len(self.text):
            if self.accept("["):
                table = self.header()
            else:
                self.pair(table)
            self.skip(_BLANK)

    def header(self) -> Path:
        double = self.accept("[")
        self.skip(_SPACE)
        keys = self.keys()
        self.expect("]]" if double else "]")
        path: Path = ()
        for depth, (name, start, end) in enumerate(keys):
            path = (*path, name)
            if double and depth == len(keys) - 1:
                index = self.counts[path] = self.counts.get(path, -1) + 1
                self.places.setdefault(path, Place(start, start, end))
                path = (*path, str(index))
            elif path in self.counts:
                path = (*path, str(self.counts[path]))
            self.places.setdefault(path, Place(start, start, end))
        return path

    def keys(self) -> list[tuple[str, int, int]]:
        """The parts of a dotted key, each with the offsets of its content."""
        parts = [self.key()]
        self.skip(_SPACE)
        while self.accept("."):
            self.skip(_SPACE)
            parts.append(self.key())
            self.skip(_SPACE)
        return parts

    def key(self) -> tuple[str, int, int]:
        if self.text.startswith('"', self.at):
            match = self.take(_BASIC)
            return _decode(match.group(1)), match.start(1), match.end(1)
        if self.text.startswith("'", self.at):
            match = self.take(_LITERAL)
            return match.group(1), match.start(1), match.end(1)
        match = self.take(_BARE)
        return match.group(), match.start(), match.end()

    def pair(self, table: Path) -> None:
        path, key = table, self.at
        for name, start, end in self.keys():
            path, key = (*path, name), start
            self.places.setdefault(path, Place(start, start, end))
        self.expect("=")
        self.skip(_SPACE)
        self.value(path, key)

    def value(self, path: Path, key: int) -> None:
        for quote, short, long in (('"', _BASIC, _LONG_BASIC), ("'", _LITERAL, _LONG_LITERAL)):
            if self.accept(3 * quote):
                self.accept("\n")
                start, end = self.at, self.long_end(long)
                self.places[path] = Place(key, start, end, 3 * quote)
                return
            if self.text.startswith(quote, self.at):
                match = self.take(short)
                self.places[path] = Place(key, match.start(1), match.end(1), quote)
                return
        start = self.at
        if self.accept("["):
            self.array(path)
        elif self.accept("{"):
            self.inline_table(path)
        else:
            self.take(_SCALAR)
        self.places[path] = Place(key, start, self.at)

    def long_end(self, closing: re.Pattern[str]) -> int:
        """Moves behind a multi-line string; the offset where its content ends."""
        for match in closing.finditer(self.text, self.at):
            if match.group(1) is not None:
                self.at = match.end()
                return match.start() + len(match.group(1))
        raise _Stopped

    def array(self, path: Path) -> None:
        index = 0
        self.skip(_BLANK)
        while not self.accept("]"):
            self.value((*path, str(index)), self.at)
            index += 1
            self.skip(_BLANK)
            if not self.accept(","):
                self.expect("]")
                return
            self.skip(_BLANK)

    def inline_table(self, path: Path) -> None:
        self.skip(_BLANK)
        while not self.accept("}"):
            self.pair(path)
            self.skip(_BLANK)
            if not self.accept(","):
                self.expect("}")
                return
            self.skip(_BLANK)


def _decode(raw: str) -> str:
    """The string that the inside of a quoted key denotes."""

    def one(match: re.Match[str]) -> str:
        code = match.group()[1:]
        if code[0] in "xuU" and len(code) > 1:
            return chr(int(code[1:], 16))
        return _SHORT.get(code, code)

    return _ESCAPE.sub(one, raw)
