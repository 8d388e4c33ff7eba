"""The store: growth, garbage, limits and interruption leave every diagram as it was."""

from __future__ import annotations

import copy
import gc
import pickle
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from diagram_tables import FLOAT, INDEX, Table, assert_table, from_table, random_table, states, tabulate

from factored_polca.diagrams import (
    MERSENNE_61,
    Aborted,
    Diagram,
    Field,
    Manager,
    MemoryLimit,
    apply,
    at,
    choose,
    cofactors,
    combine,
    dump,
    leaves,
    load,
    move,
    pairs,
    relabel,
    restrict,
    sum_out,
    weighted_sum,
)
from factored_polca.diagrams.nodes import rehash
from factored_polca.diagrams.operations import Walk
from factored_polca.models import Action, Feature, Model
from factored_polca.symbolic import NumericView, SymbolicModel, compile_model

P = MERSENNE_61
FIELD = Field()


def shrink(manager: Manager) -> None:
    """Leave room for nothing in the store, so that the next operations grow it at every turn."""
    manager.collect_garbage()
    manager.pool = manager.pool[: manager.head[0]].copy()
    size = 4
    while 2 * manager.node_count >= size:
        size *= 2
    unique = np.zeros(size, dtype=np.int64)
    rehash(manager.pool, manager.head, unique, manager.arity)
    manager.unique = unique


class Watched(Manager):
    """Counts how often the store grew."""

    grown = 0

    def grow(self) -> None:
        self.grown += 1
        super().grow()


Operation = Callable[[list[Diagram], list[Diagram], list[Diagram]], Diagram]
Definition = Callable[[list[Any], list[Any], list[Any]], Any]

OPERATIONS: dict[str, tuple[Operation, Definition]] = {
    "apply": (lambda b, i, f: b[0] & b[1] | b[2], lambda b, i, f: b[0] & b[1] | b[2]),
    "times": (lambda b, i, f: f[0] * f[1] + f[2], lambda b, i, f: (f[0] * f[1] + f[2]) % P),
    "choose": (lambda b, i, f: choose(b[0], f[1], f[2]), lambda b, i, f: f[1] if b[0] else f[2]),
    "weighted_sum": (
        lambda b, i, f: weighted_sum(f, [f[1], f[2], f[0]]),
        lambda b, i, f: (f[0] * f[1] + f[1] * f[2] + f[2] * f[0]) % P,
    ),
    "relabel": (
        lambda b, i, f: relabel(i[0], np.arange(90, 0, -1, dtype=np.uint64), INDEX),
        lambda b, i, f: 90 - i[0],
    ),
    "combine": (
        lambda b, i, f: relabel(*_numbered(combine(i, lambda x, y, z: x * y - z)), FLOAT),
        lambda b, i, f: float(i[0] * i[1] - i[2]),
    ),
    "load": (lambda b, i, f: load(f[0].manager, dump(f[0]), FIELD), lambda b, i, f: f[0]),
    "equal": (lambda b, i, f: f[0].equals(f[1]), lambda b, i, f: int(f[0] == f[1])),
}


def _numbered(result: tuple[Diagram, list[Any]]) -> tuple[Diagram, np.ndarray[Any, Any]]:
    return result[0], np.array(result[1], dtype=np.float64)


@pytest.mark.parametrize("sizes", [(2,) * 9, (3, 5, 1, 4, 3), (40, 6)], ids=str)
@pytest.mark.parametrize("name", OPERATIONS)
def test_the_store_may_grow_in_the_middle_of_any_operation(name: str, sizes: tuple[int, ...]) -> None:
    manager, random = Watched(sizes, first_nodes=1), np.random.default_rng([1, *sizes])
    tables: list[list[Table]] = [
        [np.asarray(np.vectorize(v.__getitem__, otypes=[object])(random.integers(0, len(v), sizes)))
         for _ in range(3)]
        for v in ([0, 1], list(range(90)), [0, 1, *range(5, 45)])
    ]  # fmt: skip
    kinds = [
        [from_table(manager, t, kind) for t in made]
        for made, kind in zip(tables, (INDEX, INDEX, FIELD), strict=True)
    ]
    operation, definition = OPERATIONS[name]
    shrink(manager)
    before = manager.grown
    result = operation(*kinds)
    if name != "load":
        assert manager.grown > before
    assert_table(result, tabulate(sizes, lambda s: definition(*([t[s] for t in made] for made in tables))))
    for made, diagrams in zip(tables, kinds, strict=True):
        for table, diagram in zip(made, diagrams, strict=True):
            assert_table(diagram, table)


def long_model(size: int) -> SymbolicModel:
    """Six features; the action redraws the last one near its value."""
    features = [Feature(f"{name}{i}", range(size)) for name in "xy" for i in range(3)]
    action = Action("draw", {"y2": f"{{y2: 0.5, (y2 + 1) % {size}: 0.5}}"})
    return compile_model(Model("m", features, [action]), order=[f.name for f in features])


def matching(manager: Manager, rows: list[int], columns: list[int]) -> list[Diagram]:
    """The conditions x_i = y_i for variables at the given levels."""
    result = []
    for x, y in zip(rows, columns, strict=True):
        size = manager.sizes[x]
        result.append(manager.variable(x, [manager.indicator(y, [v]) for v in range(size)]))
    return result


def assert_usable(manager: Manager) -> None:
    """New operations work and are right."""
    manager.assert_consistent()
    low, high = manager.indicator(0, [0, 1]), manager.indicator(4, [1, 2])
    both = low & high
    assert [at(both, {0: v, 4: w}) for v in range(4) for w in range(4)] == [
        int(v < 2 and w in (1, 2)) for v in range(4) for w in range(4)
    ]
    f = choose(both, manager.constant(3, FIELD), manager.constant(5, FIELD))
    g = weighted_sum([f, f], [f, manager.constant(1, FIELD)])
    assert [at(g, {0: 0, 4: 1}), at(g, {0: 2, 4: 0})] == [12, 30]
    assert leaves(sum_out(both, 0)) == [0, 1]


def test_regression_survives_growth_at_every_turn() -> None:
    symbolic = long_model(5)
    manager = symbolic.manager
    random = np.random.default_rng(2)
    table = tabulate([5] * 6, lambda s: 0)
    for s in states([5] * 6):
        table[s] = (s[0] == s[3]) * 7 + (s[2] + s[5]) % 4 * int(random.integers(1, 3))
    levels = [symbolic.now(i) for i in range(6)]
    small = Manager([5] * 6)
    value = load_moved(small, manager, from_table(small, table), levels)
    view = NumericView(symbolic, FIELD)
    value = relabel(value, np.array([FIELD.encode(v) for v in range(20)], dtype=np.uint64), FIELD)
    view.regress(0, relabel(manager.indicator(0, [0]), np.array([1, 2], dtype=np.uint64), FIELD))
    shrink(manager)
    result = view.regress(0, value)
    half = pow(2, -1, P)
    for s in states([5] * 6):
        expected = half * (table[s] + table[(*s[:5], (s[5] + 1) % 5)]) % P
        assert at(result, dict(zip(levels, s, strict=True))) == expected
    manager.assert_consistent()


def load_moved(source: Manager, target: Manager, diagram: Diagram, levels: list[int]) -> Diagram:
    """The same function of other levels of another manager."""
    assert source is not target
    arrays = dump(diagram)
    moved = np.array([*levels, target.leaf_level], dtype=np.int32)
    return load(target, {**arrays, "levels": moved[arrays["levels"]]}, diagram.leaf_type)


def test_a_collection_keeps_what_handles_reach_and_frees_the_rest() -> None:
    sizes = (3, 2, 4, 2)
    manager, random = Manager(sizes, first_nodes=1), np.random.default_rng(5)
    kept: list[tuple[Table, Diagram]] = []
    for round_number in range(30):
        table = random_table(random, sizes, [0, 1, 2, 3])
        diagram = from_table(manager, table, INDEX)
        if round_number % 3 == 0:
            kept.append((table, diagram))
        if round_number % 4 == 0 and kept:
            kept.pop(int(random.integers(len(kept))))
        del diagram
        manager.collect_garbage()
        for expected, live in kept:
            assert_table(live, expected)
    reachable = {int(n) for _, d in kept for n in Walk(d).nodes}
    manager.collect_garbage()
    assert manager.node_count == len(reachable)
    assert manager.collections == 31
    kept.clear()
    del live
    manager.collect_garbage()
    assert manager.node_count == 0


def test_a_collection_empties_every_cache() -> None:
    manager = Manager([2, 3, 2])
    a = from_table(manager, tabulate([2, 3, 2], lambda s: (s[0] + s[1]) % 2))
    b = from_table(manager, tabulate([2, 3, 2], lambda s: (s[2] * s[1]) % 2))
    f = relabel(a, np.array([1, 2], dtype=np.uint64), FIELD)
    held = [a & b, choose(a, b, ~b), weighted_sum([f, f], [f, f]), pairs(a, b)[0]]
    caches = [manager.cache, manager.choice_cache, manager.slots]
    assert all(cache.any() for cache in caches)
    manager.collect_garbage()
    assert not any(cache.any() for cache in caches)
    assert manager.operator_rows == {}
    assert held[0] == a & b
    assert held[1] == choose(a, b, ~b)
    assert held[2] == weighted_sum([f, f], [f, f])
    assert held[3] == pairs(a, b)[0]
    manager.assert_consistent()


class Restless(Manager):
    """Collects garbage at every safe point, so that nodes move whenever they may."""

    def safe_point(self) -> None:
        super().safe_point()
        self.collect_garbage()


def test_operations_stay_right_when_nodes_move_at_every_safe_point() -> None:
    sizes = (2, 3, 2, 2)
    random = np.random.default_rng(9)
    manager = Restless(sizes, first_nodes=1)
    for _ in range(5):
        b, i, f = (
            [random_table(random, sizes, values) for _ in range(3)]
            for values in ([0, 1], [0, 1, 2, 40], [0, 1, P - 2])
        )
        tables = [b, i, f]
        kinds = [
            [from_table(manager, t, kind) for t in made]
            for made, kind in zip(tables, (INDEX, INDEX, FIELD), strict=True)
        ]
        for operation, definition in OPERATIONS.values():
            expected = tabulate(
                sizes, lambda s, d=definition, m=tables: d(*([t[s] for t in made] for made in m))
            )
            assert_table(operation(*kinds), expected)
        total = sum_out(kinds[2][0], 1)
        expected = tabulate(sizes, lambda s, t=f[0]: sum(t[(s[0], v, *s[2:])] for v in range(3)) % P)
        assert_table(total, expected)
        assert_table(move(restrict(kinds[0][0], {0: 1, 3: 0}), {2: 3}), tabulate(
            sizes, lambda s, t=b[0]: t[1, s[1], s[3], 0]))  # fmt: skip
        parts = cofactors(kinds[1][0], 3)
        assert_table(parts[1], tabulate(sizes, lambda s, t=i[0]: t[(*s[:3], 1)]))
        del kinds, total, parts


def test_handles_dropped_along_the_way_free_their_nodes() -> None:
    manager = Manager([2] * 12, first_nodes=1)
    bits = [manager.indicator(level, [1]) for level in range(12)]
    parity = bits[0]
    for bit in bits[1:]:
        parity = (parity ^ bit) | (parity & ~parity)
    manager.collect_garbage()
    # Parity has one node at the top, two at each other level, of which one at the bottom is the last
    # bit; the other bits have a node each; there are two leaves.
    assert manager.node_count == 1 + 2 * 11 + 11 + 2
    cycle: list[Any] = [parity]
    cycle.append(cycle)
    del parity, cycle
    gc.collect()
    manager.collect_garbage()
    assert manager.node_count == 12 + 2
    assert all(leaves(bit) == [0, 1] for bit in bits)


def test_a_walk_notices_that_nodes_have_moved_and_repairs_its_numbers() -> None:
    manager = Manager([3, 3])
    a = from_table(manager, tabulate([3, 3], lambda s: s[0] * s[1]))
    b = from_table(manager, tabulate([3, 3], lambda s: max(s)))
    first, second = Walk(a), Walk(b)
    second.with_leaves(np.arange(3, dtype=np.uint64), INDEX)
    again = first.with_leaves(np.array([5, 6, 7, 8], dtype=np.uint64), INDEX)
    order = [0, 1, 2, 4]
    assert_table(again, tabulate([3, 3], lambda s: 5 + order.index(s[0] * s[1])))
    manager.collect_garbage()
    with pytest.raises(RuntimeError, match="does not outlive a garbage collection"):
        first.leaf_payloads()


def test_past_the_memory_limit_the_manager_stays_usable() -> None:
    manager = Manager([48] * 6, memory_limit=6 << 20)
    a, b, c = matching(manager, [0, 1, 2], [3, 4, 5])
    both = a & b
    kept = dump(both)
    for _ in range(2):
        with pytest.raises(MemoryLimit, match=r"nodes fill the memory limit of 6 MiB"):
            both & c
        assert manager.bytes <= manager.memory_limit
        assert_usable(manager)
        for name, array in dump(both).items():
            assert (array == kept[name]).all()
    assert a & b == both
    # What the failed operation left behind was collected, so there is room again.
    assert manager.collections >= 1
    assert manager.head[0] < len(manager.pool) // 2
    with pytest.raises(MemoryLimit):
        weighted_sum([relabel(d, np.array([0.5, 2.0]), FLOAT) for d in (a, b, c)],
                     [relabel(d, np.array([0.25, 3.0]), FLOAT) for d in (c, a, b)])  # fmt: skip
    assert_usable(manager)


def test_garbage_is_collected_before_the_memory_limit_is_reached() -> None:
    # Thousands of dead diagrams, each far smaller than the limit.
    manager = Manager([32] * 3, memory_limit=4 << 20)
    random = np.random.default_rng(0)
    kept = manager.indicator(2, [3])
    for _ in range(40):
        rows = [
            [manager.indicator(2, np.flatnonzero(random.integers(0, 2, 32)).tolist()) for _ in range(32)]
            for _ in range(4)
        ]
        for row in rows:
            diagram = manager.variable(0, [manager.variable(1, row)] * 31 + [kept])
            assert diagram & kept == kept & diagram
    assert leaves(kept) == [0, 1]


def test_a_limit_too_small_for_anything_is_an_error_of_its_own() -> None:
    manager = Manager([64] * 6, memory_limit=0)
    a, b, _ = matching(manager, [0, 1, 2], [3, 4, 5])
    with pytest.raises(MemoryLimit, match="limit of 0 MiB"):
        a & b


def run_and_abort(manager: Manager, operation: Callable[[], object]) -> None:
    """Call `operation` and, from another thread, abort it as soon as it has done some steps."""
    begun = int(manager.head[2])
    finished = threading.Event()

    def interrupt() -> None:
        while not finished.is_set() and int(manager.head[2]) == begun:
            time.sleep(0.001)
        manager.abort()

    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        with pytest.raises(Aborted, match="was aborted"):
            operation()
    finally:
        finished.set()
        thread.join()


def test_another_thread_can_abort_a_long_apply() -> None:
    manager = Manager([64] * 6)
    a, b, c = matching(manager, [0, 1, 2], [3, 4, 5])
    both = a & b
    run_and_abort(manager, lambda: both & c)
    assert_usable(manager)
    assert both == a & b
    three = both & c
    for s in ([1, 2, 3, 1, 2, 3], [1, 2, 3, 1, 2, 4], [0] * 6, [63, 0, 0, 62, 0, 0]):
        assert at(three, dict(enumerate(s))) == int(s[:3] == s[3:])


def long_value(symbolic: SymbolicModel) -> Diagram:
    now = [symbolic.now(i) for i in range(6)]
    a, b, c = matching(symbolic.manager, now[:3], now[3:])
    return relabel((a & b) & c, np.array([0, FIELD.encode(1)], dtype=np.uint64), FIELD)


def test_another_thread_can_abort_a_long_regression() -> None:
    symbolic = long_model(24)
    value = long_value(symbolic)
    view = NumericView(symbolic, FIELD)
    view.weights(0, 0)
    run_and_abort(symbolic.manager, lambda: view.regress(0, value))
    symbolic.manager.assert_consistent()
    result = view.regress(0, value)
    half = pow(2, -1, P)
    now = [symbolic.now(i) for i in range(6)]
    for s, expected in (([1, 2, 3, 1, 2, 3], half), ([1, 2, 3, 1, 2, 2], half), ([1, 2, 3, 1, 2, 4], 0)):
        assert at(result, dict(zip(now, s, strict=True))) == expected


def test_a_deadline_ends_long_operations_and_new_ones() -> None:
    manager = Manager([64] * 6)
    a, b, c = matching(manager, [0, 1, 2], [3, 4, 5])
    both = a & b
    manager.deadline = time.monotonic() + 0.01
    with pytest.raises(Aborted, match="time limit was reached"):
        both & c
    time.sleep(0.01)
    with pytest.raises(Aborted, match="time limit was reached"):
        a & b
    with manager.undisturbed():
        assert a & b == both
    with pytest.raises(Aborted):
        a & b
    manager.deadline = None
    assert_usable(manager)


def test_an_abort_with_nothing_under_way_meets_the_next_operation() -> None:
    manager = Manager([4] * 6)
    manager.abort()
    with pytest.raises(Aborted):
        manager.indicator(0, [0])
    assert_usable(manager)


def test_ctrl_c_between_any_two_steps_of_a_collection_does_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    # Python raises KeyboardInterrupt when a kernel returns: here after each kernel and each statement
    # that `collect_garbage` and `grow` call out to.
    import factored_polca.diagrams.manager as module

    for name in ("compact", "rehash"):
        for before in (True, False):
            manager = Manager([3] * 6, first_nodes=1)
            table = tabulate([3] * 6, lambda s: (s[0] * s[3] + s[1] * s[4] + s[2] * s[5]) % 3)
            kernel = getattr(module, name)

            def interrupted(*arguments: Any, kernel: Any = kernel, before: bool = before) -> None:
                if not before:
                    kernel(*arguments)
                raise KeyboardInterrupt

            diagram = from_table(manager, table)
            monkeypatch.setattr(module, name, interrupted)
            with pytest.raises(KeyboardInterrupt):
                manager.collect_garbage() if name == "compact" else fill(manager)
            monkeypatch.setattr(module, name, kernel)
            assert_table(diagram, table)
            assert from_table(manager, table) == diagram
            assert_table(apply("equal", diagram, diagram), tabulate([3] * 6, lambda s: 1))


def fill(manager: Manager) -> None:
    """Make leaves until the unique table grows."""
    size = len(manager.unique)
    while len(manager.unique) == size:
        manager.constant(manager.node_count)


def test_managers_and_diagrams_are_not_pickled_or_copied() -> None:
    manager = Manager([2])
    for thing in (manager, manager.indicator(0, [0])):
        for copier in (pickle.dumps, copy.copy, copy.deepcopy):
            with pytest.raises(TypeError, match="not pickled"):
                copier(thing)
    with pytest.raises(TypeError, match="unhashable"):
        hash(manager.indicator(0, [0]))


def test_a_manager_refuses_variables_that_can_not_be() -> None:
    with pytest.raises(ValueError, match="at least one value"):
        Manager([2, 0])
    with pytest.raises(ValueError, match="20001 levels; at most 20000"):
        Manager([2] * 20_001)


def test_thousands_of_levels_are_walked_without_recursion() -> None:
    count = 20_000
    manager = Manager([2] * count, first_nodes=1)
    even, odd = manager.constant(0), manager.constant(1)
    for level in reversed(range(count)):
        even, odd = manager.variable(level, [even, odd]), manager.variable(level, [odd, even])
    assert even ^ odd == manager.constant(1)
    assert choose(even, odd, even) == manager.constant(0)
    f = relabel(even, np.array([1.0, 0.0]), FLOAT)
    g = relabel(odd, np.array([1.0, 0.0]), FLOAT)
    assert weighted_sum([f, g], [g, f], normalised=True) == manager.constant(0.0, FLOAT)
    assert weighted_sum([f, g], [f, g]) == manager.constant(1.0, FLOAT)
    manager.collect_garbage()
    assert at(even, dict.fromkeys(range(count), 1)) == 0


def test_cache_keys_are_distinct_and_stay() -> None:
    manager = Manager([2])
    keys = [manager.cache_key("regression", action, prime) for action in range(50) for prime in range(50)]
    assert len(set(keys)) == 2500
    assert max(keys) < 0
    assert manager.cache_key("regression", 3, 4) == keys[3 * 50 + 4]
