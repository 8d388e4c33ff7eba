"""The symbolic reading of a model agrees with enumeration and exact sums, state by state."""

from __future__ import annotations

from fractions import Fraction
from random import Random
from typing import Any

import numpy as np
import pytest
from compiled_cases import case, chunks, probability_sum

from factored_polca.diagrams import FLOAT, Field, random_prime
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.library import load
from factored_polca.minimisation.push import make_plan, push_exact, row_table, rows_at
from factored_polca.models import (
    Action,
    Constant,
    Feature,
    InitialBelief,
    Model,
    ModelError,
    Switch,
    boolean,
    conditional,
    lottery,
    parse,
)
from factored_polca.symbolic import ORDERS, NumericView, compile_model, descent, variable_order
from factored_polca.symbolic.forward import ForwardRegression, looks_up


@chunks()
def test_applicability_and_terminal_states_are_those_of_enumeration(seeds: range) -> None:
    for seed in seeds:
        found = case(seed)
        assert found.at(found.symbolic.terminal) == [int(t) for t in found.exact.terminal], seed
        for action, mask in zip(found.symbolic.actions, found.exact.applicable, strict=True):
            assert found.at(action.app) == [int(applies) for applies in mask], (seed, action.name)


@chunks()
def test_regression_in_a_field_equals_the_sum_over_next_states(seeds: range) -> None:
    for seed in seeds:
        found, random = case(seed), Random(seed)
        field = Field() if seed % 2 else Field(random_prime(random))
        kinds = random.choice((2, 5, found.exact.states))  # few values make small diagrams
        palette = [random.randrange(field.prime) for _ in range(kinds)]
        if seed % 3 == 0:  # what is 0 nearly everywhere is summed in another way
            palette = [0] * random.choice((1, 3, 12)) + palette[:2]
        values = [random.choice(palette) for _ in range(found.exact.states)]
        numbers = NumericView(found.symbolic, field)
        diagram = found.diagram(values, field)
        for a, rows in enumerate(found.exact.rows):
            regressed = found.at(numbers.regress(a, diagram))
            for s, row in enumerate(rows):
                if found.exact.applicable[a][s]:
                    total = probability_sum(row, values)
                    residue = total.numerator * pow(total.denominator, -1, field.prime) % field.prime
                    assert regressed[s] == residue, (seed, a, s)


@chunks()
def test_regression_from_the_top_down_equals_the_sum_over_next_states(seeds: range) -> None:
    done = 0
    for seed in seeds:
        found, random = case(seed), Random(seed)
        field = Field(random_prime(random))
        palette = [0] * (seed % 3) + [random.randrange(field.prime) for _ in range(random.choice((2, 40)))]
        values = [random.choice(palette) for _ in range(found.exact.states)]
        numbers = NumericView(found.symbolic, field)
        diagram = found.diagram(values, field)
        for a, rows in enumerate(found.exact.rows):
            if not looks_up(numbers, a):
                continue
            done += 1
            forward = ForwardRegression(numbers, a, diagram)
            result = None
            while result is None:  # in slices of a few entries
                result = forward.run(budget=random.choice((1, 7, 100)))
            regressed = found.at(result)
            for s, row in enumerate(rows):
                if found.exact.applicable[a][s]:
                    total = probability_sum(row, values)
                    residue = total.numerator * pow(total.denominator, -1, field.prime) % field.prime
                    assert regressed[s] == residue, (seed, a, s)
    assert done > len(seeds) // 4


@chunks()
def test_regression_with_rows_going_along_equals_the_sum_over_next_states(
    seeds: range, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(descent, "MANY", 1)  # these models are small
    monkeypatch.setattr(descent, "CARRIED", 99)
    done, cuts = 0, 0
    for seed in seeds:
        found, random = case(seed), Random(seed)
        field = Field(random_prime(random))
        palette = [0] * random.choice((0, 1, 9)) + [
            random.randrange(field.prime) for _ in range(random.choice((2, 40)))
        ]
        values = [random.choice(palette) for _ in range(found.exact.states)]
        numbers = NumericView(found.symbolic, field)
        diagram = found.diagram(values, field)
        plain = [a for a, action in enumerate(found.symbolic.actions) if not action.synchronic]
        known: descent.Cuts = {}
        descents = descent.Descents(numbers, plain, known)
        cuts += sum(None in cut.exact for cut in known.values())
        for place, a in enumerate(plain):
            if not found.symbolic.actions[a].rows:
                continue
            done += 1
            regressed = found.at(descents.regress(place, diagram))
            for s, row in enumerate(found.exact.rows[a]):
                if found.exact.applicable[a][s]:
                    total = probability_sum(row, values)
                    residue = total.numerator * pow(total.denominator, -1, field.prime) % field.prime
                    assert regressed[s] == residue, (seed, a, s)
    assert done > len(seeds) // 4
    assert cuts > len(seeds) // 8  # rows that look below their own level


@chunks()
def test_regression_in_floats_equals_the_sum_over_next_states(seeds: range) -> None:
    for seed in seeds:
        found, random = case(seed), Random(seed)
        values = [random.randrange(-9, 10) for _ in range(found.exact.states)]
        numbers = NumericView(found.symbolic, FLOAT)
        diagram = found.diagram([float(value) for value in values], FLOAT)
        for a, rows in enumerate(found.exact.rows):
            regressed = found.at(numbers.regress(a, diagram))
            for s, row in enumerate(rows):
                if found.exact.applicable[a][s]:
                    # At most 64 * 5 products of numbers below 10, each rounded to 1e-16.
                    assert regressed[s] == pytest.approx(float(probability_sum(row, values)), abs=1e-12)


@chunks()
def test_reward_terms_add_up_to_the_exact_expected_rewards(seeds: range) -> None:
    for seed in seeds:
        found = case(seed)
        for a, action in enumerate(found.symbolic.actions):
            totals = [Fraction(0)] * found.exact.states
            for term in action.rewards:
                for s, leaf in enumerate(found.at(term.diagram)):
                    totals[s] += term.values[leaf]
            for s, applies in enumerate(found.exact.applicable[a]):
                assert not applies or totals[s] == found.exact.rewards[a][s], (seed, a, s)


@chunks()
def test_the_initial_rows_multiply_to_the_initial_belief(seeds: range) -> None:
    for seed in seeds:
        found = case(seed)
        symbolic, count = found.symbolic, len(found.model.features)
        assert sorted(symbolic.initial) == list(range(count))
        every = found.diagram(range(found.exact.states), found.symbolic.terminal.leaf_type)
        plan, table = make_plan(symbolic, every, symbolic.initial), row_table(symbolic, symbolic.initial)
        nowhere = np.zeros((1, count), dtype=np.int32)
        chosen = rows_at(symbolic, symbolic.initial, table, plan.slots, nowhere)[0]
        expected = {s: chance for s, chance in enumerate(found.exact.initial) if chance}
        assert push_exact(plan, table, chosen) == expected, seed


def test_every_order_heuristic_lists_every_feature_once() -> None:
    model = load("taxi").model
    for name in ORDERS:
        assert sorted(variable_order(model, name)) == sorted(f.name for f in model.features)
    with pytest.raises(ValueError, match="auto, file, force, spectral"):
        variable_order(model, "best")
    with pytest.raises(ValueError, match="every feature once"):
        compile_model(model, order=["x"])


# -- faults: (what, changes of a sound model, path of the fault) ------------------------------------

x = Feature("x", range(3))
y = boolean("y")
HALF = Fraction(1, 2)


def small(
    effect: Any = None,
    *,
    other: Any = None,
    applicable: Any = True,
    reward: Any = 0,
    terminal: Any = False,
    initial: Any = None,
) -> Model:
    """Two features; one action whose parts can be set."""
    effects = [("x", effect)] if effect is not None else []
    effects += [("y", other)] if other is not None else []
    action = Action("go", effects, applicable=applicable, rewards=[reward])
    return Model("small", [x, y], [action], terminal=terminal, initial=initial)


def uneven(total: Fraction) -> Any:
    return lottery([(Constant(Fraction(0)), HALF), (Constant(Fraction(1)), total - HALF)])


BAD = {
    "a row that sums to 9/10": (small(uneven(Fraction(9, 10))), ("actions", "go", "effects", "x")),
    "a value outside": (small(x.now + 1), ("actions", "go", "effects", "x")),
    "a value outside with next parent": (
        small(conditional(y.next, x.now + 1, x.now), other=True), ("actions", "go", "effects", "x")),
    "a negative probability": (
        small(lottery([(Constant(Fraction(0)), Fraction(-1)), (Constant(Fraction(1)), Fraction(2))])),
        ("actions", "go", "effects", "x")),
    "division by zero": (small(reward=parse("1 / x")), ("reward", "0")),
    "a reward undefined at a next state": (small(1, reward=parse("1 / (x' - 1)")), ("reward", "0")),
    "a condition that is a number": (small(applicable=x.now + 1), ("actions", "go", "applicable")),
    "a terminal condition that is a number": (small(terminal=x.now), ("terminal",)),
    "an initial row that sums to 3/2": (small(initial={"x": uneven(Fraction(3, 2))}), ("initial", "x")),
    "a negative factor": (
        small(initial=InitialBelief([], [Constant(Fraction(-1, 6))])), ("initial", "factors", "0")),
}  # fmt: skip

SOUND = {
    "undefined in a branch not taken": small(reward=parse("0 if x == 0 else 1 / x")),
    "outside where not applicable": small(x.now + 1, applicable=x.now < 2),
    "outside where terminal": small(x.now + 1, terminal=x.now.is_(2)),
    "bad row where a next value cannot be": small(
        conditional(y.next, x.now + 1, x.now), other=conditional(x.now < 2, Constant(True), Constant(False))
    ),
    "bad row where a persisting next value is another": small(
        conditional(y.next, conditional(y.now, x.now, uneven(Fraction(2))), x.now)
    ),
    "reward undefined at an impossible next state": small(1, reward=parse("1 / x'")),
    "initial row wrong where its parent cannot be": small(
        initial={"y": Constant(True), "x": conditional(y.now, Constant(Fraction(1)), uneven(Fraction(2)))}
    ),
    "factor undefined where the belief is zero": small(
        initial=InitialBelief(
            [("x", Constant(Fraction(1))), ("y", Constant(True))],
            [
                Switch(
                    x.now, ((0, Constant(Fraction(-1))), (1, Constant(Fraction(1)))), parse("1 / (x - 2)")
                )
            ],
        )
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_a_fault_is_reported_at_the_place_where_enumeration_reports_it(what: str) -> None:
    model, path = BAD[what]
    for read in (enumerate_model, compile_model):
        with pytest.raises(ModelError) as raised:
            read(model)  # type: ignore[operator]
        paths = [fault.path for fault in raised.value.faults]
        assert path in paths or ("actions", "go", *path) in paths, (read, raised.value)


@pytest.mark.parametrize("what", SOUND)
def test_what_cannot_happen_is_no_fault(what: str) -> None:
    model = SOUND[what]
    exact, symbolic = enumerate_model(model), compile_model(model)
    assert symbolic.model.states == exact.states


def test_all_faults_of_a_model_are_reported_at_once() -> None:
    model = small(x.now + 1, reward=parse("1 / x"), terminal=parse("x / x == 1"), initial={"x": x.now + 1})
    with pytest.raises(ModelError) as raised:
        compile_model(small(x.now + 1, reward=parse("1 / x"), initial={"x": uneven(Fraction(2))}))
    assert len(raised.value.faults) == 3
    with pytest.raises(ModelError):
        compile_model(model)


def test_a_fault_names_the_context_and_the_sum() -> None:
    effect = conditional(y.now, uneven(Fraction(9, 10)), x.now)
    with pytest.raises(ModelError, match=r"y=true.*9/10"):
        compile_model(small(effect))


def test_numbers_with_a_denominator_divisible_by_the_prime_are_refused_by_that_field() -> None:
    field = Field()
    share = Fraction(1, field.prime)
    effect = lottery([(Constant(Fraction(0)), share), (Constant(Fraction(1)), 1 - share)])
    symbolic = compile_model(small(effect))
    with pytest.raises(ZeroDivisionError, match="divisible by the prime"):
        NumericView(symbolic, field).weights(0, 0)
    assert NumericView(symbolic, Field(2**61 - 31)).weights(0, 0)
