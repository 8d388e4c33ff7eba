"""A plot of blocks against what merging near states loses, guaranteed and measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

from factored_polca.display.plots import axes, colour_of, tidy
from factored_polca.hierarchy.trade_off import TradeOff

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LEAST: Final = 1e-6
"""Shares of the optimum below this are drawn as this."""


def plot_trade_off(series: Mapping[str, Sequence[TradeOff]], ax: Axes | None = None) -> Axes:
    """Losses of the polled policy, as shares of the flat optimum, against the blocks of all tasks.

    A full line through what is guaranteed, a broken one through what was measured, for each named series;
    points without an optimum are left out.

    Raises:
        MissingLibrary: matplotlib is not installed.
    """
    ax = axes(ax)
    for number, (name, points) in enumerate(series.items()):
        colour = colour_of(name, number)
        shown = [point for point in points if point.optimum]
        for key, style, marker, what in (
            ("loss", "-", "o", "at most"),
            ("measured", "--", "x", "measured"),
        ):
            places = [
                (point.blocks, max(getattr(point, key) / abs(point.optimum or 1.0), LEAST))
                for point in shown
                if getattr(point, key) is not None
            ]
            ax.plot(
                [x for x, _ in places], [y for _, y in places], style, marker=marker, color=colour,
                linewidth=1.6, markersize=5, label=f"{name}, {what}",
            )  # fmt: skip
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("blocks of all tasks")
    ax.set_ylabel("loss (share of the optimal value)")
    return tidy(ax, legend="best")
