"""Diagrams: immutable handles with operators.

A diagram is a function from the values of the manager's variables to leaves of one type.  Two
handles are equal (`==`) where they are the same function of one manager.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from factored_polca.diagrams.leaves import LeafType, describe
from factored_polca.drawn import DrawnGraph

if TYPE_CHECKING:
    from factored_polca.diagrams.manager import Manager


class Diagram(DrawnGraph):
    """A handle on a node; made by a `Manager` and by operations, never by hand."""

    __slots__ = ("__weakref__", "_slot", "leaf_type", "manager")

    def __init__(self, manager: Manager, slot: int, leaf_type: LeafType) -> None:
        self.manager = manager
        self._slot = slot
        self.leaf_type = leaf_type

    def __del__(self) -> None:
        try:  # noqa: SIM105 (called for each handle: no context manager)
            self.manager.release(self._slot)
        except AttributeError:  # Ctrl-C came before `__init__` had set them
            pass

    @property
    def node(self) -> int:
        """The node; valid until the next operation that may collect garbage."""
        return int(self.manager.roots[self._slot])

    @property
    def level(self) -> int:
        """The level of the top node; the number of levels for a constant."""
        return int(self.manager.pool[self.node])

    @property
    def is_constant(self) -> bool:
        """Whether the function has one value."""
        return self.level == self.manager.leaf_level

    @property
    def value(self) -> int | float:
        """The value of a constant, decoded.

        Raises:
            ValueError: not a constant.
        """
        if not self.is_constant:
            raise ValueError("the diagram is not constant")
        pool, node = self.manager.pool, self.node
        payload = (int(pool[node + 2]) & 0xFFFFFFFF) | ((int(pool[node + 3]) & 0xFFFFFFFF) << 32)
        return self.leaf_type.decode(payload)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Diagram):
            return NotImplemented
        same = self.manager is other.manager and self.leaf_type == other.leaf_type
        return same and self.node == other.node

    __hash__ = None  # type: ignore[assignment]

    def __reduce__(self) -> tuple[object, ...]:
        raise TypeError("diagrams are not pickled; use factored_polca.diagrams.dump and load")

    def _apply(self, name: str, other: Diagram) -> Diagram:
        from factored_polca.diagrams.operations import apply

        return apply(name, self, other)

    def __add__(self, other: Diagram) -> Diagram:
        return self._apply("plus", other)

    def __sub__(self, other: Diagram) -> Diagram:
        return self._apply("minus", other)

    def __mul__(self, other: Diagram) -> Diagram:
        return self._apply("times", other)

    def __and__(self, other: Diagram) -> Diagram:
        return self._apply("and", other)

    def __or__(self, other: Diagram) -> Diagram:
        return self._apply("or", other)

    def __xor__(self, other: Diagram) -> Diagram:
        return self._apply("xor", other)

    def __invert__(self) -> Diagram:
        return self._apply("xor", self.manager.constant(1))

    def equals(self, other: Diagram) -> Diagram:
        """The condition that both have the same value."""
        return self._apply("equal", other)

    def __repr__(self) -> str:
        kind = describe(self.leaf_type)
        if self.is_constant:
            return f"<Diagram: constant {self.value} ({kind})>"
        return f"<Diagram: top level {self.level}, {kind} leaves>"
