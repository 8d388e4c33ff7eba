"""Certification accepts what is stable, rejects what is not, and says why."""

from __future__ import annotations

import itertools
import time
from dataclasses import replace
from fractions import Fraction
from random import Random

import numpy as np
import pytest
from compiled_cases import Case, case, chunks, compiled

from factored_polca.diagrams import INDEX, choose, is_prime, relabel
from factored_polca.explicit.minimiser import minimise as explicit_minimise
from factored_polca.library import load
from factored_polca.minimisation import (
    Certificate,
    Choice,
    DecisionProcess,
    Partition,
    certify,
    flat_process,
    minimise,
    partition_from,
)
from factored_polca.minimisation.certify import fixed_primes
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
from factored_polca.symbolic import compile_model, reachable_states


def explicit_partition(found: Case) -> Partition:
    """The coarsest stable partition that brute force finds, as a diagram."""
    labels = found.diagram(explicit_minimise(found.exact).block_of, INDEX)
    return partition_from(found.symbolic, labels)


def merged(partition: Partition, first: int, second: int) -> Partition:
    images = np.arange(partition.blocks + 1, dtype=np.uint64)
    images[second] = first
    labels = relabel(partition.diagram, images, INDEX)
    return Partition(partition.symbolic, labels, partition.blocks, partition.has_outside)


def some_pairs(blocks: int, seed: int) -> list[tuple[int, int]]:
    pairs = list(itertools.combinations(range(blocks), 2))
    return Random(seed).sample(pairs, min(10, len(pairs)))


@chunks()
def test_every_coarsest_partition_is_accepted_and_every_merge_of_two_blocks_rejected(seeds: range) -> None:
    for seed in seeds:
        found = case(seed)
        process = flat_process(found.symbolic)
        partition = minimise(process, seed=seed).partition if seed % 2 else explicit_partition(found)
        certificate = certify(process, partition)
        assert certificate.ok, (seed, str(certificate))
        assert certificate.blocks == partition.blocks
        for first, second in some_pairs(partition.blocks, seed):
            assert not certify(process, merged(partition, first, second), failure_limit=1).ok, seed


@chunks(60)
def test_outside_of_a_restriction_is_ignored(seeds: range) -> None:
    for seed in seeds:
        found = case(seed)
        reached = reachable_states(found.symbolic).diagram
        process = flat_process(found.symbolic, reachable=reached)
        partition = minimise(process, seed=seed).partition
        assert certify(process, partition).ok, seed
        # A partition that says something outside, too, is as good.
        inside = found.at(reached)
        restricted = explicit_minimise(found.exact, [bool(i) for i in inside]).block_of
        noise = Random(seed)
        labels = [b if i else noise.randrange(100, 103) for b, i in zip(restricted, inside, strict=True)]
        everywhere = partition_from(found.symbolic, found.diagram(labels, INDEX))
        assert certify(process, everywhere).ok, seed
        for first, second in some_pairs(partition.blocks, seed)[:3]:
            assert not certify(process, merged(partition, first, second), failure_limit=1).ok, seed


@chunks(60)
def test_the_partition_into_single_states_is_stable(seeds: range) -> None:
    for seed in seeds:
        found = case(seed)
        labels = found.diagram(range(found.exact.states), INDEX)
        assert certify(flat_process(found.symbolic), partition_from(found.symbolic, labels)).ok, seed


def two_rows(first: Fraction, second: Fraction) -> Case:
    """A hidden flag decides how likely the goal is reached; nothing else tells its two values apart."""
    flag, goal = boolean("flag"), boolean("goal")

    def chance(q: Fraction) -> object:
        return lottery([(Constant(True), q), (Constant(False), 1 - q)])

    effect = conditional(flag.now, chance(first), chance(second))
    action = Action("try", {goal: effect}, rewards=[conditional(goal.now, 1, 0)])
    return compiled(Model("two rows", [flag, goal], [action]))


def by_goal(found: Case) -> Partition:
    return partition_from(found.symbolic, found.diagram([0, 1, 0, 1], INDEX))


def test_a_failure_names_block_choice_states_and_both_numbers() -> None:
    found = two_rows(Fraction(1, 3), Fraction(1, 7))
    certificate = certify(flat_process(found.symbolic), by_goal(found))
    assert not certificate.ok
    assert len(certificate.failures) == 2  # one for each block that is entered
    assert certificate.failures[0] == (
        "block 0: flag=false, goal=false and flag=true, goal=false: the probability that try enters "
        "block 0 is 6/7 and 2/3"
    )
    assert "not checked" in str(certificate)
    assert certificate.bits >= (21).bit_length()


def test_rows_that_agree_modulo_one_prime_are_told_apart_by_the_next() -> None:
    prime = 2**61 - 1
    # The difference of the two chances is prime / 10^20, which is 0 modulo that prime.
    found = two_rows(Fraction(prime + 1, 10**20), Fraction(1, 10**20))
    certificate = certify(flat_process(found.symbolic), by_goal(found))
    assert len(certificate.primes) == 2
    assert certificate.primes[0] == prime
    assert not certificate.ok


def test_rewards_that_agree_modulo_one_prime_are_told_apart_by_the_next() -> None:
    flag = boolean("flag")
    stay = Action("stay", {flag: flag.now}, rewards=[conditional(flag.now, 2**61 - 1, 0)])
    symbolic = compile_model(Model("rewards", [flag], [stay]))
    one = partition_from(symbolic, symbolic.manager.constant(0))
    certificate = certify(flat_process(symbolic), one)
    assert certificate.failures == (
        f"block 0: flag=false and flag=true: the reward of stay is 0 and {2**61 - 1}",
    )


def test_flags_and_masks_are_checked() -> None:
    n = Feature("n", range(3))
    go = Action("go", {n: Constant(2)}, applicable=n.now > 0)
    rest = Action("rest", {})
    symbolic = compile_model(Model("masks", [n], [go, rest], terminal=n.now.is_(2)))
    one = partition_from(symbolic, symbolic.manager.constant(0))
    texts = certify(flat_process(symbolic), one).failures
    assert texts == (
        "block 0: n=0 and n=2: only one of them is terminal",
        "block 0: n=0 and n=1: go is applicable at only one of them",
        "block 0: n=0 and n=2: rest is applicable at only one of them",
    )


def test_a_restriction_that_a_choice_leaves_is_reported() -> None:
    n = Feature("n", range(3))
    step = Action("step", {n: lottery([((n.now + 1) % 3, Fraction(1, 4)), (n.now, Fraction(3, 4))])})
    found = compiled(Model("leaving", [n], [step]))
    inside = found.diagram([1, 1, 0], INDEX)
    process = flat_process(found.symbolic, reachable=inside)
    partition = partition_from(found.symbolic, found.diagram([0, 1, 2], INDEX), inside)
    assert "step leaves the restriction at n=1 with probability 1/4" in certify(process, partition).failures


def test_a_state_without_a_block_is_reported() -> None:
    found = case(0)
    process = flat_process(found.symbolic)
    inside = found.diagram([int(s > 0) for s in range(found.exact.states)], INDEX)
    labels = found.diagram(range(found.exact.states), INDEX)
    partition = partition_from(found.symbolic, labels, inside)
    assert any("lies in no block" in text for text in certify(process, partition).failures)


def test_a_choice_that_stands_for_nothing_where_it_applies_is_reported() -> None:
    found = case(0)
    symbolic = found.symbolic
    everywhere = symbolic.manager.constant(1)
    nothing = Choice("child", everywhere, (0,), symbolic.manager.constant(len(symbolic.actions)))
    process = DecisionProcess(symbolic, (nothing,), ~everywhere, {0: symbolic.actions[0].rewards})
    labels = partition_from(symbolic, found.diagram(range(found.exact.states), INDEX))
    assert any("stands for no action" in text for text in certify(process, labels).failures)


def test_two_primitives_of_one_choice_are_compared_over_both_denominators() -> None:
    flag, goal = boolean("flag"), boolean("goal")

    def reach(name: str, q: Fraction) -> Action:
        return Action(name, {goal: lottery([(Constant(True), q), (Constant(False), 1 - q)])})

    for other, ok in ((Fraction(1, 10), False), (Fraction(10, 70), True)):
        model = Model("two", [flag, goal], [reach("a", Fraction(1, 7)), reach("b", other)])
        found = compiled(model)
        manager = found.symbolic.manager
        policy = choose(
            manager.indicator(found.symbolic.now(0), [1]), manager.constant(1), manager.constant(0)
        )
        child = Choice("child", manager.constant(1), (0, 1), policy)
        process = DecisionProcess(found.symbolic, (child,), manager.constant(0), {0: (), 1: ()})
        certificate = certify(process, by_goal(found))
        assert certificate.ok == ok
        assert certificate.bits >= (70 if not ok else 7).bit_length()


def test_primes_are_distinct_large_enough_and_divide_no_denominator() -> None:
    primes = fixed_primes(1000, 2**61 - 1)
    assert len(set(primes)) == len(primes)
    assert all(is_prime(p) and 2**60 < p < 2**61 - 1 for p in primes)
    assert np.prod([Fraction(p) for p in primes]) > 2**1000


def test_large_quotients_are_certified() -> None:
    for name, size, blocks in (("components", 12, 91), ("linear", 20, 21), ("expon", 6, 64)):
        process = flat_process(compile_model(load(name, {"size": size}).model))
        certificate = certify(process, minimise(process).partition)
        assert (certificate.ok, certificate.blocks) == (True, blocks), name


def test_progress_ends_with_all_planned_checks_made() -> None:
    found = case(5)
    seen: list[tuple[int, int]] = []
    process = flat_process(found.symbolic)
    certify(process, minimise(process).partition, progress=lambda done, all_: seen.append((done, all_)))
    assert seen[-1][0] == seen[-1][1]
    assert seen == sorted(seen)


def test_a_passed_deadline_raises_with_the_certificate_so_far() -> None:
    symbolic = compile_model(load("components", {"size": 8}).model)
    process = flat_process(symbolic)
    partition = minimise(process).partition
    inside = symbolic.manager.indicator(0, [0])
    symbolic.manager.deadline = time.monotonic() - 1
    with pytest.raises(LimitReached, match="certification stopped after") as raised:
        certify(process, partition)
    assert isinstance(raised.value.partial, Certificate)
    assert not raised.value.partial.ok
    with pytest.raises(LimitReached, match="before the first check"):
        certify(replace(process, reachable=inside), partition)


def test_wrong_arguments_are_refused() -> None:
    first, second = case(0), case(1)
    partition = minimise(flat_process(first.symbolic)).partition
    with pytest.raises(ValueError, match="another compiled model"):
        certify(flat_process(second.symbolic), partition)
    with pytest.raises(ValueError, match="at least 1"):
        certify(flat_process(first.symbolic), partition, failure_limit=0)
