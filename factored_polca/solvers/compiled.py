"""The solvers' one door to numba, typed.

Kernels take flat arrays, numbers and the named tuple `Arrays`, so that machine code is kept on disk and
loaded by the next process; no mutual recursion (it crashes when loaded from the cache).  numba does not
notice an edit in a *callee's* file: after editing kernels, empty `NUMBA_CACHE_DIR` or `__pycache__`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile `function` on first use and keep the machine code on disk."""
    return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))


def plain(function: Function) -> Function:
    """The Python function behind a kernel: for tiny problems, where compiling would take longest."""
    return cast(Function, getattr(function, "py_func", function))
