"""Writer of Cassandra's format; the format is described in `factored_polca.formats.cassandra`.

What is written are arrays: a flat model or a quotient, made into T and O by
`factored_polca.formats.cassandra_factoring`.  States are counted, not named.  Numbers are the shortest
decimals that are read back as the same floats; rows sum to exactly 1.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from factored_polca.explicit.arrays import ArrayMDP, FloatArray, SparseMatrix
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.formats.cassandra_factoring import END, FactoredArrays, factored, with_first_step
from factored_polca.formats.decimals import float_row_texts, float_text
from factored_polca.formats.spudd_names import distinct_names

_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9_\-]*\Z")
RESERVED: Final = {
    "discount", "values", "states", "actions", "observations", "T", "O", "R", "uniform", "identity",
    "reward", "cost", "reset", "start", "include", "exclude",
}  # fmt: skip
"""Words of the format, which other programs do not take as names."""
LISTED: Final = 1_000
"""States whose meaning is told in comments."""


def write_pomdp(
    pomdp: ArrayPOMDP, name: str = "", states: Sequence[str] | None = None, *, first_step: bool = False
) -> str:
    """`pomdp` in Cassandra's format; `states` says in comments what each state is.

    With `first_step` it begins a step earlier, see `cassandra_factoring.with_first_step`.

    Raises:
        ModelError: the format can't express it; see `cassandra_factoring.factored`.
    """
    if first_step:
        pomdp = with_first_step(pomdp)
        states = None if states is None else [*states, "the beginning: a step that shows what is seen"]
    return write_factored(factored(pomdp), name, states)


def write_mdp(
    mdp: ArrayMDP, initial: FloatArray, name: str = "", states: Sequence[str] | None = None
) -> str:
    """An MDP with the start distribution `initial` [s] in Cassandra's format.

    Raises:
        ModelError: an action that does not apply everywhere.
    """
    seen = ArrayPOMDP(
        mdp.actions, (("nothing",),) * len(mdp.actions), tuple((matrix,) for matrix in mdp.transitions),
        mdp.rewards, mdp.terminal, np.arange(mdp.states), initial, mdp.discount,
    )  # fmt: skip
    return write_pomdp(seen, name, states)


def write_factored(arrays: FactoredArrays, name: str = "", states: Sequence[str] | None = None) -> str:
    """Arrays with T and O apart in Cassandra's format."""
    return "\n".join(_lines(arrays, name, states)) + "\n"


def spelled(names: Sequence[str], prefix: str) -> list[str]:
    """Names as the format takes them, all different."""
    wanted = [name if not name or name[0].isalpha() else f"{prefix}{name}" for name in names]
    wanted = [text if text.isascii() else re.sub(r"[^\x20-\x7e]", "_", text) for text in wanted]
    result = distinct_names(wanted, _NAME, set(RESERVED))
    return [text if text[0].isalpha() else f"{prefix}{text}" for text in result]


def _lines(arrays: FactoredArrays, name: str, states: Sequence[str] | None) -> Iterator[str]:
    yield _comment(name or "a decision process")
    actions, labels = spelled(arrays.actions, "a"), spelled(arrays.labels, "o")
    for word, old, new in (("action", arrays.actions, actions), ("observation", arrays.labels, labels)):
        if arrays.observations is None and word == "observation":
            continue
        for before, after in zip(old, new, strict=True):
            if before != after:
                yield _comment(f"{word} {after} is {before}")
    if arrays.origin[-1] == END:
        yield _comment(
            f"state {arrays.states - 1} stands for all terminal states: it is never left, reward 0"
        )
    if np.any(arrays.symbol >= 0):
        yield _comment("states told apart by their observation only: what is observed depends on the state "
                       "before, too")  # fmt: skip
    for k in range(arrays.states if states is not None and arrays.states <= LISTED else 0):
        origin = int(arrays.origin[k])
        if states is not None and origin != END:
            pair = f", {labels[int(arrays.symbol[k])]}" if arrays.symbol[k] >= 0 else ""
            yield _comment(f"state {k}: {states[origin]}{pair}")
    yield f"discount: {float_text(arrays.discount)}"
    yield "values: reward"
    yield f"states: {arrays.states}"
    yield f"actions: {' '.join(actions)}"
    if arrays.observations is not None:
        yield f"observations: {' '.join(labels)}"
    yield f"start: {' '.join(float_row_texts(arrays.initial.tolist()))}"
    for a, action in enumerate(actions):
        yield from _rows(f"T: {action}", arrays.transitions[a], range(arrays.states))
        if arrays.observations is not None:
            yield from _rows(f"O: {action}", arrays.observations[a], labels)
        rest = " : *" if arrays.observations is None else " : * : *"
        for s, reward in enumerate(arrays.rewards[a].tolist()):
            if reward:
                yield f"R: {action} : {s}{rest} {float_text(reward)}"


def _rows(start: str, matrix: SparseMatrix, names: Sequence[object]) -> Iterator[str]:
    pointers, columns, data = matrix.indptr.tolist(), matrix.indices.tolist(), matrix.data.tolist()
    for row in range(matrix.shape[0]):
        part = slice(pointers[row], pointers[row + 1])
        for column, text in zip(columns[part], float_row_texts(data[part]), strict=True):
            yield f"{start} : {row} : {names[column]} {text}"


def _comment(text: str) -> str:
    clean = "".join(c if c.isprintable() and c.isascii() else " " for c in text)
    return f"# {clean[:500]}".rstrip()
