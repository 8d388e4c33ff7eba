"""Where the nodes of a graph stand: boxes as large as their text, in layers, none over another.

Within a layer the order is given (`layers`), and neighbours keep a distance; each place wants to stand at
the mean of those that it is joined to.  The positions nearest to all wishes, in the sense of least squares,
that keep order and distances are found by pooling adjacent violators (Ayer et al. 1955): with offsets
o_k = sum of the distances before place k, wish_k - o_k is made monotone.  Sweeps repeat this by layers.

Arcs cross a layer straight through their joints and bend in the gaps between layers only, so no arc runs
over a box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

from factored_polca.display.graphs import Edge, Graph, Node
from factored_polca.display.layers import Chain, Layers, make_layers
from factored_polca.display.words import printable, short, text_width

FONT: Final = 12.0
LABEL_FONT: Final = 10.5
LINE: Final = 16.0
PADDING: Final = 9.0
MARGIN: Final = 12.0

BETWEEN: Final = 20.0
"""Between neighbours in a layer."""

BETWEEN_JOINTS: Final = 10.0
GAP: Final = 26.0
"""Between layers, at least."""

SWEEPS: Final = 24
WIDEST: Final = 1000.0
"""Width of a picture beyond which the other direction is tried."""

Point = tuple[float, float]


@dataclass(frozen=True)
class Box:
    """A rectangle by its middle and its sides."""

    x: float
    y: float
    width: float
    height: float

    def overlaps(self, other: Box, margin: float = 0.0) -> bool:
        """Whether both share more than their borders."""
        return (
            abs(self.x - other.x) < (self.width + other.width) / 2 + margin - 1e-6
            and abs(self.y - other.y) < (self.height + other.height) / 2 + margin - 1e-6
        )


@dataclass(frozen=True)
class PlacedNode:
    """A node, its text as it is shown, and its box."""

    node: Node
    lines: tuple[str, ...]
    box: Box


@dataclass(frozen=True)
class Route:
    """An arc as straight pieces [(from, to)] with bends between them, in the direction of the flow.

    `turned`: the arrow stands at the start.  After piece `label` the line stops for its label.
    """

    edge: Edge
    pieces: tuple[tuple[Point, Point], ...]
    turned: bool
    label: int | None = None


@dataclass(frozen=True)
class Layout:
    """A graph with everything in its place; `across` says that it flows to the right, not down."""

    nodes: tuple[PlacedNode, ...]
    labels: tuple[tuple[str, Box, str], ...]
    routes: tuple[Route, ...]
    width: float
    height: float
    across: bool

    @property
    def boxes(self) -> list[Box]:
        """All that must not overlap: nodes and labels."""
        return [*(placed.box for placed in self.nodes), *(box for _, box, _ in self.labels)]


def layout(graph: Graph) -> Layout:
    """Place a graph, in the direction that it asks for, or in the one that suits a page better."""
    lines = [_shown_lines(graph, node) for node in graph.nodes]
    layers = make_layers(graph)
    if graph.direction != "auto":
        return _placed(graph, layers, lines, across=graph.direction == "right")
    down = _placed(graph, layers, lines, across=False)
    if down.width <= WIDEST:
        return down
    right = _placed(graph, layers, lines, across=True)
    return right if right.width < down.width else down


def _shown_lines(graph: Graph, node: Node) -> tuple[str, ...]:
    """The text of a node; an arc to itself is a line of it."""
    loops = [edge.label for edge in graph.edges if edge.source == edge.target == node.key]
    again = [f"↺ {', '.join(label for label in loops if label)}".rstrip()] if loops else []
    return tuple(short(line, 60) for line in (*node.lines, *again)) or ("",)


def node_size(node: Node, lines: Sequence[str]) -> tuple[float, float]:
    """Width and height of the box around some lines."""
    widths = [text_width(line, FONT, bold=node.heading and k == 0) for k, line in enumerate(lines)]
    round_ends = 8.0 if node.kind in ("action", "reward", "more") else 0.0
    return max(widths) + 2 * PADDING + round_ends, LINE * len(lines) + PADDING


@dataclass
class _Places:
    """Sizes and positions [place], along the layer (x) and across it (y)."""

    width: list[float]
    height: list[float]
    x: list[float]
    y: list[float]
    room: list[tuple[float, float]] = field(default_factory=list)  # [layer] its upper and lower end


def _placed(graph: Graph, layers: Layers, lines: Sequence[tuple[str, ...]], across: bool) -> Layout:
    count = len(layers.rank)
    places = _Places([0.0] * count, [0.0] * count, [0.0] * count, [0.0] * count)
    for k, node in enumerate(graph.nodes):
        _resize(places, k, node_size(node, lines[k]), across)
    for k, text in layers.labels.items():
        _resize(places, k, (text_width(text, LABEL_FONT) + 6, LABEL_FONT + 6), across)
    _stack(layers, places)
    _align(layers, places, 0.55 if across else 1.0)
    left = min((x - w / 2 for x, w in zip(places.x, places.width, strict=True)), default=0.0)
    places.x = [x - left + MARGIN for x in places.x]
    extent = max((x + w / 2 for x, w in zip(places.x, places.width, strict=True)), default=0.0) + MARGIN
    depth = (places.room[-1][1] if places.room else 0.0) + MARGIN
    nodes = tuple(PlacedNode(node, lines[k], _box(places, k, across)) for k, node in enumerate(graph.nodes))
    titles = {chain.places[1]: chain.edge for chain in layers.chains if chain.edge.label}
    labels = tuple(
        (text, _box(places, k, across), titles[k].title or printable(titles[k].label))
        for k, text in layers.labels.items()
    )
    routes = tuple(_routes(layers, places, across))
    size = (depth, extent) if across else (extent, depth)
    return Layout(nodes, labels, routes, *size, across)


def _resize(places: _Places, k: int, size: tuple[float, float], across: bool) -> None:
    width, height = size
    places.width[k], places.height[k] = (height, width) if across else (width, height)


def _box(places: _Places, k: int, across: bool) -> Box:
    x, y, w, h = places.x[k], places.y[k], places.width[k], places.height[k]
    return Box(y, x, h, w) if across else Box(x, y, w, h)


def _stack(layers: Layers, places: _Places) -> None:
    """The layers one below the other; a gap is wider where many arcs bend in it."""
    crossing = [0] * max(1, len(layers.order))
    for chain in layers.chains:
        for place in chain.places[:-1]:
            crossing[layers.rank[place]] += 1
    has_labels, top = bool(layers.labels), MARGIN
    for r, layer in enumerate(layers.order):
        height = max((places.height[p] for p in layer), default=0.0)
        for p in layer:
            places.y[p] = top + height / 2
        places.room.append((top, top + height))
        gap = GAP * (0.6 if has_labels else 1.0)
        top += height + gap + min(40.0, 1.2 * crossing[r])


def _align(layers: Layers, places: _Places, closeness: float) -> None:
    """Positions within the layers; boxes that stand one above the other may be nearer than side by side."""
    joined: list[list[tuple[int, float, int]]] = [[] for _ in layers.rank]  # (place, weight, layer)
    for chain in layers.chains:
        for a, b in pairwise(chain.places):
            weight = 1.0 + 2.0 * (a in layers.joints) + 2.0 * (b in layers.joints)
            joined[a].append((b, weight, layers.rank[b]))
            joined[b].append((a, weight, layers.rank[a]))
    for layer in layers.order:
        _spread(layer, [0.0] * len(layer), layers, places, closeness)
    count = len(layers.order)
    for sweep in range(SWEEPS):
        going_down, last = sweep % 2 == 0, sweep >= SWEEPS // 2
        for r in range(count) if going_down else range(count - 1, -1, -1):
            wishes = []
            for p in layers.order[r]:
                near = [(q, w) for q, w, s in joined[p] if last or (s < r) is going_down]
                total = sum(w for _, w in near)
                wishes.append(sum(w * places.x[q] for q, w in near) / total if near else places.x[p])
            _spread(layers.order[r], wishes, layers, places, closeness)


def _spread(
    layer: Sequence[int], wishes: Sequence[float], layers: Layers, places: _Places, closeness: float
) -> None:
    """Put a layer as near to its wishes as order and distances allow."""
    if not layer:
        return
    offsets = [0.0]
    for a, b in pairwise(layer):
        both = a in layers.joints and b in layers.joints
        between = BETWEEN_JOINTS if both else closeness * BETWEEN * (0.7 if a in layers.labels else 1.0)
        offsets.append(offsets[-1] + (places.width[a] + places.width[b]) / 2 + between)
    pools: list[tuple[float, int]] = []  # (mean, how many)
    for wish, offset in zip(wishes, offsets, strict=True):
        mean, size = wish - offset, 1
        while pools and pools[-1][0] > mean:
            before, many = pools.pop()
            mean, size = (before * many + mean * size) / (many + size), many + size
        pools.append((mean, size))
    positions = [mean for mean, size in pools for _ in range(size)]
    for p, position, offset in zip(layer, positions, offsets, strict=True):
        places.x[p] = position + offset


def _routes(layers: Layers, places: _Places, across: bool) -> list[Route]:
    leaving: dict[int, list[Chain]] = {}
    entering: dict[int, list[Chain]] = {}
    for chain in layers.chains:
        leaving.setdefault(chain.places[0], []).append(chain)
        entering.setdefault(chain.places[-1], []).append(chain)
    start: dict[int, float] = {}
    end: dict[int, float] = {}
    for place, chains in leaving.items():
        _ports(place, sorted(chains, key=lambda c: places.x[c.places[1]]), places, start)
    for place, chains in entering.items():
        _ports(place, sorted(chains, key=lambda c: places.x[c.places[-2]]), places, end)
    result = []
    for chain in layers.chains:
        pieces: list[tuple[Point, Point]] = []
        label: int | None = None
        for k, p in enumerate(chain.places):
            upper, lower = places.room[layers.rank[p]]
            x = start[id(chain)] if k == 0 else end[id(chain)] if p == chain.places[-1] else places.x[p]
            if k == 0:
                upper = places.y[p] + places.height[p] / 2
            if p == chain.places[-1]:
                lower = places.y[p] - places.height[p] / 2
            if p in layers.labels:
                half, label = places.height[p] / 2, len(pieces)
                pieces.append(((x, upper), (x, places.y[p] - half)))
                upper = places.y[p] + half
            pieces.append(((x, upper), (x, lower)))
        if across:
            pieces = [((a[1], a[0]), (b[1], b[0])) for a, b in pieces]
        result.append(Route(chain.edge, tuple(pieces), chain.turned, label))
    return result


def _ports(place: int, chains: Sequence[Chain], places: _Places, where: dict[int, float]) -> None:
    """Where arcs touch a box: side by side, in the order of where they lead."""
    step = min(14.0, 0.7 * places.width[place] / max(1, len(chains)))
    for k, chain in enumerate(chains):
        where[id(chain)] = places.x[place] + (k - (len(chains) - 1) / 2) * step
