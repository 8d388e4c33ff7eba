"""The one place where numba is touched by a decorator, typed.

Kernels get flat arrays and integers only, so that the compiled code can be cached on disk and loaded
by the next process.  They are iterative or call only kernels above them: numba's mutual recursion
crashes when loaded from its cache.  numba does not notice an edit in a *callee's* file: after
editing kernels, empty `NUMBA_CACHE_DIR` (or the `__pycache__` folders).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np

int64: Callable[[Any], int] = cast(Callable[[Any], int], np.int64)
"""`np.int64`, which kernels use for offsets, under the type that type checkers understand."""

Function = TypeVar("Function", bound=Callable[..., Any])

_njit: Any = numba.njit  # its types know no `_nrt`

KERNELS: list[Any] = []
"""Every compiled function that planning needs, in order of definition."""


def kernel(function: Function) -> Function:
    """Compile `function` on first use and keep the machine code on disk.

    Nothing calls kernels through C, so that no wrapper for it is compiled.
    """
    compiled = _njit(cache=True, error_model="numpy", no_cfunc_wrapper=True)(function)
    KERNELS.append(compiled)
    return cast(Function, compiled)


def lean_kernel(function: Function) -> Function:
    """A kernel that makes no arrays, and calls none that does.

    It counts no references to the arrays that it passes on, which took a fifth of the time where small
    kernels are called for every node.
    """
    compiled = _njit(cache=True, error_model="numpy", _nrt=False, no_cfunc_wrapper=True)(function)
    KERNELS.append(compiled)
    return cast(Function, compiled)


def late_kernel(function: Function) -> Function:
    """A kernel that few models need: it is compiled when it is called first, not ahead."""
    return cast(Function, _njit(cache=True, error_model="numpy", no_cfunc_wrapper=True)(function))


def late_lean_kernel(function: Function) -> Function:
    """A lean kernel that few models need."""
    return cast(
        Function, _njit(cache=True, error_model="numpy", _nrt=False, no_cfunc_wrapper=True)(function)
    )


def inner_kernel(function: Function) -> Function:
    """A lean kernel that only kernels call: Python can't."""
    compiled = _njit(
        cache=True, error_model="numpy", _nrt=False, no_cfunc_wrapper=True, no_cpython_wrapper=True
    )(function)
    KERNELS.append(compiled)
    return cast(Function, compiled)


def inline(function: Function) -> Function:
    """Compile `function`, which makes no arrays, into each kernel that calls it."""
    return cast(
        Function,
        _njit(
            forceinline=True,
            error_model="numpy",
            _nrt=False,
            no_cfunc_wrapper=True,
            no_cpython_wrapper=True,
        )(function),
    )


def compiled_before() -> bool:
    """Whether machine code of every kernel seen so far lies in numba's cache on disk."""
    for compiled in KERNELS:
        try:
            cache = compiled._cache
            path = os.path.join(cache._cache_path, cache._cache_file._index_name)
        except AttributeError:
            return False
        if not os.path.exists(path):
            return False
    return True


_TYPES: dict[str, Any] = {
    "Int32Array": numba.int32[::1],
    "Int64Array": numba.int64[::1],
    "UInt64Array": numba.uint64[::1],
    "FloatArray": numba.float64[::1],
    "Int32Table": numba.int32[:, ::1],
    "Int64Table": numba.int64[:, ::1],
    "int": numba.int64,
    "np.uint64": numba.uint64,
}


def compile_ahead(compiled: Any) -> None:
    """Compile a kernel for the arguments that its annotations name, without calling it.

    Raises:
        KeyError: an annotation that names no type known here.
    """
    annotations = dict(compiled.py_func.__annotations__)
    annotations.pop("return")
    compiled.compile(tuple(_TYPES[name] for name in annotations.values()))
