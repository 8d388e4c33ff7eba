"""Asking a warden (`factored_polca.studies.warden`) for runs: each is a future of its outcome.

A `Warden` here is the near end of the process that supervises.  Threads may share it.  When it dies its
futures fail with `WorkerLost`; when this process dies, however, the warden ends all runs and itself.

`run_here` is what executors call on other machines: it keeps one warden for the process it is called in.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from typing import Any, Final, TypeAlias

from factored_polca.studies.limits import process_space

Client: TypeAlias = Mapping[str, Any]
"""The process that writes the store: its number, what numbers mean there, where its modules are."""

Outcome: TypeAlias = dict[str, Any]
"""What came of a run, as plain data: see `factored_polca.studies.store`."""

THREADS: Final = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS",
    "NUMBA_NUM_THREADS",
)  # fmt: skip
"""Runs compute on one thread each, so that their times can be compared, and that forking is safe."""

CLOSING_SECONDS: Final = 30.0
"""Seconds that a warden may take to kill all its runs."""

_START: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from factored_polca.studies.warden import main; main()"
)


class WorkerLost(RuntimeError):
    """The process that supervised a run has ended; what came of the run is not known."""


class Warden:
    """The near end of a process that starts, supervises and ends runs on this machine."""

    def __init__(
        self,
        groups: Sequence[Mapping[str, Any]],
        client: Client | None = None,
        *,
        fork: bool = True,
    ) -> None:
        """Start it; `groups` are the kinds of runs to come, whose kernels it loads or compiles.

        `client` is for whom this is done, if it is another process.  Returns at once: `about` waits
        until it is ready.  Without `fork` each run starts a new Python, as where forking is not safe.
        """
        self.owner = os.getpid()
        client = client or this_client()
        folders = list(dict.fromkeys((*sys.path, *client["path"])))
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _START, json.dumps(folders)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors, start_new_session=True,
            env={**os.environ, **dict.fromkeys(THREADS, "1"), "PYTHONHASHSEED": "0"},
        )  # fmt: skip
        self._lock = threading.Lock()
        self._futures: dict[int, Future[Outcome]] = {}
        self._number = 0
        self._ready: Future[dict[str, Any]] = Future()
        self._lost = ""
        _WARDENS.append(self)
        told = {"client": client["process"], "space": client["space"], "fork": fork}
        self._send({"groups": list(groups)} | told)
        threading.Thread(target=self._listen, daemon=True, name="warden").start()

    def about(self) -> dict[str, Any]:
        """What it says of itself when it is ready: versions, machine, seconds of loading kernels.

        Raises:
            WorkerLost: it has ended before; the message has what it printed.
        """
        return self._ready.result()

    def start(self, request: Mapping[str, Any]) -> Future[Outcome]:
        """Start a run."""
        future: Future[Outcome] = Future()
        future.set_running_or_notify_cancel()
        with self._lock:
            if self._lost:
                raise WorkerLost(self._lost)
            self._number += 1
            number = self._number
            self._futures[number] = future
        self._send({"start": number, "request": dict(request)})
        return future

    @property
    def alive(self) -> bool:
        """Whether runs may be started."""
        return not self._lost

    @property
    def idle(self) -> bool:
        """Whether no run is going on."""
        with self._lock:
            return not self._futures

    def close(self) -> None:
        """End all runs and the process; returns when it has ended."""
        if self.owner != os.getpid():
            return
        if self in _WARDENS:
            _WARDENS.remove(self)
        with self._lock, contextlib.suppress(OSError):
            self._stdin.close()
        try:
            self._process.wait(CLOSING_SECONDS if self._ready.done() else 0.5)
        except subprocess.TimeoutExpired:  # it is busy, with compiling kernels as a rule
            self._process.kill()
            self._process.wait()
        self._errors.close()

    def let_go(self) -> None:
        """Let go of the pipes of a copy of this in a forked process, which would keep the warden alive.

        Something else takes their numbers, as the objects that hold them will close them some day.
        """
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError, ValueError):
                    os.dup2(nowhere, stream.fileno(), inheritable=False)
        os.close(nowhere)

    @property
    def _stdin(self) -> Any:
        assert self._process.stdin is not None, "it was started with a pipe"
        return self._process.stdin

    def _send(self, message: Mapping[str, Any]) -> None:
        data = json.dumps(message).encode() + b"\n"
        with self._lock, contextlib.suppress(OSError, ValueError):  # `_listen` sees that it has ended
            self._stdin.write(data)
            self._stdin.flush()

    def _listen(self) -> None:
        """The thread that takes answers."""
        assert self._process.stdout is not None, "it was started with a pipe"
        about: dict[str, Any] = {}
        with contextlib.suppress(OSError, ValueError):
            for line in self._process.stdout:
                message = json.loads(line)
                if "ready" in message:
                    about = message["ready"]
                    self._ready.set_result(about)
                    continue
                with self._lock:
                    future = self._futures.pop(message["done"])
                if "failed" in message:
                    future.set_exception(WorkerLost(message["failed"]))
                    continue
                future.set_result(message["outcome"] | {"supervisor": about})
        self._fail()

    def _fail(self) -> None:
        """Tell all who wait that nothing will come any more."""
        code = self._process.wait()
        said = self._printed()
        with self._lock:
            self._lost = f"the process that supervises runs has ended (exit status {code}){said}"
            futures = [*self._futures.values()]
            self._futures.clear()
        if not self._ready.done():
            self._ready.set_exception(WorkerLost(self._lost))
        for future in futures:
            future.set_exception(WorkerLost(self._lost))

    def _printed(self) -> str:
        with contextlib.suppress(OSError, ValueError):
            self._errors.seek(0)
            text = self._errors.read()[-2000:].decode("utf-8", "replace").strip()
            return f": {text}" if text else ""
        return ""


_WARDENS: Final[list[Warden]] = []
_HERE: Final[dict[str, Warden]] = {}
_MAKING: Final = threading.Lock()


def this_client() -> Client:
    """This process, as what is done for it elsewhere needs to know it."""
    return {"process": os.getpid(), "space": process_space(), "path": list(sys.path)}


def run_here(request: Mapping[str, Any], groups: Sequence[Mapping[str, Any]], client: Client) -> Outcome:
    """Do a run on the machine where this is called, under a warden of this process; wait for it.

    `groups` and `client` are those of `Warden`, which is started by the first call with them.

    Raises:
        WorkerLost: the warden has ended.
    """
    kind = json.dumps([list(groups), dict(client)])
    with _MAKING:
        for other in [key for key, one in _HERE.items() if key != kind and one.idle]:
            _HERE.pop(other).close()  # of a study that was run before
        warden = _HERE.get(kind)
        if warden is None or not warden.alive:
            warden = _HERE[kind] = Warden(groups, client)
        warden.about()
        future = warden.start(request)
    return future.result()


@atexit.register
def _close_all() -> None:
    for warden in list(_WARDENS):
        warden.close()


def _let_go_in_child() -> None:
    for warden in _WARDENS:
        warden.let_go()
    _WARDENS.clear()
    _HERE.clear()


os.register_at_fork(after_in_child=_let_go_in_child)
