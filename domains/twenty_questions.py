"""Somebody thinks of one of twelve objects; ask questions about it, then guess.

After the game of twenty questions among the test problems of J. Pineau's thesis "Tractable planning under
uncertainty: exploiting structure" (Carnegie Mellon, 2004), which was not at hand: from it come the idea,
twelve objects, and twenty actions, eight questions and twelve guesses, answered by yes, no or noise.  The
objects, what is true of them, all numbers and the hierarchy are ours.

               white   brown   red     hard    large
    animal     X                               X       polar_bear
    animal             X                               monkey
    animal                     X                       robin
    animal                                     X       elephant
    vegetable  X                                       mushroom
    vegetable          X               X               potato
    vegetable                  X                       tomato
    vegetable                          X       X       pumpkin
    mineral    X                       X               marble
    mineral            X                               amber
    mineral                    X       X               ruby
    mineral                            X       X       granite

ask_PROPERTY, for three kinds and five properties, costs 1; the `answer` is right with probability
`accuracy`, and what is left is noise twice as often as a wrong answer.  guess_OBJECT brings 20 if it is
right and costs 20 if not.  After a guess a new object is thought of.  At the start, and then, each is
equally likely.  A guess is answered by noise.

    Play = {ask_animal, ask_vegetable, ask_mineral, Animals, Vegetables, Minerals}
    Animals = {ask_white, ask_brown, ask_red, ask_hard, ask_large, guess_X for each animal X}; so the others

Without observations each of the three has five blocks, its four objects and the others; with them it must
keep apart those others of which different things are true, and has 11.
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
    Task,
    TaskHierarchy,
    conditional,
    lottery,
    uniform,
)

Accuracy = Annotated[Number, "probability that an answer is right"]
Discount = Annotated[Number, "discount, from 0 to 1"]

_KINDS = ("animal", "vegetable", "mineral")
_PROPERTIES = ("white", "brown", "red", "hard", "large")
_OBJECTS = {  # what is true of it, its kind first
    "polar_bear": ("animal", "white", "large"),
    "monkey": ("animal", "brown"),
    "robin": ("animal", "red"),
    "elephant": ("animal", "large"),
    "mushroom": ("vegetable", "white"),
    "potato": ("vegetable", "brown", "hard"),
    "tomato": ("vegetable", "red"),
    "pumpkin": ("vegetable", "hard", "large"),
    "marble": ("mineral", "white", "hard"),
    "amber": ("mineral", "brown"),
    "ruby": ("mineral", "red", "hard"),
    "granite": ("mineral", "hard", "large"),
}


def model(*, accuracy: Accuracy = Fraction(85, 100), discount: Discount = Fraction(95, 100)) -> Model:
    """The POMDP of 12 states, 20 actions and 3 observations.

    Raises:
        ModelError: a parameter out of its range.
    """
    right = probability("accuracy", accuracy)
    thing = Feature("object", list(_OBJECTS))
    answer = Observation("answer", ["yes", "no", "noise"], null="noise")
    rest = (1 - right) / 3
    yes = lottery({"yes": right, "no": rest, "noise": 2 * rest})
    no = lottery({"no": right, "yes": rest, "noise": 2 * rest})

    def told(asked: str) -> Expression:
        rows = tuple((name, yes if asked in truths else no) for name, truths in _OBJECTS.items())
        return Switch(thing.next, rows)

    return Model(
        "twenty_questions",
        [thing],
        [
            *(
                Action(f"ask_{asked}", rewards=-1, senses={answer: told(asked)})
                for asked in (*_KINDS, *_PROPERTIES)
            ),
            *(
                Action(
                    f"guess_{name}",
                    {thing: uniform(thing)},
                    rewards=conditional(thing.is_(name), 20, -20),
                )
                for name in _OBJECTS
            ),
        ],
        initial={thing: uniform(thing)},
        discount=discount_factor(discount),
        observability="partial",
        observations=[answer],
        description="Ask about one of twelve objects, then guess it.",
    )


def tasks(
    *, accuracy: Accuracy = Fraction(85, 100), discount: Discount = Fraction(95, 100)
) -> TaskHierarchy:
    """Play{ask_KIND, and for each kind a task of the other questions and the guesses of that kind}.

    No parameter changes anything here.
    """
    kinds = {kind: f"{kind.capitalize()}s" for kind in _KINDS}
    questions = [f"ask_{asked}" for asked in _PROPERTIES]
    return TaskHierarchy(
        [
            Task("Play", [*(f"ask_{kind}" for kind in _KINDS), *kinds.values()]),
            *(
                Task(
                    name,
                    [
                        *questions,
                        *(f"guess_{thing}" for thing, truths in _OBJECTS.items() if kind in truths),
                    ],
                )
                for kind, name in kinds.items()
            ),
        ]
    )
