"""Hierarchies planned, and models solved, on diagrams: against rationals on all states, and in use."""

from __future__ import annotations

import json
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from random_models import random_model, random_tasks

from factored_polca import library
from factored_polca.cli.entry import run
from factored_polca.control import Controller
from factored_polca.diagrams import evaluate_states
from factored_polca.display import graph, html
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_dynamic_programming import evaluate_policy, optimal_solution
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.explicit.subtask import subtask_mdp
from factored_polca.formats import write
from factored_polca.hierarchy import HierarchicalPlan, Options, plan_mdp
from factored_polca.hierarchy.executable import ExecutablePlan, executable
from factored_polca.hierarchy.plan_file import load_plan, save_plan
from factored_polca.hierarchy.report import plan_report
from factored_polca.hierarchy.solved import SolvedTask, StructuredTask
from factored_polca.models import Action, Feature, LimitReached, Model, ModelError, TaskHierarchy

ON_DIAGRAMS = Options(solver="structured")


def state_numbers(mdp: ExactMDP) -> np.ndarray:
    """The oracle's states as value numbers [state, feature]."""
    rows = [
        [feature.index(value) for feature, value in zip(mdp.features, values, strict=True)]
        for values in mdp.state_values
    ]
    return np.array(rows, dtype=np.int32)


def primitive_policies(found: HierarchicalPlan, states: np.ndarray) -> dict[str, list[int]]:
    """Each task's policy by state: number of the model's action, -1 where undefined."""
    none, columns = len(found.symbolic.actions), found.symbolic.columns()
    result = {}
    for solved in found.solved:
        leaf = evaluate_states(solved.policy, states, columns).astype(np.int64)
        result[solved.task.name] = np.where(leaf < none, leaf, -1).tolist()
    return result


def assert_tasks_keep_their_bounds(model: Model, tasks: TaskHierarchy, found: HierarchicalPlan) -> None:
    """Each task's optimum, given its children's policies, lies in its bounds, and so does its policy."""
    flat = enumerate_model(model)
    states, columns = state_numbers(flat), found.symbolic.columns()
    policies = primitive_policies(found, states)
    for solved in found.solved:
        assert isinstance(solved, StructuredTask)
        solution = solved.solution
        mdp = subtask_mdp(model, tasks, solved.task.name, policies)
        exact = optimal_solution(mdp).values
        values = evaluate_states(solution.values, states, columns).view(np.float64).tolist()
        choices = evaluate_states(solution.choices, states, columns).astype(int).tolist()
        kept = [-1 if choice == len(mdp.actions) else choice for choice in choices]
        earned = evaluate_policy(mdp, kept)
        radius, loss = Fraction(solution.radius), Fraction(solution.policy_loss)
        for s in range(mdp.states):
            if exact[s] == -math.inf:
                assert (values[s], kept[s]) == (-math.inf, -1)
            else:
                assert abs(Fraction(values[s]) - exact[s]) <= radius
                assert earned[s] >= Fraction(values[s]) - radius - loss
        assert solved.dead_end_states == sum(v == -math.inf for v in exact)


@pytest.mark.parametrize("seed", range(24))
def test_random_hierarchies_on_diagrams(seed: int) -> None:
    model = random_model(seed, features=(2, 3), max_states=27)
    tasks = random_tasks(seed, model)
    try:
        by_blocks = plan_mdp(model, tasks)
    except ModelError as error:
        with pytest.raises(ModelError) as other:
            plan_mdp(model, tasks, ON_DIAGRAMS)
        same = str(error).split(" like ")[0]  # which start state is named may differ
        assert str(other.value).split(" like ")[0] == same
        return
    found = plan_mdp(model, tasks, ON_DIAGRAMS)
    assert_tasks_keep_their_bounds(model, tasks, found)
    assert found.polled.blocks is None
    over = enumerate_model(model, terminal=model.terminal | found.root.task.terminal)  # type: ignore[operator]
    policy = primitive_policies(found, state_numbers(over))[found.root.task.name]
    earned = evaluate_policy(over, policy)
    exact = sum(q * v for q, v in zip(over.initial, earned, strict=True) if q)
    assert Fraction(found.polled.lower) <= exact <= Fraction(found.polled.upper)
    assert found.flat is not None
    assert by_blocks.flat is not None
    assert found.flat.lower <= by_blocks.flat.upper
    assert by_blocks.flat.lower <= found.flat.upper


def test_a_plan_on_diagrams_is_executed_saved_and_drawn(tmp_path: Path) -> None:
    domain = library.load("taxi", {})
    found = plan_mdp(domain.model, domain.tasks, ON_DIAGRAMS)
    by_blocks = plan_mdp(domain.model, domain.tasks)
    assert found.polled.value == pytest.approx(by_blocks.polled.value, abs=1e-6)
    report = plan_report(found)
    assert "structured value iteration on diagrams" in report["guarantee"]
    assert all(row["blocks"] is None for row in report["tasks"])
    assert report["totals"]["q_values"] == 0
    ready = executable(found, report)
    save_plan(ready, tmp_path / "taxi.polca")
    again = load_plan(tmp_path / "taxi.polca")
    assert isinstance(again, ExecutablePlan)
    for plan in (ready, again):
        assert_polling_leads_where_the_policy_says(plan)
    for thing in (found, found.root, found.solved[0], again, again.policies["Root"]):
        assert html(thing).startswith("<")
    assert graph(found.root).nodes


def assert_polling_leads_where_the_policy_says(plan: ExecutablePlan) -> None:
    mdp = enumerate_model(plan.model)
    controller = Controller(plan)
    leaf = evaluate_states(plan.policy, state_numbers(mdp), plan.symbolic.columns()).astype(int)
    names = [feature.name for feature in plan.model.features]
    for s in range(0, mdp.states, 7):
        decision = controller.poll(dict(zip(names, mdp.state_values[s], strict=True)))
        taken = None if leaf[s] == len(mdp.actions) else mdp.actions[leaf[s]]
        assert decision.action == taken


def test_a_policy_with_a_restriction_knows_what_is_outside() -> None:
    domain = library.load("taxi", {"anywhere": "true"})
    found = plan_mdp(domain.model, domain.tasks, Options(solver="structured", reachable=True))
    ready = executable(found)
    assert any(policy.partition.has_outside for policy in ready.policies.values())
    by_blocks = plan_mdp(domain.model, domain.tasks, Options(reachable=True))
    assert found.polled.value == pytest.approx(by_blocks.polled.value, abs=1e-6)


def test_auto_goes_on_on_diagrams_where_blocks_are_too_many() -> None:
    domain = library.load("taxi", {})
    found = plan_mdp(domain.model, domain.tasks, Options(structured_blocks=60))
    kinds = {solved.task.name: type(solved) for solved in found.solved}
    assert set(kinds.values()) == {SolvedTask, StructuredTask}
    without = [solved.task.name for solved in found.solved if isinstance(solved, StructuredTask)]
    warnings = [w for w in found.warnings if "no quotient (more than 60 blocks" in w]
    assert len(warnings) == len(without)
    assert all("solved by structured value iteration" in w for w in warnings)
    report = plan_report(found)
    assert "without one, by structured value iteration on diagrams: " in report["guarantee"]
    assert "each partition exact" in report["guarantee"]
    exact = plan_mdp(domain.model, domain.tasks)
    assert found.polled.value == pytest.approx(exact.polled.value, abs=1e-6)
    ready = executable(found)
    assert_polling_leads_where_the_policy_says(ready)


def test_auto_goes_on_on_diagrams_where_memory_is_short() -> None:
    model = library.load("expon", {"size": "12"}).model
    exact = plan_mdp(model)
    found = plan_mdp(model, options=Options(memory_limit=3 << 20, flat_block_limit=None))
    assert isinstance(found.root, StructuredTask)
    assert "memory limit" in found.warnings[0]
    assert found.root.solution.lower <= exact.root.value <= found.root.solution.upper


def test_a_block_limit_that_was_asked_for_still_stops() -> None:
    domain = library.load("taxi", {})
    with pytest.raises(LimitReached, match="more than 60 blocks"):
        plan_mdp(domain.model, domain.tasks, Options(block_limit=60))
    with pytest.raises(LimitReached, match="more than 60 blocks"):
        plan_mdp(domain.model, domain.tasks, Options(block_limit=60, structured_blocks=None))


def test_at_discount_one_blocks_are_needed() -> None:
    x = Feature("x", range(40))
    step = Action("step", {x: "min(x + 1, 39)"})
    model = Model("m", [x], [step], rewards="-1", terminal="x == 39", discount=1)
    assert plan_mdp(model, options=Options(structured_blocks=10, block_limit=50)).root.blocks == 40
    with pytest.raises(ModelError, match="no bounds at discount 1"):
        plan_mdp(model, options=ON_DIAGRAMS)


# -- the command line ---------------------------------------------------------------------------


def answer(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, object]:
    assert run([*arguments, "--json"]) == 0
    data: dict[str, object] = json.loads(capsys.readouterr().out)
    return data


def test_solve_on_diagrams_writes_a_policy_that_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "taxi.policy")
    found = answer(capsys, "solve", "taxi", "--solver", "structured", "-o", path)
    listed = answer(capsys, "solve", "taxi")
    assert found["method"] == "structured value iteration"
    assert found["value"] == pytest.approx(listed["value"], abs=1e-6)
    assert found["reachable_states"] is None
    assert found["status"] == "converged"
    earned = answer(capsys, "simulate", path, "--episodes", "50")
    assert earned["episodes"] == 50
    state = "x=0,y=0,passenger=R,destination=G"
    told = answer(capsys, "act", path, "--state", state)
    assert told["action"] in {action.name for action in library.load("taxi", {}).model.actions}


def large(kind: str) -> Model:
    """21 bits, too many states to list: the quotient is tiny, or has as many blocks as states."""
    bits = [Feature(f"b{i:02}", range(2)) for i in range(21)]
    drift = {}
    row = "{{1: {0} if {1} == 1 else {2}, 0: {3} if {1} == 1 else {4}}}"
    for i, bit in enumerate(bits):
        chance = Fraction(1, 2) if kind == "alike" else Fraction(i + 1, 50)
        other = bits[i] if kind == "alike" else bits[(i + 1) % len(bits)]
        up, down = Fraction(1, 3) + chance / 4, chance / 2
        drift[bit] = row.format(up, other.name, down, 1 - up, 1 - down)
    dear = Action("dear", drift, rewards="-3 if b00 == 1 else -2")
    cheap = Action("cheap", drift, rewards="1")
    return Model(kind, bits, [dear, cheap], discount="0.9")


def test_auto_solves_what_it_can_not_list_over_blocks_or_on_diagrams(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import factored_polca.hierarchy.options as options

    write(large("alike"), tmp_path / "alike.toml")
    found = answer(capsys, "solve", str(tmp_path / "alike.toml"))
    assert found["blocks"] == 2
    assert "over blocks" in str(found["method"])
    assert found["value"] == pytest.approx(10.0)  # 1 a step at discount 0.9
    monkeypatch.setattr(options, "STRUCTURED_BLOCKS", 50)
    write(large("apart"), tmp_path / "apart.toml")
    path = str(tmp_path / "apart.plan")
    found = answer(capsys, "solve", str(tmp_path / "apart.toml"), "-o", path)
    assert found["blocks"] is None
    assert found["method"] == "structured value iteration"
    assert "no quotient (more than 50 blocks" in str(found["note"])
    assert found["value"] == pytest.approx(10.0)
    assert answer(capsys, "simulate", path, "--episodes", "2", "--steps", "3")["steps"] == 3


def test_solve_says_what_structured_is_not_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["solve", "tiger", "--solver", "structured"]) == 2
    assert "structured solves fully observed models" in capsys.readouterr().err
    assert run(["solve", "taxi", "--solver", "structured", "--horizon", "3"]) == 2
    assert "structured has none" in capsys.readouterr().err
    assert run(["solve", "taxi", "--solver", "structured", "--discount", "1"]) == 2
    assert "no bounds at discount 1" in capsys.readouterr().err


def test_plan_prints_what_was_solved_on_diagrams(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["plan", "toy", "--solver", "structured"]) == 0
    printed = capsys.readouterr().out
    assert "Pass: structured value iteration, a value diagram of 4 nodes" in printed
    assert "no partition was needed" in printed


def test_iterations_and_time_leave_bounds(capsys: pytest.CaptureFixture[str]) -> None:
    listed = answer(capsys, "solve", "taxi")
    found = answer(capsys, "solve", "taxi", "--solver", "structured", "--iterations", "3")
    assert found["status"] == "iteration limit"
    assert float(str(found["lower"])) <= float(str(listed["lower"]))
    assert float(str(listed["upper"])) <= float(str(found["upper"]))
