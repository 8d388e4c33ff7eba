"""The regression through one action from the top down: the driver of `factored_polca.diagrams.forward`.

It can be stopped by a budget and gone on with, so that it may race the one from the bottom up: nobody knows
beforehand which of the two is quicker.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import Diagram, Field, LeafType, Manager, MemoryLimit, support
from factored_polca.diagrams.forward import (
    BUDGET,
    ENTRIES,
    ITEM,
    ITEMS,
    SHORT,
    VALUE,
    YIELDED,
    join_level,
    leaf_sums,
    place_all,
    push_level,
)
from factored_polca.diagrams.operations import Walk, leaf_payloads
from factored_polca.symbolic.regression import NumericView

Int32Array = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]


def looks_up(numbers: NumericView, action: int) -> bool:
    """Whether no row of the action looks at a level below its own, or at another next feature."""
    compiled = numbers.symbolic.actions[action]
    return not compiled.synchronic and all(
        max(support(row.diagram), default=-1) <= numbers.symbolic.now(feature)
        for feature, row in compiled.rows.items()
    )


class ForwardRegression:
    """One regression of `value` through an action of which `looks_up` holds, in a field.

    The nodes of `value` and of the rows must not move before it is done: no garbage collection between.

    Raises (when run):
        MemoryLimit: it takes more memory than the manager may.
    """

    def __init__(self, numbers: NumericView, action: int, value: Diagram) -> None:
        assert isinstance(numbers.leaf_type, Field)
        self.numbers, self.field, self.manager = numbers, numbers.leaf_type, numbers.manager
        symbolic = numbers.symbolic
        feature_at = {symbolic.now(i): i for i in range(len(symbolic.order))}
        self.compiled = symbolic.actions[action]
        self.levels = sorted(feature_at)
        self.features = [feature_at[level] for level in self.levels]
        rows = self.compiled.rows
        self.carried = [
            i
            for i, level in zip(self.features, self.levels, strict=True)
            if i in rows and min(support(rows[i].diagram), default=level) < level
        ]
        self._read(value)
        self.place = 0
        self.child_items: list[npt.NDArray[np.int32]] = []
        width = len(self.carried)
        self.first = np.array([0, 1], dtype=np.int64)
        self.entry_numbers = np.array([len(self.node_level) - 1], dtype=np.int32)
        self.weights = np.array([self.field.encode(1)], dtype=np.uint64)
        self.rows = np.array([self.compiled.rows[i].diagram.node for i in self.carried], dtype=np.int32)
        self.state = np.zeros(6, dtype=np.int64)
        self.taken = np.zeros(width + 1, dtype=np.int32)
        self._begin_level()

    def _read(self, value: Diagram) -> None:
        """V as arrays over its nodes, children before parents."""
        walk, manager = Walk(value), self.manager
        walk.leaf_payloads()  # numbers the nodes
        nodes = walk.nodes.astype(np.int64)
        self.node_level = walk.levels.copy()
        sizes = np.where(walk.is_leaf, 0, manager.arity[self.node_level]).astype(np.int64)
        self.first_child = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        offsets = np.arange(self.first_child[-1]) - np.repeat(self.first_child[:-1], sizes)
        parents = np.repeat(nodes, sizes)
        self.children = manager.pool[manager.pool[parents + 2 + offsets] + 1].copy()
        self.values = np.zeros(len(nodes), dtype=np.uint64)
        self.values[walk.is_leaf] = leaf_payloads(manager, walk.leaves())
        leaves = np.flatnonzero(walk.is_leaf)
        zero = leaves[self.values[leaves] == 0]
        self.zero = int(zero[0]) if len(zero) else -1
        self.sums = np.zeros(len(nodes), dtype=np.uint64)
        self.stamps = np.zeros(len(nodes), dtype=np.int64)
        self.met = np.zeros(len(nodes), dtype=np.int32)

    @property
    def nodes(self) -> int:
        """The nodes of V."""
        return len(self.node_level)

    @property
    def items(self) -> int:
        """The items of the level under way."""
        return len(self.first) - 1

    @property
    def bytes(self) -> int:
        """What the arrays take."""
        arrays: list[npt.NDArray[Any]] = [
            self.entry_numbers, self.weights, self.next_numbers, self.next_weights, self.next_rows,
            self.slots, self.hashes, self.next_first, *self.child_items,
        ]  # fmt: skip
        return sum(array.nbytes for array in arrays)

    def _begin_level(self) -> None:
        """Empty arrays for the next level's items."""
        if self.place == len(self.levels):
            return
        size = self.manager.sizes[self.levels[self.place]]
        entries = 2 * len(self.entry_numbers) + 64
        room = 2 * self.items + 16
        self.next_first = np.zeros(room + 1, dtype=np.int64)
        self.next_numbers = np.zeros(entries, dtype=np.int32)
        self.next_weights = np.zeros(entries, dtype=np.uint64)
        self.next_rows = np.zeros(room * len(self.carried), dtype=np.int32)
        self.hashes = np.zeros(room, dtype=np.uint64)
        self.slots = self._slots(1 << (4 * room).bit_length(), 0)
        self.child_items.append(np.zeros(size * self.items, dtype=np.int32))
        self.state[[ITEM, VALUE, ITEMS, ENTRIES]] = 0
        feature = self.features[self.place]
        row = self.compiled.rows.get(feature)
        self.table = np.zeros(0, dtype=np.uint64)
        self.row = 0
        if row is not None:
            self.table = self.numbers.stored([p for r in row.rows for p in r])
            self.row = -1 - self.carried.index(feature) if feature in self.carried else row.diagram.node

    def run(self, budget: int) -> Diagram | None:
        """Go on for some `budget` entries; the regression if that was enough."""
        if not self.advance(budget):
            return None
        totals = np.zeros(self.items, dtype=np.uint64)
        leaf_sums(
            self.first, self.entry_numbers, self.weights, self.items, self.values,
            self.field.parameters, totals,
        )  # fmt: skip
        return self.join(totals, self.field)

    def whole_rows(self) -> list[Hashable]:
        """The rows of the last level's items, when all are there: what arrives at each of V's leaves.

        Equal rows, of whatever action and with the same V and field, are equal objects.
        """
        lengths = np.diff(self.first)
        order = np.lexsort((self.entry_numbers, np.repeat(np.arange(self.items), lengths)))
        pairs = np.stack([self.entry_numbers[order].astype(np.uint64), self.weights[order]], axis=1)
        return [pairs[i:j].tobytes() for i, j in itertools.pairwise(self.first.tolist())]

    def reached(self, leaf: int) -> npt.NDArray[np.bool_]:
        """Whether anything arrives at the leaf with this payload, for each of the last level's items."""
        there = np.isin(
            self.entry_numbers,
            np.flatnonzero((self.node_level == self.manager.leaf_level) & (self.values == leaf)),
        )
        return (
            np.bincount(np.repeat(np.arange(self.items), np.diff(self.first))[there], minlength=self.items)
            > 0
        )

    def advance(self, budget: int) -> bool:
        """Go on for some `budget` entries; whether all items are there."""
        self.state[BUDGET] = budget
        while self.place < len(self.levels):
            level = self.levels[self.place]
            code = push_level(
                self.manager.pool, self.manager.leaf_level, level, self.manager.sizes[level],
                self.node_level, self.first_child, self.children, self.zero, self.row,
                len(self.carried), self.table, np.uint64(self.field.encode(1)), self.field.parameters,
                self.first, self.entry_numbers, self.weights, self.rows, self.items, self.next_first,
                self.next_numbers, self.next_weights, self.next_rows, self.child_items[-1],
                self.hashes, self.slots, self.sums, self.stamps, self.met, self.taken, self.state,
            )  # fmt: skip
            if code == YIELDED:
                return False
            if code == SHORT:
                self._lengthen()
                continue
            items, entries = int(self.state[ITEMS]), int(self.state[ENTRIES])
            self.first = self.next_first[: items + 1]
            self.entry_numbers, self.weights = self.next_numbers[:entries], self.next_weights[:entries]
            self.rows = self.next_rows[: items * len(self.carried)]
            self.place += 1
            self._begin_level()
        return True

    def _lengthen(self) -> None:
        """Double the arrays that receive items."""
        if self.manager.bytes + 2 * self.bytes > self.manager.memory_limit:
            raise MemoryLimit("a regression from the top down takes more memory than allowed")
        for name in ("next_numbers", "next_weights", "next_rows", "next_first", "hashes"):
            array = getattr(self, name)
            setattr(self, name, np.concatenate([array, np.zeros_like(array)]))
        self.slots = self._slots(2 * len(self.slots), int(self.state[ITEMS]))

    def _slots(self, size: int, items: int) -> Int32Array:
        """A table of so many slots that finds the items there are."""
        slots = np.zeros(size, dtype=np.int32)
        place_all(self.hashes, items, slots)
        return slots

    def join(self, payloads: npt.NDArray[np.uint64], leaf_type: LeafType) -> Diagram:
        """The diagram of all items, given what the leaf of each of the last level's is to hold."""
        leaves = self.manager.leaf_nodes(payloads)
        return join_items(self.manager, self.levels, self.child_items, leaves, leaf_type)


def join_items(
    manager: Manager, levels: Sequence[int], child_items: Sequence[Int32Array], below: Int32Array,
    leaf_type: LeafType,
) -> Diagram:  # fmt: skip
    """The diagram of items, level by level.

    `child_items` [level][size * item + value] are numbers of the next level's items, or, at the last level,
    of the nodes `below`.
    """
    for level, children in zip(reversed(levels), reversed(child_items), strict=True):
        items = len(children) // manager.sizes[level]
        made = np.zeros(items, dtype=np.int32)
        progress = np.zeros(1, dtype=np.int64)

        def step(
            level: int = level, children: Int32Array = children, items: int = items,
            above: Int32Array = below, made: Int32Array = made, progress: Int64Array = progress,
        ) -> int:  # fmt: skip
            m = manager
            done: int = join_level(
                m.pool, m.head, m.unique, m.arity, level, children, items, above, made, m.words, progress
            )
            return done

        manager.run(step)
        below = made
    return manager.handle(int(below[0]), leaf_type)
