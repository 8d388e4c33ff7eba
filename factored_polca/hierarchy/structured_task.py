"""Subtasks solved on diagrams, without a quotient: the other way of steps 3 and 4 of PolCA.

A task is solved so where its solver is "structured", and where "auto" finds that its quotient has more
blocks than the options allow, or takes more memory than there is.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import (
    FLOAT,
    INDEX,
    MemoryLimit,
    choose,
    leaves,
    pairs,
    relabel,
    states_for_leaves,
    states_of_leaves,
)
from factored_polca.diagrams.operations import leaf_payloads
from factored_polca.hierarchy.options import Options
from factored_polca.hierarchy.solved import StructuredTask
from factored_polca.hierarchy.subtask import nothing_to_optimise
from factored_polca.minimisation import DecisionProcess, Partition, Reduction
from factored_polca.models import LimitReached, Task
from factored_polca.structured.bellman import leaf_values
from factored_polca.structured.dead_ends import PossibleView
from factored_polca.structured.rounding import round_to_size
from factored_polca.structured.solution import StructuredSolution
from factored_polca.structured.value_iteration import Progress, structured_value_iteration
from factored_polca.symbolic import NumericView
from factored_polca.symbolic.reach import initial_support

Int32Array: TypeAlias = npt.NDArray[np.int32]

STRUCTURED: Final = "structured"
"""The name of the solver."""

ASKED_FOR: Final = "asked for"
"""Why there is no quotient where the solver was named."""

KEPT_VALUES: Final = 1000
"""Values of a task that execution keeps apart."""


def reduction_or_reason(
    reduce: Callable[[int | None], Reduction],
    falls_back: bool,
    limit: int | None,
    diagrams_beyond: int | None,
) -> Reduction | str:
    """What `reduce` makes within a limit of blocks, or why a task that `falls_back` is solved on diagrams.

    Beyond `diagrams_beyond` blocks it falls back; `limit` is the user's own, an error beyond it.

    Raises:
        LimitReached, MemoryLimit: what stopped the reduction is no reason to fall back.
    """
    within = limit
    if falls_back and diagrams_beyond is not None:
        within = min(diagrams_beyond, limit or diagrams_beyond)
    try:
        return reduce(within)
    except LimitReached as error:
        if not falls_back or not _can_fall_back(error, strict=within == limit):
            raise
        return f"no quotient ({error})"
    except MemoryLimit as error:
        if not falls_back:
            raise
        return f"no quotient ({error})"


def _can_fall_back(error: LimitReached, *, strict: bool) -> bool:
    """Whether what stopped a reduction was memory, or a limit of blocks that is not `strict`."""
    text = str(error)
    if error.stage not in ("minimisation", "quotient") or "time limit" in text or "aborted" in text:
        return False
    return "joint observations" not in text and not (strict and text.startswith("more than"))


def on_diagrams(
    name: str,
    process: DecisionProcess,
    options: Options,
    progress: Progress | None = None,
    *,
    search_until: float | None = None,
) -> StructuredSolution:
    """A process solved on diagrams, as the options ask; what is cut short at `search_until` is returned.

    Raises:
        ModelError: see `structured_value_iteration`.
        LimitReached: time, or memory for not even the rewards.
        KeyboardInterrupt: Ctrl-C.
    """
    solution = structured_value_iteration(
        process, epsilon=options.epsilon, progress=progress,
        deadline=options.deadline if search_until is None else search_until,
    )  # fmt: skip
    if solution.status == "interrupted":
        raise KeyboardInterrupt
    if solution.status == "time limit" and search_until is None:
        raise LimitReached(
            f"task {name!r}: the time limit was reached in sweep {solution.iterations + 1} of structured "
            f"value iteration (value between {solution.lower:.6g} and {solution.upper:.6g})",
            "solve",
            solution,
        )
    return solution


def solve_on_diagrams(
    task: Task,
    process: DecisionProcess,
    options: Options,
    reason: str,
    progress: Progress | None = None,
    *,
    search_until: float | None = None,
) -> StructuredTask:
    """A subtask solved without a quotient; `reason` says why.

    Raises:
        ModelError: a task that has nothing to optimise; and see `on_diagrams`.
        LimitReached, KeyboardInterrupt: see `on_diagrams`.
    """
    began = time.perf_counter()
    refuse_without_purpose_on_diagrams(task, process)
    solution = on_diagrams(task.name, process, options, progress, search_until=search_until)
    symbolic = process.symbolic
    counts = dict(
        zip(leaves(solution.lost), states_of_leaves(solution.lost, symbolic.now_levels), strict=True)
    )
    dead = counts.get(1, 0)
    warnings = []
    if reason != ASKED_FOR:
        warnings.append(f"task {task.name!r}: {reason}; solved by {solution.method}, {solution.note}")
    if dead:
        warnings.append(
            f"task {task.name!r}: {dead:,} states can't avoid a state that is not terminal and has no "
            "applicable action; its policy is undefined there"
        )
    if not solution.converged:
        warnings.append(
            f"task {task.name!r}: the solver stopped early ({solution.status}), gap {solution.gap:.3g}"
        )
    return StructuredTask(task, solution, reason, time.perf_counter() - began, dead, tuple(warnings))


def refuse_without_purpose_on_diagrams(task: Task, process: DecisionProcess) -> None:
    """`refuse_without_purpose` on diagrams.

    Raises:
        ModelError: the local reward is one constant, and it is 0 or no terminal state can be reached.
    """
    manager = process.symbolic.manager
    numbers = NumericView(process.symbolic, FLOAT)
    outside = manager.constant(math.nan, FLOAT)
    found: set[float] = set()
    for choice in process.choices:
        for primitive in choice.primitives:
            reward = numbers.total(process.rewards[primitive])
            values = leaf_values(choose(choice.app & choice.where(primitive), reward, outside))
            found |= set(values[~np.isnan(values)].tolist())
            if len(found) > 1:
                return
    if not found:
        return
    view = PossibleView(process.symbolic)
    ends = any(
        (choice.app & choice.where(p) & view.may_enter(p, process.terminal)) != manager.constant(0)
        for choice in process.choices
        for p in choice.primitives
    )
    (reward_value,) = found
    if reward_value == 0 or not ends:
        raise nothing_to_optimise(task, zero=reward_value == 0, ends=ends)


def lost_start(solution: StructuredSolution) -> str | None:
    """A start state from which a dead end can't be avoided, in words; None where there is none."""
    symbolic = solution.process.symbolic
    lost = solution.lost & initial_support(symbolic)
    if lost == symbolic.manager.constant(0):
        return None
    state = states_for_leaves(lost)[leaves(lost).index(1)]
    return symbolic.state_text(state.tolist())


def policy_partition(
    solution: StructuredSolution,
) -> tuple[
    Partition, np.typing.NDArray[np.int32], np.typing.NDArray[np.float64], np.typing.NDArray[np.bool_]
]:
    """The states by the choice taken, whether the task has ended, and their value, nearly.

    Returns:
        the partition, and for each block its choice (-1: none), value and terminal flag.
    """
    process = solution.process
    symbolic = process.symbolic
    manager = symbolic.manager
    values = round_to_size(solution.values, leaves=KEPT_VALUES).diagram
    first, choice_leaf, value_leaf = pairs(solution.choices, values)
    choice = leaf_payloads(manager, choice_leaf).astype(np.int64)
    value = leaf_payloads(manager, value_leaf).view(np.float64)
    ended = process.terminal
    if process.reachable is not None:  # 0: live, 1: ended, 2: outside
        ended = choose(process.reachable, ended, manager.constant(2))
    joint, before, flag_leaf = pairs(first, ended)
    before = leaf_payloads(manager, before).astype(np.int64)
    flag = leaf_payloads(manager, flag_leaf).astype(np.int64)
    inside = flag < 2
    order = np.argsort(~inside, kind="stable")  # what is outside comes last, as one
    count = int(inside.sum())
    images = np.zeros(len(flag), dtype=np.uint64)
    images[order] = np.minimum(np.arange(len(flag)), count)
    partition = Partition(symbolic, relabel(joint, images, INDEX), count, bool(count < len(flag)))
    kept = order[:count]
    chosen = choice[before[kept]]
    return (
        partition,
        np.where(chosen == len(process.choices), -1, chosen).astype(np.int32),
        value[before[kept]].copy(),
        flag[kept] == 1,
    )
