"""Results of a study as CSV, as Parquet, and as a frame of pandas.

CSV needs nothing: a cell is empty where there is no value, infinities are `inf` and `-inf`.  Parquet and
frames need the extra `frames`.  Whole numbers beyond 64 bits, such as numbers of states, keep their digits
as texts; `log10_states` is there to compute with.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factored_polca.formats.files import write_bytes
from factored_polca.models import Fault, ModelError
from factored_polca.studies.drawing import MissingLibrary

if TYPE_CHECKING:
    import pandas

Row = Mapping[str, Any]


def export(rows: Sequence[Row], path: str | os.PathLike[str]) -> None:
    """Write rows with equal columns as the extension of `path` says, whole or not at all.

    Raises:
        ModelError: another extension, or the file can't be written.
        MissingLibrary: pandas or pyarrow is not installed.
    """
    extension = Path(path).suffix.lower()
    if extension == ".csv":
        write_bytes(Path(path), lambda: csv_text(rows).encode())
    elif extension == ".parquet":
        write_bytes(Path(path), lambda: parquet_bytes(rows))
    else:
        hint = "results are written as .csv or .parquet"
        raise ModelError([Fault(f"the extension {extension!r} is unknown", hint=hint, file=str(path))])


def csv_text(rows: Sequence[Row]) -> str:
    """The rows as CSV, headings first; truth values in small letters."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    if rows:
        writer.writerow(rows[0])
    for row in rows:
        writer.writerow(
            [str(value).lower() if isinstance(value, bool) else value for value in row.values()]
        )
    return text.getvalue()


def make_frame(rows: Sequence[Row]) -> pandas.DataFrame:
    """The rows as a frame of pandas; a column of numbers is one, even where values are missing.

    Raises:
        MissingLibrary: pandas is not installed.
    """
    try:
        import pandas
    except ImportError:
        raise missing("pandas") from None
    names = list(rows[0]) if rows else []
    columns = {name: [numeric(row[name]) for row in rows] for name in names}
    frame = pandas.DataFrame(
        {name: columns[name] if uniform(columns[name]) else texts(columns[name]) for name in names}
    )
    for name in ("started", "finished"):
        if name in frame:
            frame[name] = pandas.to_datetime(frame[name], utc=True, format="ISO8601")
    return frame


def parquet_bytes(rows: Sequence[Row]) -> bytes:
    """The rows as Parquet.

    Raises:
        MissingLibrary: pandas or pyarrow is not installed.
    """
    frame = make_frame(rows)
    data = io.BytesIO()
    try:
        frame.to_parquet(data, index=False, engine="pyarrow")
    except ImportError:
        raise missing("pyarrow") from None
    return data.getvalue()


def missing(name: str) -> MissingLibrary:
    """What is said where a library of the extra is not there."""
    return MissingLibrary(
        f"this needs {name}, which is not installed: pip install 'factored-polca[frames]'"
    )


def numeric(value: Any) -> Any:
    """Digits of a number of states as a number, where 64 bits hold it."""
    if isinstance(value, str) and value.isdecimal() and len(value) < 19:
        return int(value)
    return value


def uniform(values: Sequence[Any]) -> bool:
    """Whether a column's values are of one kind: all numbers, all truth values, or all texts."""
    kinds = {
        bool if isinstance(v, bool) else float if isinstance(v, (int, float)) else str
        for v in values
        if v is not None
    }
    return len(kinds) <= 1


def texts(values: Sequence[Any]) -> list[str | None]:
    """A column of mixed values as texts."""
    return [None if value is None else str(value) for value in values]
