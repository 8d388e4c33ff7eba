"""Running a study: what is left to do is given out, what comes back is written, until nothing is left.

Runs are given to whatever starts them and answers futures: a warden on this machine, or any
`concurrent.futures.Executor`, whose workers keep wardens of their own (`warden_client.run_here`), so that
limits hold where a run is.  Only this process writes the store.

A worker may be lost with its runs (a machine that dies, a warden that is killed): they are given out again,
up to `ATTEMPTS` times, then recorded as errors.
"""

from __future__ import annotations

import re
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

from factored_polca import library
from factored_polca.models import ModelError
from factored_polca.studies.grid import WORKS, Run
from factored_polca.studies.limits import Limits
from factored_polca.studies.model_text import ModelText
from factored_polca.studies.provenance import now
from factored_polca.studies.store import Store
from factored_polca.studies.warden_client import Outcome, Warden, WorkerLost, run_here, this_client

ATTEMPTS: Final = 3
POLL_SECONDS: Final = 0.5
FOREIGN_RUNS: Final = 32
"""Runs given at a time to an executor whose size is not known."""

Start: TypeAlias = Callable[[Mapping[str, Any]], "Future[Outcome]"]
"""Starts a run."""


@dataclass(frozen=True)
class Progress:
    """How far a study is; what `progress` is told."""

    done: int
    planned: int
    going_on: tuple[Run, ...]
    by_status: Mapping[str, int]
    seconds: float
    here: int  # results of this call

    @property
    def seconds_left(self) -> float | None:
        """A guess: as fast as so far in this call."""
        return None if not self.here else self.seconds / self.here * (self.planned - self.done)


@dataclass
class _Work:
    """What is left to do and what is going on, while a study runs."""

    pending: deque[Run]
    going_on: dict[Future[Outcome], Run] = field(default_factory=dict)
    lost: Counter[str] = field(default_factory=Counter)


def run_all(
    store: Store,
    launch: int,
    runs: Sequence[Run],
    limits: Limits,
    files: Mapping[str, ModelText],
    start: Start,
    slots: int,
    *,
    retry: Collection[str] = (),
    progress: Callable[[Progress], None] | None = None,
) -> int:
    """Run what is left of `runs`, at most `slots` at a time; answer how many results were written.

    Raises:
        WorkerLost: no more runs can be started.
    """
    done = store.finished(limits, retry)
    ended = Counter(status for key, status in store.by_key().items() if key in done)
    work = _Work(deque(run for run in runs if run.key not in done))
    began, before, written = time.monotonic(), len(runs) - len(work.pending), 0
    sent = {"seconds": limits.seconds, "memory_bytes": limits.memory_bytes}
    try:
        while work.pending or work.going_on:
            while work.pending and len(work.going_on) < slots:
                run = work.pending.popleft()
                text = files[run.model].text if run.model in files else None
                work.going_on[start(run.request(text, sent))] = run
            if progress is not None:
                progress(
                    Progress(
                        before + written, len(runs), tuple(work.going_on.values()),
                        dict(ended), time.monotonic() - began, written,
                    )
                )  # fmt: skip
            finished, _ = wait(work.going_on, POLL_SECONDS, FIRST_COMPLETED)
            for future in finished:
                run = work.going_on.pop(future)
                outcome = outcome_of(future, run, work)
                if outcome is not None:
                    store.record(launch, run, limits, outcome)
                    ended[outcome["status"]] += 1
                    written += 1
    finally:
        for future in work.going_on:
            future.cancel()  # those that have not begun
    return written


def outcome_of(future: Future[Outcome], run: Run, work: _Work) -> Outcome | None:
    """What came of a run; None where its worker was lost and it is to be run again."""
    try:
        return future.result()
    except BrokenExecutor as error:
        raise WorkerLost(f"the executor has broken down: {error}") from error
    except Exception as error:
        work.lost[run.key] += 1
        if work.lost[run.key] < ATTEMPTS:
            work.pending.append(run)
            return None
        message = f"lost {ATTEMPTS} times with what ran it: {type(error).__name__}: {error}"[:2000]
        return {
            "status": "error", "message": message, "stage": "", "figures": {}, "started": now(),
            "finished": now(), "wall_seconds": 0.0, "cpu_seconds": 0.0, "peak_memory_bytes": 0,
            "base_memory_bytes": 0,
        }  # fmt: skip


@contextmanager
def local_start(groups: Sequence[Mapping[str, Any]]) -> Iterator[Start]:
    """Runs on this machine, under one warden; a new one takes the place of one that has died."""
    wardens = [Warden(groups)]

    def start(request: Mapping[str, Any]) -> Future[Outcome]:
        if not wardens[-1].alive:
            wardens.append(Warden(groups))
            wardens[-1].about()
        return wardens[-1].start(request)

    try:
        wardens[-1].about()
        yield start
    finally:
        for warden in wardens:
            warden.close()


def executor_start(executor: Executor, groups: Sequence[Mapping[str, Any]]) -> Start:
    """Runs wherever an executor does its work; modules are looked for in the same folders as here."""
    client = this_client()

    def start(request: Mapping[str, Any]) -> Future[Outcome]:
        try:
            return executor.submit(run_here, request, groups, client)
        except BrokenExecutor as error:
            raise WorkerLost(f"the executor has broken down: {error}") from error

    return start


def kinds(runs: Sequence[Run], files: Mapping[str, ModelText]) -> list[dict[str, Any]]:
    """The kinds of runs among `runs`, for their kernels to be made ready."""
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    unseen: dict[str, bool] = {}
    for run in runs:
        if run.work in WORKS and run.model not in unseen:
            unseen[run.model] = may_be_unseen(run.model, files)
        options = dict(run.options)
        group = {
            "work": run.work,
            "solver": options.get("solver"),
            "staged": options.get("horizon", "infinite") != "infinite",
            "unseen": unseen.get(run.model, False),
        }
        found.setdefault(tuple(group.values()), group)
    return list(found.values())


_UNSEEN: Final = re.compile(r"""observability\s*=\s*["']partial|<pomdpx|^\s*observations""", re.I | re.M)


def may_be_unseen(model: str, files: Mapping[str, ModelText]) -> bool:
    """Whether a model may be partially observed; a wrong guess costs time in the first runs only."""
    if model in files:
        return _UNSEEN.search(files[model].text) is not None
    try:
        return library.load(model).model.observability == "partial"
    except ModelError:
        return True
