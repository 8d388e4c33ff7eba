"""Inputs made from sound ones: bytes, tokens, numbers and lines are changed, files are spliced."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Final

from .choices import Choices
from .pieces import BAD_NAMES, BAD_NUMBERS

_TOKEN: Final = re.compile(rb"[0-9]+(?:\.[0-9]+)?|[A-Za-z_\x80-\xff][\w\x80-\xff]*|\s+|[^\w\s]|\w")
_NUMBER: Final = re.compile(rb"(?<![\w.])[0-9]+(?:\.[0-9]+)?(?![\w.])")
_WORD: Final = re.compile(rb"(?<![</\w])[A-Za-z_\x80-\xff][\w\x80-\xff]*")
_DIGITS: Final = re.compile(rb"[0-9]+(?:\.[0-9]+)?")
_TRICKS: Final = tuple(text.encode("utf-8", "surrogatepass") for text in (*BAD_NUMBERS, *BAD_NAMES))
_BYTES: Final = (
    b"\x00",
    b"\xff",
    b"\xc3",
    b"\xed\xa0\x80",
    b"\xef\xbb\xbf",
    b"\r",
    b"\r\n",
    b"\n",
    b"\t",
    b"\x80",
)
LONGEST: Final = 12_000
"""Bytes of an input."""


@lru_cache(maxsize=4096)
def tokens_of(data: bytes) -> tuple[bytes, ...]:
    """The tokens of a file; joined they are the file."""
    return tuple(_TOKEN.findall(data))


def mutated(c: Choices, corpus: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """A file of `corpus` with some changes; `words` are pieces of its format."""
    data = c.one(corpus)
    for _ in range(c.one((1, 1, 1, 2, 2, 3, 5))):
        data = c.one(_CHANGES)(c, data, corpus, words)
    return data[:LONGEST]


Change = Callable[[Choices, bytes, Sequence[bytes], Sequence[bytes]], bytes]


def _token(c: Choices, data: bytes, corpus: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """A token becomes a word of the format, a trick, or another token of the file."""
    parts = list(tokens_of(data))
    if not parts:
        return c.one(words)
    at = c.below(len(parts))
    match c.below(4):
        case 0:
            parts[at] = c.one(words)
        case 1:
            parts[at] = c.one(parts)
        case 2:
            parts[at] = c.one(_TRICKS)
        case _:
            parts[at : at + c.below(3)] = []
    return b"".join(parts)


def _similar(c: Choices, data: bytes, corpus: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """A word or number becomes another word or number of the file."""
    found = list((_NUMBER if c.below(2) else _WORD).finditer(data))
    if len(found) < 2:
        return data
    match = c.one(found)
    return data[: match.start()] + c.one(found).group() + data[match.end() :]


def _number(c: Choices, data: bytes, corpus: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """A number becomes another."""
    found = list(_DIGITS.finditer(data))
    if not found:
        return data
    match = c.one(found)
    new = c.one(found).group() if c.below(2) else c.one(BAD_NUMBERS).encode()
    return data[: match.start()] + new + data[match.end() :]


def _line(c: Choices, data: bytes, corpus: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """Lines are dropped, doubled, moved, or taken from another file."""
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    at = c.below(len(lines))
    match c.below(4):
        case 0:
            del lines[at : at + 1 + c.below(3)]
        case 1:
            lines.insert(at, lines[c.below(len(lines))])
        case 2:
            lines.insert(c.below(len(lines)), lines.pop(at))
        case _:
            other = c.one(corpus).splitlines(keepends=True)
            if other:
                first = c.below(len(other))
                lines[at:at] = other[first : first + 1 + c.below(4)]
    return b"".join(lines)


def _splice(c: Choices, data: bytes, corpus: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """The beginning of one file and the end of another."""
    other = c.one(corpus)
    return data[: c.below(len(data) + 1)] + other[c.below(len(other) + 1) :]


def _bytes(c: Choices, data: bytes, corpus: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """Bytes are put in, changed or cut out."""
    at = c.below(len(data) + 1)
    match c.below(4):
        case 0:
            return data[:at] + c.one(_BYTES) + data[at:]
        case 1:
            return data[:at] + bytes([c.below(256)]) + data[at + 1 :]
        case 2:
            return data[:at] + data[at + 1 + c.below(20) :]
        case _:
            return data[:at]


def _insertion(c: Choices, data: bytes, corpus: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """A word of the format or a trick is put in."""
    at = c.below(len(data) + 1)
    return data[:at] + (c.one(words) if c.below(3) else c.one(_TRICKS)) + data[at:]


def _repetition(c: Choices, data: bytes, corpus: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """A piece is repeated, now and then very often."""
    at = c.below(len(data) + 1)
    piece = data[at : at + 1 + c.below(30)]
    times = c.one((1, 1, 2, 3, 10, 100, 1000))
    return data[:at] + (piece * times)[:LONGEST] + data[at:]


def _renaming(c: Choices, data: bytes, corpus: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """A token becomes another wherever it stands."""
    parts = tokens_of(data)
    if not parts:
        return data
    old = c.one(parts)
    new = c.one(_TRICKS) if c.below(3) else c.one(parts)
    return b"".join([new if part == old else part for part in parts])


_CHANGES: Final[tuple[Change, ...]] = (
    _similar, _similar, _similar, _similar, _similar, _line, _line, _line, _number, _number, _token, _token,
    _renaming, _splice, _bytes, _insertion, _repetition,
)  # fmt: skip
