"""The figures of the paper from our own runs, against brute force over states and beliefs."""

from __future__ import annotations

import math
from collections.abc import Callable
from fractions import Fraction
from functools import cache
from typing import Any

import numpy as np
import pytest
from test_hierarchical_pomdp_domains import TABLE_1 as DIALOGUE

from factored_polca import library
from factored_polca.control.belief_controller import BeliefController, plan_tracker
from factored_polca.diagrams import Diagram, evaluate_states
from factored_polca.explicit.exact_pomdp import ExactPOMDP, enumerate_pomdp
from factored_polca.hierarchy import Options, plan_mdp, plan_pomdp
from factored_polca.hierarchy.pomdp_executable import executable_pomdp
from factored_polca.minimisation.unreduced import unreduced
from factored_polca.models import ModelError, flat_task
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.studies.contenders import make_contest
from factored_polca.studies.dialogue import TABLE_1, DialogueStudy, Turn, study_dialogue
from factored_polca.studies.parameters import study_parameters
from factored_polca.studies.perturbations import study_perturbations
from factored_polca.studies.rewards import RewardStudy, paired_difference, run_contest, study_rewards
from factored_polca.symbolic import SymbolicModel, compile_model

Row = dict[tuple[int, int], Fraction]  # (next state, observation) -> probability


# --------------------------------------------------------------------------------------------
# Figure 4a
# --------------------------------------------------------------------------------------------


def taken(pomdp: ExactPOMDP, symbolic: SymbolicModel, policy: Diagram | None, name: str) -> list[int]:
    """The primitive action [state] that the choice `name` of a task stands for."""
    if policy is None:
        return [pomdp.actions.index(name)] * pomdp.states
    features = symbolic.model.features
    digits = [[f.values.index(v) for f, v in zip(features, s, strict=True)] for s in pomdp.state_values]
    found = evaluate_states(policy, np.array(digits, dtype=np.int32), symbolic.columns())
    return [pomdp.actions.index(symbolic.model.actions[a].name) for a in found.tolist()]


def merged_states(rows: list[list[Row]], rewards: list[list[Fraction]], states: int) -> list[int]:
    """The coarsest partition of Eq. 13: block [state], by refining until nothing changes."""
    block = [0] * states
    while True:
        signatures = []
        for s in range(states):
            sums = []
            for choice in rows:
                to: Row = {}
                for (t, o), q in choice[s].items():
                    to[block[t], o] = to.get((block[t], o), Fraction(0)) + q
                sums.append(frozenset(to.items()))
            signatures.append((block[s], tuple(sums), tuple(reward[s] for reward in rewards)))
        numbers = {signature: n for n, signature in enumerate(dict.fromkeys(signatures))}
        refined = [numbers[signature] for signature in signatures]
        if refined == block:
            return block
        block = refined


def entries(rows: list[list[Row]], rewards: list[list[Fraction]], block: list[int]) -> int:
    """Non-zero entries over blocks, where observations whose columns are proportional are one."""
    first = {b: s for s, b in reversed(list(enumerate(block)))}
    total = sum(reward[s] != 0 for reward in rewards for s in first.values())
    for choice in rows:
        columns: dict[int, dict[tuple[int, int], Fraction]] = {}
        for b, s in first.items():
            for (t, o), q in choice[s].items():
                column = columns.setdefault(o, {})
                column[b, block[t]] = column.get((b, block[t]), Fraction(0)) + q
        directions = {
            frozenset((key, q / sum(column.values())) for key, q in column.items() if q)
            for column in columns.values()
        }
        total += sum(len(direction) for direction in directions)
    return total


@pytest.mark.parametrize("name", ["meds", "tiger", "part_painting", "twenty_questions"])
def test_the_parameters_of_figure_4a_are_those_counted_state_by_state(name: str) -> None:
    domain = library.load(name)
    model, tasks = domain.model, domain.tasks or flat_task(domain.model)
    study = study_parameters(model, tasks)
    pomdp = enumerate_pomdp(model)
    plus = plan_pomdp(model, tasks, Options(flat_block_limit=None))
    seen = plan_mdp(model, tasks, Options(flat_block_limit=None, assume_observed=True))
    for counted in study.tasks:
        found = {}
        for reading, plan in (("plus", plus), ("polca", seen)):
            below = {solved.task.name: solved.policy for solved in plan.solved}
            rows, rewards = [], []
            for choice in tasks.task(counted.name).actions:
                primitive = taken(pomdp, plan.symbolic, below.get(choice), choice)
                kernel: list[Row] = [dict(pomdp.kernel[a][s]) for s, a in enumerate(primitive)]
                if reading == "polca":
                    kernel = [blind(row) for row in kernel]
                rows.append(kernel)
                rewards.append([pomdp.rewards[a][s] for s, a in enumerate(primitive)])
            if reading == "plus":
                found["none"] = sum(len(row) for kernel in rows for row in kernel) + sum(
                    reward != 0 for row in rewards for reward in row
                )
            found[reading] = entries(rows, rewards, merged_states(rows, rewards, pomdp.states))
        assert (counted.none, counted.polca, counted.polca_plus) == (
            found["none"], found["polca"], found["plus"],
        ), counted.name  # fmt: skip
    assert study.total("polca_plus") == sum(task.polca_plus for task in study.tasks)
    assert study.to_data()["totals"]["none"] == sum(task.none or 0 for task in study.tasks)


def blind(row: Row) -> Row:
    """A row without observations."""
    result: Row = {}
    for (t, _), q in row.items():
        result[t, 0] = result.get((t, 0), Fraction(0)) + q
    return result


def test_a_model_too_large_to_list_has_no_count_without_abstraction() -> None:
    domain = library.load("nursebot", {"rooms": "7"})  # 576 * 2^7 states
    study = study_parameters(domain.model, domain.tasks, Options(trials=1))
    plain = library.load("nursebot")
    small = study_parameters(plain.model, plain.tasks, Options(trials=1))
    assert study.total("none") is None
    assert small.total("none") is not None
    for reading in ("polca", "polca_plus"):  # no task needs to know of the rooms
        assert study.total(reading) == small.total(reading)
    assert any("too many states" in note for note in study.notes)


# --------------------------------------------------------------------------------------------
# Figure 4b
# --------------------------------------------------------------------------------------------

STEPS = 40


def exact_mean(
    pomdp: ExactPOMDP, choose: Callable[[np.ndarray], int], steps: int, discount: float
) -> float:
    """What a policy over beliefs on the states earns: the whole tree, equal beliefs once."""
    kernels = []
    for rows in pomdp.kernel:
        matrices = np.zeros((len(pomdp.observations), pomdp.states, pomdp.states))
        for s, row in enumerate(rows):
            for (t, o), q in row.items():
                matrices[o, s, t] = float(q)
        kernels.append(matrices)
    rewards = np.array([[float(r) for r in row] for row in pomdp.rewards])
    known: dict[tuple[int, tuple[float, ...]], float] = {}

    def value(belief: np.ndarray, left: int) -> float:
        key = (left, tuple(np.round(belief, 10)))
        if left and key not in known:
            action = choose(belief)
            known[key] = float(rewards[action] @ belief)
            for matrix in kernels[action]:
                after = belief @ matrix
                chance = after.sum()
                if chance > 1e-14:
                    known[key] += discount * chance * value(after / chance, left - 1)
        return known[key] if left else 0.0

    return value(np.array([float(q) for q in pomdp.initial]), steps)


def test_what_the_policies_earn_on_meds_is_what_their_belief_trees_say() -> None:
    domain = library.load("meds")
    model = domain.model
    study = study_rewards(model, domain.tasks, episodes=2000, steps=STEPS)
    pomdp, symbolic = enumerate_pomdp(model), compile_model(model)
    plan = executable_pomdp(plan_pomdp(model, domain.tasks, Options(flat_block_limit=None)))
    names = [action.name for action in model.actions]
    assert list(pomdp.actions) == names
    states = np.arange(3, dtype=np.int32)[:, None]

    def polled(belief: np.ndarray) -> int:
        name = plan.root
        while name in plan.policies:
            task = plan.policies[name]
            block = evaluate_states(task.partition.diagram, states, plan.symbolic.columns())
            over = np.bincount(block.astype(np.int64), belief, minlength=task.partition.blocks)
            name = task.actions[task.policy.choose(over[None, :])[0]]
        return names.index(name)

    def flat(method: str) -> Callable[[np.ndarray], int]:
        arrays = unreduced(symbolic)
        assert arrays.states.tolist() == states.tolist()
        policy: Any = solve_pomdp(arrays.pomdp, method).policy
        return lambda belief: int(policy.choose(belief[None, :])[0])

    def likeliest(belief: np.ndarray) -> int:
        wish = pomdp.state_values[int(np.argmax(belief >= belief.max() - 1e-9))][0]
        return names.index({"meds": "CheckMeds", "kitchen": "GoToKitchen", "bedroom": "GoToBedroom"}[wish])

    policies = {"PolCA+": polled, "PolCA": likeliest, "QMDP": flat("qmdp"), "SARSOP": flat("sarsop")}
    for name, choose in policies.items():
        one = study.of(name)
        assert abs(one.mean - exact_mean(pomdp, choose, STEPS, 0.95)) < 4 * one.standard_error, name
        end = exact_mean(pomdp, choose, STEPS, 1.0)
        assert abs(one.cumulative[-1] - end) < 4 * one.cumulative_error[-1], name
        assert one.per_episode.sum() == pytest.approx(STEPS)
    # Nothing is learnt by serving, so the likeliest wish is the first one for ever.
    assert study.of("PolCA").per_episode[names.index("CheckMeds")] == STEPS
    for d in study.differences:
        apart = study.of(d.first).returns - study.of(d.second).returns
        assert d.mean == pytest.approx(study.of(d.first).mean - study.of(d.second).mean)
        assert d.standard_error == pytest.approx(apart.std(ddof=1) / math.sqrt(2000))
    sarsop = study.of("SARSOP")
    assert sarsop.lower is not None
    assert sarsop.upper is not None
    assert sarsop.lower <= sarsop.upper < 189  # QMDP's bound, 200 gamma - 1 + ...: all is seen but now


def test_equal_seeds_give_equal_studies() -> None:
    domain = library.load("meds")

    def data(seed: int) -> dict[str, Any]:
        study = study_rewards(
            domain.model, domain.tasks, Options(seed=seed), episodes=20, steps=20, flat_trials=5
        )
        for one in (found := study.to_data())["policies"]:
            del one["planning_seconds"]
        return found

    assert data(1) == data(1)
    assert data(1) != data(2)


def test_one_episode_has_no_standard_error() -> None:
    one = paired_difference("a", "b", np.array([3.0]), np.array([1.0]))
    assert one.mean == 2
    assert math.isnan(one.standard_error)
    assert not one.clear


@cache
def ward() -> RewardStudy:
    domain = library.load("nursebot")
    contest = make_contest(domain.model, domain.tasks, flat_trials=100)
    return run_contest(contest, episodes=300, steps=60)


def test_the_nursing_robot_earns_most_with_polca_plus_then_polca_then_qmdp() -> None:
    study = ward()
    assert study.order_holds
    assert study.order_is_clear
    assert study.cumulative_order_holds
    # The differences are some 7, 7 and 8 standard errors.
    assert [(d.first, d.second) for d in study.differences] == [
        ("PolCA+", "PolCA"), ("PolCA", "QMDP"), ("SARSOP", "PolCA+"),
    ]  # fmt: skip
    for d in study.differences:
        assert d.mean > 3 * d.standard_error
    sarsop = study.of("SARSOP")
    assert sarsop.upper is not None
    for one in study.earned:
        assert one.mean - 4 * one.standard_error < sarsop.upper


def test_the_action_counts_show_the_reasons_that_the_paper_gives() -> None:
    study = ward()

    def often(policy: str, *actions: str) -> float:
        counts = dict(zip(study.actions, study.of(policy).per_episode, strict=True))
        return sum(counts[action] for action in actions)

    # CheckUserPresent is left out: while the robot waits for the person it costs no more than DoNothing.
    asking = [a for a in study.actions if a.startswith(("Confirm", "Verify")) or a == "CheckBattery"]
    assert len(asking) == 6
    assert often("QMDP", "DoNothing") > 0.75 * study.steps
    assert often("PolCA", *asking) == 0
    assert often("QMDP", *asking) == 0
    assert often("PolCA+", *asking) > 0.05 * study.steps
    assert often("PolCA+", "TellTime", "TellWeather") > often("PolCA", "TellTime", "TellWeather")
    # PolCA sets off without being sure that it is wanted.
    assert often("PolCA", "GuideToPhysio") > 1.5 * often("PolCA+", "GuideToPhysio")


# --------------------------------------------------------------------------------------------
# Figure 4b on perturbed numbers
# --------------------------------------------------------------------------------------------


def test_perturbed_runs_are_those_of_the_perturbed_models() -> None:
    options = Options(trials=3)
    study = study_perturbations("nursebot", {"topics": "2"}, options, count=2, episodes=20, steps=15)
    assert [run.seed for run in study.runs] == [1, 2]
    assert study.steps == 15
    domain = library.load("nursebot", {"perturbation": "0.2", "seed": "2"})
    alone = study_rewards(domain.model, domain.tasks, options, episodes=20, steps=15, flat_trials=None)
    assert study.runs[1].means == tuple(alone.of(name).mean for name in ("PolCA+", "PolCA", "QMDP"))
    assert study.runs[1].differences == alone.differences
    assert study.held == sum(run.means[0] > run.means[1] > run.means[2] for run in study.runs)
    assert study.clear <= study.held
    data = study.to_data()
    assert data["perturbation"] == 0.2
    assert [run["order_holds"] for run in data["runs"]] == [run.order_holds for run in study.runs]


@pytest.mark.parametrize(
    ("name", "parameters", "said"),
    [
        ("meds", {}, "nursebot has"),
        ("nursebot", {"seed": "3"}, "'seed' is set for each run"),
        ("nosuch", {}, "nosuch"),
    ],
)
def test_only_domains_with_numbers_to_draw_are_perturbed(
    name: str, parameters: dict[str, str], said: str
) -> None:
    with pytest.raises(ModelError, match=said):
        study_perturbations(name, parameters, count=1)


# --------------------------------------------------------------------------------------------
# Table 1
# --------------------------------------------------------------------------------------------


@cache
def dialogue() -> DialogueStudy:
    domain = library.load("nursebot")
    return study_dialogue(domain.model, domain.tasks, flat_trials=30)


def test_the_rows_of_table_1_are_those_that_the_domain_is_tested_with() -> None:
    ours = [
        ("" if t.observed is None else "=".join(map(str, t.observed)), t.action, t.reward) for t in TABLE_1
    ]
    assert ours == [(seen, action, reward) for seen, action, reward, _ in DIALOGUE]


def test_the_controller_is_asked_at_the_beliefs_of_the_papers_dialogue() -> None:
    study, model = dialogue(), library.load("nursebot").model
    symbolic = compile_model(model)
    arrays = unreduced(symbolic)
    pomdp, belief = arrays.pomdp, arrays.pomdp.initial
    for number, reply in enumerate(study.replies):
        if number:
            before = pomdp.actions.index(TABLE_1[number - 1].action)
            channel, value = reply.turn.observed or ("", "")
            labels = [label.split(", ") for label in pomdp.observations[before]]
            (o,) = (k for k, label in enumerate(labels) if f"{channel}={value}" in label)
            after = belief @ pomdp.kernel[before][o]
            assert reply.likelihood == pytest.approx(after.sum(), abs=1e-12)
            belief = after / after.sum()
        assert reply.impossible == ""
        assert set(reply.beliefs) == {feature.name for feature in model.features}
        for f, feature in enumerate(model.features):
            chances = np.bincount(arrays.states[:, f], belief, minlength=len(feature.values))
            value, chance = reply.beliefs[feature.name]
            assert chance == pytest.approx(chances.max(), abs=1e-12)
            assert chances[feature.values.index(value)] == pytest.approx(chances.max(), abs=1e-12)
        rewards = pomdp.rewards @ belief
        assert reply.expected == pytest.approx(rewards[pomdp.actions.index(reply.action)], abs=1e-9)
        assert reply.expected_theirs == pytest.approx(
            rewards[pomdp.actions.index(reply.turn.action)], abs=1e-9
        )


def test_the_equal_actions_are_counted_as_a_walk_of_its_own_counts_them() -> None:
    study, domain = dialogue(), library.load("nursebot")
    plan = executable_pomdp(plan_pomdp(domain.model, domain.tasks, Options(flat_block_limit=None)))
    controller, belief = BeliefController(plan), plan_tracker(plan).tracker.start()
    names = [action.name for action in domain.model.actions]
    answers = []
    for number, (_, action, _, _) in enumerate(DIALOGUE):
        answers.append(controller.poll(belief).action)
        if number + 1 < len(DIALOGUE):
            channel, _, value = DIALOGUE[number + 1][0].partition("=")
            belief = belief.after(names.index(action), {channel: value})
    assert [reply.action for reply in study.replies] == answers
    k = sum(answer == action for answer, (_, action, _, _) in zip(answers, DIALOGUE, strict=True))
    assert study.equal == k
    data = study.to_data()
    assert (data["equal"], data["of"]) == (k, 20)
    assert data["goals"] == 4
    for row in data["rows"]:
        assert row["equal"] == (row["action"] == row["paper_action"])
        if row["equal"]:
            assert (row["q_gap"], row["parted_in"], row["task_q_gap"]) == (0, None, 0)
        else:
            assert row["parted_in"] in row["path"]


def test_the_goals_of_the_dialogue_are_reached_by_the_controller_too() -> None:
    assert [reply.turn.action for reply in dialogue().goals] == [
        "RemindPhysioAppt", "GuideToPhysio", "TerminateGuidance", "TellWeather",
    ]  # fmt: skip
    assert all(reply.equal for reply in dialogue().goals)


def test_an_impossible_observation_is_said_and_skipped() -> None:
    domain = library.load("meds")
    turns = (
        Turn("", None, "ClarifyTask", -1),
        Turn("he says kitchen", ("word", "kitchen"), "GoToKitchen", 10),
        Turn(
            "he says medicine", ("word", "meds"), "ClarifyTask", -1
        ),  # after a service there is only noise
        Turn("he says kitchen", ("word", "kitchen"), "GoToKitchen", 10),
    )
    study = study_dialogue(domain.model, domain.tasks, turns, flat_trials=5)
    assert [bool(reply.impossible) for reply in study.replies] == [False, False, True, False]
    assert "impossible" in study.replies[2].impossible
    assert study.replies[2].likelihood is None
    # The next wish is any of the three; one word makes it kitchen with 0.8 / (0.8 + 2 * 0.05).
    assert study.replies[2].beliefs["wish"][1] == pytest.approx(1 / 3)
    assert study.replies[3].beliefs["wish"] == ("kitchen", pytest.approx(8 / 9))


def test_a_dialogue_with_another_model_is_refused() -> None:
    domain = library.load("meds")
    with pytest.raises(ModelError, match="no action 'DoNothing'"):
        study_dialogue(domain.model, domain.tasks)
    turns = (Turn("", None, "ClarifyTask", -1), Turn("", ("word", "tea"), "ClarifyTask", -1))
    with pytest.raises(ModelError, match="no observation word=tea"):
        study_dialogue(domain.model, domain.tasks, turns)
