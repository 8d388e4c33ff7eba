"""pomdp-py (Zheng & Tellex 2020; the extra `pomdp-py`) both ways.

- `agent_of`: a POMDP as an `Agent`, on which planners of pomdp-py run (POUCT, POMCP, value iteration).
- `arrays_of`: an `Agent` whose states, actions and observations can be listed as an `ArrayPOMDP`, which our
  solvers take.
- `PolicyPlanner`: a policy of ours as a `Planner` of theirs, for an agent made by `agent_of`.

A model of pomdp-py has T(s' | s, a) and O(o | s', a), and no end. States are split where that needs it,
what is seen of a state is part of the observation, and all terminal states are one that is never left and
earns nothing (`array_files`). Rewards there are a function of (s, a, s'), here its expectation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.arrays import FloatArray
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.external.array_files import FactoredRows, factored_rows
from factored_polca.models.errors import ModelError

try:
    import pomdp_py
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(f"{error}: pip install 'factored-polca[pomdp-py]'") from error


@dataclass(frozen=True)
class Translation:
    """An agent with the lists that its numbers refer to."""

    agent: Any
    states: tuple[Any, ...]  # [i]
    actions: tuple[Any, ...]  # [a]
    observations: tuple[Any, ...]  # [z]
    rows: FactoredRows
    original: ArrayPOMDP

    def belief(self, distribution: Any) -> FloatArray:
        """A belief of pomdp-py, by its probabilities, over our states [s]."""
        result = np.zeros(self.original.states)
        chances = [float(distribution[state]) for state in self.states]
        np.add.at(result, self.rows.owner, chances)
        return result


def agent_of(pomdp: ArrayPOMDP, *, seed: int = 0) -> Translation:
    """`pomdp` as an agent whose belief is a histogram; `seed` of what its models sample.

    Raises:
        LimitReached: more entries than may be listed.
    """
    rows, random = factored_rows(pomdp), np.random.default_rng(seed)
    states = tuple(pomdp_py.SimpleState(i) for i in range(rows.rewards.shape[1]))
    actions = tuple(pomdp_py.SimpleAction(name) for name in pomdp.actions)
    observations = tuple(pomdp_py.SimpleObservation(z) for z in range(rows.shows[0].shape[1]))
    start = np.zeros(len(states))
    np.add.at(start, rows.place, pomdp.initial)
    tables = _Tables(rows, states, actions, observations, random)
    agent = pomdp_py.Agent(
        pomdp_py.Histogram(dict(zip(states, start.tolist(), strict=True))),
        _Policy(tables), _Transitions(tables), _Observations(tables), _Rewards(tables),
    )  # fmt: skip
    return Translation(agent, states, actions, observations, rows, pomdp)


@dataclass(frozen=True)
class _Tables:
    """What the models of one agent share."""

    rows: FactoredRows
    states: Sequence[Any]
    actions: Sequence[Any]
    observations: Sequence[Any]
    random: np.random.Generator

    def action(self, action: Any) -> int:
        return next(number for number, known in enumerate(self.actions) if known == action)

    def drawn(self, chances: FloatArray) -> int:
        return int(self.random.choice(len(chances), p=chances / chances.sum()))


class _Transitions(pomdp_py.TransitionModel):  # type: ignore[misc]
    def __init__(self, tables: _Tables) -> None:
        self.tables = tables

    def probability(self, next_state: Any, state: Any, action: Any) -> float:
        move = self.tables.rows.moves[self.tables.action(action)]
        return float(move[state.data, next_state.data])

    def sample(self, state: Any, action: Any) -> Any:
        move = self.tables.rows.moves[self.tables.action(action)]
        return self.tables.states[self.tables.drawn(move[[state.data]].toarray()[0])]

    def get_all_states(self) -> list[Any]:
        return list(self.tables.states)


class _Observations(pomdp_py.ObservationModel):  # type: ignore[misc]
    def __init__(self, tables: _Tables) -> None:
        self.tables = tables

    def probability(self, observation: Any, next_state: Any, action: Any) -> float:
        return float(self.tables.rows.shows[self.tables.action(action)][next_state.data, observation.data])

    def sample(self, next_state: Any, action: Any) -> Any:
        show = self.tables.rows.shows[self.tables.action(action)]
        return self.tables.observations[self.tables.drawn(show[next_state.data])]

    def get_all_observations(self) -> list[Any]:
        return list(self.tables.observations)


class _Rewards(pomdp_py.RewardModel):  # type: ignore[misc]
    def __init__(self, tables: _Tables) -> None:
        self.tables = tables

    def sample(self, state: Any, action: Any, next_state: Any) -> float:
        del next_state  # R(s, a) is an expectation over it
        return float(self.tables.rows.rewards[self.tables.action(action), state.data])


class _Policy(pomdp_py.RolloutPolicy):  # type: ignore[misc]
    """All actions, at random."""

    def __init__(self, tables: _Tables) -> None:
        self.tables = tables

    def get_all_actions(self, state: Any = None, history: Any = None) -> list[Any]:
        return list(self.tables.actions)

    def sample(self, state: Any) -> Any:
        return self.tables.actions[int(self.tables.random.integers(len(self.tables.actions)))]

    def rollout(self, state: Any, history: Any = None) -> Any:
        return self.sample(state)


class PolicyPlanner(pomdp_py.Planner):  # type: ignore[misc]
    """A map from beliefs to actions as a planner for the agent of a `Translation`."""

    def __init__(self, translation: Translation, policy: AlphaVectors | EntropyPolicy) -> None:
        self.translation, self.policy = translation, policy

    def plan(self, agent: Any) -> Any:
        """The action of the policy at the agent's belief."""
        belief = self.translation.belief(agent.belief)
        return self.translation.actions[int(self.policy.choose(belief[None, :])[0])]


def arrays_of(agent: Any, discount: float) -> ArrayPOMDP:
    """An agent as arrays: states, actions and observations in the order that it lists them.

    Rewards are taken to be a function of (s, a, s'); each is sampled once.

    Raises:
        ModelError: something that can't be listed, or probabilities that are none.
    """
    try:
        states, actions = list(agent.all_states), list(agent.all_actions)
        observations = list(agent.all_observations)
    except NotImplementedError as error:
        raise ModelError("the agent's states, actions or observations can't be listed") from error
    kernel, rewards = [], np.zeros((len(actions), len(states)))
    for a, action in enumerate(actions):
        move = _table(lambda s, t, u=action: agent.transition_model.probability(t, s, u), states, states)
        show = _table(
            lambda t, o, u=action: agent.observation_model.probability(o, t, u), states, observations
        )
        for i, state in enumerate(states):
            for j in np.flatnonzero(move[i]).tolist():
                rewards[a, i] += move[i, j] * float(agent.reward_model.sample(state, action, states[j]))
        kernel.append([csr_array(move * show[None, :, o]) for o in range(len(observations))])
    start = np.array([float(agent.belief[state]) for state in states])
    names = [[str(observation) for observation in observations]] * len(actions)
    return array_pomdp(
        kernel,
        rewards,
        start / start.sum(),
        discount,
        actions=[str(a) for a in actions],
        observations=names,
    )


def _table(probability: Any, rows: Sequence[Any], columns: Sequence[Any]) -> FloatArray:
    """Rows of probabilities, divided by their sums."""
    table = np.array([[float(probability(r, c)) for c in columns] for r in rows], dtype=np.float64)
    sums = table.sum(axis=1, keepdims=True)
    if not np.all(table >= 0) or not np.all(np.abs(sums - 1) <= 1e-6):
        raise ModelError(
            f"probabilities that sum to {float(sums.min()):.6g} .. {float(sums.max()):.6g}, not 1"
        )
    divided: FloatArray = table / sums
    return divided
