"""HTML by inline attributes: tables, lines of text, pictures that scroll where they are wide.

Cells are given as text and escaped here.  Notebooks and the documentation bring their own colours; these
tables set none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from factored_polca.display.graphs import Graph
from factored_polca.display.pictures import graph_svg
from factored_polca.display.words import escape

_CELL: Final = "padding:2px 10px 2px 0;border:none;vertical-align:top;text-align:"
_HEAD: Final = "padding:2px 10px 2px 0;border:none;border-bottom:1px solid;text-align:"


def heading(text: str, detail: str = "") -> str:
    """What is seen, in bold, and a line about it."""
    after = f" &nbsp; {escape(detail)}" if detail else ""
    return f'<div style="margin:4px 0"><b>{escape(text)}</b>{after}</div>'


def line(text: str) -> str:
    """A line of text."""
    return f'<div style="margin:2px 0;font-size:90%">{escape(text)}</div>' if text else ""


def table(columns: Sequence[str], rows: Sequence[Sequence[object]], left: Sequence[int] = (0,)) -> str:
    """A table; columns whose number is in `left` are flush left, the others right."""
    sides = ["left" if k in left else "right" for k in range(len(columns))]
    head = "".join(
        f'<th style="{_HEAD}{side}">{escape(name)}</th>' for name, side in zip(columns, sides, strict=True)
    )
    body = "".join(
        "<tr>"
        + "".join(
            f'<td style="{_CELL}{side}">{escape(cell)}</td>' for cell, side in zip(row, sides, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    return (
        '<table style="border-collapse:collapse;border:none;margin:4px 0"><thead><tr>'
        f"{head}</tr></thead><tbody>{body}</tbody></table>"
    )


def pairs(rows: Sequence[tuple[str, object]]) -> str:
    """Names and what they are, without a heading."""
    body = "".join(
        f'<tr><td style="{_CELL}left"><i>{escape(name)}</i></td>'
        f'<td style="{_CELL}left">{escape(what)}</td></tr>'
        for name, what in rows
    )
    return f'<table style="border-collapse:collapse;border:none;margin:4px 0"><tbody>{body}</tbody></table>'


def drawing(graph: Graph) -> str:
    """A graph as a picture, and what was left out of it."""
    return scrolled(graph_svg(graph)) + line(graph.note)


def scrolled(picture: str) -> str:
    """A picture in a frame that scrolls where it is wider than the page."""
    return f'<div style="overflow-x:auto;max-width:100%">{picture}</div>'


def view(*parts: str) -> str:
    """The parts of what is shown, one below the other."""
    return f'<div style="font-size:inherit">{"".join(parts)}</div>'
