"""A small simplex method for the linear programs of vector pruning.

Whether a vector w is above all of u_1 .. u_K somewhere on the simplex is the value of a matrix game,
with D_k(s) = w(s) - u_k(s):

    max over b of min over k of b . D_k   =   min over lambda of max over s of sum_k lambda_k D_k(s)

(b a belief, lambda a distribution over the u_k).  At most 0: a mixture of the u_k is nowhere below w.
Solved is the right side, as the linear program

    min v   such that   sum_k lambda_k D_k(s) - v + z_s = 0 for each s,   sum_k lambda_k = 1,
                        lambda >= 0,  z >= 0,  v free,

with the revised primal simplex method (Dantzig's rule, Bland's once steps of length 0 repeat) on an
explicit inverse of i + 1 rows, v always basic.  Three things make it fit for pruning: a start needs no
first phase (lambda_k = 1 for any k); another u_k is another column, so the basis stays feasible when
constraints are generated (Walraven & Spaan, "Accelerated vector pruning for optimal POMDP solvers",
AAAI 2017); v bounds the game's value from above at every step, so that the search may stop early.

Letters and arrays, for kernels:

    i               the number of states; m = i + 1
    columns [m, k]  c_k * (D_k(s) for each s, then 1), the first `count` in use; the factor c_k > 0 makes
                    the largest entry of order 1 (the variable is lambda_k / c_k)
    basis [i]       the basic variable of each row r: s for z_s, i + k for lambda_k
    inverse [m, m]  B^-1 *transposed*: inverse[c, r].  r < i: the row of basis[r]; r = i: the row of v.
                    inverse[i, r] is the variable's value; inverse[s, i] is -b(s), inverse[i, i] is v
    costs [c]       working space for the columns, `out` [m] for the rows
"""

from __future__ import annotations

from typing import Final

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.models.errors import LimitReached
from factored_polca.solvers.compiled import kernel

BELOW: Final = 0
"""v is at most the target: the search may stop."""
OPTIMAL: Final = 1
FAILED: Final = 2
"""Rounding or the limit on steps: neither answer is certain."""

SMALL: Final = 3e-14
"""What counts as 0 in a reduced cost, for columns of order 1."""
LEVEL: Final = 1e-12
"""Steps and values that differ by less are ties."""
PIVOT: Final = 1e-9
"""The least entry that is divided by."""


@kernel
def first_basis(columns: FloatArray, first: int, inverse: FloatArray, basis: IntArray) -> None:
    """The basis lambda_first = 1, v = max over s of D_first(s), and every z but the one of that s."""
    i = len(basis)
    factor = columns[i, first]
    peak = 0
    for s in range(1, i):
        if columns[s, first] > columns[peak, first]:
            peak = s
    for s in range(i + 1):
        for r in range(i + 1):
            inverse[s, r] = 0.0
    for s in range(i):
        basis[s] = s
        inverse[s, s] = 1.0
        inverse[peak, s] -= 1.0
        inverse[i, s] = (columns[peak, first] - columns[s, first]) / factor
    basis[peak] = i + first
    for s in range(i):
        inverse[s, peak] = 0.0
    inverse[i, peak] = 1.0 / factor
    inverse[peak, i] = -1.0
    inverse[i, i] = columns[peak, first] / factor


@kernel
def entering(columns: FloatArray, count: int, inverse: FloatArray, costs: FloatArray, bland: bool) -> int:
    """The variable to enter: the most negative reduced cost, or the first with `bland`; -1: none."""
    i = len(inverse) - 1
    least, found = -SMALL, -1
    for s in range(i):
        cost = -inverse[s, i]
        if cost < least:
            least, found = cost, s
            if bland:
                return found
    for k in range(count):
        costs[k] = 0.0
    for s in range(i + 1):
        weight = inverse[s, i]
        if weight != 0.0:
            for k in range(count):
                costs[k] -= weight * columns[s, k]
    for k in range(count):
        if costs[k] < least:
            least, found = costs[k], i + k
            if bland:
                return found
    return found


@kernel
def direction(columns: FloatArray, variable: int, inverse: FloatArray, out: FloatArray) -> None:
    """out [m] = B^-1 times the variable's column."""
    m = len(inverse)
    for r in range(m):
        out[r] = inverse[variable, r] if variable < m - 1 else 0.0
    if variable < m - 1:
        return
    for s in range(m):
        weight = columns[s, variable - m + 1]
        if weight != 0.0:
            for r in range(m):
                out[r] += weight * inverse[s, r]


@kernel
def leaving(inverse: FloatArray, basis: IntArray, out: FloatArray, bland: bool) -> int:
    """The row that reaches 0 first; of equals the largest pivot, or with `bland` the first variable."""
    i = len(basis)
    row, length = -1, np.inf
    for r in range(i):
        if out[r] <= PIVOT:
            continue
        ratio = max(inverse[i, r], 0.0) / out[r]
        if row < 0 or ratio < length - LEVEL:
            row, length = r, ratio
        elif ratio <= length + LEVEL:
            better = basis[r] < basis[row] if bland else out[r] > out[row]
            if better:
                row = r
                length = min(length, ratio)
    return row


@kernel
def exchange(inverse: FloatArray, row: int, out: FloatArray) -> None:
    """The inverse after the entering variable has taken `row`."""
    for c in range(len(out)):
        factor = inverse[c, row] / out[row]
        if factor != 0.0:
            for r in range(len(out)):
                inverse[c, r] -= factor * out[r]
            inverse[c, row] = factor


@kernel
def optimise(
    columns: FloatArray,
    count: int,
    inverse: FloatArray,
    basis: IntArray,
    costs: FloatArray,
    out: FloatArray,
    target: float,
) -> int:
    """Steps until v <= `target`, or no step improves; BELOW, OPTIMAL or FAILED.

    `inverse` and `basis` are changed.
    """
    i = len(basis)
    idle, patience = 0, 2 * i + 10
    for _ in range(50 * (i + count) + 200):
        if inverse[i, i] <= target:
            return BELOW
        bland = idle > patience
        variable = entering(columns, count, inverse, costs, bland)
        if variable < 0:
            return OPTIMAL
        direction(columns, variable, inverse, out)
        row = leaving(inverse, basis, out, bland)
        if row < 0:
            return FAILED
        before = inverse[i, i]
        exchange(inverse, row, out)
        basis[row] = variable
        idle = idle + 1 if inverse[i, i] >= before - SMALL else 0
    return FAILED


@kernel
def read_belief(inverse: FloatArray, belief: FloatArray) -> None:
    """The belief of the basis, made a distribution, into `belief` [i]."""
    i = len(belief)
    total = 0.0
    for s in range(i):
        belief[s] = max(0.0, -inverse[s, i])
        total += belief[s]
    for s in range(i):
        belief[s] /= total


@kernel
def mixed_excess(columns: FloatArray, inverse: FloatArray, basis: IntArray, out: FloatArray) -> float:
    """max over s of sum_k lambda_k D_k(s), from the columns: a bound that trusts no inverse."""
    i = len(basis)
    total = 0.0
    for s in range(i):
        out[s] = 0.0
    for r in range(i):
        weight = inverse[i, r]
        if basis[r] >= i and weight > 0.0:
            total += weight * columns[i, basis[r] - i]
            for s in range(i):
                out[s] += weight * columns[s, basis[r] - i]
    largest = -np.inf
    for s in range(i):
        largest = max(largest, out[s])
    return largest / total if total > 0.5 else np.inf


@kernel
def equilibrate(columns: FloatArray, k: int, scale: float) -> None:
    """Turn D_k(s), in the first rows of column k, into c_k * (scale * D_k(s), 1)."""
    i = len(columns) - 1
    largest = 1.0
    for s in range(i):
        columns[s, k] *= scale
        largest = max(largest, abs(columns[s, k]))
    for s in range(i):
        columns[s, k] /= largest
    columns[i, k] = 1.0 / largest


@kernel
def solve_game(columns: FloatArray, inverse: FloatArray, basis: IntArray) -> int:
    """`optimise` to the end, over all the columns at once, from the best of them; entries in [-1, 1]."""
    i, count = len(columns) - 1, columns.shape[1]
    first, least = 0, np.inf
    for k in range(count):
        equilibrate(columns, k, 1.0)
        peak = -np.inf
        for s in range(i):
            peak = max(peak, columns[s, k])
        if peak < least:
            first, least = k, peak
    first_basis(columns, first, inverse, basis)
    return optimise(columns, count, inverse, basis, np.empty(count), np.empty(i + 1), -np.inf)


def game_value(matrix: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """(value, belief [i], mixture [k]) of the game max over b of min over k of b . matrix[k].

    The belief earns the value, and the mixture holds it down to it, within rounding.  A game that
    rounding spoils here is left to `game_value_by_highs`.
    """
    count, i = matrix.shape
    scale = float(np.abs(matrix).max(initial=0.0)) or 1.0
    columns = np.ascontiguousarray(np.vstack([matrix.T / scale, np.ones((1, count))]))
    inverse, basis = np.zeros((i + 1, i + 1)), np.zeros(i, dtype=np.int64)
    if solve_game(columns, inverse, basis) != OPTIMAL:
        return game_value_by_highs(matrix)
    belief, mixture = np.zeros(i), np.zeros(count)
    read_belief(inverse, belief)
    for r, variable in enumerate(basis.tolist()):
        if variable >= i:
            mixture[variable - i] = max(0.0, float(inverse[i, r]))
    return scale * float(inverse[i, i]), belief, mixture / mixture.sum()


def game_value_by_highs(matrix: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """The same by HiGHS, an independent program: exact to some 1e-9 of the largest entry.

    Raises:
        LimitReached: HiGHS found no answer.
    """
    from scipy.optimize import linprog  # takes long to import, and is seldom needed

    count, i = matrix.shape
    scale = float(np.abs(matrix).max(initial=0.0)) or 1.0
    result = linprog(
        np.concatenate([np.zeros(i), [-1.0]]),
        A_ub=np.hstack([-matrix / scale, np.ones((count, 1))]),
        b_ub=np.zeros(count),
        A_eq=np.concatenate([np.ones(i), [0.0]])[None, :],
        b_eq=[1.0],
        bounds=[(0, None)] * i + [(None, None)],
        method="highs",
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    if result.status != 0:
        raise LimitReached(f"HiGHS found no answer to a game of {count} x {i}: {result.message}", "HiGHS")
    belief = np.maximum(result.x[:i], 0.0)
    mixture = np.maximum(-result.ineqlin.marginals, 0.0)
    return -scale * float(result.fun), belief / belief.sum(), mixture / (mixture.sum() or 1.0)
