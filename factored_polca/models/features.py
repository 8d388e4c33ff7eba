"""Features: the variables whose joint values are the states."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final

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
    if len(values) > FEW:
        return positions(values).get((isinstance(value, bool), value))
    for index, candidate in enumerate(values):
        if isinstance(candidate, bool) is isinstance(value, bool) and candidate == value:
            return index
    return None


FEW: Final = 8
"""Values among which a search is as quick as a table."""

_tables: OrderedDict[int, tuple[tuple[Value, ...], dict[tuple[bool, Value | Scalar], int]]] = OrderedDict()
_KEPT: Final = 256


def positions(values: tuple[Value, ...]) -> Mapping[tuple[bool, Value | Scalar], int]:
    """(whether it is a truth value, value) -> its index in `values`; the last tables are kept.

    They are found by the identity of `values`, which the entry keeps alive: hashing long tuples costs
    as much as a search.
    """
    found = _tables.get(id(values))
    if found is None:
        table: dict[tuple[bool, Value | Scalar], int] = {}
        for index, value in enumerate(values):
            table.setdefault((isinstance(value, bool), value), index)
        found = _tables[id(values)] = (values, table)
        if len(_tables) > _KEPT:
            _tables.popitem(last=False)
    return found[1]
