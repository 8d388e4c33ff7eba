"""Pictures as SVG, by attributes only: no style sheets, scripts, identifiers or links.

Lines and text have the colour of the page's text (`currentColor`), areas are transparent, so one picture
suits light and dark pages.  A file of its own gets a white ground.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from factored_polca.display.graphs import Graph, Kind
from factored_polca.display.layout import FONT, LABEL_FONT, LINE, Layout, PlacedNode, Route, layout
from factored_polca.display.words import escape, printable

FONTS: Final = "Helvetica, Arial, 'Liberation Sans', 'DejaVu Sans', sans-serif"

# Okabe & Ito's colours, which the colour-blind tell apart.
BLUE, ORANGE, GREEN = "#0072b2", "#e69f00", "#009e73"
RED, PURPLE, SKY, GREY = "#d55e00", "#cc79a7", "#56b4e9", "#808080"

_LOOKS: Final[dict[Kind, tuple[str, float, float]]] = {  # colour, its opacity, how round
    "feature": (SKY, 0.22, 4), "next": (BLUE, 0.22, 4), "observation": (PURPLE, 0.28, 4),
    "reward": (ORANGE, 0.30, 12), "task": (BLUE, 0.18, 4), "action": (GREEN, 0.24, 12),
    "test": (SKY, 0.22, 4), "block": (BLUE, 0.16, 4), "terminal": (GREY, 0.22, 12),
    "belief": (PURPLE, 0.22, 6), "more": (GREY, 0.10, 12),
}  # fmt: skip


def n(value: float) -> str:
    """A coordinate."""
    return f"{value:.1f}".removesuffix(".0")


def text_element(
    x: float, y: float, text: str, size: float = FONT, *, anchor: str = "middle", bold: bool = False,
    opacity: float = 1.0,
) -> str:  # fmt: skip
    """A line of text, its baseline at y."""
    weight = ' font-weight="bold"' if bold else ""
    faint = f' fill-opacity="{opacity:g}"' if opacity < 1 else ""
    return (
        f'<text x="{n(x)}" y="{n(y)}" text-anchor="{anchor}" font-size="{size:g}"{weight}{faint}>'
        f"{escape(text)}</text>"
    )


def picture(width: float, height: float, parts: Sequence[str], description: str, alone: bool) -> str:
    """The parts of a picture as one; `alone` makes it fit for a file of its own."""
    size = f'width="{n(width)}" height="{n(height)}" viewBox="0 0 {n(width)} {n(height)}"'
    name = f'role="img" aria-label="{escape(description)}"'
    ground = '<rect width="100%" height="100%" fill="#ffffff"/>' if alone else ""
    colour = ' color="#1f2328"' if alone else ""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} {name} font-family="{FONTS}" '
        f'fill="currentColor"{colour}>{ground}{"".join(parts)}</svg>'
    )


def graph_svg(graph: Graph, *, alone: bool = False) -> str:
    """A graph as a picture."""
    return layout_svg(layout(graph), graph.description, alone=alone)


def layout_svg(placed: Layout, description: str, *, alone: bool = False) -> str:
    """A graph whose places are known."""
    parts = [_route(route, placed.across) for route in placed.routes]
    for text, box, title in placed.labels:
        tip = f"<title>{escape(title)}</title>" if title and title != text else ""
        line = text_element(box.x, box.y + LABEL_FONT * 0.36, text, LABEL_FONT)
        parts.append(f"<g>{tip}{line}</g>" if tip else line)
    parts += [_node(one) for one in placed.nodes]
    return picture(placed.width, placed.height, parts, description, alone)


def _node(placed: PlacedNode) -> str:
    node, box = placed.node, placed.box
    colour, opacity, roundness = _LOOKS[node.kind]
    x, y = box.x - box.width / 2, box.y - box.height / 2
    dash = ' stroke-dasharray="3 3"' if node.kind == "more" else ""
    rect = (
        f'<rect x="{n(x)}" y="{n(y)}" width="{n(box.width)}" height="{n(box.height)}" '
        f'rx="{min(roundness, box.height / 2):g}" fill="{colour}" fill-opacity="{opacity:g}" '
        f'stroke="{colour}" stroke-width="1.2"{dash}/>'
    )
    tip = f"<title>{escape(node.title)}</title>" if node.title else ""
    first = box.y - LINE * len(placed.lines) / 2 + LINE * 0.76
    lines = [
        text_element(
            box.x, first + LINE * k, line, bold=node.heading and k == 0,
            opacity=1.0 if k == 0 else 0.85,
        )
        for k, line in enumerate(placed.lines)
    ]  # fmt: skip
    return f"<g>{tip}{rect}{''.join(lines)}</g>"


def _route(route: Route, across: bool) -> str:
    """A smooth line with an arrow at its head."""
    (x0, y0), _ = route.pieces[0]
    path = [f"M{n(x0)} {n(y0)}"]
    for k, (upper, lower) in enumerate(route.pieces):
        if route.label is not None and k == route.label + 1:
            path.append(f"M{n(upper[0])} {n(upper[1])}")
        elif k > 0:
            (ax, ay), (bx, by) = route.pieces[k - 1][1], upper
            if across:
                middle = (ax + bx) / 2
                path.append(f"C{n(middle)} {n(ay)} {n(middle)} {n(by)} {n(bx)} {n(by)}")
            else:
                middle = (ay + by) / 2
                path.append(f"C{n(ax)} {n(middle)} {n(bx)} {n(middle)} {n(bx)} {n(by)}")
        path.append(f"L{n(lower[0])} {n(lower[1])}")
    dash = ' stroke-dasharray="4 3"' if route.edge.stroke == "dashed" else ""
    opacity = 0.35 if route.edge.stroke == "faint" else 0.6
    tip = f"<title>{escape(printable(route.edge.title))}</title>" if route.edge.title else ""
    line = (
        f'<path d="{"".join(path)}" fill="none" stroke="currentColor" stroke-width="1.1" '
        f'stroke-opacity="{opacity:g}"{dash}>{tip}</path>'
    )
    return line + _arrow(route, across, opacity)


def _arrow(route: Route, across: bool, opacity: float) -> str:
    x, y = route.pieces[0][0] if route.turned else route.pieces[-1][1]
    back = 6.0 if route.turned else -6.0
    points = (
        [(x, y), (x + back, y - 3), (x + back, y + 3)]
        if across
        else [(x, y), (x - 3, y + back), (x + 3, y + back)]
    )
    text = " ".join(f"{n(px)},{n(py)}" for px, py in points)
    return f'<polygon points="{text}" fill-opacity="{max(opacity, 0.5):g}"/>'
