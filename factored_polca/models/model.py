"""Factored models: a dynamic Bayesian network for each action, rewards, beliefs, tasks' data.

A model is M = (X, A, P, R, O, b0, gamma) with

    X   features x_1..x_n, a state is one value for each;
    A   actions; P_a(x_i' | parents) for the features an action mentions, the others persist;
    R   R_a(x, x', o) = sum of the model's terms and of the action's own terms;
    O   P_a(o_j | x', x) for the observation features an action senses, the others report `none`;
    b0  the initial belief, a product of conditional distributions and factors.

Parents are features now (x) or, where acyclic, other features next (x', "synchronic" arcs).
Nothing is checked on construction except types: `factored_polca.models.check` reports all faults.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import Any, Literal

from factored_polca.drawn import DrawnGraph
from factored_polca.models.expressions import (
    FALSE,
    TRUE,
    Expression,
    ExpressionLike,
    Reference,
    as_expression,
    lottery,
    rewrite,
)
from factored_polca.models.features import Feature
from factored_polca.models.scalars import Value, scalar
from factored_polca.models.scope import Scope

Observability = Literal["full", "partial"]


def _terms(terms: Any) -> tuple[Expression, ...]:
    if isinstance(terms, (list, tuple)):
        return tuple(as_expression(term) for term in terms)
    return (as_expression(terms),)


def _named(pairs: Any) -> tuple[tuple[str, Expression], ...]:
    items: Iterable[tuple[Any, Any]] = pairs.items() if isinstance(pairs, Mapping) else pairs
    return tuple((key if isinstance(key, str) else key.name, as_expression(value)) for key, value in items)


@dataclass(frozen=True)
class Observation:
    """An observation feature: what one channel can report.

    `null` is the value reported by actions that do not sense the channel.
    """

    name: str
    values: tuple[Value, ...]
    null: Value = "none"

    def __init__(self, name: str, values: Iterable[Value], null: Value = "none") -> None:
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "values", tuple(values))
        object.__setattr__(self, "null", null)


@dataclass(frozen=True)
class Action:
    """An action: the features it changes, where it applies, its own rewards, what it senses.

    `effects` maps features to the distribution of their next value; features it does not mention
    persist.  `applicable` is a condition on the present state.  `rewards` are added to the model's.
    """

    name: str
    effects: tuple[tuple[str, Expression], ...] = ()
    applicable: Expression = TRUE
    rewards: tuple[Expression, ...] = ()
    senses: tuple[tuple[str, Expression], ...] = ()

    def __init__(
        self,
        name: str,
        effects: Mapping[Any, ExpressionLike] | Iterable[tuple[Any, ExpressionLike]] = (),
        *,
        applicable: ExpressionLike = TRUE,
        rewards: ExpressionLike | Iterable[ExpressionLike] = (),
        senses: Mapping[Any, ExpressionLike] | Iterable[tuple[Any, ExpressionLike]] = (),
    ) -> None:
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "effects", _named(effects))
        object.__setattr__(self, "applicable", as_expression(applicable))
        object.__setattr__(self, "rewards", _terms(rewards))
        object.__setattr__(self, "senses", _named(senses))


@dataclass(frozen=True)
class InitialBelief:
    """b0(x) = prod_i P_i(x_i | parents among the features) * prod_j phi_j(x).

    `distributions` gives P_i, an acyclic network over the unprimed features; `factors` are further
    functions phi_j.  A feature without a distribution contributes the factor 1 for each value when
    there are factors, and the uniform distribution when there are none.  The whole sums to 1.
    """

    distributions: tuple[tuple[str, Expression], ...] = ()
    factors: tuple[Expression, ...] = ()

    def __init__(
        self,
        distributions: Mapping[Any, ExpressionLike] | Iterable[tuple[Any, ExpressionLike]] = (),
        factors: Iterable[ExpressionLike] = (),
    ) -> None:
        object.__setattr__(self, "distributions", _named(distributions))
        object.__setattr__(self, "factors", _terms(tuple(factors)))


@dataclass(frozen=True)
class Model(DrawnGraph):
    """A factored MDP or POMDP; see the module's docstring for the letters.

    Names inside expressions are resolved on construction as far as they are known (features,
    observations, parameters, then values); `check` reports those that are not.
    """

    name: str
    features: tuple[Feature, ...]
    actions: tuple[Action, ...]
    rewards: tuple[Expression, ...] = ()
    terminal: Expression = FALSE
    initial: InitialBelief = field(default_factory=InitialBelief)
    discount: Fraction = Fraction(95, 100)
    observability: Observability = "full"
    observations: tuple[Observation, ...] = ()
    parameters: tuple[tuple[str, Fraction], ...] = ()
    horizon: int | None = None
    description: str = ""

    def __init__(
        self,
        name: str,
        features: Iterable[Feature],
        actions: Iterable[Action],
        *,
        rewards: ExpressionLike | Iterable[ExpressionLike] = (),
        terminal: ExpressionLike = FALSE,
        initial: InitialBelief | Mapping[Any, ExpressionLike] | None = None,
        discount: Fraction | float | str = Fraction(95, 100),
        observability: Observability = "full",
        observations: Iterable[Observation] = (),
        parameters: Mapping[str, Any] | Iterable[tuple[str, Any]] = (),
        horizon: int | None = None,
        description: str = "",
    ) -> None:
        put = object.__setattr__
        put(self, "name", name)
        put(self, "features", tuple(features))
        put(self, "observations", tuple(observations))
        pairs = parameters.items() if isinstance(parameters, Mapping) else parameters
        put(self, "parameters", tuple((key, rational(value)) for key, value in pairs))
        put(self, "actions", tuple(resolve_action(self, action) for action in actions))
        put(self, "rewards", tuple(resolve(self, term) for term in _terms(rewards)))
        put(self, "terminal", resolve(self, as_expression(terminal)))
        if not isinstance(initial, InitialBelief):
            initial = InitialBelief(initial or ())
        distributions = [(key, resolve(self, value)) for key, value in initial.distributions]
        factors = [resolve(self, factor) for factor in initial.factors]
        put(self, "initial", InitialBelief(distributions, factors))
        put(self, "discount", rational(discount))
        put(self, "observability", observability)
        put(self, "horizon", horizon)
        put(self, "description", description)

    @property
    def states(self) -> int:
        """The number of states in the full product, terminal and unreachable ones included."""
        return math.prod(len(feature.values) for feature in self.features)

    def feature(self, name: str) -> Feature:
        """The feature called `name`.

        Raises:
            KeyError: there is none; the message lists those there are.
        """
        for feature in self.features:
            if feature.name == name:
                return feature
        raise KeyError(f"no feature {name!r}; there are {', '.join(f.name for f in self.features)}")

    def action(self, name: str) -> Action:
        """The action called `name`.

        Raises:
            KeyError: there is none; the message lists those there are.
        """
        for action in self.actions:
            if action.name == name:
                return action
        raise KeyError(f"no action {name!r}; there are {', '.join(a.name for a in self.actions)}")

    def scope(self) -> Scope:
        """The names that expressions of this model may use."""
        return self._scope

    @cached_property
    def _scope(self) -> Scope:
        names = [value for f in self.features for value in f.values if isinstance(value, str)]
        names += [value for o in self.observations for value in o.values if isinstance(value, str)]
        return Scope(
            features=frozenset(feature.name for feature in self.features),
            observations=frozenset(observation.name for observation in self.observations),
            parameters=frozenset(name for name, _ in self.parameters),
            values=frozenset(names),
        )

    def with_parameters(self, values: Mapping[str, Any]) -> Model:
        """The same model with some parameters set anew.

        Raises:
            KeyError: an unknown parameter; the message lists those there are.
        """
        known = dict(self.parameters)
        for name in values:
            if name not in known:
                listed = ", ".join(known) or "none"
                raise KeyError(f"no parameter {name!r}; the model has {listed}")
        merged = {name: rational(values.get(name, value)) for name, value in known.items()}
        result = replace_fields(self, parameters=tuple(merged.items()))
        return result


def replace_fields(model: Model, **changes: Any) -> Model:
    """A copy of `model` with some fields changed."""
    copy = object.__new__(Model)
    for name in model.__dataclass_fields__:
        object.__setattr__(copy, name, changes.get(name, getattr(model, name)))
    return copy


def rational(value: Any) -> Fraction:
    """`value` as an exact rational: 0.1 and "0.1" are 1/10.

    Raises:
        TypeError: not a number.
        ModelError: a text that is not a constant number.
    """
    from factored_polca.models.expressions import Constant

    expression = as_expression(value)
    if isinstance(expression, Constant) and isinstance(expression.value, Fraction):
        return expression.value
    raise TypeError(f"{value!r} is not a number")


def resolve(model: Model, expression: Expression) -> Expression:
    """`expression` with each bare name turned into what it stands for in `model`, where known."""
    scope = model.scope()

    def leaf(e: Expression) -> Expression:
        if isinstance(e, Reference):
            meaning = scope.resolve(e)
            return e if isinstance(meaning, str) else meaning
        return e

    return rewrite(expression, leaf)


def resolve_action(model: Model, action: Action) -> Action:
    """`action` with the names in its expressions resolved."""
    return Action(
        action.name,
        [(name, resolve(model, e)) for name, e in action.effects],
        applicable=resolve(model, action.applicable),
        rewards=[resolve(model, e) for e in action.rewards],
        senses=[(name, resolve(model, e)) for name, e in action.senses],
    )


def uniform(feature: Feature) -> Expression:
    """The uniform distribution over the values of `feature`."""
    share = Fraction(1, len(feature.values))
    return lottery([(as_expression(_constant(value)), share) for value in feature.values])


def _constant(value: Value) -> Expression:
    from factored_polca.models.expressions import Constant

    return Constant(scalar(value))
