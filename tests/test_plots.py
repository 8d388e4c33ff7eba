"""Plots: what is drawn where, units on axes, fitted exponents; nothing is shown, given axes are kept."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import factored_polca as fp
from factored_polca.solvers.pomdp_result import Bounds, POMDPSolution
from factored_polca.solvers.result import Guarantee

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("agg")

from matplotlib import pyplot  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402

from factored_polca.display import plots  # noqa: E402


@pytest.fixture(autouse=True)
def nothing_is_shown(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(pyplot, "show", lambda *_, **__: pytest.fail("a plot was shown"))
    before = dict(matplotlib.rcParams)
    yield
    assert dict(matplotlib.rcParams) == before
    pyplot.close("all")


def solution(*bounds: tuple[float, float, float]) -> POMDPSolution:
    history = tuple(Bounds(*b) for b in bounds)
    last = history[-1]
    return POMDPSolution(
        last.lower, last.upper, last.lower, None, np.array([]), np.array([]), "converged",  # type: ignore[arg-type]
        Guarantee("bounds", ""), "m", 1, 1, 4.0, history,
    )  # fmt: skip


def texts(ax: Any) -> list[str]:
    return [text.get_text() for text in ax.figure.findobj(matplotlib.text.Text)]


def test_bounds_are_steps_against_seconds_up_to_the_end() -> None:
    ax = plots.plot_bounds(solution((0.5, 1, 9), (2, 3, 5)), label="SARSOP")
    lines = {line.get_label(): line.get_xydata().tolist() for line in ax.lines}
    assert lines["SARSOP lower"] == [[0.5, 1], [2, 3], [4, 3]]
    assert lines["SARSOP upper"] == [[0.5, 9], [2, 5], [4, 5]]
    assert "seconds" in ax.get_xlabel()
    assert "value" in ax.get_ylabel()


def test_given_axes_are_drawn_on_and_answered_and_no_figure_is_made() -> None:
    before = pyplot.get_fignums()
    ax = Figure().add_subplot()
    assert plots.plot_bounds(solution((0, 1, 2)), ax) is ax
    assert plots.plot_growth([1, 2], {"a": [1.0, 2.0]}, ax) is ax
    assert plots.figure_4c([("a", 1)], ax) is ax
    assert plots.learning_curves({"a": ([0, 1], [0, 1])}, ax) is ax
    assert pyplot.get_fignums() == before


@pytest.mark.parametrize(("exponent", "factor"), [(1.0, 2.0), (0.5, 3.0), (2.25, 0.125)])
def test_the_exponent_of_a_power_law_is_found(exponent: float, factor: float) -> None:
    sizes = [2.0, 10.0, 64.0, 5000.0]
    values = [factor * n**exponent for n in sizes]
    assert plots.fitted_exponent(sizes, values) == pytest.approx((exponent, factor))
    powers = [2**1000, 2**2000, 2**3000]  # more than a float holds
    assert plots.fitted_exponent(powers, [2.0, 4.0, 8.0])[0] == pytest.approx(0.001)


@pytest.mark.parametrize(("sizes", "values"), [([1, 1], [1, 2]), ([1, 2], [0, 1]), ([], [])])
def test_no_exponent_is_made_up(sizes: list[float], values: list[float]) -> None:
    with pytest.raises(ValueError, match="two different sizes"):
        plots.fitted_exponent(sizes, values)


def test_growth_is_log_log_with_exponents_in_the_legend() -> None:
    """2^10 .. 2^1000 states: more than a float holds; blocks n^(1/10)."""
    powers = [10, 100, 1000]
    blocks = [2.0 ** (p / 10) for p in powers]
    ax = plots.plot_growth(
        [2**p for p in powers], {"linear": blocks, "cut": [1.0, float("nan"), float("nan")]}
    )
    shown = [text.get_text() for text in ax.get_legend().get_texts()]
    assert shown == ["linear  ~ n^0.10", "cut"]
    points = next(line for line in ax.lines if line.get_label().startswith("linear"))
    assert points.get_xdata().tolist() == pytest.approx([p * np.log10(2) for p in powers])
    ax.figure.canvas.draw()
    ticks = [label.get_text() for label in ax.get_xticklabels()]
    assert all(tick.startswith("$10^{") for tick in ticks)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("states", "blocks")


def tiger_trace() -> fp.Trace:
    plan = fp.executable_pomdp(fp.plan(fp.load_domain("tiger").model))  # type: ignore[arg-type]
    return fp.trace(plan, steps=6, seed=3)


def test_a_belief_over_time_is_stacked_to_one() -> None:
    found = tiger_trace()
    ax = plots.plot_belief(found)
    assert ax.get_ylim() == (0, 1)
    assert "probability of tiger" in ax.get_ylabel()
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["left", "right"]
    top = ax.collections[-1].get_paths()[0].vertices[:, 1]
    assert top.max() == pytest.approx(1.0)
    dots = [line for line in ax.lines if line.get_marker() == "o"]
    assert len(dots) == 7  # a true value at each step, and one after the last
    for step, dot in zip(found.steps, dots, strict=False):
        left = step.beliefs["tiger"][0]
        assert bool(dot.get_ydata()[0] < left) is (step.state["tiger"] == "left")
    assert [label.get_text() for label in ax.get_xticklabels()] == [step.action for step in found.steps]
    with pytest.raises(KeyError, match="no belief about 'x'"):
        plots.plot_belief(found, "x")


def test_a_trace_without_beliefs_has_none_to_plot() -> None:
    domain = fp.load_domain("toy")
    plan = fp.executable(fp.plan(domain.model))  # type: ignore[arg-type]
    with pytest.raises(KeyError, match="state is seen"):
        plots.plot_belief(fp.trace(plan, steps=2))


def test_figure_4a_has_a_bar_for_each_known_count() -> None:
    counts = [
        ("a", {"none": 13_200, "polca": 210, "polca_plus": 813}),
        ("b", {"none": None, "polca": 9, "polca_plus": 12}),
    ]
    ax = plots.figure_4a(counts, title="nursebot")
    assert sorted(bar.get_height() for bar in ax.patches) == [9, 12, 210, 813, 13_200]
    assert ax.get_yscale() == "log"
    assert {"13k", "210", "nursebot", "parameters (non-zero entries)"} <= set(texts(ax))


def test_figure_4b_has_bands_of_one_standard_error() -> None:
    ax = plots.figure_4b(
        {"PolCA+": ([1.0, 2.0, 3.0], [0.5, 0.5, 1.0]), "QMDP": ([1.0, 1.0, 1.0], [0.1, 0.1, 0.1])}
    )
    band = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == (0.5, 4.0)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("steps", "cumulative reward")
    assert {"PolCA+", "QMDP"} <= set(texts(ax))


def test_figure_4c_has_a_bar_for_each_method_with_its_count() -> None:
    counts = [("flat Q-learning", 3000), ("MAXQ, no abstraction", 14_000), ("PolCA", 528)]
    ax = plots.figure_4c(counts)
    assert [bar.get_width() for bar in ax.patches] == [3000, 14_000, 528]
    tops = [bar.get_y() for bar in ax.patches]
    assert tops == sorted(tops, reverse=True)
    assert {"3,000", "14,000", "528"} <= set(texts(ax))
    assert "values stored" in ax.get_xlabel()


def test_learning_curves_have_names_at_their_ends_and_the_optimum() -> None:
    curves = {"Q": ([0, 100], [-5.0, 3.8]), "MAXQ": ([0, 100], [-9.0, 3.81])}
    ax = plots.learning_curves(curves, optimum=3.857, bands={"Q": ([-6, 3], [-4, 4])})
    assert ax.get_xlabel() == "episodes"
    assert {"Q", "MAXQ", "optimum"} <= set(texts(ax))
    heights = [note.xy[1] for note in ax.texts if note.get_text() in curves]
    low, high = ax.get_ylim()
    assert abs(heights[0] - heights[1]) > 0.05 * (high - low)


def test_without_matplotlib_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> Any:
        raise ImportError(name)

    monkeypatch.setattr("factored_polca.display.extras.import_module", missing)
    with pytest.raises(
        ImportError, match=r"needs matplotlib, which is not installed: pip install 'factored-polca\[viz\]'"
    ):
        plots.plot_bounds(solution((0, 1, 2)))


def test_loading_the_plots_loads_no_matplotlib() -> None:
    code = "import sys, factored_polca.display.plots; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
