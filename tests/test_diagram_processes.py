"""What only a process of its own shows: Ctrl-C, kernels from numba's cache on disk, the end of Python."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

ROOT = str(Path(__file__).resolve().parents[1])

PREAMBLE = f"""
import sys
sys.path.insert(0, {ROOT!r})
import numpy as np
from factored_polca.diagrams import *
"""

LONG_APPLY = """
class Announcing(Manager):
    def pause(self):
        if self.head[2] > 1_000_000 and not announced:
            announced.append(True)
            print("running", flush=True)
        super().pause()

announced = []
try:
    while True:
        m = Announcing([64] * 6)
        a, b, c = (
            m.variable(i, [m.indicator(i + 3, [v]) for v in range(64)]) for i in range(3)
        )
        both = a & b
        both & c
except KeyboardInterrupt:
    m.assert_consistent() if m.node_count < 100_000 else None
    one = m.indicator(0, [1]) & m.indicator(5, [2])
    print("interrupted", at(one, {0: 1, 5: 2}), at(one, {0: 1, 5: 3}), both == a & b, flush=True)
    raise
"""


def child(
    program: str, *, environment: dict[str, str] | None = None, code: int = 0
) -> subprocess.CompletedProcess[str]:
    """Run a program in a fresh Python."""
    done = subprocess.run(
        [sys.executable, "-c", PREAMBLE + program],
        env={**os.environ, **(environment or {})},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == code, done.stderr
    return done


def test_ctrl_c_ends_a_long_apply_and_leaves_the_manager_usable() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", PREAMBLE + LONG_APPLY],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "running\n"
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=120)
    assert rest == "interrupted 1 0 True\n", errors
    assert errors.rstrip().endswith("KeyboardInterrupt")
    assert process.returncode in (-signal.SIGINT, 130, 1)


SMALL_COMPUTATION = """
from factored_polca.diagrams.jit import KERNELS
m = Manager([2, 3, 2], first_nodes=1)
a = m.variable(0, [m.indicator(1, [0, 2]), m.indicator(2, [1])])
b = m.indicator(1, [1, 2])
f = relabel(a & b, np.array([3, 5], dtype=np.uint64), Field())
values = [at(f * f, {0: i, 1: j, 2: k}) for i in range(2) for j in range(3) for k in range(2)]
used = [k for k in KERNELS if k.signatures and (k.stats.cache_hits or k.stats.cache_misses)]
hits = sum(sum(k.stats.cache_hits.values()) for k in used)
misses = sum(sum(k.stats.cache_misses.values()) for k in used)
print(len(used), hits, misses)
print(sorted(set(values)), values)
"""


def test_a_second_process_loads_kernels_from_the_cache_and_computes_the_same(tmp_path: Path) -> None:
    environment = {"NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        child(SMALL_COMPUTATION, environment=environment).stdout.splitlines() for _ in range(2)
    )
    used, hits, misses = (int(word) for word in first[0].split())
    assert hits == 0
    assert misses >= used > 0
    used, hits, misses = (int(word) for word in second[0].split())
    assert hits >= used > 0
    assert misses == 0
    assert first[1] == second[1]


def test_python_ends_quietly_with_diagrams_alive() -> None:
    done = child(
        """
m = Manager([2, 2])
a = m.indicator(0, [1])
cycle = [a & m.indicator(1, [0])]
cycle.append(cycle)
class Holder: pass
Holder.kept = [a, m]
import builtins
builtins.last = a
"""
    )
    assert done.stdout == ""
    assert done.stderr == ""
