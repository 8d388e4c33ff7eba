"""A taxi that sees only the walls around it fetches a passenger and asks where he wants to go.

After "cheese-taxi" in J. Pineau's thesis "Tractable planning under uncertainty: exploiting structure"
(Carnegie Mellon, 2004): Dietterich's taxi (2000) in McCallum's cheese maze (1993).  The thesis was not at
hand; known of it are the 11 places times 3 destinations, the seven actions and the ten observations (M.
Toussaint's program for hierarchical controllers, 2008, names places, destinations and actions too).  The
costs and the reward are Dietterich's, the walls and what is seen of them McCallum's; what follows a
delivery, and the start, are ours.

    s0 s1 s2 s3 s4      the passenger waits in s10
    s5    s6    s7      and wants to go to s0 or s4
    s8    s10   s9

Features `taxi`, its place, and `destination`, the place to be reached next: s10 while the passenger waits
there, then s0 or s4, which he chooses by a fair coin as he gets in.

    North, South, East, West   sure; into a wall they change nothing; -1
    Pickup                     in s10 the waiting passenger gets in, -1; else nothing changes, -10
    Putdown                    in his destination the passenger gets out, +20; else nothing changes, -10
    Query                      -1

After a delivery there is the next fare: a passenger waits in s10 and the taxi is anywhere, as at the start.
A move is followed by a reading of the `walls`, on which sides of the taxi they are: s1 and s3 look the
same, and s5, s6 and s7, and s8 and s9, while s10 is known as `stop`.  Query is followed by the passenger's
`answer`, s0 or s4, if he is in the taxi.  Both are exact.  Otherwise there is nothing to see: with that,
ten joint observations.

    Root = {Get, Put}
    Get = {Pickup, Navigate_s10}      Put = {Putdown, Query, Navigate_s0, Navigate_s4}
    Navigate_t = {North, South, East, West}

Navigate_t has the pseudo-reward -1 a step until the taxi is in t, as in Dietterich's taxi; Get ends when
the passenger is in the taxi, Put when he is not.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor
from factored_polca.models import (
    FALSE,
    Action,
    Constant,
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

Discount = Annotated[Number, "discount, from 0 to 1"]

_WAITING = "s10"
_GOALS = ("s0", "s4")
_CELLS = {  # place: (column, row)
    **{f"s{i}": (i, 0) for i in range(5)},
    **{"s5": (0, 1), "s6": (2, 1), "s7": (4, 1)},
    **{"s8": (0, 2), "s9": (4, 2), "s10": (2, 2)},
}
_STEPS = {"North": (0, -1), "South": (0, 1), "East": (1, 0), "West": (-1, 0)}
_TAXI = Feature("taxi", list(_CELLS))
_DESTINATION = Feature("destination", [_WAITING, *_GOALS])


def model(*, discount: Discount = Fraction(95, 100)) -> Model:
    """The POMDP of 33 states, 7 actions and 10 observations.

    Raises:
        ModelError: a parameter out of its range.
    """
    seen = {place: _seen(place) for place in _CELLS}
    walls = Observation("walls", ["none", *dict.fromkeys(seen.values())])
    answer = Observation("answer", ["none", *_GOALS])
    sight = Switch(_TAXI.next, tuple((place, Constant(sides)) for place, sides in seen.items()))
    wish = Switch(_DESTINATION.next, tuple((goal, Constant(goal)) for goal in _GOALS), Constant("none"))
    boards = _TAXI.is_(_WAITING) & _DESTINATION.is_(_WAITING)
    delivers = Switch(_DESTINATION.now, tuple((goal, _TAXI.is_(goal)) for goal in _GOALS), FALSE)
    choice = lottery(dict.fromkeys(_GOALS, Fraction(1, len(_GOALS))))
    return Model(
        "cheese_taxi",
        [_TAXI, _DESTINATION],
        [
            *(Action(move, {_TAXI: _moved(move)}, rewards=-1, senses={walls: sight}) for move in _STEPS),
            Action("Query", rewards=-1, senses={answer: wish}),
            Action(
                "Pickup",
                {_DESTINATION: conditional(boards, choice, _DESTINATION)},
                rewards=conditional(boards, -1, -10),
            ),
            Action(
                "Putdown",
                {
                    _TAXI: conditional(delivers, uniform(_TAXI), _TAXI),
                    _DESTINATION: conditional(delivers, Constant(_WAITING), _DESTINATION),
                },
                rewards=conditional(delivers, 20, -10),
            ),
        ],
        initial={_TAXI: uniform(_TAXI), _DESTINATION: Constant(_WAITING)},
        discount=discount_factor(discount),
        observability="partial",
        observations=[walls, answer],
        description="A taxi finds its way by the walls alone, and asks for the destination.",
    )


def _neighbour(place: str, direction: str) -> str | None:
    """The next place in `direction`, or None where there is a wall."""
    along, down = _STEPS[direction]
    target = (_CELLS[place][0] + along, _CELLS[place][1] + down)
    return next((other for other, cell in _CELLS.items() if cell == target), None)


def _seen(place: str) -> str:
    sides = (step.lower() for step in _STEPS if _neighbour(place, step) is None)
    return "stop" if place == _WAITING else "_".join(sides)


def _moved(direction: str) -> Expression:
    cases = tuple((place, Constant(_neighbour(place, direction) or place)) for place in _CELLS)
    return Switch(_TAXI.now, cases)


def tasks(*, discount: Discount = Fraction(95, 100)) -> TaskHierarchy:
    """Root{Get, Put}, Get{Pickup, Navigate_s10}, Put{Putdown, Query, Navigate_s0, Navigate_s4}.

    No parameter changes anything here.
    """
    waits = _DESTINATION.is_(_WAITING)
    return TaskHierarchy(
        [
            Task("Root", ["Get", "Put"]),
            Task("Get", ["Pickup", f"Navigate_{_WAITING}"], terminal=~waits),
            Task("Put", ["Putdown", "Query", *(f"Navigate_{goal}" for goal in _GOALS)], terminal=waits),
            *(
                Task(f"Navigate_{place}", _STEPS, terminal=_TAXI.is_(place), pseudo_rewards=-1)
                for place in (_WAITING, *_GOALS)
            ),
        ]
    )
