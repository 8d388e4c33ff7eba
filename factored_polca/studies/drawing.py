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
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from factored_polca.formats import destination
from factored_polca.studies.parameters import ParameterStudy, Reading
from factored_polca.studies.perturbations import PerturbationStudy
from factored_polca.studies.rewards import PAIRS, RewardStudy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS: Final = {  # Okabe & Ito's, which the colour-blind tell apart
    "none": "#8c8c8c", "polca": "#e69f00", "polca_plus": "#0072b2",
    "PolCA+": "#0072b2", "PolCA": "#e69f00", "QMDP": "#d55e00", "SARSOP": "#009e73",
}  # fmt: skip

READINGS: Final[tuple[tuple[Reading, str], ...]] = (
    ("none", "no abstraction"),
    ("polca", "PolCA"),
    ("polca_plus", "PolCA+"),
)

DOTS_PER_INCH: Final = 150


class MissingLibrary(Exception):
    """A library of an optional extra is not installed; the message says how to install it."""


def require_matplotlib() -> None:
    """Find out before the work whether it can be drawn.

    Raises:
        MissingLibrary: matplotlib is not installed.
    """
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise MissingLibrary(
            "drawing needs matplotlib, which is not installed: pip install 'factored-polca[viz]'"
        ) from None


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
    names = [*(task.name for task in study.tasks), "all"]
    places, width = np.arange(len(names)), 0.27
    for number, (reading, label) in enumerate(READINGS):
        counts = [*(getattr(task, reading) for task in study.tasks), study.total(reading)]
        known = [k for k, count in enumerate(counts) if count]
        if not known:
            continue
        heights = [counts[k] for k in known]
        bars = ax.bar(
            places[known] + (number - 1) * width, heights, 0.92 * width, color=COLOURS[reading], label=label
        )
        ax.bar_label(bars, [_short(n) for n in heights], fontsize=7, color="#404040", padding=1.5)
    ax.set_yscale("log")
    _, high = ax.get_ylim()
    ax.set_ylim(10, 2 * high)
    ax.axvline(len(names) - 1.5, color="#c0c0c0", linewidth=0.8)
    ax.set_xticks(places, names)
    ax.tick_params(axis="x", length=0)
    ax.set_ylabel("parameters (non-zero entries)")
    ax.set_title(f"{study.model}: parameters of the tasks' models", loc="left")
    return _tidy(ax, legend="upper left", columns=3)


def draw_rewards(study: RewardStudy, ax: Axes) -> Axes:
    """Figure 4b: mean cumulative reward by time, in a band of one standard error on either side."""
    time = np.arange(1, study.steps + 1)
    for one in study.earned:
        colour = COLOURS[one.name]
        ax.plot(time, one.cumulative, color=colour, linewidth=1.6, label=one.name)
        low, high = one.cumulative - one.cumulative_error, one.cumulative + one.cumulative_error
        ax.fill_between(time, low, high, color=colour, alpha=0.25, linewidth=0)
    ax.axhline(0, color="#c0c0c0", linewidth=0.8, zorder=0)
    ax.set_xlim(0, study.steps)
    _name_curves(study, ax)
    ax.set_xlabel("steps")
    ax.set_ylabel("cumulative reward")
    ax.set_title(
        f"{study.model}: cumulative reward, mean ± standard error of {study.episodes:,} episodes",
        loc="left",
    )
    return _tidy(ax)


def _name_curves(study: RewardStudy, ax: Axes) -> None:
    """The names of the curves at their right ends, moved apart where they would overlap."""
    low, high = ax.get_ylim()
    room = 0.055 * (high - low)
    ends = sorted(study.earned, key=lambda one: float(one.cumulative[-1]))
    levels = [float(one.cumulative[-1]) for one in ends]
    for k in range(1, len(levels)):
        levels[k] = max(levels[k], levels[k - 1] + room)
    ceiling = high
    for k in reversed(range(len(levels))):
        levels[k] = min(levels[k], ceiling)
        ceiling = levels[k] - room
    for one, level in zip(ends, levels, strict=True):
        ax.annotate(
            one.name, (1, level), xycoords=("axes fraction", "data"), xytext=(5, 0),
            textcoords="offset points", color=COLOURS[one.name], va="center", fontweight="bold",
        )  # fmt: skip


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
    return _tidy(ax, legend="upper left", columns=len(PAIRS))


def _tidy(ax: Axes, legend: Literal["upper left"] | None = None, columns: int = 1) -> Axes:
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    ax.grid(axis="y", color="#e4e4e4", linewidth=0.7)
    ax.set_axisbelow(True)
    if legend is not None:
        ax.legend(loc=legend, frameon=False, ncols=columns, fontsize=9)
    return ax


def _short(count: int) -> str:
    """A count in two or three digits."""
    if count < 1000:
        return f"{count}"
    return f"{count / 1000:.1f}k" if count < 10_000 else f"{count / 1000:.0f}k"
