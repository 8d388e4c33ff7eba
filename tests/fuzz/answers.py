"""Inputs for the readers whose parser is another's program in a process of its own: PRISM and RDDL.

What is fuzzed is ours: the scan of the text, the check of the parser's answer, and what is made of it.  An
input is a program and the answer to it, either of them changed; the process is not run.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final
from unittest.mock import patch

from rddl_texts import BOX, LIFE, LIFT, SERVERS, WALK

from factored_polca.formats import prism_process, rddl_process
from factored_polca.formats.prism import read_prism
from factored_polca.formats.prism_text import scan
from factored_polca.formats.rddl import read_rddl_with_warnings
from factored_polca.models import ModelError

from .choices import Choices
from .mutation import mutated
from .pieces import BAD_NAMES, BAD_NUMBERS

MARK: Final = b"\n%%answer%%\n"
"""Stands between a program and the answer."""
PROGRAMS: Final = {
    "prism": (
        b"mdp\nconst double p = 0.3;\nmodule m\n x : [0..3] init 0;\n b : bool init false;\n"
        b" [go] x<3 -> p : (x'=x+1) & (b'=!b) + 1-p : true;\n [stay] true -> (b'=false);\nendmodule\n"
        b'label "terminal" = x=3;\nrewards "r"\n [go] b : 2;\n x=1 : -1/3;\nendrewards\n',
        b"dtmc\nmodule left\n a : [0..2];\n [t] a=0 -> 1/2 : (a'=1) + 1/2 : (a'=2);\n [t] a>0 -> (a'=0);\n"
        b"endmodule\nmodule right = left [a=c] endmodule\ninit a=0 | c=1 endinit\n",
        b"mdp\nformula low = v<2;\nglobal v : [0..2] init 1;\nmodule one\n s : bool;\n"
        b" [] low -> 0.1 : (v'=v+1) + 0.9 : (s'=true);\n [reset] !low -> (v'=0) & (s'=false);\nendmodule\n"
        b"rewards\n low : 1;\n [reset] true : -5;\nendrewards\n",
    ),
    "rddl": tuple(text.encode() for text in (SERVERS, LIFE, LIFT, WALK, BOX)),
}
WORDS: Final = {
    "prism": tuple(
        b"module endmodule rewards endrewards init endinit label formula const double int bool mdp dtmc "
        b"[ ] -> ' .. & // /* \"".split()
    ),
    "rddl": tuple(
        b"domain instance non-fluents pvariables cpfs reward forall sum { } horizon discount init-state "
        b"max-nondef-actions KronDelta Bernoulli // =".split()
    ),
}
SETTINGS: Final = ({"discount": "0.9"}, {"discount": "0.9"}, {"discount": "1", "costs": "r"}, {})
STRANGE: Final = (
    None, True, -1, 0, 3, 10**30, 1.5, "", "x", "?x", "@red", "x'", "1e9", "0." + "1" * 900, "9" * 5000,
    "sum", "pow", "Bernoulli", "1/0", "__class__", "../x", [], [[]], {}, ["name", "x"],
    *BAD_NAMES, *BAD_NUMBERS,
)  # fmt: skip


def parsers() -> tuple[str, ...]:
    """Those whose parser is installed; without it there are no sound answers."""
    needed = {"prism": "stormpy", "rddl": "pyRDDLGym"}
    return tuple(name for name, package in needed.items() if find_spec(package) is not None)


@cache
def answered(name: str) -> tuple[bytes, ...]:
    """The programs, each with what its parser says."""
    return tuple(program + MARK + _answer(name, program.decode()) for program in PROGRAMS[name])


def _answer(name: str, text: str) -> bytes:
    if name == "rddl":
        return json.dumps(rddl_process.parsed(text)).encode()
    with TemporaryDirectory() as folder:
        (Path(folder) / "model.prism").write_text(scan(text).for_the_parser(), encoding="utf-8")
        answer, status = prism_process._run(Path(folder))
    assert status == 0
    assert b'"error"' not in answer[:10], answer
    return answer


def changer(name: str) -> Callable[[Choices], bytes]:
    """Changes the program, the answer's text, or parts of the answer."""

    def change(c: Choices) -> bytes:
        program, _, answer = c.one(answered(name)).partition(MARK)
        kind = c.below(8)
        if kind == 0:
            answer = mutated(c, (answer,), WORDS[name])
        elif kind > 2:
            answer = _rebuilt(c, answer, [whole.partition(MARK)[2] for whole in answered(name)])
        if kind in (1, 2, 3):
            program = mutated(c, (program,), WORDS[name])
        return program + MARK + answer

    return change


def _rebuilt(c: Choices, answer: bytes, others: Sequence[bytes]) -> bytes:
    """Some parts of an answer become others, of this answer or of another, or strange ones."""
    data = json.loads(answer)
    for _ in c.some(1, 3):
        holder, key = _place(c, data)
        if holder is None:
            continue
        match c.below(4):
            case 0:
                holder[key] = c.one(STRANGE)
            case 1:
                theirs, there = _place(c, json.loads(c.one(others)))
                holder[key] = holder[key] if theirs is None else theirs[there]
            case 2 if isinstance(holder, list):
                holder[key : key + 1] = [] if c.below(2) else [holder[key], holder[key]]
            case _:
                number = holder[key]
                whole = isinstance(number, int) and not isinstance(number, bool)
                holder[key] = number + c.below(5) - 2 if whole else _again(data, c)
    return json.dumps(data).encode()


def _again(data: Any, c: Choices) -> Any:
    """A part of the answer, copied."""
    holder, key = _place(c, data)
    return None if holder is None else json.loads(json.dumps(holder[key]))


def _place(c: Choices, data: Any) -> tuple[Any, Any]:
    """A list or an object inside `data`, and one of its keys."""
    holder: Any = None
    key: Any = None
    for _ in c.some(1, 6):
        keys = list(data) if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
        if not keys:
            break
        holder, key = data, c.one(list(keys))
        data = holder[key]
    return holder, key


def new(name: str) -> Callable[[Choices], bytes]:
    """A program of words of the language, with an answer that belongs to another."""

    def make(c: Choices) -> bytes:
        words = [c.one(WORDS[name]) for _ in c.some(0, 40)]
        return b" ".join(words) + MARK + c.one(answered(name)).partition(MARK)[2]

    return make


def reading(name: str) -> Callable[[bytes, str], Any]:
    """Reads such an input as the format's reader does, the process left out."""

    def read(data: bytes, file: str) -> Any:
        program, _, answer = data.partition(MARK)
        text = program.decode("utf-8", "replace")
        try:
            with _answering(name, answer):
                if name == "prism":
                    return read_prism(text, SETTINGS[len(data) % len(SETTINGS)])[0]
                return read_rddl_with_warnings([text])[0]
        except ModelError as error:
            raise error.in_file(file) from None

    return read


@contextmanager
def _answering(name: str, answer: bytes) -> Iterator[None]:
    module = prism_process if name == "prism" else rddl_process
    with patch.object(module, "_run", lambda *_: (answer, 0)):
        yield
