"""The command `compare`: two plans, or policies, on the same random numbers."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factored_polca.cli.output import Output, escape

if TYPE_CHECKING:
    from factored_polca.simulation.comparison import Comparison
    from factored_polca.simulation.runnable import AnyPlan


def compare(arguments: argparse.Namespace, output: Output) -> int:
    """Run both, and say by how much the first is better."""
    from factored_polca.simulation.comparison import compare as work

    plans = [open_any(path) for path in (arguments.first, arguments.second)]
    with output.progress("comparing on the same random numbers"):
        found = work(
            plans[0], plans[1], episodes=arguments.episodes, steps=arguments.steps, seed=arguments.seed,
            names=plan_names(arguments.first, arguments.second),
            progress=lambda name, done: output.update(f"running {name}: {done:,} episodes done"),
        )  # fmt: skip
    if arguments.json:
        output.result(comparison_data(found))
    else:
        print_comparison(found, output)
    return 0


def open_any(path: str) -> AnyPlan:
    """The plan or policy in a file.

    Raises:
        ModelError: no such file, neither of them, or damaged.
    """
    from factored_polca.cli.pilot import open_plan
    from factored_polca.hierarchy.policy_file import is_policy_file, load_policy

    return load_policy(path) if is_policy_file(path) else open_plan(path)


def plan_names(first: str, second: str) -> tuple[str, str]:
    """What two files are called: by their names, or their whole paths where these are equal."""
    names = Path(first).name, Path(second).name
    return names if names[0] != names[1] else (first, second)


def comparison_data(found: Comparison) -> dict[str, Any]:
    """A comparison as plain data."""
    low, high = found.interval
    return {
        "first": found.first,
        "second": found.second,
        "first_mean": float(found.first_returns.mean()),
        "second_mean": float(found.second_returns.mean()),
        "mean_difference": found.mean,
        "standard_error": found.standard_error,
        "unpaired_standard_error": found.unpaired_standard_error,
        "level": found.level,
        "interval": [low, high],
        "wins": found.wins,
        "ties": found.ties,
        "losses": found.losses,
        "episodes": found.episodes,
        "steps": found.steps,
        "seed": found.seed,
        "truncation": found.truncation,
    }


def print_comparison(found: Comparison, output: Output) -> None:
    """A comparison for people."""
    first, second = escape(found.first), escape(found.second)
    low, high = found.interval
    output.line(
        f"{found.episodes:,} episodes of at most {found.steps:,} steps, the same random numbers for both"
    )
    output.line(f"mean return of {first}: {found.first_returns.mean():.6g}")
    output.line(f"mean return of {second}: {found.second_returns.mean():.6g}")
    output.line(f"difference [bold]{found.mean:.6g}[/] ± {found.standard_error:.2g} (standard error)")
    if math.isfinite(low):
        output.line(
            f"{found.level:.0%} confidence interval: {low:.6g} .. {high:.6g}: {verdict(found, low, high)}"
        )
    output.line(
        f"{first} earns more in {found.wins:,} episodes, as much in {found.ties:,}, "
        f"less in {found.losses:,}"
    )
    if found.truncation > max(found.standard_error, 1e-6 * abs(found.mean)):
        output.line(f"cut off: longer episodes may change the difference by up to {found.truncation:.2g}")


def verdict(found: Comparison, low: float, high: float) -> str:
    """What an interval says."""
    if low > 0:
        return f"{escape(found.first)} earns more"
    if high < 0:
        return f"{escape(found.second)} earns more"
    return "no difference is shown" if low < high else "both earn the same in each episode"
