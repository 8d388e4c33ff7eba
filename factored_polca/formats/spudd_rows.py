"""Conditional distributions from decision trees of weights.

A tree f over x, the primed y' and x' itself gives P(x' = v | x, y') the weight f with x' = v.  For
each context, that is each way of deciding all but x', the weights are a row.  Rows must sum to 1;
under `unnormalised` each is divided by its sum, and a sum that misses 1 by less than 1e-4 is taken
for rounding in the file, divided out exactly and counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from factored_polca.formats.spudd_trees import Assignment, ExpansionLimit, Forest, reason
from factored_polca.models.errors import Fault
from factored_polca.models.expressions import Constant, Expression, Reference
from factored_polca.models.scalars import Value, describe, scalar

TOLERANCE: Final = Fraction(1, 10_000)
"""A row whose sum misses 1 by less is taken to be rounded."""
MAXIMUM_FAULTS: Final = 20
"""Faults reported for one file."""
MAXIMUM_CONTEXT: Final = 12
"""Features named in the context of a faulty row."""


class RowFaults(Exception):
    """`MAXIMUM_FAULTS` faulty rows were found: reading on is of no use."""


@dataclass
class Rows:
    """The rows of one file; `faults` and the count of rounded rows grow while it is read."""

    forest: Forest
    fault: Callable[[str, int, str, str], Fault]
    places: dict[int, int] = field(default_factory=dict)  # id of a row's node -> character in the file
    known: dict[tuple[int, Reference, bool], Expression] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)
    rounded: int = 0
    largest: tuple[Fraction, str, int] = (Fraction(0), "", 0)

    def distribution(
        self,
        weights: Expression,
        target: Reference,
        values: tuple[Value, ...],
        *,
        what: str,
        start: int,
        unnormalised: bool,
        identity: Reference | None = None,
    ) -> Expression:
        """The distribution of `target` that `weights` denotes.

        Where deciding every context would take too long, the probabilities stay expressions over the
        tree's own parts; the sums of their rows are then not checked here.  `identity` is the
        feature that `target` is the next value of.
        """
        key = (id(weights), target, unnormalised)
        known = self.known.get(key)
        if known is not None:
            return known
        told = len(self.faults), self.rounded
        result = self._expanded(weights, target, values, what, start, unnormalised, identity)
        if told == (len(self.faults), self.rounded):  # else each use of the tree is counted
            self.known[key] = result
        return result

    def _expanded(
        self,
        weights: Expression,
        target: Reference,
        values: tuple[Value, ...],
        what: str,
        start: int,
        unnormalised: bool,
        identity: Reference | None,
    ) -> Expression:
        forest = self.forest
        keep = forest.bit(target)

        def leaf(rest: Expression, path: Assignment) -> Expression:
            place = self.places.get(id(rest), start)
            return self._row([forest.restrict(rest, target, v) for v in values],
                             values, path, what, place, unnormalised)  # fmt: skip

        try:
            return forest.limited(lambda: forest.expand(weights, leaf, keep, identity))
        except ExpansionLimit:
            parts = [forest.restrict(weights, target, value) for value in values]
            if unnormalised and len(parts) > 1:
                total = forest.operation("add", parts)
                parts = [forest.operation("divide", (part, total)) for part in parts]
            outcomes = [(forest.constant(scalar(v)), q) for v, q in zip(values, parts, strict=True)]
            return forest.lottery(outcomes)

    def _row(
        self,
        weights: Sequence[Expression],
        values: tuple[Value, ...],
        path: Assignment,
        what: str,
        place: int,
        unnormalised: bool,
    ) -> Expression:
        forest = self.forest
        numbers: list[Fraction] = []
        for value, weight in zip(values, weights, strict=True):
            if not (isinstance(weight, Constant) and isinstance(weight.value, Fraction)):
                return self._bad(
                    f"{what}: {describe(scalar(value))} has no weight, {reason(weight)}", path, place
                )
            if weight.value < 0:
                message = f"{what}: {describe(scalar(value))} has weight {decimal(weight.value)}"
                return self._bad(message, path, place, "a probability is at least 0")
            numbers.append(weight.value)
        total = forest.operation("add", weights) if len(weights) > 1 else weights[0]
        if not (isinstance(total, Constant) and isinstance(total.value, Fraction)):
            return self._bad(f"{what}: the sum of the row is {reason(total)}", path, place)
        if total.value == 0:
            return self._bad(f"{what}: all probabilities of the row are 0", path, place,
                             "a row sums to 1")  # fmt: skip
        if total.value != 1 and not unnormalised:
            miss = abs(total.value - 1)
            if miss >= TOLERANCE:
                message = f"{what}: the row sums to {decimal(total.value)}"
                hint = "rows sum to 1, unless 'unnormalised' stands before the actions"
                return self._bad(message, path, place, hint)
            self.rounded += 1
            if miss > self.largest[0]:
                self.largest = (miss, what, place)
        return self.point_or_lottery([(v, q / total.value) for v, q in zip(values, numbers, strict=True)])

    def point_or_lottery(self, pairs: Sequence[tuple[Value, Fraction]]) -> Expression:
        """The distribution with these probabilities; a plain value where one of them is 1."""
        forest = self.forest
        possible = [(forest.constant(scalar(v)), forest.constant(q)) for v, q in pairs if q]
        return possible[0][0] if len(possible) == 1 else forest.lottery(possible)

    def _bad(self, message: str, path: Assignment, place: int, hint: str = "") -> Expression:
        if path:
            message += f" where {context(path)}"
        self.faults.append(self.fault(message, place, hint, "error"))
        if len(self.faults) >= MAXIMUM_FAULTS:
            raise RowFaults
        return self.forest.constant(Fraction(0))

    def warnings(self) -> list[Fault]:
        """One warning for all rounded rows, if there are any."""
        if not self.rounded:
            return []
        miss, what, place = self.largest
        rows = "1 row misses" if self.rounded == 1 else f"{self.rounded} rows miss"
        message = (
            f"{rows} the sum 1 by less than 1e-4; divided by the sums; the largest miss is {decimal(miss)}"
        )
        return [self.fault(f"{message}, in {what}", place, "", "warning")]


def context(path: Assignment) -> str:
    """An assignment as a person would write it."""
    shown = [f"{r.name}{quote(r)} = {describe(scalar(v))}" for r, v in path[:MAXIMUM_CONTEXT]]
    return ", ".join(shown) + (", ..." if len(path) > MAXIMUM_CONTEXT else "")


def quote(reference: Reference) -> str:
    """The prime after the name of a next value."""
    return "'" if reference.primed else ""


def decimal(value: Fraction) -> str:
    """A short decimal near `value`, for messages."""
    if value.denominator == 1 and abs(value) < 10**9:
        return str(value.numerator)
    try:
        return f"{float(value):.9g}"
    except OverflowError:
        return "a number of more than 300 digits"
