"""Flat models: the arrays of any model, over reachable states or all, against the slow reading."""

from __future__ import annotations

import numpy as np
import pytest
from random_models import random_model

from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.reachability import reachable_states
from factored_polca.minimisation.flat_model import FlatModel, flat_model
from factored_polca.models import Action, Feature, LimitReached, Model, Observation, boolean
from factored_polca.symbolic import compile_model


def assert_is(flat: FlatModel, model: Model, *, reachable: bool) -> None:
    """The arrays are those of the exact enumeration, restricted to reachable states."""
    exact = enumerate_model(model)
    kept = np.flatnonzero(reachable_states(exact)) if reachable else np.arange(exact.states)
    mdp, expected = flat.to_mdp(), exact.to_arrays()
    values = [[f.values[v] for f, v in zip(model.features, s, strict=True)] for s in flat.states.tolist()]
    assert values == [list(exact.state_values[s]) for s in kept]
    np.testing.assert_array_equal(mdp.applicable, expected.applicable[:, kept])
    np.testing.assert_array_equal(mdp.terminal, expected.terminal[kept])
    np.testing.assert_allclose(mdp.rewards, expected.rewards[:, kept], atol=1e-12)
    for matrix, other in zip(mdp.transitions, expected.transitions, strict=True):
        np.testing.assert_allclose(matrix.toarray(), other.toarray()[np.ix_(kept, kept)], atol=1e-12)
    initial = [float(exact.initial[s]) for s in kept]
    np.testing.assert_allclose(flat.pomdp.initial, initial, atol=1e-12)
    assert mdp.discount == float(model.discount)


@pytest.mark.parametrize("reachable", [True, False])
@pytest.mark.parametrize("seed", range(12))
def test_random_models_are_listed_rightly(seed: int, reachable: bool) -> None:
    model = random_model(seed, features=(2, 3), max_states=24)
    assert_is(flat_model(compile_model(model), reachable=reachable), model, reachable=reachable)


def fenced(applicable: str = "true") -> Model:
    """A counter that only grows, from 1 or 2; `jump` may not apply everywhere."""
    level = Feature("level", range(5))
    up = Action("up", {level: "level + 1 if level < 4 else 4"}, rewards="level")
    jump = Action("jump", {level: "4"}, applicable=applicable, rewards=3)
    return Model("fenced", [level], [up, jump], initial={level: "{1: 1/4, 2: 3/4}"}, terminal="level == 4")


@pytest.mark.parametrize("applicable", ["true", "level >= 2"])
def test_unreachable_states_are_left_out_where_actions_apply_everywhere_or_not(applicable: str) -> None:
    model = fenced(applicable)
    flat = flat_model(compile_model(model))
    assert flat.states.tolist() == [[1], [2], [3], [4]]
    assert flat.pomdp.initial.tolist() == [0.25, 0.75, 0, 0]
    assert flat.pomdp.observed.tolist() == [0, 1, 2, 3]
    assert flat.partial_action == (None if applicable == "true" else "jump")
    assert flat.fully_observed
    assert flat.state_text(1) == "level=2"
    assert_is(flat, model, reachable=True)
    assert flat_model(compile_model(model), reachable=False).pomdp.states == 5


def test_a_partially_observed_model_keeps_its_observations() -> None:
    hidden, seen = boolean("hidden"), Feature("seen", (0, 1), observed=True)
    look = Action("look", senses={"light": "hidden'"})
    model = Model(
        "half", [hidden, seen], [look], initial={seen: "1"}, observability="partial",
        observations=[Observation("light", (False, True, "none"))],
    )  # fmt: skip
    flat = flat_model(compile_model(model))
    assert not flat.fully_observed
    assert flat.states.tolist() == [[0, 1], [1, 1]]
    assert flat.pomdp.observations == (("light=false", "light=true"),)
    assert len(np.unique(flat.pomdp.observed)) == 1


def test_digests_tell_lists_of_states_apart() -> None:
    flats = [flat_model(compile_model(fenced()), reachable=r) for r in (True, False)]
    again = flat_model(compile_model(fenced()))
    assert flats[0].digest() == again.digest() != flats[1].digest()


@pytest.mark.parametrize("applicable", ["true", "f0 == 0"])
def test_too_many_states_are_a_limit(applicable: str) -> None:
    features = [Feature(f"f{i}", range(10)) for i in range(7)]
    actions = [Action("a", dict.fromkeys(features, "uniform(0, 1, 2, 3, 4, 5, 6, 7, 8, 9)"))]
    actions.append(Action("b", applicable=applicable))
    with pytest.raises(LimitReached, match="states"):
        flat_model(compile_model(Model("wide", features, actions)), reachable=applicable != "true")
