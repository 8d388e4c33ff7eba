"""One run in a process of its own: it tells its stages and its result through a pipe, a JSON line each.

    {"stage": "minimising", "figures": {"blocks": 17}}     what is reached
    {"result": {"status": "ok", "message": "", "figures": {...}}}

The process that supervises it (`factored_polca.studies.warden`) holds the other end of the pipe.  Nothing
here knows of limits: a run that takes too much is killed from outside.

Kernels are compiled, or loaded from disk, before any run (`warm_kernels`).  What that has missed is
compiled in the run, and its seconds are told apart: `compile_seconds`, not in `seconds`.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import json
import os
import resource
import signal
import sys
import time
import traceback
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from factored_polca.studies.limits import resident_bytes

STAGE_SECONDS: Final = 0.05
"""Least time between two lines about the same stage."""

LONGEST_TEXT: Final = 2000
MOST_FIGURES: Final = 200

_PARENT_DEATH_SIGNAL, _SUBREAPER = 1, 36  # prctl(2)


# -- ahead of runs ---------------------------------------------------------------------------------


def warm_kernels(groups: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Compile, or load from disk, the kernels that kinds of runs need; seconds by what was warmed."""
    from factored_polca.hierarchy import warm
    from factored_polca.solvers import warm_pomdp

    seconds = {"diagrams": warm.warm_up()}
    for group in groups:
        solver = group.get("solver") or ("auto" if group["work"] == "solve" else "sarsop")
        unseen = group["work"] in ("plan", "solve") and group["unseen"]
        if not unseen or solver in ("vi", "pi", "mpi") or ":" in solver:
            continue
        staged = bool(group.get("staged")) and group["work"] == "solve"
        name = f"{solver}, finite horizon" if staged else solver
        if name not in seconds:
            seconds[name] = warm_pomdp.warm_up(solver, staged=staged)
    return seconds


# -- the process of a run --------------------------------------------------------------------------


class Teller:
    """Writes lines about a run, not too often."""

    def __init__(self, pipe: int) -> None:
        self._pipe, self._stage, self._next = pipe, "", 0.0
        self._figures: dict[str, Any] = {}

    def __call__(self, stage: str, /, **figures: Any) -> None:
        self._figures |= figures
        if stage == self._stage and time.monotonic() < self._next:
            return
        self._stage, self._next = stage, time.monotonic() + STAGE_SECONDS
        self.line({"stage": stage[:LONGEST_TEXT], "figures": plain(self._figures)})
        self._figures = {}

    def line(self, data: Mapping[str, Any]) -> None:
        """Write one line whole; a reader that has gone needs no more lines."""
        rest = memoryview(json.dumps(data).encode() + b"\n")
        with contextlib.suppress(BrokenPipeError):
            while rest:
                rest = rest[os.write(self._pipe, rest) :]


def live(request: Mapping[str, Any], pipe: int) -> None:
    """Do what `request` says, and tell through `pipe` what came of it."""
    tell = Teller(pipe)
    tell.line({"began": True, "base": resident_bytes(os.getpid())})
    tell.line({"result": result_of(request, tell)})


def result_of(request: Mapping[str, Any], tell: Teller) -> dict[str, Any]:
    """The status, a message and the figures of a run that has come to its end by itself."""
    from factored_polca.models import LimitReached, ModelError
    from factored_polca.studies.works import perform

    try:
        with watched_compiling() as compiling:
            figures = perform(request, tell)
        figures["compile_seconds"] = compiling.seconds
        if isinstance(figures.get("seconds"), float):
            figures["seconds"] = max(0.0, figures["seconds"] - compiling.seconds)
        return {"status": "ok", "message": "", "stage": "done", "figures": plain(figures)}
    except ModelError as error:
        return {"status": "error", "message": str(error)[:LONGEST_TEXT]}
    except MemoryError as error:
        return {"status": "memout", "message": f"no more memory was given: {error}"[:LONGEST_TEXT]}
    except LimitReached as error:
        return {"status": "error", "message": f"limit reached: {error}"[:LONGEST_TEXT]}
    except BaseException as error:
        message = f"{type(error).__name__}: {error}"[:LONGEST_TEXT]
        return {
            "status": "error",
            "message": message,
            "detail": traceback.format_exc()[-2 * LONGEST_TEXT :],
        }


class NoCompiling:
    """Nothing is compiled where numba is not loaded."""

    seconds = 0.0


@contextlib.contextmanager
def watched_compiling() -> Iterator[Any]:
    """Seconds of compiling inside; numba is not loaded for this."""
    if "numba" not in sys.modules:
        yield NoCompiling()
        return
    from factored_polca.solvers.compiled import watch_compiling

    with watch_compiling() as compiling:
        yield compiling


def plain(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Figures as plain data: numbers, truth values and texts of bounded length."""
    return {str(name)[:100]: plain_value(value) for name, value in list(figures.items())[:MOST_FIGURES]}


def plain_value(value: Any) -> Any:
    """One figure as plain data; what is no number and no text is told in words."""
    item = getattr(value, "item", None)
    if item is not None and getattr(value, "ndim", None) == 0:  # a number of numpy's
        value = item()
    if value is None or isinstance(value, (bool, float)):
        return value
    if isinstance(value, int):
        return value if abs(value) < 2**63 else str(value) if value.bit_length() < 13_000 else float("inf")
    return (value if isinstance(value, str) else repr(value))[:LONGEST_TEXT]


# -- the operating system --------------------------------------------------------------------------


def die_with_parent(parent: int) -> None:
    """Have this process killed when the thread that started it ends (Linux), or end if it has ended."""
    _prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def adopt_orphans() -> None:
    """Make this process the parent of what its descendants leave behind (Linux)."""
    _prctl(_SUBREAPER, 1)


def _prctl(option: int, value: int) -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0)


def offer_to_the_memory_killer() -> None:
    """Where the system runs out of memory, let it end a run rather than what supervises it (Linux)."""
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w", encoding="ascii") as file:
        file.write("500")


def leave_no_core() -> None:
    """Have no image of the memory written where a run crashes: it would be as large as the run."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def enter(parent: int, pipe: int) -> int:
    """Make a forked process a run's: its own session, no files of its parent's but `pipe`; the new number.

    Standard input is empty, standard output goes where the errors go.
    """
    signal.set_wakeup_fd(-1)
    for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_DFL)
    os.setsid()
    die_with_parent(parent)
    offer_to_the_memory_killer()
    leave_no_core()
    faulthandler.enable(2)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    kept = os.dup2(pipe, 3, inheritable=False) if pipe != 3 else 3
    os.closerange(4, os.sysconf("SC_OPEN_MAX"))
    return kept


def fresh_main(pipe: int, parent: int) -> None:
    """The process of a run that was not forked from a warm one: it warms kernels by itself first."""
    os.setsid()
    die_with_parent(parent)
    offer_to_the_memory_killer()
    leave_no_core()
    request = json.load(sys.stdin)
    if any(":" not in group["work"] for group in request["groups"]):
        warm_kernels(request["groups"])
    live(request, pipe)
    os._exit(0)
