"""Snapping: a model whose rows of probabilities and rewards within epsilon of each other are one.

Each conditional distribution P_a(x_i' | parents), and each P_a(o_j | x', x), is a diagram from its parents
to the number of a row.  Two things are done to it, both exact:

1. *drop parents*: where the rows that differ only in the value of one parent have a common representative
   in every context of the others, that parent goes;
2. *share rows*: rows left are replaced by as few representatives as are found, the same for a feature in
   all actions.

In both every row stays within total variation epsilon of the one it replaces
(`factored_polca.approximation.representatives`).  An effect that becomes "stays as it is" is dropped, and
the feature persists.  A reward term is treated likewise: its values are moved by no more than

    epsilon (1 - gamma) (largest - least value of the term),

so that moving them costs at most epsilon times that difference in value, for ever.  Terminal states,
applicability and the initial belief are left as they are.

Why this makes blocks fewer: the exact minimiser then merges the states that only small differences of
probability had told apart (Dean, Givan & Leach 1997, "Model reduction techniques for computing
approximately optimal solutions for Markov decision processes", merge states within epsilon instead; theirs
is a partition of states, ours a model, so that all exact machinery applies to it).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, TypeVar

import numpy as np

from factored_polca.approximation.representatives import Representatives, cover, sure
from factored_polca.diagrams import INDEX, Diagram, cofactors, combine, leaves, relabel, support
from factored_polca.minimisation import DecisionProcess
from factored_polca.models import Fault, ModelError
from factored_polca.symbolic import RowDiagram, SymbolicAction, SymbolicModel, Term
from factored_polca.symbolic.rows import Row
from factored_polca.symbolic.variants import fresh_variant

Key = TypeVar("Key", bound=Hashable)
Sets = tuple[Diagram, list[frozenset[Any]]]
"""A diagram to numbers of sets of what stands there, and the sets."""


@dataclass(frozen=True)
class Snapped:
    """A model and what became of it.

    `symbolic` is the snapped model, over the manager of `original`.  `changed` counts the rows that were
    replaced, `rows_before` and `rows_after` the distinct rows of all features and channels, `parents` the
    parents dropped, by effect.
    """

    original: SymbolicModel
    symbolic: SymbolicModel
    epsilon: Fraction
    changed: int
    rows_before: int
    rows_after: int
    parents: int
    _terms: dict[int, tuple[Term, Term]] = field(default_factory=dict, repr=False)

    def process(self, process: DecisionProcess) -> DecisionProcess:
        """A decision process of the original as one of the snapped model: choices and masks the same."""
        rewards = {p: tuple(self.term(t) for t in terms) for p, terms in process.rewards.items()}
        return replace(process, symbolic=self.symbolic, rewards=rewards)

    def term(self, term: Term) -> Term:
        """A reward term with its near values merged."""
        key = id(term.diagram)
        if key not in self._terms:
            self._terms[key] = (term, self._snapped_term(term))
        return self._terms[key][1]

    def _snapped_term(self, term: Term) -> Term:
        used = [term.values[int(leaf)] for leaf in leaves(term.diagram)]
        radius = self.epsilon * (1 - self.original.model.discount) * (max(used) - min(used))
        if not radius:
            return term
        values = term.values

        def fits(numbers: frozenset[int]) -> bool:
            there = [values[n] for n in numbers]
            return max(there) - min(there) <= 2 * radius

        diagram, sets, _ = drop_parents(term.diagram, fits)
        middles = [(max(values[n] for n in s) + min(values[n] for n in s)) / 2 for s in sets]
        slack = [radius - (max(values[n] for n in s) - min(values[n] for n in s)) / 2 for s in sets]
        shared = cover(middles, min(slack))
        if all(len(s) == 1 and shared[m] == m for s, m in zip(sets, middles, strict=True)):
            return term
        numbers: dict[Fraction, int] = {}
        images = [numbers.setdefault(shared[m], len(numbers)) for m in middles]
        return Term(relabel(diagram, np.array(images, dtype=np.uint64), INDEX), tuple(numbers))


def as_epsilon(epsilon: Fraction | float | str) -> Fraction:
    """Epsilon as it is written: 0.1 is 1/10.

    Raises:
        ModelError: not from 0 to below 1.
    """
    try:
        found = Fraction(str(epsilon)) if isinstance(epsilon, float) else Fraction(epsilon)
    except (ValueError, OverflowError, ZeroDivisionError):
        found = Fraction(-1)
    if not 0 <= found < 1:
        hint = "it is a distance of probabilities, such as 0.05"
        raise ModelError([Fault(f"epsilon is {epsilon}: it must be from 0 to below 1", (), hint)])
    return found


def snap(symbolic: SymbolicModel, epsilon: Fraction | float | str) -> Snapped:
    """The model with rows, and by `Snapped.process` rewards, merged within `epsilon`.

    Raises:
        ModelError: an epsilon that is no distance.
        MemoryLimit, Aborted: of the diagrams.
    """
    bound = as_epsilon(epsilon)
    work = _Snapping(symbolic, bound)
    actions = tuple(work.action(action) for action in symbolic.actions) if bound else symbolic.actions
    before, after = row_count(symbolic.actions), row_count(actions)
    snapped = replace(symbolic, actions=actions, variant=fresh_variant()) if bound else symbolic
    return Snapped(symbolic, snapped, bound, work.changed, before, after, work.parents)


def row_count(actions: tuple[SymbolicAction, ...]) -> int:
    """The distinct rows of all features and channels."""
    found: set[tuple[str, int, Row]] = set()
    for action in actions:
        for kind, diagrams in (("x", action.rows), ("o", action.observations)):
            found |= {(kind, number, row) for number, d in diagrams.items() for row in d.rows}
    return len(found)


class _Snapping:
    """The working state of one call of `snap`."""

    def __init__(self, symbolic: SymbolicModel, epsilon: Fraction) -> None:
        self.symbolic, self.epsilon = symbolic, epsilon
        self.changed = self.parents = 0
        self.features = self._snapped(lambda action: action.rows)
        self.channels = self._snapped(lambda action: action.observations)

    def action(self, action: SymbolicAction) -> SymbolicAction:
        """An action with what became of its rows."""
        rows = {i: self.features[i][_name(row)] for i, row in action.rows.items()}
        rows = {i: row for i, row in rows.items() if not self._persists(i, row)}
        observations = {j: self.channels[j][_name(row)] for j, row in action.observations.items()}
        return replace(action, rows=rows, observations=observations)

    def _snapped(
        self, rows_of: Callable[[SymbolicAction], Mapping[int, RowDiagram]]
    ) -> dict[int, dict[tuple[int, int], RowDiagram]]:
        """For each feature (or channel) what its row diagrams become, by name."""
        found: dict[int, dict[tuple[int, int], RowDiagram]] = {}
        for action in self.symbolic.actions:
            for number, row in rows_of(action).items():
                found.setdefault(number, {})[_name(row)] = row
        return {number: self._of_one(diagrams) for number, diagrams in found.items()}

    def _of_one(self, diagrams: dict[Key, RowDiagram]) -> dict[Key, RowDiagram]:
        """The row diagrams of one variable, snapped together."""
        numbers: dict[Row, int] = {}
        for row in diagrams.values():
            for leaf in leaves(row.diagram):
                numbers.setdefault(row.rows[int(leaf)], len(numbers))
        find = Representatives(tuple(numbers), self.epsilon)
        dropped: dict[Key, Sets] = {}
        for key, row in diagrams.items():
            images = np.array([numbers.get(r, 0) for r in row.rows], dtype=np.uint64)
            diagram, sets, dropped_here = drop_parents(
                relabel(row.diagram, images, INDEX), lambda s: find.of(s) is not None
            )
            dropped[key] = (diagram, sets)
            self.parents += dropped_here
        shared = find.joined(s for _, sets in dropped.values() for s in sets)
        self.changed += sum(1 for s in shared for m in s if shared[s] != find.rows[m])
        return {key: self._rebuilt(diagrams[key], *dropped[key], shared) for key in diagrams}

    def _rebuilt(
        self,
        row: RowDiagram,
        diagram: Diagram,
        sets: list[frozenset[int]],
        shared: Mapping[frozenset[int], Row],
    ) -> RowDiagram:
        numbers: dict[Row, int] = {}
        images = np.array([numbers.setdefault(shared[s], len(numbers)) for s in sets], dtype=np.uint64)
        result = relabel(diagram, images, INDEX)
        tested = set(support(result))
        parents = tuple(i for i in row.parents_next if self.symbolic.next(i) in tested)
        return RowDiagram(row.feature, result, tuple(numbers), parents)

    def _persists(self, feature: int, row: RowDiagram) -> bool:
        """Whether the feature stays as it is, surely."""
        level = self.symbolic.now(feature)
        size = len(self.symbolic.model.features[feature].values)
        if support(row.diagram) != [level] or any(max(r) != 1 for r in row.rows):
            return False
        parts = cofactors(row.diagram, level)
        return all(row.rows[int(part.value)] == sure(size, v) for v, part in enumerate(parts))


def _name(row: RowDiagram) -> tuple[int, int]:
    return id(row.diagram), id(row.rows)


def drop_parents(
    diagram: Diagram, fits: Callable[[frozenset[int]], bool]
) -> tuple[Diagram, list[frozenset[int]], int]:
    """An index diagram with as many levels dropped as possible: leaves become sets of the leaves there.

    A level goes where `fits` holds for every set that joins the leaves over its values.  Levels are tried
    from the bottom up, as dropping low ones keeps the others' contexts few.

    Returns:
        the diagram to numbers of sets, the sets, and how many levels went.
    """
    gone = 0
    current, sets = combine([diagram], lambda leaf: frozenset((leaf,)))
    for level in reversed(support(diagram)):
        if len(sets) == 1:
            break
        parts = cofactors(current, level)
        known = sets

        def join(*numbers: int, known: list[frozenset[int]] = known) -> frozenset[int]:
            return frozenset[int]().union(*(known[n] for n in numbers))

        without, joined = combine(parts, join)
        if all(fits(s) for s in joined):
            current, sets, gone = without, joined, gone + 1
    return current, sets, gone
