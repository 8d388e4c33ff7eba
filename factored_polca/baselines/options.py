"""Options with learned subgoals (Sutton, Precup & Singh, Artificial Intelligence 112, 1999).

An option o is a way of acting with an end: it can be taken wherever it is not over, follows its policy
pi_o, and stops where it is over.  The root chooses among the primitive actions and the options and
stores Q(s, a) and Q(s, o).  All is learned by intra-option methods, from each step s, a, r, s':

    Q(s, a)   <-  r + gamma max_x Q(s', x)       x: all actions and options
    Q(s, o)   <-  r + gamma U(s', o)             for each o with pi_o(s) = a,
                                                 U = Q(s', o), or max_x Q(s', x) where o is over
    Q_o(s, a) <-  r + gamma max_b Q_o(s', b)     for each o that is not over in s and has the action a,
                                                 0 in place of the maximum where o is over

Q_o is the table from which pi_o is greedy: the discounted reward until the option's subgoal, whose value
is 0.  Since primitive actions stay available, the limit is the optimum of the model, not a recursive one.
For Taxi, with an option for each target that Navigate has, the values are (6 + 4) * 500 for the root and
4 * 4 * 500 for the options.  (The update rules are from memory of that paper, whose abstract was read.)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from factored_polca.baselines.learning import Knobs, Method, Record, epsilon_of
from factored_polca.baselines.process import ProcessArrays, SampledProcess, draw_start, draw_step
from factored_polca.baselines.q_learning import best_pair, greedy_choice
from factored_polca.baselines.tables import TableArrays, full_table, stored, update
from factored_polca.baselines.task_graph import NONE, GraphArrays, TaskGraph, pick
from factored_polca.solvers.compiled import kernel


def options(process: SampledProcess, graph: TaskGraph) -> Method:
    """Learning with options on a graph of a root over primitive actions and tasks over primitive actions.

    Raises:
        ValueError: a graph with more levels than that.
    """
    if graph.arrays.depth > 2:
        raise ValueError(
            f"options choose among primitive actions; this graph has {graph.arrays.depth} levels"
        )
    table = full_table("Q", len(graph.pairs), process.live)
    return Method("options", graph, (table,), run_episodes, greedy_choice)


@kernel
def _best_value(graph: GraphArrays, table: TableArrays, task: int, state: int) -> float:
    p = best_pair(graph, table, task, state)
    return stored(table, p, state) if p >= 0 else 0.0


@kernel
def learn_step(
    graph: GraphArrays, table: TableArrays, knobs: Knobs, s: int, action: int, r: float, t: int
) -> None:
    """All updates from one step; the root offers each option that is not over in s."""
    gamma, best = knobs.discount, _best_value(graph, table, 0, t)
    for p in range(graph.first[0], graph.first[1]):
        child = graph.child[p, s]
        if child == action:
            update(table, p, s, r + gamma * best, knobs.power)
        elif child >= graph.primitives:
            o = child - graph.primitives
            follows, value, taken = NONE, -np.inf, NONE
            for q in range(graph.first[o], graph.first[o + 1]):
                mine = stored(table, q, s)
                if graph.child[q, s] == action:
                    taken = q
                if graph.child[q, s] >= 0 and mine > value:
                    follows, value = q, mine
            if taken < 0:
                continue
            over = graph.over[o, t]
            if follows == taken:
                rest = best if over else stored(table, p, t)
                update(table, p, s, r + gamma * rest, knobs.power)
            rest = 0.0 if over else _best_value(graph, table, o, t)
            update(table, taken, s, r + gamma * rest, knobs.power)


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
        earned, weight, steps, running = 0.0, 1.0, 0, 0
        while not process.terminal[s] and steps < knobs.limit:
            p = pick(graph, running, s, best_pair(graph, table, running, s), epsilon, rng)
            if p < 0:
                break
            child = graph.child[p, s]
            if child >= graph.primitives:
                running = child - graph.primitives
                continue
            r = process.rewards[child, s]
            t = draw_step(process, child, s, rng)
            learn_step(graph, table, knobs, s, child, r, t)
            earned += weight * r
            weight *= knobs.discount
            s, steps = t, steps + 1
            if graph.over[running, s]:
                running = 0
        record.returns[episode] = earned
        record.steps[episode] = steps
