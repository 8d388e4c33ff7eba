"""Time minimisation and planning: one table, run with `python tests/benchmarks/minimise.py`.

Each row runs in a process of its own, kernels loaded and warm: processor seconds of compiling the
model to diagrams and minimising it, and of its quotient and solution; peak memory is the process's.
SPUDD's factory.dat and coffee.dat are in the table where FACTORED_POLCA_DATA names a folder that has
them.  The last line gives the seconds that compiling the kernels takes with an empty cache.

    python tests/benchmarks/minimise.py [--repeat N]
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

CASES = (
    "coffee.dat", "tiny-factory.dat", "factory.dat",
    "taxi", "taxi size=20", "taxi size=20 slip=true",
    "linear size=64", "expon size=10", "components size=24", "components size=40",
    "sysadmin size=10", "workshop",
)  # fmt: skip


def run_case(case: str) -> dict[str, object]:
    """Run one case in this process."""
    from factored_polca import library
    from factored_polca.formats import read
    from factored_polca.hierarchy.warm import warm_up
    from factored_polca.minimisation import flat_process, make_quotient, minimise
    from factored_polca.solvers import solve_mdp
    from factored_polca.symbolic import compile_model

    name, *settings = case.split()
    if name.endswith(".dat"):
        model = read(Path(os.environ["FACTORED_POLCA_DATA"]) / name).model
    else:
        model = library.load(name, dict(setting.split("=") for setting in settings)).model
    warm = time.process_time()
    warm_up()
    warm = time.process_time() - warm
    began = time.process_time()
    symbolic = compile_model(model)
    result = minimise(flat_process(symbolic))
    minimised = time.process_time()
    solution = solve_mdp(make_quotient(result.process, result.partition).mdp)
    solved = time.process_time()
    nodes, _ = symbolic.manager.peaks()
    return {
        "states": model.states, "blocks": result.partition.blocks, "rounds": result.rounds,
        "nodes": nodes, "minimise": minimised - began, "solve": solved - minimised,
        "status": solution.status, "warm": warm,
        "memory": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }  # fmt: skip


def in_process(case: str, **environment: str) -> dict[str, object]:
    """Run one case in a fresh process."""
    command = [sys.executable, __file__, "--case", case]
    done = subprocess.run(command, check=True, capture_output=True, env={**os.environ, **environment})
    return json.loads(done.stdout)  # type: ignore[no-any-return]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--case")
    parser.add_argument("--repeat", type=int, default=3)
    arguments = parser.parse_args()
    if arguments.case:
        print(json.dumps(run_case(arguments.case)))
        return
    print(f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {platform.processor() or platform.machine()}, ", end="")
    print(f"{os.cpu_count()} cpus, Python {platform.python_version()}; median of {arguments.repeat}")
    print("case | states | blocks | rounds | peak nodes | minimise s | quotient and solve s | peak MiB")
    folder = os.environ.get("FACTORED_POLCA_DATA")
    for case in CASES:
        if case.endswith(".dat") and not (folder and (Path(folder) / case).exists()):
            continue
        rows = [in_process(case) for _ in range(arguments.repeat)]
        row = rows[0]
        minimise_seconds = median(float(str(r["minimise"])) for r in rows)
        solve_seconds = median(float(str(r["solve"])) for r in rows)
        states = f"{row['states']:,}" if int(str(row["states"])) < 10**12 else f"{row['states']:.2e}"
        print(
            f"{case} | {states} | {row['blocks']:,} | {row['rounds']:,} | {row['nodes']:,} | "
            f"{minimise_seconds:.2f} | {solve_seconds:.2f} | {row['memory']:,}",
            flush=True,
        )
    with tempfile.TemporaryDirectory() as empty:
        first = in_process("taxi", NUMBA_CACHE_DIR=empty)["warm"]
        second = in_process("taxi", NUMBA_CACHE_DIR=empty)["warm"]
    print(f"kernels of the main job: compiled in {first:.1f} s, loaded from the cache in {second:.2f} s")


if __name__ == "__main__":
    main()
