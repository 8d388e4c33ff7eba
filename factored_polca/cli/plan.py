"""The command `plan`: PolCA for models whose state is seen, PolCA+ for those whose state is not."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from factored_polca.cli.approximation_arguments import print_merging, tried_report
from factored_polca.cli.commands import (
    compile_kernels,
    limits,
    refuse_unwritable,
    report_warnings,
)
from factored_polca.cli.memory import peak_memory_bytes
from factored_polca.cli.output import Output, big, escape, finite, make_table, seconds
from factored_polca.cli.source import Source, UsageError, load
from factored_polca.models import LimitReached, ModelError
from factored_polca.models.model import replace_fields

if TYPE_CHECKING:
    from factored_polca.hierarchy import HierarchicalPlan, Options, PomdpPlan
    from factored_polca.simulation.measure import Measurement

WIDE = 1e-6
"""Bounds further apart than that, relative to a value beyond 1, are told in its place."""

CHILD_EPISODES = 250
"""Episodes that measure a task other than the root, unless a number is given."""


def plan(arguments: argparse.Namespace, output: Output) -> int:
    """Plan a hierarchy, print the table, write the plan."""
    if arguments.output is not None:
        refuse_unwritable(arguments.output)
    source = load(arguments.model, arguments.set, arguments.tasks)
    source = overridden(source, arguments, output)
    partial = source.model.observability == "partial" and not arguments.polca
    if arguments.store != "blocks":
        refuse_store(arguments, partial)
    if arguments.polca and source.model.observability == "full":
        output.note("the state is seen: --polca changes nothing")
    report_warnings(source, output)
    compile_seconds = compile_kernels(output, "sarsop" if partial else None)
    if source.tasks is None:
        output.note(f"{source.name} has no tasks: planning one flat task with all actions")
    work = plan_partial if partial else plan_full
    data = work(source, options_of(arguments), arguments, output, compile_seconds)
    if arguments.json:
        output.result(data)
        return 0
    (print_pomdp_plan if partial else print_plan)(data, output)
    if arguments.output is not None:
        output.note(f"plan written to {arguments.output}; try: factored-polca simulate {arguments.output}")
    return 0


def refuse_store(arguments: argparse.Namespace, partial: bool) -> None:
    """Refuse `--store` where there is nothing to store so, before the work."""
    if partial:
        raise UsageError(
            "--store is for plans whose state is seen; policies of beliefs are kept as they are"
        )
    if arguments.output is None:
        raise UsageError("--store says what is written: give -o PLAN too")
    if arguments.interchangeable and arguments.store == "q":
        raise UsageError("--store q needs actions by name, not --interchangeable: use value or action")


def overridden(source: Source, arguments: argparse.Namespace, output: Output) -> Source:
    """The model with the discount that is asked for, and without a horizon; says what it had."""
    if arguments.discount is None:
        return source
    model = source.model
    steps = "" if model.horizon is None else f" over {model.horizon:,} steps"
    output.warn(
        f"{source.name}: planned without end at discount {arguments.discount}, in place of the model's "
        f"discount {model.discount}{steps}"
    )
    return replace(source, model=replace_fields(model, discount=arguments.discount, horizon=None))


def options_of(arguments: argparse.Namespace) -> Options:
    """The planner's options, from the command line."""
    from factored_polca.hierarchy import Options

    memory, deadline = limits(arguments)
    return Options(
        seed=arguments.seed,
        order=arguments.order,
        reachable=arguments.reachable,
        memory_limit=memory,
        deadline=deadline,
        flat_block_limit=None if arguments.no_flat else arguments.flat_blocks,
        solver=arguments.solver,
        gap=arguments.gap,
        trials=arguments.trials,
        assume_observed=arguments.polca,
        interchangeable=arguments.interchangeable,
        merge_within=arguments.epsilon,
    )


def figures(arguments: argparse.Namespace, source: Source, compile_seconds: float) -> dict[str, Any]:
    """What the whole command took."""
    return {
        "parse_seconds": source.parse_seconds,
        "compile_seconds": compile_seconds,
        "total_seconds": time.perf_counter() - arguments.began,
        "peak_memory_bytes": peak_memory_bytes(),
    }


def plan_full(
    source: Source,
    options: Options,
    arguments: argparse.Namespace,
    output: Output,
    compile_seconds: float,
) -> dict[str, Any]:
    """PolCA: the figures of the plan, which is written where that is asked for."""
    from factored_polca.hierarchy import plan_mdp
    from factored_polca.hierarchy.executable import executable
    from factored_polca.hierarchy.plan_file import save_plan
    from factored_polca.hierarchy.report import plan_report

    def progress(task: str, stage: str, number: int, blocks: int) -> None:
        detail = f": round {number}, {blocks:,} blocks" if blocks else ""
        output.update(f"{task}: {stage}{detail}")

    with source.located(), output.progress(f"planning {source.name}"):
        tried: dict[str, Any] = {}
        if arguments.loss is None:
            found = plan_mdp(source.model, source.tasks, options, progress=progress)
        else:
            found, tried = within_loss(source, options, arguments.loss, progress)
    data = plan_report(found) | tried | figures(arguments, source, compile_seconds)
    for warning in found.warnings:
        output.warn(warning)
    if arguments.output is not None and arguments.store != "blocks":
        from factored_polca.hierarchy.irrelevance import executable_by_classes

        stored = executable_by_classes(found, arguments.store, finite(data))
        blocks = sum(row["blocks"] for row in data["tasks"])
        classes = sum(policy.partition.blocks for policy in stored.policies.values())
        data["stored"] = {"by": arguments.store, "classes": classes, "blocks": blocks}
        save_plan(stored, arguments.output)
    elif arguments.output is not None:
        save_plan(executable(found, finite(data)), arguments.output)
    return data


def plan_partial(
    source: Source,
    options: Options,
    arguments: argparse.Namespace,
    output: Output,
    compile_seconds: float,
) -> dict[str, Any]:
    """PolCA+: the figures of the plan, measured, which is written where that is asked for."""
    from factored_polca.control.certify import certify_plan
    from factored_polca.hierarchy import plan_pomdp
    from factored_polca.hierarchy.merging import merging_report
    from factored_polca.hierarchy.pomdp_executable import executable_pomdp
    from factored_polca.hierarchy.pomdp_plan_file import save_pomdp_plan
    from factored_polca.hierarchy.pomdp_report import pomdp_plan_report
    from factored_polca.simulation.measure import measure

    def progress(task: str, stage: str, number: int, blocks: int) -> None:
        detail = f": round {number}, {blocks:,} blocks" if number else ""
        output.update(f"{task}: {stage}{detail}")

    with source.located(), output.progress(f"planning {source.name}"):
        tried: dict[str, Any] = {}
        if arguments.loss is None:
            found = plan_pomdp(source.model, source.tasks, options, progress=progress)
        else:
            found, tried = within_loss(source, options, arguments.loss, progress)
        polca = planned_as_seen(source, options, output)
        policy = executable_pomdp(found, merging_report(found.root.approximation, found.certified))
        deadline = extended(options.deadline, arguments)
        output.update(f"measuring {source.name}")
        measured = measure(
            policy,
            episodes=arguments.episodes,
            child_episodes=CHILD_EPISODES if arguments.episodes is None else arguments.episodes,
            seed=arguments.seed,
            progress=lambda task, first, step: output.update(
                f"measuring {task}: episodes from {first + 1:,} on, step {step:,}"
            ),
            deadline=deadline,
        )
        output.update(f"certifying {source.name}")
        found = replace(
            found, certified=certify_plan(found, policy, deadline=deadline, seed=arguments.seed)
        )
    in_time = deadline is None or time.monotonic() < deadline
    data = pomdp_plan_report(found, polca, list_states=in_time) | tried | measured_figures(found, measured)
    data |= figures(arguments, source, compile_seconds)
    for warning in found.warnings:
        output.warn(warning)
    if arguments.output is not None:
        save_pomdp_plan(executable_pomdp(found, finite(data)), arguments.output)
    return data


def extended(deadline: float | None, arguments: argparse.Namespace) -> float | None:
    """When measuring is to stop: a quarter of `--time` is left for it in any case."""
    return None if deadline is None else max(deadline, time.monotonic() + arguments.time / 4)


def within_loss(
    source: Source, options: Options, loss: float, progress: Callable[[str, str, int, int], None]
) -> tuple[Any, dict[str, Any]]:
    """The plan with the largest epsilon whose tasks lose at most `loss`, and the trials' figures."""
    from factored_polca.hierarchy.loss_search import plan_within_loss

    found, tried = plan_within_loss(source.model, loss, source.tasks, options, progress=progress)
    return found, tried_report(tried)


def planned_as_seen(source: Source, options: Options, output: Output) -> HierarchicalPlan | None:
    """The same hierarchy planned as if the state were seen, for comparison; None where PolCA can't."""
    from factored_polca.diagrams import Aborted, MemoryLimit
    from factored_polca.hierarchy import plan_mdp

    try:
        seen = replace(
            options, assume_observed=True, flat_block_limit=None, solver="auto", merge_within=None
        )
        return plan_mdp(source.model, source.tasks, seen)
    except (ModelError, LimitReached, MemoryLimit, Aborted) as error:
        output.note(f"PolCA, for comparison, is left out: {error}")
        return None


def measured_figures(found: PomdpPlan, measured: Measurement) -> dict[str, Any]:
    """What polling earned, and how beliefs were tracked; no value where time was up before."""
    runs = measured.runs.get(found.root.task.name)
    counts = [0] * len(found.model.actions) if runs is None else runs.counts.tolist()
    return {
        "value": None if runs is None else runs.mean,
        "standard_error": None if runs is None else runs.standard_error,
        "lower": found.root.lower,
        "upper": found.root.upper,
        "episodes": 0 if runs is None else runs.episodes,
        "steps": 0 if runs is None else runs.steps,
        "truncation": None if runs is None else runs.truncation,
        "measured": {
            name: {"value": run.mean, "standard_error": run.standard_error, "episodes": run.episodes}
            for name, run in measured.runs.items()
        },
        "action_counts": {
            action.name: int(count) for action, count in zip(found.model.actions, counts, strict=True)
        },
        "tracker": measured.tracker.kind,
        "tracker_reason": measured.tracker.reason,
    }


def print_plan(data: dict[str, Any], output: Output) -> None:
    """The figures of a plan by PolCA for people."""
    columns = {
        "task": "left", "actions": "right", "blocks": "right", "Q-values": "right", "classes": "right",
        "shared": "right", "value": "right", "time": "right", **cut_column(data),
    }  # fmt: skip
    table = make_table(f"{data['model']}: {big(data['states'])} states", columns)
    for row in data["tasks"]:
        value = "none" if row["value"] == -math.inf else f"{row['value']:.6g}"
        table.add_row(
            escape(row["name"]), f"{len(row['actions'])}",
            *(counted(row[key]) for key in ("blocks", "q_values", "q_classes", "q_classes_shared")),
            value, seconds(row["seconds"]), *([row["status"]] if cut_column(data) else []),
        )  # fmt: skip
    table.add_section()
    total = data["totals"]
    table.add_row(
        "all", "", f"{sum(row['blocks'] or 0 for row in data['tasks']):,}", f"{total['q_values']:,}",
        f"{total['q_classes']:,}", f"{total['q_classes_shared']:,}", "", seconds(data["seconds"]),
    )  # fmt: skip
    output.table(table)
    print_status(data, output)
    output.line("Q-values: blocks x actions; classes: distinct ones, per action; shared: per task")
    print_without_blocks(data, output)
    said = within(data["value"], data["value_bounds"])
    output.line(f"value of the hierarchical policy from the start: [bold]{said}[/]")
    if data["flat_value"] is None:
        output.line(f"flat optimum: {escape(data['flat_note'])}")
    else:
        cost = data["flat_value"] - data["value"]
        said = "nothing" if abs(cost) <= 1e-9 * max(1, abs(data["flat_value"])) else f"{cost:.6g}"
        texts = [within(data[key], data[f"{key}_bounds"]) for key in ("flat_value", "value")]
        if any(" and " in text for text in texts):
            said = "something within these bounds"
        output.line(f"flat optimum: {texts[0]}; the hierarchy costs {said}")
    print_merging(data, output)
    if "stored" in data:
        stored = data["stored"]
        classes, blocks = f"{stored['classes']:,}", f"{stored['blocks']:,}"
        output.line(f"stored by {stored['by']}: {classes} classes in place of {blocks} blocks")
    output.line(f"guarantee: {escape(data['guarantee'])}")


def longer(data: dict[str, Any]) -> str:
    """What longer episodes could change, where time has made them shorter than they would have been."""
    if data["truncation"] <= max(data["standard_error"], 1e-6 * abs(data["value"])):
        return ""
    return f"; longer ones may change it by {data['truncation']:.2g}"


def cut_column(data: dict[str, Any]) -> dict[str, Literal["left"]]:
    """The column that tells how searches ended, where a limit cut one short."""
    return {} if data["status"] == "complete" else {"status": "left"}


def print_status(data: dict[str, Any], output: Output) -> None:
    """Say that a limit was reached, where it was."""
    if data["status"] != "complete":
        output.line(f"[bold]{data['status']}[/]: the best plan so far; bounds hold, and may be wide")


def print_without_blocks(data: dict[str, Any], output: Output) -> None:
    """How tasks without a quotient were solved."""
    for row in data["tasks"]:
        if row["blocks"] is None:
            output.line(f"{escape(row['name'])}: {escape(row['solver'])}, {escape(row['note'])}")


def within(value: float, bounds: Sequence[float]) -> str:
    """A value, or its bounds where they are wide."""
    low, high = bounds
    if not high - low > WIDE * max(1.0, abs(value)):
        return f"{value:.9g}"
    return f"between {low:.6g} and {high:.6g}"


def counted(count: int | None) -> str:
    """A count; a dash where there are no blocks."""
    return "-" if count is None else f"{count:,}"


def print_pomdp_plan(data: dict[str, Any], output: Output) -> None:
    """The figures of a plan by PolCA+ for people."""
    columns = {
        "task": "left", "actions": "right", "blocks": "right", "observations": "right",
        "unabstracted": "right", "PolCA": "right", "PolCA+": "right", "as planned": "right",
        "corner gap": "right", "measured": "right", "time": "right", **cut_column(data),
    }  # fmt: skip
    table = make_table(f"{data['model']}: {big(data['states'])} states", columns)
    for row in data["tasks"]:
        measured = data["measured"].get(row["name"])
        table.add_row(
            escape(row["name"]), f"{len(row['actions'])}", counted(row["blocks"]),
            observations_text(row["observations"]),
            *parameters_text(row["parameters"]), f"{brief(row['lower'])} .. {brief(row['upper'])}",
            f"{row['corner_gap']:.2g}", "" if measured is None else measured_text(measured),
            seconds(row["seconds"]), *([row["status"]] if cut_column(data) else []),
        )  # fmt: skip
    table.add_section()
    table.add_row(
        "all", "", counted(sum(row["blocks"] or 0 for row in data["tasks"]) or None), "",
        *parameters_text(data["totals"]["parameters"]), "", "", "", seconds(data["seconds"]),
    )  # fmt: skip
    output.table(table)
    print_status(data, output)
    output.line(
        "observations: joint ones of all actions, before and after merging; unabstracted, PolCA, PolCA+: "
        "parameters of the task's model (Figure 4a); as planned: bounds in the task's own model, where a "
        "child does what it does when certain of the state"
    )
    print_without_blocks(data, output)
    if data["value"] is None:
        output.line("what the hierarchical policy earns was not measured: time was up")
    else:
        output.line(
            f"the hierarchical policy earns [bold]{data['value']:.6g}[/] ± {data['standard_error']:.2g} "
            f"from the start (mean and standard error, {data['episodes']:,} episodes of {data['steps']:,} "
            f"steps{longer(data)})"
        )
    if data["flat_upper"] is None:
        output.line(f"bound on all policies: {escape(data['flat_note'])}")
    else:
        output.line(f"no policy earns more than {data['flat_upper']:.6g} ({escape(data['flat_note'])})")
    print_certified(data["certified"], output)
    output.line(f"tracker: {escape(data['tracker'])}; {escape(data['tracker_reason'])}")
    print_merging(data, output)
    output.line(f"guarantee: {escape(data['guarantee'])}")


def print_certified(certified: dict[str, Any], output: Output) -> None:
    """What the hierarchical policy surely earns."""
    low, high, note = certified["polled_lower"], certified["polled_upper"], escape(certified["note"])
    if low is None:
        output.line(f"certified: {note}")
    else:
        output.line(f"certified: the hierarchical policy earns {brief(low)} .. {brief(high)} ({note})")


def observations_text(counts: dict[str, dict[str, int]] | None) -> str:
    """Joint observations before and after merging; a dash where there is no quotient."""
    if counts is None:
        return "-"
    before, after = (sum(count[key] for count in counts.values()) for key in ("before", "after"))
    return f"{before:,} -> {after:,}"


def brief(value: float) -> str:
    """Five digits of a number, without what rounding has left of a 0."""
    return f"{round(value, 9) + 0.0:.5g}"


def parameters_text(parameters: dict[str, int | None]) -> list[str]:
    """The three numbers of parameters; a dash where one is not known."""
    return ["-" if count is None else f"{count:,}" for count in parameters.values()]


def measured_text(measured: dict[str, Any]) -> str:
    """A mean with its standard error."""
    return f"{measured['value']:.5g} ± {measured['standard_error']:.2g}"
