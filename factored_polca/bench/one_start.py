"""A model from one state, for a program that lists the states it may start in one by one.

Storm finds the states of an `init` with an SMT solver, each for itself, which would take most of its time.
"""

from __future__ import annotations

from fractions import Fraction

from factored_polca.models import FALSE, TRUE, Action, Model, boolean, conjunction, lottery, operation
from factored_polca.models.expressions import Constant
from factored_polca.models.model import InitialBelief, replace_fields
from factored_polca.models.scalars import scalar


def started_by_an_action(model: Model) -> Model:
    """The model from one state, where an action `begin` leads to all states alike: one state more."""
    uniform = {
        feature.name: lottery(
            [(Constant(scalar(value)), Fraction(1, len(feature.values))) for value in feature.values]
        )
        for feature in model.features
    }
    first = {feature.name: Constant(scalar(feature.values[0])) for feature in model.features}
    started = boolean("started")
    actions = [
        Action(a.name, a.effects, applicable=conjunction([started.now, a.applicable]), rewards=a.rewards)
        for a in model.actions
    ]
    effects = [*uniform.items(), (started.name, TRUE)]
    begin = Action("begin", effects, applicable=operation("not", started.now))
    return replace_fields(
        model, features=(*model.features, started), actions=(begin, *actions),
        initial=InitialBelief({**first, started.name: FALSE}),
    )  # fmt: skip
