"""Simulation of a policy on arrays: states are drawn, beliefs are tracked exactly.

    s_0 ~ b0;   a_t by the policy;   (s_{t+1}, o) ~ K_a(s_t; ., .);   earned: sum_t gamma^t R(a_t, s_t)

R(a, s) is the expected reward of the step, so returns vary less than those of runs that draw rewards
too, and have the same mean.  The belief after a step is Bayes' rule over what was observed, over what is
seen of the state (`ArrayPOMDP.observed`, at the start included), and over the process going on: an
episode in a terminal state has ended.

A policy graph needs no belief: each episode has a node.  A `StatePolicy` reads the state itself.
Where it has no action the episode ends (a dead end), as does one whose graph has no node for a state
from which nothing is ever earned.

Letters: n an episode of a chunk, s a state, y what is seen of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from scipy.sparse import csr_array, hstack

from factored_polca.explicit.alpha_vectors import AlphaVectors, StagedVectors
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray, SparseMatrix
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.policies import AnyPolicy, horizon_of
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.models import ModelError
from factored_polca.simulation.simulate import Simulation, default_steps

BELIEF_NUMBERS: Final = 1 << 22
"""Entries of the beliefs that are kept at once: more episodes are run one chunk after the other."""


def simulate_policy(
    pomdp: ArrayPOMDP,
    policy: AnyPolicy,
    *,
    episodes: int = 1000,
    steps: int | None = None,
    seed: int = 0,
) -> Simulation:
    """Run `policy` from `pomdp.initial`; a policy for a finite horizon runs for just that many steps.

    Raises:
        ValueError: fewer than one episode or step.
        ModelError: other steps than the policy's horizon, or a policy graph that does not know what to
            do after something that may be observed.
    """
    if episodes < 1 or (steps is not None and steps < 1):
        raise ValueError("episodes and steps must be at least 1")
    horizon = horizon_of(policy)
    if horizon is not None and steps not in (None, horizon):
        raise ModelError(f"the policy is for {horizon} steps, it can't be run for {steps}")
    length = horizon or steps or default_steps(pomdp.discount)
    generator = np.random.default_rng(seed)
    dynamics = _Dynamics(pomdp)
    chunks = [
        _run(dynamics, policy, count, length, generator) for count in _chunks(pomdp, policy, episodes)
    ]
    returns = np.concatenate([chunk.returns for chunk in chunks])
    ended = sum(chunk.ended for chunk in chunks)
    error = float(returns.std(ddof=1) / math.sqrt(episodes)) if episodes > 1 else math.nan
    left = 0.0 if ended == episodes or horizon is not None else math.inf
    if left and pomdp.discount < 1:
        left = pomdp.discount**length / (1 - pomdp.discount) * max(chunk.largest for chunk in chunks)
    return Simulation(float(returns.mean()), error, episodes, length, ended, left, returns)


def _chunks(pomdp: ArrayPOMDP, policy: AnyPolicy, episodes: int) -> Iterator[int]:
    """How many episodes are run at once."""
    width = 1 if isinstance(policy, (StatePolicy, PolicyGraph)) else pomdp.states
    most = max(1, BELIEF_NUMBERS // width)
    for first in range(0, episodes, most):
        yield min(most, episodes - first)


class _Dynamics:
    """The kernel, ready for drawing: for each action one matrix [s, (o, t)] and its running sums."""

    def __init__(self, pomdp: ArrayPOMDP) -> None:
        self.pomdp = pomdp
        self.joint = [csr_array(hstack(row, format="csr")) for row in pomdp.kernel]
        for matrix in self.joint:
            matrix.eliminate_zeros()
        self.sums = [np.concatenate([[0.0], np.cumsum(matrix.data)]) for matrix in self.joint]
        self.worthless = _worthless(pomdp, self.joint)
        self.classes = int(pomdp.observed.max()) + 1

    def step(self, action: int, states: IntArray, uniform: FloatArray) -> tuple[IntArray, IntArray]:
        """The observation [n] and the next state [n] where `action` is taken in `states` [n]."""
        matrix, sums = self.joint[action], self.sums[action]
        first, last = matrix.indptr[states].astype(np.int64), matrix.indptr[states + 1].astype(np.int64)
        if np.any(first == last):
            name = self.pomdp.actions[action]
            raise ModelError(f"the policy takes {name!r} where it does not apply")
        target = sums[first] + uniform * (sums[last] - sums[first])
        entry = np.clip(np.searchsorted(sums, target, side="right") - 1, first, last - 1)
        column = matrix.indices[entry].astype(np.int64)
        return column // self.pomdp.states, column % self.pomdp.states


def _worthless(pomdp: ArrayPOMDP, joint: list[SparseMatrix]) -> BoolArray:
    """[s] the states from which nothing is ever earned: the largest closed set without reward."""
    found: BoolArray = pomdp.terminal | np.all(pomdp.rewards == 0, axis=0)
    while True:
        leaves = np.zeros(pomdp.states, dtype=np.bool_)
        away = (~found).astype(np.float64)
        for matrix, row in zip(joint, pomdp.kernel, strict=True):
            leaves |= np.asarray(matrix @ np.tile(away, len(row))) > 0
        if not np.any(leaves & found):
            return found
        found = found & ~leaves


@dataclass
class _Chunk:
    """What a chunk of episodes earned."""

    returns: FloatArray  # [n]
    ended: int
    largest: float  # the largest |reward| met


def _run(
    dynamics: _Dynamics, policy: AnyPolicy, count: int, length: int, generator: np.random.Generator
) -> _Chunk:
    pomdp = dynamics.pomdp
    states = generator.choice(pomdp.states, size=count, p=pomdp.initial / pomdp.initial.sum())
    memory = _memory(dynamics, policy, states)
    chunk = _Chunk(np.zeros(count), 0, 0.0)
    running = ~pomdp.terminal[states]
    weight = 1.0
    for step in range(length):
        actions = np.full(count, -1, dtype=np.int64)
        going = np.flatnonzero(running)
        actions[going] = memory.choose(going, states, step)
        running &= actions >= 0
        if not running.any():
            break
        uniform = generator.random(count)
        observations = np.full(count, -1, dtype=np.int64)
        before = states.copy()
        for action in np.unique(actions[running]).tolist():
            mine = np.flatnonzero(actions == action)
            rewards = pomdp.rewards[action, before[mine]]
            chunk.returns[mine] += weight * rewards
            chunk.largest = max(chunk.largest, float(np.abs(rewards).max()))
            observations[mine], states[mine] = dynamics.step(action, before[mine], uniform[mine])
        running &= ~pomdp.terminal[states]
        if step + 1 < length:
            memory.learn(running, actions, observations, states)
        weight *= pomdp.discount
    chunk.ended = int((~running).sum())
    return chunk


class _Memory(Protocol):
    """What a policy knows of each episode of a chunk."""

    def choose(self, going: IntArray, states: IntArray, step: int) -> IntArray:
        """The actions of the episodes `going`, -1 where there is none; `states` [n] are of all."""

    def learn(
        self, running: BoolArray, actions: IntArray, observations: IntArray, states: IntArray
    ) -> None:
        """Take in what was done, what was observed and what is seen of the states now (all [n])."""


def _memory(dynamics: _Dynamics, policy: AnyPolicy, states: IntArray) -> _Memory:
    if isinstance(policy, StatePolicy):
        return _State(policy)
    if isinstance(policy, PolicyGraph):
        return _Node(dynamics, policy, states)
    return _Belief(dynamics.pomdp, policy, states)


class _State:
    """The state itself is known."""

    def __init__(self, policy: StatePolicy) -> None:
        self.policy = policy

    def choose(self, going: IntArray, states: IntArray, step: int) -> IntArray:
        return self.policy.choose(states[going], step)

    def learn(self, *told: object) -> None:
        """Nothing to remember."""


class _Node:
    """The node of a policy graph."""

    def __init__(self, dynamics: _Dynamics, graph: PolicyGraph, states: IntArray) -> None:
        self.graph, self.pomdp, self.worthless = graph, dynamics.pomdp, dynamics.worthless
        self.width = len(graph.start)
        sizes = [table.size for table in graph.successors]
        self.first = np.cumsum([0, *sizes[:-1]])
        self.successors = np.concatenate([table.ravel() for table in graph.successors])
        self.nodes = graph.start[self.pomdp.observed[states]]

    def choose(self, going: IntArray, states: IntArray, step: int) -> IntArray:
        nodes = self.nodes[going]
        lost = (nodes < 0) & ~self.worthless[states[going]]
        if lost.any():
            state = int(states[going][lost][0])
            raise ModelError(f"the policy graph has no node for what led to state {state}")
        return np.where(nodes >= 0, self.graph.actions[nodes], -1)

    def learn(
        self, running: BoolArray, actions: IntArray, observations: IntArray, states: IntArray
    ) -> None:
        mine = np.flatnonzero(running)
        seen = self.pomdp.observed[states[mine]]
        place = self.first[self.nodes[mine]] + observations[mine] * self.width + seen
        self.nodes[mine] = self.successors[place]


class _Belief:
    """The exact belief [n, s]."""

    def __init__(
        self, pomdp: ArrayPOMDP, policy: AlphaVectors | StagedVectors | EntropyPolicy, states: IntArray
    ) -> None:
        self.pomdp, self.policy = pomdp, policy
        self.beliefs = np.tile(pomdp.initial, (len(states), 1))
        self._narrow(np.flatnonzero(~pomdp.terminal[states]), states)

    def choose(self, going: IntArray, states: IntArray, step: int) -> IntArray:
        return self.policy.choose(self.beliefs[going], step)

    def learn(
        self, running: BoolArray, actions: IntArray, observations: IntArray, states: IntArray
    ) -> None:
        mine = np.flatnonzero(running)
        for action in np.unique(actions[mine]).tolist():
            acted = mine[actions[mine] == action]
            for observation in np.unique(observations[acted]).tolist():
                told = acted[observations[acted] == observation]
                self.beliefs[told] = self.beliefs[told] @ self.pomdp.kernel[action][observation]
        self._narrow(mine, states)

    def _narrow(self, mine: IntArray, states: IntArray) -> None:
        """Only states that look like the true one, and go on as it does, are possible."""
        seen = self.pomdp.observed[states[mine]]
        possible = (self.pomdp.observed[None, :] == seen[:, None]) & ~self.pomdp.terminal[None, :]
        beliefs = np.where(possible, self.beliefs[mine], 0.0)
        mass = beliefs.sum(axis=1, keepdims=True)
        if not np.all(mass > 0):
            raise ImpossibleObservation("a belief has lost the true state to rounding")
        self.beliefs[mine] = beliefs / mass
