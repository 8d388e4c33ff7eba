"""The learners: what they store, what they learn, and the exact value of what was learned."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from functools import cache

import numpy as np
import pytest

from factored_polca import library
from factored_polca.baselines import (
    Learned,
    Method,
    SampledProcess,
    Schedule,
    TaskGraph,
    TaxiFacts,
    learn,
    return_of_greedy,
    sampled_process,
    taxi_facts,
    taxi_methods,
)
from factored_polca.baselines.alisp import alisp
from factored_polca.baselines.hsmq import hsmq
from factored_polca.baselines.maxq import maxq_without_abstraction
from factored_polca.baselines.options import options
from factored_polca.baselines.q_learning import q_learning
from factored_polca.baselines.tables import Numbering, full_table
from factored_polca.baselines.task_graph import NONE, TaskRow, task_graph
from factored_polca.baselines.taxi import dietterich_graph
from factored_polca.baselines.taxi_methods import source_to_goal
from factored_polca.explicit.dynamic_programming import evaluate_policy
from factored_polca.models import Action, Feature, LimitReached, Model, ModelError, conditional, lottery

NAMES = ("Q-learning", "HSMQ", "options", "MAXQ, no abstraction", "MAXQ, by hand", "ALisp")


@cache
def facts(**settings: object) -> TaxiFacts:
    """Taxi's facts, at discount 1 unless told otherwise."""
    return taxi_facts(sampled_process(library.load("taxi", {"discount": Fraction(1), **settings}).model))


@cache
def learned(name: str, episodes: int, seed: int = 0, **settings: object) -> Learned:
    found = facts(**settings)
    (method,) = (one for one in taxi_methods(found) if one.name == name)
    return learn(method, found.process, Schedule(episodes, checkpoints=40), seed)


# -- what is stored --------------------------------------------------------------------------------


def walking_distance(start: tuple[int, int], end: tuple[int, int]) -> int:
    """Moves between two cells of the 5x5 grid, by its walls as Dietterich's Figure 1 draws them."""
    walls = {(1, 4), (1, 3), (0, 0), (0, 1), (2, 0), (2, 1)}  # on the right of these cells
    reached, count = {start}, 0
    while end not in reached:
        count += 1
        for x, y in list(reached):
            reached |= {(x, y + 1)} if y < 4 else set()
            reached |= {(x, y - 1)} if y > 0 else set()
            reached |= {(x + 1, y)} if x < 4 and (x, y) not in walls else set()
            reached |= {(x - 1, y)} if x > 0 and (x - 1, y) not in walls else set()
    return count


LOCATIONS = {"R": (0, 4), "G": (4, 4), "Y": (0, 0), "B": (3, 0)}
CELLS = [(x, y) for x in range(5) for y in range(5)]


def alisp_count(sources: list[tuple[int, int]]) -> int:
    """The entries of the published features, by multiplication."""
    w, d = len(sources), len(LOCATIONS)
    k = len({walking_distance(a, b) for a in sources for b in LOCATIONS.values()})
    root = (25 * w * d + 25 * (w * d + d)) + (w * d + w * d + d) + 1  # Get where he waits, Put everywhere
    get, put = 25 * w + 1 + k, 25 * d + 2 + (k + 1)
    navigate = 4 * 25 + 4 * 25 * w + (k + (k + 1))
    return root + get + put + navigate


@pytest.mark.parametrize(
    ("anywhere", "counts"),
    [
        # Dietterich 2000, section 5: 3000, 14000 and 632; HSMQ's 11000 are the C functions' entries there.
        (False, (3000, 11000, 13000, 14000, 632, alisp_count(list(LOCATIONS.values())))),
        # The same by multiplication for 25 targets and 25 * 26 * 4 states.
        (
            True,
            (
                6 * 2600,
                (25 * 4 + 6) * 2600,
                (6 + 25 + 25 * 4) * 2600,
                (25 * 4 + 6 + 6) * 2600,
                4 * 25 * 25 + 25 + 625 + 100 + 4 + 100 + 8,
                alisp_count(CELLS),
            ),
        ),
    ],
)
def test_stored_values_are_those_of_the_sources(anywhere: bool, counts: tuple[int, ...]) -> None:
    methods = taxi_methods(facts(anywhere=anywhere))
    assert tuple(method.name for method in methods) == NAMES
    assert tuple(method.stored_values for method in methods) == counts
    for method in methods:
        for table in method.tables:  # each entry stands somewhere, and only where something can be stored
            assert np.array_equal(np.unique(table.index[table.index >= 0]), np.arange(table.size))
            assert (table.index[:, ~facts(anywhere=anywhere).process.live] == NONE).all()


def test_abstractions_do_not_see_what_matters_to_nothing() -> None:
    plain, noisy = taxi_methods(facts()), taxi_methods(facts(noise_bits=1))
    for before, after in zip(plain, noisy, strict=True):
        by_hand = before.name in ("MAXQ, by hand", "ALisp")
        assert after.stored_values == before.stored_values * (1 if by_hand else 2)


def test_the_distance_feature_is_the_walking_distance() -> None:
    found = facts()
    distance = source_to_goal(found)
    for s in np.flatnonzero(found.waiting & found.process.live):
        names = found.places[found.source[s]], found.places[found.goal[s]]
        assert distance[s] == walking_distance(LOCATIONS[names[0]], LOCATIONS[names[1]])


def test_numbering_shares_entries_and_leaves_out_what_is_not_stored() -> None:
    numbering = Numbering(4)
    here = np.array([True, True, True, False])
    first = numbering.entries(here, np.array([5, 3, 5, 3]))
    assert first.tolist() == [1, 0, 1, NONE]
    assert numbering.entries(here).tolist() == [2, 2, 2, NONE]
    assert numbering.none().tolist() == [NONE] * 4
    assert numbering.size == 3


# -- what is learned: a corridor with closed forms -------------------------------------------------


def corridor(discount: Fraction) -> SampledProcess:
    """Cells 0 to 3, 3 the end; a step costs 1, `Finish` brings 10 in cell 2 and costs 5 elsewhere."""
    cell = Feature("cell", range(4))
    return sampled_process(
        Model(
            "corridor",
            [cell],
            [
                Action("Left", {cell: conditional(cell.is_in([1, 2]), cell - 1, cell)}, rewards=-1),
                Action("Right", {cell: conditional(cell.is_in([0, 1]), cell + 1, cell)}, rewards=-1),
                Action(
                    "Finish",
                    {cell: conditional(cell.is_(2), 3, cell)},
                    rewards=conditional(cell.is_(2), 10, -5),
                ),
            ],
            terminal=cell.is_(3),
            initial={cell: lottery(dict.fromkeys(range(3), Fraction(1, 3)))},
            discount=discount,
        )
    )


LEFT, RIGHT, FINISH = 0, 1, 2
ALL = np.ones(4, dtype=np.int64)
AT_2 = np.array([False, False, True, True])


def corridor_graph(process: SampledProcess, *root: tuple[str, int], tail: int = NONE) -> TaskGraph:
    """A root that calls `root`, and the task Approach, code 4 (5 with `tail`), which ends in cell 2.

    With `tail` there is Serve, code 4: Approach, then the tail.
    """
    terminal = process.arrays.terminal
    rows = [TaskRow("Root", tuple((name, code * ALL) for name, code in root), terminal)]
    if tail != NONE:
        rows.append(TaskRow("Serve", (("Approach", 5 * ALL),), np.zeros(4, dtype=np.bool_), tail))
    rows.append(TaskRow("Approach", (("Left", LEFT * ALL), ("Right", RIGHT * ALL)), AT_2))
    return task_graph(rows, terminal, 3)


def approach(gamma: float, cell: int) -> float:
    """The costs of going from `cell` to cell 2: 1 + gamma + ..., 2 - cell terms."""
    return -sum(gamma**k for k in range(2 - cell))


Expected = Iterator[tuple[int, str, str, int, float]]
"""(table, task, slot, cell, value)"""


def expected_flat(gamma: float) -> Expected:
    for cell in range(2):
        yield 0, "Root", "Right", cell, approach(gamma, cell) + gamma ** (2 - cell) * 10
    yield 0, "Root", "Finish", 2, 10.0


def expected_hsmq(gamma: float) -> Expected:
    for cell in range(2):
        yield 0, "Root", "Approach", cell, approach(gamma, cell) + gamma ** (2 - cell) * 10
        yield 0, "Approach", "Right", cell, approach(gamma, cell)
    yield 0, "Root", "Finish", 2, 10.0


def expected_options(gamma: float) -> Expected:
    yield from expected_flat(gamma)
    yield from expected_hsmq(gamma)
    value = approach(gamma, 0) + gamma**2 * 10  # off the greedy path too: all is learned off-policy
    yield 0, "Root", "Left", 0, -1 + gamma * value
    yield 0, "Root", "Finish", 0, -5 + gamma * value
    yield 0, "Approach", "Left", 1, -1 + gamma * approach(gamma, 0)


def expected_maxq(gamma: float) -> Expected:
    for cell in range(2):
        yield 0, "Root", "Approach", cell, gamma ** (2 - cell) * 10
        yield 0, "Approach", "Right", cell, gamma * approach(gamma, cell + 1)
    yield 0, "Root", "Finish", 2, 0.0


def expected_alisp(gamma: float) -> Expected:
    for cell in range(2):
        steps = 2 - cell
        yield 0, "Root", "Serve", cell, approach(gamma, cell) + gamma**steps * 10
        yield 1, "Root", "Serve", cell, 0.0
        yield 0, "Serve", "Approach", cell, approach(gamma, cell)
        yield 1, "Serve", "Approach", cell, gamma**steps * 10
        yield 2, "Serve", "Approach", cell, 0.0
        yield 0, "Approach", "Right", cell, -1.0
        yield 1, "Approach", "Right", cell, gamma * approach(gamma, cell + 1)
        # What comes after Approach is 10 in the tail of Serve, steps later.
        yield 2, "Approach", "Right", cell, gamma**steps * 10
    yield 0, "Serve", "Approach", 2, 0.0  # Approach is over at once, and the tail follows
    yield 1, "Serve", "Approach", 2, 10.0


def expected_longer_alisp(gamma: float) -> Expected:
    yield 0, "Root", "Finish", 2, 10.0
    for cell in range(2):
        steps = 2 - cell
        yield 0, "Root", "Serve", cell, approach(gamma, cell) - gamma**steps
        yield 1, "Root", "Serve", cell, gamma ** (steps + 1) * 10
        yield 0, "Serve", "Approach", cell, approach(gamma, cell)
        yield 1, "Serve", "Approach", cell, -(gamma**steps)
        yield 2, "Serve", "Approach", cell, gamma ** (steps + 1) * 10
        yield 1, "Approach", "Right", cell, gamma * approach(gamma, cell + 1)
        yield 2, "Approach", "Right", cell, -(gamma**steps) + gamma ** (steps + 1) * 10


def flat_method(process: SampledProcess) -> Method:
    return q_learning(process)


def hsmq_method(process: SampledProcess) -> Method:
    return hsmq(process, corridor_graph(process, ("Approach", 4), ("Finish", FINISH)))


def options_method(process: SampledProcess) -> Method:
    primitive = (("Left", LEFT), ("Right", RIGHT), ("Finish", FINISH))
    return options(process, corridor_graph(process, *primitive, ("Approach", 4)))


def maxq_method(process: SampledProcess) -> Method:
    return maxq_without_abstraction(process, corridor_graph(process, ("Approach", 4), ("Finish", FINISH)))


def alisp_method(process: SampledProcess) -> Method:
    return alisp_on(process, corridor_graph(process, ("Serve", 4), tail=FINISH))


def longer_alisp_method(process: SampledProcess) -> Method:
    """Serve ends in a wasted step to the right in cell 2, and the root has to finish."""
    return alisp_on(process, corridor_graph(process, ("Serve", 4), ("Finish", FINISH), tail=RIGHT))


def alisp_on(process: SampledProcess, graph: TaskGraph) -> Method:
    return alisp(graph, *(full_table(part, len(graph.pairs), process.live) for part in ("r", "c", "e")))


CORRIDOR: dict[str, tuple[Callable[[SampledProcess], Method], Callable[[float], Expected]]] = {
    "flat": (flat_method, expected_flat),
    "hsmq": (hsmq_method, expected_hsmq),
    "options": (options_method, expected_options),
    "maxq": (maxq_method, expected_maxq),
    "alisp": (alisp_method, expected_alisp),
    "alisp, longer": (longer_alisp_method, expected_longer_alisp),
}


@pytest.mark.parametrize("discount", [Fraction(1), Fraction(9, 10)], ids=str)
@pytest.mark.parametrize("name", CORRIDOR)
def test_values_in_the_corridor_are_the_closed_forms(name: str, discount: Fraction) -> None:
    make, expected = CORRIDOR[name]
    process, gamma = corridor(discount), float(discount)
    method = make(process)
    found = learn(method, process, Schedule(20_000), seed=1)
    for table, task, slot, cell, value in expected(gamma):
        entry = method.tables[table].index[method.graph.pair(task, slot), cell]
        assert found.values[table][entry] == pytest.approx(value, abs=1e-6), (table, task, slot, cell)
    optimum = (10 + (gamma * 10 - 1) + (gamma**2 * 10 - 1 - gamma)) / 3
    assert found.optimum == pytest.approx(optimum, abs=1e-9)
    if name == "alisp, longer":  # the program costs a step in cells 0 and 1
        optimum -= (gamma + gamma**2 + (1 - gamma) * 10 * (gamma + gamma**2)) / 3
    assert found.greedy_returns[-1] == pytest.approx(optimum, abs=1e-9)
    if name == "alisp, longer":
        assert found.episodes_to() is None
    else:  # what an optimal policy earns does not hang on the starts that were drawn
        assert found.training_returns[-1] == pytest.approx(optimum, abs=1e-9)
        assert found.episodes_to() is not None
    if name == "maxq":  # V of the primitive actions
        assert found.values[1][method.tables[1].index[FINISH, 2]] == pytest.approx(10)
        assert found.values[1][method.tables[1].index[FINISH, 0]] == pytest.approx(-5)


# -- what is learned: Taxi -------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_each_learner_comes_within_two_percent_on_taxi(name: str) -> None:
    found = learned(name, 50_000)
    assert found.episodes_to(0.02) is not None
    least = found.optimum - 0.02 * abs(found.optimum)
    assert least <= found.greedy_returns[-1] <= found.optimum + 1e-9
    assert least <= found.training_returns[-1] <= found.optimum + 1e-9
    assert 0 < found.visited <= found.method.stored_values


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("settings", [{"anywhere": True}, {"slip": True}], ids=["taxi2", "slip"])
def test_each_learner_comes_within_two_percent_on_small_variants(
    name: str, settings: dict[str, object]
) -> None:
    found = learned(name, 20_000, size=3, **settings)
    assert found.greedy_returns[-1] >= found.optimum - 0.02 * abs(found.optimum)


def test_the_optimum_of_taxi_is_the_mean_of_walking_distances() -> None:
    """20 for the delivery, less the way to the source, the Pickup, and the way to the destination."""
    values = [
        20 - walking_distance(cell, source) - 1 - walking_distance(source, goal)
        for cell in CELLS
        for source in LOCATIONS.values()
        for goal in LOCATIONS.values()
    ]
    assert learned("Q-learning", 50_000).optimum == pytest.approx(sum(values) / len(values))


def test_the_values_of_maxq_by_hand_mean_what_dietterich_says() -> None:
    found = learned("MAXQ, by hand", 50_000)
    assert found.greedy_returns[-1] == pytest.approx(found.optimum, abs=1e-9)
    graph, (completion, primitive) = found.method.graph, found.method.tables
    taxi = facts()

    def value(task: str, slot: str, state: int) -> float:
        return float(found.values[0][completion.index[graph.pair(task, slot), state]])

    starts = np.flatnonzero(taxi.waiting & taxi.process.live)
    for s in starts[::7]:
        source, goal = taxi.places[taxi.source[s]], taxi.places[taxi.goal[s]]
        assert value("Get", "Navigate", s) == pytest.approx(-1, abs=1e-6)  # the Pickup
        after_get = 20 - walking_distance(LOCATIONS[source], LOCATIONS[goal])
        assert value("Root", "Get", s) == pytest.approx(after_get, abs=1e-3)
    for s in np.flatnonzero(taxi.aboard)[::7]:
        assert value("Put", "Navigate", s) == pytest.approx(20, abs=1e-6)
    assert sorted(found.values[1].round(9).tolist()) == [-10, -10, -1, -1, -1, -1, -1, 20]
    assert primitive.size == 8


def spread_of_completion(discount: Fraction) -> float:
    """How far the values of C(Root, s, Get) differ between taxi positions that MAXQ by hand merges."""
    found = learned("MAXQ, no abstraction", 50_000, discount=discount)
    taxi = facts(discount=discount)
    row = found.method.tables[0].index[found.method.graph.pair("Root", "Get")]
    spread = 0.0
    for source in range(4):
        for goal in range(4):
            same = (taxi.source == source) & (taxi.goal == goal) & taxi.process.live
            spread = max(spread, float(np.ptp(found.values[0][row[same]])))
    return spread


def test_with_a_discount_maxq_by_hand_merges_what_differs() -> None:
    """C(Root, s, Get) is gamma^n V(Put), n the steps of Get: up to 13 of them from the farthest cell."""
    assert spread_of_completion(Fraction(1)) < 0.05
    assert spread_of_completion(Fraction(95, 100)) > 3


def test_equal_seeds_give_equal_results_and_others_differ() -> None:
    found = facts(size=3)
    for method in taxi_methods(found):
        one, two, other = (
            learn(method, found.process, Schedule(300, checkpoints=5), seed=seed) for seed in (4, 4, 5)
        )
        assert all(np.array_equal(a, b) for a, b in zip(one.values, two.values, strict=True))
        assert one.training_returns == two.training_returns
        assert not all(np.array_equal(a, b) for a, b in zip(one.values, other.values, strict=True))


def test_kernels_that_were_kept_on_disk_do_the_same_in_another_process() -> None:
    found = facts(size=3)
    sums = [
        sum(
            float(v.sum())
            for v in learn(method, found.process, Schedule(200, checkpoints=5), seed=2).values
        )
        for method in taxi_methods(found)
    ]
    program = (
        "from factored_polca import library\n"
        "from factored_polca.baselines import *\n"
        "facts = taxi_facts(sampled_process(library.load('taxi', {'discount': 1, 'size': 3}).model))\n"
        "for method in taxi_methods(facts):\n"
        "    found = learn(method, facts.process, Schedule(200, checkpoints=5), seed=2)\n"
        "    print(repr(sum(float(v.sum()) for v in found.values)))\n"
    )
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert [float(line) for line in ran.stdout.split()] == sums


# -- the exact return of greedy policies -----------------------------------------------------------


def by_hand(process: SampledProcess, graph: TaskGraph, choice: np.ndarray, start: int) -> float:
    """The return of a deterministic process from one start, by recursion over the graph's tasks."""
    arrays, gain, state = graph.arrays, [], start

    def run(task: int) -> None:
        nonlocal state
        while not arrays.over[task, state]:
            code = arrays.child[choice[task, state], state]
            if code >= arrays.primitives:
                run(code - arrays.primitives)
            else:
                take(code)
            if arrays.tail[task] >= 0:
                take(arrays.tail[task])
                return

    def take(action: int) -> None:
        nonlocal state
        gain.append(process.exact.rewards[action][state])
        ((state, _),) = process.exact.rows[action][state].items()

    run(0)
    return float(sum(r * process.exact.discount**k for k, r in enumerate(gain)))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("discount", [Fraction(1), Fraction(9, 10)], ids=str)
def test_the_return_is_that_of_running_the_tasks(name: str, discount: Fraction) -> None:
    found = learned(name, 20_000, size=3, discount=discount)
    process, graph = facts(size=3, discount=discount).process, found.method.graph
    starts = np.flatnonzero(process.initial)
    mean = sum(process.initial[s] * by_hand(process, graph, found.choice, s) for s in starts)
    assert return_of_greedy(process, graph, found.choice) == pytest.approx(mean, abs=1e-9)


def test_the_return_of_a_flat_policy_is_its_exact_evaluation() -> None:
    process = facts(size=3, slip=True, discount=Fraction(9, 10)).process
    graph = q_learning(process).graph
    generator = np.random.default_rng(3)
    actions = generator.integers(0, len(process.actions), process.states)
    values = evaluate_policy(process.mdp, np.where(process.live, actions, -1))
    found = return_of_greedy(process, graph, actions[None, :])
    assert found == pytest.approx(float(process.initial @ values), abs=1e-9)


def test_a_policy_that_never_ends_is_worth_minus_infinity() -> None:
    process = corridor(Fraction(1))
    graph = q_learning(process).graph
    assert return_of_greedy(process, graph, np.full((1, 4), LEFT)) == -np.inf
    assert return_of_greedy(process, graph, np.full((1, 4), NONE)) == -np.inf
    assert return_of_greedy(process, graph, np.array([[RIGHT, RIGHT, FINISH, NONE]])) == 8.0 + 1.0


def test_close_counts_from_the_last_time_that_it_was_not() -> None:
    found = learned("Q-learning", 50_000)
    story = replace(found, checkpoints=(1, 2, 3, 4), optimum=10.0, greedy_returns=(9.9, 9.7, 9.8, 9.9))
    assert story.episodes_to(0.02) == 3
    assert replace(story, greedy_returns=(9.9, 9.9, 9.9, 9.7)).episodes_to(0.02) is None
    assert replace(story, greedy_returns=(9.9, -np.inf, 9.9, 9.9)).episodes_to(0.02) == 3


# -- what is refused -------------------------------------------------------------------------------


def test_models_that_learners_can_t_take_are_refused() -> None:
    with pytest.raises(ModelError, match="partially observed"):
        sampled_process(library.load("tiger").model)
    with pytest.raises(LimitReached, match="600 states"):
        sampled_process(library.load("taxi").model, maximum_states=599)
    with pytest.raises(ModelError, match="the features x, y, passenger, destination"):
        taxi_facts(corridor(Fraction(1)))


def test_schedules_and_graphs_are_checked() -> None:
    with pytest.raises(ModelError, match="at least 1"):
        Schedule(episodes=0)
    with pytest.raises(ModelError, match="a probability"):
        Schedule(exploration=1.5)
    process = corridor(Fraction(1))
    with pytest.raises(ValueError, match="calls itself"):
        task_graph([TaskRow("Root", (("Root", 3 * ALL),), AT_2)], process.arrays.terminal, 3)
    with pytest.raises(ValueError, match="nothing to call"):
        task_graph([TaskRow("Root", (), AT_2)], process.arrays.terminal, 3)
    with pytest.raises(ValueError, match="3 levels"):
        options(facts().process, dietterich_graph(facts()))
    with pytest.raises(KeyError, match="Get, Put"):
        dietterich_graph(facts()).pair("Root", "Fly")
