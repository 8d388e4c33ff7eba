"""Closures on the graph of pairs: what is lost when nodes are removed, what can reach a target.

Both run over the predecessor lists of `Pairs.predecessors`, each pair and node at most once.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from factored_polca.explicit.arrays import BoolArray, IntArray
from factored_polca.solvers.pairs import Pairs


def _spread(
    queue: Any,
    size: int,
    rank: Any,
    waits: Any,
    usable: Any,
    start: Any,
    predecessor: Any,
    owner: Any,
) -> int:
    """From `queue[:size]` backwards: a node joins when `waits` of its usable pairs touch the queue."""
    head = 0
    while head < size:
        node = queue[head]
        head += 1
        for k in range(start[node], start[node + 1]):
            p = predecessor[k]
            if not usable[p]:
                continue
            i = owner[p]
            usable[p] = False
            waits[i] -= 1
            if waits[i] == 0 and rank[i] < 0:
                rank[i] = size
                queue[size] = i
                size += 1
    return size


_compiled_spread: Any = numba.njit(cache=True, nogil=True)(_spread)


def _closure(pairs: Pairs, seeds: IntArray, waits: IntArray, usable: BoolArray) -> IntArray:
    start, predecessor = pairs.predecessors
    queue = np.zeros(pairs.nodes, dtype=np.int64)
    queue[: len(seeds)] = seeds
    rank = np.full(pairs.nodes, -1, dtype=np.int64)
    rank[seeds] = np.arange(len(seeds))
    _compiled_spread(queue, len(seeds), rank, waits, usable, start, predecessor, pairs.owner)
    return rank


def distance_order(pairs: Pairs, target: BoolArray, usable: BoolArray) -> IntArray:
    """The place of each node in a breadth-first search backwards from `target`; -1: it can't reach it.

    A node that is not in `target` and has a place has a usable pair with a successor of lower place.
    """
    waits = np.ones(pairs.nodes, dtype=np.int64)
    return _closure(pairs, np.flatnonzero(target), waits, usable.copy())


def prune(pairs: Pairs, lost: BoolArray, alive: BoolArray) -> tuple[BoolArray, BoolArray]:
    """(lost nodes, living pairs): the least closure of "a pair that may enter a lost node is dead,
    and a node all of whose pairs are dead is lost", from `lost` and the pairs in `alive`.

    Nodes that have no pair at all are lost only if `lost` says so.
    """
    living = np.bincount(pairs.owner[alive], minlength=pairs.nodes)
    had = np.diff(pairs.start) > 0
    seeds = np.flatnonzero(lost | (had & (living == 0)))
    alive = alive.copy()
    if len(seeds) == 0:
        return np.zeros(pairs.nodes, dtype=np.bool_), alive
    rank = _closure(pairs, seeds, living, alive)
    gone: BoolArray = rank >= 0
    return gone, alive & ~gone[pairs.owner]


def strong_components(pairs: Pairs, usable: BoolArray) -> IntArray:
    """The number of each node's strongly connected component in the graph of usable pairs."""
    entries = usable[pairs.pair_of_entry]
    origin = pairs.owner[pairs.pair_of_entry[entries]]
    edges = (np.ones(len(origin)), (origin, pairs.successor[entries]))
    graph = csr_array(edges, shape=(pairs.nodes, pairs.nodes))
    _, label = connected_components(graph, directed=True, connection="strong")
    return np.asarray(label, dtype=np.int64)
