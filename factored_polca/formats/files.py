"""Model files: which format a file has, reading it, and writing it so that no half-written file stays.

The extension decides, in any case of letters.  `FORMATS` is the table; a format that can't hold
all of a document refuses it and says why.
"""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from factored_polca.formats.document import Document
from factored_polca.formats.native import read_native, write_native
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.model import Model
from factored_polca.models.tasks import TaskHierarchy

MAXIMUM_BYTES: Final = 64 * 2**20
"""Larger files are refused."""


@dataclass(frozen=True, slots=True)
class Format:
    """A file format: `read(text, overrides, name)` gives a document, `write(document)` a text."""

    name: str
    read: Callable[[str, Mapping[str, str], str], Document]
    write: Callable[[Document], str]


def _read_native(text: str, overrides: Mapping[str, str], name: str) -> Document:
    return read_native(text, overrides, name=name)


def _write_native(document: Document) -> str:
    return write_native(document.model, document.tasks)


def _read_spudd(text: str, overrides: Mapping[str, str], name: str) -> Document:
    if overrides:
        listed = ", ".join(overrides)
        raise ModelError(f"SPUDD's format has no parameters to set ({listed}): edit the file")
    from factored_polca.formats.spudd import read_spudd_with_warnings

    model, warnings = read_spudd_with_warnings(text, name)
    return Document(model, None, tuple(warnings))


def _write_spudd(document: Document) -> str:
    _refuse_tasks(document, "SPUDD's format")
    from factored_polca.formats.spudd import write_spudd

    return write_spudd(document.model)


def _refuse_tasks(document: Document, name: str) -> None:
    if document.tasks is not None:
        hint = "write a .toml file, or leave the tasks out (--no-tasks)"
        raise ModelError([Fault(f"{name} can't hold tasks", hint=hint)])


def _read_pomdpx(text: str, overrides: Mapping[str, str], name: str) -> Document:
    if overrides:
        listed = ", ".join(overrides)
        raise ModelError(f"POMDPX has no parameters to set ({listed}): edit the file")
    from factored_polca.formats.pomdpx import read_pomdpx_with_warnings

    model, warnings = read_pomdpx_with_warnings(text, name)
    return Document(model, None, warnings)


def _write_pomdpx(document: Document) -> str:
    _refuse_tasks(document, "POMDPX")
    from factored_polca.formats.pomdpx import write_pomdpx

    return write_pomdpx(document.model)


def _read_cassandra(text: str, overrides: Mapping[str, str], name: str) -> Document:
    if overrides:
        listed = ", ".join(overrides)
        raise ModelError(f"Cassandra's format has no parameters to set ({listed}): edit the file")
    from factored_polca.formats.cassandra import read_pomdp_with_warnings

    model, warnings = read_pomdp_with_warnings(text, name)
    return Document(model, None, warnings)


def _write_cassandra(document: Document) -> str:
    _refuse_tasks(document, "Cassandra's format")
    from factored_polca.formats.cassandra import write_model

    return write_model(document.model)


def _read_prism(text: str, overrides: Mapping[str, str], name: str) -> Document:
    from factored_polca.formats.prism import read_prism

    model, warnings, locate = read_prism(text, overrides, name)
    return Document(model, None, warnings, locate)


def _write_prism(document: Document) -> str:
    _refuse_tasks(document, "PRISM's language")
    from factored_polca.formats.prism_writer import write_prism

    return write_prism(document.model)


def _read_rddl(text: str, overrides: Mapping[str, str], name: str) -> Document:
    return _read_rddl_texts((text,), overrides, ("",))


def _read_rddl_texts(texts: Sequence[str], overrides: Mapping[str, str], files: Sequence[str]) -> Document:
    if overrides:
        listed = ", ".join(overrides)
        raise ModelError(f"RDDL has no parameters to set ({listed}): edit the non-fluents")
    from factored_polca.formats.rddl import read_rddl_with_warnings

    model, warnings, locate = read_rddl_with_warnings(texts, files)
    return Document(model, None, warnings, locate)


def _write_rddl(document: Document) -> str:
    raise ModelError([Fault("RDDL is read, not written", hint="write a .toml, .spudd or .pomdpx file")])


_NATIVE: Final = Format("native", _read_native, _write_native)
_SPUDD: Final = Format("SPUDD", _read_spudd, _write_spudd)
_POMDPX: Final = Format("POMDPX", _read_pomdpx, _write_pomdpx)
_CASSANDRA: Final = Format("Cassandra", _read_cassandra, _write_cassandra)
_PRISM: Final = Format("PRISM", _read_prism, _write_prism)
_RDDL: Final = Format("RDDL", _read_rddl, _write_rddl)

FORMATS: Final[Mapping[str, Format]] = {
    ".toml": _NATIVE,
    ".dat": _SPUDD,
    ".spudd": _SPUDD,
    ".pomdpx": _POMDPX,
    ".pomdp": _CASSANDRA,
    ".mdp": _CASSANDRA,
    ".prism": _PRISM,
    ".nm": _PRISM,
    ".pm": _PRISM,
    ".rddl": _RDDL,
}


def format_of(path: str | Path) -> Format:
    """The format that the extension of `path` stands for.

    Raises:
        ModelError: none; the message lists those there are.
    """
    extension = Path(path).suffix
    if extension.lower() in FORMATS:
        return FORMATS[extension.lower()]
    listed = ", ".join(f"{key} ({value.name})" for key, value in FORMATS.items())
    found = f"the extension {extension!r} is" if extension else "a file without an extension has"
    raise ModelError(
        [Fault(f"{found} no known format", hint=f"known extensions are {listed}", file=str(path))]
    )


def read(path: str | Path, overrides: Mapping[str, str] | None = None) -> Document:
    """The model in the file `path`, with its tasks if it has any.

    `overrides` gives parameters of the model other values, as texts such as "1/3".

    Raises:
        ModelError: no such file, no known format, or a text at fault; names file, line and column.
    """
    chosen, both = format_of(path), parts(path)
    if chosen is _RDDL:
        try:
            texts = [_decoded(_bytes(part, named=True), strict=False) for part in both]
            document = _read_rddl_texts(texts, overrides or {}, [str(part) for part in both])
        except ModelError as error:
            raise error.in_file(str(path)) from None
        return _located(document, path)
    try:
        data = _bytes(Path(path))
    except ModelError as error:
        raise error.in_file(str(path)) from None
    return document_of(data, path, overrides)


def document_of(data: bytes, path: str | Path, overrides: Mapping[str, str] | None = None) -> Document:
    """The model in `data`, the bytes of a file called `path`: its extension tells the format.

    Raises:
        ModelError: no known format, or a text at fault; names file, line and column.
    """
    chosen = format_of(path)
    try:
        document = chosen.read(_decoded(data), overrides or {}, Path(path).stem)
    except ModelError as error:
        raise error.in_file(str(path)) from None
    return _located(document, path)


def _located(document: Document, path: str | Path) -> Document:
    """The document, its warnings and later faults told with the file's name."""

    def locate(faults: Iterable[Fault]) -> tuple[Fault, ...]:
        return ModelError(document.locate(faults)).in_file(str(path)).faults

    warnings = ModelError(document.warnings).in_file(str(path)).faults
    return replace(document, warnings=warnings, locate=locate)


def parts(path: str | Path) -> tuple[Path, ...]:
    """The files that a path names: two for `DOMAIN.rddl+INSTANCE.rddl`, unless there is such a file."""
    text = str(path)
    if text.lower().endswith(".rddl") and not Path(path).is_file():
        cuts = [match.end() for match in re.finditer(r"\.rddl(?=\+.)", text, re.IGNORECASE)]
        for cut in cuts:
            if Path(text[:cut]).is_file() or len(cuts) == 1:
                return Path(text[:cut]), Path(text[cut + 1 :])
    return (Path(path),)


def _bytes(path: Path, *, named: bool = False) -> bytes:
    """What a file holds; `named`: its own name is told where it is missing."""
    try:
        with path.open("rb") as stream:
            data = stream.read(MAXIMUM_BYTES + 1)
    except FileNotFoundError:
        listed = ", ".join(FORMATS)
        fault = Fault(
            "there is no such file", hint=f"formats are {listed}", file=str(path) if named else ""
        )
        raise ModelError([fault]) from None
    except (OSError, ValueError) as error:
        raise ModelError(f"the file can't be read: {_reason(error)}") from None
    return data


def _decoded(data: bytes, *, strict: bool = True) -> str:
    """The text; without `strict`, bytes that are no UTF-8 become one sign, not a fault."""
    if len(data) > MAXIMUM_BYTES:
        message = f"the file has more than {MAXIMUM_BYTES} bytes, the most that is read"
        raise ModelError([Fault(message, line=1, column=1)])
    try:
        return data.decode("utf-8", "strict" if strict else "replace")
    except UnicodeDecodeError as error:
        before = data[: error.start]
        line = before.count(b"\n") + 1
        column = len(before[before.rfind(b"\n") + 1 :].decode("utf-8", "replace")) + 1
        message = f"the byte {data[error.start]:#04x} is no UTF-8"
        hint = "save the file in the encoding UTF-8"
        raise ModelError([Fault(message, hint=hint, line=line, column=column)]) from None


def _reason(error: Exception) -> str:
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


def write(document: Document | Model, path: str | Path, tasks: TaskHierarchy | None = None) -> None:
    """Writes a model, and its tasks if there are any, in the format of the extension of `path`.

    The file appears whole or not at all; one that is already there stays as it is until then.

    Raises:
        ModelError: no known format, something the format can't express, or a folder that can't be
            written to.
    """
    if isinstance(document, Model):
        document = Document(document, tasks)
    elif tasks is not None:
        document = Document(document.model, tasks, document.warnings)
    whole, chosen = document, format_of(path)
    write_text(path, lambda: chosen.write(whole))


def write_text(path: str | Path, make: Callable[[], str]) -> None:
    """Writes the text that `make` gives; faults of it are told with the file's name.

    Raises:
        ModelError: `make` raises it, or a folder that can't be written to.
    """
    write_bytes(path, lambda: make().encode("utf-8"))


def write_bytes(path: str | Path, make: Callable[[], bytes]) -> None:
    """Writes the bytes that `make` gives; the file appears whole or not at all.

    Raises:
        ModelError: `make` raises it, or a folder that can't be written to.
    """
    try:
        data = make()
        _replace(destination(path), data)
    except ModelError as error:
        raise error.in_file(str(path)) from None
    except OSError as error:
        raise ModelError([Fault(f"can't be written: {_reason(error)}", file=str(path))]) from None


def destination(path: str | Path) -> Path:
    """The file that is written when `path` is named: links are followed, devices and pipes refused.

    Raises:
        ModelError: no such folder, or something that is no regular file stands there.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise ModelError([Fault("is a folder", hint="name a file in it", file=str(path))])
    if target.exists() and not target.is_file():
        hint = "only regular files are replaced"
        raise ModelError([Fault("is a device, a pipe or a socket", hint=hint, file=str(path))])
    if not target.parent.is_dir():
        raise ModelError(
            [Fault(f"there is no folder {target.parent}", hint="make it first", file=str(path))]
        )
    return target


def _replace(path: Path, data: bytes) -> None:
    """Puts `data` where `path` is, by way of a new file in the same folder."""
    temporary = path.with_name(f".{path.name[:100]}.{secrets.token_hex(8)}.part")
    try:
        with temporary.open("xb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        if path.exists():
            temporary.chmod(path.stat().st_mode & 0o777)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
