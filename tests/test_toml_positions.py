"""Positions: every key path of a TOML text is found where it was written."""

from __future__ import annotations

import random
import tomllib
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factored_polca.formats.positions import Path, scan
from factored_polca.formats.toml_text import load, toml_block, toml_key, toml_string
from factored_polca.models import ModelError


def paths_of(value: Any, path: Path = ()) -> set[Path]:
    """The paths of everything inside a loaded TOML value."""
    result = {path} if path else set()
    if isinstance(value, dict):
        return result.union(*(paths_of(part, (*path, key)) for key, part in value.items()))
    if isinstance(value, list):
        return result.union(*(paths_of(part, (*path, str(i))) for i, part in enumerate(value)))
    return result


class Scribe:
    """Writes random TOML and notes where each value's content begins while it writes."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.text = ""
        self.starts: dict[Path, int] = {}
        self.names = 0

    def put(self, *choices: str) -> None:
        self.text += self.rng.choice(choices)

    def key(self) -> tuple[str, str]:
        """A fresh key: its name and how it is written."""
        self.names += 1
        n = self.names
        return self.rng.choice(
            [
                (f"k{n}", f"k{n}"), (f"{n}", f"{n}"), (f"a.b {n}", f'"a.b {n}"'),
                (f"'{n}]", f"\"'{n}]\""),
                (f'"{n}=', f"'\"{n}='"), (f"é{n}\n", f'"\\u00e9{n}\\n"'),
                (f"-{n}_", f"-{n}_"), (f"#{n}", f"'#{n}'"),
            ]
        )  # fmt: skip

    def value(self, path: Path, depth: int) -> None:
        kind = self.rng.randrange(9 if depth else 6)
        at = len(self.text)
        if kind == 0:
            self.put("1", "-0.5e3", "true", "1979-05-27 07:32:00Z", "0xFF", "inf", "1_000")
            self.starts[path] = at
        elif kind == 1:
            self.put('"', "'")
            quote = self.text[-1]
            self.starts[path] = at + 1
            self.put("", "a # b", "[1, {", "é = 3]", "\\\\" if quote == '"' else "\\")
            self.text += quote
        elif kind == 2:
            self.text += '"\\" \\\\ \\u00e9"'
            self.starts[path] = at + 1
        elif kind in (3, 4):
            quote = 3 * self.rng.choice("\"'")
            self.text += quote
            self.put("", "\n")
            self.starts[path] = len(self.text)
            other = "'" if quote[0] == '"' else '"'
            self.put("x", f"a\n# b\n[c]\nd = {3 * other}", f"{quote[0]}, {quote[:2]}x", "  \n ]")
            self.put("", quote[0], quote[:2])
            self.text += quote
        elif kind in (5, 6):
            self.text += "["
            self.starts[path] = at
            for index in range(self.rng.randrange(4)):
                if index:
                    self.put(",", " , ", ",\n # , ]\n  ")
                self.put("", " ", "\n  ")
                self.value((*path, str(index)), depth - 1 if depth else 0)
            self.put(
                "",
                " ",
                "\n",
            ) if self.text[-1] == "[" else self.put("", " ", ",\n", ", # x\n")
            self.text += "]"
        else:
            self.text += "{"
            self.starts[path] = at
            for index in range(self.rng.randrange(4)):
                self.put(", " if index else " ")
                self.pair(path, depth - 1)
            self.text += " }"

    def pair(self, table: Path, depth: int) -> None:
        path = table
        for index in range(self.rng.choice([1, 1, 1, 2, 3])):
            if index:
                self.put(".", " . ")
            name, written = self.key()
            path = (*path, name)
            self.starts[path] = len(self.text) + (written[0] in "\"'")
            self.text += written
        self.put("=", " = ", "\t=\t")
        self.value(path, depth)

    def document(self) -> None:
        table: Path = ()
        arrays: dict[Path, int] = {}
        for _ in range(self.rng.randint(1, 12)):
            self.put("", "\n", "# [c] 'x\n", "  ")
            if self.rng.random() < 0.3:
                table = self.header(arrays)
            else:
                self.pair(table, 2)
            self.put("\n", " # e\n", "\n\n")

    def header(self, arrays: dict[Path, int]) -> Path:
        double = self.rng.random() < 0.4
        if double and arrays and self.rng.random() < 0.5:
            (name,) = self.rng.choice(list(arrays))
            arrays[name,] += 1
            self.text += f"[[{name}]]"
            path: Path = (name, str(arrays[name,]))
            self.starts[path] = len(self.text) - 2 - len(name)
            return path
        self.put("[[") if double else self.put("[", "[ ")
        name, written = (f"t{self.names}",) * 2 if double else self.key()
        self.names += 1
        self.starts[name,] = len(self.text) + (written[0] in "\"'")
        self.text += written
        if double:
            arrays[name,] = 0
            self.starts[name, "0"] = self.starts[name,]
            self.text += "]]"
            return (name, "0")
        self.put("]", " ]")
        return (name,)


def test_every_path_of_random_texts_is_found_where_it_was_written() -> None:
    total = 0
    for seed in range(400):
        scribe = Scribe(random.Random(seed))
        scribe.document()
        data = tomllib.loads(scribe.text)  # the scribe writes TOML
        positions = scan(scribe.text)
        found = {path: place.start for path, place in positions.places.items()}
        assert found == scribe.starts, f"seed {seed}"
        assert set(found) == paths_of(data), f"seed {seed}"
        total += len(found)
    assert total > 5000


def test_lines_and_columns_count_from_one() -> None:
    positions = scan('a = 1\n\n  b = "é"  \nc.d = [\n 2,\n   3]')
    assert positions.of_value(("a",)) == (1, 5)
    assert positions.of_key(("b",)) == (3, 3)
    assert positions.of_value(("b",)) == (3, 8)
    assert positions.of_value(("c", "d", "1")) == (6, 4)
    assert positions.of_value(("c", "d", "1", "deeper")) == (6, 4), "the nearest known place above"
    assert positions.of_value(("z",)) == (0, 0), "unknown"


@pytest.mark.parametrize(
    "written",
    [
        '"§"', "'a §'", '"a\\t\\u0041\\U0001F600\\\\ §x"', "'''\n\n  §'''", "'''§'''",
        '"""a\nb \\\n\n   c §\\n"""', '"""\\\n   §"""', '"""\\"\\"\\" "" §"""', "'''''§'''",
        '"\\"\\\\\\"§"', '"""§ \\\n\\\n"""',
    ],
)  # fmt: skip
def test_a_place_inside_a_string_is_found_in_spite_of_escapes(written: str) -> None:
    text = f"x = 1\nkey = {written}\n"
    value = tomllib.loads(text)["key"]
    index, offset = value.index("§"), text.index("§")
    line = value.count("\n", 0, index) + 1
    column = index - value.rfind("\n", 0, index)
    expected = (text.count("\n", 0, offset) + 1, offset - text.rfind("\n", 0, offset))
    assert scan(text).inside(("key",), value, line, column) == expected


ANYTHING = st.one_of(st.text(max_size=60), st.text(alphabet="ab=.[]{}\"'\\\n #,1", max_size=60))


@settings(max_examples=500, deadline=None, derandomize=True, database=None)
@given(ANYTHING)
def test_scanning_never_raises_and_knows_what_the_parser_knows(text: str) -> None:
    places = scan(text).places
    try:
        data = load(text)
    except ModelError:
        return
    if "\r" not in text:
        assert paths_of(data) <= set(places)


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(st.one_of(st.text(max_size=40), st.text(alphabet="ab\"'\\\n\t\x00\x7f .", max_size=20)))
def test_written_strings_and_keys_are_read_back(text: str) -> None:
    for written in (toml_string(text), toml_block(text)):
        assert tomllib.loads(f"x = {written}") == {"x": text}
    assert tomllib.loads(f"{toml_key(text)} = 1") == {text: 1}
