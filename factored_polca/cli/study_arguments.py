"""The options of the command `study`."""

from __future__ import annotations

import argparse

from factored_polca.cli.argument_types import counting

NOTES = """a study is a TOML file that says what is to be run; `study new` writes one to start from

  factored-polca study new growth.toml
  factored-polca study run growth.toml --jobs 4      may be stopped at any moment, and goes on from there
  factored-polca study status growth.toml
  factored-polca study report growth.toml            growth-report/index.html, and plots as PNG
  factored-polca study export growth.toml growth.csv

Results are in growth.sqlite beside the file.  Each run has a process of its own with hard limits of time
and memory, and ends as ok, timeout, memout or error.  A name written package.module:name in a study's
file is imported: run only studies that you trust.

exit status of `study run`: 0 when all runs have a result, whatever it is; 1 where nothing can be run any
more; 2 where another process is running the study; 130 after Ctrl-C.
"""

STATUSES = ("ok", "timeout", "memout", "error")


def statuses(text: str) -> tuple[str, ...]:
    """Statuses of results, with commas."""
    names = tuple(name.strip() for name in text.split(","))
    for name in names:
        if name not in STATUSES:
            raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(STATUSES)}")
    return names


def add_study(sub: argparse.ArgumentParser) -> None:
    """The commands of `study`."""
    sub.epilog, sub.formatter_class = NOTES, argparse.RawDescriptionHelpFormatter
    commands = sub.add_subparsers(dest="which", required=True, metavar="ACTION")

    def one(name: str, text: str) -> argparse.ArgumentParser:
        found = commands.add_parser(name, help=text, description=text)
        # Without a default they leave what stands before the action's name as it is.
        found.add_argument(
            "--json", action="store_true", default=argparse.SUPPRESS, help="print one JSON object only"
        )
        found.add_argument(
            "-q", "--quiet", action="store_true", default=argparse.SUPPRESS, help="no progress, no notes"
        )
        return found

    def with_store(found: argparse.ArgumentParser) -> None:
        found.add_argument("file", metavar="FILE", help="a study (.toml), or its store")

    one("new", "Write a commented study to start from.").add_argument("file", metavar="FILE.toml")
    found = one("run", "Run what has no result yet.")
    found.add_argument("file", metavar="FILE.toml")
    found.add_argument("--store", metavar="STORE", help="keep the results there")
    found.add_argument(
        "--jobs", type=counting, metavar="N", help="runs at a time (as the file says, else 1)"
    )
    found.add_argument(
        "--retry", type=statuses, default=(), metavar="STATUS,...",
        help="run those again that ended so: timeout, memout, error, ok",
    )  # fmt: skip
    with_store(one("status", "Tell how far a study is."))
    found = one("report", "Write a page with tables and plots, and the plots as PNG.")
    with_store(found)
    found.add_argument("-o", "--output", metavar="FOLDER", help="NAME-report beside the store if not given")
    found = one("export", "Write the results as a table.")
    with_store(found)
    found.add_argument("output", metavar="OUT", help="a .csv or .parquet file")
