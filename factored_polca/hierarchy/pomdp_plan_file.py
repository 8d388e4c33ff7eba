"""Plan files of partially observed models: one zip of JSON, the model, and arrays (`formats.archive`).

    belief-plan.json   "format", "version", "order" of the variables, "root", "report" (what `plan --json`
                       printed), and "tasks": for each its name, "blocks", "outside" (whether states are
                       left out), and the "kind" and "head" of its policy
    model.toml         the model and its tasks
    taskN.alphas.NAME  the policy of a task that was solved on diagrams (`alpha_policy_file`)
    taskN.NAME         the diagram of task N's partition by nodes (levels, children, leaves), what it does
                       where it is certain (corner), and its policy (`formats.policy_arrays`)

A plan file is read as a stranger's.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import INDEX, dump, evaluate_states, leaves, load
from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.policies import AnyPolicy
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.formats import read_native, write_native
from factored_polca.formats.archive import Archive, is_archive_with, reading, write_archive
from factored_polca.formats.policy_arrays import read_policy, stored_policy
from factored_polca.hierarchy.alpha_policy_file import alpha_arrays, read_alphas
from factored_polca.hierarchy.check import checked
from factored_polca.hierarchy.pomdp_executable import BeliefTask, ExecutablePomdpPlan
from factored_polca.hierarchy.subtask import ended_condition
from factored_polca.minimisation import Partition
from factored_polca.minimisation.pomdp_quotient import seen_of_blocks
from factored_polca.minimisation.quotient import feature_states
from factored_polca.models import Task
from factored_polca.structured.pomdp_solution import AlphaDiagrams
from factored_polca.symbolic import SymbolicModel, compile_model

FORMAT: Final = "factored-polca belief plan"
VERSION: Final = 1
HEAD: Final = "belief-plan.json"
ON_DIAGRAMS: Final = "alpha-vectors as diagrams"


def save_pomdp_plan(plan: ExecutablePomdpPlan, path: str | Path) -> None:
    """Write a plan file; it appears whole or not at all.

    Raises:
        ModelError: no such folder, or a device or folder in the file's place.
        OSError: the file can't be written.
        ValueError: a report that JSON can't hold.
    """
    tasks, arrays = [], dict[str, npt.NDArray[Any]]()
    for number, task in enumerate(plan.policies.values()):
        kind, head, kept = _stored(task)
        tasks.append(
            {
                "name": task.name,
                "blocks": task.partition.blocks,
                "outside": task.partition.has_outside,
                "kind": kind,
                "head": head,
            }
        )
        mine = {**dump(task.partition.diagram), "corner": task.corner, **kept}
        arrays |= {f"task{number}.{name}": array for name, array in mine.items()}
    head = {
        "format": FORMAT,
        "version": VERSION,
        "order": list(plan.symbolic.order),
        "root": plan.root,
        "tasks": tasks,
        "report": dict(plan.report),
    }
    texts = {
        HEAD: json.dumps(head, indent=1, allow_nan=False),
        "model.toml": write_native(plan.model, plan.tasks),
    }
    write_archive(path, texts, arrays)


def _stored(task: BeliefTask) -> tuple[str, dict[str, Any], dict[str, npt.NDArray[Any]]]:
    """The kind of a task's policy, what JSON holds of it, and its arrays."""
    if isinstance(task.policy, AlphaDiagrams):
        return ON_DIAGRAMS, {}, {f"alphas.{name}": a for name, a in alpha_arrays(task.policy).items()}
    stored = stored_policy(task.policy)
    return stored.kind, dict(stored.head), dict(stored.arrays)


def is_pomdp_plan_file(path: str | Path) -> bool:
    """Whether `path` looks like a plan of a partially observed model."""
    return is_archive_with(path, HEAD)


def load_pomdp_plan(path: str | Path, *, memory_limit: int | None = None) -> ExecutablePomdpPlan:
    """Read a plan file.

    Raises:
        ModelError: no such file, no plan, or damaged.
    """
    hint = f"make one with plan MODEL -o {Path(path).name}"
    with reading(path, "plan file of a partially observed model", hint) as archive:
        head = archive.json(HEAD)
        _check_head(head)
        document = read_native(archive.text("model.toml"))
        if document.tasks is None:
            raise ValueError("the plan has no tasks")
        if document.model.observability != "partial":
            raise ValueError("the plan's model is fully observed")
        symbolic = compile_model(document.model, order=head["order"], memory_limit=memory_limit)
        hierarchy = checked(document.model, document.tasks)
        (root,) = (task.name for task in hierarchy.roots())
        names = [entry["name"] for entry in head["tasks"]]
        if head["root"] != root or sorted(names) != sorted(task.name for task in hierarchy.tasks):
            raise ValueError("the plan's tasks are not those of its model")
        policies = {
            entry["name"]: _task(
                archive.within(f"task{number}."), entry, hierarchy.task(entry["name"]), symbolic
            )
            for number, entry in enumerate(head["tasks"])
        }
    return ExecutablePomdpPlan(symbolic, hierarchy, root, policies, head["report"])


def _check_head(head: dict[str, Any]) -> None:
    if head.get("format") != FORMAT:
        raise ValueError("no plan of this program")
    if head.get("version") != VERSION:
        raise ValueError(f"plan version {str(head.get('version'))[:20]}; this program reads {VERSION}")
    kinds = {"order": list, "root": str, "tasks": list, "report": dict}
    wrong = [name for name, kind in kinds.items() if not isinstance(head.get(name), kind)]
    if wrong:
        raise ValueError(f"{wrong[0]} in {HEAD} is missing or not what it should be")


def _task(archive: Archive, entry: dict[str, Any], task: Task, symbolic: SymbolicModel) -> BeliefTask:
    arrays = {name: archive.array(name, "integers") for name in ("levels", "children", "leaves")}
    diagram = load(symbolic.manager, arrays, INDEX)
    if any(level % 2 for level in set(arrays["levels"].tolist()) - {symbolic.manager.leaf_level}):
        raise ValueError("a partition depends on the next state")
    blocks, outside = int(entry["blocks"]), bool(entry["outside"])
    if blocks < 1 or sorted(int(leaf) for leaf in leaves(diagram)) != list(range(blocks + outside)):
        raise ValueError("a partition's blocks are not numbered through")
    partition = Partition(symbolic, diagram, blocks, outside)
    states, ended = feature_states(partition), ended_condition(symbolic, task)
    terminal = evaluate_states(ended, states, symbolic.columns()).astype(np.bool_)
    policy: AnyPolicy | AlphaDiagrams
    if entry["kind"] == ON_DIAGRAMS:
        policy = read_alphas(archive.within("alphas."), symbolic, len(task.actions))
    else:
        policy = read_policy(entry["kind"], entry["head"], archive, _stub(task, terminal, symbolic, states))
    if not isinstance(policy, (AlphaVectors, EntropyPolicy, AlphaDiagrams)):
        raise ValueError("a task's policy is no map from beliefs")
    corner = archive.array("corner", "integers")
    if corner.shape != (blocks,) or corner.min() < 0 or corner.max() >= len(task.actions):
        raise ValueError("a task has no action, or an unknown one, for a block")
    return BeliefTask(task.name, task.actions, partition, policy, corner, terminal, ended)


def _stub(
    task: Task, terminal: npt.NDArray[np.bool_], symbolic: SymbolicModel, states: npt.NDArray[np.int32]
) -> ArrayPOMDP:
    """The blocks and actions of a task, without its kernel: what a policy's numbers are checked against."""
    blocks = len(terminal)
    return ArrayPOMDP(
        actions=task.actions,
        observations=((),) * len(task.actions),
        kernel=((),) * len(task.actions),
        rewards=np.zeros((len(task.actions), blocks)),
        terminal=terminal,
        observed=seen_of_blocks(symbolic, states),
        initial=np.zeros(blocks),
        discount=float(symbolic.model.discount),
    )
