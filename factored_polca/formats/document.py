"""What a file of models holds."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from factored_polca.models.errors import Fault
from factored_polca.models.model import Model
from factored_polca.models.tasks import TaskHierarchy


@dataclass(frozen=True)
class Document:
    """A model, the task hierarchy that stands beside it (None: none), and what is worth a warning.

    `locate` adds file, line and column to faults that are found later, by their paths.
    """

    model: Model
    tasks: TaskHierarchy | None = None
    warnings: tuple[Fault, ...] = ()
    locate: Callable[[Iterable[Fault]], tuple[Fault, ...]] = field(default=tuple, compare=False, repr=False)
