"""The command `minimise`, and what the commands that work on models share."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from factored_polca.cli.memory import current_memory_bytes, memory_text, peak_memory_bytes
from factored_polca.cli.output import Output, big, escape, make_table, seconds
from factored_polca.cli.source import Source, UsageError, load, parse_actions
from factored_polca.formats import destination
from factored_polca.models import LimitReached

COMPILING = "compiling numeric kernels, once for this installation (10 to 20 seconds)"
"""What is said where that has to be done."""

ACTIONS_SHOWN = 30
"""Actions in a table before the rest is summed up."""

SMALLEST_STORE = 1 << 20
"""Bytes without which no model fits."""


def compile_kernels(output: Output, pomdp_method: str | None = None) -> float:
    """Compile or load the numeric kernels, those of a POMDP solver too; say so where it takes long."""
    from factored_polca.hierarchy.warm import is_compiled, warm_up

    def work(elsewhere: subprocess.Popen[bytes] | None) -> None:
        warm_up(None if elsewhere is None or pomdp_method is not None else elsewhere.wait)
        if pomdp_method is not None:
            from factored_polca.solvers import warm_pomdp

            if elsewhere is not None:
                elsewhere.wait()
            warm_pomdp.warm_up(pomdp_method)

    began = time.perf_counter()
    if is_compiled():
        with announced_compiling(output):
            work(None)
    else:
        with output.progress(COMPILING), compiling_elsewhere(pomdp_method) as elsewhere:
            work(elsewhere)
    return time.perf_counter() - began


@contextmanager
def announced_compiling(output: Output) -> Iterator[None]:
    """Say so where something inside has to be compiled."""
    from factored_polca.solvers.compiled import watch_compiling

    with watch_compiling(lambda: output.note(COMPILING)):
        yield


@contextmanager
def compiling_elsewhere(pomdp_method: str | None) -> Iterator[subprocess.Popen[bytes] | None]:
    """A second process that compiles the kernels of a POMDP solver, or the minimiser's largest one, where
    there is a core for it.

    It leaves them on disk, from where this process loads them.  Should it fail, this process compiles
    them itself.
    """
    if (os.cpu_count() or 1) < 2:
        yield None
        return
    program = "from factored_polca.hierarchy.warm import compile_passes; compile_passes()"
    if pomdp_method is not None:
        program = f"from factored_polca.solvers.warm_pomdp import warm_up; warm_up({pomdp_method!r})"
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", program],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def limits(arguments: argparse.Namespace) -> tuple[int | None, float | None]:
    """The bytes the diagrams may take, and the time at which to stop.

    Raises:
        LimitReached: the program without any diagrams takes more memory than that.
    """
    memory = None
    if arguments.memory is not None:
        taken = current_memory_bytes()
        memory = arguments.memory - taken
        if memory < SMALLEST_STORE:
            raise LimitReached(
                f"the program itself takes {taken / 2**20:,.0f} MiB, which leaves too little of --memory "
                f"{arguments.memory / 2**20:,.0f} MiB for diagrams; give more"
            )
    deadline = None if arguments.time is None else time.monotonic() + arguments.time
    return memory, deadline


def report_warnings(source: Source, output: Output) -> None:
    """Print what reading the model found worth a warning."""
    for warning in source.warnings:
        output.warn(str(warning))


def minimise(arguments: argparse.Namespace, output: Output) -> int:
    """Minimise a model, print the figures."""
    from factored_polca.cli.sensitivity import kept_symbols, parameter_data
    from factored_polca.minimisation import flat_process, observation_counts
    from factored_polca.minimisation import minimise as minimise_process
    from factored_polca.parametric import parametric_process
    from factored_polca.solvers.compiled import watch_compiling
    from factored_polca.symbolic import compile_model
    from factored_polca.symbolic.reach import reachable_states

    if arguments.interchangeable and arguments.certify:
        raise UsageError(
            "--certify checks partitions that keep actions by name, not --interchangeable ones"
        )
    names = arguments.keep_parameters
    if names is not None and arguments.certify:
        raise UsageError("--certify checks rows of numbers, and --keep-parameters leaves symbols in them")
    source = load(arguments.model, arguments.set, None, names)
    actions = None if arguments.actions is None else parse_actions(arguments.actions, source.model)
    if arguments.epsilon is not None or arguments.loss is not None:
        from factored_polca.cli.approximate import minimise_near

        return minimise_near(arguments, source, actions, output)
    report_warnings(source, output)
    compile_seconds = compile_kernels(output)
    memory, deadline = limits(arguments)
    data: dict[str, Any] = {"model": source.model.name, "states": source.model.states}
    began = time.perf_counter()
    with source.located(), output.progress(f"minimising {source.name}"):
        symbols = None if names is None else kept_symbols(source.model, names)
        symbolic = compile_model(
            source.model, order=arguments.order, memory_limit=memory, deadline=deadline, parameters=symbols
        )
        reachable = None
        if arguments.reachable:
            found = reachable_states(symbolic, actions)
            reachable = found.diagram
            data["reachable_states"] = found.states
        process = flat_process(symbolic, actions, reachable)
        if symbols is not None:
            opened = parametric_process(process)
            process = opened.process
            data |= parameter_data(opened)
        with watch_compiling() as compiling:  # kernels that few models need
            result = minimise_process(
                process,
                seed=arguments.seed,
                interchangeable=arguments.interchangeable,
                progress=lambda number, blocks: output.update(
                    f"minimising {source.name}: round {number}, {blocks:,} blocks"
                ),
            )
        if process.partial:
            data["observations"] = {
                found.choice: {"before": found.before, "after": found.after}
                for found in observation_counts(process, result.partition)
            }
    elapsed = time.perf_counter() - began - compiling.seconds
    peak_nodes, _ = symbolic.manager.peaks()
    data |= {
        "blocks": result.partition.blocks,
        "rounds": result.rounds,
        "states_listed": result.states_listed,
        "interchangeable": arguments.interchangeable,
        "nodes": result.partition.nodes,
        "peak_nodes": peak_nodes,
        "collision_bound": result.collision_bound,
        "order": list(symbolic.order),
        "seconds": elapsed,
        "parse_seconds": source.parse_seconds,
        "compile_seconds": compile_seconds + compiling.seconds,
    }
    status = 0
    if arguments.certify:
        from factored_polca.minimisation.certify import certify

        with output.progress(f"certifying {result.partition.blocks:,} blocks"):
            certificate = certify(process, result.partition)
        data["certified"] = certificate.ok
        data["certificate"] = {
            "checks": certificate.checks,
            "primes": len(certificate.primes),
            "bits": certificate.bits,
            "failures": list(certificate.failures),
            "seconds": certificate.seconds,
        }
        status = 0 if certificate.ok else 1
    data["total_seconds"] = time.perf_counter() - arguments.began
    data["peak_memory_bytes"] = peak_memory_bytes()
    if arguments.json:
        output.result(data)
    else:
        print_minimisation(data, output)
    return status


def print_minimisation(data: dict[str, Any], output: Output) -> None:
    """The figures of `minimise` for people."""
    table = make_table(f"{data['model']}, minimised", {"": "left", " ": "right"})
    table.show_header = False
    table.add_row("states", big(data["states"]))
    if "reachable_states" in data:
        table.add_row("reachable states", big(data["reachable_states"]))
    table.add_row("blocks", f"{data['blocks']:,}")
    if "parameters" in data:
        table.add_row("symbols", escape(", ".join(data["parameters"])))
        table.add_row("admissible", escape("; ".join(data["region"]) or "everywhere"))
    table.add_row("rounds", f"{data['rounds']:,}")
    if data["states_listed"]:
        table.add_row("states listed, as was quicker", f"{data['states_listed']:,}")
    table.add_row("diagram nodes (peak)", f"{data['nodes']:,} ({data['peak_nodes']:,})")
    table.add_row("chance of an unseen split", f"below {data['collision_bound']:.1g}")
    if "certified" in data:
        certificate = data["certificate"]
        verdict = "yes" if data["certified"] else "NO"
        table.add_row(
            "certified", f"{verdict}: {certificate['checks']:,} checks, {certificate['primes']} primes"
        )
    table.add_row("time", seconds(data["seconds"]))
    table.add_row("kernels loaded or compiled", seconds(data["compile_seconds"]))
    table.add_row("peak memory", memory_text(data["peak_memory_bytes"]))
    output.table(table)
    if "observations" in data:
        print_observations(data["observations"], output)
    for failure in data.get("certificate", {}).get("failures", ())[:10]:
        output.line(f"[red]{escape(failure)}[/]")


def print_observations(counts: dict[str, dict[str, int]], output: Output) -> None:
    """The joint observations of each action, those with most first."""
    columns = {"action": "left", "observations": "right", "merged": "right"}
    table = make_table("joint observations, merged without loss channel by channel", columns)
    ordered = sorted(counts.items(), key=lambda item: -item[1]["after"])
    for name, count in ordered[:ACTIONS_SHOWN]:
        table.add_row(escape(name), big(count["before"]), big(count["after"]))
    if len(ordered) > ACTIONS_SHOWN:
        table.add_row(f"... {len(ordered) - ACTIONS_SHOWN} more", "", "")
    output.table(table)


def refuse_unwritable(path: str) -> None:
    """Find out before the work, not after it, that its result can't be written.

    Raises:
        ModelError: no such folder, or no regular file in the file's place.
        UsageError: a folder that can't be written to.
    """
    folder = destination(path).parent
    if not os.access(folder, os.W_OK):
        raise UsageError(f"{path}: the folder {folder} can't be written to")
