"""A user wants his medicine checked, or a walk to the kitchen or the bedroom; asking is a task's too.

From the talk "Hierarchical POMDP planning and execution" by J. Pineau (Carnegie Mellon, November 2000), the
smallest example of a POMDP with a task hierarchy: three states, four actions, four observations, and one
clarifying action that two levels share:

    Act = {CheckMeds, ClarifyTask, Move}      Move = {ClarifyTask, GoToKitchen, GoToBedroom}

It is also its example of an abstract action's parameters: for a user who wants his medicine, Move has
nothing better to do than to ask, so that Move stands for ClarifyTask there.

The one feature is the user's `wish`: meds, kitchen or bedroom, all equally likely at the start.
ClarifyTask costs 1 and changes nothing; what is understood is the `word` for the wish with probability
`accuracy`, and else noise half of the time, or one of the two other words.  The action that fits the wish
brings 10, either of the two others costs 50; each ends the matter, and the next wish is a new one.  Then
`word` is noise.

The talk's slides name states, actions, observations and tasks.  Ours are the rewards, what follows an
action, the discount, and the reading of the 0.8 and 0.1 beside the arcs of its figure as chances of
understanding.  A wrong action costs so much that one word is not enough.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor, probability
from factored_polca.models import (
    Action,
    Feature,
    Model,
    Observation,
    Switch,
    Task,
    TaskHierarchy,
    conditional,
    lottery,
    uniform,
)

Accuracy = Annotated[Number, "probability that a wish is understood when asked for"]
Discount = Annotated[Number, "discount, from 0 to 1"]

_FITTING = {"meds": "CheckMeds", "kitchen": "GoToKitchen", "bedroom": "GoToBedroom"}


def model(*, accuracy: Accuracy = Fraction(8, 10), discount: Discount = Fraction(95, 100)) -> Model:
    """The POMDP of three states, four actions and four observations.

    Raises:
        ModelError: a parameter out of its range.
    """
    right = probability("accuracy", accuracy)
    wish = Feature("wish", list(_FITTING))
    word = Observation("word", ["noise", *_FITTING], null="noise")
    understood = []
    for said in _FITTING:
        others = dict.fromkeys((other for other in _FITTING if other != said), (1 - right) / 4)
        understood.append((said, lottery({said: right, "noise": (1 - right) / 2, **others})))
    return Model(
        "meds",
        [wish],
        [
            Action("ClarifyTask", rewards=-1, senses={word: Switch(wish.next, tuple(understood))}),
            *(
                Action(name, {wish: uniform(wish)}, rewards=conditional(wish.is_(wanted), 10, -50))
                for wanted, name in _FITTING.items()
            ),
        ],
        initial={wish: uniform(wish)},
        discount=discount_factor(discount),
        observability="partial",
        observations=[word],
        description="Ask what the user wants, or do one of three things.",
    )


def tasks(*, accuracy: Accuracy = Fraction(8, 10), discount: Discount = Fraction(95, 100)) -> TaskHierarchy:
    """Act{CheckMeds, ClarifyTask, Move{ClarifyTask, GoToKitchen, GoToBedroom}}.

    No parameter changes anything here.
    """
    return TaskHierarchy(
        [
            Task("Act", ["CheckMeds", "ClarifyTask", "Move"]),
            Task("Move", ["ClarifyTask", "GoToKitchen", "GoToBedroom"]),
        ]
    )
