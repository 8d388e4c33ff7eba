"""TOML as untrusted text: loading it within bounds, and writing keys and strings.

`load` is `tomllib.loads` with three changes: a number with a point or an exponent stays the text
it was written as (`Decimal`), so that 0.95 is exactly 19/20; size, nesting and digits are bounded
before the parser sees the text; and every failure is a `ModelError` with line and column.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from typing import Any, Final

from factored_polca.models.errors import Fault, ModelError

MAXIMUM_CHARACTERS: Final = 64 * 2**20
"""Characters in one file."""
MAXIMUM_NESTING: Final = 32
"""Levels of arrays and inline tables, and parts of a dotted key."""
MAXIMUM_DIGITS: Final = 400
"""Digits of one number."""


@dataclass(frozen=True, slots=True)
class Decimal:
    """A TOML float as it was written, without `+` and `_`."""

    text: str


def decimal(text: str) -> Decimal:
    """What `tomllib` calls for a number with a point or an exponent, and for inf and nan."""
    return Decimal(text.replace("_", "").removeprefix("+"))


def load(text: str) -> dict[str, Any]:
    """The tables of `text`, whose line ends are `\\n`.

    Raises:
        ModelError: `text` is no TOML, or is beyond the caps.
    """
    _bounded(text)
    try:
        return tomllib.loads(text, parse_float=decimal)
    except tomllib.TOMLDecodeError as error:
        raise _syntax_error(text, str(error)) from None
    except (ValueError, RecursionError) as error:
        # tomllib lets Python's own limits through, for example on the digits of an integer
        raise _fault(text, 0, f"the text is beyond what can be read: {error}") from None


def _fault(text: str, offset: int, message: str, hint: str = "") -> ModelError:
    line = text.count("\n", 0, offset) + 1
    column = offset - (text.rfind("\n", 0, offset) + 1) + 1
    return ModelError([Fault(message, hint=hint, line=line, column=column)])


# Strings first, so that brackets, dots and digits inside them don't count.  An unclosed string runs
# to its end: whatever follows, the parser stops at it, and no second look is needed.
_PIECE: Final = re.compile(
    r'"""[^"\\]*(?:(?:\\.|"(?!""))[^"\\]*)*+(?:"{3,5}|\\?\Z)'
    r"|'''[^']*(?:'(?!'')[^']*)*+(?:'{3,5}|\Z)"
    r'|"[^"\\\n]*(?:\\.[^"\\\n]*)*"?'
    r"|'[^'\n]*'?"
    r"|\#[^\n]*"
    rf"|(?P<digits>[0-9][0-9_]{{{MAXIMUM_DIGITS},}})"
    r"|(?P<mark>[\[\]{}.\n=,])",
    re.DOTALL,
)


def _bounded(text: str) -> None:
    """Refuses a text that would take the parser's time, memory or stack."""
    if len(text) > MAXIMUM_CHARACTERS:
        raise _fault(text, 0, f"a text of {len(text)} characters; at most {MAXIMUM_CHARACTERS} are read")
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise _fault(text, error.start, "half of a surrogate pair, which is no character") from None
    depth = dots = 0
    for piece in _PIECE.finditer(text):
        mark = piece.group("mark")
        if piece.group("digits") is not None:
            raise _fault(text, piece.start(), f"a number of more than {MAXIMUM_DIGITS} digits")
        if mark is None:
            continue
        dots = dots + 1 if mark == "." else 0
        depth += (mark in "[{") - (mark in "]}" and depth > 0)
        if depth > MAXIMUM_NESTING or dots > MAXIMUM_NESTING:
            raise _fault(text, piece.start(), f"nested deeper than {MAXIMUM_NESTING} levels")


_PLACE: Final = re.compile(r"(.*?) \(at (?:line (\d+), column (\d+)|end of document)\)", re.DOTALL)
_QUOTE_KEY: Final = "quote a key that has other characters than A-Z a-z 0-9 _ -"
_HINTS: Final = {
    "Cannot overwrite a value": "a key may be given only once",
    "Cannot declare": "a table may be opened only once",
    "Cannot mutate immutable namespace": "a table in braces is complete: add the key inside them",
    "Invalid value": 'texts stand in quotes, as in reward = "2 * x"',
    "Invalid initial character for a key part": _QUOTE_KEY,
    "Expected '=' after a key": _QUOTE_KEY,
    "Unclosed array": "close it with ]",
    "Unclosed inline table": "close it with }; a table in braces stands on one line",
    "Unescaped '\\' in a string": "write \\\\, or use single quotes",
    "Expected newline or end of document after a statement": "one key on a line",
}


def _syntax_error(text: str, message: str) -> ModelError:
    match = _PLACE.fullmatch(message)
    if match is None:
        return ModelError([Fault(f"no TOML: {message}")])
    reason = match.group(1)
    hint = next((hint for start, hint in _HINTS.items() if reason.startswith(start)), "")
    if match.group(2) is None:
        return _fault(text, len(text), f"no TOML: {reason}", hint)
    line, column = int(match.group(2)), int(match.group(3))
    return ModelError([Fault(f"no TOML: {reason}", hint=hint, line=line, column=column)])


def toml_key(name: str) -> str:
    """`name` as a TOML key."""
    if re.fullmatch(r"[A-Za-z0-9_-]+", name):
        return name
    written = toml_string(name)
    return _basic(name) if written.startswith("'''") else written  # keys have no triple quotes


def toml_string(text: str) -> str:
    """`text` as a TOML string on one line, with as few escapes as can be."""
    plain = not re.search(r"[\x00-\x08\x0a-\x1f\x7f]", text)
    if plain and '"' not in text and "\\" not in text:
        return f'"{text}"'
    if plain and "'" not in text:
        return f"'{text}'"
    if plain and "'''" not in text and not text.startswith("'") and not text.endswith("'"):
        return f"'''{text}'''"
    return _basic(text)


def _basic(text: str) -> str:
    return '"' + "".join(_escaped(character) for character in text) + '"'


def toml_block(text: str) -> str:
    """`text` as a TOML string over several lines."""
    if "'''" not in text and not text.endswith("'") and not re.search(r"[\x00-\x08\x0b-\x1f\x7f]", text):
        return f"'''\n{text}'''"
    lines = ("".join(_escaped(character) for character in line) for line in text.split("\n"))
    return '"""\n' + "\n".join(lines) + '"""'


def _escaped(character: str) -> str:
    if character in '"\\':
        return "\\" + character
    if (ord(character) < 32 and character != "\t") or ord(character) == 127:
        return f"\\u{ord(character):04X}"
    return character
