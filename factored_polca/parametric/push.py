"""Push the registers of probabilities down a diagram: `factored_polca.minimisation.push` for functions.

The walk is that of `push_exact`, with the registers of a straight-line program in place of numbers.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from factored_polca.minimisation.push import (
    Int32Array,
    PushPlan,
    RowTable,
    exact_rows,
    rows_at,
)
from factored_polca.parametric.program import ProgramBuilder
from factored_polca.symbolic import RowDiagram, SymbolicModel

RegisterRow = tuple[tuple[int, int], ...]
"""The values of a feature that can occur, each with the register of its probability."""


@dataclass(frozen=True)
class RegisterTable:
    """The rows of an action as registers; `table` is what `rows_at` wants, without floats."""

    rows: tuple[RegisterRow, ...]
    table: RowTable


def register_table(
    symbolic: SymbolicModel, rows: Mapping[int, RowDiagram], builder: ProgramBuilder
) -> RegisterTable:
    """The rows of an action, their numbers added to a program."""
    exact, offset = exact_rows(symbolic, rows)
    registers = tuple(tuple((v, builder.number(q)) for v, q in row) for row in exact)
    empty = np.empty(0, dtype=np.int64)
    table = RowTable(empty, empty.astype(np.int32), empty.astype(np.float64), exact, offset)
    return RegisterTable(registers, table)


def push_registers(
    plan: PushPlan, rows: Sequence[RegisterRow], chosen: Sequence[int], builder: ProgramBuilder
) -> dict[int, int]:
    """The register of the mass of each leaf, for one state whose rows are `chosen` [slot]."""
    add, multiply = builder.add, builder.multiply
    slots, first, children, leaves = plan.slot, plan.first_child, plan.children, plan.leaf
    mass: dict[int, int] = {}
    for root in plan.roots.tolist():
        mass[root] = add(mass[root], builder.one) if root in mass else builder.one
    result: dict[int, int] = {}
    heap = sorted(mass)
    while heap:
        place = heapq.heappop(heap)
        here = mass.pop(place)
        slot = int(slots[place])
        if slot < 0:
            leaf = int(leaves[place])
            result[leaf] = add(result[leaf], here) if leaf in result else here
            continue
        start = int(first[place])
        for value, chance in rows[chosen[slot]]:
            child = int(children[start + value])
            if child < 0:
                continue
            moved = multiply(here, chance)
            if child in mass:
                mass[child] = add(mass[child], moved)
            else:
                heapq.heappush(heap, child)
                mass[child] = moved
    return dict(sorted(result.items()))


def push_all_registers(
    symbolic: SymbolicModel,
    plan: PushPlan,
    table: RegisterTable,
    rows: Mapping[int, RowDiagram],
    states: Int32Array,
    builder: ProgramBuilder,
) -> list[dict[int, int]]:
    """The masses of the leaves from each of `states` [i, feature]."""
    chosen = rows_at(symbolic, rows, table.table, plan.slots, states).tolist()
    result = []
    for number, drawn in enumerate(chosen):
        if number % 64 == 0:
            symbolic.manager.pause()
        result.append(push_registers(plan, table.rows, drawn, builder))
    return result
