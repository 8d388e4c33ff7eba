"""A policy without a hierarchy, as `solve` finds it: a graph with the belief on each node, or a table."""

from __future__ import annotations

import numpy as np

from factored_polca.display.belief_graph import by_feature, followable, policy_graph
from factored_polca.display.graphs import Graph
from factored_polca.display.tables import drawing, heading, line, table, view
from factored_polca.display.words import count_text, number_text, percent, plural, short
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.hierarchy.policy_file import FlatPolicy


def html(policy: FlatPolicy) -> str:
    """What was said when it was made, and the graph."""
    detail = (
        f"{plural(len(policy.flat.states), 'state')} listed, {plural(len(policy.model.actions), 'action')}"
    )
    found = policy.policy
    if isinstance(found, StatePolicy):
        body = _actions(policy, found)
    elif followable(policy.flat.pomdp):
        body = drawing(graph(policy))
    else:
        body = line("too many states and observations to follow beliefs here")
    return view(heading(f"policy for {short(policy.model.name)}", detail), line(_said(policy)), body)


def graph(policy: FlatPolicy) -> Graph:
    """The policy from the initial belief on.

    Raises:
        TypeError: a policy of states, which has no graph.
    """
    found = policy.policy
    if isinstance(found, StatePolicy):
        raise TypeError("a policy of states has no graph; plan the model to see it as a decision tree")
    return policy_graph(
        policy.flat.pomdp, found, by_feature(policy.model.features, policy.flat.states.astype(np.int64))
    )


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
