"""The joint kernel of one choice of a partially observed process over the blocks of a partition.

Mass is pushed from each block's representative x_C down the diagram of the *ends* (`ends`): blocks of the
next state, split by the rows that the channels have there.  With t numbering the joint rows of the
channels and P_t(o) their product, an entry (C, end) of mass m adds m P_t(o) to K(C; C', o), C' being the
end's block.

Observations are merged on the way: first the values of single channels (`observations`), then the joint
columns that are proportional (`joint_columns`).  In between only joint observations that occur are listed,
so that channels which tell the same make no more of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from scipy.sparse import csr_array

from factored_polca.diagrams import INDEX, Diagram, relabel
from factored_polca.explicit.arrays import SparseMatrix
from factored_polca.explicit.exact_pomdp import NOTHING
from factored_polca.minimisation.criterion import Choice, DecisionProcess
from factored_polca.minimisation.ends import (
    Ends,
    Pairs,
    functions_of_next,
    joint_rows,
    make_ends,
    rows_sensed,
)
from factored_polca.minimisation.joint_columns import (
    JointTable,
    Limits,
    Pushed,
    joint_table,
    merge_columns,
)
from factored_polca.minimisation.observations import (
    MergedChannel,
    occurring_rows,
    sense,
    unsensed_row,
)
from factored_polca.minimisation.outcomes import Numbering
from factored_polca.minimisation.partition import Partition
from factored_polca.minimisation.push import (
    Int32Array,
    Int64Array,
    PushPlan,
    RowTable,
    make_plan,
    push_exact,
    row_table,
    rows_at,
)
from factored_polca.minimisation.quotient import feature_states, push_all
from factored_polca.models import LimitReached
from factored_polca.symbolic import RowDiagram, SymbolicModel
from factored_polca.symbolic.rows import Row

LABELS_SHOWN = 4
"""Joint observations named in the label of merged ones."""

CHANNELS_SHOWN = 10
"""Channels named where there are too many observations."""


@dataclass(frozen=True)
class ChoiceObservations:
    """The observations of one choice: `numbers` maps merged values of the channels `left` to theirs."""

    channels: tuple[MergedChannel, ...]  # all of the process
    left: tuple[MergedChannel, ...]  # those with more than one merged value
    rows: tuple[tuple[Row, ...], ...]  # [channel of left][row] over merged values
    numbers: dict[tuple[int, ...], int]
    labels: tuple[str, ...]  # [o]


@dataclass(frozen=True)
class Step:
    """How one primitive of a choice is pushed; `sensors` give the rows of the channels left."""

    plan: PushPlan
    table: RowTable
    ends: Ends
    sensors: tuple[Diagram, ...]


@dataclass(frozen=True)
class ChoiceKernel:
    """K_c as one matrix [C, C'] for each observation, and the steps of the primitives behind it."""

    observations: ChoiceObservations
    matrices: tuple[SparseMatrix, ...]
    steps: dict[int, Step]  # by primitive

    def exact_row(
        self, symbolic: SymbolicModel, primitive: int, state: Int32Array
    ) -> dict[tuple[int, int], Fraction]:
        """The exact probability of each (next block, observation) from one state [1, feature]."""
        step, observations = self.steps[primitive], self.observations
        rows = symbolic.actions[primitive].rows
        masses = push_exact(
            step.plan, step.table, rows_at(symbolic, rows, step.table, step.plan.slots, state)[0]
        )
        ends = np.array(list(masses), dtype=np.int64)
        pairs = Pairs(state, np.zeros_like(ends), step.ends.states, ends)
        chosen = [rows_sensed(symbolic, sensor, pairs).tolist() for sensor in step.sensors]
        result: dict[tuple[int, int], Fraction] = {}
        for i, (end, mass) in enumerate(masses.items()):
            found: dict[tuple[int, ...], Fraction] = {(): mass}
            for numbers, listed in zip(chosen, observations.rows, strict=True):
                row = listed[numbers[i]]
                found = {(*o, v): m * q for o, m in found.items() for v, q in enumerate(row) if q}
            for digits, share in found.items():
                key = int(step.ends.block[end]), observations.numbers[digits]
                result[key] = result.get(key, Fraction(0)) + share
        return result


class KernelBuilder:
    """Builds the kernels of the choices of a process; `entries` counts those of all so far."""

    def __init__(self, process: DecisionProcess, partition: Partition, limits: Limits, seed: int) -> None:
        self.process, self.partition, self.limits, self.seed = process, partition, limits, seed
        self.symbolic = process.symbolic
        self.states = feature_states(partition)
        self.entries = 0
        self.known_ends: list[tuple[list[Diagram], Ends]] = []

    def build(self, choice: Choice, taken: Int32Array) -> ChoiceKernel:
        """The kernel of a choice that stands for primitive `taken` [block], -1 for none.

        Raises:
            LimitReached: more joint observations, ends or entries than allowed.
        """
        sensed = sense(self.process, choice, self.partition)
        channels, left = sensed.channels, sensed.left
        used = sorted({*taken.tolist()} - {-1})
        if not used:
            nothing = ChoiceObservations(channels, (), (), {}, (NOTHING,))
            return ChoiceKernel(nothing, (csr_array((len(taken), len(taken))),), {})
        ids: list[dict[Row, int]] = [{} for _ in left]
        culprits = _values_left(left)
        steps = {}
        for p in used:
            sensors = tuple(
                self.sensor(merged, known, choice, p, sensed.rows[p].get(merged.channel))
                for merged, known in zip(left, ids, strict=True)
            )
            steps[p] = self.step(p, sensors, self.states[taken == p], culprits)
        rows = tuple(tuple(listed) for listed in ids)
        numbering = Numbering([len(listed) for listed in rows])
        pieces = [self.push(p, step, np.flatnonzero(taken == p), numbering) for p, step in steps.items()]
        tuples = numbering.tuples()
        table = joint_table(tuples, rows, self.limits, choice.name, culprits)
        image = merge_columns(pieces, table, rows, tuples, self.partition.blocks, self.seed)
        numbers = {tuple(key): int(o) for key, o in zip(table.digits.tolist(), image, strict=True)}
        observations = ChoiceObservations(channels, left, rows, numbers, _labels(left, table, image))
        return ChoiceKernel(observations, self.matrices(pieces, table.merged(image), choice.name), steps)

    def sensor(
        self,
        merged: MergedChannel,
        ids: dict[Row, int],
        choice: Choice,
        primitive: int,
        row: RowDiagram | None,
    ) -> Diagram:
        """The rows of a channel over merged values, numbered in `ids`, as a diagram over (x, x')."""
        if row is None:
            unsensed = merged.row(unsensed_row(merged.definition))
            return self.symbolic.manager.constant(ids.setdefault(unsensed, len(ids)))
        occurring = occurring_rows(self.process, choice, primitive, row)
        numbers = {number: ids.setdefault(merged.row(r), len(ids)) for number, r in occurring.items()}
        other = next(iter(numbers.values()))  # where the choice does not stand for the primitive
        images = [numbers.get(number, other) for number in range(len(row.rows))]
        return relabel(row.diagram, np.array(images, dtype=np.uint64), INDEX)

    def step(self, primitive: int, sensors: tuple[Diagram, ...], states: Int32Array, culprits: str) -> Step:
        """How `primitive` is pushed from `states` [i, feature]; `culprits` names the channels."""
        ends, rows = self.ends(sensors, states, culprits), self.symbolic.actions[primitive].rows
        plan = make_plan(self.symbolic, ends.diagram, rows)
        return Step(plan, row_table(self.symbolic, rows), ends, sensors)

    def ends(self, sensors: Sequence[Diagram], states: Int32Array, culprits: str) -> Ends:
        """The ends for some sensors; those of other choices that ask for the same are used again."""
        functions: list[Diagram] = []
        for sensor in sensors:
            for function in functions_of_next(self.symbolic, sensor, states):
                if function not in functions:
                    functions.append(function)
        for known, ends in self.known_ends:
            if known == functions:
                return ends
        ends = make_ends(self.partition, functions, culprits)
        self.known_ends.append((functions, ends))
        return ends

    def push(self, primitive: int, step: Step, blocks: Int64Array, numbering: Numbering) -> Pushed:
        """Push the mass of the representatives of `blocks`."""
        states, rows = self.states[blocks], self.symbolic.actions[primitive].rows
        chosen = rows_at(self.symbolic, rows, step.table, step.plan.slots, states)
        pointers, leaves, masses = push_all(
            self.symbolic, step.plan, step.table, chosen, self.limits.entries
        )
        source = np.repeat(np.arange(len(blocks)), np.diff(pointers))
        pairs = Pairs(states, source, step.ends.states, leaves)
        joint = joint_rows(self.symbolic, step.sensors, pairs, numbering)
        target = step.ends.block[leaves]
        return Pushed(step.plan, step.table, chosen, blocks, pointers, leaves, masses, target, joint)

    def matrices(self, pieces: Sequence[Pushed], table: JointTable, name: str) -> tuple[SparseMatrix, ...]:
        """K_c as one CSR matrix [C, C'] for each observation."""
        blocks, count, outside = self.partition.blocks, len(table.digits), self.partition.has_outside
        lengths = np.diff(table.start)
        self.entries += sum(int(lengths[piece.joint].sum()) for piece in pieces)
        if self.entries > self.limits.entries:
            raise LimitReached(
                f"the kernel has more than {self.limits.entries:,} entries (block, next block, "
                f"observation) at choice {name!r}, which has {count:,} observations; minimise for fewer "
                "blocks or observations, or raise maximum_entries",
                "quotient",
                self.partition,
            )
        row, column, chance = [], [], []
        for piece in pieces:
            number = lengths[piece.joint]
            owner = np.repeat(np.arange(len(number)), number)
            entry = np.arange(len(owner))
            entry += (table.start[piece.joint] - np.cumsum(number) + number)[owner]
            row.append(table.observation[entry] * blocks + piece.source[owner])
            column.append(piece.target[owner])
            chance.append(piece.masses[owner] * table.chance[entry])
        parts = np.concatenate(chance), (np.concatenate(row), np.concatenate(column))
        stacked = csr_array(parts, shape=(count * blocks, blocks + outside))[:, :blocks]
        return tuple(_rows(stacked, o * blocks, blocks) for o in range(count))


def _rows(matrix: SparseMatrix, first: int, count: int) -> SparseMatrix:
    """Some rows of a CSR matrix, with its arrays shared."""
    pointers = matrix.indptr[first : first + count + 1]
    part = slice(int(pointers[0]), int(pointers[-1]))
    arrays = matrix.data[part], matrix.indices[part], pointers - pointers[0]
    return csr_array(arrays, shape=(count, matrix.shape[1]))


def _values_left(left: Sequence[MergedChannel]) -> str:
    """The channels with their numbers of merged values, the largest first."""
    largest = sorted(left, key=lambda channel: -channel.values)
    named = [f"{channel.definition.name} {channel.values}" for channel in largest[:CHANNELS_SHOWN]]
    if len(largest) > CHANNELS_SHOWN:
        named.append(f"{len(largest) - CHANNELS_SHOWN} more")
    return ", ".join(named)


def _labels(left: Sequence[MergedChannel], table: JointTable, image: Int64Array) -> tuple[str, ...]:
    """The label of each merged observation: its members, the first few by name."""
    members: list[list[int]] = [[] for _ in range(int(image.max()) + 1)]
    for o, number in enumerate(image.tolist()):
        members[number].append(o)
    labels = []
    for listed in members:
        named = [
            ", ".join(m.label(v) for m, v in zip(left, table.digits[o].tolist(), strict=True)) or NOTHING
            for o in listed[:LABELS_SHOWN]
        ]
        if len(listed) > LABELS_SHOWN:
            named.append(f"{len(listed) - LABELS_SHOWN} more")
        labels.append(" / ".join(named))
    return tuple(labels)
