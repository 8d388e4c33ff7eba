"""An episode, step by step: what changed, what was believed, what was asked and done, what came of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from factored_polca.display.tables import heading, line, table, view
from factored_polca.display.words import listed, number_text, percent, plural, short, value_text
from factored_polca.explicit.arrays import FloatArray
from factored_polca.models import Model, Value
from factored_polca.simulation.trace import Trace

SHOWN_STEPS: Final = 60
SHOWN_VALUES: Final = 3
LONGEST: Final = 160

SURE: Final = 0.995
"""A value that is likelier is called certain."""


def html(trace: Trace) -> str:
    """A row for each step, and the state after the last."""
    partial = any(step.beliefs for step in trace.steps)
    columns = ["step", "state", *(["belief"] if partial else []), "asked", "action"]
    columns += [*(["observed"] if partial else []), "reward"]
    rows: list[list[object]] = []
    before: Mapping[str, Value] | None = None
    for number, step in enumerate(trace.steps[:SHOWN_STEPS]):
        row: list[object] = [number, changes(before, step.state)]
        if partial:
            row.append(told(trace.model, step.beliefs))
        row += [listed(step.path, 6, " > "), short(step.action)]
        if partial:
            row.append(observed(step.observation or {}))
        rows.append([*row, number_text(step.reward)])
        before = step.state
    left = len(trace.steps) - len(rows)
    if not left:
        last: list[object] = ["end" if trace.ended else "", changes(before, trace.state)]
        last += [told(trace.model, trace.beliefs)] if partial and not trace.ended else []
        rows.append([*last, *[""] * (len(columns) - len(last))])
    detail = f"{plural(len(trace.steps), 'step')}, seed {trace.seed}"
    return view(
        heading(f"episode of {short(trace.model.name)}", detail),
        table(columns, rows, left=range(len(columns) - 1)),
        line(f"… {plural(left, 'more step')}" if left else ""),
        line(
            f"discounted return {number_text(trace.discounted_return, 6)}{', ended' if trace.ended else ''}"
        ),
    )


def changes(before: Mapping[str, Value] | None, now: Mapping[str, Value]) -> str:
    """A state at first in full, then what changed."""
    shown = now if before is None else {n: v for n, v in now.items() if not same(before[n], v)}
    return short(", ".join(f"{name}={value_text(value)}" for name, value in shown.items()), LONGEST)


def same(one: Value, other: Value) -> bool:
    """Whether two values are the same; `True` is not 1."""
    return type(one) is type(other) and one == other


def told(model: Model, beliefs: Mapping[str, FloatArray]) -> str:
    """The features that are not certain, the least certain first, and of each its likeliest values."""
    parts = []
    for name, chances in sorted(beliefs.items(), key=lambda pair: float(pair[1].max())):
        if chances.max() > SURE:
            continue
        order = [v for v in np.argsort(-chances, kind="stable").tolist() if chances[v] > 5e-4]
        if len(order) > 1:
            values = model.feature(name).values
            said = [f"{value_text(values[v])} {percent(float(chances[v]))}" for v in order]
            parts.append(f"{name}: {listed(said, SHOWN_VALUES)}")
    return short("; ".join(parts) or "certain", LONGEST)


def observed(observation: Mapping[str, Value]) -> str:
    """What came in."""
    return short(
        ", ".join(f"{name}={value_text(v)}" for name, v in observation.items()) or "nothing", LONGEST
    )
