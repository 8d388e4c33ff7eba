"""What the tasks of a plan earn, measured, beside what they were planned to.

A parent models a child by what the child does where it is certain of the state, where nothing needs to be
asked.  So a task's bounds, which hold in its own model, may miss what polling it earns, as a rule by too
much.  Here each task that has children is polled from its own top, on the original model, with the belief
tracked, under its own reward, until it has ended.  A task without children is not misjudged: its bounds
hold as they are, so only the root is measured in any case.

Where beliefs are not tracked over blocks, episode is tracked by episode, which takes long, and only the
root is measured.  Where time is up, what is not finished is left out.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass

from factored_polca.control.belief_controller import BeliefController, plan_tracker
from factored_polca.control.belief_policies import PolledPolicy
from factored_polca.control.block_tracker import BlockTracker
from factored_polca.control.tracker import ChosenTracker
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan
from factored_polca.models import LimitReached
from factored_polca.simulation import belief_episodes, belief_runs
from factored_polca.simulation.belief_episodes import run_one_by_one
from factored_polca.simulation.belief_runs import BeliefRuns, Stage, run_on_blocks


@dataclass(frozen=True)
class Measurement:
    """The runs of each measured task by name, and the tracker that they used; tasks that time ended are not
    among them."""

    runs: Mapping[str, BeliefRuns]
    tracker: ChosenTracker


def measure(
    plan: ExecutablePomdpPlan,
    *,
    episodes: int | None = None,
    child_episodes: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    chosen: ChosenTracker | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    deadline: float | None = None,
) -> Measurement:
    """Run the root of a plan for `episodes`, other tasks with children for `child_episodes` each.

    Without a number the root is run for `belief_runs.EPISODES`, or where beliefs are tracked one by one for
    `belief_episodes.EPISODES`.
    `progress` is called with the task, the first of the episodes that run, and the step.  At `deadline`, a
    reading of `time.monotonic()`, the run of a task is given up.
    """

    def watch(task: str) -> Callable[[int, int], None]:
        def step(first: int, number: int) -> None:
            if deadline is not None and time.monotonic() > deadline:
                raise LimitReached("the time limit was reached", "measure")
            if progress is not None:
                progress(task, first, number)

        return step

    if chosen is None:
        chosen = plan_tracker(plan, seed=seed, on_impossible="reset", deadline=deadline)
    tracker = chosen.tracker
    if not isinstance(tracker, BlockTracker):
        controller = BeliefController(plan)
        with suppress(LimitReached):
            run = run_one_by_one(
                tracker,
                lambda belief: controller.poll(belief).number,
                episodes=belief_episodes.EPISODES if episodes is None else episodes,
                steps=steps,
                seed=seed,
                progress=watch(plan.root),
            )
            return Measurement({plan.root: run}, chosen)
        return Measurement({}, chosen)
    runs, root_episodes = dict[str, BeliefRuns](), belief_runs.EPISODES if episodes is None else episodes
    for name, task in reversed(list(plan.policies.items())):  # the root first
        if name != plan.root and not any(action in plan.policies for action in task.actions):
            continue
        stage = None if name == plan.root else Stage(task.ended, plan.rewards(name))
        count = root_episodes if name == plan.root or child_episodes is None else child_episodes
        with suppress(LimitReached):
            runs[name] = run_on_blocks(
                tracker, PolledPolicy(plan, tracker, name), episodes=count, steps=steps, seed=seed,
                stage=stage, progress=watch(name),
            )  # fmt: skip
    return Measurement(dict(reversed(list(runs.items()))), chosen)
