"""Minimisation with observations: Eq. 13 of the paper against brute force over exact rationals."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from random_pomdps import random_pomdp

from factored_polca.diagrams import evaluate_states
from factored_polca.explicit.exact_pomdp import ExactPOMDP, enumerate_pomdp
from factored_polca.explicit.minimiser import minimise_pomdp
from factored_polca.minimisation import flat_process, minimise
from factored_polca.models import Action, Feature, Model, Observation, boolean
from factored_polca.symbolic import SymbolicModel, compile_model

SIZES = (24, 64, 256)


@cache
def case(seed: int) -> tuple[SymbolicModel, ExactPOMDP]:
    model = random_pomdp(seed, max_states=SIZES[seed % 10 // 4])
    return compile_model(model), enumerate_pomdp(model)


def blocks_of_states(symbolic: SymbolicModel, exact: ExactPOMDP, diagram: object) -> list[int]:
    """The block of each state, numbered by first occurrence."""
    features = symbolic.model.features
    rows = [[f.values.index(v) for f, v in zip(features, s, strict=True)] for s in exact.state_values]
    found = evaluate_states(diagram, np.array(rows, dtype=np.int32), symbolic.columns())  # type: ignore[arg-type]
    numbers: dict[int, int] = {}
    return [numbers.setdefault(int(block), len(numbers)) for block in found]


@pytest.mark.parametrize("seed", range(200))
def test_the_partition_is_the_coarsest_that_equation_13_allows(seed: int) -> None:
    symbolic, exact = case(seed)
    found = minimise(flat_process(symbolic), seed=seed).partition
    expected = minimise_pomdp(exact)
    assert found.blocks == expected.blocks
    assert blocks_of_states(symbolic, exact, found.diagram) == list(expected.block_of)


def test_the_random_models_exercise_merging_and_both_ways_of_regression() -> None:
    merged = folded = eliminated = 0
    for seed in range(60):
        symbolic, exact = case(seed)
        merged += minimise_pomdp(exact).blocks < exact.states
        for action in symbolic.actions:
            next_parents = [row.parents_next for row in action.observations.values()]
            general = action.synchronic or any(len(parents) > 1 for parents in next_parents)
            eliminated += general
            folded += not general and any(next_parents)
    assert merged > 15
    assert folded > 20
    assert eliminated > 20


@pytest.mark.parametrize("bits", [16, 50])
def test_many_noisy_bits_on_one_hidden_feature_make_no_more_blocks_than_it_has_values(bits: int) -> None:
    hidden = Feature("h", ["a", "b", "c"])
    others = [boolean(f"z{i}") for i in range(6)]
    senses = {
        f"o{i}": f"switch(h', a: {{0: {i + 1}/{bits + 2}, 1: {bits + 1 - i}/{bits + 2}}}, "
        "b: {0: 1/3, 1: 2/3}, c: 0)"
        for i in range(bits)
    }
    moves = "switch(h, a: {a: 0.9, b: 0.1}, b: {b: 0.8, c: 0.2}, c: {c: 0.7, a: 0.3})"
    stay = {hidden: moves, **dict.fromkeys(others, "{true: 1/2, false: 1/2}")}
    model = Model(
        "noisy",
        [hidden, *others],
        [
            Action("stay", stay, senses=senses, rewards="1 if h == a else 0"),
            Action("go", {hidden: "switch(h, a: b, b: c, c: a)"}),
        ],
        observability="partial",
        observations=[Observation(f"o{i}", [0, 1, "none"]) for i in range(bits)],
    )
    assert minimise(flat_process(compile_model(model))).partition.blocks == 3


def test_sensors_of_features_that_are_drawn_anew_tell_no_states_apart() -> None:
    bits = [boolean(f"x{i}") for i in range(50)]
    look = Action(
        "look",
        dict.fromkeys(bits, "{true: 1/2, false: 1/2}"),
        senses={f"o{i}": f"{{0: 0.9, 1: 0.1}} if x{i}' else {{0: 0.2, 1: 0.8}}" for i in range(50)},
        rewards=1,
    )
    channels = [Observation(f"o{i}", [0, 1]) for i in range(50)]
    model = Model("anew", bits, [look], observability="partial", observations=channels)
    assert minimise(flat_process(compile_model(model))).partition.blocks == 1


def test_what_is_seen_is_never_merged_except_where_the_process_has_ended() -> None:
    seen = Feature("seen", ["left", "right", "end"], observed=True)
    model = Model(
        "seen",
        [seen, boolean("other")],
        [Action("go", {seen: "{left: 1/3, right: 1/3, end: 1/3}"})],
        terminal="seen == end",
        observability="partial",
    )
    assert minimise(flat_process(compile_model(model))).partition.blocks == 3
    hidden = Feature("seen", ["left", "right", "end"])
    model = Model(
        "hidden",
        [hidden, boolean("other")],
        [Action("go", {hidden: "{left: 1/3, right: 1/3, end: 1/3}"})],
        terminal="seen == end",
        observability="partial",
    )
    assert minimise(flat_process(compile_model(model))).partition.blocks == 2


def test_an_observation_splits_states_that_behave_alike_otherwise() -> None:
    place, sound = Feature("place", ["a", "b"]), Observation("sound", ["low", "high"])
    senses = {"sound": "{low: 0.9, high: 0.1} if place' == a else {low: 0.2, high: 0.8}"}
    heard = Action("listen", senses=senses, rewards=1)
    model = Model("sound", [place], [heard], observability="partial", observations=[sound])
    assert minimise(flat_process(compile_model(model))).partition.blocks == 2
    deaf = Action("listen", senses={"sound": "{low: 1/3, high: 2/3}"}, rewards=1)
    model = Model("deaf", [place], [deaf], observability="partial", observations=[sound])
    assert minimise(flat_process(compile_model(model))).partition.blocks == 1
