"""A decision diagram: its nodes from the top, arcs with the values that they stand for."""

from __future__ import annotations

from typing import Final

import numpy as np

from factored_polca.diagrams import Diagram, Manager, node_count
from factored_polca.diagrams.leaves import describe
from factored_polca.diagrams.nodes import Int32Array
from factored_polca.diagrams.operations import Walk, leaf_payloads
from factored_polca.display.graphs import Edge, Graph, Node
from factored_polca.display.tables import drawing, heading, table, view
from factored_polca.display.words import (
    count_text,
    number_text,
    plural,
    printable,
    short,
    value_text,
    values_text,
)
from factored_polca.models import Value

SHOWN_NODES: Final = 60
SHOWN_LEVELS: Final = 30


def html(diagram: Diagram) -> str:
    """The picture; of a large diagram its upper part, and how many nodes each level has."""
    walk = Walk(diagram)
    count, leaves = len(walk.nodes), int(walk.is_leaf.sum())
    detail = f"{plural(count, 'node')}, of which {count_text(leaves)} {'leaf' if leaves == 1 else 'leaves'}"
    levels = walk.levels.copy()
    return view(
        heading("decision diagram", f"{detail}, {describe(diagram.leaf_type)} values"),
        drawing(graph(diagram)),
        _levels(diagram.manager, levels) if count > SHOWN_NODES else "",
    )


def level_name(manager: Manager, level: int) -> tuple[str, tuple[Value, ...]]:
    """The name of a level and its values: those of the feature, where a model has named them."""
    if manager.describe is not None:
        return manager.describe(level)
    return f"level {level}", tuple(range(manager.sizes[level]))


def arc_text(values: tuple[Value, ...], some: tuple[int, ...]) -> str:
    """The values that an arc stands for."""
    numbers = all(isinstance(v, int) and not isinstance(v, bool) for v in values)
    together = numbers and some == tuple(range(some[0], some[-1] + 1))
    if len(some) > 4 and len(some) > len(values) / 2 and not together:
        left = [v for k, v in enumerate(values) if k not in some]
        return f"not {values_text(left, 3)}"
    return values_text([values[k] for k in some], 4)


def graph(diagram: Diagram) -> Graph:
    """Nodes and arcs, those nearest to the top."""
    manager, count = diagram.manager, node_count(diagram)
    shown = _nearest(diagram)
    drawn, edges, cut = [], list[Edge](), set[int]()
    for node, groups in shown.items():
        if not groups:
            drawn.append(Node(str(node), (_leaf_text(diagram, node),), "terminal", heading=False))
            continue
        name, values = level_name(manager, int(manager.pool[node]))
        drawn.append(Node(str(node), (short(name),), "test", printable(name), heading=False))
        for child, some in groups.items():
            title = f"{name}: {', '.join(value_text(values[k]) for k in some[:50])}"
            if child in shown:
                edges.append(Edge(str(node), str(child), arc_text(values, tuple(some)), title=title))
            else:
                cut.add(node)
    edges += [Edge(str(node), "more", stroke="faint") for node in shown if node in cut]
    if cut:
        more = f"… {plural(count - len(shown), 'more node')}"
        drawn.append(Node("more", (more,), "more", heading=False))
    note = f"shown: the {len(shown)} nodes nearest to the top" if cut else ""
    text = "Decision diagram: tests of features, values on arcs"
    return Graph(tuple(drawn), tuple(edges), text, "auto", note)


def _nearest(diagram: Diagram) -> dict[int, dict[int, list[int]]]:
    """The nodes nearest to the top, by breadth, each with its children and the values that lead there.

    Nodes are those of the manager's store, which keeps them where they are until its next operation.
    """
    root = diagram.node
    found: dict[int, dict[int, list[int]]] = {root: {}}
    queue = [root]
    for node in queue:
        children = _children(diagram.manager, node)
        for value, child in enumerate(children):
            found[node].setdefault(child, []).append(value)
            if child not in found and len(found) < SHOWN_NODES:
                found[child] = {}
                queue.append(child)
    return found


def _children(manager: Manager, node: int) -> list[int]:
    level = int(manager.pool[node])
    if level == manager.leaf_level:
        return []
    return [int(child) for child in manager.pool[node + 2 : node + 2 + manager.sizes[level]]]


def _leaf_text(diagram: Diagram, node: int) -> str:
    payload = int(leaf_payloads(diagram.manager, np.array([node], dtype=np.int32))[0])
    leaf = diagram.leaf_type.decode(payload)
    return number_text(leaf) if isinstance(leaf, float) else short(str(leaf))


def _levels(manager: Manager, levels: Int32Array) -> str:
    counts = np.bincount(levels, minlength=manager.leaf_level + 1)[: manager.leaf_level]
    tested = np.flatnonzero(counts).tolist()
    rows = [(short(level_name(manager, level)[0]), count_text(int(counts[level]))) for level in tested]
    if len(rows) > SHOWN_LEVELS:
        rows = [*rows[:SHOWN_LEVELS], ("…", f"{len(rows) - SHOWN_LEVELS} more levels")]
    return table(["tests", "nodes"], rows)
