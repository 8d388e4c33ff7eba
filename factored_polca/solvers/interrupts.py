"""Ctrl-C at moments when it is not lost.

Python raises KeyboardInterrupt between any two of its instructions, those inside other people's libraries
included, and there it may come out as something else: `numpy.unique` with an axis compares structured
arrays by Python code that C code calls, which answers whatever goes wrong with a TypeError of its own.
So while a solver works, a Ctrl-C that comes outside this package waits for the next poll of a `Demand` or
a `StopRule`.  A second one does not wait.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

PACKAGE: Final = os.path.join(os.path.dirname(os.path.dirname(__file__)), "")


class _Held:
    """Whether a Ctrl-C waits: signal handlers have nowhere else to leave word."""

    waiting = False


@contextmanager
def interrupts_at_polls() -> Iterator[None]:
    """Let Ctrl-C wait, while inside, where a library might lose it.

    Nothing changes outside the main thread, or where SIGINT is not handled in Python's default way.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    _Held.waiting = False
    signal.signal(signal.SIGINT, _take)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _take(number: int, frame: FrameType | None) -> None:
    ours = frame is not None and frame.f_code.co_filename.startswith(PACKAGE)
    if not ours and not _Held.waiting:
        _Held.waiting = True
        return
    _Held.waiting = False
    raise KeyboardInterrupt


def held_interrupt() -> bool:
    """Whether a Ctrl-C waits; it does no longer."""
    waiting, _Held.waiting = _Held.waiting, False
    return waiting


def raise_held_interrupt() -> None:
    """Raise the KeyboardInterrupt that waits, if one does."""
    if held_interrupt():
        raise KeyboardInterrupt
