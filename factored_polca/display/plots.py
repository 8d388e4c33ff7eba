"""Plots with matplotlib, the extra `[viz]`: functions that draw on axes and answer them.

Each takes `ax`, or makes a figure of its own where that is None; none shows anything or changes a style.
The axes say their units.

Growth is drawn log-log with the exponent p of the power law y = c n^p that fits best in the sense of least
squares of logarithms: log y = log c + p log n.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from factored_polca.display.extras import library
from factored_polca.display.solution_view import bounds_limits
from factored_polca.display.words import short, value_text
from factored_polca.simulation.trace import Trace
from factored_polca.solvers.pomdp_result import POMDPSolution

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CYCLE: Final = ("#0072b2", "#e69f00", "#009e73", "#d55e00", "#cc79a7", "#56b4e9", "#8c8c8c")
"""Okabe & Ito's colours, which the colour-blind tell apart."""

COLOURS: Final = {
    "none": "#8c8c8c", "polca": "#e69f00", "polca_plus": "#0072b2",
    "PolCA+": "#0072b2", "PolCA": "#e69f00", "QMDP": "#d55e00", "SARSOP": "#009e73",
}  # fmt: skip
"""Colours of names that occur in several figures."""

GRID: Final = "#808080"

READINGS: Final = (("none", "no abstraction"), ("polca", "PolCA"), ("polca_plus", "PolCA+"))
"""Figure 4a's three readings and what they are called."""

Curve = tuple[Sequence[float], Sequence[float]]
"""The x and the y of a line's points."""


def axes(ax: Axes | None, width: float = 7.0, height: float = 4.2) -> Axes:
    """`ax`, or the axes of a new figure.

    Raises:
        MissingLibrary: matplotlib is not installed.
    """
    if ax is not None:
        return ax
    pyplot = library("matplotlib.pyplot", "viz", "drawing")
    _, made = pyplot.subplots(figsize=(width, height), layout="constrained")
    new: Axes = made
    return new


def tidy(ax: Axes, legend: Literal["best", "upper left"] | None = None, columns: int = 1) -> Axes:
    """Without a box, with a faint grid, with a legend without a frame."""
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    ax.grid(axis="y", color=GRID, alpha=0.22, linewidth=0.7)
    ax.set_axisbelow(True)
    if legend is not None:
        ax.legend(loc=legend, frameon=False, ncols=columns, fontsize=9)
    return ax


def colour_of(name: str, number: int) -> str:
    """The colour of a name that has one, else the next of the cycle."""
    return COLOURS.get(name, CYCLE[number % len(CYCLE)])


def plot_bounds(solution: POMDPSolution, ax: Axes | None = None, *, label: str = "") -> Axes:
    """The bounds at the initial belief against time; a first bound that is far away is cut off."""
    ax = axes(ax)
    seconds = [b.seconds for b in solution.history]
    name = f"{label} " if label else ""
    ends = [*seconds, max(solution.seconds, *seconds)] if seconds else []
    for key, colour in (("upper", CYCLE[3]), ("lower", CYCLE[0])):
        values = [getattr(b, key) for b in solution.history]
        ax.step(
            ends, [*values, *values[-1:]], where="post", color=colour, linewidth=1.8, label=f"{name}{key}"
        )
    if solution.history:
        low, high = bounds_limits(solution)
        room = 0.05 * (high - low) or 0.5
        ax.set_ylim(low - room, high + room)
        ax.set_xlim(0, None)
    ax.set_xlabel("time (seconds)")
    ax.set_ylabel("value from the start")
    return tidy(ax, legend="best")


def fitted_exponent(sizes: Sequence[float], values: Sequence[float]) -> tuple[float, float]:
    """The exponent p and the factor c of y = c n^p, by least squares of logarithms.

    Raises:
        ValueError: fewer than two different sizes, or numbers that are not positive.
    """
    if len(sizes) != len(values) or len(set(sizes)) < 2 or min(*sizes, *values) <= 0:
        raise ValueError("a power law is fitted to positive values at two different sizes at least")
    slope, constant = np.polyfit([math.log(n) for n in sizes], [math.log(y) for y in values], 1)
    return float(slope), float(math.exp(constant))


def plot_growth(
    sizes: Sequence[float],
    series: Mapping[str, Sequence[float]],
    ax: Axes | None = None,
    *,
    x_label: str = "states",
    y_label: str = "blocks",
) -> Axes:
    """Blocks, or seconds, against states: log-log, each line with its fitted exponent.

    Values that are missing are given as NaN.  Integers may be of any length: 2^1000 states are drawn too.
    """
    ax = axes(ax)
    logs = np.array([math.log10(size) for size in sizes])
    for number, (name, values) in enumerate(series.items()):
        known = [k for k, value in enumerate(values) if value > 0 and math.isfinite(value)]
        x, y = logs[known], np.array([math.log10(values[k]) for k in known])
        said = short(name)
        if len(set(x.tolist())) > 1:
            slope, constant = np.polyfit(x, y, 1)
            said += f"  ~ n^{slope:.2f}"
            ends = np.array([x.min(), x.max()])
            ax.plot(ends, constant + slope * ends, color=colour_of(name, number), alpha=0.5, linewidth=1.2)
        ax.plot(x, y, "o", color=colour_of(name, number), markersize=5, label=said)
    _powers(ax)
    ax.set_xlabel(x_label)
    ax.set_ylabel(y_label)
    return tidy(ax, legend="best")


def _powers(ax: Axes) -> None:
    """Ticks of a scale of logarithms as powers of ten."""
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(7, integer=True))
        axis.set_major_formatter(FuncFormatter(lambda value, _: rf"$10^{{{value:.0f}}}$"))
    ax.margins(0.06)


def plot_belief(trace: Trace, feature: str | None = None, ax: Axes | None = None) -> Axes:
    """The belief about a feature over an episode, as stacked areas; by default the one least certain.

    Below the axis stand the actions, where they are few enough to read; a dot marks the true value.

    Raises:
        KeyError: the trace holds no belief about it.
    """
    ax = axes(ax)
    if feature is None:
        feature = _least_certain(trace)
    chances = trace.belief_over_time(feature)  # [step, value]
    values = trace.model.feature(feature).values
    used = [v for v in range(len(values)) if chances[:, v].max() > 5e-4]
    steps = np.arange(len(chances) + 1)
    layers = np.repeat(chances[:, used].T, [1] * (len(chances) - 1) + [2], axis=1)
    colours = [CYCLE[k % len(CYCLE)] for k in range(len(used))]
    names = [short(value_text(values[v])) for v in used]
    ax.stackplot(steps, layers, colors=colours, labels=names, alpha=0.6, step="post")
    truth = [*(step.state[feature] for step in trace.steps), trace.state[feature]]
    for k, value in enumerate(truth):
        v = next(i for i, other in enumerate(values) if type(other) is type(value) and other == value)
        if v in used:
            below = chances[k, [w for w in used if w < v]].sum()
            ax.plot(k + 0.5, below + chances[k, v] / 2, "o", color="black", markersize=3.5)
    ax.set_xlim(0, len(chances))
    ax.set_ylim(0, 1)
    _name_steps(ax, trace)
    ax.set_ylabel(f"probability of {short(feature)}")
    tidy(ax)
    ax.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, fontsize=9)
    return ax


def _least_certain(trace: Trace) -> str:
    """The feature whose belief is furthest from certain, summed over time."""
    spread = {name: float((1 - trace.belief_over_time(name).max(axis=1)).sum()) for name in trace.beliefs}
    if not spread:
        raise KeyError("the trace holds no beliefs: the state is seen")
    return max(spread, key=spread.__getitem__)


def _name_steps(ax: Axes, trace: Trace) -> None:
    """Actions at the steps before which they stand, or the numbers of steps where there are many."""
    if len(trace.steps) <= 24:
        places = np.arange(len(trace.steps)) + 1.0
        ax.set_xticks(
            places, [short(step.action, 18) for step in trace.steps], rotation=55, ha="right", fontsize=8
        )
        ax.set_xlabel("steps, by what was done; dots: the true value")
    else:
        ax.set_xlabel("steps; dots: the true value")


# -- the paper's figures -------------------------------------------------------------------------------


def figure_4a(
    counts: Sequence[tuple[str, Mapping[str, int | None]]], ax: Axes | None = None, *, title: str = ""
) -> Axes:
    """Parameters of the tasks' models on a logarithmic scale: three bars for each (task, counts).

    The keys of the counts are those of `READINGS`; a count that is not known is None.
    """
    ax = axes(ax, 8.0, 4.5)
    places, width = np.arange(len(counts)), 0.27
    for number, (reading, label) in enumerate(READINGS):
        known = [k for k, (_, count) in enumerate(counts) if count.get(reading)]
        if not known:
            continue
        heights = [float(counts[k][1][reading] or 0) for k in known]
        bars = ax.bar(
            places[known] + (number - 1) * width, heights, 0.92 * width, color=COLOURS[reading], label=label
        )
        ax.bar_label(bars, [brief_count(h) for h in heights], fontsize=7, padding=1.5)
    ax.set_yscale("log")
    _, high = ax.get_ylim()
    ax.set_ylim(10, 2 * high)
    ax.set_xticks(places, [short(name, 20) for name, _ in counts])
    ax.tick_params(axis="x", length=0)
    ax.set_ylabel("parameters (non-zero entries)")
    ax.set_title(title, loc="left")
    return tidy(ax, legend="upper left", columns=3)


def figure_4b(
    curves: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    ax: Axes | None = None,
    *,
    title: str = "",
) -> Axes:
    """Mean cumulative reward by time: name -> (means, standard errors) after each step, as a band."""
    ax = axes(ax, 8.0, 4.5)
    ends = {}
    for number, (name, (means, errors)) in enumerate(curves.items()):
        colour, middle, error = colour_of(name, number), np.asarray(means), np.asarray(errors)
        time = np.arange(1, len(middle) + 1)
        ax.plot(time, middle, color=colour, linewidth=1.6, label=short(name))
        ax.fill_between(time, middle - error, middle + error, color=colour, alpha=0.25, linewidth=0)
        ends[name] = (float(middle[-1]), colour)
    ax.axhline(0, color=GRID, alpha=0.4, linewidth=0.8, zorder=0)
    ax.set_xlim(0, max((len(means) for means, _ in curves.values()), default=1))
    name_curves(ax, ends)
    ax.set_xlabel("steps")
    ax.set_ylabel("cumulative reward")
    ax.set_title(title, loc="left")
    return tidy(ax)


def figure_4c(
    counts: Sequence[tuple[str, int]],
    ax: Axes | None = None,
    *,
    title: str = "",
    unit: str = "values stored",
) -> Axes:
    """How many numbers each method keeps, (name, count) from top to bottom, on a logarithmic scale."""
    ax = axes(ax, 7.0, 0.6 + 0.36 * max(3, len(counts)))
    places = np.arange(len(counts))[::-1]
    names, heights = [short(name, 44) for name, _ in counts], [count for _, count in counts]
    colours = [CYCLE[0] if name.startswith("PolCA") else "#8c8c8c" for name, _ in counts]
    bars = ax.barh(places, heights, 0.66, color=colours)
    ax.bar_label(bars, [f"{count:,}" for count in heights], fontsize=9, padding=3)
    ax.set_yticks(places, names)
    ax.tick_params(axis="y", length=0)
    ax.set_xscale("log")
    ax.set_xlim(max(1.0, min(heights, default=1) / 3), 3 * max(heights, default=1))
    ax.set_xlabel(f"{unit} (logarithmic scale)")
    ax.set_title(title, loc="left")
    tidy(ax)
    ax.grid(axis="y", visible=False)
    ax.grid(axis="x", color=GRID, alpha=0.22, linewidth=0.7)
    return ax


def learning_curves(
    curves: Mapping[str, Curve],
    ax: Axes | None = None,
    *,
    optimum: float | None = None,
    title: str = "",
    y_label: str = "mean return",
    bands: Mapping[str, tuple[Sequence[float], Sequence[float]]] | None = None,
) -> Axes:
    """Return against episodes: name -> (episodes, returns); bands by name; a line at the optimum."""
    ax = axes(ax, 8.0, 4.5)
    ends = {}
    for number, (name, (episodes, returns)) in enumerate(curves.items()):
        colour = colour_of(name, number)
        ax.plot(episodes, returns, color=colour, linewidth=1.6, label=short(name))
        if bands is not None and name in bands:
            ax.fill_between(episodes, *bands[name], color=colour, alpha=0.2, linewidth=0)
        ends[name] = (float(returns[-1]), colour)
    if optimum is not None:
        ax.axhline(optimum, color=GRID, linewidth=1.0, linestyle="--", zorder=0)
        ax.annotate(
            "optimum", (0.01, optimum), xycoords=("axes fraction", "data"), xytext=(0, 3),
            textcoords="offset points", color=GRID, fontsize=9,
        )  # fmt: skip
    name_curves(ax, ends)
    ax.set_xlabel("episodes")
    ax.set_ylabel(y_label)
    ax.set_title(title, loc="left")
    return tidy(ax)


def name_curves(ax: Axes, ends: Mapping[str, tuple[float, str]]) -> None:
    """The names of curves, (last value, colour), at the right, moved apart where they would overlap."""
    low, high = ax.get_ylim()
    room = 0.055 * (high - low)
    order = sorted(ends, key=lambda name: ends[name][0])
    levels = [ends[name][0] for name in order]
    for k in range(1, len(levels)):
        levels[k] = max(levels[k], levels[k - 1] + room)
    ceiling = high
    for k in reversed(range(len(levels))):
        levels[k] = min(levels[k], ceiling)
        ceiling = levels[k] - room
    for name, level in zip(order, levels, strict=True):
        ax.annotate(
            short(name), (1, level), xycoords=("axes fraction", "data"), xytext=(5, 0),
            textcoords="offset points", color=ends[name][1], va="center", fontweight="bold",
        )  # fmt: skip
    ax.set_ylim(low, high)


def brief_count(count: float) -> str:
    """A count in two or three digits."""
    if count < 1000:
        return f"{count:.0f}"
    return f"{count / 1000:.1f}k" if count < 10_000 else f"{count / 1000:.0f}k"
