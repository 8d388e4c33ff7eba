"""The process that starts runs, watches over them, and ends them: one on each machine that runs some.

It is asked through its standard input and answers through its standard output, a JSON line each:

    {"groups": [...], ...}                  first: kinds of runs, whose kernels are made ready
    {"start": 7, "request": {...}}          start a run; many may be going on
    {"ready": {...}}                        the kernels are; what was loaded, in how long, on what machine
    {"done": 7, "outcome": {...}}           a run has ended, or was ended
    {"done": 7, "failed": "..."}            there is no process for it

Starting Python and loading the libraries and kernels takes a second or two; forking a process that has
done so takes some milliseconds.  So this one loads them, runs nothing itself, has one thread only (else
forking would not be safe: then each run starts a new Python), and forks for each run.

*Limits.*  Every `TICK` seconds each run's processes are looked at (`limits`).  One that has taken more than
its time or memory is killed with all that it has started, and recorded as `timeout` or `memout`.

*No orphans.*  Three things may die without a word.  A run's children: they become this process's children
(subreaper), count as the run's as long as they are in its session, and are killed otherwise.  This
process: the kernel then kills the runs (parent death signal).  Who asks: standard input ends, or the
parent is another one than before, or the process that writes the store, where that is another one on this
machine, is gone; then all runs are killed, and it ends.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import selectors
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from factored_polca.studies.limits import (
    BY_CHILDREN,
    Limits,
    children,
    is_alive,
    kill_tree,
    process_space,
    resident_bytes,
    session_of,
    tree_bytes,
)
from factored_polca.studies.provenance import now, provenance

TICK: Final = 0.01 if BY_CHILDREN else 0.25
IDLE_TICK: Final = 0.5
LINGER: Final = 5.0
"""Seconds that a run which has told its result may take to end."""
START_SECONDS: Final = 600.0
"""Seconds that a run may take to begin, where it must start Python and load kernels itself."""
KEPT_ERRORS: Final = 4000
"""Bytes kept of what a run prints."""
LONGEST_LINE: Final = 4 << 20


@dataclass
class Going:
    """A run that is going on."""

    number: int
    process: int
    pipe: int
    errors: int
    limits: Limits
    started: str
    began: float
    has_begun: bool
    base: int = 0
    peak: int = 0
    stage: str = "starting"
    figures: dict[str, Any] = field(default_factory=dict)
    buffer: bytes = b""
    printed: bytes = b""
    result: dict[str, Any] | None = None
    told: float = 0.0
    stop: tuple[str, str] | None = None  # status and message of one that was ended


class Warden:
    """Who supervises; see above."""

    def __init__(self, answers: int) -> None:
        self.answers, self.asker = answers, os.getppid()
        self.runs: dict[int, Going] = {}  # by process
        self.selector = selectors.DefaultSelector()
        self.groups: list[dict[str, Any]] = []
        self.forks = False
        self.asked = b""
        self.listening = True
        self.client: int | None = None  # another process for whom all this is done, on this machine

    # -- the loop --

    def serve(self) -> None:
        """Do what is asked until nobody asks any more."""
        os.set_blocking(0, False)
        self.selector.register(0, selectors.EVENT_READ, "asked")
        self.listen_for_deaths()
        swept = time.monotonic()
        while self.listening and os.getppid() == self.asker:
            for key, _ in self.selector.select(TICK if self.runs else IDLE_TICK):
                if key.data == "asked":
                    self.take_requests()
                elif key.data == "death":
                    with contextlib.suppress(BlockingIOError):
                        os.read(key.fd, 4096)
                else:
                    self.take_lines(key.data)
            for going in list(self.runs.values()):
                self.check(going)
            self.bury()
            if time.monotonic() - swept > 1:
                swept = time.monotonic()
                self.sweep()
                self.listening = self.listening and (self.client is None or is_alive(self.client))
        self.end()

    def listen_for_deaths(self) -> None:
        """Wake up when a child ends."""
        reading, writing = os.pipe()
        os.set_blocking(reading, False)
        os.set_blocking(writing, False)
        signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.signal(signal.SIGTERM, self.stop_listening)
        self.selector.register(reading, selectors.EVENT_READ, "death")

    def stop_listening(self, *_: object) -> None:
        """End soon."""
        self.listening = False

    def end(self) -> None:
        """Kill everything below."""
        kill_tree(os.getpid(), itself=False)

    def answer(self, data: Mapping[str, Any]) -> None:
        """Write one line; if nobody reads it, end."""
        rest = memoryview(json.dumps(data).encode() + b"\n")
        try:
            while rest:
                rest = rest[os.write(self.answers, rest) :]
        except BrokenPipeError:
            self.listening = False

    # -- what is asked --

    def take_requests(self) -> None:
        """Read what is asked, and do it."""
        while True:
            try:
                piece = os.read(0, 1 << 20)
            except BlockingIOError:
                break
            if not piece:
                self.listening = False
                return
            self.asked += piece
        *lines, self.asked = self.asked.split(b"\n")
        for line in lines:
            message = json.loads(line)
            if "groups" in message:
                if message["space"] is not None and message["space"] == process_space():
                    self.client = message["client"]
                self.prepare(message["groups"], message["fork"])
            else:
                self.start(message["start"], message["request"])

    def prepare(self, groups: list[dict[str, Any]], fork: bool) -> None:
        """Load libraries and kernels, once; runs are forked from here, where that is safe and wanted."""
        from factored_polca.studies import worker, works  # noqa: F401

        self.groups = groups
        seconds: dict[str, float] = {}
        if any(":" not in group["work"] for group in groups):
            with self.ending_with_asker():
                seconds = worker.warm_kernels(groups)
        threads = len(os.listdir("/proc/self/task")) if sys.platform == "linux" else 0
        self.forks = fork and threads == 1
        gc.collect()
        gc.freeze()
        self.answer({
            "ready": provenance() | {
                "warm_seconds": seconds,
                "forks": self.forks,
                "base_memory_bytes": resident_bytes(os.getpid()),
            }
        })  # fmt: skip

    @contextlib.contextmanager
    def ending_with_asker(self) -> Iterator[None]:
        """End at once where the asker does, while this process is busy and doesn't listen."""

        def look(*_: object) -> None:
            if os.getppid() != self.asker:
                self.end()
                os._exit(1)

        before = signal.signal(signal.SIGALRM, look)
        signal.setitimer(signal.ITIMER_REAL, 0.1, 0.1)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)

    def start(self, number: int, request: dict[str, Any]) -> None:
        """Start a run."""
        given = request["limits"]
        reading, writing = os.pipe()
        errors, errors_of_run = os.pipe()
        for end in (reading, errors):
            os.set_blocking(end, False)
        started, began = now(), time.monotonic()
        make = self.forked if self.forks else self.fresh
        try:
            process = make(request, writing, errors_of_run)
        except OSError as error:  # no memory for it, or too many processes
            os.close(reading)
            os.close(errors)
            self.answer({"done": number, "failed": f"no process could be started: {error}"})
            return
        finally:
            os.close(writing)
            os.close(errors_of_run)
        going = Going(
            number, process, reading, errors, Limits(given["seconds"], given["memory_bytes"]), started,
            began, has_begun=self.forks,
        )  # fmt: skip
        self.runs[process] = going
        self.selector.register(reading, selectors.EVENT_READ, going)
        self.selector.register(errors, selectors.EVENT_READ, going)

    def forked(self, request: dict[str, Any], pipe: int, errors: int) -> int:
        """A copy of this process that does the run."""
        from factored_polca.studies import worker

        warden = os.getpid()
        process = os.fork()
        if process:
            return process
        try:
            os.dup2(errors, 2)
            worker.live(request, worker.enter(warden, pipe))
            sys.stdout.flush()
            os._exit(0)
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(1)

    def fresh(self, request: dict[str, Any], pipe: int, errors: int) -> int:
        """A new Python that does the run."""
        program = (
            "import json, sys; sys.path[:] = json.loads(sys.argv[1]); from factored_polca.studies.worker "
            f"import fresh_main; fresh_main({pipe}, {os.getpid()})"
        )
        with tempfile.TemporaryFile() as file:
            file.write(json.dumps(request | {"groups": self.groups}).encode())
            file.seek(0)
            command = [sys.executable, "-P", "-c", program, json.dumps(sys.path)]
            made = subprocess.Popen(command, stdin=file, stdout=errors, stderr=errors, pass_fds=(pipe,))
            made.returncode = 0  # `bury` waits for it
        return made.pid

    # -- what runs tell --

    def take_lines(self, going: Going) -> None:
        """Read what a run tells and prints."""
        for end, is_pipe in ((going.pipe, True), (going.errors, False)):
            piece = self.read_all(end)
            if is_pipe:
                self.understand(going, piece)
            else:
                going.printed = (going.printed + piece)[-KEPT_ERRORS:]

    def read_all(self, end: int) -> bytes:
        """All that can be read now; an end that was closed is no longer listened to."""
        pieces: list[bytes] = []
        while sum(len(piece) for piece in pieces) < LONGEST_LINE:
            try:
                piece = os.read(end, 1 << 16)
            except BlockingIOError:
                break
            if not piece:
                with contextlib.suppress(KeyError):
                    self.selector.unregister(end)
                break
            pieces.append(piece)
        return b"".join(pieces)

    def understand(self, going: Going, piece: bytes) -> None:
        """Take in what a run tells."""
        *lines, rest = (going.buffer + piece).split(b"\n")
        going.buffer = rest[-LONGEST_LINE:]
        for line in lines:
            try:
                message = json.loads(line)
            except ValueError:
                continue  # a run has written into its pipe by itself
            if "result" in message:
                going.result, going.told = message["result"], time.monotonic()
            elif "began" in message:
                going.base = message["base"]
                if not going.has_begun:
                    going.began, going.has_begun = time.monotonic(), True
            elif "stage" in message:
                going.stage = message["stage"]
                going.figures |= message["figures"]

    # -- limits and ends --

    def check(self, going: Going) -> None:
        """End a run that has taken too much."""
        if going.stop is not None:
            return
        passed = time.monotonic() - going.began
        if going.has_begun:
            going.peak = max(going.peak, self.memory(going))
        most, longest = going.limits.memory_bytes, going.limits.seconds
        if most is not None and going.peak > most:
            going.stop = "memout", too_much(going.peak, most)
        elif going.result is None and longest is not None and going.has_begun and passed > longest:
            going.stop = "timeout", f"stopped after {longest:g} s"
        elif not going.has_begun and passed > START_SECONDS:
            going.stop = "error", f"it has not begun within {START_SECONDS:g} s"
        elif going.result is None or time.monotonic() - going.told < LINGER:
            return
        kill_tree(going.process)

    def memory(self, going: Going) -> int:
        """The resident bytes of all processes of a run, those included that lost their parent."""
        own = tree_bytes(going.process)
        if len(self.runs) == len(mine := children(os.getpid())):
            return own
        strays = (c for c in mine if c not in self.runs and session_of(c) == going.process)
        return own + sum(map(tree_bytes, strays))

    def bury(self) -> None:
        """Wait for children that have ended; tell of those that were runs."""
        while True:
            try:
                process, status, used = os.wait4(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if process == 0:
                return
            going = self.runs.pop(process, None)
            if going is None:
                continue
            seconds = time.monotonic() - going.began
            self.take_lines(going)
            for end in (going.pipe, going.errors):
                with contextlib.suppress(KeyError):
                    self.selector.unregister(end)
                os.close(end)
            self.sweep()
            factor = 1 if sys.platform == "darwin" else 1024
            going.peak = max(going.peak, used.ru_maxrss * factor)
            self.answer({
                "done": going.number,
                "outcome": {
                    **ending(going, status),
                    "started": going.started,
                    "finished": now(),
                    "wall_seconds": seconds,
                    "cpu_seconds": used.ru_utime + used.ru_stime,
                    "peak_memory_bytes": going.peak,
                    "base_memory_bytes": going.base,
                },
            })  # fmt: skip

    def sweep(self) -> None:
        """Kill children that no run knows any more: their run has ended, or they have left its session."""
        for child in children(os.getpid()):
            if child not in self.runs and session_of(child) not in self.runs:
                kill_tree(child)


def ending(going: Going, status: int) -> dict[str, Any]:
    """How a run has ended: status, message, stage and figures."""
    most = going.limits.memory_bytes
    result = going.result or {}
    reached = {"stage": going.stage, "figures": going.figures | result.get("figures", {})}
    said = going.printed.decode("utf-8", "replace").strip()
    detail = result.get("detail", "") or said
    if going.stop is not None:
        return reached | {"status": going.stop[0], "message": going.stop[1], "detail": said}
    if most is not None and going.peak > most:
        return reached | {"status": "memout", "message": too_much(going.peak, most), "detail": said}
    if result:
        reached["stage"] = result.get("stage", going.stage)
        return reached | {"status": result["status"], "message": result["message"], "detail": detail}
    return reached | {"status": "error", "message": death(status), "detail": said}


def too_much(peak: int, most: int) -> str:
    """The message of a run that took too much memory."""
    return f"its processes took {peak / 2**20:,.0f} MiB; the limit is {most / 2**20:,.0f} MiB"


def death(status: int) -> str:
    """How a process has ended that told no result."""
    code = os.waitstatus_to_exitcode(status)
    if code == -signal.SIGKILL:
        return "killed from outside the study (SIGKILL): perhaps the machine was out of memory"
    if code < 0:
        return f"ended by the signal {signal.Signals(-code).name}"
    return f"ended with the exit status {code} and without a result"


def main() -> None:
    """Serve; standard output is for answers only, whatever libraries print."""
    from factored_polca.studies.worker import adopt_orphans

    answers = os.dup(1)
    os.dup2(2, 1)
    adopt_orphans()
    warden = Warden(answers)
    try:
        warden.serve()
    finally:
        warden.end()
