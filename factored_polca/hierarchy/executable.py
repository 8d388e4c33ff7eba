"""A plan as what execution needs: for each task a partition and the choice in each block.

The path from a state to a primitive action is polled from the top: the root's partition gives the
block, the block its choice; if that is a child, the child is asked in turn.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import INDEX, Diagram, choose, pairs, relabel
from factored_polca.diagrams.operations import leaf_payloads
from factored_polca.drawn import DrawnGraph, Framed
from factored_polca.hierarchy.check import planning_order
from factored_polca.hierarchy.plan import HierarchicalPlan
from factored_polca.hierarchy.solved import AnySolvedTask, StructuredTask
from factored_polca.hierarchy.structured_task import policy_partition
from factored_polca.minimisation import Partition
from factored_polca.minimisation.reduction import InterchangeableReduction
from factored_polca.models import Model, TaskHierarchy
from factored_polca.symbolic import SymbolicModel


@dataclass(frozen=True)
class TaskPolicy(DrawnGraph):
    """The policy of one task over the blocks of its partition.

    `choice[b]` is the number of the chosen one of `actions`, -1 where there is none (the task has
    ended, or can't avoid a dead end); `terminal[b]` says whether it has ended.
    """

    name: str
    actions: tuple[str, ...]
    partition: Partition
    choice: npt.NDArray[np.int32]
    values: npt.NDArray[np.float64]
    terminal: npt.NDArray[np.bool_]


@dataclass(frozen=True)
class ExecutablePlan(DrawnGraph, Framed):
    """A hierarchical policy that can be executed, saved and loaded.

    `policy` maps each state to the number of the model's action that is taken, or to the number of
    actions where there is none.  `report` is what `plan --json` prints.
    """

    symbolic: SymbolicModel
    tasks: TaskHierarchy
    root: str
    policies: Mapping[str, TaskPolicy]
    policy: Diagram
    report: Mapping[str, Any]

    @property
    def model(self) -> Model:
        """The model that was planned for."""
        return self.symbolic.model


def executable(plan: HierarchicalPlan, report: Mapping[str, Any] | None = None) -> ExecutablePlan:
    """What execution needs of a plan."""
    policies = {solved.task.name: task_policy(solved) for solved in plan.solved}
    root = plan.root
    return ExecutablePlan(
        plan.symbolic, plan.tasks, root.task.name, policies, root.policy, dict(report or {})
    )


def task_policy(solved: AnySolvedTask) -> TaskPolicy:
    """The choice in each block; where actions were exchanged blocks are split by what is chosen.

    The blocks of a task that was solved on diagrams are the states of one choice and nearly one value.
    """
    if isinstance(solved, StructuredTask):
        return TaskPolicy(solved.task.name, solved.task.actions, *policy_partition(solved.solution))
    reduction, solution = solved.reduction, solved.solution
    partition, choice = reduction.partition, solution.policy.astype(np.int32)
    values, terminal = solution.values, reduction.mdp.terminal
    if isinstance(reduction, InterchangeableReduction):
        manager = partition.diagram.manager
        joint, first, second = pairs(partition.diagram, reduction.lift_choices(solution.policy))
        block = leaf_payloads(manager, first).astype(np.int64)
        taken = leaf_payloads(manager, second).astype(np.int64)
        inside = block < partition.blocks
        order = np.argsort(~inside, kind="stable")  # what is outside comes last, as one
        images = np.zeros(len(block), dtype=np.uint64)
        images[order] = np.minimum(np.arange(len(block)), inside.sum())
        count = int(inside.sum())
        partition = Partition(
            partition.symbolic, relabel(joint, images, INDEX), count, partition.has_outside
        )
        kept = order[:count]
        none = len(reduction.process.choices)
        choice = np.where(taken[kept] == none, -1, taken[kept]).astype(np.int32)
        values, terminal = values[block[kept]], terminal[block[kept]]
    return TaskPolicy(solved.task.name, solved.task.actions, partition, choice, values, terminal)


def composed_policy(
    symbolic: SymbolicModel, tasks: TaskHierarchy, policies: Mapping[str, TaskPolicy]
) -> Diagram:
    """The primitive action that polling the root leads to at each state, from the tasks' choices.

    The leaf where there is none is the number of the model's actions.
    """
    manager, none = symbolic.manager, len(symbolic.actions)
    numbers = {action.name: index for index, action in enumerate(symbolic.actions)}
    composed: dict[str, Diagram] = {}
    result = manager.constant(none)
    for task in planning_order(tasks):
        policy = policies[task.name]
        images = np.where(policy.choice < 0, len(policy.actions), policy.choice).astype(np.uint64)
        padded = np.append(images, np.uint64(len(policy.actions)))
        chosen = relabel(policy.partition.diagram, padded, INDEX)
        result = manager.constant(none)
        for number, name in enumerate(policy.actions):
            taken = chosen.equals(manager.constant(number))
            below = composed[name] if name in composed else manager.constant(numbers[name])
            result = choose(taken, below, result)
        composed[task.name] = result
    return result
