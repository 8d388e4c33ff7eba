"""A taxi fetches a passenger in a walled grid and takes him to his destination.

From T. G. Dietterich, "Hierarchical reinforcement learning with the MAXQ value function
decomposition", Journal of Artificial Intelligence Research 13 (2000); the larger Taxi2 (`anywhere`)
is from J. Pineau, G. Gordon and S. Thrun, "Policy-contingent abstraction for robust robot control"
(2003), section 6.  For 5x5 MAXQ with a state abstraction made by hand has 632 Q-values, the flat
table 3000 and the hierarchy without abstraction 11000; the second paper reports that PolCA, which
finds its abstraction itself, needs fewer than MAXQ, and that all learn the optimal policy.
Recounted for the 25 targets of Taxi2, MAXQ's number is
4*25*25 + 25 + 625 + 100 + 4 + 100 + 8 = 3362.

Features x, y (the taxi; y grows to the North), passenger (a location, `taxi` or `delivered`) and
destination (a location).  The four moves, Pickup and Putdown; -1 for a move and a legal Pickup, +20
for a delivery (Putdown in the destination with the passenger aboard), -10 for any other Pickup or
Putdown, which change nothing.  A delivered passenger ends it.  At the start the taxi is in any cell,
the passenger waits at any location and wants to go to any location, all equally likely.

Locations and walls for n = `size`, with f(k) = floor(k * n / 5); at n = 5 they are Dietterich's:
    R = (0, n-1)   G = (n-1, n-1)   Y = (0, 0)   B = (f(3), 0)
    walls of height f(2) along the upper edge between columns f(2) - 1 and f(2),
    and along the lower edge between f(1) - 1 and f(1), and between f(3) - 1 and f(3).

    Root = {Get, Put}   Get = {Pickup, Navigate_t for each t where a passenger can wait}
    Put = {Putdown, Navigate_t for each location t}   Navigate_t = {North, South, East, West}

Navigate_t has the pseudo-reward -1 a step until the taxi is at t; Get has ended unless the passenger
waits somewhere, Put unless he is in the taxi.

`slip`: a move goes to either side of its direction with probability 1/10 each.  A blocked taxi stays.
As either x or y changes, y' has x' as a parent.  `anywhere`: the passenger may wait in any cell, which
is named x1y2 unless it is a location; there is a Navigate task for each cell.  `noise_bits`: as many
truth values that nothing depends on; each flips with probability 1/4 in each step, independently.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor, integer, probability, truth
from factored_polca.models import (
    FALSE,
    TRUE,
    Action,
    Constant,
    Expression,
    Feature,
    Model,
    ModelError,
    Switch,
    Task,
    TaskHierarchy,
    boolean,
    conditional,
    disjunction,
    lottery,
    uniform,
)

Size = Annotated[int, "cells along each side of the grid, from 2 on"]
Slip = Annotated[
    bool | str,
    'moves slip: true for "0.8,0.1,0.1" (ahead, left, right), false, three such numbers, or the chance of '
    "going aside, half of it to each side",
]
Anywhere = Annotated[bool, "the passenger may wait in any cell (Taxi2); at most size 30"]
NoiseBits = Annotated[int, "number of random truth values that matter to nothing"]
Discount = Annotated[Number, "discount, from 0 to 1"]

Cell = tuple[int, int]
Chances = tuple[Fraction, Fraction, Fraction]

_MOVES = ("North", "South", "East", "West")
_SIDES = {  # direction: (its left, its right)
    "North": ("West", "East"),
    "South": ("East", "West"),
    "East": ("North", "South"),
    "West": ("South", "North"),
}


def model(
    *,
    size: Size = 5,
    slip: Slip = False,
    anywhere: Anywhere = False,
    noise_bits: NoiseBits = 0,
    discount: Discount = Fraction(95, 100),
) -> Model:
    """The taxi MDP: 600 states at size 5, 2700 with `anywhere`.

    Raises:
        ModelError: a parameter out of its range.
    """
    chances = _chances(slip)
    grid = _Grid(_size(size, anywhere))
    waiting = grid.cells() if truth("anywhere", anywhere) else grid.locations
    x, y = grid.x, grid.y
    passenger = Feature("passenger", [*waiting, "taxi", "delivered"])
    destination = Feature("destination", list(grid.locations))
    noise = [boolean(f"noise_{i}") for i in range(integer("noise_bits", noise_bits, 0, 1000))]
    flips = {bit: conditional(bit, _bernoulli(Fraction(3, 4)), _bernoulli(Fraction(1, 4))) for bit in noise}
    here = Switch(passenger.now, tuple((name, grid.at(cell)) for name, cell in waiting.items()), FALSE)
    arrived = Switch(destination.now, tuple((name, grid.at(cell)) for name, cell in grid.locations.items()))
    delivery = passenger.is_("taxi") & arrived
    share = Fraction(1, len(waiting))
    return Model(
        "taxi",
        [x, y, passenger, destination, *noise],
        [
            *(Action(move, {**grid.effects(move, chances), **flips}, rewards=-1) for move in _MOVES),
            Action(
                "Pickup",
                {passenger: conditional(here, Constant("taxi"), passenger), **flips},
                rewards=conditional(here, -1, -10),
            ),
            Action(
                "Putdown",
                {passenger: conditional(delivery, Constant("delivered"), passenger), **flips},
                rewards=conditional(delivery, 20, -10),
            ),
        ],
        terminal=passenger.is_("delivered"),
        initial={
            x: uniform(x),
            y: uniform(y),
            passenger: lottery(dict.fromkeys(waiting, share)),
            destination: uniform(destination),
            **{bit: uniform(bit) for bit in noise},
        },
        discount=discount_factor(discount),
        description="Dietterich's taxi: fetch a passenger and take him to his destination.",
    )


def tasks(
    *,
    size: Size = 5,
    slip: Slip = False,
    anywhere: Anywhere = False,
    noise_bits: NoiseBits = 0,
    discount: Discount = Fraction(95, 100),
) -> TaskHierarchy:
    """Root{Get, Put}, Get{Pickup, Navigate_t}, Put{Putdown, Navigate_t}, Navigate_t{the moves}.

    Raises:
        ModelError: `size` or `anywhere` out of its range; the other parameters change nothing here.
    """
    grid = _Grid(_size(size, anywhere))
    waiting = grid.cells() if truth("anywhere", anywhere) else grid.locations
    passenger = Feature("passenger", [*waiting, "taxi", "delivered"])
    return TaskHierarchy(
        [
            Task("Root", ["Get", "Put"]),
            Task(
                "Get",
                ["Pickup", *(f"Navigate_{name}" for name in waiting)],
                terminal=passenger.is_in(["taxi", "delivered"]),
            ),
            Task(
                "Put",
                ["Putdown", *(f"Navigate_{name}" for name in grid.locations)],
                terminal=~passenger.is_("taxi"),
            ),
            *(
                Task(f"Navigate_{name}", _MOVES, terminal=grid.at(cell), pseudo_rewards=-1)
                for name, cell in waiting.items()
            ),
        ]
    )


def _size(size: int, anywhere: bool) -> int:
    return integer("size", size, 2, 30 if anywhere is True else 1000)


def _bernoulli(chance: Fraction) -> Expression:
    return lottery({TRUE: chance, FALSE: 1 - chance})


def _chances(slip: bool | str) -> Chances | None:
    """The probabilities of going ahead, left and right, or None where moves never slip."""
    if slip is False:
        return None
    parts = ["0.8", "0.1", "0.1"] if slip is True else str(slip).split(",")
    if isinstance(slip, Fraction) or len(parts) == 1:
        aside = probability("slip", slip)
        return 1 - aside, aside / 2, aside / 2
    if len(parts) != 3:
        raise ModelError(
            f'slip is {slip!r}: it must be true, false, a number or three numbers as "0.8,0.1,0.1"'
        )
    ahead, left, right = (probability("slip", part) for part in parts)
    if ahead + left + right != 1 or ahead == 0 or left + right == 0:
        raise ModelError(f"slip is {slip!r}: ahead and a side must be above 0, and the three sum to 1")
    return ahead, left, right


class _Grid:
    """An n by n grid with walls: its cells, and what moving does."""

    def __init__(self, n: int) -> None:
        self.n = n
        self.x = Feature("x", range(n))
        self.y = Feature("y", range(n))
        first, second, third = n // 5, 2 * n // 5, 3 * n // 5
        self.height = second
        self.locations: dict[str, Cell] = {
            "R": (0, n - 1),
            "G": (n - 1, n - 1),
            "Y": (0, 0),
            "B": (third, 0),
        }
        # The columns with a wall on their right, along the upper and along the lower edge.
        self.upper = {second - 1} - {-1} if self.height else set()
        self.lower = {first - 1, third - 1} - {-1} if self.height else set()

    def cells(self) -> dict[str, Cell]:
        """All cells by name, the locations first."""
        named = set(self.locations.values())
        others = [(i, j) for i in range(self.n) for j in range(self.n) if (i, j) not in named]
        return {**self.locations, **{f"x{i}y{j}": (i, j) for i, j in others}}

    def at(self, cell: Cell) -> Expression:
        """The taxi is in `cell`."""
        return self.x.is_(cell[0]) & self.y.is_(cell[1])

    def blocked(self, move: str) -> Expression:
        """The taxi would run into a wall or out of the grid."""
        last = self.n - 1
        if move == "North":
            return self.y.is_(last)
        if move == "South":
            return self.y.is_(0)
        shift = 0 if move == "East" else 1  # a wall on a column's right is on the next one's left
        rules = [self.x.is_(last if move == "East" else 0)]
        if self.upper:
            columns = sorted(column + shift for column in self.upper)
            rules.append(self.x.is_in(columns) & (self.y >= self.n - self.height))
        if self.lower:
            columns = sorted(column + shift for column in self.lower)
            rules.append(self.x.is_in(columns) & (self.y < self.height))
        return disjunction(rules)

    def moved(self, move: str) -> tuple[Feature, Expression]:
        """The feature that `move` changes, and its next value where nothing slips."""
        axis = self.y if move in ("North", "South") else self.x
        step = 1 if move in ("North", "East") else -1
        return axis, conditional(self.blocked(move), axis, axis + step)

    def effects(self, move: str, chances: Chances | None) -> dict[Feature, Expression]:
        """What `move` does.

        With slipping, exactly one of three directions is tried.  Let p be the probability of trying
        to move along x; x' follows from the tries along x alone, and then, if x' differs from x, y
        stays; if not, y's tries have their probabilities given that x has not changed.
        """
        if chances is None:
            axis, target = self.moved(move)
            return {axis: target}
        tries = dict(zip((move, *_SIDES[move]), chances, strict=True))
        along_x = {m: q for m, q in tries.items() if m in ("East", "West") and q}
        along_y = {m: q for m, q in tries.items() if m in ("North", "South") and q}
        rest = sum(along_y.values(), Fraction(0))
        x_next = lottery([*((self.moved(m)[1], q) for m, q in along_x.items()), (self.x, rest)])
        if not along_y:
            return {self.x: x_next}
        if not along_x:
            return {self.y: lottery([(self.moved(m)[1], q) for m, q in along_y.items()])}
        return {self.x: x_next, self.y: self._y_next(along_x, along_y)}

    def _y_next(self, along_x: dict[str, Fraction], along_y: dict[str, Fraction]) -> Expression:
        # P(x' = x) and the distribution of y' given it, by which tries along x are blocked.
        def given(moves: list[str], stayed: Fraction) -> Expression:
            if moves:
                move, *others = moves
                return conditional(
                    self.blocked(move), given(others, stayed + along_x[move]), given(others, stayed)
                )
            total = stayed + sum(along_y.values(), Fraction(0))
            outcomes = [(self.moved(m)[1], q / total) for m, q in along_y.items()]
            return lottery([*outcomes, (self.y, stayed / total)] if stayed else outcomes)

        return conditional(self.x.next.is_(self.x.now), given(list(along_x), Fraction(0)), self.y)
