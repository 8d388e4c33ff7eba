"""What `run` keeps of an episode: its steps, what was believed, and the figures that follow."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

import numpy as np

from factored_polca.cli.pilot import Said
from factored_polca.control.tracker import Belief
from factored_polca.models import Model, Value

SHOWN_VALUES: Final = 4
"""Values of a feature that are shown, the likeliest ones."""

SURE: Final = 1 - 1e-12
"""Probability from which a value is called certain: 1 but for rounding."""

Hypotheses: TypeAlias = list[tuple[str, list[tuple[Value, float]]]]
"""Features by name, and for each its values with their probabilities, likeliest first."""


@dataclass(frozen=True)
class Step:
    """One step: the belief before it, what was done, and what came of it (None: not known yet)."""

    belief: Belief
    said: Said
    observation: dict[str, Value] | None = None
    ended: bool = False
    likelihood: float | None = None
    reward: float | None = None


@dataclass
class Episode:
    """The steps so far, and the belief after them (a working state, not a value)."""

    model: Model
    features: tuple[str, ...]
    steps: list[Step] = field(default_factory=list)
    belief: Belief | None = None

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        return self.belief is not None and self.belief.ended

    def hypotheses(self, belief: Belief) -> tuple[dict[str, Value], Hypotheses]:
        """Tracked features whose value is certain, and the values of the others, likeliest first."""
        sure, unsure = dict[str, Value](), Hypotheses()
        for name, chances in belief.marginals().items():
            if name not in self.features:
                continue
            order = np.argsort(-chances, kind="stable")
            values = self.model.feature(name).values
            found = [(values[v], float(chances[v])) for v in order.tolist() if chances[v] > 0]
            if found[0][1] > SURE:
                sure[name] = found[0][0]
            else:
                unsure.append((name, found))
        return sure, unsure

    def log_likelihood(self) -> float:
        """The natural logarithm of the probability of all that was observed, given the actions."""
        chances = [step.likelihood or 0.0 for step in self.steps]
        return sum(math.log(q) if q > 0 else -math.inf for q in chances)

    def earned(self, discount: float) -> float:
        """The discounted sum of the rewards."""
        return math.fsum(discount**t * (step.reward or 0.0) for t, step in enumerate(self.steps))

    def data(self, decide: Callable[[Belief], Said], *, rewarded: bool) -> dict[str, Any]:
        """The episode as plain data; the last step has no observation where none came."""
        steps = list(self.steps)
        if self.belief is not None and not self.ended:
            steps.append(Step(self.belief, decide(self.belief)))
        result: dict[str, Any] = {
            "steps": [self.step_data(step, rewarded) for step in steps],
            "ended": self.ended,
            "log_likelihood": self.log_likelihood(),
        }
        if rewarded:
            result["return"] = self.earned(float(self.model.discount))
            result["undiscounted_return"] = self.earned(1.0)
        return result

    def step_data(self, step: Step, rewarded: bool) -> dict[str, Any]:
        """A step as plain data; beliefs are those before it."""
        sure, unsure = self.hypotheses(step.belief)
        known = {name: [(value, 1.0)] for name, value in sure.items()} | dict(unsure)
        beliefs = {
            name: [{"value": value, "probability": q} for value, q in known[name][:SHOWN_VALUES]]
            for name in self.features
            if name in known
        }
        data: dict[str, Any] = {
            "action": step.said.action,
            "path": step.said.path,
            "beliefs": beliefs,
            "observation": step.observation,
            "ended": step.ended,
            "likelihood": step.likelihood,
        }
        if step.said.state is not None:
            data["likeliest_state"] = dict(step.said.state)
        if rewarded:
            data["reward"] = step.reward
        return data
