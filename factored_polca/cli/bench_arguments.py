"""The options of `bench`."""

from __future__ import annotations

import argparse

from factored_polca.cli.argument_types import counting, positive

NOTES = """A case's name is matched by any part of it: `bench taxi` runs all sizes of taxi.  Each case runs
in a process of its own, and beside it, where stormpy is installed (the extra `storm`), Storm's sparse and
dd engines on the same model.  Nothing else should run on the machine meanwhile.
"""


def add_bench(sub: argparse.ArgumentParser) -> None:
    """Add them."""
    sub.epilog, sub.formatter_class = NOTES, argparse.RawDescriptionHelpFormatter
    sub.add_argument("case", metavar="CASE", nargs="*", help="parts of cases' names; all if not given")
    sub.add_argument("--list", action="store_true", help="list the cases and run none")
    sub.add_argument("--quick", action="store_true", help="only those that take a few seconds")
    sub.add_argument("--large", action="store_true", help="also those with 10^5 to 10^6 blocks")
    sub.add_argument("--repeat", type=counting, default=3, metavar="N", help="repetitions of each (3)")
    sub.add_argument(
        "--time", type=positive, default=600.0, metavar="SECONDS", help="limit for each run (600)"
    )
    sub.add_argument("--no-peer", action="store_true", help="leave Storm out")
    sub.add_argument("-o", "--output", metavar="FILE.md", help="write the table as Markdown")
