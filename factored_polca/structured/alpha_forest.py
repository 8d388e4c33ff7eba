"""Float diagrams as flat arrays, and their expectations under beliefs that are products.

A `Forest` holds diagrams one after the other, children before parents:

    levels[n]     the level of node n; `leaf_level` for a leaf
    first[n]      where the children of n begin in `children`; a leaf has none
    value[n]      the value of a leaf

Under a product of distributions m_l, one for each level, the expectation of a diagram is one pass from the
leaves up, E(n) = sum over v of m_l(v) E(child_v(n)): a level that is skipped counts 1.

Where some levels, the *cluster* C, have a joint distribution beta, a diagram of its own, the pass runs down
both at once:

    E(n, q) = sum over v of E(n_v, q_v)           at a level l of C
              sum over v of m_l(v) E(n_v, q)      at another level

times the number of ways that levels of C which both skip may go.  Pairs are remembered in a lossy table.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import FLOAT, Diagram, Manager
from factored_polca.diagrams.jit import int64, late_kernel
from factored_polca.diagrams.manager import require
from factored_polca.diagrams.operations import Walk

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Int32Array = npt.NDArray[np.int32]

REMEMBERED = 1 << 18
"""Pairs of nodes that the table of a pass over two diagrams holds."""


@late_kernel
def export(
    pool: Int32Array, arity: Int32Array, nodes: Int32Array, base: int, first_child: int,
    levels: Int32Array, first: Int32Array, children: Int32Array, value: FloatArray,
) -> int:  # fmt: skip
    """Write collected nodes, numbered in their scratch words, as flat arrays; the number of children."""
    leaf_level = len(arity) - 1
    count = 0
    for i in range(len(nodes)):
        node = int64(nodes[i])
        level = pool[node]
        levels[i] = level
        first[i] = first_child + count
        if level == leaf_level:
            low = np.uint64(np.uint32(pool[node + 2]))
            high = np.uint64(np.uint32(pool[node + 3]))
            value[i] = np.uint64(low | (high << np.uint64(32))).view(np.float64)
            continue
        for v in range(arity[level]):
            children[count] = base + pool[pool[node + 2 + v] + 1]
            count += 1
    return count


@late_kernel
def expectations(
    levels: Int32Array, first: Int32Array, children: Int32Array, value: FloatArray, sizes: Int32Array,
    offset: IntArray, marginals: FloatArray, start: int, out: FloatArray,
) -> None:  # fmt: skip
    """E(n) for the nodes from `start` on, which have no child before it; out[n - start]."""
    leaf_level = len(sizes) - 1
    for i in range(len(out)):
        n = start + i
        level = levels[n]
        if level == leaf_level:
            out[i] = value[n]
            continue
        total = 0.0
        at = int64(first[n])
        o = offset[level]
        for v in range(sizes[level]):
            m = marginals[o + v]
            if m != 0.0:
                total += m * out[children[at + v] - start]
        out[i] = total


@late_kernel
def pair_expectations(
    roots: IntArray, top: int, levels: Int32Array, first: Int32Array, children: Int32Array,
    value: FloatArray, b_levels: Int32Array, b_first: Int32Array, b_children: Int32Array,
    b_value: FloatArray, sizes: Int32Array, offset: IntArray, marginals: FloatArray, ways: FloatArray,
    keys: IntArray, found: FloatArray, stamp: int, out: FloatArray,
) -> None:  # fmt: skip
    """E(root, top) for each root; `ways[l]` counts the states of the cluster's levels above l.

    An open pair stands in `a`, `b` with its next value `k`, its sum so far, and the factor of the value
    under way.
    """
    leaf_level = len(sizes) - 1
    a = np.empty(leaf_level + 2, np.int64)
    b = np.empty(leaf_level + 2, np.int64)
    k = np.empty(leaf_level + 2, np.int64)
    total = np.empty(leaf_level + 2)
    factor = np.empty(leaf_level + 2)
    for i in range(len(roots)):
        a[0] = roots[i]
        b[0] = top
        k[0] = -1
        sp = 0
        result = 0.0
        while sp >= 0:
            x = a[sp]
            y = b[sp]
            level = min(levels[x], b_levels[y])
            if k[sp] < 0:  # a new pair
                closed = True
                key = stamp + y * len(levels) + x
                h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
                slot = int64(h >> np.uint64(32)) & (len(keys) - 1)
                if b_levels[y] == leaf_level and b_value[y] == 0.0:
                    result = 0.0
                elif level == leaf_level:
                    result = value[x] * b_value[y]
                elif keys[slot] == key:
                    result = found[slot]
                else:
                    closed = False
                if closed:
                    sp -= 1
                    continue
                k[sp] = 0
                total[sp] = 0.0
            else:
                total[sp] += factor[sp] * result
            v = k[sp]
            clustered = b_levels[y] == level or ways[level + 1] != ways[level]
            m = 0.0
            while v < sizes[level]:
                m = 1.0 if clustered else marginals[offset[level] + v]
                if m != 0.0:
                    break
                v += 1
            if v == sizes[level]:
                result = total[sp]
                key = stamp + y * len(levels) + x
                h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
                slot = int64(h >> np.uint64(32)) & (len(keys) - 1)
                keys[slot] = key
                found[slot] = result
                sp -= 1
                continue
            k[sp] = v + 1
            if levels[x] == level:
                x = int64(children[first[x] + v])
            if b_levels[y] == level:
                y = int64(b_children[b_first[y] + v])
            factor[sp] = m * ways[min(levels[x], b_levels[y])] / ways[level + 1]
            sp += 1
            a[sp] = x
            b[sp] = y
            k[sp] = -1
        out[i] = result * ways[min(levels[roots[i]], b_levels[top])]


@late_kernel
def pair_ratio(
    a_root: int, b_root: int, order: IntArray, in_a: IntArray, in_b: IntArray,
    a_levels: Int32Array, a_first: Int32Array, a_children: Int32Array, a_value: FloatArray,
    b_levels: Int32Array, b_first: Int32Array, b_children: Int32Array, b_value: FloatArray,
    sizes: Int32Array, offset: IntArray, a_marginals: FloatArray, b_marginals: FloatArray,
    keys: IntArray, found: FloatArray, stamp: int,
) -> float:  # fmt: skip
    """The least a / b over the states of the levels `order` with b > 0; infinity without one.

    Where a level is not `in_a`, a is a product there with its marginals, and so for b.
    """
    depth = len(order)
    a = np.empty(depth + 1, np.int64)
    b = np.empty(depth + 1, np.int64)
    k = np.empty(depth + 1, np.int64)
    least = np.empty(depth + 1)
    factor = np.empty(depth + 1)
    a[0] = a_root
    b[0] = b_root
    k[0] = -1
    sp = 0
    result = np.inf
    while sp >= 0:
        x = a[sp]
        y = b[sp]
        key = stamp + (sp * len(b_levels) + y) * len(a_levels) + x
        h = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
        slot = int64(h >> np.uint64(32)) & (len(keys) - 1)
        if k[sp] < 0:
            if sp == depth:
                result = np.inf
                if b_value[y] != 0.0:
                    result = a_value[x] / b_value[y]
                sp -= 1
                continue
            if keys[slot] == key:
                result = found[slot]
                sp -= 1
                continue
            k[sp] = 0
            least[sp] = np.inf
        elif result < np.inf:
            least[sp] = min(least[sp], factor[sp] * result)
        level = order[sp]
        v = k[sp]
        weight = 1.0
        while v < sizes[level]:
            weight = 1.0
            if in_b[sp] == 0:
                weight = b_marginals[offset[level] + v]
            if weight != 0.0:
                break
            v += 1
        if v == sizes[level] or least[sp] == 0.0:
            result = least[sp]
            keys[slot] = key
            found[slot] = result
            sp -= 1
            continue
        weight = 1.0 / weight
        if in_a[sp] == 0:
            weight *= a_marginals[offset[level] + v]
        k[sp] = v + 1
        factor[sp] = weight
        if a_levels[x] == level:
            x = int64(a_children[a_first[x] + v])
        if b_levels[y] == level:
            y = int64(b_children[b_first[y] + v])
        sp += 1
        a[sp] = x
        b[sp] = y
        k[sp] = -1
    return result


class Remembered:
    """The lossy table that passes over two diagrams share; entries of earlier passes never match."""

    def __init__(self) -> None:
        self.keys: IntArray = np.full(REMEMBERED, -1, dtype=np.int64)
        self.found: FloatArray = np.empty(REMEMBERED)
        self.stamp = 0

    def next_pass(self, pairs: int) -> int:
        """Where the keys of the next pass begin, which has so many pairs at most."""
        begin = self.stamp
        self.stamp += pairs
        if self.stamp >= 2**62:
            self.keys[:] = -1
            begin, self.stamp = 0, pairs
        return begin


class Forest:
    """Diagrams as flat arrays; `roots[i]` is the node of the i-th that was added."""

    def __init__(self, manager: Manager) -> None:
        self.manager = manager
        self.sizes: Int32Array = manager.arity
        self.levels: Int32Array = np.empty(64, dtype=np.int32)
        self.first: Int32Array = np.empty(64, dtype=np.int32)
        self.value: FloatArray = np.zeros(64)
        self.children: Int32Array = np.empty(128, dtype=np.int32)
        self.nodes = 0
        self.edges = 0
        self.roots: list[int] = []
        self.starts: list[int] = []  # [i] the first of the nodes that were added with the i-th diagram

    def __len__(self) -> int:
        return len(self.roots)

    def add(self, diagram: Diagram) -> int:
        """Append a float diagram; its number."""
        return self.add_all([diagram])

    def add_all(self, diagrams: Sequence[Diagram]) -> int:
        """Append float diagrams that share their nodes; the number of the first."""
        require(diagrams, FLOAT)
        manager = self.manager
        nodes = Walk(diagrams[0]).nodes
        if len(diagrams) > 1:  # a child stands before its parents in the store
            nodes = np.unique(np.concatenate([nodes, *(Walk(d).nodes for d in diagrams[1:])]))
        manager.walks += 1  # which makes older walks number their nodes again
        manager.pool[nodes + 1] = np.arange(len(nodes), dtype=np.int32)
        levels = manager.pool[nodes]
        count = len(nodes)
        edges = int(manager.arity[levels[levels < manager.leaf_level]].sum())
        self._room(count, edges)
        begin, end = self.nodes, self.nodes + count
        export(
            manager.pool, manager.arity, nodes, begin, self.edges, self.levels[begin:end],
            self.first[begin:end], self.children[self.edges :], self.value[begin:end],
        )  # fmt: skip
        self.nodes, self.edges = end, self.edges + edges
        number = len(self.roots)
        for diagram in diagrams:
            self.starts.append(begin)
            self.roots.append(begin + int(manager.pool[diagram.node + 1]))
        return number

    def _room(self, nodes: int, edges: int) -> None:
        if self.nodes + nodes > len(self.levels):
            size = 2 * (self.nodes + nodes)
            self.levels = _longer(self.levels, size)
            self.first = _longer(self.first, size)
            self.value = _longer(self.value, size)
        if self.edges + edges > len(self.children):
            self.children = _longer(self.children, 2 * (self.edges + edges))

    @property
    def bytes(self) -> int:
        """Memory that the arrays take."""
        return self.levels.nbytes + self.first.nbytes + self.value.nbytes + self.children.nbytes

    def under_product(self, offset: IntArray, marginals: FloatArray, since: int = 0) -> FloatArray:
        """The expectations of the diagrams from number `since` on, under a product of distributions."""
        if since >= len(self.roots):
            return np.empty(0)
        start = self.starts[since]
        out = np.empty(self.nodes - start)
        expectations(
            self.levels, self.first, self.children, self.value, self.sizes, offset, marginals, start, out
        )
        result: FloatArray = out[np.array(self.roots[since:]) - start]
        return result

    def under_joint(
        self,
        joint: Forest,
        ways: FloatArray,
        offset: IntArray,
        marginals: FloatArray,
        table: Remembered,
        since: int = 0,
    ) -> FloatArray:
        """The same where a cluster has the joint distribution that `joint` holds as its one diagram."""
        result = np.empty(len(self.roots) - since)
        stamp = table.next_pass(len(self.levels) * len(joint.levels))
        pair_expectations(
            np.array(self.roots[since:], dtype=np.int64), joint.roots[0],
            self.levels, self.first, self.children, self.value,
            joint.levels, joint.first, joint.children, joint.value,
            self.sizes, offset, marginals, ways, table.keys, table.found, stamp, result,
        )  # fmt: skip
        return result


def _longer(array: Any, size: int) -> Any:
    result = np.zeros(size, dtype=array.dtype)
    result[: len(array)] = array
    return result
