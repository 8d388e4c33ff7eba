"""What the documentation's pages promise each other: links, the public names, the notebooks.

That the pages build without a warning is what the build itself tells (`sphinx-build -W -b html docs OUT`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import factored_polca
import factored_polca.testing
from factored_polca.cli.parser import parser

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def pages() -> list[Path]:
    return sorted(path for path in DOCS.rglob("*.md") if "notebooks" not in path.parts)


def named(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def prose(text: str) -> str:
    """The page without its fenced blocks, code and formulas."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"`[^`\n]*`", "", text)
    return re.sub(r"\$\$.*?\$\$|\$[^$\n]+\$", "", text, flags=re.DOTALL)


def links(page: Path) -> Iterator[tuple[str, str]]:
    """The links to other files of the repository: path and heading."""
    for target in re.findall(r"\]\(([^()\s]+)\)", prose(page.read_text(encoding="utf-8"))):
        if not re.match(r"[a-z]+:", target):
            path, _, heading = target.partition("#")
            yield path, heading


def headings(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub and MyST make them."""
    lines = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).strip().replace(" ", "-") for line in lines}


@pytest.mark.parametrize("page", [ROOT / "README.md", *pages()], ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    for path, heading in links(page):
        target = page.parent / path if path else page
        if "notebooks" in Path(path).parts and page.is_relative_to(DOCS):
            target = ROOT / "notebooks" / Path(path).name  # they are copied there when the pages are built
        assert target.is_file(), f"{path} is not there"
        if heading:
            assert heading in headings(target), f"{path} has no heading {heading}"


def test_the_reference_lists_public_names_once_and_adds_what_is_new() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in sorted((DOCS / "reference").glob("*.md")))
    package, _, kit = text.partition("currentmodule:: factored_polca.testing")
    documented = re.findall(r"^\.\. auto(?:class|function):: (\w+)$", package, re.MULTILINE)
    assert len(documented) == len(set(documented)) > 70
    assert set(documented) <= set(factored_polca.__all__)
    assert package.count("```{further-names}") == 1
    in_kit = re.findall(r"^\.\. auto(?:class|function):: (\w+)$", kit, re.MULTILINE)
    assert set(in_kit) == set(factored_polca.testing.__all__)


def test_commands_are_listed_by_the_parser_itself() -> None:
    assert "```{command-help}" in (DOCS / "reference" / "commands.md").read_text(encoding="utf-8")
    assert parser().prog == "factored-polca"


def test_notebooks_are_numbered_from_one() -> None:
    assert [path.name[:3] for path in NOTEBOOKS] == [f"{k:02d}_" for k in range(1, len(NOTEBOOKS) + 1)]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=named)
def test_a_notebook_states_its_claim_and_carries_no_outputs(path: Path) -> None:
    book = json.loads(path.read_text(encoding="utf-8"))
    first, *rest = book["cells"]
    assert first["cell_type"] == "markdown"
    assert re.match(r"# \S", "".join(first["source"]))
    assert "**Claim.**" in "".join(first["source"])
    assert [cell["execution_count"] for cell in rest if cell["cell_type"] == "code"].count(None) >= 2
    for cell in rest:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None
        assert set(cell["metadata"]) <= {"tags"}
    assert set(book["metadata"]) == {"kernelspec", "language_info"}
