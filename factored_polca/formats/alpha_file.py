"""Value functions as sets of vectors: the `.alpha` files of pomdp-solve.

    file   ::= {vector}
    vector ::= ACTION-NUMBER number number ...       one number for each state, over any lines

States are those of the file that `write_pomdp` makes of the same arrays (see `cassandra_factoring`): copies
of a state have equal values, the end has the value 0.  Where part of the state is seen, V is a maximum for
each y that is seen; in the file a vector for y has, at states that do not look like y, a number below all
values, so that it never counts there.

Source: A. R. Cassandra, "POMDP-Solve: alpha file format", pomdp.org, 2003.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from typing import Final

import numpy as np

from factored_polca.explicit.alpha_vectors import AlphaSet, AlphaVectors
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.formats.cassandra_factoring import END, FactoredArrays, factored
from factored_polca.formats.decimals import float_text
from factored_polca.formats.policy_words import Word, lines_of
from factored_polca.models.errors import Fault, ModelError

MAXIMUM_NUMBERS: Final = 20_000_000
"""Numbers of one file."""


def write_alpha(vectors: AlphaVectors, pomdp: ArrayPOMDP) -> str:
    """`vectors`, over the states of `pomdp`, for the file that `write_pomdp` makes of `pomdp`.

    Raises:
        ModelError: vectors of another number of states, or arrays that the format can't express.
    """
    if vectors.states != pomdp.states:
        raise ModelError(f"the vectors are over {vectors.states} states, the model has {pomdp.states}")
    arrays = factored(pomdp)
    alive = arrays.origin >= 0
    low = min([0.0, *(float(part.vectors.min()) for part in vectors.sets if part.vectors.size)]) - 1.0
    lines = []
    for part in vectors.sets:
        for vector, action in zip(part.vectors, part.actions.tolist(), strict=True):
            whole = np.full(pomdp.states, low if len(vectors.sets) > 1 else 0.0)
            whole[part.states] = vector
            row = np.where(alive, whole[np.where(alive, arrays.origin, 0)], 0.0)
            lines += [str(action), " ".join(float_text(entry) for entry in row.tolist()), ""]
    return "\n".join(lines) + "\n"


def read_alpha(text: str, pomdp: ArrayPOMDP) -> AlphaVectors:
    """The vectors of a file for what `write_pomdp` makes of `pomdp`, over the states of `pomdp`.

    What they mean is not told in the file: they are called heuristic.

    Raises:
        ModelError: a text that is not right, with line and column.
    """
    arrays = factored(pomdp)
    words = list(_counted(text))
    size = arrays.states + 1
    if not words:
        raise ModelError([Fault("a file of vectors without a vector", line=1, column=1)])
    vectors, actions = [], []
    for start in range(0, len(words), size):
        part = words[start : start + size]
        actions.append(part[0].integer("action", len(arrays.actions)))
        if len(part) < size:
            message = f"the last vector has {len(part) - 1} numbers for {arrays.states} states"
            hint = "states are all those of the model, also those that can't be reached"
            raise part[-1].error(message, hint)
        vectors.append([word.number() for word in part[1:]])
    return _lifted(np.array(vectors), np.array(actions, dtype=np.int64), pomdp, arrays)


def _counted(text: str) -> Sequence[Word]:
    found: list[Word] = []
    for word in chain.from_iterable(lines_of(text)):
        if len(found) >= MAXIMUM_NUMBERS:
            raise word.error(f"more than {MAXIMUM_NUMBERS} numbers")
        found.append(word)
    return found


def _lifted(
    vectors: np.ndarray, actions: np.ndarray, pomdp: ArrayPOMDP, arrays: FactoredArrays
) -> AlphaVectors:
    """The vectors [n, s of the file] over the states of `pomdp`, one set for each y."""
    over = vectors[:, arrays.first]
    if arrays.origin[-1] == END:
        over = np.where(pomdp.terminal, 0.0, over)
    sets = []
    for y in np.unique(pomdp.observed[~pomdp.terminal]).tolist():
        states = np.flatnonzero((pomdp.observed == y) & ~pomdp.terminal)
        sets.append(AlphaSet(states, over[:, states], actions))
    return AlphaVectors(pomdp.states, tuple(sets), "heuristic")
