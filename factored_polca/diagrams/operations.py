"""Operations that make diagrams from diagrams.

Each public function first lets the manager collect garbage, then runs one kernel (or composes
others that do).  All raise `MemoryLimit` when the store may not grow and `Aborted` on request.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import apply as codes
from factored_polca.diagrams.apply import apply_binary
from factored_polca.diagrams.apply import choose as choose_kernel
from factored_polca.diagrams.diagram import Diagram
from factored_polca.diagrams.field import Field
from factored_polca.diagrams.leaves import FLOAT, INDEX, FloatLeaves, LeafType, payloads
from factored_polca.diagrams.manager import Manager, require
from factored_polca.diagrams.nodes import STEPS, Int32Array, add_node
from factored_polca.diagrams.operators import OPERATORS, Kind, OperatorRow
from factored_polca.diagrams.walk import collect, rebuild
from factored_polca.diagrams.weighted import run_weighted_sum

_NO_FIELD = np.array([3, 1], dtype=np.uint64)


def node(manager: Manager, level: int, children: Sequence[Diagram]) -> Diagram:
    """The diagram that branches at `level` to `children`; see `Manager.variable`."""
    require_level(manager, level)
    if len(children) != manager.sizes[level]:
        raise ValueError(f"{len(children)} children at level {level}, which has {manager.sizes[level]}")
    if require(children) is not manager:
        raise ValueError("the children are diagrams of another manager; dump and load them")
    manager.safe_point()
    if any(child.level <= level for child in children):
        raise ValueError(f"a child of a node at level {level} must be below that level")
    words = np.array([child.node for child in children], dtype=np.int32)
    made = -1
    while made < 0:
        made = add_node(manager.pool, manager.head, manager.unique, manager.arity, level, words)
        if made < 0:
            manager.grow()
    return manager.handle(made, children[0].leaf_type)


def require_level(manager: Manager, level: int) -> None:
    """Refuse what is no level.

    Raises:
        ValueError: there is no such level.
    """
    if not 0 <= level < manager.leaf_level:
        raise ValueError(f"level {level}; levels are 0 to {manager.leaf_level - 1}")


def _kind(leaf_type: LeafType) -> Kind:
    if isinstance(leaf_type, Field):
        return "field"
    return "float" if isinstance(leaf_type, FloatLeaves) else "boolean"


def apply(name: str, a: Diagram, b: Diagram) -> Diagram:
    """The binary operator `name` of `OPERATORS`, pointwise.

    Raises:
        ValueError: no such operator on these leaves, or diagrams that do not fit together.
    """
    manager = require((a, b))
    row = OPERATORS.get((name, "any")) or OPERATORS.get((name, _kind(a.leaf_type)))
    if row is None:
        allowed = sorted(n for n, kind in OPERATORS if kind in ("any", _kind(a.leaf_type)))
        listed = ", ".join(allowed)
        raise ValueError(f"no operator {name!r} on {_kind(a.leaf_type)} leaves; there are {listed}")
    manager.safe_point()
    result_type = INDEX if row.gives == "boolean" else a.leaf_type
    field = a.leaf_type.parameters if isinstance(a.leaf_type, Field) else _NO_FIELD
    op = operator_row(manager, name, row, a.leaf_type, result_type)
    return manager.handle(_run_binary(manager, op, field, a, b), result_type)


def operator_row(
    manager: Manager, name: str, row: OperatorRow, leaf_type: LeafType, result_type: LeafType
) -> npt.NDArray[np.int64]:
    """The operator as `apply_binary` takes it, until the next collection."""
    op = manager.operator_rows.get((name, leaf_type))
    if op is None:
        op = manager.operator_rows[name, leaf_type] = _kernel_row(manager, row, leaf_type, result_type)
    return op


def _kernel_row(
    manager: Manager, row: OperatorRow, leaf_type: LeafType, result_type: LeafType
) -> npt.NDArray[np.int64]:
    """The operator for the kernel; its leaves have no handles, so the next collection drops it."""

    def leaf(value: float | None, leaf_type: LeafType) -> int:
        return 0 if value is None else manager.constant(value, leaf_type).node

    op = np.zeros(8, dtype=np.int64)
    op[codes.CODE] = row.code
    op[codes.LEFT_IDENTITY] = leaf(row.left_identity, leaf_type)
    op[codes.RIGHT_IDENTITY] = leaf(row.right_identity, leaf_type)
    op[codes.LEFT_ABSORBING] = leaf(row.left_absorbing, leaf_type)
    op[codes.RIGHT_ABSORBING] = leaf(row.right_absorbing, leaf_type)
    op[codes.COMMUTES] = row.commutes
    op[codes.SAME] = -1 if row.same == "argument" else leaf(row.same, result_type)
    number = manager.field_number(leaf_type) if isinstance(leaf_type, Field) else 0
    op[codes.KEY] = row.code + 64 * number
    return op


def _run_binary(
    manager: Manager, op: npt.NDArray[np.int64], field: npt.NDArray[np.uint64], a: Diagram, b: Diagram
) -> int:
    manager.stack[:4] = (a.node, b.node, -1, 0)
    state = np.array([1, 0], dtype=np.int64)

    def step() -> int:
        m = manager
        return apply_binary(
            m.pool, m.head, m.unique, m.arity, m.cache, op, field, m.stack, m.results, state
        )

    manager.run(step)
    return int(manager.results[0])


def pairs(a: Diagram, b: Diagram) -> tuple[Diagram, Int32Array, Int32Array]:
    """Number the distinct pairs of leaves (a(x), b(x)) by first occurrence.

    Returns:
        the diagram x -> number of its pair, and for each pair the leaf nodes of `a` and of `b`;
        the nodes are valid until the next operation.
    """
    manager = a.manager
    if b.manager is not manager:
        raise ValueError("diagrams of two managers can't be combined")
    manager.safe_point()
    op = np.zeros(8, dtype=np.int64)
    op[codes.CODE] = op[codes.KEY] = codes.PAIR
    paired = manager.handle(_run_binary(manager, op, _NO_FIELD, a, b), INDEX)
    walk = Walk(paired)
    keys = walk.leaf_payloads()
    numbered = walk.with_leaves(np.arange(len(keys), dtype=np.uint64), INDEX)
    first = (keys >> np.uint64(32)).astype(np.int32)
    second = (keys & np.uint64(0xFFFFFFFF)).astype(np.int32)
    return numbered, first, second


def combine(diagrams: Sequence[Diagram], function: Callable[..., Any]) -> tuple[Diagram, list[Any]]:
    """Apply any function of the leaves of several index diagrams, pointwise.

    Returns:
        the diagram x -> index into the list of distinct results (in order of first occurrence of
        their arguments), and that list.  Results must be hashable; `True` and 1 are kept apart.
    """
    manager = require(diagrams, INDEX)
    current = diagrams[0]
    walk = Walk(current)
    tuples: list[tuple[int, ...]] = [(int(p),) for p in walk.leaf_payloads()]
    current = walk.with_leaves(np.arange(len(tuples), dtype=np.uint64), INDEX)
    for diagram in diagrams[1:]:
        numbered, first, second = pairs(current, diagram)
        left = leaf_payloads(manager, first)
        right = leaf_payloads(manager, second)
        tuples = [(*tuples[int(i)], int(j)) for i, j in zip(left, right, strict=True)]
        current = numbered
    values: list[Any] = []
    numbers: dict[Any, int] = {}
    images = np.empty(len(tuples), dtype=np.uint64)
    for index, arguments in enumerate(tuples):
        value = function(*arguments)
        key = (type(value), value)
        if key not in numbers:
            numbers[key] = len(values)
            values.append(value)
        images[index] = numbers[key]
    return Walk(current).map_indices(images, INDEX), values


def leaf_payloads(manager: Manager, nodes: Int32Array) -> npt.NDArray[np.uint64]:
    """The payloads of leaf nodes."""
    low = manager.pool[nodes + 2].view(np.uint32).astype(np.uint64)
    high = manager.pool[nodes + 3].view(np.uint32).astype(np.uint64)
    return low | (high << np.uint64(32))


class Walk:
    """The nodes of one diagram, collected: children first, leaves by first occurrence.

    Valid until the next garbage collection, that is until the next operation with a safe point.
    `manager.pool[node + 1]` is a node's number in the walk until another walk begins.
    """

    def __init__(self, diagram: Diagram) -> None:
        manager = self.manager = diagram.manager
        self.diagram = diagram
        self._collections = manager.collections
        manager.walks += 1
        self._number = manager.walks
        nodes = np.empty(int(manager.head[1]) + 1, dtype=np.int32)
        stack = np.empty(2 * manager.leaf_level + 4, dtype=np.int32)
        count = collect(manager.pool, manager.arity, diagram.node, nodes, stack)
        self.nodes: Int32Array = nodes[:count]
        self.levels: Int32Array = manager.pool[self.nodes]
        self.is_leaf: npt.NDArray[np.bool_] = self.levels == manager.leaf_level

    def leaves(self) -> Int32Array:
        """The leaf nodes by first occurrence."""
        return self.nodes[self.is_leaf]

    def leaf_payloads(self) -> npt.NDArray[np.uint64]:
        """The payloads of the leaves by first occurrence."""
        self._refresh()
        return leaf_payloads(self.manager, self.leaves())

    def _refresh(self) -> None:
        """Number the nodes again where another walk came between."""
        manager = self.manager
        if self._collections != manager.collections:
            raise RuntimeError("a walk does not outlive a garbage collection; walk the diagram again")
        if self._number != manager.walks:
            manager.walks += 1
            self._number = manager.walks
            manager.pool[self.nodes + 1] = np.arange(len(self.nodes), dtype=np.int32)

    def map_indices(self, images: npt.NDArray[Any], leaf_type: LeafType) -> Diagram:
        """Replace leaf i of an index diagram by the value (or stored form) `images[i]`."""
        return self.with_leaves(images[self.leaf_payloads().astype(np.int64)], leaf_type)

    def with_leaves(self, images: npt.NDArray[Any], leaf_type: LeafType) -> Diagram:
        """Rebuild with new leaves, by first occurrence."""
        self._refresh()
        out = np.zeros(len(self.nodes), dtype=np.int32)
        out[self.is_leaf] = self.manager.leaf_nodes(payloads(leaf_type, images))
        return self._rebuilt(out, np.flatnonzero(~self.is_leaf), {}, {}, leaf_type)

    def with_levels(self, fixed: Mapping[int, int], moved: Mapping[int, int]) -> Diagram:
        """Rebuild with levels fixed to a value, or moved; nodes below all of them stay what they are."""
        self._refresh()
        last = max([*fixed, *moved], default=-1)
        changed = np.flatnonzero((self.levels <= last) & ~self.is_leaf)
        return self._rebuilt(self.nodes.copy(), changed, fixed, moved, self.diagram.leaf_type)

    def _rebuilt(
        self,
        images: Int32Array,
        changed: npt.NDArray[np.int64],
        fixed: Mapping[int, int],
        moved: Mapping[int, int],
        leaf_type: LeafType,
    ) -> Diagram:
        manager = self.manager
        fixed_child = np.full(manager.leaf_level + 1, -1, dtype=np.int32)
        level_map = np.arange(manager.leaf_level + 1, dtype=np.int32)
        for level, value in fixed.items():
            fixed_child[level] = value
        for level, target in moved.items():
            level_map[level] = target
        progress = np.zeros(1, dtype=np.int64)

        def step() -> int:
            m = manager
            return rebuild(
                m.pool, m.head, m.unique, m.arity, self.nodes, changed,
                fixed_child, level_map, images, m.words, progress,
            )  # fmt: skip

        manager.run(step)
        return manager.handle(int(images[-1]), leaf_type)


def substitute_leaves(
    diagram: Diagram, function: Callable[[Any], Any], leaf_type: LeafType | None = None
) -> Diagram:
    """Replace each leaf value by `function` of it; for a field the values are integers mod p."""
    diagram.manager.safe_point()
    target = diagram.leaf_type if leaf_type is None else leaf_type
    old = [diagram.leaf_type.decode(int(p)) for p in Walk(diagram).leaf_payloads()]
    images = np.array([target.encode(function(value)) for value in old], dtype=np.uint64)
    walk = Walk(diagram)  # only now: `function` may have used the manager
    if isinstance(target, FloatLeaves):
        return walk.with_leaves(images.view(np.float64), target)
    return walk.with_leaves(images, target)


def relabel(diagram: Diagram, values: npt.NDArray[Any], leaf_type: LeafType) -> Diagram:
    """Replace leaf i of an index diagram by `values[i]`, in stored form for a field."""
    require((diagram,), INDEX)
    diagram.manager.safe_point()
    return Walk(diagram).map_indices(values, leaf_type)


def renumber(diagram: Diagram) -> tuple[Diagram, npt.NDArray[np.uint64]]:
    """Number the leaves by first occurrence: the index diagram, and the old payload of each number."""
    diagram.manager.safe_point()
    walk = Walk(diagram)
    old = walk.leaf_payloads()
    return walk.with_leaves(np.arange(len(old), dtype=np.uint64), INDEX), old


def restrict(diagram: Diagram, values: Mapping[int, int]) -> Diagram:
    """The cofactor where each level in `values` has the given value."""
    manager = diagram.manager
    for level, value in values.items():
        require_level(manager, level)
        if not 0 <= value < manager.sizes[level]:
            raise ValueError(f"value {value} at level {level}, which has {manager.sizes[level]} values")
    manager.safe_point()
    return Walk(diagram).with_levels(values, {})


def move(diagram: Diagram, levels: Mapping[int, int]) -> Diagram:
    """The same function of other variables: level i becomes `levels[i]`.

    Raises:
        ValueError: the new levels do not keep the order, or the numbers of values differ.
    """
    manager = diagram.manager
    for level in {*levels, *levels.values()}:
        require_level(manager, level)
    tested = support(diagram)
    targets = [levels.get(level, level) for level in tested]
    if targets != sorted(set(targets)):
        raise ValueError("moving levels must keep their order")
    for level, target in zip(tested, targets, strict=True):
        if manager.sizes[level] != manager.sizes[target]:
            raise ValueError(f"levels {level} and {target} have different numbers of values")
    manager.safe_point()
    return Walk(diagram).with_levels({}, levels)


def support(diagram: Diagram) -> list[int]:
    """The levels that the diagram tests, in order."""
    levels = np.unique(Walk(diagram).levels)
    return [int(level) for level in levels if level < diagram.manager.leaf_level]


def choose(condition: Diagram, then: Diagram, otherwise: Diagram) -> Diagram:
    """`then` where `condition` is true, `otherwise` elsewhere.

    Raises:
        ValueError: diagrams that do not fit together, or a condition with leaves other than 0 and 1.
    """
    manager = require((then, otherwise))
    require((condition, condition), INDEX)
    if condition.manager is not manager:
        raise ValueError("diagrams of two managers can't be combined; dump and load one of them")
    manager.safe_point()
    true, false = manager.constant(1), manager.constant(0)
    manager.stack[:5] = (condition.node, then.node, otherwise.node, -1, 0)
    state = np.array([1, 0], dtype=np.int64)

    def step() -> int:
        m = manager
        return choose_kernel(
            m.pool, m.head, m.unique, m.arity, m.choice_cache, true.node, false.node,
            m.stack, m.results, state,
        )  # fmt: skip

    manager.run(step)
    return manager.handle(int(manager.results[0]), then.leaf_type)


def sum_options(
    manager: Manager, leaf_type: LeafType, normalised: bool, step: float = 0.0
) -> npt.NDArray[np.int64]:
    """The options of weighted sums; floats are rounded to multiples of `step`, a power of 2 or 0 (none)."""
    is_field = isinstance(leaf_type, Field)
    number = manager.field_number(leaf_type) if isinstance(leaf_type, Field) else manager.step_number(step)
    zero, one = manager.constant(0, leaf_type), manager.constant(1, leaf_type)
    bits = int(np.float64(step).view(np.int64))
    values = [zero.node, one.node, normalised, 2 * number + normalised, not is_field, bits]
    return np.array(values, dtype=np.int64)


def weighted_sum(
    weights: Sequence[Diagram], terms: Sequence[Diagram], *, normalised: bool = False
) -> Diagram:
    """sum_v weights[v] * terms[v], pointwise, as one recursion; 0 times infinity is 0.

    With `normalised` the weights must sum to 1 everywhere (a conditional distribution).

    Raises:
        ValueError: no terms, not one weight for each, or diagrams that do not fit together.
    """
    if len(weights) != len(terms):
        raise ValueError(f"{len(weights)} weights for {len(terms)} terms; each term needs one weight")
    manager = require([*weights, *terms])
    leaf_type = terms[0].leaf_type
    manager.safe_point()
    options = sum_options(manager, leaf_type, normalised)
    field = leaf_type.parameters if isinstance(leaf_type, Field) else _NO_FIELD
    needed = 2 * len(weights) * (manager.leaf_level + 3) + 2
    buffer = manager.terms if len(manager.terms) >= needed else np.empty(needed, dtype=np.int32)
    for v, (weight, term) in enumerate(zip(weights, terms, strict=True)):
        buffer[2 * v] = weight.node
        buffer[2 * v + 1] = term.node
    manager.stack[:5] = (0, len(weights), -1, 0, normalised)
    state = np.array([1, 0, STEPS], dtype=np.int64)

    def step() -> int:
        m = manager
        return run_weighted_sum(
            m.pool, m.head, m.unique, m.arity, m.slots, m.ring, m.ring_state, options, field,
            m.stack, buffer, m.results, state,
        )  # fmt: skip

    manager.run(step)
    return manager.handle(int(manager.results[0]), leaf_type)


def cofactors(diagram: Diagram, level: int) -> list[Diagram]:
    """The restriction to each value of the variable at `level`."""
    manager = diagram.manager
    require_level(manager, level)
    manager.safe_point()
    walk = Walk(diagram)
    return [walk.with_levels({level: v}, {}) for v in range(manager.sizes[level])]


def sum_out(diagram: Diagram, level: int) -> Diagram:
    """The sum over the values of the variable at `level`; for conditions their disjunction."""
    name = "or" if diagram.leaf_type == INDEX else "plus"
    return reduce(lambda a, b: apply(name, a, b), cofactors(diagram, level))


def max_out(diagram: Diagram, level: int) -> Diagram:
    """The maximum over the values of the variable at `level` (float leaves)."""
    return reduce(lambda a, b: apply("maximum", a, b), cofactors(diagram, level))


def argmax_out(diagram: Diagram, level: int) -> Diagram:
    """The first value of the variable at `level` that attains the maximum (float leaves)."""
    return argmax(cofactors(diagram, level))


def argmax(candidates: Sequence[Diagram]) -> Diagram:
    """The index of the first of several float diagrams that is largest, pointwise."""
    manager = require(candidates, FLOAT)
    best, index = candidates[0], manager.constant(0)
    for number, candidate in enumerate(candidates[1:], start=1):
        better = apply("less", best, candidate)
        index = choose(better, manager.constant(number), index)
        best = choose(better, candidate, best)
    return index
