"""Functions that studies of the tests run: short ones, and ones that misbehave."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

MIB = 1 << 20


def square(n: int, seed: int) -> dict[str, Any]:
    """Done at once."""
    return {"square": n * n, "blocks": n}


def unhurried(n: int, seed: int) -> dict[str, Any]:
    """Done after a quarter of a second."""
    time.sleep(0.25)
    return {"square": n * n, "blocks": n}


def endless(seed: int) -> dict[str, Any]:
    """Never done; it computes."""
    while True:
        pass


def asleep(seed: int, started: str = "") -> dict[str, Any]:
    """Never done; it waits.  It writes its process number into a file."""
    if started:
        Path(started).write_text(str(os.getpid()))
    while True:
        time.sleep(3600)


def hungry(seed: int) -> dict[str, Any]:
    """Takes memory without end."""
    taken = []
    while True:
        taken.append(b"x" * (16 * MIB))


def hungry_children(seed: int) -> dict[str, Any]:
    """Three processes that take 80 MiB each, one of them detached from its parent."""
    program = f"import time; kept = b'x' * (80 * {MIB}); time.sleep(3600)"
    detach = f"import os\nif os.fork(): os._exit(0)\n{program}"
    for code in (program, program, detach):
        subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.DEVNULL)
    while True:
        time.sleep(3600)


def leaves_children(seed: int, started: str) -> dict[str, Any]:
    """Done at once, but what it has started goes on: one process in its session, one out of it."""
    program = f"import os, time; open({started!r}, 'a').write(f'{{os.getpid()}}\\n'); time.sleep(3600)"
    for apart in (False, True):
        subprocess.Popen([sys.executable, "-c", program], start_new_session=apart)
    while not Path(started).exists() or len(Path(started).read_text().split()) < 2:
        time.sleep(0.01)
    return {}


def broken(seed: int) -> dict[str, Any]:
    """Raises."""
    raise RuntimeError("it is <broken>")


def crashed(seed: int) -> dict[str, Any]:
    """Ends by a signal."""
    os.kill(os.getpid(), signal.SIGSEGV)
    return {}


def left(seed: int) -> dict[str, Any]:
    """Ends without a word."""
    os._exit(7)


def wordy(seed: int) -> Any:
    """Answers something else than figures."""
    return "nothing"
