"""Updates that would take a variable out of its range, where only states that are never reached allow it.

PRISM and Storm refuse a program that *reaches* a state where an enabled command takes a variable out of
its bounds; a guard such as `busy` may well allow it elsewhere, at a count that goes with `busy` never.
Here an action is defined at every state. So a command is taken as not enabled where one of its outcomes
of positive probability would leave the bounds:

    guard and not (p_k > 0 and (f_k < low or f_k > high)) for each outcome k and update x' = f_k

which changes nothing for programs that PRISM takes. Commands that this changes are told, as a warning.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from fractions import Fraction

from factored_polca.formats.prism_expressions import logical
from factored_polca.formats.prism_guards import Guards
from factored_polca.formats.prism_program import Command
from factored_polca.models.errors import Fault
from factored_polca.models.expressions import (
    ZERO,
    Constant,
    Expression,
    Parameter,
    Reference,
    conjunction,
    operation,
)
from factored_polca.models.features import Feature
from factored_polca.models.scalars import scalar


def inside_bounds(
    command: Command, features: Mapping[str, Feature], guards: Guards
) -> tuple[Command, Fault | None]:
    """The command where none of its updates leaves a variable's bounds, and a warning if that is less."""
    excluded: dict[Expression, str] = {}
    for chance, name, value in _updates(command):
        for beyond in _beyond(value, features[name]):
            happens = beyond if _is_positive(chance) else _both(operation("greater", chance, ZERO), beyond)
            if happens not in excluded and guards.satisfiable(conjunction([command.guard, happens])):
                excluded[happens] = name
    if not excluded:
        return command, None
    guard = logical("and", [command.guard, *(logical("not", [e]) for e in excluded)])
    line, column = command.place
    names = ", ".join(dict.fromkeys(excluded.values()))
    warning = Fault(
        f"the command is taken as not enabled where it would take {names} out of its range",
        hint="PRISM refuses a program that reaches such a state; a guard that excludes it says so",
        line=line, column=column, severity="warning",
    )  # fmt: skip
    return replace(command, guard=guard), warning


def _both(a: Expression, b: Expression) -> Expression:
    return logical("and", [a, b])


def _updates(command: Command) -> Iterator[tuple[Expression, str, Expression]]:
    for chance, updates in command.outcomes:
        for name, value in updates:
            if chance != ZERO:
                yield chance, name, value


def _is_positive(chance: Expression) -> bool:
    if isinstance(chance, Constant):
        return isinstance(chance.value, Fraction) and chance.value > 0
    return isinstance(chance, Parameter)


def _beyond(value: Expression, feature: Feature) -> Iterator[Expression]:
    """The conditions that a next value is below the bounds, and above."""
    first, last = feature.values[0], feature.values[-1]
    if isinstance(first, bool) or value == Reference(feature.name):
        return
    yield operation("less", value, Constant(scalar(first)))
    yield operation("greater", value, Constant(scalar(last)))
