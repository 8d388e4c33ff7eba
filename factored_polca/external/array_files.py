"""A POMDP as arrays in Cassandra's format, for programs started on it; and its vectors brought back.

The format has T(s' | s, a) and O(o | s', a), one set of observations, and nothing that is seen besides. So
an observation z of the file is a pair (observation, number of what is seen of the next state). Where each
action's joint kernel then factors,

    K_a(s; t, z) = T_a(s, t) O_a(t, z),

states stay as they are. Otherwise a state of the file is a pair (t, z), of which z is observed for sure;
what happens next depends on t only. All terminal states are one that is never left and earns nothing.

Several `starts` are reached from one more state by a first step that earns nothing, whatever the action,
to copies of their states at which the number of the start is observed.

`Layout.vectors` reads vectors over the file's states as vectors over the original ones: a copy of a state
has the state's value. (To be replaced by the writer of `factored_polca.formats` once there is one.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array

from factored_polca.explicit.arrays import FloatArray, IntArray, SparseMatrix
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.models.errors import LimitReached

FACTORS: Final = 1e-12
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
    """What the file says, over its states i: T [a] of [i, j], O [a] of [j, z], rewards [a, i].

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
    """
    rows = factored_rows(pomdp)
    belief = np.zeros(len(rows.rewards[0]))
    if len(starts) == 1:
        np.add.at(belief, rows.place, starts[0])
    else:
        rows, belief = _with_starts(rows, starts)
    return Layout(_text(pomdp, rows, belief), len(belief), rows.place)


def factored_rows(pomdp: ArrayPOMDP) -> FactoredRows:
    """T, O and rewards, states split where there is no other way.

    Raises:
        LimitReached: more entries than may be listed.
    """
    kernel, count = _by_observation(pomdp)
    if pomdp.states * count * len(kernel) > MOST_NUMBERS:
        raise LimitReached(f"tables of more than {MOST_NUMBERS:,} numbers for observations", "external")
    return _factored(pomdp, kernel) or _split(pomdp, kernel, count)


def _by_observation(pomdp: ArrayPOMDP) -> tuple[list[dict[int, SparseMatrix]], int]:
    """K_a by observation of the file, all ends moved to the first terminal state; how many there are."""
    names = sorted({name for row in pomdp.observations for name in row})
    width = int(pomdp.observed.max()) + 1
    gather = np.arange(pomdp.states)
    end = np.flatnonzero(pomdp.terminal)
    gather[end] = end[:1]
    numbers: dict[int, int] = {}
    result: list[dict[int, SparseMatrix]] = []
    for labels, matrices in zip(pomdp.observations, pomdp.kernel, strict=True):
        mine: dict[int, SparseMatrix] = {}
        for label, matrix in zip(labels, matrices, strict=True):
            cells = matrix.tocoo()
            seen = np.where(pomdp.terminal[cells.col], 0, pomdp.observed[cells.col])
            for y in np.unique(seen).tolist():
                part = seen == y
                z = numbers.setdefault(names.index(label) * width + y, len(numbers))
                entries = (cells.data[part], (cells.row[part], gather[cells.col[part]]))
                found = csr_array(coo_array(entries, shape=matrix.shape))
                mine[z] = mine[z] + found if z in mine else found
        result.append(mine)
    if sum(m.nnz for row in result for m in row.values()) > MOST_ENTRIES:
        raise LimitReached(f"more than {MOST_ENTRIES:,} entries to write to a file", "external")
    return result, max(1, len(numbers))


def _factored(pomdp: ArrayPOMDP, kernel: list[dict[int, SparseMatrix]]) -> FactoredRows | None:
    """T and O over the original states; None where they are not enough."""
    states, count = pomdp.states, 1 + max((z for row in kernel for z in row), default=0)
    end = np.flatnonzero(pomdp.terminal)
    stay = csr_array((np.ones(len(end)), (end, end)), shape=(states, states))
    moves, shows = [], []
    for row in kernel:
        total = csr_array((states, states))
        for matrix in row.values():
            total = csr_array(total + matrix)
        reached = np.asarray(total.sum(axis=0))
        seen = np.zeros((states, count))
        for z, matrix in row.items():
            seen[:, z] = np.asarray(matrix.sum(axis=0)) / np.where(reached > 0, reached, 1.0)
            off = abs(matrix - total @ diags_array(seen[:, z]))
            if off.nnz and float(off.max()) > FACTORS:
                return None
        seen[reached == 0, 0] = 1.0
        moves.append(csr_array(total + stay))
        shows.append(seen)
    place = np.arange(states)
    place[end] = end[:1]
    return FactoredRows(moves, shows, pomdp.rewards, place, np.arange(states))


def _split(pomdp: ArrayPOMDP, kernel: list[dict[int, SparseMatrix]], count: int) -> FactoredRows:
    """T and O over pairs (t, z); a state that nothing leads to keeps one pair of its own."""
    pairs = sorted({(int(t), z) for row in kernel for z, m in row.items() for t in np.unique(m.indices)})
    end = np.flatnonzero(pomdp.terminal)
    numbers: dict[tuple[int, int], int] = {}
    owner: list[int] = []
    for t, z in pairs:
        if not pomdp.terminal[t]:
            numbers[t, z] = len(owner)
            owner.append(t)
    known = set(owner)
    shown = [z for t, z in pairs if not pomdp.terminal[t]]
    for s in np.flatnonzero(~pomdp.terminal).tolist():
        if s not in known:
            owner.append(s)
            shown.append(0)
    place = np.full(pomdp.states, -1, dtype=np.int64)
    for number, s in reversed(list(enumerate(owner))):
        place[s] = number
    if len(end):
        place[end] = len(owner)
        owner.append(int(end[0]))
        shown.append(0)
    size, owners = len(owner), np.array(owner)
    if size * count > MOST_NUMBERS:
        raise LimitReached(f"a table of more than {MOST_NUMBERS:,} numbers for observations", "external")
    seen = np.zeros((size, count))
    seen[np.arange(size), shown] = 1.0
    moves = []
    for row in kernel:
        total = csr_array((size, size))
        for z, matrix in row.items():
            cells = csr_array(matrix[owners]).tocoo()
            target = [
                int(place[t]) if pomdp.terminal[t] else numbers[int(t), z] for t in cells.col.tolist()
            ]
            total = total + csr_array(coo_array((cells.data, (cells.row, target)), shape=(size, size)))
        if len(end):
            total = total + csr_array(([1.0], ([size - 1], [size - 1])), shape=(size, size))
        moves.append(csr_array(total))
    return FactoredRows(moves, [seen] * len(kernel), pomdp.rewards[:, owners], place, owners)


def _with_starts(rows: FactoredRows, starts: Sequence[FloatArray]) -> tuple[FactoredRows, FloatArray]:
    """One more state, from which each start is reached with equal probability, and told."""
    size = rows.rewards.shape[1]
    copies = [(number, s) for number, b in enumerate(starts) for s in np.flatnonzero(b).tolist()]
    origin = rows.place[[s for _, s in copies]]
    total, count = size + len(copies) + 1, rows.shows[0].shape[1]
    moves, shows = [], []
    chances = np.array([starts[number][s] / len(starts) for number, s in copies])
    for move, show in zip(rows.moves, rows.shows, strict=True):
        body = csr_array(move).tocoo()
        copied = csr_array(move)[origin].tocoo()
        row = np.concatenate([body.row, copied.row + size, np.full(len(copies), total - 1)])
        column = np.concatenate([body.col, copied.col, size + np.arange(len(copies))])
        data = np.concatenate([body.data, copied.data, chances])
        moves.append(csr_array(coo_array((data, (row, column)), shape=(total, total))))
        wide = np.zeros((total, count + len(starts)))
        wide[:size, :count] = show
        wide[size + np.arange(len(copies)), [count + number for number, _ in copies]] = 1.0
        wide[total - 1, 0] = 1.0
        shows.append(wide)
    nothing = np.zeros((len(rows.rewards), 1))
    rewards = np.concatenate([rows.rewards, rows.rewards[:, origin], nothing], axis=1)
    belief = np.zeros(total)
    belief[-1] = 1.0
    owner = np.concatenate([rows.owner, rows.owner[origin], [-1]])
    return FactoredRows(moves, shows, rewards, rows.place, owner), belief


def _text(pomdp: ArrayPOMDP, rows: FactoredRows, belief: FloatArray) -> str:
    states = len(belief)
    count = max(2, rows.shows[0].shape[1])  # pomdp-solve ends without a word where there is one only
    lines = [f"discount: {pomdp.discount!r}", "values: reward", f"states: {states}"]
    lines += [f"actions: {len(pomdp.actions)}", f"observations: {count}"]
    lines.append("start: " + " ".join(f"{p:.17g}" for p in (belief / belief.sum()).tolist()))
    for a, (move, show) in enumerate(zip(rows.moves, rows.shows, strict=True)):
        sums = np.asarray(move.sum(axis=1))
        cells = csr_array(diags_array(1.0 / np.where(sums > 0, sums, 1.0)) @ move).tocoo()
        table = zip(cells.row.tolist(), cells.col.tolist(), cells.data.tolist(), strict=True)
        lines += [f"T: {a} : {s} : {t} {p:.17g}" for s, t, p in table]
        sure = show / show.sum(
            axis=1, keepdims=True
        )  # rounding leaves sums just above 1, which are refused
        lines += [f"O: {a} : {t} : {z} {sure[t, z]:.17g}" for t, z in np.argwhere(sure).tolist()]
        lines += [f"R: {a} : {s} : * : * {r:.17g}" for s, r in enumerate(rows.rewards[a].tolist()) if r]
    return "\n".join(lines) + "\n"
