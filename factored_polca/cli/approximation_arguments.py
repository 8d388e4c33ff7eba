"""The options that merge near states, and what commands print of it."""

from __future__ import annotations

import argparse
from fractions import Fraction
from typing import Any

from factored_polca.cli.argument_types import gap
from factored_polca.cli.output import Output, escape, make_table


def epsilon(text: str) -> Fraction:
    """An exact number from 0 to below 1: a decimal or a fraction."""
    from factored_polca.approximation.snap import as_epsilon
    from factored_polca.models import ModelError

    if len(text) > 30 or "e" in text.lower():
        raise argparse.ArgumentTypeError(f"{text!r} is no distance of probabilities such as 0.05 or 1/20")
    try:
        return as_epsilon(text)
    except ModelError:
        message = f"{text!r} is no distance of probabilities, from 0 to below 1, such as 0.05 or 1/20"
        raise argparse.ArgumentTypeError(message) from None


def add_merging(sub: argparse.ArgumentParser, what: str) -> None:
    """Options to merge near states of `what`."""
    group = sub.add_argument_group(
        "near states", "merge states that are not quite alike, and bound what that costs"
    ).add_mutually_exclusive_group()
    group.add_argument(
        "--epsilon", type=epsilon, metavar="E",
        help="merge rows of probabilities within E of each other, and values within E of their span",
    )  # fmt: skip
    group.add_argument(
        "--loss", type=gap, metavar="L",
        help=f"the largest E whose bound on the loss of {what} is at most L, in units of reward",
    )  # fmt: skip


def tried_report(tried: tuple[Any, ...]) -> dict[str, Any]:
    """The trials of a search as plain data."""
    return {
        "tried": [
            {"epsilon": float(one.epsilon), "blocks": one.blocks, "loss_bound": one.loss} for one in tried
        ]
    }


def number(value: float | None) -> str:
    """Five digits, or a dash for what is not known."""
    return "-" if value is None else f"{round(value, 9) + 0.0:.5g}"


def print_merging(data: dict[str, Any], output: Output) -> None:
    """What is certain of the tasks of a plan whose near states were merged, and of the plan."""
    if "merge_within" not in data:
        return
    print_tried(data, output)
    columns = {
        "task": "left", "earns at least": "right", "at most": "right", "no policy more than": "right",
        "loses at most": "right", "measured": "right",
    }  # fmt: skip
    table = make_table(f"states within {data['merge_within']} merged: bounds in the model itself", columns)
    for row in data["tasks"]:
        found = row["approximation"]
        table.add_row(
            escape(row["name"]), number(found["lower"]), number(found["upper"]),
            number(found["optimum_upper"]), number(found["loss_bound"]), number(found["measured_loss"]),
        )  # fmt: skip
    certain = data["certified"]
    table.add_section()
    table.add_row(
        "all", number(certain["polled_lower"]), number(certain["polled_upper"]),
        number(certain["optimum_upper"]), number(certain["loss_bound"]), "",
    )  # fmt: skip
    output.table(table)
    output.line(
        "each task against its best policy given its children's; all: the polled policy against any, "
        "hierarchical or not; measured: the exact loss, where the exact quotients are small enough"
    )


def print_tried(data: dict[str, Any], output: Output) -> None:
    """The trials of a search."""
    if "tried" not in data:
        return
    table = make_table("tried", {"epsilon": "right", "blocks": "right", "loses at most": "right"})
    for one in data["tried"]:
        table.add_row(f"{one['epsilon']:g}", f"{one['blocks']:,}", number(one["loss_bound"]))
    output.table(table)
