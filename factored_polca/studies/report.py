"""A study's report: one page that needs nothing else, and its plots as PNG beside it.

The page has its style and its pictures inside (SVG for light and for dark surroundings), runs no program,
and loads nothing.  All names and messages are escaped.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from statistics import median
from typing import Any, Final

from factored_polca.formats.files import write_bytes, write_text
from factored_polca.models import Fault, ModelError
from factored_polca.studies.drawing import require_matplotlib
from factored_polca.studies.report_axes import DARK, LIGHT
from factored_polca.studies.report_plots import Plot, growth_texts, plots, render
from factored_polca.studies.report_series import Comparison, Row, brief, compare, seconds_of
from factored_polca.studies.store import STATUSES, Store

MOST_ROWS: Final = 500
"""Rows of the table of single runs."""
MOST_MESSAGES: Final = 30
MOST_LAUNCHES: Final = 50
MOST_OPEN: Final = 24
"""Rows of a table that is not folded away."""

STYLE: Final = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem;
  background: light-dark(#ffffff, #16181c); color: light-dark(#1c1c1c, #e6e6e6); }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin-top: 2.2rem; }
p.note { color: light-dark(#555, #aaa); margin-top: -.4rem; }
div.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; }
th, td { padding: .2rem .7rem .2rem 0; text-align: right; white-space: nowrap; vertical-align: top; }
th { border-bottom: 1px solid light-dark(#999, #777); font-weight: 600; }
tr + tr td { border-top: 1px solid light-dark(#e8e8e8, #2b2e34); }
td.text, th.text { text-align: left; white-space: normal; overflow-wrap: anywhere; min-width: 3.5rem; }
img { max-width: 100%; height: auto; }
pre { overflow-x: auto; font-size: 12px; line-height: 1.35; }
.ok { color: light-dark(#00734f, #2bbf93); } .timeout { color: light-dark(#8a5f00, #f0b429); }
.memout { color: light-dark(#a13f78, #dd8fbb); } .error { color: light-dark(#b34700, #f07a3a); }
"""


def write_report(store: Store, folder: str | os.PathLike[str]) -> Path:
    """Write `index.html` and the plots into a folder, which is made; answer the page's path.

    Raises:
        ModelError: the folder can't be made or written to.
        MissingLibrary: matplotlib is not installed.
    """
    require_matplotlib()
    comparison, target = compare(store), Path(folder)
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ModelError([Fault(f"the folder can't be made: {error.strerror}", file=str(target))]) from None
    drawn = list(plots(comparison))
    for plot in drawn:
        picture = render(plot, LIGHT, "png")
        write_bytes(target / f"{plot.name}.png", lambda data=picture: data)  # type: ignore[misc]
    page = page_text(store, comparison, drawn)
    write_text(target / "index.html", lambda: page)
    return target / "index.html"


def page_text(store: Store, comparison: Comparison, drawn: Sequence[Plot]) -> str:
    """The page."""
    name = escape(comparison.name)
    parts = [
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">',
        '<meta http-equiv="Content-Security-Policy" content="default-src \'none\'; '
        "img-src data:; style-src 'unsafe-inline'\">",
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{name}</title><style>{STYLE}</style></head><body>",
        f"<h1>{name}</h1>",
        f"<p>{summary(store)}</p>",
        "<h2>Contenders</h2>",
        contenders_table(comparison),
    ]
    for plot in drawn:
        parts += [
            f"<h2>{escape(plot.heading)}</h2>",
            f'<p class="note">{escape(plot.text)}</p>',
            picture(plot),
        ]
    parts += [
        growth_section(comparison),
        messages_section(comparison),
        runs_section(comparison),
        provenance_section(store),
        "</body></html>\n",
    ]
    return "\n".join(part for part in parts if part)


def picture(plot: Plot) -> str:
    """A plot for both kinds of surroundings."""
    light, dark = (
        "data:image/svg+xml;base64," + base64.b64encode(render(plot, theme, "svg")).decode()
        for theme in (LIGHT, DARK)
    )
    return (
        f'<picture><source media="(prefers-color-scheme: dark)" srcset="{dark}">'
        f'<img src="{light}" alt="{escape(plot.heading)}: {escape(plot.text)}"></picture>'
    )


def summary(store: Store) -> str:
    """How far the study is, in a sentence or two."""
    counts = store.counts()
    told = [
        f'<span class="{s}">{counts.by_status[s]:,} {s}</span>' for s in STATUSES if counts.by_status[s]
    ]
    text = f"{counts.planned - counts.left:,} of {counts.planned:,} runs ended"
    text += f": {', '.join(told)}." if told else "."
    launches = store.launches()
    if launches:
        limits = launches[-1]["limits"]
        seconds, memory = limits["seconds"], limits["memory_bytes"]
        said = [f"{seconds:g} s"] if seconds is not None else []
        said += [f"{memory / 2**20:,.0f} MiB"] if memory is not None else []
        text += f" Limits of each run: {escape(', '.join(said) or 'none')}."
    return text


def contenders_table(comparison: Comparison) -> str:
    """One row for each contender and model."""
    headings = ["contender", "model", "runs", *STATUSES, "left", "median s", "most s", "most MiB"]
    rows, by_name = [], dict[tuple[str, str], list[Row]]()
    for row in comparison.rows:
        by_name.setdefault((row["contender"], row["model"]), []).append(row)
    for (contender, model), counts in comparison.coverage().items():
        mine = by_name.get((contender, model), [])
        well = [seconds_of(row) for row in mine if row["status"] == "ok"]
        memory = [row["peak_memory_bytes"] for row in mine]
        rows.append([
            brief(contender, 60), brief(model, 60), f"{sum(counts.values()):,}",
            *(f"{counts[s]:,}" if counts[s] else "" for s in (*STATUSES, "left")),
            f"{median(well):.3g}" if well else "", f"{max(well):.3g}" if well else "",
            f"{max(memory) / 2**20:,.0f}" if memory else "",
        ])  # fmt: skip
    note = (
        "Seconds are those of the work itself by the clock, of runs that ended well; reading the model, "
        "starting the process and compiling kernels are not in them. Memory is the resident set of all "
        "processes of a run."
    )
    body = table(headings, rows)
    if len(rows) > MOST_OPEN:
        body = f"<details><summary>{len(rows):,} rows</summary>{body}</details>"
    return body + f"<p>{note}</p>"


def growth_section(comparison: Comparison) -> str:
    """The fitted curves as a table."""
    rows = []
    for one in comparison.series():
        for quantity in ("seconds", "blocks"):
            found = one.growth(quantity)
            if found is None:
                continue
            power, exponential, better = growth_texts(found)
            sizes = [x for x, _ in found.points]
            rows.append([
                brief(one.model, 60), brief(one.contender, 60), brief(one.others, 60), brief(one.parameter),
                quantity,
                f"{len(sizes)}", f"{sizes[0]:,g} .. {sizes[-1]:,g}", power, exponential, better,
            ])  # fmt: skip
    if not rows:
        return ""
    headings = [
        "model", "contender", "others", "n is", "of", "sizes", "from .. to", "power", "exponential",
        "fits better",
    ]  # fmt: skip
    note = (
        "Least squares on logarithms of the medians over seeds, for runs that ended well; sizes whose runs "
        "were all stopped are missing, which makes growth look slower. ± and brackets: 95 % intervals of "
        "the exponent and of the factor, by Student's distribution."
    )
    return f"<h2>Fitted growth</h2>{table(headings, rows)}<p>{note}</p>"


def messages_section(comparison: Comparison) -> str:
    """What runs that did not end well said, most frequent first, with what one of each printed."""
    found: dict[tuple[str, str, str], list[Row]] = {}
    for row in comparison.rows:
        if row["status"] != "ok":
            found.setdefault((row["status"], row["stage"], row["message"][:300]), []).append(row)
    if not found:
        return ""
    ordered = sorted(found.items(), key=lambda item: -len(item[1]))[:MOST_MESSAGES]
    cells = [[status, f"{len(rows):,}", brief(stage, 60), said] for (status, stage, said), rows in ordered]
    body = table(["status", "runs", "stage reached", "message"], cells)
    for (status, _, _), rows in ordered:
        if rows[0]["detail"]:
            name = f"{status}: {brief(rows[0]['instance'], 100)}"
            printed = f"<pre>{escape(rows[0]['detail'])}</pre>"
            body += f"<details><summary>{escape(name)}</summary>{printed}</details>"
    return f"<h2>What went wrong</h2>{body}"


def runs_section(comparison: Comparison) -> str:
    """The single runs, folded away."""
    rows = []
    for row in comparison.rows[:MOST_ROWS]:
        settings = ", ".join(
            f"{name[4:]}={value}"
            for name, value in row.items()
            if name.startswith("set.") and value is not None
        )
        bounds = [row.get(name) for name in ("lower", "upper")]
        rows.append([
            brief(row["contender"], 60), brief(row["model"], 60), brief(settings, 80), f"{row['seed']}",
            row["status"], number(row.get("states"), row.get("log10_states")), number(row.get("blocks")),
            number(row.get("value")), " .. ".join(map(number, bounds)) if None not in bounds else "",
            f"{seconds_of(row):.3g}", f"{row['cpu_seconds']:.3g}",
            f"{row['peak_memory_bytes'] / 2**20:,.0f}",
        ])  # fmt: skip
    headings = [
        "contender", "model", "parameters", "seed", "status", "states", "blocks", "value", "bounds", "s",
        "CPU s", "MiB",
    ]  # fmt: skip
    more = len(comparison.rows) - len(rows)
    note = f"<p>{more:,} more: study export writes them all.</p>" if more > 0 else ""
    body = table(headings, rows) + note
    return f"<h2>Runs</h2><details><summary>{len(rows):,} results</summary>{body}</details>"


def number(value: Any, magnitude: Any = None) -> str:
    """A figure in few digits."""
    if isinstance(value, str) and len(value) > 15:
        value = None if magnitude is None else f"10^{magnitude:.1f}"
    if value is None:
        return "" if magnitude is None else f"10^{magnitude:.1f}"
    if isinstance(value, float):
        return f"{value:.6g}"
    return f"{int(value):,}" if isinstance(value, int) or str(value).isdecimal() else brief(str(value))


def provenance_section(store: Store) -> str:
    """Who ran what, when, where, with what."""
    launches, supervisors = store.launches(), store.supervisors()
    rows = [
        [
            one["date"], one["machine"]["host"], (one["commit"] or "")[:12], f"{one['results']:,}",
            brief(" ".join(one["arguments"]), 100),
        ]
        for one in launches[-MOST_LAUNCHES:]
    ]  # fmt: skip
    parts = ["<h2>Provenance</h2>", table(["date", "host", "commit", "results", "arguments"], rows)]
    for one in distinct(supervisors):
        versions = ", ".join(f"{name} {value}" for name, value in one["versions"].items())
        machine = one["machine"]
        parts.append(
            f"<p>{escape(machine['host'])}: {escape(machine['processor'])}, {machine['cores']} cores, "
            f"{(machine['memory_bytes'] or 0) / 2**30:.0f} GiB, {escape(machine['system'])}. "
            f"{escape(versions)}.</p>"
        )
    warm = [f"{sum(one['warm_seconds'].values()):.1f}" for one in supervisors]
    if warm:
        parts.append(f"<p>Kernels loaded or compiled ahead of the runs in {', '.join(warm[:20])} s.</p>")
    return "".join(parts)


def distinct(supervisors: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Supervisors that differ in machine or versions."""
    found = {repr((one["versions"], one["machine"])): one for one in supervisors}
    return list(found.values())


WORDS: Final = frozenset({
    "contender", "model", "others", "n is", "of", "fits better", "status", "stage reached", "message",
    "parameters", "date", "host", "commit", "arguments",
})  # fmt: skip
"""Headings of columns that hold words, which stand on the left."""


def table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table; columns that are empty throughout are left out."""
    kept = [k for k in range(len(headings)) if any(row[k] for row in rows)]

    def cell(tag: str, place: int, content: str) -> str:
        kind = ' class="text"' if headings[place] in WORDS else ""
        shown = escape(content)
        if content in STATUSES and tag == "td":
            shown = f'<span class="{content}">{shown}</span>'
        return f"<{tag}{kind}>{shown}</{tag}>"

    head = "".join(cell("th", k, headings[k]) for k in kept)
    body = "".join(f"<tr>{''.join(cell('td', k, row[k]) for k in kept)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'
