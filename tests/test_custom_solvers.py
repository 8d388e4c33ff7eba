"""Solvers that are not ours: how they are named, what they are given, and what is refused of their results.

Values: tiger 19.371368 (see `small_pomdps`); the taxi's optimum by our own solvers; closed forms.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_pomdps import SEEDS, random_pomdp, tiger

from factored_polca import library
from factored_polca.cli import main
from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.arrays import ArrayMDP, FloatArray
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.hierarchy import Options, plan_mdp, plan_pomdp
from factored_polca.minimisation import flat_process, reduce
from factored_polca.models import Action, Model, ModelError, Task, TaskHierarchy, boolean
from factored_polca.solvers import MDPSolution, solve_mdp
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.proposal import alpha_vectors, solution_of_actions, solution_of_policy
from factored_polca.solvers.protocol import call_mdp_solver, call_pomdp_solver, load_solver
from factored_polca.solvers.verify import mdp_faults, pomdp_faults
from factored_polca.symbolic import compile_model
from factored_polca.testing import check_solver

QMDP = """
import numpy as np
from factored_polca.solvers.proposal import alpha_vectors, solution_of_actions, solution_of_policy

def q_values(mdp):
    values = np.zeros(mdp.states)
    for _ in range(400):
        q = np.array([r + mdp.discount * (m @ values) for r, m in zip(mdp.rewards, mdp.transitions)])
        values = np.where(mdp.terminal, 0.0, np.where(mdp.applicable, q, -np.inf).max(axis=0))
    return np.where(mdp.applicable, q, -np.inf)

def qmdp(pomdp, demand, roots):
    q = q_values(pomdp.to_mdp())
    q[:, pomdp.terminal] = 0.0
    return solution_of_policy(
        pomdp, alpha_vectors(pomdp, q, np.arange(len(q))), method="theirs", demand=demand, roots=roots
    )

class Steps:
    def __call__(self, mdp, demand):
        policy = np.where(mdp.terminal, -1, q_values(mdp).argmax(axis=0))
        return solution_of_actions(mdp, policy, method="theirs", demand=demand)

def fails(*given):
    raise ValueError("no idea")

def lies(*given):
    return 17

number = 3
"""


@pytest.fixture
def theirs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of an importable module with solvers."""
    name = f"theirs_{abs(hash(tmp_path)):x}"
    (tmp_path / f"{name}.py").write_text(QMDP)
    monkeypatch.syspath_prepend(tmp_path)
    return name


def ours(pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None) -> POMDPSolution:
    return solve_pomdp(pomdp, "sarsop", demand=demand, roots=roots)


def ours_mdp(mdp: ArrayMDP, demand: Demand) -> MDPSolution:
    return solve_mdp(mdp, epsilon=demand.gap, deadline=demand.deadline)


# -- naming ----------------------------------------------------------------------------------------


def test_a_function_and_a_class_are_found_by_name(theirs: str) -> None:
    assert load_solver(f"{theirs}:qmdp").__name__ == "qmdp"
    assert type(load_solver(f"{theirs}:Steps")).__name__ == "Steps"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("os.system", "write package.module:Name"),
        ("no_such_module_at_all:f", "can't be imported.*PYTHONPATH"),
        ("{}:missing", "has no missing; it has .*qmdp"),
        ("{}:number", "int, which can't be called"),
        ("a b:c", "write package.module:Name"),
    ],
)
def test_a_name_that_leads_nowhere_is_refused(theirs: str, name: str, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        load_solver(name.format(theirs))


def two_rooms(solver: str | None) -> tuple[Model, TaskHierarchy]:
    at = boolean("home")
    model = Model(
        "rooms", [at], [Action("go", {at: True}), Action("stay")], rewards="-1", terminal="home",
        initial={at: False}, discount="9/10",
    )  # fmt: skip
    return model, TaskHierarchy([Task("root", ["go", "stay"], solver=solver)])


@pytest.mark.parametrize("default", ["auto", "pi"])
def test_a_model_may_not_name_a_module(theirs: str, default: str) -> None:
    model, tasks = two_rooms(f"{theirs}:Steps")
    with pytest.raises(ModelError, match=r"would import a module, which a model may not ask for.*--solver"):
        plan_mdp(model, tasks, Options(solver=default))


def test_a_partially_observed_model_may_not_either(theirs: str) -> None:
    model = library.load("tiger").model
    tasks = TaskHierarchy([Task("root", [a.name for a in model.actions], solver=f"{theirs}:qmdp")])
    with pytest.raises(ModelError, match="a model may not ask for"):
        plan_pomdp(model, tasks)


# -- use -------------------------------------------------------------------------------------------


def test_plans_use_a_solver_given_as_an_object() -> None:
    asked: list[int] = []

    def counting(mdp: ArrayMDP, demand: Demand) -> MDPSolution:
        asked.append(mdp.states)
        return replace(ours_mdp(mdp, demand), method="counting")

    domain = library.load("taxi")
    found = plan_mdp(domain.model, domain.tasks, Options(solver=counting))
    expected = plan_mdp(domain.model, domain.tasks)
    assert len(asked) == len(found.solved)
    assert {task.solution.method for task in found.solved} == {"counting"}
    assert found.polled.value == pytest.approx(expected.polled.value, abs=1e-9)


def test_a_task_that_names_a_solver_keeps_it() -> None:
    model, tasks = two_rooms("vi")
    found = plan_mdp(model, tasks, Options(solver=ours_mdp))
    assert found.root.solution.method == "value iteration"


def test_plans_where_the_state_is_not_seen_use_it_too(theirs: str) -> None:
    found = plan_pomdp(library.load("tiger").model, None, Options(solver=f"{theirs}:qmdp"))
    assert found.root.solution.method == "theirs"
    assert 19.0 < found.root.lower <= 19.371369 <= found.root.upper


def test_children_are_asked_for_at_all_corners() -> None:
    asked: list[int | None] = []

    def asking(pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None) -> POMDPSolution:
        asked.append(None if roots is None else len(roots) - pomdp.states)
        return solve_pomdp(pomdp, "fib", demand=demand, roots=roots)

    model = library.load("tiger").model
    names = [action.name for action in model.actions]
    tasks = TaskHierarchy(
        [
            Task("child", names, pseudo_rewards="-1 if tiger == left else 0"),
            Task("root", ["child", *names]),
        ]
    )
    plan_pomdp(model, tasks, Options(solver=asking))
    assert asked[0] is not None
    assert asked[0] >= 1


def test_a_policy_with_a_memory_is_refused_in_a_task() -> None:
    graph = PolicyGraph(np.array([0]), (np.zeros((2, 1), dtype=np.int64),), np.array([0]))

    def with_memory(pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None) -> POMDPSolution:
        found = solve_pomdp(pomdp, "blind", demand=demand, roots=roots)
        count = len(pomdp.kernel[0])
        table = np.zeros((count, int(pomdp.observed.max()) + 1), dtype=np.int64)
        return replace(found, policy=replace(graph, successors=(table,)))

    with pytest.raises(ModelError, match="PolicyGraph, which is no map from beliefs"):
        plan_pomdp(library.load("tiger").model, None, Options(solver=with_memory))


# -- what is refused -------------------------------------------------------------------------------

TIGER = tiger(0.95)
RIGHT = solve_pomdp(TIGER, "sarsop", demand=Demand(gap=1e-3))
VECTORS = RIGHT.policy
assert isinstance(VECTORS, AlphaVectors)
PART = VECTORS.sets[0]


def with_part(**changes: Any) -> dict[str, Any]:
    return {"policy": AlphaVectors(2, (replace(PART, **changes),))}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"lower": RIGHT.upper + 1}, "lower bound .* is above the upper bound"),
        ({"value": RIGHT.upper + 1}, "not between the bounds"),
        ({"lower": float("nan")}, "lower is nan"),
        ({"upper": "much"}, "upper is 'much'"),
        ({"lower": 300.0, "value": 300.0, "upper": 400.0}, "above all that rewards allow, 200"),
        ({"root_lower": np.zeros(3)}, r"root_lower is an array of the shape \(3,\), not .*\(1,\)"),
        ({"root_upper": RIGHT.root_lower - 1}, "at a root the lower bound is"),
        ({"root_upper": np.array([np.nan])}, "not a number"),
        ({"status": "done"}, "the status is 'done', none of converged"),
        ({"guarantee": "sure"}, "the guarantee is none of the kinds"),
        ({"method": None}, "the method is NoneType"),
        ({"policy": 5}, "the policy is int, none of AlphaVectors"),
        ({"policy": AlphaVectors(3, VECTORS.sets)}, "for 3 states, not for 2"),
        (with_part(states=np.array([0, 2])), "a state outside 0 .. 1"),
        (with_part(vectors=np.zeros((1, 3))), r"not vectors \[n, 2\]"),
        (with_part(actions=np.zeros(1, dtype=np.int64)), "1 actions for"),
        (with_part(vectors=np.full(PART.vectors.shape, np.inf)), "not finite"),
        (with_part(actions=PART.actions + 7), "an action outside 0 .. 2"),
        ({"policy": AlphaVectors(2, (PART, PART))}, "in more than one set"),
        (
            {"policy": PolicyGraph(np.array([9]), (np.zeros((2, 1), int),), np.array([0]))},
            "an action outside",
        ),
        ({"policy": PolicyGraph(np.array([0]), (), np.array([0]))}, "0 tables for 1 nodes"),
        ({"policy": PolicyGraph(np.array([0]), (np.zeros((1, 1), int),), np.array([0]))}, "node 0 .* has"),
        ({"policy": PolicyGraph(np.array([0]), (np.ones((2, 1), int),), np.array([0]))}, "leads outside"),
        ({"policy": PolicyGraph(np.array([0]), (np.zeros((2, 1), int),), np.array([4]))}, "start"),
    ],
)
def test_a_wrong_solution_is_refused_with_what_is_wrong(changes: dict[str, Any], said: str) -> None:
    def wrong(pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None) -> POMDPSolution:
        return replace(RIGHT, **changes)

    with pytest.raises(ModelError, match=f"test_custom_solvers:.*wrong returned no right solution.*{said}"):
        call_pomdp_solver(wrong, TIGER, Demand())


def small_mdp() -> ArrayMDP:
    domain = library.load("taxi", {"size": 2})
    return reduce(flat_process(compile_model(domain.model))).quotient.mdp  # type: ignore[union-attr]


def test_ours_pass() -> None:
    mdp = small_mdp()
    assert mdp_faults(solve_mdp(mdp), mdp) == []
    for method in ("pbvi", "hsvi", "qmdp", "amdp", "blind", "auto", "exact"):
        found = solve_pomdp(TIGER, method, demand=Demand(gap=1e-2, iterations=50))
        assert pomdp_faults(found, TIGER) == [], method


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda s: {"values": s.values[:-1]}, "values is an array of the shape"),
        (lambda s: {"policy": s.policy.astype(float)}, "not whole numbers"),
        (lambda s: {"policy": s.policy + 99}, "an action outside"),
        (lambda s: {"policy": np.full_like(s.policy, -1)}, "no action, though it is no dead end"),
        (lambda s: {"lower": s.upper + 1}, "the lower bound .* is above the upper bound"),
        (lambda s: {"values": s.upper + 1}, "is not between the bounds"),
        (lambda s: {"lower": s.lower * np.nan}, "not a number"),
        (lambda s: {"status": ""}, "the status is ''"),
    ],
)
def test_a_wrong_solution_of_an_mdp_is_refused(change: Callable[[Any], Any], said: str) -> None:
    mdp = small_mdp()
    right = solve_mdp(mdp)

    def wrong(mdp: ArrayMDP, demand: Demand) -> MDPSolution:
        return replace(right, **change(right))

    with pytest.raises(ModelError, match=said):
        call_mdp_solver(wrong, mdp, Demand())


def test_an_action_that_is_not_applicable_is_refused() -> None:
    mdp = small_mdp()
    right = solve_mdp(mdp)
    state = int(np.flatnonzero(~mdp.applicable.all(axis=0))[0])
    policy = right.policy.copy()
    policy[state] = int(np.flatnonzero(~mdp.applicable[:, state])[0])
    assert any("not applicable" in fault for fault in mdp_faults(replace(right, policy=policy), mdp))


def test_a_solver_that_fails_is_named(theirs: str) -> None:
    for name, said in (("fails", "ValueError: no idea"), ("lies", "it is int, not a POMDPSolution")):
        with pytest.raises(ModelError, match=f"{theirs}:{name}.*{said}"):
            call_pomdp_solver(load_solver(f"{theirs}:{name}"), TIGER, Demand())


# -- from a policy to a solution -------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
def test_bounds_made_for_a_bare_policy_hold(seed: int) -> None:
    """Sound whatever the vectors are: exact ones are (nearly) kept, random ones earn less."""
    pomdp = random_pomdp(seed)
    best = solve_pomdp(pomdp, "exact", demand=Demand(gap=1e-7))
    random = np.random.default_rng(seed)
    for vectors in (None, random.normal(size=(4, pomdp.states)) * 100):
        if vectors is None:
            if not isinstance(best.policy, AlphaVectors):
                assert isinstance(best.policy, PolicyGraph)
            policy: Any = best.policy
        else:
            policy = alpha_vectors(pomdp, vectors, random.integers(0, len(pomdp.actions), 4))
        found = solution_of_policy(pomdp, policy, method="theirs")
        assert pomdp_faults(found, pomdp) == []
        assert found.lower <= best.upper + 1e-9
        assert found.upper >= best.lower - 1e-9
        if vectors is None:
            assert found.lower >= best.lower - 1e-3 * max(1.0, abs(best.lower))


def test_vectors_that_promise_too_much_do_not_raise_the_bound() -> None:
    policy = alpha_vectors(TIGER, np.full((3, 2), 1e6), np.arange(3))
    found = solution_of_policy(TIGER, policy, method="theirs")
    assert found.lower <= 19.371369


def test_a_table_of_actions_is_evaluated() -> None:
    mdp = small_mdp()
    best = solve_mdp(mdp)
    found = solution_of_actions(mdp, best.policy, method="theirs")
    assert found.converged
    assert mdp_faults(found, mdp) == []
    np.testing.assert_allclose(found.lower, best.values, atol=1e-7)
    worse = np.where(mdp.terminal, -1, mdp.applicable.argmax(axis=0))
    found = solution_of_actions(mdp, worse, method="theirs")
    assert mdp_faults(found, mdp) == []
    assert (found.lower <= best.upper + 1e-9).all()
    assert (found.upper >= best.lower - 1e-9).all()
    assert not found.converged


@pytest.mark.parametrize(
    ("vectors", "actions", "said"),
    [
        (np.zeros((1, 3)), np.array([0]), r"shape \(1, 3\), not \(n, 2\)"),
        (np.zeros((1, 2)), np.array([3]), "an action outside"),
        (np.full((1, 2), np.nan), np.array([0]), "not finite"),
    ],
)
def test_vectors_of_a_wrong_kind_are_refused(vectors: Any, actions: Any, said: str) -> None:
    with pytest.raises(ModelError, match=said):
        alpha_vectors(TIGER, vectors, actions)


# -- the command line ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "value"),
    [
        (("plan", "toy", "--solver", "{}:Steps"), 7.55),
        (("solve", "toy", "--solver", "{}:Steps"), 7.55),
        (("solve", "tiger", "--solver", "{}:qmdp"), 19.371368),
    ],
)
def test_the_command_line_imports_what_it_is_told(
    theirs: str, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], value: float
) -> None:
    """The toy's value: see `test_command_line`; QMDP's policy is the tiger's best."""
    assert main([*(a.format(theirs) for a in arguments), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["value"] == pytest.approx(value, abs=1e-5)
    if arguments[0] == "solve":
        assert data["method"] == "theirs"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("plan", "toy", "--solver", "{}:missing"), "has no missing"),
        (("plan", "toy", "--solver", "{}:lies"), "it is int, not an MDPSolution"),
        (("solve", "tiger", "--solver", "{}:fails"), "failed: ValueError: no idea"),
        (("solve", "tiger", "--solver", "{}:qmdp", "--horizon", "3"), "has none"),
        (("solve", "tiger", "--solver", "{}:"), "package.module:Name"),
    ],
)
def test_what_is_wrong_with_a_solver_is_said(
    theirs: str, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], said: str
) -> None:
    try:
        status = main([a.format(theirs) for a in arguments])
    except SystemExit as error:
        status = int(error.code or 0)
    message = capsys.readouterr().err
    assert status == 2
    assert said in " ".join(message.split())
    assert "a fault of factored-polca" not in message


def test_the_solver_in_the_documentation_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = Path(__file__).resolve().parent.parent / "docs" / "howto" / "write-a-solver.md"
    text = page.read_text(encoding="utf-8")
    (body,) = re.findall(r"^```python\n# qmdp\.py\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    (tmp_path / "readme_qmdp.py").write_text(body, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    assert main(["plan", "tiger", "--solver", "readme_qmdp:solve", "--json"]) == 0
    (task,) = json.loads(capsys.readouterr().out)["tasks"]
    assert 19 < task["lower"] <= 19.371369 <= task["upper"]
    solver = load_solver("readme_qmdp:solve")
    check_solver(solver)


UNTRUSTED = """name = "untrusted"
discount = 0.9
reward = "-1"
terminal = "home"
[features]
home = "boolean"
[actions.go]
effects.home = "true"
[actions.stay]
[tasks.root]
actions = ["go", "stay"]
solver = "{}:Steps"
"""


@pytest.mark.parametrize("command", [("check",), ("plan",), ("plan", "--solver", "pi")])
def test_a_model_file_runs_no_program(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: tuple[str, ...],
) -> None:
    (tmp_path / "would_be_imported.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "untrusted.toml"
    path.write_text(UNTRUSTED.format("would_be_imported"), encoding="utf-8")
    assert main([command[0], str(path), *command[1:]]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "untrusted.toml:12" in message
    assert "would import a module, which a model may not ask for" in message
    assert "would_be_imported" not in sys.modules


def test_what_is_no_solver_is_refused() -> None:
    model, tasks = two_rooms(None)
    with pytest.raises(ModelError, match="the solver is int: give a name, or something to call"):
        plan_mdp(model, tasks, Options(solver=5))  # type: ignore[arg-type]
