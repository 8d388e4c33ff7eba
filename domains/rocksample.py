"""A rover tells good rocks from bad ones at a distance, samples, and leaves by the east edge.

RockSample[n, k] from T. Smith and R. Simmons, "Heuristic search value iteration for POMDPs" (UAI 2004).
Where the paper says nothing, the rules are those of T. Smith's generators (with his solver ZMDP).

n = `size` cells a side, k = `rocks` rocks, each good or bad with probability 1/2, independently.  The
rover starts in the middle of the west edge, (0, floor(n/2)), and always knows its place (x and y are
observed features: mixed observability); y grows to the north.

    north, ...   one cell further; leaving by the east edge brings 10 and ends it
    sample       in a rock's cell: brings 10 if the rock is good, costs 10 if not, and makes it bad
    check_i      tells whether rock i is good, rightly with probability (1 + 2^(-d/d0)) / 2, where d is
                 the Euclidean distance to it and d0 the `half_distance`; rounded to 12 decimals

To leave by another edge, or to sample where there is no rock, costs 100 and ends it, as in the
generators (the paper has no such rule; programs that make the rover stay have the same optimum, since
it never pays).  Actions other than check_i report none.  The end is x = n: n (n+1) 2^k states, of
which n 2^k are terminal.

Rocks lie as published for [4,4], [5,5], [5,7], [7,8] and [10,10] (the generators) and [11,11] (the
benchmark file, as quoted by the programs POMCP and DESPOT); there d0 is 20 but ln 2 for [4,4] and 4 for
[5,5].  For other n and k, or where `seed` is not 0, rocks are drawn at random and d0 is 20.  A
`half_distance` above 0 stands in place of either d0.

For [7,8] and discount 0.95 the optimal value at the start lies between 21.1 and 24.6 (SARSOP and HSVI2
give such bounds within a minute).  There is no hierarchy.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from decimal import Context, Decimal, localcontext
from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor, integer, number
from factored_polca.models import (
    FALSE,
    TRUE,
    Action,
    Constant,
    Expression,
    Feature,
    Model,
    ModelError,
    Observation,
    Switch,
    TaskHierarchy,
    boolean,
    conditional,
    flat_task,
    lottery,
    uniform,
)

Size = Annotated[int, "cells n along each side of the grid"]
Rocks = Annotated[int, "number k of rocks; n (n + 1) 2^k states"]
HalfDistance = Annotated[
    Number, "distance d0 at which the sensor is half as good; 0: as published, else 20"
]
Seed = Annotated[int, "0: rocks as published, where they are; else where to draw them"]
Discount = Annotated[Number, "discount, from 0 to 1"]

Cell = tuple[int, int]

_DECIMALS = 12
_LN_2 = Fraction("0.69314718055994530942")  # so that 2^(-d/d0) = e^(-d)

# (size, rocks): the rocks' cells, and d0.
_PUBLISHED: dict[tuple[int, int], tuple[tuple[Cell, ...], Fraction]] = {
    (4, 4): (((3, 1), (2, 1), (1, 3), (1, 0)), _LN_2),
    (5, 5): (((2, 4), (0, 4), (3, 3), (2, 2), (4, 1)), Fraction(4)),
    (5, 7): (((1, 0), (2, 1), (1, 2), (2, 2), (4, 2), (0, 3), (3, 4)), Fraction(20)),
    (7, 8): (((2, 0), (0, 1), (3, 1), (6, 3), (2, 4), (3, 4), (5, 5), (1, 6)), Fraction(20)),
    (10, 10): (
        ((0, 3), (0, 7), (1, 8), (3, 3), (3, 8), (4, 3), (5, 8), (6, 1), (9, 3), (9, 9)),
        Fraction(20),
    ),
    (11, 11): (
        ((0, 3), (0, 7), (1, 8), (2, 4), (3, 3), (3, 8), (4, 3), (5, 8), (6, 1), (9, 3), (9, 9)),
        Fraction(20),
    ),
}

_NONE = Constant("none")


def model(
    *,
    size: Size = 4,
    rocks: Rocks = 4,
    half_distance: HalfDistance = 0,
    seed: Seed = 0,
    discount: Discount = Fraction(95, 100),
) -> Model:
    """RockSample[size, rocks]: 5 + rocks actions.

    Raises:
        ModelError: a parameter out of its range.
    """
    n = integer("size", size, 1, 64)
    cells, d0 = _layout(n, integer("rocks", rocks, 1, min(n * n, 64)), integer("seed", seed, 0, 2**31))
    given = number("half_distance", half_distance)
    if given < 0:
        raise ModelError(
            f"half_distance is {half_distance}: it must be above 0, or 0 for the published one"
        )
    rate = _accuracy(given or d0)
    x, y = Feature("x", range(n + 1), observed=True), Feature("y", range(n), observed=True)
    good = [boolean(f"rock_{i}") for i in range(len(cells))]
    reading = Observation("reading", ["none", "good", "bad"])
    return Model(
        "rocksample",
        [x, y, *good],
        [
            *_moves(n, x, y),
            _sample(n, x, y, dict(zip(cells, good, strict=True))),
            *(
                Action(f"check_{i}", senses={reading: _checked(n, x, y, rock, cell, rate)})
                for i, (cell, rock) in enumerate(zip(cells, good, strict=True))
            ),
        ],
        terminal=x.is_(n),
        initial={x: Constant(Fraction(0)), y: Constant(Fraction(n // 2)), **{r: uniform(r) for r in good}},
        discount=discount_factor(discount),
        observability="partial",
        observations=[reading],
        description="A rover checks rocks from afar and samples the good ones.",
    )


def _layout(n: int, rocks: int, seed: int) -> tuple[tuple[Cell, ...], Fraction]:
    """The rocks' cells, all different, and the published d0."""
    if seed == 0 and (n, rocks) in _PUBLISHED:
        return _PUBLISHED[n, rocks]
    draw = random.Random(seed).random  # the one method whose sequence Python promises to keep
    free = [(i, j) for i in range(n) for j in range(n)]
    return tuple(free.pop(int(draw() * len(free))) for _ in range(rocks)), Fraction(20)


def _accuracy(d0: Fraction) -> Callable[[int], Fraction]:
    """The probability of a right reading at each squared distance, rounded to 12 decimals."""
    known: dict[int, Fraction] = {}

    def rate(squared: int) -> Fraction:
        if squared not in known:
            with localcontext(Context(prec=60)):
                ratio = Decimal(squared).sqrt() * d0.denominator / d0.numerator
                exact = (1 + Decimal(2) ** -ratio) / 2
                known[squared] = Fraction(exact.quantize(Decimal(10) ** -_DECIMALS))
        return known[squared]

    return rate


def _moves(n: int, x: Feature, y: Feature) -> list[Action]:
    north, south, west = y.is_(n - 1), y.is_(0), x.is_(0)
    return [
        Action(
            "north",
            {x: conditional(north, n, x), y: conditional(north, y, y + 1)},
            rewards=conditional(north, -100, 0),
        ),
        Action(
            "south",
            {x: conditional(south, n, x), y: conditional(south, y, y - 1)},
            rewards=conditional(south, -100, 0),
        ),
        Action("east", {x: x + 1}, rewards=conditional(x.is_(n - 1), 10, 0)),
        Action("west", {x: conditional(west, n, x - 1)}, rewards=conditional(west, -100, 0)),
    ]


def _sample(n: int, x: Feature, y: Feature, rocks: dict[Cell, Feature]) -> Action:
    def at(cell: Cell) -> Expression:
        return x.is_(cell[0]) & y.is_(cell[1])

    rows: dict[int, list[int]] = {}
    for i, j in rocks:
        rows.setdefault(i, []).append(j)
    at_rock = Switch(x.now, tuple((i, y.is_in(sorted(rows[i]))) for i in sorted(rows)), FALSE)
    return Action(
        "sample",
        {
            x: conditional(at_rock, x, n),
            **{rock: conditional(at(cell), FALSE, rock) for cell, rock in rocks.items()},
        },
        rewards=[
            conditional(at_rock, 0, -100),
            *(
                conditional(at(cell), conditional(rock.now.is_(TRUE), 10, -10), 0)
                for cell, rock in rocks.items()
            ),
        ],
    )


def _checked(
    n: int, x: Feature, y: Feature, rock: Feature, cell: Cell, rate: Callable[[int], Fraction]
) -> Expression:
    """What check_i reports from each cell; nothing at the end, where no action is taken."""

    def reading(right: Fraction) -> Expression:
        return conditional(
            rock.next,
            lottery({"good": right, "bad": 1 - right}),
            lottery({"good": 1 - right, "bad": right}),
        )

    def squared(i: int, j: int) -> int:
        return (i - cell[0]) ** 2 + (j - cell[1]) ** 2

    distances = {squared(i, j) for i in range(n) for j in range(n)}
    readings = {distance: reading(rate(distance)) for distance in distances}
    columns = [(i, Switch(y.next, tuple((j, readings[squared(i, j)]) for j in range(n)))) for i in range(n)]
    return Switch(x.next, tuple(columns), _NONE)


def tasks(
    *,
    size: Size = 4,
    rocks: Rocks = 4,
    half_distance: HalfDistance = 0,
    seed: Seed = 0,
    discount: Discount = Fraction(95, 100),
) -> TaskHierarchy:
    """One task over all actions.

    Raises:
        ModelError: a parameter out of its range.
    """
    return flat_task(
        model(size=size, rocks=rocks, half_distance=half_distance, seed=seed, discount=discount)
    )
