"""Which way to regress a large V: from the bottom up or from the top down, found by running both in turns.

The way down begins with a short try.  Then each gets slices of about equal time, twice as many in each
turn, so that no more than some three times the quicker one's time is spent.  The winner of one pass is
taken without a race in the next.
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


SHORT_TRY = 64
"""Entries for each node of V that the way down may take before there is a race."""


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
        start = ForwardRegression(numbers, primitive, value)
        down: ForwardRegression | None = start
        up: NodeRegression | None = None
        failure: MemoryLimit | None = None
        if way != "down":
            try:
                found = start.run(SHORT_TRY * start.nodes)
            except MemoryLimit as error:
                down, failure, found = None, error, None
            if found is not None:
                self.ways[primitive] = "down"
                return found
            up = NodeRegression(numbers, numbers.prepared(primitive), value)
        slices = 1
        while True:
            if up is not None:
                try:
                    if self._up(up, slices):
                        self.ways[primitive] = "up"
                        return up.result
                except MemoryLimit as error:
                    up, failure = None, error
            if down is not None:
                try:
                    found = down.run(slices * STEPS * ENTRIES_PER_STEP)
                except MemoryLimit as error:
                    down, failure = None, error
                else:
                    if found is not None:
                        self.ways[primitive] = "down"
                        return found
            if up is None and down is None:
                assert failure is not None
                raise failure
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
