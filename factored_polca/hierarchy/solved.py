"""A solved subtask: its reduction, its solution, and its policy as a diagram."""

from __future__ import annotations

from dataclasses import dataclass, field

from factored_polca.approximation.approximate import Approximation
from factored_polca.diagrams import Diagram
from factored_polca.drawn import DrawnGraph
from factored_polca.hierarchy.counts import QValueCounts
from factored_polca.minimisation import Reduction
from factored_polca.models import Task
from factored_polca.solvers import MDPSolution


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
