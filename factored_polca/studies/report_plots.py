"""The plots of a study's report: coverage, cactus, scatter and growth, for light and dark pages.

Functions called `draw_*` take axes and a theme, draw there, and answer the axes.  `plots` makes all
figures of a comparison; `render` writes one as PNG or SVG.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from factored_polca.studies.drawing import require_matplotlib
from factored_polca.studies.fits import Growth
from factored_polca.studies.report_axes import (
    MARKERS,
    MOST_LINES,
    WIDTH,
    Theme,
    left_out,
    legend_below,
    legend_inches,
    logarithmic,
    new_figure,
    shown,
    spaced,
    whole_numbers,
)
from factored_polca.studies.report_series import (
    LEFT,
    Comparison,
    Pair,
    Series,
    best_of,
    is_number,
    seconds_of,
)
from factored_polca.studies.store import STATUSES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_BARS: Final = 40
MOST_PAIRS: Final = 6
MOST_PARAMETERS: Final = 4
DOTS_PER_INCH: Final = 140


@dataclass(frozen=True)
class Plot:
    """A figure of the report: the name of its file, its heading, what it shows, and how it is made."""

    name: str
    heading: str
    text: str
    make: Callable[[Theme], Figure]


def plots(comparison: Comparison) -> Iterator[Plot]:
    """All plots that the results give something for."""
    if not comparison.planned:
        return
    yield Plot(
        "coverage", "Coverage", "How the runs of each contender ended, model by model.",
        lambda theme: coverage_figure(comparison, theme),
    )  # fmt: skip
    if any(row["status"] == "ok" for row in comparison.rows):
        yield Plot(
            "cactus", "Cactus",
            "How many runs each contender ends within so many seconds each; a line further to the right "
            "and further down is better.",
            lambda theme: cactus_figure(comparison, theme),
        )  # fmt: skip
    pairs = comparison.pairs()[:MOST_PAIRS]
    if pairs:
        yield Plot(
            "scatter", "Scatter",
            "Seconds of two contenders on the same model, parameters and seed; below the diagonal the "
            "second one is faster. Open marks in the margins are runs that did not end well.",
            lambda theme: scatter_figure(pairs, theme),
        )  # fmt: skip
    elif any(row["status"] == "ok" and is_number(row.get("blocks")) for row in comparison.rows):
        yield Plot(
            "scatter", "Scatter", "Seconds against blocks, each mark one run.",
            lambda theme: blocks_figure(comparison, theme),
        )  # fmt: skip
    series = comparison.series()
    for parameter in list(dict.fromkeys(one.parameter for one in series))[:MOST_PARAMETERS]:
        mine = [one for one in series if one.parameter == parameter]
        yield Plot(
            f"growth-{file_name(parameter)}", f"Growth with {parameter}",
            "Medians over seeds, and the curve that fits better: a power of the size, or an exponential. "
            "± and brackets are 95 % intervals, if the curve is the right one.",
            growth_maker(mine, parameter),
        )  # fmt: skip


def growth_maker(series: Sequence[Series], parameter: str) -> Callable[[Theme], Figure]:
    """The function that makes the figure of one parameter."""
    return lambda theme: growth_figure(series, parameter, theme)


def file_name(text: str) -> str:
    """A name as a part of a file's name."""
    return "".join(c if c.isalnum() and c.isascii() else "_" for c in text)[:40]


def render(plot: Plot, theme: Theme, kind: Literal["png", "svg"]) -> bytes:
    """A plot as a file; SVGs have no background.

    Raises:
        MissingLibrary: matplotlib is not installed.
    """
    require_matplotlib()
    import matplotlib

    settings: Any = {
        "text.color": theme.ink, "axes.labelcolor": theme.ink, "axes.edgecolor": theme.ink,
        "xtick.color": theme.ink, "ytick.color": theme.ink, "axes.facecolor": "none",
        "figure.facecolor": "none" if kind == "svg" else theme.paper, "grid.color": theme.faint,
        "axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True, "font.size": 9,
        "legend.frameon": False, "legend.fontsize": 8, "svg.fonttype": "path",
        "svg.hashsalt": plot.name, "font.family": ["DejaVu Sans"], "axes.titlesize": 9.5,
    }  # fmt: skip
    data = io.BytesIO()
    with matplotlib.rc_context(settings):
        figure = plot.make(theme)
        metadata = {"Software": None} if kind == "png" else {"Date": None, "Creator": None}
        figure.savefig(data, format=kind, dpi=DOTS_PER_INCH, metadata=metadata)
    return data.getvalue()


# -- coverage --------------------------------------------------------------------------------------


def coverage_figure(comparison: Comparison, theme: Theme) -> Figure:
    """Bars of equal lengths, one for each contender and model, or each contender where there are many."""
    counts = comparison.coverage()
    if len(counts) > MOST_BARS:
        summed: dict[tuple[str, str], dict[str, int]] = {}
        for (contender, _), found in counts.items():
            total = summed.setdefault((contender, ""), dict.fromkeys(found, 0))
            for status, count in found.items():
                total[status] += count
        counts = dict(list(summed.items())[:MOST_BARS])
    figure, (ax,) = new_figure(1.15 + 0.27 * len(counts))
    draw_coverage(counts, ax, theme)
    return figure


def draw_coverage(counts: dict[tuple[str, str], dict[str, int]], ax: Axes, theme: Theme) -> Axes:
    """Coverage as horizontal bars, shares of runs by status with their numbers."""
    places = range(len(counts))
    names = [f"{model}  {contender}".strip() for contender, model in counts]
    lefts = [0.0] * len(counts)
    for status in (*STATUSES, LEFT):
        shares = [100 * c[status] / sum(c.values()) for c in counts.values()]
        if not any(shares):
            continue
        bars = ax.barh(places, shares, 0.78, left=lefts, color=theme.statuses[status], label=status)
        labels = [
            f"{c[status]:,}" if share >= 4 else "" for c, share in zip(counts.values(), shares, strict=True)
        ]
        ax.bar_label(bars, labels, label_type="center", fontsize=7.5, color="#101010")
        lefts = [a + b for a, b in zip(lefts, shares, strict=True)]
    ax.set_yticks(list(places), [shown(name, 52) for name in names])
    ax.tick_params(axis="y", length=0)
    ax.set_ylim(len(counts) - 0.5, -0.5)
    ax.set_xlim(0, 100)
    ax.set_xlabel("share of the runs, %; numbers are runs")
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=5)
    return ax


# -- cactus ----------------------------------------------------------------------------------------


def cactus_figure(comparison: Comparison, theme: Theme) -> Figure:
    """One line for each contender."""
    solved = {
        name: len(best_of(row for row in comparison.rows if row["contender"] == name))
        for name in comparison.contenders
    }
    names = sorted((name for name in solved if solved[name]), key=lambda name: -solved[name])
    figure, (ax,) = new_figure(3.4 + legend_inches(len(names), 2))
    draw_cactus(comparison, names, ax, theme)
    return figure


def draw_cactus(comparison: Comparison, names: Sequence[str], ax: Axes, theme: Theme) -> Axes:
    """Seconds of the k-th fastest run against k."""
    most = 0
    for number, name in enumerate(names[:MOST_LINES]):
        times = [max(t, 1e-6) for t in best_of(r for r in comparison.rows if r["contender"] == name)]
        most = max(most, len(times))
        ax.plot(
            range(1, len(times) + 1), times, color=theme.colours[number], linewidth=1.4,
            label=shown(name, 60), marker=MARKERS[number], markersize=3.5,
            markevery=max(1, len(times) // 25),
        )  # fmt: skip
    limits = {row["time_limit_seconds"] for row in comparison.rows} - {None}
    logarithmic(ax, "y", "seconds of the work")
    if len(limits) == 1 and (limit := limits.pop()) < 20 * ax.get_ylim()[1]:
        ax.axhline(limit, color=theme.ink, linewidth=0.8, linestyle=":")
        ax.annotate(
            f"limit {limit:g} s", (0, limit), xycoords=("axes fraction", "data"), xytext=(4, -3),
            textcoords="offset points", ha="left", va="top", fontsize=8,
        )  # fmt: skip
    ax.set_xlim(0, max(most * 1.02, 1.5))
    whole_numbers(ax)
    ax.set_xlabel("runs that ended well, fastest first")
    return legend_below(ax, len(names), columns=2)


# -- scatter ---------------------------------------------------------------------------------------


def scatter_figure(pairs: Sequence[Pair], theme: Theme) -> Figure:
    """One square for each pair of contenders."""
    columns = min(2, len(pairs))
    rows = math.ceil(len(pairs) / columns)
    width = 4.9 if columns == 1 else WIDTH
    models = list(dict.fromkeys(first["model"] for pair in pairs for first, _ in pair.rows))
    legend = legend_inches(len(models), 3) if len(models) > 1 else 0.0
    figure, axes = new_figure(4.4 * rows + legend, rows, columns, width)
    for pair, ax in zip(pairs, axes, strict=False):
        draw_scatter(pair, models, ax, theme)
    for ax in axes[len(pairs) :]:
        ax.set_axis_off()
    if len(models) > 1:
        figure.legend(
            handles=[legend_mark(number, model, theme) for number, model in enumerate(models[:MOST_LINES])],
            loc="outside lower left", ncols=3, title=left_out(len(models)), title_fontsize=8,
            alignment="left",
        )  # fmt: skip
    return figure


def legend_mark(number: int, name: str, theme: Theme) -> Any:
    """The mark of a model, for a legend."""
    from matplotlib.lines import Line2D

    return Line2D(
        [], [], linestyle="none", color=theme.colours[number], marker=MARKERS[number], markersize=5,
        label=shown(name, 34),
    )  # fmt: skip


def draw_scatter(pair: Pair, models: Sequence[str], ax: Axes, theme: Theme) -> Axes:
    """Seconds against seconds, equal axes, with margins for runs that did not end well."""
    ended = [seconds_of(row) for both in pair.rows for row in both if row["status"] == "ok"]
    low, high = (min(ended), max(ended)) if ended else (0.1, 1.0)
    low, high = max(low, 1e-6) / 1.5, max(high, 2e-6) * 1.5
    if high / low < 10:
        middle = math.sqrt(low * high)
        low, high = middle / math.sqrt(10), middle * math.sqrt(10)
    some_failed = any(row["status"] != "ok" for both in pair.rows for row in both)
    margin = high * (high / low) ** 0.07 if some_failed else high

    def place(row: Any) -> float:
        return max(seconds_of(row), 1e-6) if row["status"] == "ok" else margin

    for number, model in enumerate(models):
        rows = [both for both in pair.rows if both[0]["model"] == model]
        for well in (True, False):
            mine = [b for b in rows if (b[0]["status"] == b[1]["status"] == "ok") == well]
            colour = theme.colours[number % len(theme.colours)] if number < MOST_LINES else theme.faint
            ax.scatter(
                [place(a) for a, _ in mine], [place(b) for _, b in mine], s=16, alpha=0.75,
                facecolors=colour if well else "none", edgecolors=colour, linewidths=0.9,
                marker=MARKERS[number % len(MARKERS)], rasterized=len(mine) > 1500,
            )  # fmt: skip
    for scale in ("x", "y"):
        logarithmic(ax, scale, "", low, margin * (margin / high))
    ax.plot([low, high], [low, high], color=theme.ink, linewidth=0.8, zorder=0)
    for line in (ax.axvline, ax.axhline) if some_failed else ():
        line(high, color=theme.ink, linewidth=0.6, linestyle=":", zorder=0)
    ax.set_box_aspect(1)
    ax.set_xlabel(f"{shown(pair.first, 40)}, seconds")
    ax.set_ylabel(f"{shown(pair.second, 40)}, seconds")
    return ax


def blocks_figure(comparison: Comparison, theme: Theme) -> Figure:
    """Seconds against blocks, where there is one contender only on each instance."""
    rows = [r for r in comparison.rows if r["status"] == "ok" and is_number(r.get("blocks"))]
    names = list(dict.fromkeys(row["model"] for row in rows))
    figure, (ax,) = new_figure(3.6 + legend_inches(len(names), 3))
    for number, name in enumerate(names[:MOST_LINES]):
        mine = [row for row in rows if row["model"] == name]
        ax.scatter(
            [max(row["blocks"], 1) for row in mine], [max(seconds_of(row), 1e-6) for row in mine], s=18,
            color=theme.colours[number], marker=MARKERS[number], alpha=0.75, label=shown(name),
            linewidths=0, rasterized=len(mine) > 1500,
        )  # fmt: skip
    logarithmic(ax, "x", "blocks")
    logarithmic(ax, "y", "seconds of the work")
    legend_below(ax, len(names), columns=3)
    return figure


# -- growth ----------------------------------------------------------------------------------------


def growth_figure(series: Sequence[Series], parameter: str, theme: Theme) -> Figure:
    """Seconds and blocks against a parameter, side by side."""
    quantities = [("seconds", "seconds of the work")]
    if any(one.growth("blocks") for one in series):
        quantities.append(("blocks", "blocks"))
    columns = len(quantities)
    figure, axes = new_figure(
        3.5 + legend_inches(len(series), 1), 1, columns, WIDTH if columns > 1 else 5.5
    )
    for (quantity, label), ax in zip(quantities, axes, strict=True):
        draw_growth(series, quantity, ax, theme)
        logarithmic(ax, "y", label)
        ax.set_xlabel(f"{shown(parameter)} (parameter)")
    return figure


def draw_growth(series: Sequence[Series], quantity: str, ax: Axes, theme: Theme) -> Axes:
    """Medians with the better one of the fitted curves, on logarithmic axes."""
    found = [(one, growth) for one in series if (growth := one.growth(quantity)) is not None]
    for number, (one, growth) in enumerate(found[:MOST_LINES]):
        colour = theme.colours[number]
        xs, ys = zip(*growth.points, strict=True)
        ax.plot(
            xs, ys, color=colour, linestyle="none", marker=MARKERS[number], markersize=4.5, alpha=0.9,
            label=f"{shown(name_of(one, series), 28)}:  {growth.better.text('n')}",
        )  # fmt: skip
        steps = [xs[0] * (xs[-1] / xs[0]) ** (k / 60) for k in range(61)]
        ax.plot(steps, [growth.better.at(x) for x in steps], color=colour, linewidth=1.1, alpha=0.8)
    ax.set_xscale("log")
    sizes = sorted({x for _, growth in found for x, _ in growth.points})
    if sizes:
        kept = spaced(sizes)
        ax.set_xticks(kept, [f"{size:,g}" for size in kept])
        ax.set_xticks([], minor=True)
    return legend_below(ax, len(found), columns=1)


def name_of(one: Series, among: Sequence[Series]) -> str:
    """The name of a series, without what all have in common."""
    parts = [one.model]
    if len({other.contender for other in among}) > 1:
        parts.append(one.contender)
    if len({other.others for other in among}) > 1:
        parts.append(one.others)
    return " ".join(part for part in parts if part) or one.contender


def growth_texts(growth: Growth | None) -> tuple[str, str, str]:
    """Power, exponential, and which fits better, for a table."""
    if growth is None:
        return "", "", ""
    better = "exponential" if growth.better is growth.exponential else "power"
    if growth.power.residual < 1e-9:
        better = "power, exactly" if growth.power.residual < 1e-12 else better
    return growth.power.text(), growth.exponential.text(), better
