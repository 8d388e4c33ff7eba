"""The table of competition domains in docs/formats/rddl.md: which of them are read, and what they become.

    python tests/benchmarks/rddl_table.py [--seconds 20] [--years IPPC2011 IPPC2014] [--only SysAdmin]

Needs the extra `rddl` and rddlrepository, which has the files.  Instance 1 of each domain is read, compiled
and minimised, in a process of its own in which minimising may take so many seconds of processor time (and 3
GB); of instance 10 only reading and compiling are measured.  States are the full product, blocks those of
the coarsest partition of all of them.  A domain whose files are those of an earlier year is not run again.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

MEMORY = 3 << 30
GRACE = 10
"""Seconds for loading kernels, reading and compiling, beside those for minimising."""


def say(**what: Any) -> None:
    print(json.dumps(what), flush=True)


def examine(folder: Path, instance: int, minimising: bool) -> None:
    """What one instance becomes, one JSON object a line; the work of a process of its own."""
    from factored_polca.formats import read
    from factored_polca.hierarchy.warm import warm_up
    from factored_polca.minimisation import flat_process, minimise
    from factored_polca.models import LimitReached, ModelError
    from factored_polca.symbolic import compile_model

    warm_up()
    began = time.process_time()
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    try:
        document = read(f"{folder}/domain.rddl+{folder}/instance{instance}.rddl")
        model = document.model
        parse = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - children
        say(
            states=str(model.states),
            features=len(model.features),
            actions=len(model.actions),
            channels=len(model.observations),
            read=time.process_time() - began + parse,
            partial=model.observability == "partial",
            warnings=[w.message for w in document.warnings],
        )
        began = time.process_time()
        symbolic = compile_model(model, memory_limit=MEMORY // 2)
        say(compile=time.process_time() - began)
        if minimising:
            began = time.process_time()
            found = minimise(flat_process(symbolic), progress=lambda number, blocks: say(reached=blocks))
            say(blocks=found.partition.blocks, minimise=time.process_time() - began)
    except ModelError as error:
        say(refused=str(error.faults[0].message))
    except (LimitReached, MemoryError) as error:
        say(limit=f"{type(error).__name__}: {error}")


def measured(folder: Path, instance: int, seconds: int, minimising: bool) -> dict[str, Any]:
    """What the process said before it ended or was ended."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (seconds + GRACE, seconds + GRACE))
        resource.setrlimit(resource.RLIMIT_AS, (2 * MEMORY, 2 * MEMORY))

    command = [sys.executable, __file__, "--examine", str(folder), str(instance), str(int(minimising))]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=False, preexec_fn=limit)
    result: dict[str, Any] = {}
    for line in done.stdout.decode().splitlines():
        result |= json.loads(line)
    return result


def row(name: str, first: dict[str, Any], tenth: dict[str, Any], seconds: int) -> str:
    """One line of the table."""
    if "states" not in first:
        return f"| {name} | no: {first.get('refused', first.get('limit', 'no answer'))} | | | | | |"
    bits = math.log2(int(first["states"]))
    states = f"2^{bits:.0f}" if bits.is_integer() else f"{int(first['states']):,}"
    blocks = f"{first['blocks']:,}" if "blocks" in first else f"more than {seconds} s"
    if "refused" in first:
        blocks = f"refused: {first['refused']}"
    elif "blocks" in first and first["minimise"] > seconds:
        blocks = f"more than {seconds} s"
    elif "blocks" not in first and "reached" in first:
        blocks += f" ({first['reached']:,} reached)"
    sizes = f"{tenth.get('features', '?')} features, {tenth.get('actions', '?'):,} actions"
    times = f"{tenth['read']:.1f} + {tenth['compile']:.1f} s" if "compile" in tenth else "not in the time"
    channels = str(first["channels"]) if first["partial"] else "seen"
    return f"| {name} | yes | {states} | {first['actions']} | {channels} | {blocks} | {sizes}: {times} |"


def same_files(one: Path, other: Path) -> bool:
    """Whether the domain and the instances that are run are equal."""
    names = ("domain.rddl", "instance1.rddl", "instance10.rddl")
    pairs = [(one / name, other / name) for name in names]
    return all(a.is_file() and a.read_bytes() == b.read_bytes() for a, b in pairs)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=int, default=20)
    parser.add_argument("--years", nargs="+", default=["IPPC2011", "IPPC2014"])
    parser.add_argument("--only", default="")
    parser.add_argument("--examine", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.examine:
        folder, instance, minimising = arguments.examine
        examine(Path(folder), int(instance), minimising == "1")
        return
    import rddlrepository

    place = Path(rddlrepository.__file__).parent / "archive" / "competitions"
    print(
        "| domain | read | states | actions | observation features | blocks | instance 10: read + compile |"
    )
    print("|---|---|---|---|---|---|---|", flush=True)
    for year in arguments.years:
        for folder in sorted((place / year).glob("*/*MDP")):
            name = f"{year[4:]} {folder.parent.name} {folder.name}"
            before = place / "IPPC2011" / folder.relative_to(place / year)
            if arguments.only in name and before != folder and same_files(before, folder):
                print(f"| {name} | yes | as in 2011 | | | | |", flush=True)
            elif arguments.only in name:
                first = measured(folder, 1, arguments.seconds, True)
                tenth = measured(folder, 10, arguments.seconds, False)
                print(row(name, first, tenth, arguments.seconds), flush=True)


if __name__ == "__main__":
    main()
