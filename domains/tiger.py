"""Behind one of two doors is a tiger; listen, or open a door: the smallest problem of asking first.

From L. P. Kaelbling, M. L. Littman and A. R. Cassandra, "Planning and acting in partially observable
stochastic domains", Artificial Intelligence 101 (1998), section 5.1; A. R. Cassandra, L. P. Kaelbling
and M. L. Littman, "Acting optimally in partially observable stochastic domains" (AAAI 1994), has the
same problem with the discount 0.75.

Two states: the tiger is behind the left or the right door, each with probability 1/2 at the start.
To listen costs 1 and tells the door, rightly with probability `accuracy`.  To open the tiger's door
costs 100, the other door brings 10; either way the tiger is put behind a random door again, and
what is heard then is a fair coin.

With accuracy 0.85 the optimal value at the start is 19.371368 for discount 0.95 and 1.933439 for
discount 0.75, each with 9 alpha vectors (several solvers agree on it).  There is no hierarchy.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor, probability
from factored_polca.models import (
    Action,
    Expression,
    Feature,
    Model,
    Observation,
    Switch,
    TaskHierarchy,
    conditional,
    flat_task,
    lottery,
    uniform,
)

Accuracy = Annotated[Number, "probability that what is heard is right"]
Discount = Annotated[Number, "discount, from 0 to 1"]

_DOORS = ("left", "right")


def model(*, accuracy: Accuracy = Fraction(85, 100), discount: Discount = Fraction(95, 100)) -> Model:
    """The POMDP of two states, three actions and two observations.

    Raises:
        ModelError: a parameter out of its range.
    """
    right = probability("accuracy", accuracy)
    tiger = Feature("tiger", _DOORS)
    growl = Observation("growl", _DOORS)
    return Model(
        "tiger",
        [tiger],
        [
            Action("listen", rewards=-1, senses={growl: _heard(tiger, right)}),
            *(
                Action(
                    f"open_{door}",
                    {tiger: uniform(tiger)},
                    rewards=conditional(tiger.is_(door), -100, 10),
                    senses={growl: _heard(tiger, Fraction(1, 2))},
                )
                for door in _DOORS
            ),
        ],
        initial={tiger: uniform(tiger)},
        discount=discount_factor(discount),
        observability="partial",
        observations=[growl],
        description="Listen for the tiger behind one of two doors, or open one.",
    )


def _heard(tiger: Feature, right: Fraction) -> Expression:
    """The growl comes from the tiger's door with probability `right`, after the action."""
    left, other = _DOORS
    return Switch(
        tiger.next,
        (
            (left, lottery({left: right, other: 1 - right})),
            (other, lottery({left: 1 - right, other: right})),
        ),
    )


def tasks(
    *, accuracy: Accuracy = Fraction(85, 100), discount: Discount = Fraction(95, 100)
) -> TaskHierarchy:
    """One task over all actions.

    Raises:
        ModelError: a parameter out of its range.
    """
    return flat_task(model(accuracy=accuracy, discount=discount))
