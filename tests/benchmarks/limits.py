"""Run every command under limits on every shipped domain, at growing sizes up to the first limit.

    python tests/benchmarks/limits.py [--memory 2GB] [--time 30] [--command COMMAND] [WORD ...]

Each run is a process of its own, a copy of this one with the kernels loaded.  Good ends are a result
(exit status 0) and a limit that is named (exit status 3 with `limit reached`).  Everything else is a fault
and is shown at the end: a signal, a traceback, another status, a resident set beyond the limit by more than
an eighth, or no end at all.  WORD picks the domains whose name holds it.  Runs of a command on a domain go
on until the first limit.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import threading
import time
import traceback
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from factored_polca.cli import main as command_line
from factored_polca.hierarchy.warm import warm_up

SIZES: dict[str, tuple[str, ...]] = {
    "cheese": ("",),
    "cheese_taxi": ("",),
    "coffee": ("",),
    "components": ("size=4", "size=10", "size=40", "size=150", "size=400"),
    "expon": ("size=6", "size=10", "size=14", "size=18", "size=24"),
    "hallway": ("size=5", "size=11", "size=30", "size=100", "size=400"),
    "linear": ("size=4", "size=16", "size=64", "size=200", "size=500"),
    "meds": ("",),
    "network": ("size=3", "size=5", "size=8", "size=12", "size=20"),
    "nursebot": ("", "topics=4", "rooms=4", "rooms=4 bystanders=2", "rooms=8 bystanders=4 patients=2"),
    "part_painting": ("",),
    "rocksample": (
        "size=3 rocks=3", "size=5 rocks=6", "size=7 rocks=8", "size=10 rocks=12", "size=15 rocks=20",
    ),
    "sysadmin": ("size=4", "size=8", "size=12", "size=16", "size=24"),
    "taxi": ("size=5", "size=16", "size=48", "size=128", "size=256"),
    "taxi anywhere=true": ("size=5", "size=8", "size=16", "size=32", "size=64"),
    "tiger": ("",),
    "toy": ("",),
    "twenty_questions": ("",),
    "workshop": ("size=4", "size=8", "size=12", "size=18", "size=30"),
}  # fmt: skip

COMMANDS: dict[str, tuple[str, ...]] = {
    "check": ("check", "MODEL"),
    "minimise": ("minimise", "MODEL"),
    "plan": ("plan", "MODEL"),
    "solve": ("solve", "MODEL"),
    "convert to a quotient": ("convert", "MODEL", "out.npz", "--minimise"),
    "convert to a list": ("convert", "MODEL", "out.pomdp", "--no-tasks"),
}


@dataclass(frozen=True)
class End:
    """How a run ended; `status` is negative for a signal, None where it had to be stopped."""

    status: int | None
    seconds: float
    peak_bytes: int
    message: str

    def fault(self, memory: int) -> str:
        """What is wrong, or nothing."""
        if self.status is None:
            return "it went on and on"
        if self.status < 0:
            return f"killed by {signal.Signals(-self.status).name}"
        if "Traceback" in self.message or "a fault of factored-polca" in self.message:
            return "a traceback or an unforeseen error"
        if self.status not in (0, 3):
            return f"exit status {self.status}"
        if self.status == 3 and "limit reached" not in self.message:
            return "a limit without its name"
        if self.peak_bytes > memory * 9 // 8:
            return f"{self.peak_bytes / 2**20:,.0f} MiB"
        return ""

    def text(self) -> str:
        """A cell of the table."""
        word = {0: "done", 3: "limit"}.get(-1 if self.status is None else self.status, "FAULT")
        return f"{word} {self.seconds:.0f} s {self.peak_bytes / 2**20:,.0f} MiB"


def run(command: list[str], folder: str, patience: float) -> End:
    """Run one command in a copy of this process, which has the kernels loaded."""
    began = time.monotonic()
    log = Path(folder, "stderr")
    child = os.fork()
    if not child:
        status = 1
        try:
            os.chdir(folder)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT), 2)
            status = command_line(command)
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)
    stopped = threading.Event()

    def stop() -> None:
        stopped.set()
        os.kill(child, signal.SIGKILL)

    watch = threading.Timer(patience, stop)
    watch.start()
    _, code, usage = os.wait4(child, 0)
    watch.cancel()
    status_or_none = None if stopped.is_set() else os.waitstatus_to_exitcode(code)
    message = log.read_text(encoding="utf-8", errors="replace") if log.exists() else ""
    return End(status_or_none, time.monotonic() - began, usage.ru_maxrss * 1024, message)


def main() -> None:
    """Print the table, then the faults."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("words", nargs="*", metavar="WORD", help="domains whose name holds it")
    parser.add_argument("--memory", type=float, default=2.0, help="limit in GB")
    parser.add_argument("--time", type=float, default=30.0, help="limit in seconds")
    parser.add_argument(
        "--patience", type=float, default=600.0, help="seconds after which a run is stopped"
    )
    parser.add_argument("--command", choices=COMMANDS, help="this command only")
    options = parser.parse_args()
    limits = ["--memory", f"{options.memory}GB", "--time", str(options.time), "--quiet"]
    warm_up()
    faults = []
    print("| domain | size | command | end | |")
    print("|---|---|---|---|---|")
    for domain, sizes in SIZES.items():
        for name, words in COMMANDS.items():
            if options.words and not any(word in domain for word in options.words):
                continue
            if options.command not in (None, name):
                continue
            for size in sizes:
                base, *settings = [*domain.split(), *size.split()]
                model = [base, *(word for setting in settings for word in ("--set", setting))]
                command = [word for part in words for word in (model if part == "MODEL" else [part])]
                with tempfile.TemporaryDirectory() as folder:
                    end = run([*command, *limits], folder, options.patience)
                last = end.message.strip().splitlines()[-1:] or [""]
                said = last[0].split("error: ")[-1][:150].replace("|", "/") if end.status else ""
                print(f"| {domain} | {size} | {name} | {end.text()} | {said} |", flush=True)
                if fault := end.fault(int(options.memory * 10**9)):
                    faults.append(f"{' '.join(command)}: {fault}\n{end.message[-2000:]}")
                if end.status != 0:
                    break
    print(f"\n{len(faults)} faults" + "".join(f"\n\n{fault}" for fault in faults))


if __name__ == "__main__":
    main()
