"""Alpha-vectors as diagrams: backups, beliefs and bounds against arrays, on random and shipped models."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from random_pomdps import random_pomdp
from tree_brackets import bracket

from factored_polca import library
from factored_polca.cli import main
from factored_polca.diagrams import FLOAT, Diagram, Manager, at, leaves, node_count
from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.hierarchy.alpha_policy_file import load_alpha_policy, save_alpha_policy
from factored_polca.minimisation.flat_model import flat_model
from factored_polca.models import (
    Action,
    LimitReached,
    Model,
    ModelError,
    Observation,
    boolean,
    conditional,
    lottery,
)
from factored_polca.models.model import replace_fields
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.structured.pomdp_belief import BeliefSpace
from factored_polca.structured.pomdp_bounds import FirstBounds, Sizes
from factored_polca.structured.pomdp_cell_bounds import CellBounds
from factored_polca.structured.pomdp_cells import Table, diagram_of, merged_diagram, table_of
from factored_polca.structured.pomdp_lower import Alpha, LowerBound
from factored_polca.structured.pomdp_model import FactoredPOMDP, Seen, Step
from factored_polca.structured.pomdp_point import PointBelief
from factored_polca.structured.pomdp_solution import SymbolicSolution, solve_symbolic
from factored_polca.symbolic import compile_model

DISCOUNT = Fraction(2, 5)
"""Trees of this discount are expanded deep enough by `bracket`."""


def discounted(seed: int, discount: Fraction = DISCOUNT, **ranges: tuple[int, int]) -> Model:
    return replace_fields(random_pomdp(seed, **ranges), discount=discount, horizon=None)


class Reading:
    """The states of a model as numbers, by what is seen of them."""

    def __init__(self, model: Model) -> None:
        self.model, self.exact = model, enumerate_pomdp(model)
        self.pomdp = FactoredPOMDP(compile_model(model))
        self.digits = [
            tuple(next(n for n, v in enumerate(f.values) if v is w or (type(v), v) == (type(w), w))
                  for f, w in zip(model.features, values, strict=True))
            for values in self.exact.state_values
        ]  # fmt: skip

    def seen(self, state: int) -> Seen:
        return tuple(self.digits[state][i] for i in self.pomdp.observed)

    def levels(self, state: int) -> dict[int, int]:
        return {self.pomdp.symbolic.now(i): v for i, v in enumerate(self.digits[state])}

    def value(self, diagram: Diagram, state: int) -> float:
        return float(at(diagram, self.levels(state)))

    def outcome(self, step: Step, following: int, observation: int) -> int | None:
        """The number of the outcome that a next state and a joint observation belong to."""
        channels = self.model.observations
        values = self.exact.observations[observation]
        numbers = [
            next(n for n, v in enumerate(c.values) if (type(v), v) == (type(w), w))
            for c, w in zip(channels, values, strict=True)
        ]
        sensed = tuple(numbers[j] for j in sorted(self.pomdp.symbolic.actions[step.action].observations))
        found = [
            n
            for n, o in enumerate(step.outcomes)
            if o.seen == self.seen(following) and sensed in o.channels
        ]
        assert len(found) <= 1
        return found[0] if found else None


def random_alpha(reading: Reading, seen: Seen, random: np.random.Generator) -> Diagram:
    """Random numbers at the states of one y, as a diagram, 0 where terminal."""
    pomdp = reading.pomdp
    total = pomdp.zero
    for state in range(reading.exact.states):
        if reading.seen(state) == seen and not reading.exact.terminal[state]:
            here = pomdp.one
            for k in pomdp.hidden:
                level, value = pomdp.symbolic.now(k), reading.digits[state][k]
                parts = [pomdp.zero] * pomdp.manager.sizes[level]
                parts[value] = pomdp.one
                here = here * pomdp.manager.variable(level, parts)
            total = total + here * pomdp.manager.constant(float(random.integers(-9, 10)), FLOAT)
    return total


@pytest.mark.parametrize("seed", range(40))
def test_a_backup_is_the_sum_over_next_states_and_observations(seed: int) -> None:
    reading = Reading(discounted(seed))
    exact, pomdp = reading.exact, reading.pomdp
    random = np.random.default_rng(seed)
    space = BeliefSpace(pomdp)
    lower = LowerBound(space, [(0, pomdp.zero)], 100.0, nodes=1000, width=0.0)
    for seen in sorted({reading.seen(s) for s in range(exact.states)}):
        for action in range(pomdp.actions):
            step = pomdp.step(seen, action)
            chosen = [Alpha(o.seen, 0, random_alpha(reading, o.seen, random)) for o in step.outcomes]
            found = lower.backup(step, chosen).diagram
            for state in range(exact.states):
                if reading.seen(state) != seen:
                    continue
                wanted = float(exact.rewards[action][state])
                for (following, o), chance in exact.kernel[action][state].items():
                    number = reading.outcome(step, following, o)
                    if exact.terminal[following]:
                        continue
                    assert number is not None, "an outcome that happens is listed"
                    after = reading.value(chosen[number].diagram, following)
                    wanted += float(DISCOUNT) * float(chance) * after
                value = reading.value(found, state)
                # what rounding may add is taken off: never above, and below by less than 1e-9
                assert wanted - 1e-9 <= value <= wanted + 1e-13


def marginal_of(belief: PointBelief, reading: Reading, state: int) -> float:
    """The probability that a belief gives to a state of its y."""
    space = BeliefSpace(reading.pomdp)
    chance = 1.0
    for k in reading.pomdp.hidden:
        level = reading.pomdp.symbolic.now(k)
        if level not in belief.cluster:
            chance *= belief.marginals[space.offset[level] + reading.digits[state][k]]
    if belief.diagram is not None:
        chance *= reading.value(belief.diagram, state)
    return float(chance)


@pytest.mark.parametrize("seed", range(40))
def test_beliefs_follow_by_bayes_rule(seed: int) -> None:
    reading = Reading(discounted(seed))
    exact, pomdp = reading.exact, reading.pomdp
    space = BeliefSpace(pomdp)
    vectors = []
    for weight, belief in space.starts():
        dense = np.array([
            marginal_of(belief, reading, s) if reading.seen(s) == belief.seen else 0.0
            for s in range(exact.states)
        ])  # fmt: skip
        initial = [
            float(exact.initial[s]) if reading.seen(s) == belief.seen and not exact.terminal[s] else 0.0
            for s in range(exact.states)
        ]
        np.testing.assert_allclose(weight * dense, initial, atol=1e-12)
        vectors.append((belief, dense))
    for _ in range(2):  # two steps from the start
        following = []
        for belief, dense in vectors[:4]:
            for action in range(pomdp.actions):
                step = pomdp.step(belief.seen, action)
                masses = np.zeros((len(step.outcomes), exact.states))
                reward = 0.0
                for s in np.flatnonzero(dense).tolist():
                    reward += dense[s] * float(exact.rewards[action][s])
                    for (after, o), chance in exact.kernel[action][s].items():
                        if not exact.terminal[after]:
                            number = reading.outcome(step, after, o)
                            assert number is not None
                            masses[number, after] += dense[s] * float(chance)
                found_reward, follows = space.follow(belief, action)
                assert found_reward == pytest.approx(reward, abs=1e-9)
                for mass, follow in zip(masses, follows, strict=True):
                    total = mass.sum()
                    if follow is None:
                        assert total < 1e-12
                        continue
                    assert follow.probability == pytest.approx(total, abs=1e-12)
                    assert follow.exact
                    made = np.array([
                        marginal_of(follow.belief, reading, s)
                        if reading.seen(s) == follow.belief.seen else 0.0
                        for s in range(exact.states)
                    ])  # fmt: skip
                    np.testing.assert_allclose(made, mass / total, atol=1e-10)
                    following.append((follow.belief, mass / total))
        vectors = following


@pytest.mark.parametrize("first", range(0, 100, 10))
def test_bounds_hold_on_random_models(first: int) -> None:
    for seed in range(first, first + 10):
        model = discounted(seed)
        pomdp = enumerate_pomdp(model).to_arrays()
        low, high = bracket(pomdp, pomdp.initial, 1e-2)
        found = solve_symbolic(compile_model(model), Demand(1e-3, iterations=6))
        assert found.lower <= high, seed
        assert low <= found.upper, seed
        assert found.lower <= found.upper, seed
        for earlier, later in zip(found.history, found.history[1:], strict=False):
            assert earlier.lower <= later.lower
            assert later.upper <= earlier.upper


@pytest.mark.parametrize("seed", range(12))
def test_bounds_hold_where_leaves_are_merged(seed: int) -> None:
    """Few nodes and wide gaps: the bounds become wide, not wrong."""
    model = discounted(seed, features=(2, 3))
    pomdp = enumerate_pomdp(model).to_arrays()
    low, high = bracket(pomdp, pomdp.initial, 1e-2)
    for nodes, gap in ((3, 1e-3), (1000, 5.0)):
        found = solve_symbolic(compile_model(model), Demand(gap, iterations=3), node_limit=nodes)
        assert found.lower <= high
        assert low <= found.upper


# From SOLVERS: two or more independent solvers agree (pomdp-solve, SARSOP).
PUBLISHED = {"tiger": 19.371368, "cheese": 3.486207}


@pytest.mark.parametrize("name", sorted(PUBLISHED))
def test_published_values_are_between_the_bounds(name: str) -> None:
    model = library.load(name).model
    found = solve_symbolic(compile_model(model), Demand(1e-2))
    assert found.converged
    assert found.gap <= 1e-2
    assert found.lower - 1e-6 <= PUBLISHED[name] <= found.upper + 1e-6


SHIPPED = {
    "meds": {}, "part_painting": {}, "hallway": {"size": 5}, "cheese_taxi": {}, "nursebot": {},
    "twenty_questions": {}, "network": {"size": 3}, "rocksample": {},
}  # fmt: skip


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_bounds_on_shipped_domains_agree_with_those_of_listed_states(name: str) -> None:
    model = library.load(name, SHIPPED[name]).model
    found = solve_symbolic(compile_model(model), Demand(1e-2, iterations=4, deadline=time.monotonic() + 10))
    flat = flat_model(compile_model(model)).pomdp
    other = solve_pomdp(flat, "sarsop", demand=Demand(1e-2, iterations=60))
    assert found.lower <= other.upper
    assert other.lower <= found.upper
    assert found.lower <= found.upper


# -- what ends it ------------------------------------------------------------------------------------


def tiger(demand: Demand, **limits: int) -> SymbolicSolution:
    return solve_symbolic(compile_model(library.load("tiger").model), demand, **limits)


def test_a_limit_of_beliefs_ends_it_with_bounds() -> None:
    found = tiger(Demand(1e-6), belief_limit=4)
    assert found.status == "memory limit"
    assert "4 beliefs" in found.note
    assert found.lower <= PUBLISHED["tiger"] <= found.upper


def test_a_deadline_that_has_passed_leaves_the_first_bounds() -> None:
    found = tiger(Demand(1e-6, deadline=time.monotonic() - 1))
    assert found.status == "time limit"
    assert found.lower <= PUBLISHED["tiger"] <= found.upper
    assert found.policy.vectors >= 1


def test_ctrl_c_leaves_the_policy_and_the_bounds_so_far() -> None:
    calls = iter(range(100))

    def interrupt(lower: float, upper: float) -> None:
        if next(calls) == 5:
            raise KeyboardInterrupt

    found = tiger(Demand(1e-6, progress=interrupt))
    assert found.status == "interrupted"
    assert found.iterations >= 4
    assert found.lower <= PUBLISHED["tiger"] <= found.upper
    first = tiger(Demand(1e-6, iterations=1))
    assert found.lower >= first.lower
    assert found.upper <= first.upper


def test_a_policy_says_at_least_the_lower_bound_of_itself() -> None:
    found = tiger(Demand(1e-2))
    space = found.policy.space
    ((weight, belief),) = space.starts()
    assert weight == 1.0
    assert found.lower - 1e-9 <= found.policy.value(belief) <= PUBLISHED["tiger"] + 1e-9
    assert found.policy.choose(belief) == 0  # listen


def test_too_many_joint_observations_name_the_channels() -> None:
    x = boolean("x")
    channels = [Observation(f"o{i}", ["none", "a", "b", "c", "d"]) for i in range(6)]
    chances = {"a": Fraction(1, 10), "b": Fraction(2, 10), "c": Fraction(3, 10), "d": Fraction(4, 10)}
    others = [
        {"a": Fraction(i, 50), "b": Fraction(3, 10), "c": Fraction(2, 10), "d": Fraction(25 - i, 50)}
        for i in range(1, 7)
    ]
    tells = [conditional(x.next, lottery(chances), lottery(other)) for other in others]
    model = Model(
        "noisy", [x], [Action("look", {}, senses=dict(zip(channels, tells, strict=True)))],
        rewards=[1], discount=Fraction(1, 2), observability="partial", observations=channels,
    )  # fmt: skip
    with pytest.raises(LimitReached, match=r"'look'.*o0 \(5 values\).*o5 \(5 values\)"):
        FactoredPOMDP(compile_model(model)).step((), 0)


@pytest.mark.parametrize(
    ("change", "said"),
    [({"horizon": 3}, "no horizon"), ({"discount": Fraction(1)}, "discount below 1")],
)
def test_what_has_no_alpha_vectors_is_refused(change: dict[str, object], said: str) -> None:
    model = replace_fields(library.load("tiger").model, **change)
    with pytest.raises(ModelError, match=said):
        solve_symbolic(compile_model(model), Demand(1e-3))
    with pytest.raises(ModelError, match="partially observed"):
        solve_symbolic(compile_model(library.load("taxi").model), Demand(1e-3))


# -- files and commands ------------------------------------------------------------------------------


def test_a_policy_file_holds_the_policy(tmp_path: Path) -> None:
    model = library.load("rocksample").model
    found = solve_symbolic(compile_model(model), Demand(1e-2, iterations=3))
    path = tmp_path / "rock.policy"
    save_alpha_policy(found.policy, path, {"lower": found.lower})
    again = load_alpha_policy(path)
    assert again.model == model
    assert again.report == {"lower": found.lower}
    assert again.policy.vectors == found.policy.vectors
    for (_, one), (_, other) in zip(found.policy.space.starts(), again.policy.space.starts(), strict=True):
        assert found.policy.value(one) == again.policy.value(other)
        assert found.policy.choose(one) == again.policy.choose(other)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(ModelError, match="damaged"):
        load_alpha_policy(path)


@pytest.fixture
def solved(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "tiger.policy"
    assert main(["solve", "tiger", "--solver", "symbolic", "--gap", "0.1", "-q", "-o", str(path)]) == 0
    return path


def test_the_command_solves_and_simulates(solved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["simulate", str(solved), "--json", "--episodes", "20", "--steps", "40"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["tracker"] == "diagram"
    assert data["episodes"] == 20
    assert data["planned_lower"] <= PUBLISHED["tiger"] <= data["planned_upper"]


def test_auto_takes_it_where_there_are_too_many_states(capsys: pytest.CaptureFixture[str]) -> None:
    # RockSample[4,16]: 20 * 2^16 = 1,310,720 states
    arguments = [
        "--set",
        "size=4",
        "--set",
        "rocks=16",
        "--set",
        "seed=1",
        "--iterations",
        "1",
        "--time",
        "20",
    ]
    assert main(["solve", "rocksample", *arguments, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["method"] == "point-based value iteration on diagrams"
    assert "may be listed" in data["note"]
    assert data["lower"] < data["upper"]


@pytest.mark.parametrize("arguments", [["taxi"], ["tiger", "--horizon", "3"]])
def test_the_command_refuses_what_it_cannot_solve(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["solve", *arguments, "--solver", "symbolic"]) == 2
    assert "symbolic" in capsys.readouterr().err


# -- tables in place of diagrams ---------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(30))
def test_backups_on_tables_and_on_diagrams_agree(seed: int) -> None:
    reading = Reading(discounted(seed))
    pomdp = reading.pomdp
    random = np.random.default_rng(seed)
    lower = LowerBound(BeliefSpace(pomdp), [(0, pomdp.zero)], 100.0, nodes=10_000, width=0.0)
    for seen in sorted({reading.seen(s) for s in range(reading.exact.states)}):
        for action in range(pomdp.actions):
            step = pomdp.step(seen, action)
            chosen = [Alpha(o.seen, 0, random_alpha(reading, o.seen, random)) for o in step.outcomes]
            by_tables = lower.by_cells(step, chosen, 0.0)
            assert by_tables is not None
            by_diagrams, _ = lower.by_diagrams(step, chosen, 0.0)
            for state in range(reading.exact.states):
                if reading.seen(state) == seen:
                    one, other = (reading.value(d, state) for d in (by_tables[0], by_diagrams))
                    assert one == pytest.approx(other, abs=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_first_bounds_on_tables_and_on_diagrams_agree(seed: int) -> None:
    pomdp = FactoredPOMDP(compile_model(discounted(seed)))
    first = FirstBounds(pomdp, Sizes(10_000, 1e-7), lambda: None)
    later = time.monotonic() + 60
    cells = CellBounds(first)
    for one, other in zip(cells.qmdp(later), first.qmdp(later), strict=True):
        assert max(map(abs, leaves(one - other))) <= 1e-4
    tables, diagrams = dict(cells.blind(later)), dict(first.blind(later))
    for action in tables.keys() & diagrams.keys():
        assert max(map(abs, leaves(tables[action] - diagrams[action]))) <= 1e-4


@pytest.mark.parametrize("seed", range(10))
def test_a_table_is_the_diagram_that_it_came_from(seed: int) -> None:
    random = np.random.default_rng(seed)
    sizes = random.integers(1, 4, 5).tolist()
    manager = Manager([size for size in sizes for _ in range(2)])
    axes = tuple(range(0, 10, 2))
    values = random.integers(0, 3, sizes).astype(float)
    table = Table(axes, values)
    diagram = diagram_of(manager, table)
    np.testing.assert_array_equal(table_of(diagram, axes).values, values)
    for cell in np.ndindex(*sizes):
        assert at(diagram, dict(zip(axes, cell, strict=True))) == values[cell]
    for direction, sign in (("down", -1.0), ("up", 1.0)):
        merged, error = merged_diagram(manager, Table(axes, random.random(sizes)), 0.0, 5, direction)
        assert node_count(merged) <= 5
        assert 0 <= error <= 1
        noisy = Table(axes, random.random(sizes))
        merged, error = merged_diagram(manager, noisy, 0.1, 50, direction)
        difference = sign * (table_of(merged, axes).values - noisy.values)
        assert difference.min() >= 0
        assert difference.max() <= error


def test_machines_in_a_ring_get_bounds_from_projected_beliefs() -> None:
    """2^11 states; beliefs of coupled machines are projected, and the bounds hold all the same."""
    model = library.load("network", {"size": 11}).model
    found = solve_symbolic(compile_model(model), Demand(1.0, iterations=2), node_limit=500)
    assert found.projections > 0
    assert "projected" in found.note
    assert "tables" in found.note
    # all are up at the start, and the server counts twice: 12; nobody earns more in any step
    assert 12 < found.lower < found.upper <= 12 / (1 - 0.95)
