"""A zip of texts, JSON and arrays: written whole or not at all, and read as a stranger's.

Arrays are npy files (`factored_polca.formats.npy`) of the few types in `KINDS`; there is no pickle.  Sizes
are capped before anything is unpacked, and what an array's header says is compared with the bytes that
are there before memory is taken for it.
"""

from __future__ import annotations

import io
import json
import os
import secrets
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from factored_polca.formats.files import destination
from factored_polca.formats.npy import read_npy
from factored_polca.models.errors import ModelError

MAXIMUM_BYTES: Final = 4 << 30
"""Unpacked bytes; larger files are refused."""
MAXIMUM_TEXT: Final = 64 << 20
"""Bytes of a text or of the JSON."""
MAXIMUM_ENTRIES: Final = 1_000

KINDS: Final = {"integers": ("<i2", "<i8"), "numbers": ("<f8",)}
"""What an array may hold -> its types in a file."""

_DAMAGE: Final = (
    zipfile.BadZipFile, OSError, ValueError, KeyError, TypeError, EOFError, RuntimeError, IndexError,
    OverflowError, MemoryError, AttributeError, struct.error, zlib.error,
)  # fmt: skip
"""What reading a damaged zip, JSON or array raises; ValueError stands for what it holds being wrong."""


def write_archive(
    path: str | Path, texts: Mapping[str, str], arrays: Mapping[str, npt.NDArray[Any]]
) -> None:
    """Write a zip of `texts` by their names and `arrays` as NAME.npy.

    Raises:
        ModelError: no such folder, or a device or folder in the file's place.
        OSError: the file can't be written.
    """
    target = destination(path)
    temporary = target.with_name(f".{target.name[:100]}.{secrets.token_hex(4)}.part")
    try:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, text in texts.items():
                archive.writestr(name, text)
            for name, array in arrays.items():
                kind = "<f8" if array.dtype.kind == "f" else "<i2" if array.dtype.itemsize == 2 else "<i8"
                buffer = io.BytesIO()
                np.lib.format.write_array(
                    buffer, np.ascontiguousarray(array, dtype=kind), version=(1, 0), allow_pickle=False
                )
                archive.writestr(f"{name}.npy", buffer.getvalue())
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


class Archive:
    """An archive that is open for reading; its methods raise ValueError or KeyError on damage."""

    def __init__(self, archive: zipfile.ZipFile, prefix: str = "") -> None:
        self._archive, self._prefix = archive, prefix
        entries = archive.infolist()
        if len(entries) > MAXIMUM_ENTRIES or sum(entry.file_size for entry in entries) > MAXIMUM_BYTES:
            raise ValueError("larger than such a file may be")

    def within(self, prefix: str) -> Archive:
        """The same archive, the names of its arrays without `prefix`."""
        return Archive(self._archive, self._prefix + prefix)

    def text(self, name: str) -> str:
        """The text of an entry."""
        if self._archive.getinfo(name).file_size > MAXIMUM_TEXT:
            raise ValueError(f"{name} is longer than a text may be")
        return self._archive.read(name).decode("utf-8")

    def json(self, name: str) -> dict[str, Any]:
        """The object in an entry."""
        data = json.loads(self.text(name), parse_constant=_no_number)
        if not isinstance(data, dict):
            raise ValueError(f"{name} holds no object")
        return data

    def array(self, name: str, kind: str, dimensions: int = 1) -> npt.NDArray[Any]:
        """The array NAME.npy of one of the `KINDS`: int64 or float64, every number finite."""
        data = self._archive.read(f"{self._prefix}{name}.npy")
        found = read_npy(data, name)
        if found.dtype.str not in KINDS[kind] or found.ndim != dimensions:
            raise ValueError(f"{name} is no array of {kind} with {dimensions} dimensions")
        array = found.astype(np.float64 if kind == "numbers" else np.int64)
        if not np.all(np.isfinite(array)):
            raise ValueError(f"{name} has a number that is not finite")
        return array


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number")


def is_archive_with(path: str | Path, name: str) -> bool:
    """Whether `path` is a zip with an entry called `name`."""
    try:
        with zipfile.ZipFile(path) as archive:
            return name in archive.namelist()
    except _DAMAGE:
        return False


@contextmanager
def reading(path: str | Path, what: str, hint: str) -> Iterator[Archive]:
    """The archive at `path`, to be read inside `with`; `what` it is and how to make one, for errors.

    Raises:
        ModelError: no such file, or what is raised inside, which names the file then.
    """
    try:
        if Path(path).exists() and not Path(path).is_file():
            raise ValueError("no regular file")
        with zipfile.ZipFile(path) as archive:
            yield Archive(archive)
    except FileNotFoundError:
        raise ModelError(f"{path}: no such file; {hint}") from None
    except ModelError as error:
        raise error.in_file(str(path)) from None
    except _DAMAGE as error:
        reason = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
        raise ModelError(f"{path}: no {what}, or damaged ({reason or type(error).__name__})") from None
