"""The memory that a command takes: the largest resident set of its process, and of those it started."""

from __future__ import annotations

import resource
import sys


def peak_memory_bytes(*, children: bool = False) -> int:
    """The largest resident set of this process so far; with `children` that of any that it waited for."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if children:
        peak = max(peak, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
    return peak if sys.platform == "darwin" else peak * 1024


def current_memory_bytes() -> int:
    """The resident set now, or its peak where the system does not say."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * resource.getpagesize()
    except OSError:
        return peak_memory_bytes()


def memory_text(peak_bytes: int) -> str:
    """An amount of memory for people."""
    return f"{peak_bytes / 2**20:,.0f} MiB"
