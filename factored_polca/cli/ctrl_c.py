"""Ctrl-C that comes while C code calls Python.

There KeyboardInterrupt goes to `sys.unraisablehook` and no further: while numba compiles a kernel, LLVM
calls Python for each object that it has made, and lacks the object where that call was interrupted.  Here
such a Ctrl-C comes again a moment later, and an error in between counts as its consequence.
"""

from __future__ import annotations

import _thread
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

AGAIN: Final = 0.02
"""Seconds until a Ctrl-C that was lost comes again."""


@contextmanager
def ctrl_c_comes_again() -> Iterator[None]:
    """Inside, no Ctrl-C is lost.

    Raises:
        KeyboardInterrupt: in place of an error that follows a Ctrl-C which C code has swallowed.
    """
    before, waiting = sys.unraisablehook, list[threading.Timer]()

    def hook(told: UnraisableHookArgs) -> None:
        if told.exc_type is not KeyboardInterrupt:
            before(told)
            return
        timer = threading.Timer(AGAIN, _thread.interrupt_main)
        timer.daemon = True
        waiting.append(timer)
        timer.start()

    sys.unraisablehook = hook
    try:
        yield
    except Exception as error:
        pending = [timer for timer in waiting if timer.is_alive()]
        for timer in pending:
            timer.cancel()
        if pending:
            raise KeyboardInterrupt from error
        raise
    finally:
        sys.unraisablehook = before
