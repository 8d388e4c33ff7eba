"""Policies over the beliefs of a block tracker, for many beliefs at once: what simulations run.

All are maps from beliefs over the tracker's blocks to the numbers of primitive actions:

    PolledPolicy       a plan of PolCA+, polled from the top
    MostLikelyPolicy   a policy of states, asked at the likeliest one: PolCA run in a POMDP (DESIGN 5)
    FlatPolicy         a policy over beliefs of one partition: QMDP, SARSOP, ... without a hierarchy

"Likeliest state": the state is known up to the tracker's blocks, so the likeliest block counts, and of
equal ones the first.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from scipy.sparse import csr_array

from factored_polca.control.block_tracker import BlockTracker
from factored_polca.control.polling import ask
from factored_polca.control.tracker import TIE
from factored_polca.diagrams import Diagram
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan
from factored_polca.hierarchy.pomdp_solved import BeliefPolicy
from factored_polca.minimisation import Partition
from factored_polca.models import ModelError


class BlockPolicy(Protocol):
    """Chooses primitive actions at beliefs over a tracker's blocks."""

    def choose(self, beliefs: FloatArray) -> IntArray:
        """The number of the primitive action, -1 for none, [n] at beliefs [n, block]."""


def projection(tracker: BlockTracker, partition: Partition) -> Any:
    """[tracker's block, block] 1 where the first lies in the second, a CSR array.

    Raises:
        ModelError: the partition divides a block of the tracker.
    """
    labels = tracker.labels(partition.diagram)
    if (labels < 0).any():
        raise ModelError("the partition divides a block of the tracker")
    count = tracker.partition.blocks
    inside = np.flatnonzero(labels < partition.blocks)
    ones = np.ones(len(inside))
    return csr_array((ones, (inside, labels[inside])), shape=(count, partition.blocks))


def holds(tracker: BlockTracker, condition: Diagram) -> BoolArray:
    """Whether a condition holds in each block [block].

    Raises:
        ModelError: it divides a block of the tracker.
    """
    labels = tracker.labels(condition)
    if (labels < 0).any():
        raise ModelError("the condition divides a block of the tracker")
    return np.asarray(labels != 0)


class PolledPolicy:
    """A plan polled from task `top`, the root if none is named."""

    def __init__(self, plan: ExecutablePomdpPlan, tracker: BlockTracker, top: str | None = None) -> None:
        self.plan, self.top = plan, plan.root if top is None else top
        self.numbers = {action.name: i for i, action in enumerate(plan.symbolic.actions)}
        self.onto = {n: projection(tracker, task.partition) for n, task in plan.policies.items()}
        self.live = {n: ~holds(tracker, task.ended) for n, task in plan.policies.items()}

    def choose(self, beliefs: FloatArray) -> IntArray:
        result = np.full(len(beliefs), -1, dtype=np.int64)
        self._descend(self.top, np.arange(len(beliefs)), beliefs, result)
        return result

    def _descend(self, name: str, mine: IntArray, beliefs: FloatArray, result: IntArray) -> None:
        """Ask task `name` at the beliefs numbered `mine`, and whom it answers."""
        task, here = self.plan.policies[name], beliefs[mine]
        sure = np.zeros((len(mine), len(task.actions)), dtype=np.bool_)
        for number, action in enumerate(task.actions):
            live = self.live.get(action)
            if live is not None and not live.all():  # a task that can end
                sure[:, number] = ~(here[:, live] > 0).any(axis=1)
        chosen, _ = ask(self.plan, name, np.asarray(here @ self.onto[name]), sure)
        for number in np.unique(chosen).tolist():
            action, answered = task.actions[number], mine[chosen == number]
            if action in self.plan.policies:
                self._descend(action, answered, beliefs, result)
            else:
                result[answered] = self.numbers[action]


class MostLikelyPolicy:
    """A policy of states, a diagram of the numbers of actions, asked at the likeliest block.

    Where it has no action at the likeliest block, that of the likeliest one with an action counts; an
    episode that goes on must do something.
    """

    def __init__(self, policy: Diagram, tracker: BlockTracker) -> None:
        labels = tracker.labels(policy)
        if (labels < 0).any():
            raise ModelError("the policy divides a block of the tracker")
        actions = len(tracker.symbolic.actions)
        self.actions = np.where(labels < actions, labels, -1)

    def choose(self, beliefs: FloatArray) -> IntArray:
        able = np.where(self.actions >= 0, beliefs, 0.0)
        most = able.max(axis=1, keepdims=True)
        first = (able >= (1 - TIE) * most).argmax(axis=1)
        result: IntArray = np.where(most[:, 0] > 0, self.actions[first], -1)
        return result


class FlatPolicy:
    """A policy over beliefs on one partition, whose actions are the primitives `actions` [number]."""

    def __init__(
        self, policy: BeliefPolicy, partition: Partition, actions: IntArray, tracker: BlockTracker
    ) -> None:
        self.policy, self.actions = policy, actions
        self.onto = projection(tracker, partition)

    def choose(self, beliefs: FloatArray) -> IntArray:
        chosen: IntArray = self.actions[self.policy.choose(np.asarray(beliefs @ self.onto))]
        return chosen
