"""Episodes whose beliefs are tracked one by one, as diagrams or particles: where blocks would be too many.

What is drawn and earned is what `belief_runs` says, with the same uniform numbers for equal seeds: as long
as two exact trackers lead to the same actions, their episodes are the same.

A sample may lose the true state.  Its tracker must then be told to start anew (`on_impossible="reset"`);
`BeliefRuns.resets` counts how often it did.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from functools import partial
from typing import Final

import numpy as np

from factored_polca.control.particle_tracker import ParticleTracker
from factored_polca.control.tracker import Belief, Tracker
from factored_polca.explicit.arrays import IntArray
from factored_polca.models import Value
from factored_polca.simulation.belief_runs import (
    BELIEF_NUMBERS,
    BeliefRuns,
    Progress,
    World,
    run_episodes,
    whole_model,
)
from factored_polca.simulation.sampler import States

EPISODES: Final = 100
"""Episodes that are run where nobody asks for more: tracking takes milliseconds a step."""

DIAGRAM_NUMBERS: Final = 1 << 14
"""Numbers that a belief as a diagram is supposed to take."""


def run_one_by_one(
    tracker: Tracker,
    decide: Callable[[Belief], int],
    *,
    episodes: int = EPISODES,
    steps: int | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> BeliefRuns:
    """Run a policy, `decide`, which answers the number of a primitive action, on the original model.

    Raises:
        ValueError: fewer than one episode or step.
        ModelError: the policy has no action (-1) at a belief of an episode that goes on.
        ImpossibleObservation: a belief has lost the true state, and the tracker was not told to reset.
        LimitReached: a belief no longer fits (diagrams only).
    """
    return run_episodes(
        World(tracker.symbolic, whole_model(tracker.symbolic)),
        lambda count: _SingleMinds(tracker, decide, count),
        episodes=episodes,
        steps=steps,
        seed=seed,
        at_once=episodes_at_once(tracker),
        progress=progress,
    )


def episodes_at_once(tracker: Tracker) -> int:
    """How many episodes run side by side."""
    width = DIAGRAM_NUMBERS
    if isinstance(tracker, ParticleTracker):
        width = tracker.count * len(tracker.symbolic.model.features)
    return max(1, BELIEF_NUMBERS // width)


class _SingleMinds:
    """A belief for each episode.

    Exact beliefs are one as long as the same was done and observed, and asked for once; samples are each
    episode's own, so that their errors are independent.
    """

    def __init__(self, tracker: Tracker, decide: Callable[[Belief], int], count: int) -> None:
        self.tracker, self.decide, self.resets = tracker, decide, 0
        self.beliefs: list[Belief | None] = [None] * count
        model = tracker.symbolic.model
        self.observed = [(i, model.features[i]) for i in tracker.reader.observed]
        self.channels = list(enumerate(model.observations))

    def begin(self, mine: IntArray, states: States) -> None:
        made = dict[Hashable, Belief]()
        for number, state in zip(mine.tolist(), states, strict=True):
            self.keep(number, made, self.sight(state), partial(self.tracker.start, self.seen(state)))

    def choose(self, mine: IntArray) -> IntArray:
        asked, result = dict[int, int](), np.full(len(mine), -1, dtype=np.int64)
        for place, number in enumerate(mine.tolist()):
            belief = self.beliefs[number]
            assert belief is not None, "an episode that goes on has begun"
            if id(belief) not in asked:
                asked[id(belief)] = self.decide(belief)
            result[place] = asked[id(belief)]
        return result

    def learn(self, mine: IntArray, actions: IntArray, values: IntArray, following: States) -> None:
        made, before = dict[Hashable, Belief](), list(self.beliefs)  # which keeps beliefs, and so their ids
        told = zip(mine.tolist(), actions.tolist(), values.tolist(), following, strict=True)
        for number, action, row, state in told:
            belief = before[number]
            assert belief is not None, "an episode that goes on has begun"
            observation = {channel.name: channel.values[row[j]] for j, channel in self.channels}
            key = (id(belief), action, *row, *self.sight(state))
            after = partial(belief.after, action, observation | self.seen(state))
            self.keep(number, made, key, after)

    def seen(self, state: States) -> dict[str, Value]:
        """The values of the observed features."""
        return {feature.name: feature.values[int(state[i])] for i, feature in self.observed}

    def sight(self, state: States) -> tuple[int, ...]:
        """The same by numbers."""
        return tuple(int(state[i]) for i, _ in self.observed)

    def keep(
        self, number: int, made: dict[Hashable, Belief], key: Hashable, make: Callable[[], Belief]
    ) -> None:
        """Give an episode the belief of `key`, from now on in `made`."""
        if self.tracker.guarantee != "exact" or key not in made:
            made[key] = make()
        self.beliefs[number] = made[key]
        self.resets += made[key].was_reset
