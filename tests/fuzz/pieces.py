"""Pieces that inputs are made of: numbers and names, sound ones and such as break naive readers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from .choices import Choices

NUMBERS: Final = (
    "0", "1", "0.5", "0.25", "0.75", "2", "3", "0.1", "0.9", "-1", "10", "0.0", "1.0", "1e-3", "-0.5",
    "100",
)  # fmt: skip
BAD_NUMBERS: Final = (
    "1e400", "1e401", "1e30000000", "1e-30000000", "-1e399", "0.33333", "0.3333333333333333", "1e", "e1",
    "inf",
    "-inf", "nan", "1_000", "0x10", "0b1", "٣", "½", "²", "--1", "+-1", "+1", "- 1", ".", ".5", "5.",
    "1.2.3", "00",
    "1/0", "9999999999999999999", "4294967296", "2147483647", "-9223372036854775809", "100001", "1e308",
    "1e309",
    "9" * 60, "9" * 401, "9" * 4500, "0." + "0" * 390 + "1", "0." + "3" * 500, "1e+0", "1E5",
    "0e999999999999",
)  # fmt: skip
NAMES: Final = ("x", "y", "z", "a", "b", "c", "s0", "s1", "on", "off", "left", "go")
BAD_NAMES: Final = (
    "", " ", "<script>alert(1)</script>", "<img src=x onerror=alert(1)>", "&lt;b&gt;", "&amp;", '"', "'",
    "`", "\\",
    "../../etc/passwd", "/etc/passwd", "..", "C:\\con", "a/b", "a b", "a\tb", "a\nb", "\x1b[2J\x1b[31mred",
    "\x9b2J",
    "\x07", "\x00", "\x7f", "\u202etxt.exe", "\u200b", "\u2028", "\ufeff", "é", "e\u0301", "日本",
    "\U0001f600", "%s%n",
    "{x}", "{0.__class__}", "${HOME}", "$(id)", "; rm -rf", "__class__", "__import__('os')", "true",
    "false",
    "none", "null", "nan", "0", "-1", "1.5", "state", "observation", "uniform", "identity", "else", "not",
    "and",
    "x'", "SAMEx", "x1", "-", "*", ":", "#", "//", "[", "]", "(", ")", "n" * 256, "n" * 3000,
)  # fmt: skip


def number(c: Choices) -> str:
    """A number, now and then one that is none or too large."""
    if c.rarely(60):
        return c.one(BAD_NUMBERS)
    return c.one(NUMBERS)


def discount(c: Choices) -> str:
    """A discount, now and then another number."""
    return number(c) if c.rarely(12) else c.one(("0.9", "0.95", "0.5"))


def name(c: Choices, known: Sequence[str] = NAMES) -> str:
    """One of the names `known`, now and then another or a trick."""
    if c.rarely(128):
        return c.one(BAD_NAMES)
    if c.rarely(64):
        return c.one(NAMES)
    return c.one(known)


def chances(c: Choices, count: int) -> list[str]:
    """`count` numbers that mostly sum to 1."""
    if c.rarely(24) or count < 1:
        return [number(c) for _ in range(count)]
    parts = [c.below(4) for _ in range(count)]
    total = sum(parts)
    if not total:
        parts[0] = total = 1
    left, found = 10_000, []
    for part in parts[:-1]:
        mine = min(left, 10_000 * part // total)
        left -= mine
        found.append(mine)
    return [f"{k / 10_000:g}" for k in [*found, left]]
