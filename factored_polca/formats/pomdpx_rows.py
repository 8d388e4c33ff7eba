"""Rows of a POMDPX file: the probabilities of one variable's values in one context.

A row sums to 1; a sum that misses 1 by less than 1e-4 is taken for rounding in the file, divided out
exactly and counted, and a larger miss is a fault that names the context.  A row is a *lottery* over
the values of positive probability, a plain value where there is only one.

    identity    switch y {v: v, ...} over all values v of y is y itself: persistence stays persistence
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from math import lcm
from typing import Final

from factored_polca.formats.pomdpx_document import Faults, Place, error, fault, quoted
from factored_polca.formats.pomdpx_variables import Variable
from factored_polca.formats.spudd_rows import TOLERANCE, decimal
from factored_polca.formats.spudd_trees import Forest
from factored_polca.models.errors import Fault
from factored_polca.models.expressions import Constant, Expression
from factored_polca.models.language import number

MAXIMUM_CONTEXT: Final = 12
"""Variables named in the context of a faulty row."""

Context = tuple[tuple[Variable, int], ...]
"""What has been decided: variables, each with the number of its value."""

_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


@dataclass
class Numbers:
    """The numbers of a file, each text read once."""

    forest: Forest
    known: dict[str, Fraction] = field(default_factory=dict)

    def read(self, word: str) -> Fraction:
        """The exact rational that `word` denotes.

        Raises:
            ValueError: no decimal number, or more digits or a larger exponent than are read.
        """
        value = self.known.get(word)
        if value is None:
            if not _NUMBER.fullmatch(word):
                raise ValueError(f"{quoted(word)} is no number")
            value = number(word)
            self.forest.count(1 + (value.numerator.bit_length() + value.denominator.bit_length()) // 200)
            self.known[word] = value
        return value

    def probability(self, word: str) -> Fraction:
        """The number `word`, which is not negative.

        Raises:
            ValueError: as `read`, or a negative number.
        """
        value = self.read(word)
        if value < 0:
            raise ValueError(f"the probability {quoted(word)} is negative")
        return value


@dataclass
class Rows:
    """The rows of one file; the faults and the count of rounded rows grow while it is read."""

    forest: Forest
    faults: Faults
    rounded: int = 0
    largest: tuple[Fraction, str, Place] = (Fraction(0), "", Place(1, 1))

    def row(
        self,
        weights: Mapping[int, Fraction],
        variable: Variable,
        context: Context,
        place: Place,
        *,
        normalise: bool = False,
    ) -> Expression:
        """The distribution over the values of `variable` that has `weights`, 0 where there is none.

        With `normalise` the weights are divided by their sum, whatever it is: they are joint
        probabilities with what has been decided already, which is impossible where they are all 0.
        """
        whole = lcm(*{weight.denominator for weight in weights.values()})
        self.forest.count(len(weights) * (2 + whole.bit_length() // 200))
        shares = {v: w.numerator * (whole // w.denominator) for v, w in weights.items() if w}
        total = sum(shares.values())
        if normalise and total == 0:
            shares, total = {0: 1}, 1
        if not normalise and total != whole:
            miss = Fraction(abs(total - whole), whole)
            if miss >= TOLERANCE:
                self._bad(Fraction(total, whole), variable, context, place)
                return self.forest.constant(variable.values[0])
            self.rounded += 1
            if miss > self.largest[0]:
                self.largest = (miss, _described(variable, context), place)
        chances = {share: Fraction(share, total) for share in set(shares.values())}
        return self.lottery([(variable.values[value], chances[shares[value]]) for value in sorted(shares)])

    def lottery(self, outcomes: Sequence[tuple[str, Fraction]]) -> Expression:
        """The distribution with these positive probabilities."""
        constant = self.forest.constant
        pairs = [(constant(value), constant(chance)) for value, chance in outcomes]
        return pairs[0][0] if len(pairs) == 1 else self.forest.lottery(pairs)

    def uniform(self, variable: Variable) -> Expression:
        """The uniform distribution over the values of `variable`."""
        share = Fraction(1, len(variable.values))
        return self.lottery([(value, share) for value in variable.values])

    def switch(self, variable: Variable, cases: Sequence[Expression]) -> Expression:
        """The decision over `variable` between distributions; the variable itself if each is its value."""
        node = self.forest.switch(variable.reference, cases)
        if variable.kind == "action" or len(cases) == 1:
            return node
        for value, case in zip(variable.values, cases, strict=True):
            if not (isinstance(case, Constant) and case.value == value):
                return node
        return self.forest.reference(variable.reference)

    def _bad(self, total: Fraction, variable: Variable, context: Context, place: Place) -> None:
        what = _described(variable, context)
        if total == 0:
            message = f"all probabilities of {what} are 0"
        else:
            message = f"the probabilities of {what} sum to {decimal(total)}"
        hint = "a row sums to 1; what is not listed is 0, and later entries override earlier ones"
        self.faults.add(message, place, hint)

    def warnings(self) -> list[Fault]:
        """One warning for all rounded rows, if there are any."""
        if not self.rounded:
            return []
        miss, what, place = self.largest
        rows = "1 row misses" if self.rounded == 1 else f"{self.rounded} rows miss"
        message = (
            f"{rows} the sum 1 by less than 1e-4; divided by the sums; the largest miss is {decimal(miss)}"
            f", of {what}"
        )
        return [fault(message, place, severity="warning")]


def read_number(numbers: Numbers, word: str, place: Place, *, probability: bool) -> Fraction:
    """The number `word` that stands at `place`.

    Raises:
        ModelError: it is no number, or a negative `probability`.
    """
    try:
        return numbers.probability(word) if probability else numbers.read(word)
    except ValueError as problem:
        raise error(str(problem), place) from None


def _described(variable: Variable, context: Context) -> str:
    """A row as a person would name it."""
    shown = [f"{v.name} = {v.values[value]}" for v, value in context[:MAXIMUM_CONTEXT]]
    if len(context) > MAXIMUM_CONTEXT:
        shown.append("...")
    return quoted(variable.name) + (f" where {', '.join(shown)}" if shown else "")
