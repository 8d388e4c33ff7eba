"""Which way to regress a large V: from the bottom up or from the top down, found by running both in turns.

Each gets slices of about equal time, twice as many in each turn, so that no more than some three times the
quicker one's time is spent; the winner of one pass is taken without a race in the next.
"""

from __future__ import annotations

from typing import Literal

from factored_polca.diagrams import Diagram, MemoryLimit
from factored_polca.diagrams.nodes import DONE, FULL, STEPS
from factored_polca.symbolic import NumericView
from factored_polca.symbolic.forward import ForwardRegression, looks_up
from factored_polca.symbolic.regression import NodeRegression

Way = Literal["up", "down"]

ENTRIES_PER_STEP = 8
"""Entries of vectors that take the time of one step of a weighted sum, as measured."""


class Race:
    """Regressions of the primitives of one process, remembering which way was quicker for each."""

    def __init__(self) -> None:
        self.ways: dict[int, Way] = {}

    def regress(self, numbers: NumericView, primitive: int, value: Diagram) -> Diagram | None:
        """The regression of V, or None where it is left to whoever does it from the bottom up.

        Raises:
            MemoryLimit, Aborted: see there.
        """
        way = self.ways.get(primitive)
        if way is None and not looks_up(numbers, primitive):
            way = self.ways[primitive] = "up"
        if way == "up" or value.is_constant:
            return None
        manager = numbers.manager
        manager.safe_point()
        down: ForwardRegression | None = None
        up: NodeRegression | None = None
        if way != "down":
            up = NodeRegression(numbers, numbers.prepared(primitive), value)
        slices = 1
        failure: MemoryLimit | None = None
        while True:
            if up is not None:
                try:
                    if self._up(up, slices):
                        self.ways[primitive] = "up"
                        return up.result
                except MemoryLimit as error:
                    up, failure = None, error
            if failure is None or up is None:
                if down is None:
                    down = ForwardRegression(numbers, primitive, value)
                try:
                    found = down.run(slices * STEPS * ENTRIES_PER_STEP)
                except MemoryLimit as error:
                    if up is None:
                        raise
                    down, failure = None, error
                else:
                    if found is not None:
                        self.ways[primitive] = "down"
                        return found
            manager.pause()
            slices *= 2

    def _up(self, regression: NodeRegression, slices: int) -> bool:
        """Some slices from the bottom up; whether it is done."""
        manager = regression.manager
        while slices > 0:
            code = regression.step()
            if code == DONE:
                return True
            manager.pause()
            if code == FULL:
                manager.grow()
            else:
                slices -= 1
        return False
