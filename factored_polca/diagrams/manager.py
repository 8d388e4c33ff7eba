"""The manager: the one mutable thing.  It owns the node store, grows it, collects garbage.

One thread owns a manager.  Diagrams are handles into a table of roots; a handle that Python drops
frees its root, and garbage collection keeps what roots reach and renumbers it.  Kernels that find
the store full are resumed after growth.  Between slices of a long operation the manager looks for
Ctrl-C (Python raises it there), for `abort()` called by another thread, and for `deadline`.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.diagram import Diagram
from factored_polca.diagrams.field import Field
from factored_polca.diagrams.leaves import FLOAT, INDEX, LeafType, describe
from factored_polca.diagrams.nodes import (
    DONE,
    FIRST,
    FULL,
    INVALID,
    STEPS,
    Int32Array,
    Int64Array,
    compact,
    make_leaves,
    rehash,
)

MAXIMUM_LEVELS: Final = 20_000
_LARGEST_POOL: Final = 2**31 - 2**16


class MemoryLimit(MemoryError):
    """The node store may not grow further; the manager and all its diagrams stay usable."""


class Aborted(RuntimeError):
    """`abort()` was called or the deadline has passed; the manager stays usable."""


def available_memory() -> int:
    """Bytes of memory that this process may still take: what is free, or less where it has a limit."""
    free = _free_memory()
    try:
        import resource  # not everywhere

        limit, _ = resource.getrlimit(resource.RLIMIT_DATA)
        if limit == resource.RLIM_INFINITY:
            return free
        with open("/proc/self/status", encoding="ascii", errors="replace") as file:
            taken = next(int(line.split()[1]) * 1024 for line in file if line.startswith("VmData:"))
    except (ImportError, OSError, StopIteration):
        return free
    return max(0, min(free, limit - taken))


def _free_memory() -> int:
    """Bytes of memory that are free now, or 4 GiB where the system does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, ValueError, OSError):
        return 4 << 30


class Manager:
    """A store of reduced ordered diagrams over variables with `sizes` values, in this order.

    Args:
        sizes: the number of values of the variable at each level, the top one first.
        memory_limit: bytes for nodes and caches together; three quarters of the free memory if None.
        first_nodes: for about how many nodes there is room before the store first grows.
    """

    def __init__(
        self, sizes: Sequence[int], *, memory_limit: int | None = None, first_nodes: int = 1 << 14
    ) -> None:
        if len(sizes) > MAXIMUM_LEVELS:
            raise ValueError(f"{len(sizes)} levels; at most {MAXIMUM_LEVELS} are possible")
        if any(size < 1 for size in sizes):
            raise ValueError("every variable needs at least one value")
        self.sizes: tuple[int, ...] = tuple(int(size) for size in sizes)
        self.leaf_level = len(self.sizes)
        self.memory_limit = available_memory() * 3 // 4 if memory_limit is None else memory_limit
        self.deadline: float | None = None
        self.describe: Callable[[int], tuple[str, tuple[Any, ...]]] | None = (
            None  # a level's name and values
        )
        self.peak_nodes = 0
        self.peak_bytes = 0
        self.collections = 0
        self._made = 0
        self._counted = 0
        self._abort = False
        self._undisturbed = False
        self._fields: dict[int, int] = {}
        self._keys: dict[tuple[Hashable, ...], int] = {}
        self.operator_rows: dict[tuple[str, LeafType], Int64Array] = {}
        self.walks = 0

        self.arity: Int32Array = np.array([*self.sizes, 2], dtype=np.int32)
        room = 1 << max(4, (first_nodes - 1).bit_length())
        self.pool: Int32Array = np.zeros(4 * room, dtype=np.int32)
        self.head: Int64Array = np.array([FIRST, 0, 0], dtype=np.int64)
        self.unique: Int64Array = np.zeros(room, dtype=np.int64)
        self.cache: Int32Array = np.zeros(2 * room, dtype=np.int32)
        self.choice_cache: Int32Array = np.zeros(room // 2, dtype=np.int32)
        self.slots: Int64Array = np.zeros(room // 2, dtype=np.int64)
        self.ring: Int32Array = np.zeros(4 * room, dtype=np.int32)
        self.ring_state: Int64Array = np.zeros(1, dtype=np.int64)
        self.roots: Int32Array = np.zeros(1 << 8, dtype=np.int32)
        self._free = list(range(len(self.roots) - 1, -1, -1))

        levels = self.leaf_level + 3
        widest = max((*self.sizes, 2))
        self.stack: Int32Array = np.zeros(5 * levels, dtype=np.int32)
        self.results: Int32Array = np.zeros(sum(self.sizes) + 2 * widest + levels, dtype=np.int32)
        self.words: Int32Array = np.zeros(widest, dtype=np.int32)
        self.terms: Int32Array = np.zeros(2 * widest * levels + 2, dtype=np.int32)
        self._live = FIRST
        self._plan_collection()

    # -- handles ---------------------------------------------------------------------------

    def handle(self, node: int, leaf_type: LeafType) -> Diagram:
        """A diagram for `node`, kept alive from now on."""
        if not self._free:
            size = len(self.roots)
            self.roots = np.concatenate([self.roots, np.zeros(size, dtype=np.int32)])
            self._free.extend(range(2 * size - 1, size - 1, -1))
        slot = self._free.pop()
        self.roots[slot] = node
        return Diagram(self, slot, leaf_type)

    def release(self, slot: int) -> None:
        """Forget a root; called when a handle is dropped."""
        self.roots[slot] = 0
        self._free.append(slot)

    def leaf_nodes(self, payloads: npt.NDArray[np.uint64]) -> Int32Array:
        """The leaf node of each payload."""
        out = np.empty(len(payloads), dtype=np.int32)
        start = 0
        while start < len(payloads):
            done = make_leaves(self.pool, self.head, self.unique, self.arity, payloads, out, start)
            if done < len(payloads):
                self.grow()
            start = done
        return out

    def constant(self, value: int | float, leaf_type: LeafType = INDEX) -> Diagram:
        """The diagram that is `value` everywhere; for a field an integer mod p."""
        return self.stored_constant(leaf_type.encode(value), leaf_type)  # type: ignore[arg-type]

    def stored_constant(self, stored: int, leaf_type: LeafType) -> Diagram:
        """The diagram that has everywhere the leaf whose payload is `stored`."""
        return self.handle(int(self.leaf_nodes(np.array([stored], dtype=np.uint64))[0]), leaf_type)

    def variable(self, level: int, children: Sequence[Diagram]) -> Diagram:
        """The diagram that is `children[v]` where the variable at `level` has its value v.

        Raises:
            ValueError: a wrong number of children, or a child that tests `level` or one above it.
        """
        from factored_polca.diagrams.operations import node

        return node(self, level, children)

    def indicator(self, level: int, values: Sequence[int]) -> Diagram:
        """The condition that the variable at `level` has one of `values`."""
        true, false = self.constant(1), self.constant(0)
        chosen = set(values)
        return self.variable(level, [true if v in chosen else false for v in range(self.sizes[level])])

    def field_number(self, field: Field) -> int:
        """A small number for a field, for keys of caches."""
        return self._fields.setdefault(field.prime, len(self._fields) + 1)

    def step_number(self, step: float) -> int:
        """As `field_number`, for floats that are rounded to multiples of a power of 2 (0: they are not)."""
        if not step:
            return 0
        return self._fields.setdefault(-round(2000 + math.log2(step)), len(self._fields) + 1)

    def cache_key(self, *parts: Hashable) -> int:
        """A number for what `parts` name, to mark entries of `cache`; operators' keys are positive."""
        return -1 - self._keys.setdefault(parts, len(self._keys))

    # -- running kernels -------------------------------------------------------------------

    def abort(self) -> None:
        """Make the operation that runs now, in another thread, raise `Aborted`."""
        self._abort = True

    def pause(self) -> None:
        """Look for an abort or the deadline.

        Raises:
            Aborted: one of them is there.
        """
        if self._undisturbed:
            return
        if self._abort:
            self._abort = False
            raise Aborted("the computation was aborted")
        if self.deadline is not None and time.monotonic() > self.deadline:
            raise Aborted("the time limit was reached")

    @contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Inside, aborts and the deadline wait: for what is left to do after one of them came."""
        before, self._undisturbed = self._undisturbed, True
        try:
            yield
        finally:
            self._undisturbed = before

    def run(self, step: Callable[[], int]) -> None:
        """Call the resumable kernel `step` until it is done, growing the store as it asks.

        Raises:
            ValueError: a condition has a leaf that is neither 0 nor 1.
            MemoryLimit, Aborted: see there; the store is as good as before.
        """
        while True:
            code = step()
            if code == DONE:
                return
            if code == INVALID:
                raise ValueError("a condition needs leaves 0 and 1; make one of other leaves with relabel")
            self.pause()
            if code == FULL:
                self.grow()

    def safe_point(self) -> None:
        """Collect garbage if it is time; called before an operation, when all nodes in use have handles."""
        self.pause()
        if self.head[0] > self._collect_at:
            self.collect_garbage()

    @property
    def collect_at(self) -> int:
        """The end of the pool beyond which the next safe point collects garbage."""
        return self._collect_at

    def _plan_collection(self) -> None:
        """Collect when the store has trebled, earlier where the memory limit is near.

        Small stores are quick ones: what fits into the processor's caches.
        """
        room = len(self.pool)
        if self.bytes + 4 * (2 * room) <= self.memory_limit:
            room *= 2
        self._collect_at = min(max(1 << 18, 3 * self._live), (self._live + room) // 2)

    def collect_garbage(self) -> None:
        """Drop every node that no diagram reaches; all handles stay valid, caches are emptied.

        Everything that names nodes without a handle is emptied first: Ctrl-C between two of these
        statements does no harm.
        """
        self._note_peak()
        self.collections += 1
        self.operator_rows.clear()
        self.cache[:] = 0
        self.choice_cache[:] = 0
        self.slots[:] = 0
        self.ring_state[0] = 0
        stack = np.empty(2 * self.leaf_level + 4, np.int32)
        made = self.nodes_made
        compact(self.pool, self.head, self.unique, self.arity, self.roots, stack)
        self._made, self._counted = made, int(self.head[1])
        self._live = int(self.head[0])
        self._plan_collection()

    def grow(self) -> None:
        """Make room for more nodes.

        Raises:
            MemoryLimit: `memory_limit` forbids it.
        """
        self._note_peak()
        need = 2 + max((*self.sizes, 2))
        if self.head[0] + need > len(self.pool):
            size = min(2 * len(self.pool) + need, _LARGEST_POOL)
            self._claim(4 * size, size > len(self.pool))
            pool = np.empty(size, dtype=np.int32)
            pool[: self.head[0]] = self.pool[: self.head[0]]
            self.pool = pool
            self._plan_collection()
        if 2 * self.head[1] >= len(self.unique):
            self._claim(16 * len(self.unique))
            unique = np.zeros(2 * len(self.unique), dtype=np.int64)
            rehash(self.pool, self.head, unique, self.arity)
            self.unique = unique  # only now: Ctrl-C may have come while it was being filled
            self._grow_caches()

    def _claim(self, new_bytes: int, possible: bool = True) -> None:
        if not possible or self.bytes + new_bytes > self.memory_limit:
            self._collect_at = 0  # the next operation collects what this one leaves behind
            raise MemoryLimit(
                f"{int(self.head[1]):,} nodes fill the memory limit of {self.memory_limit / 2**20:,.0f} MiB"
            )

    def _grow_caches(self) -> None:
        """Double the caches, entries kept: an entry at a wrong place is only never found."""
        extra = self.cache.nbytes + self.choice_cache.nbytes + self.slots.nbytes + self.ring.nbytes
        if self.bytes + extra > self.memory_limit // 2 or len(self.cache) >= 4 << 24:
            return
        self.cache = np.concatenate([self.cache, self.cache])
        self.choice_cache = np.concatenate([self.choice_cache, self.choice_cache])
        self.slots = np.concatenate([self.slots, self.slots])
        size, end = len(self.ring), int(self.ring_state[0])
        ring = np.zeros(2 * size, dtype=np.int32)
        kept = np.arange(max(0, end - size), end)
        ring[kept & (2 * size - 1)] = self.ring[kept & (size - 1)]
        self.ring = ring

    # -- figures ---------------------------------------------------------------------------

    @property
    def bytes(self) -> int:
        """Bytes held by nodes, tables and caches."""
        arrays = (self.pool, self.unique, self.cache, self.choice_cache, self.slots, self.ring)
        return sum(array.nbytes for array in arrays)

    @property
    def node_count(self) -> int:
        """Nodes in the store, garbage included."""
        return int(self.head[1])

    @property
    def nodes_made(self) -> int:
        """How many nodes were ever made."""
        return self._made + int(self.head[1]) - self._counted

    def _note_peak(self) -> None:
        self.peak_nodes = max(self.peak_nodes, int(self.head[1]))
        self.peak_bytes = max(self.peak_bytes, self.bytes)

    def peaks(self) -> tuple[int, int]:
        """The largest number of nodes and of bytes so far."""
        self._note_peak()
        return self.peak_nodes, self.peak_bytes

    def assert_consistent(self) -> None:
        """Check the invariants of the store: order, reduction, uniqueness; for tests.

        Raises:
            AssertionError: one is broken.
        """
        seen: set[tuple[int, ...]] = set()
        node, count = FIRST, 0
        while node < self.head[0]:
            level = int(self.pool[node])
            words = tuple(int(w) for w in self.pool[node + 2 : node + 2 + self.arity[level]])
            assert (level, *words) not in seen, "a node is stored twice"
            seen.add((level, *words))
            if level < self.leaf_level:
                assert len(set(words)) > 1, "a node tests nothing"
                assert all(FIRST <= child < node for child in words), "a child is not below"
                assert all(self.pool[child] > level for child in words), "levels do not increase"
            node += 2 + len(words)
            count += 1
        assert count == self.head[1], "the number of nodes is wrong"

    def __reduce__(self) -> tuple[object, ...]:
        raise TypeError("managers are not pickled; use factored_polca.diagrams.dump and load")

    def __repr__(self) -> str:
        return (
            f"<Manager: {self.leaf_level} levels, {self.node_count:,} nodes, {self.bytes / 2**20:.0f} MiB>"
        )


def require(diagrams: Sequence[Diagram], leaf_type: LeafType | None = None) -> Manager:
    """The common manager of `diagrams`.

    Raises:
        ValueError: no diagrams, two managers, two leaf types, or another leaf type than asked for.
    """
    if not diagrams:
        raise ValueError("at least one diagram is needed")
    manager = diagrams[0].manager
    wanted = diagrams[0].leaf_type if leaf_type is None else leaf_type
    for diagram in diagrams:
        if diagram.manager is not manager:
            raise ValueError("diagrams of two managers can't be combined; dump and load one of them")
        if diagram.leaf_type != wanted:
            raise ValueError(
                f"a diagram with {describe(diagram.leaf_type)} leaves where "
                f"{describe(wanted)} leaves are needed"
            )
    return manager


__all__ = ["FLOAT", "INDEX", "STEPS", "Aborted", "Manager", "MemoryLimit", "available_memory", "require"]
