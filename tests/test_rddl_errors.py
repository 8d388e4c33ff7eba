"""What RDDL can't be, each with one clear message; the limits of the parsing process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pyRDDLGym")

from rddl_in_process import run
from rddl_texts import SERVERS, rddl

from factored_polca.formats import rddl_process
from factored_polca.formats.rddl import read_rddl_with_warnings
from factored_polca.formats.rddl_lifted import lifted
from factored_polca.formats.rddl_process import Limits
from factored_polca.models import Fault, ModelError

A = "a : { action-fluent, bool, default = false };"
X = "x : { state-fluent, bool, default = false };"
T = {"types": "t : object;", "objects": "t : { t1, t2 };"}
P = "p(t) : { state-fluent, bool, default = false };"


@pytest.fixture(name="_parsed_here")
def _parse_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rddl_process, "_run", run)


def fault(text: str, limits: Limits | None = None) -> Fault:
    with pytest.raises(ModelError) as caught:
        read_rddl_with_warnings([text], ["m.rddl"], limits)
    (found,) = caught.value.faults
    return found


def at(text: str, part: str) -> tuple[int, int]:
    """Line and column of the first character of `part`."""
    before = text[: text.index(part)]
    return before.count("\n") + 1, len(before) - (before.rfind("\n") + 1) + 1


@pytest.mark.usefixtures("_parsed_here")
@pytest.mark.parametrize(
    ("text", "message", "place"),
    [
        (rddl(X + A, "x' = KronDelta(x) ^ ];"), "syntax error at '];'", "];"),
        (rddl(X + A, "x' = x ! x;"), "the character '!' has no place in RDDL", "! x"),
        (rddl(X + A, "x' = KronDelta(z);"), "unknown fluent 'z'", "z)"),
        (rddl(X + A, "x' = Normal(0, 1);"), "the distribution Normal is continuous", ""),
        (rddl(X + A, "x' = Poisson(2.0) > 1;"), "the distribution Poisson has infinitely many values", ""),
        (rddl("x : { state-fluent, real, default = 0.0 };" + A, "x' = x + 1;"),
         "'x' is a real state-fluent: continuous fluents are not read", "x : {"),
        (rddl(X + A, "x' = KronDelta(sin[x] > 0);"), "the function 'sin' is not read", "sin["),
        (rddl(X + A, "x' = if (x + 1) then x else x;"), "a truth value is needed, not a numeric value",
         "x + 1"),
        (rddl("x : { state-fluent, int, default = 0 };" + A, "x' = x + a;"),
         "no finite range can be derived for the int-fluent x: bound it in its definition, such as "
         "max[0, min[9, ...]]", ""),
        (rddl(X + "n : { action-fluent, int, default = 0 };", "x' = KronDelta(n > 1);"),
         "the int action-fluent n has no finite range: bound it in action-preconditions, such as n >= 0 "
         "and n <= 9", ""),
        (rddl(P + A, "p'(?t) = p(?t, ?t);", **T), "'p' takes 1 arguments, not 2", "p(?t, ?t)"),
        (rddl(P + A, "p'(?t) = p(?u);", **T), "the variable ?u is not bound", "?u)"),
        (rddl(P + A, "p'(?t) = argmax_{?u : t} p(?u) == ?t;", **T),
         "the aggregation 'argmax' is not read", ""),
        (rddl(P + A, "p'(?t) = exists_{?u : s} p(?u);", **T), "unknown type 's'", "?u : s"),
        (rddl(P + A, "p'(?t) = p(@t3);", **T), "'@t3' is no object and no value of a type", "@t3"),
        (rddl(X + "i : { interm-fluent, bool, level = 1 }; j : { interm-fluent, bool, level = 1 };" + A,
              "i = j; j = i; x' = i;"), "i depends on itself", ""),
        (rddl(X + A, "x' = x;", sections="termination { a; };"),
         "a termination condition depends on an action", "a; }"),
        (rddl(X + A, "x' = x;", concurrent="1", sections="action-preconditions { x'; };"),
         "a precondition or constraint depends on the next state", "x'; }"),
        (rddl(X + "o : { observ-fluent, bool };" + A, "x' = x; o = x';",
              sections="action-preconditions { a => x; };"),
         "preconditions or constraints let the action a apply in some states only, and the state is not "
         "seen", ""),
        (rddl(X + A, "x' = x;", sections="state-invariants { x; };"),
         "the initial state does not meet the constraints or invariants on states", ""),
        (rddl("x(t) : { state-fluent, bool, default = false };"
              "b(t) : { action-fluent, bool, default = false };",
              "x'(?t) = b(?t);", types="t : object;", concurrent="",
              objects="t : { " + ", ".join(f"t{i}" for i in range(40)) + " };"),
         "no max-nondef-actions and 40 action-fluents make 1,099,511,627,776 joint actions; at most 10,000 "
         "are listed", ""),
        (rddl(X + A, "x' = x; x' = ~x;"), "Expression for CPF 'x'' is repeated in cpfs block.", ""),
        (SERVERS + SERVERS[SERVERS.index("instance") :], "a second instance block: give one domain and one "
         "instance", None),
        (SERVERS[: SERVERS.index("instance")], "the text has no instance block", ""),
        (SERVERS.rstrip()[:-1], "the text ends in the middle of a block: a closing brace is missing", ""),
        (rddl(X + A, "x' = x;", horizon="horizon = 0;"),
         "the horizon is 0: it is a whole number of steps from 1 on, or pos-inf", ""),
        (rddl(X + A, "x' = x;", discount="discount = 1.5;"), "the discount is not between 0 and 1", ""),
        (rddl(X + A, "x' = " + "~" * 400 + "x;"), "an expression is nested deeper than 150 levels", ""),
        (rddl(X + A, "x' = x;", "9" * 5000), "a number of more than 1000 digits", "9999"),
        (rddl(X + A, "x' = x;", "0." + "1" * 2000), "a number of more than 1000 digits", "0.1"),
    ],
)  # fmt: skip
def test_each_fault_has_one_message_and_its_place(
    text: str, message: str | None, place: str | None
) -> None:
    if message is None:
        return
    found = fault(text)
    assert found.message == message
    if place:
        assert (found.file, found.line, found.column) == ("m.rddl", *at(text, place))


@pytest.mark.usefixtures("_parsed_here")
def test_a_row_that_is_no_distribution_is_found_at_its_definition() -> None:
    from factored_polca.symbolic import compile_model

    text = rddl(X + A, "x' =\n  if (x) then Bernoulli(1.5) else true;")
    model, _, locate = read_rddl_with_warnings([text], ["m.rddl"])
    with pytest.raises(ModelError) as caught:
        compile_model(model)
    found = locate(caught.value.faults)
    assert {(f.file, f.line, f.column) for f in found} == {("m.rddl", *at(text, "x' ="))}
    assert all("a probability is -1/2" in f.message for f in found)


@pytest.mark.usefixtures("_parsed_here")
def test_a_number_that_is_no_truth_value_is_found_where_it_counts() -> None:
    from factored_polca.symbolic import compile_model

    model = read_rddl_with_warnings([rddl(X + A, "x' = KronDelta(x + 0.5);")])[0]
    with pytest.raises(ModelError, match=r"the distribution of x': a number other than 0 and 1"):
        compile_model(model)


def test_two_files_have_places_of_their_own() -> None:
    domain, instance = SERVERS[: SERVERS.index("non-fluents n")], SERVERS[SERVERS.index("non-fluents n") :]
    model = read_rddl_with_warnings([domain, instance], ["d", "i"])[0]
    assert model == read_rddl_with_warnings([SERVERS])[0]
    wrong = instance.replace("LINK(s2, s3)", "\n LINKS(s2, s3)").replace("CRASH = 0.2;", "CRASH = = 0.2;")
    with pytest.raises(ModelError) as caught:
        read_rddl_with_warnings([domain, wrong], ["d", "i"])
    (found,) = caught.value.faults
    assert (found.file, found.line, found.column) == ("i", *at(wrong, "= 0.2"))


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (Limits(output_bytes=1000), "takes more than 0 MiB"),
        (Limits(wall_seconds=0.01), "parsing took longer than 0.01 s"),
        (Limits(memory_bytes=1 << 26), "the parser stopped without an answer"),
    ],
)
def test_the_parser_s_limits_are_kept(limits: Limits, message: str) -> None:
    assert message in fault(SERVERS, limits).message


def test_a_bomb_of_names_is_stopped() -> None:
    """Six parameters over 100 objects are 10^12 names, which pyRDDLGym would list."""
    many = "t : { " + ", ".join(f"t{i}" for i in range(100)) + " };"
    text = rddl("p(t, t, t, t, t, t) : { non-fluent, bool, default = false };" + X + A, "x' = x;",
                types="t : object;", objects=many)  # fmt: skip
    assert "MiB of memory, the most that is allowed" in fault(text, Limits(memory_bytes=1 << 28)).message


@pytest.mark.usefixtures("_parsed_here")
def test_a_bomb_of_bindings_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    from factored_polca.formats import rddl_grounding

    monkeypatch.setattr(rddl_grounding, "MAXIMUM_STEPS", 10_000)
    many = "t : { " + ", ".join(f"t{i}" for i in range(30)) + " };"
    text = rddl(X + A, "x' = exists_{?a : t, ?b : t, ?c : t, ?d : t} (?a ~= ?b ^ ?c ~= ?d ^ ?a == ?d ^ x);",
                types="t : object;", objects=many)  # fmt: skip
    assert fault(text).message == "grounding takes more than 10,000 steps: too many objects"


def test_without_pyrddlgym_the_way_to_install_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rddl_process.importlib.util, "find_spec", lambda name: None)
    found = fault(SERVERS)
    assert found.message == "RDDL is parsed by pyRDDLGym, which is not installed"
    assert found.hint == "pip install 'factored-polca[rddl]'"


def test_the_child_loads_neither_simulator_nor_what_draws() -> None:
    child = Path(rddl_process.__file__).with_name("rddl_child.py")
    program = (
        f"import runpy, sys\nsys.argv = ['c', '0', '0', '0', {rddl_process.packages()!r}]\n"
        f"loaded = runpy.run_path({str(child)!r})\nloaded['load'](sys.argv[4])\n"
        "names = 'pygame', 'matplotlib', 'gymnasium', 'pyRDDLGym.core.simulator', 'factored_polca'\n"
        "print([name for name in names if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-I", "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def answer() -> dict[str, Any]:
    return rddl_process.parsed(SERVERS)


def test_the_answer_of_the_child_is_checked_field_by_field() -> None:
    """Whatever is put in the place of one field, the result is a model or a ModelError."""
    good = json.dumps(answer())
    assert lifted(json.loads(good)).domain == "d"
    strange: list[Any] = [None, -1, 10**9, "x", [], [[]], {}, True, 1.5, [["a", "b"]], [None]]
    count = 0
    for key in json.loads(good):
        for value in strange:
            try:
                lifted(json.loads(good) | {key: value})
            except ModelError:
                count += 1
    assert count > 100
    for field in range(6):
        for value in strange:
            data = json.loads(good)
            data["nodes"][-1][field] = value
            try:
                lifted(data)
            except ModelError:
                count += 1
    assert count > 130
