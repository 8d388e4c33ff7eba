"""The directive `command-help`: what `factored-polca COMMAND --help` prints, each command in a section."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata

from factored_polca.cli.parser import parser


def subcommands(top: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """The parsers below one, depth first, each with what is typed to reach it."""
    for action in top._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, below in action.choices.items():
                yield name, below
                for further, deeper in subcommands(below):
                    yield f"{name} {further}", deeper


class CommandHelp(SphinxDirective):
    """One section a command, from the parser itself."""

    def run(self) -> list[nodes.Node]:
        os.environ["COLUMNS"] = "96"
        found: list[nodes.Node] = []
        for name, below in subcommands(parser()):
            identifier = nodes.make_id(f"command {name}")
            section = nodes.section(ids=[identifier], names=[f"command {name}"])
            section += nodes.title("", "", nodes.literal(text=name))
            text = below.format_help()
            section += nodes.literal_block(text, text, language="none")
            found.append(section)
        return found


def setup(app: Sphinx) -> ExtensionMetadata:
    app.add_directive("command-help", CommandHelp)
    return {"version": "1", "parallel_read_safe": True}
