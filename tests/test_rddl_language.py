"""What RDDL can say, one thing at a time: the law of one fluent over all states, written by hand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from fractions import Fraction as F
from functools import cache
from typing import Any

import pytest

pytest.importorskip("pyRDDLGym")

from rddl_in_process import run
from rddl_texts import rddl

from factored_polca.explicit.evaluate import distribution, evaluate
from factored_polca.formats import rddl_process
from factored_polca.formats.rddl import read_rddl_with_warnings
from factored_polca.models import Model, check
from factored_polca.models.expressions import TRUE, Reference, references

A = "a : { action-fluent, bool, default = false };"
XY = "x : { state-fluent, bool, default = false }; y : { state-fluent, bool, default = true };"
KEEP = "y' = KronDelta(y);"
COLOURS = "colour : { @red, @green, @blue };"

Law = Callable[[Mapping[str, Any]], Mapping[Any, F]]


@pytest.fixture(autouse=True)
def _parsed_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rddl_process, "_run", run)


def read(text: str) -> Model:
    model = read_rddl_with_warnings([text])[0]
    assert check(model) == []
    return model


def laws(model: Model, action: str, feature: str, expected: Law, *, following: bool = False) -> None:
    """The law of a feature, or channel, at all values of all features, now and, if asked for, next."""
    chosen = model.action(action)
    variables = {v.name: v.values for v in (*model.features, *model.observations)}
    expression = (dict(chosen.effects) | dict(chosen.senses)).get(feature, Reference(feature))
    names = [(f.name, primed) for f in model.features for primed in (False, True)[: 1 + following]]
    for values in itertools.product(*(variables[name] for name, _ in names)):
        assignment = dict(zip(names, values, strict=True))
        row = distribution(expression, variables[feature], assignment)
        assert isinstance(row, tuple), (row, assignment)
        state = {name + "'" * primed: value for (name, primed), value in assignment.items()}
        wanted = expected(state)
        found = {v: q for v, q in zip(variables[feature], row, strict=True) if q}
        assert found == {v: q for v, q in wanted.items() if q}, state


def coin(chance: F | int | bool) -> dict[bool, F]:
    return {True: F(chance), False: 1 - F(chance)}


BOOLEANS: list[tuple[str, Callable[[Mapping[str, Any]], Any]]] = [
    ("Bernoulli(0.1)", lambda s: F(1, 10)),
    ("Bernoulli(0.1234567890123456789012345)", lambda s: F(1234567890123456789012345, 10**25)),
    ("Bernoulli(.5)", lambda s: F(1, 2)),
    ("KronDelta(x ^ ~y)", lambda s: s["x"] and not s["y"]),
    ("KronDelta(x & y | ~x)", lambda s: (s["x"] and s["y"]) or not s["x"]),
    ("KronDelta(x => y)", lambda s: not s["x"] or s["y"]),
    ("KronDelta(x <=> y)", lambda s: s["x"] == s["y"]),
    ("KronDelta(x == y)", lambda s: s["x"] == s["y"]),
    ("KronDelta(x ~= y)", lambda s: s["x"] != s["y"]),
    ("KronDelta((x + y) >= 1)", lambda s: s["x"] + s["y"] >= 1),
    ("KronDelta((x + y) < 1)", lambda s: s["x"] + s["y"] < 1),
    ("KronDelta((x - y) > 0)", lambda s: s["x"] - s["y"] > 0),
    ("KronDelta((1 - x - y + 1 - 1 + 2 * x - (y - x)) == 2)", lambda s: 1 + 2 * s["x"] - 2 * s["y"] == 2),
    ("KronDelta((" + "x - y + " * 200 + "1) > 0)", lambda s: s["x"] >= s["y"]),
    ("KronDelta(-x <= -1)", lambda s: s["x"]),
    ("KronDelta(x)", lambda s: s["x"]),
    ("x", lambda s: s["x"]),
    ("true", lambda s: True),
    ("KronDelta(if (x) then 1 else 0)", lambda s: s["x"]),
    ("if (x) then Bernoulli(0.25) else if (y) then Bernoulli(0.75) else false",
     lambda s: F(1, 4) if s["x"] else F(3, 4) * s["y"]),
    ("Bernoulli(if (x) then 0.25 else 0.5)", lambda s: F(1, 4) if s["x"] else F(1, 2)),
    ("Bernoulli([1 + x] / [4 - y])", lambda s: F(1 + s["x"], 4 - s["y"])),
    ("Bernoulli(0.5 * x * y)", lambda s: F(1, 2) * s["x"] * s["y"]),
    # draws inside of other operators: each is a draw of its own
    ("~Bernoulli(0.1)", lambda s: F(9, 10)),
    ("x ^ Bernoulli(0.1)", lambda s: F(1, 10) * s["x"]),
    ("Bernoulli(0.1) ^ Bernoulli(0.1)", lambda s: F(1, 100)),
    ("Bernoulli(0.1) | Bernoulli(0.1) | x", lambda s: 1 if s["x"] else F(19, 100)),
    ("Bernoulli(0.1) <=> Bernoulli(0.1)", lambda s: F(82, 100)),
    ("Bernoulli(0.1) => Bernoulli(0.2)", lambda s: F(9, 10) + F(1, 10) * F(1, 5)),
    ("if (Bernoulli(0.1)) then x else Bernoulli(0.5)", lambda s: F(s["x"], 10) + F(9, 20)),
    ("(Bernoulli(0.1) + Bernoulli(0.1) + x) >= 2", lambda s: F(19, 100) if s["x"] else F(1, 100)),
    ("(max[Bernoulli(0.1), 2 * Bernoulli(0.5), x]) == 1",
     lambda s: F(1, 2) if s["x"] else F(1, 20)),
    ("if (x == y) then Bernoulli(0.1) else Bernoulli(0.2)",
     lambda s: F(1, 10) if s["x"] == s["y"] else F(1, 5)),
]  # fmt: skip
"""Definitions of a Boolean, and the chance that it is true."""


@cache
def booleans() -> Model:
    """A fluent for each definition of `BOOLEANS`."""
    fluents = "".join(f"z{i} : {{ state-fluent, bool, default = false }};" for i in range(len(BOOLEANS)))
    cpfs = "".join(f"z{i}' = {text};" for i, (text, _) in enumerate(BOOLEANS))
    return read(rddl(XY + A + fluents, f"x' = x; {KEEP} {cpfs}"))


@pytest.mark.parametrize("number", range(len(BOOLEANS)), ids=[text for text, _ in BOOLEANS])
def test_the_law_of_a_boolean(number: int) -> None:
    model = booleans()
    effect = dict(model.action("a").effects)[f"z{number}"]
    for x, y in itertools.product((False, True), repeat=2):
        row = distribution(effect, (False, True), {("x", False): x, ("y", False): y})
        assert isinstance(row, tuple)
        assert row[1] == BOOLEANS[number][1]({"x": x, "y": y})


EXACT = [
    ("abs[-1.5]", "1.5"), ("sgn[-7]", "-1"), ("sgn[0]", "0"), ("round[2.5]", "2"), ("round[3.5]", "4"),
    ("round[-0.4]", "0"), ("floor[-1.5]", "-2"), ("ceil[1.2]", "2"), ("div[7, 2]", "3"),
    ("mod[-7, 3]", "2"),
    ("fmod[-7, 3]", "-1"), ("min[2, 3]", "2"), ("max[2, 3, 1]", "3"), ("pow[2, 10]", "1024"),
    ("pow[4, 0.5]", "2"), ("pow[2, -2]", "0.25"), ("sqrt[2.25]", "1.5"), ("ln[1]", "0"), ("exp[0]", "1"),
    ("log[8, 2]", "3"), ("log[0.25, 2]", "-2"),
]  # fmt: skip
IRRATIONAL = [
    ("exp[-1]", 1 / math.e), ("ln[2]", math.log(2)), ("sqrt[0.5]", 0.5**0.5), ("log[2, 3]", math.log(2, 3)),
    ("pow[0.5, 0.3]", 0.5**0.3),
]  # fmt: skip


def test_functions_of_rational_value_are_exact_and_others_are_rounded_aloud() -> None:
    laws = [f"KronDelta({text} == {value})" for text, value in EXACT]
    laws += [f"Bernoulli({text})" for text, _ in IRRATIONAL]
    fluents = "".join(f"z{i} : {{ state-fluent, bool, default = false }};" for i in range(len(laws)))
    cpfs = "".join(f"z{i}' = {law};" for i, law in enumerate(laws))
    model, warnings, _ = read_rddl_with_warnings([rddl(A + fluents, cpfs)])
    effects = [effect for _, effect in model.action("noop").effects]
    wrong = [pair for pair, effect in zip(EXACT, effects, strict=False) if effect != TRUE]
    assert wrong == []
    for (text, value), effect in zip(IRRATIONAL, effects[len(EXACT) :], strict=True):
        row = distribution(effect, (False, True), {})
        assert isinstance(row, tuple)
        assert float(row[1]) == pytest.approx(value, rel=1e-15), text
        assert len(str(row[1].numerator)) <= 20, text  # digits, then zeros
    assert [str(w) for w in warnings] == [
        "values of exp, ln, log, pow, sqrt are irrational: they are rounded to 20 significant digits"
    ]


def test_a_function_of_fluents_is_written_for_each_value() -> None:
    things = "p(t) : { state-fluent, bool, default = false };"
    cpfs = "p'(?t) = Bernoulli(1 / (1 + exp[2.5 - sum_{?u : t} p(?u)]));"
    model = read(rddl(things + A, cpfs, types="t : object;", objects="t : { t1, t2, t3 };"))
    effect = dict(model.action("noop").effects)["p(t1)"]
    for count in range(4):
        state = {(f"p(t{i})", False): i <= count for i in (1, 2, 3)}
        row = distribution(effect, (False, True), state)
        assert isinstance(row, tuple)
        assert float(row[1]) == pytest.approx(1 / (1 + math.exp(2.5 - count)), rel=1e-15)


GRID = "n(t) : { non-fluent, real, default = 0.5 }; p(t) : { state-fluent, bool, default = false };"


QUANTIFIED: list[tuple[str, Callable[[list[bool]], Any]]] = [
    ("KronDelta(forall_{?u : t} p(?u))", lambda p: all(p)),
    ("KronDelta(exists_{?u : t} p(?u))", lambda p: any(p)),
    ("KronDelta(forall_{?u : t} [(?u ~= @t1) => p(?u)])", lambda p: p[1] and p[2]),
    ("KronDelta(exists_{?u : t, ?v : t} [(?u ~= ?v) ^ p(?u) ^ p(?v)])", lambda p: sum(p) >= 2),
    ("KronDelta((sum_{?u : t} p(?u)) == 2)", lambda p: sum(p) == 2),
    ("Bernoulli(prod_{?u : t} [1 - n(?u) * p(?u)])",
     lambda p: F(1, 4) ** p[1] * F(1, 2) ** (p[0] + p[2])),
    ("Bernoulli(min_{?u : t} [1 - n(?u) * p(?u)])",
     lambda p: min(1 - F(1, 2) * p[0], 1 - F(3, 4) * p[1], 1 - F(1, 2) * p[2])),
    ("Bernoulli(max_{?u : t} [n(?u) * p(?u)])",
     lambda p: max(F(1, 2) * p[0], F(3, 4) * p[1], F(1, 2) * p[2])),
    ("Bernoulli(avg_{?u : t} p(?u))", lambda p: F(sum(p), 3)),
    ("exists_{?u : t} [p(?u) ^ Bernoulli(n(?u))]",
     lambda p: 1 - F(1, 2) ** (p[0] + p[2]) * F(1, 4) ** p[1]),
    ("KronDelta(@t1 == @t1 | p(@t2))", lambda p: True),
    ("KronDelta(n(@t1) < 0.6 ^ p(@t1))", lambda p: p[0]),
]  # fmt: skip
"""Definitions, and the chance of true given p(t1), p(t2) and p(t3)."""


def test_quantifiers() -> None:
    fluents = "".join(f"z{i} : {{ state-fluent, bool, default = false }};" for i in range(len(QUANTIFIED)))
    cpfs = "".join(f"z{i}' = {text};" for i, (text, _) in enumerate(QUANTIFIED))
    things = {"types": "t : object;", "objects": "t : { t1, t2, t3 };", "values": "n(t2) = 0.75;"}
    model = read(rddl(GRID + A + fluents, f"p'(?t) = p(?t); {cpfs}", **things))
    effects = dict(model.action("noop").effects)
    for p in itertools.product((False, True), repeat=3):
        state = {(f"p(t{i + 1})", False): value for i, value in enumerate(p)}
        for number, (text, chance) in enumerate(QUANTIFIED):
            row = distribution(effects[f"z{number}"], (False, True), state)
            assert isinstance(row, tuple)
            assert row[1] == chance(list(p)), text


def test_non_fluents_are_folded_before_parents_are_counted() -> None:
    links = "LINK(t, t) : { non-fluent, bool, default = false };"
    model = read(
        rddl(links + "p(t) : { state-fluent, bool, default = false };" + A,
             "p'(?t) = KronDelta(exists_{?u : t} [p(?u) ^ LINK(?u, ?t)]);",
             types="t : object;", objects="t : { t1, t2, t3, t4 };", values="LINK(t2, t1); LINK(t4, t1);")
    )  # fmt: skip
    effects = dict(model.action("noop").effects)
    assert {r.name for r in references(effects["p(t1)"])} == {"p(t2)", "p(t4)"}
    assert not references(effects["p(t3)"])


def test_enumerated_fluents_switch_and_discrete() -> None:
    fluents = (
        "c : { state-fluent, colour, default = @red }; paint : { action-fluent, colour, default = @red };"
        "MIX : { non-fluent, real, default = 0.2 };"
    )
    cpfs = """c' = if (paint ~= @red) then paint
        else switch (c) {
            case @red : Discrete(colour, @red : 1 - MIX, @green : MIX / 2, @blue : MIX / 2),
            case @green : UnnormDiscrete(colour, @red : 1, @green : 2, @blue : 5),
            case @blue : KronDelta(@blue) };"""
    reward = "switch (c) { case @red : 1, default : if (c == @blue) then 2 else 0 }"
    model = read(rddl(fluents, cpfs, reward, types=COLOURS))
    assert model.features[0].values == ("red", "green", "blue")
    assert [action.name for action in model.actions] == ["noop", "paint=green", "paint=blue"]
    rows = {
        "red": {"red": F(8, 10), "green": F(1, 10), "blue": F(1, 10)},
        "green": {"red": F(1, 8), "green": F(2, 8), "blue": F(5, 8)},
        "blue": {"blue": F(1)},
    }
    laws(model, "noop", "c", lambda s: rows[s["c"]])
    laws(model, "paint=green", "c", lambda s: {"green": F(1)})
    rewards = {"red": 1, "green": 0, "blue": 2}
    for colour, value in rewards.items():
        assert sum(F(evaluate(term, {("c", False): colour})) for term in model.rewards) == value


def test_a_discrete_over_a_type_and_objects_as_values() -> None:
    fluents = """W(place) : { non-fluent, real, default = 1.0 };
        where : { state-fluent, place, default = @home };
        last : { state-fluent, place, default = @home };"""
    cpfs = """where' = UnnormDiscrete_{?p : place} [W(?p) + (?p == where)];
        last' = if (where == @shop) then @shop else where;"""
    model = read(rddl(fluents + A, cpfs, types="place : object;", objects="place : { home, shop, park };",
                      values="W(shop) = 2.0;"))  # fmt: skip
    weights = {"home": 1, "shop": 2, "park": 1}
    laws(model, "noop", "where",
         lambda s: {p: F(w + (p == s["where"]), 5) for p, w in weights.items()})  # fmt: skip
    laws(model, "noop", "last", lambda s: {s["where"]: F(1)})


def test_up_to_two_action_fluents_at_once() -> None:
    fluents = (
        "p(t) : { state-fluent, bool, default = false }; put(t) : { action-fluent, bool, default = false };"
    )
    sections = "action-preconditions { forall_{?t : t} [put(?t) => ~p(?t)]; ~(put(@t1) ^ put(@t2)); };"
    model = read(rddl(fluents, "p'(?t) = p(?t) | put(?t);", "-(sum_{?t : t} put(?t))", types="t : object;",
                      objects="t : { t1, t2, t3 };", concurrent="2", sections=sections))  # fmt: skip
    pairs = ["put(t1) + put(t3)", "put(t2) + put(t3)"]
    assert [a.name for a in model.actions] == ["noop", "put(t1)", "put(t2)", "put(t3)", *pairs]
    action = model.action(pairs[1])
    for values in itertools.product((False, True), repeat=3):
        state = {(f"p(t{i + 1})", False): value for i, value in enumerate(values)}
        assert evaluate(action.applicable, state) is not (values[1] or values[2])
    assert [F(evaluate(term, {})) for term in (*model.rewards, *action.rewards)] == [-1, -1]
    assert [name for name, _ in action.effects] == ["p(t2)", "p(t3)"]


def test_a_default_of_true_and_mixed_action_fluents() -> None:
    fluents = """hold : { action-fluent, bool, default = true }; n : { action-fluent, int, default = 0 };
        x : { state-fluent, bool, default = false };"""
    sections = "action-preconditions { n >= -1; n <= 2; n ~= 1; (hold + (n ~= 0)) >= 1; };"
    model = read(rddl(fluents, "x' = KronDelta(hold ^ (n > 0));", "n", concurrent="", sections=sections))
    names = ["noop", "n=-1", "n=2", "~hold + n=-1", "~hold + n=2"]  # ~hold alone is not allowed
    assert [action.name for action in model.actions] == names
    for name, chance in (("noop", 0), ("n=2", 1), ("~hold + n=2", 0), ("n=-1", 0)):
        laws(model, name, "x", lambda s, chance=chance: coin(chance))


def test_interm_and_derived_fluents() -> None:
    fluents = """p(t) : { state-fluent, bool, default = false };
        hit : { state-fluent, bool, default = false };
        some : { derived-fluent, bool, level = 1 };
        load : { interm-fluent, real, level = 1 };
        shock : { interm-fluent, bool, level = 2 };
        unused : { interm-fluent, bool, level = 2 };"""
    cpfs = """p'(?t) = if (shock) then Bernoulli(0.5) else p(?t);
        hit' = KronDelta(shock ^ ~a);
        some = exists_{?t : t} p(?t);
        load = (sum_{?t : t} p(?t)) / 4;
        shock = if (some) then Bernoulli(load) else KronDelta(false);
        unused = Bernoulli(0.5);"""
    model = read(rddl(fluents + A, cpfs, "-shock", types="t : object;", objects="t : { t1, t2 };"))
    assert [feature.name for feature in model.features] == ["p(t1)", "p(t2)", "hit", "shock"]
    laws(model, "noop", "shock", lambda s: coin(F(s["p(t1)"] + s["p(t2)"], 4)))
    laws(model, "noop", "p(t1)", lambda s: coin(F(1, 2) if s["shock'"] else s["p(t1)"]), following=True)
    laws(model, "noop", "hit", lambda s: coin(s["shock'"]), following=True)
    laws(model, "a", "hit", lambda s: coin(0), following=True)
    (reward,) = model.rewards
    assert references(reward) == {Reference("shock", primed=True)}


def test_a_drawn_integer_between_two_states() -> None:
    fluents = "k : { state-fluent, int, default = 0 }; step : { interm-fluent, int, level = 1 };"
    cpfs = "k' = min[2, k + step]; step = if (a) then 2 * Bernoulli(0.25) else 0;"
    model = read(rddl(fluents + A, cpfs))
    assert [(f.name, f.values) for f in model.features] == [("k", (0, 2)), ("step", (0, 2))]
    laws(model, "a", "step", lambda s: {0: F(3, 4), 2: F(1, 4)})
    laws(model, "a", "k", lambda s: {min(2, s["k"] + s["step'"]): F(1)}, following=True)


def test_next_states_may_depend_on_each_other() -> None:
    model = read(rddl(XY + A, "x' = Bernoulli(0.5); y' = KronDelta(x' ^ ~a);"))
    laws(model, "noop", "y", lambda s: coin(s["x'"]), following=True)
    laws(model, "a", "y", lambda s: coin(0), following=True)


def test_integers_get_the_range_that_their_definitions_allow() -> None:
    fluents = """k : { state-fluent, int, default = 2 }; m : { state-fluent, int, default = 0 };
        down : { state-fluent, int, default = 5 }; d : { state-fluent, dir, default = @up };"""
    cpfs = """k' = if (a ^ (k < 4)) then k + 1 else k;
        m' = if (d == @up) then mod[m + 2, 6] else max[m - 2, 0];
        down' = if (a) then max[0, down - 2] else if (down == 0) then 5 else down;
        d' = d;"""
    model = read(rddl(fluents + A, cpfs, "k - m", types="dir : { @up, @low };"))
    values = {feature.name: feature.values for feature in model.features}
    assert values == {"k": (2, 3, 4), "m": (0, 2, 4), "down": (0, 1, 3, 5), "d": ("up", "low")}
    laws(model, "a", "k", lambda s: {min(s["k"] + 1, 4): F(1)})
    laws(model, "noop", "k", lambda s: {s["k"]: F(1)})
    laws(model, "noop", "m", lambda s: {(s["m"] + 2) % 6 if s["d"] == "up" else max(s["m"] - 2, 0): F(1)})


def test_integers_drawn_and_observed() -> None:
    fluents = "k : { state-fluent, int, default = 0 }; seen : { observ-fluent, int };"
    cpfs = """k' = if (a) then 0 else min[3, k + Bernoulli(0.5) + Bernoulli(0.5)];
        seen = div[k', 2];"""
    model = read(rddl(fluents + A, cpfs))
    assert model.features[0].values == (0, 1, 2, 3)
    assert model.observations[0].values == (0, 1)

    def moved(s: Mapping[str, Any]) -> dict[int, F]:
        law: dict[int, F] = {}
        for more, q in ((0, F(1, 4)), (1, F(1, 2)), (2, F(1, 4))):
            law[min(3, s["k"] + more)] = law.get(min(3, s["k"] + more), F(0)) + q
        return law

    laws(model, "noop", "k", moved)
    laws(model, "noop", "seen", lambda s: {s["k'"] // 2: F(1)}, following=True)


def test_what_divides_by_zero_where_it_does_not_count_does_no_harm() -> None:
    zero = "Z : { non-fluent, real, default = 0.0 };"
    model = read(rddl(XY + A + zero, f"x' = if (Z > 0) then Bernoulli(1 / Z) else x; {KEEP}"))
    laws(model, "noop", "x", lambda s: coin(s["x"]))
    model = read(rddl(XY + A + zero, f"x' = if (false ^ y) then Bernoulli(1 / Z) else x; {KEEP}"))
    laws(model, "noop", "x", lambda s: coin(s["x"]))


def test_numbers_of_declarations_are_exact() -> None:
    numbers = "N : { non-fluent, real, default = 0.1 }; M : { non-fluent, real, default = -0.3 };"
    model = read(rddl(XY + A + numbers, f"x' = Bernoulli(N * 3 + M + 0.1); {KEEP}", "N - M",
                      discount="discount = 0.95;"))  # fmt: skip
    laws(model, "noop", "x", lambda s: coin(F(1, 10)))
    assert model.discount == F(19, 20)
    assert [F(evaluate(term, {})) for term in model.rewards] == [F(4, 10)]


@pytest.mark.parametrize(
    ("horizon", "discount", "found"),
    [
        ("horizon = 40;", "discount = 1.0;", (40, F(1))),
        ("horizon = pos-inf;", "discount = 0.9;", (None, F(9, 10))),
        ("", "discount = 0.9;", (None, F(9, 10))),
        ("horizon = 7;", "", (7, F(1))),
    ],
)
def test_horizon_and_discount(horizon: str, discount: str, found: tuple[int | None, F]) -> None:
    model = read(rddl(XY + A, f"x' = x; {KEEP}", horizon=horizon, discount=discount))
    assert (model.horizon, model.discount) == found


def test_a_domain_that_is_partially_observed_without_observations_is_blind() -> None:
    model = read(rddl(XY + A, f"x' = x; {KEEP}", requirements="partially-observed"))
    assert (model.observability, model.observations) == ("partial", ())


def test_carriage_returns_and_signs_in_comments_do_no_harm() -> None:
    text = rddl(XY + A, f"x' = Bernoulli(0.1); // caf\u00e9 \ufffd\n {KEEP}")
    changed = "\ufeff" + text.replace("\n", "\r\n")
    assert read_rddl_with_warnings([changed])[0] == read_rddl_with_warnings([text])[0]
