"""Plans whose searches a limit of time cuts short: the best so far, with bounds that hold.

The time given to a search is replaced by none, so that all solvers stop at once; what is then planned is
compared with the plan that was given all the time it wanted.
"""

from __future__ import annotations

import json
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from random_hierarchies import random_tasks
from random_models import random_model

from factored_polca import library
from factored_polca.cli import main
from factored_polca.control.belief_controller import plan_tracker
from factored_polca.control.belief_policies import PolledPolicy
from factored_polca.control.block_tracker import BlockTracker
from factored_polca.hierarchy import Options, plan_mdp, plan_pomdp
from factored_polca.hierarchy.pomdp_executable import executable_pomdp
from factored_polca.hierarchy.time_limit import plan_status, search_deadline
from factored_polca.models import LimitReached, Task, TaskHierarchy
from factored_polca.simulation.belief_runs import run_on_blocks
from factored_polca.simulation.measure import measure
from factored_polca.symbolic import compile_model

plan_module = import_module("factored_polca.hierarchy.plan")  # a function has its name
pomdp_plan_module = import_module("factored_polca.hierarchy.pomdp_plan")
LONG_AGO = 0.0


@pytest.fixture
def no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Searches are cut short before they begin; all else takes the time it takes."""

    def cut(options: Options, *, is_root: bool) -> float:
        return LONG_AGO

    for module in (plan_module, pomdp_plan_module):
        monkeypatch.setattr(module, "search_deadline", cut)


def test_a_search_may_take_a_share_of_the_time_that_is_left() -> None:
    assert search_deadline(Options(), is_root=True) is None
    assert search_deadline(Options(deadline=LONG_AGO), is_root=True) == LONG_AGO
    far = 1e12
    child = search_deadline(Options(deadline=far), is_root=False)
    root = search_deadline(Options(deadline=far), is_root=True)
    assert child is not None
    assert root is not None
    assert 0.4 * far < child < 0.6 * far < 0.8 * far < root < far
    assert plan_status(["converged", "iteration limit"]) == "complete"
    assert plan_status(["converged", "time limit", "memory limit"]) == "time limit"


@pytest.mark.parametrize("name", ["meds", "cheese_taxi", "tiger"])
@pytest.mark.usefixtures("no_time")
def test_a_cut_plan_of_beliefs_has_bounds_around_those_of_a_finished_root(name: str) -> None:
    domain = library.load(name)
    cut = plan_pomdp(domain.model, domain.tasks)
    assert cut.status == "time limit"
    assert any("time limit cut its search short" in warning for warning in cut.warnings)
    root = cut.root
    again = pomdp_plan_module.solve_pomdp(root.reduction.pomdp_quotient.pomdp, "sarsop")
    assert root.lower <= again.upper + 1e-9
    assert again.lower <= root.upper + 1e-9
    assert root.lower <= again.lower + 1e-9
    runs = measure(executable_pomdp(cut), episodes=200, child_episodes=1)
    assert set(runs.runs) >= {root.task.name}


@pytest.mark.parametrize("seed", range(0, 36, 4))
@pytest.mark.usefixtures("no_time")
def test_a_cut_plan_of_states_is_worth_no_more_than_it_may_be(seed: int) -> None:
    """Where the chain is not solved either, the root's bounds contain what the chain's solution says."""
    model = random_model(seed, max_states=64)
    tasks = random_tasks(seed, model)
    cut = plan_mdp(model, tasks)
    if cut.root.status == "time limit":
        assert cut.status == "time limit"
    for named in (cut.polled, plan_module.root_bounds(cut.root, "a test")):
        assert named.lower <= named.upper
        slack = 1e-9 * max(1.0, abs(cut.polled.upper))
        assert named.lower <= cut.polled.upper + slack
        assert cut.polled.lower <= named.upper + slack


def test_the_roots_bounds_stand_in_for_a_chain_that_takes_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    taxi = library.load("taxi")
    exact = plan_mdp(taxi.model, taxi.tasks, Options(flat_block_limit=None))

    def stopped(*_: object) -> None:
        raise LimitReached("the time limit was reached", "minimisation")

    monkeypatch.setattr(plan_module._Planner, "polled_chain", stopped)
    found = plan_mdp(taxi.model, taxi.tasks, Options(flat_block_limit=None))
    assert found.polled.lower <= exact.polled.value <= found.polled.upper
    assert found.polled.upper - found.polled.lower <= 1e-6
    assert "time limit" in found.polled.guarantee.text
    own = Task("Root", [action.name for action in taxi.model.actions], pseudo_rewards=-1)
    with pytest.raises(LimitReached, match="time limit"):  # its value is not the model's
        plan_mdp(taxi.model, TaskHierarchy([own]), Options(flat_block_limit=None))


@pytest.mark.usefixtures("no_time")
def test_the_command_ends_well_and_says_that_time_was_up(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "meds", "--episodes", "10", "--quiet"]) == 0
    printed = capsys.readouterr()
    assert "the best plan so far" in printed.out
    assert "time limit" in printed.out
    assert "cut its search short" in printed.err
    assert main(["plan", "meds", "--episodes", "10", "--json"]) == 0
    data: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert data["status"] == "time limit"
    assert {row["status"] for row in data["tasks"]} == {"time limit"}


def test_a_plan_in_time_says_nothing_of_limits(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "meds", "--episodes", "10", "--time", "1000", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "complete"


def test_what_is_not_measured_in_time_is_left_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    domain = library.load("meds")
    policy = executable_pomdp(plan_pomdp(domain.model, domain.tasks))
    late = measure(policy, deadline=LONG_AGO)
    assert late.runs == {}
    assert late.tracker.kind == "particles"
    assert "time limit" in late.tracker.reason
    monkeypatch.setattr("factored_polca.cli.plan.extended", lambda *_: LONG_AGO)
    assert main(["plan", "meds", "--quiet"]) == 0
    assert "not measured: time was up" in capsys.readouterr().out
    assert main(["plan", "meds", "--json", "-o", "meds.plan"]) == 0
    assert json.loads(capsys.readouterr().out)["value"] is None


def test_episodes_that_time_ends_are_those_of_as_many_steps() -> None:
    domain = library.load("meds")
    policy = executable_pomdp(plan_pomdp(domain.model, domain.tasks))
    tracker = plan_tracker(policy).tracker
    assert isinstance(tracker, BlockTracker)
    polled = PolledPolicy(policy, tracker)

    def stop(first: int, step: int) -> None:
        if step == 5:
            raise LimitReached("the time limit was reached", "measure")

    whole = run_on_blocks(tracker, polled, episodes=30, steps=5)
    ended = run_on_blocks(tracker, polled, episodes=30, steps=50, progress=stop)
    assert ended.steps == 5
    assert ended.returns.tolist() == whole.returns.tolist()
    assert ended.cumulative.tolist() == whole.cumulative.tolist()
    assert ended.truncation == whole.truncation > 0


@pytest.mark.parametrize("name", ["meds", "taxi"])
def test_a_root_whose_search_ends_late_still_makes_a_plan(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    domain = library.load(name)
    symbolic = compile_model(domain.model, tasks=domain.tasks)

    def late(options: Options, *, is_root: bool) -> float | None:
        if is_root:  # from now on diagrams may not be worked on
            symbolic.manager.deadline = LONG_AGO
        return None

    for module in (plan_module, pomdp_plan_module):
        monkeypatch.setattr(module, "search_deadline", late)
    work = plan_pomdp if name == "meds" else plan_mdp
    found = work(domain.model, domain.tasks, symbolic=symbolic)
    assert found.root.lower <= found.root.upper if name == "meds" else found.polled.lower <= 3.8573860
    assert "left out" in (found.flat.note if name == "meds" else found.flat_note)
    if name == "taxi":  # the flat optimum, 3.85738595, is what this hierarchy earns (`test_solve_command`)
        assert found.polled.upper >= 3.8573859
        assert "the root's bounds" in found.polled.guarantee.text
