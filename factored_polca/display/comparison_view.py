"""A paired comparison: the mean difference with its interval, and a histogram of differences."""

from __future__ import annotations

from factored_polca.display.charts import histogram
from factored_polca.display.tables import heading, pairs, scrolled, view
from factored_polca.display.words import number_text, plural, short
from factored_polca.simulation.comparison import Comparison


def html(found: Comparison) -> str:
    """Figures and the histogram."""
    low, high = found.interval
    first, second = short(found.first), short(found.second)
    rows = [
        (f"mean return of {first}", number_text(float(found.first_returns.mean()), 6)),
        (f"mean return of {second}", number_text(float(found.second_returns.mean()), 6)),
        (
            f"{first} − {second}",
            f"{number_text(found.mean, 6)} ± {number_text(found.standard_error, 2)} (standard error)",
        ),
        (f"{found.level:.0%} interval", f"{number_text(low, 5)} .. {number_text(high, 5)}"),
        ("better, equal, worse", f"{found.wins:,}, {found.ties:,}, {found.losses:,} episodes"),
        ("unpaired standard error", number_text(found.unpaired_standard_error, 2)),
    ]
    told = "Differences of returns"
    chart = histogram(found.differences, "difference of returns (discounted)", "episodes", told, found.mean)
    detail = f"{plural(found.episodes, 'episode')}, the same random numbers for both, seed {found.seed}"
    return view(
        heading(f"{first} against {second}", detail),
        pairs(rows),
        scrolled(chart) if found.episodes > 1 else "",
    )
