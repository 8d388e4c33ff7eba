"""What a person answers in a dialogue: values of channels and of observed features, short or in full.

`Speech=yes` names the channel; `yes` alone will do where one channel, or observed feature, has that value.
What is left out is what alone is possible, else a channel reports its null value (`none`); `ended` says
that the episode has ended.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from factored_polca.cli.source import value_texts
from factored_polca.control.answers import Answer
from factored_polca.control.received import ObservationReader, shown
from factored_polca.models import Value

ENDED = "ended"

Possible: TypeAlias = Callable[[], Sequence[Answer] | None]


class Misread(ValueError):
    """An answer that can't be read, or that leaves something open; the message says what is allowed."""


@dataclass(frozen=True)
class Asked:
    """What is asked: the values of what the action (-1: none yet) senses and of what is seen, by name.

    `ending` says whether the episode may end, `others` are the channels that the action does not sense.
    """

    action: int
    values: Mapping[str, tuple[Value, ...]]
    nulls: Mapping[str, Value]
    others: Mapping[str, tuple[Value, ...]]
    ending: bool


@dataclass(frozen=True)
class Reply:
    """What was observed; `known` is its probability where the values left open are summed over."""

    observation: dict[str, Value]
    ended: bool
    known: float | None = None


def asked_after(reader: ObservationReader, action: int, ending: bool) -> Asked:
    """What is asked after an action, or at the start (-1)."""
    model = reader.model
    sensed = [model.observations[j] for j in reader.sensed[action]] if action >= 0 else []
    names = {channel.name for channel in sensed}
    features = [model.features[i] for i in reader.observed]
    return Asked(
        action,
        {c.name: c.values for c in sensed} | {f.name: f.values for f in features},
        {c.name: c.null for c in sensed if c.null is not None and c.null in c.values},
        {c.name: c.values for c in model.observations if action >= 0 and c.name not in names},
        ending,
    )


def read_reply(text: str, asked: Asked, possible: Possible) -> Reply:
    """What a line says was observed.

    `possible` lists what may be; it is asked only where something is left out.

    Raises:
        Misread: an unknown name or value, one given twice, or something left open.
    """
    given, ended = parse(text, asked)
    missing = [name for name in asked.values if name not in given]
    if not missing:
        return Reply(given, ended)
    listed = possible()
    if listed is None:
        return Reply({**{n: asked.nulls[n] for n in missing if n in asked.nulls}, **given}, ended)
    if not ended and listed and all(answer.ended for answer in listed):
        ended = True
    fitting = [a for a in listed if a.ended == ended and agrees(a, given)]
    if ended and fitting:
        return Reply({**fitting[0].observation, **given}, True, sum(a.probability for a in fitting))
    if len(fitting) == 1:
        return Reply({**fitting[0].observation, **given}, ended)
    filled = {**{name: asked.nulls[name] for name in missing if name in asked.nulls}, **given}
    if not fitting:
        raise Misread(
            "that is impossible from this belief, whatever else was observed; ? lists what may be"
        )
    quiet = [a for a in fitting if agrees(a, filled)]
    if len(quiet) == 1:
        return Reply({**quiet[0].observation, **filled}, ended)
    still = [n for n in missing if len({shown(a.observation[n]) for a in quiet or fitting}) > 1]
    raise Misread(f"a value is needed for {allowed(asked, still)}")


def agrees(answer: Answer, given: Mapping[str, Value]) -> bool:
    """Whether what may be observed has the values given."""
    pairs = (
        (answer.observation[name], value) for name, value in given.items() if name in answer.observation
    )
    return all(type(a) is type(b) and a == b for a, b in pairs)


def parse(text: str, asked: Asked) -> tuple[dict[str, Value], bool]:
    """The values that a line gives, by name, and whether it says that the episode has ended.

    Raises:
        Misread: as in `read_reply`.
    """
    if text.count('"') % 2:
        raise Misread("a quote is not closed")
    given, ended, plain = dict[str, Value](), False, list[str]()
    for word in re.findall(r'(?:"[^"]*"|[^\s,"])+', re.sub(r"\s*=\s*", "=", text)):
        match = re.fullmatch(r'("[^"]*"|[^"=]*)=(.*)', word)
        if match is None:
            plain.append(word)
            continue
        name = channel_name(match[1], asked)
        values = asked.values.get(name, asked.others.get(name))
        if values is None:
            raise Misread(f"{name!r} is not observed here; what is: {allowed(asked)}")
        put(given, name, value_of(name, values, match[2]))
    for word in plain:
        found = [
            (name, value)
            for name, values in asked.values.items()
            if name not in given and (value := find(values, word)) is not None
        ]
        if len(found) > 1:
            choices = " or ".join(f"{name}={shown(value)}" for name, value in found)
            raise Misread(f"{word!r} may be {choices}: say which")
        if found:
            put(given, *found[0])
        elif word.casefold() == ENDED and asked.ending:
            ended = True
        elif word.casefold() == ENDED:
            raise Misread("no episode of this model ever ends; quit leaves the dialogue")
        else:
            raise Misread(f"{word!r} is not observed here; what is: {allowed(asked)}")
    return given, ended


def channel_name(text: str, asked: Asked) -> str:
    """The name that is written so, capitals aside where that leaves no doubt."""
    names = [*asked.values, *asked.others]
    if text.startswith('"') or text in names:
        return text.strip('"')
    alike = [name for name in names if name.casefold() == text.casefold()]
    return alike[0] if len(alike) == 1 else text


def put(given: dict[str, Value], name: str, value: Value) -> None:
    """Note a value.

    Raises:
        Misread: there is one already.
    """
    if name in given:
        raise Misread(f"{name} is given twice")
    given[name] = value


def find(values: Sequence[Value], text: str) -> Value | None:
    """The value that is written so, capitals aside where that leaves no doubt."""
    if re.fullmatch('"[^"]*"', text):
        text = text[1:-1]
        texts: Mapping[str, Value] = {v: v for v in values if isinstance(v, str)}
    else:
        texts = value_texts(values)
    if text in texts:
        return texts[text]
    alike = [value for other, value in texts.items() if other.casefold() == text.casefold()]
    return alike[0] if len(alike) == 1 else None


def value_of(name: str, values: Sequence[Value], text: str) -> Value:
    """The value of a channel or feature.

    Raises:
        Misread: it has none such; the message lists those it has.
    """
    value = find(values, text)
    if value is None:
        raise Misread(f"{name} has no value {text!r}; it has {listing(values)}")
    return value


def listing(values: Sequence[Value]) -> str:
    """Values, the first twenty."""
    return ", ".join(map(shown, values[:20])) + (", ..." if len(values) > 20 else "")


def allowed(asked: Asked, names: Sequence[str] | None = None) -> str:
    """What can be answered."""
    told = [
        f"{name} ({listing(values)})"
        for name, values in asked.values.items()
        if names is None or name in names
    ]
    if asked.ending and names is None:
        told.append(ENDED)
    return ", ".join(told) or "nothing: press Enter"
