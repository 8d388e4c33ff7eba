"""What may be observed after an action, and with which probability.

    P(o, y, e | b, a) = sum over x of b(x) sum over x' of T(x, a, x') prod_j P_a(o_j | x', x)
                        [x' looks like y] [terminal(x') = e]

for the values o of the channels that the action senses, what is seen y of the state, and e whether the
episode has ended; only what has a positive probability is listed, the likeliest first.  Particles estimate
it from one draw for each of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from math import prod
from typing import Final, TypeAlias

import numpy as np

from factored_polca.control.block_tracker import BlockBelief
from factored_polca.control.particle_tracker import ParticleBelief
from factored_polca.control.received import Received
from factored_polca.control.tracker import Belief
from factored_polca.diagrams import evaluate_states, leaves
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.models import Value

COMBINATIONS: Final = 1_000
"""Combinations of values above which they are not tried one by one."""

Numbers: TypeAlias = tuple[tuple[int, ...], tuple[int, ...], bool]
"""(values of the sensed channels, values of the observed features, ended)."""


@dataclass(frozen=True)
class Answer:
    """Something that may be observed: values by the names of channels and observed features."""

    observation: Mapping[str, Value]
    ended: bool
    probability: float


def can_end(belief: Belief) -> bool:
    """Whether the model has states where an episode has ended."""
    return any(leaf for leaf in leaves(belief.tracker.symbolic.terminal))


def answers(belief: Belief, action: int) -> list[Answer] | None:
    """What may be observed after action number `action`; None where that is too much to list."""
    reader, model = belief.tracker.reader, belief.tracker.symbolic.model
    channels = [model.observations[j] for j in reader.sensed[action]]
    features = [model.features[i] for i in reader.observed]
    spaces = [range(len(channel.values)) for channel in channels]
    sights = [range(len(feature.values)) for feature in features]
    found: dict[Numbers, float] = {}
    over_values = prod(map(len, spaces)) <= COMBINATIONS
    if isinstance(belief, BlockBelief) and over_values:
        for values in product(*spaces):
            _over_blocks(belief, action, values, found)
    elif isinstance(belief, ParticleBelief) and over_values:
        _by_particles(belief, action, list(product(*spaces)), found)
    elif prod(map(len, spaces + sights)) <= COMBINATIONS:
        ends = (False, True) if can_end(belief) else (False,)
        for values, seen, ended in product(product(*spaces), product(*sights), ends):
            try:
                after = belief.advance(Received(action, values, seen, ended))
            except ImpossibleObservation:
                continue
            found[values, seen, ended] = after.likelihood
    else:
        return None
    result = []
    for (values, seen, ended), chance in found.items():
        observation = {c.name: c.values[v] for c, v in zip(channels, values, strict=True)}
        observation |= {f.name: f.values[v] for f, v in zip(features, seen, strict=True)}
        result.append(Answer(observation, ended, chance))
    return sorted(result, key=lambda answer: -answer.probability)


def _over_blocks(
    belief: BlockBelief, action: int, values: tuple[int, ...], found: dict[Numbers, float]
) -> None:
    tracker = belief.tracker
    blocks, masses = tracker.rows(action, values).mix(belief.blocks, belief.weights)
    for block, mass in zip(blocks.tolist(), masses.tolist(), strict=True):
        key = (values, tuple(tracker.seen[block].tolist()), bool(tracker.terminal[block]))
        found[key] = found.get(key, 0.0) + mass


def _by_particles(
    belief: ParticleBelief, action: int, choices: list[tuple[int, ...]], found: dict[Numbers, float]
) -> None:
    tracker = belief.tracker
    drawing, compiled = tracker.drawing, tracker.symbolic.actions[action]
    generator = np.random.default_rng((belief.key, belief.step + 1, len(belief.states)))
    order = drawing.order_of(action)
    after, weights = drawing.draw(compiled.rows, order, belief.states, {}, generator)
    weights = weights * belief.weights
    table = np.concatenate([belief.states, after], axis=1)
    chances = [drawing.chances(compiled.observations[j], table) for j in tracker.reader.sensed[action]]
    ended = evaluate_states(tracker.symbolic.terminal, after, drawing.columns).astype(np.int32)
    sights = np.column_stack([after[:, list(tracker.reader.observed)], ended])
    kinds, place = np.unique(sights, axis=0, return_inverse=True)
    for values in choices:
        mass = weights.copy()
        for chance, value in zip(chances, values, strict=True):
            mass *= chance[:, value]
        for kind, total in zip(
            kinds.tolist(), np.bincount(place.reshape(-1), mass, len(kinds)).tolist(), strict=True
        ):
            if total > 0:
                found[values, tuple(kind[:-1]), bool(kind[-1])] = total
