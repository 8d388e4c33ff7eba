"""The working state of `factored_polca.minimisation.pass_kernel`: arrays, growth, garbage collection.

What the kernel can't do is done here before each pass: regressions with synchronic arcs, and those with
observations.  Between two slices of a pass the manager looks for Ctrl-C and the deadline and makes room.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import INDEX, Diagram, Field, choose, node_count, relabel
from factored_polca.diagrams.apply import (
    CODE,
    KEY,
    LEFT_IDENTITY,
    OVERRIDE,
    PAIR,
    PAIR_TOUCHED,
    RIGHT_ABSORBING,
)
from factored_polca.diagrams.nodes import DONE, FULL, STEPS, YIELDED
from factored_polca.diagrams.operations import Walk, operator_row
from factored_polca.diagrams.operators import OPERATORS
from factored_polca.diagrams.sums import sum_options
from factored_polca.minimisation.criterion import Choice, ProcessView
from factored_polca.minimisation.pass_kernel import BEYOND, CHOICE, PAUSE, STEP, run_passes
from factored_polca.minimisation.race import Race
from factored_polca.minimisation.split_kernel import (
    BLOCKS,
    DIFFERENCE,
    NEXT,
    PARTITION,
    PASSES,
    ROOM,
    USED,
    shares,
)
from factored_polca.symbolic.descent import Cuts, Descents
from factored_polca.symbolic.regression import Prepared

UInt64Array = npt.NDArray[np.uint64]

UNLIMITED = 2**62

LARGE = 200
"""Nodes of V from which on it matters how it is regressed."""


class TooManyBlocks(RuntimeError):
    """The blocks are more than allowed."""


class Propagation:
    """Refines a partition by passes over the choices of a process, in one field and with one draw.

    Args:
        view: the process in the field, with its draws for observations.
        labels: the partition, an index diagram onto 0 .. blocks - 1, all of them taken.
        elements: r, a random element for each block, stored form [block].
        draw: makes so many random elements, in stored form.
        allowed: stop beyond so many blocks.
        look: called now and then with the passes so far and the blocks.
        race: tells how to regress all of V, in the first pass.
        cuts: keeps the cuts of rows from one field to the next.
    """

    def __init__(
        self,
        view: ProcessView,
        labels: Diagram,
        elements: UInt64Array,
        draw: Callable[[int], UInt64Array],
        *,
        allowed: int | None = None,
        look: Callable[[int, int], None] | None = None,
        race: Race | None = None,
        cuts: Cuts | None = None,
    ) -> None:
        field = view.numbers.leaf_type
        assert isinstance(field, Field)
        self.view, self.field, self.draw, self.look = view, field, draw, look
        self.manager, self.race = view.numbers.manager, race
        self.cuts: Cuts = {} if cuts is None else cuts
        self.zero, self.one = view.numbers.zero, view.numbers.one
        self.choices: Sequence[Choice] = view.process.choices
        self.numbers = np.array([len(elements), 0, 0, allowed or UNLIMITED, 0], dtype=np.int64)
        self.live = np.zeros(3, dtype=np.int32)
        self.handles: list[Diagram] = [labels, relabel(labels, elements, field), self.zero]
        self.work = np.zeros(8, dtype=np.int64)
        self.state = np.zeros(2, dtype=np.int64)
        self.walked = np.zeros(2, dtype=np.int64)
        self.sum_state = np.array([0, 0, STEPS], dtype=np.int64)
        self.progress = np.zeros(3, dtype=np.int64)
        self.counts = np.zeros(1, dtype=np.int64)
        sizes = self.manager.sizes
        inverses = [field.encode(pow(size, -1, field.prime)) for size in sizes]
        self.inverses = np.array([*inverses, field.encode(1)], dtype=np.uint64)
        self.unit = np.uint64(field.encode(1))
        self.factors = [
            self.manager.stored_constant(f, self.field) for f in draw(len(self.choices)).tolist()
        ]
        self.signatures = np.zeros(len(self.choices) + 1, dtype=np.int32)
        self.signature_handles: list[Diagram] = []
        self._list_choices()
        self._prepare_primitives()
        self._size_arrays(elements)
        self.steps_allowed = self.stop_at = UNLIMITED // 2
        self.collections = -1
        self._refresh()
        self._measure(labels)

    # -- what the kernel is given ------------------------------------------------------------------

    def _list_choices(self) -> None:
        """The masks m_cp, choice after choice."""
        first, primitives, self.masks = [0], [], []
        for choice in self.choices:
            app = self.view.app(choice)
            for primitive in choice.primitives:
                primitives.append(primitive)
                self.masks.append(choose(app & choice.where(primitive), self.one, self.zero))
            first.append(len(primitives))
        self.primitives = sorted(set(primitives))
        row = {primitive: number for number, primitive in enumerate(self.primitives)}
        self.choice_first = np.array(first, dtype=np.int64)
        self.choice_primitive = np.array([row[p] for p in primitives], dtype=np.int64)

    def _prepare_primitives(self) -> None:
        """The weights of the primitives that the kernel regresses itself; the others' numbers."""
        numbers, sensed = self.view.numbers, self.view.sensed
        levels = self.manager.leaf_level + 1
        self.first_weights = np.zeros((len(self.primitives), levels), dtype=np.int64)
        self.last_changed = np.full(len(self.primitives), -1, dtype=np.int64)
        self.keys = np.zeros(len(self.primitives), dtype=np.int64)
        self.weights: list[Diagram] = []
        actions = [numbers.symbolic.actions[primitive] for primitive in self.primitives]
        self.others = [n for n, a in enumerate(actions) if sensed is not None or a.synchronic]
        inside = [-1 if n in self.others else primitive for n, primitive in enumerate(self.primitives)]
        self.descents = Descents(numbers, inside, self.cuts)
        for number, (primitive, compiled) in enumerate(zip(self.primitives, actions, strict=True)):
            if number in self.others or not compiled.rows:
                continue
            if self.descents.few[number]:
                self.last_changed[number] = max(map(numbers.symbolic.now, compiled.rows))
                self.keys[number] = numbers.regression_key(primitive)
                continue
            prepared: Prepared = numbers.prepared(primitive)
            self.first_weights[number] = prepared.first + len(self.weights)
            self.last_changed[number] = prepared.last_changed
            self.keys[number] = prepared.key
            self.weights += prepared.handles
        self.regressed = np.zeros(len(self.primitives), dtype=np.int32)
        self.regressed_handles: dict[int, Diagram] = {}

    def _size_arrays(self, elements: UInt64Array) -> None:
        """Arrays over blocks and over the nodes of the store."""
        blocks = 2 * len(elements) + 1024
        self.elements = np.zeros(blocks, dtype=np.uint64)
        self.elements[: len(elements)] = elements
        self.block_shares = np.zeros(blocks, dtype=np.uint64)
        self.touched = np.zeros(blocks, dtype=np.uint64)
        self.largest = np.zeros(blocks, dtype=np.int32)
        self.fresh = self.draw(1024)
        levels, manager = self.manager.leaf_level + 3, self.manager
        widest = max((*manager.sizes, 2, int(np.diff(self.choice_first).max(initial=1)), len(self.choices)))
        self.terms = np.zeros(2 * widest * levels + 2, dtype=np.int32)
        self._size_node_arrays()

    def _size_node_arrays(self) -> None:
        room = len(self.manager.unique) // 2 + 2
        self.changed = np.zeros(room, dtype=np.int32)
        self.nodes = np.zeros(room, dtype=np.int32)
        self.images = np.zeros(room, dtype=np.int32)
        self.new_blocks = np.zeros(room, dtype=np.int32)
        self.exact = np.zeros(room, dtype=np.uint64)
        self.changes = np.zeros(room, dtype=np.uint64)
        self.rough = np.zeros(room, dtype=np.float64)

    def _more_room(self) -> None:
        """More of what the kernel found too short; it holds nothing in arrays over nodes then."""
        if len(self.nodes) <= self.manager.head[1]:
            self._size_node_arrays()
            return
        self.fresh = np.concatenate([self.fresh[self.numbers[USED] :], self.draw(2 * len(self.fresh))])
        self.numbers[USED] = 0
        missing = self.blocks + len(self.fresh) - len(self.elements)
        if missing > 0:
            for name in ("elements", "block_shares", "touched", "largest"):
                array = getattr(self, name)
                more = np.zeros(max(missing, len(array)), dtype=array.dtype)
                setattr(self, name, np.concatenate([array, more]))

    def _refresh(self) -> None:
        """Nodes for handles, after a collection."""
        manager = self.manager
        if self.collections == manager.collections:
            return
        self.sums = sum_options(manager, self.field, True)
        self.plain = sum_options(manager, self.field, False)
        zero = self.zero.node
        self.operators = np.zeros((3, 8), dtype=np.int64)
        self.operators[0, CODE], self.operators[0, KEY] = PAIR, PAIR_TOUCHED
        self.operators[0, RIGHT_ABSORBING] = zero
        self.operators[1, CODE] = self.operators[1, KEY] = OVERRIDE
        self.operators[1, LEFT_IDENTITY] = zero
        row = OPERATORS["plus", "field"]
        self.operators[2] = operator_row(manager, "plus", row, self.field, self.field)
        self.live[:] = [handle.node for handle in self.handles]
        self.weight_nodes = np.array([0, *(w.node for w in self.weights)], dtype=np.int32)[1:]
        self.mask_nodes = np.array([mask.node for mask in self.masks], dtype=np.int32)
        self.factor_nodes = np.array([factor.node for factor in self.factors], dtype=np.int32)
        self.descents.refresh()
        for number, handle in enumerate(self.signature_handles):
            self.signatures[number] = handle.node
        for number, handle in self.regressed_handles.items():
            self.regressed[number] = handle.node
        self.collections = manager.collections

    def _hold(self) -> None:
        """Handles for the nodes that the kernel holds, before a collection."""
        manager = self.manager
        self.handles = [
            manager.handle(int(self.live[PARTITION]), INDEX),
            manager.handle(int(self.live[DIFFERENCE]), self.field),
            manager.handle(int(self.live[NEXT]), self.field),
        ]
        self.regressed_handles = {
            int(number): manager.handle(int(self.regressed[number]), self.field)
            for number in np.flatnonzero(self.regressed)
        }
        self.signature_handles = [
            manager.handle(int(node), self.field) for node in self.signatures[: self.progress[0]]
        ]

    def _measure(self, labels: Diagram) -> None:
        """The share of each block."""
        walk = Walk(labels)
        count = len(walk.nodes)
        exact, rough = np.zeros(count, dtype=np.uint64), np.zeros(count)
        manager = self.manager
        shares(
            manager.pool, manager.arity, walk.nodes, count, self.inverses, self.field.parameters,
            self.unit, exact, rough,
        )  # fmt: skip
        self.block_shares[walk.leaf_payloads().astype(np.int64)] = exact[walk.is_leaf]

    # -- running it --------------------------------------------------------------------------------

    @property
    def labels(self) -> Diagram:
        """The partition so far."""
        return self.handles[PARTITION]

    @property
    def blocks(self) -> int:
        """The number of blocks so far."""
        return int(self.numbers[BLOCKS])

    @property
    def passes(self) -> int:
        """The passes done."""
        return int(self.numbers[PASSES])

    def run(self, passes: int = UNLIMITED) -> bool:
        """Up to so many passes, fewer where nothing changes any more; answer whether a block was split.

        It stops before the next pass when the kernels have taken `steps_allowed` steps.

        Raises:
            TooManyBlocks: there are more than allowed.
            MemoryLimit, Aborted: `labels` is the partition so far.
            Vanished: a draw for observations can't be used.
        """
        before = self.blocks
        self.stop_at = int(self.manager.head[2]) + self.steps_allowed
        end = self.passes + passes
        try:
            while self.passes < end and self.unfinished and self.manager.head[2] < self.stop_at:
                self._collect_if_due()
                self._regress_others()
                self._run_until(self.passes + 1 if self.others or self.regressed_handles else end)
        finally:
            self._hold()
        return self.blocks > before

    @property
    def unfinished(self) -> bool:
        """Whether something has changed that no pass has looked at."""
        return bool(self.live[DIFFERENCE] != self.zero.node)

    def _collect_if_due(self) -> None:
        if self.manager.head[0] > self.manager.collect_at:
            self._hold()
            self.manager.safe_point()
            self._refresh()

    def _regress_others(self) -> None:
        """R_p[D] for the primitives that the kernel does not regress."""
        self.regressed_handles = {}
        racing = self._racing()
        if not self.others and not racing:
            return
        self._hold()
        difference, numbers = self.handles[DIFFERENCE], self.view.numbers
        regress = numbers.regress if self.view.sensed is None else self.view.sensed.regress
        try:
            for number in self.others:
                self.regressed_handles[number] = regress(self.primitives[number], difference)
            for number in racing:
                assert self.race is not None
                result = self.race.regress(numbers, self.primitives[number], difference)
                if result is not None:
                    self.regressed_handles[number] = result
        finally:
            self._refresh()
        for number, handle in self.regressed_handles.items():
            self.regressed[number] = handle.node

    def _racing(self) -> list[int]:
        """The primitives for which it matters how V is regressed: in the first pass, where V is large."""
        if self.race is None or self.passes > 0 or self.view.sensed is not None:
            return []
        if node_count(self.handles[DIFFERENCE]) < LARGE:
            return []
        few = self.descents.few
        return [n for n in range(len(self.primitives)) if self.last_changed[n] >= 0 and not few[n]]

    def _run_until(self, end: int) -> None:
        """The kernel, until `end` passes are done or nothing changes any more."""
        m, d = self.manager, self.descents
        while True:
            code = run_passes(
                m.pool, m.head, m.unique, m.arity, m.cache, m.slots, m.ring, m.ring_state, m.stack,
                self.terms, m.results, m.words, self.sums, self.plain, self.operators,
                self.field.parameters, self.unit, self.inverses, self.weight_nodes, self.first_weights,
                self.last_changed, self.keys, self.choice_first, self.choice_primitive, self.mask_nodes,
                self.regressed, self.live, self.numbers, self.elements, self.block_shares, self.touched,
                self.largest, self.fresh, self.nodes, self.images, self.new_blocks, self.exact,
                self.changes, self.rough, self.changed, self.counts, self.sum_state, self.walked,
                self.state, self.work, self.progress, d.width, d.carried, d.roots, d.identity, d.fixed,
                d.base, d.last, d.first, d.value, d.weight, d.weight_nodes, d.frames, d.found, d.down,
                self.signatures, self.factor_nodes, m.collect_at, end,
            )  # fmt: skip
            if code == DONE:
                return
            if code == BEYOND:
                raise TooManyBlocks
            m.pause()
            if code == ROOM:
                self._more_room()
            elif code == FULL:
                m.grow()
            elif code == PAUSE:
                self._collect_if_due()
                if self.look is not None:
                    self.look(self.passes, self.blocks)
                if self.progress[CHOICE] == self.progress[STEP] == 0 and m.head[2] >= self.stop_at:
                    return
            else:
                assert code == YIELDED
