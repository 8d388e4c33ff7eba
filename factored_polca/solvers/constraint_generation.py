"""Accelerated vector pruning as a kernel: one game after another, each by constraint generation.

For a sum w = left[l] + right[r] that is still open the game of `factored_polca.solvers.simplex` is
solved with a few survivors as columns, at first those that the previous game ended with.

- v <= tolerance: a mixture of survivors holds w down everywhere.  The mixture is computed anew from the
  columns, and w is dropped.
- At an optimum of the columns, v > tolerance, the belief b of the basis is looked at.  Sums: the best
  of *all* sums at b is found with n1 + n2 products; it is a survivor, witnessed by b, and unless it is
  w the next column.  A plain set (right = {0}): survivors are looked through in blocks, beginning where
  one was found last, for one that is as good as w at b; failing that, the best open vector at b is a
  new survivor.
- Anything else is rounding: w is marked doubtful.

Source: Walraven & Spaan, "Accelerated vector pruning for optimal POMDP solvers" (AAAI 2017).  The
search through sums by sides and the start from the last mixture are additions.

Letters: i states, n1, n2 vectors left and right, a sum (l, r) has the number l * n2 + r, b a belief.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers import simplex
from factored_polca.solvers.compiled import kernel

OPEN: Final = -1
DROPPED: Final = -2
DOUBTFUL: Final = -3
"""What `Found.state` says of a sum that is no survivor; of a survivor its place in `kept`."""

NO_ROOM: Final = -4

DONE: Final = 0
FULL: Final = 1
PAUSED: Final = 2

NEXT: Final = 0
SURVIVORS: Final = 1
COLUMNS: Final = 2
PROGRAMS: Final = 3
BLOCK: Final = 4
LOOKS: Final = 5
"""Places in `progress`: the next number; how many survivors, columns and programs there are; the block
where a survivor was found last; how many sums were looked at."""

WIDTH: Final = 256
"""Survivors in a block."""


class Sums(NamedTuple):
    """The two sides, and both transposed."""

    left: FloatArray  # [n1, i]
    right: FloatArray  # [n2, i]
    left_across: FloatArray  # [i, n1]
    right_across: FloatArray  # [i, n2]
    hints: IntArray  # [n1] a survivor that is good where left[l] is, -1: none; for plain sets


class Found(NamedTuple):
    """What is known of the sums."""

    state: npt.NDArray[np.int32]  # [n1, n2]
    kept: IntArray  # [room] the survivors' numbers
    across: FloatArray  # [i, room] their vectors
    witnesses: FloatArray  # [room, i] a belief where each is the best


class Game(NamedTuple):
    """The game that is being solved, and working space."""

    local: IntArray  # [c] places in `kept` of the columns
    columns: FloatArray  # [i + 1, c]
    inverse: FloatArray  # [i + 1, i + 1]
    basis: IntArray  # [i]
    costs: FloatArray  # [c]
    out: FloatArray  # [i + 1]
    belief: FloatArray  # [i]
    w: FloatArray  # [i]
    left_values: FloatArray  # [n1]
    right_values: FloatArray  # [n2]
    block: FloatArray  # [WIDTH]


@kernel
def best_row(values: FloatArray, rows: FloatArray, tie: float) -> int:
    """The row whose value is best; of ties the lexicographically largest, then the first."""
    most = values[0]
    for n in range(1, len(values)):
        most = max(most, values[n])
    floor = most - tie
    best = -1
    for n in range(len(values)):
        if values[n] < floor:
            continue
        if best < 0:
            best = n
            continue
        for s in range(rows.shape[1]):
            if rows[n, s] > rows[best, s] + tie:
                best = n
                break
            if rows[n, s] < rows[best, s] - tie:
                break
    return best


@kernel
def best_rows(scores: FloatArray, rows: FloatArray, tie: float, out: IntArray) -> None:
    """`best_row` for each row of `scores` [p, n]."""
    for p in range(len(scores)):
        out[p] = best_row(scores[p], rows, tie)


@kernel
def products(belief: FloatArray, across: FloatArray, first: int, count: int, values: FloatArray) -> None:
    """values[n] = belief . vector first + n, for `count` vectors."""
    for n in range(count):
        values[n] = 0.0
    for s in range(len(belief)):
        weight = belief[s]
        if weight != 0.0:
            for n in range(count):
                values[n] += weight * across[s, first + n]


@kernel
def search_survivors(found: Found, game: Game, progress: IntArray, floor: float) -> int:
    """A survivor's place that is worth at least `floor` at the belief, the best of its block; -1: none."""
    count = progress[SURVIVORS]
    blocks = (count + WIDTH - 1) // WIDTH
    for turn in range(blocks):
        block = (progress[BLOCK] + turn) % blocks
        size = min(WIDTH, count - block * WIDTH)
        products(game.belief, found.across, block * WIDTH, size, game.block)
        best = 0
        for n in range(1, size):
            if game.block[n] > game.block[best]:
                best = n
        if game.block[best] >= floor:
            progress[BLOCK] = block
            return int(block * WIDTH + best)
    return -1


@kernel
def add_survivor(sums: Sums, found: Found, game: Game, progress: IntArray, l: int, r: int) -> int:
    """Note (l, r) as a survivor witnessed by the belief; its place, or NO_ROOM."""
    place = progress[SURVIVORS]
    if place == len(found.kept):
        return NO_ROOM
    found.state[l, r] = place
    found.kept[place] = l * len(sums.right) + r
    for s in range(len(game.belief)):
        found.witnesses[place, s] = game.belief[s]
        found.across[s, place] = sums.left[l, s] + sums.right[r, s]
    progress[SURVIVORS] = place + 1
    return int(place)


@kernel
def search_set(sums: Sums, found: Found, game: Game, progress: IntArray, tolerance: float) -> int:
    """The place of the next column of a plain set, a new survivor if need be; or NO_ROOM."""
    floor = -tolerance
    for s in range(len(game.belief)):
        floor += game.belief[s] * game.w[s]
    place = search_survivors(found, game, progress, floor)
    if place >= 0:
        return place
    values = game.left_values
    products(game.belief, sums.left_across, 0, len(values), values)
    for n in range(len(values)):
        if found.state[n, 0] != OPEN:
            values[n] = -np.inf
    return add_survivor(sums, found, game, progress, best_row(values, sums.left, 0.25 * tolerance), 0)


@kernel
def search_sums(sums: Sums, found: Found, game: Game, progress: IntArray, tolerance: float) -> int:
    """The place of the best of all sums at the belief, a new survivor if need be; or NO_ROOM.

    Where that sum was dropped, a survivor as good within the tolerance; -1 if rounding hides it.
    """
    products(game.belief, sums.left_across, 0, len(sums.left), game.left_values)
    products(game.belief, sums.right_across, 0, len(sums.right), game.right_values)
    l = best_row(game.left_values, sums.left, 0.25 * tolerance)
    r = best_row(game.right_values, sums.right, 0.25 * tolerance)
    if found.state[l, r] >= 0:
        return int(found.state[l, r])
    if found.state[l, r] != DROPPED:
        return add_survivor(sums, found, game, progress, l, r)
    floor = game.left_values[l] + game.right_values[r] - 2 * tolerance
    return search_survivors(found, game, progress, floor)


@kernel
def load_columns(found: Found, game: Game, count: int) -> int:
    """Write the columns of a new w; the one whose largest entry is least."""
    first, least = 0, np.inf
    for k in range(count):
        place = game.local[k]
        peak = -np.inf
        for s in range(len(game.w)):
            entry = game.w[s] - found.across[s, place]
            game.columns[s, k] = entry
            peak = max(peak, entry)
        if peak < least:
            first, least = k, peak
    return first


@kernel
def compact(game: Game, count: int) -> int:
    """Keep the columns of the basis only, in order; the new count."""
    i = len(game.basis)
    kept = 0
    for k in range(count):
        for r in range(i):
            if game.basis[r] == i + k:
                game.local[kept] = game.local[k]
                for s in range(i + 1):
                    game.columns[s, kept] = game.columns[s, k]
                game.basis[r] = i + kept
                kept += 1
                break
    return kept


@kernel
def add_column(found: Found, game: Game, progress: IntArray, place: int, scale: float) -> bool:
    """Add the survivor's column; False if it is there already."""
    count = progress[COLUMNS]
    for k in range(count):
        if game.local[k] == place:
            return False
    if count == len(game.local):
        count = compact(game, count)
    game.local[count] = place
    for s in range(len(game.w)):
        game.columns[s, count] = game.w[s] - found.across[s, place]
    simplex.equilibrate(game.columns, count, scale)
    progress[COLUMNS] = count + 1
    return True


@kernel
def play(
    sums: Sums, found: Found, game: Game, progress: IntArray, tolerance: float, number: int, first: int
) -> int:
    """Solve the game of the sum `number` from the column `first`: its new state, or NO_ROOM."""
    scale = 0.0
    for s in range(len(game.w)):
        scale = max(scale, abs(game.columns[s, first]))
    scale = 1.0 / scale
    for k in range(progress[COLUMNS]):
        simplex.equilibrate(game.columns, k, scale)
    simplex.first_basis(game.columns, first, game.inverse, game.basis)
    while True:
        code = simplex.optimise(
            game.columns,
            progress[COLUMNS],
            game.inverse,
            game.basis,
            game.costs,
            game.out,
            scale * tolerance,
        )
        if code == simplex.OPTIMAL:
            simplex.read_belief(game.inverse, game.belief)
            if len(sums.right) == 1:
                place = search_set(sums, found, game, progress, tolerance)
            else:
                place = search_sums(sums, found, game, progress, tolerance)
            if place == NO_ROOM:
                return NO_ROOM
            if place >= 0 and found.kept[place] == number:
                return place
            if place >= 0 and add_column(found, game, progress, place, scale):
                continue
        excess = simplex.mixed_excess(game.columns, game.inverse, game.basis, game.out)
        return DROPPED if excess <= 2.0 * scale * tolerance else DOUBTFUL


@kernel
def scan(sums: Sums, found: Found, game: Game, progress: IntArray, tolerance: float, looks: int) -> int:
    """Decide the sums from progress[NEXT] on; DONE, FULL (make room and call again) or PAUSED.

    PAUSED once progress[LOOKS] has reached `looks`; a pause changes nothing in the result.
    """
    n2 = len(sums.right)
    while progress[NEXT] < len(sums.left) * n2:
        number = progress[NEXT]
        l, r = number // n2, number % n2
        if found.state[l, r] != OPEN:
            progress[NEXT] += 1
            continue
        if progress[LOOKS] >= looks:
            return PAUSED
        progress[LOOKS] += 1
        for s in range(len(game.w)):
            game.w[s] = sums.left[l, s] + sums.right[r, s]
        carried = progress[COLUMNS]
        if n2 == 1 and sums.hints[l] >= 0:
            add_column(found, game, progress, sums.hints[l], 1.0)
        first = load_columns(found, game, progress[COLUMNS])
        peak = game.columns[0, first]
        for s in range(1, len(game.w)):
            peak = max(peak, game.columns[s, first])
        if peak <= tolerance:
            progress[COLUMNS] = min(carried, progress[COLUMNS])
            found.state[l, r] = DROPPED
            continue
        progress[PROGRAMS] += 1
        answer = play(sums, found, game, progress, tolerance, number, first)
        progress[COLUMNS] = compact(game, progress[COLUMNS])
        if answer == NO_ROOM:
            return FULL
        found.state[l, r] = answer
    return DONE
