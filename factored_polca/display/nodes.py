"""A diagram as plain lists, for walks in Python: nodes numbered children first, the root last."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from factored_polca.diagrams import Diagram, dump


@dataclass(frozen=True)
class Nodes:
    """`levels`, `children` (none for leaves) and `leaves` (the value, None for others), all by node."""

    levels: tuple[int, ...]
    children: tuple[tuple[int, ...], ...]
    leaves: tuple[int | float | None, ...]

    @property
    def root(self) -> int:
        """The number of the root."""
        return len(self.levels) - 1

    @cached_property
    def support(self) -> tuple[int, ...]:
        """The levels that are tested, the top one first."""
        inner = {level for level, below in zip(self.levels, self.children, strict=True) if below}
        return tuple(sorted(inner))

    def groups(self, node: int) -> list[tuple[int, tuple[int, ...]]]:
        """The different children of a node, each with the values that lead to it."""
        found: dict[int, list[int]] = {}
        for value, child in enumerate(self.children[node]):
            found.setdefault(child, []).append(value)
        return [(child, tuple(values)) for child, values in found.items()]


def read_nodes(diagram: Diagram) -> Nodes:
    """The nodes of a diagram."""
    arrays = dump(diagram)
    manager, kind = diagram.manager, diagram.leaf_type
    levels = tuple(arrays["levels"].tolist())
    flat, stored = arrays["children"].tolist(), iter(arrays["leaves"].tolist())
    children: list[tuple[int, ...]] = []
    leaves: list[int | float | None] = []
    place = 0
    for level in levels:
        if level == manager.leaf_level:
            children.append(())
            leaves.append(kind.decode(int(next(stored))))
        else:
            size = manager.sizes[level]
            children.append(tuple(flat[place : place + size]))
            leaves.append(None)
            place += size
    return Nodes(levels, tuple(children), tuple(leaves))
