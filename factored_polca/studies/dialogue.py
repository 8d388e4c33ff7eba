"""Table 1: what the controller does where the paper's robot was, after each of its twenty observations.

The belief follows the paper's dialogue, not ours.  From b_1 = b0, which "(null)" stands for,

    b_{i+1}(x') ~ sum over x of b_i(x) T(x, a_i, x') P(o_{i+1} | x', x, a_i)

with the paper's action a_i and observation o_{i+1}.  If that has the probability 0, the observation is
skipped, which is said: the belief is predicted only.  At each b_i the polling controller is asked, and its
answer a compared with a_i by looking one step ahead without a hierarchy:

    gap = Q(b_i, a) - Q(b_i, a_i),   Q(b, a) = R_a . b + gamma * sum over o of V(b K_a^o),

V being the lower bound that SARSOP proves on the flat quotient, asked for at all b_i.  A gap above 0 says
that with good play from then on the controller's answer earns more; one below 0 that the paper's action
does, and so that the hierarchy, or modelling children at corners, costs that here.  Beside it stands what
the answer is worth more in the model of the task where the paths to the two actions part, which is how the
controller sees it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Any, Final

import numpy as np

from factored_polca.control.belief_controller import BeliefController, BeliefDecision, tracked_features
from factored_polca.control.block_tracker import BlockBelief, make_block_tracker
from factored_polca.control.polling import look_ahead
from factored_polca.control.tracker import BLOCK_LIMIT, Belief, summed
from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.arrays import FloatArray
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.hierarchy import Options, plan_pomdp
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan, executable_pomdp
from factored_polca.models import Model, ModelError, TaskHierarchy, Value
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import POMDPSolution
from factored_polca.studies.contenders import FLAT_TRIALS, FlatModel, compiled, flat_demand, flat_model
from factored_polca.studies.parameters import Progress, silent


@dataclass(frozen=True)
class Turn:
    """A row of a dialogue: what was observed, in the source's words and as channel and value here (None:
    nothing, the start), what was done then, and what that earned."""

    words: str
    observed: tuple[str, Value] | None
    action: str
    reward: int


TABLE_1: Final = (
    Turn("(null)", None, "DoNothing", -1),
    Turn("Scheduler=physio-message", ("Scheduler", "physio"), "gotoPatientRoom", 5),
    Turn("Laser=RobotAtPatientRoom", ("Laser", "patient_room"), "RingBell", 5),
    Turn("Speech=yes", ("Speech", "yes"), "RemindPhysioAppt", 50),
    Turn("Speech=noise", ("Speech", "noise"), "ConfirmGuideToPhysio", -5),
    Turn("Speech=yes", ("Speech", "yes"), "CheckBattery", -5),
    Turn("Battery=high", ("Battery", "high"), "GuideToPhysio", 50),
    Turn("Laser=RobotAtPhysio", ("Laser", "physio"), "CheckUserPresent", -1),
    Turn("IR=no-user", ("IR", "no_user"), "CheckUserPresent", -1),
    Turn("IR=user", ("IR", "user"), "CheckUserPresent", -5),
    Turn("IR=user", ("IR", "user"), "TerminateGuidance", 50),
    Turn("Speech=noise", ("Speech", "noise"), "ConfirmDone", -1),
    Turn("Speech=no", ("Speech", "no"), "VerifyInfoRequest", -1),
    Turn("Speech=weather", ("Speech", "weather"), "ConfirmWantWeather", -1),
    Turn("Speech=noise", ("Speech", "noise"), "VerifyInfoRequest", -1),
    Turn("Speech=weather", ("Speech", "weather"), "ConfirmWantWeather", -1),
    Turn("Speech=yes", ("Speech", "yes"), "TellWeather", 50),
    Turn("Speech=noise", ("Speech", "noise"), "ConfirmDone", -1),
    Turn("Speech=yes", ("Speech", "yes"), "GoHome", 5),
    Turn("Laser=RobotAtHome", ("Laser", "home"), "RechargeBattery", 20),
)
"""Table 1 of the paper, in its words and in those of the domain nursebot."""

GOAL: Final = 50
"""The reward of the rows that the paper's robot was there for."""


@dataclass(frozen=True)
class Reply:
    """What the controller answers at one row.

    `path` lists the tasks polled.  `likelihood` is the probability that the belief before gave to the
    observation, None at the start; `impossible` says why it was skipped.  `beliefs` gives for each feature
    the likeliest value and its probability.  `expected` and `expected_theirs` are the mean rewards at the
    belief of the controller's answer and of the source's action.  `gap` is Q(answer) - Q(theirs), `parted`
    and `task_gap` the task where the paths part and the same in its model; `flat` what SARSOP would do.
    """

    turn: Turn
    action: str
    path: tuple[str, ...]
    likelihood: float | None
    impossible: str
    beliefs: Mapping[str, tuple[Value, float]]
    expected: float
    expected_theirs: float
    gap: float
    parted: str | None
    task_gap: float
    flat: str

    @property
    def equal(self) -> bool:
        """Whether the controller does what the source did."""
        return self.action == self.turn.action


@dataclass(frozen=True)
class DialogueStudy:
    """The replies to all rows; `bound_gap` is the largest upper - lower of SARSOP at their beliefs."""

    model: str
    replies: tuple[Reply, ...]
    bound_gap: float

    @property
    def equal(self) -> int:
        """In how many rows the actions are equal."""
        return sum(reply.equal for reply in self.replies)

    @property
    def equal_flat(self) -> int:
        """In how many the flat SARSOP does what the source did."""
        return sum(reply.flat == reply.turn.action for reply in self.replies)

    @property
    def goals(self) -> tuple[Reply, ...]:
        """The rows with the reward of a goal."""
        return tuple(reply for reply in self.replies if reply.turn.reward == GOAL)

    def to_data(self) -> dict[str, Any]:
        """The study as plain data."""
        return {
            "figure": "table1",
            "model": self.model,
            "rows": [
                {"row": number} | _reply_data(reply) for number, reply in enumerate(self.replies, start=1)
            ],
            "equal": self.equal,
            "of": len(self.replies),
            "equal_flat": self.equal_flat,
            "goals": len(self.goals),
            "goals_equal": sum(reply.equal for reply in self.goals),
            "bound_gap": self.bound_gap,
        }


def _reply_data(reply: Reply) -> dict[str, Any]:
    return {
        "observation": reply.turn.words,
        "paper_action": reply.turn.action,
        "paper_reward": reply.turn.reward,
        "action": reply.action,
        "equal": reply.equal,
        "path": list(reply.path),
        "likelihood": reply.likelihood,
        "impossible": reply.impossible or None,
        "belief": {
            name: {"value": value, "probability": chance} for name, (value, chance) in reply.beliefs.items()
        },
        "expected_reward": reply.expected,
        "expected_paper_reward": reply.expected_theirs,
        "q_gap": reply.gap,
        "parted_in": reply.parted,
        "task_q_gap": reply.task_gap,
        "flat_action": reply.flat,
    }


def study_dialogue(
    model: Model,
    tasks: TaskHierarchy | None,
    dialogue: Sequence[Turn] = TABLE_1,
    options: Options | None = None,
    *,
    flat_trials: int = FLAT_TRIALS,
    progress: Progress = silent,
) -> DialogueStudy:
    """Plan a model with PolCA+ and ask the controller along a dialogue.

    Raises:
        ModelError: the model or the hierarchy is not right, or lacks what the dialogue names.
        LimitReached: memory, blocks or observations.
    """
    refuse_foreign(model, dialogue)
    options = replace(options or Options(), flat_block_limit=None)
    symbolic = compiled(model, tasks, options)
    progress("planning PolCA+")
    plan = executable_pomdp(plan_pomdp(model, tasks, options, symbolic=symbolic))
    flat = flat_model(symbolic, options)
    tracker = make_block_tracker(
        symbolic,
        [*plan.partitions, flat.reduction.partition],
        conditions=plan.conditions,
        features=tracked_features(plan),
        block_limit=BLOCK_LIMIT,
        seed=options.seed,
    )
    believed = follow(tracker.start(), dialogue)
    partition = flat.reduction.partition
    over_blocks = np.stack([belief.project(partition) for belief, _ in believed])
    progress(f"planning SARSOP, {flat_trials:,} trials")
    solution = solve_pomdp(
        flat.reduction.pomdp_quotient.pomdp,
        "sarsop",
        demand=flat_demand(flat_trials, options.seed),
        roots=over_blocks,
    )
    if solution.status == "interrupted":
        raise KeyboardInterrupt
    controller = BeliefController(plan)
    replies = [
        _reply(plan, controller.poll(belief), turn, belief, impossible, here, flat, solution)
        for turn, (belief, impossible), here in zip(dialogue, believed, over_blocks, strict=True)
    ]
    gap = float((solution.root_upper - solution.root_lower).max())
    return DialogueStudy(model.name, tuple(replies), gap)


def refuse_foreign(model: Model, dialogue: Sequence[Turn]) -> None:
    """Refuse a model that lacks an action, a channel or a value of the dialogue.

    Raises:
        ModelError: naming it.
    """
    actions = {action.name for action in model.actions}
    channels = {channel.name: channel.values for channel in model.observations}
    for turn in dialogue:
        if turn.action not in actions:
            raise ModelError(f"{model.name} has no action {turn.action!r}, which the dialogue takes")
        if turn.observed is not None:
            name, value = turn.observed
            if value not in channels.get(name, ()):
                raise ModelError(f"{model.name} has no observation {name}={value}, which the dialogue has")


def follow(start: Belief, dialogue: Sequence[Turn]) -> list[tuple[Belief, str]]:
    """The belief before each turn's action, and why its observation was skipped ("" where it was not)."""
    numbers = {action.name: i for i, action in enumerate(start.tracker.symbolic.actions)}
    found, belief = [(start, "")], start
    for before, turn in pairwise(dialogue):
        action, impossible = numbers[before.action], ""
        try:
            belief = belief.after(action, _reading(belief, action, turn))
        except ImpossibleObservation as error:
            belief, impossible = predict(belief, action), str(error)
        found.append((belief, impossible))
    return found


def _reading(belief: Belief, action: int, turn: Turn) -> dict[str, Value]:
    """What all channels that the action senses report: of those that the turn is silent on, null."""
    channels = belief.tracker.symbolic.model.observations
    reading = {channels[j].name: channels[j].null for j in belief.tracker.reader.sensed[action]}
    return reading | dict([turn.observed] if turn.observed else [])


def predict(belief: Belief, action: int) -> BlockBelief:
    """The belief after an action, whatever it makes the channels report.

    Raises:
        TypeError: the belief is not one over blocks.
    """
    if not isinstance(belief, BlockBelief):
        raise TypeError("predictions are made over blocks only")
    tracker = belief.tracker
    channels = [tracker.symbolic.model.observations[j] for j in tracker.reader.sensed[action]]
    total = np.zeros(tracker.partition.blocks)
    for values in product(*(channel.values for channel in channels)):
        reading = {channel.name: value for channel, value in zip(channels, values, strict=True)}
        try:
            after = belief.after(action, reading)
        except ImpossibleObservation:
            continue
        assert isinstance(after, BlockBelief)
        total += after.likelihood * summed(after.blocks, after.weights, len(total))
    blocks = np.flatnonzero(total)
    weights = total[blocks] / total.sum()
    return BlockBelief(tracker=tracker, likelihood=0.0, ended=False, blocks=blocks, weights=weights)


def _reply(
    plan: ExecutablePomdpPlan,
    decision: BeliefDecision,
    turn: Turn,
    belief: Belief,
    impossible: str,
    here: FloatArray,
    flat: FlatModel,
    solution: POMDPSolution,
) -> Reply:
    pomdp = flat.reduction.pomdp_quotient.pomdp
    numbers = {name: i for i, name in enumerate(pomdp.actions)}
    ours, theirs = numbers[decision.action], numbers[turn.action]
    rewards, values = pomdp.rewards @ here, one_step(pomdp, solution, here)
    parted, task_gap = parting(plan, decision, turn.action, belief)
    return Reply(
        turn=turn,
        action=decision.action,
        path=tuple(poll.task for poll in decision.path),
        likelihood=None if turn.observed is None or impossible else belief.likelihood,
        impossible=impossible,
        beliefs=likeliest(belief),
        expected=float(rewards[ours]),
        expected_theirs=float(rewards[theirs]),
        gap=float(values[ours] - values[theirs]),
        parted=parted,
        task_gap=task_gap,
        flat=pomdp.actions[int(values.argmax())],
    )


def one_step(pomdp: ArrayPOMDP, solution: POMDPSolution, belief: FloatArray) -> FloatArray:
    """Q [action] at a belief [block], by one step and the solution's value function.

    Raises:
        TypeError: a solution without alpha-vectors.
    """
    vectors = solution.policy
    if not isinstance(vectors, AlphaVectors):
        raise TypeError(f"{type(vectors).__name__} is no value function over beliefs")
    result = pomdp.rewards @ belief
    for action, matrices in enumerate(pomdp.kernel):
        following = np.stack([belief @ matrix for matrix in matrices])
        result[action] += pomdp.discount * vectors.values(following).sum()
    return np.asarray(result, dtype=np.float64)


def likeliest(belief: Belief) -> dict[str, tuple[Value, float]]:
    """For each feature that is told apart the likeliest value, the first of equal ones, and its chance."""
    features = {feature.name: feature for feature in belief.tracker.symbolic.model.features}
    return {
        name: (features[name].values[int(chances.argmax())], float(chances.max()))
        for name, chances in belief.marginals().items()
    }


def parting(
    plan: ExecutablePomdpPlan, decision: BeliefDecision, action: str, belief: Belief
) -> tuple[str | None, float]:
    """The task at which the path to `action` leaves the decision's, and Q(answer) - Q(towards it) there."""
    for poll in decision.path:
        task = plan.policies[poll.task]
        towards = [n for n, name in enumerate(task.actions) if _leads(plan, name, action)]
        answer = task.actions.index(poll.action)
        if answer not in towards:
            values = look_ahead(plan, poll.task, belief.project(task.partition))
            return poll.task, float(values[answer] - values[towards].max()) if towards else float("nan")
    return None, 0.0


def _leads(plan: ExecutablePomdpPlan, name: str, action: str) -> bool:
    """Whether `name` is the action, or a task that may come to it."""
    if name not in plan.policies:
        return name == action
    return any(_leads(plan, below, action) for below in plan.policies[name].actions)
