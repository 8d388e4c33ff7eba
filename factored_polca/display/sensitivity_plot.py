"""The optimal value as a function of one parameter, as a curve, or of two, as a map.

Needs matplotlib, the extra `[viz]`.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Final

import numpy as np

from factored_polca.display.extras import library
from factored_polca.display.plots import CYCLE, GRID, axes, tidy
from factored_polca.display.words import short
from factored_polca.parametric.sensitivity import Sensitivity

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DOTS_PER_INCH: Final = 150

MOST_CHANGES: Final = 40
"""Changes of the optimal policy up to which they are marked."""

VISIBLE: Final = 5e-3
"""Width of bounds from which they are drawn, as a share of the range of values."""


def plot_sensitivity(found: Sensitivity, ax: Axes | None = None, *, title: str = "") -> Axes:
    """The value against a parameter, or over two parameters.

    On a curve, bounds that are wide enough to be seen are shaded, and dotted lines mark where the optimal
    policy changes.  Settings that are not admissible are left blank.

    Raises:
        ValueError: the settings vary none or more than two parameters.
    """
    if len(found.parameters) == 1:
        return _curve(found, ax, title)
    if len(found.parameters) == 2:
        return _map(found, ax, title)
    raise ValueError(f"{len(found.parameters)} parameters vary; one or two can be drawn")


def picture(found: Sensitivity, title: str, kind: str) -> bytes:
    """The plot as a file of the given kind, "png" or "svg", the same for the same points.

    Raises:
        MissingLibrary: matplotlib is not installed.
    """
    figures = library("matplotlib.figure", "viz", "drawing")
    two = len(found.parameters) == 2
    figure = figures.Figure(figsize=(6.4, 4.8) if two else (7.0, 4.2), layout="constrained")
    plot_sensitivity(found, figure.subplots(), title=title)
    data = io.BytesIO()
    metadata = {"Software": None} if kind == "png" else {"Date": None, "Creator": None}
    figure.savefig(data, format=kind, dpi=DOTS_PER_INCH, metadata=metadata)
    return data.getvalue()


def _curve(found: Sensitivity, ax: Axes | None, title: str) -> Axes:
    ax = axes(ax)
    (name,) = found.parameters
    points = sorted(found.points, key=lambda point: point.setting[name])
    x = np.array([float(point.setting[name]) for point in points])
    values = np.array([point.value for point in points])
    lower, upper = (np.array([getattr(point, side) for point in points]) for side in ("lower", "upper"))
    finite = values[np.isfinite(values)]
    span = float(np.ptp(finite)) if len(finite) else 0.0
    if len(finite) and np.nanmax(upper - lower) > VISIBLE * span:
        ax.fill_between(x, lower, upper, color=CYCLE[0], alpha=0.2, linewidth=0, label="bounds")
    marker = "o" if len(points) <= 60 else ""
    ax.plot(x, values, color=CYCLE[0], linewidth=1.8, marker=marker, markersize=3, label="optimal value")
    changes = [
        0.5 * (x[k] + x[k + 1])
        for k in range(len(points) - 1)
        if points[k].policy >= 0 and points[k + 1].policy >= 0 and points[k].policy != points[k + 1].policy
    ]
    for number, place in enumerate(changes if len(changes) <= MOST_CHANGES else []):
        label = "another policy is optimal" if number == 0 else None
        ax.axvline(place, color=GRID, alpha=0.7, linewidth=0.9, linestyle=":", label=label)
    ax.margins(x=0.01)
    ax.set_xlabel(short(name))
    ax.set_ylabel("value from the start")
    ax.set_title(title, loc="left")
    return tidy(ax, legend="best" if len(ax.get_legend_handles_labels()[0]) > 1 else None)


def _map(found: Sensitivity, ax: Axes | None, title: str) -> Axes:
    ax = axes(ax, 6.4, 4.8)
    first, second = found.parameters
    across = sorted({point.setting[first] for point in found.points})
    up = sorted({point.setting[second] for point in found.points})
    column, row = ({value: number for number, value in enumerate(side)} for side in (across, up))
    values = np.full((len(up), len(across)), np.nan)
    for point in found.points:
        values[row[point.setting[second]], column[point.setting[first]]] = point.value
    mesh = ax.pcolormesh(
        [float(value) for value in across], [float(value) for value in up], values, cmap="viridis",
        shading="nearest", rasterized=True,
    )  # fmt: skip
    ax.figure.colorbar(mesh, ax=ax, label="value from the start")
    ax.set_xlabel(short(first))
    ax.set_ylabel(short(second))
    ax.set_title(title, loc="left")
    tidy(ax)
    ax.grid(visible=False)
    return ax
