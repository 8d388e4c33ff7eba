"""Figure 4b: what PolCA+, PolCA, QMDP and SARSOP earn, on equal random numbers.

    C_t = sum over s < t of R(x_s, a_s)                  cumulative reward, without discount
    G   = sum over t of gamma^t R(x_t, a_t)              discounted return of an episode

All policies meet the same draws (common random numbers), so the difference of two is taken episode by
episode: d_n = G_n(first) - G_n(second), its mean with the standard error s(d) / sqrt(n).  SARSOP - PolCA+
is what the hierarchy, and modelling children at corners, costs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np

from factored_polca.drawn import Framed
from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.hierarchy import Options
from factored_polca.models import Model, TaskHierarchy
from factored_polca.simulation.belief_runs import BeliefRuns, run_on_blocks
from factored_polca.studies.contenders import FLAT_TRIALS, Contender, Contest, make_contest
from factored_polca.studies.parameters import Progress, silent

EPISODES: Final = 1000

PAIRS: Final = (("PolCA+", "PolCA"), ("PolCA", "QMDP"), ("SARSOP", "PolCA+"))
"""Whose difference is of interest."""

ORDER: Final = ("PolCA+", "PolCA", "QMDP")
"""The paper's order, best first."""


@dataclass(frozen=True, eq=False)
class Earned:
    """What one policy earned, and what planning said of it; see `Contender`.

    `returns` [episode]; `cumulative` and `cumulative_error` [t - 1] are the mean of C_t and its standard
    error; `per_episode` [action] says how often each action was taken in an episode.
    """

    name: str
    returns: FloatArray
    mean: float
    standard_error: float
    cumulative: FloatArray
    cumulative_error: FloatArray
    per_episode: FloatArray
    truncation: float
    planning_seconds: float
    lower: float | None
    upper: float | None
    planned: tuple[float, float] | None


@dataclass(frozen=True)
class Difference:
    """The mean of G(first) - G(second) over paired episodes, and its standard error."""

    first: str
    second: str
    mean: float
    standard_error: float

    @property
    def clear(self) -> bool:
        """Whether it is more than two standard errors from 0."""
        return abs(self.mean) > 2 * self.standard_error


@dataclass(frozen=True, eq=False)
class RewardStudy(Framed):
    """What each policy earned on one model, and the differences."""

    model: str
    discount: float
    episodes: int
    steps: int
    seed: int
    actions: tuple[str, ...]
    earned: tuple[Earned, ...]
    differences: tuple[Difference, ...]
    tracker_blocks: int

    def of(self, name: str) -> Earned:
        """What the policy called `name` earned.

        Raises:
            KeyError: there is none; the message lists those there are.
        """
        for one in self.earned:
            if one.name == name:
                return one
        raise KeyError(f"no policy {name!r}; there are {', '.join(one.name for one in self.earned)}")

    @property
    def order_holds(self) -> bool:
        """Whether the discounted returns have the paper's order, by their means."""
        return all(self.of(high).mean > self.of(low).mean for high, low in pairwise(ORDER))

    @property
    def cumulative_order_holds(self) -> bool:
        """Whether the cumulative rewards at the end have it."""
        ends = [self.of(name).cumulative[-1] for name in ORDER]
        return all(high > low for high, low in pairwise(ends))

    @property
    def order_is_clear(self) -> bool:
        """Whether it holds, and by more than two standard errors each time."""
        between = [d for d in self.differences if {d.first, d.second} <= set(ORDER)]
        return self.order_holds and all(d.clear for d in between)

    def to_data(self) -> dict[str, Any]:
        """The study as plain data."""
        return {
            "figure": "4b",
            "model": self.model,
            "discount": self.discount,
            "episodes": self.episodes,
            "steps": self.steps,
            "seed": self.seed,
            "tracker_blocks": self.tracker_blocks,
            "policies": [self._policy_data(one) for one in self.earned],
            "differences": [difference_data(d) for d in self.differences],
            "order_holds": self.order_holds,
            "cumulative_order_holds": self.cumulative_order_holds,
            "order_is_clear": self.order_is_clear,
        }

    def _policy_data(self, one: Earned) -> dict[str, Any]:
        low, high = one.planned or (None, None)
        return {
            "name": one.name,
            "mean": one.mean,
            "standard_error": one.standard_error,
            "cumulative_end": float(one.cumulative[-1]),
            "cumulative_end_error": float(one.cumulative_error[-1]),
            "lower": one.lower,
            "upper": one.upper,
            "planned_lower": low,
            "planned_upper": high,
            "truncation": one.truncation,
            "action_counts": dict(zip(self.actions, one.per_episode.tolist(), strict=True)),
            "cumulative": one.cumulative.tolist(),
            "cumulative_error": one.cumulative_error.tolist(),
            "planning_seconds": one.planning_seconds,
        }


def study_rewards(
    model: Model,
    tasks: TaskHierarchy | None = None,
    options: Options | None = None,
    *,
    episodes: int = EPISODES,
    steps: int | None = None,
    flat_trials: int | None = FLAT_TRIALS,
    progress: Progress = silent,
) -> RewardStudy:
    """Plan a model in all four ways and run the policies; `flat_trials` None leaves out SARSOP.

    Raises:
        ValueError: fewer than one episode or step.
        ModelError: the model or the hierarchy is not right, or the state is seen.
        LimitReached: memory, blocks or observations.
    """
    options = options or Options()
    contest = make_contest(model, tasks, options, flat_trials=flat_trials, progress=progress)
    return run_contest(contest, episodes=episodes, steps=steps, seed=options.seed, progress=progress)


def run_contest(
    contest: Contest,
    *,
    episodes: int = EPISODES,
    steps: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> RewardStudy:
    """Run the contenders on common random numbers."""
    model = contest.tracker.symbolic.model
    earned, length = [], 0
    for one in contest.contenders:
        progress(f"running {one.name}, {episodes:,} episodes")
        runs = run_on_blocks(contest.tracker, one.policy, episodes=episodes, steps=steps, seed=seed)
        earned.append(_earned(one, runs))
        length = runs.steps
    return RewardStudy(
        model.name,
        float(model.discount),
        episodes,
        length,
        seed,
        tuple(action.name for action in model.actions),
        tuple(earned),
        differences(earned),
        contest.tracker.partition.blocks,
    )


def _earned(one: Contender, runs: BeliefRuns) -> Earned:
    counts: IntArray = runs.counts
    return Earned(
        one.name, runs.returns, runs.mean, runs.standard_error, runs.cumulative, runs.cumulative_error,
        counts / runs.episodes, runs.truncation, one.seconds, one.lower, one.upper, one.planned,
    )  # fmt: skip


def differences(earned: Sequence[Earned]) -> tuple[Difference, ...]:
    """The paired differences of `PAIRS`, as far as both took part."""
    returns = {one.name: one.returns for one in earned}
    return tuple(
        paired_difference(first, second, returns[first], returns[second])
        for first, second in PAIRS
        if first in returns and second in returns
    )


def paired_difference(first: str, second: str, high: FloatArray, low: FloatArray) -> Difference:
    """The mean difference of returns [episode] from equal draws; the error is not a number for one."""
    apart = high - low
    error = float(np.std(apart, ddof=1) / math.sqrt(len(apart))) if len(apart) > 1 else math.nan
    return Difference(first, second, float(apart.mean()), error)


def difference_data(one: Difference) -> dict[str, Any]:
    """A difference as plain data."""
    return {
        "first": one.first,
        "second": one.second,
        "mean": one.mean,
        "standard_error": one.standard_error,
    }
