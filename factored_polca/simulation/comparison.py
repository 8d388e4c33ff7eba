"""Two plans of one model compared on common random numbers.

Both run the same episodes: the same uniform numbers decide where each starts, what each action does and
what the channels report, whatever is done.  With D_i = G_i - H_i the difference of returns in episode i,

    mean D +- t s_D / sqrt(n),   s_D the sample standard deviation, t Student's quantile for n - 1,

is a confidence interval of the difference of their values; as the D_i vary less than the G_i and H_i, it
is narrower than that of two independent runs (Law: Simulation Modeling and Analysis, 5th ed. 2015, 11.2).
Where the returns of an episode agree within `TIE` relatively, which is rounding, neither wins.

Episodes that do not fit side by side run in chunks, each with a seed of its own, the same for both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, TypeAlias

import numpy as np

from factored_polca.control.belief_controller import BeliefController, plan_tracker
from factored_polca.control.belief_policies import BlockPolicy, MostLikelyPolicy, PolledPolicy
from factored_polca.control.block_tracker import BlockTracker
from factored_polca.control.likeliest import LikeliestController, likeliest_tracker
from factored_polca.control.tracker import Belief
from factored_polca.drawn import Drawn, Framed
from factored_polca.explicit.arrays import FloatArray
from factored_polca.explicit.policies import horizon_of
from factored_polca.hierarchy.executable import ExecutablePlan
from factored_polca.hierarchy.policy_file import FlatPolicy
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan
from factored_polca.models import Action, Model, ModelError, Value
from factored_polca.simulation.belief_episodes import episodes_at_once, run_one_by_one
from factored_polca.simulation.belief_runs import (
    BELIEF_NUMBERS,
    World,
    run_episodes,
    run_on_blocks,
    whole_model,
)
from factored_polca.simulation.listed_policy import ListedActions, ListedMinds
from factored_polca.simulation.runnable import AnyPlan, runnable
from factored_polca.simulation.simulate import StateActions, default_steps, simulate, simulate_actions

TIE: Final = 1e-9
EPISODES: Final = 1000
FEW_EPISODES: Final = 100
"""Episodes where nobody asks for another number and beliefs are tracked one by one."""

Runnable: TypeAlias = ExecutablePlan | ExecutablePomdpPlan | FlatPolicy


@dataclass(frozen=True)
class Outcome:
    """The returns [episode] of some episodes, and what longer ones could change in their mean."""

    returns: FloatArray
    truncation: float


Run: TypeAlias = Callable[[int, int, int], Outcome]
"""Runs so many episodes of so many steps with a seed."""


@dataclass(frozen=True)
class Runner:
    """Something that runs a plan: at most `at_once` episodes side by side; `slow`: one by one."""

    run: Run
    at_once: int
    slow: bool = False


@dataclass(frozen=True)
class Comparison(Drawn, Framed):
    """The paired difference of two plans' returns, first minus second.

    `interval` is its confidence interval of the level `level`; `wins` counts the episodes in which the
    first earned more.  `truncation` bounds what longer episodes could change in the difference.
    """

    first: str
    second: str
    first_returns: FloatArray  # [episode]
    second_returns: FloatArray  # [episode]
    level: float
    steps: int
    seed: int
    truncation: float

    @property
    def differences(self) -> FloatArray:
        """First minus second [episode]."""
        return self.first_returns - self.second_returns

    @property
    def episodes(self) -> int:
        """The number of episodes."""
        return len(self.first_returns)

    @property
    def mean(self) -> float:
        """The mean difference."""
        return float(self.differences.mean())

    @property
    def standard_error(self) -> float:
        """The standard error of the mean difference; not a number for one episode."""
        if self.episodes < 2:
            return math.nan
        return float(self.differences.std(ddof=1) / math.sqrt(self.episodes))

    @property
    def unpaired_standard_error(self) -> float:
        """What the standard error would be of two independent runs."""
        if self.episodes < 2:
            return math.nan
        variance = self.first_returns.var(ddof=1) + self.second_returns.var(ddof=1)
        return float(math.sqrt(variance / self.episodes))

    @property
    def interval(self) -> tuple[float, float]:
        """The confidence interval of the mean difference; not a number for one episode."""
        if self.episodes < 2:
            return math.nan, math.nan
        from scipy.stats import t

        half = float(t.ppf((1 + self.level) / 2, self.episodes - 1)) * self.standard_error
        return self.mean - half, self.mean + half

    @property
    def wins(self) -> int:
        """Episodes in which the first earned more."""
        return int((self._signs > 0).sum())

    @property
    def ties(self) -> int:
        """Episodes in which both earned the same."""
        return int((self._signs == 0).sum())

    @property
    def losses(self) -> int:
        """Episodes in which the second earned more."""
        return int((self._signs < 0).sum())

    @property
    def _signs(self) -> FloatArray:
        scale = np.maximum(1.0, np.maximum(np.abs(self.first_returns), np.abs(self.second_returns)))
        difference = self.differences
        return np.where(np.abs(difference) <= TIE * scale, 0.0, np.sign(difference))


def compare(
    first: AnyPlan,
    second: AnyPlan,
    *,
    episodes: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    level: float = 0.95,
    names: tuple[str, str] = ("first", "second"),
    progress: Callable[[str, int], None] | None = None,
) -> Comparison:
    """Run two plans, or policies, of one model on the same random numbers.

    Without a number 1,000 episodes are run; 100 where beliefs are tracked one by one.  `progress` is called
    with the name of what runs and the number of episodes that it has run.

    Raises:
        ModelError: they are of different models, or for different numbers of steps.
        TypeError: no plan and no policy.
        ValueError: fewer than one episode or step, or a level that is no probability.
    """
    if (episodes is not None and episodes < 1) or (steps is not None and steps < 1):
        raise ValueError("episodes and steps must be at least 1")
    if not 0 < level < 1:
        raise ValueError(f"the level is {level}; it is a probability between 0 and 1, such as 0.95")
    plans = runnable(first), runnable(second)
    reason = model_difference(plans[0].model, plans[1].model)
    if reason is not None:
        raise ModelError(
            f"the plans are of different models: {reason}; only plans of one model are compared"
        )
    length = common_steps(*plans, steps)
    runners = [runner_of(plan, seed) for plan in plans]
    count = episodes or (FEW_EPISODES if any(one.slow for one in runners) else EPISODES)
    chunk = max(1, min(count, *(one.at_once for one in runners)))
    found: list[list[Outcome]] = [[], []]
    for number, begun in enumerate(range(0, count, chunk)):
        many = min(chunk, count - begun)
        for which, one in enumerate(runners):
            if progress is not None:
                progress(names[which], begun)
            found[which].append(one.run(many, length, chunk_seed(seed, number)))
    returns = [np.concatenate([outcome.returns for outcome in half]) for half in found]
    truncation = sum(max(outcome.truncation for outcome in half) for half in found)
    return Comparison(names[0], names[1], returns[0], returns[1], level, length, seed, truncation)


def chunk_seed(seed: int, number: int) -> int:
    """The seed of a chunk of episodes; of the first one `seed` itself."""
    if number == 0:
        return seed
    return int(np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0])


def common_steps(first: Runnable, second: Runnable, steps: int | None) -> int:
    """The steps of an episode: those asked for, a policy's horizon, or as many as the discount needs.

    Raises:
        ModelError: a policy for other steps than asked for, or than the other policy is for.
    """
    horizons = {horizon_of(plan.policy) for plan in (first, second) if isinstance(plan, FlatPolicy)} - {
        None
    }
    wanted = horizons | ({steps} if steps is not None else set())
    if len(wanted) > 1:
        listed = " and ".join(str(h) for h in sorted(h for h in wanted if h is not None))
        raise ModelError(
            f"a policy for a horizon runs for its own number of steps; here these are {listed}"
        )
    known = next(iter(wanted), None)
    return default_steps(float(first.model.discount)) if known is None else known


# -- how each kind of plan is run ----------------------------------------------------------------------


def runner_of(plan: Runnable, seed: int) -> Runner:
    """How a plan is run."""
    if plan.model.observability == "full":
        return _seen(plan)
    if isinstance(plan, FlatPolicy):
        return _listed(plan)
    return _tracked(plan, seed)


def _seen(plan: Runnable) -> Runner:
    if isinstance(plan, ExecutablePlan):
        return Runner(partial(_run_plan, plan), BELIEF_NUMBERS)
    if isinstance(plan, FlatPolicy):
        return Runner(partial(_run_actions, plan, ListedActions(plan)), BELIEF_NUMBERS)
    raise ModelError("the state is seen, and the plan is one over beliefs")


def _run_plan(plan: ExecutablePlan, episodes: int, steps: int, seed: int) -> Outcome:
    found = simulate(plan, episodes=episodes, steps=steps, seed=seed)
    return Outcome(found.returns, found.truncation)


def _run_actions(plan: FlatPolicy, choose: StateActions, episodes: int, steps: int, seed: int) -> Outcome:
    found = simulate_actions(plan.flat.symbolic, choose, episodes=episodes, steps=steps, seed=seed)
    return Outcome(found.returns, 0.0 if horizon_of(plan.policy) is not None else found.truncation)


def _listed(plan: FlatPolicy) -> Runner:
    """A policy over beliefs on listed states."""
    symbolic = plan.flat.symbolic
    at_once = max(1, BELIEF_NUMBERS // plan.flat.pomdp.states)

    def run(episodes: int, steps: int, seed: int) -> Outcome:
        found = run_episodes(
            World(symbolic, whole_model(symbolic)), partial(ListedMinds, plan),
            episodes=episodes, steps=steps, seed=seed, at_once=episodes,
        )  # fmt: skip
        return Outcome(found.returns, 0.0 if horizon_of(plan.policy) is not None else found.truncation)

    return Runner(run, at_once)


def _tracked(plan: ExecutablePlan | ExecutablePomdpPlan, seed: int) -> Runner:
    """A plan whose beliefs a tracker keeps."""
    decide: Callable[[Belief], int]
    if isinstance(plan, ExecutablePomdpPlan):
        tracker = plan_tracker(plan, on_impossible="reset", seed=seed).tracker
        polled = BeliefController(plan)

        def decide(belief: Belief) -> int:
            return polled.poll(belief).number
    else:
        tracker = likeliest_tracker(plan, on_impossible="reset", seed=seed).tracker
        asked = LikeliestController(plan)

        def decide(belief: Belief) -> int:
            return asked.poll(belief).number

    if isinstance(tracker, BlockTracker):
        policy: BlockPolicy
        if isinstance(plan, ExecutablePomdpPlan):
            policy = PolledPolicy(plan, tracker)
        else:
            policy = MostLikelyPolicy(plan.policy, tracker)

        def over_blocks(episodes: int, steps: int, seed: int) -> Outcome:
            found = run_on_blocks(tracker, policy, episodes=episodes, steps=steps, seed=seed)
            return Outcome(found.returns, found.truncation)

        return Runner(over_blocks, max(1, BELIEF_NUMBERS // tracker.partition.blocks))

    def one_by_one(episodes: int, steps: int, seed: int) -> Outcome:
        found = run_one_by_one(tracker, decide, episodes=episodes, steps=steps, seed=seed)
        return Outcome(found.returns, found.truncation)

    return Runner(one_by_one, episodes_at_once(tracker), slow=True)


# -- whether two models are one -----------------------------------------------------------------------


def model_difference(first: Model, second: Model) -> str | None:
    """What tells two models apart, in words; None where they are the same but for names and descriptions.

    Expressions are compared as they are written, without algebra.
    """
    for what, one, other in (
        ("features", [f.name for f in first.features], [f.name for f in second.features]),
        ("actions", [a.name for a in first.actions], [a.name for a in second.actions]),
        ("observations", [o.name for o in first.observations], [o.name for o in second.observations]),
    ):
        if one != other:
            return f"one has the {what} {_listed_names(one)}, the other {_listed_names(other)}"
    for mine, theirs in zip(first.features, second.features, strict=True):
        if _typed(mine.values) != _typed(theirs.values) or mine.observed != theirs.observed:
            return f"the values of feature {mine.name!r} differ, or whether it is seen"
    for channel, like in zip(first.observations, second.observations, strict=True):
        if _typed((*channel.values, channel.null)) != _typed((*like.values, like.null)):
            return f"the values of observation {channel.name!r} differ"
    for a, b in zip(first.actions, second.actions, strict=True):
        if (part := _action_difference(a, b)) is not None:
            return f"action {a.name!r} has another {part}"
    for name in ("discount", "observability", "horizon", "terminal", "rewards"):
        if getattr(first, name) != getattr(second, name):
            return f"they differ in {name}"
    if dict(first.parameters) != dict(second.parameters):
        return "they differ in parameters"
    begun, other_begun = first.initial, second.initial
    same = dict(begun.distributions) == dict(other_begun.distributions)
    return None if same and begun.factors == other_begun.factors else "they differ at the start"


def _typed(values: Sequence[Value]) -> list[tuple[bool, Value]]:
    """Values such that `True` is not 1."""
    return [(isinstance(value, bool), value) for value in values]


def _action_difference(a: Action, b: Action) -> str | None:
    for name in ("applicable", "rewards"):
        if getattr(a, name) != getattr(b, name):
            return {"applicable": "condition", "rewards": "reward"}[name]
    for what, mine, theirs in (
        ("effect on", a.effects, b.effects),
        ("distribution of", a.senses, b.senses),
    ):
        one, other = dict(mine), dict(theirs)
        for name in [*one, *other]:
            if one.get(name) != other.get(name):
                return f"{what} {name!r}"
    return None


def _listed_names(names: list[str]) -> str:
    shown = ", ".join(names[:8]) or "none"
    return shown + (f" and {len(names) - 8} more" if len(names) > 8 else "")
