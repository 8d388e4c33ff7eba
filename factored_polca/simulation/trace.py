"""One episode, step by step: what is true, what is believed, what is done and why.

Where the state is seen the plan's controller is asked at the state; where it is not, at the belief that the
plan's tracker keeps, and the state is drawn unseen by it.  The draws are those of `simulate` and of the
command `run --auto` with one episode: the same seed, the same episode.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from factored_polca.control import Controller
from factored_polca.control.belief_controller import BeliefController, plan_tracker, tracked_features
from factored_polca.control.likeliest import LikeliestController, likeliest_tracker
from factored_polca.control.tracker import Belief, Tracker
from factored_polca.diagrams import support
from factored_polca.drawn import Drawn, Framed
from factored_polca.explicit.arrays import FloatArray
from factored_polca.hierarchy.executable import ExecutablePlan
from factored_polca.hierarchy.policy_file import FlatPolicy
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan
from factored_polca.models import Model, Value
from factored_polca.simulation.runnable import AnyPlan, runnable
from factored_polca.simulation.sampler import Sampler, States

Plan: TypeAlias = ExecutablePlan | ExecutablePomdpPlan

STEPS = 20
"""Steps where nobody asks for another number."""


@dataclass(frozen=True)
class TracedStep:
    """One step.

    `path` are the tasks that were asked, from the top; `beliefs` maps features to the probabilities of
    their values [value] before the step, empty where the state is seen.  `observation` is what came after
    the action, None where the state is seen.
    """

    state: Mapping[str, Value]
    beliefs: Mapping[str, FloatArray]
    path: tuple[str, ...]
    action: str
    observation: Mapping[str, Value] | None
    reward: float


@dataclass(frozen=True)
class Trace(Drawn, Framed):
    """The steps of an episode, the state and belief after them, and whether it has ended."""

    model: Model
    steps: tuple[TracedStep, ...]
    state: Mapping[str, Value]
    beliefs: Mapping[str, FloatArray]
    ended: bool
    seed: int

    @property
    def discounted_return(self) -> float:
        """The discounted sum of the rewards."""
        discount = float(self.model.discount)
        return math.fsum(discount**t * step.reward for t, step in enumerate(self.steps))

    def belief_over_time(self, feature: str) -> FloatArray:
        """The probability of each value of a feature [step, value], the last row after the last step.

        Raises:
            KeyError: the trace holds no belief about it; the message lists those it holds.
        """
        if feature not in self.beliefs:
            listed = ", ".join(self.beliefs) or "none: the state is seen"
            raise KeyError(f"no belief about {feature!r}; there are {listed}")
        return np.array([*(step.beliefs[feature] for step in self.steps), self.beliefs[feature]])


def trace(plan: AnyPlan, *, steps: int = STEPS, seed: int = 0) -> Trace:
    """Run one episode of a plan, of at most so many steps.

    Raises:
        ValueError: fewer than one step.
        TypeError: no plan; policies without a hierarchy have no trace.
    """
    plan = runnable(plan)
    if isinstance(plan, FlatPolicy):
        raise TypeError("a policy without a hierarchy has no trace; `plan` without tasks makes a flat plan")
    if steps < 1:
        raise ValueError(f"{steps} steps; a trace has at least 1")
    if plan.model.observability == "full":
        assert isinstance(plan, ExecutablePlan), "plans over beliefs are of partially observed models"
        return _seen(plan, steps, seed)
    return _unseen(plan, steps, seed)


def _seen(plan: ExecutablePlan, steps: int, seed: int) -> Trace:
    sampler, generator, controller = Sampler(plan.symbolic), np.random.default_rng(seed), Controller(plan)
    states, done, ended = sampler.initial(1, generator), list[TracedStep](), False
    for _ in range(steps):
        state = values_of(plan.model, states)
        decision = controller.poll(state)
        if decision.action is None:
            ended = True
            break
        number = np.array([_number(plan.model, decision.action)])
        states, rewards = sampler.step(states, number, generator)
        path = tuple(poll.task for poll in decision.path)
        done.append(TracedStep(state, {}, path, decision.action, None, float(rewards[0])))
    last = values_of(plan.model, states)
    ended = ended or controller.poll(last).action is None
    return Trace(plan.model, tuple(done), last, {}, ended, seed)


def _unseen(plan: Plan, steps: int, seed: int) -> Trace:
    mind = _Mind(plan, seed)
    sampler, generator = Sampler(plan.symbolic), np.random.default_rng(seed)
    states, done = sampler.initial(1, generator), list[TracedStep]()
    belief = mind.tracker.start(mind.seen(states), ended=bool(sampler.terminal(states)[0]))
    while not belief.ended and len(done) < steps:
        action, path = mind.ask(belief)
        if action is None:
            break
        number = np.array([_number(plan.model, action)])
        following, rewards = sampler.step(states, number, generator)
        values = sampler.observe(states, number, following, generator)[0].tolist()
        channels = [
            (plan.model.observations[j], values[j]) for j in mind.tracker.reader.sensed[int(number[0])]
        ]
        observation = {c.name: c.values[v] for c, v in channels} | mind.seen(following)
        over = bool(sampler.terminal(following)[0])
        known, believed = values_of(plan.model, states), mind.told(belief)
        belief = belief.after(int(number[0]), observation, ended=over)
        done.append(TracedStep(known, believed, path, action, observation, float(rewards[0])))
        states = following
    last = values_of(plan.model, states)
    return Trace(plan.model, tuple(done), last, mind.told(belief), belief.ended, seed)


@dataclass
class _Mind:
    """What tracks and decides (a working state, not a value)."""

    plan: Plan
    seed: int
    tracker: Tracker = field(init=False)

    def __post_init__(self) -> None:
        plan = self.plan
        if isinstance(plan, ExecutablePomdpPlan):
            self.tracker = plan_tracker(plan, on_impossible="reset", seed=self.seed).tracker
            self._polled: BeliefController | LikeliestController = BeliefController(plan)
            self._shown = set(tracked_features(plan))
        else:
            self.tracker = likeliest_tracker(plan, on_impossible="reset", seed=self.seed).tracker
            self._polled = LikeliestController(plan)
            tested, features = support(plan.policy), enumerate(plan.model.features)
            self._shown = {f.name for k, f in features if f.observed or plan.symbolic.now(k) in tested}

    def ask(self, belief: Belief) -> tuple[str | None, tuple[str, ...]]:
        """The action at a belief, and the tasks that were asked."""
        decision = self._polled.poll(belief)
        return decision.action, tuple(poll.task for poll in decision.path)

    def seen(self, states: States) -> dict[str, Value]:
        """The values of the observed features."""
        features = [(i, self.plan.model.features[i]) for i in self.tracker.reader.observed]
        return {feature.name: feature.values[int(states[0, i])] for i, feature in features}

    def told(self, belief: Belief) -> dict[str, FloatArray]:
        """The probabilities of the values of the features that count."""
        return {name: chances for name, chances in belief.marginals().items() if name in self._shown}


def values_of(model: Model, states: States) -> dict[str, Value]:
    """The first of some states [episode, feature] as {feature: value}."""
    numbers = states[0].tolist()
    return {feature.name: feature.values[v] for feature, v in zip(model.features, numbers, strict=True)}


def _number(model: Model, action: str) -> int:
    return [one.name for one in model.actions].index(action)
