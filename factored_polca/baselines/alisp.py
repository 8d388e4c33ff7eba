"""The three-part decomposition of ALisp (Andre & Russell, AAAI 2002), learned by HORDQ.

An ALisp program leaves some choices open.  At such a choice point omega (state and stack of the program)
the value of the choice u has three parts, each with an abstraction of its own:

    Q(omega, u) = Q_r(omega, u)    earned while u is carried out
                + Q_c(omega, u)    earned after that, until the running procedure returns
                + Q_e(omega, u)    earned after that, until the end of the program

u* maximises the sum, so the limit is *hierarchically* optimal: a procedure knows, by Q_e, what its end is
good for.  Let omega' be the next choice point of the same procedure, reached in N steps, and c what was
earned between u and omega' (by a tail, a primitive action that the program leaves no choice about):

    Q_r(omega, u)  <-  r of a primitive action u;  (Q_r + Q_c)(first choice point below, u*) of a
                       procedure u, 0 where that makes no choice
    Q_c(omega, u)  <-  c + gamma^N (Q_r + Q_c)(omega', u*);  c where the procedure returns
    Q_e(omega, u)  <-  gamma^N Q_e(omega', u*);  where the procedure returns: what is earned from its return
                       to the next choice point at all, and gamma^(steps) Q there; 0 at the end

Taxi's program and features are those that were published with the ALisp library (B. Marthi,
"programmable-reinforcement-learning", td-taxi-prog.lisp and td-taxi-prog-features.lisp, read there with
the library's hordq.lisp, which the rules above restate).  The library's tutorial says that its program is
adapted from Andre & Russell 2002; that paper's own table of features could not be read.  `taxi_methods`
lists the features.  Like MAXQ's, they are exact at gamma = 1 only.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from factored_polca.baselines.learning import Knobs, Method, Record, epsilon_of
from factored_polca.baselines.process import ProcessArrays, draw_start, draw_step
from factored_polca.baselines.tables import Table, TableArrays, stored, update
from factored_polca.baselines.task_graph import NONE, GraphArrays, TaskGraph, pick
from factored_polca.explicit.arrays import IntArray
from factored_polca.solvers.compiled import kernel


def alisp(graph: TaskGraph, during: Table, completing: Table, after: Table) -> Method:
    """HORDQ with Q_r, Q_c and Q_e stored in the three tables [pair, s]."""
    return Method("ALisp", graph, (during, completing, after), run_episodes, greedy_choice)


@kernel
def best_pair(graph: GraphArrays, tables: tuple[TableArrays, ...], task: int, state: int) -> int:
    """The first pair of the task with the largest sum of the three parts, or NONE."""
    best, value = NONE, -np.inf
    for p in range(graph.first[task], graph.first[task + 1]):
        if graph.child[p, state] >= 0:
            mine = stored(tables[0], p, state) + stored(tables[1], p, state) + stored(tables[2], p, state)
            if mine > value:
                best, value = p, mine
    return best


@kernel
def greedy_choice(graph: GraphArrays, tables: tuple[TableArrays, ...], choice: IntArray) -> None:
    """Write the greedy pair of each task and state into `choice` [task, s]."""
    for i in range(graph.over.shape[0]):
        for s in range(graph.over.shape[1]):
            choice[i, s] = best_pair(graph, tables, i, s)


@kernel
def run_episodes(
    process: ProcessArrays, graph: GraphArrays, tables: tuple[TableArrays, ...], knobs: Knobs,
    first: int, last: int, record: Record, rng: Any,
) -> None:  # fmt: skip
    """Learn from the episodes `first` to `last` - 1."""
    during, completing, after = tables
    gamma, power, depth = knobs.discount, knobs.power, graph.depth
    task = np.zeros(depth, dtype=np.int64)  # [level] the procedures that run, the root first
    called = np.zeros(depth, dtype=np.int64)  # [level] the pair that each chose last, NONE before
    where = np.zeros(depth, dtype=np.int64)  # [level] the state where it did
    gain = np.zeros(depth)  # [level] what its tail has earned since that choice was carried out
    fading = np.zeros(depth)  # [level] gamma^(steps since that choice)
    known = np.zeros(depth, dtype=np.bool_)  # [level] Q_r of that choice has been updated
    # Choices whose procedure has returned, waiting for the next choice point to update Q_e.
    left_pair = np.zeros(depth, dtype=np.int64)
    left_where = np.zeros(depth, dtype=np.int64)
    left_gain, left_fading = np.zeros(depth), np.zeros(depth)
    for episode in range(first, last):
        epsilon = epsilon_of(knobs, episode)
        s = draw_start(process, rng)
        record.starts[episode] = s
        earned, weight, steps, top, left = 0.0, 1.0, 0, 0, 0
        called[0], tailing = NONE, False
        while top >= 0 and steps < knobs.limit:
            i = task[top]
            if tailing:
                action = graph.tail[i]
            else:
                best = best_pair(graph, tables, i, s)
                if best < 0:
                    break
                inner = stored(during, best, s) + stored(completing, best, s)
                outer = stored(after, best, s)
                if called[top] >= 0:  # the choice before, at this level
                    update(completing, called[top], where[top], gain[top] + fading[top] * inner, power)
                    update(after, called[top], where[top], fading[top] * outer, power)
                elif top > 0 and not known[top - 1]:  # the choice that called this procedure
                    update(during, called[top - 1], where[top - 1], inner, power)
                    known[top - 1] = True
                for k in range(left):
                    rest = left_gain[k] + left_fading[k] * (inner + outer)
                    update(after, left_pair[k], left_where[k], rest, power)
                left = 0
                p = pick(graph, i, s, best, epsilon, rng)
                called[top], where[top], gain[top], fading[top], known[top] = p, s, 0.0, 1.0, False
                action = graph.child[p, s]
                if action >= graph.primitives:
                    j = action - graph.primitives
                    if graph.over[j, s]:  # it returns at once; only before a tail
                        update(during, p, s, 0.0, power)
                        known[top], tailing = True, True
                    else:
                        top += 1
                        task[top], called[top] = j, NONE
                    continue
            r = process.rewards[action, s]
            if tailing:
                gain[top] += fading[top] * r
            else:
                update(during, called[top], where[top], r, power)
                known[top] = True
            for level in range(top + 1):
                fading[level] *= gamma
            for k in range(left):
                left_gain[k] += left_fading[k] * r
                left_fading[k] *= gamma
            s = draw_step(process, action, s, rng)
            earned += weight * r
            weight *= gamma
            steps += 1
            ended = process.terminal[s]
            returning = ended or tailing or (graph.tail[i] < 0 and graph.over[i, s])
            tailing = not tailing and graph.tail[i] >= 0
            while returning:  # the procedure at `top` returns
                update(completing, called[top], where[top], gain[top], power)
                left_pair[left], left_where[left] = called[top], where[top]
                left_gain[left], left_fading[left] = 0.0, fading[top]
                left += 1
                top -= 1
                if top < 0:
                    break
                tailing = graph.tail[task[top]] >= 0
                returning = ended or (not tailing and graph.over[task[top], s])
        if top < 0:  # the program has ended, and nothing comes after
            for k in range(left):
                update(after, left_pair[k], left_where[k], left_gain[k], power)
        record.returns[episode] = earned
        record.steps[episode] = steps
