"""A policy without a hierarchy, as `solve` finds it: a graph with the belief on each node, or a table."""

from __future__ import annotations

from typing import Final

import numpy as np

from factored_polca.diagrams import Diagram
from factored_polca.diagrams.nodes import Int32Array
from factored_polca.display.belief_graph import by_feature, followable, policy_graph
from factored_polca.display.graphs import Graph
from factored_polca.display.policy_tree import policy_tree
from factored_polca.display.tables import drawing, heading, line, table, view
from factored_polca.display.words import count_text, number_text, percent, plural, short
from factored_polca.explicit.arrays import IntArray
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.hierarchy.policy_file import FlatPolicy
from factored_polca.symbolic import SymbolicModel

LARGEST: Final = 20_000
"""Listed states up to which a policy of states is drawn as a tree."""


def html(policy: FlatPolicy) -> str:
    """What was said when it was made, and the graph."""
    detail = (
        f"{plural(len(policy.flat.states), 'state')} listed, {plural(len(policy.model.actions), 'action')}"
    )
    found = policy.policy
    if isinstance(found, StatePolicy):
        body = _actions(policy, found)
        body += drawing(graph(policy)) if len(policy.flat.states) <= LARGEST else ""
    elif followable(policy.flat.pomdp):
        body = drawing(graph(policy))
    else:
        body = line("too many states and observations to follow beliefs here")
    return view(heading(f"policy for {short(policy.model.name)}", detail), line(_said(policy)), body)


def graph(policy: FlatPolicy) -> Graph:
    """The policy from the initial belief on; of states a decision tree (of a horizon, the first step's)."""
    found = policy.policy
    if isinstance(found, StatePolicy):
        symbolic, names = policy.flat.symbolic, [action.name for action in policy.model.actions]
        choices = np.where(found.actions[-1] < 0, len(names), found.actions[-1])
        diagram = listed_function(symbolic, policy.flat.states, choices, len(names))
        return policy_tree(symbolic, diagram, names, "none, or not reached")
    states = policy.flat.states.astype(np.int64)
    return policy_graph(policy.flat.pomdp, found, by_feature(policy.model.features, states))


def listed_function(symbolic: SymbolicModel, states: Int32Array, values: IntArray, other: int) -> Diagram:
    """The diagram of a function: `values` [s] at listed states [s, feature], `other` elsewhere."""
    manager = symbolic.manager
    order = sorted(range(states.shape[1]), key=symbolic.now)
    known: dict[tuple[int, bytes], Diagram] = {}

    def build(rows: IntArray, place: int) -> Diagram:
        if len(rows) == 0:
            return manager.constant(other)
        if place == len(order):
            return manager.constant(int(values[rows[0]]))
        key = (place, states[rows][:, order[place:]].tobytes() + values[rows].tobytes())
        if key not in known:
            feature = order[place]
            size = len(symbolic.model.features[feature].values)
            digits = states[rows, feature]
            below = [build(rows[digits == v], place + 1) for v in range(size)]
            known[key] = manager.variable(symbolic.now(feature), below)
        return known[key]

    everything = np.lexsort([states[:, feature] for feature in reversed(order)])
    return build(everything.astype(np.int64), 0)


def _said(policy: FlatPolicy) -> str:
    lower, upper = policy.report.get("lower"), policy.report.get("upper")
    if not (isinstance(lower, float) and isinstance(upper, float)):
        return ""
    return f"value from the start between {number_text(lower, 9)} and {number_text(upper, 9)}"


def _actions(policy: FlatPolicy, found: StatePolicy) -> str:
    first = found.actions[-1]
    rows = []
    for number, action in enumerate(policy.model.actions):
        states = np.flatnonzero(first == number)
        if len(states):
            such = short(policy.flat.state_text(int(states[0])), 100)
            rows.append(
                (short(action.name), count_text(len(states)), percent(len(states) / len(first)), such)
            )
    return table(["action", "states", "share", "such as"], rows[:40], left=(0, 3))
