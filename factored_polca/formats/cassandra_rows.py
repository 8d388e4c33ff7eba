"""Rows of T and O as distributions.

A row sums to 1.  One that misses it by less than 1e-4 is taken to be rounded in the file, divided by
its sum exactly and counted; a larger miss is a fault that names the row, and so is a row that no
entry sets.  Rows with the same content are one object.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final, NamedTuple

from factored_polca.formats.cassandra_layers import Layer, Row, Slices, Steps, folded
from factored_polca.formats.cassandra_names import Index
from factored_polca.formats.spudd_rows import TOLERANCE, decimal
from factored_polca.models.errors import Fault
from factored_polca.models.expressions import ZERO, Constant, Expression, Lottery

MAXIMUM_FAULTS: Final = 20
"""Faulty rows reported for one file."""


class RowFaults(Exception):
    """`MAXIMUM_FAULTS` faulty rows were found: reading on is of no use."""


class Rows(NamedTuple):
    """Rows that come from the same entries: the first of them in words, how many, from where."""

    what: str
    copies: int
    start: int


@dataclass
class Ledger:
    """The faulty and the rounded rows of one file, which grow in number while it is read."""

    fault: Callable[[str, int, str, str], Fault]
    faults: list[Fault] = field(default_factory=list)
    rounded: int = 0
    largest: tuple[Fraction, Rows] = (Fraction(0), Rows("", 0, 0))

    def report(self, message: str, rows: Rows, hint: str) -> None:
        """Note that `rows` are at fault.

        Raises:
            RowFaults: they are many by now.
        """
        others = rows.copies - 1
        more = f" (and {others} more with the same entries)" if others else ""
        self.faults.append(self.fault(f"{rows.what}{more}: {message}", rows.start, hint, "error"))
        if len(self.faults) >= MAXIMUM_FAULTS:
            raise RowFaults

    def check(self, total: Fraction, rows: Rows) -> None:
        """Note by how much `rows`, whose sum is `total`, miss 1.

        Raises:
            RowFaults: too many rows are at fault.
        """
        if total == 1:
            return
        miss = abs(total - 1)
        if miss >= TOLERANCE:
            self.report(f"the row sums to {decimal(total)}", rows, "a row sums to 1")
        else:
            self.rounded += rows.copies
            if miss > self.largest[0]:
                self.largest = (miss, rows)

    def warnings(self) -> list[Fault]:
        """One warning for all rounded rows, if there are any."""
        if not self.rounded:
            return []
        miss, rows = self.largest
        many = "1 row misses" if self.rounded == 1 else f"{self.rounded} rows miss"
        message = f"{many} the sum 1 by less than 1e-4; divided by the sums; the largest miss is"
        return [self.fault(f"{message} {decimal(miss)}, in {rows.what}", rows.start, "", "warning")]


@dataclass
class Distributions:
    """The distributions over the values of `columns` that are known so far, by their content."""

    columns: Index
    steps: Steps
    ledger: Ledger
    known: dict[object, tuple[Expression, Fraction]] = field(default_factory=dict)

    def distribution(self, row: Row, rows: Rows) -> Expression:
        """The distribution with the weights of `row`; a plain value where only one is not 0.

        Raises:
            StepLimit: too much work.
            RowFaults: too many rows are at fault.
        """
        self.steps.count(len(row.cells) + 1)
        default = row.default if len(row.cells) < len(self.columns) else ZERO
        cells = [pair for pair in row.cells.items() if pair[1] is not default]
        cells.sort(key=_column)
        key = (default, tuple(cells))
        if key not in self.known:
            self.known[key] = self._normalised(dict(cells), default)
        result, total = self.known[key]
        self.ledger.check(total, rows)
        return result

    def _normalised(self, cells: Mapping[int, Constant], default: Constant) -> tuple[Expression, Fraction]:
        """The distribution, and the sum of the weights that it was divided by."""
        pairs = list(cells.items())
        if default is not ZERO:
            self.steps.count(len(self.columns))
            pairs = [(column, cells.get(column, default)) for column in range(len(self.columns))]
            pairs = [(column, weight) for column, weight in pairs if weight is not ZERO]
        total = _number(pairs[0][1]) if len(pairs) == 1 else _sum([weight for _, weight in pairs])
        values = self.columns.constants
        if total == 0:
            return ZERO, total
        if len(pairs) == 1:
            return values[pairs[0][0]], total
        if total != 1:
            pairs = [(column, Constant(_number(weight) / total)) for column, weight in pairs]
        return Lottery(tuple((values[column], weight) for column, weight in pairs)), total

    def of_each(
        self, found: Slices, given: Index, what: Callable[[str], Rows]
    ) -> tuple[dict[int, Expression], Expression]:
        """The distribution for each value of `given` that a layer names, and that for all others.

        `what` completes the words for a row and says how many tables have it.

        Raises:
            StepLimit: too much work.
            RowFaults: too many rows are at fault.
        """
        chosen = {value: self._of_layers(part, what(given.show(value))) for value, part in found.named()}
        if len(chosen) == len(given):
            return chosen, ZERO
        rows = what(given.show(found.first_other()))
        rows = rows._replace(copies=rows.copies * (len(given) - len(chosen)))
        return chosen, self._of_layers(found.others(), rows)

    def _of_layers(self, layers: Sequence[Layer], rows: Rows) -> Expression:
        if not layers:
            self.ledger.report("no entry sets the row", rows, "each row is given and sums to 1")
            return ZERO
        row = folded(layers, self.steps)
        return self.distribution(row, rows._replace(start=max(layer.start for layer in layers)))


def _column(cell: tuple[int, Constant]) -> int:
    return cell[0]


def _number(constant: Constant) -> Fraction:
    assert isinstance(constant.value, Fraction), "tables hold numbers"
    return constant.value


def _sum(weights: Sequence[Constant]) -> Fraction:
    """The sum of `weights`, each different number multiplied by how often it occurs."""
    counts: dict[Constant, int] = {}
    for weight in weights:
        counts[weight] = counts.get(weight, 0) + 1
    return sum((_number(weight) * count for weight, count in counts.items()), Fraction(0))
