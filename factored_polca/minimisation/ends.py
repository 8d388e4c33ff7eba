"""Where a step of a quotient ends: the next block, and what the channels read of the next state.

A *sensor* is a diagram (x, x') -> number of a row of probabilities.  Next states x' of one block on which
the sensors agree, whatever x, need not be told apart: they are one *end*.  For a sensor of x' alone that
asks for its own value; for one of both, for its values at each x that matters, listed while these are few
(`PRESENT_STATES`), and else for the values of the next features that it reads.

The ends are the leaves of one diagram over x', finer than the partition, so that mass is pushed down it
as it is down the partition's (`factored_polca.minimisation.push`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from factored_polca.diagrams import (
    Diagram,
    MemoryLimit,
    evaluate_states,
    leaves,
    move,
    restrict,
    states_for_leaves,
    support,
)
from factored_polca.diagrams import pairs as pair_leaves
from factored_polca.diagrams.operations import leaf_payloads, node
from factored_polca.minimisation.outcomes import Numbering
from factored_polca.minimisation.partition import Partition
from factored_polca.minimisation.push import Int32Array, Int64Array
from factored_polca.models import LimitReached
from factored_polca.symbolic import SymbolicModel

MAXIMUM_ENDS: Final = 1_000_000
"""Ends beyond which the work stops."""

PRESENT_STATES: Final = 64
"""Most present contexts of a sensor for which it is looked at in each."""


@dataclass(frozen=True)
class Ends:
    """The ends: leaves 0, 1, ... of `diagram`, the block of each, and a next state there."""

    diagram: Diagram
    block: Int64Array  # [end], the partition's number for outside where there is one
    states: Int32Array  # [end, feature] value numbers


def make_ends(partition: Partition, functions: Iterable[Diagram], culprits: str) -> Ends:
    """The ends on which all `functions`, over present variables, and the block are constant.

    `culprits` names the channels behind the functions, where there are too many.

    Raises:
        LimitReached: too many ends, or diagrams larger than memory.
    """
    symbolic, manager = partition.symbolic, partition.symbolic.manager
    current, block = partition.diagram, np.arange(partition.blocks + partition.has_outside)
    message = (
        f"the blocks of the next state, with what the channels read of it, make more than {MAXIMUM_ENDS:,} "
        f"cases; channels and their values left after merging are {culprits}; let the task observe fewer "
        "channels (`observes`)"
    )
    for function in functions:
        try:
            current, first, _ = pair_leaves(current, function)
        except MemoryLimit as error:
            text = (
                f"the diagram of next blocks and of what channels read ({culprits}) is too large: {error}"
            )
            raise LimitReached(text, "quotient", partition) from None
        block = block[leaf_payloads(manager, first).astype(np.int64)]
        if len(block) > MAXIMUM_ENDS:
            raise LimitReached(message, "quotient", partition)
    states = np.empty((len(block), len(symbolic.model.features)), dtype=np.int32)
    numbers = np.array([int(leaf) for leaf in leaves(current)])
    states[numbers] = states_for_leaves(current)[:, symbolic.now_levels]
    return Ends(current, block, states)


def functions_of_next(symbolic: SymbolicModel, sensor: Diagram, states: Int32Array) -> list[Diagram]:
    """Functions of x', moved to the present variables, that tell `sensor` at each of `states`.

    `states` [i, feature] are the present states that matter.
    """
    manager, tested = symbolic.manager, support(sensor)
    later = [level for level in tested if level % 2]
    if not later:
        return []
    now = [level for level in tested if level % 2 == 0]
    columns = symbolic.columns()
    contexts = np.unique(states[:, [columns[level] for level in now]], axis=0)
    if len(contexts) > PRESENT_STATES:
        sizes = [manager.sizes[level] for level in later]
        return [
            node(manager, level - 1, [manager.constant(value) for value in range(size)])
            for level, size in zip(later, sizes, strict=True)
        ]
    functions: list[Diagram] = []
    for values in contexts.tolist():
        at_context = restrict(sensor, dict(zip(now, values, strict=True))) if now else sensor
        moved = move(at_context, {level: level - 1 for level in later})
        if not moved.is_constant and moved not in functions:
            functions.append(moved)
    return functions


@dataclass(frozen=True)
class Pairs:
    """Pairs (x, x'): number i is states[source[i]] and ends[end[i]]."""

    states: Int32Array  # [., feature] value numbers
    source: Int64Array  # [i]
    ends: Int32Array  # [., feature]
    end: Int64Array  # [i]


def rows_sensed(symbolic: SymbolicModel, sensor: Diagram, pairs: Pairs) -> Int64Array:
    """The row number of a sensor at pairs of states [i]."""
    if sensor.is_constant:
        return np.full(len(pairs.source), int(sensor.value), dtype=np.int64)
    column_of, features = symbolic.columns(), pairs.ends.shape[1]
    table = np.empty((len(pairs.source), len(support(sensor))), dtype=np.int32)
    columns = [0] * symbolic.manager.leaf_level
    for number, level in enumerate(support(sensor)):
        columns[level], place = number, column_of[level]
        now = place < features
        table[:, number] = (
            pairs.states[pairs.source, place] if now else pairs.ends[pairs.end, place - features]
        )
    return evaluate_states(sensor, table, columns).astype(np.int64)


def joint_rows(
    symbolic: SymbolicModel, sensors: Sequence[Diagram], pairs: Pairs, numbering: Numbering
) -> Int64Array:
    """The number that `numbering` gives the rows of all sensors at pairs of states [i]."""
    if all(level % 2 for sensor in sensors for level in support(sensor)):  # x' alone: look at each end once
        met = np.zeros(len(pairs.ends), dtype=np.bool_)
        met[pairs.end] = True
        used = np.flatnonzero(met)
        once = Pairs(pairs.states, np.zeros_like(used), pairs.ends, used)
        place = np.cumsum(met) - 1
        found = _numbered(symbolic, sensors, once, numbering)
        return np.asarray(found[place[pairs.end]])
    return _numbered(symbolic, sensors, pairs, numbering)


def _numbered(
    symbolic: SymbolicModel, sensors: Sequence[Diagram], pairs: Pairs, numbering: Numbering
) -> Int64Array:
    rows = np.empty((len(pairs.end), len(sensors)), dtype=np.int64)
    for number, sensor in enumerate(sensors):
        rows[:, number] = rows_sensed(symbolic, sensor, pairs)
    return numbering.number(rows)
