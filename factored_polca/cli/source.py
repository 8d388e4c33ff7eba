"""What a command works on: the MODEL argument, parameters, sizes and states given as text."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from factored_polca import library
from factored_polca.formats import FORMATS, read
from factored_polca.models import Fault, Model, ModelError, TaskHierarchy, Value


class UsageError(Exception):
    """A wrong argument on the command line."""


@dataclass(frozen=True)
class Source:
    """A model and its tasks, where they came from, and how long reading took."""

    name: str
    model: Model
    tasks: TaskHierarchy | None
    warnings: tuple[Fault, ...]
    parse_seconds: float
    locate: Callable[[Iterable[Fault]], tuple[Fault, ...]] = tuple

    @contextmanager
    def located(self) -> Iterator[None]:
        """Give faults that are found inside the file, line and column of their places."""
        try:
            yield
        except ModelError as error:
            raise ModelError(self.locate(error.faults)) from None


def load(text: str, settings: Sequence[str] = (), tasks: str | None = None) -> Source:
    """The model that MODEL names: a file, or else a shipped domain.

    Raises:
        ModelError: neither, or not a right model.
    """
    began = time.perf_counter()
    parameters = parse_settings(settings)
    path = Path(text)
    warnings: tuple[Fault, ...] = ()
    locate: Callable[[Iterable[Fault]], tuple[Fault, ...]] = tuple
    if path.is_file() or path.suffix.lower() in FORMATS or path.is_dir():
        document = read(path, parameters)
        name, model, hierarchy, warnings = path.name, document.model, document.tasks, document.warnings
        locate = document.locate
    elif text in library.domains():
        domain = library.load(text, parameters)
        name, model, hierarchy = text, domain.model, domain.tasks
    else:
        domains, extensions = ", ".join(library.domains()), ", ".join(FORMATS)
        raise ModelError(
            f"{text}: no such file and no shipped domain; domains are {domains}; files end in {extensions}"
        )
    if tasks is not None:
        hierarchy = read_tasks(tasks, model)
    return Source(name, model, hierarchy, warnings, time.perf_counter() - began, locate)


def read_tasks(text: str, model: Model) -> TaskHierarchy:
    """The tasks of another file, for `model`.

    Raises:
        ModelError: the file is not right or holds no tasks.
    """
    from factored_polca.formats.native import read_native_tasks

    path = Path(text)
    try:
        content = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ModelError(f"{text}: there is no such file; --tasks takes a .toml file") from None
    except (OSError, ValueError) as error:
        raise ModelError(f"{text}: can't be read ({error})") from None
    try:
        return read_native_tasks(content, model)
    except ModelError as error:
        raise error.in_file(text) from None


def parse_settings(settings: Sequence[str]) -> dict[str, str]:
    """`["size=10"]` as {"size": "10"}.

    Raises:
        UsageError: without "=".
    """
    result: dict[str, str] = {}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or not name:
            raise UsageError(f"--set takes NAME=VALUE, not {setting!r}")
        result[name.strip()] = value.strip()
    return result


def parse_actions(text: str, model: Model) -> list[str]:
    """`a,b` as the names of actions, in the model's order.

    Raises:
        UsageError: an unknown action; the message lists those there are.
    """
    asked = {name.strip() for name in text.split(",")}
    known = [action.name for action in model.actions]
    unknown = sorted(asked - set(known))
    if unknown:
        raise UsageError(f"--actions: no action {unknown[0]!r}; there are {', '.join(known[:50])}")
    return [name for name in known if name in asked]


def parse_state(text: str, model: Model) -> dict[str, Value]:
    """`x=3,y=on,"a feature"="a, b"` as {feature: value}.

    What stands in double quotes may have commas and equal signs; a value in quotes is a name, never a
    number or a truth value.

    Raises:
        ModelError: an unknown feature or value, or a feature without one.
    """
    if text.count('"') % 2:
        raise ModelError(f"--state takes FEATURE=VALUE,...; a quote is not closed in {text!r}")
    state: dict[str, Value] = {}
    for part in re.findall(r'(?:"[^"]*"|[^,"])+|^$', text):
        match = re.fullmatch(r'\s*("[^"]*"|[^"=]*?)\s*=\s*("[^"]*"|[^"]*?)\s*', part)
        if match is None:
            raise ModelError(f"--state takes FEATURE=VALUE,..., not {part!r}")
        name, value = match[1].strip('"'), match[2]
        try:
            feature = model.feature(name)
        except KeyError as error:
            raise ModelError(str(error.args[0])) from None
        if name in state:
            raise ModelError(f"--state gives {name} twice")
        if value.startswith('"'):
            value = value[1:-1]
            by_text: Mapping[str, Value] = {v: v for v in feature.values if isinstance(v, str)}
        else:
            by_text = value_texts(feature.values)
        if value not in by_text:
            listed = ", ".join(list(by_text)[:20])
            raise ModelError(f"{name} has no value {value!r}; it has {listed}")
        state[name] = by_text[value]
    missing = [feature.name for feature in model.features if feature.name not in state]
    if missing:
        raise ModelError(f"--state gives no value for {', '.join(missing)}")
    return state


def value_texts(values: Sequence[Value]) -> Mapping[str, Value]:
    """Values by the text a person writes for them; truth values and numbers before names like them."""
    ordered = sorted(values, key=lambda v: not isinstance(v, str))
    return {str(v).lower() if isinstance(v, bool) else str(v): v for v in ordered}
