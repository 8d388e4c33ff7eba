"""Flat Q-learning (Watkins 1989; Watkins & Dayan, Machine Learning 8, 1992).

After a step s, a, r, s' with the rate alpha

    Q(s, a) <- (1 - alpha) Q(s, a) + alpha (r + gamma max_b Q(s', b)),   0 in place of max Q at an end.

It stores one value for each primitive action and each state that is not terminal: in Taxi 6 * 500 = 3000
(Dietterich 2000, section 5).  The task graph is a root that chooses among the primitive actions.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from factored_polca.baselines.learning import Knobs, Method, Record, epsilon_of
from factored_polca.baselines.process import ProcessArrays, SampledProcess, draw_start, draw_step
from factored_polca.baselines.tables import TableArrays, full_table, stored, update
from factored_polca.baselines.task_graph import (
    NONE,
    GraphArrays,
    TaskRow,
    pick,
    task_graph,
)
from factored_polca.explicit.arrays import IntArray
from factored_polca.solvers.compiled import kernel


def q_learning(process: SampledProcess) -> Method:
    """Flat Q-learning of `process`."""
    slots = tuple(
        (action, np.where(process.applicable[a], a, NONE)) for a, action in enumerate(process.actions)
    )
    terminal = process.arrays.terminal
    graph = task_graph([TaskRow("Root", slots, terminal)], terminal, len(slots))
    table = full_table("Q", len(slots), process.live)
    return Method("Q-learning", graph, (table,), run_episodes, greedy_choice)


@kernel
def best_pair(graph: GraphArrays, table: TableArrays, task: int, state: int) -> int:
    """The first pair of the task with the largest value among those that can be called, or NONE."""
    best, value = NONE, -np.inf
    for p in range(graph.first[task], graph.first[task + 1]):
        if graph.child[p, state] >= 0:
            mine = stored(table, p, state)
            if mine > value:
                best, value = p, mine
    return best


@kernel
def greedy_choice(graph: GraphArrays, tables: tuple[TableArrays, ...], choice: IntArray) -> None:
    """Write the greedy pair of each task and state into `choice` [task, s]."""
    for i in range(graph.over.shape[0]):
        for s in range(graph.over.shape[1]):
            choice[i, s] = best_pair(graph, tables[0], i, s)


@kernel
def run_episodes(
    process: ProcessArrays, graph: GraphArrays, tables: tuple[TableArrays, ...], knobs: Knobs,
    first: int, last: int, record: Record, rng: Any,
) -> None:  # fmt: skip
    """Learn from the episodes `first` to `last` - 1."""
    table = tables[0]
    for episode in range(first, last):
        epsilon = epsilon_of(knobs, episode)
        s = draw_start(process, rng)
        record.starts[episode] = s
        earned, weight, steps = 0.0, 1.0, 0
        while not process.terminal[s] and steps < knobs.limit:
            p = pick(graph, 0, s, best_pair(graph, table, 0, s), epsilon, rng)
            if p < 0:
                break
            a = graph.child[p, s]
            r = process.rewards[a, s]
            t = draw_step(process, a, s, rng)
            target = r
            following = best_pair(graph, table, 0, t)
            if following >= 0:
                target += knobs.discount * stored(table, following, t)
            update(table, p, s, target, knobs.power)
            earned += weight * r
            weight *= knobs.discount
            s, steps = t, steps + 1
        record.returns[episode] = earned
        record.steps[episode] = steps
