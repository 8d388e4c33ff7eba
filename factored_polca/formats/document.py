"""What a file of models holds."""

from __future__ import annotations

from dataclasses import dataclass

from factored_polca.models.errors import Fault
from factored_polca.models.model import Model
from factored_polca.models.tasks import TaskHierarchy


@dataclass(frozen=True)
class Document:
    """A model, the task hierarchy that stands beside it (None: none), and what is worth a warning."""

    model: Model
    tasks: TaskHierarchy | None = None
    warnings: tuple[Fault, ...] = ()
