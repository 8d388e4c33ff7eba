"""PolCA+ with subtasks solved on diagrams: against arrays of all states, and against quotients."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from belief_plans import ByHand, corridor, corridor_tasks
from test_polca_plus import Case, explicit_task, random_hierarchy, values_at
from test_symbolic_pomdp import discounted
from tree_brackets import bracket

from factored_polca import library
from factored_polca.cli.entry import run
from factored_polca.control.belief_controller import BeliefController, plan_tracker
from factored_polca.diagrams import evaluate_states
from factored_polca.display import html
from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.hierarchy import Options, PomdpPlan, plan, plan_pomdp
from factored_polca.hierarchy.pomdp_executable import executable_pomdp
from factored_polca.hierarchy.pomdp_plan_file import load_pomdp_plan, save_pomdp_plan
from factored_polca.hierarchy.pomdp_report import pomdp_plan_report
from factored_polca.hierarchy.pomdp_solved import SolvedPomdpTask
from factored_polca.hierarchy.symbolic_task import SymbolicPomdpTask
from factored_polca.minimisation.flat_model import flat_model
from factored_polca.models import Action, LimitReached, Model, ModelError, Task, TaskHierarchy
from factored_polca.models.model import replace_fields
from factored_polca.simulation.measure import measure
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.structured.pomdp_belief import BeliefSpace
from factored_polca.structured.pomdp_bounds import FirstBounds, Sizes
from factored_polca.structured.pomdp_cell_bounds import first_bounds
from factored_polca.structured.pomdp_informed import InformedBound
from factored_polca.structured.pomdp_model import FactoredPOMDP
from factored_polca.symbolic import compile_model

SEEDS = range(32)
ON_DIAGRAMS = Options(solver="symbolic", trials=30, gap=1e-2, flat_block_limit=None)


def digits(model: Model) -> np.ndarray:
    """The states of the enumeration as value numbers [s, feature]."""
    rows = [
        [f.index(v) for f, v in zip(model.features, values, strict=True)]
        for values in enumerate_pomdp(model).state_values
    ]
    return np.array(rows, dtype=np.int32)


def mixed(seed: int, tasks: TaskHierarchy) -> TaskHierarchy:
    """All tasks on diagrams, or the children only, or the root only."""
    kinds = {0: ("symbolic", "symbolic"), 1: ("symbolic", "sarsop"), 2: ("sarsop", "symbolic")}[seed % 3]
    (root,) = tasks.roots()
    return TaskHierarchy([replace(t, solver=kinds[t.name == root.name]) for t in tasks.tasks])


@cache
def planned(seed: int) -> Case | str:
    """The plan of a random hierarchy, or why it is refused."""
    model = discounted(seed, actions=(2, 3))
    try:
        found = plan_pomdp(model, mixed(seed, random_hierarchy(seed, model)), ON_DIAGRAMS)
    except ModelError as error:
        return str(error)
    except LimitReached as error:
        return str(error)
    return Case(model, found, digits(model))


@pytest.mark.parametrize("seed", SEEDS)
def test_bounds_of_random_tasks_contain_their_values_by_enumeration(seed: int) -> None:
    """Each task given its children's policies, whatever solved these; and what it does at corners."""
    found = planned(seed)
    if isinstance(found, str):
        return
    random = np.random.default_rng(seed)
    for solved in found.plan.solved:
        task = solved.task
        if task.observes is not None and not (task.has_pseudo_reward and not task.adds_reward):
            continue
        pomdp = explicit_task(found, task).to_arrays()
        low, high = bracket(pomdp, pomdp.initial, 1e-2)
        assert solved.lower <= high + 1e-9
        assert low <= solved.upper + 1e-9
        if isinstance(solved, SolvedPomdpTask) or solved.solution.corner_gap is None:
            continue
        chosen = values_at(found, solved.corner)
        live = np.flatnonzero(~pomdp.terminal)
        for state in random.permutation(live)[:2].tolist():
            corner = np.eye(pomdp.states)[state]
            best = bracket(pomdp, corner, 1e-2)[0]
            worth = float(pomdp.rewards[chosen[state], state])
            for matrix in pomdp.kernel[chosen[state]]:
                after = corner @ matrix
                if after.sum() > 0:
                    after_high = bracket(pomdp, after / after.sum(), 1e-2)[1]
                    worth += pomdp.discount * float(after.sum()) * after_high
            assert worth + solved.corner_gap >= best - 1e-9


def test_the_random_hierarchies_are_of_all_kinds() -> None:
    cases = [case for seed in SEEDS if not isinstance(case := planned(seed), str)]
    refused = [case for seed in SEEDS if isinstance(case := planned(seed), str)]
    assert all("nothing to optimise" in text or "each other's order" in text for text in refused)
    solved = [one for found in cases for one in found.plan.solved]
    on_diagrams = [one for one in solved if isinstance(one, SymbolicPomdpTask)]
    assert len(cases) >= 20
    assert len(on_diagrams) > 40
    parents = [one for one in on_diagrams if any(len(c.primitives) > 1 for c in one.process.choices)]
    assert len(parents) >= 5, "children that take several primitives"
    assert sum(one.solution.corner_gap is not None for one in on_diagrams) > 15


@pytest.mark.parametrize("name", ["meds", "cheese_taxi", "part_painting"])
def test_shipped_hierarchies_on_diagrams_agree_with_quotients(name: str) -> None:
    """Tasks without children against their quotients; the root over the same children's policies."""
    domain = library.load(name, {})
    assert domain.tasks is not None
    found = plan_pomdp(domain.model, domain.tasks, ON_DIAGRAMS)
    over_blocks = plan_pomdp(domain.model, domain.tasks, replace(ON_DIAGRAMS, solver="auto"))
    (root,) = domain.tasks.roots()
    changed = [
        replace(t, solver="sarsop" if t.name == root.name else "symbolic") for t in domain.tasks.tasks
    ]
    same_children = plan_pomdp(domain.model, TaskHierarchy(changed), ON_DIAGRAMS)
    names = {task.name for task in domain.tasks.tasks}
    for solved in found.solved:
        other = same_children if solved.task.name == root.name else over_blocks
        if other is over_blocks and any(action in names for action in solved.task.actions):
            continue
        against = other.task(solved.task.name)
        assert isinstance(against, SolvedPomdpTask)
        assert solved.lower <= against.upper + 1e-9
        assert against.lower <= solved.upper + 1e-9


# -- execution -------------------------------------------------------------------------------------


class ByStates(ByHand):
    """Tasks on diagrams asked by their alpha-vectors' values at all states."""

    def vectors(self, name: str, belief: np.ndarray) -> list[tuple[int, np.ndarray]]:
        policy = self.plan.policies[name].policy
        pomdp = policy.space.pomdp
        state = int(belief.argmax())
        seen = tuple(int(self.digits[state][i]) for i in pomdp.observed)
        same = (self.digits[:, list(pomdp.observed)] == seen).all(axis=1)
        columns = self.plan.symbolic.columns()
        return [
            (a.action, np.where(same, evaluate_states(a.diagram, self.digits, columns).view(np.float64), 0))
            for a in policy.at(seen).alphas
        ]

    def value(self, name: str, belief: np.ndarray) -> float:
        total = 0.0
        for y in np.unique(self.observed[belief > 0]).tolist():
            part = np.where((self.observed == y) & ~self.over[name], belief, 0.0)
            if part.sum() > 0:
                total += max(float(alpha @ part) for _, alpha in self.vectors(name, part))
        return total

    def first_choice(self, name: str, belief: np.ndarray) -> str:
        worth = [(float(alpha @ belief), action) for action, alpha in self.vectors(name, belief)]
        return self.plan.policies[name].actions[max(worth, key=lambda pair: pair[0])[1]]

    def corner(self, name: str) -> np.ndarray:
        task, numbers = self.plan.policies[name], [action.name for action in self.plan.model.actions]
        labels = self.labels[name]
        result = np.zeros(len(self.digits), dtype=np.int64)
        for s in range(len(self.digits)):
            action = task.actions[int(task.corner[labels[s]])]
            below = action in self.plan.policies
            result[s] = self.corner(action)[s] if below else numbers.index(action)
        return result


@pytest.mark.parametrize("ending", [False, True])
@pytest.mark.parametrize("only_children", [False, True])
def test_the_controller_does_what_the_alpha_vectors_say_at_the_belief(
    ending: bool, only_children: bool
) -> None:
    model = corridor(ending)
    found = plan_pomdp(model, corridor_tasks(only_children=only_children), ON_DIAGRAMS)
    executable = executable_pomdp(found)
    hand, controller = ByStates(executable), BeliefController(executable)
    tracker = plan_tracker(executable).tracker
    assert tracker.kind == "diagram"
    random = np.random.default_rng(3)
    ahead = 0
    channel = model.observations[0]
    for _ in range(12):
        state = int(random.choice(len(hand.initial), p=hand.initial))
        belief = np.where(hand.observed == hand.observed[state], hand.initial, 0.0)
        belief /= belief.sum()
        told = tracker.start({"place": model.features[0].values[hand.digits[state][0]]} if ending else {})
        for _ in range(6):
            decision = controller.poll(told)
            ahead += any(poll.looked_ahead for poll in decision.path)
            assert decision.number == hand.action(belief)
            joint = hand.kernel[decision.number][:, state, :]  # [o, t]
            place = int(random.choice(joint.size, p=joint.ravel() / joint.sum()))
            o, state = divmod(place, joint.shape[1])
            belief = belief @ hand.kernel[decision.number, o]
            belief = np.where((hand.observed == hand.observed[state]) & ~hand.terminal, belief, 0.0)
            if hand.terminal[state]:
                break
            belief /= belief.sum()
            said = {channel.name: hand.exact.observations[o][0]}
            if ending:
                said["place"] = model.features[0].values[hand.digits[state][0]]
            told = told.after(decision.number, said)
    if ending and only_children:
        assert ahead > 0, "a child that has surely ended is met"


def test_a_plan_with_tasks_on_diagrams_is_measured_saved_loaded_and_drawn(tmp_path: Path) -> None:
    found = plan(corridor(), corridor_tasks(), replace(ON_DIAGRAMS, flat_block_limit=1000))
    assert isinstance(found, PomdpPlan)
    assert found.flat.upper is not None
    assert found.flat.upper >= found.root.lower
    report = pomdp_plan_report(found)
    assert all(row["blocks"] is None for row in report["tasks"])
    assert "on diagrams, without a quotient" in report["guarantee"]
    assert "point-based value iteration on diagrams" in html(found)
    assert "alpha-vectors" in html(found.root)
    executable = executable_pomdp(found, {"value": 1.0})
    path = tmp_path / "corridor.plan"
    save_pomdp_plan(executable, path)
    again = load_pomdp_plan(path)
    first, second = (measure(p, episodes=8, steps=12, seed=4) for p in (executable, again))
    assert first.tracker.kind == "diagram"
    np.testing.assert_array_equal(first.runs["Root"].returns, second.runs["Root"].returns)
    for name in executable.policies:
        np.testing.assert_array_equal(executable.policies[name].corner, again.policies[name].corner)


def test_auto_takes_diagrams_where_a_quotient_is_too_large() -> None:
    found = plan_pomdp(corridor(), corridor_tasks(), Options(symbolic_blocks=3, trials=10))
    kinds = {solved.task.name: type(solved) for solved in found.solved}
    assert kinds["Root"] is SymbolicPomdpTask
    warnings = [text for text in found.warnings if "'Root'" in text]
    assert any("no quotient (more than 3 blocks" in text for text in warnings)
    assert any("point-based value iteration on diagrams" in text for text in warnings)
    with pytest.raises(LimitReached, match="more than 3 blocks"):
        plan_pomdp(corridor(), corridor_tasks(), Options(block_limit=3))


def test_merging_near_states_and_diagrams_exclude_each_other() -> None:
    with pytest.raises(ModelError, match="merging near states needs blocks"):
        plan_pomdp(corridor(), corridor_tasks(), Options(solver="symbolic", merge_within="0.01"))


def test_a_child_whose_next_values_need_two_orders_is_refused_by_a_parent_on_diagrams() -> None:
    model = corridor()
    place, lamp = model.features
    first = Action("first", {place: "2 if lamp' else 0", lamp: "{true: 1/2, false: 1/2}"})
    other = Action("other", {lamp: "place' == 2", place: "{0: 1/2, 2: 1/2}"})
    model = replace_fields(model, actions=(*model.actions, first, other))
    both = Task("Both", ["first", "other"], pseudo_rewards="lamp", pseudo_rewards_of={"first": "place - 1"})
    tasks = TaskHierarchy([Task("Root", ["Both", "step", "look"]), both])
    with pytest.raises(LimitReached, match=r"'Both'.*each other's order"):
        plan_pomdp(model, tasks, ON_DIAGRAMS)


def test_the_commands_plan_simulate_and_act_on_diagrams(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "meds.plan")
    assert run(["plan", "meds", "--solver", "symbolic", "--episodes", "5", "-o", path]) == 0
    said = capsys.readouterr().out
    assert "point-based value iteration on diagrams" in said
    assert run(["plan", "meds", "--solver", "symbolic", "--episodes", "5", "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert [row["blocks"] for row in data["tasks"]] == [None, None]
    assert data["tracker"] == "diagram"
    flat = flat_model(compile_model(library.load("meds").model)).pomdp
    assert data["flat_upper"] >= solve_pomdp(flat, "sarsop", demand=Demand(0.1)).lower
    assert run(["simulate", path, "--episodes", "3", "--steps", "5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["tracker"] == "diagram"
    assert run(["act", path, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["action"]


# -- the fast informed bound -------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(30))
def test_the_informed_bound_is_its_equation_solved_over_all_states(seed: int) -> None:
    """Hauskrecht 2000 by value iteration over the enumeration's states and joint observations."""
    model = discounted(seed, actions=(1, 3))
    exact = enumerate_pomdp(model)
    pomdp = FactoredPOMDP(compile_model(model))
    first = FirstBounds(pomdp, Sizes(10_000, 1e-9), lambda: None)
    quality, _ = first_bounds(first, 60.0, 60.0, lambda blind: None)
    found = InformedBound(first, [belief.seen for _, belief in BeliefSpace(pomdp).starts()], quality)
    found.improve(60.0, 1e-9)
    numbers = digits(model)
    seen = [tuple(int(row[i]) for i in pomdp.observed) for row in numbers]
    discount = float(model.discount)
    wanted = np.full((pomdp.actions, exact.states), first.ceiling)
    for _ in range(60):
        after = np.zeros_like(wanted)
        for a in range(pomdp.actions):
            for s in range(exact.states):
                if exact.terminal[s]:
                    continue
                totals: dict[object, np.ndarray] = {}
                for (t, o), chance in exact.kernel[a][s].items():
                    if not exact.terminal[t]:
                        part = totals.setdefault((o, seen[t]), np.zeros(pomdp.actions))
                        part += float(chance) * wanted[:, t]
                best = sum(float(part.max()) for part in totals.values())
                after[a, s] = float(exact.rewards[a][s]) + discount * best
        wanted = after
    order = sorted(pomdp.hidden, key=pomdp.symbolic.now)
    for s in range(exact.states):
        if seen[s] in found.q and not exact.terminal[s]:
            cell = tuple(int(numbers[s][k]) for k in order)
            for a in range(pomdp.actions):
                assert found.q[seen[s]][(a, *cell)] == pytest.approx(wanted[a, s], abs=1e-5)
                assert found.q[seen[s]][(a, *cell)] >= wanted[a, s] - 1e-9
