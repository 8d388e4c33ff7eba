"""Draws moved to where the model has them: the outcomes of a ground term, each with its probability.

RDDL lets a draw stand anywhere, as in `~running(c) ^ Bernoulli(0.1)`; the model wants distributions at the
ends of branches.  Each occurrence of a draw is independent of all others given the fluents, and an
occurrence stands in one part of a term only; so the parts of an operator are independent, and

    P(a and b) = P(a) P(b),   P(if c then a else b) = P(c) P(a) + (1 - P(c)) P(b),

and generally the outcomes of op(a, b) are those of the pairs.  Probabilities are terms without draws.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Final

from factored_polca.formats.rddl_terms import BOOL, DRAWS, Row, Term, Terms
from factored_polca.models.errors import ModelError

MAXIMUM_OUTCOMES: Final = 1_000

Law = Mapping[Term, Term]
"""Values, as terms without draws, and their probabilities."""


def chance(terms: Terms, root: Term) -> Term:
    """The probability that a truth value is true, as a term without draws."""
    return _laws(terms, root).get(terms.truth(True), terms.number(0))


def outcomes(terms: Terms, root: Term) -> Law:
    """The outcomes of a term.

    Raises:
        ModelError: too many.
    """
    return _laws(terms, root)


def mean(terms: Terms, root: Term) -> Term:
    """The expectation of a number."""
    if terms.fixed(root):
        return root
    return terms.sum([terms.product([p, v]) for v, p in outcomes(terms, root).items()])


def _laws(terms: Terms, root: Term) -> Law:
    laws: dict[Term, Law] = {}

    def law_of(part: Term) -> Law:
        found = laws.get(part)
        if found is not None:
            return found
        if terms[part].kind == BOOL:
            return {terms.truth(True): terms.choice(part, terms.number(1), terms.number(0)),
                    terms.truth(False): terms.choice(part, terms.number(0), terms.number(1))}  # fmt: skip
        return {part: terms.number(1)}

    for part in terms.parts_first([root], lambda row: bool(row.flags & DRAWS)):
        row = terms[part]
        laws[part] = _law(terms, row, law_of)
        if len(laws[part]) > MAXIMUM_OUTCOMES:
            raise ModelError(f"a draw with more than {MAXIMUM_OUTCOMES} outcomes")
    return law_of(root)


def _law(terms: Terms, row: Row, law_of: Callable[[Term], Law]) -> Law:
    one = terms.number(1)
    match row.op:
        case "bernoulli":
            return _booleans(terms, row.parts[0])
        case "discrete":
            pairs = zip(row.data, row.parts, strict=True)
            return {terms.constant(label, row.kind): chance for label, chance in pairs}
        case "and" | "or":
            neutral = terms.truth(row.op == "and")
            product = terms.product([law_of(part).get(neutral, terms.number(0)) for part in row.parts])
            law = _booleans(terms, product)
            return law if row.op == "and" else _swapped(terms, law)
        case "not":
            return _swapped(terms, law_of(row.parts[0]))
        case "if":
            condition, then, otherwise = row.parts
            fixed = terms.fixed(condition)
            weight = one if fixed else law_of(condition).get(terms.truth(True), terms.number(0))
            result: dict[Term, list[Term]] = {}
            for branch, first in ((then, True), (otherwise, False)):
                for value, chance in law_of(branch).items():
                    result.setdefault(value, []).append(
                        _weighted(terms, condition if fixed else None, weight, chance, first)
                    )
            return {value: terms.sum(chances) for value, chances in result.items()}
    return _combined(terms, row, [law_of(part) for part in row.parts])


def _weighted(terms: Terms, condition: Term | None, weight: Term, chance: Term, first: bool) -> Term:
    """The probability of a branch's outcome: under a condition, or with its probability."""
    if condition is None:
        return terms.product([weight if first else terms.less_one(weight), chance])
    zero = terms.number(0)
    return terms.choice(condition, chance, zero) if first else terms.choice(condition, zero, chance)


def _booleans(terms: Terms, true: Term) -> Law:
    return {terms.truth(True): true, terms.truth(False): terms.less_one(true)}


def _swapped(terms: Terms, law: Law) -> Law:
    """The law of the negation."""
    return {terms.negation(value): chance for value, chance in law.items()}


def _combined(terms: Terms, row: Row, laws: list[Law]) -> Law:
    """The outcomes of an operator, its parts' outcomes taken one after the other where that is possible."""
    if row.op in ("add", "multiply", "minimum", "maximum") and len(laws) > 2:
        found = laws[0]
        for law in laws[1:]:
            found = _combined(terms, row, [found, law])
        return found
    if len(laws) == 2 and len(laws[0]) * len(laws[1]) > MAXIMUM_OUTCOMES**2:
        raise ModelError(f"a draw with more than {MAXIMUM_OUTCOMES} outcomes")
    result: dict[Term, list[Term]] = {}
    for chosen in itertools.product(*(law.items() for law in laws)):
        value = terms.again(row, tuple(v for v, _ in chosen))
        result.setdefault(value, []).append(terms.product([p for _, p in chosen]))
    return {value: terms.sum(chances) for value, chances in result.items()}
