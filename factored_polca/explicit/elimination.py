"""Systems of linear equations in exact rationals, by Gaussian elimination on sparse rows."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction


class SingularSystem(ArithmeticError):
    """The equations have no solution, or more than one."""


def solve(matrix: Sequence[dict[int, Fraction]], right: Sequence[Fraction]) -> list[Fraction]:
    """The x with A x = b; `matrix[i]` maps columns to the entries of row i, `right` is b.

    Raises:
        SingularSystem: A has no inverse.
    """
    size = len(matrix)
    rows = [{j: value for j, value in row.items() if value} for row in matrix]
    constants = list(right)
    waiting = set(range(size))
    pivots: list[tuple[int, int]] = []
    for column in range(size):
        candidates = [i for i in waiting if column in rows[i]]
        if not candidates:
            raise SingularSystem(f"no equation determines unknown {column}")
        pivot = min(candidates, key=lambda i: (len(rows[i]), i))  # short rows fill in least
        waiting.remove(pivot)
        pivots.append((column, pivot))
        for i in candidates:
            if i == pivot:
                continue
            factor = rows[i].pop(column) / rows[pivot][column]
            constants[i] -= factor * constants[pivot]
            for j, value in rows[pivot].items():
                if j == column:
                    continue
                entry = rows[i].get(j, Fraction(0)) - factor * value
                if entry:
                    rows[i][j] = entry
                else:
                    rows[i].pop(j, None)
    solution = [Fraction(0)] * size
    for column, pivot in reversed(pivots):
        rest = sum((value * solution[j] for j, value in rows[pivot].items() if j != column), Fraction(0))
        solution[column] = (constants[pivot] - rest) / rows[pivot][column]
    return solution
