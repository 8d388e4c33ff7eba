"""Parametric processes: what is refused, what is admissible, special values, large models, domains."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import sympy

from factored_polca import library
from factored_polca.hierarchy.subtask import subtask_process
from factored_polca.minimisation import flat_process, minimise, reduce
from factored_polca.models import (
    FALSE,
    TRUE,
    Action,
    Expression,
    Feature,
    LimitReached,
    Model,
    ModelError,
    Observation,
    Parameter,
    Task,
    boolean,
    conditional,
    lottery,
)
from factored_polca.parametric import (
    compile_parametric,
    parametric_flat_process,
    parametric_process,
    reduce_parametric,
)
from factored_polca.parametric.conditions import region_text
from factored_polca.parametric.program import CANCELLED, ProgramBuilder
from factored_polca.solvers.choose import solve_mdp
from factored_polca.symbolic import compile_model

MERSENNE = 2**61 - 1


def chance(expression: object) -> Expression:
    return lottery({TRUE: expression, FALSE: 1 - expression})  # type: ignore[operator]


def coin(expression: object, **options: object) -> Model:
    """One truth value x, and an action that makes it true with a chance."""
    x = boolean("x")
    parameters = {"p": "1/3", "q": "1/4"}
    return Model("coin", [x], [Action("toss", {x: expression})], rewards=[conditional(x, 1, 0)],
                 parameters=parameters, **options)  # fmt: skip


P, Q = Parameter("p"), Parameter("q")


# -- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "operator"),
    [
        ("bernoulli(min(p, 1/2))", "'min' of p"),
        ("bernoulli(max(p, q))", "'max' of p"),
        ("bernoulli(abs(p))", "'abs' of p"),
        ("bernoulli(p // 2)", "'//' of p"),
        ("bernoulli(p % 1)", "'%' of p"),
        ("bernoulli(1/2) if p > 1/4 else true", "'>' of p"),
        ("bernoulli(1/2) if p == q else true", "'==' of p"),
        ("bernoulli(2 ** -p)", "the exponent -p"),
    ],
)
def test_only_field_operations_may_involve_parameters(text: str, operator: str) -> None:
    with pytest.raises(ModelError) as caught:
        parametric_flat_process(coin(text))
    (fault,) = caught.value.faults
    assert operator in fault.message
    assert fault.path == ("actions", "toss", "effects", "x")


def test_the_same_operations_are_fine_where_the_parameter_is_not_kept() -> None:
    model = coin("bernoulli(min(p, 1/2) * q)")
    process = parametric_flat_process(model, ["q"])
    assert region_text(process.conditions) == ["0 <= q <= 3"]  # min(1/3, 1/2) q


def test_a_parameter_in_a_condition_is_refused_with_its_place() -> None:
    x = boolean("x")
    model = Model("m", [x], [Action("a", {x: TRUE}, applicable=P > 0)], parameters={"p": "1/2"})
    with pytest.raises(ModelError) as caught:
        parametric_flat_process(model)
    assert caught.value.faults[0].path == ("actions", "a", "applicable")


def test_a_value_of_a_feature_that_depends_on_a_parameter_is_refused() -> None:
    x = Feature("x", range(3))
    model = Model("m", [x], [Action("a", {x: x + P})], parameters={"p": 1})
    with pytest.raises(ModelError, match="is no value of 'x'"):
        parametric_flat_process(model)


def test_rows_must_sum_to_one_as_functions() -> None:
    with pytest.raises(ModelError, match=r"the probabilities sum to p \+ q"):
        parametric_flat_process(coin("{true: p, false: q}"))


def test_unknown_parameters_are_named() -> None:
    with pytest.raises(ModelError, match=r"no parameter 'r'.*parameters are p, q"):
        parametric_flat_process(coin(chance(P)), ["r"])
    x = boolean("x")
    without = Model("m", [x], [Action("a", {x: TRUE})])
    with pytest.raises(ModelError, match="no parameter to keep"):
        parametric_flat_process(without)
    with pytest.raises(ModelError, match="without symbols"):
        parametric_process(flat_process(compile_model(coin(chance(P)))))


def test_functions_that_grow_too_large_are_a_limit() -> None:
    with pytest.raises(LimitReached, match="a degree beyond 64"):
        parametric_flat_process(coin("bernoulli(p ** 65)"))


def test_a_child_policy_is_refused_and_a_task_of_primitives_is_not() -> None:
    symbolic = compile_parametric(coin(chance(P)))
    task = Task("T", ["toss"], terminal=symbolic.model.feature("x").is_(True), pseudo_rewards=-P)
    opened = parametric_process(subtask_process(symbolic, task, {}, None))
    assert reduce_parametric(opened).mdp({"p": "1/2"}).rewards.min() == -0.5

    from dataclasses import replace

    child = replace(opened.process.choices[0], policy=symbolic.manager.constant(0))
    with pytest.raises(ModelError, match="policy of a child"):
        parametric_process(replace(opened.process, choices=(child,)))


# -- admissible settings -----------------------------------------------------------------------


def test_the_conditions_are_those_of_the_probabilities_and_divisors() -> None:
    process = parametric_flat_process(coin(chance(P / (1 + Q))))
    assert {str(condition) for condition in process.conditions} == {"0 <= p/(1 + q) <= 1", "1 + q != 0"}
    with pytest.raises(ModelError, match=r"at p = 2, q = 1/4 the condition 0 <= p/\(1 \+ q\) <= 1"):
        process.at({"p": Fraction(2)})
    with pytest.raises(ModelError, match=r"1 \+ q != 0 does not hold"):
        process.at({"q": Fraction(-1)})
    with pytest.raises(ModelError, match="no parameter 'r' was kept"):
        process.at({"r": Fraction(1)})


def test_a_divisor_that_cancels_still_may_not_vanish() -> None:
    process = parametric_flat_process(coin(chance(P * P / P)))
    assert {str(condition) for condition in process.conditions} == {"p != 0", "0 <= p <= 1"}


def test_rows_where_an_action_does_not_apply_ask_for_nothing() -> None:
    x = boolean("x")
    toss = Action("toss", {x: conditional(x, chance(3 * P), chance(P))}, applicable=~x)
    model = Model("m", [x], [toss, Action("wait")], parameters={"p": "1/3"})
    assert region_text(parametric_flat_process(model).conditions) == ["0 <= p <= 1"]


def test_intervals_of_one_parameter_are_joined() -> None:
    x, y = boolean("x"), boolean("y")
    model = Model("m", [x, y], [Action("a", {x: chance(P / 2 + Fraction(1, 4)), y: chance(3 * P)})],
                  parameters={"p": "1/4"})  # fmt: skip
    assert region_text(parametric_flat_process(model).conditions) == ["0 <= p <= 1/3"]


# -- partitions --------------------------------------------------------------------------------


def twins(first: Expression, second: Expression) -> Model:
    """Two states from which a prize is won with the given chances; what is won ends."""
    place = Feature("place", ["here", "there", "won", "lost"])

    def prize(e: Expression) -> Expression:
        return lottery({"won": e, "lost": 1 - e})

    law = conditional(
        place.is_("here"), prize(first), conditional(place.is_("there"), prize(second), place)
    )
    return Model(
        "twins", [place], [Action("play", {place: law})], rewards=[conditional(place.is_("won"), 1, 0)],
        parameters={"p": "1/2", "q": "1/2"},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("first", "second", "blocks"),
    [
        (P, P, 3),
        (P, Q, 4),  # equal at the model's own values only
        (P, 1 - P, 4),  # equal at p = 1/2
        (P, P**2, 4),  # equal at 0 and 1
        (P * Q, Q * P, 3),
        ((1 - P**2) / (1 + P), 1 - P, 3),  # equal as functions
        (P * (1 - P), P - P**2, 3),
        (P / MERSENNE, P / MERSENNE, 3),  # a denominator that the first prime divides
        (P / MERSENNE, 2 * P / MERSENNE, 4),
        (P / (MERSENNE + Q), P / (MERSENNE + Q), 3),
        (P / 2, P / 2 + (P - P) * Q, 3),
        (P / 2, P / 2 + P * Fraction(1, 10**30), 4),
    ],
)
def test_states_are_merged_where_rows_are_equal_as_functions(
    first: Expression, second: Expression, blocks: int
) -> None:
    assert minimise(parametric_flat_process(twins(first, second)).process).partition.blocks == blocks


def test_at_special_values_the_instance_is_finer_than_need_be() -> None:
    model = twins(P, 1 - P)
    quotient = reduce_parametric(parametric_flat_process(model, ["p"]))
    fixed = reduce(flat_process(compile_model(model.with_parameters({"p": "1/2"}))))
    assert (quotient.partition.blocks, fixed.partition.blocks) == (4, 3)
    mdp = quotient.mdp({"p": "1/2"})
    values = solve_mdp(mdp).values
    # the prize 1 for ever from the next step on, with chance 1/2: 0.95 / 0.05 / 2
    assert sorted(values.round(6).tolist()) == [0.0, 9.5, 9.5, 20.0]


def test_zeros_are_left_out_at_special_values() -> None:
    quotient = reduce_parametric(parametric_flat_process(twins(P, Q)))
    generic, special = (quotient.mdp({"p": p, "q": "1/3"}).transitions[0] for p in ("1/5", 0))
    assert generic.nnz == special.nnz + 1
    assert (special.data > 0).all()
    assert special.sum(axis=1).tolist() == [1, 1, 1, 1]


def test_an_undiscounted_model_at_special_values() -> None:
    x = boolean("x")
    model = Model("m", [x], [Action("try", {x: chance(P)}, rewards=-1)], terminal=x, discount=1,
                  initial={x: FALSE}, parameters={"p": "1/4"})  # fmt: skip
    quotient = reduce_parametric(parametric_flat_process(model))
    for p in (Fraction(1, 4), Fraction(1)):
        assert solve_mdp(quotient.mdp({"p": p})).values.min() == pytest.approx(-1 / float(p), rel=1e-9)
    assert np.isneginf(solve_mdp(quotient.mdp({"p": 0})).values).sum() == 1  # it never ends


def test_interchangeable_actions_with_parameters() -> None:
    ups = [boolean(f"up_{i}") for i in range(6)]
    decay = {up: conditional(up, chance(1 - P), FALSE) for up in ups}
    fixes = [Action(f"fix_{i}", {**decay, up: chance(Q)}) for i, up in enumerate(ups)]
    model = Model("m", ups, fixes, rewards=[conditional(up, 1, 0) for up in ups],
                  parameters={"p": "1/10", "q": "1/2"})  # fmt: skip
    found = minimise(parametric_flat_process(model).process, interchangeable=True)
    assert found.partition.blocks == 7  # how many are up


# -- rows for people, and large models ---------------------------------------------------------


def test_rows_are_sympy_expressions() -> None:
    p, q = sympy.symbols("p q")
    quotient = reduce_parametric(parametric_flat_process(coin(chance(P / (1 + Q)))))
    true = int(solve_mdp(quotient.mdp({})).values.argmax())
    assert sympy.simplify(quotient.expression(0, "toss", true) - p / (1 + q)) == 0
    matrix = quotient.to_sympy()["toss"]
    assert all(sympy.simplify(sum(matrix.row(block)) - 1) == 0 for block in range(2))
    with pytest.raises(KeyError, match="there are toss"):
        quotient.expression(0, "roll", 0)
    assert quotient.reward_expression(true, "toss") == 1


def test_a_partially_observed_model_has_a_matrix_for_each_observation() -> None:
    accuracy = sympy.Symbol("accuracy")
    model = library.load("tiger", keep=["accuracy"]).model
    quotient = reduce_parametric(parametric_flat_process(model))
    left, right = quotient.to_sympy()["listen"]
    assert sorted([left[0, 0], right[0, 0]], key=str) == sorted([accuracy, 1 - accuracy], key=str)
    assert len(quotient.observations[1]) == 1  # what is heard after opening tells nothing
    with pytest.raises(TypeError, match="partially observed"):
        quotient.mdp({})
    pomdp = quotient.pomdp({"accuracy": "0.85"})
    assert pomdp.kernel[0][0].toarray().sum() + pomdp.kernel[0][1].toarray().sum() == pytest.approx(2)


def machines(count: int) -> Model:
    """Machines that break with chance p, each, and may all be tried to be repaired at once for a price."""
    ups = [boolean(f"up_{i}") for i in range(count)]
    worth = Parameter("worth")
    return Model(
        "machines",
        ups,
        [
            Action("wait", {up: conditional(up, chance(1 - P), FALSE) for up in ups}),
            Action("repair", {up: conditional(up, TRUE, chance(Q)) for up in ups}, rewards=-3),
        ],
        rewards=[conditional(up, worth, 0) for up in ups],
        initial=dict.fromkeys(ups, TRUE),
        parameters={"p": "0.1", "q": "0.6", "worth": 1},
    )


def test_two_to_the_forty_states_with_three_parameters() -> None:
    count = 40
    quotient = reduce_parametric(parametric_flat_process(machines(count)))
    assert quotient.process.process.symbolic.model.states == 2**40
    assert quotient.partition.blocks == count + 1
    assert region_text(quotient.process.conditions) == ["0 <= p <= 1", "0 <= q <= 1"]
    start = int(quotient.initial_distribution({}).argmax())
    discount = 0.95
    for p in (0, Fraction(1, 1000), Fraction(97, 100), 1):
        setting = {"p": p, "q": Fraction(1, 3), "worth": 2}
        mdp = quotient.mdp(setting)
        row = mdp.transitions[0][[start], :].toarray().ravel()
        # the number that stay up is binomial: its mean is n (1 - p), the largest n with chance (1 - p)^n
        values = mdp.rewards[0] / 2
        assert row @ values == pytest.approx(count * (1 - float(p)), rel=1e-12, abs=1e-12)
        assert row[start] == pytest.approx(float((1 - Fraction(p)) ** count), rel=1e-11, abs=0)
        # for ever waiting earns n / (1 - discount (1 - p)) times the worth, and the best no less
        waiting = 2 * count / (1 - discount * (1 - float(p)))
        assert solve_mdp(mdp).values[start] >= waiting * (1 - 1e-9)
    assert quotient.expression(start, "wait", start) == (sympy.Symbol("p") - 1) ** count


def test_observations_are_merged_where_their_columns_are_proportional() -> None:
    x = boolean("x")
    word, tone = Observation("word", ["a", "b", "c"]), Observation("tone", ["low", "high"])
    heard = conditional(
        x.next, lottery({"a": P, "b": 1 - P}), lottery({"a": P * Q, "b": Q - P * Q, "c": 1 - Q})
    )
    pitch = lottery({"low": Q, "high": 1 - Q})
    model = Model("m", [x], [Action("listen", senses={word: heard, tone: pitch})],
                  rewards=[conditional(x, 1, 0)], observability="partial", observations=[word, tone],
                  parameters={"p": "1/3", "q": "1/4"})  # fmt: skip
    quotient = reduce_parametric(parametric_flat_process(model))
    # b is to a as 1 - p to p wherever x is: one observation; the tone tells nothing
    assert quotient.observations == (("word=a / b", "word=c"),)


# -- programs ----------------------------------------------------------------------------------


def test_numbers_that_cancel_are_evaluated_exactly() -> None:
    import random

    from factored_polca.models.rational_functions import FunctionField

    field = FunctionField(["t"])
    t = field.symbol("t")
    function = (t - 1) ** 12  # expanded, its terms are up to 924, and all but cancel near 1
    builder = ProgramBuilder(field, random.Random(0))
    register = builder.number(function)
    builder.finish_numbers()
    square = builder.multiply(register, register)
    program = builder.finish()
    assert program.numbers_end < program.registers
    for value in (Fraction(1), Fraction(999, 1000), Fraction(3, 2), Fraction(0)):
        found = program.run({"t": value})
        assert found[register] == pytest.approx(float((value - 1) ** 12), rel=1e-11, abs=0)
        assert found[square] == pytest.approx(float((value - 1) ** 24), rel=1e-11, abs=0)
    naive = sum(c * 0.999 ** e[0] for e, c in function.over)
    assert abs(naive - 1e-36) > CANCELLED * 1e-36  # which is why


def test_equal_functions_share_a_register() -> None:
    import random

    from factored_polca.models.rational_functions import FunctionField

    field = FunctionField(["t", "u"])
    t, u = field.symbol("t"), field.symbol("u")
    builder = ProgramBuilder(field, random.Random(0))
    a, b, both = builder.number(t), builder.number(1 - t), builder.number(t * (1 - t))
    c = builder.number(u)
    builder.finish_numbers()
    assert builder.multiply(a, b) == builder.multiply(b, a) == both
    assert builder.add(a, b) == builder.one
    left = builder.multiply(builder.add(a, c), builder.add(a, c))
    twice = builder.multiply(builder.multiply(a, c), builder.number(Fraction(1)))
    right = builder.add(
        builder.add(builder.multiply(a, a), builder.multiply(c, c)), builder.add(twice, twice)
    )
    assert left == right


# -- domains -----------------------------------------------------------------------------------

NUMERIC = [
    ("expon", "success"), ("hallway", "hit"), ("hallway", "false_alarm"), ("linear", "success"),
    ("meds", "accuracy"), ("sysadmin", "cost"), ("tiger", "accuracy"), ("toy", "reward"),
    ("twenty_questions", "accuracy"), ("workshop", "decay"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "parameter"), NUMERIC)
def test_a_domain_keeps_a_number_as_a_parameter_of_its_model(name: str, parameter: str) -> None:
    plain, kept = library.load(name), library.load(name, keep=[parameter])
    assert parameter in dict(kept.model.parameters)
    assert kept.tasks == plain.tasks
    process = parametric_flat_process(kept.model, [parameter])
    partition = minimise(process.process).partition
    fixed = minimise(flat_process(compile_model(plain.model))).partition
    assert partition.blocks >= fixed.blocks
    again = minimise(process.at({})).partition
    assert again.blocks == fixed.blocks


def test_slippery_taxi_keeps_its_slip() -> None:
    kept = library.load("taxi", {"slip": "0.2"}, keep=["slip"]).model
    fixed = library.load("taxi", {"slip": "0.8,0.1,0.1"}).model
    quotient = reduce_parametric(parametric_flat_process(kept))
    small = reduce(flat_process(compile_model(fixed)))
    assert quotient.partition.blocks == small.partition.blocks
    values = solve_mdp(quotient.mdp({})).values @ quotient.initial_distribution({})
    assert values == pytest.approx(solve_mdp(small.mdp).values @ small.project_initial(), rel=1e-9)


def test_what_a_domain_needs_as_a_number_is_refused() -> None:
    for name, parameter in (("nursebot", "perturbation"), ("rocksample", "half_distance")):
        with pytest.raises(ModelError, match=f"{parameter} can't stay a symbol"):
            library.load(name, keep=[parameter])
    with pytest.raises(ModelError, match=r"size is .*it must be an integer"):
        library.load("linear", keep=["size"])
    with pytest.raises(ModelError, match="discount can't stay a symbol"):
        library.load("tiger", keep=["discount"])
    with pytest.raises(ModelError, match="no parameter 'acuracy'; did you mean 'accuracy'"):
        library.load("tiger", keep=["acuracy"])
