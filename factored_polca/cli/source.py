"""What a command works on: the MODEL argument, parameters, sizes and states given as text."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from factored_polca import library
from factored_polca.formats import FORMATS, read
from factored_polca.formats.files import parts
from factored_polca.models import Fault, Feature, Model, ModelError, TaskHierarchy, Value


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


def load(
    text: str, settings: Sequence[str] = (), tasks: str | None = None, keep: Sequence[str] | None = None
) -> Source:
    """The model that MODEL names: a file, or else a shipped domain.

    `keep` names parameters of a domain that become parameters of the model; without names all numbers do.

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
        name = "+".join(part.name for part in parts(text))
        model, hierarchy, warnings = document.model, document.tasks, document.warnings
        locate = document.locate
    elif text in library.domains():
        if keep is not None and not keep:
            keep = library.numeric_parameters(text)
        domain = library.load(text, parameters, keep=keep or ())
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


_LISTED = re.compile(r"(?:\([^()]*\)|[^,(]|\()+")
"""Names with commas between them; a comma in parentheses is part of a name, as in move(x1,y2)."""


def parse_actions(text: str, model: Model) -> list[str]:
    """`a,b` or `move(x1,y2),noop` as the names of actions, in the model's order.

    Raises:
        UsageError: an unknown action; the message lists those there are.
    """
    asked = {name.strip() for name in _LISTED.findall(text) if name.strip()} or {""}
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
    state = {
        feature.name: parse_value(feature.name, feature.values, value)
        for feature, value in assignments(text, "--state", "FEATURE=VALUE,...", model)
    }
    missing = [feature.name for feature in model.features if feature.name not in state]
    if missing:
        raise ModelError(f"--state gives no value for {', '.join(missing)}")
    return state


_SHARE = re.compile(r"""\s*("[^"]*"|[^":/]*?)\s*:([^":/]*(?:/[^":/]*)?)(?=$|/\s*(?:"[^"]*"|[^":/]*):)/?""")
"""VALUE:P, and the slash before the next one; P may have a slash itself."""

_NUMBER = re.compile(r"[0-9]{1,30}(\.[0-9]{0,30})?|\.[0-9]{1,30}|[0-9]{1,30}/[0-9]{0,29}[1-9][0-9]{0,29}")


def parse_belief(text: str, model: Model) -> dict[str, dict[Value, Fraction]]:
    """`battery=low,person=room:0.9/physio:0.1` as {feature: {value: probability}}.

    Probabilities are decimals or fractions such as 1/3; a value without one is certain.  Quotes work as
    in `parse_state`; a value with a colon or a slash needs them.

    Raises:
        ModelError: an unknown feature or value, no number, a feature or value given twice, or
            probabilities that do not sum to exactly 1.
    """
    form = "FEATURE=VALUE or FEATURE=VALUE:P/VALUE:P,..."
    return {
        feature.name: _distribution(feature, chances, form)
        for feature, chances in assignments(text, "--belief", form, model)
    }


def _distribution(feature: Feature, text: str, form: str) -> dict[Value, Fraction]:
    name, row, place = feature.name, dict[Value, Fraction](), 0
    if ":" not in text or text in value_texts(feature.values) or re.fullmatch('"[^"]*"', text):
        return {parse_value(name, feature.values, text): Fraction(1)}
    while place < len(text):
        match = _SHARE.match(text, place)
        if match is None:
            raise ModelError(f"--belief takes {form}, not {name}={text!r}")
        value, number, place = match[1], match[2].strip(), match.end()
        key = parse_value(name, feature.values, value)
        if not _NUMBER.fullmatch(number):
            raise ModelError(
                f"--belief: {number[:40]!r} is no probability of {name}={value}, such as 0.25 or 1/4"
            )
        if key in row:
            raise ModelError(f"--belief gives {name}={value} twice")
        row[key] = Fraction(number)
    total = sum(row.values())
    if total != 1:
        raise ModelError(
            f"--belief: the probabilities of {name} sum to {str(total)[:60]}, not to 1; numbers are read "
            "exactly, and a third is 1/3"
        )
    return row


def assignments(text: str, option: str, form: str, model: Model) -> Iterator[tuple[Feature, str]]:
    """The parts of `x=3,y=on`: each feature, once, and what is written for it.

    Raises:
        ModelError: not of that form, an unknown feature, or one given twice.
    """
    if text.count('"') % 2:
        raise ModelError(f"{option} takes {form}; a quote is not closed in {text!r}")
    given = set[str]()
    for part in re.findall(r'(?:"[^"]*"|[^,"])+|^$', text):
        match = re.fullmatch(r'\s*("[^"]*"|[^"=]*?)\s*=\s*(.*?)\s*', part, re.DOTALL)
        if match is None:
            raise ModelError(f"{option} takes {form}, not {part!r}")
        name = match[1].strip('"')
        try:
            feature = model.feature(name)
        except KeyError as error:
            raise ModelError(str(error.args[0])) from None
        if name in given:
            raise ModelError(f"{option} gives {name} twice")
        given.add(name)
        yield feature, match[2]


def parse_value(name: str, values: Sequence[Value], text: str) -> Value:
    """The value of a feature or channel that a person wrote; in quotes it is a name.

    Raises:
        ModelError: there is none; the message lists those there are.
    """
    by_text: Mapping[str, Value]
    if re.fullmatch(r'"[^"]*"', text):
        text = text[1:-1]
        by_text = {v: v for v in values if isinstance(v, str)}
    else:
        by_text = value_texts(values)
    if text not in by_text:
        listed = ", ".join(list(by_text)[:20])
        raise ModelError(f"{name} has no value {text!r}; it has {listed}")
    return by_text[text]


def value_texts(values: Sequence[Value]) -> Mapping[str, Value]:
    """Values by the text a person writes for them; truth values and numbers before names like them."""
    ordered = sorted(values, key=lambda v: not isinstance(v, str))
    return {str(v).lower() if isinstance(v, bool) else str(v): v for v in ordered}
