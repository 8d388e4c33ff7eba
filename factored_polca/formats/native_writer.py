"""Writes models and tasks in the native format (see `factored_polca.formats.native`).

What is written is read again and compared before it is handed over, so a text that this module
returns always describes exactly the model it was given.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from fractions import Fraction
from typing import Final

from factored_polca.formats.document import Document
from factored_polca.formats.native_reader import read_native
from factored_polca.formats.toml_text import toml_block, toml_key, toml_string
from factored_polca.models.check import check, check_tasks
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import FALSE, TRUE, Constant, Expression
from factored_polca.models.features import Feature
from factored_polca.models.model import Action, Model, Observation, uniform
from factored_polca.models.printing import number_text, to_text
from factored_polca.models.scalars import Value
from factored_polca.models.tasks import Task, TaskHierarchy

WIDTH: Final = 100
"""Expressions longer than this are broken into several lines."""


def write_native(model: Model, tasks: TaskHierarchy | None = None) -> str:
    """The text from which `read_native` reads `model` and `tasks` back.

    Raises:
        ModelError: `model` or `tasks` are at fault, or the text would not mean the same (for
            example an expression nested deeper than the language reads); says what and where.
    """
    faults = check(model) + (check_tasks(model, tasks) if tasks is not None else [])
    faults = [fault for fault in faults if fault.severity == "error"]
    faults = faults or list(_unwritable(model, tasks))
    if faults:
        raise ModelError(faults)
    text = "\n\n".join("\n".join(lines) for lines in _sections(model, tasks) if lines) + "\n"
    try:
        back = read_native(text)
    except ModelError as error:
        raise ModelError(
            _refusal(fault.message, fault.path, fault.hint) for fault in error.faults
        ) from None
    _confirm(Document(model, tasks), back)
    return text


def _refusal(message: str, path: tuple[str, ...], hint: str = "") -> Fault:
    return Fault(f"can't be written in the native format: {message}", path, hint)


def _unwritable(model: Model, tasks: TaskHierarchy | None) -> Iterable[Fault]:
    """The expressions that have no text: those whose text would be too long."""
    for path, expression in _expressions(model, tasks):
        try:
            to_text(expression)
        except ModelError as error:
            yield from (_refusal(fault.message, path, fault.hint) for fault in error.faults)
        except (RecursionError, ValueError) as error:  # Python's own limits, on digits for example
            yield _refusal(str(error), path)


def _confirm(written: Document, back: Document) -> None:
    """Refuses where reading gave something else than was written."""
    parts = [
        (name, getattr(written.model, name), getattr(back.model, name))
        for name in Model.__dataclass_fields__
    ]
    parts.append(("tasks", written.tasks, back.tasks))
    typed = ("features", "observations")  # in Python True == 1: only their repr tells them apart
    faults = [
        _refusal("it would be read as something else", (name,))
        for name, ours, theirs in parts
        if ours != theirs or (name in typed and repr(ours) != repr(theirs))
    ]
    if faults:
        raise ModelError(faults)


def _expressions(model: Model, tasks: TaskHierarchy | None) -> Iterable[tuple[tuple[str, ...], Expression]]:
    """All expressions of a model and its tasks, with their paths."""
    for term in model.rewards:
        yield ("reward",), term
    yield ("terminal",), model.terminal
    for name, part in model.initial.distributions:
        yield ("initial", name), part
    for part in model.initial.factors:
        yield ("initial_factors",), part
    for action in model.actions:
        path = ("actions", action.name)
        yield (*path, "applicable"), action.applicable
        for name, part in action.effects:
            yield (*path, "effects", name), part
        for name, part in action.senses:
            yield (*path, "senses", name), part
        for part in action.rewards:
            yield (*path, "reward"), part
    for task in tasks.tasks if tasks is not None else ():
        path = ("tasks", task.name)
        yield (*path, "terminal"), task.terminal
        for part in task.pseudo_rewards:
            yield (*path, "pseudo_reward"), part
        for name, terms in task.pseudo_rewards_of:
            for part in terms:
                yield (*path, "pseudo_reward", name), part


# --------------------------------------------------------------------------------------------
# Sections
# --------------------------------------------------------------------------------------------


def _sections(model: Model, tasks: TaskHierarchy | None) -> Iterable[list[str]]:
    """The lines of each section, in the order of the file."""
    yield _head(model)
    yield _titled("parameters", [_pair(name, _number(value)) for name, value in model.parameters])
    yield _titled("features", [_pair(feature.name, _feature(feature)) for feature in model.features])
    yield _titled("observations", [_pair(o.name, _observation(o)) for o in model.observations])
    yield _titled("initial", [
        _pair(name, '"uniform"' if _is_uniform(model, name, part) else _expression(part))
        for name, part in model.initial.distributions
    ])  # fmt: skip
    for action in model.actions:
        yield [f"[actions.{toml_key(action.name)}]", *_action(action)]
    if tasks is not None:
        for task in tasks.tasks:
            yield [f"[tasks.{toml_key(task.name)}]", *_task(task)]


def _titled(title: str, lines: list[str]) -> list[str]:
    return [f"[{title}]", *lines] if lines else []


def _pair(key: str, value: str) -> str:
    return f"{toml_key(key)} = {value}"


def _head(model: Model) -> list[str]:
    lines = [f"name = {toml_string(model.name)}"]
    if model.description:
        several = "\n" in model.description
        lines.append(f"description = {(toml_block if several else toml_string)(model.description)}")
    lines.append(f"discount = {_number(model.discount)}")
    if model.horizon is not None:
        lines.append(f"horizon = {model.horizon}")
    lines.append(f"observability = {toml_string(model.observability)}")
    if model.terminal != FALSE:
        lines.append(f"terminal = {_expression(model.terminal)}")
    if model.rewards:
        lines.append(f"reward = {_terms(model.rewards)}")
    if model.initial.factors:
        lines.append(f"initial_factors = {_list(_expression(factor) for factor in model.initial.factors)}")
    return lines


def _values(values: Sequence[Value]) -> str:
    """A feature's values in the shortest spelling."""
    if len(values) == 2 and values[0] is False and values[1] is True:
        return '"boolean"'
    first = values[0]
    numbers = all(isinstance(value, int) and not isinstance(value, bool) for value in values)
    if numbers and isinstance(first, int) and len(values) > 2:
        last = first + len(values) - 1
        if tuple(values) == tuple(range(first, last + 1)):
            return f'"{first}..{last}"'
    return f"[{', '.join(_value(value) for value in values)}]"


def _value(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return toml_string(value) if isinstance(value, str) else str(value)


def _feature(feature: Feature) -> str:
    values = _values(feature.values)
    return f"{{ values = {values}, observed = true }}" if feature.observed else values


def _observation(observation: Observation) -> str:
    values, null = _values(observation.values), observation.null
    return values if null == "none" else f"{{ values = {values}, null = {_value(null)} }}"


def _is_uniform(model: Model, name: str, expression: Expression) -> bool:
    return expression == uniform(model.feature(name))


def _action(action: Action) -> list[str]:
    lines = []
    if action.applicable != TRUE:
        lines.append(f"applicable = {_expression(action.applicable)}")
    lines += [f"effects.{_pair(name, _expression(part))}" for name, part in action.effects]
    lines += [f"senses.{_pair(name, _expression(part))}" for name, part in action.senses]
    if action.rewards:
        lines.append(f"reward = {_terms(action.rewards)}")
    return lines


def _task(task: Task) -> list[str]:
    lines = [f"actions = {_names(task.actions)}"]
    if task.terminal != FALSE:
        lines.append(f"terminal = {_expression(task.terminal)}")
    if task.has_pseudo_reward:
        lines.append(f"pseudo_reward = {_pseudo_reward(task)}")
    if task.adds_reward:
        lines.append("adds_reward = true")
    if task.observes is not None:
        lines.append(f"observes = {_names(task.observes)}")
    if task.solver is not None:
        lines.append(f"solver = {toml_string(task.solver)}")
    return lines


def _names(names: Iterable[str]) -> str:
    return f"[{', '.join(toml_string(name) for name in names)}]"


def _pseudo_reward(task: Task) -> str:
    """Common terms, and one table for each run of single actions in which none comes twice."""
    if not task.pseudo_rewards_of:
        return _terms(task.pseudo_rewards)
    tables: list[dict[str, str]] = [{}]
    for name, terms in task.pseudo_rewards_of:
        if name in tables[-1]:
            tables.append({})
        shown = [_expression(term, broken=False) for term in terms]
        tables[-1][name] = shown[0] if len(shown) == 1 else f"[{', '.join(shown)}]"
    inline = [f"{{ {', '.join(_pair(n, text) for n, text in table.items())} }}" for table in tables]
    if not task.pseudo_rewards and len(inline) == 1:
        return inline[0]
    return _list([*(_expression(term) for term in task.pseudo_rewards), *inline])


# --------------------------------------------------------------------------------------------
# Expressions
# --------------------------------------------------------------------------------------------


def _terms(terms: Sequence[Expression]) -> str:
    return _expression(terms[0]) if len(terms) == 1 else _list(_expression(term) for term in terms)


def _list(items: Iterable[str]) -> str:
    listed = list(items)
    line = f"[{', '.join(listed)}]"
    if len(line) <= WIDTH and "\n" not in line:
        return line
    return "[\n" + "".join(f"  {item},\n" for item in listed) + "]"


def _number(value: Fraction) -> str:
    """A TOML number where that is exact and in every TOML reader's range, else a text."""
    text = number_text(value)
    return f'"{text}"' if "/" in text or abs(value) >= 2**53 else text


def _expression(expression: Expression, *, broken: bool = True) -> str:
    """A TOML number, truth value or text for `expression`."""
    if isinstance(expression, Constant):
        if isinstance(expression.value, bool):
            return "true" if expression.value else "false"
        if isinstance(expression.value, Fraction):
            return _number(expression.value)
    text = to_text(expression)
    if broken and len(text) > WIDTH:
        lines = _broken(text)
        if "\n" in lines:
            return toml_block(lines)
    return toml_string(text)


_PART: Final = re.compile(r'"[^"]*"|`[^`]*`|[({]|[)}]|, ')


def _broken(text: str) -> str:
    """`text` with a new line after each comma of a long pair of brackets, indented by their depth."""
    parts = list(_PART.finditer(text))
    ends: dict[int, int] = {}
    opened: list[int] = []
    for part in parts:
        if part.group() in "({":
            opened.append(part.start())
        elif part.group() in ")}":
            ends[opened.pop()] = part.end()
    result: list[str] = []
    at, long = 0, [False]
    for part in parts:
        if part.group() in "({":
            long.append(ends[part.start()] - part.start() > WIDTH)
        elif part.group() in ")}":
            long.pop()
        elif part.group() == ", " and long[-1]:
            result.append(text[at : part.start()] + ",\n" + "  " * (len(long) - 1))
            at = part.end()
    return "".join(result) + text[at:]
