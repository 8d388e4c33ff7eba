"""Arguments, dispatch, and exit statuses: 0 done, 2 wrong use or model, 3 a limit, 130 Ctrl-C."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version

from factored_polca.models.errors import LimitReached, ModelError

DESCRIPTION = """Plan factored Markov decision processes with task hierarchies: each subtask is
minimised exactly on decision diagrams, without enumerating states, and solved."""

EXAMPLES = """examples:
  factored-polca plan taxi --set size=10        plan a shipped domain
  factored-polca minimise linear --set size=64  2^64 states become 65 blocks
  factored-polca new robot                      write robot.toml, a model to start from
  factored-polca plan robot.toml -o robot.polca
  factored-polca simulate robot.polca --episodes 1000
"""


def parser() -> argparse.ArgumentParser:
    """The parser of the command line."""
    top = argparse.ArgumentParser(
        "factored-polca",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"factored-polca {installed_version()}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def command(name: str, text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        sub.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
        sub.add_argument("-q", "--quiet", action="store_true", help="no progress, no notes")
        return sub

    def with_model(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("model", metavar="MODEL", help="a model file, or the name of a shipped domain")
        sub.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="NAME=VALUE",
            help="set a parameter; may be repeated",
        )

    def with_limits(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("--seed", type=natural, default=0, metavar="S", help="seed of random draws (0)")
        sub.add_argument("--memory", metavar="SIZE", help="memory limit, such as 2GB")
        sub.add_argument("--time", type=positive, metavar="SECONDS", help="time limit")
        sub.add_argument("--order", default="auto", choices=ORDERS, help="order of the diagrams' variables")
        sub.add_argument("--reachable", action="store_true", help="only states that the start can reach")

    command("domains", "List the shipped domains.")
    command("new", "Write a commented model to start from.").add_argument("name", metavar="NAME")
    with_model(command("info", "Describe a model, or a domain and its parameters."))
    with_model(command("check", "Check a model and its tasks, and report all faults at once."))
    sub = command("minimise", "Merge the states that behave alike, exactly.")
    with_model(sub)
    with_limits(sub)
    sub.add_argument("--actions", metavar="A,B,...", help="only these actions count")
    sub.add_argument("--certify", action="store_true", help="check the partition without fingerprints")
    sub = command("plan", "Plan a task hierarchy with PolCA.")
    with_model(sub)
    with_limits(sub)
    sub.add_argument("--tasks", metavar="FILE", help="take the tasks from this .toml file")
    sub.add_argument("-o", "--output", metavar="PLAN", help="write the plan to a file")
    sub.add_argument("--solver", default="auto", help="auto, vi, pi or mpi, for tasks that name none")
    sub.add_argument("--no-flat", action="store_true", help="leave out the flat optimum")
    sub.add_argument(
        "--flat-blocks", type=natural, default=100_000, metavar="N",
        help="leave out the flat optimum beyond N blocks (100000)",
    )  # fmt: skip
    sub = command("act", "Say what a plan does in a state, and why.")
    sub.add_argument("plan", metavar="PLAN")
    sub.add_argument("--state", required=True, metavar="x=3,y=2,...", help="a value for each feature")
    sub = command("simulate", "Run a plan on the original model.")
    sub.add_argument("plan", metavar="PLAN")
    sub.add_argument("--episodes", type=natural, default=1000, metavar="N", help="1000 if not given")
    sub.add_argument(
        "--steps", type=natural, metavar="T", help="steps an episode; by the discount if not given"
    )
    sub.add_argument("--seed", type=natural, default=0, metavar="S")
    sub = command("convert", "Write a model in another format, chosen by the extension.")
    with_model(sub)
    sub.add_argument("output", metavar="OUT")
    return top


ORDERS = ("auto", "file", "force", "spectral")


def natural(text: str) -> int:
    """A whole number from 0 on."""
    if not text.isdecimal() or len(text) > 15:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number")
    return int(text)


def positive(text: str) -> float:
    """A positive number."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number of seconds")
    return value


def installed_version() -> str:
    """The version of the installed package."""
    try:
        return version("factored-polca")
    except PackageNotFoundError:
        return "unknown (not installed)"


def commands() -> dict[str, Callable[..., int]]:
    """The functions behind the commands; importing them loads the libraries they need."""
    from factored_polca.cli import commands as work
    from factored_polca.cli import models

    return {
        "domains": models.domains, "new": models.new, "info": models.info, "check": models.check,
        "convert": models.convert, "minimise": work.minimise, "plan": work.plan, "act": work.act,
        "simulate": work.simulate,
    }  # fmt: skip


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command; answer its exit status."""
    try:
        parsed = parser().parse_args(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        return guarded(parsed)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        with contextlib.suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def guarded(parsed: argparse.Namespace) -> int:
    """Run the command; turn the errors that users can mend into messages and exit statuses."""
    from factored_polca.cli.output import Output
    from factored_polca.cli.source import UsageError
    from factored_polca.diagrams import Aborted, MemoryLimit

    output = Output(parsed.json, parsed.quiet)
    try:
        return commands()[parsed.command](parsed, output)
    except BrokenPipeError:
        raise
    except ModelError as error:
        for fault in error.faults[:20]:
            output.error(str(fault))
        if len(error.faults) > 20:
            output.error(f"... and {len(error.faults) - 20} more")
        return 2
    except (UsageError, OSError) as error:
        output.error(str(error))
        return 2
    except (LimitReached, MemoryLimit, Aborted) as error:
        output.error(f"limit reached: {error}")
        return 3
    except MemoryError:
        output.error("limit reached: out of memory; give --memory to stop earlier and more gently")
        return 3
