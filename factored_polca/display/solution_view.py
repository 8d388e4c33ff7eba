"""What solvers return: bounds over time, and of whole states the range of values."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from factored_polca.display.charts import BLUE, RED, Series, line_chart
from factored_polca.display.tables import heading, line, pairs, scrolled, view
from factored_polca.display.words import count_text, number_text, plural, seconds_text
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.solvers.pomdp_result import Bounds, POMDPSolution
from factored_polca.solvers.result import MDPSolution


def html(solution: POMDPSolution | MDPSolution) -> str:
    """Figures, and a chart where there is a history."""
    if isinstance(solution, MDPSolution):
        return _states(solution)
    rows = [
        (
            "value from the start",
            f"between {number_text(solution.lower, 9)} and {number_text(solution.upper, 9)}",
        ),
        ("gap", number_text(solution.gap, 3)),
        ("status", solution.status),
        ("policy", _policy(solution)),
        ("iterations", f"{solution.iterations:,}"),
        ("time", seconds_text(solution.seconds)),
        ("guarantee", f"{solution.guarantee.kind}: {solution.guarantee.text}"),
    ]
    return view(
        heading(f"solution by {solution.method}"),
        pairs(rows),
        line(solution.note),
        scrolled(bounds_chart(solution)) if len(solution.history) > 1 else "",
    )


class BoundedSolution(Protocol):
    """What closed a gap over time."""

    @property
    def history(self) -> tuple[Bounds, ...]: ...


def bounds_chart(solution: BoundedSolution) -> str:
    """The bounds at the initial belief against time."""
    seconds = [b.seconds for b in solution.history]
    lower = Series("lower", seconds, [b.lower for b in solution.history], BLUE, stepped=True)
    upper = Series("upper", seconds, [b.upper for b in solution.history], RED, stepped=True)
    said = "Bounds over time"
    return line_chart(
        [upper, lower], "time (seconds)", "value from the start", said, bounds_limits(solution)
    )


def bounds_limits(solution: BoundedSolution) -> tuple[float, float]:
    """The values worth seeing: the last bounds, and what came before them, but for where it is far away."""
    last = solution.history[-1]
    lowest = min(b.lower for b in solution.history)
    highest = max(b.upper for b in solution.history)
    room = 3 * max(last.upper - last.lower, min(highest - last.upper, last.lower - lowest))
    return max(lowest, last.lower - room), min(highest, last.upper + room)


def _policy(solution: POMDPSolution) -> str:
    if isinstance(solution.policy, PolicyGraph):
        return plural(solution.policy.nodes, "node") + " of a policy graph"
    if isinstance(solution.policy, EntropyPolicy):
        return f"a table of {count_text(solution.policy.count)} actions"
    return plural(solution.vectors, "alpha-vector")


def _states(solution: MDPSolution) -> str:
    finite = solution.values[np.isfinite(solution.values)]
    span = (
        f"{number_text(float(finite.min()))} .. {number_text(float(finite.max()))}" if len(finite) else "–"
    )
    dead = int(solution.dead_ends.sum())
    rows = [
        ("states", count_text(len(solution.values))),
        ("values", span + (f"; −∞ in {plural(dead, 'dead end')}" if dead else "")),
        ("largest gap of the bounds", number_text(solution.gap, 3)),
        ("states decided by a tie", f"{solution.ties:,}"),
        ("status", solution.status),
        ("iterations", f"{solution.iterations:,}"),
        ("time", seconds_text(solution.seconds)),
        ("guarantee", f"{solution.guarantee.kind}: {solution.guarantee.text}"),
    ]
    return view(heading(f"solution by {solution.method}"), pairs(rows))
