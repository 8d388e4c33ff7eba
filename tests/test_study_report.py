"""Fits, comparisons, the page and the plots of a study's report."""

from __future__ import annotations

import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import linregress, t

from factored_polca.studies import Store, make_grid
from factored_polca.studies.fits import growth
from factored_polca.studies.limits import Limits
from factored_polca.studies.provenance import now, provenance
from factored_polca.studies.report_axes import DARK, LIGHT, plain_number, spaced
from factored_polca.studies.report_plots import file_name, plots, render
from factored_polca.studies.report_series import brief, compare

PNG = b"\x89PNG\r\n\x1a\n"
NASTY = "<b>$x^2$ & 'co'.toml"


# -- fits ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("power", "level"), [(2.0, 3.0), (0.0, 5.0), (-1.5, 0.1)])
def test_a_power_is_found(power: float, level: float) -> None:
    found = growth((x, level * x**power) for x in (2, 3, 5, 9))
    assert found is not None
    assert found.power.rate == pytest.approx(power, abs=1e-12)
    assert found.power.margin < 1e-10
    assert math.exp(found.power.level) == pytest.approx(level)
    assert found.power.at(7) == pytest.approx(level * 7**power)
    assert found.better is found.power


def test_an_exponential_is_found() -> None:
    found = growth((x, 3 * 2.0**x) for x in (4, 6, 7, 12))
    assert found is not None
    assert found.exponential.rate == pytest.approx(math.log(2))
    assert found.better is found.exponential
    assert found.better.text() == "2^n (2 to 2)"
    assert found.power.residual > 0.1


def test_the_uncertainty_is_that_of_a_linear_regression() -> None:
    """scipy's linregress computes the same from other formulas."""
    draw = np.random.default_rng(7)
    x = np.array([2.0, 3, 5, 8, 13, 21])
    y = 0.3 * x**1.7 * np.exp(draw.normal(0, 0.2, len(x)))
    found = growth(zip(x.tolist(), y.tolist(), strict=True))
    assert found is not None
    for fit, places in ((found.power, np.log(x)), (found.exponential, x)):
        theirs = linregress(places, np.log(y))
        assert fit.rate == pytest.approx(theirs.slope)
        assert fit.standard_error == pytest.approx(theirs.stderr)
        assert fit.level == pytest.approx(theirs.intercept)
        assert fit.margin == pytest.approx(theirs.stderr * t.ppf(0.975, 4))


def test_the_interval_holds_the_exponent_in_95_of_100_cases() -> None:
    draw, x, held = np.random.default_rng(11), np.array([1.0, 2, 4, 8, 16]), 0
    for _ in range(400):
        y = x**1.5 * np.exp(draw.normal(0, 0.3, len(x)))
        found = growth(zip(x.tolist(), y.tolist(), strict=True))
        assert found is not None
        held += abs(found.power.rate - 1.5) <= found.power.margin
    assert 363 <= held <= 397  # 380 ± four standard deviations of a binomial (4.4)


def test_seeds_count_once_by_their_median() -> None:
    single = growth([(1, 2.0), (2, 4.0), (4, 9.0)])
    several = growth([(1, 2.0), (2, 4.0), (4, 9.0), (4, 1.0), (4, 100.0), (2, 4.0)])
    assert single == several


def test_too_little_gives_no_fit() -> None:
    assert growth([]) is None
    assert growth([(1, 1.0), (2, 2.0), (2, 3.0)]) is None
    assert growth([(1, 1.0), (2, 2.0), (3, 0.0), (0, 4.0), (math.inf, 1.0), (4, math.nan)]) is None


# -- comparisons -----------------------------------------------------------------------------------


def made(path: Path, grids: list[dict[str, Any]], results: Any) -> Store:
    """A store whose results `results(run)` gives as (status, figures), or None for none."""
    store = Store(path, writing=True)
    told = provenance() | {"arguments": ["<run>"], "limits": {"seconds": 60, "memory_bytes": None}}
    runs = [run for grid in grids for run in make_grid(grid).runs({})]
    launch = store.launch(f"study {NASTY}", runs, told)
    for run in runs:
        found = results(run)
        if found is not None:
            status, figures = found
            store.record(launch, run, Limits(60, None), {
                "status": status, "message": "" if status == "ok" else f"bad {NASTY}", "stage": "done",
                "figures": figures, "started": now(), "finished": now(),
                "wall_seconds": figures.get("seconds", 1.0) + 0.1, "cpu_seconds": 1.0,
                "peak_memory_bytes": 10**8, "base_memory_bytes": 10**7,
                "supervisor": told | {"warm_seconds": {"diagrams": 0.5}},
            })  # fmt: skip
    return store


SOLVE = {
    "work": "solve",
    "model": ["tiger", NASTY],
    "solver": ["sarsop", "hsvi"],
    "gap": 0.1,
    "seed": [0, 1],
}
GROW = {"work": "minimise", "model": ["linear", "expon"], "set": {"size": [2, 4, 8, 16]}, "seed": [0, 1]}


def answer(run: Any) -> Any:
    """hsvi fails on seed 1, sarsop has no result for the second model's; growth n and 2^n."""
    if run.work == "solve":
        solver = dict(run.options)["solver"]
        if solver == "hsvi" and run.seed == 1:
            return "timeout", {}
        if solver == "sarsop" and run.seed == 1 and run.model == NASTY:
            return None
        return "ok", {"seconds": 1.0 + run.seed, "lower": 1.0, "upper": 2.0, "value": 1.5}
    size = float(dict(run.settings)["size"])
    blocks = size if run.model == "linear" else 2**size
    return "ok", {"seconds": 0.01 * size**1.5, "blocks": blocks, "states": str(2 ** int(size))}


@pytest.fixture
def store(tmp_path: Path) -> Any:
    with made(tmp_path / "s.sqlite", [SOLVE, GROW], answer) as opened:
        yield opened


def test_contenders_differ_in_solver_and_in_options_that_vary(store: Store) -> None:
    assert compare(store).contenders == ("solve sarsop", "solve hsvi", "minimise")


def test_coverage_counts_each_run_once(store: Store) -> None:
    counts = compare(store).coverage()
    assert counts["solve sarsop", "tiger"] == {"ok": 2, "timeout": 0, "memout": 0, "error": 0, "left": 0}
    assert counts["solve sarsop", NASTY] == {"ok": 1, "timeout": 0, "memout": 0, "error": 0, "left": 1}
    assert counts["solve hsvi", NASTY] == {"ok": 1, "timeout": 1, "memout": 0, "error": 0, "left": 0}
    assert sum(sum(c.values()) for c in counts.values()) == 8 + 16


def test_pairs_stand_on_the_same_instances(store: Store) -> None:
    (pair,) = compare(store).pairs()
    assert (pair.first, pair.second) == ("solve sarsop", "solve hsvi")
    assert [(a["model"], a["seed"], b["status"]) for a, b in pair.rows] == [
        ("tiger", 0, "ok"), ("tiger", 1, "timeout"), (NASTY, 0, "ok"),
    ]  # fmt: skip
    assert all(a["instance"] == b["instance"] for a, b in pair.rows)


def test_series_follow_one_parameter(store: Store) -> None:
    linear, expon = compare(store).series()
    assert (linear.model, linear.parameter, linear.contender) == ("linear", "size", "minimise")
    assert linear.points("blocks") == [(n, n) for n in (2, 2, 4, 4, 8, 8, 16, 16)]
    for one, kind in ((linear, "power"), (expon, "exponential")):
        found = one.growth("blocks")
        assert found is not None
        assert found.better.kind == kind
        seconds = one.growth("seconds")
        assert seconds is not None
        assert seconds.power.rate == pytest.approx(1.5)


def test_two_parameters_give_series_of_each_with_the_other_fixed(tmp_path: Path) -> None:
    grid = {"work": "m:f", "set": {"n": [1, 2, 3], "k": [1, 2, 4], "word": ["a", "b"]}}
    with made(tmp_path / "s.sqlite", [grid], lambda run: ("ok", {"seconds": 1.0})) as store:
        series = compare(store).series()
    assert len(series) == 2 * (3 + 3)
    assert {one.others for one in series if one.parameter == "n"} == {
        f"k={k}, word={word}" for k in (1, 2, 4) for word in "ab"
    }


# -- the page --------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Checks nesting, and gathers texts, tags and attributes."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "source"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def test_the_page_stands_alone_and_names_are_escaped(store: Store, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from factored_polca.studies.report import write_report

    path = write_report(store, tmp_path / "report")
    text = path.read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    assert page.open == []
    assert "<b>" not in text
    assert f"study {NASTY}" in "".join(page.texts)
    tags = {tag for tag, _ in page.tags}
    assert not tags & {"script", "link", "iframe", "object", "b"}
    for tag, attributes in page.tags:
        assert not any(name.startswith("on") for name in attributes)
        for name in ("src", "srcset", "href"):
            value = attributes.get(name)
            assert value is None or value.startswith("data:image/svg+xml;base64,"), tag
    assert "23 of 24 runs ended" in re.sub(r"<[^>]*>", "", text)
    assert "2^n (2 to 2)" in text
    names = sorted(p.name for p in path.parent.iterdir())
    assert names == ["cactus.png", "coverage.png", "growth-size.png", "index.html", "scatter.png"]
    assert all((path.parent / name).read_bytes().startswith(PNG) for name in names if name[-3:] == "png")


def test_a_study_without_results_has_a_page(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from factored_polca.studies.report import write_report

    with made(tmp_path / "s.sqlite", [GROW], lambda run: None) as store:
        page = write_report(store, tmp_path / "report").read_text(encoding="utf-8")
    assert "0 of 16 runs ended." in page


@pytest.mark.parametrize("count", [3, 60])
def test_nothing_is_cut_or_laid_over_something_else(tmp_path: Path, count: int) -> None:
    """Texts lie inside the picture; the legend of the axes meets neither their labels nor one another."""
    pytest.importorskip("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    models = [f"a model of a name that goes on {n}.toml" for n in range(count)]
    solvers = ["sarsop", "hsvi", "pbvi"]
    grids = [GROW | {"model": models}, SOLVE | {"model": models[:12], "solver": solvers}]
    with made(tmp_path / "s.sqlite", grids, answer) as store:
        found = list(plots(compare(store)))
    assert [plot.name for plot in found] == ["coverage", "cactus", "scatter", "growth-size"]
    for plot in found:
        figure = plot.make(LIGHT)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        renderer, whole = canvas.get_renderer(), figure.bbox
        for ax in figure.axes:
            if not ax.axison:
                continue
            boxes = [
                text.get_window_extent(renderer)
                for text in (ax.xaxis.label, ax.yaxis.label)
                if text.get_text()
            ]
            assert len(boxes) >= 1, f"{plot.name}: an axis has no name"
            ticks = [
                tick.label1.get_window_extent(renderer)
                for axis in (ax.xaxis, ax.yaxis)
                for tick in axis.get_major_ticks()
                if min(axis.get_view_interval()) <= tick.get_loc() <= max(axis.get_view_interval())
            ]
            assert len(ticks) >= 4
            legend = ax.get_legend()
            if legend is not None:
                boxes.append(legend.get_window_extent(renderer))
            for box in (*boxes, *ticks):
                assert box.x0 >= whole.x0 - 1, plot.name
                assert box.x1 <= whole.x1 + 1, plot.name
                assert box.y0 >= whole.y0 - 1, plot.name
                assert box.y1 <= whole.y1 + 1, plot.name
            for k, box in enumerate(boxes):
                assert not any(box.overlaps(other) for other in boxes[k + 1 :]), plot.name


def test_plots_come_in_both_themes(store: Store) -> None:
    pytest.importorskip("matplotlib")
    first = next(plots(compare(store)))
    light, dark = (render(first, theme, "svg").decode() for theme in (LIGHT, DARK))
    assert LIGHT.statuses["ok"] in light
    assert DARK.statuses["ok"] in dark
    assert light == render(first, LIGHT, "svg").decode()  # the same picture each time
    assert "<script" not in light


def test_names_and_numbers_on_axes() -> None:
    assert [plain_number(v) for v in (0.001, 0.5, 20, 3000, 1e8, 1e-6)] == [
        "0.001", "0.5", "20", "3,000", "1e+08", "1e-06"
    ]  # fmt: skip
    assert spaced([1.0, 2, 3, 4, 100, 101]) == [1, 2, 4, 100]
    assert spaced([3.0]) == [3]
    assert file_name("a/b ü") == "a_b__"
    assert brief("short") == "short"
    assert len(brief("x" * 100)) == 44
    assert brief("a\nb") == "a?b"
