"""Questions to a diagram: its leaves, size, values at states, counts and examples of states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.diagram import Diagram
from factored_polca.diagrams.field import MERSENNE_61, Field, is_prime
from factored_polca.diagrams.leaves import FLOAT, LeafType
from factored_polca.diagrams.leaves import payloads as leaf_payloads_of
from factored_polca.diagrams.manager import Manager
from factored_polca.diagrams.nodes import Int32Array, insert_all
from factored_polca.diagrams.operations import Walk, leaf_payloads, support
from factored_polca.diagrams.walk import count_states, evaluate, first_states


def node_count(diagram: Diagram) -> int:
    """The number of nodes, leaves included."""
    return len(Walk(diagram).nodes)


def leaves(diagram: Diagram) -> list[int | float]:
    """The distinct values, decoded, in order of first occurrence."""
    return [diagram.leaf_type.decode(int(p)) for p in Walk(diagram).leaf_payloads()]


def evaluate_states(diagram: Diagram, states: npt.NDArray[Any], columns: Sequence[int]) -> npt.NDArray[Any]:
    """The payloads at many states.

    Args:
        states: int array [row, column] of value numbers.
        columns: for each level the column that holds its value (any, where the level is not tested).

    Returns:
        uint64 payloads [row]; for index leaves they are the values, floats are to be viewed.

    Raises:
        ValueError: a level that is tested has no column, or a state a value it can't have.
    """
    manager = diagram.manager
    table = np.ascontiguousarray(states, dtype=np.int32)
    if table.ndim != 2 or len(columns) != manager.leaf_level:
        raise ValueError(
            f"states are an array [row, column], columns one for each of {manager.leaf_level} levels"
        )
    out = np.empty(len(table), dtype=np.int32)
    columns_array = np.asarray([*columns, 0], dtype=np.int32)
    done = evaluate(manager.pool, manager.arity, diagram.node, table, columns_array, out)
    if done < len(table):
        raise ValueError(f"row {done}, {table[done].tolist()}, lacks a column or has a value out of range")
    return leaf_payloads(manager, out)


def at(diagram: Diagram, values: Mapping[int, int]) -> int | float:
    """The value at one state, decoded; `values` maps levels to value numbers.

    Raises:
        KeyError: the diagram tests a level without a value.
        ValueError: the variable at a level has no such value.
    """
    manager, node = diagram.manager, diagram.node
    while (level := int(manager.pool[node])) < manager.leaf_level:
        value = values[level]
        if not 0 <= value < manager.sizes[level]:
            raise ValueError(f"value {value} at level {level}, which has {manager.sizes[level]} values")
        node = int(manager.pool[node + 2 + value])
    payload = int(leaf_payloads(manager, np.array([node], dtype=np.int32))[0])
    return diagram.leaf_type.decode(payload)


def states_of_leaves(diagram: Diagram, levels: Sequence[int]) -> list[int]:
    """The exact number of states of each leaf, by first occurrence, over the given levels.

    Counting runs modulo as many 61-bit primes as the number of states needs, and the Chinese
    remainder theorem puts the counts together.

    Raises:
        ValueError: the diagram tests a level that is not given.
    """
    manager = diagram.manager
    if missing := sorted(set(support(diagram)) - set(levels)):
        raise ValueError(f"the diagram tests levels {missing}; count states over all levels it tests")
    counted = [manager.sizes[i] if i in set(levels) else 1 for i in range(manager.leaf_level)]
    total = 1
    for size in counted:
        total *= size
    walk = Walk(diagram)
    modulus, counts = 1, [0] * int(walk.is_leaf.sum())
    prime = MERSENNE_61
    while True:
        residues = _count_modulo(walk, counted, prime)
        lift = pow(modulus, -1, prime)
        counts = [c + modulus * ((r - c) * lift % prime) for c, r in zip(counts, residues, strict=True)]
        modulus *= prime
        if modulus > total:
            return counts
        prime -= 2
        while not is_prime(prime):
            prime -= 2


def _count_modulo(walk: Walk, counted: Sequence[int], prime: int) -> list[int]:
    field, manager = Field(prime), walk.manager
    above, inverse = [field.encode(1)], [field.encode(1)]
    product = 1
    for size in counted:
        product = product * size % prime
        above.append(field.encode(product))
        inverse.append(field.encode(pow(product, -1, prime)))
    inverse.append(field.encode(1))
    totals = np.zeros(len(walk.nodes), dtype=np.uint64)
    count_states(
        manager.pool, manager.arity, walk.nodes, len(walk.nodes), np.array(above, dtype=np.uint64),
        np.array(inverse, dtype=np.uint64), field.parameters[0], field.parameters[1], totals,
    )  # fmt: skip
    return [field.decode(int(c)) for c in totals[walk.is_leaf]]


def states_for_leaves(diagram: Diagram) -> Int32Array:
    """The lexicographically first state of each leaf, by first occurrence: int32 [leaf, level]."""
    manager = diagram.manager
    count = int(Walk(diagram).is_leaf.sum())
    states = np.zeros((count, manager.leaf_level), dtype=np.int32)
    manager.walks += 1
    nodes = np.empty(int(manager.head[1]) + 1, dtype=np.int32)
    stack = np.empty(2 * manager.leaf_level + 4, dtype=np.int32)
    first_states(manager.pool, manager.arity, diagram.node, nodes, stack, states)
    return states


def dump(diagram: Diagram) -> dict[str, npt.NDArray[Any]]:
    """The diagram as arrays: `levels` [node], `children` (flat, node numbers), `leaves` (payloads)."""
    manager = diagram.manager
    walk = Walk(diagram)
    numbers = manager.pool[walk.nodes + 1]
    assert (numbers == np.arange(len(walk.nodes))).all(), "the walk is stale"
    parts = [
        manager.pool[manager.pool[node + 2 : node + 2 + manager.arity[level]] + 1]
        for node, level in zip(walk.nodes.tolist(), walk.levels.tolist(), strict=True)
        if level < manager.leaf_level
    ]
    children = np.concatenate(parts) if parts else np.empty(0, dtype=np.int32)
    return {"levels": walk.levels.copy(), "children": children, "leaves": walk.leaf_payloads()}


def _integers(arrays: Mapping[str, npt.NDArray[Any]], name: str) -> npt.NDArray[np.int64]:
    """One of the arrays that `dump` writes, checked to be a list of integers."""
    if name not in arrays:
        raise ValueError(f"a dumped diagram has arrays levels, children and leaves; {name!r} is missing")
    array = np.asarray(arrays[name])
    if array.ndim != 1 or (array.size and array.dtype.kind not in "iu"):
        raise ValueError(f"the diagram's {name} must be a list of integers")
    return array.astype(np.int64)


def load(manager: Manager, arrays: Mapping[str, npt.NDArray[Any]], leaf_type: LeafType) -> Diagram:
    """The diagram that `dump` wrote, in a manager with variables of the same sizes.

    Raises:
        ValueError: the arrays are no diagram over these variables.
    """
    levels, children, stored = (_integers(arrays, name) for name in ("levels", "children", "leaves"))
    payloads = leaf_payloads_of(leaf_type, stored.view(np.float64 if leaf_type == FLOAT else np.uint64))
    if len(levels) == 0 or levels.min() < 0 or levels.max() > manager.leaf_level:
        raise ValueError("the diagram has levels that the model has not")
    is_leaf = levels == manager.leaf_level
    sizes = np.where(is_leaf, 0, manager.arity[levels]).astype(np.int64)
    first = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    if first[-1] != len(children) or int(is_leaf.sum()) != len(payloads):
        raise ValueError("the diagram's arrays do not fit together")
    owner = np.repeat(np.arange(len(levels)), sizes)
    if len(children) and (
        children.min() < 0 or (children >= owner).any() or (levels[children] <= levels[owner]).any()
    ):
        raise ValueError("the diagram's nodes are not ordered")
    levels32, children32 = levels.astype(np.int32), children.astype(np.int32)
    manager.safe_point()
    out = np.zeros(len(levels), dtype=np.int32)
    out[is_leaf] = manager.leaf_nodes(payloads)
    progress = np.zeros(1, dtype=np.int64)

    def step() -> int:
        m = manager
        return insert_all(
            m.pool, m.head, m.unique, m.arity, levels32, first, children32, out, m.words, progress
        )

    manager.run(step)
    return manager.handle(int(out[-1]), leaf_type)
