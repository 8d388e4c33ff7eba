"""Plan and policy files: zips of JSON, a model and arrays, changed inside and outside."""

from __future__ import annotations

import io
import json
import struct
import tempfile
import tokenize
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

import factored_polca as fp
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.formats import read_native
from factored_polca.hierarchy.options import Options
from factored_polca.hierarchy.policy_file import FlatPolicy, save_policy
from factored_polca.minimisation.flat_model import flat_model

from .choices import Choices
from .mutation import mutated
from .native_text import WORDS as MODEL_WORDS
from .native_text import native_text
from .pieces import BAD_NAMES

JSON_WORDS: Final = tuple(
    text.encode()
    for text in (
        "{", "}", "[", "]", ":", ",", '"', "null", "true", "false", "0", "-1", "1e999", "NaN", "Infinity",
        "[" * 2000,
        '{"a":' * 500, '"\\ud800"', '"format"', '"version"', '"order"', '"tasks"', '"blocks"', '"kind"',
        '"head"',
        '"root"', '"report"', '"alpha"', '"graph"', '"mdp"', '"staged"', '"entropy"', '"meanings"',
        '"reachable"',
        '"states"', '"digest"', "9" * 5000, "1" * 30,
    )
)  # fmt: skip
NPY_WORDS: Final = (
    b"\x93NUMPY", b"\x01\x00", b"\x02\x00", b"'descr'", b"'<i8'", b"'|O'", b"'<f8'", b"'shape'", b"(2,)",
    b"(-1,)", b"()", b"(9999999999999,)", b"'fortran_order'", b"True", b"False", b"\x00" * 8, b"\xff" * 8,
    b"__import__('os')", b"{", b"}", struct.pack("<d", float("nan")), struct.pack("<q", -1),
    struct.pack("<q", 1 << 62), b"(" * 300,
)  # fmt: skip
ENTRY_NAMES: Final = (
    "plan.json", "belief-plan.json", "policy.json", "model.toml", "../evil", "/etc/passwd", "actions.npy",
    "start.npy",
    "policy.levels.npy", "task0.levels.npy", "task0.corner.npy", "task9.levels.npy", *BAD_NAMES[:10],
)  # fmt: skip


Contents = Mapping[str, bytes]


def packed(entries: Sequence[tuple[str, bytes]], compression: int = zipfile.ZIP_STORED) -> bytes:
    """A zip with these entries."""
    stream = io.BytesIO()
    with warnings.catch_warnings(action="ignore"), zipfile.ZipFile(stream, "w", compression) as archive:
        for name, data in entries:
            info = zipfile.ZipInfo(name.encode("utf-8", "replace").decode("utf-8")[:1000])
            info.compress_type = compression
            archive.writestr(info, data)
    return stream.getvalue()


def unpacked(data: bytes) -> Contents:
    """The entries of a sound zip."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def changed_archive(c: Choices, corpus: Sequence[Contents]) -> bytes:
    """A zip of `corpus`, one to three entries of it changed, or its bytes."""
    entries = list(c.one(corpus).items())
    outside = c.rarely(8)
    for _ in c.some(0 if outside else 1, 3):
        _change(c, entries, corpus)
    data = packed(entries, zipfile.ZIP_DEFLATED if c.rarely(6) else zipfile.ZIP_STORED)
    return (
        mutated(c, [data], (b"PK\x03\x04", b"PK\x01\x02", b"PK\x05\x06", b"\xff" * 4)) if outside else data
    )


def _change(c: Choices, entries: list[tuple[str, bytes]], corpus: Sequence[Contents]) -> None:
    if not entries:
        return
    at = c.below(len(entries))
    name, data = entries[at]
    match c.below(8):
        case 0:
            del entries[at]
        case 1:
            entries[at] = c.one(ENTRY_NAMES), data
        case 2:
            other = c.one(corpus)
            entries[at] = name, other.get(name, data)
        case 3:
            entries[at] = name, new_entry(c, name)
        case _:
            entries[at] = name, _changed_entry(c, name, data, corpus)


def _changed_entry(c: Choices, name: str, data: bytes, corpus: Sequence[Contents]) -> bytes:
    if name.endswith(".toml"):
        return mutated(c, [data, *(part["model.toml"] for part in corpus)], MODEL_WORDS)
    if name.endswith(".json"):
        if c.below(2):
            return mutated(c, [data], JSON_WORDS)
        return _changed_json(c, data)
    if c.below(2):
        return _changed_array(c, data)
    return mutated(c, [data], NPY_WORDS)


def _value(c: Choices, depth: int = 2) -> Any:
    plain = (0, 1, -1, 2, 10**30, 1.5, True, False, None, "", "x", "alpha", "lower", [], {}, *BAD_NAMES[:6])
    if depth and c.rarely(4):
        return [_value(c, depth - 1) for _ in c.some(0, 3)]
    if depth and c.rarely(6):
        return {str(_value(c, 0)): _value(c, depth - 1) for _ in c.some(0, 2)}
    return c.one(plain)


def _changed_json(c: Choices, data: bytes) -> bytes:
    """A value of the object becomes another, or a key goes."""
    try:
        whole = json.loads(data)
        place, key = whole, c.one(sorted(whole))
        while isinstance(place[key], (dict, list)) and place[key] and c.below(3):
            place = place[key]
            key = c.one(sorted(place)) if isinstance(place, dict) else c.below(len(place))
        if c.rarely(6):
            del place[key]
        else:
            place[key] = _value(c)
        return json.dumps(whole).encode()
    except (ValueError, KeyError, IndexError, TypeError):
        return data


def _array(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=False)
    return stream.getvalue()


def _changed_array(c: Choices, data: bytes) -> bytes:
    """Numbers of an array become others; its shape or type changes."""
    try:
        array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False).copy()
    except (ValueError, tokenize.TokenError, SyntaxError, MemoryError):  # it has been changed before
        return data
    match c.below(5):
        case 0:
            array = array[: c.below(len(array) + 1)] if array.ndim else array
        case 1:
            with np.errstate(all="ignore"):
                array = array.astype(c.one(("<i2", "<i8", "<f8", "<i4", "?", "<u8", ">i8", "<f4", "<c16")))
        case 2:
            array = array.reshape(c.one(((-1,), (1, -1), (-1, 1), (1, 1, -1))))
        case _:
            flat = array.reshape(-1)
            for _ in c.some(1, 3):
                if flat.size:
                    new = np.array([c.one((0, 1, -1, 2, 3, 7, 100, 32767, 1 << 30))])
                    flat[c.below(flat.size)] = new.astype(array.dtype)[0]
    return _array(array)


def new_entry(c: Choices, name: str) -> bytes:
    """An entry made from nothing."""
    if name.endswith(".toml"):
        return native_text(c)
    if name.endswith(".json"):
        keys = (
            "format",
            "version",
            "order",
            "root",
            "tasks",
            "report",
            "kind",
            "reachable",
            "states",
            "digest",
            "head",
        )
        return json.dumps({key: _value(c) for key in keys if c.below(8)}).encode()
    kind = c.one(("<i8", "<f8", "<i2", "?"))
    return _array(np.array([c.below(5) - 1 for _ in c.some(0, 8)]).astype(kind))


def new_archive(c: Choices, corpus: Sequence[Contents]) -> bytes:
    """A zip with the entries of one of `corpus`, each kept or made from nothing."""
    return packed([
        (name, data if c.below(3) else new_entry(c, name)) for name, data in c.one(corpus).items()
    ])  # fmt: skip


LAMP: Final = """discount = 0.5
reward = "1 if on else 0"
[features]
on = "boolean"
[actions.press]
effects.on = "{true: 0.9, false: 0.1}"
[actions.wait]
reward = "-1"
[tasks.Root]
actions = ["Child", "wait"]
[tasks.Child]
actions = ["press"]
"""
HIDDEN: Final = """observability = "partial"
[observations]
seen = ["u", "v", "none"]
[initial]
on = "uniform"
[actions.press]
senses.seen = "{u: 0.8, v: 0.2} if on' else v"
"""
"""What makes the lamp a partially observed model."""


def _small(partial: bool) -> Any:
    """A model of two states with tasks, so small that its plan is read in a millisecond."""
    if not partial:
        return read_native(LAMP)
    flag, _, rest = HIDDEN.partition("\n")
    middle, _, senses = rest.partition("[actions.press]\n")
    return read_native(f"{flag}\n{LAMP}".replace("[actions.press]\n", f"{middle}[actions.press]\n{senses}"))


@cache
def _saved(what: str) -> bytes:
    kind, _, name = what.partition(" ")
    small = _small(kind != "plan" and name != "seen")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "saved"
        if kind == "plan":
            fp.save_plan(fp.executable(fp.plan(small.model, small.tasks)), path)
        elif kind == "belief-plan":
            found = fp.plan_pomdp(small.model, small.tasks, Options(solver=name))
            fp.save_pomdp_plan(fp.executable_pomdp(found), path)
        else:
            flat = flat_model(fp.compile_model(small.model), reachable=False)
            if name == "seen":
                save_policy(FlatPolicy(flat, StatePolicy(np.array([[0, 1]]))), path)
            else:
                policy = fp.solve_pomdp(flat.pomdp, name, demand=fp.Demand(gap=0.1)).policy
                save_policy(FlatPolicy(flat, policy), path)
        return path.read_bytes()


SAVED: Final[Mapping[str, tuple[str, ...]]] = {
    "plan": ("plan lamp",),
    "belief-plan": ("belief-plan sarsop", "belief-plan amdp"),
    "policy": ("policy sarsop", "policy exact", "policy amdp", "policy seen"),
}
"""Kind of file -> the files that inputs are made of."""


@cache
def corpus_of(kind: str) -> tuple[Contents, ...]:
    """The contents of sound files."""
    return tuple(unpacked(_saved(what)) for what in SAVED[kind])


def maker(kind: str, make: Callable[[Choices, Sequence[Contents]], bytes]) -> Callable[[Choices], bytes]:
    """`make` with the corpus of a kind."""
    return lambda c: make(c, corpus_of(kind))
