"""A study that is killed again and again, and goes on each time: exactly one result for each run.

    python tests/benchmarks/study_kills.py [--runs 200] [--kills 20] [--seed 0]

`factored-polca study run` is started on a study of so many short runs (`minimise linear`), in a process
group of its own, and the whole group is killed (SIGKILL) at a random moment: at once, while kernels are
loaded, or after some more results.  After each kill:

- the store is whole (SQLite's integrity check), and no result that was there has gone or changed;
- no process of the killed study is left after some seconds;

and in the end, when it is left to run, there is one result for each run, each of them `ok`.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
import uuid
from dataclasses import dataclass
from pathlib import Path

MARK = "FACTORED_POLCA_STUDY_KILLS"
SETTLING_SECONDS = 20.0

MINIMISE = """[[grid]]
work = "minimise"
model = "linear"
set.size = [4, 5, 6, 7]
seed = "0..{last}"
"""


@dataclass(frozen=True)
class Rehearsal:
    """What came of it: results after each kill, and of each launch; leftover processes never."""

    after_kills: tuple[int, ...]
    by_launch: tuple[int, ...]
    slowest_end_seconds: float


def marked(mark: str) -> list[int]:
    """The processes whose environment has the mark; all that a study starts inherit it."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            try:
                if f"{MARK}={mark}\0".encode() in (folder / "environ").read_bytes():
                    found.append(int(folder.name))
            except OSError:
                continue
    return found


def results(store: Path) -> dict[str, tuple[object, ...]]:
    """The results by key; none where there is no store yet, or it is being made."""
    if not store.exists():
        return {}
    connection = sqlite3.connect(store, timeout=30)
    try:
        rows = connection.execute("SELECT key, status, started, launch, figures FROM results").fetchall()
        return {str(row[0]): row[1:] for row in rows}
    except sqlite3.OperationalError:
        return {}
    finally:
        connection.close()


def whole(store: Path) -> bool:
    """Whether SQLite finds the file in order."""
    if not store.exists():
        return True
    connection = sqlite3.connect(store, timeout=30)
    try:
        (said,) = connection.execute("PRAGMA integrity_check").fetchone()
        return bool(said == "ok")
    finally:
        connection.close()


def rehearse(text: str, runs: int, kills: int, seed: int, folder: Path, *, tell: bool = False) -> Rehearsal:
    """Kill a study `kills` times, fewer if it ends before, then let it run to its end; `runs` is how many
    results it must have.

    Raises:
        AssertionError: something was lost, changed, run twice or left over.
    """
    draw = random.Random(seed)
    file, store, mark = folder / "kills.toml", folder / "kills.sqlite", uuid.uuid4().hex
    file.write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "factored_polca", "study", "run", str(file), "--quiet", "--json"]
    environment = {**os.environ, MARK: mark}
    after, slowest = [], 0.0
    while len(after) < kills:
        before = results(store)
        study = subprocess.Popen(
            command, env=environment, start_new_session=True, stdout=subprocess.DEVNULL
        )
        if draw.random() < 0.25:
            time.sleep(draw.uniform(0.0, 4.0))
        else:
            wanted = len(before) + draw.randint(0, max(1, (runs - len(before)) // (kills - len(after) + 1)))
            while len(results(store)) < wanted and study.poll() is None:
                time.sleep(0.02)
            time.sleep(draw.uniform(0.0, 0.3))
        if study.poll() is not None:  # all runs were done before it could be killed
            assert study.returncode == 0, f"it ended by itself, {study.returncode}"
            assert len(results(store)) == runs
            break
        os.killpg(study.pid, signal.SIGKILL)
        study.wait()
        killed = time.monotonic()
        while marked(mark):
            assert time.monotonic() - killed < SETTLING_SECONDS, f"left over: {marked(mark)}"
            time.sleep(0.01)
        slowest = max(slowest, time.monotonic() - killed)
        now = results(store)
        assert whole(store), "the store is damaged"
        assert {key: now.get(key) for key in before} == before, "results were lost or changed"
        after.append(len(now))
        if tell:
            print(f"kill {len(after)}: {len(now)} results", flush=True)
    before = results(store)
    subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    now = results(store)
    assert {key: now.get(key) for key in before} == before, "results were changed at the end"
    assert len(now) == runs, f"{len(now)} results of {runs} runs"
    assert {str(row[0]) for row in now.values()} == {"ok"}, "not all are ok"
    launches = sorted({row[2] for row in now.values()}, key=str)
    by_launch = tuple(sum(row[2] == launch for row in now.values()) for launch in launches)
    return Rehearsal(tuple(after), by_launch, slowest)


def main() -> None:
    """Do it, and tell."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=200, help="a multiple of 4")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    text = MINIMISE.format(last=arguments.runs // 4 - 1)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        found = rehearse(text, arguments.runs, arguments.kills, arguments.seed, Path(folder), tell=True)
    print(
        f"{len(found.after_kills)} kills: {arguments.runs} results, one for each run; by launch "
        f"{', '.join(map(str, found.by_launch))}; no process left after at most "
        f"{found.slowest_end_seconds:.2f} s; {time.monotonic() - began:.0f} s in all"
    )


if __name__ == "__main__":
    main()
