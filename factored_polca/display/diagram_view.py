"""A decision diagram: its nodes from the top, arcs with the values that they stand for."""

from __future__ import annotations

from typing import Final

from factored_polca.diagrams import Diagram, Manager
from factored_polca.diagrams.leaves import describe
from factored_polca.display.graphs import Edge, Graph, Node
from factored_polca.display.nodes import Nodes, read_nodes
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
    nodes = read_nodes(diagram)
    leaves = sum(1 for below in nodes.children if not below)
    detail = f"{plural(len(nodes.levels), 'node')}, of which {plural(leaves, 'leaf')}".replace(
        "leafs", "leaves"
    )
    return view(
        heading("decision diagram", f"{detail}, {describe(diagram.leaf_type)} values"),
        drawing(_graph(diagram.manager, nodes)),
        _levels(diagram.manager, nodes) if len(nodes.levels) > SHOWN_NODES else "",
    )


def graph(diagram: Diagram) -> Graph:
    """Nodes and arcs, those nearest to the top."""
    return _graph(diagram.manager, read_nodes(diagram))


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


def _graph(manager: Manager, nodes: Nodes) -> Graph:
    shown = _nearest(nodes)
    drawn, edges, cut = [], list[Edge](), False
    for node in shown:
        below = nodes.children[node]
        if not below:
            leaf = nodes.leaves[node]
            text = (
                number_text(leaf)
                if isinstance(leaf, float)
                else value_text(leaf if leaf is not None else 0)
            )
            drawn.append(Node(str(node), (short(text),), "terminal", heading=False))
            continue
        name, values = level_name(manager, nodes.levels[node])
        drawn.append(Node(str(node), (short(name),), "test", printable(name), heading=False))
        for child, some in nodes.groups(node):
            target = str(child) if child in shown else "more"
            cut = cut or target == "more"
            title = f"{name}: {', '.join(value_text(values[k]) for k in some[:50])}"
            edges.append(Edge(str(node), target, arc_text(values, some), title=title))
    left = len(nodes.levels) - len(shown)
    if cut:
        drawn.append(Node("more", (f"… {plural(left, 'more node')}",), "more", heading=False))
    note = f"shown: the {len(shown)} nodes nearest to the top" if cut else ""
    return Graph(
        tuple(drawn), tuple(edges), "Decision diagram: tests of features, values on arcs", "auto", note
    )


def _nearest(nodes: Nodes) -> dict[int, None]:
    """The nodes nearest to the top, by breadth, as many as are shown."""
    found = {nodes.root: None}
    queue = [nodes.root]
    for node in queue:
        for child, _ in nodes.groups(node):
            if child not in found and len(found) < SHOWN_NODES:
                found[child] = None
                queue.append(child)
    return found


def _levels(manager: Manager, nodes: Nodes) -> str:
    counts: dict[int, int] = {}
    for level, below in zip(nodes.levels, nodes.children, strict=True):
        if below:
            counts[level] = counts.get(level, 0) + 1
    rows = [(short(level_name(manager, level)[0]), count_text(counts[level])) for level in sorted(counts)]
    if len(rows) > SHOWN_LEVELS:
        rows = [*rows[:SHOWN_LEVELS], ("…", f"{len(rows) - SHOWN_LEVELS} more levels")]
    return table(["tests", "nodes"], rows)
