"""Figure 4c as a picture: what each method stores, and the learning curves, for Taxi and for Taxi2."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from factored_polca.studies.q_values import COUNTS, QValueStudy, TaxiStudy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS: Final = {  # Okabe & Ito's, and a grey
    "Q-learning": "#8c8c8c", "HSMQ": "#56b4e9", "options": "#cc79a7", "MAXQ, no abstraction": "#0072b2",
    "MAXQ, by hand": "#d55e00", "ALisp": "#009e73", "PolCA": "#e69f00",
}  # fmt: skip

WIDTH, HEIGHT = 12.0, 8.4
"""Inches."""

DEPTH: Final = 60.0
"""How far below the optimum the curves are shown."""


def fill_figure(study: QValueStudy, figure: Figure) -> None:
    """Draw each domain in a row: bars, and curves beside them, whose legend stands below all."""
    places = figure.subplots(len(study.domains), 2, width_ratios=(1, 1))
    for number, domain in enumerate(study.domains):
        draw_stored_values(domain, places[number][0])
        draw_learning_curves(domain, places[number][1], study.close)
    handles, labels = places[0][1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)


def draw_stored_values(study: TaxiStudy, ax: Axes) -> Axes:
    """A bar for each method, on a logarithmic scale; of learners the part that was visited is darker.

    PolCA has one set of bars where its counts do not depend on the discount.
    """
    bars = [(one.method.name, one.method.stored_values, one.visited) for one in study.learned]
    colours = [COLOURS[name] for name, _, _ in bars]
    alike = len({one.counts for one in study.polca}) == 1
    for one in study.polca[:1] if alike else study.polca:
        suffix = "" if alike else f", γ = {float(one.discount):g}"
        for field, text in COUNTS:
            count = getattr(one.counts, field)
            bars.append((f"PolCA, {text}{suffix}", count, count))
            colours.append(COLOURS["PolCA"])
    place = np.arange(len(bars))[::-1]
    ax.barh(place, [allocated for _, allocated, _ in bars], 0.72, color=colours, alpha=0.45)
    ax.barh(place, [visited for _, _, visited in bars], 0.72, color=colours)
    for y, (_, allocated, _) in zip(place, bars, strict=True):
        ax.annotate(
            f"{allocated:,}", (allocated, y), xytext=(4, 0), textcoords="offset points", va="center"
        )
    ax.set_xscale("log")
    ax.set_xlim(100, 6 * max(allocated for _, allocated, _ in bars))
    ax.set_yticks(place, [name for name, _, _ in bars])
    ax.tick_params(axis="y", length=0)
    ax.set_xlabel("stored values (of learners dark: visited)")
    note = " and ".join(f"{float(one.discount):g}" for one in study.polca)
    ax.set_title(
        f"{study.title}: {study.live_states:,} non-terminal states; PolCA at γ = {note}", loc="left"
    )
    return _tidy(ax, "x")


def draw_learning_curves(study: TaxiStudy, ax: Axes, close: float) -> Axes:
    """Mean return of the training episodes; above, where each greedy policy has come close for good."""
    optimum, top = study.optimum, study.optimum + 0.28 * DEPTH
    for one in study.learned:
        ax.plot(
            one.checkpoints, np.maximum(one.training_returns, optimum - 2 * DEPTH),
            color=COLOURS[one.method.name], linewidth=1.5, label=one.method.name,
        )  # fmt: skip
    ax.axhline(optimum, color="#404040", linewidth=0.8, linestyle="--", label="optimum")
    for number, one in enumerate(study.learned):
        there = one.episodes_to(close)
        if there is not None:
            height = optimum + 0.24 * DEPTH * (number + 1) / len(study.learned)
            ax.plot(
                [there],
                [height],
                marker="o",
                markersize=5,
                color=COLOURS[one.method.name],
                linestyle="none",
            )
    ax.annotate(
        f"greedy policy\nwithin {close:.0%} from here on:", (0.02, (optimum + top) / 2),
        xycoords=("axes fraction", "data"), va="center", fontsize=9,
    )  # fmt: skip
    ax.set_xscale("log")
    ax.set_xlim(min(10, study.episodes / 2), study.episodes)
    ax.set_yticks(np.arange(np.ceil((optimum - DEPTH) / 10) * 10, optimum, 10))  # none beside the dots
    ax.set_ylim(optimum - DEPTH, top)
    ax.set_xlabel("episodes")
    ax.set_ylabel("mean return of an episode")
    ax.set_title(f"{study.title}: learning at γ = 1, exploration included", loc="left")
    return _tidy(ax, "y")


def _tidy(ax: Axes, axis: Literal["x", "y"]) -> Axes:
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    ax.grid(axis=axis, color="#e4e4e4", linewidth=0.7)
    ax.set_axisbelow(True)
    return ax
