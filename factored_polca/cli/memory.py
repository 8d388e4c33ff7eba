"""The memory that a command takes: the largest resident set of its process, and of those it started.

The diagrams count their bytes and stop by themselves.  What else grows (lists of states, quotients, sets
of vectors) is held by a backstop: the system is asked to give no more data than the limit allows, and an
allocation beyond it is an error that Python and its libraries report, where without it the system might
end the process.  Only growth counts, as libraries reserve much that they never touch.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager

SLACK_BYTES = 64 << 20
"""What the backstop leaves beyond the limit, and a sixteenth of it, so that gentler limits come first."""


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


def data_bytes() -> int | None:
    """What the process has reserved for data, touched or not; None where the system does not say."""
    try:
        with open("/proc/self/status", encoding="ascii", errors="replace") as file:
            return next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmData:"))
    except (OSError, StopIteration):
        return None


@contextmanager
def memory_backstop(limit: int | None) -> Iterator[None]:
    """Inside, allocations fail once the process has grown to `limit` bytes and some slack (Linux only)."""
    reserved = None if limit is None else data_bytes()
    if limit is None or reserved is None or sys.platform != "linux":
        yield
        return
    import scipy.linalg  # noqa: F401  its threads reserve memory when it is loaded

    before = resource.getrlimit(resource.RLIMIT_DATA)
    room = max(0, limit - current_memory_bytes()) + limit // 16 + SLACK_BYTES
    wanted = (data_bytes() or reserved) + room
    smallest = min((bound for bound in before if bound != resource.RLIM_INFINITY), default=wanted)
    resource.setrlimit(resource.RLIMIT_DATA, (min(wanted, smallest), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)
