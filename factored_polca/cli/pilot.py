"""A plan of a partially observed model as what the commands `act` and `run` ask: an action at a belief.

Plans of PolCA+ are polled at the belief.  Those that were made as if the state were seen (`plan --polca`)
are polled at its likeliest state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeAlias

from factored_polca.cli.output import escape
from factored_polca.control.belief_controller import (
    BeliefController,
    block_state,
    plan_tracker,
    tracked_features,
)
from factored_polca.control.controller import Poll
from factored_polca.control.likeliest import LikeliestController, likeliest_tracker
from factored_polca.control.received import shown
from factored_polca.control.tracker import Belief, ChosenTracker, OnImpossible, Rows, independent_belief
from factored_polca.diagrams import support
from factored_polca.hierarchy.executable import ExecutablePlan
from factored_polca.hierarchy.plan_file import load_plan
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan
from factored_polca.hierarchy.pomdp_plan_file import is_pomdp_plan_file, load_pomdp_plan
from factored_polca.models import Value
from factored_polca.symbolic import SymbolicModel

AnyPlan: TypeAlias = ExecutablePomdpPlan | ExecutablePlan

LIKELIEST = "planned as if the state were seen: its policy is asked at the likeliest state"


@dataclass(frozen=True)
class Said:
    """What a plan does at a belief: the action (None: none), its number, and the path as plain data."""

    action: str | None
    number: int
    path: list[dict[str, Any]]
    state: Mapping[str, Value] | None = None


def open_plan(path: str) -> AnyPlan:
    """The plan in a file, of either kind.

    Raises:
        ModelError: no such file, no plan, or damaged.
    """
    return load_pomdp_plan(path) if is_pomdp_plan_file(path) else load_plan(path)


def decider(plan: AnyPlan) -> Callable[[Belief], Said]:
    """What a plan does at a belief."""
    if isinstance(plan, ExecutablePomdpPlan):
        polled = BeliefController(plan)

        def poll(belief: Belief) -> Said:
            decision = polled.poll(belief)
            path = [
                {
                    "task": poll.task,
                    "block": poll.block,
                    "block_states": poll.block_states,
                    "state": block_state(plan.policies[poll.task].partition, poll.block),
                    "probability": poll.probability,
                    "action": poll.action,
                    "ended": poll.ended,
                    "looked_ahead": poll.looked_ahead,
                }
                for poll in decision.path
            ]
            return Said(decision.action, decision.number, path)

        return poll
    asked = LikeliestController(plan)

    def ask(belief: Belief) -> Said:
        found = asked.poll(belief)
        return Said(found.action, found.number, [poll_data(poll) for poll in found.path], found.state)

    return ask


def poll_data(poll: Poll) -> dict[str, Any]:
    """One question to a policy of states."""
    return {
        "task": poll.task,
        "block": poll.block,
        "block_states": poll.block_states,
        "action": poll.action,
        "terminal": poll.terminal,
    }


def tracker_of(plan: AnyPlan, on_impossible: OnImpossible, seed: int = 0) -> ChosenTracker:
    """The tracker that fits a plan."""
    if isinstance(plan, ExecutablePomdpPlan):
        return plan_tracker(plan, on_impossible=on_impossible, seed=seed)
    return likeliest_tracker(plan, on_impossible=on_impossible, seed=seed)


def features_of(plan: AnyPlan) -> list[str]:
    """The features whose probabilities are of use: those that the plan tells apart, or that are seen."""
    if isinstance(plan, ExecutablePomdpPlan):
        return tracked_features(plan)
    tested = support(plan.policy)
    return [
        feature.name
        for number, feature in enumerate(plan.model.features)
        if feature.observed or plan.symbolic.now(number) in tested
    ]


# -- beliefs to start from -------------------------------------------------------------------------


def rows_of(plan: AnyPlan, given: Mapping[str, Mapping[Value, Fraction]] | None) -> Rows:
    """The belief to start from: b0, some of its features as given."""
    rows = dict(plan.symbolic.initial) if given is None else independent_belief(plan.symbolic, given)
    return rows


def seen_at_start(symbolic: SymbolicModel, rows: Rows) -> tuple[dict[str, Value], list[str]]:
    """The values of the observed features that are certain, and the names of the others."""
    seen, open_ones = dict[str, Value](), list[str]()
    for number, feature in enumerate(symbolic.model.features):
        if feature.observed:
            sure = {row.index(1) if 1 in row else -1 for row in rows[number].rows}
            value = sure.pop() if len(sure) == 1 else -1
            if value >= 0:
                seen[feature.name] = feature.values[value]
            else:
                open_ones.append(feature.name)
    return seen, open_ones


# -- text ------------------------------------------------------------------------------------------


def assigned(values: Mapping[str, Value], separator: str = ", ") -> str:
    """`x=3, y=true`, escaped."""
    return escape(separator.join(f"{name}={shown(value)}" for name, value in values.items()))


def chance(probability: float) -> str:
    """A probability for people; what is not quite sure is not said to be 1."""
    if probability >= 0.9995:
        return "1" if probability > 1 - 1e-12 else ">0.999"
    return f"{probability:.3g}"
