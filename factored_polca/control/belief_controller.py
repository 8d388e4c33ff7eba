"""The polling controller over beliefs (the paper's section 4.4): at every step ask from the top.

One belief serves all tasks.  At each step it is projected onto the root's blocks and the root's policy
asked; the child that it answers is asked at the same belief over *its* blocks, and so on until a primitive
action comes back.  There is no stack.  A task that was solved on diagrams is asked at the whole belief
(`diagram_polling`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factored_polca.control.diagram_polling import ask_on_diagrams
from factored_polca.control.polling import ask
from factored_polca.control.tracker import (
    BLOCK_LIMIT,
    Belief,
    ChosenTracker,
    OnImpossible,
    choose_tracker,
    tested_features,
)
from factored_polca.diagrams import support
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan
from factored_polca.minimisation import Partition
from factored_polca.models import Value


@dataclass(frozen=True)
class BeliefPoll:
    """One question on the way down: the task, its answer, and what the task believed.

    `block` is the likeliest block of the task, `probability` the belief's mass there; `ended` whether the
    belief is sure that the task has ended; `looked_ahead` whether the policy's own answer was a child that
    has surely ended, and another one was found by looking one step ahead.
    """

    task: str
    block: int
    block_states: int
    probability: float
    action: str
    ended: bool
    looked_ahead: bool


@dataclass(frozen=True)
class BeliefDecision:
    """The primitive action at a belief, and the polls that led to it."""

    action: str
    number: int
    path: tuple[BeliefPoll, ...]


def tracked_features(plan: ExecutablePomdpPlan) -> list[str]:
    """The features that some task tells apart, or that are seen: those whose marginals are of use."""
    told = [partition.diagram for partition in plan.partitions]
    told += [diagram for task in plan.policies.values() for diagram in task.diagrams]
    return tested_features(plan.symbolic, told)


def block_state(partition: Partition, block: int) -> dict[str, Value]:
    """The first state of a block, as far as the partition tells it: the features that it tests."""
    symbolic, tested = partition.symbolic, support(partition.diagram)
    first = partition.representatives[block]
    return {
        feature.name: feature.values[int(first[symbolic.now(number)])]
        for number, feature in enumerate(symbolic.model.features)
        if symbolic.now(number) in tested
    }


def plan_tracker(
    plan: ExecutablePomdpPlan,
    *,
    on_impossible: OnImpossible = "error",
    seed: int = 0,
    deadline: float | None = None,
) -> ChosenTracker:
    """The tracker that fits a plan: on the common refinement of its tasks, else others.

    A task that was solved on diagrams is asked at the whole belief, which is then no vector over blocks.
    Blocks and diagrams are given up at `deadline`, a reading of `time.monotonic()`.
    """
    on_diagrams = any(task.on_diagrams for task in plan.policies.values())
    return choose_tracker(
        plan.symbolic,
        plan.partitions,
        conditions=plan.conditions,
        features=tracked_features(plan),
        on_impossible=on_impossible,
        block_limit=0 if on_diagrams else BLOCK_LIMIT,
        seed=seed,
        deadline=deadline,
    )


class BeliefController:
    """Executes a plan of a partially observed model; it holds no state of its own."""

    def __init__(self, plan: ExecutablePomdpPlan) -> None:
        self.plan = plan
        self._numbers = {action.name: i for i, action in enumerate(plan.symbolic.actions)}

    def poll(self, belief: Belief) -> BeliefDecision:
        """The action at a belief.

        Raises:
            ModelError: the belief's tracker does not tell apart what the plan does, or holds states
                possible that the plan was not made for.
        """
        plan, path = self.plan, list[BeliefPoll]()
        name = plan.root
        while name in plan.policies:
            task = plan.policies[name]
            over_blocks = belief.project(task.partition)
            sure = [
                action in plan.policies and belief.support_in(plan.policies[action].ended)
                for action in task.actions
            ]
            if task.on_diagrams:
                number, looked_ahead = ask_on_diagrams(plan, name, belief, np.array(sure))
            else:
                chosen, ahead = ask(plan, name, over_blocks[None, :], np.array([sure]))
                number, looked_ahead = int(chosen[0]), bool(ahead[0])
            block = int(over_blocks.argmax())
            path.append(
                BeliefPoll(
                    task=name,
                    block=block,
                    block_states=task.partition.sizes[block],
                    probability=float(over_blocks[block]),
                    action=task.actions[number],
                    ended=bool(over_blocks[~task.terminal].sum() == 0),
                    looked_ahead=looked_ahead,
                )
            )
            name = path[-1].action
        return BeliefDecision(name, self._numbers[name], tuple(path))
