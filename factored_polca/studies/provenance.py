"""Where results come from: versions, commit, machine, date.

Each process that supervises runs tells this of itself, so that results of other machines carry their own
versions; the one that writes the store adds its arguments and its directory's commit.
"""

from __future__ import annotations

import os
import platform
import socket
import subprocess
import sys
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import factored_polca

LIBRARIES: Final = ("numpy", "numba", "scipy", "sympy", "networkx", "dd")


@cache
def versions() -> dict[str, str]:
    """The versions of the package, of Python, and of the libraries that compute."""
    found = {"factored_polca": factored_polca.__version__, "python": platform.python_version()}
    for name in LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = ""
    return found


@cache
def commit() -> str | None:
    """The git commit of the package's own repository, with "+" where files were changed; None without one.

    Only a repository whose top folder holds this package is asked, not one in which it happens to be
    installed.
    """
    top = Path(factored_polca.__file__).resolve().parent.parent
    if not (top / ".git").exists():
        return None
    try:
        found = _git(top, "rev-parse", "HEAD").strip()
        return found + ("+" if _git(top, "status", "--porcelain", "--untracked-files=no").strip() else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout


@cache
def machine() -> dict[str, Any]:
    """The machine's name, system, processor, cores and memory."""
    return {
        "host": socket.gethostname(),
        "system": f"{platform.system()} {platform.release()}",
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_bytes": memory_bytes(),
    }


def memory_bytes() -> int | None:
    """The bytes of memory that the machine has; None where it doesn't say."""
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return None


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            for line in file:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def provenance() -> dict[str, Any]:
    """Everything above, and this process."""
    return {
        "versions": versions(),
        "commit": commit(),
        "machine": machine(),
        "executable": sys.executable,
        "process": os.getpid(),
        "date": now(),
    }


def now() -> str:
    """The date and time now, in UTC, as ISO 8601 writes it."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
