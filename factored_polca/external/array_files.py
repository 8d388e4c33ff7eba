"""Arrays of a POMDP for programs started on a file in Cassandra's format, and their vectors brought back.

The format has T(s' | s, a) and O(o | s', a), one set of observations, and nothing that is seen besides:
`factored_polca.formats.cassandra_factoring` says what becomes of a joint kernel, of what is seen of the
state, and of terminal states.

Several `starts` are reached from one more state by a first step that earns nothing, whatever the action,
to copies of their states at which the number of the start is observed: all values there are the discount
times the mean of the starts' values.

`Layout.vectors` reads vectors over the file's states as vectors over the original ones: a copy of a state
has the state's value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.sparse import coo_array, csr_array, vstack

from factored_polca.explicit.arrays import FloatArray, IntArray, SparseMatrix
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.formats.cassandra import write_factored
from factored_polca.formats.cassandra_factoring import END, FactoredArrays, factored
from factored_polca.models.errors import LimitReached

MOST_ENTRIES: Final = 5_000_000
MOST_NUMBERS: Final = 50_000_000


@dataclass(frozen=True)
class Layout:
    """The text of a file, and where the original states are among its states."""

    text: str
    states: int  # of the file
    place: IntArray  # [s] the file's state for each original one

    def vectors(self, table: FloatArray) -> FloatArray:
        """Vectors [n, file state] as vectors [n, s]."""
        return np.ascontiguousarray(table[:, self.place])


@dataclass(frozen=True)
class FactoredRows:
    """T and O over the states i of a file: T [a] of [i, j], O [a] of [j, z], rewards [a, i].

    `place[s]` is the file's state for an original one, `owner[i]` the original one of a file's state.
    """

    moves: list[SparseMatrix]
    shows: list[FloatArray]
    rewards: FloatArray
    place: IntArray
    owner: IntArray


def lay_out(pomdp: ArrayPOMDP, starts: Sequence[FloatArray]) -> Layout:
    """The file for a POMDP, to be solved from one belief [s] or from several at once.

    Raises:
        LimitReached: more entries than a file should have.
        ModelError: what the format can't express.
    """
    whole = replace(pomdp, initial=starts[0]) if len(starts) == 1 else with_starts(pomdp, starts)
    arrays = _within_limits(whole)
    return Layout(write_factored(arrays), arrays.states, arrays.first[: pomdp.states])


def factored_rows(pomdp: ArrayPOMDP) -> FactoredRows:
    """T, O and rewards, states split where there is no other way; what is seen at the start is left out.

    Raises:
        LimitReached: more entries than may be listed.
        ModelError: an action that does not apply everywhere.
    """
    arrays = _within_limits(pomdp, start_told=False)
    assert arrays.observations is not None, "it was not asked for as an MDP"
    if arrays.states * len(arrays.labels) * len(arrays.actions) > MOST_NUMBERS:
        raise LimitReached(f"tables of more than {MOST_NUMBERS:,} numbers for observations", "external")
    end = np.flatnonzero(pomdp.terminal)
    return FactoredRows(
        list(arrays.transitions),
        [matrix.toarray() for matrix in arrays.observations],
        arrays.rewards,
        arrays.first,
        np.where(arrays.origin == END, end[0] if len(end) else 0, arrays.origin),
    )


def _within_limits(pomdp: ArrayPOMDP, *, start_told: bool = True) -> FactoredArrays:
    if sum(matrix.nnz for matrices in pomdp.kernel for matrix in matrices) > MOST_ENTRIES:
        raise LimitReached(f"more than {MOST_ENTRIES:,} entries to write to a file", "external")
    return factored(pomdp, as_mdp=False, start_told=start_told)


def with_starts(pomdp: ArrayPOMDP, starts: Sequence[FloatArray]) -> ArrayPOMDP:
    """One more state, the last, from which each start is reached with equal probability, and told.

    The states after those of `pomdp` are copies of the starts' states; what follows them is the same.
    """
    size = pomdp.states
    copies = [(number, s) for number, b in enumerate(starts) for s in np.flatnonzero(b).tolist()]
    origin = np.array([s for _, s in copies], dtype=np.int64)
    total = size + len(copies) + 1
    told = tuple(f"start{number}" for number in range(len(starts)))
    kernel = []
    for matrices in pomdp.kernel:
        longer = []
        for matrix in matrices:
            below = vstack([matrix, csr_array(matrix)[origin], csr_array((1, size))], format="csr")
            longer.append(csr_array((below.data, below.indices, below.indptr), shape=(total, total)))
        for number in range(len(starts)):
            mine = [(size + k, starts[number][s]) for k, (n, s) in enumerate(copies) if n == number]
            cells = np.array([chance for _, chance in mine]) / len(starts)
            columns = np.array([column for column, _ in mine], dtype=np.int64)
            rows = np.full(len(mine), total - 1)
            longer.append(csr_array(coo_array((cells, (rows, columns)), shape=(total, total))))
        kernel.append(tuple(longer))
    belief = np.zeros(total)
    belief[-1] = 1.0
    nothing = np.zeros((len(pomdp.actions), 1))
    return replace(
        pomdp,
        observations=tuple((*row, *told) for row in pomdp.observations),
        kernel=tuple(kernel),
        rewards=np.concatenate([pomdp.rewards, pomdp.rewards[:, origin], nothing], axis=1),
        terminal=np.concatenate([pomdp.terminal, pomdp.terminal[origin], [False]]),
        observed=np.concatenate([pomdp.observed, pomdp.observed[origin], [pomdp.observed.max() + 1]]),
        initial=belief,
    )
