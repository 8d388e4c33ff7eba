"""Features: the variables whose joint values are the states."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from factored_polca.models.expressions import Constant, Operators, Reference
from factored_polca.models.scalars import Scalar, Value, scalar


@dataclass(frozen=True)
class Feature(Operators):
    """A name and a finite ordered tuple of values: integers, truth values or names.

    `observed` features are known at every step (mixed observability).  A feature can be used in
    Python wherever an expression is expected, and in sympy expressions.

    >>> x = Feature("x", range(5))
    >>> str(x + 1 < 4)
    'x + 1 < 4'
    """

    name: str
    values: tuple[Value, ...]
    observed: bool = False

    def __init__(self, name: str, values: Iterable[Value], observed: bool = False) -> None:
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "values", tuple(values))
        object.__setattr__(self, "observed", observed)

    def __len__(self) -> int:
        return len(self.values)

    @property
    def now(self) -> Reference:
        """The feature in the present state."""
        return Reference(self.name)

    @property
    def next(self) -> Reference:
        """The feature in the next state."""
        return Reference(self.name, primed=True)

    @property
    def symbol(self) -> Any:
        """The feature in the present state as a sympy symbol."""
        return self.now._sympy_()

    def symbol_is(self, value: Value) -> Any:
        """The condition that the feature equals `value`, as a sympy relation."""
        import sympy

        return sympy.Eq(self.symbol, Constant(scalar(value))._sympy_())

    def index(self, value: Value | Scalar) -> int | None:
        """The position of `value` among the values, or None."""
        return position(self.values, value)


def boolean(name: str, observed: bool = False) -> Feature:
    """A feature with the values false and true, in this order."""
    return Feature(name, (False, True), observed)


def position(values: tuple[Value, ...], value: Value | Scalar) -> int | None:
    """The index of `value` in `values`, or None; `True` is not the number 1."""
    for index, candidate in enumerate(values):
        if isinstance(candidate, bool) is isinstance(value, bool) and candidate == value:
            return index
    return None
