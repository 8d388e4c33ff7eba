"""`minimise --epsilon` and `minimise --loss`: near states merged, and what that loses at most."""

from __future__ import annotations

import argparse
import time
from fractions import Fraction
from typing import Any

from factored_polca.approximation.approximate import ApproximateReduction, Approximation
from factored_polca.cli.approximation_arguments import number, print_tried, tried_report
from factored_polca.cli.commands import (
    compile_kernels,
    limits,
    report_warnings,
)
from factored_polca.cli.memory import peak_memory_bytes
from factored_polca.cli.output import Output, big, make_table, seconds
from factored_polca.cli.source import Source, UsageError
from factored_polca.minimisation import DecisionProcess
from factored_polca.models import Fault, LimitReached, ModelError
from factored_polca.symbolic import SymbolicModel


def minimise_near(
    arguments: argparse.Namespace,
    source: Source,
    actions: tuple[str, ...] | list[str] | None,
    output: Output,
) -> int:
    """Merge near states of a model, print the figures.

    Raises:
        ModelError: discount 1; no epsilon keeps the loss that small.
        LimitReached: memory or time.
    """
    from factored_polca.minimisation import flat_process
    from factored_polca.symbolic import compile_model
    from factored_polca.symbolic.reach import reachable_states

    if arguments.interchangeable or arguments.certify:
        raise UsageError("--epsilon and --loss keep actions by name, and have a certificate of their own")
    if not source.model.discount < 1:
        hint = "use a discount below 1, or leave --epsilon and --loss out"
        raise ModelError([Fault("at discount 1 merging near states has no bound", ("discount",), hint)])
    report_warnings(source, output)
    compile_seconds = compile_kernels(output)
    memory, deadline = limits(arguments)
    data: dict[str, Any] = {"model": source.model.name, "states": source.model.states}
    began = time.perf_counter()
    with source.located(), output.progress(f"minimising {source.name}"):
        symbolic = compile_model(
            source.model, order=arguments.order, memory_limit=memory, deadline=deadline
        )
        reachable = None
        if arguments.reachable:
            found = reachable_states(symbolic, actions)
            reachable = found.diagram
            data["reachable_states"] = found.states
        process = flat_process(symbolic, actions, reachable)
        reduction, certain, tried = _merged(symbolic, process, arguments, output)
    peak_nodes, _ = symbolic.manager.peaks()
    data |= {
        "epsilon": float(certain.epsilon),
        "blocks": reduction.partition.blocks,
        "rounds": reduction.minimisation.rounds,
        "nodes": reduction.partition.nodes,
        "peak_nodes": peak_nodes,
        "rows_before": reduction.snapped.rows_before,
        "rows_after": reduction.snapped.rows_after,
        "parents_dropped": reduction.snapped.parents,
        "model_error": certain.model_error,
        "loss_bound": certain.loss,
        "optimum_upper": None if process.partial else certain.optimum,
        "policy_lower": None if process.partial else certain.lower,
        "classes": certain.classes,
        "collision_bound": certain.collision_bound
        + (reduction.minimisation.collision_bound if reduction.stable else 0.0),
        "note": certain.note,
        "order": list(symbolic.order),
        **tried,
        "seconds": time.perf_counter() - began,
        "parse_seconds": source.parse_seconds,
        "compile_seconds": compile_seconds,
        "total_seconds": time.perf_counter() - arguments.began,
        "peak_memory_bytes": peak_memory_bytes(),
    }
    if arguments.json:
        output.result(data)
    else:
        print_near(data, output)
    return 0


def _merged(
    symbolic: SymbolicModel, process: DecisionProcess, arguments: argparse.Namespace, output: Output
) -> tuple[ApproximateReduction, Approximation, dict[str, Any]]:
    from factored_polca.approximation.search import Trial, candidates, largest_within

    made: dict[Fraction, tuple[ApproximateReduction, Approximation]] = {}

    def attempt(epsilon: Fraction) -> Trial:
        output.update(f"epsilon {float(epsilon):g}")
        made.clear()  # one at a time is kept
        made[epsilon] = near(symbolic, process, epsilon, arguments, output)
        reduction, certain = made[epsilon]
        return Trial(epsilon, reduction.partition.blocks, certain.loss)

    if arguments.loss is None:
        attempt(arguments.epsilon)
        return *made[arguments.epsilon], {}
    numbers = candidates(symbolic, seen=not process.partial)
    found, tried = largest_within(numbers, arguments.loss, attempt)
    if found is None:
        message = (
            f"exact abstraction bounds the loss by {tried[0].loss:.3g} only, not by {arguments.loss:g}"
        )
        raise ModelError([Fault(message, (), "give a larger --loss")])
    if found.epsilon not in made:
        attempt(found.epsilon)
    return *made[found.epsilon], tried_report(tried)


def near(
    symbolic: SymbolicModel,
    process: DecisionProcess,
    epsilon: Fraction,
    arguments: argparse.Namespace,
    output: Output,
) -> tuple[ApproximateReduction, Approximation]:
    """The process merged within epsilon, and what is certain of planning on it."""
    from factored_polca.approximation.approximate import approximate, certify_mdp, certify_rows
    from factored_polca.approximation.snap import snap
    from factored_polca.solvers import solve_mdp

    deadline = symbolic.manager.deadline
    reduction = approximate(
        process, snap(symbolic, epsilon), seed=arguments.seed, deadline=deadline,
        progress=lambda round_, blocks: output.update(
            f"epsilon {float(epsilon):g}: round {round_}, {blocks:,} blocks"
        ),
    )  # fmt: skip
    if process.partial:
        return reduction, certify_rows(reduction)
    solution = solve_mdp(reduction.mdp, deadline=deadline)
    if solution.status == "interrupted":
        raise KeyboardInterrupt
    if solution.status == "time limit":
        raise LimitReached("the time limit was reached while solving the merged process", "solve")
    return reduction, certify_mdp(reduction, solution.policy, seed=arguments.seed)


def print_near(data: dict[str, Any], output: Output) -> None:
    """The figures for people."""
    print_tried(data, output)
    title = f"{data['model']}, states within {data['epsilon']:g} merged"
    table = make_table(title, {"": "left", " ": "right"})
    table.show_header = False
    table.add_row("states", big(data["states"]))
    if "reachable_states" in data:
        table.add_row("reachable states", big(data["reachable_states"]))
    table.add_row("blocks", f"{data['blocks']:,}")
    table.add_row("distinct rows", f"{data['rows_before']:,} -> {data['rows_after']:,}")
    table.add_row("parents dropped", f"{data['parents_dropped']:,}")
    table.add_row("rounds", f"{data['rounds']:,}")
    table.add_row("diagram nodes (peak)", f"{data['nodes']:,} ({data['peak_nodes']:,})")
    table.add_row("planning on them loses at most", number(data["loss_bound"]))
    if data["policy_lower"] is not None:
        table.add_row("the policy earns at least", number(data["policy_lower"]))
        table.add_row("no policy earns more than", number(data["optimum_upper"]))
    table.add_row("simulation lemma, rows and rewards", number(data["model_error"]))
    table.add_row("chance of an error", f"below {max(data['collision_bound'], 1e-300):.1g}")
    table.add_row("time", seconds(data["seconds"]))
    table.add_row("kernels loaded or compiled", seconds(data["compile_seconds"]))
    table.add_row("peak memory", f"{data['peak_memory_bytes'] / 2**20:,.0f} MiB")
    output.table(table)
    output.line(data["note"])
