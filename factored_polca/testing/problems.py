"""Small problems whose optimal values are known: closed forms, and values that programs agree on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factored_polca.explicit.arrays import ArrayMDP, FloatArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp

ROUNDING = 1e-9


@dataclass(frozen=True)
class KnownPOMDP:
    """A POMDP with bounds on its optimal value at the initial belief, and where they come from."""

    name: str
    pomdp: ArrayPOMDP
    low: float
    high: float
    source: str


@dataclass(frozen=True)
class KnownMDP:
    """An MDP with its optimal values [s] (minus infinity: a dead end), and where they come from."""

    name: str
    mdp: ArrayMDP
    values: FloatArray
    source: str


def known_pomdps() -> tuple[KnownPOMDP, ...]:
    """POMDPs of one to eleven states: blind, mixed observability, terminal states among them."""
    agreed = "six decimals on which two or more of pomdp-solve, APPL and zmdp agree"
    return (
        KnownPOMDP("tiger, discount 0.95", tiger(0.95), 19.371366, 19.371370, agreed),
        KnownPOMDP("tiger, discount 0.75", tiger(0.75), 1.933437, 1.933441, agreed),
        KnownPOMDP("cheese maze", cheese(), 3.486205, 3.486209, agreed),
        worn_machine(),
        ending(),
        seen_coin(),
        ended(),
    )


def known_mdps() -> tuple[KnownMDP, ...]:
    """MDPs of a few states: terminal states, actions with conditions, a dead end, discount 1."""
    return (corridor(0.9), corridor(1.0), doors())


def sensed(rows: Sequence[FloatArray], shows: FloatArray) -> list[list[FloatArray]]:
    """The kernel [a][o] of moves [a] of [s, t] after which `shows` [t, o] is observed."""
    return [[row * shows[None, :, o] for o in range(shows.shape[1])] for row in rows]


def tiger(discount: float) -> ArrayPOMDP:
    """Cassandra, Kaelbling & Littman 1994: listen (right in 85 %, -1) or open a door (-100 or 10)."""
    doors = np.full((2, 2), 0.5)
    listen = sensed([np.eye(2)], np.array([[0.85, 0.15], [0.15, 0.85]]))
    opened = sensed([doors, doors], np.full((2, 2), 0.5))
    rewards = np.array([[-1.0, -1.0], [-100.0, 10.0], [10.0, -100.0]])
    return array_pomdp([*listen, *opened], rewards, np.array([0.5, 0.5]), discount)


def cheese() -> ArrayPOMDP:
    """McCallum 1992: eleven cells, of which only the walls are seen; reaching the cheese earns 1."""
    cells = [*((0, x) for x in range(5)), *((1, x) for x in (0, 2, 4)), (2, 0), (2, 4), (2, 2)]
    around = [(-1, 0), (1, 0), (0, 1), (0, -1)]
    walls: list[tuple[object, ...]] = [
        tuple((y + dy, x + dx) in cells for dy, dx in around) for y, x in cells
    ]
    walls[10] = ("cheese",)
    kinds = sorted(set(walls), key=walls.index)
    shows = np.array([[float(wall == kind) for kind in kinds] for wall in walls])
    start = np.append(np.full(10, 0.1), 0.0)
    rows = np.zeros((4, 11, 11))
    for action, (dy, dx) in enumerate(around):
        for number, (y, x) in enumerate(cells[:10]):
            target = (y + dy, x + dx)
            rows[action, number, cells.index(target) if target in cells else number] = 1.0
        rows[action, 10] = start
    return array_pomdp(sensed(list(rows), shows), rows[:, :, 10], start, 0.95)


def worn_machine() -> KnownPOMDP:
    """Blind: a machine earns 1 until it breaks unseen (1/10 a step); replacing it costs 2 and a step."""
    discount, breaks, cost = 0.9, 0.1, 2.0
    run = np.array([[1 - breaks, breaks], [0.0, 1.0]])
    anew = np.array([[1.0, 0.0], [1.0, 0.0]])
    rewards = np.array([[1.0, 0.0], [-cost, -cost]])
    keep = discount * (1 - breaks)
    cycles = [
        (sum(keep**i for i in range(k)) - discount**k * cost) / (1 - discount ** (k + 1))
        for k in range(1, 200)
    ]
    value = max(*cycles, 1 / (1 - keep))
    pomdp = array_pomdp([[run], [anew]], rewards, np.array([1.0, 0.0]), discount)
    source = "closed form: max over k of (sum_{i<k} (d (1 - q))^i - d^k c) / (1 - d^(k+1))"
    return KnownPOMDP("worn machine, blind", pomdp, value - ROUNDING, value + ROUNDING, source)


def ending() -> KnownPOMDP:
    """Earn 3 and go on with 2/3, else end; or earn 1 and go on; or earn 2 and end."""
    discount, onward, rewards = 0.9, (2 / 3, 1.0, 0.0), (3.0, 1.0, 2.0)
    value = max(r / (1 - discount * p) for r, p in zip(rewards, onward, strict=True))
    kernel = [[np.array([[p, 1 - p], [0.0, 0.0]])] for p in onward]
    table = np.array(rewards)[:, None] * np.array([1.0, 0.0])
    pomdp = array_pomdp(kernel, table, np.array([1.0, 0.0]), discount, terminal=np.array([False, True]))
    return KnownPOMDP("ending", pomdp, value - ROUNDING, value + ROUNDING, "closed form: max r / (1 - d p)")


def seen_coin() -> KnownPOMDP:
    """A coin that is seen is thrown anew at each step; naming its side earns 1, the other costs 1."""
    thrown = np.full((2, 2), 0.5)
    pomdp = array_pomdp(
        [[thrown], [thrown]], np.array([[1.0, -1.0], [-1.0, 1.0]]), np.array([0.25, 0.75]), 0.9,
        observed=np.array([0, 1]),
    )  # fmt: skip
    return KnownPOMDP("coin that is seen", pomdp, 10 - ROUNDING, 10 + ROUNDING, "closed form: 1 / (1 - d)")


def ended() -> KnownPOMDP:
    """Every state is terminal."""
    pomdp = array_pomdp(
        [[np.zeros((2, 2))]],
        np.zeros((1, 2)),
        np.array([0.5, 0.5]),
        0.9,
        terminal=np.ones(2, dtype=np.bool_),
    )
    return KnownPOMDP("ended at once", pomdp, 0.0, 0.0, "nothing is earned after the end")


def _mdp(rows: FloatArray, rewards: FloatArray, terminal: int, discount: float) -> ArrayMDP:
    from scipy.sparse import csr_array

    applicable = rows.sum(axis=2) > 0
    flags = np.arange(rows.shape[1]) == terminal
    names = tuple(f"a{number}" for number in range(len(rows)))
    matrices = tuple(csr_array(row) for row in rows)
    return ArrayMDP(names, matrices, np.where(applicable, rewards, 0.0), applicable, flags, discount)


def corridor(discount: float) -> KnownMDP:
    """Cells 4, 3, 2, 1 before the end 0; a step on works in 1/2 of the cases, a step back always; -1 each.

    At discount 1 a cell costs two steps; below, a cell's factor is f = (d / 2) / (1 - d / 2) and
    V = -(1 - f^n) / (1 - d).
    """
    rows = np.zeros((2, 5, 5))
    for cell in range(1, 5):
        rows[0, cell, cell - 1] = rows[0, cell, cell] = 0.5
        rows[1, cell, min(cell + 1, 4)] = 1.0
    cells = np.arange(5)
    factor = discount / 2 / (1 - discount / 2)
    exact = -2.0 * cells if discount == 1 else (factor**cells - 1) / (1 - discount)
    values = np.asarray(exact, dtype=np.float64)
    mdp = _mdp(rows, np.full((2, 5), -1.0), 0, discount)
    return KnownMDP(f"corridor, discount {discount:g}", mdp, values, "closed form: geometric times")


def doors() -> KnownMDP:
    """State 1 offers 5 and the end by action 0; state 2 leads to it for 1, or for 100 to the dead end 3."""
    rows = np.zeros((2, 4, 4))
    rows[0, 1, 0] = rows[1, 2, 1] = rows[0, 2, 3] = 1.0
    rewards = np.zeros((2, 4))
    rewards[0, 1], rewards[1, 2], rewards[0, 2] = 5.0, -1.0, 100.0
    values = np.array([0.0, 5.0, -1.0 + 0.9 * 5.0, -np.inf])
    return KnownMDP("doors", _mdp(rows, rewards, 0, 0.9), values, "two steps of arithmetic")
