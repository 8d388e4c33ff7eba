"""Faults of a model and the error that carries them.

A check reports *all* faults at once.  Each fault says what is wrong, by which rule, and what would
be right; where the model came from a file it also says in which file, line and column.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that is wrong with a model.

    `path` names the place inside the model, for example `("actions", "North", "effects", "x")`.
    `line` and `column` count from 1; 0 means unknown.
    """

    message: str
    path: tuple[str, ...] = ()
    hint: str = ""
    file: str = ""
    line: int = 0
    column: int = 0
    severity: str = "error"

    def __str__(self) -> str:
        place = self.file
        if self.line:
            place += f":{self.line}:{self.column}" if place else f"line {self.line}, column {self.column}"
        where = " -> ".join(shown(part, 100) for part in self.path)
        text = ": ".join(part for part in (shown(place), where, shown(self.message)) if part)
        return f"{text} ({shown(self.hint)})" if self.hint else text


def shown(text: str, most: int = 1000) -> str:
    """`text` on one line of a terminal: shortened, characters that can't be shown escaped (as in \\x1b)."""
    if len(text) > most:
        text = f"{text[: most - 20]}..."
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


class ModelError(ValueError):
    """A model, or the text of one, is not right; `faults` lists everything that was found."""

    def __init__(self, faults: Iterable[Fault] | str) -> None:
        self.faults: tuple[Fault, ...] = (Fault(faults),) if isinstance(faults, str) else tuple(faults)
        super().__init__("\n".join(str(fault) for fault in self.faults))

    def in_file(self, file: str) -> ModelError:
        """The same error with `file` named in every fault that names none."""
        return ModelError(fault if fault.file else replace(fault, file=file) for fault in self.faults)


class LimitReached(RuntimeError):
    """A limit on blocks, time, memory or states stopped the work; `stage` names where.

    What was reached so far is in `partial` where there is something to keep.
    """

    def __init__(self, message: str, stage: str = "", partial: object = None) -> None:
        super().__init__(message)
        self.stage = stage
        self.partial = partial
