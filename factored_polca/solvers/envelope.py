"""Upper envelopes of lines: the useful vectors of classes with two states, without linear programs.

A vector (v0, v1) is the line v0 + p (v1 - v0) over p = b(1) in [0, 1].  Sorted by slope, the lines of
the envelope follow from one pass over a stack (the planar convex hull, by duality; Andrew 1979).  The
envelope of the sums of two sets is the sum of their envelopes: at each breakpoint one side moves on,
so that at most n1 + n2 - 1 of the n1 * n2 sums are useful.

A last pass drops lines whose loss is at most the tolerance.  What is left is linear between its own
breakpoints, the full envelope convex, so that their distance is largest at such a breakpoint (or an
end), where it is checked against the full envelope: dropped lines do not add up.

Plain Python: a few dozen lines take less time here than loading compiled code.
"""

from __future__ import annotations

from bisect import bisect_right
from itertools import pairwise

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray

Line = tuple[float, float]


def envelope(vectors: FloatArray, tolerance: float) -> tuple[IntArray, FloatArray]:
    """Indices [n], ascending, of the useful vectors among `vectors` [m, 2], and a witness [n, 2] each."""
    order, starts = _hull(vectors)
    lines = [(float(vectors[k, 0]), float(vectors[k, 1])) for k in order]
    chosen, middles = _thinned(lines, starts, tolerance)
    return _sorted(np.array([order[k] for k in chosen], dtype=np.int64), middles)


def envelope_of_sums(
    left: FloatArray, right: FloatArray, tolerance: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """(l [n], r [n], witnesses [n, 2]) of the useful sums left[l] + right[r], by ascending (l, r)."""
    left_order, left_starts = _hull(left)
    right_order, right_starts = _hull(right)
    l, r, at = 0, 0, 0.0
    pairs, starts = [], []
    while True:
        pairs.append((left_order[l], right_order[r]))
        starts.append(at)
        next_left = left_starts[l + 1] if l + 1 < len(left_order) else 2.0
        next_right = right_starts[r + 1] if r + 1 < len(right_order) else 2.0
        at = min(next_left, next_right)
        if at > 1.0:
            break
        l, r = l + (next_left == at), r + (next_right == at)
    lines = [(float(left[a, 0] + right[b, 0]), float(left[a, 1] + right[b, 1])) for a, b in pairs]
    chosen, middles = _thinned(lines, starts, tolerance)
    numbers = np.array([pairs[k][0] * len(right) + pairs[k][1] for k in chosen], dtype=np.int64)
    numbers, witnesses = _sorted(numbers, middles)
    return numbers // len(right), numbers % len(right), witnesses


def _sorted(numbers: IntArray, middles: list[float]) -> tuple[IntArray, FloatArray]:
    order = np.argsort(numbers)
    p = np.array(middles)[order]
    return numbers[order], np.column_stack([1 - p, p])


def _hull(vectors: FloatArray) -> tuple[list[int], list[float]]:
    """The lines of the envelope from p = 0 to 1, and where each one starts to be the best."""
    slope = vectors[:, 1] - vectors[:, 0]
    order = np.lexsort((np.arange(len(vectors)), -vectors[:, 0], slope))
    slopes, heights = slope.tolist(), vectors[:, 0].tolist()
    hull: list[int] = []
    starts: list[float] = []
    for k in order.tolist():
        start = 0.0
        while hull:
            top = hull[-1]
            rise = slopes[k] - slopes[top]
            if rise <= 0:  # the same slope: the higher one came first
                start = 2.0
                break
            start = (heights[top] - heights[k]) / rise
            if start > starts[-1]:
                break
            hull.pop()
            starts.pop()
            start = 0.0
        if start < 1.0:
            hull.append(k)
            starts.append(max(start, 0.0))
    return hull, starts


def _thinned(lines: list[Line], starts: list[float], tolerance: float) -> tuple[list[int], list[float]]:
    """The places of lines that are worth more than the tolerance, and the middle of each one's stretch."""
    kept: list[int] = []
    for k in range(len(lines)):
        following = lines[k + 1] if k + 1 < len(lines) else None
        before = lines[kept[-1]] if kept else None
        p = _crossing(before, following)
        low = starts[kept[-1] + 1] if kept else 0.0
        high = starts[k + 1] if k + 1 < len(lines) else 1.0
        p = min(max(p, low), high)
        rest = max((_height(line, p) for line in (before, following) if line), default=-np.inf)
        if _height(lines[bisect_right(starts, p) - 1], p) - rest > tolerance:
            kept.append(k)
    bounds = [0.0] + [_crossing(lines[a], lines[b]) for a, b in pairwise(kept)] + [1.0]
    return kept, [min(max(0.5 * (a + b), 0.0), 1.0) for a, b in pairwise(bounds)]


def _height(line: Line, p: float) -> float:
    return (1 - p) * line[0] + p * line[1]


def _crossing(one: Line | None, other: Line | None) -> float:
    """Where the steeper `other` reaches `one`; the end 0 or 1 beside a line that is missing."""
    if one is None:
        return 0.0
    if other is None:
        return 1.0
    rise = (other[1] - other[0]) - (one[1] - one[0])
    return (one[0] - other[0]) / rise if rise > 0 else 0.0
