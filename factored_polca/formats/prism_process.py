"""Runs the parser of PRISM programs: stormpy (the extra `storm`), in a child process with limits.

Storm's parser is C++ that may stop the process it runs in, and model files come from strangers. So it
runs in a process of its own (`factored_polca.formats.prism_child`), in an empty folder that holds only
the text, with limits on processor time, memory and the length of what it prints; its answer is data, and
every part of it is checked here before use. A fault is told with its place in the text.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import selectors
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, Final

from factored_polca.formats.prism_text import Place
from factored_polca.models.errors import Fault, ModelError

SECONDS: Final = 60
"""Processor seconds that the parser may take."""
WAITING: Final = 300.0
"""Seconds of waiting for it, however busy the machine."""
MEGABYTES: Final = 4096
"""Address space of the parser."""
MAXIMUM_ANSWER: Final = 256 * 2**20

CHILD: Final = Path(__file__).with_name("prism_child.py")

NEEDED: Final = "reading PRISM needs stormpy 2, which is an extra: pip install 'factored-polca[storm]'"


@dataclass(frozen=True)
class RawVariable:
    """A variable: `low` and `high` are nodes, None for truth values; `first` is None if there is `init`."""

    name: str
    module: str | None
    low: int | None
    high: int | None
    first: int | None


@dataclass(frozen=True)
class RawCommand:
    """A command: its label ("" for none), the node of its guard, outcomes (chance, updates)."""

    label: str
    guard: int
    outcomes: tuple[tuple[int, tuple[tuple[str, int], ...]], ...]


@dataclass(frozen=True)
class RawProgram:
    """A program as the parser gives it; numbers are those of `nodes`."""

    constants: tuple[tuple[str, str, int | None], ...]
    variables: tuple[RawVariable, ...]
    modules: tuple[tuple[str, tuple[RawCommand, ...]], ...]
    labels: tuple[tuple[str, int], ...]
    initial: int | None
    nodes: tuple[tuple[Any, ...], ...]


def parse_program(text: str, original: Callable[[int, int], Place]) -> RawProgram:
    """What stormpy reads in `text`; `original` gives the place to tell for a place in it.

    Raises:
        ModelError: stormpy is not there, does not take the text, or reached a limit.
    """
    if find_spec("stormpy") is None:
        raise ModelError(NEEDED)
    with tempfile.TemporaryDirectory(prefix="factored_polca_") as name:
        folder = Path(name)
        (folder / "model.prism").write_text(text, encoding="utf-8")
        answer, code = _run(folder)
    if code != 0:
        raise ModelError(_ending(code))
    try:
        data = json.loads(answer)
        if isinstance(data, dict) and isinstance(data.get("error"), str):
            raise _refusal(data["error"], original)
        return _checked(data)
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        if isinstance(error, ModelError):
            raise
        raise ModelError(
            "the parser of PRISM gave an answer that can't be read; is it stormpy 2?"
        ) from error


def _run(folder: Path) -> tuple[bytes, int]:
    """What the child prints, as much of it as is read, and its exit status."""
    command = [sys.executable, "-I", str(CHILD), "model.prism", str(SECONDS), str(MEGABYTES)]
    with (folder / "said").open("wb") as said:
        process = subprocess.Popen(
            command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said,
            start_new_session=True,
        )  # fmt: skip
        assert process.stdout is not None
        try:
            answer = _answer(process.stdout, time.monotonic() + WAITING)
            return answer, process.wait(timeout=WAITING)
        except (subprocess.TimeoutExpired, TimeoutError):
            return b"", -signal.SIGXCPU
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
            process.stdout.close()
            process.wait()


def _answer(stream: IO[bytes], deadline: float) -> bytes:
    """What a child writes until it ends.

    Raises:
        TimeoutError: it has not ended at the deadline.
        ModelError: it writes too much.
    """
    parts: list[bytes] = []
    length = 0
    with selectors.DefaultSelector() as selector:
        selector.register(stream, selectors.EVENT_READ)
        while True:
            if not selector.select(max(0.0, deadline - time.monotonic())):
                raise TimeoutError
            part = os.read(stream.fileno(), 1 << 20)
            if not part:
                return b"".join(parts)
            parts.append(part)
            length += len(part)
            if length > MAXIMUM_ANSWER:
                raise ModelError(
                    f"the program is too large: written out it has more than {MAXIMUM_ANSWER} bytes"
                )


def _ending(code: int) -> str:
    if -code in (signal.SIGXCPU, signal.SIGKILL):
        limits = f"it may take {SECONDS} s and {MEGABYTES} MB"
        return f"the parser of PRISM was stopped: {limits}; is the program so large?"
    if code < 0:
        name = signal.Signals(-code).name if -code in {s.value for s in signal.Signals} else str(-code)
        return f"the parser of PRISM crashed on this program (signal {name}); does Storm itself read it?"
    return f"the parser of PRISM ended with status {code}; is stormpy 2 installed right?"


_PLACES: Final = (
    re.compile(r"Parsing error at (?P<line>\d{1,9}):(?P<column>\d{1,9}):\s*"),
    re.compile(r"\s*\(?(?:in )?(?:file )?\S*model\.prism, line (?P<line>\d{1,9})\)?"),
)


def _refusal(message: str, original: Callable[[int, int], Place]) -> ModelError:
    """What the parser says, as a fault with its place."""
    line = column = 0
    for pattern in _PLACES:
        match = pattern.search(message)
        if match is not None and not line:
            line = int(match["line"])
            column = int(match.groupdict().get("column") or 1)
            message = message[: match.start()] + message[match.end() :]
    if line:
        line, column = original(line, column)
    message = re.sub(r"^(WrongFormatException|InvalidTypeException|[A-Z]\w*Exception):\s*", "", message)
    message = re.sub(r",? here:\n.*", "", message, flags=re.DOTALL)
    message = re.sub(r"^Error( for)?:?\s+", "", message)
    text = "".join(c if c.isprintable() else " " for c in message).strip()[:1000]
    return ModelError([Fault(f"Storm's parser: {text}", line=line, column=column)])


# -- checking the answer ---------------------------------------------------------------------


def _checked(data: Any) -> RawProgram:
    version = str(data["version"])
    if not re.match(r"[2-9]\.", version):
        raise ModelError(f"{NEEDED}; {version[:40]} is installed")
    nodes = tuple(_node(row, index) for index, row in enumerate(data["nodes"]))

    def node(number: Any) -> int:
        if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < len(nodes):
            raise ValueError("a number that is no node's")
        return number

    def perhaps(number: Any) -> int | None:
        return None if number is None else node(number)

    names = {_text(row[0]) for row in data["variables"]}

    def variable(name: Any) -> str:
        if _text(name) not in names:
            raise ValueError("an update of no variable")
        return str(name)

    def command(row: Any) -> RawCommand:
        label, guard, outcomes = row
        return RawCommand(
            _text(label),
            node(guard),
            tuple(
                (node(chance), tuple((variable(name), node(value)) for name, value in updates))
                for chance, updates in outcomes
            ),
        )

    return RawProgram(
        tuple((_text(n), _text(kind), perhaps(value)) for n, kind, value in data["constants"]),
        tuple(
            RawVariable(
                _text(n), None if m is None else _text(m), perhaps(low), perhaps(high), perhaps(first)
            )
            for n, m, low, high, first in data["variables"]
        ),
        tuple((_text(n), tuple(command(row) for row in rows)) for n, rows in data["modules"]),
        tuple((_text(n), node(value)) for n, value in data["labels"]),
        perhaps(data["initial"]),
        nodes,
    )


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError("a name that is no text")
    return value


_BINARY: Final = (
    "AND", "OR", "IFF", "XOR", "IMPLIES", "EQUAL", "NOT_EQUAL", "LESS", "LESS_OR_EQUAL", "GREATER",
    "GREATER_OR_EQUAL", "PLUS", "TIMES", "DIVIDE", "MIN", "MAX", "POWER", "MODULO",
)  # fmt: skip
_PARTS: Final[Mapping[str, tuple[int, ...]]] = {
    "NOT": (1,), "FLOOR": (1,), "CEIL": (1,), "MINUS": (1, 2), "ITE": (3,),
} | dict.fromkeys(_BINARY, (2,))  # fmt: skip
"""How many parts an operator has; of one that is not read, any number."""


def _node(row: Any, index: int) -> tuple[Any, ...]:
    if not isinstance(row, list) or not row or not isinstance(row[0], str):
        raise TypeError("a node that is none")
    kind, *rest = row
    if kind in ("int", "rational", "name"):
        (text,) = rest
        pattern = {"int": r"-?[0-9]+", "rational": r"-?[0-9]+(/[0-9]+)?", "name": r".+"}[kind]
        if re.fullmatch(pattern, _text(text)) is None:
            raise ValueError("a node that is none")
    elif kind == "bool":
        (truth,) = rest
        if not isinstance(truth, bool):
            raise TypeError("a node that is none")
    elif not _are_before(rest, index):
        raise ValueError("a node before its parts")
    elif len(rest) not in _PARTS.get(kind, (len(rest),)):
        raise ValueError("a node with parts too many or too few")
    return (kind, *rest)


def _are_before(numbers: Sequence[Any], index: int) -> bool:
    return bool(numbers) and all(type(n) is int and 0 <= n < index for n in numbers)
