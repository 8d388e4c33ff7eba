"""Minimisation finds the partitions that brute force finds, and quotients carry answers back exactly."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cache
from random import Random

import numpy as np
import pytest
from compiled_cases import MODELS, Case, case, chunks, compiled
from random_models import add_irrelevant_feature, relabel, reorder

from factored_polca.diagrams import INDEX, MERSENNE_61, Diagram
from factored_polca.explicit.dynamic_programming import action_values, evaluate_policy
from factored_polca.explicit.exact_dynamic_programming import optimal_solution
from factored_polca.explicit.minimiser import minimise as explicit_minimise
from factored_polca.explicit.reachability import reachable_states as explicit_closure
from factored_polca.library import load
from factored_polca.minimisation import (
    Choice,
    DecisionProcess,
    Partition,
    Reduction,
    flat_process,
    minimise,
    propagation,
    reduce,
    refine,
)
from factored_polca.minimisation.collision import difference_bits
from factored_polca.minimisation.criterion import policy_primitives
from factored_polca.minimisation.quotient import exact_initial_distribution
from factored_polca.minimisation.race import Race
from factored_polca.models import (
    Action,
    Constant,
    Feature,
    LimitReached,
    Model,
    boolean,
    conditional,
    lottery,
)
from factored_polca.solvers.choose import solve_mdp
from factored_polca.symbolic import NumericView, compile_model, reachable_states
from factored_polca.symbolic.forward import looks_up

FEWER = MODELS // 3
"""Seeds for variations whose main statement all models have been tested for."""


@cache
def reduction(seed: int) -> Reduction:
    return reduce(flat_process(case(seed).symbolic), seed=seed)


def members(found: Case, partition: Partition) -> dict[int, tuple[int, ...]]:
    """The states of each block, outside left out."""
    blocks: dict[int, list[int]] = defaultdict(list)
    for s, block in enumerate(found.at(partition.diagram)):
        if block < partition.blocks:
            blocks[block].append(s)
    return {block: tuple(states) for block, states in blocks.items()}


def same_blocks(found: Case, partition: Partition, expected: Sequence[Sequence[int]]) -> bool:
    mine = members(found, partition)
    return sorted(mine.values()) == sorted(map(tuple, expected)) and len(mine) == partition.blocks


@chunks()
def test_the_partition_is_the_one_that_brute_force_finds(seeds: range) -> None:
    for seed in seeds:
        found, result = case(seed), reduction(seed)
        partition = result.partition
        assert same_blocks(found, partition, explicit_minimise(found.exact).members()), seed
        blocks = members(found, partition)
        assert partition.sizes == [len(blocks[k]) for k in range(partition.blocks)]
        assert sum(partition.sizes) == found.model.states
        assert 0 < result.minimisation.collision_bound < 1e-10


class Downwards(Race):
    """Regresses from the top down wherever it can."""

    def regress(self, numbers: NumericView, primitive: int, value: Diagram) -> Diagram | None:
        self.ways.setdefault(primitive, "down" if looks_up(numbers, primitive) else "up")
        return super().regress(numbers, primitive, value)


@chunks()
def test_passes_over_what_has_changed_find_the_same_partition(
    seeds: range, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without passes that begin anew, and with whole passes regressed from the top down."""
    monkeypatch.setattr(refine, "EARLY", 0)
    monkeypatch.setattr(refine, "Race", Downwards)
    monkeypatch.setattr(propagation, "LARGE", 0)
    for seed in seeds:
        found = case(seed)
        again = minimise(flat_process(found.symbolic), seed=seed + 1)
        assert again.partition.diagram == reduction(seed).partition.diagram, seed
        assert same_blocks(found, again.partition, explicit_minimise(found.exact).members()), seed


def test_a_chain_is_split_state_by_state() -> None:
    """x counts up to where it is paid, so each state is a block, found in one pass each from the end."""
    x, lamp = Feature("x", range(40)), boolean("lamp")
    up = Action("up", {x: "min(x + 1, 39)", lamp: lottery({True: Fraction(1, 2), False: Fraction(1, 2)})})
    symbolic = compile_model(Model("chain", [x, lamp], [up], rewards="1 if x == 39 else 0"))
    found = minimise(flat_process(symbolic))
    assert found.partition.blocks == 40
    assert found.partition.sizes == [2] * 40
    assert found.rounds > 36


@pytest.mark.parametrize("telling", [0, 31, 32, 63, 64, 69])
def test_one_of_many_actions_is_enough_to_tell_states_apart(telling: int) -> None:
    """Choices are summed up in groups; x' = y under one of them, so x and y count, and z does not."""
    x, y, z = boolean("x"), boolean("y"), boolean("z")
    half = lottery({True: Fraction(1, 2), False: Fraction(1, 2)})
    actions = [Action(f"a{i}", {x: y if i == telling else half, z: half}) for i in range(70)]
    symbolic = compile_model(Model("many", [x, y, z], actions, rewards="1 if x else 0"))
    assert minimise(flat_process(symbolic)).partition.sizes == [2] * 4


def test_many_actions_and_long_chains_are_no_trouble() -> None:
    """`linear`: the flat quotient counts how many conditions hold from the first on, n + 1 blocks."""
    symbolic = compile_model(load("linear", {"size": "70"}).model)
    assert minimise(flat_process(symbolic)).partition.blocks == 71


@chunks()
def test_representatives_are_the_first_states_of_their_blocks(seeds: range) -> None:
    for seed in seeds:
        found, partition = case(seed), reduction(seed).partition
        by_order = [found.model.features.index(found.model.feature(n)) for n in found.symbolic.order]
        keys = [tuple(state[by_order].tolist()) for state in found.states]
        for block, states in members(found, partition).items():
            representative = tuple(partition.representatives[block][::2].tolist())
            assert representative == min(keys[s] for s in states), (seed, block)


@chunks()
def test_the_quotient_has_the_exact_rows_and_rewards_of_every_state(seeds: range) -> None:
    for seed in seeds:
        found, result = case(seed), reduction(seed)
        quotient, blocks = result.quotient, found.at(result.partition.diagram)
        random = Random(seed)
        for block, states in members(found, result.partition).items():
            s = random.choice(states)  # any state will do, if the partition is right
            assert quotient.mdp.terminal[block] == found.exact.terminal[s]
            for c in range(len(found.exact.actions)):
                expected: dict[int, Fraction] = defaultdict(Fraction)
                for t, chance in found.exact.rows[c][s].items():
                    expected[blocks[t]] += chance
                assert quotient.exact_row(c, block) == expected, (seed, c, block)
                assert quotient.exact_reward(c, block) == found.exact.rewards[c][s]
                assert quotient.mdp.applicable[c, block] == found.exact.applicable[c][s]
                floats = quotient.mdp.transitions[c][[block]].toarray()[0]
                wanted = [float(expected.get(k, 0)) for k in range(result.partition.blocks)]
                assert floats == pytest.approx(wanted, abs=1e-14)
                assert quotient.mdp.rewards[c, block] == pytest.approx(float(found.exact.rewards[c][s]))


@chunks()
def test_beliefs_and_states_are_projected_to_their_blocks(seeds: range) -> None:
    for seed in seeds:
        found, result = case(seed), reduction(seed)
        blocks = found.at(result.partition.diagram)
        expected: dict[int, Fraction] = defaultdict(Fraction)
        for s, chance in enumerate(found.exact.initial):
            if chance:
                expected[blocks[s]] += chance
        assert exact_initial_distribution(result.partition) == expected, seed
        wanted = [float(expected.get(k, 0)) for k in range(result.partition.blocks)]
        assert result.project_initial() == pytest.approx(wanted, abs=1e-14)
        belief = [(state, float(q)) for state, q in zip(found.states, found.exact.initial, strict=True)]
        assert result.project(belief) == pytest.approx(wanted, abs=1e-12)
        assert result.project_states(found.states).tolist() == blocks
        s = Random(seed).randrange(found.exact.states)
        names = [feature.name for feature in found.model.features]
        assert result.block(dict(zip(names, found.exact.state_values[s], strict=True))) == blocks[s]


@chunks()
def test_the_lifted_solution_is_optimal_on_the_original_model(seeds: range) -> None:
    for seed in seeds:
        found, result = case(seed), reduction(seed)
        solution = solve_mdp(result.quotient.mdp)
        arrays = found.exact.to_arrays()
        values = np.array(found.at(result.lift_values(solution.values)))
        # |V - V*| <= residual / (1 - discount): Bellman's operator is a contraction.
        best = np.where(arrays.terminal, 0.0, action_values(arrays, values).max(axis=0))
        scale = max(1.0, np.abs(values).max())
        assert np.abs(best - values).max() / (1 - arrays.discount) <= 1e-9 * scale, seed
        policy = np.array(found.at(result.lift_policy(solution.policy)))
        policy[policy == len(found.model.actions)] = -1
        assert (policy[arrays.terminal] == -1).all()
        achieved = evaluate_policy(arrays, policy.tolist())
        assert np.abs(achieved - values).max() <= 1e-9 * scale, seed


@chunks(FEWER)
def test_the_lifted_values_are_the_exact_optima_of_small_models(seeds: range) -> None:
    for seed in seeds:
        found = case(seed)
        if found.exact.states > 16:
            continue
        result = reduction(seed)
        values = found.at(result.lift_values(solve_mdp(result.quotient.mdp).values))
        optimum = [float(value) for value in optimal_solution(found.exact).values]
        assert values == pytest.approx(optimum, rel=1e-9, abs=1e-9), seed


@chunks(FEWER)
def test_other_seeds_give_the_identical_diagram(seeds: range) -> None:
    for seed in seeds:
        process = flat_process(case(seed).symbolic)
        other = minimise(process, seed=seed + 1, confirmations=2)
        assert other.partition.diagram == reduction(seed).partition.diagram, seed
        assert other.collision_bound < 1e-20


@chunks(FEWER)
def test_other_variable_orders_give_the_same_partition(seeds: range) -> None:
    for seed in seeds:
        found = case(seed)
        names = [feature.name for feature in found.model.features]
        order = Random(seed).sample(names, len(names))
        symbolic = compile_model(found.model, order=order)
        partition = minimise(flat_process(symbolic), seed=seed).partition
        expected = members(found, reduction(seed).partition).values()
        assert same_blocks(replace(found, symbolic=symbolic), partition, list(expected)), seed


@chunks()
def test_new_names_or_another_order_of_everything_give_the_same_block_sizes(seeds: range) -> None:
    for seed in seeds:
        changed = (relabel if seed % 2 else reorder)(case(seed).model, seed)
        partition = minimise(flat_process(compile_model(changed)), seed=seed).partition
        assert sorted(partition.sizes) == sorted(reduction(seed).partition.sizes), seed


@chunks()
def test_an_irrelevant_feature_multiplies_sizes_and_changes_nothing_else(seeds: range) -> None:
    for seed in seeds:
        larger = add_irrelevant_feature(case(seed).model, seed)
        factor = larger.states // case(seed).model.states
        partition = minimise(flat_process(compile_model(larger)), seed=seed).partition
        expected = sorted(factor * size for size in reduction(seed).partition.sizes)
        assert sorted(partition.sizes) == expected, seed


@chunks(FEWER)
def test_a_restriction_to_reachable_states_partitions_only_those(seeds: range) -> None:
    for seed in seeds:
        found = case(seed)
        inside = explicit_closure(found.exact)
        reached = reachable_states(found.symbolic, backend="kernel").diagram
        result = reduce(flat_process(found.symbolic, reachable=reached), seed=seed)
        partition = result.partition
        expected = explicit_minimise(found.exact, inside)
        assert same_blocks(found, partition, expected.members()), seed
        assert partition.has_outside == (not all(inside))
        assert sum(partition.sizes) == sum(inside)
        mdp = result.quotient.mdp
        pairs = zip(mdp.transitions, mdp.applicable, strict=True)
        rows = [matrix.sum(axis=1)[mask] for matrix, mask in pairs]
        assert np.concatenate(rows) == pytest.approx(1.0, abs=1e-12)  # no choice leaves


@chunks(FEWER)
def test_fewer_actions_give_the_partition_of_those_actions(seeds: range) -> None:
    for seed in seeds:
        found = case(seed)
        actions = [action.name for action in found.model.actions]
        chosen = Random(seed).sample(actions, Random(seed).randint(1, len(actions)))
        partition = minimise(flat_process(found.symbolic, chosen), seed=seed).partition
        assert same_blocks(found, partition, explicit_minimise(found.exact.restrict(chosen)).members()), (
            seed
        )


def random_policy(found: Case, random: Random) -> list[int]:
    """An applicable action for most states, -1 elsewhere."""
    exact = found.exact
    choices = [
        [a for a in range(len(exact.actions)) if exact.applicable[a][s]] for s in range(exact.states)
    ]
    return [random.choice(options) if options and random.random() < 0.9 else -1 for options in choices]


@chunks(FEWER)
def test_abstract_choices_are_minimised_like_the_primitives_they_stand_for(seeds: range) -> None:
    for seed in seeds:
        found, random = case(seed), Random(seed)
        count = len(found.exact.actions)
        policies = {f"child {i}": random_policy(found, random) for i in range(random.randint(1, 2))}
        kept = random.sample(range(count), random.randint(0, count - 1))
        flat = flat_process(found.symbolic)
        choices = [flat.choices[a] for a in kept]
        for name, policy in policies.items():
            diagram = found.diagram([count if a < 0 else a for a in policy], INDEX)
            app = found.diagram([int(a >= 0) for a in policy], INDEX)
            choices.append(Choice(name, app, policy_primitives(diagram, app, count), diagram))
        process = DecisionProcess(found.symbolic, tuple(choices), flat.terminal, flat.rewards)
        names = [found.exact.actions[a] for a in kept] + list(policies)
        exact = found.exact.with_abstract_actions(policies).restrict(names)
        result = reduce(process, seed=seed)
        assert same_blocks(found, result.partition, explicit_minimise(exact).members()), seed
        blocks = found.at(result.partition.diagram)
        for block, states in members(found, result.partition).items():
            s = random.choice(states)
            for c in range(len(names)):
                expected: dict[int, Fraction] = defaultdict(Fraction)
                for t, chance in exact.rows[c][s].items():
                    expected[blocks[t]] += chance
                assert result.quotient.exact_row(c, block) == expected, (seed, c, block)
                assert result.quotient.exact_reward(c, block) == exact.rewards[c][s]
        # A lifted policy names the primitive that the abstract choice stands for.
        last = np.where(result.quotient.mdp.applicable[-1], len(names) - 1, -1)
        lifted = found.at(result.lift_policy(last))
        assert lifted == [count if a < 0 else a for a in policies[names[-1]]], seed


# -- what a single field cannot see ----------------------------------------------------------------


def hidden_flag(first: Sequence[Fraction], second: Sequence[Fraction]) -> Model:
    """Both bits become true together with probability prod(first) or prod(second), by a flag that stays."""
    flag, a, b = boolean("flag"), boolean("a"), boolean("b")

    def chance(q: Fraction) -> object:
        return lottery([(Constant(True), q), (Constant(False), 1 - q)])

    effects = {bit: conditional(flag.now, chance(p), chance(q))
               for bit, p, q in zip((a, b), first, second, strict=True)}  # fmt: skip
    reward = conditional(a.now & b.now, 1, 0)
    return Model("hidden flag", [flag, a, b], [Action("try", effects, rewards=[reward])])


def test_the_confirming_round_repairs_what_the_first_prime_cannot_tell_apart() -> None:
    tiny = Fraction(1, 10**10)
    # 2^61 / 10^20 and 1 / 10^20 are equal modulo 2^61 - 1 and different rationals.
    model = hidden_flag((2**31 * tiny, 2**30 * tiny), (tiny, tiny))
    symbolic = compile_model(model)
    seen: list[tuple[int, int]] = []
    result = minimise(flat_process(symbolic), progress=lambda n, blocks: seen.append((n, blocks)))
    assert seen[0] == (1, 2)  # the first prime sees only whether both bits are true
    assert result.partition.blocks == 4
    assert result.primes[0] == MERSENNE_61
    assert len(set(result.primes)) == len(result.primes) == 3  # one finds the split, one confirms
    assert result.partition.blocks == explicit_minimise(compiled(model).exact).blocks


def test_a_denominator_divisible_by_the_first_prime_makes_another_prime_the_first() -> None:
    share = Fraction(1, MERSENNE_61)
    model = hidden_flag((share, Fraction(1, 2)), (2 * share, Fraction(1, 2)))
    result = reduce(flat_process(compile_model(model)))
    assert MERSENNE_61 not in result.minimisation.primes
    assert result.partition.blocks == explicit_minimise(compiled(model).exact).blocks == 4


def test_the_bits_of_a_difference_cover_both_denominators() -> None:
    # 1/3^60 of one action against 1/10^30 of another: the cleared numerator 3^60 - 10^30 has 100 bits.
    n = Feature("n", range(2))
    actions = [
        Action("a", {}, rewards=[Fraction(1, 3**60)]),
        Action("b", {}, rewards=[Fraction(1, 10**30)]),
    ]
    process = flat_process(compile_model(Model("bits", [n], actions)))
    assert difference_bits(process) >= (10**30 - 3**60).__abs__().bit_length()


# -- known sizes, and limits -----------------------------------------------------------------------

KNOWN = (  # name, size, states, blocks: closed forms in the domains' docstrings
    ("linear", 16, 2**16, 17),
    ("expon", 5, 2**5, 2**5),
    ("components", 12, 3**12, 13 * 14 // 2),
)


@pytest.mark.parametrize(("name", "size", "states", "blocks"), KNOWN)
def test_shipped_domains_have_the_blocks_that_theory_says(
    name: str, size: int, states: int, blocks: int
) -> None:
    model = load(name, {"size": size}).model
    partition = minimise(flat_process(compile_model(model))).partition
    assert (model.states, sum(partition.sizes), partition.blocks) == (states, states, blocks)


def test_too_many_blocks_raise_with_the_partition_so_far() -> None:
    process = flat_process(compile_model(load("expon", {"size": 6}).model))
    with pytest.raises(LimitReached, match="more than 10 blocks") as raised:
        minimise(process, block_limit=10)
    assert raised.value.stage == "minimisation"
    assert isinstance(raised.value.partial, Partition)
    assert 10 < raised.value.partial.blocks <= 64
    assert sum(raised.value.partial.sizes) == 64
    assert minimise(process, block_limit=64).partition.blocks == 64


def test_the_class_outside_a_restriction_counts_against_no_limit() -> None:
    symbolic = compile_model(load("linear", {"size": 8}).model)
    process = flat_process(symbolic, reachable=reachable_states(symbolic).diagram)
    seen: list[int] = []
    result = minimise(process, block_limit=9, progress=lambda _, blocks: seen.append(blocks))
    assert result.partition.blocks == seen[-1] == 9
    assert result.partition.has_outside


@pytest.mark.parametrize("restricted", [False, True])
def test_a_passed_deadline_raises_with_the_partition_so_far(restricted: bool) -> None:
    symbolic = compile_model(load("expon", {"size": 6}).model)
    reached = reachable_states(symbolic).diagram if restricted else None
    deadline = symbolic.manager.deadline = time.monotonic() - 1
    with pytest.raises(LimitReached, match="time limit") as raised:
        minimise(flat_process(symbolic, reachable=reached))
    assert isinstance(raised.value.partial, Partition)
    assert raised.value.partial.blocks >= 1
    assert symbolic.manager.deadline == deadline
    symbolic.manager.deadline = None
    assert minimise(flat_process(symbolic)).partition.blocks == 64


def test_a_full_memory_raises_and_leaves_the_manager_usable() -> None:
    symbolic = compile_model(load("expon", {"size": 8}).model)
    symbolic.manager.memory_limit = symbolic.manager.bytes
    with pytest.raises(LimitReached, match="memory limit"):
        minimise(flat_process(symbolic))
    symbolic.manager.memory_limit = 2**30
    assert minimise(flat_process(symbolic)).partition.blocks == 2**8


def test_an_unknown_action_is_refused_with_those_there_are() -> None:
    found = case(0)
    with pytest.raises(KeyError, match="there are a0"):
        flat_process(found.symbolic, ["jump"])


def test_a_value_that_a_feature_does_not_have_is_refused_when_a_state_is_projected() -> None:
    found, result = case(0), reduction(0)
    names = [feature.name for feature in found.model.features]
    state = dict(zip(names, found.exact.state_values[0], strict=True))
    with pytest.raises(ValueError, match="has no value 'nowhere'; it has"):
        result.block({**state, names[0]: "nowhere"})
