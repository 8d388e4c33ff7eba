"""Joint actions: which action-fluents differ from their defaults, and to what.

At most `max-nondef-actions` fluents may; every such combination is one action of the model, `noop` the one
where none does.  There are sum over k of (choices of k fluents) (non-default values), counted before
any is made, and refused where there are too many.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from factored_polca.formats.rddl_ranges import Ranges, Unbounded, Values, spread
from factored_polca.formats.rddl_terms import Row, Term, Terms
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.scalars import Scalar, describe

MAXIMUM_ACTIONS: Final = 10_000

Joint = Mapping[str, Scalar]
"""The action-fluents that differ from their defaults."""


@dataclass(frozen=True, slots=True)
class ActionFluent:
    """A ground action-fluent; `values` has the default first."""

    name: str
    kind: str
    values: tuple[Scalar, ...]


def count(fluents: Sequence[ActionFluent], concurrent: int) -> int:
    """How many joint actions there are: the first coefficients of prod (1 + m_i z)."""
    coefficients = [1]
    for fluent in fluents:
        others = len(fluent.values) - 1
        longer = [*coefficients, 0]
        for k, number in enumerate(coefficients):
            longer[k + 1] += number * others
        coefficients = longer[: concurrent + 1]
    return sum(coefficients)


def joint_actions(
    terms: Terms, fluents: Sequence[ActionFluent], concurrent: int | None, conditions: Sequence[Term]
) -> list[Joint]:
    """All joint actions that the conditions allow, those with few non-default fluents first.

    Conditions that mention no state are looked at while the combinations are made: what they exclude
    whatever follows is not gone into.

    Raises:
        ModelError: too many; names how many.
    """
    most = len(fluents) if concurrent is None else min(concurrent, len(fluents))
    total = count(fluents, most)
    about = [c for c in conditions if all(op == "act" for op, _ in terms.mentioned([c]))]
    said = "no max-nondef-actions" if concurrent is None else f"max-nondef-actions = {concurrent}"
    if total > MAXIMUM_ACTIONS and not about:
        raise _too_many(f"{said} and {len(fluents)} action-fluents make {total:,} joint actions")
    found: list[Joint] = []
    for looked, joint in enumerate(_joint(terms, fluents, most, about)):
        if joint is not None:
            found.append(joint)
        if max(len(found), looked // 10) >= MAXIMUM_ACTIONS and total > MAXIMUM_ACTIONS:
            raise _too_many(
                f"{said} and {len(fluents)} action-fluents make {total:,} joint actions, and what is asked "
                f"of actions leaves {len(found):,} of the first {looked + 1:,}"
            )
    return sorted(found, key=len)


def _too_many(message: str) -> ModelError:
    hint = "lower max-nondef-actions in the instance"
    return ModelError([Fault(f"{message}; at most {MAXIMUM_ACTIONS:,} are listed", hint=hint)])


def _joint(
    terms: Terms, fluents: Sequence[ActionFluent], most: int, about: Sequence[Term]
) -> Iterator[Joint | None]:
    """Combinations that may be allowed; None for one that is not, with all that extend it."""
    every: dict[tuple[str, str], Values] = {("act", f.name): frozenset(f.values) for f in fluents}
    first = {("act", f.name): frozenset(f.values[:1]) for f in fluents}
    work: list[tuple[int, dict[str, Scalar]]] = [(0, {})]
    while work:
        start, joint = work.pop()
        if about:
            chosen = {("act", name): frozenset([value]) for name, value in joint.items()}
            if not _can_hold(
                terms, about, {**every, **dict(itertools.islice(first.items(), start)), **chosen}
            ):
                yield None
                continue
        yield joint
        if len(joint) < most:
            for index in range(len(fluents) - 1, start - 1, -1):
                fluent = fluents[index]
                work += [(index + 1, {**joint, fluent.name: value}) for value in fluent.values[:0:-1]]


def _can_hold(terms: Terms, conditions: Sequence[Term], ranges: Ranges) -> bool:
    try:
        return all(True in spread(terms, condition, ranges) for condition in conditions)
    except Unbounded:
        return True


def joint_name(joint: Joint) -> str:
    """`noop`, `move(r1)`, `~hold(a) + dir=north`."""
    return " + ".join(_part(name, value) for name, value in joint.items()) or "noop"


def _part(name: str, value: Scalar) -> str:
    if isinstance(value, bool):
        return name if value else f"~{name}"
    return f"{name}={describe(value)}"


def integer_values(
    terms: Terms, name: str, default: Fraction, conditions: Sequence[Term], largest: int
) -> tuple[Scalar, ...]:
    """The values of an int action-fluent: those that the preconditions about it alone allow.

    Raises:
        ModelError: they do not bound it from both sides, or allow too many values.
    """
    about = [c for c in conditions if terms.mentioned([c]) == {("act", name)}]
    low, high = _bounds(terms, about)
    if low is None or high is None or high - low >= largest:
        raise ModelError(
            f"the int action-fluent {name} has no finite range: bound it in action-preconditions, such as "
            f"{name} >= 0 and {name} <= 9"
        )
    allowed = [Fraction(v) for v in range(low, high + 1) if _holds(terms, about, name, Fraction(v))]
    return (default, *(value for value in allowed if value != default))


def _bounds(terms: Terms, conditions: Sequence[Term]) -> tuple[int | None, int | None]:
    low: int | None = None
    high: int | None = None
    for condition in conditions:
        row = terms[condition]
        negated = row.op == "not"
        row = terms[row.parts[0]] if negated else row
        if row.op not in ("less", "less_equal"):
            continue
        bound = _bound(terms, row, negated)
        if bound is None:
            continue
        if bound[0]:
            low = bound[1] if low is None else max(low, bound[1])
        else:
            high = bound[1] if high is None else min(high, bound[1])
    return low, high


def _bound(terms: Terms, row: Row, negated: bool) -> tuple[bool, int] | None:
    """(whether it is a lower bound, the whole number that is allowed last) of a comparison."""
    left, right = row.parts
    value = terms.value(right)
    reference, lower = (left, negated) if value is not None else (right, not negated)
    value = terms.value(left) if value is None else value
    if value is None or terms[reference].op != "act":
        return None
    strict = (row.op == "less") is not negated
    number = Fraction(value)
    whole = -((-number) // 1) if lower else number // 1
    if strict and whole == number:
        whole += 1 if lower else -1
    return lower, int(whole)


def _holds(terms: Terms, conditions: Sequence[Term], name: str, value: Fraction) -> bool:
    leaves = {name: terms.number(value)}
    return all(terms.value(terms.replaced(c, leaves, "act")) is True for c in conditions)
