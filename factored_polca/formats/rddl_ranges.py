"""Which values terms can have, and so the finite ranges of integer fluents.

RDDL gives an int-fluent no range.  Its values are the least set R that holds its initial value and, with
all values of its parents in their sets, every value of its definition under every action:

    R_f = {initial value of f} united with the values of f' for parents in their R.

Sets are propagated through terms; below a condition on one fluent, such as x < 5, only the values that meet
it count; a term over few combinations of values is evaluated for each of them.  So R may have values that
no state reaches, but none is missing.  Where R grows past `MAXIMUM_VALUES`, the fluent has no range.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from factored_polca.formats.rddl_functions import NoValue, applied
from factored_polca.formats.rddl_terms import REFERENCES, Row, Term, Terms
from factored_polca.models.errors import ModelError
from factored_polca.models.scalars import Scalar, Undefined, apply_operator

MAXIMUM_VALUES: Final = 1_000
MAXIMUM_ROUNDS: Final = 2_000
_COMBINATIONS: Final = 2_000
_SET: Final = 5_000

Values = frozenset[Scalar]
Ranges = Mapping[tuple[str, str], Values]
"""(op, fluent) -> the values of that reference."""

_BOTH: Final[Values] = frozenset([False, True])


class Unbounded(Exception):
    """Too many values."""


@dataclass(frozen=True)
class Unknown:
    """An int-fluent whose range is looked for: its name, its first value and its definition."""

    name: str
    ops: tuple[str, ...]  # of the references that take its values
    first: Values
    law: Term


def closed(terms: Terms, ranges: Ranges, unknown: list[Unknown]) -> Ranges:
    """`ranges` with those of the unknown fluents.

    Raises:
        ModelError: one has no finite range, or values that are no integers.
    """
    found = dict(ranges)
    for fluent in unknown:
        found |= {(op, fluent.name): fluent.first for op in fluent.ops}
    looked_at: dict[str, Ranges] = {}
    for _ in range(MAXIMUM_ROUNDS):
        changed = False
        for fluent in unknown:
            before = found[fluent.ops[0], fluent.name]
            try:
                after = before | possible(terms, fluent.law, found, looked_at.get(fluent.name))
                looked_at[fluent.name] = dict(found)
            except Unbounded:
                raise _no_range(fluent.name) from None
            if len(after) > MAXIMUM_VALUES:
                raise _no_range(fluent.name)
            if any(not isinstance(value, Fraction) or value.denominator != 1 for value in after):
                raise ModelError(f"the int-fluent {fluent.name} takes values that are no integers")
            if after != before:
                changed = True
                found |= {(op, fluent.name): after for op in fluent.ops}
        if not changed:
            for fluent in unknown:
                if not found[fluent.ops[0], fluent.name]:
                    raise _no_range(fluent.name)
            return found
    raise _no_range(unknown[0].name)


def _no_range(name: str) -> ModelError:
    return ModelError(
        f"no finite range can be derived for the int-fluent {name}: bound it in its definition, such as "
        "max[0, min[9, ...]]"
    )


def possible(terms: Terms, root: Term, ranges: Ranges, before: Ranges | None = None) -> Values:
    """The values that a term can have, at least; few combinations of its parents' values are all tried.

    Combinations from `before`, whose ranges are smaller, may be left out.

    Raises:
        Unbounded: too many.
    """
    needed = sorted(terms.mentioned([root]))
    sizes = [len(ranges[reference]) for reference in needed]
    if math.prod(sizes) > _COMBINATIONS:
        return spread(terms, root, ranges)
    result: set[Scalar] = set()
    smaller = None if before is None else [before[r] for r in needed]
    for chosen in _combinations([ranges[r] for r in needed], smaller):
        single = {r: frozenset([value]) for r, value in zip(needed, chosen, strict=True)}
        result |= spread(terms, root, single)
    return frozenset(result)


def _combinations(sets: list[Values], before: list[Values] | None) -> Iterator[tuple[Scalar, ...]]:
    """The combinations of values, those of the smaller sets left out: by the first that has a new value."""
    if before is None:
        yield from itertools.product(*sets)
        return
    for i in range(len(sets)):
        yield from itertools.product(*before[:i], sets[i] - before[i], *sets[i + 1 :])


def spread(terms: Terms, root: Term, ranges: Ranges) -> Values:
    """The values that a term can have, at least, by propagating sets; conditions narrow their branches.

    Raises:
        Unbounded: too many.
    """
    memo: dict[Term, Values] = {}
    for part in terms.parts_first([root], lambda row: row.op != "if"):
        row = terms[part]
        parts = [memo[p] if p in memo else _branches(terms, terms[p], ranges) for p in row.parts]
        memo[part] = _set(row, parts, ranges)
    return memo[root] if root in memo else _branches(terms, terms[root], ranges)


def _branches(terms: Terms, row: Row, ranges: Ranges) -> Values:
    condition, then, otherwise = row.parts
    met = spread(terms, condition, ranges)
    result = frozenset[Scalar]()
    for branch, truth in ((then, True), (otherwise, False)):
        if truth in met:
            narrowed = _narrowed(terms, condition, truth, ranges)
            if narrowed is not None:
                result |= spread(terms, branch, narrowed)
    return result


def _narrowed(terms: Terms, condition: Term, truth: bool, ranges: Ranges) -> Ranges | None:
    """`ranges` where a condition has that truth value, as far as it is about one fluent; None: nowhere."""
    row = terms[condition]
    if row.op == "not":
        return _narrowed(terms, row.parts[0], not truth, ranges)
    if row.op == ("and" if truth else "or"):
        for part in row.parts:
            found = _narrowed(terms, part, truth, ranges)
            if found is None:
                return None
            ranges = found
        return ranges
    about = terms.mentioned([condition])
    if len(about) != 1:
        return ranges
    (reference,) = about
    kept = frozenset(
        value
        for value in ranges[reference]
        if truth in spread(terms, condition, {**ranges, reference: frozenset([value])})
    )
    return {**ranges, reference: kept} if kept else None


def _set(row: Row, parts: list[Values], ranges: Ranges) -> Values:
    match row.op:
        case "constant":
            return frozenset([row.data])
        case "undefined":
            return frozenset()
        case "bernoulli":
            return _BOTH
        case "discrete":
            return frozenset(row.data)
        case "and" | "or":
            decides = row.op == "or"
            some = any(decides in part for part in parts)
            every = all((not decides) in part for part in parts)
            return frozenset(v for v, can in ((decides, some), (not decides, every)) if can)
        case "not":
            return frozenset(not value for value in parts[0])
        case "indicator":
            return frozenset(Fraction(int(bool(value))) for value in parts[0])
        case "add" | "multiply" | "minimum" | "maximum":
            found = parts[0]
            for part in parts[1:]:
                found = _applied(row, [found, part])
            return found
    return ranges[row.op, row.data] if row.op in REFERENCES else _applied(row, parts)


def _applied(row: Row, parts: list[Values]) -> Values:
    if math.prod(map(len, parts)) > _SET * 40:
        raise Unbounded
    found: set[Scalar] = set()
    for chosen in itertools.product(*parts):
        if row.op == "function":
            try:
                found.add(applied(row.data, [Fraction(value) for value in chosen]).value)
            except NoValue:
                continue
        else:
            value = apply_operator(row.op, chosen)
            if not isinstance(value, Undefined):
                found.add(value)
    if len(found) > _SET:
        raise Unbounded
    return frozenset(found)
