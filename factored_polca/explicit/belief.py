"""Beliefs: distributions over states, and how an action and an observation change them.

    P(o | b, a) = sum over s, t of b(s) K_a(s; t, o),
    b'(t)       = sum over s of b(s) K_a(s; t, o) / P(o | b, a)          (Bayes' rule)

Where part of the state is seen (mixed observability), what is seen after the action narrows b'
further; `split` gives the part of a belief for each number of `ArrayPOMDP.observed`.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from factored_polca.explicit.arrays import FloatArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP


class ImpossibleObservation(ValueError):
    """An observation that the belief and the action give the probability 0."""


def observation_probabilities(pomdp: ArrayPOMDP, belief: FloatArray, action: int) -> FloatArray:
    """P(o | b, a) for each observation [o]; they sum to the belief's mass at states that go on."""
    return np.array([float((belief @ matrix).sum()) for matrix in pomdp.kernel[action]])


def update(
    pomdp: ArrayPOMDP, belief: FloatArray, action: int, observation: int, seen: int | None = None
) -> tuple[FloatArray, float]:
    """The next belief [s] and the probability of what was observed.

    `seen` is the number of `observed` after the action, None where it is not told.

    Raises:
        ImpossibleObservation: its probability is 0.
    """
    mass = np.asarray(belief @ pomdp.kernel[action][observation], dtype=np.float64)
    if seen is not None:
        mass = np.where(pomdp.observed == seen, mass, 0.0)
    chance = float(mass.sum())
    if not chance > 0:
        name, label = pomdp.actions[action], pomdp.observations[action][observation]
        raise ImpossibleObservation(
            f"observation {label!r} is impossible after action {name!r} from this belief"
        )
    return mass / chance, chance


def split(pomdp: ArrayPOMDP, belief: FloatArray) -> Iterator[tuple[int, float, FloatArray]]:
    """What may be seen at a belief: (number of `observed`, its probability, the belief then)."""
    for seen in np.unique(pomdp.observed[belief > 0]).tolist():
        part = np.where(pomdp.observed == seen, belief, 0.0)
        chance = float(part.sum())
        yield seen, chance, part / chance
