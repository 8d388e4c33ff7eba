"""Dispatch, and exit statuses: 0 done, 2 wrong use or model, 3 a limit, 130 Ctrl-C."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from factored_polca.cli.parser import parser
from factored_polca.models.errors import LimitReached, ModelError

if TYPE_CHECKING:
    from factored_polca.cli.output import Output

WITH_PROCESSES = ("bench", "study")
"""Commands that work in other processes than their own."""

MEMORY_NOTED = ("check", "convert", "plan", "simulate", "run", "compare", "figure", *WITH_PROCESSES)
"""Commands that say at their end how much memory they took: all that work more than a moment, but for
those that have it in their table."""


def commands() -> dict[str, Callable[..., int]]:
    """The functions behind the commands; importing them loads the libraries they need."""
    from factored_polca.cli import act, compare, figure, models, plan, simulate, solve
    from factored_polca.cli import commands as work

    return {
        "domains": models.domains, "new": models.new, "info": models.info, "check": models.check,
        "convert": models.convert, "minimise": work.minimise, "plan": plan.plan, "act": act.act,
        "run": run_plan, "simulate": simulate.simulate, "solve": solve.solve,
        "figure": figure.figure, "bench": run_bench, "study": run_study, "compare": compare.compare,
        "sensitivity": run_sensitivity,
    }  # fmt: skip


def run_plan(arguments: argparse.Namespace, output: Output) -> int:
    """The command `run`, whose module loads all that tracks beliefs."""
    from factored_polca.cli.run import run as work

    return work(arguments, output)


def run_study(arguments: argparse.Namespace, output: Output) -> int:
    """The command `study`, which needs none of the libraries that compute."""
    from factored_polca.cli.study import study as work

    return work(arguments, output)


def run_sensitivity(arguments: argparse.Namespace, output: Output) -> int:
    """The command `sensitivity`."""
    from factored_polca.cli.sensitivity import sensitivity

    return sensitivity(arguments, output)


def run_bench(arguments: argparse.Namespace, output: Output) -> int:
    """The command `bench`."""
    from factored_polca.cli.bench import bench

    return bench(arguments, output)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command; answer its exit status."""
    began = time.perf_counter()
    prepare_streams()
    try:
        try:
            parsed = parser().parse_args(arguments)
            parsed.began = began
            return guarded(parsed)
        except SystemExit as stop:
            return stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        close_output()
        return 1


def prepare_streams() -> None:
    """Let output that nobody can take do no harm: closed streams, and letters an encoding lacks."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def close_output() -> None:
    """Send what is still to be written nowhere, as nobody reads it; `| head` is no error."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def guarded(parsed: argparse.Namespace) -> int:
    """Run the command; turn errors into messages and exit statuses, without a traceback.

    What no one can mend but us is said too, with the status 1; with the variable
    FACTORED_POLCA_TRACEBACK set it comes with the traceback that a report of the fault needs.
    """
    from factored_polca.cli.ctrl_c import ctrl_c_comes_again
    from factored_polca.cli.memory import memory_backstop, memory_text
    from factored_polca.cli.output import Output
    from factored_polca.cli.source import UsageError
    from factored_polca.diagrams import Aborted, MemoryLimit

    output = Output(parsed.json, parsed.quiet, children=parsed.command in WITH_PROCESSES)
    memory: int | None = getattr(parsed, "memory", None)
    try:
        work = commands()[parsed.command]
        with memory_backstop(memory), ctrl_c_comes_again():
            status = work(parsed, output)
        if parsed.command in MEMORY_NOTED and not parsed.json:
            output.note(f"peak memory {memory_text(output.peak_memory_bytes())}")
        return status
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
        reason = "out of memory; give --memory to stop earlier and more gently"
        if memory is not None:
            reason = f"the {memory_text(memory)} of --memory are used up; give more, or a smaller model"
        output.error(f"limit reached: {reason}")
        return 3
    except Exception as error:
        if os.environ.get("FACTORED_POLCA_TRACEBACK"):
            traceback.print_exc()
        output.error(
            f"a fault of factored-polca, not of your input: {type(error).__name__}: {error}; please report "
            "it with what FACTORED_POLCA_TRACEBACK=1 prints"
        )
        return 1
