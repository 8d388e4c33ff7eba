"""Expressions of a PRISM program, given as numbered nodes, as expressions of ours.

Numbers are exact rationals; `/` is exact division, as in PRISM, where it gives a real number.

    PRISM                      here
    & | ! => <=> = != ?:       and, or, not, not a or b, ==, ==, !=, conditional
    mod(a, b)                  a % b, with the sign of b (the parser writes it as (a >= 0 ? a%b : a%b + b))
    floor(a), ceil(a)          a // 1, -(-a // 1)
    pow(a, b), min, max        a ** b, min, max

Constants of the program are replaced by what `names` gives for them: numbers and truth values, and
parameters of the model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any, Final

from factored_polca.models.errors import ModelError
from factored_polca.models.expressions import (
    ONE,
    Conditional,
    Constant,
    Expression,
    Operation,
    operation,
)
from factored_polca.models.language import MAXIMUM_DIGITS
from factored_polca.models.scalars import MAXIMUM_BITS

_NAMES: Final[Mapping[str, str]] = {
    "AND": "and", "OR": "or", "NOT": "not", "IFF": "equal", "XOR": "not_equal", "EQUAL": "equal",
    "NOT_EQUAL": "not_equal", "LESS": "less", "LESS_OR_EQUAL": "less_equal", "GREATER": "greater",
    "GREATER_OR_EQUAL": "greater_equal", "PLUS": "add", "TIMES": "multiply", "DIVIDE": "divide",
    "MIN": "minimum", "MAX": "maximum", "POWER": "power",
}  # fmt: skip
"""Operators that are one of ours."""


def number(text: str) -> Fraction:
    """A number such as -5 or 1/10.

    Raises:
        ModelError: it is too long.
    """
    over, _, under = text.partition("/")
    if max(len(over.lstrip("-")), len(under)) > MAXIMUM_DIGITS:
        raise ModelError(f"a number of more than {MAXIMUM_DIGITS} digits")
    if under and not int(under):
        raise ModelError("a number with the denominator 0")
    value = Fraction(int(over), int(under or 1))
    if max(value.numerator.bit_length(), value.denominator.bit_length()) > MAXIMUM_BITS:
        raise ModelError(f"a number of more than {MAXIMUM_BITS} bits")
    return value


def choose(condition: Expression, then: Expression, otherwise: Expression) -> Expression:
    """A conditional, its branch itself where the condition is known."""
    if isinstance(condition, Constant) and isinstance(condition.value, bool):
        return then if condition.value else otherwise
    return then if then == otherwise else Conditional(condition, then, otherwise)


class Translator:
    """The expressions behind nodes; each is made once, when it is asked for first."""

    def __init__(self, nodes: Sequence[tuple[Any, ...]], names: Callable[[str], Expression]) -> None:
        self._nodes, self._names = nodes, names
        self._made: dict[int, Expression] = {}

    def __call__(self, root: int) -> Expression:
        """The expression behind a node.

        Raises:
            ModelError: an operator or number that is not read, or what `names` raises.
        """
        stack = [root]
        while stack:
            index = stack[-1]
            if index in self._made:
                stack.pop()
                continue
            kind, *rest = self._nodes[index]
            waiting = [] if kind in ("int", "rational", "bool", "name") else rest
            waiting = [part for part in waiting if part not in self._made]
            if waiting:
                stack += waiting
                continue
            self._made[index] = self._make(index, kind, rest)
            stack.pop()
        return self._made[root]

    def _make(self, index: int, kind: str, rest: list[Any]) -> Expression:
        if kind in ("int", "rational"):
            return Constant(number(rest[0]))
        if kind == "bool":
            return Constant(bool(rest[0]))
        if kind == "name":
            return self._names(rest[0])
        parts = [self._made[part] for part in rest]
        if kind == "MINUS":
            return -parts[0] if len(parts) == 1 else parts[0] - parts[1]
        if kind == "IMPLIES":
            return logical("or", [logical("not", parts[:1]), parts[1]])
        if kind == "FLOOR":
            return operation("floor_divide", parts[0], ONE)
        if kind == "CEIL":
            return -operation("floor_divide", -parts[0], ONE)
        if kind == "MODULO":
            rest_of = operation("modulo", operation("absolute", parts[0]), operation("absolute", parts[1]))
            return choose(operation("less", parts[0], 0), -rest_of, rest_of)
        if kind == "ITE":
            modulo = self._modulo(index)
            return choose(*parts) if modulo is None else modulo
        name = _NAMES.get(kind)
        if name is None or len(parts) != (1 if name == "not" else 2):
            raise ModelError(f"the operator {kind[:40]!r} is not read")
        return logical(name, parts) if name in ("and", "or", "not") else operation(name, *parts)

    def _modulo(self, index: int) -> Expression | None:
        """`mod(a, b)`, if that is what a conditional was written as."""
        condition, then, otherwise = (self._nodes[part] for part in self._nodes[index][1:])
        if then[0] != "MODULO" or condition[0] != "GREATER_OR_EQUAL" or otherwise[0] != "PLUS":
            return None
        a, b = then[1:]
        if condition[1] != a or self._nodes[condition[2]] != ("int", "0"):
            return None
        if otherwise[1:] != (self._nodes[index][2], b):
            return None
        return operation("modulo", self._made[a], self._made[b])


def logical(name: str, parts: Sequence[Expression]) -> Expression:
    """`and`, `or`, `not`, with truth values that are known left out."""
    if name == "not":
        (part,) = parts
        return (
            part.arguments[0]
            if isinstance(part, Operation) and part.operator == "not"
            else operation("not", part)
        )
    decides = Constant(name == "or")
    kept = [part for part in dict.fromkeys(parts) if part != Constant(name == "and")]
    if decides in kept:
        return decides
    return operation(name, *kept) if kept else Constant(name == "and")
