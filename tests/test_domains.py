"""The shipped domains against their descriptions, read again here by independent means.

Rows and rewards are compared with small simulations written from the domains' definitions; numbers of
blocks with closed forms.  Where a partition or a value is needed it comes from `explicit`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factored_polca import library
from factored_polca.explicit.dynamic_programming import action_values, greedy_policy, value_iteration
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.explicit.minimiser import minimise
from factored_polca.explicit.subtask import subtask_mdp
from factored_polca.models import ModelError, check, check_tasks
from factored_polca.models.expressions import references, subexpressions

STATES = [
    ("toy", {}, 4),
    ("linear", {}, 2**16),
    ("linear", {"size": "64"}, 2**64),
    ("expon", {}, 2**8),
    ("components", {}, 3**10),
    ("components", {"size": "40"}, 3**40),
    ("sysadmin", {}, 2**8),
    ("sysadmin", {"size": "1"}, 2),
    ("sysadmin", {"size": "5", "topology": "star", "cost": "0"}, 2**5),
    ("sysadmin", {"size": "5", "topology": "independent"}, 2**5),
    ("taxi", {}, 600),
    ("taxi", {"size": "2"}, 4 * 6 * 4),
    ("taxi", {"size": "128", "slip": "true"}, 128 * 128 * 6 * 4),
    ("taxi", {"anywhere": "true", "noise_bits": "3"}, 25 * 27 * 4 * 8),
    ("workshop", {}, 4**8 * 60),
    ("workshop", {"size": "1", "decay": "0"}, 4 * 60),
    # Partially observable: see test_pomdp_domains.py and test_hierarchical_pomdp_domains.py.
    ("cheese", {}, 11),
    ("cheese_taxi", {}, 33),
    ("coffee", {}, 432),
    ("hallway", {}, 60),
    ("meds", {}, 3),
    ("network", {}, 2**4),
    ("nursebot", {}, 576),
    ("part_painting", {}, 4),
    ("rocksample", {}, 4 * 5 * 2**4),
    ("tiger", {}, 2),
    ("twenty_questions", {}, 12),
]


@pytest.mark.parametrize(("name", "parameters", "states"), STATES)
def test_every_domain_is_sound_and_has_the_states_it_says(
    name: str, parameters: Mapping[str, str], states: int
) -> None:
    domain = library.load(name, parameters)
    assert domain.model.states == states
    assert check(domain.model) == []
    if domain.tasks is not None:
        assert check_tasks(domain.model, domain.tasks) == []


def test_every_shipped_domain_is_listed_and_loads_with_its_defaults() -> None:
    assert set(library.domains()) == {name for name, _, _ in STATES}
    for name in library.domains():
        assert library.load(name).model.name == name


# --------------------------------------------------------------------------------------------
# Dynamics from the definitions
# --------------------------------------------------------------------------------------------

State = tuple[Any, ...]
Marginals = Sequence[Mapping[Any, Fraction]]
F = Fraction


def _bit(chance: Fraction) -> Mapping[Any, Fraction]:
    return {True: chance, False: 1 - chance}


def _linear_or_expon(name: str) -> Callable[[State, str], tuple[Marginals, Fraction]]:
    def step(x: State, action: str) -> tuple[Marginals, Fraction]:
        k = int(action.split("_")[1])
        able = all(x[:k])
        set_false = range(k + 1, len(x)) if name == "linear" else range(k)
        rows = [_bit(F(0)) if i in set_false else _bit(F(x[i])) for i in range(len(x))]
        rows[k] = _bit(F(0)) if not able else _bit(F(1) if x[k] else F(7, 10))
        return rows, F(all(x))

    return step


def _components(x: State, action: str) -> tuple[Marginals, Fraction]:
    table = {
        "noop": {
            "ok": {"ok": F("0.9"), "degraded": F("0.1")},
            "degraded": {"degraded": F("0.8"), "failed": F("0.2")},
            "failed": {"failed": F(1)},
        },
        "fix": {
            "ok": {"ok": F(1)},
            "degraded": {"ok": F(1, 2), "degraded": F(1, 2)},
            "failed": {"ok": F(1, 4), "degraded": F(1, 4), "failed": F(1, 2)},
        },
    }
    return [table[action][c] for c in x], F(x.count("ok") - 2 * x.count("failed"))


def _sysadmin(topology: str) -> Callable[[State, str], tuple[Marginals, Fraction]]:
    def step(x: State, action: str) -> tuple[Marginals, Fraction]:
        rows = []
        for i, up in enumerate(x):
            hears = {"ring": x[i - 1], "star": i == 0 or x[0], "independent": True}[topology]
            chance = {
                (True, True): "0.95",
                (True, False): "0.475",
                (False, True): "0.0475",
                (False, False): "0.0238",
            }[up, hears]
            rows.append(_bit(F(1) if action == f"reboot_{i}" else F(chance)))
        return rows, sum(x) - (F(0) if action == "noop" else F(3, 4))

    return step


@pytest.mark.parametrize(
    ("name", "parameters", "step"),
    [
        ("linear", {"size": "4", "success": "0.7"}, _linear_or_expon("linear")),
        ("expon", {"size": "4", "success": "7/10"}, _linear_or_expon("expon")),
        ("components", {"size": "3"}, _components),
        ("sysadmin", {"size": "4"}, _sysadmin("ring")),
        ("sysadmin", {"size": "3", "topology": "star"}, _sysadmin("star")),
        ("sysadmin", {"size": "3", "topology": "independent"}, _sysadmin("independent")),
    ],
)
def test_rows_and_rewards_are_those_of_the_definition(
    name: str, parameters: Mapping[str, str], step: Callable[[State, str], tuple[Marginals, Fraction]]
) -> None:
    mdp = enumerate_model(library.load(name, parameters).model)
    for a, action in enumerate(mdp.actions):
        for s, x in enumerate(mdp.state_values):
            marginals, reward = step(x, action)
            expected = {}
            for outcome in product(*(row.items() for row in marginals)):
                chance = math.prod((q for _, q in outcome), start=F(1))
                if chance:
                    expected[mdp.index([value for value, _ in outcome])] = chance
            assert mdp.rows[a][s] == expected
            assert mdp.rewards[a][s] == reward


# From the description of Taxi: locations, and cells with a wall on their right.
LOCATIONS = {"R": (0, 4), "G": (4, 4), "Y": (0, 0), "B": (3, 0)}
WALLS = {(1, 4), (1, 3), (0, 0), (0, 1), (2, 0), (2, 1)}
MOVES = {"North": (0, 1), "South": (0, -1), "East": (1, 0), "West": (-1, 0)}
PERPENDICULAR = {
    "North": ("East", "West"),
    "South": ("East", "West"),
    "East": ("North", "South"),
    "West": ("North", "South"),
}


def _drive(cell: tuple[int, int], move: str) -> tuple[int, int]:
    x, y = cell
    target = (x + MOVES[move][0], y + MOVES[move][1])
    left_of_edge = (min(x, target[0]), y)
    walled = move in ("East", "West") and left_of_edge in WALLS
    outside = not (0 <= target[0] < 5 and 0 <= target[1] < 5)
    return cell if walled or outside else target


def _taxi_step(
    state: State, action: str, places: Mapping[str, tuple[int, int]], slip: bool
) -> tuple[Mapping[State, Fraction], int]:
    x, y, passenger, destination = state
    if action in MOVES:
        tries = (
            {action: F(8, 10), **dict.fromkeys(PERPENDICULAR[action], F(1, 10))} if slip else {action: F(1)}
        )
        row: dict[State, Fraction] = {}
        for move, chance in tries.items():
            after = (*_drive((x, y), move), passenger, destination)
            row[after] = row.get(after, F(0)) + chance
        return row, -1
    if action == "Pickup" and places.get(passenger) == (x, y):
        return {(x, y, "taxi", destination): F(1)}, -1
    if action == "Putdown" and passenger == "taxi" and places[destination] == (x, y):
        return {(x, y, "delivered", destination): F(1)}, 20
    return {state: F(1)}, -10


@pytest.mark.parametrize("slip", ["false", "true", "0.8, 1/10, 0.1"])
@pytest.mark.parametrize("anywhere", [False, True])
def test_the_taxi_drives_as_described(slip: str, anywhere: bool) -> None:
    mdp = enumerate_model(library.load("taxi", {"slip": slip, "anywhere": str(anywhere)}).model)
    places = dict(LOCATIONS)
    if anywhere:
        others = set(product(range(5), range(5))) - set(LOCATIONS.values())
        places |= {f"x{x}y{y}": (x, y) for x, y in others}
    assert set(mdp.features[2].values) == {*places, "taxi", "delivered"}
    for s, state in enumerate(mdp.state_values):
        assert mdp.terminal[s] == (state[2] == "delivered")
        waits = state[2] in places
        assert mdp.initial[s] == (F(1, 25 * len(places) * 4) if waits else 0)
        if mdp.terminal[s]:
            continue
        for a, action in enumerate(mdp.actions):
            row, reward = _taxi_step(state, action, places, slip != "false")
            assert mdp.rows[a][s] == {mdp.index(after): chance for after, chance in row.items()}
            assert mdp.rewards[a][s] == reward


def test_an_uneven_slip_goes_left_and_right_as_it_says() -> None:
    mdp = enumerate_model(library.load("taxi", {"slip": "0.7,0.3,0"}).model)
    centre = mdp.index([2, 2, "taxi", "R"])
    left = {"North": (1, 2), "West": (2, 1), "South": (3, 2), "East": (2, 3)}
    for a, action in enumerate(mdp.actions[:4]):
        ahead = (2 + MOVES[action][0], 2 + MOVES[action][1])
        assert mdp.rows[a][centre] == {
            mdp.index([*ahead, "taxi", "R"]): F(7, 10),
            mdp.index([*left[action], "taxi", "R"]): F(3, 10),
        }


def test_noise_bits_flip_on_their_own_and_split_no_block() -> None:
    mdp = enumerate_model(library.load("taxi", {"noise_bits": "1"}).model)
    s = mdp.index([0, 0, "R", "G", False])
    for a, action in enumerate(mdp.actions):
        flipped = sum(q for t, q in mdp.rows[a][s].items() if mdp.state_values[t][4])
        assert flipped == F(1, 4), action
    assert minimise(mdp).blocks == 501


@pytest.mark.parametrize("size", [2, 3, 4, 6, 7, 10, 13])
def test_a_taxi_of_any_size_can_reach_every_cell_and_has_four_locations(size: int) -> None:
    model = library.load("taxi", {"size": str(size)}).model
    assert len(model.feature("destination").values) == 4
    mdp = enumerate_model(model, actions=["North", "South", "East", "West"])
    seen = {mdp.index([0, 0, "taxi", "R"])}
    waiting = list(seen)
    while waiting:
        s = waiting.pop()
        for rows in mdp.rows:
            new = set(rows[s]) - seen
            seen |= new
            waiting += new
    assert len(seen) == size * size
    tasks = library.load("taxi", {"size": str(size)}).tasks
    assert tasks is not None
    targets = {task.terminal for task in tasks.tasks if task.name.startswith("Navigate_")}
    assert len(targets) == 4, "the four locations are four cells"


def test_a_ten_by_ten_taxi_has_each_wall_and_location_in_proportion() -> None:
    # Twice Dietterich's grid: walls at columns 2, 4 and 6 of 10 instead of 1, 2 and 3 of 5, of height 4.
    mdp = enumerate_model(library.load("taxi", {"size": "10"}).model)
    east = mdp.actions.index("East")
    walled = set()
    for x, y in product(range(9), range(10)):
        s = mdp.index([x, y, "taxi", "R"])
        if mdp.rows[east][s] == {s: F(1)}:
            walled.add((x, y))
    lower = {(x, y) for x in (1, 5) for y in range(4)}
    assert walled == lower | {(3, y) for y in range(6, 10)}
    pickup = mdp.actions.index("Pickup")
    for name, (x, y) in {"R": (0, 9), "G": (9, 9), "Y": (0, 0), "B": (6, 0)}.items():
        legal = [v[:2] for s, v in enumerate(mdp.state_values)
                 if v[2:] == (name, "R") and mdp.rewards[pickup][s] == -1]  # fmt: skip
        assert legal == [(x, y)]


# --------------------------------------------------------------------------------------------
# Numbers of blocks
# --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "parameters", "blocks"),
    [
        ("toy", {}, 4),
        *(("linear", {"size": str(n)}, n + 1) for n in (1, 2, 4, 6)),
        *(("expon", {"size": str(n)}, 2**n) for n in (1, 2, 4, 6)),
        *(("components", {"size": str(n)}, (n + 1) * (n + 2) // 2) for n in (1, 2, 3, 5)),
        # Named reboots tell all machines apart.
        ("sysadmin", {"size": "4"}, 2**4),
        # Taxi: 25 cells, 5 passengers, 4 destinations, all different, and one terminal block.
        ("taxi", {}, 501),
        ("taxi", {"slip": "true"}, 501),
    ],
)
def test_the_flat_quotient_has_the_blocks_of_the_closed_form(
    name: str, parameters: Mapping[str, str], blocks: int
) -> None:
    assert minimise(enumerate_model(library.load(name, parameters).model)).blocks == blocks


# --------------------------------------------------------------------------------------------
# Hierarchies
# --------------------------------------------------------------------------------------------


class Solved:
    """Each task of a domain solved on its unreduced arrays, children first."""

    def __init__(self, name: str, parameters: Mapping[str, str]) -> None:
        self.domain = library.load(name, parameters)
        self.policies: dict[str, list[int]] = {}
        self.mdps: dict[str, ExactMDP] = {}
        self.values: dict[str, float] = {}
        assert self.domain.tasks is not None
        (root,) = self.domain.tasks.roots()
        self.root = root.name
        self._solve(self.root)
        flat = enumerate_model(self.domain.model)
        self.flat_value = float(np.array(flat.initial, dtype=float) @ value_iteration(flat.to_arrays()))

    def _solve(self, name: str) -> None:
        tasks, model = self.domain.tasks, self.domain.model
        assert tasks is not None
        names = {task.name for task in tasks.tasks}
        for child in tasks.task(name).actions:
            if child in names and child not in self.policies:
                self._solve(child)
        mdp = subtask_mdp(model, tasks, name, self.policies)
        arrays = mdp.to_arrays()
        values = value_iteration(arrays)
        assert np.isfinite(values).all(), f"{name} has a dead end"
        primitives = [action.name for action in model.actions]
        policy = []
        for s, a in enumerate(greedy_policy(action_values(arrays, values))):
            if a < 0 or mdp.terminal[s]:
                policy.append(-1)
            elif mdp.actions[a] in names:
                policy.append(self.policies[mdp.actions[a]][s])
            else:
                policy.append(primitives.index(mdp.actions[a]))
        self.mdps[name], self.policies[name] = mdp, policy
        self.values[name] = float(np.array(mdp.initial, dtype=float) @ values)

    def blocks(self, name: str) -> int:
        return minimise(self.mdps[name]).blocks


@pytest.fixture(scope="module")
def taxi() -> Solved:
    return Solved("taxi", {})


@pytest.fixture(scope="module")
def workshop() -> Solved:
    return Solved("workshop", {"size": "3"})


@pytest.fixture(scope="module")
def toy() -> Solved:
    return Solved("toy", {})


@pytest.fixture(params=["toy", "taxi", "workshop"])
def solved(request: pytest.FixtureRequest) -> Solved:
    result = request.getfixturevalue(request.param)
    assert isinstance(result, Solved)
    return result


def test_every_subtask_has_something_to_optimise(solved: Solved) -> None:
    # A constant local reward is refused if it is 0 or if the task can't end.
    for name, mdp in solved.mdps.items():
        pairs = [(a, s) for a in range(len(mdp.actions)) for s in range(mdp.states) if mdp.applicable[a][s]]
        rewards = {mdp.rewards[a][s] for a, s in pairs}
        can_end = any(mdp.terminal[t] for a, s in pairs for t in mdp.rows[a][s])
        assert len(rewards) > 1 or (rewards != {F(0)} and can_end), name


def test_the_toy_child_makes_two_states_alike_for_its_parent(toy: Solved) -> None:
    assert toy.blocks("Unlock") == 3
    assert toy.blocks("Pass") == 3
    # One step to unlock (-1), then the reward of 10 for passing less 1, discounted once.
    assert toy.values["Pass"] == pytest.approx(-1 + 0.95 * 9, abs=1e-9)
    assert toy.flat_value == pytest.approx(toy.values["Pass"], abs=1e-9)


def test_the_taxi_hierarchy_ignores_what_each_task_can_ignore_and_loses_nothing(taxi: Solved) -> None:
    # Navigate: the cell.  Get: cell and passenger.  Put: cell and destination.  One terminal block.
    for name in ("Navigate_R", "Navigate_G", "Navigate_Y", "Navigate_B"):
        assert taxi.blocks(name) == 25
    assert taxi.blocks("Get") == 101
    assert taxi.blocks("Put") == 101
    assert taxi.blocks("Root") < 501
    assert taxi.values["Root"] == pytest.approx(taxi.flat_value, abs=1e-8)


def test_taxi2_has_a_navigate_task_for_each_cell_and_puts_down_at_locations_only() -> None:
    tasks = library.load("taxi", {"anywhere": "true"}).tasks
    assert tasks is not None
    assert sum(task.name.startswith("Navigate_") for task in tasks.tasks) == 25
    assert len(tasks.task("Get").actions) == 26
    assert tasks.task("Put").actions == (
        "Putdown", "Navigate_R", "Navigate_G", "Navigate_Y", "Navigate_B",
    )  # fmt: skip


def test_the_workshop_tasks_ignore_what_the_description_says(workshop: Solved) -> None:
    n = 3
    for name in ("ShapeParts", "DrillParts", "PaintParts"):
        assert workshop.blocks(name) == 3 * n + 1
    assert workshop.blocks("Assemble") == 4
    assert workshop.blocks("Deliver") == 4
    # Choose how many parts are at each unfinished stage, k stages being occupied; then the tool held
    # is new or worn and of use at one of them, or of no use: 2k + 1 cases.  One terminal block.
    counts = [c for c in product(range(n + 1), repeat=3) if 0 < sum(c) <= n]
    cases = 1 + sum(2 * sum(part > 0 for part in c) + 1 for c in counts)
    assert workshop.blocks("Prepare") <= cases == 80


def test_the_workshop_hierarchy_costs_something_but_little(workshop: Solved) -> None:
    cost = workshop.flat_value - workshop.values["Produce"]
    assert 1e-3 < cost < 0.05


def test_the_workshop_has_three_levels_of_tasks_and_a_million_states() -> None:
    domain = library.load("workshop")
    assert domain.tasks is not None
    assert domain.model.states >= 10**6
    assert "Prepare" in domain.tasks.task("Produce").actions
    assert "ShapeParts" in domain.tasks.task("Prepare").actions


def _workshop_step(state: State, action: str) -> tuple[Mapping[State, Fraction], Fraction]:
    """The workshop of two parts from its description, with decay 1/5."""
    stock, tool, wear, *parts = state
    stages = ["raw", "shaped", "drilled", "painted"]
    users = {"shape": "press", "drill": "drill", "paint": "sprayer", "join": "welder"}
    if action.startswith("mount_"):
        return {(stock, action.removeprefix("mount_"), "new", *parts): F(1)}, F(-3)
    if action in users:
        stage = ["shape", "drill", "paint"].index(action) if action != "join" else 3
        work = parts == ["painted"] * 2 if action == "join" else stages[stage] in parts
        if stock != "open" or tool != users[action] or not work:
            return {state: F(1)}, F(-1)
        done, left = list(parts), "joined" if action == "join" else "open"
        if action != "join":
            done[parts.index(stages[stage])] = stages[stage + 1]
        success = {"new": F(9, 10), "worn": F(1, 2), "broken": F(0)}[wear]
        worse = {"new": {"new": F(4, 5), "worn": F(1, 5)}, "worn": {"worn": F(4, 5), "broken": F(1, 5)}}
        row: dict[State, Fraction] = {}
        for after, q in worse.get(wear, {"broken": F(1)}).items():
            for result, p in (((left, done), success), ((stock, parts), 1 - success)):
                if p:
                    row[(result[0], tool, after, *result[1])] = p * q
        return row, F(-1)
    if action == "inspect" and stock == "joined":
        row = {(v, tool, wear, *parts): q for v, q in (("passed", F(9, 10)), ("failed", F(1, 10)))}
        return row, F(-1)
    if action == "strip" and stock == "failed":
        return {("open", tool, wear, "drilled", "drilled"): F(1)}, F(-1)
    if action == "ship" and stock == "passed":
        return {("shipped", tool, wear, *parts): F(1)}, F(99)
    if action == "ship" and stock == "joined":
        row = {(v, tool, wear, *parts): q for v, q in (("shipped", F(9, 10)), ("failed", F(1, 10)))}
        return row, F(-1) + F(9, 10) * 100 - F(1, 10) * 100
    return {state: F(1)}, F(-1)


def test_the_workshop_works_as_described() -> None:
    mdp = enumerate_model(library.load("workshop", {"size": "2"}).model)
    for s, state in enumerate(mdp.state_values):
        assert mdp.terminal[s] == (state[0] == "shipped")
        for a, action in enumerate(mdp.actions):
            if not mdp.terminal[s]:
                row, reward = _workshop_step(state, action)
                assert mdp.rows[a][s] == {mdp.index(after): chance for after, chance in row.items()}
                assert mdp.rewards[a][s] == reward


# --------------------------------------------------------------------------------------------
# Factored form
# --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "parameters", "parents", "parts"),
    [
        # Largest number of features that one distribution or reward term may mention, and of its parts.
        ("components", {"size": "40"}, 1, 20),
        ("sysadmin", {"size": "40"}, 2, 30),
        ("taxi", {"size": "128"}, 4, 50),
        ("taxi", {"size": "128", "slip": "true"}, 4, 90),
        ("linear", {"size": "64"}, 64, 80),
        ("workshop", {}, 8 + 3, 80),
    ],
)
def test_big_domains_stay_factored(
    name: str, parameters: Mapping[str, str], parents: int, parts: int
) -> None:
    model = library.load(name, parameters).model
    expressions = [*model.rewards, model.terminal]
    for action in model.actions:
        expressions += [*action.rewards, *(effect for _, effect in action.effects)]
    assert max(len({r.name for r in references(e)}) for e in expressions) <= parents
    assert max(sum(1 for _ in subexpressions(e)) for e in expressions) <= parts


# --------------------------------------------------------------------------------------------
# Finding, describing, parameters
# --------------------------------------------------------------------------------------------


UNSIZED = ("toy", "cheese", "cheese_taxi", "coffee", "meds", "nursebot", "part_painting", "tiger",
           "twenty_questions")  # fmt: skip


def test_describe_gives_each_parameter_with_default_type_and_meaning() -> None:
    for name in library.domains():
        description = library.describe(name)
        assert description.documentation.startswith(description.summary)
        assert description.summary.endswith(".")
        for parameter in description.parameters:
            assert parameter.documentation, (name, parameter.name)
        names = [parameter.name for parameter in description.parameters]
        assert "discount" in names
        assert names[0] == "size" or name in UNSIZED
    size, slip = library.describe("taxi").parameters[:2]
    assert (size.name, size.default, size.kind) == ("size", 5, "integer")
    assert (slip.default, slip.kind) == (False, "true or false or text")
    success = library.describe("linear").parameters[1]
    assert (success.name, success.default, success.kind) == ("success", F(9, 10), "number")


def test_texts_and_values_give_the_same_model() -> None:
    assert library.load("linear", {"size": 3, "success": 0.9}) == library.load(
        "linear", {"size": " 3 ", "success": "9/10"}
    )
    assert library.load("taxi", {"slip": True}) == library.load("taxi", {"slip": "Yes"})
    assert library.load("components", {"discount": "0.9"}).model.discount == F(9, 10)


@pytest.mark.parametrize(
    ("name", "parameters", "said"),
    [
        ("taxy", {}, ["no domain 'taxy'", "components", "did you mean 'taxi'"]),
        ("../domains/taxi", {}, ["no domain"]),
        ("os", {}, ["no domain"]),
        ("", {}, ["no domain"]),
        ("taxi", {"sise": "3"}, ["no parameter 'sise'", "noise_bits", "did you mean 'size'"]),
        ("taxi", {"size": "1"}, ["size is 1", "from 2 to 1000"]),
        ("taxi", {"size": "five"}, ["'five'", "integer", "cells along"]),
        ("taxi", {"size": "9" * 50}, ["integer"]),
        ("taxi", {"size": True}, ["size is True"]),
        ("taxi", {"size": "31", "anywhere": "true"}, ["from 2 to 30"]),
        ("taxi", {"anywhere": "maybe"}, ["'maybe'", "true or false"]),
        ("taxi", {"anywhere": 1}, ["anywhere is 1", "true or false"]),
        ("taxi", {"noise_bits": "-1"}, ["noise_bits is -1", "from 0"]),
        ("taxi", {"slip": "0.8,0.1"}, ["slip", "three numbers"]),
        ("taxi", {"slip": "0.8,0.1,0.2"}, ["slip", "sum to 1"]),
        ("taxi", {"slip": "1.2,-0.1,-0.1"}, ["slip", "from 0 to 1"]),
        ("taxi", {"slip": "0,0.5,0.5"}, ["slip", "above 0"]),
        ("taxi", {"slip": "a,b,c"}, ["slip", "a number"]),
        ("taxi", {"discount": "1.01"}, ["discount is", "from 0 to 1"]),
        ("toy", {"reward": "much"}, ["'much'", "number"]),
        ("linear", {"size": "0"}, ["size is 0", "from 1"]),
        ("linear", {"success": "1.5"}, ["success is", "from 0 to 1"]),
        ("linear", {"success": "1e30000000"}, ["success"]),
        ("expon", {"size": "-2"}, ["size is -2"]),
        ("expon", {"success": "-0.1"}, ["success is"]),
        ("components", {"size": "0"}, ["size is 0"]),
        ("components", {"size": 2.5}, ["size is 2.5", "integer"]),
        ("sysadmin", {"topology": "tree"}, ["topology is 'tree'", "ring, star, independent"]),
        ("sysadmin", {"cost": float("nan")}, ["cost is nan", "a number"]),
        ("workshop", {"size": "0"}, ["size is 0"]),
        ("workshop", {"decay": "2"}, ["decay is", "from 0 to 1"]),
    ],
)
def test_a_bad_name_or_parameter_is_refused_with_what_is_allowed(
    name: str, parameters: Mapping[str, object], said: Sequence[str]
) -> None:
    with pytest.raises(ModelError) as caught:
        library.load(name, parameters)
    for part in said:
        assert part in str(caught.value)


def test_all_unknown_parameters_are_reported_at_once() -> None:
    with pytest.raises(ModelError) as caught:
        library.load("linear", {"length": "3", "chance": "0.1"})
    assert [fault.path for fault in caught.value.faults] == [("length",), ("chance",)]


def test_an_installed_package_finds_its_own_folder_first(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    package = tmp_path / "top" / "factored_polca"
    package.mkdir(parents=True)
    monkeypatch.setattr(library, "__file__", str(package / "library.py"))
    with pytest.raises(FileNotFoundError, match="install the package again"):
        library.folder()
    outer = tmp_path / "top" / "domains"
    outer.mkdir()
    with pytest.raises(FileNotFoundError, match="install the package again"):
        library.folder()  # somebody's folder of that name: there is no pyproject.toml beside it
    (tmp_path / "top" / "pyproject.toml").touch()
    assert library.folder() == outer
    inner = package / "domains"
    inner.mkdir()
    assert library.folder() == inner
    for file in ("b.py", "a.py", "_hidden.py", "Not-a-name.py", "notes.txt"):
        (inner / file).touch()
    assert library.domains() == ("a", "b")
