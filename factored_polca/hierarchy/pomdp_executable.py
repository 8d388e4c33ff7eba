"""A plan of a partially observed model as what execution needs: for each task a partition and a policy.

A belief is projected onto the root's partition and the root's policy asked; if it answers a child, the
belief is projected onto the child's partition, and so on down to a primitive action.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from factored_polca.approximation.snap import Snapped, snap
from factored_polca.diagrams import INDEX, Diagram, choose, pairs, relabel
from factored_polca.diagrams.operations import leaf_payloads
from factored_polca.drawn import DrawnGraph, Framed
from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.arrays import BoolArray, IntArray
from factored_polca.explicit.subtask import primitives_below
from factored_polca.hierarchy.pomdp_plan import PomdpPlan
from factored_polca.hierarchy.pomdp_solved import BeliefPolicy
from factored_polca.hierarchy.subtask import local_reward, planning_channels, subtask_process
from factored_polca.hierarchy.symbolic_task import SymbolicPomdpTask
from factored_polca.minimisation import DecisionProcess, Partition, PomdpQuotient, make_pomdp_quotient
from factored_polca.models import Model, ModelError, Task, TaskHierarchy
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.structured.pomdp_belief import BeliefSpace
from factored_polca.structured.pomdp_model import FactoredPOMDP
from factored_polca.structured.pomdp_solution import AlphaDiagrams
from factored_polca.structured.process_model import process_model
from factored_polca.symbolic import SymbolicModel, Term

OBSERVATIONS: Final = 1_000_000
"""Joint observations that a quotient may have when it is made again; planning has capped them."""


@dataclass(frozen=True)
class BeliefTask:
    """The policy of one task over beliefs on the blocks of its partition.

    `corner[b]` is the number of the one of `actions` that it chooses where it is certain of block b;
    `terminal[b]` says whether it has ended there, and `ended` is the same as a condition on states.

    A task that was solved on diagrams (`on_diagrams`) has alpha-vectors over the state, which are asked at
    the whole belief; its blocks are the states where it does the same.
    """

    name: str
    actions: tuple[str, ...]
    partition: Partition
    policy: BeliefPolicy | AlphaDiagrams
    corner: IntArray
    terminal: BoolArray
    ended: Diagram

    @property
    def on_diagrams(self) -> bool:
        """Whether its policy is one of alpha-vectors as diagrams."""
        return isinstance(self.policy, AlphaDiagrams)

    @property
    def diagrams(self) -> list[Diagram]:
        """Its alpha-vectors where they are diagrams."""
        if not isinstance(self.policy, AlphaDiagrams):
            return []
        sliced = [alpha.diagram for alphas in self.policy.slices.values() for alpha in alphas]
        return [*(diagram for _, diagram in self.policy.blind), *sliced]

    @property
    def over_blocks(self) -> BeliefPolicy:
        """Its policy over beliefs on its blocks.

        Raises:
            ModelError: it was solved on diagrams.
        """
        if isinstance(self.policy, AlphaDiagrams):
            raise ModelError(f"task {self.name!r} was solved on diagrams: it has no policy over blocks")
        return self.policy


@dataclass(frozen=True)
class ExecutablePomdpPlan(DrawnGraph, Framed):
    """A hierarchical policy over beliefs that can be executed, saved and loaded.

    `report` is what `plan --json` prints.
    """

    symbolic: SymbolicModel
    tasks: TaskHierarchy
    root: str
    policies: Mapping[str, BeliefTask]
    report: Mapping[str, Any]
    known: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def model(self) -> Model:
        """The model that was planned for."""
        return self.symbolic.model

    @property
    def partitions(self) -> list[Partition]:
        """The partitions of the tasks."""
        return [task.partition for task in self.policies.values()]

    @property
    def conditions(self) -> list[Diagram]:
        """Where the tasks have ended."""
        return [task.ended for task in self.policies.values()]

    def corner_policy(self, name: str) -> Diagram:
        """The primitive action that polling task `name` leads to where the state is known, by state."""
        key = f"policy {name}"
        if key not in self.known:
            self.known[key] = _composed(self, self.policies[name])
        return self.known[key]  # type: ignore[no-any-return]

    def process(self, name: str) -> DecisionProcess:
        """The decision process that task `name` was solved for, over states."""
        children = {
            child: _Child(self.corner_policy(child), self.symbolic.manager.constant(1))
            for child in self.policies[name].actions
            if child in self.policies
        }
        task, partition = self.tasks.task(name), self.policies[name].partition
        reachable = None
        if partition.has_outside:
            reachable = ~partition.diagram.equals(self.symbolic.manager.constant(partition.blocks))
        channels = planning_channels(self.model, task)
        return subtask_process(self.symbolic, task, children, reachable, channels)

    def rewards(self, name: str) -> dict[int, tuple[Term, ...]]:
        """The reward of task `name` by the number of each primitive that polling it may lead to."""
        task, numbers = self.tasks.task(name), {a.name: i for i, a in enumerate(self.symbolic.actions)}
        below = sorted(numbers[action] for action in primitives_below(self.model, self.tasks, name))
        live = ~self.policies[name].ended
        return {p: local_reward(self.symbolic, task, p, live) for p in below}

    @property
    def snapped(self) -> Snapped:
        """The model whose near rows are one, which a plan with `merge_within` was made with.

        Raises:
            ModelError: the report's number is no distance.
        """
        if "snapped" not in self.known:
            self.known["snapped"] = snap(self.symbolic, self.report["merge_within"])
        return self.known["snapped"]  # type: ignore[no-any-return]

    def quotient(self, name: str) -> PomdpQuotient:
        """The POMDP over blocks that task `name` was solved for; made when it is first asked for.

        Raises:
            LimitReached: it has too many observations or entries.
        """
        key = f"quotient {name}"
        if key not in self.known:
            partition, process = self.policies[name].partition, self.process(name)
            if self.report.get("merge_within"):
                process = self.snapped.process(process)
            self.known[key] = make_pomdp_quotient(process, partition, maximum_observations=OBSERVATIONS)
        return self.known[key]  # type: ignore[no-any-return]

    def follow(self, name: str) -> BeliefSpace:
        """What follows a belief under the actions of task `name`, children doing what they do when sure."""
        key = f"space {name}"
        if key not in self.known:
            self.known[key] = BeliefSpace(FactoredPOMDP(process_model(self.process(name))))
        return self.known[key]  # type: ignore[no-any-return]

    def values(self, name: str) -> AlphaVectors:
        """A value function of task `name`: that of its policy, or QMDP's where the policy has none."""
        policy = self.policies[name].over_blocks
        if isinstance(policy, AlphaVectors):
            return policy
        key = f"values {name}"
        if key not in self.known:
            self.known[key] = solve_pomdp(self.quotient(name).pomdp, "qmdp").policy
        return self.known[key]  # type: ignore[no-any-return]


@dataclass(frozen=True)
class _Child:
    policy: Diagram
    defined: Diagram


def executable_pomdp(plan: PomdpPlan, report: Mapping[str, Any] | None = None) -> ExecutablePomdpPlan:
    """What execution needs of a plan."""
    policies, known = dict[str, BeliefTask](), dict[str, Any]()
    for solved in plan.solved:
        name = solved.task.name
        known[f"policy {name}"] = solved.policy
        if isinstance(solved, SymbolicPomdpTask):
            ended = solved.process.terminal
            policies[name] = task_on_diagrams(solved.task, solved.solution.policy, solved.corner, ended)
            continue
        quotient = solved.reduction.pomdp_quotient
        policies[name] = BeliefTask(
            name,
            solved.task.actions,
            solved.reduction.partition,
            solved.belief_policy,
            solved.corner,
            quotient.pomdp.terminal,
            quotient.process.terminal,
        )
        known[f"quotient {name}"] = quotient
    return ExecutablePomdpPlan(
        plan.symbolic, plan.tasks, plan.root.task.name, policies, dict(report or {}), known
    )


def task_on_diagrams(task: Task, policy: AlphaDiagrams, corner: Diagram, ended: Diagram) -> BeliefTask:
    """A task that was solved on diagrams; `corner` maps states to the action chosen when certain."""
    manager = policy.symbolic.manager
    joint, chosen, over = pairs(corner, ended)
    partition = Partition(policy.symbolic, joint, len(chosen), False)
    actions = leaf_payloads(manager, chosen).astype(np.int64)
    terminal = leaf_payloads(manager, over) == 1
    return BeliefTask(task.name, task.actions, partition, policy, actions, terminal, ended)


def _composed(plan: ExecutablePomdpPlan, task: BeliefTask) -> Diagram:
    symbolic = plan.symbolic
    manager, none = symbolic.manager, len(symbolic.actions)
    numbers = {action.name: index for index, action in enumerate(symbolic.actions)}
    outside = np.uint64(len(task.actions))
    chosen = relabel(task.partition.diagram, np.append(task.corner.astype(np.uint64), outside), INDEX)
    result = manager.constant(none)
    for number, name in enumerate(task.actions):
        taken = chosen.equals(manager.constant(number))
        below = plan.corner_policy(name) if name in plan.policies else manager.constant(numbers[name])
        result = choose(taken, below, result)
    return result
