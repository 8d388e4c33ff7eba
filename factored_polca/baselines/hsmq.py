"""Hierarchical semi-Markov Q-learning, HSMQ (Dietterich, SARA 2000, "An overview of MAXQ").

Each task i of the graph is a semi-Markov decision process of its own with a table Q(i, s, j) of the
discounted reward until the end of i.  When the child j that i called in s returns after N steps in s',
having earned G = sum_{k < N} gamma^k r_k,

    Q(i, s, j) <- (1 - alpha) Q(i, s, j) + alpha (G + gamma^N max_j' Q(i, s', j')),

0 in place of the maximum where i is over in s'.  There is no decomposition: a value is stored in each
task that it matters to.  In Taxi that is (2 + 2 + 2 + 4 * 4) * 500 = 11000 values.  The limit is
recursively optimal.  (The algorithm and its name are from memory of that paper; the count of pairs of
tasks and states is that of the C functions in Dietterich, JAIR 13, 2000, section 5, where it was read.)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from factored_polca.baselines.learning import Knobs, Method, Record, epsilon_of
from factored_polca.baselines.process import ProcessArrays, SampledProcess, draw_start, draw_step
from factored_polca.baselines.q_learning import best_pair, greedy_choice
from factored_polca.baselines.tables import TableArrays, full_table, stored, update
from factored_polca.baselines.task_graph import GraphArrays, TaskGraph, pick
from factored_polca.solvers.compiled import kernel


def hsmq(process: SampledProcess, graph: TaskGraph) -> Method:
    """HSMQ on a task graph without tails."""
    table = full_table("Q", len(graph.pairs), process.live)
    return Method("HSMQ", graph, (table,), run_episodes, greedy_choice)


@kernel
def run_episodes(
    process: ProcessArrays, graph: GraphArrays, tables: tuple[TableArrays, ...], knobs: Knobs,
    first: int, last: int, record: Record, rng: Any,
) -> None:  # fmt: skip
    """Learn from the episodes `first` to `last` - 1."""
    table, gamma = tables[0], knobs.discount
    task = np.zeros(graph.depth, dtype=np.int64)  # [level] the tasks that run, the root first
    called = np.zeros(graph.depth, dtype=np.int64)  # [level] the pair that each has called
    where = np.zeros(graph.depth, dtype=np.int64)  # [level] the state where it did
    gain = np.zeros(graph.depth)  # [level] what that call has earned
    fading = np.zeros(graph.depth)  # [level] gamma^(steps of that call)
    for episode in range(first, last):
        epsilon = epsilon_of(knobs, episode)
        s = draw_start(process, rng)
        record.starts[episode] = s
        earned, weight, steps, top = 0.0, 1.0, 0, 0
        while not process.terminal[s] and steps < knobs.limit:
            i = task[top]
            p = pick(graph, i, s, best_pair(graph, table, i, s), epsilon, rng)
            if p < 0:
                break
            called[top], where[top], gain[top], fading[top] = p, s, 0.0, 1.0
            child = graph.child[p, s]
            if child >= graph.primitives:
                top += 1
                task[top] = child - graph.primitives
                continue
            r = process.rewards[child, s]
            s = draw_step(process, child, s, rng)
            for level in range(top + 1):
                gain[level] += fading[level] * r
                fading[level] *= gamma
            earned += weight * r
            weight *= gamma
            steps += 1
            while True:  # the call at `top` has returned
                i = task[top]
                over = graph.over[i, s]
                target = gain[top]
                following = best_pair(graph, table, i, s)
                if not over and following >= 0:
                    target += fading[top] * stored(table, following, s)
                update(table, called[top], where[top], target, knobs.power)
                if not over or top == 0:
                    break
                top -= 1
        record.returns[episode] = earned
        record.steps[episode] = steps
