"""What a reader may do with an input: accept it, or refuse it with faults that can be found and shown."""

from __future__ import annotations

import traceback
import unicodedata
from dataclasses import dataclass
from typing import Any, Final, Literal

from factored_polca.formats import Document, read_native, write_native
from factored_polca.models import Model, ModelError, TaskHierarchy, check, check_tasks
from factored_polca.models.model import replace_fields

from .readers import Reader
from .work import WorkExceeded, counted

Outcome = Literal["accepted", "refused", "limit"]

LONGEST_FAULT: Final = 4_000
"""Characters of the text of one fault."""
MOST_FAULTS: Final = 1_001


@dataclass(frozen=True)
class Finding:
    """A rule that a reader broke; findings with the same `sign` are taken to have one cause."""

    sign: str
    detail: str


def judged(reader: Reader, data: bytes, *, closely: bool = False) -> Outcome | Finding:
    """What `reader` does with `data`.

    `closely` also counts the calls of the interpreter, checks an accepted model, and writes and reads it
    again.
    """
    try:
        with counted(len(data), calls=closely):
            found = reader.read(data, reader.file)
    except ModelError as error:
        return _refusal(reader, data, error) or "refused"
    except WorkExceeded as error:
        return Finding(f"work: {error.what}", str(error))
    except reader.limits:
        return "limit"
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        frames = traceback.extract_tb(error.__traceback__)
        where = next((f for f in reversed(frames) if "factored_polca" in f.filename), frames[-1])
        place = f"{where.filename.rpartition('factored_polca/')[2]}:{where.name}"
        return Finding(f"{type(error).__name__} in {place}", traceback.format_exc())
    return _acceptance(found, closely) or "accepted"


def _refusal(reader: Reader, data: bytes, error: ModelError) -> Finding | None:
    shown = str(error)
    if not error.faults or not shown.strip():
        return Finding("an empty error", repr(error))
    if len(error.faults) > MOST_FAULTS:
        return Finding("too many faults", str(len(error.faults)))
    if bad := unprintable(shown):
        return Finding(f"U+{ord(bad):04X} in an error", shown)
    text = data.decode("utf-8", "replace").replace("\r\n", "\n")
    plain = text.split("\n")
    lines = (text.replace("\r", "\n") if reader.file.endswith(".pomdpx") else text).split("\n")
    for fault in error.faults:
        if len(str(fault)) > LONGEST_FAULT:
            return Finding(f"a long error: {fault.message[:30]!r}", str(fault))
        if fault.file != reader.file and not str(fault).startswith(reader.file):
            return Finding(f"no file: {fault.message[:40]!r}", str(fault))
        if not reader.text:
            continue
        if fault.line < 1 or fault.column < 1:
            return Finding(f"no place: {_words(fault.message)}", str(fault))
        seen = plain if "is no UTF-8" in fault.message else lines  # bytes are counted before XML is read
        if fault.line > len(seen) or fault.column > len(seen[fault.line - 1]) + 1:
            return Finding(f"a place outside the text: {_words(fault.message)}", str(fault))
    return None


def _words(message: str) -> str:
    """A message without what comes from the file."""
    return " ".join(word for word in message.split() if word.isalpha())[:60]


def unprintable(text: str) -> str:
    """The first character that would move a terminal's cursor or turn the text round; "" if none."""
    if text.isprintable():
        return ""
    for character in text:
        if character != "\n" and unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp"):
            return character
    return ""


def _acceptance(found: Any, closely: bool) -> Finding | None:
    if isinstance(found, Document):
        for name in names_of(found):
            if bad := unprintable(name) or ("\n" if "\n" in name else ""):
                return Finding(f"U+{ord(bad):04X} in an accepted name", repr(name))
        if closely:
            return _again(found)
    return None


def names_of(document: Document) -> list[str]:
    """The names that a document shows."""
    model = document.model
    named: list[Any] = [*model.features, *model.observations]
    found = [model.name, *(x.name for x in named), *(a.name for a in model.actions)]
    found += [value for x in named for value in x.values[:100] if isinstance(value, str)]
    found += [name for name, _ in model.parameters]
    tasks = document.tasks or TaskHierarchy(())
    return [*found, *(task.name for task in tasks.tasks), *(w.message for w in document.warnings)]


def _again(document: Document) -> Finding | None:
    """An accepted model is sound, and the same after it was written and read."""
    model: Model = document.model
    if model.discount == 1 and model.horizon is None:  # what is read may be given a horizon later
        model = replace_fields(model, horizon=1)
    faults = check(model) + (check_tasks(model, document.tasks) if document.tasks else [])
    if faults:
        return Finding(f"accepted, though {_words(faults[0].message)}", str(faults[0]))
    try:
        back = read_native(write_native(model, document.tasks))
    except ModelError as error:
        return Finding(f"not read again: {_words(error.faults[0].message)}", str(error))
    if back.model != model or back.tasks != document.tasks:
        return Finding("another model when read again", "")
    return None
