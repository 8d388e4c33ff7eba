"""The (state, action) pairs of an MDP, state by state, in one concatenated sparse structure.

Pair p belongs to node `owner[p]`; the pairs of node i are `start[i] .. start[i+1]`, in the order of
the actions.  The transition row of p is `successor[row[p]:row[p+1]]` with `probability` beside it.
A node without pairs has a fixed value: 0 (terminal), or it is a dead end that no pair reaches.

    Q(p) = reward(p) + discount * sum_j probability(j) V(successor(j)),   (T V)(i) = max_p Q(p).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import ArrayMDP, BoolArray, FloatArray, IntArray, SparseMatrix
from factored_polca.models.errors import Fault, ModelError

STAY = -1
"""The action of the pair that ends in a collapsed component, for ever, at no cost."""

ROW_SUM_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Pairs:
    """Pairs of n nodes; see the module's docstring for the letters."""

    start: IntArray  # [n+1]
    owner: IntArray  # [p] node
    state: IntArray  # [p] state of the MDP, -1 for STAY
    action: IntArray  # [p] action of the MDP, or STAY
    reward: FloatArray  # [p]
    row: IntArray  # [p+1]
    successor: Any  # [j] int32 node
    probability: FloatArray  # [j]
    discount: float

    @property
    def nodes(self) -> int:
        """The number of nodes."""
        return len(self.start) - 1

    @property
    def count(self) -> int:
        """The number of pairs."""
        return len(self.owner)

    @cached_property
    def free(self) -> IntArray:
        """The nodes that have pairs, in order."""
        return np.flatnonzero(np.diff(self.start))

    @cached_property
    def matrix(self) -> SparseMatrix:
        """The transition rows as a CSR array [p, node]."""
        shape = (self.count, self.nodes)
        return csr_array((self.probability, self.successor, self.row), shape=shape)

    @cached_property
    def pair_of_entry(self) -> IntArray:
        """The pair that each stored transition belongs to."""
        return np.repeat(np.arange(self.count), np.diff(self.row))

    @cached_property
    def predecessors(self) -> tuple[IntArray, IntArray]:
        """(start, pair): `pair[start[i]:start[i+1]]` are the pairs with i among their successors."""
        columns = self.matrix.tocsc()
        return columns.indptr.astype(np.int64), columns.indices.astype(np.int64)

    def q_values(self, values: FloatArray) -> FloatArray:
        """Q of every pair, one step ahead of `values` [node]."""
        return np.asarray(self.reward + self.discount * (self.matrix @ values))

    def touches(self, nodes: BoolArray) -> BoolArray:
        """Whether some successor of the pair lies in `nodes`, for every pair."""
        hits = self.pair_of_entry[nodes[self.successor]]
        return np.bincount(hits, minlength=self.count) > 0

    def select(self, chosen: IntArray) -> Pairs:
        """The same nodes with only the pairs `chosen`, given in ascending order."""
        length = (self.row[1:] - self.row[:-1])[chosen]
        row = running_total(length)
        entries = np.repeat(self.row[chosen] - row[:-1], length) + np.arange(row[-1])
        owner = self.owner[chosen]
        return Pairs(
            start=running_total(np.bincount(owner, minlength=self.nodes)),
            owner=owner,
            state=self.state[chosen],
            action=self.action[chosen],
            reward=self.reward[chosen],
            row=row,
            successor=self.successor[entries],
            probability=self.probability[entries],
            discount=self.discount,
        )

    def keep(self, mask: BoolArray) -> Pairs:
        """The same nodes with only the pairs in `mask`."""
        return self.select(np.flatnonzero(mask))


def running_total(counts: IntArray) -> IntArray:
    """0, c_0, c_0 + c_1, ..."""
    return np.concatenate(([0], np.cumsum(counts))).astype(np.int64)


def pairs_of(mdp: ArrayMDP) -> Pairs:
    """All applicable pairs of `mdp`, a node for each state; stored zeros are dropped.

    Raises:
        ModelError: the arrays are not an MDP; all faults are listed.
    """
    faults = list(_faults(mdp))
    if faults:
        raise ModelError(faults)
    S = mdp.states
    matrices = [_without_zeros(matrix) for matrix in mdp.transitions]
    owner, action = np.nonzero(mdp.applicable.T)
    counts = [np.diff(matrix.indptr) for matrix in matrices]
    lengths = np.array(counts, dtype=np.int64).reshape(len(counts), S)[action, owner]
    row = running_total(lengths)
    successor = np.empty(row[-1], dtype=np.int32)
    probability = np.empty(row[-1], dtype=np.float64)
    for a, matrix in enumerate(matrices):
        mine = np.flatnonzero(action == a)
        shift = row[mine] - matrix.indptr[owner[mine]]
        target = np.repeat(shift, lengths[mine]) + np.arange(matrix.nnz)
        successor[target] = matrix.indices
        probability[target] = matrix.data
    pairs = Pairs(
        start=running_total(np.bincount(owner, minlength=S)),
        owner=owner.astype(np.int64),
        state=owner.astype(np.int64),
        action=action.astype(np.int64),
        reward=np.ascontiguousarray(mdp.rewards[action, owner], dtype=np.float64),
        row=row,
        successor=successor,
        probability=probability,
        discount=float(mdp.discount),
    )
    return pairs


def _without_zeros(matrix: SparseMatrix) -> SparseMatrix:
    if np.all(matrix.data > 0):
        return matrix
    clean = matrix.copy()
    clean.eliminate_zeros()
    return clean


def _faults(mdp: ArrayMDP) -> Iterator[Fault]:
    A, S = len(mdp.actions), mdp.states
    if not 0 <= mdp.discount <= 1:
        yield Fault(f"the discount is {mdp.discount}", ("discount",), "0 <= discount <= 1")
    shapes = {"rewards": mdp.rewards.shape, "applicable": mdp.applicable.shape}
    for name, shape in shapes.items():
        if shape != (A, S):
            yield Fault(f"{name} has the shape {shape}", (name,), f"{A} actions x {S} states: {(A, S)}")
    if len(mdp.transitions) != A:
        yield Fault(f"{len(mdp.transitions)} transition arrays for {A} actions", ("transitions",))
    if any(shape != (A, S) for shape in shapes.values()) or len(mdp.transitions) != A:
        return
    if np.any(mdp.applicable & mdp.terminal):
        a, s = np.argwhere(mdp.applicable & mdp.terminal)[0]
        yield Fault(f"action {mdp.actions[a]!r} is applicable in the terminal state {s}", ("applicable",))
    if not np.all(np.isfinite(mdp.rewards[mdp.applicable])):
        a, s = np.argwhere(mdp.applicable & ~np.isfinite(mdp.rewards))[0]
        yield Fault(
            f"the reward of {mdp.actions[a]!r} in state {s} is {mdp.rewards[a, s]}", ("rewards",), "finite"
        )
    for a, matrix in enumerate(mdp.transitions):
        yield from _row_faults(mdp, a, matrix)


def _row_faults(mdp: ArrayMDP, a: int, matrix: SparseMatrix) -> Iterator[Fault]:
    S, path = mdp.states, ("transitions", mdp.actions[a])
    if matrix.shape != (S, S):
        yield Fault(f"the shape {matrix.shape}", path, f"{S} states: {(S, S)}")
        return
    if not np.all(matrix.data >= 0):  # also finds NaN
        entry = int(np.flatnonzero(~(matrix.data >= 0))[0])
        s = int(np.searchsorted(matrix.indptr, entry, side="right")) - 1
        yield Fault(f"state {s} has the probability {matrix.data[entry]}", path, "between 0 and 1")
        return
    sums = np.asarray(matrix.sum(axis=1)).reshape(-1)
    wrong = np.abs(sums - mdp.applicable[a]) > ROW_SUM_TOLERANCE
    if np.any(wrong):
        s = int(np.flatnonzero(wrong)[0])
        meant = "1, as the action is applicable" if mdp.applicable[a, s] else "0, as it is not applicable"
        rows = int(wrong.sum())
        yield Fault(
            f"the row of state {s} sums to {sums[s]}", path, f"it must be {meant}; {rows} such rows"
        )
