"""Ctrl-C while a solver works: never lost, and what was found is returned."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from small_pomdps import PUBLISHED, maze_4x3, tiger

from factored_polca.solvers import graph_iteration, pomdp_choose, warm_pomdp
from factored_polca.solvers.evaluation import StopRule
from factored_polca.solvers.interrupts import PACKAGE, held_interrupt, interrupts_at_polls
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand


@pytest.fixture(autouse=True)
def usual_handler() -> Iterator[None]:
    """Python's own handler, also where the tests were started with Ctrl-C ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press() -> None:
    """Ctrl-C, in a frame that is not of the package."""
    signal.raise_signal(signal.SIGINT)


def press_inside() -> None:
    """Ctrl-C, in a frame of the package."""
    source = "import signal\nsignal.raise_signal(signal.SIGINT)\npass\n"
    exec(compile(source, PACKAGE + "somewhere.py", "exec"), {})


@pytest.mark.parametrize("rule", [Demand(), StopRule()])
def test_ctrl_c_in_a_library_waits_for_the_next_poll(rule):
    with interrupts_at_polls():
        rule.poll()
        press()
        with pytest.raises(KeyboardInterrupt):
            rule.poll()
        rule.poll()


def test_ctrl_c_in_the_package_does_not_wait():
    with interrupts_at_polls():
        with pytest.raises(KeyboardInterrupt):
            press_inside()
        assert not held_interrupt()


def test_a_second_ctrl_c_does_not_wait():
    with interrupts_at_polls():
        press()
        with pytest.raises(KeyboardInterrupt):
            press()
        assert not held_interrupt()


def test_python_s_handler_is_back_afterwards():
    with interrupts_at_polls(), interrupts_at_polls():
        press()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with pytest.raises(KeyboardInterrupt):
        press()


def test_other_handlers_and_other_threads_are_left_alone():
    def mine(number, frame):
        pass

    signal.signal(signal.SIGINT, mine)
    with interrupts_at_polls():
        assert signal.getsignal(signal.SIGINT) is mine
    signal.signal(signal.SIGINT, signal.default_int_handler)
    seen = []

    def work():
        with interrupts_at_polls():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [signal.default_int_handler]


@pytest.mark.parametrize("method", ["auto", "exact", "pbvi", "perseus", "hsvi", "sarsop", "blind", "amdp"])
@pytest.mark.parametrize(("name", "call"), [("unique", 1), ("unique", 3), ("repeat", 40), ("cumsum", 20)])
def test_ctrl_c_in_numpy_leaves_bounds_and_a_policy(method, name, call, monkeypatch):
    """It comes in the midst of the given call of one of numpy's functions."""
    original, calls = getattr(np, name), 0

    def pressed(*arguments, **named):
        nonlocal calls
        calls += 1
        if calls == call:
            press()
        return original(*arguments, **named)

    monkeypatch.setattr(np, name, pressed)
    found = solve_pomdp(maze_4x3(), method, demand=Demand(gap=1e-12, iterations=30))
    assert (found.status == "interrupted") == (calls >= call) or found.converged
    low, high = next(case.truth for case in PUBLISHED if case.name == "4x3.95")
    assert found.lower <= high
    assert found.upper >= low
    assert found.policy is not None


def test_a_warm_up_does_not_keep_ctrl_c_to_itself(monkeypatch):
    def interrupted(problem, demand, **named):
        return replace(graph_iteration.solve_by_graph_iteration(problem, demand), status="interrupted")

    monkeypatch.setattr(warm_pomdp, "solve_by_graph_iteration", interrupted)
    with pytest.raises(KeyboardInterrupt):
        warm_pomdp.warm_up("auto")


@pytest.mark.parametrize("method", ["pbvi", "sarsop", "qmdp", "amdp", "witness"])
@pytest.mark.parametrize("staged", [False, True])
def test_no_warm_up_does(method, staged, monkeypatch):
    """Whatever method it runs, the first poll finds a Ctrl-C."""

    def pressed(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(Demand, "poll", pressed)
    monkeypatch.setattr(StopRule, "poll", pressed)
    with pytest.raises(KeyboardInterrupt):
        warm_pomdp.warm_up(method, staged=staged)


@pytest.mark.parametrize("status", ["interrupted", "time limit"])
def test_auto_ends_as_the_policy_iteration_in_its_midst_did(status, monkeypatch):
    """It was called an iteration limit."""

    def ended(problem, demand, *, everywhere):
        found = graph_iteration.solve_by_graph_iteration(problem, demand, everywhere=everywhere)
        return replace(found, status=status)

    monkeypatch.setattr(pomdp_choose, "STALLED", 3)
    monkeypatch.setattr(pomdp_choose, "FEW_BACKUPS", 0)
    monkeypatch.setattr(pomdp_choose, "FEW_BELIEFS", 3)
    monkeypatch.setattr(pomdp_choose, "solve_by_graph_iteration", ended)
    found = solve_pomdp(tiger(0.95), "auto", demand=Demand(gap=1e-9))
    assert found.status == status
