"""SPUDD's language: what a text denotes, what is written back, and what is refused."""

from __future__ import annotations

import os
import random
from collections.abc import Mapping
from fractions import Fraction
from itertools import product
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_dynamics import constant
from random_models import random_model
from random_pomdps import random_pomdp

from factored_polca.explicit.alpha_expansion import forward_value
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.evaluate import distribution, evaluate
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.explicit.minimiser import minimise
from factored_polca.formats import read_native, write_native
from factored_polca.formats.spudd import read_spudd, read_spudd_with_warnings, write_spudd
from factored_polca.models import (
    Action,
    Fault,
    Feature,
    InitialBelief,
    Model,
    ModelError,
    Observation,
    Reference,
    boolean,
    check,
    conditional,
    lottery,
)
from factored_polca.models.expressions import Expression, references
from factored_polca.models.model import replace_fields

F = Fraction

OLD_STYLE = """
// a lamp and a battery; the comment has (brackets] and 'quotes'
(variables (lamp off on broken) (full-1 no yes))
action switch
  lamp (full-1 (yes (lamp (off (0.1 0.9 0))   // rows in the order off on broken
                          (on (0.5 0.25 0.25))
                          (broken (0 0 1))))
               (no (lamp (off (1 0 0)) (on (1 0 0)) (broken (0 0 1)))))
  full-1 (full-1 (no (1 0)) (yes (0.2 0.8)))
endaction
action wait
  lamp (SAMElamp)
  full-1 (0 1)
  cost (lamp (off (0)) (on (0.5)) (broken (0)))
endaction
reward (lamp (off (0)) (on (2)) (broken (-1.5)))
discount 0.9
tolerance 0.01
"""

PERSEUS_STYLE = """
(variables (lamp off on broken) (full-1 no yes))
unnormalised
dd flip
  (lamp (off (lamp' (off (1)) (on (9)) (broken (0))))
        (on (lamp' (off (2)) (on (1)) (broken (1))))
        (broken (lampbroken)))
enddd
dd out (lamp (off (lampoff)) (on (lampoff)) (broken (lampbroken))) enddd
action switch
  lamp [+ [* (full-1 (no (0)) (yes (1))) (flip)] [* (full-1 (no (3)) (yes (0))) (out)]]
  full-1 (full-1' (no (full-1 (no (0.5)) (yes (0.2)))) (yes (full-1 (no (0)) (yes (0.8)))))
endaction
action wait
  lamp (SAMElamp)
  full-1 (full-1yes)
  cost [- (lamp (off 0.5) (on 1) (broken 0.5)) (0.5)]
endaction
reward [+ (lamp (off (0)) (on (2)) (broken (0))) (lamp (off (0)) (on (0)) (broken (-1.5)))]
discount 0.9
horizon 7
"""

HIDDEN = """
(variables (place left right))
(observations (noise none hiss))
init (place (left (3)) (right (1)))
unnormalized
action listen
  place (SAMEplace)
  observe noise (place' (left (noise' (none (1)) (hiss (3)))) (right (noisenone))) endobserve
  cost 1
endaction
action jump
  place (place' (left (1)) (right (1)))
  observe noise (place (left (noise' (none (1)) (hiss (1)))) (right (noisehiss))) endobserve
  cost (noise' (none (0)) (hiss (place (left (2)) (right (-4)))))
endaction
discount 0.95
"""


def rows(text: str) -> ExactMDP:
    return enumerate_model(read_spudd(text, "test"))


def transition(mdp: ExactMDP, action: str, state: tuple[str, ...]) -> dict[tuple[object, ...], Fraction]:
    a = mdp.actions.index(action)
    return {mdp.state_values[t]: p for t, p in mdp.rows[a][mdp.index(state)].items()}


def small(body: str, *, variables: str = "(x a b) (y c d)", tail: str = "discount 0.5") -> str:
    return f"(variables {variables})\n{body}\n{tail}\n"


def refusal(text: str) -> str:
    with pytest.raises(ModelError) as caught:
        read_spudd(text, "test")
    assert all(fault.line >= 1 and fault.column >= 1 for fault in caught.value.faults)
    return str(caught.value)


# -- what a text denotes ----------------------------------------------------------------------


@pytest.mark.parametrize("text", [OLD_STYLE, PERSEUS_STYLE])
def test_both_styles_give_the_transitions_and_rewards_worked_out_by_hand(text: str) -> None:
    mdp = rows(text)
    assert mdp.states == 6
    assert transition(mdp, "switch", ("off", "yes")) == {
        ("off", "no"): F(1, 50), ("off", "yes"): F(4, 50),
        ("on", "no"): F(9, 50), ("on", "yes"): F(36, 50),
    }  # fmt: skip
    assert transition(mdp, "switch", ("on", "yes"))["broken", "yes"] == F(1, 4) * F(4, 5)
    assert transition(mdp, "switch", ("on", "no")) == {("off", "no"): 1}
    assert transition(mdp, "switch", ("broken", "no")) == {("broken", "no"): 1}
    assert transition(mdp, "wait", ("on", "no")) == {("on", "yes"): 1}
    expected = {"off": (0, 0), "on": (2, F(3, 2)), "broken": (F(-3, 2), F(-3, 2))}
    for state, (switch, wait) in product(mdp.state_values, [(0, 1)]):
        s = mdp.index(state)
        assert (mdp.rewards[switch][s], mdp.rewards[wait][s]) == expected[str(state[0])]
    assert mdp.discount == F(9, 10)


def test_horizon_is_kept_and_tolerance_is_not() -> None:
    assert read_spudd(PERSEUS_STYLE, "m").horizon == 7
    assert read_spudd(OLD_STYLE, "m").horizon is None


def test_a_model_read_has_no_structural_fault() -> None:
    for text in (OLD_STYLE, PERSEUS_STYLE, HIDDEN):
        assert check(read_spudd(text, "m")) == []


def test_a_feature_that_stays_has_no_effect() -> None:
    model = read_spudd(OLD_STYLE, "m")
    assert [name for name, _ in model.action("wait").effects] == ["full-1"]


def test_a_next_value_may_depend_on_another_next_value() -> None:
    mdp = rows(
        small(
            "action go y (0.25 0.75) "
            "x (y' (c (x (a (0.5 0.5)) (b (0 1)))) (d (SAMEx))) endaction "
            "reward (x' (a (8)) (b (y' (c (0)) (d (4)))))"
        )
    )
    assert transition(mdp, "go", ("a", "c")) == {
        ("a", "c"): F(1, 8), ("b", "c"): F(1, 8), ("a", "d"): F(3, 4),
    }  # fmt: skip
    # reward: 8 P(x'=a) + 4 P(x'=b, y'=d)
    assert mdp.rewards[0][mdp.index(("a", "c"))] == 7
    assert mdp.rewards[0][mdp.index(("b", "c"))] == 3


@pytest.mark.parametrize(
    ("tree", "value"),
    [
        ("[+ 1 2 3.5]", F(13, 2)),
        ("[* (2) (3) [+ (1) (1)]]", 12),
        ("[- (10) (1) (2)]", 7),
        ("[/ (12) (3) (2)]", 2),
        ("[+ (4)]", 4),
        ("-2.50", F(-5, 2)),
        ("(.125)", F(1, 8)),
        ("(1e-2)", F(1, 100)),
        ("[# x' (x' (a (3)) (b (1)))]", None),
    ],
)
def test_operators_take_their_arguments_from_left_to_right(tree: str, value: Fraction | None) -> None:
    mdp = rows(small(f"action go x (xb) y (SAMEy) endaction reward {tree}"))
    assert set(mdp.rewards[0]) == {F(1, 4) if value is None else value}


def test_a_tree_of_the_same_name_as_a_variable_with_branches_is_told_apart() -> None:
    mdp = rows(small("dd x (y (c (1)) (d (2))) enddd action go x (SAMEx) y (SAMEy) endaction reward (x)"))
    assert [mdp.rewards[0][mdp.index(("a", v))] for v in ("c", "d")] == [1, 2]


def test_a_named_tree_hides_the_implicit_one() -> None:
    mdp = rows(small("dd xa (x' (a (0)) (b (1))) enddd action go x (xa) y (SAMEy) endaction"))
    assert transition(mdp, "go", ("a", "c")) == {("b", "c"): 1}


def test_the_number_after_the_name_of_an_action_is_its_cost() -> None:
    mdp = rows(small("action go 2.5 x (SAMEx) y (SAMEy) endaction reward (1)"))
    assert set(mdp.rewards[0]) == {F(-3, 2)}


def test_all_spellings_of_a_primed_name_and_of_numeric_values_are_read() -> None:
    text = small(
        "action go x (x ' (0 (1)) (1 (0))) y (y' (c (0.5)) (d (0.5))) endaction",
        variables="(x 0 1) (y c d)",
    )
    assert transition(rows(text), "go", ("1", "c")) == {("0", "c"): F(1, 2), ("0", "d"): F(1, 2)}


def test_partial_observability_maps_onto_observations_senses_and_belief() -> None:
    model = read_spudd(HIDDEN, "m")
    assert model.observability == "partial"
    assert model.observations == (Observation("noise", ("none", "hiss")),)
    assert dict(model.initial.distributions)["place"] == lottery({"left": F(3, 4), "right": F(1, 4)})
    senses = {action.name: dict(action.senses)["noise"] for action in model.actions}

    def chances(action: str, now: str, after: str) -> object:
        places = {("place", False): now, ("place", True): after}
        return distribution(senses[action], ("none", "hiss"), places)

    assert chances("listen", "right", "left") == (F(1, 4), F(3, 4))
    assert chances("listen", "left", "right") == (1, 0)
    assert chances("jump", "left", "right") == (F(1, 2), F(1, 2))
    assert chances("jump", "right", "left") == (0, 1)
    (cost,) = model.action("jump").rewards
    assert evaluate(cost, {("place", False): "right", ("noise", False): "hiss"}) == 4
    assert evaluate(cost, {("place", False): "right", ("noise", False): "none"}) == 0


def test_no_observations_at_all_is_blind_not_fully_observed() -> None:
    text = "(variables (x a b)) (observations) action go x (SAMEx) endaction discount 0.5"
    model = read_spudd(text, "m")
    assert (model.observability, model.observations) == ("partial", ())


def test_an_initial_belief_is_divided_by_its_sum_and_joint_factors_are_kept() -> None:
    body = "action go x (SAMEx) y (SAMEy) z (SAMEz) endaction"
    text = small(f"init [* (x (a (y (c (1)) (d (2)))) (b (y (c (3)) (d (0))))) (z (e (1)) (f (1)))] {body}",
                 variables="(x a b) (y c d) (z e f) (w g h)")  # fmt: skip
    model, warnings = read_spudd_with_warnings(text.replace("z (SAMEz)", "z (SAMEz) w (SAMEw)"), "m")
    mdp = enumerate_model(model)
    # weights 1 2 3 0 over (x, y), sum 6, times 1/2 for z and 1/2 for w, which init does not mention
    for (x, y, _, _), p in zip(mdp.state_values, mdp.initial, strict=True):
        assert p == F({"ac": 1, "ad": 2, "bc": 3, "bd": 0}[f"{x}{y}"], 24)
    assert [fault.severity for fault in warnings] == ["warning"]
    assert "init" in warnings[0].message


# -- warnings ---------------------------------------------------------------------------------


def test_rounded_rows_are_divided_by_their_sums_with_one_warning() -> None:
    text = small(
        "action go x (x (a (0.33333 0.66666))\n (b (0.99995 0))) y (SAMEy) endaction"
    )  # misses 1e-5, 5e-5
    model, warnings = read_spudd_with_warnings(text, "m")
    assert transition(enumerate_model(model), "go", ("a", "c")) == {
        ("a", "c"): F(1, 3),
        ("b", "c"): F(2, 3),
    }
    (warning,) = warnings
    assert warning.severity == "warning"
    assert "2 rows" in warning.message
    assert "5e-05" in warning.message
    assert (warning.line, warning.column) == (3, 5)


def test_what_is_left_out_is_told_once_and_read_as_zero_or_as_staying() -> None:
    text = small("action go x (x' (a (1))) endaction action stay endaction reward (x (a (1)))")
    model, warnings = read_spudd_with_warnings(text, "m")
    mdp = enumerate_model(model)
    assert transition(mdp, "go", ("b", "d")) == {("a", "d"): 1}
    assert transition(mdp, "stay", ("b", "d")) == {("b", "d"): 1}
    assert [mdp.rewards[1][mdp.index((v, "c"))] for v in "ab"] == [1, 0]
    messages = [fault.message for fault in warnings]
    assert len(messages) == 2
    assert "some value: 2" in messages[0]
    assert "does not mention: 3" in messages[1]
    assert all(fault.severity == "warning" and fault.line for fault in warnings)


def test_a_clean_file_has_no_warning() -> None:
    assert read_spudd_with_warnings(OLD_STYLE, "m")[1] == ()


# -- refusals ---------------------------------------------------------------------------------

GO = "action go x (SAMEx) y (SAMEy) endaction"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "(variables"),
        ("(variables", "found the end of the file"),
        ("(variables)", "(variables"),
        ("(variables (x a b)", "')' in the list"),
        ("(variables (x a a))", "lists the value 'a' twice"),
        ("(variables (x a) (x b))", "'x' is declared twice"),
        ("(variables (x))", "'x' has no values"),
        ("(variables (cost a b))", "'cost' is a word of the language"),
        ("(variables (x a b)) (variables (y a b))", "a second 'variables'"),
        ("(states (x a b))", "expected 'variables' or 'observations'"),
        ("action go x (0 1) endaction", "(variables"),
        ("(variables (x a b)) {", "unexpected character '{'"),
        ("(variables (x a b)) belief x (0 1) endbelief", "unexpected 'belief'"),
        ("(variables (x a b)) (observations (o 3))", "Gaussian"),
        (small(GO, tail=""), "the file has no discount"),
        (small(""), "the file has no action"),
        (small(GO, tail="discount 1.5"), "not between 0 and 1"),
        (small(GO, tail="discount (x (a 0.5) (b 0.4))"), "depends on the state"),
        (small(GO, tail="discount 0.5 discount 0.5"), "a second 'discount'"),
        (small(GO, tail="discount 0.5 horizon 2.5"), "whole number of steps"),
        (small(GO + " " + GO), "action 'go' is defined twice"),
        (small(GO + " reward (1 2)"), "2 numbers in the reward"),
        (small(GO + " reward (x (a (1)) (a (2)))"), "a second branch for x = a"),
        (small(GO + " reward (x (c (1)))"), "'c' is no value of 'x'"),
        (small(GO + " reward (z (c (1)))"), "'z' is no variable"),
        (small(GO + " reward (x)"), "a variable without branches"),
        (small(GO + " reward (nothing)"), "'nothing' is no dd"),
        (small(GO + " reward (x (a (1)) (b (2)]"), "expected ')'"),
        (small(GO + " reward [+]"), "too few arguments"),
        (small(GO + " reward [- (1)]"), "too few arguments"),
        (small(GO + " reward [! (1)]"), "no operator that is read"),
        (small(GO + " reward [/ (1) (0)]"), "division by zero"),
        (small(GO + " reward (x (a ()) (b (1)))"), "a variable, the name of a dd or a number"),
        (small(GO + " reward " + "9" * 5000), "digits"),
        (small(GO + " reward 1e9999"), "exponent"),
        (small("dd m (1) enddd dd m (1) enddd" + GO), "dd 'm' is defined twice"),
        (small("dd m (1 0) enddd" + GO), "2 numbers in dd m"),
        (small("dd m (1)" + GO), "expected 'enddd'"),
        (small("init (x' (a 1) (b 2))" + GO), "can't depend on x'"),
        (small("init (x (a 0) (b 0))" + GO), "all weights are 0"),
        (small("init (x (a 2) (b -1))" + GO), "a weight is negative"),
        (small("action go x (1 0 0) y (SAMEy) endaction"), "3 probabilities"),
        (small("action go x (0.7 0.2) y (SAMEy) endaction"), "the row sums to 0.9"),
        (small("action go x (1.5 -0.5) y (SAMEy) endaction"), "b has weight -0.5"),
        (small("action go x (0.5 0.4999) y (SAMEy) endaction"), "the row sums to 0.9999"),
        (small("action go x (1) y (SAMEy) endaction"), "the row sums to 2"),
        (small("unnormalised action go x (0 0) y (SAMEy) endaction"), "all probabilities of the row are 0"),
        (small("action go x (SAMEx) x (SAMEx) endaction"), "gives 'x' twice"),
        (small("action go z (1 0) endaction"), "'z' is no variable"),
        (small("action go x (SAMEx) cost (1) cost (2) endaction"), "two costs"),
        (small("action go x (SAMEx)"), "'endaction'"),
        (small("action go x (y' (c (1 0)) (d (0 1))) y (x' (a (1 0)) (b (0 1))) endaction"), "in a circle"),
        (small("observe x (1 0) endobserve " + GO), "unexpected 'observe'"),
        ("(variables (x a b)) (observations (o u v)) action go x (SAMEx) endaction discount 0.5",
         "no observation function of 'o'"),
        ("(variables (x a b)) (observations (o u v)) action go x (o' (u (1 0)) (v (0 1))) endaction",
         "can't depend on o'"),
        ("(variables (x a b)) (observations (o u v)) action go x (SAMEx) observe o (o (u 1) (v 0))",
         "made after the action"),
        ("(variables (x a b)) (observations (o u v)) action go x (SAMEo) endaction", "no value before"),
        ("(variables (a bc d) (ab c d)) action go a (abc) endaction", "in two ways"),
    ],
)  # fmt: skip
def test_each_bad_text_is_refused_with_its_place_and_reason(text: str, told: str) -> None:
    assert told in refusal(text)


def test_a_bad_row_is_named_with_its_context_line_and_column() -> None:
    text = small(
        "action go\n x (y (c (1 0))\n      (d (x (a (0.5 0.6))\n (b (0.5 0.5))))) y (SAMEy) endaction"
    )
    with pytest.raises(ModelError) as caught:
        read_spudd(text, "test")
    (fault,) = caught.value.faults
    assert "x' in action go" in fault.message
    assert "sums to 1.1 where y = d, x = a" in fault.message
    assert (fault.line, fault.column) == (4, 16)
    assert "unnormalised" in fault.hint


def test_all_bad_rows_are_reported_at_once() -> None:
    text = small("action go x (0.5 0.1)\n y (0.2 0.2) endaction action to y (0 0.5) endaction")
    with pytest.raises(ModelError) as caught:
        read_spudd(text, "test")
    assert [fault.line for fault in caught.value.faults] == [2, 3, 3]


# -- bounded work -----------------------------------------------------------------------------


def chain(length: int, leaf: str, step: str) -> str:
    lines = [f"dd n0 {leaf} enddd"]
    lines += [f"dd n{i + 1} {step.replace('PREVIOUS', f'(n{i})')} enddd" for i in range(length)]
    return "\n".join(lines)


def test_named_trees_nested_exponentially_stay_shared() -> None:
    variables = " ".join(f"(v{i} a b)" for i in range(150))
    steps = ["dd n0 (1) enddd"]
    steps += [f"dd n{i + 1} (v{i} (a (n{i})) (b [+ (n{i}) (n{i})])) enddd" for i in range(60)]
    text = small("\n".join(steps) + " action go endaction reward (n60)", variables=variables)
    model = read_spudd(text, "m")  # unfolded, 3^60 nodes
    (term,) = model.rewards
    assert evaluate(term, {(f"v{i}", False): "a" for i in range(150)}) == 1


def test_a_shared_chain_of_decisions_is_a_distribution_and_is_written_back_with_names() -> None:
    count = 30
    variables = "(x a b) " + " ".join(f"(v{i} a b)" for i in range(count))
    # parity of v0..v29 decides x'
    lines = ["dd e0 (xa) enddd dd o0 (xb) enddd"]
    lines += [
        f"dd e{i + 1} (v{i} (a (e{i})) (b (o{i}))) enddd dd o{i + 1} (v{i} (a (o{i})) (b (e{i}))) enddd"
        for i in range(count)
    ]
    stays = " ".join(f"v{i} (SAMEv{i})" for i in range(count))
    text = small(f"{' '.join(lines)} action go x (e{count}) {stays} endaction", variables=variables)
    model = read_spudd(text, "m")
    again = read_spudd(write_spudd(model), "m")
    for seed in range(20):
        chosen = random.Random(seed).choices("ab", k=count)
        state = {(f"v{i}", False): value for i, value in enumerate(chosen)}
        expected = (F(1), F(0)) if chosen.count("b") % 2 == 0 else (F(0), F(1))
        for m in (model, again):
            assert distribution(dict(m.action("go").effects)["x"], ("a", "b"), state) == expected
    assert len(write_spudd(model)) < 20_000  # unfolded, 2^30 rows


def test_weights_that_would_take_exponential_work_stay_expressions() -> None:
    count = 40
    variables = "(x a b) " + " ".join(f"(v{i} a b)" for i in range(count))
    parts = " ".join(f"(v{i} (a (1)) (b (x' (a (2)) (b ({i + 2})))))" for i in range(count))
    text = small(f"unnormalised action go x [* {parts}] endaction", variables=variables)
    effect = dict(read_spudd(text, "m").action("go").effects)["x"]
    state = {(f"v{i}", False): "b" if i in (3, 5) else "a" for i in range(count)}
    # weights 2*2 and 5*7
    assert distribution(effect, ("a", "b"), state) == (F(4, 39), F(35, 39))


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (small(GO + " reward " + "(x (a " * 5000), "nested deeper than 200 levels"),
        (small(GO + " reward " + "[+ " * 5000), "nested deeper than 200 levels"),
        (small(chain(300, "(1)", "(y (c PREVIOUS) (d [+ (x' (a 1) (b 2)) PREVIOUS]))") + GO),
         "nested deeper than 200 levels"),
        (small(chain(40, "(1.1)", "[* PREVIOUS PREVIOUS]") + GO), "too many digits"),
        (f"(variables ({'x' * 300} a b))", "a name of more than 255 characters"),
    ],
)  # fmt: skip
def test_oversized_texts_are_refused_by_counting(text: str, told: str) -> None:
    assert told in refusal(text)


def test_deep_texts_within_the_limit_are_read() -> None:
    depth = 190
    text = small(GO + " reward " + "(x (b 0) (a " * depth + "(7)" + "))" * depth)
    mdp = rows(text)
    assert mdp.rewards[0][mdp.index(("a", "c"))] == 7


# -- writing ----------------------------------------------------------------------------------


def same_but_for_terminal(model: Model, again: Model) -> None:
    """`again` has the states of `model` in the same order, terminal ones absorbing with reward 0."""
    one, two = enumerate_model(model), enumerate_model(again)
    assert (one.states, one.discount, len(one.actions)) == (two.states, two.discount, len(two.actions))
    assert one.initial == two.initial
    for a, s in product(range(len(one.actions)), range(one.states)):
        if one.terminal[s]:
            assert (two.rows[a][s], two.rewards[a][s]) == ({s: 1}, 0)
        else:
            assert (two.rows[a][s], two.rewards[a][s]) == (one.rows[a][s], one.rewards[a][s])


def with_decimals(model: Model) -> Model:
    """`model` with rewards and discount that are decimals; its probabilities stay as they are."""

    def scaled(terms: tuple[Expression, ...]) -> tuple[Expression, ...]:
        return tuple(term * 2520 for term in terms)

    actions = [
        Action(a.name, a.effects, applicable=a.applicable, rewards=scaled(a.rewards), senses=a.senses)
        for a in model.actions
    ]
    return replace_fields(model, actions=tuple(actions), rewards=scaled(model.rewards), discount=F(9, 10))


@pytest.mark.parametrize("seed", range(60))
def test_a_written_model_is_read_back_as_the_same_mdp(seed: int) -> None:
    model = random_model(seed, inapplicable=False, parameters=seed % 3 == 0, max_states=100)
    model = with_decimals(model)
    same_but_for_terminal(model, read_spudd(write_spudd(model), model.name))


@pytest.mark.parametrize("text", [OLD_STYLE, PERSEUS_STYLE])
def test_a_model_that_was_read_is_written_and_read_back(text: str) -> None:
    model = read_spudd(text, "m")
    again = read_spudd(write_spudd(model), "m")
    same_but_for_terminal(model, again)
    assert again.horizon == model.horizon


def test_a_pomdp_is_written_and_read_back_unchanged() -> None:
    model = read_spudd(HIDDEN, "m")
    again = read_spudd(write_spudd(model), "m")
    assert again == model


@pytest.mark.parametrize("seed", range(60))
def test_a_written_pomdp_is_read_back_as_the_same(seed: int) -> None:
    model = with_decimals(random_pomdp(seed))
    if any(feature.observed for feature in model.features):
        first = [(f.name, constant(f.values[0])) for f in model.features if f.observed]
        kept = [d for d in model.initial.distributions if not model.feature(d[0]).observed]
        model = replace_fields(model, initial=InitialBelief(first + kept * (not model.initial.factors)))
    ours, theirs = enumerate_pomdp(model), enumerate_pomdp(read_spudd(write_spudd(model), "m"))
    assert theirs.initial == ours.initial
    assert theirs.states == ours.states
    for a in range(len(ours.actions)):
        for s, ended in enumerate(ours.terminal):
            row = theirs.kernel[a][s]
            assert theirs.rewards[a][s] == ours.rewards[a][s]
            if ended:
                assert {t for t, _ in row} == {s}
                continue
            mine = ours.kernel[a][s]
            assert sorted((t, p) for (t, _), p in row.items()) == sorted(
                (t, p) for (t, _), p in mine.items()
            )
    arrays, back = ours.to_arrays(), theirs.to_arrays()
    value = forward_value(arrays, arrays.initial, 3)
    assert forward_value(back, back.initial, 3) == pytest.approx(value, rel=1e-12)


def test_thirds_are_written_as_whole_number_weights() -> None:
    x = Feature("x", ["a", "b", "c"])
    effects = {x: lottery({"a": F(1, 3), "b": F(1, 6), "c": F(1, 2)})}
    model = Model("m", [x], [Action("go", effects)], rewards=1, discount="0.9")
    text = write_spudd(model)
    assert "unnormalised" in text
    assert "(2 1 3)" in text
    same_but_for_terminal(model, read_spudd(text, "m"))


def test_an_initial_network_with_thirds_keeps_its_conditional_weights() -> None:
    x, y = Feature("x", ["a", "b"]), Feature("y", ["c", "d"])
    third, fifth = lottery({"c": F(1, 3), "d": F(2, 3)}), lottery({"c": F(1, 5), "d": F(4, 5)})
    first = lottery({"a": F(1, 7), "b": F(6, 7)})
    initial = InitialBelief({x: first, y: conditional(x.is_("a"), third, fifth)})
    model = Model("m", [x, y], [Action("go")], initial=initial)
    same_but_for_terminal(model, read_spudd(write_spudd(model), "m"))


def test_names_that_the_language_lacks_are_replaced_and_told() -> None:
    features = [Feature("my place", [-1, 0, 1]), boolean("cost"), Feature("my_place", ["a b", "a_b", "2"])]
    model = Model(
        "a}", features, [Action("go!", {"cost": True}), Action("go?")], rewards="`my place` * 2",
        description="two\nlines}",
    )  # fmt: skip
    text = write_spudd(model)
    again = read_spudd(text, "m")
    assert [f.name for f in again.features] == ["my_place_2", "cost_2", "my_place"]
    assert again.features[0].values == ("v_1", "v0", "v1")
    assert again.features[1].values == ("false", "true")
    assert again.features[2].values == ("a_b_2", "a_b", "v2")
    assert [action.name for action in again.actions] == ["go_", "go__2"]
    assert "my place is my_place_2" in text
    same_but_for_terminal(model, again)


def test_terminal_states_become_absorbing_and_the_file_says_so() -> None:
    x = Feature("x", range(4))
    step = Action("step", {x: lottery([(x + 1, F(1, 2)), (x.now, F(1, 2))])}, rewards=-1)
    stop = Action("stop", {x: 0}, rewards=[x * 2, 1])
    model = Model("walk", [x], [step, stop], rewards=x.next, terminal=x.is_(3), discount="0.9")
    text = write_spudd(model)
    assert "absorbing" in text
    same_but_for_terminal(model, read_spudd(text, "walk"))


SWITCH = Feature("s", ["on", "off"])


@pytest.mark.parametrize(
    ("model", "told"),
    [
        (Model("m", [SWITCH], [Action("go", applicable=SWITCH.is_("on"))]), "applicable everywhere"),
        (Model("m", [Feature("x", ["only"])], [Action("go")]), "two values or more"),
        (Model("m", [SWITCH], [Action("go")], rewards="1/3"), "decimals only"),
        (Model("m", [SWITCH], [Action("go")], discount="1/3"), "decimals only"),
        (Model("m", [Feature("x", [1, 2], observed=True)], [Action("go")], observability="partial"),
         "no observed features"),
        (Model("m", [Feature("x", range(3))], [Action("go", {"x": "x + 1"})]), "none of its values"),
        (Model("m", [Feature("x", range(3))], [Action("go")], rewards="1 / x"), "division by zero"),
        (Model("m", [SWITCH], [Action("go", {"s": lottery({"on": "0.5"})})]), "sums to 0.5"),
        (Model("m", [SWITCH], [Action("go", {"t": lottery({"on": 1})})]), "no feature"),
        (Model("m", [Feature(f"x{i}", [0, 1]) for i in range(40)], [Action("go")],
               rewards=" * ".join(f"(x{i} + {i + 2})" for i in range(40))), "too large"),
    ],
)  # fmt: skip
def test_what_the_language_lacks_is_refused_with_the_reason(model: Model, told: str) -> None:
    with pytest.raises(ModelError) as caught:
        write_spudd(model)
    assert told in str(caught.value)


def test_a_sum_of_many_terms_is_written_as_a_sum() -> None:
    bits = [boolean(f"x{i}") for i in range(40)]
    model = Model("m", bits, [Action("go")], rewards=" + ".join(f"(1 if x{i} else 0)" for i in range(40)))
    assert len(read_spudd(write_spudd(model), "m").rewards) == 40


# -- any text ---------------------------------------------------------------------------------

PIECES = (
    (OLD_STYLE + PERSEUS_STYLE + HIDDEN).split() + list("()[]'+*-/#!:@$") + ["0", "-1", "1e5", "\x00", "é"]
)


def read_or_refuse(text: str) -> None:
    faults: tuple[Fault, ...] = ()
    try:
        read_spudd_with_warnings(text, "any")
    except ModelError as error:
        faults = error.faults
    assert all(fault.line >= 1 and fault.column >= 1 for fault in faults)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.lists(st.sampled_from(PIECES), max_size=60))
def test_any_sequence_of_tokens_is_read_or_refused(pieces: list[str]) -> None:
    read_or_refuse(" ".join(pieces))
    read_or_refuse("(variables (lamp off on broken) (full-1 no yes)) " + " ".join(pieces))


@settings(max_examples=150, deadline=None, derandomize=True)
@given(st.text(max_size=80))
def test_any_text_is_read_or_refused(text: str) -> None:
    read_or_refuse(text)
    read_or_refuse(small(GO + " reward " + text))


@pytest.mark.parametrize("sample", [OLD_STYLE, PERSEUS_STYLE, HIDDEN])
def test_changed_samples_are_read_or_refused(sample: str) -> None:
    generator = random.Random(5)
    for _ in range(250):
        text = sample
        for _ in range(generator.randint(1, 3)):
            at = generator.randrange(len(text))
            length = generator.choice((0, 1, 1, 5, 40))
            text = text[:at] + generator.choice(["", generator.choice(PIECES), " "]) + text[at + length :]
        read_or_refuse(text)


# -- files made by others ---------------------------------------------------------------------


@pytest.fixture
def data() -> Path:
    folder = os.environ.get("FACTORED_POLCA_DATA")
    assert folder, "tests marked 'data' need the folder named by FACTORED_POLCA_DATA"
    return Path(folder)


@pytest.mark.data
@pytest.mark.parametrize(
    ("file", "states", "blocks"),
    # numbers of states: products of the declared values; blocks: enumeration by the author
    [("coffee.dat", 64, 40), ("tiny-factory.dat", 96, 21)],
)
def test_the_published_mdps_have_the_known_numbers_of_blocks(
    data: Path, file: str, states: int, blocks: int
) -> None:
    model, warnings = read_spudd_with_warnings((data / file).read_text(), file)
    assert (model.states, warnings) == (states, ())
    assert minimise(enumerate_model(model)).blocks == blocks
    again = read_spudd(write_spudd(model), file)
    same_but_for_terminal(model, again)


@pytest.mark.data
def test_factory_has_the_known_number_of_states(data: Path) -> None:
    model = read_spudd((data / "factory.dat").read_text(), "factory")
    assert (model.states, len(model.actions), check(model)) == (55_296, 14, [])


@pytest.mark.data
def test_the_published_tiger_is_the_tiger(data: Path) -> None:
    model = read_spudd((data / "tiger.95.SPUDD").read_text(), "tiger")
    assert (model.states, model.observability, model.discount) == (2, "partial", F(19, 20))
    senses = dict(model.action("listen").senses)["growl"]
    values: Mapping[object, str] = {("tiger-location", True): "tiger-left"}
    assert distribution(senses, ("growl-left", "growl-right"), values) == (F(17, 20), F(3, 20))
    opened = model.action("open-left").rewards
    assert [evaluate(e, {("tiger-location", False): "tiger-left"}) for e in opened] == [-100]
    assert dict(model.action("listen").effects) == {}
    assert read_spudd(write_spudd(model), "tiger") == model


@pytest.mark.data
def test_the_published_coffee_pomdp_is_normalised_as_its_comments_say(data: Path) -> None:
    model, warnings = read_spudd_with_warnings((data / "coffee.90.SPUDD").read_text(), "coffee")
    assert (model.states, model.observability, warnings, check(model)) == (432, "partial", (), [])
    # move with a low battery: weights (0.1 + 1, 0.9 + 1) from the office, divided by 3
    effect = dict(model.action("move").effects)["l"]
    state = {("l", False): "office", ("batt", False): "low"}
    assert distribution(effect, ("office", "shop"), state) == (F(11, 30), F(19, 30))
    # 9 to 1 by the file's unnormalised tree
    huc = dict(model.action("nothing").effects)["huc"]
    assert distribution(huc, ("yes", "no"), {("huc", False): "yes"}) == (F(9, 10), F(1, 10))
    # the robot can get wet from spilling only if it got the coffee just now: a synchronic arc
    assert Reference("hrc", primed=True) in references(dict(model.action("buyc_fast").effects)["w"])
    assert read_spudd(write_spudd(model), "coffee") == model


def test_products_of_products_keep_their_brackets_in_the_native_format() -> None:
    trees = "(x (a (3)) (b (2)))", "(y (c (5)) (d (1)))", "(y (c (7)) (d (11)))"
    reward = f"[* 2 3 [* {trees[0]} {trees[1]}] [+ 1 4 [+ {trees[2]} {trees[0]}]]]"
    text = small("action go x (SAMEx) y (SAMEy) endaction reward " + reward)
    model = read_spudd(text, "test")
    back = read_native(write_native(model)).model
    assert back == model
    earned = [float(r) for r in enumerate_model(back).rewards[0]]
    x, y, z = {"a": 3, "b": 2}, {"c": 5, "d": 1}, {"c": 7, "d": 11}
    assert earned == [6 * x[u] * y[v] * (5 + z[v] + x[u]) for u in "ab" for v in "cd"]
