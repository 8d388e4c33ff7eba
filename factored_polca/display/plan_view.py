"""Plans of both kinds, whole and as what is executed: the hierarchy with the figures of each task."""

from __future__ import annotations

from factored_polca.display.hierarchy_view import plan_graph as graph
from factored_polca.display.hierarchy_view import plan_html as html

__all__ = ["graph", "html"]
