"""The command `figure 4c`: stored values and learning curves on Taxi and Taxi2."""

from __future__ import annotations

import argparse
import time
from typing import Any

from factored_polca.cli.commands import announced_compiling, compile_kernels
from factored_polca.cli.output import Output, escape, make_table
from factored_polca.cli.source import parse_settings


def figure_4c(arguments: argparse.Namespace, output: Output) -> int:
    """Count and learn, print both tables, and draw them where that is asked for."""
    from factored_polca.studies.q_values import refuse_settings, study_q_values

    settings = parse_settings(arguments.set)
    refuse_settings(settings)
    compile_kernels(output)
    with announced_compiling(output), output.progress("learning Taxi and Taxi2"):
        study = study_q_values(
            settings, episodes=arguments.episodes, seed=arguments.seed, progress=output.update
        )
    if arguments.output is not None:
        from factored_polca.studies import q_value_drawing as drawing
        from factored_polca.studies.drawing import write_figure

        write_figure(
            arguments.output, lambda figure: drawing.fill_figure(study, figure),
            width=drawing.WIDTH, height=drawing.HEIGHT,
        )  # fmt: skip
    data = study.to_data()
    data["total_seconds"] = time.perf_counter() - arguments.began
    if arguments.json:
        output.result(data)
        return 0
    print_4c(data, output)
    if arguments.output is not None:
        output.note(f"drawing written to {arguments.output}")
    return 0


def print_4c(data: dict[str, Any], output: Output) -> None:
    """A table for each domain."""
    close = f"within {data['close']:.0%}"
    for domain in data["domains"]:
        title = (
            f"{domain['domain']}: {domain['live_states']:,} states that are not terminal, "
            f"{domain['episodes']:,} episodes"
        )
        columns = {
            "method": "left", "γ": "right", "stored": "right", "visited": "right", close: "right",
            "return": "right", "optimum": "right",
        }  # fmt: skip
        table = make_table(title, columns)
        for row in domain["learners"]:
            there = row["episodes_to_optimum"]
            table.add_row(
                escape(row["name"]), f"{row['discount']:g}", f"{row['stored_values']:,}",
                f"{row['visited']:,}", "never" if there is None else f"{there:,}",
                shown(row["final_return"]), shown(domain["optimum"]),
            )  # fmt: skip
        table.add_section()
        for row in domain["polca"]:
            for field, text in polca_counts():
                table.add_row(
                    f"PolCA, {text}", f"{row['discount']:g}", f"{row[field]:,}", "", "",
                    shown(row["return"]), shown(row["optimum"]),
                )  # fmt: skip
        output.table(table)
        output.line()
    output.line(
        "stored: values, allocated over the states that are not terminal; visited: those that learning "
        "updated"
    )
    output.line(
        f"{close}: of the optimal return the greedy policy is from that episode on; returns are exact, "
        "discounted, from the start; endless: the greedy policy may never end"
    )
    output.line(
        "PolCA plans and counts Q-values: of blocks and actions, of pairs that an action's transitions and "
        "rewards tell apart, and of those shared by a task's actions"
    )


def polca_counts() -> tuple[tuple[str, str], ...]:
    """PolCA's counts, by their names in the data and in words."""
    from factored_polca.studies.q_values import COUNTS

    return COUNTS


def shown(value: float) -> str:
    """A return."""
    return "endless" if value == float("-inf") else f"{value:.4f}"
