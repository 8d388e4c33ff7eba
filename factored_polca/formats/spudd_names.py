"""Names that SPUDD's language can spell.

SPUDD spells names with letters, digits and `_`, not beginning with a digit; Symbolic Perseus also
allows `-` and `.` inside.  Integers become `v0`, `v_1` (for -1), truth values `true` and `false`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import count
from typing import Final

from factored_polca.formats.spudd_reader import RESERVED
from factored_polca.models.features import Feature
from factored_polca.models.model import Model, Observation
from factored_polca.models.scalars import Value, describe, scalar

_FULL: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_PARTIAL: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_.\-]*\Z")
_LENGTH: Final = 100
_TAKEN: Final = RESERVED | {"belief", "endbelief", "obsdd", "value", "adjunct", "debugon", "debugoff"}


@dataclass(frozen=True)
class Names:
    """How the file spells variables, values and actions, and which spellings are new."""

    variables: dict[str, str]
    values: dict[str, tuple[str, ...]]  # by variable, in the order of its values
    actions: dict[str, str]
    changed: tuple[str, ...]
    taken: frozenset[str]  # spellings that name a variable or an implicit tree

    def of_trees(self) -> Iterator[str]:
        """Names for shared trees, different from each other and from all others."""
        return (name for number in count(1) if (name := f"shared{number}") not in self.taken)


def spell(model: Model) -> Names:
    """The names of `model` as the file spells them."""
    pattern = _FULL if model.observability == "full" else _PARTIAL
    changed: list[str] = []
    variables: list[Feature | Observation] = [*model.features, *model.observations]
    spelled = _distinct([v.name for v in variables], pattern, set(_TAKEN))
    values: dict[str, tuple[str, ...]] = {}
    taken: set[str] = set(spelled.values())
    for variable in variables:
        name = spelled[variable.name]
        wanted = [_value_name(value) for value in variable.values]
        values[variable.name] = tuple(distinct_names(wanted, pattern, set(_TAKEN)))
        taken |= {f"SAME{name}", *(f"{name}{value}" for value in values[variable.name])}
        if name != variable.name:
            changed.append(f"{variable.name} is {name}")
        pairs = zip(variable.values, values[variable.name], strict=True)
        new = [f"{describe(scalar(old))} is {text}" for old, text in pairs if describe(scalar(old)) != text]
        if new:
            changed.append(f"values of {name}: {', '.join(new)}")
    actions = _distinct([action.name for action in model.actions], pattern, set(_TAKEN))
    changed += [f"action {old} is {text}" for old, text in actions.items() if old != text]
    return Names(spelled, values, actions, tuple(changed), frozenset(taken))


def _value_name(value: Value) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"v{value}" if value >= 0 else f"v_{-value}"
    return value


def _distinct(wanted: Iterable[str], pattern: re.Pattern[str], taken: set[str]) -> dict[str, str]:
    names = list(wanted)
    return dict(zip(names, distinct_names(names, pattern, taken), strict=True))


def distinct_names(wanted: list[str], pattern: re.Pattern[str], taken: set[str]) -> list[str]:
    """Spellings of `wanted`; those that are fine as they are come first, so that they stay."""
    fine = [len(name) <= _LENGTH and bool(pattern.match(name)) and name not in taken for name in wanted]
    used = taken | {name for name, good in zip(wanted, fine, strict=True) if good}
    seen: set[str] = set()
    found: list[str] = []
    for name, good in zip(wanted, fine, strict=True):
        if good and name not in seen:
            seen.add(name)
            found.append(name)
            continue
        base = re.sub(r"[^A-Za-z0-9_]", "_", name)[:_LENGTH] or "_"
        base = base if not base[0].isdigit() else f"v{base}"
        text, number = base, 1
        while text in used:
            number += 1
            text = f"{base}_{number}"
        used.add(text)
        found.append(text)
    return found
