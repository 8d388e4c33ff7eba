"""Refining a partition on a list of the states, where that takes less time than on diagrams.

Where most states are told apart, a diagram of the partition is a list with overhead: a node has a place for
each value of its variable, and a block that is split costs a node at each level.  Then the same passes run
on arrays (`factored_polca.minimisation.listed_kernel`), in GF(p) as well: what is random and what is exact,
what the passes are and what comes of them does not change.

What is listed are the value combinations of the relevant features (`factored_polca.minimisation.apart`).
With n_i values of feature i and at most e_pi positive entries in its rows of primitive p,

    states N = prod_i n_i,      entries <= N * sum over choices of max over their p of prod_i e_pi.

Whether that pays nobody knows beforehand: so diagrams may take as many steps as lists would take time, and
then lists are tried (as with renting skis: no more than about twice the time of the better one).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import prod

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import INDEX, Diagram, Field, Manager, evaluate_states, support
from factored_polca.diagrams.nodes import DONE, YIELDED, Int32Array, Int64Array
from factored_polca.minimisation.apart import relevant_features
from factored_polca.minimisation.criterion import ProcessView
from factored_polca.minimisation.listed_kernel import (
    BLOCKS,
    CHANGED,
    ENTRIES,
    PASSES,
    SHORT,
    list_weights,
    refine_listed,
    transpose,
)
from factored_polca.minimisation.outcomes import FlatDraws, make_draw
from factored_polca.minimisation.propagation import UNLIMITED, TooManyBlocks
from factored_polca.symbolic import SymbolicModel
from factored_polca.symbolic.forward import join_items

UInt64Array = npt.NDArray[np.uint64]

MAXIMUM_STATES = 1 << 23
"""States that are listed at most."""

MAXIMUM_ENTRIES = 1 << 26
"""Entries of M at most; two copies take 24 bytes an entry while one is made of the other."""

BYTES_PER_ENTRY, BYTES_PER_STATE = 24, 64

STEPS_PER_ENTRY = 2.0
"""Steps of the kernels over diagrams that take the time of listing and refining one entry, as measured."""

FEWEST_STEPS = 1 << 18
"""Steps that diagrams may take at least: loading the kernels for lists takes as long."""

CHUNK = 1 << 18
"""States that a diagram is evaluated at at once."""


@dataclass(frozen=True)
class StateList:
    """The relevant features, by level, their numbers of values, and a bound on the entries."""

    features: tuple[int, ...]
    sizes: tuple[int, ...]
    entries: int

    @property
    def states(self) -> int:
        """The number of states."""
        return prod(self.sizes)

    @property
    def strides(self) -> Int64Array:
        """What a value of each feature adds to the number of a state [feature]."""
        return np.array([prod(self.sizes[i + 1 :]) for i in range(len(self.sizes))], dtype=np.int64)

    @property
    def steps(self) -> int:
        """Steps over diagrams that take as long."""
        return max(FEWEST_STEPS, int(STEPS_PER_ENTRY * self.entries))

    @property
    def bytes(self) -> int:
        """What the arrays take at most."""
        return BYTES_PER_ENTRY * self.entries + BYTES_PER_STATE * self.states


def state_list(view: ProcessView, labels: Diagram) -> StateList | None:
    """What would be listed to refine `labels`; None where that is too much, or has observations."""
    process = view.process
    symbolic, manager = process.symbolic, labels.manager
    if view.sensed is not None or not process.choices:
        return None
    features = tuple(relevant_features(view, labels))
    sizes = tuple(manager.sizes[symbolic.now(i)] for i in features)
    if prod(sizes) > MAXIMUM_STATES:
        return None
    longest = {
        p: prod(
            max(sum(q != 0 for q in row) for row in symbolic.actions[p].rows[i].rows)
            for i in features
            if i in symbolic.actions[p].rows
        )
        for choice in process.choices
        for p in choice.primitives
    }
    entries = prod(sizes) * sum(
        max((longest[p] for p in choice.primitives), default=0) for choice in process.choices
    )
    found = StateList(features, sizes, entries)
    if entries > MAXIMUM_ENTRIES or manager.bytes + found.bytes > manager.memory_limit:
        return None
    return found


def evaluate_listed(symbolic: SymbolicModel, listed: StateList, diagram: Diagram) -> UInt64Array:
    """The payloads of a diagram, over the features listed, at all states [state]."""
    columns = symbolic.columns()
    result = np.empty(listed.states, dtype=np.uint64)
    table = np.zeros((min(CHUNK, listed.states), len(symbolic.model.features)), dtype=np.int32)
    for low in range(0, listed.states, CHUNK):
        numbers = np.arange(low, min(low + CHUNK, listed.states))
        for feature, size, stride in zip(listed.features, listed.sizes, listed.strides, strict=True):
            table[: len(numbers), feature] = numbers // stride % size
        result[low : low + CHUNK] = evaluate_states(diagram, table[: len(numbers)], columns)
    return result


@dataclass(frozen=True)
class ListedPartition:
    """A partition as a diagram and as a list: `block` [state]."""

    symbolic: SymbolicModel
    listed: StateList
    diagram: Diagram
    block: Int32Array

    def is_split_by(self, function: Diagram) -> bool:
        """Whether a function may differ within a block; it surely does unless it reads other features."""
        levels = {self.symbolic.now(feature) for feature in self.listed.features}
        if not levels.issuperset(support(function)):
            return True
        values = evaluate_listed(self.symbolic, self.listed, function)
        some = np.empty(int(self.block.max()) + 1, dtype=np.uint64)
        some[self.block] = values
        return not np.array_equal(values, some[self.block])


class ListedRefinement:
    """Refines a partition on a list of states; used as `propagation.Propagation` is.

    Args:
        view: the process in the field.
        listed: what is listed.
        labels: the partition, an index diagram onto 0 .. blocks - 1, all of them taken.
        draw: makes so many random elements, in stored form.
        allowed: stop beyond so many blocks.
        look: called now and then with the passes so far and the blocks.
        known: `labels` as a list, if there is one.
    """

    def __init__(
        self,
        view: ProcessView,
        listed: StateList,
        labels: Diagram,
        draw: Callable[[int], UInt64Array],
        *,
        allowed: int | None = None,
        look: Callable[[int, int], None] | None = None,
        known: ListedPartition | None = None,
    ) -> None:
        field = view.numbers.leaf_type
        assert isinstance(field, Field)
        self.view, self.field, self.listed, self.look = view, field, listed, look
        self.manager: Manager = view.numbers.manager
        self.symbolic = view.process.symbolic
        self.allowed = UNLIMITED if allowed is None else allowed
        self._labels: Diagram | None = labels
        if known is None or known.listed != listed or known.diagram != labels:
            self.block = evaluate_listed(self.symbolic, listed, labels).astype(np.int32)
        else:
            self.block = known.block.copy()
        blocks, states = int(self.block.max()) + 1, listed.states
        self._list_entries(draw)
        self.elements = draw(states)
        self.state = np.array([states, blocks, 0], dtype=np.int64)
        self.order = np.argsort(self.block, kind="stable").astype(np.int32)
        self.place = np.empty(states, dtype=np.int32)
        self.place[self.order] = np.arange(states, dtype=np.int32)
        ends = np.cumsum(np.bincount(self.block, minlength=blocks))
        self.begin, self.end = np.zeros((2, states), dtype=np.int32)
        self.end[:blocks] = ends
        self.begin[1:blocks] = ends[:-1]
        self.changed = np.arange(states, dtype=np.int32)
        self.delta = self.elements[self.block]
        self.acc = np.zeros(states, dtype=np.uint64)
        self.met, self.hits = np.zeros((2, states), dtype=np.int32)
        self.touched, self.blocks_hit = np.empty((2, states), dtype=np.int32)
        self.stack = np.zeros(160, dtype=np.int64)

    def _list_entries(self, draw: Callable[[int], UInt64Array]) -> None:
        """M by columns."""
        listed, manager = self.listed, self.manager
        choices = [choice for choice in self.view.process.choices if choice.primitives]
        features = len(self.symbolic.model.features)
        draws = _Draws(self.view, listed)
        masks = [self.view.app(choice) for choice in choices]
        apps = np.array([mask.node for mask in masks], dtype=np.int32)
        policies = np.array([0 if c.policy is None else c.policy.node for c in choices], dtype=np.int32)
        single = np.array([choice.primitives[0] for choice in choices], dtype=np.int64)
        factors, states = draw(len(choices)), listed.states
        first = np.zeros(states + 1, dtype=np.int64)
        room = min(listed.entries, 4 * states + 1024)
        target, weight = np.empty(room, dtype=np.int32), np.empty(room, dtype=np.uint64)
        row = np.zeros(2 * features, dtype=np.int32)
        entry, ends = np.zeros((2, len(draws.roots) + 1), dtype=np.int64)
        weights = np.zeros(len(draws.roots) + 1, dtype=np.uint64)
        codes = np.zeros(len(draws.roots) + 1, dtype=np.int64)
        stamp = np.full(states, -1, dtype=np.int32)
        state = np.zeros(2, dtype=np.int64)
        strides = np.zeros(features, dtype=np.int64)
        strides[list(listed.features)] = listed.strides
        while True:
            code = list_weights(
                manager.pool, manager.leaf_level, np.array([*self.symbolic.columns(), 0], dtype=np.int32),
                self.field.parameters, apps, policies, single, draws.local, factors, draws.first,
                draws.roots, draws.targets, draws.bases, draws.start, draws.value, draws.residue,
                np.array(listed.features, dtype=np.int64), np.array(listed.sizes, dtype=np.int64),
                listed.strides, strides, features, states, row, entry, ends, weights, codes, first, target,
                weight, stamp, state,
            )  # fmt: skip
            if code == DONE:
                break
            manager.pause()
            if code == SHORT:
                target, weight = (
                    np.concatenate([array, np.empty_like(array)]) for array in (target, weight)
                )
            else:
                assert code == YIELDED
        found = int(state[ENTRIES])
        self.column_first = np.zeros(states + 2, dtype=np.int64)
        self.source, self.weight = np.empty(found, dtype=np.int32), np.empty(found, dtype=np.uint64)
        transpose(first, target, weight, self.column_first, self.source, self.weight)

    @property
    def labels(self) -> Diagram:
        """The partition so far."""
        if self._labels is None:
            symbolic, listed, manager = self.symbolic, self.listed, self.manager
            leaves = manager.leaf_nodes(np.arange(self.blocks, dtype=np.uint64))
            levels = [symbolic.now(feature) for feature in listed.features]
            items = [np.arange(prod(listed.sizes[: i + 1]), dtype=np.int32) for i in range(len(levels))]
            self._labels = join_items(manager, levels, items, leaves[self.block], INDEX)
        return self._labels

    @property
    def partition(self) -> ListedPartition:
        """The partition so far; no more passes may follow."""
        return ListedPartition(self.symbolic, self.listed, self.labels, self.block)

    @property
    def blocks(self) -> int:
        """The number of blocks so far."""
        return int(self.state[BLOCKS])

    @property
    def passes(self) -> int:
        """The passes done."""
        return int(self.state[PASSES])

    def run(self, passes: int = UNLIMITED) -> bool:
        """Up to so many passes, fewer where nothing changes any more; answer whether a block was split.

        Raises:
            TooManyBlocks: there are more than allowed.
            Aborted: `labels` is the partition so far.
        """
        before = self.blocks
        end = min(self.passes + passes, UNLIMITED)
        while self.state[CHANGED] > 0 and self.passes < end:
            self._labels = None
            code = refine_listed(
                self.column_first, self.source, self.weight, self.field.parameters, self.order,
                self.place, self.begin, self.end, self.block, self.elements, self.changed, self.delta,
                self.acc, self.met, self.touched, self.hits, self.blocks_hit, self.stack, self.state,
                self.allowed, end,
            )  # fmt: skip
            if self.blocks > self.allowed:
                raise TooManyBlocks
            if code == YIELDED:
                self.manager.pause()
                if self.look is not None:
                    self.look(self.passes, self.blocks)
        return self.blocks > before


class _Draws(FlatDraws):
    """The draws of the relevant features, primitive after primitive.

    `local` [action] is the place of a primitive, `residue` [entry] the probabilities in the field.
    """

    def __init__(self, view: ProcessView, listed: StateList) -> None:
        symbolic = view.process.symbolic
        features = len(symbolic.model.features)
        primitives = sorted({p for choice in view.process.choices for p in choice.primitives})
        self.local = np.zeros(len(symbolic.actions) + 1, dtype=np.int64)
        self.local[primitives] = np.arange(len(primitives))
        drawn = [
            [
                action.rows[i]
                for i in reversed(action.elimination)
                if i in action.rows and i in listed.features
            ]
            for action in (symbolic.actions[p] for p in primitives)
        ]
        super().__init__([[make_draw(row, features + row.feature) for row in rows] for rows in drawn])
        entries = [q for rows in drawn for row in rows for chances in row.rows for q in chances if q]
        self.residue = view.numbers.stored(entries).astype(np.uint64)
