"""The directive `drawn`: an object drawn as a notebook draws it, from a model that the page itself shows.

    ```{drawn} NAME WHAT
    ```

NAME is the name in one of the page's TOML blocks; WHAT is `model`, `tasks`, `plan`, or `root`, the plan's
task at the top.
"""

from __future__ import annotations

import re
import tempfile
from functools import cache
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

import factored_polca as fp


@cache
def drawings(text: str) -> dict[str, str]:
    """What can be drawn of a model file, as HTML."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.toml"
        path.write_text(text, encoding="utf-8")
        document = fp.read(path)
    plan = fp.plan(document.model, document.tasks)
    things = {"model": document.model, "plan": plan, "root": plan.root}
    if document.tasks is not None:
        things["tasks"] = document.tasks
    return {name: thing._repr_html_() for name, thing in things.items()}


class DrawnDirective(SphinxDirective):
    """One object as HTML."""

    required_arguments = 2

    def run(self) -> list[nodes.Node]:
        name, what = self.arguments
        page = Path(self.env.doc2path(self.env.docname)).read_text(encoding="utf-8")
        for text in re.findall(r"^```toml\n(.*?)^```$", page, re.MULTILINE | re.DOTALL):
            if re.search(rf'^name = "{re.escape(name)}"', text, re.MULTILINE):
                found = drawings(text)
                if what not in found:
                    raise self.error(f"{what!r} is not drawn; what is: {', '.join(found)}")
                return [nodes.raw("", f'<div class="drawn">{found[what]}</div>', format="html")]
        raise self.error(f"the page shows no model named {name!r}")


def setup(app: Sphinx) -> ExtensionMetadata:
    app.add_directive("drawn", DrawnDirective)
    return {"version": "1", "parallel_read_safe": True}
