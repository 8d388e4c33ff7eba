"""Push probability mass down the diagram of a partition: the rows of a quotient.

For a state x and an action a the next features x_i' are drawn in the order of the diagram's levels, so
the mass that reaches block k is

    T_a(x, k) = sum over paths of P to k of prod_i P_a(x_i' | x, parents).

The walk needs one *plan* for each action, made once for all states: a graph of places, each a node
of P together with the values of those synchronic parents that later features still need.  At a
level that P skips nothing is drawn, unless the feature is such a parent.  A parent that stands
*below* its child in the order is guessed first: there is one root for each combination of guessed
values, and at the parent's level only the guessed value is drawn.

    slot            a feature with values of its synchronic parents; selects one row for each x
    children[q, v]  the place after value v at place q, or -1

`push_floats` runs over many states in numba; `push_exact` is the same walk in rationals.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import Diagram, evaluate_states, support
from factored_polca.diagrams.jit import kernel
from factored_polca.diagrams.operations import Walk, leaf_payloads
from factored_polca.symbolic import RowDiagram, SymbolicModel

Int32Array = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Slot:
    """A feature and the value numbers of its synchronic parents (pairs feature, value)."""

    feature: int
    parents: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True)
class PushPlan:
    """The places of one action's walk down a diagram; places are numbered level by level.

    `leaf[q]` is the leaf's value at an end place and -1 elsewhere.
    """

    slots: tuple[Slot, ...]
    roots: Int32Array  # [root]
    slot: Int32Array  # [place], -1 at the ends
    level: Int32Array  # [place], 0 for the first that there is, 1 for the next, ..
    first_child: Int64Array  # [place]
    children: Int32Array  # flat
    leaf: Int64Array  # [place]


def make_plan(symbolic: SymbolicModel, diagram: Diagram, rows: Mapping[int, RowDiagram]) -> PushPlan:
    """The plan of a walk down `diagram` (over present variables) under the given row diagrams."""
    manager = symbolic.manager
    names = symbolic.order
    feature_at = {symbolic.now(i) // 2: i for i in range(len(names))}
    position = {feature: place for place, feature in feature_at.items()}
    needed = _needed_parents(symbolic, diagram, rows)
    if not any(row.parents_next for row in rows.values()):
        return _plain_plan(symbolic, diagram)
    parents_of = {i: tuple(p for p in rows[i].parents_next) if i in rows else () for i in range(len(names))}
    drawn = {i for level in support(diagram) for i in [feature_at[level // 2]]} | needed
    guessed = tuple(sorted({p for i in drawn for p in parents_of[i] if position[p] > position[i]}))
    last_use = {p: max(position[i] for i in drawn if p in parents_of[i]) for p in needed}
    last_use |= {p: max(last_use.get(p, 0), position[p]) for p in guessed}
    sizes = [len(f.values) for f in symbolic.model.features]
    Key = tuple[int, tuple[tuple[int, int], ...], int]  # node, carried values, position
    pool = manager.pool
    root = diagram.node

    def settle(node: int, carried: dict[int, int], place: int) -> Key:
        """The next place at or after `place` where something is drawn."""
        top = int(pool[node]) // 2 if pool[node] < manager.leaf_level else len(names)
        while place < top and feature_at[place] not in needed:
            place += 1
        kept = {p: v for p, v in carried.items() if last_use[p] >= place}
        return node, tuple(sorted(kept.items())), place

    slots: dict[Slot, int] = {}
    starts = [
        settle(root, dict(zip(guessed, values, strict=True)), 0)
        for values in itertools.product(*(range(sizes[p]) for p in guessed))
    ]
    buckets: list[dict[Key, int]] = [{} for _ in range(len(names) + 1)]
    for start in starts:
        buckets[start[2]].setdefault(start, -1)
    order: list[Key] = []
    edges: list[list[Key | None]] = []
    slot_of: list[int] = []
    for place in range(len(names) + 1):
        for key in list(buckets[place]):
            buckets[place][key] = len(order)
            order.append(key)
            if place == len(names):
                edges.append([])
                slot_of.append(-1)
                continue
            node, carried_items, _ = key
            carried = dict(carried_items)
            feature = feature_at[place]
            chosen = Slot(feature, tuple((p, carried[p]) for p in parents_of[feature]))
            slot_of.append(slots.setdefault(chosen, len(slots)))
            following: list[Key | None] = []
            for value in range(sizes[feature]):
                if feature in guessed and carried[feature] != value:
                    following.append(None)
                    continue
                child = node
                if pool[node] == 2 * place:
                    child = int(pool[node + 2 + value])
                after = {**carried, feature: value} if feature in needed else carried
                target = settle(child, after, place + 1)
                buckets[target[2]].setdefault(target, -1)
                following.append(target)
            edges.append(following)
    numbers = {key: number for number, key in enumerate(order)}
    first = np.concatenate([[0], np.cumsum([len(e) for e in edges])]).astype(np.int64)
    children = [-1 if key is None else numbers[key] for e in edges for key in e]
    ends = np.array([-1 if edges[q] else order[q][0] for q in range(len(order))], dtype=np.int64)
    at_end = ends >= 0
    ends[at_end] = leaf_payloads(manager, ends[at_end].astype(np.int32)).astype(np.int64)
    return PushPlan(
        tuple(slots), np.array([numbers[start] for start in starts], dtype=np.int32),
        np.array(slot_of, dtype=np.int32), _ranks([key[2] for key in order]), first,
        np.array(children, dtype=np.int32), ends,
    )  # fmt: skip


def _ranks(levels: npt.ArrayLike) -> Int32Array:
    """Levels, in ascending order, counted without gaps."""
    return np.cumsum(np.diff(levels, prepend=np.asarray(levels)[:1]) > 0).astype(np.int32)


def _needed_parents(symbolic: SymbolicModel, diagram: Diagram, rows: Mapping[int, RowDiagram]) -> set[int]:
    """Features whose drawn value a feature that matters depends on: synchronic ancestors of the support."""
    positions = {symbolic.now(i) // 2: i for i in range(len(symbolic.order))}
    frontier = [positions[level // 2] for level in support(diagram)]
    needed: set[int] = set()
    while frontier:
        feature = frontier.pop()
        for parent in rows[feature].parents_next if feature in rows else ():
            if parent not in needed:
                needed.add(parent)
                frontier.append(parent)
    return needed


def _plain_plan(symbolic: SymbolicModel, diagram: Diagram) -> PushPlan:
    """Without synchronic arcs places are nodes, sorted by level."""
    manager = symbolic.manager
    walk = Walk(diagram)
    by_level = np.argsort(walk.levels, kind="stable")
    number = np.empty(len(by_level), dtype=np.int32)
    number[by_level] = np.arange(len(by_level), dtype=np.int32)
    nodes, levels = walk.nodes[by_level], walk.levels[by_level]
    inner = levels < manager.leaf_level
    sizes = np.where(inner, manager.arity[levels], 0).astype(np.int64)
    first = np.concatenate([[0], np.cumsum(sizes)])
    where = np.repeat(nodes.astype(np.int64) + 2, sizes) + (
        np.arange(first[-1]) - np.repeat(first[:-1], sizes)
    )
    children = number[manager.pool[manager.pool[where] + 1]]
    feature_at = np.full(manager.leaf_level + 1, -1, dtype=np.int32)
    for feature in range(len(symbolic.order)):
        feature_at[symbolic.now(feature)] = feature
    drawn, slot = np.unique(feature_at[levels[inner]], return_inverse=True)
    slots = np.full(len(nodes), -1, dtype=np.int32)
    slots[inner] = slot.reshape(-1)
    leaf = np.full(len(nodes), -1, dtype=np.int64)
    leaf[~inner] = leaf_payloads(manager, nodes[~inner]).astype(np.int64)
    return PushPlan(
        tuple(Slot(int(i)) for i in drawn),
        number[-1:].copy(), slots, _ranks(levels), first.astype(np.int64),
        children.astype(np.int32), leaf,
    )  # fmt: skip


ExactRow = tuple[tuple[int, Fraction], ...]
"""The values of a feature that have a positive probability, with it."""


@dataclass(frozen=True)
class RowTable:
    """Rows of many features as flat lists of (value, probability), positive entries only."""

    start: Int64Array  # [row]
    value: Int32Array
    probability: FloatArray
    exact: tuple[ExactRow, ...]
    offset: dict[int, int]  # feature -> number of its first row; persisting features: rows by value


def exact_rows(
    symbolic: SymbolicModel, rows: Mapping[int, RowDiagram]
) -> tuple[tuple[ExactRow, ...], dict[int, int]]:
    """All rows of an action: of its row diagrams, and unit rows for features that persist.

    Returns:
        the rows; feature -> the number of its first one.
    """
    exact: list[ExactRow] = []
    offset: dict[int, int] = {}
    for feature, definition in enumerate(symbolic.model.features):
        offset[feature] = len(exact)
        if feature in rows:
            exact += [tuple((v, q) for v, q in enumerate(row) if q) for row in rows[feature].rows]
        else:
            exact += [((v, Fraction(1)),) for v in range(len(definition.values))]
    return tuple(exact), offset


def row_table(symbolic: SymbolicModel, rows: Mapping[int, RowDiagram]) -> RowTable:
    """All rows of an action, as `exact_rows` lists them."""
    exact, offset = exact_rows(symbolic, rows)
    start = np.concatenate([[0], np.cumsum([len(row) for row in exact])]).astype(np.int64)
    value = np.array([v for row in exact for v, _ in row], dtype=np.int32)
    probability = np.array([float(q) for row in exact for _, q in row], dtype=np.float64)
    return RowTable(start, value, probability, exact, offset)


def rows_at(
    symbolic: SymbolicModel,
    rows: Mapping[int, RowDiagram],
    table: RowTable,
    slots: Sequence[Slot],
    states: npt.NDArray[np.int32],
) -> Int32Array:
    """The row that each slot selects at each state: int32 [state, slot]; `states` is [state, feature]."""
    count, columns = len(symbolic.model.features), symbolic.columns()
    features = np.array([slot.feature for slot in slots], dtype=np.int64)
    offsets = np.array([table.offset[slot.feature] for slot in slots], dtype=np.int32)
    result: Int32Array = np.take(states, features, axis=1) + offsets  # of those that persist
    pairs = states
    if any(slot.parents for slot in slots):
        pairs = np.zeros((len(states), 2 * count), dtype=np.int32)
        pairs[:, :count] = states
    for number, slot in enumerate(slots):
        if slot.feature in rows:
            for parent, value in slot.parents:
                pairs[:, count + parent] = value
            found = evaluate_states(rows[slot.feature].diagram, pairs, columns)
            result[:, number] = offsets[number] + found.astype(np.int32)
    return result


PAIRS = 1 << 19
"""Pairs that `push_floats` writes before it hands control back."""


@kernel
def push_floats(
    roots: Int32Array, slot: Int32Array, level: Int32Array, first_child: Int64Array, children: Int32Array,
    leaf: Int64Array, start: Int64Array, value: Int32Array, probability: FloatArray,
    chosen: Int32Array, row_ends: Int64Array, blocks: Int64Array, masses: FloatArray, state: Int64Array,
) -> int:  # fmt: skip
    """Write the rows of states state[0].. as (block, mass) pairs.

    Answers 0 when done, 1 if the room ran out, 2 after `PAIRS` pairs, so that Ctrl-C is seen.
    `state` is [next row, pairs written].  Each level has a list of its places that mass has come to, so
    that a place has all its mass when it is taken; a level's list begins where its places do.

    What a level sends on depends on the rows selected at that level and above.  So a state begins at the
    first level where its rows are not those of the state before: what was sent from there on is taken back,
    the last first, to what `log` says the mass of a place was.  Representatives in their order differ but
    at a few levels below.
    """
    places = len(slot)
    slots = chosen.shape[1]
    levels = level[places - 1] + 1
    begins = np.zeros(levels, np.int64)
    for j in range(places - 1):
        if level[j + 1] != level[j]:
            begins[level[j + 1]] = j + 1
    count = np.zeros(levels, np.int64)
    level_of = np.full(slots, levels, np.int64)  # of slots
    largest = 0
    for q in range(places):
        if slot[q] >= 0:
            level_of[slot[q]] = level[q]
        if leaf[q] > largest:
            largest = leaf[q]
    waiting = np.empty(places, np.int32)
    mass = np.zeros(places, np.float64)
    logged = np.empty(len(children), np.int32)
    log = np.empty(len(children), np.float64)
    log_begins = np.zeros(levels + 1, np.int64)
    total = np.zeros(largest + 1, np.float64)
    leaves = np.empty(largest + 2, np.int32)
    for j in range(len(roots)):
        q = roots[j]
        if mass[q] == 0.0:
            waiting[begins[level[q]] + count[level[q]]] = q
            count[level[q]] += 1
        mass[q] += 1.0
    begun = False
    pause_at = state[1] + PAIRS
    while state[0] < len(chosen):
        if state[1] >= pause_at:
            return 2
        row = state[0]
        at = 0
        if begun:
            at = levels
            for j in range(slots):
                if chosen[row, j] != chosen[row - 1, j]:
                    at = min(at, level_of[j])
            for k in range(log_begins[levels] - 1, log_begins[at] - 1, -1):
                q = logged[k]
                mass[q] = log[k]
                if log[k] == 0.0:
                    count[level[q]] -= 1
        written = log_begins[at]
        while at < levels:
            log_begins[at] = written
            for i in range(begins[at], begins[at] + count[at]):
                q = waiting[i]
                if slot[q] < 0:
                    continue
                m = mass[q]
                r = chosen[row, slot[q]]
                for e in range(start[r], start[r + 1]):
                    child = children[first_child[q] + value[e]]
                    part = m * probability[e]
                    if child < 0 or part == 0.0:  # 0 where it is too small for a float
                        continue
                    if mass[child] == 0.0:
                        waiting[begins[level[child]] + count[level[child]]] = child
                        count[level[child]] += 1
                    logged[written] = child
                    log[written] = mass[child]
                    written += 1
                    mass[child] += part
            at += 1
        log_begins[levels] = written
        begun = True
        ends = 0
        smallest = largest
        for i in range(begins[levels - 1], begins[levels - 1] + count[levels - 1]):
            k = leaf[waiting[i]]
            if total[k] == 0.0:
                leaves[ends] = k
                ends += 1
                smallest = min(smallest, k)
            total[k] += mass[waiting[i]]
        if state[1] + ends > len(blocks):
            for j in range(ends):
                total[leaves[j]] = 0.0
            return 1
        if 8 * ends < largest - smallest:
            for j in range(1, ends):
                _heap_push(leaves, j, leaves[j])
            size = ends
            for j in range(ends):
                k = leaves[0]
                size = _heap_pop(leaves, size)
                blocks[state[1] + j] = k
                masses[state[1] + j] = total[k]
                total[k] = 0.0
            state[1] += ends
        else:
            k = smallest
            for _ in range(ends):
                while total[k] == 0.0:
                    k += 1
                blocks[state[1]] = k
                masses[state[1]] = total[k]
                total[k] = 0.0
                state[1] += 1
        row_ends[row] = state[1]
        state[0] += 1
    return 0


@kernel
def _heap_push(heap: Int32Array, size: int, item: int) -> int:
    i = size
    while i > 0:
        parent = (i - 1) >> 1
        if heap[parent] <= item:
            break
        heap[i] = heap[parent]
        i = parent
    heap[i] = item
    return size + 1


@kernel
def _heap_pop(heap: Int32Array, size: int) -> int:
    size -= 1
    item = heap[size]
    i = 0
    while 2 * i + 1 < size:
        child = 2 * i + 1
        if child + 1 < size and heap[child + 1] < heap[child]:
            child += 1
        if item <= heap[child]:
            break
        heap[i] = heap[child]
        i = child
    heap[i] = item
    return size


def push_exact(plan: PushPlan, table: RowTable, chosen: Int32Array) -> dict[int, Fraction]:
    """The exact mass of each leaf for one state, whose rows are `chosen` [slot]."""
    mass: dict[int, Fraction] = {}
    for root in plan.roots.tolist():
        mass[root] = mass.get(root, Fraction(0)) + 1
    result: dict[int, Fraction] = {}
    heap = sorted(mass)
    while heap:
        place = heapq.heappop(heap)
        here = mass.pop(place)
        slot = int(plan.slot[place])
        if slot < 0:
            leaf = int(plan.leaf[place])
            result[leaf] = result.get(leaf, Fraction(0)) + here
            continue
        for value, chance in table.exact[int(chosen[slot])]:
            child = int(plan.children[plan.first_child[place] + value])
            if child < 0:
                continue
            if child not in mass:
                heapq.heappush(heap, child)
                mass[child] = Fraction(0)
            mass[child] += here * chance
    return result
