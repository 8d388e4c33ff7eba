"""The explicit reading of a model against hand-made examples and the definitions themselves."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from random_models import random_model, random_tasks

from factored_polca.explicit import exact_dynamic_programming as exact
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.evaluate import Distribution, distribution, evaluate
from factored_polca.explicit.subtask import subtask_mdp
from factored_polca.models import (
    Action,
    Conditional,
    Feature,
    InitialBelief,
    LimitReached,
    Model,
    ModelError,
    Observation,
    Task,
    TaskHierarchy,
    boolean,
    check_tasks,
    parse,
)
from factored_polca.models.expressions import Reference
from factored_polca.models.scalars import Undefined

F = Fraction
SEEDS = range(60)


# -- expressions -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "x", "expected"),
    [
        ("x + 1/3", 2, F(7, 3)),
        ("1/x if x != 0 else 5", 0, F(5)),
        ("x != 0 and 1/x > 0", 0, False),
        ("x == 0 or 1/x > 0", 0, True),
        ("not (x < 1)", 2, True),
        ("switch(x, 0: 10, 1: 1/0, else: 7)", 2, F(7)),
        ("switch(x, 0: 10, 1: 1/0, else: 7)", 0, F(10)),
        ("max(x, 1, x - 5) ** 2", 3, F(9)),
        ("(x + 5) % 3 - 7 // 2", 3, F(-1)),
        ("{x: 0.25, 2: 0.75}", 2, Distribution(((F(2), F(1)),))),
        ("{x: 0.25, 2: 0.75}", 1, Distribution(((F(1), F(1, 4)), (F(2), F(3, 4))))),
        ("{1/x: 0, 2: 1}", 0, Distribution(((F(2), F(1)),))),
    ],
)
def test_only_the_chosen_part_of_an_expression_counts(text: str, x: int, expected: object) -> None:
    assert evaluate(parse(text), {("x", False): x}) == expected
    assert evaluate(parse(text), {Reference("x"): x}) == expected


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("1/x", "division by zero"),
        ("1/x > 0 and x != 0", "division by zero"),
        ("switch(x, 1: 10)", "no case for 0"),
        ("1 if x else 2", "true or false"),
        ("x and true", "truth values"),
        ("x == true", "compares"),
        ("y + 1", "y has no value"),
        ("x' + 1", "x' has no value"),
        ("{0: 1/x}", "division by zero"),
        ("{0: -0.5, 1: 1.5}", "negative"),
        ("{0: true}", "must be a number"),
        ("{{0: 1}: 1}", "not a distribution"),
        ("{0: 1} + 1", "operand"),
    ],
)
def test_an_expression_without_a_value_says_why(text: str, reason: str) -> None:
    result = evaluate(parse(text), {("x", False): 0})
    assert isinstance(result, Undefined)
    assert reason in result.reason


def test_a_long_chain_of_conditionals_needs_no_deep_recursion() -> None:
    chain = parse("0")
    for number in range(590):
        chain = Conditional(parse(f"x == {number}"), parse(f"{number} + 1"), chain)
    assert evaluate(chain, {("x", False): 0}) == 1


def test_a_parameter_is_looked_up() -> None:
    model = Model("m", [boolean("b")], [Action("a", {"b": "bernoulli(p)"})], parameters={"p": "1/3"})
    effect = dict(model.actions[0].effects)["b"]
    assert distribution(effect, (True, False), {}, dict(model.parameters)) == (F(1, 3), F(2, 3))
    assert isinstance(evaluate(effect, {}), Undefined)
    assert enumerate_model(model).rows[0][0] == {0: F(2, 3), 1: F(1, 3)}


@pytest.mark.parametrize(
    ("text", "x", "expected"),
    [
        ("x", 1, (F(0), F(1), F(0))),
        ("{min(x + 1, 2): 0.9, x: 0.1}", 2, (F(0), F(0), F(1))),
        ("{x + 1: 0 if x == 2 else 0.5, x: 1 if x == 2 else 0.5}", 2, (F(0), F(0), F(1))),
        ("{x + 1: 0 if x == 2 else 0.5, x: 1 if x == 2 else 0.5}", 0, (F(1, 2), F(1, 2), F(0))),
        ("x + 1", 2, "3 is none of the values 0, 1, 2"),
        ("x == 1", 1, "true is none of the values"),
        ("{0: 0.3, 1: 0.6}", 0, "sum to 9/10"),
    ],
)
def test_a_row_is_exact_or_undefined(text: str, x: int, expected: object) -> None:
    row = distribution(parse(text), (0, 1, 2), {("x", False): x})
    if isinstance(row, Undefined):
        assert isinstance(expected, str)
        assert expected in row.reason
    else:
        assert row == expected


# -- enumeration -------------------------------------------------------------------------------


def _two_features(first: str, second: str) -> Model:
    features = {"x": Feature("x", (0, 1)), "y": Feature("y", ("u", "v", "w"))}
    effects = {"x": "{1: 0.3, 0: 0.7}", "y": 'switch(x\', 1: {"u": 1/3, "v": 2/3}, 0: y)'}
    action = Action("a", effects, rewards=["2 * x + 5 * x'", 'switch(y\', "u": 3, else: 0)'])
    return Model("two", [features[first], features[second]], [action, Action("wait")])


@pytest.mark.parametrize("order", [("x", "y"), ("y", "x")])
def test_synchronic_parents_may_stand_before_or_after_their_children(order: tuple[str, str]) -> None:
    mdp = enumerate_model(_two_features(*order))

    def number(x: int, y: str) -> int:
        values: dict[str, int | str] = {"x": x, "y": y}
        return mdp.index([values[name] for name in order])

    # By hand: x' = 1 with 0.3, then y' = u with 1/3 and v with 2/3; otherwise y stays.
    assert mdp.rows[0][number(1, "w")] == {
        number(1, "u"): F(1, 10),
        number(1, "v"): F(2, 10),
        number(0, "w"): F(7, 10),
    }
    # 2 x + 5 E[x'] + 3 P(y' = u) = 2 + 5 * 0.3 + 3 * 0.1.
    assert mdp.rewards[0][number(1, "w")] == F(38, 10)
    assert mdp.rows[1][number(1, "w")] == {number(1, "w"): F(1)}
    assert mdp.initial == (F(1, 6),) * 6


def test_states_run_through_the_last_feature_first() -> None:
    mdp = enumerate_model(_two_features("x", "y"))
    assert mdp.state_values == tuple(product((0, 1), ("u", "v", "w")))
    assert [mdp.index(values) for values in mdp.state_values] == list(range(6))
    with pytest.raises(ValueError, match="no value of 'y'"):
        mdp.index((0, "z"))


def _brute_force_probability(model: Model, action: Action, now: tuple, after: tuple) -> Fraction:  # type: ignore[type-arg]
    """T(x, a, x') as the product over features, straight from its definition."""
    x = {(f.name, False): v for f, v in zip(model.features, now, strict=True)}
    x |= {(f.name, True): v for f, v in zip(model.features, after, strict=True)}
    effects = dict(action.effects)
    result = F(1)
    for feature, before, value in zip(model.features, now, after, strict=True):
        if feature.name not in effects:
            result *= before == value
            continue
        row = distribution(effects[feature.name], feature.values, x, dict(model.parameters))
        assert not isinstance(row, Undefined)
        index = feature.index(value)
        assert index is not None
        result *= row[index]
    return result


@pytest.mark.parametrize("seed", SEEDS[:20])
def test_rows_are_the_product_of_the_conditional_distributions(seed: int) -> None:
    model = random_model(seed, max_states=36)
    mdp = enumerate_model(model)
    for a, action in enumerate(model.actions):
        for s, now in enumerate(mdp.state_values):
            if mdp.applicable[a][s]:
                expected = {
                    t: chance
                    for t, after in enumerate(mdp.state_values)
                    if (chance := _brute_force_probability(model, action, now, after))
                }
                assert mdp.rows[a][s] == expected
                assert sum(expected.values()) == 1
            else:
                assert mdp.rows[a][s] == {}
                assert mdp.rewards[a][s] == 0


def test_faults_count_only_where_an_action_can_be_taken() -> None:
    x = Feature("x", range(3))
    step = Action("step", {"x": "x + 1"}, applicable="x < 2", rewards="1 / (2 - x)")
    assert enumerate_model(Model("m", [x], [step, Action("wait")])).rows[0][2] == {}
    ended = Model("m", [x], [Action("step", {"x": "x + 1"})], terminal="x == 2")
    assert enumerate_model(ended).applicable == ((True, True, False),)
    with pytest.raises(ModelError, match=r"actions -> step -> effects -> x: 3 is none .* at x=2"):
        enumerate_model(Model("m", [x], [Action("step", {"x": "x + 1"})]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rewards": "1 / x"}, "reward -> 0: division by zero, at x=0"),
        ({"rewards": "{1: 0.5, 2: 0.5}"}, "a distribution can't be used here"),
        ({"terminal": "1 / x > 5"}, "terminal: division by zero"),
        ({"terminal": "x + 1"}, "true or false"),
        ({"initial": {"x": "{0: 0.5, 1: 0.4}"}}, "initial -> x: the probabilities sum to 9/10"),
        ({"initial": InitialBelief(factors=["x"])}, "initial: the initial belief sums to 3"),
        ({"initial": InitialBelief(factors=["x - 1"])}, "the weight -1 is negative"),
        ({"rewards": "nothing"}, "unknown name 'nothing'"),
    ],
)
def test_each_fault_names_its_place(changes: dict[str, object], message: str) -> None:
    model = Model("m", [Feature("x", range(3))], [Action("wait")], **changes)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=message):
        enumerate_model(model)


def test_an_undefined_applicability_is_a_fault() -> None:
    model = Model("m", [Feature("x", range(3))], [Action("wait", applicable="1 / x > 0")])
    with pytest.raises(ModelError, match="actions -> wait -> applicable: division by zero, at x=0"):
        enumerate_model(model)


def test_too_many_states_are_refused_before_work_begins() -> None:
    model = Model("wide", [boolean(f"b{i}") for i in range(200)], [Action("wait")])
    with pytest.raises(LimitReached, match="more than the 200000") as caught:
        enumerate_model(model)
    assert caught.value.stage == "enumeration"


@pytest.mark.parametrize(
    ("initial", "expected"),
    [
        (InitialBelief(), (F(1, 4),) * 4),
        (InitialBelief({"x": "{0: 0.1, 1: 0.9}"}), (F(1, 20), F(1, 20), F(9, 20), F(9, 20))),
        # A network against the order of the file: y first, x given y.
        (
            InitialBelief({"x": "{0: 1/3, 1: 2/3} if y == 1 else 0", "y": "{0: 0.4, 1: 0.6}"}),
            (F(4, 10), F(2, 10), F(0), F(4, 10)),
        ),
        # Factors: a feature without a distribution counts 1 for each value.
        (InitialBelief({"x": "1"}, ["0.25 if y == 0 else 0.75"]), (F(0), F(0), F(1, 4), F(3, 4))),
        (InitialBelief(factors=["0.5 if x == y else 0"]), (F(1, 2), F(0), F(0), F(1, 2))),
        # Where one part of the product is 0 another may be undefined.
        (InitialBelief({"x": "1", "y": "{0: 1 / x, 1: 1 - 1 / x}"}), (F(0), F(0), F(1), F(0))),
    ],
)
def test_initial_beliefs_by_hand(initial: InitialBelief, expected: tuple[Fraction, ...]) -> None:
    model = Model("m", [Feature("x", (0, 1)), Feature("y", (0, 1))], [Action("wait")], initial=initial)
    assert enumerate_model(model).initial == expected


def test_rewards_over_observations_are_expectations() -> None:
    model = Model(
        "listen",
        [boolean("tiger")],
        [
            Action("listen", {"tiger": "bernoulli(0.5)"}, senses={"ear": "{tiger': 0.8, not tiger': 0.2}"}),
            Action("wait", rewards='7 if hum == "none" else 0'),
        ],
        rewards='switch(ear, true: 10, else: 0) if hum == "none" else 1000',
        observability="partial",
        observations=[Observation("ear", (True, False), null=False), Observation("hum", ("none", "loud"))],
    )
    mdp = enumerate_model(model)
    # P(ear) = 0.5 * 0.8 + 0.5 * 0.2 = 0.5 when listening; unsensed channels report their null value.
    assert mdp.rewards == ((F(5), F(5)), (F(7), F(7)))


def test_overrides_and_restriction_choose_what_is_read() -> None:
    model = _two_features("x", "y")
    mdp = enumerate_model(model, terminal="x == 1", rewards={"a": ["x' - 1"]}, actions=["wait", "a"])
    assert mdp.actions == ("wait", "a")
    assert mdp.terminal == (False, False, False, True, True, True)
    assert mdp.rewards[1] == (F(-7, 10),) * 3 + (F(0),) * 3
    assert mdp.rewards[0] == (F(0),) * 6
    assert mdp.restrict(["a"]).rewards == (mdp.rewards[1],)
    with pytest.raises(KeyError, match="there are wait, a"):
        mdp.restrict(["b"])


@pytest.mark.parametrize("seed", SEEDS[:10])
def test_arrays_hold_the_same_numbers(seed: int) -> None:
    mdp = enumerate_model(random_model(seed))
    arrays = mdp.to_arrays()
    assert arrays.states == mdp.states
    assert arrays.actions == mdp.actions
    for a, matrix in enumerate(arrays.transitions):
        dense = matrix.toarray()
        expected = np.zeros_like(dense)
        for s, row in enumerate(mdp.rows[a]):
            for t, chance in row.items():
                expected[s, t] = float(chance)
        assert np.array_equal(dense, expected)
        # Rows of at most 256 rounded entries: 256 half units in the last place of 1.
        assert np.allclose(dense.sum(axis=1), arrays.applicable[a], atol=3e-14, rtol=0)
    assert np.array_equal(arrays.rewards, np.array([[float(r) for r in rs] for rs in mdp.rewards]))


# -- subtasks ----------------------------------------------------------------------------------


def _corridor() -> tuple[Model, TaskHierarchy]:
    model = Model(
        "corridor",
        [Feature("x", range(4)), boolean("lamp")],
        [
            Action("left", {"x": "max(x - 1, 0)"}),
            Action("right", {"x": "min(x + 1, 3)"}, applicable="not lamp"),
            Action("switch", {"lamp": "not lamp"}),
        ],
        rewards="-1",
        terminal="x == 3 and lamp",
    )
    hierarchy = TaskHierarchy(
        [
            Task("root", ["go", "switch"]),
            Task(
                "go",
                ["right", "left"],
                terminal="x == 3",
                pseudo_rewards="5 if x' == 3 else 0",
                adds_reward=True,
            ),
        ]
    )
    return model, hierarchy


def test_an_abstract_action_copies_what_its_policy_chooses() -> None:
    model, hierarchy = _corridor()
    child = subtask_mdp(model, hierarchy, "go")
    assert child.actions == ("right", "left")
    assert child.terminal == (False,) * 6 + (True,) * 2
    assert list(child.rewards[0]) == [
        -1,
        0,
        -1,
        0,
        4,
        0,
        0,
        0,
    ]  # -1, and 5 on arrival, where `right` applies
    policy = exact.optimal_solution(child).policy
    chosen = [-1 if a < 0 else (1, 0)[a] for a in policy]  # as numbers of the model's actions
    # Without the lamp go right; with it only `left` is possible; at x = 3 `go` has ended.
    assert chosen == [1, 0, 1, 0, 1, 0, -1, -1]
    root = subtask_mdp(model, hierarchy, "root", {"go": chosen})
    assert root.actions == ("go", "switch")
    assert root.applicable[0] == (True,) * 6 + (False,) * 2
    assert root.rows[0][2] == {4: 1}
    assert root.rows[0][5] == {3: 1}
    assert root.rows[0][6] == {}
    # From (x, lamp): off: 3 - x steps and one switch; on: one more switch first.
    gamma = F(95, 100)
    steps = [4, 5, 3, 4, 2, 3, 1, 0]
    assert exact.optimal_solution(root).values == tuple(-(1 - gamma**n) / (1 - gamma) for n in steps)


def test_bad_policies_of_children_are_refused() -> None:
    model, hierarchy = _corridor()
    with pytest.raises(ModelError, match="the child 'go' has no policy"):
        subtask_mdp(model, hierarchy, "root")
    with pytest.raises(ValueError, match="'go' stands for 'right' at state 1"):
        subtask_mdp(model, hierarchy, "root", {"go": [1] * 8})
    with pytest.raises(ValueError, match="3 entries for 8 states"):
        subtask_mdp(model, hierarchy, "root", {"go": [1] * 3})
    with pytest.raises(ValueError, match="action number 9, which is not below 'root'"):
        subtask_mdp(model, hierarchy, "root", {"go": [9] * 8})
    with pytest.raises(ValueError, match="'wait' is already an action"):
        enumerate_model(_two_features("x", "y")).with_abstract_actions({"wait": [0] * 6})


@pytest.mark.parametrize("seed", SEEDS[:20])
def test_the_roots_value_is_the_polled_policys_value(seed: int) -> None:
    # DESIGN, recursive optimality: exactly so in rationals, where the root's reward is the model's.
    model = random_model(seed, max_states=40)
    hierarchy = random_tasks(seed, model)
    assert check_tasks(model, hierarchy) == []
    (root,) = hierarchy.roots()
    numbers = {action.name: a for a, action in enumerate(model.actions)}
    policies: dict[str, list[int]] = {}
    values: tuple[exact.ExactValue, ...] = ()
    waiting = [task.name for task in hierarchy.tasks]
    while waiting:
        name = next(
            n for n in waiting if all(c in policies or c in numbers for c in hierarchy.task(n).actions)
        )
        waiting.remove(name)
        mdp = subtask_mdp(model, hierarchy, name, policies)
        if name != root.name:
            rewards = {
                mdp.rewards[a][s]
                for a in range(len(mdp.actions)) for s in range(mdp.states) if mdp.applicable[a][s]
            }  # fmt: skip
            assert len(rewards) > 1
        solution = exact.optimal_solution(mdp)
        policies[name] = []
        for s, a in enumerate(solution.policy):
            action = "" if a < 0 else mdp.actions[a]
            policies[name].append(
                -1 if a < 0 else numbers.get(action, policies.get(action, [-1] * (s + 1))[s])
            )
        if name == root.name:
            values = solution.values
    flat = enumerate_model(model)
    assert exact.evaluate_policy(flat, policies[root.name]) == values
    best = exact.optimal_solution(flat).values
    assert all(v <= w for v, w in zip(values, best, strict=True))
