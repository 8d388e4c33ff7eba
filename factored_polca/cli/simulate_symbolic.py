"""`simulate` for policies of alpha-vectors as diagrams: beliefs are tracked without a list of states."""

from __future__ import annotations

import argparse
from typing import Any

from factored_polca.cli.output import Output


def simulate_alpha_policy(arguments: argparse.Namespace, output: Output) -> dict[str, Any]:
    """A policy that `solve` found on diagrams, asked at beliefs that are diagrams, or else particles."""
    from factored_polca.cli.simulate import figures
    from factored_polca.control.diagram_polling import point_of
    from factored_polca.control.tracker import Belief, choose_tracker
    from factored_polca.hierarchy.alpha_policy_file import load_alpha_policy
    from factored_polca.simulation.belief_episodes import EPISODES, run_one_by_one

    loaded = load_alpha_policy(arguments.plan)
    policy, model = loaded.policy, loaded.model
    episodes = arguments.episodes or EPISODES
    with output.progress(f"simulating {model.name}"):
        chosen = choose_tracker(policy.symbolic, block_limit=0, on_impossible="reset", seed=arguments.seed)

        def decide(belief: Belief) -> int:
            return policy.choose(point_of(policy, belief))

        found = run_one_by_one(
            chosen.tracker, decide, episodes=episodes, steps=arguments.steps, seed=arguments.seed,
            progress=lambda first, step: output.update(
                f"simulating {episodes:,} episodes ({chosen.kind}): from episode {first + 1:,}, "
                f"step {step + 1:,}"
            ),
        )  # fmt: skip
    data = figures(found) | {
        f"planned_{name}": loaded.report.get(name) for name in ("value", "lower", "upper")
    }
    reason = chosen.reason
    if chosen.tracker.guarantee != "exact":
        data["resets"] = found.resets
        reason += ", and actions are chosen at the product of their marginals"
    return data | {
        "tracker": chosen.kind,
        "tracker_reason": reason,
        "action_counts": {
            action.name: int(count)
            for action, count in zip(model.actions, found.counts.tolist(), strict=True)
        },
    }
