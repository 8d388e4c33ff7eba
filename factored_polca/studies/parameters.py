"""Figure 4a: how many numbers the models of a hierarchy's tasks have, by how they are abstracted.

    parameters = non-zero entries of all K_c(C; C', o) and of all R(C, c), c a choice of the task,

each task once, without abstraction, as PolCA sees it (no observations), and as PolCA+ does; the counting
is that of `factored_polca.hierarchy.parameters`.  Abstraction depends on the children's policies, so each
hierarchy is planned for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

from factored_polca.drawn import Framed
from factored_polca.hierarchy import HierarchicalPlan, Options, plan_mdp, plan_pomdp
from factored_polca.hierarchy.parameters import unreduced_parameters
from factored_polca.hierarchy.pomdp_report import polca_parameters, task_parameters
from factored_polca.models import LimitReached, Model, ModelError, TaskHierarchy

Progress: TypeAlias = Callable[[str], None]
"""Told what is being done."""

Reading: TypeAlias = Literal["none", "polca", "polca_plus"]


def silent(text: str) -> None:
    """Progress that nobody follows."""
    del text


@dataclass(frozen=True)
class TaskParameters:
    """The parameters of one task; None where they are not known."""

    name: str
    none: int | None
    polca: int | None
    polca_plus: int | None


@dataclass(frozen=True)
class ParameterStudy(Framed):
    """The parameters of all tasks, children first; `notes` say what was left out, and why."""

    model: str
    states: int
    tasks: tuple[TaskParameters, ...]
    notes: tuple[str, ...]
    seconds: float

    def total(self, reading: Reading) -> int | None:
        """The parameters of all tasks, None where those of one are not known."""
        counts = [getattr(task, reading) for task in self.tasks]
        return None if None in counts else sum(counts)

    def to_data(self) -> dict[str, Any]:
        """The study as plain data."""
        return {
            "figure": "4a",
            "model": self.model,
            "states": self.states,
            "tasks": [
                {"name": t.name, "none": t.none, "polca": t.polca, "polca_plus": t.polca_plus}
                for t in self.tasks
            ],
            "totals": {
                "none": self.total("none"),
                "polca": self.total("polca"),
                "polca_plus": self.total("polca_plus"),
            },
            "notes": list(self.notes),
            "seconds": self.seconds,
        }


def study_parameters(
    model: Model,
    tasks: TaskHierarchy | None = None,
    options: Options | None = None,
    *,
    progress: Progress = silent,
) -> ParameterStudy:
    """Plan a partially observed model with PolCA+ and with PolCA, and count.

    Raises:
        ModelError: the model or the hierarchy is not right, or the state is seen.
        LimitReached: memory, blocks or observations.
    """
    began = time.perf_counter()
    options = replace(options or Options(), flat_block_limit=None)
    progress("PolCA+")
    plan = plan_pomdp(model, tasks, options)
    notes = []
    polca: HierarchicalPlan | None = None
    try:
        progress("PolCA")
        polca = plan_mdp(model, tasks, as_if_seen(options), symbolic=plan.symbolic)
    except (ModelError, LimitReached) as error:
        notes.append(f"PolCA is left out: {error}")
    progress("counting without abstraction")
    none = unreduced_parameters(plan.symbolic, [solved.process for solved in plan.solved])
    if none is None:
        notes.append("without abstraction: too many states to list")
    counted = tuple(
        TaskParameters(
            solved.task.name,
            None if none is None else none[number],
            None if polca is None else polca_parameters(polca, solved.task.name),
            task_parameters(solved),
        )
        for number, solved in enumerate(plan.solved)
    )
    seconds = time.perf_counter() - began
    return ParameterStudy(model.name, model.states, counted, tuple(notes), seconds)


def as_if_seen(options: Options) -> Options:
    """The options under which PolCA plans the same hierarchy as if the state were seen."""
    return replace(options, assume_observed=True, flat_block_limit=None, solver="auto")
