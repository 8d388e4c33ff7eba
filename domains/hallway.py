"""A robot looks for the goal at a corridor's side with noisy motion and noisy wall sensors.

From M. L. Littman, A. R. Cassandra and L. P. Kaelbling, "Learning policies for partially observable
environments: scaling up" (ICML 1995), whose Hallway has 60 states, 5 actions and 21 observations.  The
paper gives the map and the idea.  The numbers here are those of Cassandra's file hallway.POMDP, worked
out from its translation to POMDPX that comes with APPL; for `size` 11 this factored form repeats the
file's kernel, which is rounded to six decimals.  Corridors of other lengths are ours.

    n = `size` cells, hall_0 in the west to hall_(n-1) in the east; a room to the south of each
    even cell from 2 to n - 3, the last of which is the goal:

        hall_0 hall_1 hall_2 hall_3 hall_4 ... hall_8 hall_9 hall_10
                      room_2        room_4     goal

State: `place` and `heading`, 4 (n + number of rooms) states.  The robot starts anywhere but in the goal,
heading anywhere.  Whatever it does in the goal, it is put at a random start.  Entering the goal brings 1.

    stay                  nothing happens
    forward               tries one step ahead (0.8), to its left (0.05), to its right (0.05) or back
                          (0.05); else, or where there is a wall, it stays as it is.  A step to a side
                          turns it that way, a step back does so with probability 1/2.
    turn_left, turn_right the right turn with 0.7, each other heading with 0.1
    turn_around           the right turn with 0.6, 0.15 to either side, 0.1 not at all

After each action four sensors (front, right, back, left) each tell, independently, whether there is a wall:
a wall is sensed with probability `hit`, one is imagined with probability `false_alarm`.  Two sights are
certain and silence the sensors: the `landmark` of a door while heading south in front of a room (each door
has its own), and the goal while in it.

For size 11 and discount 0.95 the optimal value at the start lies between 0.9905 and 1.2053 (bounds of
several solvers).  There is no hierarchy.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise
from typing import Annotated

from factored_polca.library import Number, discount_factor, integer, probability
from factored_polca.models import (
    FALSE,
    TRUE,
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
    uniform,
)

Size = Annotated[int, "cells n of the corridor, from 5 on; 4 (n + floor((n - 3) / 2)) states"]
Hit = Annotated[Number, "probability that a wall is sensed as one"]
FalseAlarm = Annotated[Number, "probability that a wall is sensed where there is none"]
Discount = Annotated[Number, "discount, from 0 to 1"]

_HEADINGS = ("north", "east", "south", "west")
_SENSORS = ("front", "right", "back", "left")  # a quarter turn apart, as the headings are
_AHEAD, _SIDE, _BACK = Fraction(8, 10), Fraction(5, 100), Fraction(5, 100)
_TURNS = {  # probabilities of turning by no, one, two and three quarters to the right
    "turn_right": (Fraction(1, 10), Fraction(7, 10), Fraction(1, 10), Fraction(1, 10)),
    "turn_around": (Fraction(1, 10), Fraction(15, 100), Fraction(6, 10), Fraction(15, 100)),
    "turn_left": (Fraction(1, 10), Fraction(1, 10), Fraction(1, 10), Fraction(7, 10)),
}


def model(
    *,
    size: Size = 11,
    hit: Hit = Fraction(9, 10),
    false_alarm: FalseAlarm = Fraction(5, 100),
    discount: Discount = Fraction(95, 100),
) -> Model:
    """The POMDP of a corridor: 60 states, 5 actions and 21 observations at size 11.

    Raises:
        ModelError: a parameter out of its range.
    """
    hall = _Hall(integer("size", size, 5, 300))
    sensors = [Observation(name, [False, True]) for name in _SENSORS]
    landmark = Observation("landmark", ["none", *hall.doors.values(), "goal"])
    hits, alarms = probability("hit", hit), probability("false_alarm", false_alarm)
    senses = {
        **{sensor: hall.sensed(side, hits, alarms) for side, sensor in enumerate(sensors)},
        landmark: hall.landmark(),
    }
    place, heading = hall.place, hall.heading
    home = place.is_("goal")
    effects: dict[str, dict[Feature, Expression]] = {
        "stay": {heading: conditional(home, uniform(heading), heading)},
        "forward": {heading: hall.heading_after_forward(), place: hall.forward()},
        **{name: {heading: hall.turned(chances)} for name, chances in _TURNS.items()},
    }
    leave = {place: conditional(home, hall.starts(), place)}
    return Model(
        "hallway",
        [place, heading],
        [
            Action(
                name,
                {**leave, **changes},
                senses=senses,
                rewards=conditional(place.next.is_("goal"), 1, 0) if name == "forward" else (),
            )
            for name, changes in effects.items()
        ],
        initial={place: hall.starts(), heading: uniform(heading)},
        discount=discount_factor(discount),
        observability="partial",
        observations=[*sensors, landmark],
        description="Find the goal in a corridor with noisy motion and noisy wall sensors.",
    )


class _Hall:
    """A corridor of n cells with rooms: what is where, and what the robot does and senses there."""

    def __init__(self, n: int) -> None:
        cells = [f"hall_{i}" for i in range(n)]
        columns = range(2, n - 2, 2)
        rooms = {cells[i]: f"room_{i}" for i in columns}
        rooms[cells[columns[-1]]] = "goal"
        self.doors = {cells[i]: f"door_{i}" for i in columns}
        # neighbour[place][quarter] is the place one step to the north, east, south or west.
        self.neighbour: dict[str, dict[int, str]] = {name: {} for name in (*cells, *rooms.values())}
        for west, east in pairwise(cells):
            self.neighbour[west][1], self.neighbour[east][3] = east, west
        for cell, room in rooms.items():
            self.neighbour[cell][2], self.neighbour[room][0] = room, cell
        self.place = Feature("place", list(self.neighbour))
        self.heading = Feature("heading", _HEADINGS)

    def starts(self) -> Expression:
        """Anywhere but in the goal."""
        others = [name for name in self.neighbour if name != "goal"]
        return lottery(dict.fromkeys(others, Fraction(1, len(others))))

    def each_heading(self, result: Callable[[int], Expression], primed: bool = False) -> Expression:
        """`result` of the number of quarter turns from the north."""
        reference = self.heading.next if primed else self.heading.now
        return Switch(reference, tuple((name, result(quarter)) for quarter, name in enumerate(_HEADINGS)))

    def turned(self, chances: tuple[Fraction, ...]) -> Expression:
        def row(quarter: int) -> Expression:
            turned = [(_HEADINGS[(quarter + turn) % 4], chance) for turn, chance in enumerate(chances)]
            return lottery(turned)

        return conditional(self.place.is_("goal"), uniform(self.heading), self.each_heading(row))

    def forward(self) -> Expression:
        """The next place; no two directions lead to the same one."""

        def row(place: str, quarter: int) -> Expression:
            tries = ((0, _AHEAD), (1, _SIDE), (2, _BACK), (3, _SIDE))
            steps = {
                target: chance
                for turn, chance in tries
                if (target := self.neighbour[place].get((quarter + turn) % 4))
            }
            return lottery({**steps, place: 1 - sum(steps.values(), Fraction(0))})

        cases = [
            (place, self.each_heading(lambda quarter, place=place: row(place, quarter)))  # type: ignore[misc]
            for place in self.neighbour
            if place != "goal"
        ]
        return Switch(self.place.now, tuple(cases), self.starts())

    def heading_after_forward(self) -> Expression:
        """The next heading, by the direction of the step that the next place betrays."""

        def row(direction: int) -> Expression:
            back = _HEADINGS[(direction + 2) % 4]
            went = Constant(_HEADINGS[direction])
            undecided = lottery({back: Fraction(1, 2), _HEADINGS[direction]: Fraction(1, 2)})
            return Switch(self.heading.now, ((back, undecided),), went)

        cases = [
            (
                place,
                Switch(
                    self.place.next,
                    tuple((target, row(direction)) for direction, target in neighbours.items()),
                    self.heading.now,
                ),
            )
            for place, neighbours in self.neighbour.items()
            if place != "goal"
        ]
        return Switch(self.place.now, tuple(cases), uniform(self.heading))

    def sensed(self, side: int, hits: Fraction, alarms: Fraction) -> Expression:
        """What the sensor on `side` tells, after the action."""
        wall, free = lottery({TRUE: hits, FALSE: 1 - hits}), lottery({TRUE: alarms, FALSE: 1 - alarms})

        def row(quarter: int) -> Expression:
            silent = {"goal", *(self.doors if quarter == 2 else ())}
            look = (quarter + side) % 4
            cases = [
                (place, FALSE if place in silent else free if look in neighbours else wall)
                for place, neighbours in self.neighbour.items()
            ]
            return Switch(self.place.next, tuple(cases))

        return self.each_heading(row, primed=True)

    def landmark(self) -> Expression:
        """The door that the robot faces, or the goal that it is in."""
        doors = tuple((cell, Constant(door)) for cell, door in self.doors.items())
        facing = Switch(self.place.next, doors, Constant("none"))
        none = Constant("none")
        ahead = Switch(self.heading.next, (("south", facing),), none)
        return conditional(self.place.next.is_("goal"), Constant("goal"), ahead)


def tasks(
    *,
    size: Size = 11,
    hit: Hit = Fraction(9, 10),
    false_alarm: FalseAlarm = Fraction(5, 100),
    discount: Discount = Fraction(95, 100),
) -> TaskHierarchy:
    """One task over all actions.

    Raises:
        ModelError: a parameter out of its range.
    """
    return flat_task(model(size=size, hit=hit, false_alarm=false_alarm, discount=discount))
