"""Random models with parameters p, q (any values from 0 to 1) and r, made from random models.

A distribution (c_1, .., c_n) of a model becomes w c + (1 - w) c', where c' has the same probabilities in
another order and w is a function of the parameters that lies in [0, 1] for all values of p and q there.
So at p = 0 and p = 1 rows turn into plain ones, at p = 1/2 rows with w and 1 - w coincide.  Rewards
become multiples of r or fractions with 1 + q.
"""

from __future__ import annotations

from fractions import Fraction
from random import Random

from changed_models import replace_action
from random_models import random_model
from random_pomdps import random_pomdp

from factored_polca.models import (
    Action,
    Conditional,
    Constant,
    Expression,
    InitialBelief,
    Lottery,
    Model,
    Parameter,
    Switch,
)
from factored_polca.models.expressions import ONE
from factored_polca.models.model import replace_fields

NAMES = ("p", "q", "r")
SPECIAL = (Fraction(0), Fraction(1), Fraction(1, 2))


def weights() -> list[Expression]:
    """Functions of p and q with values in [0, 1]."""
    p, q = Parameter("p"), Parameter("q")
    return [p, 1 - p, p, 1 - p, q, p * q, p**2, p / (1 + q), (1 - p) / 2 + q / 2, 1 - p * (1 - q) ** 3]


class _Maker:
    def __init__(self, random: Random) -> None:
        self.random = random
        self.weights = random.sample(weights(), 3)

    def mixed(self, lottery: Lottery) -> Expression:
        chances = [q for _, q in lottery.outcomes]
        positive = [
            isinstance(q, Constant) and isinstance(q.value, Fraction) and q.value > 0 for q in chances
        ]
        if sum(positive) < 2 or not all(isinstance(q, Constant) for q in chances):
            return lottery
        if self.random.random() < 0.35:
            return lottery
        w = self.random.choice(self.weights)
        places = [i for i, good in enumerate(positive) if good]
        turned = dict(zip(places, places[1:] + places[:1], strict=True))
        outcomes = []
        for i, (value, chance) in enumerate(lottery.outcomes):
            outcomes.append((value, w * chance + (1 - w) * chances[turned[i]] if i in turned else chance))
        return Lottery(tuple(outcomes))

    def distribution(self, e: Expression) -> Expression:
        match e:
            case Lottery():
                return self.mixed(e)
            case Conditional():
                return Conditional(e.condition, self.distribution(e.then), self.distribution(e.otherwise))
            case Switch():
                otherwise = None if e.otherwise is None else self.distribution(e.otherwise)
                cases = tuple((value, self.distribution(case)) for value, case in e.cases)
                return Switch(e.reference, cases, otherwise)
        return e

    def reward(self, e: Expression) -> Expression:
        match e:
            case Conditional():
                return Conditional(e.condition, self.reward(e.then), self.reward(e.otherwise))
            case Switch():
                otherwise = None if e.otherwise is None else self.reward(e.otherwise)
                return Switch(e.reference, tuple((v, self.reward(c)) for v, c in e.cases), otherwise)
        kind = self.random.random()
        if kind < 0.2:
            return e * Parameter("r")
        if kind < 0.3:
            return e / (ONE + Parameter("q"))
        return e + Parameter("r") ** 2 if kind < 0.35 else e

    def action(self, action: Action) -> Action:
        return replace_action(
            action,
            effects=[(name, self.distribution(e)) for name, e in action.effects],
            senses=[(name, self.distribution(e)) for name, e in action.senses],
            rewards=[self.reward(e) for e in action.rewards],
        )


def with_parameters(model: Model, seed: int) -> Model:
    """A model with the parameters p, q and r in place of some of its numbers."""
    maker = _Maker(Random(f"parameters {seed}"))
    initial = model.initial
    if not initial.factors:
        distributions = [(name, maker.distribution(e)) for name, e in initial.distributions]
        initial = InitialBelief(distributions)
    nominal = (("p", Fraction(1, 3)), ("q", Fraction(1, 4)), ("r", Fraction(2)))
    return replace_fields(
        model,
        actions=tuple(maker.action(action) for action in model.actions),
        rewards=tuple(maker.reward(e) for e in model.rewards),
        initial=initial,
        parameters=nominal,
    )


def parametric_mdp(seed: int) -> Model:
    """A random fully observed model with parameters, of at most 48 states."""
    return with_parameters(random_model(seed, features=(2, 4), values=(2, 3), max_states=48), seed)


def parametric_pomdp(seed: int) -> Model:
    """A random partially observed model with parameters, of at most 12 states."""
    return with_parameters(random_pomdp(seed), seed)


def settings(seed: int, count: int) -> list[dict[str, Fraction]]:
    """Settings of p, q and r: special values among them, at least one in each third setting."""
    random = Random(f"settings {seed}")
    result = []
    for number in range(count):
        values = {name: Fraction(random.randint(1, 98), random.choice((99, 100, 150))) for name in NAMES}
        if number % 3 == 0:
            values["p"] = SPECIAL[number // 3 % 3]
        if number % 4 == 0:
            values["q"] = random.choice(SPECIAL)
        if number % 5 == 0:
            values["r"] = Fraction(random.choice((0, 1, -2)))
        result.append(values)
    return result


def generic(seed: int) -> dict[str, Fraction]:
    """A setting that no model here singles out: numbers of 60 random bits."""
    random = Random(f"generic {seed}")
    return {name: Fraction(random.randrange(1, 2**60), 2**60 + 33) for name in NAMES}
