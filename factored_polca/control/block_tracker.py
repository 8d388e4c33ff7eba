"""Beliefs over blocks: the exact filter on the common refinement of the subtasks' partitions.

The partition P is the coarsest one that tells apart what the subtasks' partitions, their terminal sets,
the observed features and the features to be shown tell apart, and that is stable (the paper's Eq. 13)
for every action of the model, rewards aside.  Then for each state x of a block C

    K_a(C; C', o) = sum over x' in C' of T(x, a, x') prod_j P_a(o_j | x', x)

is the same, and b'(C') = sum over C of b(C) K_a(C; C', o) / P(o | b, a) is the belief summed over
blocks, for any b0 (DESIGN 5, "Tracking").

Rows are made when they are first needed, for the blocks of the belief's support and the values that
were received, from the blocks' first states (`block_walk`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Final, Literal

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from factored_polca.control.block_walk import Walk, make_walk
from factored_polca.control.received import Received
from factored_polca.control.tracker import (
    TIE,
    Belief,
    FloatArray,
    IntArray,
    OnImpossible,
    Rows,
    Tracker,
    refuse_fully_observed,
    summed,
)
from factored_polca.diagrams import Diagram, evaluate_states, pairs
from factored_polca.diagrams.operations import leaf_payloads
from factored_polca.explicit.arrays import SparseMatrix
from factored_polca.minimisation import DecisionProcess, Partition, flat_process, minimise
from factored_polca.models import ModelError, Value
from factored_polca.symbolic import SymbolicModel, Term

Int32Array = npt.NDArray[np.int32]

CELLS: Final = 1 << 20
"""Cells of the arrays that are filled at once."""

ENTRIES: Final = 1 << 21
"""Entries of rows that are taken together at once."""

REMEMBERED: Final = 1 << 24
"""Entries of rows above which all are forgotten; they take 16 bytes each."""


def tracking_process(symbolic: SymbolicModel, reachable: Diagram | None = None) -> DecisionProcess:
    """What a tracker must preserve: all actions of the model and its terminal set, no rewards."""
    process = flat_process(symbolic, reachable=reachable)
    no_terms: tuple[Term, ...] = ()
    return replace(process, rewards=dict.fromkeys(process.rewards, no_terms))


def feature_diagram(symbolic: SymbolicModel, feature: int) -> Diagram:
    """The number of a feature's value as a function of the state."""
    manager = symbolic.manager
    values = range(len(symbolic.model.features[feature].values))
    return manager.variable(symbolic.now(feature), [manager.constant(v) for v in values])


def kept_apart(
    symbolic: SymbolicModel,
    partitions: Sequence[Partition],
    conditions: Sequence[Diagram],
    features: Sequence[str] = (),
) -> list[Diagram]:
    """What a partition to track with must tell apart: these things, and what is seen of the state."""
    shown = [i for i, f in enumerate(symbolic.model.features) if f.observed or f.name in features]
    separate = [partition.diagram for partition in partitions] + list(conditions)
    return separate + [feature_diagram(symbolic, i) for i in shown]


def make_block_tracker(
    symbolic: SymbolicModel,
    partitions: Sequence[Partition] = (),
    *,
    conditions: Sequence[Diagram] = (),
    features: Sequence[str] = (),
    reachable: Diagram | None = None,
    block_limit: int | None = None,
    seed: int = 0,
    on_impossible: OnImpossible = "error",
) -> BlockTracker:
    """The tracker over the coarsest stable partition that refines `partitions`.

    Args:
        conditions: over states, kept apart as well (leaves 0 and 1).
        features: names of features whose values are kept apart, so that marginals tell of them.
        reachable: a set of states that no action leaves; all others are left out.

    Raises:
        LimitReached: more blocks than allowed, or a walk with too many places.
        ModelError: a fully observed model, or no such feature.
    """
    refuse_fully_observed(symbolic)
    names = [feature.name for feature in symbolic.model.features]
    for name in features:
        if name not in names:
            raise ModelError(f"no feature {name!r}; there are {', '.join(names)}")
    separate = kept_apart(symbolic, partitions, conditions, features)
    process = tracking_process(symbolic, reachable)
    found = minimise(process, seed=seed, block_limit=block_limit, separate=separate)
    tracker = BlockTracker(found.partition, on_impossible)
    for action in range(len(symbolic.actions)):
        tracker.walk(action)
    return tracker


class BlockTracker(Tracker):
    """Tracks over a partition that is stable for all actions and tells observed features apart."""

    kind: ClassVar[Literal["blocks"]] = "blocks"
    guarantee: ClassVar[Literal["exact"]] = "exact"

    def __init__(self, partition: Partition, on_impossible: OnImpossible = "error") -> None:
        super().__init__(partition.symbolic, on_impossible)
        self.partition = partition
        symbolic = self.symbolic
        levels = partition.representatives[:, symbolic.now_levels]
        self.states: Int32Array = np.ascontiguousarray(levels)  # [block, feature]
        self.columns = symbolic.columns()
        self.terminal = evaluate_states(symbolic.terminal, self.states, self.columns).astype(np.bool_)
        self.seen = self.states[:, list(self.reader.observed)]  # [block, observed feature]
        self._walks: dict[int, Walk] = {}
        self._rows: dict[tuple[int, tuple[int, ...]], KernelRows] = {}
        self.remembered = 0  # entries of all of them together
        self._labels: dict[int, tuple[Diagram, IntArray]] = {}
        count = len(symbolic.model.features)
        self.feature_labels = [self.labels(feature_diagram(symbolic, i)) for i in range(count)]

    def begin(self, initial: Rows, received: Received, *, narrow: bool = False) -> BlockBelief:
        masses = self.begun if initial is self.symbolic.initial else self._spread(initial)
        count = self.partition.blocks
        if not narrow and masses[count:].sum() > 0:
            raise ModelError(
                "the belief gives some probability to states that were left out as unreachable"
            )
        blocks = np.flatnonzero(masses[:count] > 0)
        return self.narrowed(blocks, masses[blocks], received)

    def _spread(self, initial: Rows) -> FloatArray:
        """A belief over the leaves of the partition's diagram [leaf]."""
        nowhere = np.zeros_like(self.states[:1])
        _, reached, masses = make_walk(self.partition, initial, {}).push(nowhere, ())
        return summed(reached, masses, self.partition.blocks)

    @cached_property
    def begun(self) -> FloatArray:
        return self._spread(self.symbolic.initial)

    def narrowed(self, blocks: IntArray, masses: FloatArray, received: Received) -> BlockBelief:
        """The belief with `masses` at `blocks`, only what is as seen kept, normalised."""
        possible = self.terminal[blocks] == received.ended
        if received.seen:
            possible &= (self.seen[blocks] == received.seen).all(axis=1)
        if not possible.all():
            blocks, masses = blocks[possible], masses[possible]
        chance = float(masses.sum())
        if not chance > 0:
            raise self.impossible(received)
        return BlockBelief(
            tracker=self, likelihood=chance, ended=received.ended, blocks=blocks, weights=masses / chance
        )

    def walk(self, action: int) -> Walk:
        """The walk of an action down the partition's diagram."""
        if action not in self._walks:
            compiled = self.symbolic.actions[action]
            self._walks[action] = make_walk(self.partition, compiled.rows, compiled.observations)
        return self._walks[action]

    def rows(self, action: int, values: tuple[int, ...]) -> KernelRows:
        """The rows K_a(.; ., o) for the values received, as far as they are known."""
        key = (action, values)
        if self.remembered > REMEMBERED:
            self._rows.clear()
            self.remembered = 0
        if key not in self._rows:
            self._rows[key] = KernelRows(self, action, values)
        return self._rows[key]

    def labels(self, diagram: Diagram) -> IntArray:
        """The value of an index diagram in each block [block], -1 where it has several."""
        known = self._labels.get(id(diagram))
        if known is not None:
            return known[1]
        found = evaluate_states(diagram, self.states, self.columns).astype(np.int64)
        _, first, _ = pairs(self.partition.diagram, diagram)
        count = self.partition.blocks
        meets = np.bincount(leaf_payloads(self.symbolic.manager, first).astype(np.int64), minlength=count)
        found[meets[:count] > 1] = -1
        if len(self._labels) >= 256:
            self._labels.clear()
        self._labels[id(diagram)] = (diagram, found)  # which keeps the diagram, and so its id
        return found


@dataclass(frozen=True, eq=False, kw_only=True)
class BlockBelief(Belief):
    """A belief over blocks: `weights` [k] > 0 of the `blocks` [k], ascending; they sum to 1."""

    tracker: BlockTracker
    blocks: IntArray
    weights: FloatArray

    def advance(self, received: Received) -> BlockBelief:
        rows = self.tracker.rows(received.action, received.values)
        blocks, masses = rows.mix(self.blocks, self.weights)
        return self.tracker.narrowed(blocks, masses, received)

    def _labels(self, diagram: Diagram, what: str) -> IntArray:
        labels = self.tracker.labels(diagram)[self.blocks]
        if (labels < 0).any():
            raise ModelError(
                f"{what} divides a block of the tracker; pass it to `choose_tracker` in the first place"
            )
        return labels

    def project(self, partition: Partition) -> FloatArray:
        labels = self._labels(partition.diagram, "the partition")
        result = summed(labels, self.weights, partition.blocks)
        if result[partition.blocks :].any():
            raise ModelError("the partition leaves out states that the belief holds possible")
        return result[: partition.blocks]

    def probability(self, condition: Diagram) -> float:
        labels = self._labels(condition, "the condition")
        return float(self.weights[labels != 0].sum())

    def support_in(self, condition: Diagram) -> bool:
        return bool((self._labels(condition, "the condition") != 0).all())

    def marginals(self) -> dict[str, FloatArray]:
        result = {}
        tracker = self.tracker
        for number, feature in enumerate(tracker.symbolic.model.features):
            labels = tracker.feature_labels[number][self.blocks]
            if (labels >= 0).all():
                result[feature.name] = summed(labels, self.weights, len(feature.values))
        return result

    def most_likely(self) -> dict[str, Value]:
        place = int(np.argmax(self.weights >= (1 - TIE) * self.weights.max()))
        return self.tracker.state(self.tracker.states[self.blocks[place]])


# -- rows ------------------------------------------------------------------------------------------


class KernelRows:
    """The rows of K_a(.; ., o) for one action and one observation, made as they are asked for."""

    def __init__(self, tracker: BlockTracker, action: int, values: tuple[int, ...]) -> None:
        self._tracker, self._walk, self._values = tracker, tracker.walk(action), values
        self._count = tracker.partition.blocks
        self._forget()
        tracker.remembered += self._count

    def mix(self, blocks: IntArray, weights: FloatArray) -> tuple[IntArray, FloatArray]:
        """sum over C of weights[C] K_a(C; ., o): the next blocks, ascending, and their masses > 0."""
        step = max(1, ENTRIES // self._count)
        total = self._mixed(blocks[:step], weights[:step])
        for low in range(step, len(blocks), step):
            total = total + self._mixed(blocks[low : low + step], weights[low : low + step])
        reached = np.flatnonzero(total)
        return reached, total[reached]

    def matrix(self) -> SparseMatrix:
        """All rows as a CSR array [block, next block]."""
        missing = np.flatnonzero(self._place < 0)
        if len(missing):
            self._extend(missing)
        shape = (len(self._start) - 1, self._count)
        return csr_array((self._masses, self._blocks, self._start), shape=shape)[self._place]

    def _mixed(self, blocks: IntArray, weights: FloatArray) -> FloatArray:
        """The mass of each next block [block]."""
        place = self._place[blocks]
        if place.min() < 0:
            if len(self._blocks) > REMEMBERED // 4:
                self._forget()
                place = self._place[blocks]
            self._extend(blocks[place < 0])
            place = self._place[blocks]
        first = self._start[place]
        lengths = self._start[place + 1] - first
        ends = np.cumsum(lengths)
        entries = np.arange(ends[-1]) + np.repeat(first - ends + lengths, lengths)
        masses = np.repeat(weights, lengths) * self._masses[entries]
        return summed(self._blocks[entries], masses, self._count)

    def _forget(self) -> None:
        self._place = np.full(self._count, -1, dtype=np.int32)  # [block] -> row
        self._start = np.zeros(1, dtype=np.int64)  # [row]
        self._blocks = np.empty(0, dtype=np.int64)
        self._masses = np.empty(0)

    def _extend(self, blocks: IntArray) -> None:
        """Make the rows of `blocks`."""
        step = max(1, CELLS // self._walk.width)
        starts, targets, masses = [self._start], [self._blocks], [self._masses]
        for low in range(0, len(blocks), step):
            part = blocks[low : low + step]
            self._tracker.symbolic.manager.pause()
            ends, reached, pushed = self._walk.push(self._tracker.states[part], self._values)
            if reached.max(initial=-1) >= self._count:
                raise ModelError(
                    "an action leads out of the states that were not left out; `reachable` must hold all "
                    "that every action of the model leads to"
                )
            starts.append(starts[-1][-1] + ends)
            targets.append(reached)
            masses.append(pushed)
        self._place[blocks] = len(self._start) - 1 + np.arange(len(blocks))
        before = len(self._blocks)
        self._start = np.concatenate(starts)
        self._blocks, self._masses = np.concatenate(targets), np.concatenate(masses)
        self._tracker.remembered += len(self._blocks) - before
