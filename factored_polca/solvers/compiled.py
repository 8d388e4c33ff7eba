"""The solvers' one door to numba, typed.

Kernels take flat arrays, numbers and the named tuple `Arrays`, so that machine code is kept on disk and
loaded by the next process; no mutual recursion (it crashes when loaded from the cache).  numba does not
notice an edit in a *callee's* file: after editing kernels, empty `NUMBA_CACHE_DIR` or `__pycache__`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numba
from numba.core import event

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile `function` on first use and keep the machine code on disk."""
    return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def plain(function: Function) -> Function:
    """The Python function behind a kernel: for tiny problems, where compiling would take longest."""
    return cast(Function, getattr(function, "py_func", function))


class Compiling:
    """How long numba compiled (loading from disk not counted) since this began to watch."""

    def __init__(self, announce: Callable[[], None] | None) -> None:
        self.seconds = 0.0
        self._announce, self._depth, self._since = announce, 0, 0.0

    def notify(self, told: Any) -> None:
        """Take in that a compilation begins or ends; those of callees lie inside their callers'."""
        if told.is_start:
            if self._announce is not None:
                announce, self._announce = self._announce, None
                announce()
            if self._depth == 0:
                self._since = time.perf_counter()
            self._depth += 1
        elif self._depth:
            self._depth -= 1
            if self._depth == 0:
                self.seconds += time.perf_counter() - self._since


@contextmanager
def watch_compiling(announce: Callable[[], None] | None = None) -> Iterator[Compiling]:
    """Watch what is compiled inside `with`; `announce()` is called when the first compilation begins."""
    watcher = Compiling(announce)

    class Listener(event.Listener):
        def on_start(self, told: Any) -> None:
            watcher.notify(told)

        def on_end(self, told: Any) -> None:
            watcher.notify(told)

    events: Any = event  # without types
    listener = Listener()
    events.register("numba:compile", listener)
    try:
        yield watcher
    finally:
        events.unregister("numba:compile", listener)
