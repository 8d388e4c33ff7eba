"""A POMDP made ready for solving: what can be left out is left out, the rest in flat arrays.

What is done, all without loss for beliefs over the states that are kept:

- *Dead states* go: the largest set without reward that no action leaves.  Their value is 0 under
  every policy, as that of terminal states; what mass of a row is missing has gone there.
- States that no root belief can reach go (with a root at every corner none do).
- States are grouped by what is seen of them: *class* y holds n_y states, numbered through within the
  class (mixed observability, Ong, Png, Hsu & Lee 2010).  A belief lies within one class.
- Within a class, actions with equal rewards and branches are one *option*.
- A *branch* is one (observation, next class) of an option, an n_y x n_y' matrix of the joint kernel.
  Branches of an option to the same class with proportional matrices M' = lambda M lead to the same
  belief: they are merged, their matrices added.

Letters: y class, i state within the kept ones, j option, k branch.  For a belief b over class y (a
vector of n_y, its mass may be below 1 in intermediate results) and a value function V that is
positively homogeneous,

    Q(b, j) = b . r_j + gamma * sum over branches k of j of V(b M_k).

Arrays (all int64 or float64, ready for kernels):

    offset [Y + 1]            states of class y are offset[y] .. offset[y + 1] - 1
    first_option [Y + 1]      options of class y
    option_action [J]         the action's number in the original POMDP
    reward_start [J]          r_j is rewards[reward_start[j] : ... + n_y]
    first_branch [J + 1]      branches of option j
    branch_target [K]         the next class y'
    branch_rows [K]           the matrix's row pointers are row_start[branch_rows[k] : ... + n_y + 1],
    row_start, column, probability    the CSR of all matrices; column counts within class y'
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.alpha_vectors import AlphaSet, AlphaVectors, Meaning
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray, SparseMatrix
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.models.errors import ModelError

PROPORTIONAL: Final = 2e-15
"""Matrices are proportional if no entry of one, scaled, is off by more than this share."""


class Arrays(NamedTuple):
    """The flat arrays of a `Problem`, as kernels take them."""

    offset: IntArray
    first_option: IntArray
    reward_start: IntArray
    first_branch: IntArray
    branch_target: IntArray
    branch_rows: IntArray
    row_start: IntArray
    column: IntArray
    probability: FloatArray
    rewards: FloatArray


class Root(NamedTuple):
    """A belief to start from: over class `y`, with its weight in the value at b0 (0: none)."""

    y: int
    belief: FloatArray  # [n_y], sums to 1
    weight: float


@dataclass(frozen=True)
class Problem:
    """A prepared POMDP; see the module's docstring."""

    original: ArrayPOMDP
    states: IntArray  # [i] the original number of each kept state, by class, ascending within
    seen: IntArray  # [y] the original number in `observed`
    arrays: Arrays
    option_action: IntArray  # [j]
    observed_as: tuple[tuple[int, ...], ...]  # [k] the original observations that branch k stands for
    roots: tuple[Root, ...]
    discount: float
    ends: bool  # whether the process can come to a dead state
    cache: dict[str, object] = field(default_factory=dict, compare=False, repr=False)

    @property
    def classes(self) -> int:
        """Y, the number of classes; 0 where every state is dead."""
        return len(self.seen)

    @property
    def options(self) -> int:
        """J, the number of options over all classes."""
        return len(self.option_action)

    @property
    def branches(self) -> int:
        """K, the number of branches over all options."""
        return len(self.observed_as)

    def size(self, y: int) -> int:
        """n_y, the number of states of class y."""
        return int(self.arrays.offset[y + 1] - self.arrays.offset[y])

    def option_range(self, y: int) -> range:
        """The options of class y."""
        return range(int(self.arrays.first_option[y]), int(self.arrays.first_option[y + 1]))

    def branch_range(self, j: int) -> range:
        """The branches of option j."""
        return range(int(self.arrays.first_branch[j]), int(self.arrays.first_branch[j + 1]))

    @cached_property
    def option_class(self) -> IntArray:
        """[j] the class that an option belongs to."""
        return np.repeat(np.arange(self.classes), np.diff(self.arrays.first_option))

    @cached_property
    def branch_option(self) -> IntArray:
        """[k] the option that a branch belongs to."""
        return np.repeat(np.arange(self.options), np.diff(self.arrays.first_branch))

    def reward(self, j: int) -> FloatArray:
        """r_j [n_y]."""
        start = int(self.arrays.reward_start[j])
        return self.arrays.rewards[start : start + self.size(int(self.option_class[j]))]

    @cached_property
    def matrices(self) -> tuple[SparseMatrix, ...]:
        """[k] M_k as CSR arrays [n_y, n_y'] that share the flat arrays' memory."""
        return tuple(self._matrix(k) for k in range(self.branches))

    def _matrix(self, k: int) -> SparseMatrix:
        a = self.arrays
        rows = self.size(int(self.option_class[self.branch_option[k]]))
        at = int(a.branch_rows[k])
        pointers = a.row_start[at : at + rows + 1]
        inside = slice(int(pointers[0]), int(pointers[-1]))
        shape = (rows, self.size(int(a.branch_target[k])))
        return csr_array((a.probability[inside], a.column[inside], pointers - pointers[0]), shape=shape)

    @property
    def reward_range(self) -> tuple[float, float]:
        """The least and the largest reward, 0 included where the process may end."""
        rewards = self.arrays.rewards
        if len(rewards) == 0:
            return 0.0, 0.0
        least, largest = float(rewards.min()), float(rewards.max())
        return (min(least, 0.0), max(largest, 0.0)) if self.ends else (least, largest)

    @property
    def value_span(self) -> float:
        """A bound on the largest |value| of any policy, (1 for a problem without rewards)."""
        largest = max(map(abs, self.reward_range)) or 1.0
        return largest / (1 - self.discount) if self.discount < 1 else float("inf")

    @cached_property
    def slack(self) -> float:
        """What rounding may do to a bound: subtracted from lower and added to upper bounds.

        A backup sums as many terms as the longest row of an option has entries, over all its branches,
        and some more; each errs by at most two units of |V|.  Errors add up to 1 / (1 - gamma) times.
        """
        a = self.arrays
        terms = 8
        for j in range(self.options):
            entries = np.zeros(self.size(int(self.option_class[j])), dtype=np.int64)
            for k in self.branch_range(j):
                at = int(a.branch_rows[k])
                entries += np.diff(a.row_start[at : at + len(entries) + 1])
            terms = max(terms, int(entries.max(initial=0)) + len(self.branch_range(j)) + 8)
        return terms * 2.0**-52 * self.value_span / max(1 - self.discount, 1e-9)

    def belief(self, y: int, belief: FloatArray) -> FloatArray:
        """A belief [n_y] over class y as one over the original states [s]."""
        result = np.zeros(self.original.states)
        result[self.states[self.arrays.offset[y] : self.arrays.offset[y + 1]]] = belief
        return result

    def combine(self, values: Sequence[float] | FloatArray) -> float:
        """The value at b0 from the value at each root [root]."""
        return float(sum(root.weight * value for root, value in zip(self.roots, values, strict=True)))

    def policy(
        self, vectors: Sequence[FloatArray], actions: Sequence[IntArray], meaning: Meaning
    ) -> AlphaVectors:
        """Vectors [n, n_y] with their actions (original numbers) [n], by class, as a policy."""
        bounds = self.arrays.offset
        sets = tuple(
            AlphaSet(
                self.states[bounds[y] : bounds[y + 1]],
                np.ascontiguousarray(vectors[y]),
                np.asarray(actions[y], dtype=np.int64),
            )
            for y in range(self.classes)
        )
        return AlphaVectors(self.original.states, sets, meaning)


def prepare(pomdp: ArrayPOMDP, roots: FloatArray | None = None, *, merge: bool = True) -> Problem:
    """`pomdp` made ready.

    `roots` [r, s] are further beliefs at which the policy is wanted good; b0 comes first, its parts
    by class each a root with its probability as weight.  `merge=False` leaves actions and
    observations as they are (for tests).

    Raises:
        ModelError: a root that is no distribution.
    """
    beliefs = pomdp.initial[None, :]
    if roots is not None:
        beliefs = np.vstack([beliefs, _checked_roots(roots, pomdp.states)])
    totals = pomdp.to_mdp().transitions
    dead = _dead_states(pomdp, totals)
    kept = _reached(totals, (beliefs > 0).any(axis=0) & ~dead, dead)
    states = np.flatnonzero(kept)
    states = states[np.argsort(pomdp.observed[states], kind="stable")]
    seen, counts = np.unique(pomdp.observed[states], return_counts=True)
    offset = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    builder = _Builder(pomdp, states, offset, merge)
    for y in range(len(seen)):
        builder.add_class(y)
    return Problem(
        original=pomdp,
        states=states,
        seen=seen,
        arrays=builder.arrays(),
        option_action=np.array(builder.option_action, dtype=np.int64),
        observed_as=tuple(builder.observed_as),
        roots=_roots(beliefs, states, offset),
        discount=pomdp.discount,
        ends=any(bool((matrix[states][:, dead] > 0).nnz) for matrix in totals),
    )


def _checked_roots(roots: FloatArray, states: int) -> FloatArray:
    given = np.asarray(roots)
    if given.ndim != 2 or given.shape[1] != states or given.dtype.kind not in "fiu":
        raise ModelError(f"root beliefs are an array of numbers [r, s], s = {states}: a row for each")
    beliefs = given.astype(np.float64)
    if not np.all(np.isfinite(beliefs)) or np.any(beliefs < 0):
        raise ModelError("a root belief has an entry that is negative or not finite: give probabilities")
    if np.any(np.abs(beliefs.sum(axis=1) - 1) > 1e-9):
        raise ModelError("a root belief does not sum to 1: divide it by its sum")
    return beliefs


def _dead_states(pomdp: ArrayPOMDP, totals: Sequence[SparseMatrix]) -> BoolArray:
    dead: BoolArray = pomdp.terminal | np.all(pomdp.rewards == 0, axis=0)
    while True:
        leaves = np.zeros(pomdp.states, dtype=np.bool_)
        for matrix in totals:
            leaves |= np.asarray(matrix @ (~dead).astype(np.float64)) > 0
        if not np.any(leaves & dead):
            return dead
        dead = dead & ~leaves


def _reached(totals: Sequence[SparseMatrix], start: BoolArray, dead: BoolArray) -> BoolArray:
    reached = start.copy()
    while True:
        mass = reached.astype(np.float64)
        further = np.zeros(len(mass), dtype=np.bool_)
        for matrix in totals:
            further |= np.asarray(mass @ matrix) > 0
        further &= ~(dead | reached)
        if not further.any():
            return reached
        reached |= further


def _roots(beliefs: FloatArray, states: IntArray, offset: IntArray) -> tuple[Root, ...]:
    roots: list[Root] = []
    known: dict[tuple[int, bytes], None] = {}
    for number, belief in enumerate(beliefs):
        inside = belief[states]
        for y in range(len(offset) - 1):
            part = inside[offset[y] : offset[y + 1]]
            mass = float(part.sum())
            if mass <= 0:
                continue
            root = Root(y, part / mass, mass if number == 0 else 0.0)
            key = (y, root.belief.tobytes())
            if key not in known:
                known[key] = None
                roots.append(root)
    return tuple(roots)


class _Builder:
    """Collects options and branches class by class."""

    def __init__(self, pomdp: ArrayPOMDP, states: IntArray, offset: IntArray, merge: bool) -> None:
        self.pomdp, self.states, self.offset, self.merge = pomdp, states, offset, merge
        self.first_option = [0]
        self.option_action: list[int] = []
        self.rewards: list[FloatArray] = []
        self.first_branch = [0]
        self.branch_target: list[int] = []
        self.matrices: list[SparseMatrix] = []
        self.observed_as: list[tuple[int, ...]] = []
        self.columns = [[m[:, states] for m in row] for row in pomdp.kernel]

    def add_class(self, y: int) -> None:
        mine = self.states[self.offset[y] : self.offset[y + 1]]
        known: set[bytes] = set()
        for action, row in enumerate(self.columns):
            rewards = np.ascontiguousarray(self.pomdp.rewards[action, mine])
            branches = self._branches([csr_array(matrix[mine, :]) for matrix in row])
            if self.merge:
                key = _option_key(rewards, branches)
                if key in known:
                    continue
                known.add(key)
            self.option_action.append(action)
            self.rewards.append(rewards)
            for target, matrix, observations in branches:
                self.branch_target.append(target)
                self.matrices.append(matrix)
                self.observed_as.append(observations)
            self.first_branch.append(len(self.matrices))
        self.first_option.append(len(self.option_action))

    def _branches(self, rows: Sequence[SparseMatrix]) -> list[tuple[int, SparseMatrix, tuple[int, ...]]]:
        """(next class, matrix, observations) of each branch, proportional ones merged."""
        found: list[tuple[int, SparseMatrix, tuple[int, ...]]] = []
        by_shape: dict[tuple[int, bytes], list[int]] = {}
        for observation, matrix in enumerate(rows):
            matrix.eliminate_zeros()
            classes = np.searchsorted(self.offset, matrix.indices, side="right") - 1
            for target in np.unique(classes).tolist():
                part = self._part(matrix, classes, target)
                key = (target, part.indices.tobytes() + b"/" + part.indptr.tobytes())
                same = by_shape.setdefault(key, [])
                place = next((f for f in same if self.merge and _proportional(found[f][1], part)), None)
                if place is None:
                    same.append(len(found))
                    found.append((target, part, (observation,)))
                else:
                    _, other, observations = found[place]
                    total = csr_array((other.data + part.data, part.indices, part.indptr), shape=part.shape)
                    found[place] = (target, total, (*observations, observation))
        return found

    def _part(self, matrix: SparseMatrix, classes: IntArray, target: int) -> SparseMatrix:
        """The columns of `matrix` [n_y, i] that belong to one class, sorted."""
        keep = classes == target
        rows = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))[keep]
        pointers = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=matrix.shape[0]))])
        shape = (matrix.shape[0], int(self.offset[target + 1] - self.offset[target]))
        columns = matrix.indices[keep] - self.offset[target]
        part = csr_array((matrix.data[keep], columns, pointers), shape=shape)
        part.sort_indices()
        return part

    def arrays(self) -> Arrays:
        """The flat arrays of what was collected."""
        pointers, branch_rows, at, entries = [], [], 0, 0
        for matrix in self.matrices:
            pointers.append(matrix.indptr.astype(np.int64) + entries)
            branch_rows.append(at)
            at += len(matrix.indptr)
            entries += int(matrix.indptr[-1])
        lengths = [len(rewards) for rewards in self.rewards]
        return Arrays(
            offset=self.offset,
            first_option=_integers(self.first_option),
            reward_start=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)[: len(lengths)],
            first_branch=_integers(self.first_branch),
            branch_target=_integers(self.branch_target),
            branch_rows=_integers(branch_rows),
            row_start=_joined(pointers, np.int64),
            column=_joined([matrix.indices for matrix in self.matrices], np.int64),
            probability=_joined([matrix.data for matrix in self.matrices], np.float64),
            rewards=_joined(self.rewards, np.float64),
        )


def _integers(values: Sequence[int]) -> IntArray:
    return np.array(values, dtype=np.int64)


def _joined(parts: Sequence[Any], kind: type) -> Any:
    if not parts:
        return np.zeros(0, dtype=kind)
    return np.ascontiguousarray(np.concatenate(parts).astype(kind))


def _proportional(one: SparseMatrix, other: SparseMatrix) -> bool:
    """Whether two matrices with the same pattern are multiples of each other, but for rounding."""
    scale = float(other.data.sum() / one.data.sum())
    return bool(np.all(np.abs(other.data - scale * one.data) <= PROPORTIONAL * other.data))


def _option_key(
    rewards: FloatArray, branches: Sequence[tuple[int, SparseMatrix, tuple[int, ...]]]
) -> bytes:
    """Equal for options with equal rewards and the same branches in any order."""
    parts = sorted(
        b"|".join([str(target).encode(), m.indptr.tobytes(), m.indices.tobytes(), m.data.tobytes()])
        for target, m, _ in branches
    )
    return rewards.tobytes() + b"//" + b"//".join(parts)
