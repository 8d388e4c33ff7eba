"""How the time that is left is shared, so that searches that are cut short leave a plan.

The search of a task may take a share of the time that is left when it begins: what follows (parents,
bounds, the way back to the states) needs time too.  A search that is cut short leaves a policy and bounds
that hold, and the plan goes on with them.  What can't be cut short, as finding blocks, has all the rest.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Final, Literal, TypeAlias

from factored_polca.hierarchy.options import Options
from factored_polca.solvers.result import Status

CHILD_SHARE: Final = 0.5
"""Share of the time left that the search of a task with parents may take."""

ROOT_SHARE: Final = 0.9
"""The same of the root."""

PlanStatus: TypeAlias = Literal["complete", "time limit", "memory limit"]
"""Whether all searches came to their own ends, or which limit cut one short first."""


def search_deadline(options: Options, *, is_root: bool) -> float | None:
    """When the search of a task that begins now is to stop; a reading of `time.monotonic()`."""
    if options.deadline is None:
        return None
    now = time.monotonic()
    share = ROOT_SHARE if is_root else CHILD_SHARE
    return min(options.deadline, now + share * max(options.deadline - now, 0.0))


def plan_status(statuses: Iterable[Status]) -> PlanStatus:
    """The status of a plan whose tasks' solvers stopped so."""
    for status in statuses:
        if status in ("time limit", "memory limit"):
            return status
    return "complete"


def cut_short_text(name: str, status: Status, gap: float) -> str:
    """A warning: the search of a task was cut short."""
    return f"task {name!r}: the {status} cut its search short; its policy is the best so far, gap {gap:.3g}"
