"""The table of docs/formats/rddl.md has every domain of the competitions."""

from __future__ import annotations

import re
from pathlib import Path

PAGE = Path(__file__).resolve().parent.parent / "docs" / "formats" / "rddl.md"


def test_every_competition_domain_has_a_line() -> None:
    text = PAGE.read_text(encoding="utf-8")
    lines = re.findall(r"^\| (20\d\d) (\w+) (P?O?MDP) \| (\w+)", text, re.MULTILINE)
    assert len(lines) == len(set(lines)) == 32
    assert {read for _, _, _, read in lines} == {"yes"}
