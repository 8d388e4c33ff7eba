"""The shipped partially observable domains against their sources, read again here by independent means.

Kernels are compared, state by state, with small simulations written from the domains' definitions;
values with closed forms, with brute force over beliefs, and with those that several solvers agree on.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factored_polca import library, read
from factored_polca.explicit.evaluate import distribution, evaluate
from factored_polca.explicit.exact_pomdp import ExactPOMDP, enumerate_pomdp
from factored_polca.formats.document import Document
from factored_polca.formats.native import read_native, write_native
from factored_polca.models import Model, check, check_tasks
from factored_polca.models.errors import ModelError
from factored_polca.models.expressions import references
from factored_polca.symbolic import compile_model

F = Fraction
State = tuple[Any, ...]
Joint = Mapping[tuple[State, State], Fraction]
Step = Callable[[State, str], tuple[Joint, Fraction]]

# name, parameters, states, actions
SOUND = [
    ("tiger", {}, 2, 3),
    ("tiger", {"accuracy": "1/2", "discount": "0"}, 2, 3),
    ("tiger", {"accuracy": "1", "discount": "0.75"}, 2, 3),
    ("cheese", {}, 11, 4),
    ("hallway", {}, 60, 5),
    ("hallway", {"size": "5", "hit": "1", "false_alarm": "0"}, 4 * 6, 5),
    ("hallway", {"size": "6"}, 4 * 7, 5),
    ("hallway", {"size": "21"}, 4 * (21 + 9), 5),
    ("coffee", {}, 432, 9),
    ("network", {}, 2**4, 9),
    ("network", {"size": "1"}, 2, 3),
    ("network", {"size": "1", "topology": "legs"}, 2, 3),
    ("network", {"size": "7", "topology": "legs"}, 2**7, 15),
    ("network", {"size": "20"}, 2**20, 41),
    ("rocksample", {}, 4 * 5 * 2**4, 9),
    ("rocksample", {"size": "1", "rocks": "1"}, 2 * 2, 6),
    ("rocksample", {"size": "3", "rocks": "2", "half_distance": "0.5", "seed": "7"}, 3 * 4 * 2**2, 7),
    ("rocksample", {"size": "7", "rocks": "8"}, 7 * 8 * 2**8, 13),
    ("rocksample", {"size": "11", "rocks": "11"}, 11 * 12 * 2**11, 16),
    ("rocksample", {"size": "8", "rocks": "12", "seed": "3"}, 8 * 9 * 2**12, 17),
]


@pytest.mark.parametrize(("name", "parameters", "states", "actions"), SOUND)
def test_every_domain_is_sound_and_has_the_states_and_actions_it_says(
    name: str, parameters: Mapping[str, str], states: int, actions: int
) -> None:
    domain = library.load(name, parameters)
    assert domain.model.observability == "partial"
    assert domain.model.states == states
    assert len(domain.model.actions) == actions
    assert check(domain.model) == []
    # Without a hierarchy, one task holds every action.
    assert domain.tasks is not None
    assert check_tasks(domain.model, domain.tasks) == []
    (root,) = domain.tasks.roots()
    assert root.actions == tuple(action.name for action in domain.model.actions)


@pytest.mark.parametrize(("name", "parameters"), [(n, p) for n, p, states, _ in SOUND if states < 10**5])
def test_every_domain_is_read_back_from_its_own_text(name: str, parameters: Mapping[str, str]) -> None:
    domain = library.load(name, parameters)
    assert read_native(write_native(domain.model, domain.tasks)) == Document(domain.model, domain.tasks)


@pytest.mark.parametrize(("name", "parameters"), [(n, p) for n, p, states, _ in SOUND if states < 10**5])
def test_every_domain_has_rows_that_sum_to_one(name: str, parameters: Mapping[str, str]) -> None:
    # Compiling refuses rows that don't; enumeration, below, reads the small ones by another way.
    assert compile_model(library.load(name, parameters).model).model.name == name


@cache
def enumerated(name: str, *parameters: tuple[str, str]) -> ExactPOMDP:
    return enumerate_pomdp(library.load(name, dict(parameters)).model)


def agrees(pomdp: ExactPOMDP, step: Step) -> None:
    """Each row and reward at non-terminal states is what `step` says; exactly."""
    for s, state in enumerate(pomdp.state_values):
        for a, action in enumerate(pomdp.actions):
            if pomdp.terminal[s]:
                assert pomdp.kernel[a][s] == {}
                continue
            joint, reward = step(state, action)
            found = {
                (pomdp.state_values[t], pomdp.observations[o]): q
                for (t, o), q in pomdp.kernel[a][s].items()
            }
            assert found == {key: q for key, q in joint.items() if q}, (state, action)
            assert pomdp.rewards[a][s] == reward, (state, action)


# --------------------------------------------------------------------------------------------
# Tiger
# --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("accuracy", [F(85, 100), F(1, 2), F(1)])
def test_the_tiger_is_that_of_the_source(accuracy: Fraction) -> None:
    def step(state: State, action: str) -> tuple[Joint, Fraction]:
        (tiger,) = state
        if action == "listen":
            other = {"left": "right", "right": "left"}[tiger]
            return {((tiger,), (tiger,)): accuracy, ((tiger,), (other,)): 1 - accuracy}, F(-1)
        everything = {
            (after, heard): F(1, 4) for after, heard in product((("left",), ("right",)), repeat=2)
        }
        return everything, F(-100 if action == f"open_{tiger}" else 10)

    pomdp = enumerated("tiger", ("accuracy", str(accuracy)))
    assert pomdp.actions == ("listen", "open_left", "open_right")
    assert pomdp.initial == (F(1, 2), F(1, 2))
    agrees(pomdp, step)


def tiger_bounds(discount: float, points: int = 2001) -> tuple[float, float]:
    """Bounds on the tiger's value at 1/2: p is the probability of left.

    V is convex and symmetric.  Interpolating a grid's values between its points keeps an upper bound
    one; the vectors that are best at some point of it are a lower bound.
    """
    p = np.linspace(0, 1, points)
    hear = np.array([0.85, 0.15])  # P(growl left | left, right)
    chance = [p * hear[z] + (1 - p) * hear[1 - z] for z in (0, 1)]
    posterior = [p * hear[z] / chance[z] for z in (0, 1)]
    opened = np.maximum(-100 * p + 10 * (1 - p), 10 * p - 100 * (1 - p))
    upper = np.full(points, 10 / (1 - discount))
    vectors = np.array([[-1.0, -1.0]]) / (1 - discount)  # listening for ever; columns left, right
    steps = 0
    while discount**steps > 1e-8:
        steps += 1
        listen = -1 + discount * sum(chance[z] * np.interp(posterior[z], p, upper) for z in (0, 1))
        upper = np.maximum(listen, opened + discount * upper[points // 2])
        best = vectors @ np.array([p, 1 - p])
        now = vectors[best.argmax(axis=0)]
        after = [vectors[(vectors @ np.array([b, 1 - b])).argmax(axis=0)] for b in posterior]
        listening = -1 + discount * (after[0] * hear + after[1] * hear[::-1])
        middle = discount * now[points // 2].mean()
        opening = np.array([[-100.0, 10.0], [10.0, -100.0]]) + middle
        vectors = np.unique(np.vstack([listening, opening]).round(11), axis=0)
        lines = vectors @ np.array([p, 1 - p])
        vectors = vectors[np.unique(lines.argmax(axis=0))]
    return float((vectors @ [0.5, 0.5]).max()), float(upper[points // 2])


@pytest.mark.parametrize(("discount", "value"), [(0.95, 19.371368), (0.75, 1.933439)])
def test_the_tiger_s_published_value_lies_between_brute_force_bounds(discount: float, value: float) -> None:
    # The values are those that pomdp-solve and SARSOP agree on.
    lower, upper = tiger_bounds(discount)
    assert lower <= value + 1e-6
    assert value - 1e-6 <= upper
    assert upper - lower < 1e-3


# --------------------------------------------------------------------------------------------
# Cheese
# --------------------------------------------------------------------------------------------

# As cheese.95 numbers its states: 0..4 along the corridor, 5 to 7 below its ends and middle, then 8 and 9
# below 5 and 7, and 10, the cheese, below 6.
CELLS = ["x0y0", "x1y0", "x2y0", "x3y0", "x4y0", "x0y1", "x2y1", "x4y1", "x0y2", "x4y2", "x2y2"]
READINGS = [0, 1, 2, 1, 3, 4, 4, 4, 5, 5, 6]  # of each state, as there
WALLS = ["north_west", "north_south", "north", "north_east", "east_west", "east_south_west", "cheese"]
PATHS = {
    "north": {5: 0, 6: 2, 7: 4, 8: 5, 9: 7},
    "south": {0: 5, 2: 6, 4: 7, 5: 8, 6: 10, 7: 9},
    "east": {0: 1, 1: 2, 2: 3, 3: 4},
    "west": {1: 0, 2: 1, 3: 2, 4: 3},
}


def test_the_cheese_maze_is_that_of_the_source() -> None:
    def step(state: State, action: str) -> tuple[Joint, Fraction]:
        at = CELLS.index(state[0])
        after = {t: F(1, 10) for t in range(10)} if at == 10 else {PATHS[action].get(at, at): F(1)}
        joint = {((CELLS[t],), (WALLS[READINGS[t]],)): q for t, q in after.items()}
        return joint, after.get(10, F(0))

    pomdp = enumerated("cheese")
    assert {values[0] for values in pomdp.state_values} == set(CELLS)
    assert {values[0] for values in pomdp.observations} == set(WALLS)
    assert dict(zip(pomdp.state_values, pomdp.initial, strict=True)) == {
        (cell,): F(0 if cell == "x2y2" else 1, 10) for cell in CELLS
    }
    agrees(pomdp, step)


def closed_value(pomdp: ExactPOMDP) -> float:
    """V*(b0) where the beliefs reachable from b0 are finitely many: an MDP over exact beliefs."""
    number = {pomdp.initial: 0}
    waiting = [pomdp.initial]
    branches: list[list[tuple[float, list[tuple[float, int]]]]] = []
    while waiting:
        belief = waiting.pop(0)
        options = []
        for rows, rewards in zip(pomdp.kernel, pomdp.rewards, strict=True):
            after: dict[int, dict[int, Fraction]] = {}
            for s, weight in enumerate(belief):
                for (t, o), q in rows[s].items() if weight else ():
                    seen = after.setdefault(o, {})
                    seen[t] = seen.get(t, F(0)) + weight * q
            targets = []
            for seen in after.values():
                total = sum(seen.values())
                new = tuple(seen.get(t, F(0)) / total for t in range(pomdp.states))
                if new not in number:
                    number[new] = len(number)
                    waiting.append(new)
                    assert len(number) < 2000, "the beliefs do not close"
                targets.append((float(total), number[new]))
            options.append(
                (float(sum(w * r for w, r in zip(belief, rewards, strict=True))), targets),
            )
        branches.append(options)
    discount, values = float(pomdp.discount), np.zeros(len(branches))
    for _ in range(700):  # 0.95^700 < 1e-15
        values = np.array(
            [
                max(r + discount * sum(q * values[b] for q, b in t) for r, t in options)
                for options in branches
            ]
        )
    return float(values[0])


def test_the_cheese_is_worth_what_is_published() -> None:
    # pomdp-solve and SARSOP agree on 3.486207.
    assert closed_value(enumerated("cheese")) == pytest.approx(3.486207, abs=1e-6)


# --------------------------------------------------------------------------------------------
# Network
# --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "topology", "upstream"),
    [
        (1, "cycle", {0: 0}),
        (3, "cycle", {0: 2, 1: 0, 2: 1}),
        (4, "legs", {1: 0, 2: 0, 3: 0}),
        (7, "legs", {1: 0, 2: 1, 3: 0, 4: 3, 5: 0, 6: 5}),
    ],
)
def test_the_network_is_that_of_the_source(size: int, topology: str, upstream: Mapping[int, int]) -> None:
    def chance_up(state: State, i: int, action: str) -> Fraction:
        if action == f"reboot_{i}":
            return F("0.95")
        if not state[i]:
            return F("0.01")
        return F("0.9") if i not in upstream or state[upstream[i]] else F("0.667")

    def step(state: State, action: str) -> tuple[Joint, Fraction]:
        joint = {}
        for after in product((False, True), repeat=size):
            up = [chance_up(state, i, action) for i in range(size)]
            q = math.prod((p if t else 1 - p for p, t in zip(up, after, strict=True)), start=F(1))
            if action.startswith("ping_"):
                right, wrong = ("up", "down") if after[int(action[5:])] else ("down", "up")
                joint[after, (right,)], joint[after, (wrong,)] = q * F("0.95"), q * F("0.05")
            else:
                joint[after, ("none",)] = q
        cost = {"noop": F(0), "reboo": F("2.5"), "ping_": F("0.1")}[action[:5]]
        return joint, sum(state) + state[0] - cost

    if size < 7:
        pomdp = enumerated("network", ("size", str(size)), ("topology", topology))
        assert pomdp.initial[-1] == 1  # all up
        assert pomdp.state_values[-1] == (True,) * size
        agrees(pomdp, step)
        return
    model = library.load("network", {"size": str(size), "topology": topology}).model
    for state in product((False, True), repeat=size):
        here = {(f"up_{i}", False): up for i, up in enumerate(state)}
        for action in model.actions:
            for name, effect in action.effects:
                row = distribution(effect, (False, True), here)
                assert isinstance(row, tuple)
                assert row[1] == chance_up(state, int(name[3:]), action.name)


# --------------------------------------------------------------------------------------------
# RockSample
# --------------------------------------------------------------------------------------------

# The first draws of Python's generator for the seed 0 are 0.8444.. and 0.7579..: the 8th of the 9 cells,
# in the order (0, 0), (0, 1), .., then the 7th of the 8 left.
DRAWN = [(2, 1), (2, 0)]
PUBLISHED = [(3, 1), (2, 1), (1, 3), (1, 0)]  # RockSample[4, 4], gen_RockSample_4_4 of ZMDP


@pytest.mark.parametrize(
    ("n", "rocks", "half_distance"), [(3, DRAWN, 20.0), (4, PUBLISHED, math.log(2))], ids=["3,2", "4,4"]
)
def test_rocksample_is_that_of_the_source(
    n: int, rocks: Sequence[tuple[int, int]], half_distance: float
) -> None:
    moves = {"north": (0, 1), "south": (0, -1), "east": (1, 0), "west": (-1, 0)}

    def outcome(state: State, action: str) -> tuple[State, int]:
        x, y, *good = state
        if action in moves:
            i, j = x + moves[action][0], y + moves[action][1]
            if i == n:
                return (n, y, *good), 10
            return ((i, j, *good), 0) if i >= 0 and 0 <= j < n else ((n, y, *good), -100)
        if (x, y) not in rocks:
            return (n, y, *good), -100
        rock = rocks.index((x, y))
        reward = 10 if good[rock] else -10
        good[rock] = False
        return (x, y, *good), reward

    pomdp = enumerated("rocksample", ("size", str(n)), ("rocks", str(len(rocks))))
    numbers = {values: t for t, values in enumerate(pomdp.state_values)}
    channel = {values[0]: o for o, values in enumerate(pomdp.observations)}
    for s, state in enumerate(pomdp.state_values):
        assert pomdp.terminal[s] == (state[0] == n)
        start = state[:2] == (0, n // 2)
        assert pomdp.initial[s] == (F(1, 2 ** len(rocks)) if start else 0)
        for a, action in enumerate(pomdp.actions):
            row = pomdp.kernel[a][s]
            if pomdp.terminal[s]:
                assert row == {}
                assert pomdp.rewards[a][s] == 0
            elif not action.startswith("check_"):
                after, reward = outcome(state, action)
                assert row == {(numbers[after], channel["none"]): F(1)}
                assert pomdp.rewards[a][s] == reward
            else:
                i = int(action[6:])
                efficiency = 2 ** (
                    -math.hypot(int(state[0]) - rocks[i][0], int(state[1]) - rocks[i][1]) / half_distance
                )
                good = (1 + efficiency) / 2 if state[2 + i] else (1 - efficiency) / 2
                # 12 decimals, and what floats lose in computing them
                assert float(row.get((s, channel["good"]), 0)) == pytest.approx(good, abs=1e-11)
                assert sum(row.values()) == 1
                assert set(row) <= {(s, channel["good"]), (s, channel["bad"])}
                assert pomdp.rewards[a][s] == 0


def check_accuracy(model: Model, i: int, x: int, y: int) -> Fraction:
    """P(good | rock i is good) at (x, y)."""
    sense = dict(model.action(f"check_{i}").senses)["reading"]
    here = {("x", True): x, ("y", True): y, (f"rock_{i}", True): True}
    row = distribution(sense, ("none", "good", "bad"), here)
    assert isinstance(row, tuple)
    return row[1]


def test_the_rover_s_sensor_is_half_as_good_at_the_half_distance() -> None:
    model = library.load("rocksample", {"size": "5", "rocks": "5"}).model  # published: d0 = 4
    assert check_accuracy(model, 1, 0, 4) == 1  # at the rock (0, 4)
    assert check_accuracy(model, 1, 4, 4) == F(3, 4)
    assert check_accuracy(model, 1, 0, 0) == F(3, 4)
    given = library.load("rocksample", {"size": "5", "rocks": "5", "half_distance": "1"}).model
    assert check_accuracy(given, 1, 3, 4) == F(9, 16)
    # The rock (2, 0) from (3, 1): (1 + e^(-sqrt(2) ln(2) / 20)) / 2 = 0.97608441990542.., by Decimal.exp.
    far = library.load("rocksample", {"size": "7", "rocks": "8"}).model
    assert check_accuracy(far, 0, 3, 1) == F("0.976084419905")


def test_rocksample_knows_where_the_rover_is_and_nothing_of_the_rocks() -> None:
    model = library.load("rocksample", {"size": "11", "rocks": "11"}).model
    assert [f.name for f in model.features if f.observed] == ["x", "y"]
    pomdp = enumerated("rocksample", ("size", "3"), ("rocks", "2"))
    places = [values[:2] for values in pomdp.state_values]
    for s, t in product(range(pomdp.states), repeat=2):
        assert (pomdp.observed[s] == pomdp.observed[t]) == (places[s] == places[t])


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_drawn_rocks_lie_apart_in_the_grid_and_move_with_the_seed(seed: int) -> None:
    def cells(parameters: Mapping[str, str]) -> list[tuple[int, int]]:
        model = library.load("rocksample", parameters).model
        rate = [
            [(check_accuracy(model, i, x, y), (x, y)) for x in range(5) for y in range(5)] for i in range(7)
        ]
        return [max(rates)[1] for rates in rate]  # the sensor is sure at the rock itself

    drawn = {"size": "5", "rocks": "7", "seed": str(seed)}
    assert len(set(cells(drawn))) == 7
    assert cells(drawn) == cells(drawn)
    # gen_RockSample_5_7 of ZMDP
    published = [(1, 0), (2, 1), (1, 2), (2, 2), (4, 2), (0, 3), (3, 4)]
    assert cells({"size": "5", "rocks": "7"}) == published
    assert cells(drawn) not in (published, cells({**drawn, "seed": str(seed + 1)}))


def test_one_rock_underfoot_is_checked_first() -> None:
    # The check is sure: 0.95 (1/2 (10 + 0.95 10) + 1/2 10); to leave at once brings 10.
    assert closed_value(enumerated("rocksample", ("size", "1"), ("rocks", "1"))) == pytest.approx(14.0125)
    # Leaving at once is better when nothing after the first step counts.
    hasty = enumerated("rocksample", ("size", "1"), ("rocks", "1"), ("discount", "0"))
    assert closed_value(hasty) == 10


# --------------------------------------------------------------------------------------------
# Hallway
# --------------------------------------------------------------------------------------------

COMPASS = {"north": (0, 1), "east": (1, 0), "south": (0, -1), "west": (-1, 0)}
TURNED = list(COMPASS)


def place_name(cell: tuple[int, int], goal: int) -> str:
    x, y = cell
    return f"hall_{x}" if y == 0 else "goal" if x == goal else f"room_{x}"


@pytest.mark.parametrize(("size", "doors"), [(11, [2, 4, 6, 8]), (6, [2]), (7, [2, 4])])
def test_the_hallway_is_that_of_the_source(size: int, doors: Sequence[int]) -> None:
    goal = doors[-1]
    cells = [*((x, 0) for x in range(size)), *((x, -1) for x in doors)]
    names = {place_name(cell, goal): cell for cell in cells}
    starts = [(name, heading) for name in names if name != "goal" for heading in COMPASS]

    def walled(cell: tuple[int, int], heading: str) -> bool:
        return (cell[0] + COMPASS[heading][0], cell[1] + COMPASS[heading][1]) not in cells

    def seen(state: State) -> Mapping[State, Fraction]:
        (x, y), heading = names[state[0]], state[1]
        if state[0] == "goal" or (y == 0 and x in doors and heading == "south"):
            return {(False,) * 4 + ("goal" if state[0] == "goal" else f"door_{x}",): F(1)}
        ahead = TURNED.index(heading)
        walls = [walled((x, y), TURNED[(ahead + turn) % 4]) for turn in range(4)]
        return {
            (*told, "none"): math.prod(
                (
                    (F(9, 10) if tell else F(1, 10)) if wall else (F(1, 20) if tell else F(19, 20))
                    for wall, tell in zip(walls, told, strict=True)
                ),
                start=F(1),
            )
            for told in product((False, True), repeat=4)
        }

    def moved(state: State, action: str) -> dict[State, Fraction]:
        place, heading = state
        if place == "goal":
            return dict.fromkeys(starts, F(1, len(starts)))
        turn = TURNED.index(heading)
        if action == "stay":
            return {state: F(1)}
        if action != "forward":
            quarters = {
                "turn_right": (10, 70, 10, 10),
                "turn_left": (10, 10, 10, 70),
                "turn_around": (10, 15, 60, 15),
            }[action]
            return {(place, TURNED[(turn + k) % 4]): F(q, 100) for k, q in enumerate(quarters)}
        result = {state: F(5, 100)}
        for k, q in enumerate((80, 5, 5, 5)):
            direction = TURNED[(turn + k) % 4]
            cell = names[place]
            if walled(cell, direction):
                result[state] += F(q, 100)
                continue
            target = place_name((cell[0] + COMPASS[direction][0], cell[1] + COMPASS[direction][1]), goal)
            for after in (heading, direction) if k == 2 else (direction,):
                result[target, after] = F(q, 200 if k == 2 else 100)
        return result

    def step(state: State, action: str) -> tuple[Joint, Fraction]:
        after = moved(state, action)
        joint = {(t, o): q * p for t, q in after.items() for o, p in seen(t).items()}
        return joint, sum((q for t, q in after.items() if t[0] == "goal" != state[0]), F(0))

    pomdp = enumerated("hallway", ("size", str(size)))
    assert pomdp.states == 4 * len(cells)
    assert len(pomdp.observations) == 16 + len(doors) + 1
    begin = {s for s, q in zip(pomdp.state_values, pomdp.initial, strict=True) if q}
    assert begin == set(starts)
    assert set(pomdp.initial) == {0, F(1, len(starts))}
    agrees(pomdp, step)


@pytest.mark.data
def test_the_hallway_is_that_of_the_authors_file() -> None:
    """States and actions have the same numbers; the file's rows are rounded, what is left in one entry."""
    source = enumerate_pomdp(read(Path(os.environ["FACTORED_POLCA_DATA"]) / "Hallway.pomdpx").model)
    ours = enumerated("hallway", ("size", "11"))

    def number(observation: State) -> int:
        """Sixteen sets of walls, front first; the four doors from the west; the goal."""
        *walls, landmark = observation
        if landmark == "none":
            return int("".join(str(int(wall)) for wall in walls), 2)
        return 16 + ["door_2", "door_4", "door_6", "door_8", "goal"].index(landmark)

    names = [f"o{number(values)}" for values in ours.observations]
    for a, s in product(range(5), range(60)):
        row = {(t, names[o]): q for (t, o), q in ours.kernel[a][s].items()}
        given = {(t, str(source.observations[o][0])): q for (t, o), q in source.kernel[a][s].items()}
        for key in row.keys() | given.keys():
            assert abs(row.get(key, F(0)) - given.get(key, F(0))) < 2e-5
        assert ours.rewards[a][s] == source.rewards[a][s]
        assert abs(ours.initial[s] - source.initial[s]) < 2e-5


# --------------------------------------------------------------------------------------------
# Coffee
# --------------------------------------------------------------------------------------------

CALM = {
    "user_has_coffee": False, "wetness": "dry", "robot_has_coffee": False, "rain": "none",
    "umbrella": False, "location": "office", "battery": "high",
}  # fmt: skip


def coffee_row(action: str, feature: str, **changes: Any) -> dict[Any, Fraction]:
    """P(feature' | CALM with `changes`); names that end in `_next` are values afterwards."""
    model = library.load("coffee").model
    here = {(name, False): value for name, value in {**CALM, **changes}.items() if name in CALM}
    here |= {(name[:-5], True): value for name, value in changes.items() if name.endswith("_next")}
    values = model.feature(feature).values
    row = distribution(dict(model.action(action).effects)[feature], values, here)
    assert isinstance(row, tuple)
    return {value: q for value, q in zip(values, row, strict=True) if q}


@pytest.mark.parametrize(
    ("action", "feature", "changes", "expected"),
    [
        ("wait", "user_has_coffee", {}, {False: 1}),
        ("wait", "user_has_coffee", {"user_has_coffee": True}, {True: "0.9", False: "0.1"}),
        ("wait", "rain", {"rain": "light"}, {"heavy": "0.1", "light": "0.8", "none": "0.1"}),
        ("wait", "battery", {"battery": "low"}, {"dead": "0.2", "low": "0.8"}),
        ("wait", "battery", {"battery": "dead"}, {"dead": 1}),
        ("move", "location", {}, {"shop": "0.9", "office": "0.1"}),
        # On a low battery both moving and staying gain 1 before normalising: 1.9 and 1.1 of 3.
        ("move", "location", {"battery": "low", "location": "shop"}, {"office": "19/30", "shop": "11/30"}),
        ("move", "location", {"battery": "dead"}, {"office": 1}),
        ("move", "wetness", {"rain": "heavy"}, {"drenched": "0.9", "sprinkled": "0.1"}),
        ("move", "wetness", {"rain": "light", "umbrella": True}, {"sprinkled": "0.05", "dry": "0.95"}),
        ("move", "wetness", {"wetness": "sprinkled"}, {"sprinkled": "0.9", "dry": "0.1"}),
        ("move", "wetness", {"wetness": "drenched"}, {"drenched": 1}),
        ("deliver", "user_has_coffee", {"robot_has_coffee": True}, {True: "0.8", False: "0.2"}),
        ("deliver", "user_has_coffee", {"robot_has_coffee": True, "location": "shop"}, {False: 1}),
        ("deliver", "robot_has_coffee", {"robot_has_coffee": True}, {True: "0.1", False: "0.9"}),
        ("get_umbrella", "umbrella", {}, {True: "0.9", False: "0.1"}),
        ("get_umbrella", "umbrella", {"location": "shop"}, {False: 1}),
        ("buy_carefully", "robot_has_coffee", {}, {False: 1}),
        ("buy_carefully", "robot_has_coffee", {"location": "shop"}, {True: 1}),
        ("buy_fast", "robot_has_coffee", {"location": "shop"}, {True: "0.9", False: "0.1"}),
        ("buy_fast", "wetness", {"robot_has_coffee_next": True}, {"sprinkled": "0.3", "dry": "0.7"}),
        ("buy_fast", "wetness", {"robot_has_coffee_next": False}, {"dry": 1}),
        ("buy_fast", "wetness", {"robot_has_coffee": True, "robot_has_coffee_next": True}, {"dry": 1}),
        ("recharge", "battery", {"battery": "dead"}, {"high": 1}),
        ("recharge", "battery", {"battery": "dead", "location": "shop"}, {"dead": 1}),
        (
            "dry_off",
            "wetness",
            {"wetness": "drenched"},
            {"drenched": "0.1", "sprinkled": "0.2", "dry": "0.7"},
        ),
    ],
)
def test_the_coffee_robot_s_world_changes_as_described(
    action: str, feature: str, changes: Mapping[str, Any], expected: Mapping[Any, Any]
) -> None:
    assert coffee_row(action, feature, **changes) == {value: F(q) for value, q in expected.items()}


def test_the_coffee_robot_is_rewarded_and_pays_as_described() -> None:
    model = library.load("coffee").model

    def reward(action: str, **changes: Any) -> Any:
        here = {(name, False): value for name, value in {**CALM, **changes}.items()}
        terms = [evaluate(term, here) for term in (*model.rewards, *model.action(action).rewards)]
        return sum(terms)

    assert reward("wait", user_has_coffee=True, wetness="drenched") == 2
    assert reward("wait", wetness="sprinkled") == F("-1.1")
    assert reward("move") == F("-0.2")
    assert reward("move", location="shop") == F("-0.1")
    assert reward("get_umbrella") == F("-1.6")
    assert reward("get_umbrella", location="shop") == 0
    assert reward("buy_carefully", location="shop") == F("-0.3")
    assert reward("buy_fast", location="shop", user_has_coffee=True) == F("4.9")
    assert reward("buy_fast") == 0


@pytest.mark.data
def test_the_coffee_robot_is_that_of_the_source() -> None:
    """State by state; where we report none of the pavement, the source reports a fair coin."""
    source = enumerate_pomdp(read(Path(os.environ["FACTORED_POLCA_DATA"]) / "coffee.90.SPUDD").model)
    ours = enumerated("coffee")
    renamed = {
        "nothing": "wait",
        "measurewet": "measure",
        "delc": "deliver",
        "getu": "get_umbrella",
        "buyc_careful": "buy_carefully",
        "buyc_fast": "buy_fast",
        "dryoff": "dry_off",
    }
    yes = {"yes": True, "no": False}

    def translated(values: Sequence[Any]) -> State:
        huc, wet, hrc, rain, umbrella, place, battery = values
        return (yes[huc], wet, yes[hrc], "none" if rain == "no" else rain, yes[umbrella], place, battery)

    def row(pomdp: ExactPOMDP, a: int, s: int) -> dict[tuple[State, State], Fraction]:
        result: dict[tuple[State, State], Fraction] = {}
        for (t, o), q in pomdp.kernel[a][s].items():
            pavement, charge = pomdp.observations[o]
            for seen in ("wet", "dry") if pavement == "none" else (pavement,):
                share = q / 2 if pavement == "none" else q
                after = translated(pomdp.state_values[t]) if pomdp is source else pomdp.state_values[t]
                result[after, (seen, charge)] = share
        return result

    number = {values: s for s, values in enumerate(ours.state_values)}
    assert source.discount == ours.discount
    for a, action in enumerate(source.actions):
        b = ours.actions.index(renamed.get(action, action))
        for s, values in enumerate(source.state_values):
            t = number[translated(values)]
            assert source.initial[s] == ours.initial[t]
            assert source.rewards[a][s] == ours.rewards[b][t]
            assert row(source, a, s) == row(ours, b, t), (action, values)


# --------------------------------------------------------------------------------------------
# Factored form, and parameters
# --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "parameters", "parents"),
    [
        # Largest number of variables that one distribution, sense or reward term may mention.
        ("network", {"size": "40"}, 2),
        ("rocksample", {"size": "11", "rocks": "11"}, 3),
        ("hallway", {"size": "51"}, 3),
        ("coffee", {}, 3),
    ],
)
def test_big_domains_stay_factored(name: str, parameters: Mapping[str, str], parents: int) -> None:
    model = library.load(name, parameters).model
    expressions = [*model.rewards, model.terminal]
    for action in model.actions:
        expressions += [*action.rewards, *(e for _, e in action.effects), *(e for _, e in action.senses)]
    assert max(len(references(e)) for e in expressions) <= parents


@pytest.mark.parametrize(
    ("name", "parameters", "said"),
    [
        ("tiger", {"accuracy": "1.1"}, ["accuracy is", "from 0 to 1"]),
        ("tiger", {"accuracy": "often"}, ["'often'", "number"]),
        ("tiger", {"discount": "2"}, ["discount is", "from 0 to 1"]),
        ("tiger", {"size": "2"}, ["no parameter 'size'", "accuracy, discount"]),
        ("cheese", {"discount": "-1"}, ["discount is", "from 0 to 1"]),
        ("coffee", {"discount": "x"}, ["'x'", "number"]),
        ("hallway", {"size": "4"}, ["size is 4", "from 5"]),
        ("hallway", {"size": "long"}, ["'long'", "integer"]),
        ("hallway", {"hit": "-0.1"}, ["hit is", "from 0 to 1"]),
        ("hallway", {"false_alarm": "1.5"}, ["false_alarm is", "from 0 to 1"]),
        ("network", {"size": "0"}, ["size is 0", "from 1"]),
        ("network", {"topology": "ring"}, ["topology is 'ring'", "cycle, legs"]),
        ("network", {"size": "5", "topology": "legs"}, ["size is 5", "1, 4, 7, 10"]),
        ("rocksample", {"size": "0"}, ["size is 0", "from 1"]),
        ("rocksample", {"size": "2", "rocks": "5"}, ["rocks is 5", "from 1 to 4"]),
        ("rocksample", {"rocks": "0"}, ["rocks is 0"]),
        ("rocksample", {"half_distance": "-1"}, ["half_distance is -1", "above 0"]),
        ("rocksample", {"half_distance": "far"}, ["'far'", "number"]),
        ("rocksample", {"seed": "-1"}, ["seed is -1", "from 0"]),
    ],
)
def test_a_bad_parameter_is_refused_with_what_is_allowed(
    name: str, parameters: Mapping[str, object], said: Sequence[str]
) -> None:
    with pytest.raises(ModelError) as caught:
        library.load(name, parameters)
    for part in said:
        assert part in str(caught.value)


@pytest.mark.parametrize("name", ["tiger", "cheese", "hallway", "coffee", "network", "rocksample"])
def test_discount_one_is_refused_by_the_check(name: str) -> None:
    faults = check(library.load(name, {"discount": "1"}).model)
    assert ["discount 1" in fault.message for fault in faults] == [True]
