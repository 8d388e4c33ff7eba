"""Reads the native format (see `factored_polca.formats.native`) into a `Document`.

Reading goes on after a fault, with something neutral in its place, so that one run shows them all:
first the shape of the tables and the text of every expression, then what `check` and `check_tasks`
see.  Places are looked up only when there are faults to show.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from difflib import get_close_matches
from fractions import Fraction
from typing import Any, Final

from factored_polca.formats.document import Document
from factored_polca.formats.positions import Path, scan
from factored_polca.formats.toml_text import MAXIMUM_DIGITS, Decimal, load
from factored_polca.models.check import MAXIMUM_FEATURES, MAXIMUM_VALUES, model_faults, task_faults
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import FALSE, Constant, Expression, depth
from factored_polca.models.features import Feature
from factored_polca.models.language import number, parse
from factored_polca.models.model import Action, InitialBelief, Model, Observation, uniform
from factored_polca.models.scalars import Value
from factored_polca.models.scope import Scope
from factored_polca.models.tasks import Task, TaskHierarchy
from factored_polca.models.work import Work

MAXIMUM_ACTIONS: Final = 100_000
MAXIMUM_TASKS: Final = 10_000
MAXIMUM_VALUES_IN_ALL: Final = 1_000_000
MAXIMUM_FAULTS: Final = 1_000
"""Reading stops after as many."""

_KEYS: Final[Mapping[str, tuple[str, ...]]] = {
    "a model": (
        "name", "description", "discount", "horizon", "observability", "parameters", "features",
        "observations", "initial", "initial_factors", "reward", "terminal", "actions", "tasks",
    ),
    "a feature": ("values", "observed"),
    "an observation": ("values", "null"),
    "an action": ("effects", "applicable", "reward", "senses"),
    "a task": ("actions", "terminal", "pseudo_reward", "adds_reward", "observes", "solver"),
}  # fmt: skip
_RANGE: Final = re.compile(r"\s*(-?[0-9]{1,18})\s*\.\.\s*(-?[0-9]{1,18})\s*")
_VALUES_HINT: Final = 'values are a list such as ["red", "green"], a range such as "0..4", or "boolean"'
_NUMBER_HINT: Final = 'write a number such as 0.95, or a text such as "19/20"'


def read_native(text: str, overrides: Mapping[str, str] | None = None, *, name: str = "model") -> Document:
    """The model, and the tasks if there are any, that `text` describes.

    `overrides` gives parameters of the model other values, as texts such as "1/3".  `name` is the
    model's name where the text gives none.

    Raises:
        ModelError: with all faults that were found, each with line and column.
    """
    text = text.removeprefix("\ufeff").replace("\r\n", "\n")
    reader = _Reader(load(text))
    try:
        document = reader.document(name, overrides or {})
    except RecursionError:
        raise reader.located(text, [*reader.found, reader.too_deep()]) from None
    except _Enough:
        raise reader.located(text, reader.found) from None
    errors = [found for found in reader.found if found.fault.severity == "error"]
    if errors:
        raise reader.located(text, errors)
    warnings = reader.located(text, reader.found).faults if reader.found else ()

    def locate(faults: Iterable[Fault]) -> tuple[Fault, ...]:
        places = [_Found(fault, reader.places.get(fault.path, fault.path)) for fault in faults]
        return reader.located(text, places, absent=(0, 0)).faults

    return Document(document.model, document.tasks, warnings, locate)


def read_native_tasks(text: str, model: Model) -> TaskHierarchy:
    """The tasks that `text` describes, for another file's or a domain's model; other tables are skipped.

    Raises:
        ModelError: no tasks, or faults, each with line and column.
    """
    text = text.removeprefix("\ufeff").replace("\r\n", "\n")
    reader = _Reader(load(text))
    reader.scope = model.scope()
    try:
        table = reader.section("tasks", MAXIMUM_TASKS)
        if not table:
            reader.fault("there are no tasks", ("tasks",), "add a table such as [tasks.Root]")
        tasks = TaskHierarchy(reader.task(key, value) for key, value in table.items())
        if table:
            reader.checked(task_faults(model, tasks))
    except _Enough:
        pass
    if reader.found:
        raise reader.located(text, reader.found)
    return tasks


class _Enough(Exception):
    """`MAXIMUM_FAULTS` faults were found, or one after which reading on is of no use."""


@dataclass(frozen=True, slots=True)
class _Found:
    """A fault and where to look for its place: `value` is the text that its line and column are in."""

    fault: Fault
    place: Path | None
    value: str | None = None
    at_key: bool = False


class _Reader:
    """One pass over the tables of a text; collects faults."""

    def __init__(self, data: dict[str, Any]) -> None:
        self.data = data
        self.found: list[_Found] = []
        self.places: dict[Path, Path] = {}  # where `check` says something is -> where it is in the text
        self.failed: set[Path] = set()
        self.expressions: dict[Path, Expression] = {}
        self.parsed: dict[str, Expression] = {}
        self.scope = Scope()
        self.values_left = MAXIMUM_VALUES_IN_ALL
        self.work = Work()

    # -- faults ----------------------------------------------------------------------------

    def add(self, found: _Found) -> None:
        if len(self.found) >= MAXIMUM_FAULTS:
            raise _Enough
        self.found.append(found)

    def fault(self, message: str, path: Path, hint: str = "", *, at_key: bool = False) -> None:
        self.failed.add(path)
        self.add(_Found(Fault(message, path, hint), path, at_key=at_key))

    def refuse(self, message: str, path: Path) -> _Enough:
        """The exception for a fault after which reading on would be too much work."""
        self.fault(message, path)
        return _Enough()

    def checked(self, faults: Iterable[Fault]) -> None:
        """Takes over what `check` found, except in parts that were already at fault."""
        for fault in faults:
            place = self.places.get(fault.path, fault.path)
            if any(place[:length] in self.failed for length in range(1, len(place) + 1)):
                continue
            if fault.path[:1] == ("features",):  # `check` says so for all names
                sections = ("features", "observations", "parameters")
                there = [s for s in sections if len(place) > 1 and place[1] in self.data.get(s, ())]
                place = (there[-1], *place[1:]) if there else place
            self.add(_Found(fault, place))

    def too_deep(self) -> _Found:
        path = max(self.expressions, key=lambda p: depth(self.expressions[p]), default=())
        return _Found(Fault("nested too deeply", path, "split the expression, or use switch(...)"), path)

    def located(self, text: str, found: Iterable[_Found], absent: tuple[int, int] = (1, 1)) -> ModelError:
        """The error with a line and column for each fault, in the order of the text.

        What is about something that the text lacks has the place `absent`.
        """
        positions = scan(text)
        faults = []
        for item in found:
            fault = item.fault
            if item.place is None:
                line, column = 0, 0
            elif item.value is not None:
                line, column = positions.inside(item.place, item.value, fault.line, fault.column)
            else:
                line, column = (positions.of_key if item.at_key else positions.of_value)(item.place)
                line, column = (line, column) if line else absent
            faults.append(replace(fault, line=line, column=column))
        faults.sort(key=lambda fault: (fault.line == 0, fault.line, fault.column))
        if len(faults) >= MAXIMUM_FAULTS:
            last = faults[-1]
            message = f"reading stopped: there are {MAXIMUM_FAULTS} faults"
            faults.append(Fault(message, line=last.line, column=last.column))
        return ModelError(faults)

    # -- shapes ----------------------------------------------------------------------------

    def table(self, path: Path, value: Any, what: str = "") -> dict[str, Any]:
        """`value`, which must be a table and, where `what` is given, may have only its keys."""
        if not isinstance(value, dict):
            self.fault(f"expected a table, found {_kind(value)}", path)
            return {}
        for key in value if what else ():
            if key not in _KEYS[what]:
                near = get_close_matches(key[:40], _KEYS[what], 1)
                hint = f"{what} has the keys {', '.join(_KEYS[what])}"
                hint += f"; did you mean {near[0]!r}?" if near else ""
                self.fault(f"unknown key {key!r}", (*path, key), hint, at_key=True)
        return value

    def section(self, name: str, limit: int = MAXIMUM_VALUES_IN_ALL) -> dict[str, Any]:
        table = self.table((name,), self.data.get(name, {}))
        if len(table) > limit:
            raise self.refuse(f"{len(table)} {name}; at most {limit} are read", (name,))
        return table

    def text(self, path: Path, value: Any, hint: str = "") -> str:
        if isinstance(value, str):
            return value
        self.fault(f"expected a text in quotes, found {_kind(value)}", path, hint)
        return ""

    def flag(self, path: Path, value: Any) -> bool:
        if isinstance(value, bool):
            return value
        self.fault(f"expected true or false, found {_kind(value)}", path, "without quotes")
        return False

    def names(self, path: Path, value: Any) -> tuple[str, ...]:
        if not isinstance(value, list):
            self.fault(f"expected a list of names, found {_kind(value)}", path, 'as in ["North", "South"]')
            return ()
        result = tuple(self.text((*path, str(index)), item) for index, item in enumerate(value))
        if not all(isinstance(item, str) for item in value):
            self.failed.add(path)
        return result

    def value(self, path: Path, value: Any) -> Value:
        if isinstance(value, bool | str) or (isinstance(value, int) and abs(value) < 10**18):
            return value
        hint = "a value is a text, an integer of at most 18 digits, true or false"
        self.fault(f"{_kind(value)} can't be a value", path, hint)
        return False

    def values(self, path: Path, value: Any) -> tuple[Value, ...]:
        result: tuple[Value, ...] = (False, True)
        if isinstance(value, list):
            result = tuple(self.value((*path, str(index)), item) for index, item in enumerate(value))
        elif isinstance(value, str) and (match := _RANGE.fullmatch(value)):
            low, high = int(match[1]), int(match[2])
            if low > high:
                self.fault(f"the range {value!r} is empty", path, f'write "{high}..{low}"')
            elif high - low >= MAXIMUM_VALUES:
                self.fault(f"the range {value!r} has more than {MAXIMUM_VALUES} values", path)
            else:
                result = tuple(range(low, high + 1))
        elif value != "boolean":
            self.fault(f"{_shown(value)} gives no values", path, _VALUES_HINT)
        self.values_left -= len(result)
        if self.values_left < 0:
            raise self.refuse(f"more than {MAXIMUM_VALUES_IN_ALL} values of features in all", path)
        return result

    # -- expressions -----------------------------------------------------------------------

    def expression(
        self, path: Path, value: Any, *, shown: Path = (), scope: Scope | None = None
    ) -> Expression:
        """The expression that `value` is; `shown` is the path by which `check` knows it."""
        if shown and shown != path:
            self.places.setdefault(shown, path)
        try:
            result = self.read(value) if scope is None else _expression(value, scope, self.work)
        except ModelError as error:
            self.failed.add(path)
            text = value if isinstance(value, str) else None
            for fault in error.faults:
                self.add(_Found(replace(fault, path=shown or path), path, text))
            if self.work.exceeded:
                raise _Enough from None
            return FALSE
        except RecursionError:
            self.fault("nested too deeply", path, "split the expression, or use switch(...)")
            return FALSE
        except ValueError as error:
            self.fault(str(error), path)
            return FALSE
        self.expressions[path] = result
        return result

    def read(self, value: Any) -> Expression:
        """The expression in the model's scope; actions often repeat a text, which is read once."""
        if not isinstance(value, str):
            return _expression(value, self.scope, self.work)
        if value not in self.parsed:
            self.parsed[value] = _expression(value, self.scope, self.work)
        return self.parsed[value]

    def table_of_expressions(self, path: Path, value: Any) -> list[tuple[str, Expression]]:
        table = self.table(path, value)
        return [(key, self.expression((*path, key), part)) for key, part in table.items()]

    def terms(self, path: Path, value: Any) -> list[Expression]:
        """One expression, or a list of them that are added up."""
        if not isinstance(value, list):
            return [self.expression(path, value, shown=(*path, "0"))]
        return [self.expression((*path, str(index)), part) for index, part in enumerate(value)]

    def constant(self, path: Path, value: Any) -> Fraction:
        result = self.expression(path, value, scope=Scope())
        if path in self.failed:
            return Fraction(0)
        if isinstance(result, Constant) and isinstance(result.value, Fraction):
            return result.value
        self.fault(f"{_shown(value)} is not a number", path, _NUMBER_HINT)
        return Fraction(0)

    # -- the parts of a model --------------------------------------------------------------

    def document(self, name: str, overrides: Mapping[str, str]) -> Document:
        data = self.table((), self.data, "a model")
        parameters = self.parameters(overrides)
        features = [
            self.feature(("features", key), key, value)
            for key, value in self.section("features", MAXIMUM_FEATURES).items()
        ]
        observations = [
            self.observation(("observations", key), key, value)
            for key, value in self.section("observations", MAXIMUM_FEATURES).items()
        ]
        self.scope = Model("", features, (), observations=observations, parameters=parameters).scope()
        model = Model(
            self.text(("name",), data["name"]) if "name" in data else name,
            features,
            [self.action(key, value) for key, value in self.section("actions", MAXIMUM_ACTIONS).items()],
            rewards=self.terms(("reward",), data.get("reward", [])),
            terminal=self.expression(("terminal",), data.get("terminal", False)),
            initial=self.initial({feature.name: feature for feature in features}),
            discount=self.discount(),
            observability=self.text(("observability",), data.get("observability", "full")),  # type: ignore[arg-type]
            observations=observations,
            parameters=parameters,
            horizon=self.horizon(data.get("horizon")),
            description=self.text(("description",), data.get("description", "")),
        )
        self.checked(model_faults(model))
        tasks = None
        if "tasks" in data:
            table = self.section("tasks", MAXIMUM_TASKS)
            tasks = TaskHierarchy(self.task(key, value) for key, value in table.items())
            self.checked(task_faults(model, tasks))
        return Document(model, tasks)

    def parameters(self, overrides: Mapping[str, str]) -> list[tuple[str, Fraction]]:
        table = self.section("parameters")
        result = {key: self.constant(("parameters", key), value) for key, value in table.items()}
        for key, text in overrides.items():
            path = ("parameters", key)
            if key not in table:
                hint = f"its parameters are {', '.join(table) or 'none'}"
                self.add(_Found(Fault(f"the model has no parameter {key!r}", path, hint), None))
                continue
            apart = _Reader({})
            result[key] = apart.constant(path, str(text))
            for found in apart.found:
                message = f"the value {_shown(text)} for a parameter: {found.fault.message}"
                fault = Fault(message, path, found.fault.hint or _NUMBER_HINT)
                self.add(_Found(fault, None))
        return list(result.items())

    def feature(self, path: Path, name: str, value: Any) -> Feature:
        if not isinstance(value, dict):
            return Feature(name, self.values(path, value))
        table = self.table(path, value, "a feature")
        if "values" not in table:
            self.fault(f"feature {name!r} has no values", path, _VALUES_HINT)
        values = self.values((*path, "values"), table.get("values", "boolean"))
        return Feature(name, values, self.flag((*path, "observed"), table.get("observed", False)))

    def observation(self, path: Path, name: str, value: Any) -> Observation:
        if not isinstance(value, dict):
            return Observation(name, self.values(path, value))
        table = self.table(path, value, "an observation")
        if "values" not in table:
            self.fault(f"observation {name!r} has no values", path, _VALUES_HINT)
        values = self.values((*path, "values"), table.get("values", "boolean"))
        return Observation(name, values, self.value((*path, "null"), table.get("null", "none")))

    def discount(self) -> Fraction:
        if "discount" not in self.data:
            self.fault("the model has no discount", ("discount",), "add a line such as discount = 0.95")
            return Fraction(0)
        return self.constant(("discount",), self.data["discount"])

    def horizon(self, value: Any) -> int | None:
        if value is None or (isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63):
            return value
        self.fault(
            f"{_shown(value)} is no number of steps", ("horizon",), "a whole number, or leave it out"
        )
        return None

    def initial(self, features: Mapping[str, Feature]) -> InitialBelief:
        distributions = []
        for key, value in self.section("initial").items():
            if isinstance(value, str) and value.strip() == "uniform":
                feature = features.get(key)  # `check` says so if there is none
                distributions.append((key, uniform(feature) if feature and feature.values else FALSE))
            else:
                distributions.append((key, self.expression(("initial", key), value)))
        factors = self.data.get("initial_factors", [])
        if not isinstance(factors, list):
            factors = [factors]
        return InitialBelief(distributions, [
            self.expression(("initial_factors", str(i)), factor, shown=("initial", "factors", str(i)))
            for i, factor in enumerate(factors)
        ])  # fmt: skip

    def action(self, name: str, value: Any) -> Action:
        path = ("actions", name)
        table = self.table(path, value, "an action")
        return Action(
            name,
            self.table_of_expressions((*path, "effects"), table.get("effects", {})),
            applicable=self.expression((*path, "applicable"), table.get("applicable", True)),
            rewards=self.terms((*path, "reward"), table.get("reward", [])),
            senses=self.table_of_expressions((*path, "senses"), table.get("senses", {})),
        )

    def task(self, name: str, value: Any) -> Task:
        path = ("tasks", name)
        table = self.table(path, value, "a task")
        common, single = self.pseudo_rewards((*path, "pseudo_reward"), table.get("pseudo_reward", []))
        observes, solver = table.get("observes"), table.get("solver")
        return Task(
            name,
            self.names((*path, "actions"), table.get("actions", [])),
            terminal=self.expression((*path, "terminal"), table.get("terminal", False)),
            pseudo_rewards=common,
            pseudo_rewards_of=single,
            adds_reward=self.flag((*path, "adds_reward"), table.get("adds_reward", False)),
            observes=None if observes is None else self.names((*path, "observes"), observes),
            solver=None if solver is None else self.text((*path, "solver"), solver),
        )

    def pseudo_rewards(
        self, path: Path, value: Any
    ) -> tuple[list[Expression], list[tuple[str, list[Expression]]]]:
        """The terms of all actions and those of single actions: a term, a table, or a list of both."""
        parts = [(path, value)]
        if isinstance(value, list):
            parts = [((*path, str(index)), part) for index, part in enumerate(value)]
        common: list[Expression] = []
        single: list[tuple[str, list[Expression]]] = []
        for place, part in parts:
            if not isinstance(part, dict):
                common.append(self.expression(place, part, shown=(*path, str(len(common)))))
                continue
            for action, terms in part.items():
                self.places.setdefault((*path, action), (*place, action))
                single.append((action, self.terms((*place, action), terms)))
        return common, single


def _expression(value: Any, scope: Scope, work: Work) -> Expression:
    """The expression of a TOML value: a text in the expression language, a number or a truth value."""
    if isinstance(value, str):
        return parse(value, scope, work)
    work.count(1)
    if isinstance(value, bool):
        return Constant(value)
    if isinstance(value, int):
        if abs(value) >= 10**MAXIMUM_DIGITS:
            raise ValueError(f"a number of more than {MAXIMUM_DIGITS} digits")
        return Constant(Fraction(value))
    if isinstance(value, Decimal):
        digits = value.text.removeprefix("-")
        if not digits[:1].isdigit():
            raise ValueError(f"{value.text} is not a rational number")
        size = number(digits)
        return Constant(-size if value.text.startswith("-") else size)
    raise ValueError(
        f"expected an expression (a text in quotes, a number, true or false), found {_kind(value)}"
    )


def _kind(value: Any) -> str:
    """What TOML calls `value`."""
    kinds = {bool: "true or false", int: "an integer", Decimal: "a number", str: "a text", list: "a list"}
    return "a table" if isinstance(value, dict) else kinds.get(type(value), "a date or time")


def _shown(value: Any) -> str:
    """`value` itself where it is short, else what it is."""
    if isinstance(value, Decimal) and len(value.text) <= 40:
        return value.text
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int) and value.bit_length() <= 128:
        return str(value)
    return repr(value) if isinstance(value, str) and len(value) <= 40 else _kind(value)
