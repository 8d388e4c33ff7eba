"""A symbolic model, or a decision process over it, with every number replaced by another.

The numbers of a model compiled with symbols are rational functions f(t) of its parameters t.  Replacing f
by f(t_0) gives the model at the setting t_0; replacing it by its residue at a random point modulo a prime
gives what the minimiser works with.  Diagrams do not change: they map states to the *numbers of* rows and
values, some of which may now be equal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from fractions import Fraction

from factored_polca.minimisation import DecisionProcess
from factored_polca.models.model import Model
from factored_polca.symbolic import RowDiagram, SymbolicAction, SymbolicModel, Term
from factored_polca.symbolic.rows import Row
from factored_polca.symbolic.variants import fresh_variant

Image = Callable[[Fraction], Fraction]
"""What a number is replaced by."""


class Substitution:
    """Replaces numbers; what shares a table of numbers before shares one afterwards."""

    def __init__(self, image: Image) -> None:
        self.image = image
        self._numbers: dict[Fraction, Fraction] = {}
        self._tables: dict[int, tuple[object, tuple[Row, ...]]] = {}
        self._terms: dict[int, tuple[Term, Term]] = {}

    def number(self, value: Fraction) -> Fraction:
        """The image of a number."""
        if value not in self._numbers:
            self._numbers[value] = self.image(value)
        return self._numbers[value]

    def row(self, row: RowDiagram) -> RowDiagram:
        """A row diagram with other rows."""
        known = self._tables.get(id(row.rows))
        if known is None:
            rows = tuple(tuple(map(self.number, r)) for r in row.rows)
            known = self._tables[id(row.rows)] = (row.rows, rows)
        return replace(row, rows=known[1])

    def rows(self, rows: Mapping[int, RowDiagram]) -> dict[int, RowDiagram]:
        """Row diagrams by feature or channel."""
        return {number: self.row(row) for number, row in rows.items()}

    def term(self, term: Term) -> Term:
        """A term with other values."""
        known = self._terms.get(id(term))
        if known is None:
            image = Term(term.diagram, tuple(map(self.number, term.values)))
            known = self._terms[id(term)] = (term, image)
        return known[1]

    def terms(self, terms: Iterable[Term]) -> tuple[Term, ...]:
        """Several terms."""
        return tuple(map(self.term, terms))

    def action(self, action: SymbolicAction) -> SymbolicAction:
        """An action with other numbers."""
        return replace(
            action,
            rows=self.rows(action.rows),
            rewards=self.terms(action.rewards),
            sampled_rewards=self.terms(action.sampled_rewards),
            observations=self.rows(action.observations),
        )

    def symbolic(self, symbolic: SymbolicModel, model: Model | None = None) -> SymbolicModel:
        """A compiled model with other numbers; `model` is what it then says it was made from."""
        return replace(
            symbolic,
            model=symbolic.model if model is None else model,
            actions=tuple(map(self.action, symbolic.actions)),
            initial=self.rows(symbolic.initial),
            variant=fresh_variant(),
        )

    def process(self, process: DecisionProcess, model: Model | None = None) -> DecisionProcess:
        """A decision process with other numbers, and nothing left open."""
        return replace(
            process,
            symbolic=self.symbolic(process.symbolic, model),
            rewards={p: self.terms(terms) for p, terms in process.rewards.items()},
            open_numbers=None,
        )


def rows_of(process: DecisionProcess) -> Iterator[tuple[int, RowDiagram]]:
    """The row diagrams of the primitives that a process uses, each with the primitive's number."""
    for primitive in used_primitives(process):
        action = process.symbolic.actions[primitive]
        for row in action.rows.values():
            yield primitive, row
        for channel in process.channels or ():
            if channel in action.observations:
                yield primitive, action.observations[channel]


def used_primitives(process: DecisionProcess) -> list[int]:
    """The numbers of the primitives that a process uses, ascending."""
    return sorted({p for choice in process.choices for p in choice.primitives})
