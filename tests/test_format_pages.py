"""The pages on formats are true, and there is one for each format."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from pages import run_page

from factored_polca.formats import FORMATS

FOLDER = Path(__file__).resolve().parent.parent / "docs" / "formats"
NEEDS = {"gymnasium": "gymnasium", "rddl": "pyRDDLGym", "prism": "stormpy"}
"""Pages whose examples need an extra."""

PAGES = sorted(path.stem for path in FOLDER.glob("*.md"))
OWN_TEST = {"rddl", "prism"}


@pytest.mark.parametrize("name", [name for name in PAGES if name not in OWN_TEST])
def test_a_page_does_what_it_says(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
        pytest.skip(f"{NEEDS[name]} is not installed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    assert run_page(FOLDER / f"{name}.md", capsys) or name in ("index", "fuzzing")


def test_the_table_of_formats_names_each_extension_and_each_page() -> None:
    index = (FOLDER / "index.md").read_text(encoding="utf-8")
    assert all(f"`{extension}`" in index for extension in FORMATS)
    assert all(f"]({name}.md)" in index for name in PAGES if name != "index")
