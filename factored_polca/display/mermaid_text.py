"""Graphs as Mermaid flowcharts: what is no letter, digit or blank in a name is written as its code."""

from __future__ import annotations

from typing import Final

from factored_polca.display.graphs import Edge, Graph, Kind, Node
from factored_polca.display.words import printable

_BRACKETS: Final[dict[Kind, tuple[str, str]]] = {
    "reward": ("{{", "}}"), "action": ("([", "])"), "terminal": ("([", "])"), "more": ("([", "])"),
    "belief": ("(", ")"),
}  # fmt: skip
_ARROWS: Final = {"solid": "-->", "dashed": "-.->", "faint": "-.->"}


def coded(text: str) -> str:
    """A label's text; `#35;` is Mermaid's way to write the character 35."""
    return "".join(c if c.isalnum() or c in " .,_" else f"#{ord(c)};" for c in printable(text))


def graph_mermaid(graph: Graph) -> str:
    """The text of a flowchart."""
    direction = "LR" if graph.direction == "right" else "TB"
    numbers = {node.key: f"n{k}" for k, node in enumerate(graph.nodes)}
    lines = [f"flowchart {direction}"]
    lines += [f"  {numbers[node.key]}{_node(node)}" for node in graph.nodes]
    lines += [f"  {numbers[e.source]} {_edge(e)} {numbers[e.target]}" for e in graph.edges]
    return "\n".join(lines) + "\n"


def _node(node: Node) -> str:
    opening, closing = _BRACKETS.get(node.kind, ("[", "]"))
    return f'{opening}"{"<br/>".join(map(coded, node.lines))}"{closing}'


def _edge(edge: Edge) -> str:
    arrow = _ARROWS[edge.stroke]
    return f'{arrow}|"{coded(edge.label)}"|' if edge.label else arrow
