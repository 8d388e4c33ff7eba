"""The initial belief of a written POMDPX file: each variable's chances, given others at the start.

A product of conditional distributions over variables that are features is written as it is, if no observed
one depends on a hidden one.  Otherwise the belief is a product M of functions, and for the variables
c_1..c_m that M connects, observed ones first,

    P(c_k | c_1..c_(k-1)) = M_k / M_(k-1),    M_m = M,   M_(k-1) = sum of M_k over c_k.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction
from functools import partial

from factored_polca.formats.pomdpx_columns import Column
from factored_polca.formats.pomdpx_entries import Entry, Walk
from factored_polca.formats.spudd_rows import context
from factored_polca.formats.spudd_trees import Assignment, Forest
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import Constant, Expression, Reference
from factored_polca.models.model import Model, uniform

Found = Iterator[tuple[Column, list[Entry]]]


def belief_entries(walk: Walk, model: Model, columns: Sequence[Column]) -> Found:
    """The entries of each column.

    Raises:
        ModelError: something that is no distribution, or has no positive weight.
    """
    given = dict(model.initial.distributions)
    parameters = dict(model.parameters)
    if not model.initial.factors:
        given = {f.name: given.get(f.name, uniform(f)) for f in model.features}
    functions = {name: walk.forest.adopt(e, parameters) for name, e in given.items()}
    hidden = sum(walk.forest.bit(Reference(f.name)) for f in model.features if not f.observed)
    plain = not any(
        walk.forest.support(function) & hidden
        for name, function in functions.items()
        if model.feature(name).observed
    )
    if plain and not model.initial.factors and all(len(column.members) == 1 for column in columns):
        for column in columns:
            feature = column.members[0]
            entries = []
            for path, (rest,) in walk.paths([functions[feature.name]]):
                row = walk.row(rest, feature.name, feature.values, path, ("initial", feature.name))
                entries.append(Entry("", path, row))
            yield column, entries
        return
    factors = [_weights(walk, model, name, function) for name, function in functions.items()]
    factors += [walk.forest.adopt(e, parameters) for e in model.initial.factors]
    yield from _chains(walk, columns, factors)


def _weights(walk: Walk, model: Model, name: str, function: Expression) -> Expression:
    """A conditional distribution as a function of its parents and of the feature itself."""
    forest, values, reference = walk.forest, model.feature(name).values, Reference(name)

    def leaf(rest: Expression, path: Assignment) -> Expression:
        row = walk.row(rest, name, values, path, ("initial", name))
        return forest.switch(reference, [forest.constant(chance) for chance in row])

    return forest.limited(lambda: forest.expand(function, leaf))


def _chains(walk: Walk, columns: Sequence[Column], factors: Sequence[Expression]) -> Found:
    forest = walk.forest
    columns = sorted(columns, key=lambda column: not column.observed)
    bits = [sum(forest.bit(Reference(f.name)) for f in column.members) for column in columns]
    groups = list(bits)
    for factor in factors:
        touched = [group for group in groups if group & forest.support(factor)]
        joined = 0
        for group in touched:
            joined |= group
        groups = [*(group for group in groups if group not in touched), *([joined] if joined else [])]
    for group in groups:
        mine = [column for column, bit in zip(columns, bits, strict=True) if bit & group]
        parts = [factor for factor in factors if forest.support(factor) & group]
        parts = parts or [forest.constant(Fraction(1))]
        whole = forest.operation("multiply", parts) if len(parts) > 1 else parts[0]
        yield from _chain(walk, mine, _numbers(forest, whole))


def _chain(walk: Walk, columns: Sequence[Column], whole: Expression) -> Found:
    forest = walk.forest
    for column in reversed(columns):
        parts = []
        for joint in column.joints:
            part = whole
            for feature, value in zip(column.members, joint, strict=True):
                part = forest.restrict(part, Reference(feature.name), value)
            parts.append(part)
        entries = []
        for path, here in walk.paths(parts):
            row = [_number(e) for e in here]
            total = sum(row, Fraction(0))
            if not total:  # a context without weight
                row = [Fraction(k == 0) for k in range(len(row))]
            entries.append(Entry("", path, [weight / (total or 1) for weight in row]))
        yield column, entries
        whole = _numbers(forest, forest.operation("add", parts) if len(parts) > 1 else parts[0])
    if _number(whole) == 0:
        raise ModelError([Fault("the initial belief has no positive weight", ("initial",))])


def _numbers(forest: Forest, function: Expression) -> Expression:
    """`function` as a decision graph with numbers at its ends."""

    def leaf(rest: Expression, path: Assignment) -> Expression:
        if not (isinstance(rest, Constant) and isinstance(rest.value, Fraction)) or rest.value < 0:
            where = f" where {context(path)}" if path else ""
            raise ModelError([Fault(f"a weight of the initial belief is no number from 0 on{where}",
                                    ("initial",))])  # fmt: skip
        return rest

    return forest.limited(partial(forest.expand, function, leaf))


def _number(e: Expression) -> Fraction:
    assert isinstance(e, Constant)
    assert isinstance(e.value, Fraction)
    return e.value
