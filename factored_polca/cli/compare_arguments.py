"""The options of the command `compare`."""

from __future__ import annotations

import argparse

from factored_polca.cli.argument_types import counting, natural


def add_comparing(sub: argparse.ArgumentParser) -> None:
    """Two plans, and how they are run."""
    sub.add_argument("first", metavar="PLAN", help="a plan, or a policy that solve found")
    sub.add_argument("second", metavar="PLAN", help="another one for the same model")
    sub.add_argument(
        "--episodes",
        type=counting,
        metavar="N",
        help="1000 if not given; 100 where beliefs are not over blocks",
    )
    sub.add_argument(
        "--steps", type=counting, metavar="T", help="steps an episode; by the discount if not given"
    )
    sub.add_argument("--seed", type=natural, default=0, metavar="S", help="seed of what is drawn (0)")
