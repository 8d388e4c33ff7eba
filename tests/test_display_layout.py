"""Pictures of graphs: no box over another, no arc over a box, text inside its box."""

from __future__ import annotations

import random
from itertools import combinations, pairwise
from xml.etree import ElementTree

import pytest

from factored_polca.display.dot_text import graph_dot
from factored_polca.display.graphs import Direction, Edge, Graph, Node
from factored_polca.display.layers import make_layers
from factored_polca.display.layout import FONT, Box, Layout, Route, layout
from factored_polca.display.mermaid_text import graph_mermaid
from factored_polca.display.pictures import graph_svg, layout_svg
from factored_polca.display.words import text_width

KINDS = ("feature", "next", "observation", "reward", "task", "action", "test", "block", "terminal", "more")


def random_graph(count: int, seed: int, labels: bool, direction: Direction = "auto") -> Graph:
    """A connected graph with further arcs, backward ones and loops among them."""
    draw = random.Random(seed)
    nodes = [
        Node(
            f"k{k}",
            (f"node {k} {'m' * draw.randrange(12)}", *(f"line {j}" for j in range(draw.randrange(3)))),
            KINDS[k % len(KINDS)],  # type: ignore[arg-type]
        )
        for k in range(count)
    ]
    pairs = [(draw.randrange(k), k) for k in range(1, count)]
    pairs += [(draw.randrange(count), draw.randrange(count)) for _ in range(count // 2)]
    names = ["", "a", "north, south", "W" * 40] if labels else [""]
    edges = [Edge(f"k{s}", f"k{t}", draw.choice(names)) for s, t in pairs]
    return Graph(tuple(nodes), tuple(edges), "a random graph", direction)


def points(route: Route, across: bool) -> list[tuple[float, float]]:
    """Points of the line that is drawn: straight pieces, and the cubic bends between them."""
    found = []
    for k, (start, end) in enumerate(route.pieces):
        if k and route.label != k - 1:
            (ax, ay), (bx, by) = route.pieces[k - 1][1], start
            c, d = ((ax + bx) / 2, ay), ((ax + bx) / 2, by)
            if not across:
                c, d = (ax, (ay + by) / 2), (bx, (ay + by) / 2)
            for step in range(21):
                t = step / 20
                w = ((1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3)
                corners = ((ax, ay), c, d, (bx, by))
                found.append(
                    (
                        sum(q * p[0] for q, p in zip(w, corners, strict=True)),
                        sum(q * p[1] for q, p in zip(w, corners, strict=True)),
                    )
                )
        found += [
            (start[0] + (end[0] - start[0]) * t / 10, start[1] + (end[1] - start[1]) * t / 10)
            for t in range(11)
        ]
    return found


def inside(box: Box, point: tuple[float, float]) -> bool:
    return abs(box.x - point[0]) < box.width / 2 - 0.1 and abs(box.y - point[1]) < box.height / 2 - 0.1


def assert_sound(placed: Layout) -> None:
    for one, other in combinations(placed.boxes, 2):
        assert not one.overlaps(other), (one, other)
    for box in placed.boxes:
        assert box.width / 2 <= box.x <= placed.width - box.width / 2
        assert box.height / 2 <= box.y <= placed.height - box.height / 2
    for route in placed.routes:
        for point in points(route, placed.across):
            assert not any(inside(box, point) for box in placed.boxes), route.edge


@pytest.mark.parametrize("labels", [False, True], ids=["plain", "labelled"])
@pytest.mark.parametrize("direction", ["down", "right"])
@pytest.mark.parametrize("count", [3, 20, 60])
def test_no_box_overlaps_another_and_no_arc_runs_over_a_box(
    count: int, direction: Direction, labels: bool
) -> None:
    for seed in range(4):
        assert_sound(layout(random_graph(count, seed, labels, direction)))


def test_a_box_that_is_moved_onto_another_overlaps_it() -> None:
    placed = layout(random_graph(20, 1, True))
    first, second = placed.boxes[:2]
    assert not first.overlaps(second)
    assert first.overlaps(Box(first.x + 1, first.y + 1, second.width, second.height))


def test_boxes_are_as_wide_as_the_widest_usual_font_needs() -> None:
    """Widths of matplotlib's DejaVu Sans, of the usual fonts about the widest."""
    pytest.importorskip("matplotlib")
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    for weight in ("normal", "bold"):
        font = FontProperties(family="DejaVu Sans", weight=weight)
        for text in ("passenger", "Navigate_R", "WWWMMM@@", "x >= 10 and y != 3", "illi", "0123456789"):
            drawn = TextPath((0, 0), text, size=FONT, prop=font).get_extents().width
            assert text_width(text, FONT, bold=weight == "bold") >= drawn - 1.0, (text, weight)


def test_layers_go_down_along_every_arc_but_those_that_close_a_cycle() -> None:
    edges = [Edge("a", "b"), Edge("b", "c"), Edge("c", "a"), Edge("a", "c")]
    nodes = [Node(key, (key,), "block") for key in "abc"]
    layers = make_layers(Graph(tuple(nodes), tuple(edges), "a cycle"))
    assert layers.rank[:3] == [0, 1, 2]
    turned = {(chain.edge.source, chain.edge.target): chain.turned for chain in layers.chains}
    assert turned == {("a", "b"): False, ("b", "c"): False, ("c", "a"): True, ("a", "c"): False}
    for chain in layers.chains:
        assert [layers.rank[p] for p in chain.places] == list(
            range(layers.rank[chain.places[0]], layers.rank[chain.places[-1]] + 1)
        )


def test_a_tree_is_drawn_without_crossings() -> None:
    draw = random.Random(5)
    nodes = [Node(str(k), (f"n{k}",), "test") for k in range(40)]
    edges = [Edge(str(draw.randrange(k)), str(k)) for k in range(1, 40)]
    layers = make_layers(Graph(tuple(nodes), tuple(edges), "a tree"))
    where = {p: (r, k) for r, layer in enumerate(layers.order) for k, p in enumerate(layer)}
    steps = [pair for chain in layers.chains for pair in pairwise(chain.places)]
    for (a, b), (c, d) in combinations(steps, 2):
        if where[a][0] == where[c][0]:
            assert (where[a][1] - where[c][1]) * (where[b][1] - where[d][1]) >= 0


def test_a_graph_needs_nodes_for_its_arcs_and_one_key_for_each() -> None:
    node = Node("a", ("a",), "block")
    with pytest.raises(ValueError, match="one key"):
        Graph((node, node), (), "")
    with pytest.raises(ValueError, match="no node at an end"):
        Graph((node,), (Edge("a", "b"),), "")


def test_pictures_are_well_formed_and_without_style_sheets_identifiers_and_scripts() -> None:
    allowed = {"svg", "g", "rect", "text", "path", "polygon", "title"}
    for count in (0, 1, 3, 20):
        root = ElementTree.fromstring(graph_svg(random_graph(count, 2, True)))
        for element in root.iter():
            assert element.tag.removeprefix("{http://www.w3.org/2000/svg}") in allowed
            assert not {"id", "style", "class", "href", "onload", "onclick"} & set(element.attrib)


def test_colours_are_those_of_the_page_unless_the_picture_stands_alone() -> None:
    graph = random_graph(20, 3, True)
    inline, alone = graph_svg(graph), graph_svg(graph, alone=True)
    root = ElementTree.fromstring(inline)
    assert root.attrib["fill"] == "currentColor"
    assert "color" not in root.attrib
    for element in root.iter("{http://www.w3.org/2000/svg}rect"):
        assert float(element.attrib["fill-opacity"]) <= 0.3
    assert "#ffffff" not in inline
    assert ElementTree.fromstring(alone)[0].attrib["fill"] == "#ffffff"


@pytest.mark.parametrize(
    "name", ['<script>alert("x")</script>', "a\\b\"c'd", "x\ny\x00z\u202e", "]]>&amp;"]
)
def test_names_are_text_wherever_they_stand(name: str) -> None:
    graph = Graph(
        (Node("a", (name, name), "task", name), Node("b", (name,), "action")),
        (Edge("a", "b", name, title=name), Edge("a", "a", name)),
        name,
    )
    picture = layout_svg(layout(graph), name)
    root = ElementTree.fromstring(picture)
    assert {e.tag.rpartition("}")[2] for e in root.iter()} <= {
        "svg",
        "g",
        "rect",
        "text",
        "path",
        "polygon",
        "title",
    }
    assert "\u202e" not in picture
    shown = [e.text or "" for e in root.iter("{http://www.w3.org/2000/svg}text")]
    assert any(text.startswith(name[:3].replace("\n", "\\n")) for text in shown)
    text = graph_dot(graph)
    assert text.count("\n") == 2 + 1 + 2 + 2 + 1  # no line more than the statements
    for line in text.splitlines():  # an even number of quotes that are no part of a string
        assert line.replace("\\\\", "").replace('\\"', "").count('"') % 2 == 0
    chart = graph_mermaid(graph)
    assert chart.count("\n") == 1 + 2 + 2
    for sign in "<>&\\'":
        assert sign not in chart.replace("<br/>", "").replace("-->", "")


def test_dot_and_mermaid_have_a_line_for_each_node_and_arc() -> None:
    graph = random_graph(20, 4, True)
    loops_and_all = len(graph.edges)
    assert graph_dot(graph).count(" -> ") == loops_and_all
    assert graph_mermaid(graph).count("-->") == loops_and_all
    assert graph_dot(graph).count("shape=") == 20
