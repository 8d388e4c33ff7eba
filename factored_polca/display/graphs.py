"""Graphs that are drawn: nodes with lines of text, and arcs between them.

A graph says what is shown, not where: `layout` places it, `svg`, `dot` and `mermaid` write it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal[
    "feature",
    "next",
    "observation",
    "reward",
    "task",
    "action",
    "test",
    "block",
    "terminal",
    "belief",
    "more",
]
"""What a node stands for: its shape and colour."""

Direction = Literal["down", "right", "auto"]

Stroke = Literal["solid", "dashed", "faint"]


@dataclass(frozen=True)
class Node:
    """A node: its text, the first line in bold where it is a `heading`, and a tooltip.

    `rank` is the least layer that it may stand in, from 0.
    """

    key: str
    lines: tuple[str, ...]
    kind: Kind
    title: str = ""
    heading: bool = True
    rank: int = 0


@dataclass(frozen=True)
class Edge:
    """An arc from one node to another, or to itself."""

    source: str
    target: str
    label: str = ""
    stroke: Stroke = "solid"
    title: str = ""


@dataclass(frozen=True)
class Graph:
    """Nodes and arcs; `description` says in a sentence what is seen, also to those who can't see it.

    `note` says what was left out, if anything was.
    """

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]
    description: str
    direction: Direction = "auto"
    note: str = ""

    def __post_init__(self) -> None:
        keys = {node.key for node in self.nodes}
        if len(keys) < len(self.nodes):
            raise ValueError("two nodes of a graph have one key")
        lost = [edge for edge in self.edges if edge.source not in keys or edge.target not in keys]
        if lost:
            raise ValueError(f"an arc from {lost[0].source!r} to {lost[0].target!r} has no node at an end")
