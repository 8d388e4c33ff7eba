"""Value-irrelevance: after a task is solved, states are merged by what its solution says of them.

A block of the minimised task holds states that behave alike (model irrelevance).  Once Q* is known, fewer
differences matter (Li, Walsh & Littman, "Towards a unified theory of state abstraction for MDPs", 2006):

    kind       states x, y are one class where                             what the class says
    q          the same choices apply, Q*(x, c) = Q*(y, c) for each c      Q*, V*, pi
    value      V*(x) = V*(y) and pi(x) = pi(y)                             V*, pi
    action     pi(x) = pi(y)                                               pi

In each kind states where the task has ended are apart from others, and pi, the solution's policy with its
ties decided, is kept as it is: the policy over classes is the same function of the states, so it earns the
same from every state, whatever values were taken for equal.  The classes are **no model** of the dynamics:
two states of a class may go to different classes, so nothing is to be planned on them.  A parent regresses
through the primitive actions of pi, state by state, as it does anyway (DESIGN 5).

Values come from a solver with bounds lower <= V* <= upper in each block.  Values count as equal where they
lie within `within` of each other, by default the width in which ties are decided, 1e-9 max(1, |V|), and the
solver's gap; a class carries the hull of its blocks' bounds, and `width` is the widest hull, the price paid
in what is said of V*.

Where the task was planned with near states merged (`factored_polca.approximation`), V* and Q* are those of
the merged process.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Literal, get_args

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import FLOAT, INDEX, Diagram, relabel
from factored_polca.hierarchy.executable import ExecutablePlan, TaskPolicy, executable, task_policy
from factored_polca.hierarchy.plan import HierarchicalPlan
from factored_polca.hierarchy.solved import SolvedTask, StructuredTask
from factored_polca.minimisation.partition import Partition
from factored_polca.minimisation.reduction import InterchangeableReduction
from factored_polca.models import Fault, ModelError

Kind = Literal["q", "value", "action"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)
TIE: Final = 1e-9
"""Ties are decided within this, relative to the largest value."""

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class ValueClasses:
    """Classes of states by a solved task's values or actions.

    `class_of_block` [block] gives the class of each block of the task; `policy` is the task's policy over
    classes.  `lower` and `upper` [class] bound V* in every state of the class (None for the kind "action",
    which says nothing of values), `q_values` [choice, class] are the middles of what was taken for equal
    (the kind "q" only; minus infinity: does not apply, or can't avoid a dead end).
    """

    kind: Kind
    within: float
    class_of_block: Ints
    policy: TaskPolicy
    lower: Floats | None
    upper: Floats | None
    q_values: Floats | None

    def __repr__(self) -> str:
        before = len(self.class_of_block)
        return f"<ValueClasses of {self.policy.name}: {self.classes:,} by {self.kind}, {before:,} blocks>"

    @property
    def classes(self) -> int:
        """How many classes there are."""
        return self.policy.partition.blocks

    @property
    def width(self) -> float:
        """The largest upper - lower over classes, dead ends left out; 0 where values are not kept."""
        if self.lower is None or self.upper is None:
            return 0.0
        finite = np.isfinite(self.lower) & np.isfinite(self.upper)
        return float((self.upper - self.lower)[finite].max(initial=0.0))

    def value(self) -> Diagram:
        """The middle of each class's bounds as a float diagram over states; 0 outside a restriction.

        Raises:
            ValueError: classes by action say nothing of values.
        """
        if self.lower is None or self.upper is None:
            raise ValueError("classes by action hold no values: make them by 'value' or 'q'")
        middle = np.where(np.isfinite(self.lower), (self.lower + self.upper) / 2, self.lower)
        return relabel(self.policy.partition.diagram, np.append(middle, 0.0), FLOAT)


def value_classes(solved: SolvedTask, kind: Kind = "q", within: float | None = None) -> ValueClasses:
    """The classes of a solved task's states.

    Args:
        kind: "q", "value" or "action"; see the module.
        within: how far values that are taken for equal may lie apart; None: as ties are decided.

    Raises:
        ValueError: no such kind, or `within` negative.
        TypeError: a task whose state is not seen.
        ModelError: the kind "q" where actions were exchanged: there choices are no named actions.
    """
    if kind not in KINDS:
        raise ValueError(f"kind is one of {', '.join(KINDS)}, not {kind!r}")
    if within is not None and not within >= 0:
        raise ValueError(f"within is at least 0, not {within!r}")
    if not isinstance(solved, SolvedTask):
        raise TypeError(f"classes are of a task whose state is seen, not of {type(solved).__name__}")
    reduction, solution = solved.reduction, solved.solution
    exchanged = isinstance(reduction, InterchangeableReduction)
    if kind == "q" and exchanged:
        message = "classes by Q-values need actions by name; they were planned as interchangeable"
        raise ModelError([Fault(message, hint="make them by value or action, or plan without it")])
    policy = task_policy(solved)
    own = _blocks_of(policy, solved)
    lower, upper, values = solution.lower[own], solution.upper[own], solution.values[own]
    finite = np.abs(values[np.isfinite(values)])
    if within is None:
        within = TIE * max(1.0, float(finite.max(initial=0.0))) + max(0.0, float(solution.gap))
    labels = _numbered(policy.terminal.astype(np.int64), policy.choice.astype(np.int64))
    columns: list[Floats] = []
    if kind == "value":
        columns = [values]
    elif kind == "q":
        columns = [values, *(np.where(policy.terminal, 0.0, row) for row in solution.q_values[:, own])]
    for column in columns:
        labels = _refined(labels, column, within)
    return _classes(policy, kind, within, labels, lower, upper, solution.q_values[:, own])


def _blocks_of(policy: TaskPolicy, solved: SolvedTask) -> Ints:
    """The block of the task's quotient that each block of the policy lies in."""
    partition = solved.reduction.partition
    if policy.partition.blocks == partition.blocks:
        return np.arange(partition.blocks)
    states = np.zeros((policy.partition.blocks, len(partition.symbolic.model.features)), dtype=np.int32)
    for number, levels in enumerate(policy.partition.representatives):
        states[number] = partition.symbolic.state(levels.tolist())
    return solved.reduction.project_states(states)


def _numbered(*keys: Ints) -> Ints:
    """One number for each combination of keys, from 0, by first occurrence."""
    _, first, inverse = np.unique(np.stack(keys), axis=1, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse.reshape(-1)]


def _refined(labels: Ints, values: Floats, within: float) -> Ints:
    """Classes split where values lie more than `within` apart, so that none spans more than that.

    Values that a chain of such steps joins stay together, unless the chain spans more; that one is cut
    from its least value on.  Equal infinities are equal.
    """
    order = np.lexsort((values, labels))
    label, value = labels[order], values[order]
    with np.errstate(invalid="ignore"):
        apart = (value[1:] != value[:-1]) & ~(value[1:] - value[:-1] <= within)
    first = np.flatnonzero(np.append(True, apart | (label[1:] != label[:-1])))[: len(order)]
    last = np.append(first[1:], len(order)) - 1
    cuts = [first]
    with np.errstate(invalid="ignore"):
        long = np.flatnonzero((value[last] != value[first]) & ~(value[last] - value[first] <= within))
    for chain in long.tolist():
        start, end = int(first[chain]), int(last[chain])
        while start <= end:
            start += int(np.searchsorted(value[start : end + 1], value[start] + within, "right"))
            cuts.append(np.array([start] if start <= end else [], dtype=np.int64))
    marks = np.zeros(len(order), dtype=np.int64)
    marks[np.concatenate(cuts)] = 1
    group = np.empty(len(order), dtype=np.int64)
    group[order] = np.cumsum(marks)
    return _numbered(group)


def _classes(
    policy: TaskPolicy, kind: Kind, within: float, labels: Ints, lower: Floats, upper: Floats, q: Floats
) -> ValueClasses:
    count = int(labels.max(initial=-1)) + 1
    partition = policy.partition
    images = np.append(labels, count).astype(np.uint64)
    diagram = relabel(partition.diagram, images, INDEX)
    merged = Partition(partition.symbolic, diagram, count, partition.has_outside)
    first = np.full(count, len(labels), dtype=np.int64)
    np.minimum.at(first, labels, np.arange(len(labels)))
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, labels, lower)
    np.maximum.at(high, labels, upper)
    values = np.where(np.isfinite(low), (low + high) / 2, low)
    if kind == "action":
        values = np.zeros(count)
    over = TaskPolicy(
        policy.name, policy.actions, merged, policy.choice[first], values, policy.terminal[first]
    )
    if kind == "action":
        return ValueClasses(kind, within, labels, over, None, None, None)
    if kind == "value":
        return ValueClasses(kind, within, labels, over, low, high, None)
    middles = np.stack([_middle(row, labels, count) for row in q]) if len(q) else np.zeros((0, count))
    return ValueClasses(kind, within, labels, over, low, high, middles)


def _middle(values: Floats, labels: Ints, count: int) -> Floats:
    """The middle of the least and the largest value of each class."""
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, labels, values)
    np.maximum.at(high, labels, values)
    return np.where(np.isfinite(low) & np.isfinite(high), (low + high) / 2, low)


def executable_by_classes(
    plan: HierarchicalPlan,
    kind: Kind,
    report: Mapping[str, Any] | None = None,
    within: float | None = None,
) -> ExecutablePlan:
    """What execution needs of a plan, each task's policy over classes in place of blocks.

    Raises:
        ValueError, ModelError: see `value_classes`.
    """
    without = [s.task.name for s in plan.solved if isinstance(s, StructuredTask)]
    if without:
        raise ModelError(f"task {without[0]!r} was solved on diagrams: it has no blocks to be merged")
    solved = [s for s in plan.solved if isinstance(s, SolvedTask)]
    policies = {s.task.name: value_classes(s, kind, within).policy for s in solved}
    return replace(executable(plan, report), policies=policies)
