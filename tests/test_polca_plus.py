"""PolCA+: every task of random hierarchies against its POMDP by enumeration, and what DESIGN 5 promises."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from random import Random

import numpy as np
import numpy.typing as npt
import pytest
from changed_models import replace_action
from random_dynamics import Reader, amount, told_apart
from random_pomdps import random_pomdp

from factored_polca.diagrams import evaluate_states
from factored_polca.explicit.alpha_expansion import forward_values
from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.exact_pomdp import ExactPOMDP, enumerate_pomdp
from factored_polca.explicit.minimiser import minimise_pomdp
from factored_polca.explicit.subtask import local_rewards
from factored_polca.hierarchy import (
    Options,
    PomdpPlan,
    SolvedPomdpTask,
    plan,
    plan_mdp,
    plan_pomdp,
    planning_order,
)
from factored_polca.hierarchy.parameters import pomdp_parameters
from factored_polca.hierarchy.pomdp_plan import refuse_unplannable
from factored_polca.hierarchy.pomdp_report import task_guarantee
from factored_polca.hierarchy.subtask import planning_channels, subtask_process
from factored_polca.library import load
from factored_polca.minimisation import minimise
from factored_polca.models import (
    Action,
    Constant,
    Feature,
    LimitReached,
    Model,
    ModelError,
    Observation,
    Task,
    TaskHierarchy,
    boolean,
    disjunction,
)
from factored_polca.models.expressions import Reference
from factored_polca.models.model import replace_fields
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand

SEEDS = range(60)
FAST = Options(trials=40, gap=1e-3)

# -- random hierarchies ---------------------------------------------------------------------------


def random_task(random: Random, model: Model, name: str, actions: Sequence[str]) -> Task:
    """A task with pseudo-rewards over the state, and sometimes an end and fewer observations."""
    reader = Reader(random, told_apart(model.features), {f.name: f for f in model.features})
    references = [Reference(f.name) for f in random.sample(model.features, len(model.features))]
    channels = [channel.name for channel in model.observations]
    below = [a.name for a in model.actions]
    return Task(
        name,
        actions,
        terminal=reader.condition(references[-1]) if random.random() < 0.6 else False,
        pseudo_rewards=reader.tree(references[:2], lambda: Constant(amount(random))),
        pseudo_rewards_of={random.choice(below): [Constant(amount(random))]},
        adds_reward=random.random() < 0.3,
        observes=random.sample(channels, len(channels) - 1) if channels and random.random() < 0.2 else None,
    )


def random_hierarchy(seed: int, model: Model) -> TaskHierarchy:
    """A chain or a tree of two or three tasks; the root has the model's reward."""
    random = Random(f"belief tasks {seed}")
    names = [action.name for action in model.actions]
    first = random_task(random, model, "first", random.sample(names, random.randint(1, len(names))))
    tasks = [first]
    if random.random() < 0.6:
        below = ["first"] if random.random() < 0.5 else []
        own = random.sample(names, random.randint(1, len(names)))
        tasks.append(random_task(random, model, "second", random.sample(own + below, len(own + below))))
    orphans = {task.name for task in tasks} - {a for task in tasks for a in task.actions}
    actions = sorted(orphans) + random.sample(names, random.randint(0, len(names)))
    return TaskHierarchy([*tasks, Task("root", random.sample(actions, len(actions)))])


@dataclass(frozen=True)
class Case:
    """A planned hierarchy, and the states of its model as value numbers [s, feature]."""

    model: Model
    plan: PomdpPlan
    states: npt.NDArray[np.int32]


@cache
def case(seed: int) -> Case | str:
    """The plan of a random hierarchy, or why it is refused."""
    model = random_pomdp(seed, actions=(2, 3), max_states=24)
    exact = enumerate_pomdp(model)
    rows = [[f.index(v) for f, v in zip(model.features, s, strict=True)] for s in exact.state_values]
    try:
        found = plan_pomdp(model, random_hierarchy(seed, model), FAST)
    except ModelError as error:
        return str(error)
    return Case(model, found, np.array(rows, dtype=np.int32))


def values_at(found: Case, diagram: object) -> list[int]:
    """The leaf of an index diagram at each state."""
    columns = found.plan.symbolic.columns()
    return [int(v) for v in evaluate_states(diagram, found.states, columns)]  # type: ignore[arg-type]


def explicit_task(found: Case, task: Task) -> ExactPOMDP:
    """The POMDP of a task by enumeration: its own end and reward, children by their policies of states."""
    model, channels = found.model, planning_channels(found.model, task)
    kept = {model.observations[j].name for j in channels}
    terms = local_rewards(model, task)
    acting = [
        replace_action(a, rewards=terms[a.name], senses=[(c, e) for c, e in a.senses if c in kept])
        for a in model.actions
    ]
    if task.has_pseudo_reward and not task.adds_reward and len(kept) < len(model.observations):
        listed = [model.observations[j] for j in channels]
    else:  # the model's rewards may be over any channel
        listed = list(model.observations)
    changed = replace_fields(
        model,
        actions=tuple(acting),
        rewards=(),
        terminal=disjunction([model.terminal, task.terminal]),
        observations=tuple(listed),
    )
    exact = enumerate_pomdp(changed)
    numbers = {a.name: i for i, a in enumerate(model.actions)}
    policies = {}
    for name in task.actions:
        if name in numbers:
            policies[name] = [numbers[name]] * exact.states
        else:
            policies[name] = values_at(found, found.plan.task(name).policy)
    return polled(exact, policies)


def polled(exact: ExactPOMDP, policies: Mapping[str, Sequence[int]]) -> ExactPOMDP:
    """The POMDP whose actions take, at each state, the primitive that a policy says."""
    taken = list(policies.values())
    kernel = tuple(
        tuple({} if exact.terminal[s] else exact.kernel[a][s] for s, a in enumerate(policy))
        for policy in taken
    )
    rewards = tuple(
        tuple(Fraction(0) if exact.terminal[s] else exact.rewards[a][s] for s, a in enumerate(policy))
        for policy in taken
    )
    listed = tuple(tuple(sorted({o for row in rows for _, o in row})) or (0,) for rows in kernel)
    return replace(exact, actions=tuple(policies), kernel=kernel, rewards=rewards, observations_of=listed)


def tasks_of(seed: int) -> list[tuple[Case, SolvedPomdpTask]]:
    found = case(seed)
    return [] if isinstance(found, str) else [(found, solved) for solved in found.plan.solved]


def comparable(found: Case, task: Task) -> bool:
    """Whether `explicit_task` gives the task's POMDP: it hears all, or what is left out earns nothing."""
    return task.observes is None or (task.has_pseudo_reward and not task.adds_reward)


@pytest.mark.parametrize("seed", SEEDS)
def test_each_task_has_the_coarsest_partition_of_its_pomdp_by_enumeration(seed: int) -> None:
    for found, solved in tasks_of(seed):
        if comparable(found, solved.task):
            expected = minimise_pomdp(explicit_task(found, solved.task))
            blocks = values_at(found, solved.reduction.partition.diagram)
            numbers: dict[int, int] = {}
            assert [numbers.setdefault(b, len(numbers)) for b in blocks] == list(expected.block_of)


@pytest.mark.parametrize("seed", SEEDS)
def test_each_task_is_worth_at_horizon_three_what_its_pomdp_by_enumeration_is(seed: int) -> None:
    for found, solved in tasks_of(seed):
        exact = explicit_task(found, solved.task)
        if not comparable(found, solved.task) or sum(map(len, exact.observations_of)) > 20:
            continue
        original, quotient = exact.to_arrays(), solved.reduction.pomdp_quotient.pomdp
        random = np.random.default_rng(seed)
        beliefs = np.vstack([original.initial, random.dirichlet(np.ones(original.states), 3)])
        blocks = np.array(values_at(found, solved.reduction.partition.diagram))
        projected = np.array([np.bincount(blocks, b, quotient.states) for b in beliefs])
        expected = forward_values(original, beliefs, 3)
        assert forward_values(quotient, projected, 3) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_bounds_of_tasks_contain_those_of_their_pomdps_by_enumeration() -> None:
    compared = 0
    for seed in SEEDS:
        for found, solved in tasks_of(seed):
            if comparable(found, solved.task) and seed % 3 == 0:
                pomdp = explicit_task(found, solved.task).to_arrays()
                other = solve_pomdp(pomdp, "hsvi", demand=Demand(gap=1e-3, iterations=60))
                assert solved.lower <= other.upper
                assert other.lower <= solved.upper
                compared += 1
    assert compared > 20


@pytest.mark.parametrize("seed", SEEDS)
def test_at_corners_a_task_does_what_its_vectors_say_the_first_of_equals(seed: int) -> None:
    for _, solved in tasks_of(seed):
        pomdp, policy = solved.reduction.pomdp_quotient.pomdp, solved.belief_policy
        assert isinstance(policy, AlphaVectors)
        for block in range(pomdp.states):
            best: dict[int, float] = {}
            for part in policy.sets:
                for i in np.flatnonzero(part.states == block).tolist():
                    for action, vector in zip(part.actions.tolist(), part.vectors, strict=True):
                        best[action] = max(best.get(action, -np.inf), float(vector[i]))
            top = max(best.values(), default=0.0)
            first = min((a for a, v in best.items() if v >= top - 1e-9 * max(1, abs(top))), default=0)
            assert solved.corner[block] == first


def test_at_every_corner_the_bounds_contain_those_of_another_solver() -> None:
    """What is chosen at a corner earns, given the children, at most `corner_gap` less than can be had."""
    compared = 0
    for seed in SEEDS[:30]:
        for _, solved in tasks_of(seed):
            pomdp, policy = solved.reduction.pomdp_quotient.pomdp, solved.belief_policy
            if solved.task.name == "root" or solved.solution.status != "converged" or pomdp.states > 12:
                continue
            for block in np.flatnonzero(~pomdp.terminal).tolist()[:3]:
                corner = np.zeros(pomdp.states)
                corner[block] = 1.0
                other = solve_pomdp(
                    replace(pomdp, initial=corner), "hsvi", demand=Demand(gap=1e-2, iterations=20)
                )
                worth = policy.value(corner)  # type: ignore[union-attr]
                assert worth <= other.upper + 1e-9
                assert worth + solved.corner_gap >= other.lower - 1e-9
                compared += 1
    assert compared > 30


def test_the_random_hierarchies_are_varied() -> None:
    planned = [found for seed in SEEDS if not isinstance(found := case(seed), str)]
    solved = [one for found in planned for one in found.plan.solved]
    assert len(planned) > 40
    assert sum(len(found.plan.solved) > 2 for found in planned) > 15
    assert sum(bool(one.reduction.pomdp_quotient.pomdp.terminal.any()) for one in solved) > 25
    assert sum(one.task.observes is not None for one in solved) > 5
    assert sum(len(set(one.corner.tolist())) > 1 for one in solved) > 40
    assert sum(one.ties > 0 for one in solved) > 3
    refused = [found for seed in SEEDS if isinstance(found := case(seed), str)]
    assert [text for text in refused if "nothing to optimise" not in text] == []


# -- PolCA and PolCA+ -----------------------------------------------------------------------------


def test_the_partition_of_polca_plus_refines_that_of_polca_given_the_same_children() -> None:
    finer = 0
    for seed in SEEDS:
        found = case(seed)
        if isinstance(found, str):
            continue
        children = {solved.task.name: solved for solved in found.plan.solved}
        for task in planning_order(found.plan.tasks):
            aware = subtask_process(
                found.plan.symbolic, task, children, None, planning_channels(found.model, task)
            )
            blind = replace(aware, channels=None)
            fine = values_at(found, minimise(aware).partition.diagram)
            coarse = values_at(found, minimise(blind).partition.diagram)
            assert len(set(zip(fine, coarse, strict=True))) == len(set(fine))
            finer += len(set(fine)) > len(set(coarse))
    assert finer > 5


def test_polca_on_a_pomdp_is_polca_on_the_model_whose_state_is_seen() -> None:
    for name in ("meds", "part_painting", "cheese_taxi"):
        domain = load(name, {})
        blind = replace_fields(
            domain.model,
            observability="full",
            observations=(),
            actions=tuple(replace_action(a, senses=()) for a in domain.model.actions),
        )
        seen = plan_mdp(domain.model, domain.tasks, Options(assume_observed=True))
        expected = plan_mdp(blind, domain.tasks)
        assert seen.polled.value == expected.polled.value
        assert seen.flat is not None
        assert expected.flat is not None
        assert seen.flat.value == expected.flat.value


def test_one_task_over_all_actions_is_the_flat_problem() -> None:
    tiger = load("tiger", {}).model
    found = plan_pomdp(tiger, options=Options(gap=1e-6, trials=None))
    assert [solved.task.name for solved in found.solved] == ["flat"]
    # The optimum: several solvers agree (SOLVERS' table; Kaelbling, Littman & Cassandra's tiger).
    assert found.root.lower <= 19.3713690
    assert found.root.upper >= 19.3713675
    assert found.root.upper - found.root.lower <= 1e-6
    assert found.flat.upper is not None
    assert found.flat.upper >= 19.3713675


def test_a_child_is_modelled_by_what_it_does_where_it_is_certain() -> None:
    """The example of the talk that meds is from: Move asks one who wants his medicine, else it goes."""
    domain = load("meds", {})
    found = plan_pomdp(domain.model, domain.tasks)
    move = found.task("Move")
    names = [found.symbolic.actions[int(a)].name for a in values_at(meds_case(found), move.policy)]
    assert names == ["ClarifyTask", "GoToKitchen", "GoToBedroom"]


def meds_case(found: PomdpPlan) -> Case:
    return Case(found.model, found, np.array([[0], [1], [2]], dtype=np.int32))


def test_each_task_may_have_a_solver_of_its_own() -> None:
    domain = load("meds", {})
    tasks = TaskHierarchy(
        [
            Task("Act", ["CheckMeds", "ClarifyTask", "Move"], solver="amdp"),
            Task("Move", ["ClarifyTask", "GoToKitchen", "GoToBedroom"], solver="exact"),
        ]
    )
    found = plan_pomdp(domain.model, tasks)
    assert "AMDP" in found.task("Act").solution.method
    assert found.task("Move").solution.upper - found.task("Move").solution.lower <= 0.1
    assert not isinstance(found.task("Act").belief_policy, AlphaVectors)
    heuristic = TaskHierarchy(
        [replace(tasks.tasks[0], solver=None), replace(tasks.tasks[1], solver="amdp")]
    )
    warned = plan_pomdp(domain.model, heuristic)
    assert any("Move" in warning and "certain" in warning for warning in warned.warnings)


def test_equal_demands_give_equal_plans() -> None:
    domain = load("meds", {})
    one, two = (plan_pomdp(domain.model, domain.tasks, Options(seed=3)) for _ in range(2))
    for a, b in zip(one.solved, two.solved, strict=True):
        assert (a.lower, a.upper, a.solution.vectors) == (b.lower, b.upper, b.solution.vectors)
        assert np.array_equal(a.corner, b.corner)


# -- observes -------------------------------------------------------------------------------------


def test_a_task_may_plan_with_fewer_observations_and_says_so() -> None:
    domain = load("tiger", {})
    names = [action.name for action in domain.model.actions]
    channel = domain.model.observations[0].name
    deaf = plan_pomdp(domain.model, TaskHierarchy([Task("deaf", names, observes=[])]), Options(gap=1e-6))
    hears = plan_pomdp(domain.model, TaskHierarchy([Task("hears", names, observes=[channel])]))
    quotient = deaf.root.reduction.pomdp_quotient
    assert quotient.observations_after == (1, 1, 1)
    # Without hearing it never pays to open: listen for ever, -1 / (1 - 0.95).
    assert deaf.root.lower == pytest.approx(-20, abs=1e-6)
    assert deaf.root.upper == pytest.approx(-20, abs=1e-5)
    assert any("lower bound" in warning for warning in deaf.warnings)
    assert "can earn more" in task_guarantee(deaf.root)
    assert hears.root.upper >= 19.37


# -- what DESIGN says of corner cases ---------------------------------------------------------------


def test_a_blind_model_is_planned_with_one_null_observation() -> None:
    light = boolean("light")
    model = Model(
        "blind",
        [light],
        [Action("wait", {light: "{true: 0.5, false: 0.5}"}), Action("bet", rewards="1 if light else -2")],
        observability="partial",
        observations=[],
        discount="0.5",
    )
    found = plan_pomdp(model, options=Options(gap=1e-9))
    assert found.root.reduction.pomdp_quotient.observations_after == (1, 1)
    # Half a chance of each: betting is worth -0.5 whenever it is done, waiting nothing.
    assert found.root.lower == pytest.approx(0, abs=1e-9)
    assert found.root.upper == pytest.approx(0, abs=1e-9)


def test_a_model_whose_sensors_all_tell_nothing_is_as_good_as_blind() -> None:
    side = Feature("side", ["left", "right"])
    sound = Observation("sound", ["low", "high", "none"])
    model = Model(
        "noise",
        [side],
        [
            Action("listen", senses={sound: "{low: 0.3, high: 0.7}"}, rewards=-1),
            Action("open", rewards="10 if side == left else -100"),
        ],
        observability="partial",
        observations=[sound],
    )
    found = plan_pomdp(model, options=Options(gap=1e-6))
    quotient = found.root.reduction.pomdp_quotient
    assert quotient.observations_before == (3, 1)
    assert quotient.observations_after == (1, 1)
    assert found.root.upper == pytest.approx(-20, abs=1e-4)


def test_a_child_that_has_ended_somewhere_stays_available_to_its_parent() -> None:
    domain = load("cheese_taxi", {})
    found = plan_pomdp(domain.model, domain.tasks)
    for solved in found.solved:
        pomdp = solved.reduction.pomdp_quotient.pomdp
        assert (solved.reduction.pomdp_quotient.primitive[:, ~pomdp.terminal] >= 0).all()
        assert (solved.corner[pomdp.terminal] == 0).all()  # tie-broken: the first action
        assert solved.defined.is_constant


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"discount": 1}, "discount below 1"),
        ({"horizon": 5}, "finite horizon"),
        ({"observability": "full", "observations": ()}, "fully observed"),
    ],
)
def test_what_has_no_meaning_is_refused(changes: dict[str, object], message: str) -> None:
    tiger = load("tiger", {}).model
    if "observations" in changes:
        changes = {**changes, "actions": tuple(replace_action(a, senses=()) for a in tiger.actions)}
    with pytest.raises(ModelError, match=message):
        refuse_unplannable(replace_fields(tiger, **changes))


def test_wrong_tasks_are_refused() -> None:
    tiger = load("tiger", {}).model
    names = [action.name for action in tiger.actions]
    with pytest.raises(ModelError, match=r"no solver 'vi'.*sarsop"):
        plan(tiger, TaskHierarchy([Task("root", names, solver="vi")]))
    with pytest.raises(ModelError, match="nothing to optimise"):
        plan(tiger, TaskHierarchy([Task("root", ["child", *names]), Task("child", names[:1])]))
    with pytest.raises(ModelError, match="no observation"):
        plan(tiger, TaskHierarchy([Task("root", names, observes=["smell"])]))


def test_too_many_observations_name_the_task_and_the_channels_to_blame() -> None:
    hidden = boolean("hidden")
    channels = [Observation(f"bit{i}", [0, 1], null=0) for i in range(16)]
    look = {
        c: f"{{1: 0.{i + 51}, 0: 0.{49 - i}}} if hidden' else {{1: 0.2, 0: 0.8}}"
        for i, c in enumerate(channels)
    }
    model = Model(
        "bits",
        [hidden],
        [Action("look", senses=look), Action("bet", rewards="1 if hidden else -1")],
        observability="partial",
        observations=channels,
    )
    with pytest.raises(LimitReached, match=r"task 'flat'.*bit0"):
        plan_pomdp(model)


# -- scale ----------------------------------------------------------------------------------------


def test_ten_to_the_twelve_states_are_planned_with_the_blocks_of_576() -> None:
    small, big = load("nursebot", {}), load("nursebot", {"rooms": "18", "bystanders": "3"})
    assert big.model.states >= 10**12
    options = Options(trials=5, flat_block_limit=None)
    plans = [plan_pomdp(domain.model, domain.tasks, options) for domain in (small, big)]
    blocks = [[solved.reduction.partition.blocks for solved in one.solved] for one in plans]
    assert blocks[0][:4] == blocks[1][:4]  # the leaves; others may hang on which of equal actions is taken
    assert [sum(row) for row in blocks][1] <= 1.1 * sum(blocks[0])
    assert plans[1].root.upper >= plans[1].root.lower
    remind = [pomdp_parameters(one.task("Remind").reduction.pomdp_quotient.pomdp) for one in plans]
    assert remind[0] == remind[1]
