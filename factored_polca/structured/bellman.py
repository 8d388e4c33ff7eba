"""The Bellman operator of a decision process on float diagrams.

This is SPUDD (Hoey, St-Aubin, Hu & Boutilier 1999) on diagrams with any number of values.

Letters: x a state, c a choice, p a primitive action, V a function of states, gamma the discount.

    Q_p(x) = R_p(x) + gamma sum_x' P_p(x' | x) V(x')            for each primitive in use,
    Q_c(x) = Q_p(x), p what c stands for at x                   where c is safe, minus infinity elsewhere,
    (T V)(x) = max_c Q_c(x)                                     where some choice is, 0 elsewhere.

Safe means that c applies and leads into no dead end (`dead_ends`).  Where there is no choice the process
has ended, or the state is lost or out of reach: V must be 0 there.

Rounding.  Each number of the model is the nearest float.  The regression sums each changed feature of d
values out with d products, so with K = the sum of (d + 1) over the features,

    |computed Q - Q| <= (K + 6) u max |V| + (k + 3) u r                  u = 2^-53,

where k is the number of reward terms of the action and r the sum of their largest values (Higham 2002,
section 3.1, doubled here to cover terms of second order and numbers below the normal range).  Regressions
that are rounded to multiples of a step on purpose (`stepped`) add gamma n step / 2, n features being
changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, TypeAlias

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import FLOAT, Diagram, apply, choose
from factored_polca.diagrams.operations import Walk
from factored_polca.minimisation.criterion import DecisionProcess, largest_reward
from factored_polca.structured.dead_ends import Safety, find_safety
from factored_polca.structured.stepped import SteppedView
from factored_polca.symbolic.floats import as_float

FloatArray: TypeAlias = npt.NDArray[np.float64]

UNIT: Final = 2.0**-53
TIE_TOLERANCE: Final = 1e-9
"""Q-values within this much of the best, relative to it where it exceeds 1, tie with it."""


class Bellman:
    """The operator T of one process, with its greedy policies.

    Raises (when made):
        ModelError: a reward beyond the range of floats.
        MemoryLimit, Aborted: as the manager says.
    """

    def __init__(self, process: DecisionProcess) -> None:
        self.process = process
        symbolic = process.symbolic
        self.manager = symbolic.manager
        self.numbers = SteppedView(symbolic)
        self.discount = float(symbolic.model.discount)
        self.zero = self.numbers.zero
        self.lowest = self.manager.constant(-np.inf, FLOAT)
        self.primitives = sorted({p for choice in process.choices for p in choice.primitives})
        for p in self.primitives:
            for term in process.rewards[p]:
                for value in term.values:
                    as_float(value, symbolic.actions[p].name)
        self.largest_reward = max((float(largest_reward(process, p)) for p in self.primitives), default=0.0)
        self.safety: Safety = find_safety(process)
        self.rewards = {p: self.numbers.total(process.rewards[p]) for p in self.primitives}
        self.masks = [
            [(p, choice.where(p) & safe) for p in choice.primitives]
            for choice, safe in zip(process.choices, self.safety.safe, strict=True)
        ]  # [choice] where it is safe and stands for which primitive
        sizes = [len(feature.values) + 1 for feature in symbolic.model.features]
        self._numbers = 0
        self._sum_terms = sum(sizes)
        self._reward_terms = max((len(process.rewards[p]) for p in self.primitives), default=0)

    def next_number(self) -> int:
        """A number not used before, to tell remembered results apart."""
        self._numbers += 1
        return self._numbers

    @property
    def has_fixed(self) -> bool:
        """Whether some choice may lead to a state whose value is fixed: one that has ended."""
        ended = self.process.terminal
        if self.process.reachable is not None:
            ended = ended & self.process.reachable
        return ended != self.manager.constant(0)

    def error(self, largest: float) -> float:
        """A bound on |computed T V - T V| for |V| <= `largest`; it holds for each Q-value."""
        return self.float_error(largest) + self.steps() * self.numbers.step / 2

    def float_error(self, largest: float) -> float:
        """The same without steps."""
        terms = (self._sum_terms + 6) * largest + (self._reward_terms + 3) * self.largest_reward
        return 2 * UNIT * terms + 1e-300

    def steps(self) -> int:
        """How often a regression rounds on one path, at most."""
        actions = self.process.symbolic.actions
        return max((len(actions[p].rows) for p in self.primitives), default=0)

    def masked(self, value: Diagram) -> Diagram:
        """`value` where there are choices, 0 elsewhere."""
        return choose(self.safety.free, value, self.zero)

    def q_values(self, value: Diagram) -> list[Diagram]:
        """Q_c for each choice, minus infinity where c is not safe."""
        scaled = scale_leaves(value, self.discount)
        by_primitive = {p: self.rewards[p] + self.numbers.regress(p, scaled) for p in self.primitives}
        found = []
        for masks in self.masks:
            result = self.lowest
            for p, where in masks:
                result = choose(where, by_primitive[p], result)
            found.append(result)
        return found

    def best(self, q_values: list[Diagram]) -> Diagram:
        """max_c Q_c, 0 where there is no choice."""
        result = self.lowest
        for q in q_values:
            result = apply("maximum", result, q)
        return self.masked(result)

    def greedy(self, q_values: list[Diagram], best: Diagram, gap: float = 0.0) -> Diagram:
        """The number of the first choice whose Q-value is within the tolerance, plus `gap`, of the best;
        where there is no choice the number of choices."""
        none = self.manager.constant(len(q_values))
        result = first_best(list(enumerate(q_values)), best, none, gap)
        return choose(self.safety.free, result, none)

    def chosen(self, policy: Diagram, q_values: list[Diagram]) -> Diagram:
        """Q of the choice that `policy` [x] -> choice takes, 0 where there is none."""
        result = self.zero
        for number, q in enumerate(q_values):
            result = choose(policy.equals(self.manager.constant(number)), q, result)
        return self.masked(result)

    def extremes(self, difference: Diagram) -> tuple[float, float]:
        """The least and the largest leaf of `difference` where there are choices; (0, 0) if nowhere."""
        values = leaf_values(choose(self.safety.free, difference, self.lowest))
        values = values[values > -np.inf]
        return (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)

    def primitive_policy(self, policy: Diagram) -> Diagram:
        """The primitive that a policy [x] -> choice takes; the number of the model's actions if none."""
        return primitive_policy(self.process, policy)


def primitive_policy(process: DecisionProcess, policy: Diagram) -> Diagram:
    """The primitive that a policy [x] -> choice takes; the number of the model's actions if none."""
    manager = process.symbolic.manager
    result = manager.constant(len(process.symbolic.actions))
    for number, choice in enumerate(process.choices):
        taken = policy.equals(manager.constant(number))
        primitive = choice.policy
        if primitive is None:
            primitive = manager.constant(choice.primitives[0])
        result = choose(taken, primitive, result)
    return result


def first_best(
    values: Sequence[tuple[int, Diagram]], best: Diagram, none: Diagram, gap: float = 0.0
) -> Diagram:
    """The first number whose value is within the tolerance, plus `gap`, of the best; else `none`."""
    threshold = map_leaves(best, lambda v: v - TIE_TOLERANCE * np.maximum(1.0, np.abs(v)) - gap)
    result = none
    for number, value in reversed(values):
        below = apply("less", value, threshold)
        result = choose(below, result, none.manager.constant(number))
    return result


def leaf_values(diagram: Diagram) -> FloatArray:
    """The leaves of a float diagram."""
    values: FloatArray = Walk(diagram).leaf_payloads().view(np.float64)
    return values


def map_leaves(diagram: Diagram, function: Callable[[FloatArray], FloatArray]) -> Diagram:
    """A float diagram with each leaf replaced; `function` maps arrays of floats."""
    diagram.manager.safe_point()
    walk = Walk(diagram)
    return walk.with_leaves(function(walk.leaf_payloads().view(np.float64)), FLOAT)


def scale_leaves(diagram: Diagram, factor: float) -> Diagram:
    """A float diagram times a number."""
    return map_leaves(diagram, lambda v: v * factor)
