"""The command `study`: grids of runs, each in a process of its own, that survive being stopped."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from factored_polca.cli.output import Output, escape, make_table, seconds
from factored_polca.cli.source import UsageError
from factored_polca.models import ModelError

if TYPE_CHECKING:
    from factored_polca.studies.runner import Progress
    from factored_polca.studies.store import Counts, Store

MESSAGES_SHOWN: Final = 5
STYLES: Final = {"ok": "green", "timeout": "yellow", "memout": "yellow", "error": "red"}


def study(arguments: argparse.Namespace, output: Output) -> int:
    """Do one of the actions."""
    from factored_polca.studies.drawing import MissingLibrary
    from factored_polca.studies.store_lock import StoreLocked
    from factored_polca.studies.warden_client import WorkerLost

    work: dict[str, Callable[..., int]] = {
        "new": new, "run": run, "status": status, "report": report, "export": export
    }  # fmt: skip
    try:
        return work[arguments.which](arguments, output)
    except (StoreLocked, MissingLibrary) as error:
        raise UsageError(str(error)) from None
    except WorkerLost as error:
        output.error(f"{error}; what has been done is kept")
        return 1


def new(arguments: argparse.Namespace, output: Output) -> int:
    """Write a study to start from."""
    from factored_polca.formats.files import destination
    from factored_polca.studies.study_file import template

    path = Path(arguments.file)
    path = path if path.suffix.lower() == ".toml" else path.with_name(f"{path.name}.toml")
    destination(path)
    try:
        with path.open("x", encoding="utf-8") as stream:
            stream.write(template(path.stem, str(path)))
    except FileExistsError:
        raise UsageError(f"{path} is there already; name another file") from None
    if arguments.json:
        output.result({"file": str(path)})
    else:
        output.line(f"{escape(str(path))} written; try: factored-polca study run {escape(str(path))}")
    return 0


def run(arguments: argparse.Namespace, output: Output) -> int:
    """Run what is left of a study."""
    from factored_polca.studies import read_study
    from factored_polca.studies.provenance import memory_bytes
    from factored_polca.studies.store import Store

    asked = read_study(arguments.file, store=arguments.store)
    jobs, most, there = arguments.jobs or asked.jobs, asked.limits.memory_bytes, memory_bytes()
    if asked.cluster is None and most is not None and there is not None and jobs * most > there:
        output.warn(
            f"{jobs} runs at a time may take {jobs * most / 2**30:.3g} GiB together, and the machine has "
            f"{there / 2**30:.3g} GiB: lower memory in the study, or --jobs"
        )
    began, last = time.perf_counter(), 0.0

    def show(progress: Progress) -> None:
        nonlocal last
        if time.monotonic() - last >= 0.2:
            last = time.monotonic()
            output.update(progress_text(asked.name, progress))

    interrupted = False
    with output.progress(f"{asked.name}: {len(asked.runs()):,} runs; loading or compiling kernels"):
        try:
            counts = asked.run(jobs=arguments.jobs, retry=arguments.retry, progress=show)
        except KeyboardInterrupt:
            interrupted, counts = True, asked.counts()
    if interrupted:
        output.note("stopped; the same command goes on from here")
    with Store(asked.store) as store:
        tell(store, counts, arguments, output, {"seconds": time.perf_counter() - began})
    return 130 if interrupted else 0


def progress_text(name: str, progress: Progress) -> str:
    """One line about how far a study is."""
    ended = ", ".join(f"{count:,} {status}" for status, count in progress.by_status.items() if count)
    text = f"{name}: {progress.done:,} of {progress.planned:,} runs ended"
    text += f" ({ended})" if ended else ""
    if progress.seconds_left is not None:
        text += f"; {duration(progress.seconds_left)} left at this pace"
    if progress.going_on:
        text += f"; {len(progress.going_on)} going on, {progress.going_on[0].title()[:60]}"
    return text


def duration(value: float) -> str:
    """A long or short time."""
    if value < 120:
        return seconds(value)
    return f"{value / 60:.0f} min" if value < 7200 else f"{value / 3600:.1f} h"


def opened(text: str) -> Path:
    """The store that FILE means: that of a study's file, or itself.

    Raises:
        ModelError: the study's file is not right.
    """
    from factored_polca.studies import read_study

    path = Path(text)
    if path.suffix.lower() == ".toml":
        return read_study(path).store
    if path.is_dir():
        raise ModelError(f"{text} is a folder; name a study (.toml) or its store")
    return path


def status(arguments: argparse.Namespace, output: Output) -> int:
    """Tell how far a study is."""
    from factored_polca.studies.store import Store

    with Store(opened(arguments.file)) as store:
        tell(store, store.counts(), arguments, output, {})
    return 0


def tell(
    store: Store, counts: Counts, arguments: argparse.Namespace, output: Output, more: dict[str, Any]
) -> None:
    """Print how many runs ended how, for people or as JSON."""
    from factored_polca.studies.store_lock import holder_text, is_locked

    rows = store.rows()
    going_on = holder_text(store.path) if is_locked(store.path) else None
    if arguments.json:
        output.result({
            "name": store.name, "store": str(store.path), "runs": counts.planned, "left": counts.left,
            **counts.by_status, "beyond_the_grid": counts.beyond, "running": going_on, **more,
        })  # fmt: skip
        return
    columns = {
        "work": "left", "model": "left", "runs": "right", "ok": "right", "timeout": "right",
        "memout": "right", "error": "right", "left": "right", "seconds of the ok": "right",
    }  # fmt: skip
    table = make_table(
        f"{store.name}: {counts.planned - counts.left:,} of {counts.planned:,} runs ended", columns
    )
    planned = store.planned()
    by_name: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        by_name.setdefault((row["work"], row["model"]), []).append(row)
    for (work, model), total in planned.items():
        mine = by_name.get((work, model), [])
        often = [sum(row["status"] == name for row in mine) for name in STYLES]
        times = [row["wall_seconds"] for row in mine if row["status"] == "ok"]
        span = "" if not times else f"{min(times):.2g} .. {max(times):.2g}"
        table.add_row(
            escape(work), escape(model), f"{total:,}",
            *(f"[{STYLES[name]}]{n:,}[/]" if n else "-" for name, n in zip(STYLES, often, strict=True)),
            f"{total - len(mine):,}" if total > len(mine) else "-", span,
        )  # fmt: skip
    output.table(table)
    for text, count in messages(rows).items():
        output.line(f"{count:,} x {escape(text)}")
    made_by = {f"{row['version.factored_polca']} {(row['commit'] or '')[:10]}".strip() for row in rows}
    if len(made_by) > 1:
        output.line(f"results are of several versions: {escape(', '.join(sorted(made_by)))}")
    if counts.beyond:
        output.line(f"{counts.beyond:,} further results are of runs that are no longer in the study")
    if going_on is not None:
        output.line(f"it is being run by {escape(going_on)}")
    elif counts.left:
        left = "one run is" if counts.left == 1 else f"{counts.left:,} runs are"
        output.line(f"{left} left; study run goes on")
    output.note(f"results are in {store.path}")


def messages(rows: list[dict[str, Any]]) -> dict[str, int]:
    """The most frequent messages of errors, with how often they occur."""
    found: dict[str, int] = {}
    for row in rows:
        if row["status"] == "error":
            text = f"error: {row['message'].splitlines()[0] if row['message'] else ''}"
            found[text] = found.get(text, 0) + 1
    ordered = sorted(found.items(), key=lambda item: -item[1])
    return dict(ordered[:MESSAGES_SHOWN])


def report(arguments: argparse.Namespace, output: Output) -> int:
    """Write the page and the plots."""
    from factored_polca.studies.report import write_report
    from factored_polca.studies.store import Store

    path = opened(arguments.file)
    folder = Path(arguments.output) if arguments.output else path.with_name(f"{path.stem}-report")
    with Store(path) as store, output.progress(f"drawing {store.name}"):
        page = write_report(store, folder)
    if arguments.json:
        output.result({"page": str(page), "plots": sorted(str(p) for p in folder.glob("*.png"))})
    else:
        output.line(f"{escape(str(page))} written; open it in a browser")
    return 0


def export(arguments: argparse.Namespace, output: Output) -> int:
    """Write the results as CSV or Parquet."""
    from factored_polca.studies.store import Store
    from factored_polca.studies.study_export import export as write

    with Store(opened(arguments.file)) as store:
        rows = store.rows()
    write(rows, arguments.output)
    if arguments.json:
        output.result({"file": arguments.output, "rows": len(rows)})
    else:
        output.line(f"{len(rows):,} results written to {escape(arguments.output)}")
    return 0
