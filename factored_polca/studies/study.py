"""A study: grids of runs under limits, their store, and what is made of it.

from factored_polca.studies import Study

study = Study("growth", [{"work": "minimise", "model": ["linear", "expon"], "set": {"size": [4, 6, 8]}}])
study.run(jobs=2)
frame = study.frame()
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from factored_polca.models import Fault, ModelError
from factored_polca.studies.grid import MAXIMUM_RUNS, WORKS, Grid, Run, is_file, make_grid
from factored_polca.studies.limits import Limits
from factored_polca.studies.model_text import ModelText, read_model_texts
from factored_polca.studies.provenance import provenance
from factored_polca.studies.store import Counts, Store
from factored_polca.studies.store_lock import StoreLock

if TYPE_CHECKING:
    import pandas

    from factored_polca.studies.cluster import Cluster
    from factored_polca.studies.runner import Progress

LIMITS: Final = Limits(600.0, 4 * 10**9)
"""Limits of a run where a study gives none: ten minutes, 4 GB."""


@dataclass(frozen=True, init=False)
class Study:
    """What is to be run, within which limits, and where the results are.

    `grids` are `Grid`s, or the same as plain data: a dictionary with `work`, `model`, `set`, `seed` and the
    options of the work, each a value or a list.  `store` is the file of results, NAME.sqlite in the current
    folder if not given.  `folder` is where model files are looked for.
    """

    name: str
    grids: tuple[Grid, ...]
    limits: Limits
    store: Path
    jobs: int
    cluster: Cluster | None
    files: Mapping[str, ModelText] = field(repr=False)

    def __init__(
        self,
        name: str,
        grids: Sequence[Grid | Mapping[str, Any]],
        *,
        seconds: float | None = LIMITS.seconds,
        memory_bytes: int | None = LIMITS.memory_bytes,
        store: str | os.PathLike[str] | None = None,
        folder: str | os.PathLike[str] = ".",
        jobs: int = 1,
        cluster: Cluster | None = None,
    ) -> None:
        """Check the grids, and read the model files.

        Raises:
            ModelError: a grid is not right, a file can't be read, or there are too many runs.
        """
        made, faults = [], list[Fault]()
        for number, grid in enumerate(grids):
            try:
                made.append(grid if isinstance(grid, Grid) else make_grid(grid, ("grid", str(number))))
            except ModelError as error:
                faults += error.faults
        for key, most in {"seconds": seconds, "memory_bytes": memory_bytes, "jobs": jobs}.items():
            if most is not None and not most > 0:
                faults.append(Fault(f"{key} is {most!r}", (key,), "it must be positive"))
        if not grids:
            faults.append(Fault("there is nothing to run", hint="a study has at least one grid"))
        total = sum(grid.size for grid in made)
        if total > MAXIMUM_RUNS:
            faults.append(Fault(f"{total:,} runs", hint=f"a study has at most {MAXIMUM_RUNS:,}"))
        if faults:
            raise ModelError(faults)
        files = dict[str, ModelText]()
        for number, grid in enumerate(made):
            try:
                files |= read_model_texts(
                    {m for m in grid.models if is_file(m)} - files.keys(), Path(folder)
                )
                faults += file_faults(grid, files, ("grid", str(number)))
            except ModelError as error:
                faults += [
                    Fault(fault.message, ("grid", str(number), "model"), fault.hint)
                    for fault in error.faults
                ]
        if faults:
            raise ModelError(faults)
        for key, value in {
            "name": name, "grids": tuple(made), "limits": Limits(seconds, memory_bytes),
            "store": Path(f"{name}.sqlite") if store is None else Path(store), "jobs": jobs,
            "cluster": cluster, "files": files,
        }.items():  # fmt: skip
            object.__setattr__(self, key, value)

    @cached_property
    def _runs(self) -> tuple[Run, ...]:
        runs = (run for grid in self.grids for run in grid.runs(self.files))
        return tuple({run.key: run for run in runs}.values())

    def runs(self) -> tuple[Run, ...]:
        """All runs, each once."""
        return self._runs

    def run(
        self,
        *,
        jobs: int | None = None,
        executor: Executor | None = None,
        retry: Collection[str] = (),
        progress: Callable[[Progress], None] | None = None,
    ) -> Counts:
        """Run what has no result yet; answer how many runs have which status.

        On this machine `jobs` runs go on at a time.  With an `executor`, or a `cluster` of the study's,
        runs are done by its workers, `jobs` being given to it at a time; the limits hold there too.
        Results with a status in `retry` are computed again.

        Raises:
            StoreLocked: another process is running the study.
            ModelError: the store is something else.
            WorkerLost: nothing can be run any more; what has been done is in the store.
        """
        from factored_polca.studies import runner

        lock = StoreLock(self.store)
        try:
            with Store(self.store, writing=True) as store:
                runs = self.runs()
                told = provenance() | {"arguments": sys.argv[:100], "limits": self.limits_as_data()}
                launch = store.launch(self.name, runs, told)
                done = store.finished(self.limits, retry)
                left = [run for run in runs if run.key not in done]
                if left:
                    groups = runner.kinds(left, self.files)
                    self._run_left(store, launch, groups, jobs, executor, retry, progress)
                return store.counts()
        finally:
            lock.release()

    def _run_left(
        self,
        store: Store,
        launch: int,
        groups: list[dict[str, Any]],
        jobs: int | None,
        executor: Executor | None,
        retry: Collection[str],
        progress: Callable[[Progress], None] | None,
    ) -> None:
        from factored_polca.studies import runner

        def go(start: runner.Start, slots: int) -> None:
            runner.run_all(
                store, launch, self.runs(), self.limits, self.files, start, slots, retry=retry,
                progress=progress,
            )  # fmt: skip

        if executor is not None:
            go(runner.executor_start(executor, groups), jobs or runner.FOREIGN_RUNS)
        elif self.cluster is not None:
            from factored_polca.studies.cluster import open_cluster

            with open_cluster(self.cluster) as pool:
                go(runner.executor_start(pool, groups), jobs or self.cluster.slots)
        else:
            with runner.local_start(groups) as start:
                go(start, jobs or self.jobs)

    def limits_as_data(self) -> dict[str, Any]:
        """The limits as plain data."""
        return {"seconds": self.limits.seconds, "memory_bytes": self.limits.memory_bytes}

    def rows(self) -> list[dict[str, Any]]:
        """The results so far, a dictionary each, with equal keys.

        Raises:
            ModelError: there is no store yet.
        """
        with Store(self.store) as store:
            return store.rows()

    def counts(self) -> Counts:
        """How many runs have which status.

        Raises:
            ModelError: there is no store yet.
        """
        with Store(self.store) as store:
            return store.counts()

    def frame(self) -> pandas.DataFrame:
        """The results so far as a frame of pandas (extra `frames`).

        Raises:
            ModelError: there is no store yet.
            MissingLibrary: pandas is not installed.
        """
        from factored_polca.studies.study_export import make_frame

        return make_frame(self.rows())

    def export(self, path: str | os.PathLike[str]) -> None:
        """Write the results so far as .csv or .parquet.

        Raises:
            ModelError: there is no store yet, or the file can't be written.
            MissingLibrary: pandas or pyarrow is not installed.
        """
        from factored_polca.studies.study_export import export

        export(self.rows(), path)

    def report(self, folder: str | os.PathLike[str]) -> Path:
        """Write a page with plots, and the plots as PNG, into a folder; answer the page's path.

        Raises:
            ModelError: there is no store yet, or the folder can't be written to.
            MissingLibrary: matplotlib is not installed.
        """
        from factored_polca.studies.report import write_report

        with Store(self.store) as store:
            return write_report(store, folder)


def file_faults(grid: Grid, files: Mapping[str, ModelText], path: tuple[str, ...]) -> list[Fault]:
    """Parameters that a model file doesn't have."""
    faults = []
    for model in grid.models:
        if grid.work not in WORKS or model not in files:
            continue
        known = files[model].parameters()
        for name, _ in grid.settings:
            if known is not None and name not in known:
                listed = f"it has {', '.join(sorted(known))}" if known else "it has none"
                faults.append(Fault(f"{model} has no parameter {name!r}", (*path, "set", name), listed))
    return faults
