"""The flat model read off diagrams is the exact enumeration in floats, and quick about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
import pytest
from random_models import random_model
from random_pomdps import random_pomdp

from factored_polca.diagrams import evaluate_states
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_pomdp import ExactPOMDP, enumerate_pomdp
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.formats.native import read_native, write_native
from factored_polca.library import load
from factored_polca.minimisation import expansion, outcomes
from factored_polca.minimisation.flat_model import flat_model
from factored_polca.minimisation.outcomes import Numbering
from factored_polca.minimisation.unreduced import unreduced, unreduced_mdp, unreduced_pomdp
from factored_polca.models import (
    Action,
    Feature,
    LimitReached,
    Model,
    ModelError,
    Observation,
    boolean,
    parse,
)
from factored_polca.symbolic import ORDERS, SymbolicModel, compile_model, compile_term

F = Fraction
SEEDS = 200
CHUNKS = [range(start, start + 20) for start in range(0, SEEDS, 20)]
TOLERANCE = 1e-12  # products of at most six rounded probabilities; sums of rewards below 1000


@cache
def case(seed: int) -> tuple[ExactPOMDP, SymbolicModel]:
    """A random model in both readings, under one of the variable orders in turn."""
    model = random_pomdp(seed)
    return enumerate_pomdp(model), compile_model(model, order=ORDERS[seed % len(ORDERS)])


def assert_same(found: ArrayPOMDP, expected: ArrayPOMDP, note: object = "") -> None:
    assert found.actions == expected.actions, note
    assert found.observations == expected.observations, note
    assert found.terminal.tolist() == expected.terminal.tolist(), note
    assert found.observed.tolist() == expected.observed.tolist(), note
    assert found.discount == expected.discount, note
    np.testing.assert_allclose(found.rewards, expected.rewards, rtol=0, atol=TOLERANCE, err_msg=str(note))
    np.testing.assert_allclose(found.initial, expected.initial, rtol=0, atol=TOLERANCE, err_msg=str(note))
    for mine, theirs in zip(found.kernel, expected.kernel, strict=True):
        for a, b in zip(mine, theirs, strict=True):
            assert a.indptr.tolist() == b.indptr.tolist(), note
            assert a.indices.tolist() == b.indices.tolist(), note
            np.testing.assert_allclose(a.data, b.data, rtol=0, atol=TOLERANCE, err_msg=str(note))


@pytest.mark.parametrize("seeds", CHUNKS, ids=lambda r: f"{r.start}-{r.stop - 1}")
def test_random_models_have_the_entries_of_the_exact_enumeration(seeds: range) -> None:
    for seed in seeds:
        exact, symbolic = case(seed)
        assert_same(unreduced_pomdp(symbolic), exact.to_arrays(), seed)


@pytest.mark.parametrize("seeds", CHUNKS[:5], ids=lambda r: f"{r.start}-{r.stop - 1}")
def test_compiled_rewards_are_the_exact_expectations(seeds: range) -> None:
    for seed in seeds:
        exact, symbolic = case(seed)
        states = unreduced(symbolic).states
        for a, action in enumerate(symbolic.actions):
            totals = [F(0)] * exact.states
            for term in action.rewards:
                leaves = evaluate_states(term.diagram, states, symbolic.columns())
                totals = [q + term.values[int(leaf)] for q, leaf in zip(totals, leaves, strict=True)]
            expected = exact.rewards[a]
            assert all(
                t == r for t, r, end in zip(totals, expected, exact.terminal, strict=True) if not end
            )


@pytest.mark.parametrize("seeds", CHUNKS[5:], ids=lambda r: f"{r.start}-{r.stop - 1}")
def test_the_reachable_states_are_the_closure_and_keep_their_entries(seeds: range) -> None:
    for seed in seeds:
        exact, symbolic = case(seed)
        full = exact.to_arrays()
        waiting = [s for s, chance in enumerate(exact.initial) if chance]
        closure = set(waiting)
        while waiting:
            s = waiting.pop()
            after = {t for rows in exact.kernel for t, _ in rows[s]} - closure
            closure |= after
            waiting.extend(after)
        kept = sorted(closure)
        found = unreduced(symbolic, reachable=True)
        radix = np.array([len(f.values) for f in exact.features])
        numbers = [int(np.ravel_multi_index(tuple(state), tuple(radix))) for state in found.states]
        assert numbers == kept, seed
        pomdp = found.pomdp
        assert pomdp.terminal.tolist() == full.terminal[kept].tolist()
        np.testing.assert_allclose(pomdp.rewards, full.rewards[:, kept], rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(pomdp.initial, full.initial[kept], rtol=0, atol=TOLERANCE)
        # What is seen keeps its order, and is numbered without gaps.
        assert pomdp.observed.tolist() == np.unique(full.observed[kept], return_inverse=True)[1].tolist()
        for a, names in enumerate(full.observations):
            parts = {
                name: m[kept][:, kept].toarray() for name, m in zip(names, full.kernel[a], strict=True)
            }
            occurring = [name for name in names if parts[name].any()]
            if occurring:  # otherwise no reachable state is live
                assert pomdp.observations[a] == tuple(occurring), seed
            for name, matrix in zip(pomdp.observations[a], pomdp.kernel[a], strict=True):
                wanted = parts.get(name, np.zeros((len(kept), len(kept))))
                np.testing.assert_allclose(matrix.toarray(), wanted, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("seed", range(0, 60, 4))
def test_small_pieces_make_the_same_arrays(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    exact, symbolic = case(seed)
    monkeypatch.setattr(outcomes, "CELLS", 20)  # a few rows
    monkeypatch.setattr(expansion, "PIECE", 3)
    assert_same(unreduced_pomdp(symbolic), exact.to_arrays(), seed)
    reached = unreduced(symbolic, reachable=True)
    monkeypatch.undo()
    assert_same(reached.pomdp, unreduced_pomdp(symbolic, reachable=True), seed)


@pytest.mark.parametrize("seed", range(40))
def test_the_flat_mdp_is_the_enumerated_one(seed: int) -> None:
    model = random_model(seed, max_states=48)
    found, expected = unreduced_mdp(compile_model(model)), enumerate_model(model).to_arrays()
    assert found.actions == expected.actions
    assert found.applicable.tolist() == expected.applicable.tolist()
    assert found.terminal.tolist() == expected.terminal.tolist()
    np.testing.assert_allclose(found.rewards, expected.rewards, rtol=0, atol=TOLERANCE)
    for a, b in zip(found.transitions, expected.transitions, strict=True):
        assert a.indptr.tolist() == b.indptr.tolist()
        assert a.indices.tolist() == b.indices.tolist()
        np.testing.assert_allclose(a.data, b.data, rtol=0, atol=TOLERANCE)


def test_a_flat_mdp_does_not_see_observations() -> None:
    exact, symbolic = case(3)
    np.testing.assert_allclose(
        np.array([matrix.toarray() for matrix in unreduced_mdp(symbolic).transitions]),
        np.array([matrix.toarray() for matrix in exact.to_arrays().to_mdp().transitions]),
        rtol=0,
        atol=TOLERANCE,
    )


@pytest.mark.parametrize("seed", range(0, 60, 3))
def test_partially_observed_models_survive_their_file(seed: int) -> None:
    model = random_pomdp(seed)
    again = read_native(write_native(model)).model
    assert_same(unreduced_pomdp(compile_model(again)), unreduced_pomdp(case(seed)[1]), seed)


# -- by hand -----------------------------------------------------------------------------------------


def flat(model: Model, **options: Any) -> ArrayPOMDP:
    found = unreduced_pomdp(compile_model(model), **options)
    if not options:
        assert_same(found, enumerate_pomdp(model).to_arrays())
    return found


def test_the_tiger_problem_entry_by_entry() -> None:
    """Kaelbling, Littman & Cassandra 1998, section 3.3."""
    place = Feature("tiger", ("left", "right"))
    growl = Observation("growl", ("left", "right", "none"))
    heard = "switch(tiger', left: {left: 0.85, right: 0.15}, right: {left: 0.15, right: 0.85})"
    anew = "{left: 1/2, right: 1/2}"
    pomdp = flat(
        Model(
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
    )
    assert pomdp.observations == (("growl=left", "growl=right"), ("growl=none",), ("growl=none",))
    assert pomdp.kernel[0][0].toarray().tolist() == [[0.85, 0], [0, 0.15]]
    assert pomdp.kernel[0][1].toarray().tolist() == [[0.15, 0], [0, 0.85]]
    assert pomdp.kernel[1][0].toarray().tolist() == [[0.5, 0.5], [0.5, 0.5]]
    assert pomdp.rewards.tolist() == [[-1, -1], [-100, 10], [10, -100]]
    assert pomdp.initial.tolist() == [0.5, 0.5]


def test_a_synchronic_arc_is_drawn_after_its_parent_and_sensed_after_both() -> None:
    model = Model(
        "copy",
        [boolean("late"), boolean("early")],
        [
            Action(
                "step",
                {"late": "early'", "early": "bernoulli(0.25)"},
                senses={"same": "{true: 0.75, false: 0.25} if late' and not late else false"},
                rewards="8 if same else (4 if early' else 0)",
            )
        ],
        observability="partial",
        observations=[Observation("same", (False, True))],
    )
    quiet, loud = flat(model).kernel[0]
    # late' = early' = 1 with 1/4; from late = 0 it is then told with 3/4.
    assert quiet.toarray().tolist() == [[0.75, 0, 0, 0.0625]] * 2 + [[0.75, 0, 0, 0.25]] * 2
    assert loud.toarray().tolist() == [[0, 0, 0, 0.1875]] * 2 + [[0] * 4] * 2
    # 0.1875 * 8 + 0.0625 * 4, or 0.25 * 4
    assert flat(model).rewards.tolist() == [[1.75, 1.75, 1, 1]]


def test_a_blind_model_has_one_observation() -> None:
    model = Model("blind", [boolean("x")], [Action("flip", {"x": "not x"})], observability="partial")
    pomdp = flat(model)
    assert pomdp.observations == (("nothing",),)
    assert pomdp.kernel[0][0].toarray().tolist() == [[0, 1], [1, 0]]
    assert pomdp.observed.tolist() == [0, 0]


def test_a_fully_observed_model_tells_all_states_apart() -> None:
    model = Model("seen", [Feature("x", range(3)), boolean("y")], [Action("up", {"x": "min(x + 1, 2)"})])
    assert flat(model).observed.tolist() == [0, 1, 2, 3, 4, 5]


def test_observed_features_number_what_is_seen() -> None:
    features = [Feature("x", range(2), observed=True), boolean("y"), Feature("z", range(3), observed=True)]
    model = Model("mixed", features, [Action("wait")], initial={"x": "1"}, observability="partial")
    assert flat(model).observed.tolist() == [0, 1, 2, 0, 1, 2, 3, 4, 5, 3, 4, 5]
    assert flat(model, reachable=True).observed.tolist() == [0, 1, 2, 0, 1, 2]


def test_terminal_states_have_no_rows_and_no_rewards() -> None:
    model = Model(
        "ends",
        [Feature("x", range(3))],
        [Action("go", {"x": "{x: 1/2, x + 1: 1/2}"}, senses={"o": "{0: 1 - x, 1: x}"}, rewards="3")],
        terminal="x == 2",
        observability="partial",
        observations=[Observation("o", range(2))],
    )
    pomdp = flat(model)
    assert pomdp.terminal.tolist() == [False, False, True]
    assert pomdp.rewards.tolist() == [[3, 3, 0]]
    assert [matrix.toarray()[2].tolist() for matrix in pomdp.kernel[0]] == [[0] * 3] * 2
    over = Model(
        "over", model.features, [Action("wait"), model.actions[0]], terminal="true",
        observability="partial", observations=[Observation("o", (0, 1, "none"))],
    )  # fmt: skip
    assert flat(over).observations == (("o=0",), ("o=0",))


def test_few_reachable_states_of_a_huge_product_are_quick_to_list() -> None:
    count = 80  # 4^80 states do not fit into a machine word
    features = [Feature(f"x{i}", range(4), observed=i == 0) for i in range(count)]
    shift = {f"x{i}": f"x{i - 1}" for i in range(1, count)}
    model = Model(
        "register",
        features,
        [Action("shift", {**shift, "x0": 0}, senses={"last": f"x{count - 1}'"})],
        initial={"x0": "{1: 0.5, 2: 0.5}"} | {f"x{i}": 0 for i in range(1, count)},
        observability="partial",
        observations=[Observation("last", range(4))],
    )
    found = unreduced(compile_model(model, order="file"), reachable=True)
    assert found.pomdp.states == 2 * count + 1
    listed = list(map(tuple, found.states.tolist()))
    assert listed == sorted(set(listed))
    assert found.states[0].tolist() == [0] * count
    assert found.states[-1].tolist() == [2] + [0] * (count - 1)
    assert found.pomdp.observed.tolist() == found.states[:, 0].tolist()
    assert found.pomdp.observations == (("last=0", "last=1", "last=2"),)
    assert [matrix.nnz for matrix in found.pomdp.kernel[0]] == [2 * count - 1, 1, 1]


def test_states_that_are_found_one_after_the_other_are_quick_to_list() -> None:
    """`expon` counts through all 2^12 states; a_k keeps or makes x_k where it can: two outcomes if x_0 ..
    x_{k-1} are true and x_k is not, one else.  That is so in 2^(n-k-1) states, 2^n - 1 over all k."""
    n = 12
    symbolic = compile_model(load("expon", {"size": str(n)}).model)
    found = unreduced(symbolic, reachable=True)
    assert found.pomdp.states == 2**n
    assert sum(matrix.nnz for (matrix,) in found.pomdp.kernel) == n * 2**n + 2**n - 1
    assert_same(found.pomdp, unreduced_pomdp(symbolic))


def test_numbers_of_tuples_follow_the_order_of_tuples() -> None:
    generator = np.random.default_rng(0)
    for sizes in ([3, 2, 4], [1000] * 9, []):
        numbering = Numbering(sizes)
        digits = np.array([generator.integers(0, sizes) for _ in range(50)], dtype=np.int32).reshape(50, -1)
        numbers = numbering.number(digits)
        assert (numbering.tuples()[numbers] == digits).all()
        assert (numbering.number(digits[::-1]) == numbers[::-1]).all()
        distinct = sorted(set(map(tuple, digits.tolist())))
        assert [distinct[rank] for rank in numbering.ranks()] == list(
            map(tuple, numbering.tuples().tolist())
        )


def test_a_term_over_observations_can_be_compiled_later() -> None:
    model = Model(
        "later",
        [boolean("x")],
        [Action("look", senses={"o": "{0: 0.25, 3: 0.75} if x' else 0"}), Action("wait")],
        observability="partial",
        observations=[Observation("o", range(4), null=2)],
    )
    symbolic = compile_model(model)
    states = unreduced(symbolic).states
    expected = {0: [F(0), F(9, 4)], 1: [F(2), F(2)]}
    for action, means in expected.items():
        term = compile_term(symbolic, parse("o"), ("later",), action, symbolic.actions[action].app)
        leaves = evaluate_states(term.diagram, states, symbolic.columns())
        assert [term.values[int(leaf)] for leaf in leaves] == means


# -- limits ------------------------------------------------------------------------------------------


def counters(count: int) -> Model:
    """`count` counters to ten that move at random, each with a channel of its own."""
    names = [f"x{i}" for i in range(count)]
    return Model(
        "counters",
        [Feature(name, range(10)) for name in names],
        [
            Action(
                "roll",
                {name: f"{{{name}: 0.5, ({name} + 1) % 10: 0.5}}" for name in names},
                senses={f"see_{name}": f"{name}'" for name in names},
            )
        ],
        initial=dict.fromkeys(names, 0),
        observability="partial",
        observations=[Observation(f"see_{name}", range(10)) for name in names],
    )


LIMITS: list[tuple[int, dict[str, Any], str]] = [
    (3, {"maximum_states": 999}, "1000 states are more than the 999 that may be listed; raise max"),
    (40, {}, f"{10**40} states are more than"),
    (40, {"maximum_states": 500, "reachable": True}, "more than 500 states can be reached; raise max"),
    (2, {"maximum_observations": 99}, r"'roll' .*more than 99 joint observations of see_x0 \(10 values\)"),
    (3, {"maximum_entries": 7999}, "more than 7999 triples"),
]


@pytest.mark.parametrize(("count", "options", "message"), LIMITS)
def test_limits_say_what_to_do(count: int, options: dict[str, Any], message: str) -> None:
    with pytest.raises(LimitReached, match=message) as caught:
        flat(counters(count), **options)
    assert caught.value.stage.startswith("listing the ")


def test_what_is_just_within_the_limits_is_listed() -> None:
    found = flat(counters(2), maximum_states=100, maximum_observations=100, maximum_entries=400)
    assert (found.states, len(found.observations[0])) == (100, 100)


# -- faults, in both readings --------------------------------------------------------------------------


def faulty(senses: str, *, rewards: str = "0", effect: str = "x") -> Model:
    """x is 0, 1 or 2, where the process ends; the channel o is sensed by `go`."""
    return Model(
        "faulty",
        [Feature("x", range(3))],
        [Action("go", {"x": effect}, senses={"o": senses}, rewards=rewards)],
        terminal="x == 2",
        observability="partial",
        observations=[Observation("o", (0, 1))],
    )


READINGS: list[Callable[[Model], object]] = [enumerate_pomdp, compile_model]
SENSED, PAID = ("actions", "go", "senses", "o"), ("actions", "go", "reward", "0")
FAULTS = [
    ("{0: 0.5, 1: 0.4}", "0", SENSED, "the probabilities sum to 9/10"),
    ("x'", "0", SENSED, "2 is no"),
    ("1 / x", "0", SENSED, "division by zero"),
    ("{0: 1.5, 1: -0.5}", "0", SENSED, "-1/2"),
    ("x' >= 0", "0", SENSED, "true is no"),
    ("1", "1 / (1 - o)", PAID, "division by zero"),
    ("{0: 0.5, 1: 0.5}", "switch(o, 0: 5)", PAID, "has no"),
    ("1", "5 if o else 6", PAID, "a condition must be true or false"),
]


@pytest.mark.parametrize("read", READINGS)
@pytest.mark.parametrize(("senses", "rewards", "path", "text"), FAULTS)
def test_wrong_observations_are_reported(
    read: Callable[[Model], object], senses: str, rewards: str, path: tuple[str, ...], text: str
) -> None:
    with pytest.raises(ModelError) as caught:
        read(faulty(senses, rewards=rewards, effect="min(x + 1, 2)"))
    (fault,) = caught.value.faults
    assert fault.path == path
    assert text in str(fault)


def test_a_fault_of_an_observation_says_where_and_what_would_be_right() -> None:
    with pytest.raises(ModelError) as caught:
        compile_model(faulty("{0: 0.5, 1: 0.4} if x' == 1 else 0"))
    assert "the distribution of o at x'=1: the probabilities sum to 9/10" in str(caught.value)
    with pytest.raises(ModelError, match=r"the distribution of o at x=0, x'=1: .*values of 'o' are 0, 1"):
        compile_model(faulty("5 if x < x' else 0", effect="1"))
    with pytest.raises(ModelError, match="the reward is wrong at o=1: division by zero"):
        compile_model(faulty("1", rewards="1 / (1 - o)"))


HARMLESS = [
    ("(2 - x) // (2 - x)", "0", "x"),  # undefined where the process has ended
    ("{0: 1, 5: 0}", "0", "x"),  # no value, with probability 0
    ("1 if x' > 0 else 1 / 0", "0", "x + 1"),  # undefined after no action
    ("0", "1 / (1 - o)", "x"),  # an observation that never comes
    ("0 if x' == 0 else 1", "1 / (1 - o)", "0"),  # nor here, since x' is 0
    ("{0: 1, 1: 0}", "switch(o, 0: 5)", "x"),
]


@pytest.mark.parametrize(("senses", "rewards", "effect"), HARMLESS)
def test_what_can_not_happen_is_no_fault(senses: str, rewards: str, effect: str) -> None:
    pomdp = flat(faulty(senses, rewards=rewards, effect=effect))
    assert sum(matrix.sum() for matrix in pomdp.kernel[0]) == 2  # two live states


def test_a_channel_that_is_not_sensed_reports_nothing_else() -> None:
    model = faulty("{0: 0.5, 1: 0.5}")
    silent = Action("wait", rewards="1 / o")
    both = replace(model, observations=[Observation("o", (0, 1), null=1)], actions=[*model.actions, silent])
    assert flat(both).rewards.tolist() == [[0, 0, 0], [1, 1, 0]]
    with pytest.raises(ModelError, match="division by zero"):
        compile_model(replace(both, observations=[Observation("o", (0, 1), null=0)]))


def test_an_action_that_does_not_apply_everywhere_is_refused() -> None:
    x = Feature("x", range(2))
    model = Model("partly", [x], [Action("wait"), Action("up", {x: 1}, applicable="x == 0")])
    with pytest.raises(ModelError, match="'up' does not apply at x=1") as caught:
        unreduced_pomdp(compile_model(model))
    assert caught.value.faults[0].path == ("actions", "up", "applicable")
    ended = replace(model, terminal="x == 1")
    assert flat(ended).kernel[1][0].toarray().tolist() == [[0, 1], [0, 0]]


@pytest.mark.parametrize("observability", ["full", "partial"])
def test_a_reward_that_no_float_holds_is_refused_by_its_action(observability: str) -> None:
    """A number of a file may have 400 digits before the point; floats end at 1.8e308."""
    x = boolean("x")
    model = Model(
        "m", [x], [Action("a", rewards="1e399 if x else 0")], discount="0.9", observability=observability
    )
    with pytest.raises(ModelError, match=r"action 'a' has a reward beyond 10\^200"):
        flat_model(compile_model(model), reachable=False)
