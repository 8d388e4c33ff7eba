"""Layers of a graph and the order within them (Sugiyama, Tagawa & Toda 1981).

1. arcs that close a cycle of a depth-first search are turned round;
2. a node's layer is the length of the longest path that leads to it, sources are drawn near their first
   successor (Eades & Sugiyama 1990);
3. each label is a node of its own, on the layers in between, so that labels have room as boxes have;
   an arc over several layers gets a *joint* on each layer that it passes;
4. layers are ordered by the mean position of their neighbours, in sweeps down and up; the order with
   the fewest crossings is kept.
"""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import networkx as nx

from factored_polca.display.graphs import Edge, Graph

SWEEPS: Final = 16


@dataclass(frozen=True)
class Chain:
    """An arc as a chain of places from the upper layer to the lower one.

    `place` numbers are those of `Layers`; `turned` says that the arc points from the last to the first.
    """

    edge: Edge
    places: tuple[int, ...]
    turned: bool


@dataclass
class Layers:
    """Places 0, 1, ...: nodes first, in the graph's order, then labels and joints.

    `rank` [place] is the layer, `order` [layer] the places of each layer from left to right; `labels` maps
    places to the texts that stand there.
    """

    rank: list[int]
    order: list[list[int]]
    chains: list[Chain]
    labels: dict[int, str] = field(default_factory=dict)
    joints: set[int] = field(default_factory=set)


def merged(edges: Sequence[Edge]) -> list[Edge]:
    """Arcs between different nodes, those from one node to another as one, with all their labels."""
    found: dict[tuple[str, str], list[Edge]] = {}
    for edge in edges:
        if edge.source != edge.target:
            found.setdefault((edge.source, edge.target), []).append(edge)
    result = []
    for same in found.values():
        first = same[0]
        label = ", ".join(edge.label for edge in same if edge.label)
        title = "; ".join(edge.title for edge in same if edge.title)
        result.append(Edge(first.source, first.target, label, first.stroke, title))
    return result


def make_layers(graph: Graph, longest_label: int = 30) -> Layers:
    """Layers, labels, joints, and their order."""
    number = {node.key: place for place, node in enumerate(graph.nodes)}
    edges = merged(graph.edges)
    pairs = [(number[edge.source], number[edge.target]) for edge in edges]
    back = _closing(len(graph.nodes), pairs)
    forward = [(t, s) if turned else (s, t) for (s, t), turned in zip(pairs, back, strict=True)]
    rank = _ranks([node.rank for node in graph.nodes], forward)
    labelled = any(edge.label for edge in edges)
    layers = Layers([r * 2 for r in rank] if labelled else rank, [], [])
    for edge, (above, below), turned in zip(edges, forward, back, strict=True):
        layers.chains.append(_chain(layers, edge, above, below, turned, longest_label))
    _order(layers)
    return layers


def _closing(count: int, pairs: Sequence[tuple[int, int]]) -> list[bool]:
    """Which arcs lead back to a node on the path of a depth-first search that starts at sources."""
    following: list[list[tuple[int, int]]] = [[] for _ in range(count)]
    entered = [0] * count
    for k, (source, target) in enumerate(pairs):
        following[source].append((target, k))
        entered[target] += 1
    back = [False] * len(pairs)
    state = [0] * count  # 1 on the path, 2 left for good
    for start in sorted(range(count), key=lambda v: (entered[v] > 0, v)):
        if state[start]:
            continue
        stack = [(start, iter(following[start]))]
        state[start] = 1
        while stack:
            here, rest = stack[-1]
            step = next(rest, None)
            if step is None:
                state[here] = 2
                stack.pop()
            elif state[step[0]] == 1:
                back[step[1]] = True
            elif state[step[0]] == 0:
                state[step[0]] = 1
                stack.append((step[0], iter(following[step[0]])))
    return back


def _ranks(least: Sequence[int], pairs: Sequence[tuple[int, int]]) -> list[int]:
    """Longest paths, at least `least`; then sources move down to their first successor."""
    graph = nx.DiGraph()
    graph.add_nodes_from(range(len(least)))
    graph.add_edges_from(pairs)
    rank = list(least)
    for place in nx.topological_sort(graph):
        for target in graph.successors(place):
            rank[target] = max(rank[target], rank[place] + 1)
    for place in graph:
        if graph.in_degree(place) == 0 and graph.out_degree(place) > 0:
            rank[place] = max(rank[place], min(rank[t] for t in graph.successors(place)) - 1)
    lowest = min(rank, default=0)
    return [r - lowest for r in rank]


def _chain(layers: Layers, edge: Edge, above: int, below: int, turned: bool, longest: int) -> Chain:
    places = [above]
    for layer in range(layers.rank[above] + 1, layers.rank[below]):
        place = len(layers.rank)
        layers.rank.append(layer)
        if edge.label and layer == layers.rank[above] + 1:
            text = edge.label
            layers.labels[place] = text if len(text) <= longest else text[: longest - 1] + "…"
        else:
            layers.joints.add(place)
        places.append(place)
    return Chain(edge, (*places, below), turned)


# -- order ---------------------------------------------------------------------------------------------


def _order(layers: Layers) -> None:
    count = max(layers.rank, default=-1) + 1
    up: list[list[int]] = [[] for _ in layers.rank]
    down: list[list[int]] = [[] for _ in layers.rank]
    for chain in layers.chains:
        for a, b in zip(chain.places, chain.places[1:], strict=False):
            down[a].append(b)
            up[b].append(a)
    order: list[list[int]] = [[] for _ in range(count)]
    for place in _depth_first(up, down):
        order[layers.rank[place]].append(place)
    best, fewest = [list(layer) for layer in order], _crossings(order, down)
    for sweep in range(SWEEPS):
        if fewest == 0:
            break
        going_down = sweep % 2 == 0
        for r in range(1, count) if going_down else range(count - 2, -1, -1):
            fixed, near = (r - 1, up) if going_down else (r + 1, down)
            position = {place: k for k, place in enumerate(order[fixed])}
            order[r] = _by_mean(order[r], near, position)
        crossings = _crossings(order, down)
        if crossings < fewest:
            best, fewest = [list(layer) for layer in order], crossings
    layers.order = best


def _depth_first(up: Sequence[Sequence[int]], down: Sequence[Sequence[int]]) -> list[int]:
    """All places, sources first, each followed by what hangs on it: no crossings in trees."""
    seen: set[int] = set()
    result = []
    for start in sorted(range(len(up)), key=lambda v: (len(up[v]) > 0, v)):
        stack = [start]
        while stack:
            place = stack.pop()
            if place not in seen:
                seen.add(place)
                result.append(place)
                stack.extend(reversed(down[place]))
    return result


def _by_mean(layer: Sequence[int], near: Sequence[Sequence[int]], position: Mapping[int, int]) -> list[int]:
    """A layer by the mean position of neighbours; places without any stay where they are."""
    means = {p: sum(position[q] for q in near[p]) / len(near[p]) for p in layer if near[p]}
    moving = iter(sorted(means, key=means.__getitem__))
    return [next(moving) if p in means else p for p in layer]


def _crossings(order: Sequence[Sequence[int]], down: Sequence[Sequence[int]]) -> int:
    total = 0
    for above, below in pairwise(order):
        position = {place: k for k, place in enumerate(below)}
        seen: list[int] = []
        for place in above:
            ends = sorted(position[q] for q in down[place])
            total += sum(len(seen) - bisect_right(seen, end) for end in ends)
            for end in ends:
                insort(seen, end)
    return total
