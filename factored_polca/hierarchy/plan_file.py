"""Plan files: one zip of JSON, the model in the native format, and arrays; no pickle.

    plan.json      format, version, variable order, root, the tasks, the report
    model.toml     the model and its tasks
    NAME.npy       for the polled policy and each task: the diagram by nodes (levels, children,
                   leaves), and for each task its choices, values and terminal flags by block

A plan file is read as untrusted: sizes are capped before anything is unpacked, arrays are loaded
without pickle, diagrams are checked node by node against the model's variables.
"""

from __future__ import annotations

import io
import json
import os
import secrets
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import INDEX, Diagram, dump, leaves, load
from factored_polca.formats import destination, read_native, write_native
from factored_polca.formats.npy import read_npy
from factored_polca.hierarchy.check import checked
from factored_polca.hierarchy.executable import ExecutablePlan, TaskPolicy, composed_policy
from factored_polca.minimisation import Partition
from factored_polca.models import ModelError
from factored_polca.symbolic import SymbolicModel, compile_model

FORMAT: Final = "factored-polca plan"
VERSION: Final = 1
MAXIMUM_BYTES: Final = 4 << 30
"""Unpacked bytes; larger files are refused."""
MAXIMUM_ENTRIES: Final = 100_000


def save_plan(plan: ExecutablePlan, path: str | Path) -> None:
    """Write a plan file; it appears whole or not at all.

    Raises:
        ModelError: no such folder, or a device or folder in the file's place.
        OSError: the file can't be written.
    """
    path = destination(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.part")
    try:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            _write(plan, archive)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _write(plan: ExecutablePlan, archive: zipfile.ZipFile) -> None:
    names = list(plan.policies)
    tasks = [
        {
            "name": name,
            "actions": list(policy.actions),
            "blocks": policy.partition.blocks,
            "outside": policy.partition.has_outside,
        }
        for name, policy in plan.policies.items()
    ]
    head = {
        "format": FORMAT,
        "version": VERSION,
        "order": list(plan.symbolic.order),
        "root": plan.root,
        "tasks": tasks,
        "report": dict(plan.report),
    }
    archive.writestr("plan.json", json.dumps(head, indent=1, allow_nan=False))
    archive.writestr("model.toml", write_native(plan.model, plan.tasks))
    _write_diagram(archive, "policy", plan.policy)
    for number, name in enumerate(names):
        policy = plan.policies[name]
        _write_diagram(archive, f"task{number}", policy.partition.diagram)
        _write_array(archive, f"task{number}.choice", policy.choice)
        _write_array(archive, f"task{number}.values", policy.values)
        _write_array(archive, f"task{number}.terminal", policy.terminal)


def _write_diagram(archive: zipfile.ZipFile, name: str, diagram: Diagram) -> None:
    for key, array in dump(diagram).items():
        _write_array(archive, f"{name}.{key}", array)


def _write_array(archive: zipfile.ZipFile, name: str, array: npt.NDArray[Any]) -> None:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
    archive.writestr(f"{name}.npy", buffer.getvalue())


def load_plan(path: str | Path, *, memory_limit: int | None = None) -> ExecutablePlan:
    """Read a plan file.

    Raises:
        ModelError: no such file, no plan, or damaged.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            return _read(archive, memory_limit)
    except FileNotFoundError:
        raise ModelError(f"{path}: no such file; make one with plan MODEL -o {path.name}") from None
    except ModelError as error:
        raise error.in_file(str(path)) from None
    except (
        zipfile.BadZipFile, OSError, ValueError, KeyError, TypeError, EOFError, NotImplementedError,
        IndexError, OverflowError, MemoryError, AttributeError, RecursionError, struct.error, zlib.error,
    ) as error:  # fmt: skip
        reason = str(error) or type(error).__name__
        raise ModelError(f"{path}: not a plan file, or damaged ({reason})") from None


def _read(archive: zipfile.ZipFile, memory_limit: int | None) -> ExecutablePlan:
    entries = archive.infolist()
    if len(entries) > MAXIMUM_ENTRIES or sum(entry.file_size for entry in entries) > MAXIMUM_BYTES:
        raise ValueError("larger than a plan may be")
    head = json.loads(archive.read("plan.json"))
    if head.get("format") != FORMAT:
        raise ValueError("no plan of this program")
    if head.get("version") != VERSION:
        raise ValueError(f"plan version {head.get('version')}; this program reads {VERSION}")
    document = read_native(archive.read("model.toml").decode("utf-8"))
    if document.tasks is None:
        raise ValueError("the plan has no tasks")
    symbolic = compile_model(document.model, order=head["order"], memory_limit=memory_limit)
    hierarchy = checked(document.model, document.tasks)
    policy = _read_diagram(archive, "policy", symbolic)
    if max(leaves(policy)) > len(symbolic.actions):
        raise ValueError("the policy names actions that the model has not")
    policies = {}
    for number, entry in enumerate(head["tasks"]):
        policies[entry["name"]] = _read_task(archive, number, entry, symbolic)
    known = {task.name: task.actions for task in hierarchy.tasks}
    (root,) = (task.name for task in hierarchy.roots())
    if head["root"] != root or {n: p.actions for n, p in policies.items()} != known:
        raise ValueError("the plan's tasks are not those of its model")
    if composed_policy(symbolic, hierarchy, policies) != policy:
        raise ValueError("the plan's policy is not what its tasks choose")
    return ExecutablePlan(symbolic, hierarchy, head["root"], policies, policy, head["report"])


def _read_task(
    archive: zipfile.ZipFile, number: int, entry: dict[str, Any], symbolic: SymbolicModel
) -> TaskPolicy:
    diagram = _read_diagram(archive, f"task{number}", symbolic)
    blocks, outside = int(entry["blocks"]), bool(entry["outside"])
    if sorted(int(leaf) for leaf in leaves(diagram)) != list(range(blocks + outside)):
        raise ValueError("a partition's blocks are not numbered through")
    choice = _read_array(archive, f"task{number}.choice", np.int32, blocks)
    values = _read_array(archive, f"task{number}.values", np.float64, blocks)
    terminal = _read_array(archive, f"task{number}.terminal", np.bool_, blocks)
    actions = tuple(str(action) for action in entry["actions"])
    if blocks and not (choice.min() >= -1 and choice.max() < len(actions)):
        raise ValueError("a policy chooses an action that its task has not")
    partition = Partition(symbolic, diagram, blocks, outside)
    return TaskPolicy(str(entry["name"]), actions, partition, choice, values, terminal)


def _read_diagram(archive: zipfile.ZipFile, name: str, symbolic: SymbolicModel) -> Diagram:
    arrays = {key: _array(archive, f"{name}.{key}") for key in ("levels", "children", "leaves")}
    for key, array in arrays.items():
        if array.ndim != 1 or array.dtype.kind not in "iu":
            raise ValueError(f"{name}.{key} is no list of integers")
    diagram = load(symbolic.manager, arrays, INDEX)
    if any(level % 2 for level in set(arrays["levels"].tolist()) - {symbolic.manager.leaf_level}):
        raise ValueError("a policy depends on the next state")
    return diagram


def _read_array(archive: zipfile.ZipFile, name: str, kind: Any, length: int) -> npt.NDArray[Any]:
    array = _array(archive, name)
    if array.shape != (length,) or array.dtype != np.dtype(kind):
        raise ValueError(f"{name} has a wrong shape or type")
    return array


def _array(archive: zipfile.ZipFile, name: str) -> npt.NDArray[Any]:
    return read_npy(archive.read(f"{name}.npy"), name)
