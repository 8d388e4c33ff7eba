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

`run_episodes` is the loop, whatever beliefs are kept in (`Minds`); those that are not kept over blocks are
in `belief_episodes`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Protocol

import numpy as np

from factored_polca.control.belief_policies import BlockPolicy, holds
from factored_polca.control.block_tracker import BlockTracker
from factored_polca.diagrams import Diagram, evaluate_states
from factored_polca.drawn import Drawn, Framed
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.models import LimitReached, ModelError
from factored_polca.simulation.sampler import Sampler, States
from factored_polca.simulation.simulate import default_steps
from factored_polca.symbolic import SymbolicModel, Term

Progress = Callable[[int, int], None]
"""Called at each step with the number of the first episode of those that run, and the step, both from 0.

It may raise `LimitReached`: episodes then end as they are, but for those that have not taken a step.
"""

EPISODES: Final = 1000
"""Episodes that are run where nobody asks for another number."""

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
class BeliefRuns(Drawn, Framed):
    """What episodes earned.

    `returns` [episode] are discounted.  `cumulative` and `cumulative_error` [step] are the mean of what has
    been earned without discount after so many steps, and its standard error.  `counts` [action] says how
    often each action was taken; `truncation` bounds what longer episodes could change in the mean return.
    `resets` counts beliefs that a sample had lost and that were started anew (particles only).
    """

    returns: FloatArray
    steps: int
    ended: int
    truncation: float
    cumulative: FloatArray
    cumulative_error: FloatArray
    counts: IntArray
    resets: int = 0

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
    episodes: int = EPISODES,
    steps: int | None = None,
    seed: int = 0,
    stage: Stage | None = None,
    progress: Progress | None = None,
) -> BeliefRuns:
    """Run a policy over beliefs on the original model.

    Raises:
        ValueError: fewer than one episode or step.
        ModelError: the policy has no action at a belief of an episode that goes on.
    """
    symbolic = tracker.symbolic
    stage = whole_model(symbolic) if stage is None else stage
    kernels = _Kernels(tracker, holds(tracker, stage.ended))
    return run_episodes(
        World(symbolic, stage),
        lambda count: _BlockMinds(kernels, policy, count),
        episodes=episodes,
        steps=steps,
        seed=seed,
        at_once=max(1, BELIEF_NUMBERS // tracker.partition.blocks),
        progress=progress,
    )


class Minds(Protocol):
    """What the policy believes in the episodes of a chunk, and what it does; n are some of them."""

    resets: int

    def begin(self, mine: IntArray, states: States) -> None:
        """Start the episodes numbered `mine` [n], whose states [n, feature] give what is seen."""

    def choose(self, mine: IntArray) -> IntArray:
        """The numbers of the primitive actions [n], -1 for none."""

    def learn(self, mine: IntArray, actions: IntArray, values: IntArray, following: States) -> None:
        """Take in what came after `actions` [n]: channels' values [n, channel], and the next states.

        Of these only what is seen may be read, and that the episodes go on.
        """


def whole_model(symbolic: SymbolicModel) -> Stage:
    """The model itself as a stage."""
    return Stage(symbolic.terminal, {a: action.rewards for a, action in enumerate(symbolic.actions)})


def run_episodes(
    world: World,
    minds: Callable[[int], Minds],
    *,
    episodes: int,
    steps: int | None,
    seed: int,
    at_once: int,
    progress: Progress | None = None,
) -> BeliefRuns:
    """Run episodes, at most `at_once` side by side; `minds` makes the beliefs of so many.

    Raises:
        ValueError: fewer than one episode or step.
        ModelError: the policy has no action at a belief of an episode that goes on.
        LimitReached: of `progress`, before the first step.
    """
    if episodes < 1 or (steps is not None and steps < 1):
        raise ValueError("episodes and steps must be at least 1")
    symbolic = world.symbolic
    discount = float(symbolic.model.discount)
    length = default_steps(discount) if steps is None else steps
    generator = np.random.default_rng(seed)
    total = _Total(length, len(symbolic.actions))
    for first in range(0, episodes, at_once):
        count = min(at_once, episodes - first)
        tell = None if progress is None else partial(progress, first)
        try:
            _run(world, minds(count), count, length, discount, generator, total, tell)
        except LimitReached:
            if not total.returns:
                raise
            break
    return total.runs(discount)


class World:
    """The model that states are drawn from, unseen, until the stage has ended."""

    def __init__(self, symbolic: SymbolicModel, stage: Stage) -> None:
        self.symbolic, self.stage = symbolic, stage
        self.sampler = Sampler(symbolic)

    def ended(self, states: States) -> BoolArray:
        """Which episodes are over."""
        return evaluate_states(self.stage.ended, states, self.symbolic.columns()).astype(np.bool_)

    def rewards(self, action: int, states: States) -> FloatArray:
        """The expected reward of an action at each state."""
        return self.sampler.expected_rewards(self.stage.rewards[action], states)


class _Kernels:
    """The kernels over a tracker's blocks, made as they are needed; episodes are over in blocks `over`."""

    def __init__(self, tracker: BlockTracker, over: BoolArray) -> None:
        self.tracker, self.over = tracker, over
        self.sensed = [list(channels) for channels in tracker.reader.sensed]
        self.observed = list(tracker.reader.observed)
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


class _BlockMinds:
    """Beliefs over a tracker's blocks and a policy over them."""

    resets = 0

    def __init__(self, kernels: _Kernels, policy: BlockPolicy, count: int) -> None:
        self.kernels, self.policy = kernels, policy
        self.beliefs = np.zeros((count, kernels.tracker.partition.blocks))

    def begin(self, mine: IntArray, states: States) -> None:
        self.beliefs[mine] = self.kernels.begin(states)

    def choose(self, mine: IntArray) -> IntArray:
        return self.policy.choose(self.beliefs[mine])

    def learn(self, mine: IntArray, actions: IntArray, values: IntArray, following: States) -> None:
        self.beliefs[mine] = self.kernels.learn(self.beliefs[mine], actions, values, following)


class _Total:
    """Sums over all episodes (a working state, not a value)."""

    def __init__(self, steps: int, actions: int) -> None:
        self.returns: list[FloatArray] = []
        self.steps = steps
        self.sums, self.squares = np.zeros(steps), np.zeros(steps)
        self.counts = np.zeros(actions, dtype=np.int64)
        self.ended, self.largest, self.resets = 0, 0.0, 0

    def runs(self, discount: float) -> BeliefRuns:
        steps, returns = self.steps, np.concatenate(self.returns)
        episodes = len(returns)
        mean = self.sums / episodes
        variance = np.maximum(0.0, self.squares - episodes * mean**2) / max(1, episodes - 1)
        left = 0.0 if self.ended == episodes else math.inf
        if left and discount < 1:
            left = discount**steps / (1 - discount) * self.largest
        return BeliefRuns(
            returns, steps, self.ended, left, mean[:steps], np.sqrt(variance / episodes)[:steps],
            self.counts, self.resets,
        )  # fmt: skip


def _run(
    world: World,
    minds: Minds,
    count: int,
    length: int,
    discount: float,
    generator: np.random.Generator,
    total: _Total,
    tell: Callable[[int], None] | None,
) -> None:
    states = world.sampler.initial(count, generator)
    running = ~world.ended(states)
    going = np.flatnonzero(running)
    minds.begin(going, states[going])
    returns, cumulative, weight = np.zeros(count), np.zeros(count), 1.0
    for step in range(length):
        if len(going):
            if tell is not None:
                try:
                    tell(step)
                except LimitReached:
                    if not step:
                        raise
                    total.sums[step:] += cumulative.sum()
                    total.squares[step:] += (cumulative**2).sum()
                    total.steps = min(total.steps, step)
                    break
            actions = np.full(count, -1, dtype=np.int64)
            actions[going] = minds.choose(going)
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
            going = np.flatnonzero(running)
            if len(going) and step + 1 < length:
                minds.learn(going, actions[going], values[going], following[going])
            states, weight = following, weight * discount
        total.sums[step] += cumulative.sum()
        total.squares[step] += (cumulative**2).sum()
    total.returns.append(returns)
    total.ended += int((~running).sum())
    total.resets += minds.resets
