"""The learners on Taxi, with the state abstractions that were made for it by hand.

MAXQ, from Dietterich (JAIR 13, 2000, section 5.1.6), L being the 25 cells, W the waiting places, D the 4
destinations:

    V of a move                  1 value each          V of Pickup, of Putdown     2 each: legal or not
    C(Navigate(t), s, move)      W * L * 4 moves       C(Get, s, Navigate)         W, by the source
    C(Get, s, Pickup)            W * L                 C(Put, s, Navigate)         D, by the destination
    C(Put, s, Putdown)           D * L                 C(Root, s, Get)             W * D
    C(Root, s, Put)              none: the end of Put is the end of Root, and Put runs in no other states

632 in all for Taxi, and 3362 by the same rules for Taxi2.  A Get is only ever asked about where the
passenger waits, a Put where he is aboard.

ALisp, from the library's td-taxi-prog-features.lisp; a part without features is one value for its choice
point:

    choice point                 Q_r                          Q_c                      Q_e
    Root: Get or Put             position, aboard?, source,   the same without         (one value)
                                 destination, choice          the position
    Get: the call of Navigate    position, source             (one value)              distance
    Put: the call of Navigate    position, destination        aboard?                  aboard?, distance
    Navigate: a move             position, move               position, move, target   aboard?, under Put?,
                                                                                       distance

`distance` is the number of moves from source to destination.  The library's states remember the source of
a passenger who is aboard, these do not: where he is aboard there is one value in its place.  Entries are
those feature values that occur in some state that is not terminal.
"""

from __future__ import annotations

import numpy as np

from factored_polca.baselines.alisp import alisp
from factored_polca.baselines.hsmq import hsmq
from factored_polca.baselines.learning import Method
from factored_polca.baselines.maxq import maxq, maxq_without_abstraction
from factored_polca.baselines.options import options
from factored_polca.baselines.process import IndexArray
from factored_polca.baselines.q_learning import q_learning
from factored_polca.baselines.tables import Numbering, Table
from factored_polca.baselines.task_graph import NONE, TaskGraph
from factored_polca.baselines.taxi import TaxiFacts, alisp_graph, dietterich_graph, options_graph
from factored_polca.explicit.arrays import IntArray


def taxi_methods(facts: TaxiFacts) -> tuple[Method, ...]:
    """All learners, without and with abstraction."""
    process, graph = facts.process, dietterich_graph(facts)
    return (
        q_learning(process),
        hsmq(process, graph),
        options(process, options_graph(facts)),
        maxq_without_abstraction(process, graph),
        maxq_by_hand(facts, graph),
        alisp_by_hand(facts, alisp_graph(facts)),
    )


def maxq_by_hand(facts: TaxiFacts, graph: TaskGraph) -> Method:
    """MAXQ-Q with Dietterich's abstraction, on `dietterich_graph`."""
    completion, primitive = maxq_tables(facts, graph)
    return maxq("MAXQ, by hand", graph, completion, primitive)


def maxq_tables(facts: TaxiFacts, graph: TaskGraph) -> tuple[Table, Table]:
    """The tables of C and V with Dietterich's abstraction."""
    live, states = facts.process.live, facts.process.states
    numbering = Numbering(states)
    waiting, aboard = live & facts.waiting, live & facts.aboard
    rows: list[IndexArray] = []
    for task, slot in graph.pairs:
        if (task, slot) == ("Root", "Get"):
            rows.append(numbering.entries(waiting, facts.source, facts.goal))
        elif (task, slot) == ("Root", "Put"):
            rows.append(numbering.none())
        elif (task, slot) == ("Get", "Navigate"):
            rows.append(numbering.entries(waiting, facts.source))
        elif (task, slot) == ("Get", "Pickup"):
            rows.append(numbering.entries(waiting, facts.source, facts.cell))
        elif (task, slot) == ("Put", "Navigate"):
            rows.append(numbering.entries(aboard, facts.goal))
        elif (task, slot) == ("Put", "Putdown"):
            rows.append(numbering.entries(aboard, facts.goal, facts.cell))
        else:
            rows.append(numbering.entries(live, facts.cell))
    completion = numbering.table("C", rows)
    numbering = Numbering(states)
    legal = {
        "Pickup": facts.waiting & facts.at(facts.source),
        "Putdown": facts.aboard & facts.at(facts.goal),
    }
    primitive = [
        numbering.entries(live, legal[name]) if name in legal else numbering.entries(live)
        for name in facts.process.actions
    ]
    return completion, numbering.table("V", primitive)


def alisp_by_hand(facts: TaxiFacts, graph: TaskGraph) -> Method:
    """HORDQ with the published features, on `alisp_graph`."""
    live, states, moves = facts.process.live, facts.process.states, len(facts.moves)
    waiting = live & facts.waiting
    distance = source_to_goal(facts)
    during, completing, after = Numbering(states), Numbering(states), Numbering(states)
    r: list[IndexArray] = []
    c: list[IndexArray] = []
    e: list[IndexArray] = []
    move_r = [during.entries(live, facts.cell) for _ in range(moves)]
    move_c = {place: [completing.entries(live, facts.cell) for _ in range(moves)] for place in facts.places}
    root_e = after.entries(live)
    move_e = {
        "Get's Navigate": after.entries(waiting, distance),
        "Put's Navigate": after.entries(live, facts.aboard, distance),
    }
    for task, slot in graph.pairs:
        caller, _, target = task.partition("_")
        if task == "Root":
            where = waiting if slot == "Get" else live
            r.append(during.entries(where, facts.cell, facts.aboard, facts.source, facts.goal))
            c.append(completing.entries(where, facts.aboard, facts.source, facts.goal))
            e.append(root_e)
        elif task == "Get":
            r.append(during.entries(waiting, facts.cell, facts.source))
            c.append(completing.entries(waiting))
            e.append(after.entries(waiting, distance))
        elif task == "Put":
            r.append(during.entries(live, facts.cell, facts.goal))
            c.append(completing.entries(live, facts.aboard))
            e.append(after.entries(live, facts.aboard, distance))
        else:
            number = facts.moves.index(slot)
            r.append(move_r[number])
            c.append(move_c[target][number])
            e.append(move_e[caller])
    return alisp(graph, during.table("Q_r", r), completing.table("Q_c", c), after.table("Q_e", e))


def source_to_goal(facts: TaxiFacts) -> IntArray:
    """[s], the moves from the passenger's source to his destination; NONE where he does not wait.

    Distances are those of the moves that may succeed, whatever their chances.
    """
    process, cells = facts.process, int(facts.cell.max()) + 1
    step = np.zeros((cells, cells), dtype=np.bool_)  # [from, to]
    for move in facts.moves:
        for k in range(process.arrays.successors.shape[2]):
            after = process.arrays.successors[facts.action(move), :, k]
            step[facts.cell[process.live], facts.cell[after][process.live]] = True
    moves = np.full((len(facts.places), cells), NONE)
    for goal in facts.goals:
        moves[goal, facts.place_cells[goal]] = 0
        reached, count = moves[goal] == 0, 0
        while True:
            count += 1
            fresh = (step & reached).any(axis=1) & ~reached
            if not fresh.any():
                break
            moves[goal, fresh] = count
            reached |= fresh
    found: IntArray = np.where(facts.waiting, moves[facts.goal, facts.place_cells[facts.source]], NONE)
    return found
