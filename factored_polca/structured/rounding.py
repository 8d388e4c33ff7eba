"""Merging the leaves of a float diagram within a known error (APRICODD; St-Aubin, Hoey & Boutilier 2000,
section 3: a range of values becomes one leaf).

The finite leaves of a diagram, sorted, are cut into groups from the smallest on: a group takes in every
leaf at most `width` above its smallest one.  No other grouping of that width has fewer groups.  Each group
becomes one leaf:

    down     its smallest value,   diagram - width <= rounded <= diagram
    up       its largest value,    diagram <= rounded <= diagram + width
    middle   the middle of both,   |rounded - diagram| <= width / 2

the distances but for the last bit of a leaf.  Infinite leaves stay what they are.  The error that is
answered is the largest distance of a leaf from its group's, computed from the floats themselves and rounded
up: it holds exactly.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import FLOAT, Diagram, node_count
from factored_polca.diagrams.manager import require
from factored_polca.diagrams.operations import Walk

Direction: TypeAlias = Literal["down", "middle", "up"]
FloatArray: TypeAlias = npt.NDArray[np.float64]
Int64Array: TypeAlias = npt.NDArray[np.int64]

HALVINGS: Final = 6
"""How often the interval in which the least width lies is halved, where nodes are counted."""


@dataclass(frozen=True)
class Rounded:
    """A diagram with fewer leaves: |diagram - original| <= error everywhere, `width` what was asked for."""

    diagram: Diagram
    error: float
    width: float
    leaves: int


def round_leaves(diagram: Diagram, width: float, direction: Direction = "middle") -> Rounded:
    """Merge leaves of a float diagram that lie at most `width` apart.

    Raises:
        ValueError: no float diagram, a width that is negative or no number, an unknown direction, or a
            leaf that is no number.
    """
    if not width >= 0:
        raise ValueError(f"leaves are merged within a width of 0 or more, not {width}")
    values = _checked_leaves(diagram, direction)
    return _rounded(diagram, values, np.argsort(values, kind="stable"), width, direction)


def round_to_size(
    diagram: Diagram,
    *,
    leaves: int | None = None,
    nodes: int | None = None,
    width: float = 0.0,
    direction: Direction = "middle",
) -> Rounded:
    """Merge leaves within the least width, but not less than `width`, that leaves at most so many of them
    or at most so many nodes (leaves included).

    The width is the least one for `leaves`, and near it for `nodes`.  Where no width is enough, because
    infinite leaves stay, the finite leaves become one.

    Raises:
        ValueError: see `round_leaves`; or a size below 1.
    """
    if not width >= 0:
        raise ValueError(f"leaves are merged within a width of 0 or more, not {width}")
    for size in (leaves, nodes):
        if size is not None and size < 1:
            raise ValueError(f"a diagram has at least one node, so {size} can't be asked for")
    values = _checked_leaves(diagram, direction)
    order = np.argsort(values, kind="stable")
    ascending = values[order]
    finite = ascending[np.isfinite(ascending)]
    infinite = len(ascending) - len(finite)
    if leaves is not None and len(finite) > 1:
        width = max(width, _width_for(finite, max(1, leaves - infinite), width))
    result = _rounded(diagram, values, order, width, direction)
    if nodes is None or node_count(result.diagram) <= nodes:
        return result
    if len(finite) < 2 or _span(finite) <= width:
        return result
    low, high = width, _span(finite)
    best = _rounded(diagram, values, order, high, direction)
    if node_count(best.diagram) > nodes:
        return best
    low = max(low, float(np.diff(finite).min()) / 2)  # below it nothing merges
    halvings = 0
    while halvings < HALVINGS:
        if high > 2 * low:  # first the magnitude
            middle = math.sqrt(low) * math.sqrt(high)
        else:
            middle, halvings = low + (high - low) / 2, halvings + 1
        tried = _rounded(diagram, values, order, middle, direction)
        if node_count(tried.diagram) <= nodes:
            best, high = tried, middle
        else:
            low = middle
    return best


def _checked_leaves(diagram: Diagram, direction: Direction) -> FloatArray:
    """The leaves by first occurrence."""
    if direction not in get_args(Direction):
        raise ValueError(f"no direction {direction!r}; there are {', '.join(get_args(Direction))}")
    require((diagram,), FLOAT)
    diagram.manager.safe_point()
    values = Walk(diagram).leaf_payloads().view(np.float64).copy()
    if np.isnan(values).any():
        raise ValueError("a leaf is no number; only numbers and infinities are merged")
    return values


def _width_for(finite: FloatArray, groups: int, least: float) -> float:
    """The least width of at most so many groups of ascending values: one of their differences."""
    values = finite.tolist()
    low, high = least, _span(finite)
    if fits(values, low, groups):
        return low
    while True:  # `low` is too little and `high` enough; halve the floats between them
        middle = low + (high - low) / 2
        if not low < middle < high:
            return high
        if fits(values, middle, groups):
            high = middle
        else:
            low = middle


def _span(finite: FloatArray) -> float:
    """A width that holds all ascending values."""
    return float(np.nextafter(finite[-1] - finite[0], np.inf))


def _rounded(
    diagram: Diagram, values: FloatArray, order: Int64Array, width: float, direction: Direction
) -> Rounded:
    """The diagram with the leaves `values`, which `order` sorts, merged."""
    ascending = values[order]
    first = group(ascending, width)
    count = len(first)
    if count == len(values):
        return Rounded(diagram, 0.0, width, count)
    sizes = np.diff(np.append(first, len(values)))
    last = first + sizes - 1
    low, high = ascending[first], ascending[last]
    if direction == "down":
        chosen = low
    elif direction == "up":
        chosen = high
    else:
        with np.errstate(invalid="ignore"):
            middles = low + (high - low) / 2
        chosen = np.where(low == high, low, middles)
    error = 0.0
    merged = low < high
    if merged.any():
        above = difference_above(high[merged], chosen[merged])
        below = difference_above(chosen[merged], low[merged])
        error = float(max(above.max(), below.max()))
    images = np.empty(len(values), dtype=np.float64)
    images[order] = np.repeat(chosen, sizes)
    diagram.manager.safe_point()
    walk = Walk(diagram)
    return Rounded(walk.with_leaves(images, FLOAT), error, width, count)


def difference_above(large: FloatArray, small: FloatArray) -> FloatArray:
    """large - small, rounded up (Knuth's exact error of a sum tells which way it was rounded)."""
    difference = large - small
    back = difference - large
    rest = (large - (difference - back)) - (small + back)
    return np.where(rest > 0, np.nextafter(difference, np.inf), difference)


def group(ascending: FloatArray, width: float) -> Int64Array:
    """Where groups of ascending values begin; infinities are groups of their own."""
    if len(ascending) == 0:
        return np.empty(0, dtype=np.int64)
    infinite = np.isinf(ascending)
    apart = (ascending[1:] > ascending[:-1] + width) | infinite[1:] | infinite[:-1]
    runs = np.append(0, np.flatnonzero(apart) + 1)
    last = np.append(runs[1:], len(ascending)) - 1
    long = runs[ascending[last] > ascending[runs] + width]
    if len(long) == 0:
        return runs
    values = ascending.tolist()
    starts = set(runs.tolist())
    ends = dict(zip(runs.tolist(), (last + 1).tolist(), strict=True))
    for run in long.tolist():
        at = run
        while at < ends[run]:
            starts.add(at)
            at = bisect_right(values, values[at] + width, at, ends[run])
    return np.array(sorted(starts), dtype=np.int64)


def fits(values: list[float], width: float, groups: int) -> bool:
    """Whether ascending finite values form at most so many groups."""
    at, count = 0, 0
    while at < len(values):
        count += 1
        if count > groups:
            return False
        at = bisect_right(values, values[at] + width, at)
    return True
