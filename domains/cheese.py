"""A mouse looks for cheese in a maze of eleven cells and sees only the walls around it.

From A. K. McCallum, "Overcoming incomplete perception with utile distinction memory" (ICML 1993; the
maze is from his technical report of 1992), in the form that comes with A. R. Cassandra's pomdp-solve
as cheese.95: a corridor with three legs, the cheese at the end of the middle one.

    a b c d e       column 0 .. 4, row 0
    f   g   h       row 1
    i   *   j       row 2, * is the cheese

One feature, the `cell`, named by its column and row.  A move is sure; into a wall it changes nothing.
Coming to the cheese brings 1; the next action, whatever it is, puts the mouse into a random other cell,
where it also starts.  What is seen after each action is exact: on which sides there are walls, or the
cheese.  Of the seven readings, north_south, east_west and east_south_west each fit several cells.

The optimal value at the start is 3.486207 for discount 0.95, with 14 alpha vectors (several solvers
agree on it).  There is no hierarchy.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor
from factored_polca.models import (
    Action,
    Constant,
    Expression,
    Feature,
    Model,
    Observation,
    Switch,
    TaskHierarchy,
    conditional,
    flat_task,
    lottery,
)

Discount = Annotated[Number, "discount, from 0 to 1"]

Place = tuple[int, int]

_CHEESE: Place = (2, 2)
_PLACES: tuple[Place, ...] = (
    *((column, 0) for column in range(5)),
    *((column, row) for row in (1, 2) for column in (0, 2, 4)),
)
_STEPS = {"north": (0, -1), "east": (1, 0), "south": (0, 1), "west": (-1, 0)}


def model(*, discount: Discount = Fraction(95, 100)) -> Model:
    """The POMDP of 11 states, 4 actions and 7 observations.

    Raises:
        ModelError: a parameter out of its range.
    """
    cell = Feature("cell", [_name(place) for place in _PLACES])
    seen = {_name(place): _seen(place) for place in _PLACES}
    reading = Observation("reading", list(dict.fromkeys(seen.values())))
    sight = Switch(cell.next, tuple((name, Constant(walls)) for name, walls in seen.items()))
    others = [_name(place) for place in _PLACES if place != _CHEESE]
    anywhere = lottery(dict.fromkeys(others, Fraction(1, len(others))))
    return Model(
        "cheese",
        [cell],
        [
            Action(direction, {cell: _moved(cell, direction, anywhere)}, senses={reading: sight})
            for direction in _STEPS
        ],
        rewards=conditional(cell.next.is_(_name(_CHEESE)), 1, 0),
        initial={cell: anywhere},
        discount=discount_factor(discount),
        observability="partial",
        observations=[reading],
        description="McCallum's cheese maze: find the cheese by the walls alone.",
    )


def _name(place: Place) -> str:
    return f"x{place[0]}y{place[1]}"


def _neighbour(place: Place, direction: str) -> Place | None:
    """The next cell in `direction`, or None where there is a wall."""
    along, down = _STEPS[direction]
    target = (place[0] + along, place[1] + down)
    return target if target in _PLACES else None


def _seen(place: Place) -> str:
    if place == _CHEESE:
        return "cheese"
    return "_".join(direction for direction in _STEPS if _neighbour(place, direction) is None)


def _moved(cell: Feature, direction: str, anywhere: Expression) -> Expression:
    cases = {
        _name(place): Constant(_name(_neighbour(place, direction) or place))
        for place in _PLACES
        if place != _CHEESE
    }
    return Switch(cell.now, tuple(cases.items()), anywhere)


def tasks(*, discount: Discount = Fraction(95, 100)) -> TaskHierarchy:
    """One task over all actions.

    Raises:
        ModelError: a parameter out of its range.
    """
    return flat_task(model(discount=discount))
