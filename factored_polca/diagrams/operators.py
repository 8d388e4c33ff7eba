"""The table of binary operators: one row each, and one loop in the tests checks every row.

A row names the kernel's code, the leaf type it takes, its identities and absorbing elements (as
values), whether it commutes, what it gives on equal arguments, and its textbook definition.  As in
measure theory 0 times infinity is 0: what has probability 0 does not count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

from factored_polca.diagrams import apply as codes

Kind = Literal["field", "float", "boolean", "any"]


@dataclass(frozen=True)
class OperatorRow:
    """A binary operator; values are Python numbers, None where there is no such element.

    `same` is "argument" where op(a, a) = a, a number where it is that constant, None without a rule.
    `gives` is "same" for a result of the arguments' type and "boolean" for a condition.
    """

    name: str
    kind: Kind
    code: int
    definition: Callable[[Any, Any], Any]
    left_identity: float | None = None
    right_identity: float | None = None
    left_absorbing: float | None = None
    right_absorbing: float | None = None
    commutes: bool = False
    same: Literal["argument"] | float | None = None
    gives: Literal["same", "boolean"] = "same"


def _symmetric(
    name: str,
    kind: Kind,
    code: int,
    definition: Callable[[Any, Any], Any],
    identity: float | None = None,
    absorbing: float | None = None,
    same: Literal["argument"] | float | None = None,
) -> OperatorRow:
    return OperatorRow(
        name, kind, code, definition, identity, identity, absorbing, absorbing, True, same
    )  # fmt: skip


OPERATORS: Final[dict[tuple[str, Kind], OperatorRow]] = {
    (row.name, row.kind): row
    for row in (
        _symmetric("plus", "field", codes.FIELD_ADD, lambda a, b: a + b, 0),
        OperatorRow("minus", "field", codes.FIELD_SUBTRACT, lambda a, b: a - b, right_identity=0, same=0),
        _symmetric("times", "field", codes.FIELD_MULTIPLY, lambda a, b: a * b, 1, 0),
        _symmetric("plus", "float", codes.FLOAT_ADD, lambda a, b: a + b, 0),
        OperatorRow("minus", "float", codes.FLOAT_SUBTRACT, lambda a, b: a - b, right_identity=0),
        _symmetric("times", "float", codes.FLOAT_MULTIPLY, lambda a, b: a * b if a and b else 0.0, 1, 0),
        _symmetric("minimum", "float", codes.FLOAT_MINIMUM, min, same="argument"),
        _symmetric("maximum", "float", codes.FLOAT_MAXIMUM, max, same="argument"),
        OperatorRow("less", "float", codes.FLOAT_LESS, lambda a, b: a < b, same=0, gives="boolean"),
        _symmetric("and", "boolean", codes.AND, lambda a, b: a and b, 1, 0, "argument"),
        _symmetric("or", "boolean", codes.OR, lambda a, b: a or b, 0, 1, "argument"),
        _symmetric("xor", "boolean", codes.XOR, lambda a, b: a != b, 0, None, 0),
        OperatorRow(
            "difference", "boolean", codes.DIFFERENCE, lambda a, b: a and not b,
            right_identity=0, left_absorbing=0, same=0,
        ),
        OperatorRow(
            "equal", "any", codes.EQUAL, lambda a, b: a == b, commutes=True, same=1, gives="boolean"
        ),
    )
}  # fmt: skip
