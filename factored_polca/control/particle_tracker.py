"""Beliefs as weighted samples of states: a bootstrap filter.

Each particle x is moved to a next state drawn from T(x, a, .) and weighted with what was received,

    w' = w * prod_j P_a(o_j | x', x) * [terminal(x') = e] * prod_i P_a(x_i' = seen | parents),

i the observed features: they are not drawn but set to what is seen (likelihood weighting).  The sum of
the w' estimates the likelihood without bias.  Where the *effective* number of particles 1 / sum w^2
falls below half of them, they are resampled, systematically: one uniform number decides for all
(Gordon, Salmond & Smith 1993; Kitagawa 1996).

*Depletion.*  Where all weights are 0 the belief is rejuvenated: the episode's history is filtered again
from the start, with 4, 16 and 64 times as many particles.  If no particle explains the history even then,
it is impossible, or just too unlikely for so few: a sample can't tell these apart, and the error says so.

A belief draws from a generator of its own, seeded by the episode's key and the step: the same belief,
action and observation always give the same belief.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Final, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from factored_polca.control.received import Received
from factored_polca.control.tracker import (
    PARTICLES,
    TIE,
    Belief,
    FloatArray,
    OnImpossible,
    Rows,
    Tracker,
    summed,
)
from factored_polca.diagrams import Diagram, evaluate_states
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.minimisation import Partition
from factored_polca.minimisation.outcomes import parents_first
from factored_polca.models import ModelError, Value
from factored_polca.symbolic import RowDiagram, SymbolicModel

States: TypeAlias = npt.NDArray[np.int32]  # [particle, feature] value numbers
History: TypeAlias = Any
"""What was received, latest first: (received, the history before it); at the start (received, rows)."""

TRIES: Final = (4, 16, 64)
"""How many times as many particles a rejuvenation takes, one try after the other."""

RESAMPLE_BELOW: Final = 0.5
"""Part of the particles that must be effective."""


class Depleted(ImpossibleObservation):
    """No particle explains what was received: impossible, or too unlikely for so few particles."""


class ParticleTracker(Tracker):
    """Tracks a sample of `count` states.

    Args:
        seed: of the keys of episodes, which are drawn one after the other by `start`.

    Raises:
        ValueError: fewer than one particle.
    """

    kind: ClassVar[Literal["particles"]] = "particles"
    guarantee: ClassVar[Literal["statistical"]] = "statistical"

    def __init__(
        self,
        symbolic: SymbolicModel,
        count: int = PARTICLES,
        *,
        seed: int = 0,
        on_impossible: OnImpossible = "error",
    ) -> None:
        super().__init__(symbolic, on_impossible)
        if count < 1:
            raise ValueError(f"{count} particles; at least one is needed")
        self.count = count
        self.drawing = Drawing(symbolic)
        self._keys = np.random.default_rng(seed)

    def begin(self, initial: Rows, received: Received, *, narrow: bool = False) -> ParticleBelief:
        key = int(self._keys.integers(2**62))
        try:
            return self.first(initial, received, key, self.count)
        except Depleted:
            return self.rejuvenated((received, initial), key, 0)

    def first(self, initial: Rows, received: Received, key: int, count: int) -> ParticleBelief:
        """The belief at the start, of `count` particles."""
        generator = np.random.default_rng((key, 0, count))
        drawing = self.drawing
        nothing = np.zeros((count, drawing.features), dtype=np.int32)
        fixed = dict(zip(self.reader.observed, received.seen, strict=True))
        states, weights = drawing.draw(initial, drawing.order(initial), nothing, fixed, generator)
        return self.weighed(states, weights / count, received, key, 0, (received, initial))

    def step(self, belief: ParticleBelief, received: Received) -> ParticleBelief:
        """The belief after one action; its particles are as many as before."""
        generator = np.random.default_rng((belief.key, belief.step + 1, len(belief.states)))
        drawing, action = self.drawing, self.symbolic.actions[received.action]
        before, weights = belief.resampled(generator)
        fixed = dict(zip(self.reader.observed, received.seen, strict=True))
        order = drawing.order_of(received.action)
        after, chances = drawing.draw(action.rows, order, before, fixed, generator)
        weights = weights * chances
        table = np.concatenate([before, after], axis=1)
        for channel, value in zip(self.reader.sensed[received.action], received.values, strict=True):
            weights *= drawing.chances(action.observations[channel], table)[:, value]
        history = (received, belief.history)
        return self.weighed(after, weights, received, belief.key, belief.step + 1, history)

    def weighed(
        self,
        states: States,
        weights: FloatArray,
        received: Received,
        key: int,
        step: int,
        history: History,
    ) -> ParticleBelief:
        """The belief of the particles that go on, or have ended, as was received."""
        terminal = evaluate_states(self.symbolic.terminal, states, self.drawing.columns).astype(np.bool_)
        weights = np.where(terminal == received.ended, weights, 0.0)
        chance = float(weights.sum())
        if not chance > 0:
            raise Depleted(
                f"{self.impossible(received)}; or {len(states):,} particles are too few: a sample can't "
                "tell these apart; track more particles"
            )
        return ParticleBelief(
            tracker=self, likelihood=chance, ended=received.ended, states=states,
            weights=weights / chance, key=key, step=step, history=history,
        )  # fmt: skip

    def rejuvenated(self, history: History, key: int, step: int) -> ParticleBelief:
        """The belief after a history, filtered again with more particles, then as many as there were.

        The likelihood is that of the last step.
        """
        told: list[Received] = []
        rest = history
        for _ in range(step + 1):
            received, rest = rest
            told.append(received)
        for times in TRIES:
            try:
                belief = self.first(rest, told[-1], key, times * self.count)
                for received in reversed(told[:-1]):
                    belief = self.step(belief, received)
            except Depleted as error:
                problem = error
                continue
            chosen = systematic(belief.weights, self.count, np.random.default_rng((key, step, times)))
            even = np.full(self.count, 1 / self.count)
            return replace(belief, states=belief.states[chosen], weights=even, history=history)
        raise problem


@dataclass(frozen=True, eq=False, kw_only=True)
class ParticleBelief(Belief):
    """A weighted sample: `states` [n, feature] and their `weights` [n], which sum to 1.

    `key` names the episode and `step` counts its actions; `history` is what was received.
    """

    tracker: ParticleTracker
    states: States
    weights: FloatArray
    key: int
    step: int
    history: History

    @property
    def effective(self) -> float:
        """The effective number of particles, 1 / sum w^2: errors are about those of so many draws.

        Copies count as often as they are there: see `distinct`.
        """
        return float(1 / (self.weights**2).sum())

    @property
    def distinct(self) -> int:
        """The number of different states among the particles of positive weight."""
        return len(np.unique(self.states[self.weights > 0], axis=0))

    def advance(self, received: Received) -> ParticleBelief:
        try:
            return self.tracker.step(self, received)
        except Depleted:
            return self.tracker.rejuvenated((received, self.history), self.key, self.step + 1)

    def resampled(self, generator: np.random.Generator) -> tuple[States, FloatArray]:
        """The particles and weights to go on with."""
        count = len(self.states)
        if self.effective >= RESAMPLE_BELOW * count:
            return self.states, self.weights
        return self.states[systematic(self.weights, count, generator)], np.full(count, 1 / count)

    def _values(self, diagram: Diagram) -> npt.NDArray[np.int64]:
        return evaluate_states(diagram, self.states, self.tracker.drawing.columns).astype(np.int64)

    def project(self, partition: Partition) -> FloatArray:
        sums = summed(self._values(partition.diagram), self.weights, partition.blocks)
        if sums[partition.blocks :].any():
            raise ModelError("the partition leaves out states that the belief holds possible")
        return sums[: partition.blocks]

    def probability(self, condition: Diagram) -> float:
        return float(self.weights[self._values(condition) != 0].sum())

    def support_in(self, condition: Diagram) -> bool:
        return bool((self._values(condition)[self.weights > 0] != 0).all())

    def marginals(self) -> dict[str, FloatArray]:
        features = self.tracker.symbolic.model.features
        return {
            feature.name: summed(self.states[:, i].astype(np.int64), self.weights, len(feature.values))
            for i, feature in enumerate(features)
        }

    def most_likely(self) -> dict[str, Value]:
        order = np.argsort(self.tracker.symbolic.positions)  # as in the diagrams: ties go to the first
        found, place = np.unique(self.states[:, order], axis=0, return_inverse=True)
        mass = summed(place.reshape(-1).astype(np.int64), self.weights, len(found))
        digits = np.empty(len(order), dtype=np.int64)
        digits[order] = found[int(np.argmax(mass >= (1 - TIE) * mass.max()))]
        return self.tracker.state(digits)


def systematic(weights: FloatArray, count: int, generator: np.random.Generator) -> npt.NDArray[np.int64]:
    """`count` indices; i occurs count * weights[i] times, rounded up or down."""
    points = (generator.random() + np.arange(count)) / count
    ends = np.cumsum(weights)
    ends[np.flatnonzero(weights)[-1] :] = np.inf  # rounding: the last possible one takes the rest
    return np.searchsorted(ends, points, side="right").astype(np.int64)


class Drawing:
    """Draws next states and observations of many particles at once."""

    def __init__(self, symbolic: SymbolicModel) -> None:
        self.symbolic = symbolic
        self.features = len(symbolic.model.features)
        self.columns = symbolic.columns()
        self._orders: dict[int, list[int]] = {}
        self._tables: dict[int, tuple[RowDiagram, FloatArray]] = {}

    def order(self, rows: Rows) -> list[int]:
        """The features of `rows`, parents first."""
        return parents_first(rows)

    def order_of(self, action: int) -> list[int]:
        """The features that an action changes, parents first."""
        if action not in self._orders:
            self._orders[action] = self.order(self.symbolic.actions[action].rows)
        return self._orders[action]

    def chances(self, row: RowDiagram, table: States) -> FloatArray:
        """The row of each pair of states [n, value]; `table` is [n, (x, x')]."""
        if id(row) not in self._tables:
            self._tables[id(row)] = (row, np.array([[float(q) for q in r] for r in row.rows]))
        numbers = evaluate_states(row.diagram, table, self.columns).astype(np.int64)
        result: FloatArray = self._tables[id(row)][1][numbers]
        return result

    def draw(
        self,
        rows: Rows,
        order: Sequence[int],
        before: States,
        fixed: Mapping[int, int],
        generator: np.random.Generator,
    ) -> tuple[States, FloatArray]:
        """Next states [n, feature], features in `fixed` set to a value, and the weights of that [n]."""
        table = np.concatenate([before, before], axis=1)
        weights = np.ones(len(before))
        for i in order:
            chances = self.chances(rows[i], table)
            column = self.features + i
            if i in fixed:
                weights *= chances[:, fixed[i]]
                table[:, column] = fixed[i]
            else:
                table[:, column] = drawn(chances, generator)
        for i, value in fixed.items():
            if i not in rows:
                weights *= before[:, i] == value
        return np.ascontiguousarray(table[:, self.features :]), weights


def drawn(chances: FloatArray, generator: np.random.Generator) -> npt.NDArray[np.int32]:
    """A value for each distribution [n, value]."""
    ends = np.cumsum(chances, axis=1)
    last = chances.shape[1] - 1 - np.argmax(chances[:, ::-1] > 0, axis=1)
    found = (ends <= generator.random(len(chances))[:, None]).sum(axis=1)
    result: npt.NDArray[np.int32] = np.minimum(found, last).astype(np.int32)
    return result


def random_history(symbolic: SymbolicModel, steps: int, seed: int = 0) -> list[Received]:
    """What comes in along an episode of random actions: at the start, and after each action.

    The episode is over before `steps` actions where it ends.
    """
    generator = np.random.default_rng(seed)
    drawing, model = Drawing(symbolic), symbolic.model
    seen = [i for i, feature in enumerate(model.features) if feature.observed]

    def received(action: int, values: tuple[int, ...], state: States) -> Received:
        ended = bool(evaluate_states(symbolic.terminal, state, drawing.columns)[0])
        return Received(action, values, tuple(int(state[0, i]) for i in seen), ended)

    nothing = np.zeros((1, drawing.features), dtype=np.int32)
    initial = symbolic.initial
    state, _ = drawing.draw(initial, drawing.order(initial), nothing, {}, generator)
    result = [received(-1, (), state)]
    while len(result) <= steps and not result[-1].ended:
        number = int(generator.integers(len(symbolic.actions)))
        action = symbolic.actions[number]
        after, _ = drawing.draw(action.rows, drawing.order_of(number), state, {}, generator)
        table = np.concatenate([state, after], axis=1)
        channels = [drawing.chances(action.observations[j], table) for j in sorted(action.observations)]
        values = tuple(int(drawn(chances, generator)[0]) for chances in channels)
        state = after
        result.append(received(number, values, state))
    return result
