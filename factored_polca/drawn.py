"""What objects that draw themselves have in common; `factored_polca.display` draws, when it is asked to.

A notebook calls `_repr_html_`.  Nothing of this loads a library, and nothing draws before that.
"""

from __future__ import annotations

from typing import Any


class Drawn:
    """Base of objects that show themselves as HTML: inline attributes only, no scripts or style sheets."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        from factored_polca.display import html

        return html(self)


class DrawnGraph(Drawn):
    """Base of objects that are also drawn as a graph."""

    __slots__ = ()

    def to_svg(self) -> str:
        """The graph as a picture: the text of an SVG file."""
        from factored_polca.display import svg

        return svg(self)

    def to_dot(self) -> str:
        """The graph in the language of Graphviz."""
        from factored_polca.display import dot

        return dot(self)

    def to_mermaid(self) -> str:
        """The graph as a Mermaid flowchart."""
        from factored_polca.display import mermaid

        return mermaid(self)


class Framed:
    """Base of objects that have rows."""

    __slots__ = ()

    def to_frame(self) -> Any:
        """The rows as a `pandas.DataFrame`; pandas is the extra `[frames]`.

        Raises:
            MissingLibrary: pandas is not installed.
        """
        from factored_polca.display.frames import frame

        return frame(self)
