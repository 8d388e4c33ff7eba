"""What comes in after an action: values by name, read as numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from factored_polca.models import ModelError, Value
from factored_polca.models.features import position
from factored_polca.models.scalars import describe, scalar
from factored_polca.symbolic import SymbolicModel


@dataclass(frozen=True)
class Received:
    """What came in after an action, as numbers; `action` is -1 at the start of an episode.

    `values` are those of the channels that the action senses, in ascending order of the channels;
    `seen` those of the observed features.  `stray` tells of a value of a channel that it does not sense.
    """

    action: int
    values: tuple[int, ...]
    seen: tuple[int, ...]
    ended: bool
    stray: str = ""


class ObservationReader:
    """Reads observations given by names.

    `sensed[a]` are the numbers of the channels that action a senses, ascending; `observed` those of the
    observed features.
    """

    def __init__(self, symbolic: SymbolicModel) -> None:
        model = symbolic.model
        self.model = model
        self.sensed = [tuple(sorted(action.observations)) for action in symbolic.actions]
        self.observed = tuple(i for i, feature in enumerate(model.features) if feature.observed)
        self._channels = {channel.name: number for number, channel in enumerate(model.observations)}
        self._seen = {model.features[i].name for i in self.observed}

    def read(self, action: int, observation: Mapping[str, Value], ended: bool) -> Received:
        """What came in after an action (-1: at the start).

        Raises:
            ModelError: no such action, an unknown name or value, or a missing one.
        """
        model = self.model
        if not -1 <= action < len(model.actions):
            names = ", ".join(f"{i} {a.name}" for i, a in enumerate(model.actions))
            raise ModelError(f"no action number {action}; there are {names}")
        sensed = self.sensed[action] if action >= 0 else ()
        allowed = self._channels if action >= 0 else {}
        for name in observation:
            if name not in allowed and name not in self._seen:
                listed = ", ".join([*allowed, *sorted(self._seen)]) or "nothing"
                raise ModelError(f"{name!r} is not observed here; what is: {listed}")
        channels = [model.observations[j] for j in sensed]
        features = [model.features[i] for i in self.observed]
        needed = [*(c.name for c in channels), *(f.name for f in features)]
        missing = [name for name in needed if name not in observation]
        if missing:
            when = f"after action {model.actions[action].name!r}" if action >= 0 else "at the start"
            raise ModelError(f"{when} a value is needed for {', '.join(missing)}")
        values = tuple(value_number(c.name, c.values, observation[c.name]) for c in channels)
        seen = tuple(value_number(f.name, f.values, observation[f.name]) for f in features)
        stray = self._stray(action, observation) if len(observation) > len(values) + len(seen) else ""
        return Received(action, values, seen, ended, stray)

    def _stray(self, action: int, observation: Mapping[str, Value]) -> str:
        for name, number in self._channels.items():
            if name not in observation or number in self.sensed[action]:
                continue
            channel = self.model.observations[number]
            value = value_number(name, channel.values, observation[name])
            if value != position(channel.values, channel.null):
                return (
                    f"{name}={shown(observation[name])} is impossible after action "
                    f"{self.model.actions[action].name!r}: it does not sense {name}, which then reports "
                    f"{shown(channel.null)}"
                )
        return ""


def value_number(name: str, values: tuple[Value, ...], value: Value) -> int:
    """The number of a value of the feature or channel `name`.

    Raises:
        ModelError: it has no such value; the message lists those it has.
    """
    number = position(values, value)
    if number is None:
        listed = ", ".join(shown(v) for v in values[:20])
        raise ModelError(f"{name} has no value {shown(value)}; it has {listed}")
    return number


def shown(value: Value) -> str:
    """A value as a person would write it."""
    return describe(scalar(value))
