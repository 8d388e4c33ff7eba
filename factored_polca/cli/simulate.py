"""The command `simulate`: run a plan or a policy on the original model."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from factored_polca.cli.output import Output, escape
from factored_polca.cli.simulate_symbolic import simulate_alpha_policy

if TYPE_CHECKING:
    from factored_polca.cli.pilot import AnyPlan
    from factored_polca.control.belief_policies import BlockPolicy
    from factored_polca.control.tracker import ChosenTracker
    from factored_polca.simulation import Simulation
    from factored_polca.simulation.belief_runs import BeliefRuns

EPISODES = 1000


def simulate(arguments: argparse.Namespace, output: Output) -> int:
    """Run a plan or a policy on the original model."""
    from factored_polca.cli.pilot import open_plan
    from factored_polca.hierarchy.alpha_policy_file import is_alpha_policy_file
    from factored_polca.hierarchy.policy_file import is_policy_file

    if is_policy_file(arguments.plan):
        data = simulate_policy_file(arguments, output)
    elif is_alpha_policy_file(arguments.plan):
        data = simulate_alpha_policy(arguments, output)
    else:
        plan = open_plan(arguments.plan)
        partial = plan.model.observability == "partial"
        data = (simulate_beliefs if partial else simulate_states)(plan, arguments, output)
    data["seed"] = arguments.seed
    if arguments.json:
        output.result(data)
    else:
        print_simulation(data, output)
    return 0


def figures(result: Simulation | BeliefRuns) -> dict[str, Any]:
    """What all simulations say."""
    return {
        "mean": result.mean,
        "standard_error": result.standard_error,
        "episodes": result.episodes,
        "steps": result.steps,
        "ended": result.ended,
        "truncation": result.truncation,
    }


def simulate_policy_file(arguments: argparse.Namespace, output: Output) -> dict[str, Any]:
    """A policy that `solve` found, on the states that it was found for."""
    from factored_polca.hierarchy.policy_file import load_policy
    from factored_polca.simulation import simulate_policy

    policy, episodes = load_policy(arguments.plan), arguments.episodes or EPISODES
    with output.progress(f"simulating {episodes:,} episodes"):
        found = simulate_policy(
            policy.flat.pomdp, policy.policy, episodes=episodes, steps=arguments.steps, seed=arguments.seed
        )
    planned = {f"planned_{name}": policy.report.get(name) for name in ("value", "lower", "upper")}
    return figures(found) | planned


def simulate_states(plan: Any, arguments: argparse.Namespace, output: Output) -> dict[str, Any]:
    """A plan of a fully observed model."""
    from factored_polca.simulation import simulate as run

    episodes = arguments.episodes or EPISODES
    with output.progress(f"simulating {episodes:,} episodes"):
        found = run(plan, episodes=episodes, steps=arguments.steps, seed=arguments.seed)
    return figures(found) | {"planned_value": plan.report.get("value")}


def simulate_beliefs(plan: AnyPlan, arguments: argparse.Namespace, output: Output) -> dict[str, Any]:
    """A plan of a partially observed model, its beliefs tracked."""
    from factored_polca.cli.pilot import LIKELIEST, tracker_of
    from factored_polca.control.block_tracker import BlockTracker
    from factored_polca.hierarchy.executable import ExecutablePlan
    from factored_polca.simulation import belief_episodes

    with output.progress(f"simulating {plan.model.name}"):
        chosen = tracker_of(plan, "reset", arguments.seed)
        blocks = isinstance(chosen.tracker, BlockTracker)
        episodes = arguments.episodes or (EPISODES if blocks else belief_episodes.EPISODES)
        output.update(f"simulating {episodes:,} episodes; tracked: {chosen.kind}")
        found = run_beliefs(plan, chosen, episodes, arguments, output)
    data = figures(found) | {"planned_value": plan.report.get("value")}
    if isinstance(plan, ExecutablePlan):
        data["execution"] = LIKELIEST
    else:
        data["planned_standard_error"] = plan.report.get("standard_error")
    if chosen.tracker.guarantee != "exact":
        data["resets"] = found.resets
    return data | {
        "tracker": chosen.kind,
        "tracker_reason": chosen.reason,
        "action_counts": {
            action.name: int(count)
            for action, count in zip(plan.model.actions, found.counts.tolist(), strict=True)
        },
    }


def run_beliefs(
    plan: AnyPlan, chosen: ChosenTracker, episodes: int, arguments: argparse.Namespace, output: Output
) -> BeliefRuns:
    """Episodes over blocks side by side, else one by one."""
    from factored_polca.cli.pilot import decider
    from factored_polca.control.belief_policies import MostLikelyPolicy, PolledPolicy
    from factored_polca.control.block_tracker import BlockTracker
    from factored_polca.hierarchy.executable import ExecutablePlan
    from factored_polca.simulation.belief_episodes import run_one_by_one
    from factored_polca.simulation.belief_runs import run_on_blocks

    tracker, steps, seed = chosen.tracker, arguments.steps, arguments.seed
    if isinstance(tracker, BlockTracker):
        policy: BlockPolicy
        if isinstance(plan, ExecutablePlan):
            policy = MostLikelyPolicy(plan.policy, tracker)
        else:
            policy = PolledPolicy(plan, tracker)
        return run_on_blocks(tracker, policy, episodes=episodes, steps=steps, seed=seed)
    decide = decider(plan)
    return run_one_by_one(
        tracker, lambda belief: decide(belief).number, episodes=episodes, steps=steps, seed=seed,
        progress=lambda first, step: output.update(
            f"simulating {episodes:,} episodes, tracked one by one ({chosen.kind}): from episode "
            f"{first + 1:,}, step {step + 1:,}"
        ),
    )  # fmt: skip


def print_simulation(data: Mapping[str, Any], output: Output) -> None:
    """The figures of `simulate` for people."""
    output.line(
        f"mean return [bold]{data['mean']:.6g}[/] ± {data['standard_error']:.2g} (standard error, "
        f"{data['episodes']:,} episodes of at most {data['steps']:,} steps, {data['ended']:,} ended)"
    )
    value, lower, upper = (data.get(f"planned_{name}") for name in ("value", "lower", "upper"))
    if isinstance(value, (int, float)):
        bounded = isinstance(lower, (int, float)) and isinstance(upper, (int, float))
        bounds = f", the bounds {lower:.6g} .. {upper:.6g}" if bounded else ""
        error = data.get("planned_standard_error")
        spread = f" ± {error:.2g}, as measured then" if isinstance(error, (int, float)) else ""
        as_seen = ", as if the state were seen" if "execution" in data else ""
        output.line(f"planned value: {value:.6g}{spread}{bounds}{as_seen}")
    if data["truncation"] > max(data["standard_error"], 1e-6 * abs(data["mean"])):
        output.line(f"cut off: longer episodes may change the mean by up to {data['truncation']:.2g}")
    if "tracker" not in data:
        return
    total = max(1, sum(data["action_counts"].values()))
    ordered = sorted(data["action_counts"].items(), key=lambda pair: -pair[1])
    shares = [f"{name} {count / total:.1%}" for name, count in ordered if count]
    output.line(f"actions: {escape(', '.join(shares))}")
    output.line(f"tracker: {escape(data['tracker'])}; {escape(data['tracker_reason'])}")
    if data.get("resets"):
        output.line(f"beliefs that had lost the true state and were started anew: {data['resets']:,}")
    if "execution" in data:
        output.line(f"note: {data['execution']}")
