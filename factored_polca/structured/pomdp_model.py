"""A partially observed model as small diagrams, one family for each value of what is seen.

Observed features are known at every step (mixed observability; Ong, Png, Hsu & Lee 2010).  Let y be their
values and x those of the others, the *hidden* features.  A belief is a value y and a distribution over x,
and every function of the state is used at one y at a time, as a diagram over x only.  For a value y and an
action a, a *step* has

    R(x)                 the expected reward, 0 where y, x is terminal,
    P(x_k' | x, x')      for each hidden feature k that the action changes,
    W_o(x, x')           for each *outcome* o = (y', joint observation): the probability of y' and of the
                         observation, and that the episode goes on, given x and x'.

The next value x_k' of a feature that the action leaves alone is x_k itself and needs no variable.  The
regression of functions A_o of x', one for each outcome, is

    sum over o, x' of  P(x' | x) W_o(x, x') A_o(x'),

W_o A_o being summed over the outcomes of one y' first; then the changed features are summed out one by one,
children of synchronic arcs before their parents.  Outcomes of one y' whose W are proportional lead to the
same belief and are one.

Joint observations are listed, and so are the y' that may follow: they must be few.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Final

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import (
    FLOAT,
    Diagram,
    apply,
    choose,
    cofactors,
    leaves,
    move,
    relabel,
    restrict,
    support,
    weighted_sum,
)
from factored_polca.models import LimitReached, ModelError
from factored_polca.symbolic import NumericView, RowDiagram, SymbolicModel
from factored_polca.symbolic.floats import as_float

FloatArray = npt.NDArray[np.float64]
Seen = tuple[int, ...]
"""The numbers of the values of the observed features."""

OUTCOME_LIMIT: Final = 1_000
"""Pairs of a next y and a joint observation that an action may have at one y."""

UNIT: Final = 2.0**-53


@dataclass(frozen=True, eq=False)
class Outcome:
    """What may come in after an action: the next y', and W_o(x, x') as one diagram and as factors."""

    seen: Seen
    weight: Diagram
    parts: tuple[Diagram, ...]
    channels: tuple[tuple[int, ...], ...]  # the values of the sensed channels that it stands for


@dataclass(frozen=True, eq=False)
class Step:
    """An action at one y.

    `roundings` is how many units in the last place a backup may be off, relative to the largest number
    that it meets.
    """

    seen: Seen
    action: int
    reward: Diagram
    largest_reward: float
    changed: tuple[int, ...]  # hidden features, in the order in which they are summed out
    weights: dict[tuple[Seen, int], list[Diagram]]  # [y', feature][value]
    outcomes: tuple[Outcome, ...]
    roundings: int


def largest(diagram: Diagram) -> float:
    """The largest absolute value of a float diagram."""
    return max(abs(float(value)) for value in leaves(diagram))


class FactoredPOMDP:
    """A compiled model with a discount below 1, as steps that are made when first asked for.

    Raises:
        ModelError: fully observed, or a discount of 1, or a finite horizon.
    """

    def __init__(self, symbolic: SymbolicModel) -> None:
        model = symbolic.model
        if model.observability != "partial":
            raise ModelError("alpha-vectors as diagrams are for partially observed models")
        if model.horizon is not None or not model.discount < 1:
            raise ModelError("alpha-vectors as diagrams need a discount below 1 and no horizon")
        for action in symbolic.actions:
            for term in action.rewards:
                for value in term.values:
                    as_float(value, action.name)
        self.symbolic = symbolic
        self.manager = symbolic.manager
        self.numbers = NumericView(symbolic)
        self.discount = float(model.discount)
        self.features = model.features
        self.observed = tuple(i for i, f in enumerate(model.features) if f.observed)
        self.hidden = tuple(i for i, f in enumerate(model.features) if not f.observed)
        self.zero, self.one = self.numbers.zero, self.numbers.one
        self.live = choose(symbolic.terminal, self.zero, self.one)
        self._steps: dict[tuple[Seen, int], Step] = {}
        self._rewards: dict[int, Diagram] = {}

    @property
    def actions(self) -> int:
        """How many actions there are."""
        return len(self.symbolic.actions)

    def at(self, seen: Seen, diagram: Diagram) -> Diagram:
        """A function of the state at one y: a diagram over the hidden features."""
        symbolic = self.symbolic
        return restrict(diagram, {symbolic.now(i): v for i, v in zip(self.observed, seen, strict=True)})

    def reward(self, action: int) -> Diagram:
        """The expected reward over the whole state, 0 where it is terminal."""
        if action not in self._rewards:
            total = self.numbers.total(self.symbolic.actions[action].rewards)
            self._rewards[action] = choose(self.symbolic.terminal, self.zero, total)
        return self._rewards[action]

    def step(self, seen: Seen, action: int) -> Step:
        """The action at one y.

        Raises:
            LimitReached: too many outcomes; the message names what has too many values.
        """
        key = (seen, action)
        if key not in self._steps:
            self._steps[key] = self._made(seen, action)
        return self._steps[key]

    # -- making a step ---------------------------------------------------------------------------

    def _made(self, seen: Seen, action: int) -> Step:
        symbolic = self.symbolic
        compiled = symbolic.actions[action]
        changed = tuple(i for i in compiled.elimination if i in compiled.rows and i in self.hidden)
        reward = self.at(seen, self.reward(action))
        found = list(self._outcomes(seen, action))
        weights = {
            (outcome.seen, k): [
                self._placed(part, seen, outcome.seen, action) for part in self.numbers.weights(action, k)
            ]
            for outcome in found
            for k in changed
        }
        sizes = sum(len(self.features[k].values) + 2 for k in changed)
        factors = len(compiled.observations) + len(self.observed) + 2
        terms = len(compiled.rewards)
        roundings = 2 * (sizes + factors + len(found) + terms) + 16
        bound = sum(max((abs(float(v)) for v in t.values), default=0.0) for t in compiled.rewards)
        return Step(seen, action, reward, bound, changed, weights, tuple(found), roundings)

    def _placed(self, diagram: Diagram, seen: Seen, then: Seen, action: int) -> Diagram:
        """A function of the two states with y and y' put in, and x_k for x_k' where a leaves k alone."""
        symbolic = self.symbolic
        fixed = {symbolic.now(i): v for i, v in zip(self.observed, seen, strict=True)}
        fixed |= {symbolic.next(i): v for i, v in zip(self.observed, then, strict=False)}
        diagram = restrict(diagram, fixed)
        tested = set(support(diagram))
        for k in self.hidden:
            if symbolic.next(k) in tested and k not in symbolic.actions[action].rows:
                diagram = self.branch(symbolic.now(k), cofactors(diagram, symbolic.next(k)))
        return diagram

    def branch(self, level: int, parts: Sequence[Diagram]) -> Diagram:
        """parts[v] where the variable at `level` has its value v; parts may test levels above."""
        result = parts[-1]
        for value, part in enumerate(parts[:-1]):
            result = choose(self.manager.indicator(level, [value]), part, result)
        return result

    def _outcomes(self, seen: Seen, action: int) -> Iterator[Outcome]:
        """The outcomes, those of one y' together."""
        count = 0
        for then, parts in self._next_seen(seen, action):
            alive = self._placed(self._shifted(self.live), seen, then, action)
            if alive == self.zero:
                continue
            found: list[tuple[Outcome, Diagram]] = []
            for values, sensed in self._readings(seen, then, action):
                factors = [part for part in (*parts, *sensed, alive) if part != self.one]
                weight = reduce(lambda a, b: a * b, factors, self.one)
                if weight == self.zero:
                    continue
                shape = weight * self.manager.constant(1.0 / float(leaves_of(weight)[0]), FLOAT)
                for number, (known, known_shape) in enumerate(found):
                    if known_shape == shape:
                        merged = Outcome(
                            then, known.weight + weight, (known.weight + weight,), (*known.channels, values)
                        )
                        found[number] = (merged, shape)
                        break
                else:
                    found.append((Outcome(then, weight, tuple(factors), (values,)), shape))
                if count + len(found) > OUTCOME_LIMIT:
                    raise self._too_many(action)
            count += len(found)
            yield from (outcome for outcome, _ in found)

    def _too_many(self, action: int) -> LimitReached:
        symbolic = self.symbolic
        compiled = symbolic.actions[action]
        named = [
            f"{symbolic.model.observations[j].name} ({len(symbolic.model.observations[j].values)} values)"
            for j in compiled.observations
        ]
        named += [
            f"{self.features[i].name} ({len(self.features[i].values)} values)"
            for i in self.observed
            if i in compiled.rows
        ]
        return LimitReached(
            f"action {compiled.name!r} has more than {OUTCOME_LIMIT:,} joint observations, of "
            f"{', '.join(named)}; solving on diagrams lists them: coarsen or drop some",
            "outcomes",
        )

    def _shifted(self, diagram: Diagram) -> Diagram:
        return self.numbers.shift(diagram)

    def _next_seen(self, seen: Seen, action: int) -> Iterator[tuple[Seen, list[Diagram]]]:
        """The y' that may follow, each with the factors of its probability.

        Parents of synchronic arcs come first, so that what is read of y' is known.
        """
        symbolic = self.symbolic
        compiled = symbolic.actions[action]
        order = [i for i in reversed(compiled.elimination) if i in self.observed]
        place = {i: n for n, i in enumerate(self.observed)}

        def extend(known: dict[int, int], factors: list[Diagram]) -> Iterator[tuple[Seen, list[Diagram]]]:
            if len(known) == len(order):
                yield tuple(known[i] for i in self.observed), factors
                return
            i = order[len(known)]
            if i not in compiled.rows:
                yield from extend({**known, i: seen[place[i]]}, factors)
                return
            fixed = {symbolic.now(j): v for j, v in zip(self.observed, seen, strict=True)}
            fixed |= {symbolic.next(j): v for j, v in known.items()}
            for value, part in enumerate(self.numbers.weights(action, i)):
                chance = self._placed(restrict(part, fixed), seen, (), action)
                if chance != self.zero:
                    kept = factors if chance == self.one else [*factors, chance]
                    yield from extend({**known, i: value}, kept)

        yield from extend({}, [])

    def _readings(
        self, seen: Seen, then: Seen, action: int
    ) -> Iterator[tuple[tuple[int, ...], list[Diagram]]]:
        """The joint values of the sensed channels, each with the factors of its probability."""
        channels = sorted(self.symbolic.actions[action].observations.items())

        def extend(
            number: int, values: tuple[int, ...], factors: list[Diagram]
        ) -> Iterator[tuple[tuple[int, ...], list[Diagram]]]:
            if number == len(channels):
                yield values, factors
                return
            row = channels[number][1]
            for value in range(len(row.rows[0])):
                part = self._placed(self.chance(row, value), seen, then, action)
                if part != self.zero:
                    yield from extend(number + 1, (*values, value), [*factors, part])

        yield from extend(0, (), [])

    def chance(self, row: RowDiagram, value: int) -> Diagram:
        """P(value | parents) of a row diagram."""
        return relabel(row.diagram, np.array([float(r[value]) for r in row.rows]), FLOAT)

    # -- using it --------------------------------------------------------------------------------

    def to_next(self, step: Step, diagram: Diagram) -> Diagram:
        """A function of x as the same function of x', for the features that the step changes."""
        symbolic = self.symbolic
        if not step.changed:
            return diagram
        return move(diagram, {symbolic.now(k): symbolic.next(k) for k in step.changed})

    def eliminate(self, step: Step, then: Seen, function: Diagram) -> Diagram:
        """The expectation over x' of a function of (x, x'), y' being given."""
        for k in step.changed:
            level = self.symbolic.next(k)
            if level in support(function):
                parts = cofactors(function, level)
                function = weighted_sum(step.weights[then, k], parts, normalised=True)
        return function

    def regress(self, step: Step, functions: Sequence[Diagram]) -> Diagram:
        """sum over o, x' of P(x' | x) W_o(x, x') A_o(x'), for `functions` A_o over x."""
        total = self.zero
        by_seen: dict[Seen, Diagram] = {}
        for outcome, function in zip(step.outcomes, functions, strict=True):
            part = outcome.weight * self.to_next(step, function)
            before = by_seen.get(outcome.seen)
            by_seen[outcome.seen] = part if before is None else before + part
        for then, function in by_seen.items():
            total = total + self.eliminate(step, then, function)
        return total

    def backup_error(self, step: Step, size: float) -> float:
        """How far R + discount * regression may be off by rounding, for functions up to `size`."""
        return step.roundings * 2 * UNIT * (step.largest_reward + size)

    def shifted_by(self, diagram: Diagram, amount: float) -> Diagram:
        """A float diagram plus a constant."""
        return apply("plus", diagram, self.manager.constant(amount, FLOAT))


def leaves_of(weight: Diagram) -> list[float]:
    """The leaves of a float diagram other than 0, by first occurrence."""
    return [float(value) for value in leaves(weight) if value]
