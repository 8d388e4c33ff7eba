"""Task graphs whose parameters are bound: which task may call what, in which state.

Dietterich (JAIR 13, 2000, section 3) writes a hierarchy as a graph with parameters: Get calls
Navigate(t) with t bound to where the passenger waits.  Here each Navigate(t) is a task of its own, and
the binding is a function of the state:

    pair p = (task i, slot)          one of the actions that task i chooses among
    child[p, s]                      what p calls in state s: a primitive action, a task, or nothing
    over[i, s]                       the termination predicate T_i(s)

Codes of children: a < A is a primitive action, A + j the task number j, NONE what can't be called, which
is so of a task that is over.  Task 0 is the root, and the model's end ends every task.

A task with a `tail` is a short program, as ALisp has it (Andre & Russell, AAAI 2002): it makes one
choice, calls that (which may be over at once), then takes the tail, a primitive action, and returns.

A task runs until its own termination predicate holds, as in the pseudo-code of MAXQ-Q (Dietterich 2000,
Table 4); those of its callers are looked at when it has returned.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np

from factored_polca.baselines.process import IndexArray
from factored_polca.explicit.arrays import BoolArray, IntArray
from factored_polca.solvers.compiled import kernel

NONE: Final = -1
"""No child, no stored value, no tail."""


class GraphArrays(NamedTuple):
    """What the kernels read of a task graph."""

    first: IntArray  # [task + 1], the pairs of task i are first[i] to first[i + 1] - 1
    child: IndexArray  # [pair, s]
    over: BoolArray  # [task, s]
    tail: IntArray  # [task]
    primitives: int  # A
    depth: int  # tasks on the longest path from the root


@dataclass(frozen=True, eq=False)
class TaskGraph:
    """A task graph over numbered states."""

    tasks: tuple[str, ...]
    pairs: tuple[tuple[str, str], ...]  # (task, what it calls), in words
    arrays: GraphArrays

    @property
    def states(self) -> int:
        """All states, terminal ones included."""
        return int(self.arrays.over.shape[1])

    def pair(self, task: str, slot: str) -> int:
        """The number of a pair.

        Raises:
            KeyError: there is none; the message lists the slots of the task.
        """
        if (task, slot) not in self.pairs:
            there = ", ".join(s for t, s in self.pairs if t == task) or "no such task"
            raise KeyError(f"{task!r} does not call {slot!r}; there are {there}")
        return self.pairs.index((task, slot))


@dataclass(frozen=True, eq=False)
class TaskRow:
    """One task of a graph: its slots by name with their children [s], and where it is over [s]."""

    name: str
    slots: tuple[tuple[str, IntArray], ...]
    over: BoolArray
    tail: int = NONE


def task_graph(rows: list[TaskRow], terminal: BoolArray, primitives: int) -> TaskGraph:
    """The graph of `rows`, the root first; children that can't be called are taken out.

    Raises:
        ValueError: a task that calls itself, over whichever others, or one without slots.
    """
    over = np.array([row.over | terminal for row in rows])
    first = np.cumsum([0, *(len(row.slots) for row in rows)])
    child = np.empty((int(first[-1]), len(terminal)), dtype=np.int32)
    for i, row in enumerate(rows):
        if not row.slots:
            raise ValueError(f"task {row.name!r} has nothing to call; give it a slot")
        for p, (_, codes) in enumerate(row.slots, start=int(first[i])):
            child[p] = np.where(terminal, NONE, codes)
            if row.tail == NONE:
                called = child[p] - primitives
                lost = (called >= 0) & over[np.maximum(called, 0), np.arange(len(terminal))]
                child[p, lost] = NONE
    arrays = GraphArrays(
        first, by_state(child), by_state(over), np.array([row.tail for row in rows]), primitives,
        _depth(first, child, primitives, rows),
    )  # fmt: skip
    pairs = tuple((row.name, slot) for row in rows for slot, _ in row.slots)
    return TaskGraph(tuple(row.name for row in rows), pairs, arrays)


def by_state(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """[row, s] with all rows of a state side by side in memory: kernels read them together."""
    return np.asfortranarray(array)


def called_tasks(arrays: GraphArrays, task: int) -> list[int]:
    """The tasks that `task` calls in some state, by number."""
    codes = np.unique(arrays.child[arrays.first[task] : arrays.first[task + 1]])
    return [int(code) - arrays.primitives for code in codes if code >= arrays.primitives]


def _depth(first: IntArray, child: IndexArray, primitives: int, rows: list[TaskRow]) -> int:
    known: dict[int, int] = {}

    def measure(task: int, path: tuple[int, ...]) -> int:
        if task in path:
            raise ValueError(f"task {rows[task].name!r} calls itself; a task graph has no circles")
        if task not in known:
            codes = np.unique(child[first[task] : first[task + 1]])
            below = [measure(int(c) - primitives, (*path, task)) for c in codes if c >= primitives]
            known[task] = 1 + max(below, default=0)
        return known[task]

    return measure(0, ())


@kernel
def pick(graph: GraphArrays, task: int, state: int, best: int, epsilon: float, rng: Any) -> int:
    """epsilon-greedy: `best`, or with probability epsilon any pair of the task that can be called."""
    if epsilon <= 0.0 or rng.random() >= epsilon:
        return best
    count = 0
    for p in range(graph.first[task], graph.first[task + 1]):
        if graph.child[p, state] >= 0:
            count += 1
    left = int(rng.random() * count)
    for p in range(graph.first[task], graph.first[task + 1]):
        if graph.child[p, state] >= 0:
            if left == 0:
                return p
            left -= 1
    return best
