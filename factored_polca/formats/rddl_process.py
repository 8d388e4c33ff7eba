"""Parsing RDDL in a child process: strangers' text meets pyRDDLGym there, and only there.

`rddl_child` parses and checks the text under limits on memory, processor time and output; this side bounds
the wall time and the bytes that it reads, kills what exceeds them, and takes nothing but one JSON object.
No shell, no inherited environment, no temporary file.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import os
import selectors
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Final

from factored_polca.models.errors import Fault, ModelError

INSTALL: Final = "pip install 'factored-polca[rddl]'"


@dataclass(frozen=True, slots=True)
class Limits:
    """What the child may take."""

    memory_bytes: int = 2 << 30
    cpu_seconds: int = 60
    wall_seconds: float = 120.0
    output_bytes: int = 64 << 20


class ParseFault(Exception):
    """The text is at fault at the character numbered `offset` (-1: unknown)."""

    def __init__(self, message: str, offset: int) -> None:
        super().__init__(message)
        self.offset = offset


def parsed(text: str, limits: Limits | None = None) -> dict[str, Any]:
    """What `rddl_child` says of `text`.

    Raises:
        ParseFault: the text is not right.
        ModelError: pyRDDLGym is not installed, or a limit was reached.
    """
    limits = limits or Limits()
    output, status = _run(text.encode("utf-8"), limits, packages())
    if output is None:
        raise ModelError(f"parsing took longer than {limits.wall_seconds:g} s, the most that is allowed")
    found: Any = None
    with contextlib.suppress(ValueError, RecursionError):
        found = json.loads(output) if len(output) <= limits.output_bytes else {"limit": "output"}
    if not isinstance(found, dict) or "limit" in found:
        raise ModelError(_reached(found, status, limits))
    if "missing" in found:
        raise ModelError(_not_installed(f"pyRDDLGym can't be loaded: {str(found['missing'])[:200]}"))
    if "error" in found:
        offset = found.get("offset")
        raise ParseFault(str(found["error"])[:1000], offset if isinstance(offset, int) else -1)
    return found


def packages() -> str:
    """The folder that holds pyRDDLGym.

    Raises:
        ModelError: it is not installed.
    """
    spec = importlib.util.find_spec("pyRDDLGym")
    places = list(spec.submodule_search_locations or ()) if spec is not None else []
    if not places:
        raise ModelError(_not_installed("RDDL is parsed by pyRDDLGym, which is not installed"))
    return str(Path(places[0]).resolve().parent)


def _not_installed(message: str) -> list[Fault]:
    return [Fault(message, hint=INSTALL)]


def _reached(found: Any, status: int, limits: Limits) -> str:
    if isinstance(found, dict) and found.get("limit") == "output":
        return f"the parsed text takes more than {limits.output_bytes >> 20} MiB, the most that is read"
    if isinstance(found, dict):
        return (
            f"parsing takes more than {limits.memory_bytes >> 20} MiB of memory, the most that is allowed"
        )
    if status in (-24, -9):  # SIGXCPU, or SIGKILL after it
        return f"parsing took more than {limits.cpu_seconds} s of processor time, the most that is allowed"
    return (
        f"the parser stopped without an answer (status {status}): most likely it needed more than "
        f"{limits.memory_bytes >> 20} MiB of memory, the most that is allowed"
    )


def _run(data: bytes, limits: Limits, folder: str) -> tuple[bytes | None, int]:
    """The output of the child, None past the time limit, and its exit status."""
    command = [
        sys.executable, "-I", str(Path(__file__).with_name("rddl_child.py")), str(limits.memory_bytes),
        str(limits.cpu_seconds), str(limits.output_bytes), folder,
    ]  # fmt: skip
    environment = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PATH": os.defpath}
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        env=environment, close_fds=True,
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None
    feeder = threading.Thread(target=_feed, args=(process.stdin, data), daemon=True)
    feeder.start()
    try:
        output = _collect(process.stdout, limits)
        if output is not None:
            process.wait(timeout=5)
    except subprocess.TimeoutExpired:
        output = None
    finally:
        process.kill()
        process.wait()
        feeder.join(timeout=5)
        process.stdout.close()
    return output, process.returncode


def _feed(stream: IO[bytes], data: bytes) -> None:
    with contextlib.suppress(OSError, ValueError):
        stream.write(data)
    with contextlib.suppress(OSError, ValueError):
        stream.close()


def _collect(stream: IO[bytes], limits: Limits) -> bytes | None:
    """What the child writes, one byte more than allowed at most; None when time is up."""
    deadline = time.monotonic() + limits.wall_seconds
    parts: list[bytes] = []
    size = 0
    with selectors.DefaultSelector() as selector:
        selector.register(stream, selectors.EVENT_READ)
        while size <= limits.output_bytes:
            left = deadline - time.monotonic()
            if left <= 0 or not selector.select(left):
                return None
            part = os.read(stream.fileno(), 1 << 16)
            if not part:
                break
            parts.append(part)
            size += len(part)
    return b"".join(parts)
