"""Measure the diagram kernel: Boolean apply beside CUDD's, and the seconds that compiling takes.

    python tests/benchmarks/kernel.py [--pairs 5] [--quick]

Both sides build the same functions by the same sequence of apply calls over the same order of
one-bit variables, in one process, in interleaved pairs of runs, each run in a fresh manager; CUDD's
reordering is off.  Work is counted once for both: the nodes of the results of all calls, as diagrams
without complement edges.  So the ratio of rates is the ratio of times, and CUDD's complement edges
(free negation, up to half the nodes) count in its favour.  Only the calls are timed.

Arithmetic has no peer here: CUDD's leaves are doubles.  So multiplying modulo 2^61 - 1 stands beside
adding there, and beside both in doubles, on arguments of the same shape with random leaves, whose results
have the same shape too.

Compile seconds are the processor's in a fresh process with an empty `NUMBA_CACHE_DIR`, beside those
of the same process started again; they are not part of the rates.
"""

from __future__ import annotations

import argparse
import os
import platform
import random
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

Program = tuple[int, list[tuple[str, int, int]]]
"""The number of variables, and calls (operator, argument, argument) on earlier results.

Results 0 .. n - 1 are the variables, results n .. 2n - 1 their negations, later ones calls.
"""


class Recorder:
    """Writes a program."""

    def __init__(self, variables: int) -> None:
        self.variables = variables
        self.calls: list[tuple[str, int, int]] = []

    def call(self, name: str, a: int, b: int) -> int:
        self.calls.append((name, a, b))
        return 2 * self.variables + len(self.calls) - 1

    def fold(self, name: str, parts: list[int]) -> int:
        result = parts[0]
        for part in parts[1:]:
            result = self.call(name, result, part)
        return result

    def program(self) -> Program:
        return self.variables, self.calls


def queens(n: int) -> Program:
    """All placements of n queens on an n x n board: row by row, first excluding, then requiring."""
    write = Recorder(n * n)
    result = -1
    for row in range(n):
        for column in range(n):
            attacked = [
                r * n + c
                for r in range(n)
                for c in range(n)
                if (r, c) != (row, column) and (r == row or c == column or abs(r - row) == abs(c - column))
            ]
            free = write.fold("and", [n * n + i for i in reversed(attacked)])
            rule = write.call("or", n * n + row * n + column, free)
            result = rule if result < 0 else write.call("and", result, rule)
    for row in range(n):
        some = write.fold("or", [row * n + column for column in range(n)])
        result = write.call("and", result, some)
    return write.program()


def random_clauses(variables: int, clauses: int, seed: int) -> Program:
    """The conjunction of random clauses of three literals, one after the other."""
    generator = random.Random(seed)
    write = Recorder(variables)
    result = -1
    for _ in range(clauses):
        chosen = generator.sample(range(variables), 3)
        clause = write.fold("or", [i + variables * generator.randrange(2) for i in chosen])
        result = clause if result < 0 else write.call("and", result, clause)
    return write.program()


def multiplier(bits: int) -> Program:
    """All output bits of a multiplier of two numbers, by adding shifted rows."""
    write = Recorder(2 * bits)
    total: list[int] = []
    for shift in range(bits):
        row = [write.call("and", i, bits + shift) for i in range(bits)]
        if not total:
            total = row
            continue
        carry = -1
        for i, bit in enumerate(row):
            place = shift + i
            if place == len(total):
                total.append(bit if carry < 0 else write.call("xor", bit, carry))
                carry = -1 if carry < 0 else write.call("and", bit, carry)
                continue
            old = total[place]
            half = write.call("xor", old, bit)
            both = write.call("and", old, bit)
            if carry < 0:
                total[place], carry = half, both
            else:
                total[place] = write.call("xor", half, carry)
                carry = write.call("or", both, write.call("and", half, carry))
        if carry >= 0:
            total.append(carry)
    return write.program()


PROGRAMS: dict[str, Callable[[], Program]] = {
    "8 queens": lambda: queens(8),
    "3-CNF, 30 variables, 75 clauses": lambda: random_clauses(30, 75, 1),
    "3-CNF, 36 variables, 85 clauses": lambda: random_clauses(36, 85, 2),
    "multiplier, 9 bits": lambda: multiplier(9),
    "multiplier, 11 bits": lambda: multiplier(11),
}
QUICK = {"6 queens": lambda: queens(6), "multiplier, 6 bits": lambda: multiplier(6)}


def run_ours(program: Program) -> tuple[float, list[Any], Any]:
    """Seconds in apply, the results, and the manager."""
    from factored_polca.diagrams import Manager, apply

    variables, calls = program
    manager = Manager([2] * variables)
    results = [manager.indicator(i, [1]) for i in range(variables)]
    results += [manager.indicator(i, [0]) for i in range(variables)]
    start = time.perf_counter()
    for name, a, b in calls:
        results.append(apply(name, results[a], results[b]))
    return time.perf_counter() - start, results, manager


def run_dd(program: Program, module: Any) -> tuple[float, list[Any], Any]:
    """The same with a manager of `dd`."""
    variables, calls = program
    manager = module.BDD()
    manager.configure(reordering=False)
    manager.declare(*(f"x{i}" for i in range(variables)))
    results = [manager.var(f"x{i}") for i in range(variables)]
    results += [~manager.var(f"x{i}") for i in range(variables)]
    start = time.perf_counter()
    for name, a, b in calls:
        results.append(manager.apply(name, results[a], results[b]))
    return time.perf_counter() - start, results, manager


def other_package() -> tuple[str, Any]:
    """CUDD through `dd`, or where the wheel has none `dd`'s own manager in Python."""
    try:
        from dd import cudd

        return "dd.cudd", cudd
    except ImportError:
        from dd import autoref

        return "dd.autoref (dd.cudd is not in this wheel)", autoref


def work(program: Program) -> tuple[int, int, int]:
    """Nodes of all results, nodes of the last one, and our peak bytes."""
    from factored_polca.diagrams import node_count

    _, results, manager = run_ours(program)
    sizes = [node_count(result) for result in results[2 * program[0] :]]
    return sum(sizes), sizes[-1], manager.peaks()[1]


def check_same(program: Program, module: Any) -> None:
    """Compare the two sides' last results on random assignments."""
    from factored_polca.diagrams import at

    variables = program[0]
    _, ours, _ = run_ours(program)
    _, theirs, manager = run_dd(program, module)
    generator = random.Random(0)
    for _ in range(50):
        values = [generator.randrange(2) for _ in range(variables)]
        there = manager.let({f"x{i}": bool(v) for i, v in enumerate(values)}, theirs[-1])
        assert bool(at(ours[-1], dict(enumerate(values)))) == (there == manager.true)


def measure(names: dict[str, Callable[[], Program]], pairs: int) -> Iterator[list[str]]:
    """One row of the table for each program."""
    module = other_package()[1]
    for name, make in names.items():
        program = make()
        check_same(program, module)
        nodes, last, peak = work(program)
        ours, theirs = [], []
        for _ in range(pairs):
            ours.append(run_ours(program)[0])
            theirs.append(run_dd(program, module)[0])
        a, b = statistics.median(ours), statistics.median(theirs)
        ratios = sorted(y / x for x, y in zip(ours, theirs, strict=True))
        yield [
            name, f"{len(program[1]):,}", f"{nodes:,}", f"{last:,}", f"{a:.3f}", f"{b:.3f}",
            f"{nodes / a / 1e6:.2f}", f"{nodes / b / 1e6:.2f}",
            f"{b / a:.2f} ({ratios[0]:.2f}-{ratios[-1]:.2f})", f"{peak / 2**20:.0f}",
        ]  # fmt: skip


ARITHMETIC = (("field", "plus"), ("field", "times"), ("float", "plus"), ("float", "times"))
"""Kinds of leaves, and operators."""


def full_tree(manager: Any, levels: list[int], sizes: int, numbers: Iterator[int]) -> Any:
    """An index diagram that tells all values of the variables at `levels` apart."""
    if not levels:
        return manager.constant(next(numbers))
    children = [full_tree(manager, levels[1:], sizes, numbers) for _ in range(sizes)]
    return manager.variable(levels[0], children)


def counter(manager: Any, levels: list[int]) -> Any:
    """The number of ones among the variables at `levels`: many states, few leaves."""
    rows = [manager.constant(count) for count in range(len(levels) + 1)]
    for place in range(len(levels) - 1, -1, -1):
        rows = [manager.variable(levels[place], rows[count : count + 2]) for count in range(place + 1)]
    return rows[0]


def trees() -> tuple[Any, Any, Any]:
    """Two trees of 729 leaves over alternating variables: most work is at the leaves."""
    from factored_polca.diagrams import Manager

    manager = Manager([3] * 12)
    return manager, *(full_tree(manager, list(range(i, 12, 2)), 3, iter(range(729))) for i in (0, 1))


def counters() -> tuple[Any, Any, Any]:
    """Two counters over 240 alternating variables: most work is above the leaves."""
    from factored_polca.diagrams import Manager

    manager = Manager([2] * 240)
    return manager, counter(manager, list(range(0, 240, 2))), counter(manager, list(range(1, 240, 2)))


def arithmetic(
    make: Callable[[], tuple[Any, Any, Any]], pairs: int
) -> tuple[int, dict[tuple[str, str], float]]:
    """Nodes of the result, and the median processor seconds of each kind and operator."""
    from factored_polca.diagrams import FLOAT, Field, apply, leaves, node_count, relabel

    seconds: dict[tuple[str, str], list[float]] = {row: [] for row in ARITHMETIC}
    nodes: set[int] = set()
    for number in range(pairs + 1):
        for kind, name in ARITHMETIC:
            manager, *indices = make()
            draw = random.Random(number)
            arguments = []
            for index in indices:
                values = [draw.randrange(1, 2**52) for _ in range(max(leaves(index)) + 1)]
                leaf_type = Field() if kind == "field" else FLOAT
                images = np.array(values, dtype=np.uint64 if kind == "field" else np.float64)
                arguments.append(relabel(index, images, leaf_type))
            start = time.process_time()
            result = apply(name, *arguments)
            if number:  # the first loads the kernels
                seconds[kind, name].append(time.process_time() - start)
            nodes.add(node_count(result))
            del manager
    smallest, largest = min(nodes), max(nodes)
    assert largest <= 1.01 * smallest, "the results differ in shape"
    return largest, {row: statistics.median(found) for row, found in seconds.items()}


_FIRST_USE = """
import sys, time
sys.path.insert(0, sys.argv[1])
start = time.process_time()
import numpy as np
from factored_polca.diagrams import *
from factored_polca.diagrams.weighted import run_regression
imported = time.process_time()
m = Manager([2, 3])
a, b = m.indicator(0, [1]), m.indicator(1, [1, 2])
a & b
applied = time.process_time()
f = relabel(choose(a, b, ~b), np.array([1.0, 2.0]), FLOAT)
w = [relabel(m.indicator(0, [v]), np.array([0.0, 1.0]), FLOAT) for v in (0, 1)]
weighted_sum(w, [f, f], normalised=True)
evaluate_states(f, np.zeros((1, 2)), [0, 1]), states_of_leaves(f, [0, 1]), states_for_leaves(f)
load(m, dump(f), FLOAT)
m.collect_garbage()
nodes, words = np.zeros(1, np.int32), np.zeros(5, np.int64)
run_regression(
    m.pool, m.head, m.unique, m.arity, m.slots, m.ring, m.ring_state, words, np.ones(2, np.uint64),
    m.stack, m.terms, m.results, words, m.cache, 1, nodes, 0, nodes, words, 0, nodes, words,
)
print(imported - start, applied - imported, time.process_time() - applied)
"""


def first_use(cache: str) -> list[float]:
    """Processor seconds of a child process: imports, the first apply, one use of every other kernel."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
    answer = subprocess.run(
        [sys.executable, "-c", _FIRST_USE, str(ROOT)],
        env=environment,
        capture_output=True,
        check=True,
        text=True,
    )
    return [float(word) for word in answer.stdout.split()]


def processor() -> str:
    """The processor's name."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="ascii").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pairs", type=int, default=5, help="interleaved pairs of runs for each row")
    parser.add_argument("--quick", action="store_true", help="small programs only")
    options = parser.parse_args()
    name, _ = other_package()
    print(
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {platform.node()}, {processor()}, {os.cpu_count()} cpus"
    )
    print(f"Python {platform.python_version()}; ours beside {name}; medians of {options.pairs} pairs")
    head = [
        "program", "calls", "nodes", "last", "ours s", "other s", "ours Mn/s", "other Mn/s",
        "ratio of rates (range)", "our peak MiB",
    ]  # fmt: skip
    print(" | ".join(head))
    for row in measure(QUICK if options.quick else PROGRAMS, options.pairs):
        print(" | ".join(row), flush=True)
    print("arithmetic, millions of nodes a second: | " + " | ".join(f"{k} {n}" for k, n in ARITHMETIC))
    for label, make in (("two trees", trees), ("two counters", counters)):
        nodes, seconds = arithmetic(make, options.pairs)
        rates = " | ".join(f"{nodes / seconds[row] / 1e6:.2f}" for row in ARITHMETIC)
        ratio = seconds["field", "times"] / seconds["field", "plus"]
        print(
            f"{label}, {nodes:,} nodes: | {rates} | field times / plus: {ratio:.2f} of the time", flush=True
        )
    with tempfile.TemporaryDirectory() as cache:
        cold, warm = first_use(cache), first_use(cache)
    print("processor seconds in a fresh process: import | first apply | every other kernel")
    for label, seconds in (("compiling", cold), ("compiled before", warm)):
        print(f"{label}: " + " | ".join(f"{s:.2f}" for s in seconds))


if __name__ == "__main__":
    main()
