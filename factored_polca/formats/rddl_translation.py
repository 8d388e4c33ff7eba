"""Ground terms as expressions of the model.

A draw at the end of a branch becomes a lottery; other draws are moved there first (`rddl_laws`).  Functions
that the model's language lacks, such as `exp`, are written case by case over the values of their arguments.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from factored_polca.formats.rddl_functions import NoValue, applied
from factored_polca.formats.rddl_laws import outcomes
from factored_polca.formats.rddl_ranges import Ranges, Unbounded, spread
from factored_polca.formats.rddl_terms import DRAWS, Row, Term, Terms
from factored_polca.models.errors import ModelError
from factored_polca.models.expressions import (
    FALSE,
    ONE,
    TRUE,
    ZERO,
    Conditional,
    Constant,
    Expression,
    Lottery,
    Operation,
    Reference,
)
from factored_polca.models.scalars import Scalar

MAXIMUM_CASES: Final = 2_000

_SAME: Final = {
    "and": "and", "or": "or", "not": "not", "add": "add", "multiply": "multiply", "divide": "divide",
    "minimum": "minimum", "maximum": "maximum", "equal": "equal", "less": "less",
    "less_equal": "less_equal",
}  # fmt: skip
_FUNCTIONS: Final = {"abs": "absolute", "div": "floor_divide", "mod": "modulo"}
DIVISION: Final = "division by zero"
_UNDEFINED: Final = Operation("divide", (ONE, ZERO))


@dataclass
class Translator:
    """Turns terms into expressions, each once."""

    terms: Terms
    ranges: Ranges
    _memo: dict[Term, Expression] = field(default_factory=dict)
    _laws: dict[Term, Expression] = field(default_factory=dict)

    def expression(self, root: Term) -> Expression:
        """The expression of a term without draws."""
        for term in self.terms.parts_first([root], lambda row: True):
            if term not in self._memo:
                self._memo[term] = self._expression(self.terms[term])
        return self._memo[root]

    def law(self, root: Term) -> Expression:
        """The conditional distribution of a term: conditionals, with lotteries or values at their ends."""
        work = [root]
        while work:
            term = work[-1]
            if term in self._laws:
                work.pop()
                continue
            row = self.terms[term]
            if row.flags & DRAWS and row.op == "if" and self.terms.fixed(row.parts[0]):
                missing = [part for part in row.parts[1:] if part not in self._laws]
                if missing:
                    work += missing
                    continue
                condition = self.expression(row.parts[0])
                self._laws[term] = Conditional(condition, *(self._laws[part] for part in row.parts[1:]))
            elif row.flags & DRAWS:
                law = outcomes(self.terms, term)
                zero = self.terms.number(0)
                self._laws[term] = Lottery(
                    tuple((self.expression(v), self.expression(p)) for v, p in law.items() if p != zero)
                )
            else:
                self._laws[term] = self.expression(term)
            work.pop()
        return self._laws[root]

    def _expression(self, row: Row) -> Expression:
        parts = tuple(self._memo[part] for part in row.parts)
        if row.op in _SAME:
            return Operation(_SAME[row.op], parts)
        match row.op:
            case "constant":
                return Constant(row.data) if not isinstance(row.data, bool) else TRUE if row.data else FALSE
            case "now":
                return Reference(row.data)
            case "next" | "random":
                return Reference(row.data, primed=True)
            case "indicator":
                return Conditional(parts[0], ONE, ZERO)
            case "if":
                return Conditional(*parts)
            case "function":
                return self._function(row, parts)
            case "undefined":
                return _UNDEFINED if row.data == DIVISION else Constant(row.data)  # which is no value
        raise AssertionError(f"a term {row.op} is left where a value is needed")

    def _function(self, row: Row, parts: tuple[Expression, ...]) -> Expression:
        if row.data in _FUNCTIONS:
            return Operation(_FUNCTIONS[row.data], parts)
        try:
            values = [sorted(map(_number, spread(self.terms, p, self.ranges))) for p in row.parts]
        except Unbounded:
            values = []
        if not values or math.prod(map(len, values)) > MAXIMUM_CASES:
            raise ModelError(f"{row.data} is taken of more than {MAXIMUM_CASES} values")
        results: dict[tuple[Fraction, ...], Expression] = {}
        for chosen in itertools.product(*values):
            try:
                result = applied(row.data, chosen)
            except NoValue:
                results[chosen] = _UNDEFINED
                continue
            if result.rounded:
                self.terms.rounded.add(row.data)
            results[chosen] = Constant(result.value)
        return _by_cases(parts, values, results, ())


def _number(value: Scalar) -> Fraction:
    return Fraction(value)


def _by_cases(
    parts: Sequence[Expression],
    values: Sequence[Sequence[Fraction]],
    results: Mapping[tuple[Fraction, ...], Expression],
    chosen: tuple[Fraction, ...],
) -> Expression:
    """A function of `parts` by comparing them with their values; `chosen` are those of the first parts."""
    if not parts:
        return results[chosen]
    if len(values[0]) == 1:
        return _by_cases(parts[1:], values[1:], results, (*chosen, values[0][0]))
    middle = len(values[0]) // 2
    lower, upper = values[0][:middle], values[0][middle:]
    condition = Operation("less_equal", (parts[0], Constant(lower[-1])))
    low, high = (_by_cases(parts, [part, *values[1:]], results, chosen) for part in (lower, upper))
    return low if low == high else Conditional(condition, low, high)
