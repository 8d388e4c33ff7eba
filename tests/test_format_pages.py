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

FEWEST = {"index": 0, "fuzzing": 0, "rddl": 3, "prism": 3}
"""Commands and programs that a page has at least, where it is not one."""

PAGES = sorted(path.stem for path in FOLDER.glob("*.md"))


@pytest.mark.parametrize("name", PAGES)
def test_a_page_does_what_it_says(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
        pytest.skip(f"{NEEDS[name]} is not installed")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    assert run_page(FOLDER / f"{name}.md", capsys) >= FEWEST.get(name, 1)


def test_the_table_of_formats_names_each_extension_and_each_page() -> None:
    index = (FOLDER / "index.md").read_text(encoding="utf-8")
    assert all(f"`{extension}`" in index for extension in FORMATS)
    assert all(f"]({name}.md)" in index for name in PAGES if name != "index")
