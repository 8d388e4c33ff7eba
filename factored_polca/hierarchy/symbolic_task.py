"""Subtasks whose state is not seen, solved on diagrams: the other way of steps 2 to 4 of PolCA+.

A task is solved so where its solver is "symbolic", and where "auto" finds that its quotient has more blocks
than the options allow, or takes more memory than there is.  Its process is a model of its own
(`structured.process_model`); alpha-vectors are diagrams.  For its parents it is what a task with a quotient
is: what it does at the belief corner of each state is a diagram, state -> primitive action, made pointwise
from its alpha-vectors (`structured.pomdp_corners`).  A child is searched from the worst corners, the
uniform belief and the initial one; the root from the initial belief.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias

from factored_polca.diagrams import Diagram, MemoryLimit, choose, leaves
from factored_polca.drawn import Drawn
from factored_polca.hierarchy.options import Options
from factored_polca.hierarchy.pomdp_solved import RELATIVE_GAP, SolvedPomdpTask
from factored_polca.hierarchy.structured_task import ASKED_FOR, refuse_without_purpose_on_diagrams
from factored_polca.minimisation import DecisionProcess
from factored_polca.models import LimitReached, Task
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.structured.bellman import primitive_policy
from factored_polca.structured.pomdp_corners import corner_policy
from factored_polca.structured.pomdp_solution import SymbolicSolution, solve_symbolic
from factored_polca.structured.process_model import process_model
from factored_polca.symbolic import NumericView

SYMBOLIC: Final = "symbolic"
"""The name of the solver."""


@dataclass(frozen=True)
class SymbolicPomdpTask(Drawn):
    """A subtask solved on diagrams, without a quotient; `reason` says why.

    For its parents it is what a `SolvedPomdpTask` is.  `corner` maps states to the number of the one of the
    task's actions that it chooses where it is certain (0, the first, where it has ended), `policy` to the
    primitive action that this leads to.  There are no blocks: neither they nor ties are counted.
    """

    task: Task
    process: DecisionProcess
    solution: SymbolicSolution
    corner: Diagram
    policy: Diagram
    defined: Diagram
    reason: str
    seconds: float
    warnings: tuple[str, ...] = field(default=())

    def __repr__(self) -> str:
        return f"<SymbolicPomdpTask {self.task.name}: {self.solution.vectors:,} alpha-vectors as diagrams>"

    @property
    def lower(self) -> float:
        """The task's own lower bound at the initial belief."""
        return self.solution.lower

    @property
    def upper(self) -> float:
        """The task's own upper bound at the initial belief."""
        return self.solution.upper

    @property
    def corner_gap(self) -> float:
        """The largest upper - lower at the beliefs that it was solved for: of a child at all corners."""
        gap = self.solution.corner_gap
        return self.solution.gap if gap is None else gap

    @property
    def approximation(self) -> None:
        """Near states are merged in blocks only."""
        return


AnySolvedPomdpTask: TypeAlias = SolvedPomdpTask | SymbolicPomdpTask
"""A solved subtask whose state is not seen."""


def solve_on_diagrams(
    task: Task,
    process: DecisionProcess,
    options: Options,
    reason: str,
    *,
    is_root: bool,
    shares: int = 1,
    progress: Callable[[float, float], None] | None = None,
) -> SymbolicPomdpTask:
    """A subtask solved without a quotient; `reason` says why.

    It takes one of `shares` parts of the time that is left, and ends with the bounds so far.

    Raises:
        ModelError: a task that has nothing to optimise.
        LimitReached: too many joint observations or values of what is seen; a policy with too many nodes.
        KeyboardInterrupt: Ctrl-C.
    """
    began = time.perf_counter()
    refuse_without_purpose_on_diagrams(task, process)
    demand = Demand(
        gap=options.gap if options.gap is not None else max(RELATIVE_GAP * reward_span(process), 1e-12),
        iterations=options.trials,
        seed=options.seed,
        progress=progress,
    )
    demand = _within(demand, options, shares)
    with limits_of(task.name):
        solution = solve_symbolic(process_model(process), demand, everywhere=not is_root)
        if solution.status == "interrupted":
            raise KeyboardInterrupt
        try:
            corner = corner_policy(solution.policy)[1]
            policy = primitive_policy(process, corner)
        except MemoryLimit as error:
            raise LimitReached(str(error), "solve") from None
    warnings = []
    if reason != ASKED_FOR:
        warnings.append(f"task {task.name!r}: {reason}; solved by {solution.method}, {solution.note}")
    if solution.status in ("time limit", "memory limit"):
        warnings.append(
            f"task {task.name!r}: the {solution.status} ended the search at a gap of {solution.gap:.3g}"
        )
    return SymbolicPomdpTask(
        task, process, solution, corner, policy, process.symbolic.manager.constant(1), reason,
        time.perf_counter() - began, tuple(warnings),
    )  # fmt: skip


def upper_on_diagrams(process: DecisionProcess, options: Options) -> float:
    """What no policy can earn more of from the initial belief on: the first upper bound on diagrams.

    It takes half of the time that is left, at most.

    Raises:
        LimitReached: too many joint observations or values of what is seen.
        KeyboardInterrupt: Ctrl-C.
    """
    demand = Demand(gap=max(RELATIVE_GAP * reward_span(process), 1e-12), iterations=0)
    found = solve_symbolic(process_model(process), _within(demand, options, 2))
    if found.status == "interrupted":
        raise KeyboardInterrupt
    return found.upper


def _within(demand: Demand, options: Options, shares: int) -> Demand:
    """The demand with one of so many parts of the time that is left."""
    if options.deadline is None:
        return demand
    now = time.monotonic()
    return replace(demand, deadline=now + max(0.0, options.deadline - now) / shares)


@contextmanager
def limits_of(name: str) -> Iterator[None]:
    """Inside, limits that are reached are said to be those of a task."""
    try:
        yield
    except LimitReached as error:
        raise LimitReached(f"task {name!r}: {error}", error.stage, error.partial) from None


def reward_span(process: DecisionProcess) -> float:
    """The largest less the least reward of a choice, 0 being the reward where the process has ended."""
    numbers = NumericView(process.symbolic)
    found = {0.0}
    for choice in process.choices:
        for primitive in choice.primitives:
            reward = numbers.total(process.rewards[primitive])
            live = choice.where(primitive) & ~process.terminal
            found |= {float(value) for value in leaves(choose(live, reward, numbers.zero))}
    return max(found) - min(found)
