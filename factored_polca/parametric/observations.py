"""The joint kernel of one action of a partially observed process, its entries registers of a program.

The parts are those of `factored_polca.minimisation.choice_kernel`: values of single channels merged, mass
pushed to the *ends*, joint observations listed as they occur, proportional columns merged.  A fully
observed process has one observation, which tells nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from factored_polca.diagrams import Diagram
from factored_polca.explicit.exact_pomdp import NOTHING
from factored_polca.minimisation.choice_kernel import KernelBuilder
from factored_polca.minimisation.criterion import Choice, DecisionProcess
from factored_polca.minimisation.ends import Ends, Pairs, rows_sensed
from factored_polca.minimisation.joint_columns import Limits
from factored_polca.minimisation.observations import MergedChannel, sense
from factored_polca.minimisation.partition import Partition
from factored_polca.minimisation.pomdp_quotient import MAXIMUM_ENTRIES, MAXIMUM_OBSERVATIONS
from factored_polca.minimisation.push import Int32Array, Int64Array
from factored_polca.models import LimitReached
from factored_polca.parametric.program import ProgramBuilder
from factored_polca.symbolic import SymbolicModel
from factored_polca.symbolic.rows import Row

Digits = tuple[int, ...]
"""A joint observation: the merged value of each channel that tells something."""

LABELS_SHOWN: Final = 4


@dataclass(frozen=True)
class PreparedChoice:
    """What an action senses: the channels that tell something, and the registers of their rows."""

    name: str
    symbolic: SymbolicModel
    diagram: Diagram  # the ends, or the partition where nothing is sensed
    ends: Ends | None
    left: tuple[MergedChannel, ...]
    sensors: tuple[Diagram, ...]
    rows: tuple[tuple[tuple[tuple[int, int], ...], ...], ...]  # [channel][row] (merged value, register)


@dataclass(frozen=True)
class JointKernel:
    """K as rows [o][C] {C': register}, and the names of the observations."""

    rows: list[list[dict[int, int]]]
    labels: tuple[str, ...]


def prepare_choice(
    process: DecisionProcess,
    partition: Partition,
    choice: Choice,
    taken: Int32Array,
    builder: ProgramBuilder,
) -> PreparedChoice:
    """What an action senses, the numbers of its rows added to the program.

    `taken` [block] is the action's number, -1 where it does not apply.
    """
    symbolic = process.symbolic
    here = taken >= 0
    if not process.partial or not here.any():
        return PreparedChoice(choice.name, symbolic, partition.diagram, None, (), (), ())
    limits = Limits(MAXIMUM_OBSERVATIONS, MAXIMUM_ENTRIES)
    kernels = KernelBuilder(process, partition, limits, 0)
    sensed = sense(process, choice, partition)
    left, p = sensed.left, choice.primitives[0]
    ids: list[dict[Row, int]] = [{} for _ in left]
    sensors = tuple(
        kernels.sensor(merged, known, choice, p, sensed.rows[p].get(merged.channel))
        for merged, known in zip(left, ids, strict=True)
    )
    culprits = ", ".join(f"{merged.definition.name} {merged.values}" for merged in left)
    ends = kernels.ends(sensors, kernels.states[here], culprits)
    rows = tuple(
        tuple(tuple((v, builder.number(q)) for v, q in enumerate(row) if q) for row in known)
        for known in ids
    )
    return PreparedChoice(choice.name, symbolic, ends.diagram, ends, left, sensors, rows)


def joint_kernel(
    partition: Partition,
    prepared: PreparedChoice,
    blocks: Int64Array,
    states: Int32Array,
    masses: Sequence[dict[int, int]],
    builder: ProgramBuilder,
) -> JointKernel:
    """The kernel from the masses [i] {end: register} that reach the ends from `states` [i, feature].

    Raises:
        LimitReached: more joint observations than allowed.
    """
    empty: list[dict[int, int]] = [{} for _ in range(partition.blocks)]
    ends = prepared.ends
    if ends is None:
        for block, row in zip(blocks.tolist(), masses, strict=True):
            empty[block] = row
        return JointKernel([empty], (NOTHING,))
    found: dict[Digits, list[dict[int, int]]] = {}
    for i, (block, reached) in enumerate(zip(blocks.tolist(), masses, strict=True)):
        prepared.symbolic.manager.pause()
        numbers = np.array(list(reached), dtype=np.int64)
        pairs = Pairs(states[i : i + 1], np.zeros_like(numbers), ends.states, numbers)
        chosen = [rows_sensed(prepared.symbolic, sensor, pairs).tolist() for sensor in prepared.sensors]
        for place, (end, mass) in enumerate(reached.items()):
            target = int(ends.block[end])
            listed: list[tuple[Digits, int]] = [((), mass)]
            for rows, picked in zip(prepared.rows, chosen, strict=True):
                listed = [
                    ((*digits, value), builder.multiply(register, chance))
                    for digits, register in listed
                    for value, chance in rows[picked[place]]
                ]
            for digits, register in listed:
                if digits not in found:
                    _refuse_more(prepared, len(found) + 1)
                    found[digits] = [{} for _ in range(partition.blocks)]
                row = found[digits][block]
                row[target] = builder.add(row[target], register) if target in row else register
    if not found:
        return JointKernel([empty], (NOTHING,))
    return _merged(prepared, dict(sorted(found.items())), builder)


def _refuse_more(prepared: PreparedChoice, count: int) -> None:
    if count > MAXIMUM_OBSERVATIONS:
        named = ", ".join(f"{merged.definition.name} {merged.values}" for merged in prepared.left)
        raise LimitReached(
            f"action {prepared.name!r} has more than {MAXIMUM_OBSERVATIONS:,} joint observations; its "
            f"channels and their values left after merging are {named}",
            "quotient",
        )


def _merged(
    prepared: PreparedChoice, found: dict[Digits, list[dict[int, int]]], builder: ProgramBuilder
) -> JointKernel:
    """Columns that are proportional as functions made one; see `joint_columns`."""
    prime = builder.primes[0]
    blocks = len(next(iter(found.values())))
    draws = np.random.default_rng(0).integers(1, 2**60, size=(4, blocks + 1)).tolist()
    groups: dict[object, list[Digits]] = {}
    for digits, rows in found.items():
        forms = [0, 0]
        for block, row in enumerate(rows):
            for target, register in row.items():
                residue = builder.residues[register][0]
                for k in (0, 1):
                    forms[k] += draws[k][block] * draws[2 + k][target] % prime * residue
        first, second = (form % prime for form in forms)
        key = first * pow(second, -1, prime) % prime if second else digits
        groups.setdefault(key, []).append(digits)
    result = []
    for members in groups.values():
        total: list[dict[int, int]] = [{} for _ in range(blocks)]
        for digits in members:
            for row, more in zip(total, found[digits], strict=True):
                for target, register in more.items():
                    row[target] = builder.add(row[target], register) if target in row else register
        result.append(total)
    return JointKernel(result, tuple(_label(prepared.left, members) for members in groups.values()))


def _label(left: Sequence[MergedChannel], members: Sequence[Digits]) -> str:
    named = [
        ", ".join(m.label(v) for m, v in zip(left, digits, strict=True)) or NOTHING
        for digits in members[:LABELS_SHOWN]
    ]
    if len(members) > LABELS_SHOWN:
        named.append(f"{len(members) - LABELS_SHOWN} more")
    return " / ".join(named)
