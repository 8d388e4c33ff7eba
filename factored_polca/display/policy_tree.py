"""A policy of states as a decision tree over features.

The policy is a diagram from states to choices.  At each node of the tree the feature is tested that tells
most about the choice for the number of branches it makes, by the gain ratio of Quinlan (C4.5, 1993), all
states weighing the same:

    gain(i)  = H(choice) - sum over v of P(x_i = v) H(choice | x_i = v)
    ratio(i) = gain(i) / H(x_i), values with one and the same distribution of choices counted as one.

Values that lead to the same function share a branch.  Of a large tree the parts with the most states are
unfolded first, and what is left says which share of its states each choice has.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Final

import numpy as np

from factored_polca.diagrams import Diagram, cofactors, node_count
from factored_polca.display.diagram_view import arc_text
from factored_polca.display.graphs import Edge, Graph, Kind, Node
from factored_polca.display.nodes import Nodes, read_nodes
from factored_polca.display.words import count_text, percent, plural, printable, short
from factored_polca.explicit.arrays import FloatArray
from factored_polca.symbolic import SymbolicModel

SHOWN_NODES: Final = 60

LARGEST: Final = 20_000
"""Nodes of a diagram beyond which the top feature is tested, and no shares are worked out."""


@dataclass(frozen=True)
class Part:
    """A part of the tree: its function, the share of all states that lead there, and the level tested.

    `nodes` is None where the function's diagram is too large.
    """

    key: str
    function: Diagram
    share: Fraction
    nodes: Nodes | None
    level: int | None = None

    @property
    def leaf(self) -> int | None:
        """The choice, where there is only one."""
        return int(self.function.value) if self.function.is_constant else None


def made(key: str, function: Diagram, share: Fraction) -> Part:
    """A part that is not unfolded."""
    small = node_count(function) <= LARGEST
    return Part(key, function, share, read_nodes(function) if small else None)


def policy_tree(
    symbolic: SymbolicModel, policy: Diagram, choices: Sequence[str], none: str = "none"
) -> Graph:
    """The tree of a diagram over present states with numbers of `choices`; any other leaf means `none`."""
    features = {symbolic.now(k): feature for k, feature in enumerate(symbolic.model.features)}
    names, states = [*choices, none], symbolic.model.states
    parts, edges = _unfolded(symbolic, policy, len(choices))
    drawn, cut = [], 0
    for part in parts:
        count = plural(int(part.share * states), "state")
        if part.leaf is not None:
            chosen = min(part.leaf, len(choices))
            kind: Kind = "action" if chosen < len(choices) else "terminal"
            name = names[chosen]
            drawn.append(
                Node(part.key, (short(name),), kind, f"{printable(name)}: {count}", chosen < len(choices))
            )
        elif part.level is not None:
            name = features[part.level].name
            drawn.append(
                Node(part.key, (short(name),), "test", f"{printable(name)}: {count}", heading=False)
            )
        else:
            cut += 1
            drawn.append(Node(part.key, _mixture(part.nodes, names), "more", count, heading=False))
    note = ""
    if cut:
        note = (
            f"dashed: {plural(cut, 'part')} not unfolded, with the share of its states that each choice has"
        )
    text = f"Policy as a decision tree over features, {count_text(states)} states"
    return Graph(tuple(drawn), tuple(edges), text, "right", note)


def _unfolded(symbolic: SymbolicModel, policy: Diagram, count: int) -> tuple[list[Part], list[Edge]]:
    """The parts that are shown and the arcs between them, the parts with the most states unfolded first."""
    features = {symbolic.now(k): feature for k, feature in enumerate(symbolic.model.features)}
    parts, edges = [made("0", policy, Fraction(1))], list[Edge]()
    heap = [(-parts[0].share, 0)]
    while heap:
        _, number = heapq.heappop(heap)
        part = parts[number]
        if part.leaf is not None:
            continue
        level = part.function.level
        if part.nodes is not None:
            level = _best_level(part.nodes, {n: len(f.values) for n, f in features.items()}, count)
        groups: list[tuple[Diagram, list[int]]] = []
        for value, function in enumerate(cofactors(part.function, level)):
            same = next((some for other, some in groups if other == function), None)
            if same is None:
                groups.append((function, [value]))
            else:
                same.append(value)
        if len(parts) + len(groups) > SHOWN_NODES:
            continue
        parts[number], values = replace(part, level=level), features[level].values
        for function, some in groups:
            share = part.share * Fraction(len(some), len(values))
            below = made(str(len(parts)), function, share)
            edges.append(Edge(part.key, below.key, arc_text(values, tuple(some))))
            heapq.heappush(heap, (-share, len(parts)))
            parts.append(below)
    return parts, edges


def shares(nodes: Nodes, count: int) -> FloatArray:
    """The share of the states below each node that each choice has [node, choice]; "none" is the last."""
    result = np.zeros((len(nodes.levels), count + 1))
    for node, below in enumerate(nodes.children):
        leaf = nodes.leaves[node]
        if leaf is None:
            result[node] = result[list(below)].mean(axis=0)
        else:
            result[node, min(int(leaf), count)] = 1.0
    return result


def _best_level(nodes: Nodes, sizes: dict[int, int], count: int) -> int:
    """The level with the highest gain ratio, the top one of equals."""
    support = nodes.support
    if len(support) == 1:
        return support[0]
    below = shares(nodes, count)
    reach = np.zeros(len(nodes.levels))
    reach[nodes.root] = 1.0
    joint = {level: np.zeros((sizes[level], count + 1)) for level in support}
    met = {level: np.zeros(count + 1) for level in support}
    for node in range(nodes.root, -1, -1):
        children, level = nodes.children[node], nodes.levels[node]
        for value, child in enumerate(children):
            passed = reach[node] / len(children)
            reach[child] += passed
            joint[level][value] += passed * below[child]
        if children:
            met[level] += reach[node] * below[node]
    whole = below[nodes.root]
    best, best_ratio = support[0], -1.0
    for level in support:
        table = joint[level] + (whole - met[level]) / sizes[level]  # paths that skip the level
        classes: dict[tuple[float, ...], float] = {}
        for row in table:
            key = tuple(np.round(row, 12).tolist())
            classes[key] = classes.get(key, 0.0) + float(row.sum())
        gain = _entropy(whole) - sum(float(row.sum()) * _entropy(row) for row in table)
        split = _entropy(np.array(list(classes.values())))
        ratio = gain / split if split > 1e-12 else 0.0
        if ratio > best_ratio + 1e-12:
            best, best_ratio = level, ratio
    return best


def _entropy(weights: FloatArray) -> float:
    inside = weights[weights > 1e-15]
    if len(inside) == 0:
        return 0.0
    q = inside / inside.sum()
    return float(-(q * np.log2(q)).sum())


def _mixture(nodes: Nodes | None, names: Sequence[str]) -> tuple[str, ...]:
    if nodes is None:
        return ("…",)
    found = shares(nodes, len(names) - 1)[nodes.root]
    used = [k for k in np.argsort(-found, kind="stable").tolist() if found[k] > 0]
    said = [f"{short(names[k], 18)} {percent(float(found[k]))}" for k in used[:3]]
    return (", ".join(said) + (f", {len(used) - 3} more" if len(used) > 3 else ""),)
