"""A minimisation, or a reduction: the partition or the quotient, and how far it may be trusted."""

from __future__ import annotations

from factored_polca.display import partition_view, quotient_view
from factored_polca.display.graphs import Graph
from factored_polca.display.tables import line, view
from factored_polca.display.words import plural, seconds_text
from factored_polca.minimisation import Minimisation, Reduction
from factored_polca.minimisation.reduction import InterchangeableReduction


def html(found: Minimisation | Reduction) -> str:
    """What was found, and how."""
    if isinstance(found, Reduction):
        exchanged = ""
        if isinstance(found, InterchangeableReduction):
            exchanged = (
                "actions count by what they do; shown are the named ones of each block's first state"
            )
        return view(quotient_view.html(found.quotient), line(exchanged), line(_trust(found.minimisation)))
    return view(partition_view.html(found.partition), line(_trust(found)))


def graph(found: Reduction) -> Graph:
    """The graph of the quotient."""
    return quotient_view.graph(found.quotient)


def _trust(found: Minimisation) -> str:
    return (
        f"exact but for a chance below {max(found.collision_bound, 1e-300):.1g}; "
        f"{plural(found.rounds, 'round')}, {seconds_text(found.seconds)}"
    )
