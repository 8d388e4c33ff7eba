"""States found one from the other, or all of the product, and what can come of each action in them.

Breadth first, or in the order of the product: the driver of `factored_polca.minimisation.states_kernel`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from factored_polca.diagrams.nodes import DONE
from factored_polca.minimisation.outcomes import Draw, FlatDraws, FloatArray, Int32Array, Int64Array
from factored_polca.minimisation.states_kernel import (
    ACTION,
    ENTRIES,
    OUTPUT,
    STATE,
    STATES,
    TABLE,
    list_outcomes,
    number_state,
    place_states,
)
from factored_polca.symbolic import SymbolicModel

PIECE = 1 << 16
"""Entries that are listed at once."""


@dataclass(frozen=True)
class Piece:
    """Entries of some states, of all actions [k].

    `seen` [k, channel] has the null value where a channel is not sensed.
    """

    action: Int32Array
    source: Int32Array
    target: Int32Array
    chance: FloatArray
    seen: Int32Array


class DoesNotApply(RuntimeError):
    """An action does not apply in a state, though it should: its number and the state's value numbers."""

    def __init__(self, action: int, digits: Int32Array) -> None:
        super().__init__(f"action {action} does not apply")
        self.action, self.digits = action, digits


class TooMany(RuntimeError):
    """More states, or entries of one state, than allowed: `what` is "states" or "entries"."""

    def __init__(self, what: str) -> None:
        super().__init__(f"too many {what}")
        self.what = what


class Expansion:
    """The states that `add` was given and those they lead to, or, with `reachable` false, all.

    `most` are the states and the entries of one state that are allowed.
    """

    def __init__(self, symbolic: SymbolicModel, most: tuple[int, int], *, reachable: bool) -> None:
        self.symbolic, self.most = symbolic, most
        self.sizes = [len(feature.values) for feature in symbolic.model.features]
        self.state = np.zeros(4, dtype=np.int64)
        self.strides = np.zeros(len(self.sizes), dtype=np.int64)
        room = 1024 if reachable else 0
        self.table = np.zeros((room, len(self.sizes)), dtype=np.int32)
        self.slots = np.zeros(4 * room, dtype=np.int32)

    def __len__(self) -> int:
        return int(self.state[STATES])

    @property
    def states(self) -> Int32Array:
        """The states found [number, feature]."""
        return self.table[: len(self)]

    def add(self, digits: Int32Array) -> Int64Array:
        """The number of each state [k, feature]."""
        numbers = np.empty(len(digits), dtype=np.int64)
        for k, row in enumerate(np.ascontiguousarray(digits)):
            while (number := number_state(row, 0, len(row), self.table, self.slots, self.state)) < 0:
                self._grow()
            numbers[k] = number
        return numbers

    def pieces(
        self, draws: Sequence[Sequence[Draw]], nulls: Sequence[int], *, total: bool
    ) -> Iterator[Piece]:
        """All entries; `draws` [action], `nulls` the value numbers that channels have where not sensed.

        Raises:
            DoesNotApply: with `total`, an action that does not apply in a state that is not terminal.
            TooMany: see there.
        """
        flat, manager, count = FlatDraws(draws), self.symbolic.manager, len(self.sizes)
        if not len(self.slots):
            self.state[STATES] = math.prod(self.sizes)
            self.strides[:] = [math.prod(self.sizes[i + 1 :]) for i in range(count)]
        terminal = self.symbolic.terminal.node
        apps = np.array([action.app.node for action in self.symbolic.actions], dtype=np.int32)
        columns = np.array([*self.symbolic.columns(), 0], dtype=np.int32)
        sizes, null_values = np.array(self.sizes, dtype=np.int64), np.array(nulls, dtype=np.int32)
        row = np.zeros(2 * count + len(nulls), dtype=np.int32)
        entry, ends = np.zeros((2, len(flat.roots) + 1), dtype=np.int64)
        products = np.zeros(len(flat.roots) + 1)
        room = PIECE
        while True:
            action, source, target = np.empty((3, room), dtype=np.int32)
            chance = np.empty(room)
            seen = np.empty((room, len(nulls)), dtype=np.int32)
            self.state[ENTRIES] = 0
            code = list_outcomes(
                manager.pool, manager.leaf_level, columns, terminal, apps, int(total), flat.first,
                flat.roots, flat.targets, flat.bases, flat.start, flat.value, flat.chance, sizes,
                self.strides, null_values, self.table, self.slots, row, entry, ends, products, action,
                source, target, chance, seen, self.state,
            )  # fmt: skip
            manager.pause()
            done = int(self.state[ENTRIES])
            if done:
                yield Piece(action[:done], source[:done], target[:done], chance[:done], seen[:done])
            if len(self.slots) and len(self) > self.most[0]:
                raise TooMany("states")
            if code == DONE:
                return
            if code == TABLE:
                self._grow()
            elif code == OUTPUT:
                if done == 0:  # not even room for one state
                    room *= 2
                if room > 2 * max(self.most[1], PIECE):
                    raise TooMany("entries")
            else:
                raise DoesNotApply(int(self.state[ACTION]), self._digits(int(self.state[STATE])))

    def _digits(self, number: int) -> Int32Array:
        digits = self.table[number] if len(self.slots) else number // self.strides % np.array(self.sizes)
        result: Int32Array = digits.astype(np.int32)
        return result

    def _grow(self) -> None:
        """Twice the room for states."""
        if len(self) > self.most[0]:
            raise TooMany("states")
        self.table = np.concatenate([self.table, np.zeros_like(self.table)])
        self.slots = np.zeros(4 * len(self.table), dtype=np.int32)
        place_states(self.table, len(self), self.slots)
