"""What is written in Cassandra's format: flat models and quotients, read back by our reader."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from random_dynamics import constant
from random_models import random_model
from random_pomdps import random_pomdp

from factored_polca.explicit.alpha_expansion import forward_value
from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.formats import files
from factored_polca.formats.cassandra import read_pomdp_with_warnings, write_model, write_pomdp
from factored_polca.formats.cassandra_factoring import factored
from factored_polca.minimisation import flat_process, reduce
from factored_polca.models import Feature, InitialBelief, Model, ModelError
from factored_polca.models.model import replace_fields
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.symbolic import compile_model

HORIZON = 3
SEEDS = range(60)


def read_back(text: str) -> ArrayPOMDP:
    """The arrays of a written text; it has no fault and no rounded row."""
    model, warnings = read_pomdp_with_warnings(text, "back")
    assert not warnings
    return enumerate_pomdp(model).to_arrays()


def value(pomdp: ArrayPOMDP) -> float:
    return forward_value(pomdp, pomdp.initial, HORIZON)


def foretold(model: Model) -> Model:
    """The same model, which begins with the first value of each observed feature."""
    kept = [pair for pair in model.initial.distributions if not model.feature(pair[0]).observed]
    first = [(f.name, constant(f.values[0])) for f in model.features if f.observed]
    if model.initial.factors:
        kept = []
    return replace_fields(model, initial=InitialBelief([*first, *kept]))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_flat_model_keeps_its_value(seed: int) -> None:
    model = random_pomdp(seed)
    if any(feature.observed for feature in model.features):
        model = foretold(model)
    arrays = enumerate_pomdp(model).to_arrays()
    assert value(read_back(write_model(model))) == pytest.approx(value(arrays), abs=1e-9)


@pytest.mark.parametrize("seed", range(0, 60, 3))
def test_a_fully_observed_model_is_written_as_an_mdp(seed: int) -> None:
    model = random_model(seed, inapplicable=False, max_states=40)
    text = write_model(model)
    assert ("observations:" not in text) or model.states == 1
    arrays, back = enumerate_pomdp(model).to_arrays(), read_back(text)
    assert value(back) == pytest.approx(value(arrays), abs=1e-9)


@pytest.mark.parametrize("seed", range(0, 60, 2))
def test_a_quotient_keeps_the_value_of_its_model(seed: int, tmp_path: Path) -> None:
    model = random_pomdp(seed)
    if any(feature.observed for feature in model.features):
        model = foretold(model)
    quotient = reduce(flat_process(compile_model(model))).pomdp_quotient
    quotient.to_pomdp(tmp_path / "q.POMDP")
    back = read_back((tmp_path / "q.POMDP").read_text())
    arrays = enumerate_pomdp(model).to_arrays()
    assert value(back) == pytest.approx(value(arrays), abs=1e-9)


@pytest.mark.parametrize("seed", range(0, 60, 6))
def test_a_quotient_in_pomdpx_keeps_the_value_of_its_model(seed: int, tmp_path: Path) -> None:
    model = random_pomdp(seed)
    if any(feature.observed for feature in model.features):
        model = foretold(model)
    path = tmp_path / "q.pomdpx"
    reduce(flat_process(compile_model(model))).pomdp_quotient.to_pomdpx(path)
    back = enumerate_pomdp(files.read(path).model).to_arrays()
    assert value(back) == pytest.approx(value(enumerate_pomdp(model).to_arrays()), abs=1e-9)
    seen = random_model(seed, inapplicable=False, max_states=40)
    reduce(flat_process(compile_model(seen))).quotient.to_pomdpx(path)
    back = enumerate_pomdp(files.read(path).model).to_arrays()
    assert value(back) == pytest.approx(value(enumerate_pomdp(seen).to_arrays()), abs=1e-9)


@pytest.mark.parametrize("seed", range(0, 20, 2))
def test_a_quotient_of_an_mdp_keeps_the_value_of_its_model(seed: int, tmp_path: Path) -> None:
    model = random_model(seed, inapplicable=False, max_states=40)
    reduce(flat_process(compile_model(model))).quotient.to_pomdp(tmp_path / "q.pomdp")
    back = read_back((tmp_path / "q.pomdp").read_text())
    assert value(back) == pytest.approx(value(enumerate_pomdp(model).to_arrays()), abs=1e-9)


def worn() -> ArrayPOMDP:
    """Two states and an end; what is observed in the first depends on the state before."""
    quiet = [[0.5, 0.125, 0.125], [0.0, 0.5, 0.25], [0.0, 0.0, 0.0]]
    loud = [[0.125, 0.0, 0.125], [0.25, 0.0, 0.0], [0.0, 0.0, 0.0]]
    wait = [[0.75, 0.25, 0.0], [0.25, 0.75, 0.0], [0.0, 0.0, 0.0]]
    return array_pomdp(
        [[np.array(quiet), np.array(loud)], [np.array(wait)]],
        np.array([[1.0, -4.0, 0.0], [-0.5, 0.25, 0.0]]),
        np.array([0.5, 0.5, 0.0]),
        0.9,
        actions=["run", "wait"],
        observations=[["quiet", "loud"], ["quiet"]],
        terminal=np.array([False, False, True]),
    )


def test_a_state_is_split_only_where_its_observation_depends_on_the_one_before() -> None:
    arrays = factored(worn())
    assert arrays.origin.tolist() == [0, 0, 1, -1]
    assert arrays.symbol.tolist() == [0, 1, -1, -1]
    assert arrays.labels == ("quiet", "loud", "ended")
    assert arrays.initial.tolist() == [0.5, 0.0, 0.5, 0.0]
    assert arrays.observations is not None
    back = read_back(write_pomdp(worn()))
    assert back.states == 4
    for horizon in (1, 2, 3, 4):
        ours = forward_value(worn(), worn().initial, horizon)
        assert forward_value(back, back.initial, horizon) == pytest.approx(ours, abs=1e-9)


def test_solvers_find_the_same_value_with_terminal_states_and_with_an_absorbing_one() -> None:
    pomdp = worn()
    back = read_back(write_pomdp(pomdp))
    ours, theirs = solve_pomdp(pomdp, "exact"), solve_pomdp(back, "exact")
    assert ours.converged
    assert theirs.converged
    assert max(ours.lower, theirs.lower) <= min(ours.upper, theirs.upper) + 1e-9
    assert ours.upper - ours.lower < 1e-4
    staged, again = solve_pomdp(pomdp, horizon=4), solve_pomdp(back, horizon=4)
    assert staged.lower == pytest.approx(again.lower, abs=1e-9)


def seen_half(initial: Sequence[float]) -> ArrayPOMDP:
    """Four states, of which two classes are seen; the observation says nothing."""
    step = np.array([[0.5, 0.0, 0.5, 0.0], [0.0, 0.5, 0.0, 0.5], [0.25] * 4, [0.0, 0.25, 0.25, 0.5]])
    rewards = np.array([[1.0, -1.0, 0.0, 2.0], [0.0, 1.0, 1.0, -1.0]])
    return array_pomdp(
        [[step], [step[::-1]]], rewards, np.array(initial), 0.9, observed=np.array([0, 0, 1, 1])
    )


def test_what_is_seen_becomes_part_of_the_observation() -> None:
    pomdp = seen_half([0.5, 0.5, 0.0, 0.0])
    text = write_pomdp(pomdp)
    assert "observations: o0_seen0 o0_seen1" in text
    assert value(read_back(text)) == pytest.approx(value(pomdp), abs=1e-9)


def test_what_is_seen_at_the_start_must_be_foretold() -> None:
    with pytest.raises(ModelError, match=r"leaves open what is seen first.*--first-step"):
        write_pomdp(seen_half([0.5, 0.0, 0.5, 0.0]))


def test_a_first_step_shows_what_is_seen_at_the_start() -> None:
    pomdp = seen_half([0.5, 0.25, 0.125, 0.125])
    back = read_back(write_pomdp(pomdp, first_step=True))
    assert back.states == pomdp.states + 1
    for horizon in (1, 2, 3):
        ours = pomdp.discount * forward_value(pomdp, pomdp.initial, horizon)
        assert forward_value(back, back.initial, horizon + 1) == pytest.approx(ours, abs=1e-9)


@pytest.mark.parametrize("seed", range(0, 60, 2))
def test_a_quotient_with_any_start_is_written_with_a_first_step(seed: int) -> None:
    model = random_pomdp(seed)
    quotient = reduce(flat_process(compile_model(model))).pomdp_quotient
    back = read_back(quotient.to_pomdp_text(first_step=True))
    arrays = enumerate_pomdp(model).to_arrays()
    ours = arrays.discount * forward_value(arrays, arrays.initial, 2)
    assert forward_value(back, back.initial, 3) == pytest.approx(ours, abs=1e-9)


def test_names_that_the_format_lacks_are_replaced_and_told() -> None:
    pomdp = seen_half([0.5, 0.5, 0.0, 0.0])
    strange = ArrayPOMDP(
        ("T", "go left"), (("x=1, y",), ("x=1; y",)), pomdp.kernel, pomdp.rewards, pomdp.terminal,
        np.zeros(4, dtype=np.int64), pomdp.initial, pomdp.discount,
    )  # fmt: skip
    text = write_pomdp(strange, "a\nmodel")
    assert "# action go_left is go left" in text
    assert len({line for line in text.splitlines() if line.startswith("observations:")}) == 1
    assert value(read_back(text)) == pytest.approx(value(strange), abs=1e-9)


def test_files_are_written_by_extension_and_refuse_what_they_cannot_hold(tmp_path: Path) -> None:
    x = Feature("x", [0, 1, 2])
    model = random_pomdp(3)
    files.write(model, tmp_path / "m.POMDP")
    assert files.read(tmp_path / "m.POMDP").model.observability == "partial"
    large = Model("large", [Feature(f"x{i}", [0, 1]) for i in range(40)], random_pomdp(3).actions[:0])
    with pytest.raises(ModelError):
        files.write(large, tmp_path / "large.pomdp")
    with pytest.raises(ModelError):
        files.write(replace_fields(model, features=(x,)), tmp_path / "bad.pomdp")
    assert [path.name for path in tmp_path.iterdir()] == ["m.POMDP"]


def test_arrays_of_quotients_are_given_and_saved(tmp_path: Path) -> None:
    hidden = reduce(flat_process(compile_model(random_pomdp(5)))).pomdp_quotient
    seen = reduce(flat_process(compile_model(random_model(5, inapplicable=False)))).quotient
    dense, sparse = hidden.to_arrays(dense=True), hidden.to_arrays()
    live = ~hidden.pomdp.terminal
    assert dense["kernel"].sum(axis=(1, 3))[:, live] == pytest.approx(1.0)
    assert np.array_equal(sparse["kernel"][0][0].toarray(), dense["kernel"][0, 0])
    hidden.to_npz(tmp_path / "hidden.npz")
    seen.to_npz(tmp_path / "seen.npz")
    loaded = np.load(tmp_path / "hidden.npz")
    again = np.zeros_like(dense["kernel"])
    again[tuple(loaded["kernel_index"].T)] = loaded["kernel_value"]
    assert np.array_equal(again, dense["kernel"])
    assert loaded["actions"].tolist() == list(hidden.pomdp.actions)
    flat = np.load(tmp_path / "seen.npz")
    whole = np.zeros_like(seen.to_arrays(dense=True)["transitions"])
    whole[tuple(flat["transitions_index"].T)] = flat["transitions_value"]
    assert np.array_equal(whole, seen.to_arrays(dense=True)["transitions"])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hidden.npz", "seen.npz"]


def test_rows_of_rounded_floats_sum_to_exactly_one() -> None:
    text = write_pomdp(worn())
    rows: dict[str, Fraction] = {}
    for line in text.splitlines():
        if line.startswith(("T:", "O:")):
            *row, _, number = line.replace(":", " ").split()
            key = " ".join(row)
            rows[key] = rows.get(key, Fraction(0)) + Fraction(number)
    assert set(rows.values()) == {Fraction(1)}
