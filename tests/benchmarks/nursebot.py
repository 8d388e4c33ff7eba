"""How planning the nursing robot grows with its parameters: a table of states, blocks, time and memory.

    python tests/benchmarks/nursebot.py [--trials 100] [--episodes 100] [--seconds 900]

Each size is planned by `factored-polca plan nursebot` in a process of its own, with the kernels loaded from
disk.  `rooms` and `bystanders` multiply the states and matter to nothing; `patients` and `topics` make more
to be told apart.  Seconds are wall clock; memory is the process' largest resident set.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
from typing import Any

SIZES = [
    {},
    {"rooms": 10},
    {"rooms": 20, "bystanders": 5},
    {"rooms": 40, "bystanders": 10},
    {"rooms": 100, "bystanders": 30},
    {"topics": 4},
    {"topics": 8},
    {"topics": 16},
    {"patients": 2},
    {"patients": 4},
    {"patients": 6},
    {"patients": 8},
]


def planned(size: dict[str, int], trials: int, episodes: int, seconds: float) -> dict[str, Any] | str:
    """What `plan --json` says, or why it says nothing."""
    command = [sys.executable, "-m", "factored_polca", "plan", "nursebot", "--json", "--quiet", "--no-flat"]
    command += ["--trials", str(trials), "--episodes", str(episodes)]
    for name, value in size.items():
        command += ["--set", f"{name}={value}"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:
        return f"not within {seconds:g} s"
    if done.returncode:
        return done.stderr.strip().splitlines()[-1]
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def row(size: dict[str, int], found: dict[str, Any] | str) -> str:
    """A row of the table."""
    name = ", ".join(f"{key} {value}" for key, value in size.items()) or "the paper's"
    if isinstance(found, str):
        return f"| {name} | {found} |"
    tasks = found["tasks"]
    minimised = sum(task["minimise_seconds"] for task in tasks)
    columns = [
        name, f"{found['states']:.2g}".replace("e+", " 10^"), f"{tasks[-1]['blocks']:,}",
        f"{sum(task['blocks'] for task in tasks):,}", f"{minimised:.1f}", f"{found['seconds']:.1f}",
        f"{found['total_seconds']:.0f}", f"{found['peak_memory_bytes'] / 2**20:,.0f}",
        f"{found['value']:.1f} ± {found['standard_error']:.1f}",
    ]  # fmt: skip
    return f"| {' | '.join(columns)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=100)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=900, help="for each size")
    arguments = parser.parse_args()
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}\n")
    headings = "size", "states", "blocks of Act", "of all tasks", "minimised in, s", "planned, s"
    print(f"| {' | '.join((*headings, 'in all, s', 'MiB', 'earns'))} |")
    print("|---|---|---|---|---|---|---|---|---|")
    for size in SIZES:
        print(row(size, planned(size, arguments.trials, arguments.episodes, arguments.seconds)), flush=True)


if __name__ == "__main__":
    main()
