"""Texts in SPUDD's and Symbolic Perseus' language, from its grammar (`factored_polca.formats.spudd`)."""

from __future__ import annotations

from .choices import Choices
from .pieces import chances, discount, name, number

VARIABLES = ("x", "y", "z")
VALUES = ("on", "off", "mid")
TREES = ("xon", "xoff", "SAMEx")

WORDS = tuple(
    text.encode()
    for text in (
        "(", ")", "[", "]", "'", "+", "*", "-", "/", "#", "!", "$", "//", "\n", "(variables (x on off))",
        "(observations",
        "(variables", "unnormalised", "unnormalized", "dd ", "enddd", "action ", "endaction", "observe",
        "endobserve",
        "cost", "reward", "discount", "tolerance", "horizon", "init", "belief", "SAMEx", "xon", "x'", "(x ",
        "(on ",
        "(1)", "(0)", "(0.5 0.5)", "[+ (1) (2)]", "[* ", "[# x' (1)]", "[/ (1) (0)]", "(" * 210,
        "[+ " * 210,
        "dd a [+ (a) (a)] enddd", "(x (on (x (on 1) (off 0))) (off 0))", "adjunct", "obsdd",
    )
)  # fmt: skip


def spudd_text(c: Choices) -> bytes:
    """A file."""
    names = VARIABLES[: 1 + c.below(3)]
    values = {word: VALUES[: 3 if c.rarely(8) else 2] for word in names}
    lines = ["(variables " + " ".join(_declared(c, word, values[word]) for word in names) + ")"]
    partial = c.below(2) == 1
    if partial:
        lines.append("(observations " + _declared(c, "o", VALUES[:2]) + ")")
    if c.below(2):
        lines.append("init " + ("(1)" if c.below(2) else _tree(c, names, 2, primed=False)))
    if c.rarely(6):
        lines.append("unnormalised")
    for k in c.some(0, 2):
        lines.append(f"dd {name(c, (f'd{k}',))} {_tree(c, names, 2)} enddd")
    for action in ("go", "stay")[: 1 + c.below(2)]:
        lines.append(f"action {name(c, (action,))}{' ' + number(c) if c.rarely(6) else ''}")
        for word in names:
            if not c.rarely(8):
                lines.append(f"  {name(c, (word,))} {_distribution(c, names, word, values[word], 2)}")
        if partial and not c.rarely():
            lines.append(f"  observe o {_distribution(c, names, 'o', VALUES[:2], 2)} endobserve")
        if c.below(2):
            lines.append("  cost " + _tree(c, names, 2))
        lines.append("endaction" if not c.rarely(30) else "")
    if c.below(3):
        lines.append("reward " + _tree(c, names, 3))
    lines.append(f"discount {discount(c)}")
    if c.rarely(4):
        lines.append(f"{c.one(('tolerance', 'horizon', 'discount', 'value'))} {number(c)}")
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def _declared(c: Choices, word: str, values: tuple[str, ...]) -> str:
    return f"({name(c, (word,))} {' '.join(name(c, (value,)) for value in values)})"


def _distribution(
    c: Choices, names: tuple[str, ...], target: str, values: tuple[str, ...], depth: int
) -> str:
    """A tree that mostly ends in rows over the target."""
    if depth and c.below(2):
        tested = name(c, names)
        prime = "'" if c.rarely(6) and tested != target else ""
        branches = " ".join(
            f"({name(c, (value,))} {_distribution(c, names, target, values, depth - 1)})"
            for value in VALUES[:2]
        )
        return f"({tested}{prime} {branches})"
    match c.below(6):
        case 0 if target != "o":
            return f"(SAME{target})"
        case 1 if target != "o":
            return f"({target}{values[0]})"
        case 2:
            row = zip(values, chances(c, len(values)), strict=True)
            return f"({target}' {' '.join(f'({value} ({q}))' for value, q in row)})"
        case 3 if c.rarely(3):
            return _tree(c, names, depth)
        case _:
            return "(" + " ".join(chances(c, len(values))) + ")"


def _tree(c: Choices, names: tuple[str, ...], depth: int, *, primed: bool = True) -> str:
    """A tree of numbers."""
    if not depth or c.ended:
        return f"({number(c)})" if c.below(3) else number(c)
    match c.below(6):
        case 0:
            symbol = c.one(("+", "*", "-", "+", "*", "/"))
            if c.rarely():
                return f"[# {name(c, names)}' {_tree(c, names, depth - 1, primed=primed)}]"
            parts = [_tree(c, names, depth - 1, primed=primed) for _ in range(2)]
            return f"[{symbol} {' '.join(parts)}]"
        case 1 if primed:
            return f"({name(c, (*TREES, 'd0') if c.rarely() else TREES)})"
        case 2:
            return f"({number(c)})"
        case _:
            prime = "'" if primed and c.rarely(4) else ""
            branches = " ".join(
                f"({name(c, (value,))} {_tree(c, names, depth - 1, primed=primed)})"
                for value in VALUES[: 2 if not c.rarely() else c.below(4)]
            )
            return f"({name(c, names)}{prime} {branches})"
