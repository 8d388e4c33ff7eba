"""The quotient: a small decision process over the blocks of a partition.

    T_c(C, C') = sum_{x' in C'} T(x_C, p, x')      R_c(C) = R(x_C, p)       (the paper's Eqs. 10, 11)

with x_C the representative of block C and p the primitive that choice c stands for there.  Rows are
floats by default; `exact_row` gives rationals.  Block numbers are those of the partition; a block is
terminal if its states are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from math import lcm
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from factored_polca.diagrams import evaluate_states
from factored_polca.drawn import DrawnGraph, Framed
from factored_polca.explicit.arrays import ArrayMDP
from factored_polca.minimisation.criterion import Choice, DecisionProcess
from factored_polca.minimisation.partition import Partition
from factored_polca.minimisation.push import (
    FloatArray,
    Int32Array,
    Int64Array,
    PushPlan,
    RowTable,
    make_plan,
    push_exact,
    push_floats,
    row_table,
    rows_at,
)
from factored_polca.models import LimitReached
from factored_polca.symbolic import RowDiagram, SymbolicModel
from factored_polca.symbolic.floats import as_float

DIRECT = 1 << 22
"""Combinations of entries up to which they are found by indexing, beyond by sorting."""


@dataclass(frozen=True)
class Quotient(DrawnGraph, Framed):
    """A decision process over blocks, and what its exact rows are made from.

    `primitive[c, b]` is the primitive that choice c stands for in block b, -1 where not applicable.
    """

    process: DecisionProcess
    partition: Partition
    mdp: ArrayMDP
    primitive: npt.NDArray[np.int32]
    _plans: dict[int, tuple[PushPlan, RowTable]] = field(default_factory=dict, repr=False)

    def exact_row(self, choice: int, block: int) -> dict[int, Fraction]:
        """The exact probability of each next block; empty where the choice is not applicable."""
        primitive = int(self.primitive[choice, block])
        if primitive < 0:
            return {}
        symbolic = self.process.symbolic
        plan, table = self._plans[primitive]
        states = feature_states(self.partition)[block : block + 1]
        rows = symbolic.actions[primitive].rows
        return push_exact(plan, table, rows_at(symbolic, rows, table, plan.slots, states)[0])

    def exact_reward(self, choice: int, block: int) -> Fraction:
        """The exact reward; 0 where the choice is not applicable."""
        primitive = int(self.primitive[choice, block])
        if primitive < 0:
            return Fraction(0)
        states = feature_states(self.partition)[block : block + 1]
        return exact_rewards(self.process, primitive, states)[0]

    def to_arrays(self, *, dense: bool = False) -> dict[str, Any]:
        """The quotient as plain arrays by name; see `factored_polca.formats.array_fields`."""
        from factored_polca.formats.array_fields import mdp_fields

        return mdp_fields(self.mdp, initial_distribution(self.partition), dense=dense)

    def to_npz(self, path: str | Path) -> None:
        """Write the arrays to a file in numpy's format .npz; it appears whole or not at all.

        Raises:
            ModelError: the file can't be written.
        """
        from factored_polca.formats.array_fields import mdp_fields, write_npz

        write_npz(mdp_fields(self.mdp, initial_distribution(self.partition)), path)

    def to_pomdp(self, path: str | Path) -> None:
        """Write the quotient as a file in Cassandra's format; it appears whole or not at all.

        Raises:
            ModelError: a choice does not apply everywhere, or the file can't be written.
        """
        from factored_polca.formats.files import write_text

        write_text(path, self.to_pomdp_text)

    def to_pomdpx(self, path: str | Path) -> None:
        """Write the quotient as a POMDPX file with one variable, the block; it appears whole or not at all.

        Raises:
            ModelError: a choice does not apply everywhere, or the file can't be written.
        """
        from factored_polca.formats.files import write_text

        write_text(path, self.to_pomdpx_text)

    def to_pomdpx_text(self) -> str:
        """The text that `to_pomdpx` writes.

        Raises:
            ModelError: a choice does not apply everywhere.
        """
        from factored_polca.formats.cassandra import read_pomdp
        from factored_polca.formats.pomdpx import write_pomdpx

        return write_pomdpx(read_pomdp(self.to_pomdp_text(), self.process.symbolic.model.name))

    def to_pomdp_text(self) -> str:
        """The text that `to_pomdp` writes.

        Raises:
            ModelError: a choice does not apply everywhere.
        """
        from factored_polca.formats.cassandra import write_mdp

        name, initial = self.process.symbolic.model.name, initial_distribution(self.partition)
        return write_mdp(self.mdp, initial, name, block_texts(self.partition))


def block_texts(partition: Partition) -> list[str]:
    """A representative of each block as `x=3, y=on`."""
    return [partition.symbolic.state_text(levels) for levels in partition.representatives.tolist()]


def feature_states(partition: Partition) -> npt.NDArray[np.int32]:
    """The representatives as value numbers by feature: int32 [block, feature]."""
    return np.ascontiguousarray(partition.representatives[:, partition.symbolic.now_levels])


def distinct_rewards(
    process: DecisionProcess, primitive: int, states: npt.NDArray[np.int32]
) -> tuple[list[Fraction], npt.NDArray[np.int64]]:
    """The reward of a primitive at states [state, feature]: the exact sums that occur, and which is where.

    States on which all terms agree share one sum.
    """
    columns = process.symbolic.columns()
    terms = process.rewards[primitive]
    if not terms:
        return [Fraction(0)], np.zeros(len(states), dtype=np.int64)
    entries = [evaluate_states(term.diagram, states, columns).astype(np.int64) for term in terms]
    key, size = np.zeros(len(states), dtype=np.int64), 1
    for term, entry in zip(terms, entries, strict=True):
        if size * len(term.values) > DIRECT:
            found, key = np.unique(key, return_inverse=True)
            size = len(found)
        key = key.reshape(-1) * len(term.values) + entry
        size *= len(term.values)
    if size > DIRECT:
        found, key = np.unique(key, return_inverse=True)
        size = len(found)
    example = np.full(size, -1, dtype=np.int64)  # a state for each key that occurs
    example[key] = np.arange(len(states))
    present = np.flatnonzero(example >= 0)
    place = np.zeros(size, dtype=np.int64)
    place[present] = np.arange(len(present))
    rows = np.stack([entry[example[present]] for entry in entries], axis=1).tolist()
    if process.open_numbers is not None:  # functions of parameters have no common denominator
        tables = [term.values for term in terms]
        open_sums = [sum((t[n] for t, n in zip(tables, row, strict=True)), Fraction(0)) for row in rows]
        return open_sums, place[key]
    common = lcm(*(value.denominator for term in terms for value in term.values))
    cleared = [[int(value * common) for value in term.values] for term in terms]
    sums = [
        Fraction(sum([values[number] for values, number in zip(cleared, row, strict=True)]), common)
        for row in rows
    ]
    return sums, place[key]


def exact_rewards(
    process: DecisionProcess, primitive: int, states: npt.NDArray[np.int32]
) -> list[Fraction]:
    """The exact reward of a primitive at each of several states [state, feature]."""
    sums, place = distinct_rewards(process, primitive, states)
    return [sums[index] for index in place.tolist()]


def make_quotient(process: DecisionProcess, partition: Partition) -> Quotient:
    """The quotient of `process` by a stable partition of it."""
    symbolic = process.symbolic
    states = feature_states(partition)
    columns = symbolic.columns()
    blocks = partition.blocks
    primitive = np.full((len(process.choices), blocks), -1, dtype=np.int32)
    for c, choice in enumerate(process.choices):
        primitive[c] = primitives_at(choice, states, columns)
    terminal = evaluate_states(process.terminal, states, columns).astype(bool)
    plans: dict[int, tuple[PushPlan, RowTable]] = {}
    plain: PushPlan | None = None
    rewards = np.zeros((len(process.choices), blocks))
    matrices: dict[int, tuple[npt.NDArray[np.int64], Any]] = {}
    for p in sorted({int(p) for p in np.unique(primitive)} - {-1}):
        chosen_blocks = np.flatnonzero((primitive == p).any(axis=0))
        rows = symbolic.actions[p].rows
        if any(row.parents_next for row in rows.values()):
            plan = make_plan(symbolic, partition.diagram, rows)
        else:  # one for all
            plan = plain = plain or make_plan(symbolic, partition.diagram, rows)
        plans[p] = (plan, row_table(symbolic, rows))
        matrix = push_states(partition, rows, *plans[p], states[chosen_blocks])
        matrices[p] = (chosen_blocks, matrix)
        sums, place = distinct_rewards(process, p, states[chosen_blocks])
        gains = np.array([as_float(value, process.symbolic.actions[p].name) for value in sums])[place]
        for c in range(len(process.choices)):
            mine = primitive[c, chosen_blocks] == p
            rewards[c, chosen_blocks[mine]] = gains[mine]
    transitions = tuple(_choice_matrix(primitive[c], matrices, blocks) for c in range(len(process.choices)))
    mdp = ArrayMDP(
        process.names, transitions, rewards, primitive >= 0, terminal, float(symbolic.model.discount)
    )
    return Quotient(process, partition, mdp, primitive, plans)


def primitives_at(
    choice: Choice, states: npt.NDArray[np.int32], columns: list[int]
) -> npt.NDArray[np.int32]:
    """The primitive that a choice stands for at each state [state, feature], -1 where not applicable."""
    app = evaluate_states(choice.app, states, columns).astype(bool)
    if choice.policy is None:
        return np.where(app, choice.primitives[0], -1).astype(np.int32)
    taken = evaluate_states(choice.policy, states, columns).astype(np.int64)
    return np.where(app, taken, -1).astype(np.int32)


def push_states(
    partition: Partition,
    rows: Mapping[int, RowDiagram],
    plan: PushPlan,
    table: RowTable,
    states: npt.NDArray[np.int32],
) -> Any:
    """The float rows of states [state, feature] over blocks, as a CSR array."""
    symbolic = partition.symbolic
    chosen = rows_at(symbolic, rows, table, plan.slots, states)
    pointers, blocks, masses = push_all(symbolic, plan, table, chosen)
    shape = (len(states), partition.blocks + partition.has_outside)
    return sparse.csr_array((masses, blocks, pointers), shape=shape)


def push_all(
    symbolic: SymbolicModel, plan: PushPlan, table: RowTable, chosen: Int32Array, most: int | None = None
) -> tuple[Int64Array, Int64Array, FloatArray]:
    """The float masses of the leaves that states reach, whose rows are `chosen` [state, slot].

    Returns:
        pointers [state], one more at the end; leaves and masses [entry], by state and leaf.

    Raises:
        LimitReached: more than `most` entries.
    """
    row_ends = np.zeros(len(chosen), dtype=np.int64)
    room = max(1024, 8 * len(chosen))
    found, masses = np.empty(room, dtype=np.int64), np.empty(room, dtype=np.float64)
    state = np.zeros(2, dtype=np.int64)
    while True:
        symbolic.manager.pause()
        code = push_floats(
            plan.roots, plan.slot, plan.level, plan.first_child, plan.children, plan.leaf,
            table.start, table.value, table.probability, chosen, row_ends, found, masses, state,
        )  # fmt: skip
        if most is not None and state[1] > most:
            raise LimitReached(f"more than {most:,} entries in the quotient's kernel", "quotient")
        if code == 0:
            break
        if code == 2:
            continue
        more = max(len(found), int(plan.leaf.max()) + 1)
        found = np.concatenate([found, np.empty(more, dtype=np.int64)])
        masses = np.concatenate([masses, np.empty(more, dtype=np.float64)])
    return np.concatenate([[0], row_ends]), found[: state[1]], masses[: state[1]]


def _choice_matrix(
    primitive: npt.NDArray[np.int32],
    matrices: dict[int, tuple[npt.NDArray[np.int64], Any]],
    blocks: int,
) -> Any:
    """The rows of one choice, gathered from those of the primitives it stands for."""
    pieces, targets = [], []
    for p, (chosen_blocks, matrix) in matrices.items():
        mine = np.flatnonzero(primitive[chosen_blocks] == p)
        if len(mine):
            rows = matrix if len(mine) == len(chosen_blocks) else matrix[mine]
            pieces.append(rows if rows.shape[1] == blocks else rows[:, :blocks])
            targets.append(chosen_blocks[mine])
    if not pieces:
        return sparse.csr_array((blocks, blocks))
    order = np.concatenate(targets)
    place = np.full(blocks, -1, dtype=np.int64)
    place[order] = np.arange(len(order))
    if len(pieces) == 1:
        selected, found = pieces[0], np.diff(pieces[0].indptr)
    else:
        stacked = sparse.vstack(pieces, format="csr")
        selected, found = stacked[place[place >= 0]], np.diff(stacked.indptr)
    lengths = np.where(place >= 0, found[place], 0)
    pointers = np.concatenate([[0], np.cumsum(lengths)])
    return sparse.csr_array((selected.data, selected.indices, pointers), shape=(blocks, blocks))


def initial_distribution(partition: Partition) -> npt.NDArray[np.float64]:
    """b0 over blocks, as floats [block]."""
    symbolic = partition.symbolic
    plan, table = (
        make_plan(symbolic, partition.diagram, symbolic.initial),
        row_table(symbolic, symbolic.initial),
    )
    nowhere = np.zeros((1, len(symbolic.model.features)), dtype=np.int32)
    row = push_states(partition, symbolic.initial, plan, table, nowhere)
    return np.asarray(row.toarray()[0, : partition.blocks])


def exact_initial_distribution(partition: Partition) -> dict[int, Fraction]:
    """b0 over blocks, exactly."""
    symbolic = partition.symbolic
    plan, table = (
        make_plan(symbolic, partition.diagram, symbolic.initial),
        row_table(symbolic, symbolic.initial),
    )
    nowhere = np.zeros((1, len(symbolic.model.features)), dtype=np.int32)
    return push_exact(plan, table, rows_at(symbolic, symbolic.initial, table, plan.slots, nowhere)[0])
