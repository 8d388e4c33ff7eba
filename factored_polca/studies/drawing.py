"""Drawings of studies.  matplotlib is an optional extra: it is loaded when something is drawn.

Functions called `draw_*` take axes, draw a study there, and answer the axes; nothing is shown on a screen.
`write_drawing` makes a PNG file, which appears whole or not at all.
"""

from __future__ import annotations

import io
import os
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from factored_polca.display.extras import MissingLibrary, library
from factored_polca.display.plots import COLOURS, figure_4a, figure_4b, tidy
from factored_polca.formats import destination
from factored_polca.studies.parameters import ParameterStudy, Reading
from factored_polca.studies.perturbations import PerturbationStudy
from factored_polca.studies.rewards import PAIRS, RewardStudy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "MissingLibrary", "draw_parameters", "draw_perturbations", "draw_rewards", "require_matplotlib",
    "write_drawing",
]  # fmt: skip

ALL_READINGS: Final[tuple[Reading, ...]] = ("none", "polca", "polca_plus")

DOTS_PER_INCH: Final = 150


def require_matplotlib() -> None:
    """Find out before the work whether it can be drawn.

    Raises:
        MissingLibrary: matplotlib is not installed.
    """
    library("matplotlib.figure", "viz", "drawing")


def write_drawing(
    path: str | Path, draw: Callable[[Axes], Axes], *, width: float = 8.0, height: float = 4.5
) -> None:
    """Write what `draw` draws as a PNG of so many inches; a file that is there stays until then.

    Raises:
        MissingLibrary: matplotlib is not installed.
        ModelError: no such folder, or no regular file in the file's place.
        OSError: the file can't be written.
    """
    write_figure(path, lambda figure: draw(figure.add_subplot()), width=width, height=height)


def write_figure(
    path: str | Path, fill: Callable[[Figure], object], *, width: float, height: float
) -> None:
    """Write a figure of several drawings, which `fill` makes, as a PNG; else like `write_drawing`.

    Raises:
        MissingLibrary: matplotlib is not installed.
        ModelError: no such folder, or no regular file in the file's place.
        OSError: the file can't be written.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    target = destination(path)
    figure = Figure(figsize=(width, height), layout="constrained")
    fill(figure)
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None})
    temporary = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.part")
    try:
        temporary.write_bytes(data.getvalue())
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def draw_parameters(study: ParameterStudy, ax: Axes) -> Axes:
    """Figure 4a: bars on a logarithmic scale, three for each task and for all together."""
    counts: list[tuple[str, dict[str, int | None]]] = [
        (task.name, {"none": task.none, "polca": task.polca, "polca_plus": task.polca_plus})
        for task in study.tasks
    ]
    counts.append(("all", {reading: study.total(reading) for reading in ALL_READINGS}))
    figure_4a(counts, ax, title=f"{study.model}: parameters of the tasks' models")
    ax.axvline(len(counts) - 1.5, color="#c0c0c0", linewidth=0.8)
    return ax


def draw_rewards(study: RewardStudy, ax: Axes) -> Axes:
    """Figure 4b: mean cumulative reward by time, in a band of one standard error on either side."""
    curves = {one.name: (one.cumulative.tolist(), one.cumulative_error.tolist()) for one in study.earned}
    episodes = f"mean ± standard error of {study.episodes:,} episodes"
    return figure_4b(curves, ax, title=f"{study.model}: cumulative reward, {episodes}")


def draw_perturbations(study: PerturbationStudy, ax: Axes) -> Axes:
    """The paired differences of the policies for each seed, with two standard errors on either side."""
    pairs = [(d.first, d.second) for d in study.runs[0].differences]
    for number, pair in enumerate(pairs):
        mine = [run.differences[number] for run in study.runs]
        places = np.array([run.seed for run in study.runs]) + 0.24 * (number - (len(pairs) - 1) / 2)
        ax.errorbar(
            places, [d.mean for d in mine], yerr=[2 * d.standard_error for d in mine], fmt="o",
            markersize=4, linewidth=1.2, color=COLOURS[pair[0]], label=f"{pair[0]} − {pair[1]}",
        )  # fmt: skip
    ax.axhline(0, color="#808080", linewidth=0.8, zorder=0)
    ax.set_xticks([run.seed for run in study.runs])
    ax.tick_params(axis="x", labelsize=8)
    ax.set_xlim(0, len(study.runs) + 1)
    low, high = ax.get_ylim()
    ax.set_ylim(low, high + 0.12 * (high - low))  # room for the legend
    ax.set_xlabel("seed of the perturbed numbers")
    ax.set_ylabel("difference in discounted return")
    ax.set_title(
        f"{study.model}, all numbers changed by up to {float(study.share):.0%}: paired differences ± 2 "
        "standard errors",
        loc="left",
    )
    return tidy(ax, legend="upper left", columns=len(PAIRS))
