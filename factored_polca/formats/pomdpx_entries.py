"""The tables of a written POMDPX file: one entry for each path of a decision tree.

`Walk.paths` decides the references of some functions f_1..f_k one after the other, as far as they matter,

    paths(f) = [((), f)]                                      nothing is left to decide
             = [((x = v, *p), g) for v, for (p, g) in paths(f restricted to x = v)]

so that a variable that makes no difference on a path is `*` in its entry; no table over all parents is
made.  A group of functions that says x_1 = x_0 for each feature of a variable is left whole: an identity.

Rows are exact where they have finite decimals, else rounded; they sum to exactly 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from typing import Final

from factored_polca.formats.decimals import number_text, row_texts
from factored_polca.formats.pomdpx_columns import Cluster, Column
from factored_polca.formats.spudd_model_trees import row_chances
from factored_polca.formats.spudd_rows import context
from factored_polca.formats.spudd_trees import Assignment, Forest
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import Expression, Reference
from factored_polca.models.features import Feature
from factored_polca.models.scalars import Value

MAXIMUM_ENTRIES: Final = 200_000
"""Entries of one file."""

Place = tuple[str, ...]


class TooManyEntries(Exception):
    """More than `MAXIMUM_ENTRIES`."""


@dataclass(frozen=True)
class Entry:
    """One entry: where it holds, and a row of chances or a number; None is the identity."""

    action: str  # a spelling, or `*`
    path: Assignment
    content: Sequence[Fraction] | Fraction | None


@dataclass
class Walk:
    """Decides functions of one forest; the paths of a file are counted."""

    forest: Forest
    count: int = 0

    def paths(
        self, functions: Sequence[Expression], keep: int = 0, whole: Sequence[Expression] = ()
    ) -> Iterator[tuple[Assignment, list[Expression]]]:
        """Paths and the functions at their ends, which mention references of the bits `keep` only.

        Raises:
            TooManyEntries: there are too many paths.
        """
        stack: list[tuple[Assignment, list[Expression]]] = [((), list(functions))]
        while stack:
            path, here = stack.pop()
            reference = None
            if not whole or any(f is not other for f, other in zip(here, whole, strict=True)):
                found = (self.forest.first_reference(f, keep) for f in here)
                reference = next((r for r in found if r is not None), None)
            if reference is None:
                self.count += 1
                if self.count > MAXIMUM_ENTRIES:
                    raise TooManyEntries
                yield path, here
                continue
            for value in reversed(self.forest.values_of(reference)):
                below = [self.forest.restrict(f, reference, value) for f in here]
                stack.append(((*path, (reference, value)), below))

    def row(
        self, function: Expression, name: str, values: tuple[Value, ...], path: Assignment, place: Place
    ) -> list[Fraction]:
        """The chances of `values` of the variable `name` under a function that mentions no reference.

        Raises:
            ModelError: it is no distribution.
        """
        try:
            return row_chances(function, values)
        except ValueError as problem:
            where = f" where {context(path)}" if path else ""
            raise ModelError([Fault(f"no distribution of {name}{where}: {problem}", place)]) from None

    def joint(
        self, order: Sequence[Feature], functions: dict[str, Expression], path: Assignment, place: Place
    ) -> dict[tuple[Value, ...], Fraction]:
        """The chances of joint next values, in the order of `functions`.

        `order` are the same features, each after those that it depends on.
        """
        result: dict[tuple[Value, ...], Fraction] = {}

        def visit(known: dict[str, Value], chance: Fraction, left: dict[str, Expression]) -> None:
            if not left:
                result[tuple(known[name] for name in functions)] = chance
                return
            feature = order[len(known)]
            row = self.row(left[feature.name], feature.name, feature.values, path, place)
            for value, share in zip(feature.values, row, strict=True):
                if share:
                    next_value = Reference(feature.name, primed=True)
                    rest = {
                        name: self.forest.restrict(f, next_value, value)
                        for name, f in left.items()
                        if name != feature.name
                    }
                    visit({**known, feature.name: value}, chance * share, rest)

        visit({}, Fraction(1), functions)
        return result


def cluster_entries(
    walk: Walk, cluster: Cluster, functions: dict[str, Expression], action: str, place: Place
) -> Iterator[tuple[Column, Entry]]:
    """The entries of a cluster's variables under one action, whose functions are by feature."""
    forest = walk.forest
    members = cluster.members
    keep = 0
    for feature in members:
        keep |= forest.bit(Reference(feature.name, primed=True))
    order = _order(forest, members, functions)
    listed = [functions[feature.name] for feature in members]
    whole = [forest.reference(Reference(feature.name)) for feature in members]
    for path, here in walk.paths(listed, keep, whole):
        if all(f is other for f, other in zip(here, whole, strict=True)):
            for column in cluster.columns:
                yield column, Entry(action, path, None)
            continue
        known = dict(zip((f.name for f in members), here, strict=True))
        chances = walk.joint(order, known, path, place)
        first = cluster.columns[0]
        size = len(first.members)
        head: dict[tuple[Value, ...], Fraction] = {}
        for joint, chance in chances.items():
            head[joint[:size]] = head.get(joint[:size], Fraction(0)) + chance
        yield first, Entry(action, path, [head.get(joint, Fraction(0)) for joint in first.joints])
        for column in cluster.columns[1:]:
            for seen in first.joints:
                given = tuple(
                    (Reference(f.name, True), v) for f, v in zip(first.members, seen, strict=True)
                )
                row = [chances.get((*seen, *joint), Fraction(0)) for joint in column.joints]
                total = sum(row, Fraction(0))
                row = [chance / total for chance in row] if total else _point(len(row))
                walk.count += 1
                yield column, Entry(action, (*path, *given), row)


def _point(size: int) -> list[Fraction]:
    return [Fraction(1), *[Fraction(0)] * (size - 1)]


def _order(forest: Forest, members: Sequence[Feature], functions: dict[str, Expression]) -> list[Feature]:
    """The features, each after those whose next values it depends on."""
    left, found = list(members), list[Feature]()
    while left:
        bits = sum(forest.bit(Reference(f.name, primed=True)) for f in left)
        ready = [f for f in left if not forest.support(functions[f.name]) & bits]
        assert ready, "checked models have no circles"
        found += ready
        left = [f for f in left if f not in ready]
    return found


# -- text ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Parent:
    """A variable that a function depends on: its spelling, its labels, and the references it stands for."""

    name: str
    references: tuple[Reference, ...]
    joints: Sequence[tuple[Value, ...]]
    labels: Sequence[str]

    def spelled(self, path: dict[Reference, Value]) -> list[str]:
        """The labels that agree with a path; `*` if it says nothing."""
        if not any(reference in path for reference in self.references):
            return ["*"]
        return [
            label
            for joint, label in zip(self.joints, self.labels, strict=True)
            if all(r not in path or _same(path[r], v) for r, v in zip(self.references, joint, strict=True))
        ]


def _same(one: Value, other: Value) -> bool:
    return isinstance(one, bool) is isinstance(other, bool) and one == other


def entry_lines(
    entry: Entry, parents: Sequence[Parent], labels: Sequence[str], own: str, table: str
) -> Iterator[str]:
    """The text of an entry; `own` is the parent that an identity copies, `table` the element of numbers."""
    path = dict(entry.path)
    for instance in product(*(parent.spelled(path) for parent in parents)):
        shown = " ".join((entry.action, *instance))
        if entry.content is None:
            marked = ["-" if p.name == own else word for p, word in zip(parents, instance, strict=True)]
            yield _entry(" ".join((entry.action, *marked, "-")), "identity", table)
        elif isinstance(entry.content, Fraction):
            yield _entry(shown, number_text(entry.content), table)
        else:
            positive = [k for k, chance in enumerate(entry.content) if chance]
            if 2 * len(positive) > len(labels):
                yield _entry(f"{shown} -", " ".join(row_texts(entry.content)), table)
            else:
                texts = row_texts([entry.content[k] for k in positive])
                for k, text in zip(positive, texts, strict=True):
                    yield _entry(f"{shown} {labels[k]}", text, table)


def _entry(instance: str, numbers: str, table: str) -> str:
    return f"<Entry><Instance>{instance.strip()}</Instance><{table}>{numbers}</{table}></Entry>"
