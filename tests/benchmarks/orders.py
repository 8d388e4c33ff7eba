"""Measure variable orders: what `auto` costs beside the best order known, on the shipped domains.

    python tests/benchmarks/orders.py [--repeat N] [--shuffles N] [WORD ...]

WORD picks the cases whose name holds it.  The orders that are tried: the order of the file, FORCE, the
spectral one, FORCE after it, FORCE from shuffled orders, shuffled orders, and all of them reversed.  Each
is compiled and minimised once in one warm process; then `auto` and the six quickest are run again in turns.
A figure is the least processor time of all runs of an order, which is what other work on the machine
disturbs least.  SPUDD's models are in the table where FACTORED_POLCA_DATA names their folder.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from factored_polca import library
from factored_polca.formats import read
from factored_polca.hierarchy.warm import warm_up
from factored_polca.minimisation import flat_process, minimise
from factored_polca.models import Model
from factored_polca.symbolic import compile_model
from factored_polca.symbolic.order import force, groups, spectral, variable_order

CASES = (
    "cheese_taxi", "coffee", "components size=12", "components size=30", "expon size=8", "expon size=12",
    "hallway", "hallway size=20", "linear size=32", "linear size=64", "network size=4", "network size=6",
    "nursebot", "nursebot topics=3 rooms=3", "part_painting", "rocksample size=5 rocks=6",
    "rocksample size=7 rocks=8", "sysadmin size=8", "sysadmin size=11", "sysadmin size=8 topology=star",
    "taxi", "taxi size=20", "taxi noise_bits=8", "taxi size=8 anywhere=true", "taxi size=10 slip=true",
    "workshop", "workshop size=11", "coffee.dat", "tiny-factory.dat", "factory.dat",
)  # fmt: skip

AGAIN = 6
"""How many of the quickest orders are run again."""


@dataclass
class Tried:
    """An order, the names under which it was found, and the runs with it."""

    order: tuple[str, ...]
    names: list[str] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    nodes: int = 0
    peak: int = 0
    blocks: int = 0

    @property
    def least(self) -> float:
        """The least seconds of all runs."""
        return min(self.seconds)


def load(case: str) -> Model | None:
    """The model of a case; None where its file is not at hand."""
    name, *settings = case.split()
    if not name.endswith(".dat"):
        return library.load(name, dict(setting.split("=") for setting in settings)).model
    path = Path(os.environ.get("FACTORED_POLCA_DATA", "."), name)
    return read(path).model if path.exists() else None


def orders(model: Model, shuffles: int) -> list[Tried]:
    """The different orders to try."""
    given = [feature.name for feature in model.features]
    found = groups(model)
    named = {"file": given, "force": force(given, found), "spectral": spectral(given, found)}
    named["spectral, force"] = force(named["spectral"], found)
    generator = random.Random(1)
    for number in range(shuffles):
        shuffled = generator.sample(given, len(given))
        named[f"shuffled {number}"] = shuffled
        named[f"shuffled {number}, force"] = force(shuffled, found)
    named |= {f"{name}, reversed": order[::-1] for name, order in named.items()}
    named["auto"] = list(variable_order(model))
    result: dict[tuple[str, ...], Tried] = {}
    for name, order in named.items():
        result.setdefault(tuple(order), Tried(tuple(order))).names.append(name)
    return list(result.values())


def run(model: Model, tried: Tried) -> None:
    """Compile and minimise once."""
    began = time.process_time()
    symbolic = compile_model(model, order=tried.order)
    result = minimise(flat_process(symbolic))
    tried.seconds.append(time.process_time() - began)
    tried.nodes = symbolic.manager.nodes_made
    tried.peak, _ = symbolic.manager.peaks()
    tried.blocks = result.partition.blocks


def measure(case: str, model: Model, repeat: int, shuffles: int) -> str:
    """One row of the table."""
    every = orders(model, shuffles)
    auto = next(tried for tried in every if "auto" in tried.names)
    run(model, auto)  # what a first run loads is nobody's
    auto.seconds.clear()
    for tried in every:
        run(model, tried)
    quickest = sorted(every, key=lambda tried: tried.least)[:AGAIN]
    for _ in range(repeat - 1):
        for tried in {id(t): t for t in (auto, *quickest)}.values():
            run(model, tried)
    best = min(every, key=lambda tried: tried.least)
    given = next(tried for tried in every if "file" in tried.names)
    worst = max(every, key=lambda tried: tried.least)
    cells = (
        case, f"{auto.blocks:,}", str(len(every)), f"{auto.least:.3f}", f"{best.least:.3f}",
        f"{auto.least / best.least:.2f}", f"{given.least / best.least:.2f}",
        f"{worst.least / best.least:.2f}", f"{auto.peak:,}", f"{best.peak:,}", best.names[0],
    )  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("words", nargs="*", metavar="WORD", help="cases whose name holds it")
    parser.add_argument("--repeat", type=int, default=5, help="runs of auto and of the quickest orders")
    parser.add_argument("--shuffles", type=int, default=4, help="shuffled orders to start from")
    options = parser.parse_args()
    warm_up()
    heads = "case", "blocks", "orders", "auto s", "best s", "auto", "file", "worst"
    print("| " + " | ".join((*heads, "peak nodes of auto", "of the best", "best")) + " |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---|")
    for case in CASES:
        if options.words and not any(word in case for word in options.words):
            continue
        model = load(case)
        if model is not None:
            print(measure(case, model, options.repeat, options.shuffles), flush=True)


if __name__ == "__main__":
    main()
