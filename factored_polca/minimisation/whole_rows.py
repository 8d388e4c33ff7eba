"""Whole rows modulo a prime, as diagrams: which row T_p(x, .) over the blocks each state x has.

The regression from the top down (`factored_polca.diagrams.forward`) of the partition itself ends with one
item for each distinct row: what of a unit of weight arrives at each block.  Numbered, the items are the
leaves of a diagram, constant on a block exactly where all rows of it are equal modulo the prime.  No value
is given to the blocks, so nothing is random.
"""

from __future__ import annotations

from collections.abc import Hashable

import numpy as np

from factored_polca.diagrams import INDEX, Diagram, MemoryLimit, choose, node_count, relabel
from factored_polca.diagrams.nodes import STEPS
from factored_polca.minimisation.criterion import Choice
from factored_polca.symbolic import NumericView
from factored_polca.symbolic.forward import ForwardRegression, looks_up


class WholeRows:
    """Rows over the leaves of `labels`, in the field of `numbers`; equal rows have one number, from 1.

    `outside` is a leaf that must not be reached (None: there is none).
    """

    def __init__(self, numbers: NumericView, labels: Diagram, leaves: int, outside: int | None) -> None:
        self.numbers, self.manager = numbers, labels.manager
        shifted = np.arange(1, leaves + 1, dtype=np.uint64)  # the way down leaves out leaves that are 0
        self.labels = relabel(labels, shifted, INDEX)
        self.outside = None if outside is None else outside + 1
        self.budget = max(STEPS, leaves * node_count(labels))
        self.known: dict[Hashable, int] = {}
        self.leaving: set[int] = set()
        self.found: dict[int, Diagram | None] = {}

    def of_primitive(self, primitive: int) -> Diagram | None:
        """x -> the number of T_p(x, .); None where that is not to be had from the top down.

        That is so where rows look down, where it takes more entries than there are blocks times nodes of
        the partition, which checks block by block would take, or where it takes too much memory.
        """
        if primitive not in self.found:
            self.found[primitive] = self._rows(primitive)
        return self.found[primitive]

    def _rows(self, primitive: int) -> Diagram | None:
        if not looks_up(self.numbers, primitive):
            return None
        self.manager.safe_point()
        try:
            forward = ForwardRegression(self.numbers, primitive, self.labels)
            spent = 0
            while not forward.advance(STEPS):
                self.manager.pause()
                spent += STEPS
                if spent > self.budget:
                    return None
        except MemoryLimit:
            return None
        rows = forward.whole_rows()
        numbers = [self.known.setdefault(row, len(self.known) + 1) for row in rows]
        if self.outside is not None:
            reached = forward.reached(self.outside)
            self.leaving.update(number for number, leaves in zip(numbers, reached, strict=True) if leaves)
        return forward.join(np.array(numbers, dtype=np.uint64), INDEX)

    def of_choice(self, choice: Choice, app: Diagram) -> Diagram | None:
        """x -> the number of T_c(x, .), 0 where the choice is not applicable; None as above."""
        zero = self.manager.constant(0)
        result = zero
        for primitive in choice.primitives:
            part = self.of_primitive(primitive)
            if part is None:
                return None
            result = choose(choice.where(primitive), part, result)
        return choose(app, result, zero)

    def leaves_restriction(self, rows: Diagram) -> bool:
        """Whether one of these rows reaches the leaf that must not be reached."""
        if not self.leaving:
            return False
        images = np.zeros(len(self.known) + 1, dtype=np.uint64)
        images[list(self.leaving)] = 1
        return relabel(rows, images, INDEX) != self.manager.constant(0)
