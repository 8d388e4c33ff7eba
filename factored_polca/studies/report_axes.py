"""Axes of a report's plots: their colours, numbers and legends.

Names come from other people's files: they are shortened, and a dollar sign in them starts no formula.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from factored_polca.studies.report_series import LEFT, brief

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_LINES: Final = 10
"""Lines in one plot; the table has the others."""
WIDTH: Final = 9.0
"""Inches."""
LEGEND_DISTANCE: Final = 0.5
"""Inches from the axes to a legend below them: the room of the ticks' numbers and the axis' name."""
MARKERS: Final = "osD^vP*Xd<"


@dataclass(frozen=True)
class Theme:
    """The colours of a page; `colours` are Okabe and Ito's, which the colour-blind tell apart."""

    paper: str
    ink: str
    faint: str
    statuses: dict[str, str]
    colours: tuple[str, ...]


LIGHT: Final = Theme(
    "#ffffff", "#1c1c1c", "#d4d4d4",
    {"ok": "#009e73", "timeout": "#e69f00", "memout": "#cc79a7", "error": "#d55e00", LEFT: "#c8c8c8"},
    ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5b4a9e", "#7a5c2e", "#4d4d4d",
     "#8a1538"),
)  # fmt: skip
DARK: Final = Theme(
    "#16181c", "#e6e6e6", "#44484f",
    {"ok": "#2bbf93", "timeout": "#f0b429", "memout": "#dd8fbb", "error": "#f07a3a", LEFT: "#5c6068"},
    ("#58b0ea", "#f07a3a", "#2bbf93", "#dd8fbb", "#f0b429", "#9fd8ff", "#a99be8", "#c8a56b", "#b8b8b8",
     "#ee7b98"),
)  # fmt: skip


def new_figure(
    height: float, rows: int = 1, columns: int = 1, width: float = WIDTH
) -> tuple[Figure, list[Axes]]:
    """A figure of so many inches, and its axes row by row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.flat)


def shown(name: str, longest: int = 44) -> str:
    """A name as matplotlib shows it."""
    return brief(name, longest).replace("$", r"\$")


def logarithmic(
    ax: Axes, scale: str, label: str, low: float | None = None, high: float | None = None
) -> None:
    """A logarithmic axis with plain numbers at its ticks; at least three of them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis = ax.xaxis if scale == "x" else ax.yaxis
    (ax.set_xscale if scale == "x" else ax.set_yscale)("log")
    set_limits = ax.set_xlim if scale == "x" else ax.set_ylim
    if low is not None and high is not None:
        set_limits(low, high)
    low, high = ax.get_xlim() if scale == "x" else ax.get_ylim()
    if high / low < 4:  # less than the distance of two ticks, or one value only
        middle = math.sqrt(low * high)
        low, high = middle / 3, middle * 3
        set_limits(low, high)
    decades = math.log10(high / low)
    steps = (1, 2, 5) if decades < 2.2 else (1,)
    axis.set_major_locator(LogLocator(10, subs=steps, numticks=30 if decades < 2.2 else 9))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: plain_number(value)))
    ax.grid(True, axis="x" if scale == "x" else "y", linewidth=0.6)
    if label:
        axis.set_label_text(label)


def plain_number(value: float) -> str:
    """A tick's number."""
    if value >= 1e7 or value < 1e-4:
        return f"{value:.0e}"
    return f"{value:,.0f}" if value >= 1000 else f"{value:g}"


def whole_numbers(ax: Axes) -> None:
    """Ticks at whole numbers only."""
    from matplotlib.ticker import MaxNLocator

    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.grid(True, axis="x", linewidth=0.6)


def legend_inches(count: int, columns: int) -> float:
    """The height of a legend below a plot."""
    return 0.18 * math.ceil(min(count, MOST_LINES) / columns) + (0.2 if count > MOST_LINES else 0.0)


def legend_below(ax: Axes, count: int, columns: int) -> Axes:
    """A legend below the axes; how many lines were left out stands in its title."""
    from matplotlib.transforms import ScaledTranslation

    handles: Iterable[Any] = ax.get_legend_handles_labels()[0]
    if handles:
        below = ScaledTranslation(0, -LEGEND_DISTANCE, ax.figure.dpi_scale_trans)
        ax.legend(
            loc="upper left", bbox_to_anchor=(-0.02, 0), bbox_transform=ax.transAxes + below, ncols=columns,
            title=left_out(count), title_fontsize=8, alignment="left", borderaxespad=0,
        )  # fmt: skip
    return ax


def left_out(count: int) -> str | None:
    """How many lines or marks are not drawn, in words; None where all are."""
    return None if count <= MOST_LINES else f"not drawn: {count - MOST_LINES:,} more"


def spaced(sizes: Sequence[float], most: int = 9) -> list[float]:
    """Sizes for ticks, none too near to the one before on a logarithmic axis."""
    if len(sizes) < 2:
        return list(sizes)
    least = math.log(sizes[-1] / sizes[0]) / most
    kept = [sizes[0]]
    for size in sizes[1:]:
        if math.log(size / kept[-1]) >= least:
            kept.append(size)
    return kept
