"""Small charts as SVG by attributes: lines over time, and histograms; for objects that show themselves.

Figures for papers are drawn with matplotlib (`factored_polca.display.plots`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from factored_polca.display.pictures import n, picture, text_element
from factored_polca.display.words import escape, number_text, text_width
from factored_polca.explicit.arrays import FloatArray

WIDTH: Final = 520.0
HEIGHT: Final = 220.0
SMALL: Final = 10.5

BLUE: Final = "#3a8fd0"
RED: Final = "#e2691f"
"""Between light and dark, so that thin lines are seen on both."""

MOST_POINTS: Final = 400


@dataclass(frozen=True)
class Series:
    """A line: its name, its points, its colour; a stepped one keeps its value until the next point."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    colour: str
    stepped: bool = False


def nice_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Round numbers between two others."""
    if not (math.isfinite(low) and math.isfinite(high)) or high <= low:
        return [low] if math.isfinite(low) else []
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(power * m for m in (1, 2, 5, 10) if power * m >= raw * (1 - 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]


@dataclass(frozen=True)
class Frame:
    """Where numbers stand in a chart."""

    low: tuple[float, float]
    high: tuple[float, float]
    left: float
    right: float
    top: float = 14.0
    bottom: float = 40.0

    def x(self, value: float) -> float:
        """A horizontal place."""
        return self.left + (value - self.low[0]) / (self.high[0] - self.low[0]) * (
            WIDTH - self.left - self.right
        )

    def y(self, value: float) -> float:
        """A vertical place."""
        room = HEIGHT - self.top - self.bottom
        return HEIGHT - self.bottom - (value - self.low[1]) / (self.high[1] - self.low[1]) * room


def line_chart(
    series: Sequence[Series],
    x_label: str,
    y_label: str,
    description: str,
    limits: tuple[float, float] | None = None,
) -> str:
    """Lines with their names at their ends; what lies beyond `limits` is drawn at the border."""
    points = [(x, y) for one in series for x, y in zip(one.x, one.y, strict=True) if math.isfinite(x + y)]
    if not points:
        return ""
    xs, ys = [x for x, _ in points], [y for _, y in points]
    low, high = _widened(*(limits or (min(ys), max(ys))))
    right = max(text_width(one.name, SMALL) for one in series) + 14
    frame = _frame((min(0.0, *xs), low), (max(xs) or 1.0, high), right)
    parts = _axes(frame, x_label, y_label)
    ends = []
    for one in series:
        drawn = [(x, min(max(y, low), high)) for x, y in _thinned(one) if math.isfinite(x + y)]
        places = [(frame.x(x), frame.y(y)) for x, y in drawn]
        if not places:
            continue
        steps = [f"{n(x)},{n(y)}" for x, y in (_stepped(places) if one.stepped else places)]
        parts.append(
            f'<polyline points="{" ".join(steps)}" fill="none" stroke="{one.colour}" stroke-width="1.8"/>'
        )
        ends.append((places[-1], one))
    for y, ((x, _), one) in zip(_apart([p[1] for p, _ in ends]), ends, strict=True):
        parts.append(text_element(x + 6, y + 4, one.name, SMALL, anchor="start"))
    return picture(WIDTH, HEIGHT, parts, description, alone=False)


def histogram(
    values: FloatArray, x_label: str, y_label: str, description: str, mean: float | None = None
) -> str:
    """How often values lie in intervals of equal width; a line at the mean."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return ""
    low, high = _widened(float(finite.min()), float(finite.max()), 0.0)
    counts, borders = np.histogram(
        finite, bins=min(30, max(5, int(math.sqrt(len(finite))))), range=(low, high)
    )
    frame = _frame((low, 0.0), (high, float(counts.max())), 14.0)
    parts = _axes(frame, x_label, y_label)
    for count, a, b in zip(counts.tolist(), borders, borders[1:], strict=False):
        if count:
            x, y = frame.x(float(a)), frame.y(count)
            parts.append(
                f'<rect x="{n(x + 0.5)}" y="{n(y)}" width="{n(frame.x(float(b)) - x - 1)}" '
                f'height="{n(frame.y(0) - y)}" fill="{BLUE}" fill-opacity="0.55"/>'
            )
    if mean is not None and low <= mean <= high:
        at = n(frame.x(mean))
        parts.append(
            f'<line x1="{at}" y1="{n(frame.top)}" x2="{at}" y2="{n(frame.y(0))}" stroke="{RED}" '
            f'stroke-width="1.6"><title>{escape(f"mean {number_text(mean)}")}</title></line>'
        )
    return picture(WIDTH, HEIGHT, parts, description, alone=False)


def _widened(low: float, high: float, share: float = 0.04) -> tuple[float, float]:
    room = (high - low) * share if high > low else max(1.0, abs(low)) * 0.5
    return low - room, high + room


def _frame(low: tuple[float, float], high: tuple[float, float], right: float) -> Frame:
    labels = [number_text(tick) for tick in nice_ticks(low[1], high[1])]
    left = max((text_width(label, SMALL) for label in labels), default=0.0) + 30
    return Frame(low, high, left, max(right, 20.0))


def _axes(frame: Frame, x_label: str, y_label: str) -> list[str]:
    parts = []
    left, right, bottom = frame.left, WIDTH - frame.right, HEIGHT - frame.bottom
    for tick in nice_ticks(frame.low[1], frame.high[1]):
        y = n(frame.y(tick))
        ends = f'x1="{n(left)}" y1="{y}" x2="{n(right)}" y2="{y}"'
        parts.append(f'<line {ends} stroke="currentColor" stroke-opacity="0.15"/>')
        parts.append(text_element(left - 5, frame.y(tick) + 4, number_text(tick), SMALL, anchor="end"))
    for tick in nice_ticks(frame.low[0], frame.high[0]):
        parts.append(text_element(frame.x(tick), bottom + 15, number_text(tick), SMALL))
    parts.append(
        f'<line x1="{n(left)}" y1="{n(bottom)}" x2="{n(right)}" y2="{n(bottom)}" stroke="currentColor" '
        'stroke-opacity="0.6"/>'
    )
    parts.append(text_element((left + right) / 2, HEIGHT - 8, x_label, SMALL))
    middle = (frame.top + bottom) / 2
    turned = f'transform="rotate(-90 12 {n(middle)})"'
    parts.append(text_element(12, middle + 4, y_label, SMALL).replace("<text ", f"<text {turned} ", 1))
    return parts


def _thinned(one: Series) -> list[tuple[float, float]]:
    points = list(zip(one.x, one.y, strict=True))
    if len(points) <= MOST_POINTS:
        return points
    kept = np.unique(np.linspace(0, len(points) - 1, MOST_POINTS).astype(int)).tolist()
    return [points[k] for k in kept]


def _stepped(places: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    found = [places[0]]
    for x, y in places[1:]:
        found += [(x, found[-1][1]), (x, y)]
    return found


def _apart(places: Sequence[float], room: float = 13.0) -> list[float]:
    """Vertical places of names, moved apart where they would overlap."""
    order = sorted(range(len(places)), key=places.__getitem__)
    result = list(places)
    for above, below in pairwise(order):
        result[below] = max(result[below], result[above] + room)
    over = max((result[k] for k in order), default=0.0) - (HEIGHT - 44.0)
    return [y - over if over > 0 else y for y in result]
