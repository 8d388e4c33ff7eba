"""Hard limits of a run: seconds on the clock, and the resident memory of all its processes together.

A run is a process and whatever that process started: its tree, known by who is whose parent.

    memory of a run  =  sum over the processes of its tree of the resident set (RSS)

Pages that several of them share count once for each, so that the sum is never too small.  On Linux the tree
and the sizes are read from /proc (`children` of each thread, `statm`: proc(5)), in some 50 microseconds a
run; elsewhere from the program `ps`.

`kill_tree` kills until nothing is left: a process that is started while others are killed is found in the
next look, and dead processes hold their numbers until their parent has waited for them, so that no number
is met twice.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from dataclasses import dataclass
from typing import Final

LOOKS: Final = 200
"""How often a tree is looked at while it is being killed."""

PAGE: Final = os.sysconf("SC_PAGE_SIZE")

BY_CHILDREN: Final = os.path.exists(f"/proc/self/task/{os.getpid()}/children")
"""Whether /proc tells the children of processes: Linux, as it is configured as a rule."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What a run may take; None: as much as it likes."""

    seconds: float | None = None
    memory_bytes: int | None = None


def children(process: int) -> list[int]:
    """The children of one process; none where it is gone."""
    if not BY_CHILDREN:
        return [number for number, parent, _ in _table() if parent == process]
    try:
        threads = os.listdir(f"/proc/{process}/task")
    except OSError:
        return []
    found: list[int] = []
    for thread in threads:
        with contextlib.suppress(OSError), open(f"/proc/{process}/task/{thread}/children", "rb") as file:
            found += map(int, file.read().split())
    return found


def descendants(root: int) -> list[int]:
    """The processes below `root`, parents before children, dead ones that nobody waited for included."""
    if not BY_CHILDREN:
        return _below(root, _table())
    found, at = [root], 0
    while at < len(found):
        found += children(found[at])
        at += 1
    return found[1:]


def resident_bytes(process: int) -> int:
    """The resident set of one process now; 0 where it is gone."""
    if not BY_CHILDREN:
        return sum(rss for number, _, rss in _table() if number == process)
    try:
        with open(f"/proc/{process}/statm", "rb") as file:
            return int(file.read().split()[1]) * PAGE
    except (OSError, IndexError, ValueError):
        return 0


def tree_bytes(root: int) -> int:
    """The resident memory of `root` and of all below it."""
    if not BY_CHILDREN:
        table = _table()
        below = {root, *_below(root, table)}
        return sum(rss for number, _, rss in table if number in below)
    return resident_bytes(root) + sum(map(resident_bytes, descendants(root)))


def session_of(process: int) -> int | None:
    """The number of the session that a process belongs to; None where it is gone."""
    try:
        return os.getsid(process)
    except OSError:
        return None


def process_space() -> str | None:
    """What process numbers mean here: the boot of the machine and the name space (Linux), else None."""
    try:
        with open("/proc/sys/kernel/random/boot_id", encoding="ascii") as file:
            return f"{file.read().strip()} {os.stat('/proc/self/ns/pid').st_ino}"
    except OSError:
        return None


def is_alive(process: int) -> bool:
    """Whether there is a process of that number."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def kill_tree(root: int, *, itself: bool = True) -> None:
    """Kill all below `root`, and `root` first if `itself`; whoever started `root` must wait for it."""
    if itself:
        _kill(root)
    for _ in range(LOOKS):
        left = [number for number in descendants(root) if not _is_dead(number)]
        if not left:
            return
        for number in left:
            _kill(number)
        time.sleep(0.001)


def _kill(process: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.kill(process, signal.SIGKILL)


def _is_dead(process: int) -> bool:
    """Whether a process has ended, waited for or not."""
    if not os.path.exists("/proc/self/stat"):
        return not is_alive(process)
    try:
        with open(f"/proc/{process}/stat", "rb") as file:
            return file.read().rpartition(b")")[2].split()[0] in (b"Z", b"X")
    except (OSError, IndexError):
        return True


# -- where /proc doesn't tell children -------------------------------------------------------------


def _table() -> list[tuple[int, int, int]]:
    """All processes as (number, parent, resident bytes), by the program `ps` (POSIX), without itself."""
    with subprocess.Popen(
        ["ps", "-A", "-o", "pid=,ppid=,rss="], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as ps:
        printed, _ = ps.communicate()
    rows = (line.split() for line in printed.splitlines())
    found = [(int(row[0]), int(row[1]), 1024 * int(row[2])) for row in rows if len(row) == 3]
    return [row for row in found if row[0] != ps.pid]


def _below(root: int, table: list[tuple[int, int, int]]) -> list[int]:
    found, at = [root], 0
    while at < len(found):
        found.extend(number for number, parent, _ in table if parent == found[at])
        at += 1
    return found[1:]
