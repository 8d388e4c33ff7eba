"""The command `figure`: the paper's Figures 4a, 4b and 4c and its Table 1, from our own runs."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factored_polca.cli.commands import compile_kernels, refuse_unwritable, report_warnings
from factored_polca.cli.figure_q_values import figure_4c
from factored_polca.cli.output import Output, big, escape, make_table, seconds
from factored_polca.cli.source import Source, UsageError, load, parse_settings

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from factored_polca.hierarchy import Options


def figure(arguments: argparse.Namespace, output: Output) -> int:
    """Compute one of the figures, print its table, and draw it where that is asked for."""
    work: dict[str, Callable[..., int]] = {
        "4a": figure_4a, "4b": figure_4b, "4c": figure_4c, "table1": table_1,
    }  # fmt: skip
    if getattr(arguments, "output", None) is not None:
        refuse_undrawable(arguments.output)
    return work[arguments.which](arguments, output)


def refuse_undrawable(path: str) -> None:
    """Find out before the work, not after it, that its drawing can't be made.

    Raises:
        UsageError: no PNG file, no matplotlib, or a folder that can't be written to.
        ModelError: no such folder, or no regular file in the file's place.
    """
    from factored_polca.studies.drawing import MissingLibrary, require_matplotlib

    if Path(path).suffix.lower() != ".png":
        raise UsageError(f"{path}: figures are drawn as PNG; name a file that ends in .png")
    try:
        require_matplotlib()
    except MissingLibrary as error:
        raise UsageError(str(error)) from None
    refuse_unwritable(path)


def options_of(arguments: argparse.Namespace) -> Options:
    """The planner's options, from the command line."""
    from factored_polca.hierarchy import Options

    return Options(seed=arguments.seed, trials=arguments.trials)


def prepared(arguments: argparse.Namespace, output: Output) -> Source:
    """The model, read, and the kernels, compiled."""
    source = load(arguments.model, arguments.set)
    report_warnings(source, output)
    compile_kernels(output, "sarsop")
    return source


def finish(
    data: dict[str, Any],
    arguments: argparse.Namespace,
    output: Output,
    show: Callable[[dict[str, Any], Output], None],
    draw: Callable[[Axes], Axes] | None = None,
) -> int:
    """Draw, then print for people or as JSON."""
    from factored_polca.studies.drawing import write_drawing

    path = getattr(arguments, "output", None)
    if draw is not None and path is not None:
        write_drawing(path, draw)
    data["total_seconds"] = time.perf_counter() - arguments.began
    if arguments.json:
        output.result(data)
        return 0
    show(data, output)
    if path is not None:
        output.note(f"drawing written to {path}")
    return 0


# -- Figure 4a -------------------------------------------------------------------------------------


def figure_4a(arguments: argparse.Namespace, output: Output) -> int:
    """Parameters without abstraction, with PolCA's and with PolCA+'s."""
    from factored_polca.studies.drawing import draw_parameters
    from factored_polca.studies.parameters import study_parameters

    source = prepared(arguments, output)
    with source.located(), output.progress(f"planning {source.name}"):
        study = study_parameters(source.model, source.tasks, options_of(arguments), progress=output.update)
    return finish(study.to_data(), arguments, output, print_4a, lambda ax: draw_parameters(study, ax))


def print_4a(data: dict[str, Any], output: Output) -> None:
    """Figure 4a as a table."""
    columns = {"task": "left", "no abstraction": "right", "PolCA": "right", "PolCA+": "right"}
    table = make_table(f"{data['model']}: {big(data['states'])} states", columns)
    for row in data["tasks"]:
        table.add_row(escape(row["name"]), *counts(row))
    table.add_section()
    table.add_row("all", *counts(data["totals"]))
    output.table(table)
    output.line(
        "parameters: non-zero entries of the transitions (with observations but for PolCA) and rewards"
    )
    for note in data["notes"]:
        output.line(escape(note))


def counts(row: dict[str, int | None]) -> list[str]:
    """The three numbers of parameters; a dash where one is not known."""
    return ["-" if row[k] is None else f"{row[k]:,}" for k in ("none", "polca", "polca_plus")]


# -- Figure 4b -------------------------------------------------------------------------------------


def figure_4b(arguments: argparse.Namespace, output: Output) -> int:
    """What PolCA+, PolCA, QMDP and flat SARSOP earn."""
    if arguments.perturbations is not None:
        return figure_4b_perturbed(arguments, output)
    if arguments.perturbation is not None:
        raise UsageError(
            "--perturbation goes with --perturbations N; for one model use --set perturbation="
        )
    from factored_polca.studies.drawing import draw_rewards
    from factored_polca.studies.rewards import EPISODES, study_rewards

    source = prepared(arguments, output)
    with source.located(), output.progress(f"planning {source.name}"):
        study = study_rewards(
            source.model,
            source.tasks,
            options_of(arguments),
            episodes=arguments.episodes or EPISODES,
            steps=arguments.steps,
            flat_trials=arguments.flat_trials,
            progress=output.update,
        )
    return finish(study.to_data(), arguments, output, print_4b, lambda ax: draw_rewards(study, ax))


def print_4b(data: dict[str, Any], output: Output) -> None:
    """Figure 4b as tables: rewards, differences, actions."""
    columns = {
        "policy": "left", "discounted return": "right", f"reward in {data['steps']:,} steps": "right",
        "bounds on the optimum": "right", "as planned": "right", "planned in": "right",
    }  # fmt: skip
    title = f"{data['model']}: {data['episodes']:,} episodes, discount {data['discount']:g}"
    table = make_table(title, columns)
    for row in data["policies"]:
        table.add_row(
            row["name"], measured(row["mean"], row["standard_error"]),
            measured(row["cumulative_end"], row["cumulative_end_error"]),
            interval(row["lower"], row["upper"]), interval(row["planned_lower"], row["planned_upper"]),
            seconds(row["planning_seconds"]),
        )  # fmt: skip
    table.add_section()
    for row in data["differences"]:
        name = f"{row['first']} - {row['second']}"
        table.add_row(name, measured(row["mean"], row["standard_error"]), "", "", "", "")
    output.table(table)
    output.line(
        "± standard errors, of differences that of paired episodes; as planned: in the planner's own "
        "model, where a child does what it does when certain (PolCA+) or the state is seen (PolCA)"
    )
    names = [row["name"] for row in data["policies"]]
    table = make_table("actions an episode", {"action": "left", **dict.fromkeys(names, "right")})
    for action in data["policies"][0]["action_counts"]:
        often = [row["action_counts"][action] for row in data["policies"]]
        if any(often):
            table.add_row(escape(action), *(f"{count:.2f}" if count else "-" for count in often))
    output.table(table)
    said = "holds" if data["order_holds"] else "does not hold"
    clear = ", by more than two standard errors each" if data["order_is_clear"] else ""
    output.line(f"PolCA+ > PolCA > QMDP {said} for the mean discounted returns{clear}")
    said = "holds" if data["cumulative_order_holds"] else "does not hold"
    output.line(f"PolCA+ > PolCA > QMDP {said} for the mean cumulative rewards")


def measured(mean: float, error: float) -> str:
    """A mean with its standard error."""
    return f"{mean:.2f} ± {error:.2g}"


def interval(low: float | None, high: float | None) -> str:
    """Bounds."""
    return "" if low is None or high is None else f"{low:.5g} .. {high:.5g}"


def figure_4b_perturbed(arguments: argparse.Namespace, output: Output) -> int:
    """The comparison for many seeds of perturbed numbers."""
    from factored_polca import library
    from factored_polca.studies.drawing import draw_perturbations
    from factored_polca.studies.perturbations import EPISODES, SHARE, study_perturbations

    name = arguments.model
    if name not in library.domains():
        raise UsageError(f"--perturbations takes a shipped domain, not {name!r}")
    compile_kernels(output, "sarsop")
    with output.progress(f"perturbing {name} {arguments.perturbations} times"):
        study = study_perturbations(
            name,
            parse_settings(arguments.set),
            options_of(arguments),
            count=arguments.perturbations,
            share=SHARE if arguments.perturbation is None else arguments.perturbation,
            episodes=arguments.episodes or EPISODES,
            steps=arguments.steps,
            progress=output.update,
        )
    return finish(
        study.to_data(), arguments, output, print_perturbations, lambda ax: draw_perturbations(study, ax)
    )


def print_perturbations(data: dict[str, Any], output: Output) -> None:
    """The comparison for many seeds as a table."""
    pairs = [f"{d['first']} - {d['second']}" for d in data["runs"][0]["differences"]]
    columns = {"seed": "right", **dict.fromkeys([*data["order"], *pairs], "right"), "order": "left"}
    title = f"{data['model']}, numbers changed by up to {data['perturbation']:.0%}: discounted returns"
    table = make_table(title, columns)
    for run in data["runs"]:
        said = "clear" if run["order_is_clear"] else "holds" if run["order_holds"] else "no"
        means = [measured(run["means"][n], run["standard_errors"][n]) for n in data["order"]]
        apart = [measured(d["mean"], d["standard_error"]) for d in run["differences"]]
        table.add_row(f"{run['seed']}", *means, *apart, said)
    output.table(table)
    of = data["perturbations"]
    output.line(
        f"PolCA+ > PolCA > QMDP holds for the mean discounted returns in {data['held']} of {of} "
        f"({data['episodes']:,} episodes each), in {data['clear']} by more than two standard errors each "
        f"time; in {data['refuted']} two policies stand the other way round by more than that"
    )
    output.line(f"it holds for the mean cumulative rewards in {data['cumulative_held']} of {of}")


# -- Table 1 ---------------------------------------------------------------------------------------


def table_1(arguments: argparse.Namespace, output: Output) -> int:
    """What the controller does after the observations of the paper's Table 1."""
    from factored_polca.studies.dialogue import study_dialogue

    arguments.model = "nursebot"
    source = prepared(arguments, output)
    with output.progress(f"planning {source.name}"):
        study = study_dialogue(
            source.model,
            source.tasks,
            options=options_of(arguments),
            flat_trials=arguments.flat_trials,
            progress=output.update,
        )
    return finish(study.to_data(), arguments, output, print_table_1)


def print_table_1(data: dict[str, Any], output: Output) -> None:
    """Table 1 beside the controller's answers, and what stands behind the differences."""
    columns = {
        "": "right", "observation": "left", "paper": "left", "reward": "right", "controller": "left",
        "Q-gap": "right", "flat SARSOP": "left",
    }  # fmt: skip
    table = make_table(f"{data['model']}: the dialogue of Table 1", columns)
    for row in data["rows"]:
        ours = "=" if row["equal"] else f"[bold]{escape(row['action'])}[/]"
        gap = "" if row["equal"] else f"{row['q_gap']:+.2f}"
        flat = "=" if row["flat_action"] == row["paper_action"] else escape(row["flat_action"])
        table.add_row(
            f"{row['row']}", escape(row["observation"]), escape(row["paper_action"]),
            f"{row['paper_reward']}", ours, gap, flat,
        )  # fmt: skip
    output.table(table)
    output.line(
        "=: the paper's action; Q-gap: what the controller's answer is worth more than the paper's action, "
        "by looking one step ahead with flat SARSOP's lower bound (at these beliefs its bounds are up to "
        f"{data['bound_gap']:.3g} apart)"
    )
    for row in data["rows"]:
        for line in explanation(row):
            output.line(line)
    output.line(
        f"[bold]{data['equal']} of {data['of']}[/] actions equal; of the rows with reward 50 "
        f"{data['goals_equal']} of {data['goals']}; flat SARSOP: {data['equal_flat']} of {data['of']}"
    )


def explanation(row: dict[str, Any]) -> list[str]:
    """What stands behind a row where the actions differ, or whose observation was skipped."""
    lines = []
    if row["impossible"] is not None:
        lines.append(f"{row['row']}: skipped: {escape(row['impossible'])}")
    if row["equal"]:
        return lines
    features = row["belief"].items()
    believed = ", ".join(
        f"{escape(name)}={escape(shown(one['value']))} {one['probability']:.2f}" for name, one in features
    )
    lines.append(f"{row['row']}: believes {believed}")
    better = "answer" if row["q_gap"] >= 0 else "paper's action"
    lines.append(
        f"    {escape(row['action'])} brings {row['expected_reward']:.1f} now, "
        f"{escape(row['paper_action'])} {row['expected_paper_reward']:.1f} (in the paper "
        f"{row['paper_reward']}); the {better} is worth "
        f"{abs(row['q_gap']):.2f} more, and in the eyes of {escape(str(row['parted_in']))} the answer "
        f"{row['task_q_gap']:+.2f}"
    )
    return lines


def shown(value: object) -> str:
    """A value as a person would write it."""
    return str(value).lower() if isinstance(value, bool) else str(value)
