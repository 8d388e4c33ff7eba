"""Episodes of a partially observed model under a policy over beliefs.

    x_0 ~ b0;   a_t by the policy at the belief;   x_{t+1} ~ T(x_t, a_t, .),   o ~ P_a(. | x_{t+1}, x_t);
    earned: sum_t gamma^t R_a(x_t)

States are drawn from the original model, feature by feature, and never seen by the policy; beliefs are
tracked exactly over the blocks of a tracker, many episodes at once:  b' ~ b K_a(.; ., o), narrowed to what
is seen of the state and to the episode going on.  R_a(x) is the expected reward of the step, so that
returns vary less than those of runs that draw rewards too, and have the same mean.

Equal seeds draw equal uniform numbers whatever the policy does (common random numbers), so that the
difference of two policies varies less than each.

A subtask may be run in place of the model: with its own reward, until it has ended, which its own model
supposes to be seen (`Stage`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from factored_polca.control.belief_policies import BlockPolicy, holds
from factored_polca.control.block_tracker import BlockTracker
from factored_polca.diagrams import Diagram
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.models import ModelError
from factored_polca.simulation.sampler import Sampler, States
from factored_polca.simulation.simulate import default_steps
from factored_polca.symbolic import Term

BELIEF_NUMBERS: Final = 1 << 23
"""Entries of the beliefs that are kept at once: more episodes are run one chunk after the other."""

MATRIX_ENTRIES: Final = 1 << 25
"""Entries of kernels above which all are forgotten; each takes 12 bytes."""


@dataclass(frozen=True)
class Stage:
    """Where episodes take place: until `ended` holds, with `rewards` [action] as terms over states."""

    ended: Diagram
    rewards: Mapping[int, Sequence[Term]]


@dataclass(frozen=True)
class BeliefRuns:
    """What episodes earned.

    `returns` [episode] are discounted.  `cumulative` and `cumulative_error` [step] are the mean of what has
    been earned without discount after so many steps, and its standard error.  `counts` [action] says how
    often each action was taken; `truncation` bounds what longer episodes could change in the mean return.
    """

    returns: FloatArray
    steps: int
    ended: int
    truncation: float
    cumulative: FloatArray
    cumulative_error: FloatArray
    counts: IntArray

    @property
    def episodes(self) -> int:
        """The number of episodes."""
        return len(self.returns)

    @property
    def mean(self) -> float:
        """The mean return."""
        return float(self.returns.mean())

    @property
    def standard_error(self) -> float:
        """The standard error of the mean; not a number for one episode."""
        if len(self.returns) < 2:
            return math.nan
        return float(self.returns.std(ddof=1) / math.sqrt(len(self.returns)))


def run_on_blocks(
    tracker: BlockTracker,
    policy: BlockPolicy,
    *,
    episodes: int = 1000,
    steps: int | None = None,
    seed: int = 0,
    stage: Stage | None = None,
) -> BeliefRuns:
    """Run a policy over beliefs on the original model.

    Raises:
        ValueError: fewer than one episode or step.
        ModelError: the policy has no action at a belief of an episode that goes on.
    """
    if episodes < 1 or (steps is not None and steps < 1):
        raise ValueError("episodes and steps must be at least 1")
    symbolic = tracker.symbolic
    discount = float(symbolic.model.discount)
    length = default_steps(discount) if steps is None else steps
    if stage is None:
        stage = Stage(symbolic.terminal, {a: act.rewards for a, act in enumerate(symbolic.actions)})
    most = max(1, BELIEF_NUMBERS // tracker.partition.blocks)
    generator = np.random.default_rng(seed)
    world = _World(tracker, stage)
    total = _Total(length, len(symbolic.actions))
    for first in range(0, episodes, most):
        _run(world, policy, min(most, episodes - first), length, discount, generator, total)
    return total.runs(episodes, length, discount)


class _World:
    """The sampled world and the kernels over blocks, made as they are needed."""

    def __init__(self, tracker: BlockTracker, stage: Stage) -> None:
        self.tracker, self.stage = tracker, stage
        self.sampler = Sampler(tracker.symbolic)
        self.sensed = [list(channels) for channels in tracker.reader.sensed]
        self.observed = list(tracker.reader.observed)
        self.over = holds(tracker, stage.ended)
        self.kernels: dict[tuple[int, tuple[int, ...]], Any] = {}
        self.entries = 0

    def kernel(self, action: int, values: tuple[int, ...]) -> Any:
        """K_a(.; ., o) [block, next block]."""
        key = (action, values)
        if key not in self.kernels:
            if self.entries > MATRIX_ENTRIES:
                self.kernels.clear()
                self.entries = 0
            self.kernels[key] = self.tracker.rows(action, values).matrix()
            self.entries += self.kernels[key].nnz
        return self.kernels[key]

    def ended(self, states: States) -> BoolArray:
        """Which episodes are over."""
        from factored_polca.diagrams import evaluate_states

        columns = self.tracker.symbolic.columns()
        return evaluate_states(self.stage.ended, states, columns).astype(np.bool_)

    def rewards(self, action: int, states: States) -> FloatArray:
        """The expected reward of an action at each state."""
        return self.sampler.expected_rewards(self.stage.rewards[action], states)

    def begin(self, states: States) -> FloatArray:
        """Beliefs [n, block] at the start, after what is seen of `states`, which are not over."""
        masses = self.tracker.begun[: self.tracker.partition.blocks]
        return self.narrow(np.tile(masses, (len(states), 1)), states)

    def narrow(self, beliefs: FloatArray, states: States) -> FloatArray:
        """`beliefs` with only such blocks left as look like the states and go on as they do."""
        beliefs[:, self.over] = 0.0
        if self.observed:
            seen = states[:, self.observed]
            beliefs[(self.tracker.seen[None, :, :] != seen[:, None, :]).any(axis=2)] = 0.0
        mass = beliefs.sum(axis=1, keepdims=True)
        if not (mass > 0).all():
            raise ImpossibleObservation("a belief has lost the true state to rounding")
        beliefs /= mass
        return beliefs

    def learn(
        self, beliefs: FloatArray, actions: IntArray, values: IntArray, following: States
    ) -> FloatArray:
        """The beliefs [n, block] after actions [n], channels' values [n, channel], and next states."""
        result = np.empty_like(beliefs)
        keys = np.concatenate([actions[:, None], values], axis=1)
        distinct, place = np.unique(keys, axis=0, return_inverse=True)
        place = place.reshape(-1)
        order = np.argsort(place, kind="stable")
        bounds = np.searchsorted(place[order], np.arange(len(distinct) + 1))
        for number, key in enumerate(distinct.tolist()):
            mine = order[bounds[number] : bounds[number + 1]]
            action = key[0]
            received = tuple(key[1 + j] for j in self.sensed[action])
            result[mine] = beliefs[mine] @ self.kernel(action, received)
        return self.narrow(result, following)


class _Total:
    """Sums over all episodes (a working state, not a value)."""

    def __init__(self, steps: int, actions: int) -> None:
        self.returns: list[FloatArray] = []
        self.sums, self.squares = np.zeros(steps), np.zeros(steps)
        self.counts = np.zeros(actions, dtype=np.int64)
        self.ended, self.largest = 0, 0.0

    def runs(self, episodes: int, steps: int, discount: float) -> BeliefRuns:
        mean = self.sums / episodes
        variance = np.maximum(0.0, self.squares - episodes * mean**2) / max(1, episodes - 1)
        left = 0.0 if self.ended == episodes else math.inf
        if left and discount < 1:
            left = discount**steps / (1 - discount) * self.largest
        return BeliefRuns(
            np.concatenate(self.returns), steps, self.ended, left, mean, np.sqrt(variance / episodes),
            self.counts,
        )  # fmt: skip


def _run(
    world: _World,
    policy: BlockPolicy,
    count: int,
    length: int,
    discount: float,
    generator: np.random.Generator,
    total: _Total,
) -> None:
    states = world.sampler.initial(count, generator)
    running = ~world.ended(states)
    beliefs = np.zeros((count, world.tracker.partition.blocks))
    beliefs[running] = world.begin(states[running])
    returns, cumulative, weight = np.zeros(count), np.zeros(count), 1.0
    for step in range(length):
        going = np.flatnonzero(running)
        if len(going):
            actions = np.full(count, -1, dtype=np.int64)
            actions[going] = policy.choose(beliefs[going])
            if (actions[going] < 0).any():
                raise ModelError("the policy has no action at a belief of an episode that goes on")
            following, _ = world.sampler.step(states, actions, generator)
            values = world.sampler.observe(states, actions, following, generator)
            for action in np.unique(actions[going]).tolist():
                mine = np.flatnonzero(actions == action)
                rewards = world.rewards(action, states[mine])
                returns[mine] += weight * rewards
                cumulative[mine] += rewards
                total.counts[action] += len(mine)
                total.largest = max(total.largest, float(np.abs(rewards).max()))
            running &= ~world.ended(following)
            on = np.flatnonzero(running)
            if len(on) and step + 1 < length:
                beliefs[on] = world.learn(beliefs[on], actions[on], values[on], following[on])
            states, weight = following, weight * discount
        total.sums[step] += cumulative.sum()
        total.squares[step] += (cumulative**2).sum()
    total.returns.append(returns)
    total.ended += int((~running).sum())
