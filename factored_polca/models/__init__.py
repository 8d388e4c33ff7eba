"""Models as data: features, expressions, actions, rewards, beliefs, tasks. Knows nothing of diagrams."""

from factored_polca.models.check import check, check_tasks
from factored_polca.models.errors import Fault, LimitReached, ModelError
from factored_polca.models.expressions import (
    FALSE,
    TRUE,
    Conditional,
    Constant,
    Expression,
    Lottery,
    Operation,
    Parameter,
    Reference,
    Switch,
    as_expression,
    conditional,
    conjunction,
    disjunction,
    lottery,
    operation,
)
from factored_polca.models.features import Feature, boolean
from factored_polca.models.language import parse
from factored_polca.models.model import Action, InitialBelief, Model, Observation, uniform
from factored_polca.models.printing import to_text
from factored_polca.models.scalars import Value
from factored_polca.models.tasks import Task, TaskHierarchy, flat_task, resolve_tasks

__all__ = [
    "FALSE", "TRUE", "Action", "Conditional", "Constant", "Expression", "Fault", "Feature",
    "InitialBelief", "LimitReached", "Lottery", "Model", "ModelError", "Observation", "Operation",
    "Parameter", "Reference", "Switch", "Task", "TaskHierarchy", "Value", "as_expression", "boolean",
    "check", "check_tasks", "conditional", "conjunction", "disjunction", "flat_task", "lottery",
    "operation", "parse", "resolve_tasks", "to_text", "uniform",
]  # fmt: skip
