"""What the tasks of a plan earn, measured, beside what they were planned to.

A parent models a child by what the child does where it is certain of the state, where nothing needs to be
asked.  So a task's bounds, which hold in its own model, may miss what polling it earns, as a rule by too
much.  Here each task that has children is polled from its own top, on the original model, with the belief
tracked, under its own reward, until it has ended.  A task without children is not misjudged: its bounds
hold as they are, so only the root is measured in any case.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from factored_polca.control.belief_controller import plan_tracker
from factored_polca.control.belief_policies import PolledPolicy
from factored_polca.control.block_tracker import BlockTracker
from factored_polca.control.tracker import ChosenTracker
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan
from factored_polca.models import LimitReached
from factored_polca.simulation.belief_runs import BeliefRuns, Stage, run_on_blocks


@dataclass(frozen=True)
class Measurement:
    """The runs of each measured task by name, and the tracker that they used."""

    runs: Mapping[str, BeliefRuns]
    tracker: ChosenTracker


def measure(
    plan: ExecutablePomdpPlan,
    *,
    episodes: int = 1000,
    child_episodes: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    chosen: ChosenTracker | None = None,
) -> Measurement:
    """Run the root of a plan for `episodes`, other tasks with children for `child_episodes` each.

    Raises:
        LimitReached: no tracker over blocks fits the plan; its reason is in the message.
    """
    chosen = plan_tracker(plan, seed=seed) if chosen is None else chosen
    tracker = chosen.tracker
    if not isinstance(tracker, BlockTracker):
        raise LimitReached(f"tasks are measured on blocks only: {chosen.reason}", "tracker")
    runs = {}
    for name, task in plan.policies.items():
        if name != plan.root and not any(action in plan.policies for action in task.actions):
            continue
        stage = None if name == plan.root else Stage(task.ended, plan.process(name).rewards)
        count = episodes if name == plan.root or child_episodes is None else child_episodes
        runs[name] = run_on_blocks(
            tracker, PolledPolicy(plan, tracker, name), episodes=count, steps=steps, seed=seed, stage=stage
        )
    return Measurement(runs, chosen)
