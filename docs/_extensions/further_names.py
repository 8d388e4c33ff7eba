"""The directive `further-names`: the public names that no page of the reference lists yet."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

import factored_polca


class FurtherNames(SphinxDirective):
    """A section with these names, or nothing where there are none."""

    def run(self) -> list[nodes.Node]:
        pages = Path(self.env.doc2path(self.env.docname)).parent.glob("*.md")
        text = "".join(page.read_text(encoding="utf-8") for page in pages)
        listed = set(re.findall(r"^\.\. auto(?:class|function):: (\w+)$", text, re.MULTILINE))
        further = [n for n in factored_polca.__all__ if n not in listed and not n.startswith("_")]
        if not further:
            return []
        lines = ["```{eval-rst}", ".. currentmodule:: factored_polca", ""]
        for name in further:
            kind = "class" if inspect.isclass(getattr(factored_polca, name)) else "function"
            lines += [f".. auto{kind}:: {name}", *(["   :members:"] if kind == "class" else []), ""]
        section = nodes.section(ids=["further-names"], names=["further names"])
        section += nodes.title("", "Further names")
        section += self.parse_text_to_nodes("\n".join([*lines, "```"]))
        return [section]


def setup(app: Sphinx) -> ExtensionMetadata:
    app.add_directive("further-names", FurtherNames)
    return {"version": "1", "parallel_read_safe": True}
