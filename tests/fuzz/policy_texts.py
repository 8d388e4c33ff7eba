"""Texts of the files .alpha and .pg, for arrays of two states, three actions and two observations."""

from __future__ import annotations

from .choices import Choices
from .pieces import name, number

ALPHA_WORDS = tuple(
    text.encode()
    for text in ("0", "1", "2", "-1", "\n", "\n\n", "\t", "0\n1 2\n", "nan", "1e9999", "#", "9" * 70)
)
GRAPH_WORDS = tuple(
    text.encode()
    for text in ("0", "1", "2", "-", "X", "\n", "0 0  0 0\n", "1 2  - X\n", "-1", "x", "1.0", "9" * 70)
)


def alpha_text(c: Choices) -> bytes:
    """Vectors."""
    lines = []
    for _ in c.some(1, 4):
        lines.append(str(c.below(3)) if not c.rarely(24) else name(c))
        lines.append(" ".join(number(c) for _ in range(2 if not c.rarely(12) else c.below(5))))
        lines.append("")
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def graph_text(c: Choices) -> bytes:
    """A policy graph."""
    count = 1 + c.below(4)
    lines = []
    for node in range(count):
        after = [
            c.one((*map(str, range(count)), "-", "X")) for _ in range(2 if not c.rarely(16) else c.below(5))
        ]
        first = str(node) if not c.rarely(24) else number(c)
        lines.append(f"{first} {c.below(3) if not c.rarely(24) else name(c)}  {' '.join(after)}")
    return "\n".join(lines).encode("utf-8", "surrogatepass")
