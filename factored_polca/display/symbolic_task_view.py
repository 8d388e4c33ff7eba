"""A task whose state is not seen, solved on diagrams: figures, and its bounds over time."""

from __future__ import annotations

from factored_polca.display.solution_view import bounds_chart
from factored_polca.display.tables import heading, line, pairs, scrolled, view
from factored_polca.display.words import count_text, number_text, seconds_text, short
from factored_polca.hierarchy.symbolic_task import SymbolicPomdpTask


def html(task: SymbolicPomdpTask) -> str:
    """Figures and chart."""
    solution = task.solution
    rows = [
        ("value as planned", f"between {number_text(task.lower, 7)} and {number_text(task.upper, 7)}"),
        ("corner gap", number_text(task.corner_gap, 3)),
        ("blocks", "none: no quotient was made"),
        ("solver", f"{solution.method}: {solution.status}"),
        ("policy", f"{solution.vectors:,} alpha-vectors of {count_text(solution.policy.nodes)} nodes"),
        ("beliefs met", count_text(solution.beliefs)),
        ("time", seconds_text(task.seconds)),
    ]
    return view(
        heading(f"task {short(task.task.name)}", solution.guarantee.text),
        pairs(rows),
        *(line(f"warning: {warning}") for warning in task.warnings[:5]),
        scrolled(bounds_chart(solution)) if len(solution.history) > 1 else "",
    )
