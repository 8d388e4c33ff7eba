"""Partitions that tell all states apart need no confirming pass; others are not taken for such."""

from __future__ import annotations

from fractions import Fraction

import pytest
from compiled_cases import case, chunks
from test_minimisation import FEWER, same_blocks

from factored_polca.diagrams import MERSENNE_61, Diagram, Field
from factored_polca.explicit.minimiser import minimise as explicit_minimise
from factored_polca.library import load
from factored_polca.minimisation import Minimisation, flat_process, minimise, refine
from factored_polca.minimisation.apart import all_apart, relevant_features
from factored_polca.minimisation.criterion import ProcessView
from factored_polca.models import Action, Feature, Model, Observation, boolean
from factored_polca.symbolic import NumericView, compile_model


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """What `all_apart` said, each time it was asked."""
    said: list[bool] = []

    def noted(view: ProcessView, labels: Diagram, blocks: int) -> bool:
        said.append(all_apart(view, labels, blocks))
        return said[-1]

    monkeypatch.setattr(refine, "all_apart", noted)
    return said


def minimised(model: Model) -> Minimisation:
    return minimise(flat_process(compile_model(model)))


@chunks(FEWER)
def test_brute_force_agrees_wherever_all_are_said_to_be_apart(seeds: range, answers: list[bool]) -> None:
    certain = 0
    for seed in seeds:
        found = case(seed)
        result = minimise(flat_process(found.symbolic), seed=seed)
        if answers[-1]:
            certain += 1
            assert same_blocks(found, result.partition, explicit_minimise(found.exact).members()), seed
    assert certain > len(seeds) // 4  # many small random models


@pytest.mark.parametrize("size", [4, 7])
def test_a_network_of_named_machines_takes_one_pass(size: int, answers: list[bool]) -> None:
    """Each machine has an action of its own: all 2^n states differ (the domain's own words)."""
    result = minimised(load("sysadmin", {"size": str(size)}).model)
    assert result.partition.blocks == 2**size
    assert answers == [True]
    assert len(result.primes) == 1


def test_terminal_states_may_be_one_block_and_irrelevant_features_vary(answers: list[bool]) -> None:
    """Taxi: no two of the 25 * 5 * 4 live states are alike, and the delivered ones are."""
    result = minimised(load("taxi", {"size": "5", "noise_bits": "3"}).model)
    assert result.partition.blocks == 501
    assert answers[-1]
    assert sorted(result.partition.sizes)[-2:] == [8, 100 * 8]


def test_states_that_are_alike_are_not_said_to_be_apart(answers: list[bool]) -> None:
    result = minimised(load("components", {"size": "4"}).model)
    assert result.partition.blocks < 3**4
    assert answers
    assert not any(answers)


def test_rewards_that_differ_by_the_first_prime_are_told_apart() -> None:
    """Modulo 2^61 - 1 nothing is seen of z: the blocks of x alone are not all that there is."""
    x, z = boolean("x"), boolean("z")
    model = Model(
        "trap", [x, z], [Action("wait", rewards=f"(1 if x else 0) + ({MERSENNE_61} if z else 0)")]
    )
    assert minimised(model).partition.blocks == 4


def test_chances_that_differ_by_a_multiple_of_the_first_prime_are_told_apart() -> None:
    """P(y') is u where z and u + p 2^-63 elsewhere, p the first prime; x tells nothing of z."""
    y, z = boolean("y"), boolean("z")
    low = Fraction(1, 2**63)
    high = low + Fraction(MERSENNE_61, 2**63)
    model = Model(
        "trap",
        [y, z],
        [Action("step", {y: f"bernoulli({low.numerator}/{low.denominator}) if z else "
                            f"bernoulli({high.numerator}/{high.denominator})"})],
        rewards="1 if y else 0",
    )  # fmt: skip
    assert minimised(model).partition.blocks == 4


def test_what_channels_read_is_relevant() -> None:
    """z moves nothing and earns nothing; it shows in what is observed."""
    x, z, idle = boolean("x"), boolean("z"), Feature("idle", range(3))
    sees = Observation("sees", (False, True))
    model = Model(
        "seen",
        [x, z, idle],
        [Action("flip", {x: "not x"}, senses={sees: "z'"})],
        rewards="1 if x else 0",
        observability="partial",
        observations=[sees],
    )
    symbolic = compile_model(model)
    view = ProcessView(flat_process(symbolic), NumericView(symbolic, Field()))
    by_x = symbolic.manager.indicator(symbolic.now(0), [1])
    assert sorted(relevant_features(view, by_x)) == [0, 1]
    assert not all_apart(view, by_x, 2)
    result = minimised(model)
    assert result.partition.blocks == 4
    assert result.partition.sizes == [3] * 4
