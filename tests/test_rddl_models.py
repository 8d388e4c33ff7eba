"""RDDL models against transition matrices that are written here by hand, entry by entry, in rationals."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from fractions import Fraction as F
from functools import cache

import pytest

pytest.importorskip("pyRDDLGym")

from rddl_texts import BOX, LIFE, LIFT, SERVERS, WALK

from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.formats.rddl import read_rddl_with_warnings
from factored_polca.models import Model
from factored_polca.models.expressions import references

State = Mapping[str, bool]
Chances = Callable[[State], Mapping[str, F]]


@cache
def read(text: str) -> Model:
    return read_rddl_with_warnings([text])[0]


def compare(model: Model, action: str, chances: Chances, reward: Callable[[State], F]) -> None:
    """Every entry of T and R of one action: next values are independent, with the given chances."""
    mdp = enumerate_model(model)
    number = mdp.actions.index(action)
    names = [feature.name for feature in model.features]
    states = list(itertools.product((False, True), repeat=len(names)))
    for s, values in enumerate(states):
        if mdp.terminal[s] or not mdp.applicable[number][s]:
            continue
        state = dict(zip(names, values, strict=True))
        expected = chances(state)
        assert set(expected) == set(names)
        for t, after in enumerate(states):
            product = F(1)
            for name, value in zip(names, after, strict=True):
                product *= expected[name] if value else 1 - expected[name]
            assert mdp.rows[number][s].get(t, F(0)) == product, (state, after)
        assert mdp.rewards[number][s] == reward(state), state


@pytest.mark.parametrize("restarted", [None, "s1", "s2", "s3"])
def test_servers(restarted: str | None) -> None:
    model = read(SERVERS)
    before = {"s1": "s3", "s2": "s1", "s3": "s2"}

    def chances(x: State) -> dict[str, F]:
        result = {}
        for s, t in before.items():
            if s == restarted:
                chance = F(1)
            elif x[f"up({s})"]:
                chance = 1 - F(1, 5) * (1 + (not x[f"up({t})"]))
            else:
                chance = F(1, 20)
            result[f"up({s})"] = chance
        return result

    name = "noop" if restarted is None else f"restart({restarted})"
    compare(model, name, chances, lambda x: sum(x.values()) - (F(3, 4) if restarted else F(0)))


def test_servers_have_minimal_parents_and_the_instance_s_numbers() -> None:
    model = read(SERVERS)
    assert [action.name for action in model.actions] == [
        "noop",
        "restart(s1)",
        "restart(s2)",
        "restart(s3)",
    ]
    effects = dict(model.action("restart(s1)").effects)
    assert {r.name for r in references(effects["up(s2)"])} == {"up(s1)", "up(s2)"}
    assert not references(effects["up(s1)"])
    assert (model.discount, model.horizon, model.observability) == (F(9, 10), 3, "full")
    assert dict(model.initial.distributions)["up(s2)"].value is False
    assert len(model.rewards) == 3  # one term a machine, not one over all


@pytest.mark.parametrize("chosen", [None, "a", "c"])
def test_life(chosen: str | None) -> None:
    model = read(LIFE)

    def chances(x: State) -> dict[str, F]:
        result = {}
        for c in "abcd":
            near = sum(x[f"alive({d})"] for d in "abcd" if d != c)
            lives = (x[f"alive({c})"] and near >= 2) or (not x[f"alive({c})"] and near == 3) or c == chosen
            noise = F(1, 20) if c == "c" else F(1, 10)
            result[f"alive({c})"] = 1 - noise if lives else noise
        return result

    name = "noop" if chosen is None else f"set({chosen})"
    compare(model, name, chances, lambda x: F(sum(x.values()) - (chosen is not None)))


@pytest.mark.parametrize("action", ["noop", "up", "down", "serve"])
def test_lift(action: str) -> None:
    model = read(LIFT)
    assert [a.name for a in model.actions] == ["noop", "up", "down", "serve"]  # not two at once
    call = [F(1, 10), F(0), F(3, 10)]

    def chances(x: State) -> dict[str, F]:
        at = [x[f"at(f{i})"] for i in range(3)]
        result = {}
        for i in range(3):
            stays = x[f"waiting(f{i})"] and not (at[i] and action == "serve")
            result[f"waiting(f{i})"] = F(1) if stays else call[i]
            if action == "up":
                there = (i > 0 and at[i - 1]) or (i == 2 and at[2])
            elif action == "down":
                there = (i < 2 and at[i + 1]) or (i == 0 and at[0])
            else:
                there = at[i]
            result[f"at(f{i})"] = F(there)
        return result

    moves = action in ("up", "down")
    compare(
        model, action, chances,
        lambda x: F(-sum(x[f"waiting(f{i})"] for i in range(3))) - (F(1, 4) if moves else 0),
    )  # fmt: skip


@pytest.mark.parametrize("action", ["noop", "go", "back"])
def test_walk(action: str) -> None:
    model = read(WALK)

    def chances(x: State) -> dict[str, F]:
        at = [x[f"robot(p{i})"] for i in (1, 2, 3)]
        target = {"noop": [False] * 3, "go": [False, at[0], at[1]], "back": [at[1], at[2], False]}[action]
        risk, result = [F(0), F(1, 4), F(0)], []
        for i in range(3):
            if target[i]:
                result.append(1 - risk[i])
            elif (action == "go" and at[i] and i < 2) or (action == "back" and at[i] and i > 0):
                result.append(F(0))
            else:
                result.append(F(at[i]))
        return {f"robot(p{i + 1})": chance for i, chance in enumerate(result)}

    compare(model, action, chances, lambda x: F(-1))
    mdp = enumerate_model(model)
    number = mdp.actions.index(action)
    for s, (first, _, goal) in enumerate(mdp.state_values):
        assert mdp.terminal[s] is goal
        allowed = not (action == "back" and first)
        assert mdp.applicable[number][s] is (allowed and not goal)


def test_box_is_seen_through_its_observations_after_the_action() -> None:
    model = read(BOX)
    assert model.observability == "partial"
    pomdp = enumerate_pomdp(model)
    names = [action.name for action in model.actions]
    assert names == ["noop", "shake", "empty"]
    for a, name in enumerate(names):
        for s in (0, 1):
            fills = F(0) if name == "empty" else F(1) if s else F(3, 10)
            for t in (0, 1):
                moved = fills if t else 1 - fills
                hears = (F(4, 5) if t else F(1, 5)) if name == "shake" else F(0)
                shaken = name == "shake"
                for heard in (False, True) if shaken else (False,):
                    said = hears if heard else 1 - hears
                    seen = pomdp.observations.index((heard, shaken))
                    assert pomdp.kernel[a][s].get((t, seen), F(0)) == moved * said
            reward = {"noop": F(0), "shake": F(-1, 2), "empty": F(5) if s else F(-3)}[name]
            assert pomdp.rewards[a][s] == reward
