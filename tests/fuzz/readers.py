"""The readers that are fuzzed: what they read, what inputs are made of, and how much work they may do."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

from factored_polca import array_pomdp, library
from factored_polca.formats import alpha_file, cassandra_factoring, files, graph_file, read_native
from factored_polca.formats.alpha_file import read_alpha
from factored_polca.formats.graph_file import read_graph
from factored_polca.hierarchy.plan_file import load_plan
from factored_polca.hierarchy.policy_file import load_policy
from factored_polca.hierarchy.pomdp_plan_file import load_pomdp_plan
from factored_polca.models import LimitReached, ModelError

from . import answers, archives, cassandra_text, native_text, policy_texts, pomdpx_text, spudd_text
from .choices import Choices
from .mutation import mutated

MOST_BYTES: Final = 2_600
"""Larger files are not in the corpus: an input is to be read in a millisecond."""
SHIPPED: Final = (
    "cheese", "cheese_taxi", "coffee", "components", "expon", "linear", "meds", "network", "part_painting",
    "rocksample", "sysadmin", "taxi", "tiger", "toy", "twenty_questions",
)  # fmt: skip
SIZES: Final = {
    "components": "2",
    "expon": "3",
    "linear": "3",
    "network": "2",
    "sysadmin": "3",
    "taxi": "2",
}


@dataclass(frozen=True)
class Reader:
    """A reader: the name that its inputs have, how they are made, and reading one."""

    file: str
    text: bool  # of text formats every fault has a line and a column
    corpus: Callable[[], Sequence[bytes]]
    change: Callable[[Choices], bytes]
    generate: Callable[[Choices], bytes]
    read: Callable[[bytes, str], Any]
    limits: tuple[type[BaseException], ...] = ()  # what it says it raises where a model is too large

    def make(self, c: Choices) -> bytes:
        """An input."""
        return self.generate(c) if c.below(3) == 2 else self.change(c)


@cache
def written(extension: str) -> tuple[bytes, ...]:
    """Shipped domains in a format, and the files of FACTORED_POLCA_DATA that have its extension."""
    found = []
    for name in SHIPPED:
        domain = library.load(name, {"size": SIZES[name]} if name in SIZES else {})
        tasks = domain.tasks if extension == ".toml" else None
        try:
            text = files.FORMATS[extension].write(files.Document(domain.model, tasks))
        except ModelError:
            continue
        if len(text) <= MOST_BYTES:
            found.append(text.encode())
    folder = os.environ.get("FACTORED_POLCA_DATA", "")
    for path in sorted(Path(folder).iterdir()) if folder else ():
        same = files.FORMATS.get(path.suffix.lower()) is files.FORMATS[extension]
        if same and path.stat().st_size <= 2 * MOST_BYTES:
            found.append(path.read_bytes())
    return tuple(found)


def _model(extension: str, words: Sequence[bytes], generate: Callable[[Choices], bytes]) -> Reader:
    return Reader(
        f"input{extension}",
        True,
        lambda: written(extension),
        lambda c: mutated(c, written(extension), words),
        generate,
        lambda data, file: files.document_of(data, file),
    )


def _tasks(data: bytes, file: str) -> Any:
    from factored_polca.formats.native import read_native_tasks

    try:
        return read_native_tasks(data.decode("utf-8", "replace"), _toy())
    except ModelError as error:
        raise error.in_file(file) from None


@cache
def _toy() -> Any:
    return library.load("toy", {}).model


@cache
def _arrays() -> Any:
    stay, listen = [[0.5, 0.5], [0.5, 0.5]], [[0.85, 0.0], [0.0, 0.15]]
    other = [[0.15, 0.0], [0.0, 0.85]]
    return array_pomdp(
        [[listen, other], [stay], [stay]], [[-1.0, -1.0], [10.0, -100.0], [-100.0, 10.0]], [0.5, 0.5], 0.95,
        observations=[["left", "right"], ["left"], ["left"]],
    )  # fmt: skip


ALPHAS: Final = (
    b"0\n19.3713683559 19.3713683559\n\n1\n-81.5972 28.4028\n\n2\n28.4028 -81.5972\n\n",
    b"0 1 2\n1 -3.5e-3 +4.\n",
    b"2\n1\n2\n\n0\n.5\n-0\n",
)
GRAPHS: Final = (
    b"0 1  0 - \n1 0  0 1 \n",
    b"0 0  1 2\n1 0  3 0\n2 0  0 4\n3 2  0 0\n4 1  0 0\n",
    b"0 2 X X\n",
)


@contextmanager
def prepared() -> Iterator[None]:
    """Within it what the readers make of `_arrays` is made once: their work on texts is what counts."""
    made = cassandra_factoring.factored(_arrays())
    with (
        patch.object(alpha_file, "factored", lambda _: made),
        patch.object(graph_file, "factored", lambda _: made),
    ):
        yield


def _policy(
    file: str,
    seeds: Sequence[bytes],
    words: Sequence[bytes],
    generate: Callable[[Choices], bytes],
    read: Any,
) -> Reader:
    def located(data: bytes, name: str) -> Any:
        try:
            return read(data.decode("utf-8", "replace"), _arrays())
        except ModelError as error:
            raise error.in_file(name) from None

    return Reader(file, True, lambda: seeds, lambda c: mutated(c, seeds, words), generate, located)


_FOLDER: Final = "/dev/shm" if Path("/dev/shm").is_dir() else None


@cache
def _scratch() -> Any:
    return tempfile.TemporaryDirectory(prefix="factored_polca_fuzz_", dir=_FOLDER)


def _archive(kind: str, load: Callable[[str], Any]) -> Reader:
    path = Path(_scratch().name) / f"input.{kind}"

    def read(data: bytes, file: str) -> Any:
        path.write_bytes(data)
        return load(file)

    return Reader(
        str(path),
        False,
        lambda: tuple(archives.packed(list(part.items())) for part in archives.corpus_of(kind)),
        archives.maker(kind, archives.changed_archive),
        archives.maker(kind, archives.new_archive),
        read,
        (LimitReached,),
    )


def _parsed_elsewhere(name: str) -> Reader:
    return Reader(
        f"input.{name}", False, lambda: answers.answered(name), answers.changer(name), answers.new(name),
        answers.reading(name),
    )  # fmt: skip


READERS: Final[dict[str, Reader]] = {
    "native": _model(".toml", native_text.WORDS, native_text.native_text),
    "spudd": _model(".dat", spudd_text.WORDS, spudd_text.spudd_text),
    "pomdpx": _model(".pomdpx", pomdpx_text.WORDS, pomdpx_text.pomdpx_text),
    "cassandra": _model(".pomdp", cassandra_text.WORDS, cassandra_text.cassandra_text),
    "tasks": Reader(
        "tasks.toml", True, lambda: written(".toml"), lambda c: mutated(c, written(".toml"),
        native_text.WORDS),
        native_text.native_text, _tasks,
    ),
    "alpha": _policy("input.alpha", ALPHAS, policy_texts.ALPHA_WORDS, policy_texts.alpha_text, read_alpha),
    "pg": _policy("input.pg", GRAPHS, policy_texts.GRAPH_WORDS, policy_texts.graph_text, read_graph),
    "plan": _archive("plan", load_plan),
    "belief-plan": _archive("belief-plan", load_pomdp_plan),
    "policy": _archive("policy", load_policy),
    **{name: _parsed_elsewhere(name) for name in answers.parsers()},
}  # fmt: skip
"""Name -> reader."""

__all__ = ["READERS", "Reader", "read_native", "written"]
