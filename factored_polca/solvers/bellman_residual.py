"""How far one maximum of vectors rises above another, over all beliefs, from above.

For a vector w and a set of vectors u_n, max over b of (w . b - max over n of u_n . b) is the value of a
game (`simplex`), and any mixture lambda of the u_n holds it to max over s of
(w - sum_n lambda_n u_n)(s): that is computed anew from the mixture that the simplex method ends with.
With two states no program is needed: between two neighbouring beliefs at which vectors of the set cross
the set's maximum is linear and the difference convex, so it is largest at a crossing or a corner.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from factored_polca.explicit.arrays import FloatArray
from factored_polca.solvers.controllers import UNIT
from factored_polca.solvers.simplex import game_value


def excess(
    new: FloatArray,
    old: FloatArray,
    beliefs: FloatArray,
    known: float = 0.0,
    poll: Callable[[], None] | None = None,
) -> float:
    """max over b of (max of `new` [n, i] at b - max of `old` [m, i] at b), from above; `known` at least.

    `beliefs` [w, i] say where to look first: vectors of `new` that cannot raise what was found are
    passed over.  `poll` is called between programs and may raise.
    """
    size = new.shape[1]
    scale = float(np.abs(new).max(initial=0.0)) + float(np.abs(old).max(initial=0.0))
    rounding = (4 * size + 64) * UNIT * scale
    if size == 1:
        beliefs = np.ones((1, 1))
    elif size == 2:
        beliefs = _crossings(old)
    apart = (beliefs @ new.T).max(axis=1) - (beliefs @ old.T).max(axis=1)
    most = float(np.max(apart, initial=known))
    for vector in new if size > 2 else []:
        matrix = vector - old
        if float(matrix.max(axis=1).min()) <= most:  # held down by one vector of `old`
            continue
        if poll is not None:
            poll()
        _, _, mixture = game_value(matrix)
        most = max(most, float((mixture @ matrix).max()))
    bound: float = most + rounding
    return bound


def _crossings(vectors: FloatArray) -> FloatArray:
    """The corners and every belief [w, 2] at which two of the vectors [m, 2] are equal."""
    left, right = vectors[:, 0], vectors[:, 1]
    one, other = np.triu_indices(len(vectors), 1)
    down, up = left[one] - left[other], right[other] - right[one]
    total = down + up
    inside = (down * up > 0) & (total != 0)
    second = down[inside] / total[inside]
    places = np.concatenate([[0.0, 1.0], second])
    return np.column_stack([1 - places, places])
