"""A solved subtask whose state is not seen: its reduction, its solution, what it does at belief corners.

pi_h(s), by which a parent models child h, is what h does at the corner b(s) = 1 (Pineau, Gordon & Thrun
2003, section 4.4).  Ties: the first action in the task's order whose value at the corner is within
`TIE` * max(1, |V|) of the best.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np

from factored_polca.approximation.approximate import Approximation
from factored_polca.diagrams import Diagram
from factored_polca.drawn import DrawnGraph
from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.minimisation import DecisionProcess, Reduction
from factored_polca.models import Task
from factored_polca.solvers.pomdp_result import POMDPSolution

TIE: Final = 1e-9

RELATIVE_GAP: Final = 1e-3
"""upper - lower asked for, as a share of the span of a task's rewards, unless a gap is given."""

BeliefPolicy: TypeAlias = AlphaVectors | EntropyPolicy
"""What a task's policy may be: a map from beliefs over its blocks to its actions."""


@dataclass(frozen=True)
class SolvedPomdpTask(DrawnGraph):
    """What PolCA+ knows of a subtask when its parents are planned.

    `corner` [block] is what it chooses where it is certain of the block (0, the first action, where it has
    ended); `policy` the primitive action that this leads to, by state.  `solution.lower` and `upper`
    bound the best value of the task at the initial belief *as the task sees it*: with each child modelled
    by what it does where it is certain.  `corner_gap` is the largest upper - lower at the corners, the
    uniform belief and the initial one.
    """

    task: Task
    reduction: Reduction
    solution: POMDPSolution
    belief_policy: BeliefPolicy
    corner: IntArray
    policy: Diagram
    defined: Diagram
    ties: int
    seconds: float
    minimise_seconds: float
    warnings: tuple[str, ...] = field(default=())
    approximation: Approximation | None = None

    @property
    def process(self) -> DecisionProcess:
        """The decision process that was solved."""
        return self.reduction.process

    @property
    def lower(self) -> float:
        """The task's own lower bound at the initial belief."""
        return self.solution.lower

    @property
    def upper(self) -> float:
        """The task's own upper bound at the initial belief."""
        return self.solution.upper

    def __repr__(self) -> str:
        return f"<SolvedPomdpTask {self.task.name}: {self.reduction.partition.blocks:,} blocks>"

    @property
    def corner_gap(self) -> float:
        """The largest upper - lower at the beliefs that the task was solved for."""
        return float((self.solution.root_upper - self.solution.root_lower).max(initial=0.0))


def corner_choices(policy: BeliefPolicy, blocks: int) -> tuple[IntArray, int]:
    """The choice in each block [block], and in how many blocks several were as good as the best."""
    if isinstance(policy, EntropyPolicy):
        return policy.actions[:, 0].astype(np.int64), 0
    result, ties = np.zeros(blocks, dtype=np.int64), 0
    for part in policy.sets:
        best = part.vectors.max(axis=0)
        close = part.vectors >= best - TIE * np.maximum(1.0, np.abs(best))
        numbers = np.where(close, part.actions[:, None], np.iinfo(np.int64).max)
        result[part.states] = numbers.min(axis=0)
        highest = np.where(close, part.actions[:, None], -1).max(axis=0)
        ties += int((highest != result[part.states]).sum())
    return result, ties


def root_beliefs(pomdp: ArrayPOMDP) -> FloatArray:
    """The beliefs [r, block] that a child is solved for: all corners, the uniform one, the initial one."""
    live = np.flatnonzero(~pomdp.terminal)
    if len(live) == 0:  # the task has ended wherever it is called
        return pomdp.initial[None, :]
    corners = np.zeros((len(live) + 2, pomdp.states))
    corners[np.arange(len(live)), live] = 1.0
    corners[len(live), live] = 1.0 / len(live)
    corners[len(live) + 1] = pomdp.initial
    return corners
