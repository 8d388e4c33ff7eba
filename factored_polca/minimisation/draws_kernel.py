"""All that can come of drawing some variables in turn, one outcome after the other, as a kernel.

A *draw* gives one column of a row of value numbers a value that is distributed as a row diagram says, read
off the other columns; a variable is drawn after those that it depends on.  Draw d has its diagram's root in
`roots[d]` and its column in `targets[d]`; its row number r has the positive entries `start[bases[d] + r]`
up to `start[bases[d] + r + 1]` of `value`, and of what the caller keeps beside it.

The draws first .. last - 1 are an odometer: `entry[d]` is what draw d came to, `ends[d]` where its row
ends.
"""

from __future__ import annotations

from factored_polca.diagrams.jit import inline, int64, late_lean_kernel
from factored_polca.diagrams.nodes import Int32Array, Int64Array, payload


@inline
def leaf_at(pool: Int32Array, leaf_level: int, columns: Int32Array, root: int, row: Int32Array) -> int:
    """The leaf that a row of value numbers leads to; column `columns[level]` holds a level's value."""
    node = int64(root)
    while pool[node] < leaf_level:
        node = int64(pool[node + 2 + row[columns[pool[node]]]])
    return node


@late_lean_kernel
def next_outcome(
    pool: Int32Array, leaf_level: int, columns: Int32Array, roots: Int32Array, targets: Int32Array,
    bases: Int64Array, start: Int64Array, value: Int32Array, first: int, last: int, begin: int,
    row: Int32Array, entry: Int64Array, ends: Int64Array,
) -> int:  # fmt: skip
    """Go on to the next outcome, with `begin` to the first one: write it to `row` and `entry`.

    Answers the first draw whose entry has changed, or -1 after the last outcome.
    """
    d = int64(first)
    if begin == 0:
        d = int64(last) - 1
        while d >= first and entry[d] + 1 >= ends[d]:
            d -= 1
        if d < first:
            return int64(-1)
        entry[d] += 1
        row[targets[d]] = value[entry[d]]
        d += 1
    changed = max(int64(first), d - 1)
    while d < last:
        number = bases[d] + int64(payload(pool, leaf_at(pool, leaf_level, columns, roots[d], row)))
        entry[d] = start[number]
        ends[d] = start[number + 1]
        row[targets[d]] = value[entry[d]]
        d += 1
    return changed
