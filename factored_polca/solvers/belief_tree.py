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

MERGE: Final = 1e-13
"""Beliefs closer than this in L1 distance count as equal; `merge_widening` bounds what it may cost."""

NODES, ENTRIES, CHOICES, CHILDREN, VECTORS, NUMBERS, LINKS, LOG, BACKUPS, TRIALS = range(10)
"""What `Tree.counts` counts."""


class Tree(NamedTuple):
    """See the module's docstring; -1 stands for "none" in all integers."""

    counts: IntArray  # [10]
    # nodes [n]
    node_class: IntArray
    entry_start: IntArray
    entry_count: IntArray
    upper: FloatArray
    lower: FloatArray
    base: FloatArray  # what the corners alone give
    best_vector: IntArray
    vector_mark: IntArray  # the newest vector looked at
    log_mark: IntArray  # the newest log entry looked at
    first_choice: IntArray  # -1: not opened
    same_hash: IntArray  # the next node in the same bucket
    # entries of beliefs [e]
    entry_state: IntArray  # within the class
    entry_weight: FloatArray
    # choices [c] of opened nodes, by option
    choice_reward: FloatArray
    choice_upper: FloatArray
    first_child: IntArray  # -1: not expanded
    # children [h], by branch
    child: IntArray  # -1: probability 0
    chance: FloatArray
    # vectors [m]
    vector_class: IntArray
    vector_option: IntArray
    vector_start: IntArray
    vector_previous: IntArray  # the next older vector of the class
    vector_links: IntArray  # start in `links`, -1: a policy by itself
    number: FloatArray  # the vectors' entries
    links: IntArray  # [l] for each branch of the vector's option, the vector it continues with
    # log [g]
    log_node: IntArray
    log_previous: IntArray
    # by class
    newest_vector: IntArray
    newest_log: IntArray
    oldest_vector: IntArray
    # others
    corner: FloatArray  # [i] upper bounds at single states
    option_bound: FloatArray  # laid out like Arrays.rewards: b . w_j bounds Q(b, j) from above
    bucket: IntArray  # heads of the hash table, a power of two
    dense: FloatArray  # [widest class] scratch
    other: FloatArray  # [widest class] scratch
    touched: IntArray  # [widest class] scratch
    path: IntArray  # [depth] scratch
    span: FloatArray  # [2] the least and largest corner at the start
    bins: FloatArray  # [class of upper bound, class of entropy, (mean, count)] of SARSOP's prediction


GROWING: Final = {
    "node_class": NODES, "entry_start": NODES, "entry_count": NODES, "upper": NODES, "lower": NODES,
    "base": NODES, "best_vector": NODES, "vector_mark": NODES, "log_mark": NODES, "first_choice": NODES,
    "same_hash": NODES, "entry_state": ENTRIES, "entry_weight": ENTRIES, "choice_reward": CHOICES,
    "choice_upper": CHOICES, "first_child": CHOICES, "child": CHILDREN, "chance": CHILDREN,
    "vector_class": VECTORS, "vector_option": VECTORS, "vector_start": VECTORS,
    "vector_previous": VECTORS, "vector_links": VECTORS, "number": NUMBERS, "links": LINKS,
    "log_node": LOG, "log_previous": LOG,
}  # fmt: skip
"""The arrays that grow, and the count that says how full they are."""


def merge_widening(problem: Problem) -> float:
    """What counting beliefs within `MERGE` as equal may take off an upper bound.

    The optimal value changes by at most (V_max - V_min)/2 times the L1 distance; each step may merge
    once more: gamma * MERGE * (R_max - R_min) / (2 (1 - gamma)^2).
    """
    least, largest = problem.reward_range
    return problem.discount * MERGE * (largest - least) / (2 * (1 - problem.discount) ** 2)


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
        kind = Tree.__annotations__[name]
        fields[name] = np.zeros(sizes[count], dtype=np.float64 if "Float" in str(kind) else np.int64)
    classes = problem.classes
    tree = Tree(
        **fields,  # type: ignore[arg-type]
        counts=np.zeros(10, dtype=np.int64),
        newest_vector=np.full(classes, -1, dtype=np.int64),
        newest_log=np.full(classes, -1, dtype=np.int64),
        oldest_vector=np.full(classes, -1, dtype=np.int64),
        corner=corner.astype(np.float64),
        option_bound=option_bound.astype(np.float64),
        bucket=np.full(1 << 12, -1, dtype=np.int64),
        dense=np.zeros(widest),
        other=np.zeros(widest),
        touched=np.zeros(widest, dtype=np.int64),
        path=np.zeros(depth + 1, dtype=np.int64),
        span=np.array([corner.min(initial=0.0), corner.max(initial=0.0)]),
        bins=np.zeros((BINS, BINS, 2)),
    )
    for y in range(classes):
        for vector, option in zip(vectors[y], options[y], strict=True):
            _first_vector(tree, y, int(option), vector)
    return tree


BINS: Final = 10


def _first_vector(tree: Tree, y: int, option: int, vector: FloatArray) -> None:
    m, start = int(tree.counts[VECTORS]), int(tree.counts[NUMBERS])
    tree.vector_class[m], tree.vector_option[m], tree.vector_start[m] = y, option, start
    tree.vector_previous[m], tree.vector_links[m] = tree.newest_vector[y], -1
    tree.number[start : start + len(vector)] = vector
    if tree.oldest_vector[y] < 0:
        tree.oldest_vector[y] = m
    tree.newest_vector[y] = m
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


def grown(tree: Tree, least: IntArray) -> Tree:
    """`tree` with at least `least` free places for each count; full arrays double."""
    changes: dict[str, FloatArray | IntArray] = {}
    for name, count in GROWING.items():
        array = getattr(tree, name)
        needed = int(tree.counts[count] + 2 * least[count])
        if len(array) < needed:
            bigger = np.zeros(max(needed, 2 * len(array)), dtype=array.dtype)
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
