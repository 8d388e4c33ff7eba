"""MAXQ-Q with all-states updating (Dietterich, JAIR 13, 2000, sections 3, 4 and 5).

The value of a task is decomposed along the graph into V(a, s), the expected reward of a primitive action,
and completion functions C(i, s, j), what task i earns after its child j has returned:

    Q(i, s, j) = V(j, s) + C(i, s, j),     V(i, s) = max_j Q(i, s, j)  for a task i (0 where it is over).

V(a, s) is moved towards each reward r of a in s.  When j, called by i in s_1, has gone through the states
s_1 .. s_N and returned in s', then for each of them, the last one first, with n = N + 1 - k

    C(i, s_k, j) <- (1 - alpha) C(i, s_k, j) + alpha gamma^n V(i, s').

MAXQ-Q keeps a second completion function for pseudo-rewards.  Where these are 0, as in Taxi, where each
task can end in its goal only, both are one function, and one is stored.

An abstraction is an index of C and one of V.  "Safe" ones keep the recursively optimal policy
(Dietterich's five conditions), but one of these, result distribution irrelevance, holds at gamma = 1 only:
with a discount, C(i, s, j) depends on how long j will take from s, and an abstraction that forgets s can't
hold it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from factored_polca.baselines.learning import Knobs, Method, Record, epsilon_of
from factored_polca.baselines.process import ProcessArrays, SampledProcess, draw_start, draw_step
from factored_polca.baselines.tables import Table, TableArrays, full_table, stored, update
from factored_polca.baselines.task_graph import NONE, GraphArrays, TaskGraph, pick
from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.compiled import kernel


def maxq(name: str, graph: TaskGraph, completion: Table, primitive: Table) -> Method:
    """MAXQ-Q with C stored in `completion` [pair, s] and V in `primitive` [a, s]."""
    return Method(name, graph, (completion, primitive), run_episodes, greedy_choice)


def maxq_without_abstraction(process: SampledProcess, graph: TaskGraph) -> Method:
    """MAXQ-Q with an entry for each pair or primitive action and each live state."""
    completion = full_table("C", len(graph.pairs), process.live)
    primitive = full_table("V", graph.arrays.primitives, process.live)
    return maxq("MAXQ, no abstraction", graph, completion, primitive)


class Search(NamedTuple):
    """Room for the search below a task, one place a level: numba's recursion can't be kept on disk."""

    task: IntArray
    pair: IntArray
    best: FloatArray


@kernel
def value_of(
    graph: GraphArrays,
    completion: TableArrays,
    primitive: TableArrays,
    search: Search,
    node: int,
    state: int,
) -> float:  # fmt: skip
    """V(node, s), of a primitive action or by the best path below a task; `node` is a child's code.

    Depth first, as EvaluateMaxNode (Dietterich's Table 3).  Minus infinity where a task can call nothing.
    """
    if node < graph.primitives:
        return stored(primitive, node, state)
    if graph.over[node - graph.primitives, state]:
        return 0.0
    level = 0
    search.task[0] = node - graph.primitives
    search.pair[0], search.best[0] = graph.first[search.task[0]], -np.inf
    while True:
        p = search.pair[level]
        if p == graph.first[search.task[level] + 1]:  # all pairs of this task have been seen
            value = search.best[level]
            if level == 0:
                return value  # type: ignore[no-any-return]
            level -= 1
            p = search.pair[level]
        else:
            child = graph.child[p, state]
            if child < 0:
                search.pair[level] += 1
                continue
            if child >= graph.primitives:
                level += 1
                search.task[level] = child - graph.primitives
                search.pair[level], search.best[level] = graph.first[search.task[level]], -np.inf
                continue
            value = stored(primitive, child, state)
        search.best[level] = max(search.best[level], value + stored(completion, p, state))
        search.pair[level] += 1


@kernel
def best_pair(
    graph: GraphArrays,
    completion: TableArrays,
    primitive: TableArrays,
    search: Search,
    task: int,
    state: int,
) -> int:  # fmt: skip
    """The first pair of the task with the largest Q(i, s, j), or NONE."""
    best, value = NONE, -np.inf
    for p in range(graph.first[task], graph.first[task + 1]):
        child = graph.child[p, state]
        if child >= 0:
            mine = value_of(graph, completion, primitive, search, child, state)
            mine += stored(completion, p, state)
            if mine > value:
                best, value = p, mine
    return best


@kernel
def room_for(graph: GraphArrays) -> Search:
    """Room for the searches below the tasks of a graph."""
    depth = graph.depth
    return Search(np.zeros(depth, dtype=np.int64), np.zeros(depth, dtype=np.int64), np.zeros(depth))


@kernel
def greedy_choice(graph: GraphArrays, tables: tuple[TableArrays, ...], choice: IntArray) -> None:
    """Write the greedy pair of each task and state into `choice` [task, s]."""
    search = room_for(graph)
    for i in range(graph.over.shape[0]):
        for s in range(graph.over.shape[1]):
            choice[i, s] = best_pair(graph, tables[0], tables[1], search, i, s)


@kernel
def run_episodes(
    process: ProcessArrays, graph: GraphArrays, tables: tuple[TableArrays, ...], knobs: Knobs,
    first: int, last: int, record: Record, rng: Any,
) -> None:  # fmt: skip
    """Learn from the episodes `first` to `last` - 1."""
    completion, primitive, gamma = tables[0], tables[1], knobs.discount
    search = room_for(graph)
    task = np.zeros(graph.depth, dtype=np.int64)  # [level] the tasks that run, the root first
    called = np.zeros(graph.depth, dtype=np.int64)  # [level] the pair that each has called
    since = np.zeros(graph.depth, dtype=np.int64)  # [level] the step when it did
    trace = np.zeros(knobs.limit + 1, dtype=np.int64)  # [step] the states of the episode
    for episode in range(first, last):
        epsilon = epsilon_of(knobs, episode)
        s = draw_start(process, rng)
        record.starts[episode] = s
        earned, weight, steps, top = 0.0, 1.0, 0, 0
        while not process.terminal[s] and steps < knobs.limit:
            i = task[top]
            p = pick(graph, i, s, best_pair(graph, completion, primitive, search, i, s), epsilon, rng)
            if p < 0:
                break
            called[top], since[top] = p, steps
            child = graph.child[p, s]
            if child >= graph.primitives:
                top += 1
                task[top] = child - graph.primitives
                continue
            r = process.rewards[child, s]
            update(primitive, child, s, r, knobs.power)
            trace[steps] = s
            s = draw_step(process, child, s, rng)
            earned += weight * r
            weight *= gamma
            steps += 1
            while True:  # the call at `top` has returned
                i, p = task[top], called[top]
                rest = value_of(graph, completion, primitive, search, i + graph.primitives, s)
                rest = rest if rest > -np.inf else 0.0
                child = graph.child[p, trace[since[top]]]
                for k in range(steps - 1, since[top] - 1, -1):
                    rest *= gamma
                    if graph.child[p, trace[k]] == child:
                        update(completion, p, trace[k], rest, knobs.power)
                if not graph.over[i, s] or top == 0:
                    break
                top -= 1
        record.returns[episode] = earned
        record.steps[episode] = steps
