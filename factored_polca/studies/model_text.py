"""The model files of a study: their texts, read once.

Runs get the text, not the file's name: so they need no file system in common, all work on the same text
even where somebody edits the file meanwhile, and the hash of the text stands for it in their keys.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from factored_polca.formats.toml_text import load
from factored_polca.models import Fault, ModelError

MAXIMUM_BYTES: Final = 64 << 20


@dataclass(frozen=True)
class ModelText:
    """The text of a model file, and its hash."""

    name: str
    text: str
    fingerprint: str

    def parameters(self) -> frozenset[str] | None:
        """The parameters that a file of our own format has; None where it doesn't say."""
        if not self.name.lower().endswith(".toml"):
            return frozenset()
        try:
            table = load(self.text.replace("\r\n", "\n")).get("parameters", {})
        except ModelError:
            return None  # the runs will say what is wrong
        return frozenset(table) if isinstance(table, dict) else None


def read_model_text(name: str, folder: Path) -> ModelText:
    """The file that a study calls `name`, from the study's `folder`.

    Raises:
        ModelError: there is none, it is too long, or no UTF-8.
    """
    try:
        with (folder / name).open("rb") as stream:
            data = stream.read(MAXIMUM_BYTES + 1)
        if len(data) > MAXIMUM_BYTES:
            raise ModelError(f"{name} has more than {MAXIMUM_BYTES} bytes, the most that is read")
        text = data.decode("utf-8")
    except FileNotFoundError:
        hint = f"files are looked for in the study's folder, {folder}"
        raise ModelError([Fault(f"there is no file {name}", hint=hint)]) from None
    except UnicodeDecodeError as error:
        raise ModelError([Fault(f"{name} is no UTF-8 at byte {error.start}")]) from None
    except (OSError, ValueError) as error:
        raise ModelError([Fault(f"{name} can't be read: {error}")]) from None
    normal = text.replace("\r\n", "\n")
    return ModelText(name, text, hashlib.sha256(normal.encode()).hexdigest()[:32])


def read_model_texts(names: Iterable[str], folder: Path) -> dict[str, ModelText]:
    """All of several files.

    Raises:
        ModelError: one can't be read.
    """
    return {name: read_model_text(name, folder) for name in names}
