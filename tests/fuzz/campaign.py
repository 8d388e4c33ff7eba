"""Many inputs, in blocks, with a state that is kept in a file: where to go on, what was found."""

from __future__ import annotations

import json
import os
import secrets
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any, Final

from .choices import Choices
from .readers import READERS, Reader, prepared
from .verdict import Finding, judged
from .work import watched

BLOCK: Final = 1_000
"""Inputs between two writings of the state."""
CHOICES: Final = 220
"""Bytes that decide an input."""
CLOSELY: Final = 50
"""One input in so many is judged closely."""
SECONDS: Final = 60
"""Processor seconds for one input, after which it is a finding: a guard, not a test of speed."""
KEPT: Final = 3
"""Inputs that are kept for one kind of finding."""


class Slow(BaseException):
    """An input takes too long."""


@dataclass(frozen=True)
class Campaign:
    """A state file and what it holds."""

    path: Path
    state: dict[str, Any]

    @staticmethod
    def opened(path: Path, seed: int) -> Campaign:
        """The campaign of a state file, begun if there is none."""
        if path.exists():
            state = json.loads(path.read_text(encoding="utf-8"))
            if state["seed"] != seed:
                raise SystemExit(f"{path} was begun with --seed {state['seed']}")
        else:
            state = {"version": 1, "seed": seed, "readers": {}}
        return Campaign(path, state)

    def of(self, name: str) -> dict[str, Any]:
        """The part of one reader."""
        empty = {"inputs": 0, "accepted": 0, "refused": 0, "limit": 0, "seconds": 0.0, "findings": {}}
        part: dict[str, Any] = self.state["readers"].setdefault(name, empty)
        return part

    def save(self) -> None:
        """Write the state, whole or not at all."""
        temporary = self.path.with_name(f".{self.path.name}.{secrets.token_hex(4)}.part")
        temporary.write_text(json.dumps(self.state, indent=1), encoding="utf-8")
        os.replace(temporary, self.path)

    def block(self, name: str) -> None:
        """Read the next `BLOCK` inputs of a reader, then write the state."""
        reader, part = READERS[name], self.of(name)
        began = time.process_time()
        found: dict[str, int] = {"accepted": 0, "refused": 0, "limit": 0}
        findings: list[tuple[int, Finding, bytes]] = []
        for index in range(part["inputs"], part["inputs"] + BLOCK):
            data = input_of(self.state["seed"], name, index)
            with guarded():
                outcome = verdict(reader, data, index)
            if isinstance(outcome, Finding):
                findings.append((index, outcome, data))
            else:
                found[outcome] += 1
        for index, finding, data in findings:
            self._keep(name, part, index, finding, data)
        for key, count in found.items():
            part[key] += count
        part["inputs"] += BLOCK
        part["seconds"] = round(part["seconds"] + time.process_time() - began, 3)
        self.save()

    def _keep(self, name: str, part: dict[str, Any], index: int, finding: Finding, data: bytes) -> None:
        """Note a finding; the first few inputs of its kind are kept as files beside the state."""
        known = part["findings"].setdefault(finding.sign, {"count": 0, "inputs": []})
        known["count"] += 1
        if len(known["inputs"]) < KEPT:
            folder = self.path.with_suffix(".findings")
            folder.mkdir(exist_ok=True)
            (folder / f"{name}-{index}").write_bytes(data)
            (folder / f"{name}-{index}.txt").write_text(
                f"{finding.sign}\n\n{finding.detail}\n", encoding="utf-8"
            )
            known["inputs"].append(index)


def input_of(seed: int, name: str, index: int) -> bytes:
    """Input number `index` of a reader."""
    return READERS[name].make(Choices(Random(f"{seed} {name} {index}").randbytes(CHOICES)))


def verdict(reader: Reader, data: bytes, index: int) -> str | Finding:
    """What the reader does; slowness is a finding."""
    try:
        return judged(reader, data, closely=index % CLOSELY == 0)
    except Slow:
        return Finding("slow", f"more than {SECONDS} processor seconds")


@contextmanager
def guarded() -> Iterator[None]:
    """End a block that takes more than `SECONDS` of the processor's time."""

    def stop(*_: object) -> None:
        raise Slow

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def run(campaign: Campaign, names: list[str], inputs: int, say: Callable[[str], None]) -> None:
    """Blocks of the readers in turns, until each has read `inputs`."""
    with watched(), prepared():
        _run(campaign, names, inputs, say)


def _run(campaign: Campaign, names: list[str], inputs: int, say: Callable[[str], None]) -> None:
    while waiting := [name for name in names if campaign.of(name)["inputs"] < inputs]:
        for name in waiting:
            campaign.block(name)
        say(summary(campaign, names))


def summary(campaign: Campaign, names: list[str]) -> str:
    """One line a reader."""
    lines = ["reader        inputs   accepted    refused    limit  findings  kinds  inputs/s"]
    for name in names:
        part = campaign.of(name)
        count = sum(finding["count"] for finding in part["findings"].values())
        rate = part["inputs"] / part["seconds"] if part["seconds"] else 0.0
        lines.append(
            f"{name:11s} {part['inputs']:8,d} {part['accepted']:10,d} {part['refused']:10,d} "
            f"{part['limit']:8,d} {count:9,d} {len(part['findings']):6d} {rate:9,.0f}"
        )
    return "\n".join(lines)
