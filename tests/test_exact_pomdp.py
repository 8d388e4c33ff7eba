"""The exact POMDP of a model against hand-made examples and against its definition, entry by entry."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np
import pytest
from random_pomdps import random_pomdp

from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.evaluate import distribution, evaluate
from factored_polca.explicit.exact_pomdp import enumerate_pomdp, observation_label
from factored_polca.models import (
    Action,
    Constant,
    Feature,
    LimitReached,
    Model,
    ModelError,
    Observation,
    boolean,
    check,
)
from factored_polca.models.expressions import Reference, references
from factored_polca.models.scalars import scalar

F = Fraction
LEFT, RIGHT = 0, 1


def tiger() -> Model:
    """Kaelbling, Littman & Cassandra 1998, section 3.3: listening is right with probability 0.85."""
    place = Feature("tiger", ("left", "right"))
    growl = Observation("growl", ("left", "right", "none"))
    heard = "switch(tiger', left: {left: 0.85, right: 0.15}, right: {left: 0.15, right: 0.85})"
    anew = "{left: 1/2, right: 1/2}"
    return Model(
        "tiger",
        [place],
        [
            Action("listen", rewards=-1, senses={growl: heard}),
            Action("open_left", {place: anew}, rewards='-100 if tiger == "left" else 10'),
            Action("open_right", {place: anew}, rewards='-100 if tiger == "right" else 10'),
        ],
        observability="partial",
        observations=[growl],
    )


def test_the_tiger_problem_entry_by_entry() -> None:
    pomdp = enumerate_pomdp(tiger())
    assert pomdp.observations == (("left",), ("right",), ("none",))
    assert pomdp.observations_of == ((0, 1), (2,), (2,))
    near, far, half = F(85, 100), F(15, 100), F(1, 2)
    listen = ({(LEFT, 0): near, (LEFT, 1): far}, {(RIGHT, 0): far, (RIGHT, 1): near})
    opened = ({(LEFT, 2): half, (RIGHT, 2): half},) * 2
    assert pomdp.kernel == (listen, opened, opened)
    assert pomdp.rewards == ((-1, -1), (-100, 10), (10, -100))
    assert pomdp.initial == (half, half)
    assert pomdp.observed == (0, 0)
    assert (pomdp.terminal, pomdp.discount, pomdp.horizon) == ((False, False), F(95, 100), None)
    arrays = pomdp.to_arrays()
    assert arrays.observations == (("growl=left", "growl=right"), ("growl=none",), ("growl=none",))
    assert arrays.kernel[0][1].toarray().tolist() == [[0.15, 0], [0, 0.85]]
    assert arrays.kernel[2][0].toarray().tolist() == [[0.5, 0.5], [0.5, 0.5]]
    assert arrays.rewards.tolist() == [[-1, -1], [-100, 10], [10, -100]]


def test_observations_follow_the_action_and_may_read_both_states() -> None:
    model = Model(
        "flip",
        [boolean("x")],
        [Action("flip", {"x": "not x"}, senses={"after": "x'", "changed": "x != x'"})],
        observability="partial",
        observations=[Observation("after", (False, True)), Observation("changed", (True, False))],
    )
    pomdp = enumerate_pomdp(model)
    assert pomdp.observations == ((False, True), (True, True))
    assert pomdp.kernel == (({(1, 1): F(1)}, {(0, 0): F(1)}),)
    labels = pomdp.to_arrays().observations
    assert labels == (("after=false, changed=true", "after=true, changed=true"),)


def test_rewards_are_expected_over_next_states_and_observations() -> None:
    model = Model(
        "paid",
        [boolean("x")],
        [
            Action("guess", {"x": "bernoulli(0.3)"}, senses={"o": "{0: 0.1, 2: 0.9} if x' else 1"}),
            Action("wait", rewards="100 if o == 2 else 0"),
        ],
        rewards="o + 10 if x' else o",
        observability="partial",
        observations=[Observation("o", range(3), null=2)],
    )
    # guess: 0.3 * (10 + 0.9 * 2) + 0.7 * 1; wait, which does not sense: 2 + 100, and 10 where x holds.
    assert enumerate_pomdp(model).rewards == ((F("4.24"), F("4.24")), (F(102), F(112)))


def test_a_model_without_channels_is_blind() -> None:
    model = Model("blind", [boolean("x")], [Action("flip", {"x": "not x"})], observability="partial")
    pomdp = enumerate_pomdp(model)
    assert pomdp.observations == ((),)
    assert pomdp.kernel == (({(1, 0): F(1)}, {(0, 0): F(1)}),)
    assert pomdp.observed == (0, 0)
    assert pomdp.to_arrays().observations == (("nothing",),)


def test_a_fully_observed_model_tells_all_states_apart() -> None:
    model = Model("seen", [Feature("x", range(3))], [Action("up", {"x": "min(x + 1, 2)"})])
    pomdp = enumerate_pomdp(model)
    assert pomdp.observed == (0, 1, 2)
    assert pomdp.observations == ((),)
    assert pomdp.kernel == (({(1, 0): F(1)}, {(2, 0): F(1)}, {(2, 0): F(1)}),)


def test_observed_features_number_what_is_seen() -> None:
    features = [Feature("x", range(2), observed=True), boolean("y"), Feature("z", range(3), observed=True)]
    pomdp = enumerate_pomdp(Model("mixed", features, [Action("wait")], observability="partial"))
    assert pomdp.observed == (0, 1, 2, 0, 1, 2, 3, 4, 5, 3, 4, 5)


def test_terminal_states_have_no_rows_and_no_rewards() -> None:
    model = Model(
        "ends",
        [Feature("x", range(2))],
        [
            Action(
                "go",
                {"x": 1},
                senses={"o": "{0: 1 - x, 1: x} if x' == 1 else 1 / 0"},
                rewards="1 / (1 - x)",
            )
        ],
        terminal="x == 1",
        observability="partial",
        observations=[Observation("o", range(2))],
    )
    pomdp = enumerate_pomdp(model)
    assert pomdp.kernel == (({(1, 0): F(1)}, {}),)
    assert pomdp.rewards == ((F(1), F(0)),)
    assert pomdp.observations == ((0,),)  # o=1 never occurs


def test_a_model_that_has_ended_everywhere_still_has_an_observation() -> None:
    channels = [Observation("o", (5, 6, "none"))]
    model = Model(
        "over", [boolean("x")], [Action("wait")], terminal="true", observability="partial",
        observations=channels,
    )  # fmt: skip
    arrays = enumerate_pomdp(model).to_arrays()
    assert arrays.observations == (("o=5",),)
    assert arrays.kernel[0][0].nnz == 0
    assert arrays.terminal.all()


def test_labels_name_each_channel() -> None:
    channels = [Observation("ear", (True, False)), Observation("hum", (0, 1)), Observation("eye", ("a",))]
    assert observation_label(channels, (True, 1, "a")) == "ear=true, hum=1, eye=a"
    assert observation_label([], ()) == "nothing"


# -- against the definition ------------------------------------------------------------------------


def _chance(model: Model, given: Mapping[str, Any], name: str, values: Any, x: Any, value: Any) -> Fraction:
    """The probability that `given` says for one value of a variable; its default is a plain value."""
    row = distribution(given[name], values, x, dict(model.parameters))
    assert isinstance(row, tuple), row
    return row[[repr(v) for v in values].index(repr(value))]


def _definition(
    model: Model, action: Action, before: Any, after: Any
) -> tuple[Fraction, dict[Any, Fraction]]:
    """T(x, a, x') and P(o | x', x) for each joint value o of the channels."""
    names = [f.name for f in model.features]
    x = dict(zip([(n, False) for n in names], before, strict=True))
    x |= dict(zip([(n, True) for n in names], after, strict=True))
    effects = {n: Reference(n) for n in names} | dict(action.effects)
    moved = F(1)
    for f, value in sorted(zip(model.features, after, strict=True), key=lambda pair: pair[0].name):
        if any(r.primed for r in references(effects[f.name])) and not _parents_happen(model, effects, f, x):
            return F(0), {}
        moved *= _chance(model, effects, f.name, f.values, x, value)
    senses = {c.name: Constant(scalar(c.null)) for c in model.observations} | dict(action.senses)
    joint = {}
    for o in product(*(c.values for c in model.observations)) if moved else ():
        shares = [
            _chance(model, senses, c.name, c.values, x, v)
            for c, v in zip(model.observations, o, strict=True)
        ]
        joint[tuple(map(repr, o))] = np.prod(shares, initial=F(1))
    return moved, joint


def _parents_happen(model: Model, effects: Any, feature: Feature, x: Any) -> bool:
    """Whether the synchronic parents have the values in x' with positive probability."""
    parents = {r.name for r in references(effects[feature.name]) if r.primed}
    return all(
        _parents_happen(model, effects, f, x)
        and _chance(model, effects, f.name, f.values, x, x[f.name, True]) > 0
        for f in model.features
        if f.name in parents
    )


@pytest.mark.parametrize("seed", range(50))
def test_kernel_and_rewards_are_what_the_definition_says(seed: int) -> None:
    model = random_pomdp(seed, max_states=8)
    pomdp = enumerate_pomdp(model)
    parameters = dict(model.parameters)
    found = [tuple(map(repr, o)) for o in pomdp.observations]
    for a, action in enumerate(model.actions):
        for s, before in enumerate(pomdp.state_values):
            row, reward = {}, F(0)
            for t, after in enumerate(pomdp.state_values if not pomdp.terminal[s] else ()):
                moved, joint = _definition(model, action, before, after)
                for o, share in joint.items():
                    if not moved * share:
                        continue
                    row[t, found.index(o)] = moved * share
                    x: dict[Any, Any] = {}
                    for f, now, then in zip(model.features, before, after, strict=True):
                        x |= {(f.name, False): now, (f.name, True): then}
                    x |= {
                        (c.name, False): next(v for v in c.values if repr(v) == shown)
                        for c, shown in zip(model.observations, o, strict=True)
                    }
                    for term in (*model.rewards, *action.rewards):
                        value = evaluate(term, x, parameters)
                        reward += moved * share * value  # type: ignore[operator]
            assert pomdp.kernel[a][s] == row, (seed, a, s)
            assert pomdp.rewards[a][s] == reward, (seed, a, s)
        occurring = {o for row in pomdp.kernel[a] for _, o in row}
        assert not occurring or pomdp.observations_of[a] == tuple(sorted(occurring))


@pytest.mark.parametrize("seed", range(0, 60, 3))
def test_summing_the_observations_out_leaves_the_enumerated_mdp(seed: int) -> None:
    model = random_pomdp(seed)
    pomdp, mdp = enumerate_pomdp(model), enumerate_model(model)
    for rows, plain in zip(pomdp.kernel, mdp.rows, strict=True):
        for row, expected in zip(rows, plain, strict=True):
            total: dict[int, Fraction] = {}
            for (t, _), chance in row.items():
                total[t] = total.get(t, F(0)) + chance
            assert total == expected
    assert (pomdp.rewards, pomdp.initial, pomdp.terminal) == (mdp.rewards, mdp.initial, mdp.terminal)


def test_random_pomdps_are_sound_varied_and_deterministic() -> None:
    kinds = dict.fromkeys(
        ("terminal", "observed", "paid", "several channels", "unsensed", "now", "synchronic", "null"), 0
    )
    for seed in range(60):
        model = random_pomdp(seed)
        assert model == random_pomdp(seed)
        assert check(model) == []
        assert model.states <= 12
        names = {channel.name for channel in model.observations}
        terms = [*model.rewards, *(term for action in model.actions for term in action.rewards)]
        sensed = [e for action in model.actions for _, e in action.senses]
        kinds["terminal"] += any(enumerate_pomdp(model).terminal)
        kinds["observed"] += any(feature.observed for feature in model.features)
        kinds["paid"] += any(r.name in names for r in references(*terms))
        kinds["several channels"] += len(names) > 1
        kinds["unsensed"] += any(len(action.senses) < len(names) for action in model.actions)
        kinds["now"] += any(not r.primed for r in references(*sensed))
        effects = [e for action in model.actions for _, e in action.effects]
        kinds["synchronic"] += any(r.primed for r in references(*effects))
        kinds["null"] += any(channel.null != "none" for channel in model.observations)
    assert all(count >= 8 for count in kinds.values()), kinds
    blind = random_pomdp(1, channels=(0, 0))
    assert enumerate_pomdp(blind).observations == ((),)


# -- refusals (faults inside a model: see test_unreduced.py, for both readings) ----------------------


def test_an_action_that_does_not_apply_everywhere_is_refused() -> None:
    x = Feature("x", range(2))
    model = Model("partly", [x], [Action("up", {x: 1}, applicable="x == 0"), Action("wait")])
    with pytest.raises(
        ModelError, match="'up' does not apply; in a POMDP actions apply everywhere, at x=1"
    ):
        enumerate_pomdp(model)
    ended = Model("ended", [x], [Action("up", {x: 1}, applicable="x == 0")], terminal="x == 1")
    assert enumerate_pomdp(ended).kernel == (({(1, 0): F(1)}, {}),)


def test_too_many_states_reach_a_limit() -> None:
    with pytest.raises(LimitReached, match="2 states are more than the 1"):
        enumerate_pomdp(tiger(), maximum_states=1)
