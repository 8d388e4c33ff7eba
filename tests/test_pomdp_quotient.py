"""Quotients of POMDPs against brute force over enumerated models, in exact rationals."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from random import Random

import numpy as np
import numpy.typing as npt
import pytest
from compiled_cases import table_diagram
from random_pomdps import random_pomdp

from factored_polca.diagrams import INDEX, evaluate_states, support
from factored_polca.explicit.alpha_expansion import forward_values
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.explicit.exact_pomdp import ExactPOMDP, enumerate_pomdp
from factored_polca.explicit.minimiser import minimise_pomdp
from factored_polca.explicit.pomdp_arrays import check_pomdp
from factored_polca.library import load
from factored_polca.minimisation import (
    Choice,
    DecisionProcess,
    PomdpQuotient,
    Reduction,
    ends,
    flat_process,
    make_pomdp_quotient,
    minimise,
    observation_counts,
    reduce,
)
from factored_polca.models import Action, Feature, LimitReached, Model, ModelError, Observation, boolean
from factored_polca.symbolic import SymbolicModel, compile_model, reachable_states

SEEDS, CHUNK = 200, 20
SIZES = (24, 64, 256)
CHUNKS = [range(start, start + CHUNK) for start in range(0, SEEDS, CHUNK)]

Column = dict[tuple[int, int], Fraction]
"""(block, next block) -> positive probability."""


@dataclass(frozen=True)
class Case:
    """A model in both readings; `states` [s, feature] are value numbers."""

    symbolic: SymbolicModel
    exact: ExactPOMDP
    states: npt.NDArray[np.int32]


def both(model: Model) -> Case:
    exact = enumerate_pomdp(model)
    rows = [[f.index(v) for f, v in zip(model.features, s, strict=True)] for s in exact.state_values]
    return Case(compile_model(model), exact, np.array(rows, dtype=np.int32))


@cache
def case(seed: int) -> Case:
    return both(random_pomdp(seed, max_states=SIZES[seed % 10 // 4]))


@cache
def reduction(seed: int) -> Reduction:
    return reduce(flat_process(case(seed).symbolic), seed=seed)


def raw_number(quotient: PomdpQuotient, choice: int, values: Sequence[object]) -> int:
    names = [channel.name for channel in quotient.process.symbolic.model.observations]
    return quotient.observation_of(choice, dict(zip(names, values, strict=True)))  # type: ignore[arg-type]


def columns(
    exact: ExactPOMDP, action: int, block_of: Sequence[int], states: Sequence[int]
) -> dict[int, Column]:
    """K(C; C', o) by raw joint observation o, from one state of each block."""
    result: dict[int, Column] = defaultdict(lambda: defaultdict(Fraction))
    for s in states:
        for (t, o), chance in exact.kernel[action][s].items():
            result[o][block_of[s], block_of[t]] += chance
    return result


def direction(column: Column) -> frozenset[tuple[tuple[int, int], Fraction]]:
    """The same for columns that are proportional, and for no others."""
    total = sum(column.values(), Fraction(0))
    return frozenset((key, chance / total) for key, chance in column.items())


def check_quotient(
    found: Case, exact: ExactPOMDP, result: Reduction, inside: Sequence[bool] | None = None
) -> None:
    """The quotient's kernel is the brute-force sum, and merging is lossless and goes as far as it can."""
    quotient = result.pomdp_quotient
    check_pomdp(quotient.pomdp)
    block_of = result.project_states(found.states).tolist()
    listed = [s for s in range(exact.states) if inside is None or inside[s]]
    first = list({block_of[s]: s for s in reversed(listed)}.values())
    for c in range(len(exact.actions)):
        raw = columns(exact, c, block_of, first)
        number = {o: raw_number(quotient, c, exact.observations[o]) for o in raw}
        # lossless: what is merged is proportional; complete: what is proportional is merged
        directions = {o: direction(column) for o, column in raw.items()}
        assert len(set(directions.values())) == len(set(number.values())) == len(set(zip(
            directions.values(), number.values(), strict=True)))  # fmt: skip
        if raw:
            assert sorted(set(number.values())) == list(range(quotient.observations_after[c]))
        for s in listed:
            expected: dict[tuple[int, int], Fraction] = defaultdict(Fraction)
            for (t, o), chance in exact.kernel[c][s].items():
                expected[block_of[t], number[o]] += chance
            row = quotient.exact_row(c, block_of[s])
            assert row == expected
            assert quotient.exact_reward(c, block_of[s]) == exact.rewards[c][s]
            assert quotient.pomdp.rewards[c, block_of[s]] == float(exact.rewards[c][s])
            assert sum(row.values()) == (not exact.terminal[s])
        for o, matrix in enumerate(quotient.pomdp.kernel[c]):
            dense = matrix.toarray()
            wanted = np.zeros_like(dense)
            for s in first:
                for (t, seen), chance in quotient.exact_row(c, block_of[s]).items():
                    if seen == o:
                        wanted[block_of[s], t] = float(chance)
            assert np.abs(dense - wanted).max() <= 1e-12


@pytest.mark.parametrize("seeds", CHUNKS, ids=[f"{chunk.start}-{chunk.stop - 1}" for chunk in CHUNKS])
def test_the_kernel_is_the_sum_over_all_states_and_merging_is_lossless_and_complete(seeds: range) -> None:
    for seed in seeds:
        check_quotient(case(seed), case(seed).exact, reduction(seed))


def test_the_random_models_exercise_every_kind_of_dependence_and_of_merging() -> None:
    met: dict[str, int] = defaultdict(int)
    for seed in range(SEEDS):
        symbolic, quotient = case(seed).symbolic, reduction(seed).pomdp_quotient
        last = 2 * len(symbolic.order)
        for action in symbolic.actions:
            met["synchronic"] += action.synchronic
            for row in action.observations.values():
                levels = [level for level in support(row.diagram) if level < last]
                met["several next parents"] += sum(level % 2 for level in levels) > 1
                met["now and next"] += len({level % 2 for level in levels}) == 2
        for c, kernel in enumerate(quotient.kernels):
            channels = kernel.observations.channels
            met["never occurs"] += any(-1 in channel.image for channel in channels)
            met["values merged"] += any(
                0 < channel.values < len(set(range(len(channel.image)))) - channel.image.count(-1)
                for channel in channels
            )
            met["channel dropped"] += len(kernel.observations.left) < len(channels)
            met["columns merged"] += quotient.observations_after[c] < len(kernel.observations.numbers)
        met["terminal"] += bool(quotient.pomdp.terminal.any())
        met["merged blocks"] += quotient.partition.blocks < case(seed).exact.states
        met["mixed observability"] += any(f.observed for f in symbolic.model.features)
    kinds = 10
    assert len(met) == kinds
    assert min(met.values()) >= 10, dict(met)


def test_observed_features_terminal_states_and_the_start_are_those_of_the_model() -> None:
    for seed in range(SEEDS):
        found, result = case(seed), reduction(seed)
        pomdp, blocks = result.pomdp_quotient.pomdp, result.project_states(found.states).tolist()
        live = [s for s in range(found.exact.states) if not found.exact.terminal[s]]
        seen = {(found.exact.observed[s], int(pomdp.observed[blocks[s]])) for s in live}
        assert len(seen) == len({old for old, _ in seen}) == len({new for _, new in seen})
        assert [bool(pomdp.terminal[b]) for b in blocks] == list(found.exact.terminal)
        initial = np.bincount(blocks, weights=np.array(found.exact.initial, dtype=float))
        assert pomdp.initial == pytest.approx(initial, abs=1e-12)
        assert pomdp.initial == pytest.approx(result.project_initial(), abs=0)
        assert pomdp.discount == float(found.exact.discount)


def test_counts_need_no_quotient_and_bound_what_it_is_left_with() -> None:
    for seed in range(SEEDS):
        found, quotient = case(seed), reduction(seed).pomdp_quotient
        counts = observation_counts(quotient.process)
        with_noise_left_out = observation_counts(quotient.process, quotient.partition)
        model = found.symbolic.model
        for c, action in enumerate(model.actions):
            sizes = {channel.name: len(channel.values) for channel in model.observations}
            before = int(np.prod([sizes[name] for name, _ in action.senses], dtype=int))
            assert counts[c].choice == action.name
            assert counts[c].before == quotient.observations_before[c] == before
            occurring = len(quotient.kernels[c].observations.numbers)
            assert quotient.observations_after[c] <= max(1, occurring)
            assert occurring <= with_noise_left_out[c].after <= counts[c].after <= before


# -- the value ------------------------------------------------------------------------------------


def small_enough(exact: ExactPOMDP) -> bool:
    """Whether all histories of four steps are soon listed."""
    seen = {y for y, ended in zip(exact.observed, exact.terminal, strict=True) if not ended}
    branches = [len(listed) for listed in exact.observations_of]
    return exact.states <= 64 and 1 <= len(seen) <= 4 and max(branches) <= 4 and sum(branches) <= 8


def test_the_quotient_is_worth_what_the_model_is_at_horizon_four() -> None:
    compared = fewer_observations = fewer_states = 0
    for seed in range(SEEDS):
        found, result = case(seed), reduction(seed)
        if not small_enough(found.exact):
            continue
        original, quotient = found.exact.to_arrays(), result.pomdp_quotient.pomdp
        beliefs = np.vstack(
            [original.initial, np.random.default_rng(seed).dirichlet(np.ones(original.states), 5)]
        )
        blocks = result.project_states(found.states)
        projected = np.array([np.bincount(blocks, b, quotient.states) for b in beliefs])
        expected = forward_values(original, beliefs, 4)
        assert forward_values(quotient, projected, 4) == pytest.approx(expected, rel=1e-9, abs=1e-9)
        compared += 1
        fewer_observations += sum(map(len, quotient.observations)) < sum(map(len, original.observations))
        fewer_states += quotient.states < original.states
    assert compared >= 80
    assert min(fewer_observations, fewer_states) >= 15


# -- abstract choices -----------------------------------------------------------------------------


def polled(exact: ExactPOMDP, policies: Mapping[str, Sequence[int]]) -> ExactPOMDP:
    """The POMDP whose actions take, at each state, the primitive that a policy says."""
    taken = list(policies.values())
    kernel = tuple(tuple(exact.kernel[a][s] for s, a in enumerate(policy)) for policy in taken)
    return replace(
        exact,
        actions=tuple(policies),
        kernel=kernel,
        rewards=tuple(tuple(exact.rewards[a][s] for s, a in enumerate(policy)) for policy in taken),
        observations_of=tuple(tuple(sorted({o for row in rows for _, o in row})) for rows in kernel),
    )


def abstract_process(found: Case, policies: Mapping[str, Sequence[int]]) -> DecisionProcess:
    """Choices that stand for what `policies` [s] say at live states, and for nothing at others."""
    flat, exact = flat_process(found.symbolic), found.exact
    live, none = [not ended for ended in exact.terminal], len(exact.actions)
    app = table_diagram(found.symbolic, [int(inside) for inside in live], INDEX)
    choices = []
    for name, policy in policies.items():
        used = tuple(sorted({a for a, inside in zip(policy, live, strict=True) if inside}))
        masked = [a if inside else none for a, inside in zip(policy, live, strict=True)]
        choices.append(Choice(name, app, used, table_diagram(found.symbolic, masked, INDEX)))
    return replace(flat, choices=tuple(choices))


def test_an_abstract_choice_has_the_kernel_of_the_primitives_that_it_stands_for() -> None:
    several = 0
    for seed in range(0, SEEDS, 3):
        found, random = case(seed), Random(seed)
        exact = found.exact
        if all(exact.terminal) or exact.states > 64:
            continue
        policies = {
            f"child {i}": [random.randrange(len(exact.actions)) for _ in range(exact.states)]
            for i in range(random.randint(1, 2))
        }
        result = reduce(abstract_process(found, policies), seed=seed)
        abstract = polled(exact, policies)
        assert result.partition.blocks == minimise_pomdp(abstract).blocks
        check_quotient(found, abstract, result)
        several += any(len(set(policy)) > 1 for policy in policies.values())
    assert several > 12


def test_an_abstract_choice_merges_only_what_all_its_primitives_allow() -> None:
    place, sound = Feature("place", ["a", "b"]), Observation("sound", ["low", "high", "loud", "none"])
    left = {
        "sound": "{low: 0.2, high: 0.4, loud: 0.4} if place' == a else {low: 0.6, high: 0.2, loud: 0.2}"
    }
    right = {"sound": "{low: 0.2, high: 0.5, loud: 0.3}"}
    model = Model(
        "two ears",
        [place],
        [
            Action("left", {place: "{a: 0.5, b: 0.5}"}, senses=left, rewards="1 if place == a else 0"),
            Action("right", {place: "{a: 0.1, b: 0.9}"}, senses=right),
            Action("deaf", {}),
        ],
        observability="partial",
        observations=[sound],
    )
    found = both(model)
    counts = [(count.before, count.after) for count in observation_counts(flat_process(found.symbolic))]
    assert counts == [(4, 2), (4, 1), (1, 1)]
    policies = {"left or right": [0, 1], "right or deaf": [1, 2]}
    result = reduce(abstract_process(found, policies))
    check_quotient(found, polled(found.exact, policies), result)
    assert result.pomdp_quotient.observations_after == (3, 2)
    assert result.pomdp_quotient.pomdp.observations[1] == ("sound=low / high / loud", "sound=none")
    assert result.pomdp_quotient.primitive.tolist() == [[0, 1], [1, 2]]


def test_a_choice_that_does_not_apply_everywhere_is_refused() -> None:
    found = both(load("tiger", {}).model)
    flat = flat_process(found.symbolic)
    nowhere = replace(flat.choices[0], app=found.symbolic.manager.constant(0))
    process = replace(flat, choices=(*flat.choices[1:], nowhere))
    with pytest.raises(ModelError, match=r"does not apply at .*actions apply everywhere"):
        make_pomdp_quotient(process, minimise(process).partition)


def test_a_restriction_to_reachable_states_leaves_the_others_out() -> None:
    restricted = 0
    for seed in range(0, SEEDS, 3):
        found = case(seed)
        reached = reachable_states(found.symbolic, backend="kernel").diagram
        inside = evaluate_states(reached, found.states, found.symbolic.columns()).astype(bool).tolist()
        result = reduce(flat_process(found.symbolic, reachable=reached), seed=seed)
        check_quotient(found, found.exact, result, inside)
        restricted += not all(inside)
    assert restricted >= 5


def test_channels_that_a_process_does_not_observe_are_summed_out() -> None:
    for seed in range(0, SEEDS, 5):
        found = case(seed)
        process = replace(flat_process(found.symbolic), channels=(0,))
        values = [(values[0],) for values in found.exact.observations]
        kept = sorted(set(values), key=repr)
        exact = replace(
            found.exact,
            channels=found.exact.channels[:1],
            observations=tuple(kept),
            kernel=tuple(tuple(summed(row, values, kept) for row in rows) for rows in found.exact.kernel),
        )
        result = reduce(process, seed=seed)
        assert result.partition.blocks == minimise_pomdp(exact).blocks
        padded = replace(exact, observations=tuple(
            (*o, *(c.values[0] for c in found.exact.channels[1:])) for o in kept))  # fmt: skip
        check_quotient(found, padded, result)


def summed(
    row: Mapping[tuple[int, int], Fraction], values: Sequence[object], kept: Sequence[object]
) -> dict[tuple[int, int], Fraction]:
    result: dict[tuple[int, int], Fraction] = defaultdict(Fraction)
    for (t, o), chance in row.items():
        result[t, kept.index(values[o])] += chance
    return dict(result)


# -- single cases ---------------------------------------------------------------------------------


def listening(senses: Mapping[str, str], observations: Sequence[Observation], *more: Feature) -> Case:
    """A hidden place that pays in a; noise is drawn anew at each step."""
    place = Feature("place", ["a", "b"])
    effects = {place: "{a: 0.9, b: 0.1} if place == a else {a: 0.3, b: 0.7}"}
    effects |= {f: f"{{{f.values[0]}: 0.5, {f.values[1]}: 0.5}}".lower() for f in more}
    action = Action("listen", effects, senses=senses, rewards="1 if place == a else 0")
    return both(
        Model("listening", [place, *more], [action], observability="partial", observations=observations)
    )


def checked(found: Case) -> PomdpQuotient:
    result = reduce(flat_process(found.symbolic))
    check_quotient(found, found.exact, result)
    return result.pomdp_quotient


def test_tiger_keeps_what_is_heard_while_listening_and_nothing_else() -> None:
    quotient = checked(both(load("tiger", {}).model))  # Kaelbling, Littman & Cassandra 1998
    names = quotient.pomdp.actions
    listen = names.index("listen")
    assert quotient.partition.blocks == 2
    assert [quotient.observations_after[c] for c in range(3)] == [1 + (c == listen) for c in range(3)]
    heard = sorted(m.toarray()[0, 0] for m in quotient.pomdp.kernel[listen])
    assert heard == pytest.approx([0.15, 0.85], abs=1e-15)


def test_values_that_are_proportional_everywhere_are_merged_and_those_that_never_occur_dropped() -> None:
    sound = Observation("sound", ["low", "loud", "blare", "boom", "none"])
    senses = {
        "sound": "{low: 0.7, loud: 0.1, blare: 0.2} if place' == a else {low: 0.4, loud: 0.2, blare: 0.4}"
    }
    quotient = checked(listening(senses, [sound]))
    assert quotient.pomdp.observations == (("sound=low", "sound=loud / blare"),)
    assert (quotient.observations_before, quotient.observations_after) == ((5,), (2,))
    assert quotient.observation_of(0, {"sound": "loud"}) == quotient.observation_of(0, {"sound": "blare"})
    with pytest.raises(ImpossibleObservation, match="sound=boom never occurs after 'listen'"):
        quotient.observation_of(0, {"sound": "boom"})
    with pytest.raises(ValueError, match="sound has no value 'hiss'; it has low, loud"):
        quotient.observation_of(0, {"sound": "hiss"})
    with pytest.raises(KeyError, match="no value of 'sound', which 'listen' senses"):
        quotient.observation_of(0, {})


def test_a_channel_whose_row_is_one_and_the_same_is_dropped_and_the_process_blind() -> None:
    constant = {"sound": "{low: 1/3, high: 2/3}"}
    quotient = checked(listening(constant, [Observation("sound", ["low", "high"])]))
    assert quotient.pomdp.observations == (("nothing",),)
    assert quotient.observation_of(0, {"sound": "low"}) == 0
    quotient = checked(listening({}, []))
    assert quotient.pomdp.observations == (("nothing",),)
    assert (quotient.observations_before, quotient.observations_after) == ((1,), (1,))


def test_joint_observations_that_never_come_together_are_not_listed() -> None:
    # Three copies of one reading: 2 of 8 combinations occur.
    senses = {f"o{i}": "{0: 0.9, 1: 0.1} if place' == a else 1" for i in range(2)}
    senses = {
        "o0": "0 if place' == a else 1",
        "o1": "0 if place' == a else 1",
        "o2": "1 if place' == a else 0",
    }
    quotient = checked(listening(senses, [Observation(f"o{i}", [0, 1]) for i in range(3)]))
    assert quotient.observations_after == (2,)
    assert observation_counts(quotient.process)[0].after == 8
    with pytest.raises(ImpossibleObservation, match="o0=0, o1=1, o2=1 never occurs"):
        quotient.observation_of(0, {"o0": 0, "o1": 1, "o2": 1})


@pytest.mark.parametrize(("shift", "left"), [(Fraction(0), 3), (Fraction(1, 10**13), 4)])
def test_joint_columns_are_compared_exactly(shift: Fraction, left: int) -> None:
    # (0, 1) and (1, 0) are proportional where both channels are distributed alike in a and in b.
    channels = [Observation("o0", [0, 1]), Observation("o1", [0, 1])]
    other = Fraction(1, 5) + shift
    senses = {
        "o0": "{0: 0.7, 1: 0.3} if place' == a else {0: 0.2, 1: 0.8}",
        "o1": f"{{0: 0.7, 1: 0.3}} if place' == a else {{0: {other}, 1: {1 - other}}}",
    }
    quotient = checked(listening(senses, channels))
    assert quotient.observations_after == (left,)
    if left == 3:
        assert quotient.pomdp.observations[0][1] == "o0=0, o1=1 / o0=1, o1=0"


def test_noise_that_one_channel_reads_is_summed_out_of_its_rows() -> None:
    z, w = boolean("z"), boolean("w")
    senses = {
        "sound": "{low: 0.9, high: 0.1} if z' else ({low: 0.4, high: 0.6} if place' == a else high)",
        "light": "on if w' else off",
    }
    channels = [Observation("sound", ["low", "high"]), Observation("light", ["on", "off"])]
    quotient = checked(listening(senses, channels, z, w))
    assert quotient.partition.blocks == 2
    assert quotient.observations_after == (2,)
    assert observation_counts(quotient.process)[0].after == 4
    assert observation_counts(quotient.process, quotient.partition)[0].after == 2


def test_noise_is_kept_where_it_ties_channels_together_or_to_what_matters() -> None:
    z, w = boolean("z"), boolean("w")
    channels = [Observation("o0", [0, 1]), Observation("o1", [0, 1])]
    # Each channel alone says nothing; together they tell place', as z' is the key of the cipher.
    cipher = {"o0": "1 if z' else 0", "o1": "(1 if z' else 0) if place' == a else (0 if z' else 1)"}
    assert checked(listening(cipher, channels, z)).observations_after == (2,)
    place = Feature("place", ["a", "b"])
    effects = {
        z: "{true: 0.5, false: 0.5}",
        place: "{a: 0.9, b: 0.1} if z' else {a: 0.2, b: 0.8}",
        w: "{true: 0.6, false: 0.4} if z' else {true: 0.3, false: 0.7}",
    }
    action = Action("go", effects, senses={"o0": "1 if w' else 0"}, rewards="1 if place == a else 0")
    model = Model("tied", [place, z, w], [action], observability="partial", observations=channels[:1])
    quotient = checked(both(model))
    assert quotient.partition.blocks == 2
    assert quotient.observations_after == (2,)


def test_synchronic_arcs_and_several_next_parents_of_a_channel_agree_with_brute_force() -> None:
    x, y, z = Feature("x", range(3)), Feature("y", range(2)), Feature("z", range(2), observed=True)
    effects = {
        x: "{0: 0.5, 1: 0.3, 2: 0.2} if z == 0 else x",
        y: "x' if x' < 2 else {0: 0.4, 1: 0.6}",
        z: "{0: 0.1, 1: 0.9} if y' == x' else z",
    }
    senses = {
        "sum": "{0: 0.8, 1: 0.2} if x' + y' == 0 else ({1: 0.6, 2: 0.4} if x' + y' == 1 else 2)",
        "moved": "(1 if x' != x else 0) if y == 0 else {0: 0.5, 1: 0.5}",
    }
    channels = [Observation("sum", range(3)), Observation("moved", [0, 1])]
    look = Action("look", effects, senses=senses, rewards="x * y")
    wait = Action(
        "wait", {x: "{0: 0.5, 1: 0.5} if y == 0 else 2"}, senses={"sum": "min(2, x')", "moved": 0}
    )
    model = Model("arcs", [x, y, z], [look, wait], terminal="x == 2 and y == 1",
                  observability="partial", observations=channels)  # fmt: skip
    found = both(model)
    assert found.symbolic.actions[0].synchronic
    assert len(set(checked(found).pomdp.observed.tolist())) == 2


def test_sensors_with_many_present_contexts_are_told_by_the_next_features_they_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ends, "PRESENT_STATES", 0)
    for seed in range(0, SEEDS, 10):
        check_quotient(case(seed), case(seed).exact, reduce(flat_process(case(seed).symbolic)))
    loc = Feature("loc", range(9))
    moves = {loc: "{0: 1/9, 1: 2/9, 2: 1/9, 3: 5/9} if loc < 4 else loc - 2"}
    act = Action("go", moves, senses={"stuck": "1 if loc' == loc else 0"}, rewards="loc * loc")
    channel = Observation("stuck", [0, 1])
    checked(both(Model("stuck", [loc], [act], observability="partial", observations=[channel])))


# -- many channels, and limits --------------------------------------------------------------------


def noisy(bits: int) -> SymbolicModel:
    """Many noisy bits about one hidden feature, among features that do not matter."""
    hidden = Feature("h", ["a", "b", "c"])
    others = [boolean(f"z{i}") for i in range(6)]
    senses = {
        f"o{i}": f"switch(h', a: {{0: {i + 1}/{bits + 2}, 1: {bits + 1 - i}/{bits + 2}}}, "
        "b: {0: 1/3, 1: 2/3}, c: 0)"
        for i in range(bits)
    }
    moves = "switch(h, a: {a: 0.9, b: 0.1}, b: {b: 0.8, c: 0.2}, c: {c: 0.7, a: 0.3})"
    stay = {hidden: moves, **dict.fromkeys(others, "{true: 1/2, false: 1/2}")}
    actions = [
        Action("stay", stay, senses=senses, rewards="1 if h == a else 0"),
        Action("go", {hidden: "switch(h, a: b, b: c, c: a)"}),
    ]
    channels = [Observation(f"o{i}", [0, 1, "none"]) for i in range(bits)]
    return compile_model(
        Model("noisy", [hidden, *others], actions, observability="partial", observations=channels)
    )


@pytest.mark.parametrize("bits", [16, 50])
def test_many_noisy_bits_are_counted_and_the_quotient_names_them(bits: int) -> None:
    process = flat_process(noisy(bits))
    counts = [(count.before, count.after) for count in observation_counts(process)]
    assert counts == [(3**bits, 2**bits), (1, 1)]
    partition = minimise(process).partition
    assert partition.blocks == 3
    with pytest.raises(LimitReached, match="'stay' has more than 1,000 joint observations") as raised:
        make_pomdp_quotient(process, partition)
    for part in ("o0 2, o1 2", f"{bits - 10} more", "`observes`", "maximum_observations"):
        assert part in str(raised.value)
    fewer = replace(process, channels=(0, 1, 2))
    assert make_pomdp_quotient(fewer, partition).observations_after == (8, 1)


def test_noisy_bits_below_the_cap_make_a_kernel_whose_proportional_columns_are_merged() -> None:
    process = flat_process(noisy(6))
    quotient = reduce(process).pomdp_quotient
    # P(bits | h' = a) / P(bits | h' = b) by brute force; all bits 0 is possible in c too.
    ratios = {None}
    for word in range(1, 2**6):
        ratio = Fraction(1)
        for i in range(6):
            one = word >> i & 1
            ratio *= Fraction(7 - i, 8) / Fraction(2, 3) if one else Fraction(i + 1, 8) / Fraction(1, 3)
        ratios.add(ratio)
    assert quotient.observations_after == (len(ratios), 1)
    assert len(ratios) < 2**6


def test_sensors_of_many_features_that_are_drawn_anew_tell_nothing() -> None:
    bits = [boolean(f"x{i}") for i in range(50)]
    senses = {f"o{i}": f"{{0: 0.9, 1: 0.1}} if x{i}' else {{0: 0.2, 1: 0.8}}" for i in range(50)}
    look = Action("look", dict.fromkeys(bits, "{true: 1/2, false: 1/2}"), senses=senses, rewards=1)
    channels = [Observation(f"o{i}", [0, 1]) for i in range(50)]
    model = Model("anew", bits, [look], observability="partial", observations=channels)
    process = flat_process(compile_model(model))
    quotient = reduce(process).pomdp_quotient
    assert quotient.observations_before == (2**50,)
    assert quotient.observations_after == (1,)
    assert [count.after for count in observation_counts(process)] == [2**50]
    assert [count.after for count in observation_counts(process, quotient.partition)] == [1]


def test_too_many_entries_or_ends_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    process = flat_process(noisy(4))
    partition = minimise(process).partition
    with pytest.raises(LimitReached, match=r"more than 20 entries.*maximum_entries"):
        make_pomdp_quotient(process, partition, maximum_entries=20)
    monkeypatch.setattr(ends, "MAXIMUM_ENDS", 2)
    with pytest.raises(LimitReached, match=r"more than 2 cases.*o0 2, o1 2"):
        make_pomdp_quotient(process, partition)


def test_a_fully_observed_process_keeps_its_markov_decision_process() -> None:
    result = reduce(flat_process(compile_model(load("linear", {"size": 4}).model)))
    assert result.quotient.mdp.states == result.partition.blocks == 5
    with pytest.raises(TypeError, match="fully observed"):
        assert result.pomdp_quotient


def test_a_map_from_blocks_to_actions_is_lifted_to_states() -> None:
    for seed in range(0, 20):
        found, result = case(seed), reduction(seed)
        pomdp = result.pomdp_quotient.pomdp
        random = np.random.default_rng(seed)
        policy = np.where(pomdp.terminal, -1, random.integers(0, len(pomdp.actions), pomdp.states))
        lifted = evaluate_states(result.lift_policy(policy), found.states, found.symbolic.columns())
        blocks = result.project_states(found.states)
        expected = np.where(policy[blocks] < 0, len(found.exact.actions), policy[blocks])
        assert lifted.tolist() == expected.tolist()
        assert result.quotient.mdp.transitions[0].sum() == pytest.approx((~pomdp.terminal).sum())


def test_a_model_whose_states_are_all_terminal_has_one_block_and_observes_nothing() -> None:
    place = Feature("place", ["a", "b"])
    sound = Observation("sound", ["low", "high"])
    listen = Action("listen", {}, senses={"sound": "low if place' == a else high"})
    model = Model("over", [place], [listen], terminal=True, observability="partial", observations=[sound])
    quotient = reduce(flat_process(compile_model(model))).pomdp_quotient
    assert quotient.pomdp.terminal.tolist() == [True]
    assert quotient.pomdp.observations == (("nothing",),)
    assert quotient.pomdp.kernel[0][0].nnz == 0
    assert quotient.exact_row(0, 0) == {}
    assert quotient.exact_reward(0, 0) == 0
