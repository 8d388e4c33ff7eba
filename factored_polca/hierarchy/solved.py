"""A solved subtask: what solved it, over blocks or on diagrams, and its policy as a diagram.

Both kinds tell their parents, the report and execution the same: `process`, `policy`, `defined`, `value`,
`blocks`, `counts`, `method`, `gap`, `status`, `ties`, `seconds` and `warnings`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

from factored_polca.approximation.approximate import Approximation
from factored_polca.diagrams import Diagram
from factored_polca.drawn import DrawnGraph
from factored_polca.hierarchy.counts import QValueCounts
from factored_polca.minimisation import DecisionProcess, Reduction
from factored_polca.models import Task
from factored_polca.solvers import MDPSolution
from factored_polca.solvers.result import Status
from factored_polca.structured.solution import StructuredSolution


@dataclass(frozen=True)
class SolvedTask(DrawnGraph):
    """What PolCA knows of a subtask when its parents are planned.

    `policy` maps states to numbers of primitive actions; where it is not `defined` (the task has
    ended, or has no way to avoid a dead end) its leaf is the number of the model's actions.
    `value` is the optimum under the task's own reward at the initial belief; minus infinity where
    a dead end can't be avoided from some start state.  Where near states were merged all of this is the
    merged process's, and `approximation` says what is certain in the task itself.
    """

    task: Task
    reduction: Reduction
    solution: MDPSolution
    policy: Diagram
    defined: Diagram
    counts: QValueCounts
    value: float
    seconds: float
    dead_end_states: int = 0
    warnings: tuple[str, ...] = field(default=())
    approximation: Approximation | None = None

    def __repr__(self) -> str:
        blocks = self.reduction.partition.blocks
        return f"<SolvedTask {self.task.name}: {blocks:,} blocks, worth {self.value:.6g}>"

    @property
    def process(self) -> DecisionProcess:
        """The decision process that was solved."""
        return self.reduction.process

    @property
    def blocks(self) -> int:
        """The blocks of the quotient."""
        return self.reduction.partition.blocks

    @property
    def cells(self) -> Diagram:
        """What the task's choice depends on: the partition."""
        return self.reduction.partition.diagram

    @property
    def method(self) -> str:
        """The solver's name."""
        return self.solution.method

    @property
    def gap(self) -> float:
        """The largest upper - lower of a state."""
        return self.solution.gap

    @property
    def status(self) -> Status:
        """Why the solver stopped."""
        return self.solution.status

    @property
    def ties(self) -> int:
        """The blocks that were decided by a tie."""
        return self.solution.ties


@dataclass(frozen=True)
class StructuredTask(DrawnGraph):
    """A subtask solved on diagrams, without a quotient; `reason` says why.

    For its parents it is what a `SolvedTask` is.  `value` lies in the solution's bounds at the start.
    There are no blocks, so neither they nor Q-values nor ties are counted.
    """

    task: Task
    solution: StructuredSolution
    reason: str
    seconds: float
    dead_end_states: int = 0
    warnings: tuple[str, ...] = field(default=())

    def __repr__(self) -> str:
        return f"<StructuredTask {self.task.name}: {self.solution.nodes:,} nodes, worth {self.value:.6g}>"

    @property
    def process(self) -> DecisionProcess:
        """The decision process that was solved."""
        return self.solution.process

    @property
    def policy(self) -> Diagram:
        """State -> number of the primitive action, or the number of the model's actions."""
        return self.solution.policy

    @property
    def defined(self) -> Diagram:
        """Where the policy takes an action."""
        return self.solution.defined

    @property
    def value(self) -> float:
        """The value at the initial belief, within the solution's bounds."""
        return self.solution.value

    @property
    def cells(self) -> Diagram:
        """What the task's choice depends on: the choices themselves."""
        return self.solution.choices

    @property
    def approximation(self) -> None:
        """Near states are merged in blocks only."""
        return

    @property
    def blocks(self) -> None:
        """There are none."""
        return

    @property
    def counts(self) -> None:
        """Q-values are not kept by blocks."""
        return

    @property
    def method(self) -> str:
        """The solver's name."""
        return self.solution.method

    @property
    def gap(self) -> float:
        """The largest upper - lower of a state."""
        return self.solution.gap

    @property
    def status(self) -> Status:
        """Why the solver stopped."""
        return self.solution.status

    @property
    def ties(self) -> None:
        """Ties are not counted."""
        return


AnySolvedTask: TypeAlias = SolvedTask | StructuredTask
