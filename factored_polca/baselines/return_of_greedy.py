"""The exact return of a greedy hierarchical policy, executed as it was learned: call and return.

Where the tasks on the stack are known, each next primitive action is a function of the state, so the
policy is a Markov chain over *configurations* (path of running tasks, state).  The initial probabilities
are pushed along it step by step,

    return = sum_t gamma^t sum over configurations c of P_t(c) r(c),

until all but `LOST` of the probability has ended.  At discount 1 a policy of which more is still running
after `STEPS` steps counts as one that may never end, with the return minus infinity; so does one that has
nothing to call.  (With a discount below 1 the sum is that of the first `STEPS` steps, which leaves out
gamma^STEPS.)
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from factored_polca.baselines.process import IndexArray, ProcessArrays, SampledProcess
from factored_polca.baselines.task_graph import NONE, GraphArrays, TaskGraph, called_tasks
from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.compiled import kernel

LOST: Final = 1e-12
STEPS: Final = 1_000


class Paths(NamedTuple):
    """The paths of running tasks, the root alone being path 0."""

    task: IntArray  # [path] the task that runs at its end
    caller: IntArray  # [path] the path without it
    called: IndexArray  # [path, task] the path that is made by calling a task


def paths_of(graph: TaskGraph) -> Paths:
    """All paths from the root."""
    arrays = graph.arrays
    task, caller, called = [0], [NONE], [[NONE] * len(graph.tasks)]
    below = [called_tasks(arrays, i) for i in range(len(graph.tasks))]
    path = 0
    while path < len(task):
        for j in below[task[path]]:
            called[path][j] = len(task)
            task.append(j)
            caller.append(path)
            called.append([NONE] * len(graph.tasks))
        path += 1
    return Paths(np.array(task), np.array(caller), np.array(called, dtype=np.int32))


def return_of_greedy(process: SampledProcess, graph: TaskGraph, choice: IntArray) -> float:
    """The expected discounted return from the start of the policy `choice` [task, s] -> pair."""
    value, running = _propagate(
        process.arrays, graph.arrays, paths_of(graph), choice, process.initial, process.mdp.discount
    )
    if running > LOST and process.mdp.discount == 1:
        return -np.inf
    return float(value)


@kernel
def descend(
    graph: GraphArrays, paths: Paths, choice: IntArray, path: int, state: int
) -> tuple[int, int, bool]:
    """The next primitive action below `path`, or NONE; the path that takes it; whether it is a tail."""
    while True:
        i = paths.task[path]
        p = choice[i, state]
        if p < 0:
            return NONE, path, False
        child = graph.child[p, state]
        if child < graph.primitives:
            return child, path, False
        if graph.over[child - graph.primitives, state]:
            return graph.tail[i], path, True
        path = paths.called[path, child - graph.primitives]


@kernel
def ascend(graph: GraphArrays, paths: Paths, path: int, tailed: bool, state: int) -> tuple[int, bool]:
    """The path that goes on after a primitive action that `path` took, and whether by its tail.

    NONE where the root has returned.  `tailed`: the action was the tail, and so the last of its task.
    """
    i = paths.task[path]
    if not tailed and graph.tail[i] >= 0:
        return path, True
    if not tailed and not graph.over[i, state]:
        return path, False
    path = paths.caller[path]
    while path >= 0:
        i = paths.task[path]
        if graph.tail[i] >= 0:
            return path, True
        if not graph.over[i, state]:
            return path, False
        path = paths.caller[path]
    return NONE, False


@kernel
def _propagate(
    process: ProcessArrays, graph: GraphArrays, paths: Paths, choice: IntArray, initial: FloatArray,
    discount: float,
) -> tuple[float, float]:  # fmt: skip
    """The return, and the probability that is still running at the end."""
    states, outcomes = process.successors.shape[1], process.successors.shape[2]
    size = 2 * len(paths.task) * states  # a configuration's number: (2 path + by its tail) * states + state
    mass, after, queued = np.zeros(size), np.zeros(size), np.zeros(size, dtype=np.bool_)
    frontier, coming = np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.int64)
    count, running, stuck, total, weight = 0, 0.0, 0.0, 0.0, 1.0
    for s in range(states):
        if initial[s] > 0.0 and not process.terminal[s]:
            mass[s] = initial[s]
            frontier[count] = s
            count += 1
            running += initial[s]
    for _ in range(STEPS):
        if running <= LOST:
            break
        found, running = 0, 0.0
        for f in range(count):
            c = frontier[f]
            m = mass[c]
            mass[c] = 0.0
            s, path, tailed = c % states, c // states // 2, c // states % 2 == 1
            action = graph.tail[paths.task[path]]
            if not tailed:
                action, path, tailed = descend(graph, paths, choice, path, s)
            if action < 0:
                stuck += m
                continue
            total += weight * m * process.rewards[action, s]
            before = 0.0
            for k in range(outcomes):
                chance = process.cumulative[action, s, k] - before
                before = process.cumulative[action, s, k]
                t = process.successors[action, s, k]
                if chance <= 0.0 or process.terminal[t]:
                    continue
                onward, by_tail = ascend(graph, paths, path, tailed, t)
                if onward < 0:
                    continue
                number = (2 * onward + (1 if by_tail else 0)) * states + t
                if not queued[number]:
                    queued[number] = True
                    coming[found] = number
                    found += 1
                after[number] += m * chance
                running += m * chance
        for f in range(found):
            queued[coming[f]] = False
        mass, after = after, mass
        frontier, coming = coming, frontier
        count = found
        weight *= discount
    return total, running + stuck
