"""The compiled Bellman backup that every iterative solver here calls.

One kernel serves as Jacobi pass (`out` is another array than `values`) and as Gauss-Seidel pass (the
same array), over all pairs or over those of one policy (`Pairs.select`).  Each call is one pass, so
that Python sees Ctrl-C and deadlines between passes.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.pairs import Pairs


def _backup(
    values: Any,
    out: Any,
    choice: Any,
    start: Any,
    row: Any,
    successor: Any,
    probability: Any,
    reward: Any,
    discount: float,
    backward: bool,
) -> tuple[float, float]:
    """out(i) = max_p Q(p), choice(i) = the first best p; returns min and max of the change."""
    nodes = len(values)
    smallest, largest = np.inf, -np.inf
    for k in range(nodes):
        i = nodes - 1 - k if backward else k
        if start[i] == start[i + 1]:
            out[i] = values[i]
            continue
        best, pick = -np.inf, start[i]
        for p in range(start[i], start[i + 1]):
            expected = 0.0
            for j in range(row[p], row[p + 1]):
                expected += probability[j] * values[successor[j]]
            q = reward[p] + discount * expected
            if q > best:
                best, pick = q, p
        change = best - values[i]
        smallest, largest = min(smallest, change), max(largest, change)
        out[i] = best
        choice[i] = pick
    return smallest, largest


_compiled_backup: Any = numba.njit(cache=True, nogil=True)(_backup)


def backup(
    pairs: Pairs,
    values: FloatArray,
    out: FloatArray,
    choice: IntArray,
    *,
    reward: FloatArray | None = None,
    backward: bool = False,
) -> tuple[float, float]:
    """One pass from `values` to `out` [node] (may be the same array); writes the best pair of each.

    `reward` [p] replaces the rewards (minus infinity excludes a pair).  Returns the least and the
    largest change; (inf, -inf) if no node has a pair.
    """
    smallest, largest = _compiled_backup(
        values,
        out,
        choice,
        pairs.start,
        pairs.row,
        pairs.successor,
        pairs.probability,
        pairs.reward if reward is None else reward,
        pairs.discount,
        backward,
    )
    return float(smallest), float(largest)


def initial_choice(pairs: Pairs) -> IntArray:
    """The first pair of each node (`start[i]`, also where there is none)."""
    return pairs.start[:-1].copy()
