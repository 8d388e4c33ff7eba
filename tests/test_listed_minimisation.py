"""Refining on a list of the states finds what brute force finds, whenever it is turned to."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from random import Random

import numpy as np
import pytest
from compiled_cases import CHUNK, Case, case, chunks
from test_minimisation import random_policy, same_blocks

from factored_polca.diagrams import INDEX, Field
from factored_polca.explicit.minimiser import minimise as explicit_minimise
from factored_polca.explicit.reachability import reachable_states as explicit_closure
from factored_polca.library import load
from factored_polca.minimisation import Choice, DecisionProcess, flat_process, listed, minimise, refine
from factored_polca.minimisation.criterion import ProcessView, policy_primitives
from factored_polca.minimisation.listed import ListedRefinement, StateList, state_list
from factored_polca.minimisation.listed_kernel import sort_by
from factored_polca.models import Action, Feature, LimitReached, Model, boolean
from factored_polca.symbolic import NumericView, compile_model, reachable_states

SEEDS = 120
PRIME = Field()


@pytest.fixture
def used(monkeypatch: pytest.MonkeyPatch) -> list[StateList]:
    """All passes run on lists where that is possible at all; what has been listed."""
    begin, found = refine._Refinement.begin, []

    def begin_with_lists(self: refine._Refinement) -> None:
        begin(self)
        self.listed = state_list(self.view, self.labels.diagram)
        if self.listed is not None:
            found.append(self.listed)

    monkeypatch.setattr(refine._Refinement, "begin", begin_with_lists)
    return found


def of_model(process: DecisionProcess) -> ProcessView:
    return ProcessView(process, NumericView(process.symbolic, PRIME))


@chunks(SEEDS)
def test_the_partition_is_the_one_that_brute_force_finds(seeds: range, used: list[StateList]) -> None:
    for seed in seeds:
        found = case(seed)
        partition = minimise(flat_process(found.symbolic), seed=seed).partition
        assert same_blocks(found, partition, explicit_minimise(found.exact).members()), seed
    assert len(used) == len(seeds) == CHUNK


@chunks(SEEDS // 3)
def test_a_restriction_partitions_only_what_is_in_it(seeds: range, used: list[StateList]) -> None:
    for seed in seeds:
        found = case(seed)
        reached = reachable_states(found.symbolic, backend="kernel").diagram
        partition = minimise(flat_process(found.symbolic, reachable=reached), seed=seed).partition
        expected = explicit_minimise(found.exact, explicit_closure(found.exact))
        assert same_blocks(found, partition, expected.members()), seed
    assert used


@chunks(SEEDS // 3)
def test_abstract_choices_count_as_the_primitives_they_stand_for(
    seeds: range, used: list[StateList]
) -> None:
    for seed in seeds:
        found = case(seed)
        policy = random_policy(found, Random(seed))
        count = len(found.exact.actions)
        diagram = found.diagram([count if a < 0 else a for a in policy], INDEX)
        app = found.diagram([int(a >= 0) for a in policy], INDEX)
        choice = Choice("child", app, policy_primitives(diagram, app, count), diagram)
        flat = flat_process(found.symbolic)
        process = DecisionProcess(found.symbolic, (choice,), flat.terminal, flat.rewards)
        exact = found.exact.with_abstract_actions({"child": policy}).restrict(["child"])
        partition = minimise(process, seed=seed).partition
        assert same_blocks(found, partition, explicit_minimise(exact).members()), seed
    assert used


def listed_number(found: Case, what: StateList, s: int) -> int:
    """The number in the list of the state s."""
    number = 0
    for feature, size in zip(what.features, what.sizes, strict=True):
        number = number * size + int(found.states[s, feature])
    return number


@pytest.mark.parametrize("seed", range(20))
def test_the_matrix_is_the_weighed_sum_of_the_actions_rows(seed: int) -> None:
    """All rows of all states of `ExactMDP`, added up by states listed, with the same s_c."""
    found = case(seed)
    process = flat_process(found.symbolic)
    drawn: list[np.ndarray] = []  # what is drawn first are the factors s_c

    def draw(count: int) -> np.ndarray:
        drawn.append(PRIME.draw(np.random.default_rng(seed + len(drawn)), count))
        return drawn[-1]

    view = of_model(process)
    labels = found.symbolic.terminal
    what = state_list(view, labels)
    assert what is not None
    if labels.is_constant:  # 0 .. blocks - 1 are to be taken
        labels = found.symbolic.manager.constant(0)
    refinement = ListedRefinement(view, what, labels, draw)
    mine: dict[tuple[int, int], int] = {}
    for y in range(what.states):
        for e in range(refinement.column_first[y], refinement.column_first[y + 1]):
            mine[int(refinement.source[e]), y] = PRIME.decode(int(refinement.weight[e]))
    assert len(mine) == len(refinement.source) <= what.entries
    prime = PRIME.prime
    factors = [PRIME.decode(int(stored)) for stored in drawn[0]]
    for s in range(found.exact.states):
        expected: dict[int, int] = defaultdict(int)
        for a, factor in enumerate(factors):
            if found.exact.applicable[a][s] and not found.exact.terminal[s]:
                for t, q in found.exact.rows[a][s].items():
                    residue = q.numerator * pow(q.denominator, -1, prime) * factor
                    expected[listed_number(found, what, t)] += residue
        x = listed_number(found, what, s)
        row = {y: value for (source, y), value in mine.items() if source == x}
        assert row == {y: value % prime for y, value in expected.items()}, (seed, s)


def chain(last: int) -> Model:
    """x counts up to where it is paid, so that each value is a block, found one a pass from the end."""
    x, lamp = Feature("x", range(last + 1)), boolean("lamp")
    up = Action("up", {x: f"min(x + 1, {last})", lamp: "{true: 0.5, false: 0.5}"})
    return Model("chain", [x, lamp], [up], rewards=f"1 if x == {last} else 0")


def test_lists_are_turned_to_where_diagrams_take_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listed, "FEWEST_STEPS", 1)
    runs: list[tuple[int, int]] = []
    run = ListedRefinement.run

    def noted(self: ListedRefinement, *passes: int) -> bool:
        before = self.blocks
        answer = run(self, *passes)
        runs.append((before, self.blocks))
        return answer

    monkeypatch.setattr(ListedRefinement, "run", noted)
    found = minimise(flat_process(compile_model(chain(699))))
    assert found.partition.blocks == 700
    assert found.partition.sizes == [2] * 700
    ((before, after),) = runs  # no confirming pass: each value of x is a block
    assert before < 650
    assert after == 700
    assert found.states_listed == 700  # of the values of x; the other feature matters to nothing


def test_both_ways_give_one_diagram(request: pytest.FixtureRequest) -> None:
    process = flat_process(compile_model(load("taxi", {"size": "6"}).model))
    by_diagrams = minimise(process)
    used: list[StateList] = request.getfixturevalue("used")
    by_lists = minimise(process, seed=1)
    assert [what.states for what in used] == [6 * 6 * 6 * 4]
    assert (by_diagrams.states_listed, by_lists.states_listed) == (0, 6 * 6 * 6 * 4)
    assert by_lists.partition.diagram == by_diagrams.partition.diagram
    assert by_lists.partition.blocks == 6 * 6 * 5 * 4 + 1  # no two live states are alike


def limited(build: Callable[[], Model], limit: int) -> LimitReached:
    with pytest.raises(LimitReached) as raised:
        minimise(flat_process(compile_model(build())), block_limit=limit)
    return raised.value


def test_a_limit_of_blocks_ends_with_the_partition_so_far(used: list[StateList]) -> None:
    error = limited(lambda: chain(200), 50)
    assert "more than 50 blocks" in str(error)
    assert error.partial.blocks == 51  # a pass splits one off
    assert used


def test_irrelevant_features_are_not_listed() -> None:
    symbolic = compile_model(load("taxi", {"size": "5", "noise_bits": "8"}).model)
    view = of_model(flat_process(symbolic))
    what = state_list(view, symbolic.terminal)
    assert what is not None
    assert what.states == 600  # 25 cells, 6 places of the passenger, 4 destinations
    assert what.entries == 600 * 6  # six deterministic actions


def test_what_is_too_much_is_not_listed() -> None:
    large = compile_model(load("linear", {"size": "32"}).model)
    assert state_list(of_model(flat_process(large)), large.manager.indicator(0, [0])) is None
    dense = compile_model(load("sysadmin", {"size": "14"}).model)
    assert state_list(of_model(flat_process(dense)), dense.manager.indicator(0, [0])) is None


@pytest.mark.parametrize("keys", [1, 3, 1000])
def test_sorting_by_keys_with_few_or_many_alike(keys: int) -> None:
    generator = np.random.default_rng(keys)
    values = generator.integers(0, keys, 1000).astype(np.uint64)
    items = generator.permutation(1000).astype(np.int32)
    expected = items.copy()
    expected[100:900] = expected[100:900][np.argsort(values[expected[100:900]])]
    sort_by(values, items, 100, 900, np.zeros(160, dtype=np.int64))
    assert values[items].tolist() == values[expected].tolist()
    assert sorted(items[100:900].tolist()) == sorted(expected[100:900].tolist())
    assert items[:100].tolist() == expected[:100].tolist()
