"""What episodes earned: the mean, its standard error, and a histogram of returns."""

from __future__ import annotations

from factored_polca.display.charts import histogram
from factored_polca.display.tables import heading, line, scrolled, view
from factored_polca.display.words import number_text, plural
from factored_polca.simulation.belief_runs import BeliefRuns
from factored_polca.simulation.simulate import Simulation


def html(runs: Simulation | BeliefRuns) -> str:
    """Figures and the histogram."""
    error = number_text(runs.standard_error, 2)
    detail = (
        f"(standard error, {plural(runs.episodes, 'episode')} of at most {plural(runs.steps, 'step')}, "
        f"{runs.ended:,} ended)"
    )
    cut = ""
    if runs.truncation > max(runs.standard_error, 1e-6 * abs(runs.mean)):
        cut = f"cut off: longer episodes may change the mean by up to {number_text(runs.truncation, 2)}"
    chart = histogram(runs.returns, "return (discounted)", "episodes", "Returns of episodes", runs.mean)
    return view(
        heading(f"mean return {number_text(runs.mean, 6)} ± {error}", detail),
        line(cut),
        scrolled(chart) if runs.episodes > 1 else "",
    )
