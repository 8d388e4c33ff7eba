"""The working memory of the search methods (HSVI2, SARSOP): beliefs, vectors and bounds in flat arrays.

*Nodes* are beliefs, each over one class; equal ones (within `MERGE` in L1 distance) are one node.  A
node has an upper and a lower bound of V*.  Its *choices* are the options of its class; an expanded
choice has *children*, one for each branch.  *Vectors* bound V* from below, each with its option and the
vectors that its branches were backed up from.  `log` lists, class by class, the nodes whose upper
bound has fallen below what corners give: the points of the sawtooth bound.

Vectors and log entries are only ever appended (until `compact`), and form a list for each class from
the newest to the oldest; a node remembers how far it has looked, so that no pair of a belief and a
vector, or of a belief and a point, is evaluated twice.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.pomdp_problem import Problem

MERGE: Final = 1e-14
"""Beliefs closer than this in L1 distance count as equal; `merge_widening` bounds what it may cost."""

NODES, ENTRIES, CHOICES, CHILDREN, VECTORS, NUMBERS, LINKS, LOG, BACKUPS, TRIALS = range(10)
"""What `Tree.counts` counts."""
COUNTS: Final = 10


CLASS, START, COUNT, BEST, VECTOR_MARK, LOG_MARK, FIRST_CHOICE, SAME_HASH = range(8)
"""Columns of `Tree.node`: its class, its entries, its best vector, the newest vector and log entry it has
looked at, its first choice (-1: not opened), the next node in the same bucket."""

UPPER, LOWER, BASE = range(3)
"""Columns of `Tree.bound`; BASE is what the corners alone give."""

REWARD, CHOICE_UPPER = range(2)
"""Columns of `Tree.choice`."""

OF_CLASS, OPTION, AT, OLDER, FIRST_LINK = range(5)
"""Columns of `Tree.vector`: class, option, start in `number`, the next older vector of the class, start in
`links` (-1: a policy by itself)."""

LOGGED, LOGGED_BEFORE = range(2)
"""Columns of `Tree.log`: a node, and the next older entry of its class."""

NEWEST_VECTOR, OLDEST_VECTOR, NEWEST_LOG = range(3)
"""Columns of `Tree.head`, by class."""


class Tree(NamedTuple):
    """See the module's docstring; -1 stands for "none" in all integers.

    Few arrays with columns, as each array is an argument of every kernel and takes time to compile.
    """

    counts: IntArray  # [10]
    node: IntArray  # [n, column]
    bound: FloatArray  # [n, column]
    entry_state: IntArray  # [e] entries of beliefs, states within the class
    entry_weight: FloatArray  # [e]
    choice: FloatArray  # [c, column], of opened nodes, by option
    first_child: IntArray  # [c] -1: not expanded
    child: IntArray  # [h] by branch, -1: probability 0
    chance: FloatArray  # [h]
    vector: IntArray  # [m, column]
    number: FloatArray  # the vectors' entries
    links: IntArray  # [l] for each branch of the vector's option, the vector it continues with
    log: IntArray  # [g, column]
    head: IntArray  # [y, column]
    corner: FloatArray  # [i] upper bounds at single states
    option_bound: FloatArray  # laid out like Arrays.rewards: b . w_j bounds Q(b, j) from above
    bucket: IntArray  # heads of the hash table, a power of two
    dense: FloatArray  # [widest class] scratch, 0 outside kernels
    other: FloatArray  # [widest class] scratch
    touched: IntArray  # [widest class] scratch
    path: IntArray  # [depth] scratch
    bins: FloatArray  # [by upper bound, by entropy, (mean, count)]; last row: corners' range, distance


GROWING: Final = {
    "node": NODES, "bound": NODES, "entry_state": ENTRIES, "entry_weight": ENTRIES, "choice": CHOICES,
    "first_child": CHOICES, "child": CHILDREN, "chance": CHILDREN, "vector": VECTORS,
    "number": NUMBERS, "links": LINKS, "log": LOG,
}  # fmt: skip
"""The arrays that grow, and the count that says how full they are."""

FLOATS: Final = {"bound", "entry_weight", "choice", "chance", "number"}
COLUMNS: Final = {"node": 8, "bound": 3, "choice": 2, "vector": 5, "log": 2}


def merge_widening(problem: Problem, tree: Tree) -> float:
    """What counting beliefs as equal may have taken off an upper bound; d is the largest distance so far.

    The optimal value changes by at most (V_max - V_min)/2 times the L1 distance; each step may merge
    once more: gamma d (R_max - R_min) / (2 (1 - gamma)^2).
    """
    least, largest = problem.reward_range
    distance = float(tree.bins[BINS, 1, 0])
    return problem.discount * distance * (largest - least) / (2 * (1 - problem.discount) ** 2)


def new_tree(
    problem: Problem,
    vectors: Sequence[FloatArray],
    options: Sequence[IntArray],
    corner: FloatArray,
    option_bound: FloatArray,
    depth: int,
) -> Tree:
    """A tree without nodes.

    `vectors` [n, n_y] with their `options` [n], by class, bound V* from below and each is the value of
    a policy; `corner` [i] bounds V* at single states from above, and `option_bound` Q at beliefs.
    """
    widest = int(np.diff(problem.arrays.offset).max(initial=1))
    total = sum(len(part) for part in vectors)
    numbers = sum(part.size for part in vectors)
    sizes = [1024, 1 << 15, 4096, 1 << 14, total + 1024, numbers + (1 << 15), 1 << 14, 4096, 0, 0]
    fields: dict[str, object] = {}
    for name, count in GROWING.items():
        shape = (sizes[count], COLUMNS[name]) if name in COLUMNS else (sizes[count],)
        fields[name] = np.zeros(shape, dtype=np.float64 if name in FLOATS else np.int64)
    bins = np.zeros((BINS + 1, BINS, 2))
    bins[BINS, 0] = corner.min(initial=0.0), corner.max(initial=0.0)
    tree = Tree(
        **fields,  # type: ignore[arg-type]
        counts=np.zeros(COUNTS, dtype=np.int64),
        head=np.full((problem.classes, 3), -1, dtype=np.int64),
        corner=corner.astype(np.float64),
        option_bound=option_bound.astype(np.float64),
        bucket=np.full(1 << 12, -1, dtype=np.int64),
        dense=np.zeros(widest),
        other=np.zeros(widest),
        touched=np.zeros(widest, dtype=np.int64),
        path=np.zeros(depth + 1, dtype=np.int64),
        bins=bins,
    )
    for y in range(problem.classes):
        for vector, option in zip(vectors[y], options[y], strict=True):
            _first_vector(tree, y, int(option), vector)
    return tree


BINS: Final = 10


def _first_vector(tree: Tree, y: int, option: int, vector: FloatArray) -> None:
    m, start = int(tree.counts[VECTORS]), int(tree.counts[NUMBERS])
    tree.vector[m] = y, option, start, tree.head[y, NEWEST_VECTOR], -1
    tree.number[start : start + len(vector)] = vector
    if tree.head[y, OLDEST_VECTOR] < 0:
        tree.head[y, OLDEST_VECTOR] = m
    tree.head[y, NEWEST_VECTOR] = m
    tree.counts[VECTORS] += 1
    tree.counts[NUMBERS] += len(vector)


def room(problem: Problem) -> IntArray:
    """By count: what one opening, expansion or backup of a node takes at most."""
    widest = int(np.diff(problem.arrays.offset).max(initial=1))
    options = int(np.diff(problem.arrays.first_option).max(initial=1))
    branches = int(np.diff(problem.arrays.first_branch).max(initial=1))
    nodes = branches + 1
    return np.array(
        [nodes, nodes * widest, options, branches, 1, widest, branches, 2, 0, 0], dtype=np.int64
    )


def for_vectors(least: IntArray) -> IntArray:
    """What backups alone take: `least` without nodes, entries, choices, children and updates of points."""
    needed = np.zeros_like(least)
    needed[[VECTORS, NUMBERS, LINKS]] = least[[VECTORS, NUMBERS, LINKS]]
    return needed


def for_points(points: int) -> IntArray:
    """What `points` updates of points take."""
    needed = np.zeros(COUNTS, dtype=np.int64)
    needed[LOG] = points
    return needed


def grown(tree: Tree, least: IntArray) -> Tree:
    """`tree` with at least `least` free places for each count; full arrays double."""
    changes: dict[str, FloatArray | IntArray] = {}
    for name, count in GROWING.items():
        array = getattr(tree, name)
        needed = int(tree.counts[count] + 2 * least[count])
        if len(array) < needed:
            bigger = np.zeros((max(needed, 2 * len(array)), *array.shape[1:]), dtype=array.dtype)
            bigger[: len(array)] = array
            changes[name] = bigger
    return tree._replace(**changes)  # type: ignore[arg-type]


def is_short(tree: Tree, least: IntArray) -> bool:
    """Whether some array lacks `least` free places."""
    return any(
        len(getattr(tree, name)) < tree.counts[count] + least[count] for name, count in GROWING.items()
    )


def size_in_bytes(tree: Tree) -> int:
    """The memory of all arrays."""
    return sum(array.nbytes for array in tree)
