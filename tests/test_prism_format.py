"""PRISM's language: what a program denotes, what is written back, and what is refused."""

from __future__ import annotations

import json
from collections.abc import Sequence
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path

import pytest
from random_models import random_model

from factored_polca.cli import main
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_dynamic_programming import optimal_solution
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.formats import prism_process, read, write
from factored_polca.formats.prism import read_prism
from factored_polca.formats.prism_expressions import number
from factored_polca.formats.prism_process import RawProgram, parse_program
from factored_polca.formats.prism_spelling import Spelling
from factored_polca.formats.prism_text import scan
from factored_polca.formats.prism_writer import write_prism
from factored_polca.models import Action, Feature, InitialBelief, Model, ModelError, boolean, check, lottery
from factored_polca.models.model import replace_fields

F = Fraction

with_storm = pytest.mark.skipif(find_spec("stormpy") is None, reason="needs the extra `storm`")

DIE = """dtmc
// Knuth and Yao's die from a fair coin
module die
  s : [0..7] init 0;
  d : [0..6] init 0;
  [] s=0 -> 0.5 : (s'=1) + 0.5 : (s'=2);
  [] s=1 -> 0.5 : (s'=3) + 0.5 : (s'=4);
  [] s=2 -> 0.5 : (s'=5) + 0.5 : (s'=6);
  [] s=3 -> 0.5 : (s'=1) + 0.5 : (s'=7) & (d'=1);
  [] s=4 -> 0.5 : (s'=7) & (d'=2) + 0.5 : (s'=7) & (d'=3);
  [] s=5 -> 0.5 : (s'=7) & (d'=4) + 0.5 : (s'=7) & (d'=5);
  [] s=6 -> 0.5 : (s'=2) + 0.5 : (s'=7) & (d'=6);
endmodule
label "thrown" = s=7;
rewards "flips" s<7 : 1; endrewards
rewards "six" s!=7 : 0; [] s=6 : 0.5; endrewards
"""

WALK = """mdp
const int N;
const double p;
const double q = 1 - p;
const bool fast = false;
formula last = x=N;
global turns : [0..2] init 0;
module walker
  x : [0..N];
  [go] !last -> p : (x'=x+1) + q : (x'=max(x-1, 0));
  [go] fast & !last -> (x'=N);
  [wait] true -> true;
  [] turns<2 -> (turns'=turns+1) & (x'=0);
endmodule
module weather
  wet : bool init true;
  [go] wet -> 0.25 : (wet'=false) + 0.75 : true;
  [go] !wet -> (wet'=true);
endmodule
module other = weather [wet=damp, go=wait] endmodule
label "there" = last;
rewards "pay"
  wet : 2;
  [go] x>0 : x/4;
  [] true : mod(x - 3, 2);
endrewards
"""


def model_of(text: str, **settings: str) -> Model:
    model, _, _ = read_prism(text, {"discount": "0.9", **settings})
    assert check(model) == []
    return model


def fault_of(text: str, **settings: str) -> str:
    with pytest.raises(ModelError) as caught:
        read_prism(text, settings)
    return str(caught.value)


def row(mdp: ExactMDP, action: str, state: Sequence[object]) -> dict[tuple[object, ...], Fraction]:
    a, s = mdp.actions.index(action), mdp.state_values.index(tuple(state))  # type: ignore[arg-type]
    return {mdp.state_values[t]: chance for t, chance in mdp.rows[a][s].items()}


def reward(mdp: ExactMDP, action: str, state: Sequence[object]) -> Fraction:
    return mdp.rewards[mdp.actions.index(action)][mdp.state_values.index(tuple(state))]  # type: ignore[arg-type]


@with_storm
def test_a_die_takes_eleven_thirds_of_a_flip() -> None:
    """Knuth and Yao (1976): 11/3 flips; and a six is as likely as any other number, 1/6."""
    for structure, value in (("flips", F(11, 3)), ("six", F(1, 6))):
        model = model_of(DIE, discount="1", rewards=structure, terminal="thrown")
        mdp = enumerate_model(model)
        solution = optimal_solution(mdp)
        assert solution.values[mdp.index((0, 0))] == value
        assert [action.name for action in model.actions] == ["step"]


@with_storm
def test_outcomes_assign_several_variables_at_once() -> None:
    mdp = enumerate_model(model_of(DIE, rewards="flips"))
    assert row(mdp, "step", (3, 0)) == {(1, 0): F(1, 2), (7, 1): F(1, 2)}
    assert row(mdp, "step", (4, 5)) == {(7, 2): F(1, 2), (7, 3): F(1, 2)}
    assert row(mdp, "step", (7, 3)) == {(7, 3): F(1)}  # nothing is enabled: it stays


@with_storm
def test_modules_synchronise_and_overlapping_commands_are_distinct_actions() -> None:
    model = model_of(WALK, N="2", p="1/3", fast="true")
    assert [a.name for a in model.actions] == ["go_1", "go_2", "wait", "walker"]
    assert [f.name for f in model.features] == ["turns", "x", "wet", "damp"]
    assert dict(model.parameters) == {"p": F(1, 3)}
    mdp = enumerate_model(model)
    assert row(mdp, "go_1", (0, 1, True, False)) == {
        (0, 2, False, False): F(1, 12), (0, 2, True, False): F(1, 4),
        (0, 0, False, False): F(1, 6), (0, 0, True, False): F(1, 2),
    }  # fmt: skip
    assert row(mdp, "go_2", (0, 0, False, True)) == {(0, 2, True, True): F(1)}
    assert row(mdp, "wait", (1, 2, True, False)) == {(1, 2, True, True): F(1)}  # the renamed copy
    assert row(mdp, "walker", (1, 2, True, True)) == {(2, 0, True, True): F(1)}
    at_end = mdp.state_values.index((0, 2, True, True))
    applicable = [name for a, name in enumerate(mdp.actions) if mdp.applicable[a][at_end]]
    assert applicable == ["wait", "walker"]


@with_storm
def test_without_an_overlap_they_are_one_action() -> None:
    model = model_of(WALK, N="2", p="0.5")
    assert [a.name for a in model.actions] == ["go", "wait", "walker"]


@with_storm
def test_rewards_of_states_actions_and_unlabelled_commands() -> None:
    mdp = enumerate_model(model_of(WALK, N="4", p="1/3"))
    assert reward(mdp, "go", (0, 3, True, True)) == 2 + F(3, 4)
    assert reward(mdp, "go", (0, 0, False, True)) == 0
    assert reward(mdp, "wait", (0, 3, True, True)) == 2
    assert reward(mdp, "walker", (0, 2, False, True)) == 1  # mod(-1, 2)
    costs = enumerate_model(model_of(WALK, N="4", p="1/3", costs="pay"))
    assert reward(costs, "go", (0, 3, True, True)) == -2 - F(3, 4)


@with_storm
def test_a_dtmc_chooses_evenly_among_what_is_enabled() -> None:
    text = """dtmc
    module a x : [0..2]; [] x<2 -> (x'=x+1); [s] x=1 -> (x'=0); endmodule
    module b y : [0..1]; [] true -> 1/4:(y'=0) + 3/4:(y'=1); [s] y=1 -> (y'=0); endmodule
    rewards [s] true : 6; y=1 : 1; endrewards
    """
    mdp = enumerate_model(model_of(text))
    third = F(1, 3)
    assert row(mdp, "step", (1, 1)) == {
        (2, 1): third, (1, 0): third / 4, (1, 1): third * 3 / 4, (0, 0): third,
    }  # fmt: skip
    assert reward(mdp, "step", (1, 1)) == 1 + 6 * third
    assert row(mdp, "step", (2, 0)) == {(2, 0): F(1, 4), (2, 1): F(3, 4)}


@with_storm
def test_a_deadlock_stays_and_a_terminal_state_ends() -> None:
    text = """mdp module m x : [0..2]; [up] x<2 -> (x'=x+1); endmodule
    label "top" = x=2; rewards x=2 : 5; endrewards"""
    mdp = enumerate_model(model_of(text))
    assert mdp.actions == ("up", "stay")
    assert reward(mdp, "stay", (2,)) == 5
    assert row(mdp, "stay", (2,)) == {(2,): F(1)}
    ended = model_of(text, terminal="top")
    assert [a.name for a in ended.actions] == ["up"]
    assert enumerate_model(ended).terminal == (False, False, True)


@with_storm
def test_a_command_is_not_enabled_where_it_would_leave_a_range() -> None:
    text = """mdp module m x : [0..2]; busy : bool;
    [up] busy -> 1/2:(x'=x+1) + 1/2:(busy'=false);
    [down] busy -> (x=0 ? 0 : 1/3):(x'=x-1) + (x=0 ? 1 : 2/3):true; endmodule"""
    model, warnings, _ = read_prism(text, {"discount": "0.9"})
    (place,) = [(w.line, w.column) for w in warnings if "out of its range" in w.message]
    assert place == (2, 5)  # the other command has probability 0 there
    mdp = enumerate_model(model)
    enabled = {
        name: [values for s, values in enumerate(mdp.state_values) if mdp.applicable[a][s]]
        for a, name in enumerate(mdp.actions)
    }
    assert enabled["up"] == [(0, True), (1, True)]
    assert enabled["down"] == [(0, True), (1, True), (2, True)]


@with_storm
def test_init_is_uniform_over_its_states() -> None:
    text = """mdp
    module m x : [0..3]; y : [0..1]; z : [0..2]; b : bool; [a] true -> (z'=0); endmodule
    init x>=1 & (y=0 | b) & z!=1 endinit
    """
    model, warnings, _ = read_prism(text, {"discount": "1/2"})
    initial = enumerate_model(model).initial
    assert set(initial) == {F(0), F(1, 3 * 3 * 2)}
    assert any("uniform" in str(warning) for warning in warnings)
    assert "no state satisfies init" in fault_of(text.replace("x>=1", "x>3"), discount="1/2")


@with_storm
def test_constants_are_set_and_follow_each_other() -> None:
    text = """mdp
    const int M = 1; const int N = 2*M; const double p = 0.5; const double q = p/2;
    module m x : [0..N]; [a] true -> q : (x'=M) + 1-q : (x'=0); endmodule
    """
    model = model_of(text, M="3", p="1/4")
    assert model.features[0].values == tuple(range(7))
    assert dict(model.parameters) == {"p": F(1, 4)}
    mdp = enumerate_model(model.with_parameters({"p": F(1, 2)}))
    assert row(mdp, "a", (5,)) == {(3,): F(1, 4), (0,): F(3, 4)}


@with_storm
def test_probabilities_that_miss_one_by_rounding_are_divided() -> None:
    text = (
        "mdp module m x : [0..2]; [a] true -> 0.33333:(x'=0) + 0.33333:(x'=1) + 0.33333:(x'=2); endmodule"
    )
    model, warnings, _ = read_prism(text, {"discount": "0.9"})
    assert row(enumerate_model(model), "a", (0,)) == {(k,): F(1, 3) for k in range(3)}
    assert any(warning.line == 1 and "divided" in warning.message for warning in warnings)


@with_storm
@pytest.mark.parametrize(
    ("change", "settings", "message"),
    [
        (("", ""), {"discount": "0.9", "N": "2"}, "2:"),
        (("", ""), {"N": "2", "p": "0.5"}, "--set discount="),
        (("", ""), {"N": "2", "p": "0.5", "discount": "0.9", "fas": "3"}, "nothing called 'fas' to set"),
        (("", ""), {"N": "2.5", "p": "0.5", "discount": "0.9"}, "N is an int constant"),
        (("", ""), {"N": "x", "p": "0.5", "discount": "0.9"}, "N is a number"),
        (("", ""), {"N": "2", "p": "0.5", "discount": "0.9", "fast": "1"}, "true or false"),
        (("", ""), {"N": "-1", "p": "0.5", "discount": "0.9"}, "[0..-1]"),
        (("", ""), {"N": "2", "p": "0.5", "discount": "0.9", "terminal": "here"}, "labels are there"),
        (("", ""), {"N": "2", "p": "0.5", "discount": "0.9", "rewards": "gain"}, "there are pay"),
        (("wet : 2;", "wet 2;"), {"N": "2", "p": "0.5", "discount": "0.9"}, "expected ':' in a reward"),
        (("[go] x>0", "[run] x>0"), {"N": "2", "p": "0.5", "discount": "0.9"}, "the action 'run'"),
        (("x/4", "log(x, 2)"), {"N": "2", "p": "0.5", "discount": "0.9"}, "operator that is not read"),
        (("x/4", "zzz/4"), {"N": "2", "p": "0.5", "discount": "0.9"}, "line 24, column 3: Storm's parser"),
        (("[wait] true", "[wait] ture"), {"N": "2", "p": "0.5", "discount": "0.9"}, "line 12, column"),
    ],
)  # fmt: skip
def test_faults_say_what_is_wrong_and_where(
    change: tuple[str, str], settings: dict[str, str], message: str
) -> None:
    assert message in fault_of(WALK.replace(*change), **settings).replace("line 3, column 14", "2:")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ctmc module m x : [0..1]; [] true -> 3.5 : (x'=1); endmodule", "continuous-time Markov chains"),
        ("pta module m c : clock; endmodule", "timed automata"),
        ("pomdp observables x endobservables", "partially observed models"),
        ("smg player p1 m endplayer", "games"),
        ("ma module m endmodule", "Markov automata"),
        ("mdp module m c : clock; endmodule", "c is of the type clock"),
        ("mdp module m c : int; endmodule", "give it bounds"),
        (
            "mdp module m x : [0..1]; [] true -> [0.1,0.2]:(x'=1) + [0.8,0.9]:(x'=0); endmodule",
            "an interval",
        ),
        ("mdp module m endmodule system m || m endsystem", "a system block"),
        ("mdp rewards true : 1 endrewards", "expected ';'"),
        ("mdp rewards [a true : 1; endrewards", "expected ']'"),
        ("mdp rewards [a] true -> x=1 : 1; endrewards", "rewards of next states"),
        ("mdp rewards : 1; endrewards", "without guard or value"),
        ("mdp rewards true : 1;", "found the end"),
        ("mdp rewards true : 1 endmodule module m [] true -> 1; endrewards", "expected ';'"),
    ],
)
def test_what_is_not_read_is_refused_before_the_parser_runs(text: str, message: str) -> None:
    with pytest.raises(ModelError, match=r"line 1, column [0-9]+: ") as caught:
        scan(text)
    assert message in str(caught.value)


def test_a_conditional_in_a_reward_keeps_its_colons() -> None:
    text = 'mdp rewards "r" [a] (x=1 ? y=2 : z) : x=1 ? (y=0 ? 1 : 2) : 3; b : 4; endrewards'
    (structure,) = scan(text).structures
    first, second = structure.items
    assert (first.label, first.guard) == ("a", "( x = 1 ? y = 2 : z )")
    assert first.value == "x = 1 ? ( y = 0 ? 1 : 2 ) : 3"
    assert (second.label, second.guard, second.value) == (None, "b", "4")


def test_without_stormpy_the_message_names_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(prism_process, "find_spec", lambda name: None)
    path = tmp_path / "die.PM"
    path.write_text(DIE, encoding="utf-8")
    assert main(["info", str(path), "--set", "discount=0.9"]) == 2
    assert "pip install 'factored-polca[storm]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("import os; os.abort()", "crashed on this program (signal SIGABRT)"),
        ("import sys; sys.exit(3)", "ended with status 3"),
        ("print('no json')", "can't be read"),
        ("print('[1, 2]')", "can't be read"),
        ("import json; print(json.dumps({'version': '1.9.0', 'nodes': []}))", "1.9.0 is installed"),
        ("import json; print(json.dumps({'version': '2.0.0', 'nodes': [['AND', 0, 1]]}))", "can't be read"),
        ("import json; print(json.dumps({'version': '2.0.0', 'nodes': [['int', '1'], ['AND', 0]]}))",
         "can't be read"),
        ("import time; time.sleep(600)", "was stopped"),
        ("while True: print('x' * 10**6)", "too large"),
    ],
)  # fmt: skip
def test_a_parser_that_misbehaves_is_a_clear_error(
    script: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "prism_child.py").write_text(script, encoding="utf-8")
    monkeypatch.setattr(prism_process, "CHILD", tmp_path / "prism_child.py")
    monkeypatch.setattr(prism_process, "WAITING", 1.0 if "sleep" in script else 60.0)
    monkeypatch.setattr(prism_process, "MAXIMUM_ANSWER", 10**7)
    monkeypatch.setattr(prism_process, "find_spec", lambda name: name)
    with pytest.raises(ModelError) as caught:
        parse_program("mdp", lambda line, column: (line, column))
    assert message in str(caught.value)


@with_storm
def test_an_answer_whose_operator_lacks_a_part_is_a_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    text = """dtmc
module m x : [0..1]; [] true -> (x'=1-x); endmodule
rewards x=0 : 3; endrewards"""
    run = prism_process._run
    changed = []

    def cut(folder: Path) -> tuple[bytes, int]:
        answer, code = run(folder)
        data = json.loads(answer)
        for node in data["nodes"]:
            if node[0] == "EQUAL" and data["nodes"][node[2]][0] == "name":
                changed.append(node.pop())
        return json.dumps(data).encode(), code

    assert enumerate_model(read_prism(text, {"discount": "0.9"})[0]).rewards[0] == (F(3), F(0))
    monkeypatch.setattr(prism_process, "_run", cut)
    with pytest.raises(ModelError) as caught:
        read_prism(text, {"discount": "0.9"})
    assert len(changed) == 1
    assert "gave an answer that can't be read" in str(caught.value)


@pytest.mark.parametrize("text", ["9" * 4001, "-1/" + "9" * 4001, "7" * 5000 + "/3"])
def test_long_numbers_of_an_answer_are_refused(text: str) -> None:
    with pytest.raises(ModelError, match="more than 4000 digits"):
        number(text)
    assert number("-10/4") == F(-5, 2)


@with_storm
def test_formulas_that_double_and_double_are_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(prism_process, "SECONDS", 2)
    doubling = "".join(f"formula f{i + 1} = f{i} + f{i};\n" for i in range(40))
    text = f"mdp\nformula f0 = x;\n{doubling}module m x : [0..1]; [] f40>0 -> true; endmodule"
    raw: RawProgram | None = None
    with pytest.raises(ModelError, match=r"stopped|more than|MB"):
        raw = parse_program(text, lambda line, column: (line, column))
    assert raw is None


# -- writing ---------------------------------------------------------------------------------------


def dynamics(mdp: ExactMDP, code: dict[str, dict[object, object]]) -> dict[object, object]:
    """What each state's actions do, by names and by coded values."""
    names = [feature.name for feature in mdp.features]

    def key(values: Sequence[object]) -> object:
        coded = zip(names, values, strict=True)
        return frozenset((name, code.get(name, {}).get((type(v), v), v)) for name, v in coded)

    states = [key(values) for values in mdp.state_values]
    return {
        state: (
            mdp.terminal[s],
            mdp.initial[s],
            {
                name: (mdp.rewards[a][s], frozenset((states[t], q) for t, q in mdp.rows[a][s].items()))
                for a, name in enumerate(mdp.actions)
                if mdp.applicable[a][s]
            },
        )
        for s, state in enumerate(states)
    }


@with_storm
@pytest.mark.parametrize("seed", range(10))
def test_a_model_that_is_written_and_read_is_the_same(seed: int) -> None:
    model = random_model(seed, parameters=seed % 2 == 0, max_states=100)
    model = replace_fields(model, initial=InitialBelief())
    again, _, _ = read_prism(write_prism(model))
    spelling = Spelling(model)
    code: dict[str, dict[object, object]] = {
        f.name: {(type(v), v): i for i, v in enumerate(f.values)}
        for f in model.features
        if not spelling.plain[f.name] and not spelling.truth[f.name]
    }
    assert dynamics(enumerate_model(again), {}) == dynamics(enumerate_model(model), code)
    assert again.discount == model.discount
    assert [a.name for a in again.actions if a.name != "stay"] == [a.name for a in model.actions]


@with_storm
def test_files_of_every_extension_are_converted(tmp_path: Path) -> None:
    room = Feature("room", ["hall", "attic"])
    lit = boolean("if")  # no name in PRISM, nor here without quotes
    go = Action(
        "go up", {room: lottery({"attic": "1/3", "hall": "2/3"})}, rewards="1 if room' == attic else 0"
    )
    model = Model("house", [room, lit], [go], initial={room: "hall", lit: False}, discount="3/4")
    for name in ("house.prism", "house.NM", "house.pm"):
        write(model, tmp_path / name)
        again = read(tmp_path / name).model
        assert [f.values for f in again.features] == [(0, 1), (False, True)]
        assert [a.name for a in again.actions] == ["go_up"]
        assert set(enumerate_model(again).rewards[0]) == {F(1, 3)}
        write(again, tmp_path / "house.toml")
        assert enumerate_model(read(tmp_path / "house.toml").model) == enumerate_model(again)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"observability": "partial"}, "fully observed"),
        ({"horizon": 10}, "no horizon"),
        ({"initial": {"x": lottery([(0, "1/3"), (1, "2/3")])}}, "equally likely"),
    ],
)
def test_what_prism_cannot_say_is_refused(change: dict[str, object], message: str) -> None:
    model = Model("m", [Feature("x", (0, 1))], [Action("a", {"x": "1"})], **change)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=message):
        write_prism(model)
