"""The work of a reader, counted: its own counters hold, and they count what is done.

Readers count tokens, nodes and steps against limits, which no input may pass.  `watched` lowers them,
so that inputs of a few thousand bytes reach them.  That the counters count is checked by another: the
interpreter's calls of functions, which must stay below a multiple of what was counted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Final
from unittest.mock import patch

from factored_polca.formats import cassandra_layers, spudd_trees
from factored_polca.models import work

LIMIT: Final = 60_000
"""Steps that a reader may count for one input."""
SLACK: Final = 300_000
"""Steps beyond the limit that one act of counting may add: all values that a file counts."""
CALLS: Final = 120
"""Calls of the interpreter for each step or byte."""
CALLS_AT_LEAST: Final = 20_000


class WorkExceeded(BaseException):
    """More was done than counted, or counted than allowed."""

    def __init__(self, what: str, text: str) -> None:
        super().__init__(text)
        self.what = what


class _Counters:
    """The counters that were made while an input was read."""

    made: Final[list[Any]] = []

    def steps(self) -> int:
        """The sum of all counters."""
        return sum(counter.used for counter in self.made)


_COUNTERS: Final = _Counters()


@contextmanager
def watched() -> Iterator[None]:
    """Within it limits are lower, and each counter that is made is noted."""
    with ExitStack() as stack:
        for module in (spudd_trees, cassandra_layers, work):
            stack.enter_context(patch.object(module, "MAXIMUM_STEPS", LIMIT))
        stack.enter_context(patch.object(spudd_trees, "MAXIMUM_EXPANSION", LIMIT // 10))
        for kind in (spudd_trees.Forest, cassandra_layers.Steps, work.Work):
            stack.enter_context(patch.object(kind, "__init__", _noting(kind.__init__)))
        yield


def _noting(made: Callable[..., None]) -> Callable[..., None]:
    """A constructor that notes what it makes."""

    def init(self: Any, *arguments: Any, **named: Any) -> None:
        made(self, *arguments, **named)
        _COUNTERS.made.append(self)

    return init


@contextmanager
def counted(size: int, *, calls: bool) -> Iterator[None]:
    """Count the work of the block, on an input of `size` bytes; with `calls` the interpreter's calls too.

    Raises:
        WorkExceeded: after the block, if the work was too much.
    """
    _COUNTERS.made.clear()
    done = 0

    def count(frame: object, event: str, argument: object) -> None:
        nonlocal done
        done += 1

    if calls:
        sys.setprofile(count)
    try:
        yield
    finally:
        if calls:
            sys.setprofile(None)
        steps = _COUNTERS.steps()
        _COUNTERS.made.clear()
        if steps > LIMIT + SLACK:
            raise WorkExceeded(
                "a counter passed its limit", f"{steps} steps were counted, at most {LIMIT} are allowed"
            )
        if done > CALLS_AT_LEAST + CALLS * (steps + size):
            raise WorkExceeded(
                "more calls than counted work",
                f"{done} calls and returns for {steps} steps and {size} bytes",
            )
