"""What the tasks of a plan earn, measured, beside what they were planned to.

A parent models a child by what the child does where it is certain of the state, where nothing needs to be
asked.  So a task's bounds, which hold in its own model, may miss what polling it earns, as a rule by too
much.  Here each task that has children is polled from its own top, on the original model, with the belief
tracked, under its own reward, until it has ended.  A task without children is not misjudged: its bounds
hold as they are, so only the root is measured in any case.

Where beliefs are not tracked over blocks, episode is tracked by episode, which takes long, and only the
root is measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from factored_polca.control.belief_controller import BeliefController, plan_tracker
from factored_polca.control.belief_policies import PolledPolicy
from factored_polca.control.block_tracker import BlockTracker
from factored_polca.control.tracker import ChosenTracker
from factored_polca.hierarchy.pomdp_executable import ExecutablePomdpPlan
from factored_polca.simulation import belief_episodes, belief_runs
from factored_polca.simulation.belief_episodes import run_one_by_one
from factored_polca.simulation.belief_runs import BeliefRuns, Stage, run_on_blocks


@dataclass(frozen=True)
class Measurement:
    """The runs of each measured task by name, and the tracker that they used."""

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
) -> Measurement:
    """Run the root of a plan for `episodes`, other tasks with children for `child_episodes` each.

    Without a number the root is run for `belief_runs.EPISODES`, or where beliefs are tracked one by one for
    `belief_episodes.EPISODES`.
    `progress` is called with the task, the first of the episodes that run, and the step, where they are
    tracked one by one.
    """
    chosen = plan_tracker(plan, seed=seed, on_impossible="reset") if chosen is None else chosen
    tracker = chosen.tracker
    if not isinstance(tracker, BlockTracker):
        controller = BeliefController(plan)
        run = run_one_by_one(
            tracker,
            lambda belief: controller.poll(belief).number,
            episodes=belief_episodes.EPISODES if episodes is None else episodes,
            steps=steps,
            seed=seed,
            progress=None if progress is None else partial(progress, plan.root),
        )
        return Measurement({plan.root: run}, chosen)
    runs, root_episodes = {}, belief_runs.EPISODES if episodes is None else episodes
    for name, task in plan.policies.items():
        if name != plan.root and not any(action in plan.policies for action in task.actions):
            continue
        stage = None if name == plan.root else Stage(task.ended, plan.process(name).rewards)
        count = root_episodes if name == plan.root or child_episodes is None else child_episodes
        runs[name] = run_on_blocks(
            tracker, PolledPolicy(plan, tracker, name), episodes=count, steps=steps, seed=seed, stage=stage
        )
    return Measurement(runs, chosen)
