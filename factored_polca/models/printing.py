"""Expressions as text: `to_text` writes what `factored_polca.models.language.parse` reads back."""

from __future__ import annotations

import re
from fractions import Fraction
from typing import Final

from factored_polca.models.errors import ModelError
from factored_polca.models.expressions import (
    Conditional,
    Constant,
    Expression,
    Lottery,
    Operation,
    Parameter,
    Reference,
    Switch,
    parts_first,
)
from factored_polca.models.language import KEYWORDS, MAXIMUM_LENGTH
from factored_polca.models.scalars import OPERATORS, Value

_LEVEL: Final = {
    "or": 2, "and": 3, "not": 4,
    "equal": 5, "not_equal": 5, "less": 5, "less_equal": 5, "greater": 5, "greater_equal": 5,
    "add": 6, "multiply": 7, "divide": 7, "floor_divide": 7, "modulo": 7, "negate": 8, "power": 9,
}  # fmt: skip
_ATOM: Final = 10


def number_text(value: Fraction) -> str:
    """`value` as a decimal where that is exact and short, else as a fraction."""
    if value.denominator == 1:
        return str(value.numerator)
    rest, twos, fives = value.denominator, 0, 0
    while rest % 2 == 0:
        rest, twos = rest // 2, twos + 1
    while rest % 5 == 0:
        rest, fives = rest // 5, fives + 1
    places = max(twos, fives)
    if rest != 1 or places > 20:
        return f"{value.numerator}/{value.denominator}"
    digits = str(abs(value.numerator) * 10**places // value.denominator).rjust(places + 1, "0")
    sign = "-" if value < 0 else ""
    return f"{sign}{digits[:-places]}.{digits[-places:]}"


def name_text(name: str) -> str:
    """A feature's, observation's or parameter's name as the language writes it."""
    if name not in KEYWORDS and re.fullmatch(r"[^\W\d]\w*", name):
        return name
    return f"`{name}`"


def value_text(value: Value) -> str:
    """A feature's value as the language writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return f'"{value}"' if isinstance(value, str) else str(value)


def _constant_text(value: Fraction | bool | str) -> tuple[str, int]:
    if isinstance(value, bool):
        return ("true" if value else "false"), _ATOM
    if isinstance(value, str):
        return f'"{value}"', _ATOM
    text = number_text(value)
    return text, (_LEVEL["divide"] if "/" in text else 8 if value < 0 else _ATOM)


def to_text(expression: Expression) -> str:
    """`expression` in the language; `parse` reads it back as an equal expression."""
    memo: dict[Expression, tuple[str, int]] = {}

    def wrap(e: Expression, least: int) -> str:
        text, level = memo[e]
        return text if level >= least else f"({text})"

    def render(e: Expression) -> tuple[str, int]:
        match e:
            case Constant():
                return _constant_text(e.value)
            case Reference():
                return name_text(e.name) + ("'" if e.primed else ""), _ATOM
            case Parameter():
                return name_text(e.name), _ATOM
            case Conditional():
                test, then = wrap(e.condition, 2), wrap(e.then, 2)
                return f"{then} if {test} else {wrap(e.otherwise, 1)}", 1
            case Switch():
                parts = [memo[e.reference][0]]
                parts += [f"{value_text(value)}: {memo[case][0]}" for value, case in e.cases]
                if e.otherwise is not None:
                    parts.append(f"else: {memo[e.otherwise][0]}")
                return f"switch({', '.join(parts)})", _ATOM
            case Lottery():
                pairs = (f"{memo[v][0]}: {memo[q][0]}" for v, q in e.outcomes)
                return "{" + ", ".join(pairs) + "}", _ATOM
            case Operation():
                return _operation_text(e, wrap)
        raise TypeError(f"{type(e).__name__} is no expression")

    for part in parts_first(expression):
        memo[part] = render(part)
        if len(memo[part][0]) > MAXIMUM_LENGTH:
            raise ModelError(f"an expression of more than {MAXIMUM_LENGTH} characters can't be written")
    return memo[expression][0]


def _operation_text(e: Operation, wrap: object) -> tuple[str, int]:
    show = wrap
    assert callable(show)
    name, symbol = e.operator, OPERATORS[e.operator].symbol
    if name in ("absolute", "minimum", "maximum"):
        return f"{symbol}({', '.join(show(a, 1) for a in e.arguments)})", _ATOM
    level = _LEVEL[name]
    if name in ("not", "negate"):
        return f"{symbol}{' ' if name == 'not' else ''}{show(e.arguments[0], level)}", level
    if name == "power":
        return f"{show(e.arguments[0], _ATOM)} ** {show(e.arguments[1], 8)}", level
    nested = isinstance(e.arguments[0], Operation) and e.arguments[0].operator == name
    if name == "add":
        text = show(e.arguments[0], level + nested)
        for part in e.arguments[1:]:
            shown = show(part, level + 1)
            minus = isinstance(part, Operation) and part.operator == "negate"
            if shown.startswith("-") and (minus or isinstance(part, Constant)):
                text += f" - {shown[1:]}"
            else:
                text += f" + {shown}"
        return text, level
    if level == 5:
        return f"{show(e.arguments[0], 6)} {symbol} {show(e.arguments[1], 6)}", level
    first = level if name in ("multiply", "divide", "floor_divide", "modulo") else level + 1
    if name == "multiply":
        first += nested
    parts = [show(e.arguments[0], first)] + [show(a, level + 1) for a in e.arguments[1:]]
    return f" {symbol} ".join(parts), level
