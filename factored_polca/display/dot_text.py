"""Graphs as text in the language of Graphviz: quoted strings only, every name escaped."""

from __future__ import annotations

from typing import Final

from factored_polca.display.graphs import Edge, Graph, Kind, Node
from factored_polca.display.words import printable

_SHAPES: Final[dict[Kind, str]] = {
    "feature": "box", "next": "box", "observation": "box", "reward": "diamond", "task": "box",
    "action": "ellipse", "test": "box", "block": "box", "terminal": "ellipse", "belief": "box",
    "more": "plaintext",
}  # fmt: skip
_STYLES: Final = {"solid": "", "dashed": ", style=dashed", "faint": ", color=gray"}


def quoted(text: str) -> str:
    """A string of the language; backslashes are kept from being escapes."""
    return '"' + printable(text).replace("\\", "\\\\").replace('"', '\\"') + '"'


def graph_dot(graph: Graph) -> str:
    """The text of a .dot file."""
    direction = "LR" if graph.direction == "right" else "TB"
    numbers = {node.key: f"n{k}" for k, node in enumerate(graph.nodes)}
    lines = ["digraph {", f"  rankdir={direction};", f"  label={quoted(graph.description)};"]
    lines += [f"  {numbers[node.key]} [{_node(node)}];" for node in graph.nodes]
    lines += [f"  {numbers[e.source]} -> {numbers[e.target]} [{_edge(e)}];" for e in graph.edges]
    return "\n".join([*lines, "}"]) + "\n"


def _node(node: Node) -> str:
    label = "\\n".join(quoted(line)[1:-1] for line in node.lines)
    return f'label="{label}", shape={_SHAPES[node.kind]}'


def _edge(edge: Edge) -> str:
    return f"label={quoted(edge.label)}{_STYLES[edge.stroke]}"
