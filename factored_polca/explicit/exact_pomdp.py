"""A model's POMDP by enumeration of its states and joint observations, in exact rationals.

States are numbered as in `enumeration`.  A joint observation is one value for each channel; for each
action a at a non-terminal state x

    K_a(x; x', o) = T(x, a, x') * prod_j P_a(o_j | x', x),
    R(x, a)       = sum over x', o of K_a(x; x', o) * sum of the terms' values at (x, x', o).

A channel that an action does not sense reports its null value.  A model without channels is blind:
its one joint observation is empty.  In a fully observed model every state is seen: `observed`
numbers all of them apart.  Otherwise it numbers the values of the features flagged `observed`
(mixed observability), the last running fastest.  Terminal states have empty rows and the reward 0.

Plain and slow on purpose: the oracle for `factored_polca.minimisation.unreduced`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeAlias

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import SparseMatrix
from factored_polca.explicit.enumeration import (
    MAXIMUM_STATES,
    ActionReader,
    Faults,
    condition_memo,
    conditions_at,
    initial_belief,
    list_states,
    reward_terms,
)
from factored_polca.explicit.evaluate import Assignment
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.models.features import Feature
from factored_polca.models.model import Action, Model, Observation
from factored_polca.models.scalars import Value, describe, scalar

JointRow: TypeAlias = dict[tuple[int, int], Fraction]
"""(next state, joint observation) -> positive probability."""

NOTHING = "nothing"
"""The label of the one observation of a blind process."""


@dataclass(frozen=True)
class ExactPOMDP:
    """A POMDP over numbered states in exact rationals; axes are a (action), s (state).

    `observations` are the joint observations that occur, one value for each channel;
    `observations_of[a]` the numbers of those that occur under a.  Rows of terminal states are empty.
    """

    features: tuple[Feature, ...]
    channels: tuple[Observation, ...]
    state_values: tuple[tuple[Value, ...], ...]  # [s], one value for each feature
    actions: tuple[str, ...]
    observations: tuple[tuple[Value, ...], ...]  # [o], one value for each channel
    observations_of: tuple[tuple[int, ...], ...]  # [a], ascending
    kernel: tuple[tuple[JointRow, ...], ...]  # [a][s]
    rewards: tuple[tuple[Fraction, ...], ...]  # [a][s]
    terminal: tuple[bool, ...]  # [s]
    observed: tuple[int, ...]  # [s], from 0
    initial: tuple[Fraction, ...]  # [s], sums to 1
    discount: Fraction
    horizon: int | None

    @property
    def states(self) -> int:
        """The number of states."""
        return len(self.state_values)

    def to_arrays(self) -> ArrayPOMDP:
        """The same POMDP in floating point; each action lists the observations that occur under it."""
        labels = [observation_label(self.channels, values) for values in self.observations]
        return array_pomdp(
            [
                [_sparse(rows, o) for o in numbers]
                for rows, numbers in zip(self.kernel, self.observations_of, strict=True)
            ],
            np.array(self.rewards, dtype=np.float64).reshape(len(self.actions), self.states),
            np.array(self.initial, dtype=np.float64),
            float(self.discount),
            actions=self.actions,
            observations=[[labels[o] for o in numbers] for numbers in self.observations_of],
            terminal=np.array(self.terminal, dtype=np.bool_),
            observed=np.array(self.observed, dtype=np.int64),
        )


def observation_label(channels: Sequence[Observation], values: Sequence[Value]) -> str:
    """A joint observation as `channel=value, channel=value`."""
    pairs = zip(channels, values, strict=True)
    return ", ".join(f"{c.name}={describe(scalar(value))}" for c, value in pairs) or NOTHING


def _sparse(rows: Sequence[JointRow], o: int) -> SparseMatrix:
    seen = [sorted((t, chance) for (t, number), chance in row.items() if number == o) for row in rows]
    starts = np.cumsum([0, *map(len, seen)])
    columns = np.array([t for row in seen for t, _ in row], dtype=np.int64)
    chances = np.array([float(chance) for row in seen for _, chance in row], dtype=np.float64)
    return csr_array((chances, columns, starts), shape=(len(rows), len(rows)))


def enumerate_pomdp(model: Model, *, maximum_states: int = MAXIMUM_STATES) -> ExactPOMDP:
    """The exact POMDP of `model`; a fully observed model's states are all told apart.

    Raises:
        ModelError: structural faults; those met where something has positive probability; and an
            action that does not apply at a non-terminal state: in a POMDP actions are total.
        LimitReached: the model has more than `maximum_states` states.
    """
    combinations, states = list_states(model, maximum_states)
    faults = Faults()
    ends = conditions_at(condition_memo(model, model.terminal), states, ("terminal",), faults)
    read = [_read_action(model, action, states, ends, faults) for action in model.actions]
    initial = initial_belief(model, states, faults)
    faults.raise_if_any()
    occurring = [sorted({o for row in rows for _, o in row}) for rows, _ in read]
    every = sorted({o for found in occurring for o in found})
    if not every:  # all states are terminal
        every = [(0,) * len(model.observations)]
        occurring = [every for _ in read]
    number = {o: index for index, o in enumerate(every)}
    return ExactPOMDP(
        features=model.features,
        channels=model.observations,
        state_values=combinations,
        actions=tuple(action.name for action in model.actions),
        observations=tuple(
            tuple(c.values[v] for c, v in zip(model.observations, o, strict=True)) for o in every
        ),
        observations_of=tuple(tuple(number[o] for o in found) for found in occurring),
        kernel=tuple(
            tuple({(t, number[o]): chance for (t, o), chance in row.items()} for row in rows)
            for rows, _ in read
        ),
        rewards=tuple(rewards for _, rewards in read),
        terminal=ends,
        observed=_observed(model, combinations),
        initial=initial,
        discount=model.discount,
        horizon=model.horizon,
    )


def _read_action(
    model: Model, action: Action, states: Sequence[Assignment], ends: Sequence[bool], faults: Faults
) -> tuple[list[dict[tuple[int, tuple[int, ...]], Fraction]], tuple[Fraction, ...]]:
    """The joint rows, observations as value numbers by channel, and the expected rewards."""
    reader = ActionReader(model, action, reward_terms(model, action), faults)
    path = ("actions", action.name, "applicable")
    applies = conditions_at(
        condition_memo(model, action.applicable),
        [state for state, ended in zip(states, ends, strict=True) if not ended],
        path,
        faults,
    )
    answers = iter(applies)
    rows: list[dict[tuple[int, tuple[int, ...]], Fraction]] = []
    rewards: list[Fraction] = []
    for state, ended in zip(states, ends, strict=True):
        joint: dict[tuple[int, tuple[int, ...]], Fraction] = {}
        row = None
        if not ended and not next(answers):
            faults.add(path, f"{action.name!r} does not apply; in a POMDP actions apply everywhere", state)
        elif not ended:
            row = reader.row(state)
        for t, chance in (row or {}).items():
            for o, share in (reader.observe(state, states[t]) or {}).items():
                joint[t, o] = chance * share
        rows.append(joint)
        rewards.append(reader.reward(state, row, states) if row else Fraction(0))
    return rows, tuple(rewards)


def _observed(model: Model, combinations: Sequence[tuple[Value, ...]]) -> tuple[int, ...]:
    """What is seen of each state, as a number."""
    if model.observability == "full":
        return tuple(range(len(combinations)))
    numbers = []
    for values in combinations:
        number = 0
        for feature, value in zip(model.features, values, strict=True):
            if feature.observed:
                digit = feature.index(value)
                assert digit is not None
                number = number * len(feature.values) + digit
        numbers.append(number)
    return tuple(numbers)
