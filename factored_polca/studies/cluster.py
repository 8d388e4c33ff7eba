"""Runs on many machines, by Parsl (extra `cluster`): Y. Babuji et al., HPDC 2019, parsl-project.org.

Parsl asks for nodes (from this machine, Slurm or Kubernetes), starts workers there, and hands them runs.
The limits hold there: each worker has a warden of its own (`factored_polca.studies.warden`).  Results come
back here, where one process writes the store.

    [cluster]
    provider = "slurm"              # local, slurm, kubernetes
    workers = 8                     # runs at a time on each node
    nodes = 4
    walltime = "04:00:00"           # slurm: as long as a node is kept
    partition = "short"             # slurm
    account = "planning"            # slurm
    options = "#SBATCH --mem=64G"   # slurm: more lines for the top of its script
    image = "registry/image:tag"    # kubernetes: with factored-polca[cluster] of this version in it
    namespace = "default"           # kubernetes
    prepare = "source venv/bin/activate"    # shell commands before a worker starts
    address = "10.0.0.5"            # of this machine, as workers see it

Nodes must have the same version of this package; each result says which versions made it.  With Python any
Parsl configuration, and any other executor, may be used: `study.run(executor=...)`.
"""

from __future__ import annotations

import difflib
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any, Final, Literal

from factored_polca.models import Fault, ModelError

PROVIDERS: Final = ("local", "slurm", "kubernetes")
MOST: Final = 10_000
HEARTBEAT_SECONDS: Final = 5
"""Workers that hear nothing for six heartbeats end."""
ONLY: Final = {
    "walltime": "slurm", "partition": "slurm", "account": "slurm", "options": "slurm",
    "image": "kubernetes", "namespace": "kubernetes",
}  # fmt: skip
"""Keys that only one provider has."""


@dataclass(frozen=True)
class Cluster:
    """Where runs are done; see the module's docstring."""

    provider: Literal["local", "slurm", "kubernetes"] = "local"
    workers: int = 1
    nodes: int = 1
    walltime: str = "01:00:00"
    partition: str | None = None
    account: str | None = None
    options: str = ""
    image: str | None = None
    namespace: str = "default"
    prepare: str = ""
    address: str | None = None

    @property
    def slots(self) -> int:
        """Runs given out at a time: enough that no worker waits for this machine."""
        return 2 * self.workers * self.nodes


def read_cluster(table: Any) -> Cluster:
    """The table `[cluster]` of a study's file.

    Raises:
        ModelError: an unknown key, or a value that is not right.
    """
    if not isinstance(table, Mapping):
        raise ModelError([Fault("cluster is no table", ("cluster",), "write [cluster]")])
    faults = []
    known = [field.name for field in fields(Cluster)]
    provider = table.get("provider", "local")
    for key, value in table.items():
        rule = ""
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            guess = f"did you mean {near[0]}? " if near else ""
            hint = f"{guess}the keys are {', '.join(known)}"
            faults.append(Fault(f"unknown key {key!r}", ("cluster", key), hint))
            continue
        if key == "provider":
            rule = "" if value in PROVIDERS else f"one of {', '.join(PROVIDERS)}"
        elif key in ("workers", "nodes"):
            right = isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= MOST
            rule = "" if right else f"a whole number from 1 to {MOST}"
        elif not isinstance(value, str):
            rule = "a text"
        elif ONLY.get(key, provider) != provider:
            rule = f"left out: only {ONLY[key]} has it"
        if rule:
            faults.append(Fault(f"{key} is {value!r}", ("cluster", key), f"it must be {rule}"))
    if provider == "kubernetes" and "image" not in table:
        faults.append(Fault("there is no image", ("cluster",), "kubernetes needs image = ..."))
    if faults:
        raise ModelError(faults)
    return Cluster(**table)


def parsl_module(name: str) -> Any:
    """A module of Parsl.

    Raises:
        MissingLibrary: Parsl is not installed.
    """
    from factored_polca.studies.drawing import MissingLibrary

    try:
        return import_module(f"parsl.{name}")
    except ImportError as error:
        raise MissingLibrary(
            f"a cluster needs Parsl: pip install 'factored-polca[cluster]' (parsl.{name}: {error})"
        ) from None


def make_config(cluster: Cluster, folder: str) -> Any:
    """Parsl's configuration; `folder` is where it keeps its logs.

    Raises:
        MissingLibrary: Parsl is not installed.
    """
    local = cluster.provider == "local"
    options: dict[str, Any] = {
        "heartbeat_period": HEARTBEAT_SECONDS, "heartbeat_threshold": 6 * HEARTBEAT_SECONDS,
        "encrypted": not local, "cores_per_worker": 1e-6 if local else 1.0,
    }  # fmt: skip
    if local:
        options |= {"address": "127.0.0.1", "loopback_address": "127.0.0.1"}
    if cluster.address is not None:
        options["address"] = cluster.address
    executor = parsl_module("executors").HighThroughputExecutor(
        label="study",
        provider=make_provider(cluster),
        max_workers_per_node=cluster.workers,
        **options,
    )
    return parsl_module("config").Config(
        executors=[executor], run_dir=folder, strategy="none", initialize_logging=False, usage_tracking=0
    )


def make_provider(cluster: Cluster) -> Any:
    """What Parsl gets nodes from."""
    providers = parsl_module("providers")
    if cluster.provider == "kubernetes":
        return providers.KubernetesProvider(
            image=cluster.image, namespace=cluster.namespace, nodes_per_block=1,
            init_blocks=cluster.nodes, max_blocks=cluster.nodes, worker_init=cluster.prepare,
        )  # fmt: skip
    if cluster.provider == "slurm":
        return providers.SlurmProvider(
            partition=cluster.partition, account=cluster.account, nodes_per_block=cluster.nodes,
            init_blocks=1, max_blocks=1, walltime=cluster.walltime, scheduler_options=cluster.options,
            worker_init=cluster.prepare, launcher=parsl_module("launchers").SrunLauncher(),
            cores_per_node=cluster.workers,
        )  # fmt: skip
    return providers.LocalProvider(
        init_blocks=cluster.nodes, max_blocks=cluster.nodes, worker_init=cluster.prepare
    )


@contextmanager
def open_cluster(cluster: Cluster) -> Iterator[Executor]:
    """Nodes with workers, as an executor, given back at the end.

    Raises:
        MissingLibrary: Parsl is not installed.
    """
    with (
        own_programs_found(),
        tempfile.TemporaryDirectory(prefix="study-parsl-", ignore_cleanup_errors=True) as folder,
    ):
        config = make_config(cluster, folder)
        executor: Executor = parsl_module("concurrent").ParslPoolExecutor(config)
        done = False
        try:
            yield executor
            done = True
        finally:
            executor.shutdown(wait=done)  # workers that are stopped kill their runs


@contextmanager
def own_programs_found() -> Iterator[None]:
    """Parsl starts programs of its own by name: they lie beside this Python, perhaps not on PATH."""
    before = os.environ.get("PATH", os.defpath)
    os.environ["PATH"] = os.pathsep.join([os.path.dirname(sys.executable), before])
    try:
        yield
    finally:
        os.environ["PATH"] = before
