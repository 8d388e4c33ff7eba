"""What is written in POMDPX: the model that our reader finds, and the arcs that `pomdpsol` allows."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree  # of texts that we wrote ourselves
from fractions import Fraction
from itertools import product
from pathlib import Path

import pytest
from random_models import random_model
from random_pomdps import random_pomdp

from factored_polca import library
from factored_polca.explicit.alpha_expansion import forward_value
from factored_polca.explicit.exact_pomdp import ExactPOMDP, enumerate_pomdp
from factored_polca.formats import files
from factored_polca.formats.pomdpx import read_pomdpx_with_warnings, write_pomdpx
from factored_polca.formats.pomdpx_columns import spell, with_memories, without_ends
from factored_polca.models import (
    Action,
    Feature,
    InitialBelief,
    Model,
    ModelError,
    Observation,
    Reference,
    conditional,
    lottery,
)
from factored_polca.models.model import replace_fields

F = Fraction
SEEDS = range(80)


def read_back(text: str) -> Model:
    """The model of a written text, which has no row that does not sum to exactly 1."""
    model, warnings = read_pomdpx_with_warnings(text, "back")
    assert not warnings
    return model


def same(model: Model, back: Model) -> None:
    """Compare exact enumerations state by state; rounded numbers within 1e-14."""
    clusters, names = spell(with_memories(without_ends(model)))
    columns = [column for cluster in clusters for column in cluster.columns]
    ours, theirs = enumerate_pomdp(model), enumerate_pomdp(back)
    assert [a.name for a in back.actions] == list(names.actions.values())
    place = [f.name for f in model.features]
    number = {values: k for k, values in enumerate(ours.state_values)}
    image: dict[int, int] = {}
    for k, values in enumerate(theirs.state_values):
        found: dict[str, object] = {}
        for column, label in zip(columns, values, strict=True):
            joint = column.joints[column.labels.index(str(label))]
            found |= dict(zip((f.name for f in column.members), joint, strict=True))
        image[k] = number[tuple(found[name] for name in place)]  # type: ignore[index]
    assert sorted(image.values()) == list(range(ours.states))
    label = {
        tuple(
            names.values[c.name][c.values.index(v)] for c, v in zip(model.observations, o, strict=True)
        ): k
        for k, o in enumerate(ours.observations)
    }
    # True == 1 == "1" do not meet in one channel of the random models
    compare(ours, theirs, image, label)


def compare(
    ours: ExactPOMDP, theirs: ExactPOMDP, image: dict[int, int], label: dict[tuple[str, ...], int]
) -> None:
    for a in range(len(ours.actions)):
        for s, row in enumerate(theirs.kernel[a]):
            origin = image[s]
            if ours.terminal[origin]:
                assert {t for t, _ in row} == {s}
                assert theirs.rewards[a][s] == 0
                continue
            mine: dict[tuple[int, int], Fraction] = {}
            for (t, o), chance in row.items():
                key = image[t], label.get(theirs.observations[o], -1)  # type: ignore[call-overload]
                if chance > F(1, 10**15):
                    mine[key] = chance
            assert set(mine) == set(ours.kernel[a][origin])
            for key, chance in mine.items():
                assert abs(chance - ours.kernel[a][origin][key]) < F(1, 10**14)
            assert abs(theirs.rewards[a][s] - ours.rewards[a][origin]) < F(1, 10**13)
    for s, chance in enumerate(theirs.initial):
        assert abs(chance - ours.initial[image[s]]) < F(1, 10**14)
    assert theirs.discount == ours.discount or abs(theirs.discount - ours.discount) < F(1, 10**16)
    seen = {(y, ours.observed[image[s]]) for s, y in enumerate(theirs.observed)}
    assert len(seen) == len({y for y, _ in seen}) == len({y for _, y in seen})


def legal(text: str) -> None:
    """Arcs are those that `pomdpsol` reads, each function is a table, each instance fits its parents."""
    root = ElementTree.fromstring(text)
    states = {s.get("vnameCurr", ""): s.get("fullyObs") == "true" for s in root.iter("StateVar")}
    seen = {s.get("vnamePrev", ""): s.get("fullyObs") == "true" for s in root.iter("StateVar")}
    before = set(seen)
    channels = {o.get("vname") for o in root.iter("ObsVar")}
    assert root.find("InitialStateBelief") is not None
    for section in ("InitialStateBelief", "StateTransitionFunction", "ObsFunction", "RewardFunction"):
        for function in root.findall(f"{section}/*"):
            about, parents = function.findtext("Var", ""), function.findtext("Parent", "").split()
            parameter = function.find("Parameter")
            assert parameter is not None
            assert parameter.get("type") == "TBL"
            if section == "InitialStateBelief":
                assert set(parents) <= before | {"null"}
                assert not seen[about] or all(seen.get(parent, True) for parent in parents)
            else:
                assert parents[0] not in before | set(states)
            if section == "StateTransitionFunction":
                assert not any(
                    parent in states and (states[about] or not states[parent]) for parent in parents
                )
            if section == "ObsFunction":
                assert about in channels
                assert not set(parents) & before
            own = 0 if section == "RewardFunction" else 1
            for entry in parameter:
                words = entry.findtext("Instance", "").split()
                assert len(words) == len([p for p in parents if p != "null"]) + own
            assert len(parameter)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_partially_observed_model_is_read_back_as_the_same(seed: int) -> None:
    model = random_pomdp(seed)
    text = write_pomdpx(model)
    legal(text)
    back = read_back(text)
    if with_memories(model) is model:
        same(model, back)
    ours, theirs = enumerate_pomdp(model).to_arrays(), enumerate_pomdp(back).to_arrays()
    value = forward_value(ours, ours.initial, 3)
    assert forward_value(theirs, theirs.initial, 3) == pytest.approx(value, abs=1e-9)


@pytest.mark.parametrize("seed", range(60))
def test_a_fully_observed_model_is_read_back_as_the_same(seed: int) -> None:
    model = random_model(seed, inapplicable=False, parameters=seed % 3 == 0, max_states=60)
    text = write_pomdpx(model)
    back = read_back(text)
    assert back.observability == "full"
    same(model, back)


LAMP = Feature("lamp", ["off", "on"])


def test_a_feature_that_stays_is_an_identity_and_a_number_without_end_is_rounded() -> None:
    model = Model("m", [LAMP, Feature("x", range(3))], [Action("go", {"x": "x"}), Action("rest")],
                  rewards=conditional(LAMP.is_("on"), "1/3", "-2"), discount="2/3")  # fmt: skip
    text = write_pomdpx(model)
    assert text.count("identity") == 2
    assert "<Instance>* - -</Instance>" in text
    assert "<ValueTable>0.33333333333333333</ValueTable>" in text
    assert "<Discount>0.66666666666666667</Discount>" in text
    same(model, read_back(text))


def test_a_table_is_as_small_as_the_decision_tree() -> None:
    bits = [Feature(f"x{k}", [0, 1]) for k in range(30)]
    first = " and ".join(f"x{k} == 1" for k in range(30))
    model = Model("m", bits, [Action("go", {"x0": f"1 if {first} else 0"})], rewards="x29")
    text = write_pomdpx(model)
    assert text.count("<Entry>") < 31 + 29 + 31 + 2
    assert read_back(text).states == 2**30


def test_linked_next_values_become_one_variable_observed_ones_apart() -> None:
    a, b, c = Feature("a", [0, 1], observed=True), Feature("b", [0, 1]), Feature("c", [0, 1])
    coin = lottery({0: F(1, 4), 1: F(3, 4)})
    step = Action("step", {b: coin, a: conditional(Reference("b", True).is_(1), coin, 0), c: "b'"})
    model = Model("m", [a, b, c], [step], rewards=Reference("c"), observability="partial")
    text = write_pomdpx(model)
    legal(text)
    assert 'vnamePrev="b.c_0" vnameCurr="b.c_1"' in text
    assert 'vnamePrev="a_0" vnameCurr="a_1" fullyObs="true"' in text
    same(model, read_back(text))


def test_an_observation_of_the_state_before_gets_a_variable_that_remembers() -> None:
    sensor = Observation("sensor", ["off", "on"], null="off")
    flip = Action("flip", {LAMP: conditional(LAMP.is_("on"), "off", "on")}, senses={"sensor": "lamp"})
    model = Model("m", [LAMP], [flip, Action("rest")], rewards=conditional(LAMP.is_("on"), 1, 0),
                  observability="partial", observations=[sensor])  # fmt: skip
    text = write_pomdpx(model)
    legal(text)
    assert 'vnameCurr="before_lamp_1"' in text
    ours, theirs = enumerate_pomdp(model).to_arrays(), enumerate_pomdp(read_back(text)).to_arrays()
    assert theirs.states == 4
    for horizon in (1, 2, 3, 4):
        value = forward_value(ours, ours.initial, horizon)
        assert forward_value(theirs, theirs.initial, horizon) == pytest.approx(value, abs=1e-12)


def test_names_that_the_format_lacks_are_replaced_and_told() -> None:
    x, y = Feature("a b", ["*", "-", "identity", "q<&>"]), Feature("a_b", [True, False])
    z = Feature("a_b_0", [-1, 0, 1])
    seen = Observation("a_b_1", ["null", "none"])
    model = Model("m --> <x>", [x, y, z], [Action("go & see", {z: "0"}, senses={"a_b_1": "none"})],
                  observability="partial", observations=[seen])  # fmt: skip
    text = write_pomdpx(model)
    legal(text)
    assert "go_see" in text.replace("___", "_")
    same(model, read_back(text))


def test_factors_of_the_initial_belief_become_conditional_chances() -> None:
    x, y, z = (Feature(name, [0, 1, 2]) for name in "xyz")
    weights = [F(1, 9) * (i != j) + F(1, 9) * (i == 0) * (j == 0) for i, j in product(range(3), repeat=2)]
    total = sum(weights)
    factor = conditional(x.now.is_(y.now), conditional(x.is_(0), F(1, 9) / total, 0), F(1, 9) / total)
    model = Model("m", [x, y, z], [Action("go")], initial=InitialBelief({"z": 1}, [factor]))
    same(model, read_back(write_pomdpx(model)))


@pytest.mark.parametrize(
    ("model", "told"),
    [
        (Model("m", [LAMP], [Action("go", applicable=LAMP.is_("on"))]), "applicable everywhere"),
        (Model("m", [Feature("x", range(3))], [Action("go", {"x": "x + 1"})]), "none of its values"),
        (Model("m", [Feature("x", range(3))], [Action("go")], rewards="1 / x"), "division by zero"),
        (Model("m", [LAMP], [Action("go", {"lamp": lottery({"on": "0.5"})})]), "sums to 0.5"),
        (Model("m", [LAMP], [Action("go", {"t": lottery({"on": 1})})]), "no feature"),
        (Model("m", [Feature(f"x{i}", [0, 1]) for i in range(40)], [Action("go")],
               rewards=" * ".join(f"(x{i} + {i + 2})" for i in range(40))), "too large"),
        (Model("m", [Feature(f"x{i}", range(9)) for i in range(6)],
               [Action("go", {f"x{i}": f"x{i - 1}'" for i in range(1, 6)})]), "would be one variable"),
    ],
)  # fmt: skip
def test_what_the_format_lacks_is_refused_with_the_reason(model: Model, told: str) -> None:
    with pytest.raises(ModelError) as caught:
        write_pomdpx(model)
    assert told in str(caught.value)


@pytest.mark.parametrize("name", ["tiger", "nursebot", "coffee", "toy", "hallway", "cheese"])
def test_shipped_domains_are_written_and_read_back(name: str, tmp_path: Path) -> None:
    model = library.load(name).model
    files.write(model, tmp_path / f"{name}.POMDPX")
    legal((tmp_path / f"{name}.POMDPX").read_text())
    assert files.read(tmp_path / f"{name}.POMDPX").model.observability == model.observability


def test_tasks_are_refused(tmp_path: Path) -> None:
    domain = library.load("toy")
    with pytest.raises(ModelError, match="can't hold tasks"):
        files.write(domain.model, tmp_path / "toy.pomdpx", domain.tasks)
    assert not list(tmp_path.iterdir())


def test_exact_numbers_survive() -> None:
    model = random_pomdp(7)
    again = read_back(write_pomdpx(read_back(write_pomdpx(model))))
    assert replace_fields(again, name="") == replace_fields(read_back(write_pomdpx(model)), name="")
