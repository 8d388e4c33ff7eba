"""Walks: what one action makes of the blocks, pushed from states down the diagram of a partition P.

For a state x, an action a and the values o received from the channels that it senses,

    K_a(x; C', o) = sum over x' in C' of T(x, a, x') prod_j P_a(o_j | x', x)

is the mass that reaches the leaf C' of P where the next features are drawn in the order of its levels.
The *walk* of an action is a graph of places, each a position in the order, a node of P, and the values
of those next features that features or channels further down still depend on.  At a level that P skips
nothing is drawn, unless something depends on it.  The factor of a channel is multiplied in where its
last parent is drawn.  A parent that stands below its child in the order is guessed first: there is a
root for each of its values, and at its own level only the guessed one is drawn.  The walk does not
depend on x, nor on o; a feature that the action does not change has its value in x wherever it is read.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import Diagram, evaluate_states, support
from factored_polca.diagrams.jit import kernel
from factored_polca.diagrams.operations import leaf_payloads
from factored_polca.minimisation import Partition
from factored_polca.minimisation.push import RowTable, row_table
from factored_polca.models import LimitReached
from factored_polca.symbolic import RowDiagram, SymbolicModel

Int32Array = npt.NDArray[np.int32]
IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]
Rows = Mapping[int, RowDiagram]
Values = tuple[tuple[int, int], ...]  # pairs (feature, value number of its next value)

PLACES: Final = 1 << 20
"""Places that a walk may have."""


@dataclass(frozen=True)
class Walk:
    """The graph of places of one action; places are numbered level by level.

    `draws[s]` is a feature with the values of its parents among the next features, `weighings[w]` are
    channels with those of theirs; `at_once` are the channels that depend on x alone.  The edge
    `first[q] + v` leads from place q by value v to `child`, -1 where v was not guessed, and multiplies
    by weighing number `weighed`, -1: none.
    """

    symbolic: SymbolicModel
    rows: Rows
    channels: Rows
    table: RowTable
    draws: tuple[tuple[int, Values], ...]
    weighings: tuple[tuple[tuple[int, Values], ...], ...]
    at_once: tuple[int, ...]
    roots: Int32Array
    slot: Int32Array  # [place] -> number of its draw, -1 at the ends
    level: Int32Array  # [place] -> its position in the order, that of the ends being the last
    first: IntArray  # [place]
    child: Int32Array  # [edge]
    weighed: Int32Array  # [edge]
    leaf: IntArray  # [place] -> leaf of P, -1 but at the ends
    leaves: int

    def push(self, states: Int32Array, values: tuple[int, ...]) -> tuple[IntArray, IntArray, FloatArray]:
        """What reaches the leaves of P from `states` [state, feature].

        Args:
            values: those received from the channels, in their ascending order.

        Returns:
            where the leaves that each state reaches end [state], the leaves, and the mass of each.
        """
        received = dict(zip(sorted(self.channels), values, strict=True))
        chosen = np.empty((len(states), len(self.draws)), dtype=np.int32)
        for feature, members in self._draws_of.items():
            row = self.rows.get(feature)
            found = states[:, feature, None] if row is None else self._at(row.diagram, states, members)
            chosen[:, list(members)] = self.table.offset[feature] + found
        weight = np.ones((len(states), len(self.weighings)))
        scale = np.ones(len(states))
        for channel, row in self.channels.items():
            chances = np.array([float(r[received[channel]]) for r in row.rows])
            if channel in self.at_once:
                scale *= chances[self._at(row.diagram, states, {0: ()})[:, 0]]
            else:
                members = self._weighings_of[channel]
                weight[:, list(members)] *= chances[self._at(row.diagram, states, members)]
        return self._push(chosen, weight, scale)

    def _push(
        self, chosen: Int32Array, weight: FloatArray, scale: FloatArray
    ) -> tuple[IntArray, IntArray, FloatArray]:
        ends = np.zeros(len(chosen), dtype=np.int64)
        room = self.leaves + 16 * len(chosen)
        targets, masses = np.empty(room, dtype=np.int64), np.empty(room)
        done = 0
        while True:
            done = push_mass(
                self.roots, self.slot, self.level, self.first, self.child, self.weighed, self.leaf,
                self.table.start, self.table.value, self.table.probability, chosen, weight, scale,
                len(self.symbolic.order), ends, targets, masses, done,
            )  # fmt: skip
            if done == len(chosen):
                return ends, targets[: ends[-1]], masses[: ends[-1]]
            self.symbolic.manager.pause()
            targets = np.concatenate([targets, np.empty(room, dtype=np.int64)])
            masses = np.concatenate([masses, np.empty(room)])
            room *= 2

    @property
    def width(self) -> int:
        """Cells that `push` needs for each state."""
        most = max([1, *(len(members) for members in self._weighings_of.values()), len(self.draws)])
        return 2 * len(self.symbolic.order) * most

    @cached_property
    def _draws_of(self) -> dict[int, dict[int, Values]]:
        """For each feature its draws: the parents' values of each."""
        result: dict[int, dict[int, Values]] = {}
        for number, (feature, parents) in enumerate(self.draws):
            result.setdefault(feature, {})[number] = parents
        return result

    @cached_property
    def _weighings_of(self) -> dict[int, dict[int, Values]]:
        """For each channel the weighings that it takes part in: its parents' values in each."""
        result: dict[int, dict[int, Values]] = {}
        for number, members in enumerate(self.weighings):
            for channel, parents in members:
                result.setdefault(channel, {})[number] = parents
        return result

    def _at(self, diagram: Diagram, states: Int32Array, parents: Mapping[int, Values]) -> IntArray:
        """The leaves at (x, x') [state, member]: x' is x but for the values given to each member."""
        pairs = np.concatenate([states, states], axis=1)
        table = np.repeat(pairs[:, None, :], len(parents), axis=1)
        for number, values in enumerate(parents.values()):
            for feature, value in values:
                table[:, number, states.shape[1] + feature] = value
        flat = table.reshape(-1, table.shape[2])
        found = evaluate_states(diagram, flat, self.symbolic.columns()).astype(np.int64)
        return found.reshape(len(states), -1)


Key = tuple[int, int, Values]  # position, node, values carried


def make_walk(partition: Partition, rows: Rows, channels: Rows) -> Walk:
    """The walk down the diagram of a partition under the rows of an action.

    Raises:
        LimitReached: more than `PLACES` places.
    """
    return _Walking(partition, rows, channels).finish()


class _Walking:
    """A walk under construction; no operation on diagrams runs until it is finished."""

    def __init__(self, partition: Partition, rows: Rows, channels: Rows) -> None:
        symbolic = self.symbolic = partition.symbolic
        self.partition, self.rows, self.channels = partition, rows, channels
        self.place = symbolic.positions
        self.feature_at = sorted(range(len(self.place)), key=self.place.__getitem__)
        self.parents = {i: self.next_parents(row.diagram) for i, row in rows.items()}
        senses = {j: self.next_parents(row.diagram) for j, row in channels.items()}
        tested = {self.feature_at[level // 2] for level in support(partition.diagram)}
        self.needed = {i for found in senses.values() for i in found}
        waiting = [*tested, *self.needed]
        while waiting:
            fresh = set(self.parents.get(waiting.pop(), ())) - self.needed
            self.needed |= fresh
            waiting += fresh
        drawn = tested | self.needed
        links = [(p, i) for i in drawn for p in self.parents.get(i, ())]
        self.guessed = tuple(sorted({p for p, i in links if self.place[p] > self.place[i]}))
        self.weighed_at: dict[int, list[tuple[int, tuple[int, ...]]]] = {}
        for j, found in senses.items():
            if found:
                last = max(found, key=self.place.__getitem__)
                self.weighed_at.setdefault(last, []).append((j, found))
                links += [(p, last) for p in found]
        self.at_once = tuple(j for j, found in senses.items() if not found)
        self.last_use = {p: self.place[p] for p in self.guessed}
        for p, i in links:
            self.last_use[p] = max(self.last_use.get(p, -1), self.place[i])
        self.draws: dict[tuple[int, Values], int] = {}
        self.weighings: dict[tuple[tuple[int, Values], ...], int] = {}

    def next_parents(self, diagram: Diagram) -> tuple[int, ...]:
        """The features whose next values a diagram over (x, x') tests, of those that change."""
        last = 2 * len(self.feature_at)
        found = [self.feature_at[level // 2] for level in support(diagram) if level % 2 and level < last]
        return tuple(i for i in found if i in self.rows)

    def settle(self, place: int, node: int, carried: dict[int, int]) -> Key:
        """The next place from position `place` on where something is drawn."""
        manager = self.symbolic.manager
        level = int(manager.pool[node])
        top = level // 2 if level < manager.leaf_level else len(self.feature_at)
        while place < top and self.feature_at[place] not in self.needed:
            place += 1
        return place, node, tuple(sorted((p, v) for p, v in carried.items() if self.last_use[p] >= place))

    def expand(self, key: Key) -> Iterator[tuple[Key | None, int]]:
        """For each value of the feature drawn at a place: the place after it, and the weighing."""
        place, node, items = key
        feature, carried, pool = self.feature_at[place], dict(items), self.symbolic.manager.pool
        for value in range(len(self.symbolic.model.features[feature].values)):
            if carried.get(feature, value) != value:
                yield None, -1
                continue
            after = {**carried, feature: value}
            members = tuple(
                (j, tuple((p, after[p]) for p in found)) for j, found in self.weighed_at.get(feature, ())
            )
            weighing = self.weighings.setdefault(members, len(self.weighings)) if members else -1
            child = int(pool[node + 2 + value]) if pool[node] == 2 * place else node
            kept = after if feature in self.needed else carried
            yield self.settle(place + 1, child, kept), weighing

    def finish(self) -> Walk:
        symbolic, manager = self.symbolic, self.symbolic.manager
        sizes = [len(feature.values) for feature in symbolic.model.features]
        root = self.partition.diagram.node
        buckets: list[dict[Key, None]] = [{} for _ in range(len(sizes) + 1)]
        starts = []
        for values in itertools.product(*(range(sizes[p]) for p in self.guessed)):
            starts.append(self.settle(0, root, dict(zip(self.guessed, values, strict=True))))
            buckets[starts[-1][0]][starts[-1]] = None
        number: dict[Key, int] = {}
        slot: list[int] = []
        edges: list[list[tuple[Key | None, int]]] = []
        for bucket in buckets:
            for key in bucket:
                number[key] = len(number)
                if key[0] == len(sizes):
                    slot.append(-1)
                    edges.append([])
                    continue
                feature, carried = self.feature_at[key[0]], dict(key[2])
                draw = (feature, tuple((p, carried[p]) for p in self.parents.get(feature, ())))
                slot.append(self.draws.setdefault(draw, len(self.draws)))
                edges.append(list(self.expand(key)))
                buckets_after = [target for target, _ in edges[-1] if target is not None]
                for target in buckets_after:
                    buckets[target[0]][target] = None
            if len(number) > PLACES:
                raise LimitReached(f"more than {PLACES:,} places in the walk of an action", "tracking")
        ends = np.array([-1 if edges[q] else key[1] for q, key in enumerate(number)], dtype=np.int64)
        ends[ends >= 0] = leaf_payloads(manager, ends[ends >= 0].astype(np.int32)).astype(np.int64)
        child = [-1 if target is None else number[target] for found in edges for target, _ in found]
        return Walk(
            symbolic, self.rows, self.channels, row_table(symbolic, self.rows), tuple(self.draws),
            tuple(self.weighings), self.at_once,
            np.array([number[start] for start in starts], dtype=np.int32),
            np.array(slot, dtype=np.int32),
            np.array([place for place, _, _ in number], dtype=np.int32),
            np.cumsum([0, *map(len, edges)]).astype(np.int64),
            np.array(child, dtype=np.int32),
            np.array([weighing for found in edges for _, weighing in found], dtype=np.int32),
            ends, self.partition.blocks + self.partition.has_outside,
        )  # fmt: skip


@kernel
def push_mass(
    roots: Int32Array, slot: Int32Array, level: Int32Array, first: IntArray, child: Int32Array,
    weighed: Int32Array, leaf: IntArray, start: IntArray, value: Int32Array, probability: FloatArray,
    chosen: Int32Array, weight: FloatArray, scale: FloatArray, levels: int, ends: IntArray,
    targets: IntArray, masses: FloatArray, begin: int,
) -> int:  # fmt: skip
    """Push the mass scale[x] from the roots to the leaves, for each state x from `begin` on.

    Writes pairs (leaf, mass) and in ends[x] where those of x end; answers the first state for which
    there is no room.  The touched places of each level form a chain, so that others cost nothing.
    """
    mass = np.zeros(len(slot))
    top = np.full(levels + 1, -1, np.int64)
    below = np.full(len(slot), -1, np.int64)
    largest = 0
    for q in range(len(slot)):
        largest += slot[q] < 0
    count = ends[begin - 1] if begin > 0 else 0
    for x in range(begin, len(chosen)):
        if count + largest > len(targets):
            return x
        if scale[x] > 0.0:
            for j in range(len(roots)):
                if mass[roots[j]] == 0.0:
                    below[roots[j]] = top[level[roots[j]]]
                    top[level[roots[j]]] = roots[j]
                mass[roots[j]] += scale[x]
        for i in range(levels + 1):
            q = top[i]
            top[i] = -1
            while q >= 0:
                m = mass[q]
                mass[q] = 0.0
                if i == levels:
                    targets[count] = leaf[q]
                    masses[count] = m
                    count += 1
                    q = below[q]
                    continue
                row = chosen[x, slot[q]]
                for entry in range(start[row], start[row + 1]):
                    edge = first[q] + value[entry]
                    c = child[edge]
                    if c < 0:
                        continue
                    share = m * probability[entry]
                    if weighed[edge] >= 0:
                        share *= weight[x, weighed[edge]]
                    if share == 0.0:
                        continue
                    if mass[c] == 0.0:
                        below[c] = top[level[c]]
                        top[level[c]] = c
                    mass[c] += share
                q = below[q]
        ends[x] = count
    return len(chosen)
