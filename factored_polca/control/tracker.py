"""Trackers: one belief for all subtasks of a plan, carried through an episode.

With b the belief before action a, o what was observed and e whether the episode has ended,

    b'(x') = [x' is as seen] [terminal(x') = e] sum over x of b(x) T(x, a, x') prod_j P_a(o_j | x', x) / c,

c, the *likelihood*, being the sum over x' of what stands before it (Bayes' rule; DESIGN 5).  What is
seen are the values of observed features (mixed observability), at the start too; that the episode goes
on or has ended is seen as well.

Three trackers do this.  *Blocks* and *diagram* are exact, *particles* is statistical:

    blocks     a vector over the blocks of a stable partition           (`block_tracker`)
    diagram    a product of decision diagrams over parts of the state   (`diagram_tracker`)
    particles  a weighted sample of states                              (`particle_tracker`)

A `Belief` is a value: `after` answers a new one.  An observation of probability 0 is an error, or
where that is declared (`on_impossible="reset"`) the belief becomes b0 narrowed to what is seen, and if
b0 does not allow that either, the uniform distribution over the states that are as seen.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, ClassVar, Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from factored_polca.control.received import ObservationReader, Received, shown, value_number
from factored_polca.diagrams import Aborted, Diagram, Manager, MemoryLimit, support
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.explicit.exact_pomdp import observation_label
from factored_polca.minimisation import Partition
from factored_polca.models import LimitReached, ModelError, Value
from factored_polca.models.model import rational
from factored_polca.symbolic import RowDiagram, SymbolicModel
from factored_polca.symbolic.reach import uniform_rows

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
Rows: TypeAlias = Mapping[int, RowDiagram]
OnImpossible: TypeAlias = Literal["error", "reset"]

BLOCK_LIMIT: Final = 10_000
"""Blocks up to which a belief is a vector over blocks, unless a caller says otherwise."""

BYTES_PER_BLOCK: Final = 20_000
"""Memory for diagrams that finding each block up to the limit may take."""

SPARE: Final = 64 << 20
"""Bytes for diagrams that tracking may take in any case."""

NODE_LIMIT: Final = 100_000
"""Nodes up to which a belief, or what comes between two, is a diagram, likewise."""

PARTICLES: Final = 10_000
"""States of a sample, likewise."""

TRIED_STEPS: Final = 20
"""Steps of the random history along which beliefs are tried as diagrams."""

TIE: Final = 1e-9
"""States or blocks within this fraction of the most likely one count as likely: the first is taken."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Belief(ABC):
    """What a tracker believes; a value.

    `likelihood` is the probability that the belief before gave to what came in (at the start, to what
    was seen), 0 after a reset; for particles it is estimated.  `ended`: the episode is over.
    """

    tracker: Tracker
    likelihood: float
    ended: bool
    was_reset: bool = False

    def after(self, action: int, observation: Mapping[str, Value], *, ended: bool = False) -> Belief:
        """The belief after action number `action` and what was observed.

        Args:
            observation: a value for each channel that the action senses and for each observed feature,
                by name; channels that it does not sense may be left out.
            ended: whether the episode has ended.

        Raises:
            ModelError: the episode had ended before; an unknown name or value, or a missing one.
            ImpossibleObservation: its probability is 0, and the tracker was not told to reset.
            LimitReached: the belief no longer fits (diagrams only).
        """
        if self.ended:
            raise ModelError("the episode has ended: no action follows; start another one")
        received = self.tracker.reader.read(action, observation, ended)
        try:
            if received.stray:
                raise ImpossibleObservation(received.stray)
            return self.advance(received)
        except ImpossibleObservation:
            if self.tracker.on_impossible == "error":
                raise
            return self.tracker.restart(received)

    @abstractmethod
    def advance(self, received: Received) -> Belief:
        """The next belief; see `after`."""

    @abstractmethod
    def project(self, partition: Partition) -> FloatArray:
        """The belief over the blocks of a partition [block].

        Raises:
            ModelError: the partition leaves out a state that may be, or the tracker knows too little
                (blocks only: it is not coarser than the tracker's).
        """

    @abstractmethod
    def probability(self, condition: Diagram) -> float:
        """The probability of a condition over states (leaves 0 and 1).

        Raises:
            ModelError: the tracker knows too little (blocks only).
        """

    @abstractmethod
    def support_in(self, condition: Diagram) -> bool:
        """Whether a condition holds at every state that may be; raises as `probability` does."""

    @abstractmethod
    def marginals(self) -> dict[str, FloatArray]:
        """For each feature the probability of each of its values [value].

        Features that a tracker over blocks does not tell apart are left out.
        """

    @abstractmethod
    def most_likely(self) -> dict[str, Value]:
        """The most likely state; over blocks, the first state of the most likely block."""


class Tracker(ABC):
    """Starts and carries beliefs of one model.

    `guarantee` is "exact" or "statistical".

    Raises:
        ModelError: the model is fully observed: there is no belief to track.
        ValueError: `on_impossible` is neither "error" nor "reset".
    """

    kind: ClassVar[Literal["blocks", "diagram", "particles"]]
    guarantee: ClassVar[Literal["exact", "statistical"]]

    def __init__(self, symbolic: SymbolicModel, on_impossible: OnImpossible = "error") -> None:
        refuse_fully_observed(symbolic)
        if on_impossible not in ("error", "reset"):
            raise ValueError(f"on_impossible is {on_impossible!r}; it can be 'error' or 'reset'")
        self.symbolic = symbolic
        self.on_impossible = on_impossible
        self.reader = ObservationReader(symbolic)

    def start(
        self,
        seen: Mapping[str, Value] | None = None,
        *,
        ended: bool = False,
        initial: Rows | None = None,
    ) -> Belief:
        """The belief at the start of an episode.

        Args:
            seen: the values of the observed features.
            ended: whether the episode is over before it began.
            initial: takes the place of the model's b0; see `independent_belief`.

        Raises:
            ModelError: an unknown name or value, or a missing one; an `initial` belief that gives some
                probability to states that the tracker leaves out.
            ImpossibleObservation: what is seen has the probability 0.
        """
        return self.begin(
            self.symbolic.initial if initial is None else initial,
            self.reader.read(-1, seen or {}, ended),
        )

    @abstractmethod
    def begin(self, initial: Rows, received: Received, *, narrow: bool = False) -> Belief:
        """The belief `initial` after what is seen; `narrow`: without the states that are left out."""

    def restart(self, received: Received) -> Belief:
        """The belief after a reset."""
        try:
            belief = self.begin(self.symbolic.initial, received)
        except ImpossibleObservation:
            belief = self.begin(uniform_rows(self.symbolic), received, narrow=True)
        return replace(belief, likelihood=0.0, was_reset=True)

    def state(self, digits: npt.NDArray[Any]) -> dict[str, Value]:
        """A state [feature] of value numbers as {feature: value}."""
        features = self.symbolic.model.features
        return {f.name: f.values[int(v)] for f, v in zip(features, digits, strict=True)}

    def impossible(self, received: Received) -> ImpossibleObservation:
        """The error that says what the belief gives the probability 0."""
        model = self.symbolic.model
        told = zip([model.features[i] for i in self.reader.observed], received.seen, strict=True)
        parts = [f"{feature.name}={shown(feature.values[v])}" for feature, v in told]
        seen = f"seeing {', '.join(parts)}" if parts else ""
        end = "the episode having ended" if received.ended else "the episode going on"
        if received.action < 0:
            text = f"at the start {' with '.join(filter(None, [seen, end]))} is impossible"
        else:
            name = model.actions[received.action].name
            sensed = [model.observations[j] for j in self.reader.sensed[received.action]]
            values = [c.values[v] for c, v in zip(sensed, received.values, strict=True)]
            what = f"observation {observation_label(sensed, values)!r}"
            rest = ", ".join(filter(None, [seen, end]))
            text = f"{what}, {rest}, is impossible after action {name!r} from this belief"
        return ImpossibleObservation(text)


def refuse_fully_observed(symbolic: SymbolicModel) -> None:
    """Refuse a model whose state is seen.

    Raises:
        ModelError: it is.
    """
    if symbolic.model.observability == "full":
        raise ModelError(
            f"{symbolic.model.name} is fully observed: its state is known, no belief is to be tracked"
        )


def tested_features(symbolic: SymbolicModel, diagrams: Iterable[Diagram]) -> list[str]:
    """The features that some diagram over states tests, or that are seen, in the model's order."""
    tested = {level for diagram in diagrams for level in support(diagram)}
    return [
        feature.name
        for number, feature in enumerate(symbolic.model.features)
        if feature.observed or symbolic.now(number) in tested
    ]


def summed(labels: IntArray, weights: FloatArray, count: int) -> FloatArray:
    """The weight of each of `count` labels, or of more where there are more."""
    result: FloatArray = np.bincount(labels, weights, minlength=count).astype(np.float64, copy=False)
    return result


@contextmanager
def limited_memory(manager: Manager, room: int, deadline: float | None = None) -> Iterator[None]:
    """Inside, diagrams take at most `room` bytes more, and `SPARE` of them in any case.

    `deadline` (a reading of `time.monotonic()`) takes the place of the manager's own.
    """
    before = manager.memory_limit, manager.deadline
    manager.memory_limit = min(before[0], manager.bytes + SPARE + room)
    manager.deadline = before[1] if deadline is None else deadline
    try:
        yield
    finally:
        manager.memory_limit, manager.deadline = before


# -- beliefs to start from -------------------------------------------------------------------------


def independent_belief(
    symbolic: SymbolicModel, distributions: Mapping[str, Mapping[Value, Fraction | float | str]]
) -> Rows:
    """A belief to start from: some features independent of all others, with the distributions given.

    The other features are distributed as in b0 given the features that they depend on there.  Values
    that are not mentioned have the probability 0; numbers are read exactly (0.1 is 1/10).

    Raises:
        ModelError: an unknown feature or value, or a distribution that does not sum to exactly 1.
    """
    model = symbolic.model
    rows = dict(symbolic.initial)
    numbers = {feature.name: i for i, feature in enumerate(model.features)}
    for name, distribution in distributions.items():
        if name not in numbers:
            raise ModelError(f"no feature {name!r}; there are {', '.join(numbers)}")
        values = model.feature(name).values
        row = [Fraction(0)] * len(values)
        for value, chance in distribution.items():
            row[value_number(name, values, value)] = rational(chance)
        if sum(row) != 1 or min(row) < 0:
            raise ModelError(f"the distribution of {name} sums to {sum(row)}; it must be one: sum to 1")
        rows[numbers[name]] = RowDiagram(numbers[name], symbolic.manager.constant(0), (tuple(row),))
    return rows


# -- the choice ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChosenTracker:
    """A tracker and why it was taken."""

    tracker: Tracker
    reason: str

    @property
    def kind(self) -> str:
        """The tracker's kind: blocks, diagram or particles."""
        return self.tracker.kind


def choose_tracker(
    symbolic: SymbolicModel,
    partitions: Sequence[Partition] = (),
    *,
    conditions: Sequence[Diagram] = (),
    features: Sequence[str] = (),
    reachable: Diagram | None = None,
    on_impossible: OnImpossible = "error",
    block_limit: int = BLOCK_LIMIT,
    node_limit: int = NODE_LIMIT,
    particles: int = PARTICLES,
    seed: int = 0,
    deadline: float | None = None,
) -> ChosenTracker:
    """The tracker that fits the model: over blocks, else as a diagram, else particles.

    Args:
        partitions: those of the subtasks, onto which beliefs shall be projected.
        conditions: over states, for example the subtasks' terminal sets (leaves 0 and 1).
        features: names of the features whose marginals are wanted whatever the blocks are.
        reachable: the states that the plan was made for (None: all).
        block_limit: blocks up to which the belief is a vector over them; 0 leaves blocks out.
        node_limit: nodes up to which it is a diagram, tried along a random history of
            `TRIED_STEPS` steps; 0 leaves diagrams out.
        particles: how many there are if it comes to them.
        seed: of random elements, of the history that is tried and of particles.
        deadline: a reading of `time.monotonic()` at which blocks, and then diagrams, are given up.

    Raises:
        ModelError: a fully observed model, or no such feature.
    """
    # These modules build on this one.
    from factored_polca.control.block_tracker import make_block_tracker
    from factored_polca.control.diagram_tracker import DiagramTracker, try_history
    from factored_polca.control.particle_tracker import ParticleTracker, random_history

    reasons = []
    if block_limit > 0:
        try:
            with limited_memory(symbolic.manager, BYTES_PER_BLOCK * block_limit, deadline):
                blocks = make_block_tracker(
                    symbolic, partitions, conditions=conditions, features=features, reachable=reachable,
                    block_limit=block_limit, seed=seed, on_impossible=on_impossible,
                )  # fmt: skip
            return ChosenTracker(blocks, f"the common refinement has {blocks.partition.blocks:,} blocks")
        except (LimitReached, MemoryLimit, Aborted) as error:
            reasons.append(f"no tracker over blocks: {error}")
    if node_limit > 0:
        try:
            with limited_memory(symbolic.manager, symbolic.manager.memory_limit, deadline):
                diagram = DiagramTracker(symbolic, node_limit=node_limit, on_impossible=on_impossible)
                largest = try_history(diagram, random_history(symbolic, TRIED_STEPS, seed))
            reasons.append(f"beliefs that were tried have up to {largest:,} nodes")
            return ChosenTracker(diagram, "; ".join(reasons))
        except (LimitReached, Aborted) as error:
            reasons.append(f"no belief as a diagram: {error}")
    tracker = ParticleTracker(symbolic, particles, seed=seed, on_impossible=on_impossible)
    reasons.append(f"{particles:,} particles")
    return ChosenTracker(tracker, "; ".join(reasons))
