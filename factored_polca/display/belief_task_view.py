"""A solved task whose state is not seen: figures, bounds over time, and its policy graph with beliefs."""

from __future__ import annotations

from factored_polca.display.belief_graph import by_partition, followable, policy_graph
from factored_polca.display.graphs import Graph
from factored_polca.display.partition_view import block_formulas
from factored_polca.display.solution_view import bounds_chart
from factored_polca.display.tables import drawing, heading, line, pairs, scrolled, view
from factored_polca.display.words import count_text, number_text, seconds_text, short
from factored_polca.hierarchy.pomdp_solved import SolvedPomdpTask

SHOWN_NODES = 16
LONGEST = 44


def html(task: SolvedPomdpTask) -> str:
    """Figures, chart and graph."""
    solution, quotient = task.solution, task.reduction.pomdp_quotient
    before, after = sum(quotient.observations_before), sum(quotient.observations_after)
    rows = [
        ("value as planned", f"between {number_text(task.lower, 7)} and {number_text(task.upper, 7)}"),
        ("corner gap", number_text(task.corner_gap, 3)),
        ("blocks", count_text(task.reduction.partition.blocks)),
        ("observations", f"{before:,} joint ones, merged to {after:,}"),
        ("solver", f"{solution.method}: {solution.status}"),
        ("policy", f"{solution.vectors:,} vectors"),
        ("time", seconds_text(task.seconds)),
    ]
    small = followable(quotient.pomdp)
    return view(
        heading(f"task {short(task.task.name)}", solution.guarantee.text),
        pairs(rows),
        *(line(f"warning: {warning}") for warning in task.warnings[:5]),
        scrolled(bounds_chart(solution)) if len(solution.history) > 1 else "",
        drawing(graph(task)) if small else line("too many blocks and observations to follow beliefs here"),
    )


def graph(task: SolvedPomdpTask) -> Graph:
    """The policy from the initial belief on."""
    quotient = task.reduction.pomdp_quotient
    texts = list(block_formulas(task.reduction.partition, None, LONGEST))
    brief = [text.removeprefix("no short formula; ") for text in texts]
    describe = by_partition(task.reduction.partition, brief)
    return policy_graph(quotient.pomdp, task.belief_policy, describe, SHOWN_NODES)
