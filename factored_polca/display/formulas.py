"""Conditions on states as short formulas over features, in the language of model files.

A block, or any set of states that is given as a diagram, becomes the shortest of

    a minimal cover of it (`covers`),
    "not" and a minimal cover of its complement,
    what sympy's `simplify_logic` makes of either, each literal "x in S" standing for a symbol,
    how many features have a value, where a longer condition only counts (`symmetry`).

What is shorter to read decides.  A formula is true on exactly the states of its diagram; there may be none
within the budget.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, Literal, TypeAlias

from factored_polca.diagrams import Diagram, node_count
from factored_polca.display.covers import Budget, Condition, Cube, TooLong, cover
from factored_polca.display.nodes import Nodes, read_nodes
from factored_polca.display.symmetry import count_vectors, one_value
from factored_polca.models import Feature, Value
from factored_polca.models.language import KEYWORDS
from factored_polca.models.printing import name_text
from factored_polca.models.printing import value_text as quoted_value
from factored_polca.symbolic import SymbolicModel

STEPS: Final = 3_000_000
"""Steps for all formulas of a table: a second or two."""

LONG: Final = 40
"""What is longer is looked at for whether it only counts."""

MOST_SYMBOLS: Final = 7
"""Literals up to which sympy is asked; its time grows as 2^n."""

LARGEST_DIAGRAM: Final = 3_000


@dataclass(frozen=True)
class Membership:
    """The condition that a feature has one of some values, given by their numbers."""

    feature: Feature
    values: frozenset[int]

    def holds(self, state: Mapping[str, Value]) -> bool:
        """Whether it holds at a state."""
        return self.feature.index(state[self.feature.name]) in self.values


@dataclass(frozen=True)
class Junction:
    """All of some conditions, or at least one of them; of no conditions true, or false."""

    operator: Literal["and", "or"]
    parts: tuple[Formula, ...]

    def holds(self, state: Mapping[str, Value]) -> bool:
        """Whether it holds at a state."""
        every = all if self.operator == "and" else any
        return every(part.holds(state) for part in self.parts)


@dataclass(frozen=True)
class Negation:
    """The opposite of a condition."""

    part: Formula

    def holds(self, state: Mapping[str, Value]) -> bool:
        """Whether it holds at a state."""
        return not self.part.holds(state)


@dataclass(frozen=True)
class Counting:
    """The condition that of some features between `low` and `high` have a value, for each of some values.

    `bounds` maps numbers of values to (low, high).
    """

    features: tuple[Feature, ...]
    bounds: tuple[tuple[int, tuple[int, int]], ...]

    def holds(self, state: Mapping[str, Value]) -> bool:
        """Whether it holds at a state."""
        numbers = [feature.index(state[feature.name]) for feature in self.features]
        return all(low <= numbers.count(value) <= high for value, (low, high) in self.bounds)


Formula: TypeAlias = Membership | Junction | Negation | Counting

TRUE: Final = Junction("and", ())
FALSE: Final = Junction("or", ())


def formula(symbolic: SymbolicModel, condition: Diagram, budget: Budget | None = None) -> Formula | None:
    """A short formula for a condition over present states (leaves 0 and 1); None: none that is short.

    Raises:
        ValueError: the diagram tests something other than present features.
    """
    if node_count(condition) > LARGEST_DIAGRAM:
        return None
    nodes = read_nodes(condition)
    features = {symbolic.now(k): feature for k, feature in enumerate(symbolic.model.features)}
    if not set(nodes.support) <= set(features):
        raise ValueError("a formula is made of a condition over present features")
    budget = Budget(STEPS) if budget is None else budget
    tested = [features[level] for level in nodes.support]
    sizes = [len(feature.values) for feature in tested]
    candidates: list[Formula] = []
    for true in (1, 0):
        try:
            cubes = cover(Condition(nodes, sizes, true, budget))
        except TooLong:
            continue
        for found in (_sum_of_products(cubes, tested), _simplified(cubes, tested)):
            if found is not None:
                candidates += [found] if true else [negated(found), inverted(found)]
        if true and len(cubes) <= 1:  # its opposite is no shorter
            break
    if not candidates or min(map(size, candidates)) > LONG:
        counted = _counting(nodes, tested, budget)
        if counted is not None:
            return counted
    return min(candidates, key=size, default=None)


def _counting(nodes: Nodes, tested: Sequence[Feature], budget: Budget) -> Formula | None:
    """A condition that only counts, where one value or one vector says it all."""
    if len({feature.values for feature in tested}) != 1:
        return None
    n, d = len(tested), len(tested[0].values)
    try:
        vectors = count_vectors(nodes, [d] * n, budget)
    except TooLong:
        return None
    if not vectors:
        return None
    single = one_value(vectors, n, d)
    if single is not None:
        value, low, high = single
        return Counting(tuple(tested), ((value, (low, high)),))
    if len(vectors) > 1:
        return None
    (counts,) = vectors
    bounds = [(value, (many, many)) for value, many in enumerate(counts) if many]
    if len(bounds) == len(counts):  # the last follows from the others
        bounds.remove(max(bounds, key=lambda bound: bound[1]))
    return Counting(tuple(tested), tuple(bounds))


def size(found: Formula) -> int:
    """How much there is to read; tests of what is not, and "not" before a whole, cost more."""
    match found:
        case Membership():
            return 5 if 2 * len(found.values) > len(found.feature.values) else 4
        case Negation():
            return size(found.part) + 2
        case Counting():
            return 6 * len(found.bounds)
        case Junction():
            return sum(size(part) for part in found.parts)


def negated(found: Formula) -> Formula:
    """The opposite, as one "not" before the whole; that of a test is a test."""
    if isinstance(found, Membership):
        return Membership(found.feature, frozenset(range(len(found.feature.values))) - found.values)
    if isinstance(found, Negation):
        return found.part
    if isinstance(found, Junction) and not found.parts:
        return TRUE if found.operator == "or" else FALSE
    return Negation(found)


def inverted(found: Formula) -> Formula:
    """The opposite, with "not" at the tests (De Morgan's laws)."""
    if isinstance(found, Junction):
        parts = tuple(inverted(part) for part in found.parts)
        return Junction("or" if found.operator == "and" else "and", parts)
    return negated(found)


def _tests(cube: Cube, tested: Sequence[Feature]) -> list[Formula]:
    pairs = zip(tested, cube, strict=True)
    return [Membership(feature, values) for feature, values in pairs if len(values) < len(feature.values)]


def _joined(operator: Literal["and", "or"], parts: Sequence[Formula]) -> Formula:
    return parts[0] if len(parts) == 1 else Junction(operator, tuple(parts))


def _sum_of_products(cubes: Sequence[Cube], tested: Sequence[Feature]) -> Formula:
    return _joined("or", [_joined("and", _tests(cube, tested)) for cube in cubes])


def _simplified(cubes: Sequence[Cube], tested: Sequence[Feature]) -> Formula | None:
    """What sympy makes of a cover; each literal is a symbol, the opposite of one its negation."""
    if len(cubes) < 2:
        return None
    import sympy
    from sympy.logic import boolalg

    symbols: dict[Membership, Any] = {}
    by_name: dict[str, Membership] = {}

    def literal(test: Formula) -> Any:
        assert isinstance(test, Membership)
        opposite = negated(test)
        assert isinstance(opposite, Membership)
        if opposite in symbols:
            return sympy.Not(symbols[opposite])
        if test not in symbols:
            name = f"t{len(symbols)}"
            symbols[test], by_name[name] = sympy.Symbol(name), test
        return symbols[test]

    parts = [[literal(test) for test in _tests(cube, tested)] for cube in cubes]
    if len(symbols) > MOST_SYMBOLS:
        return None
    whole = sympy.Or(*(sympy.And(*part) for part in parts))
    return _read(boolalg.simplify_logic(whole, force=True), by_name)


def _read(found: Any, by_name: Mapping[str, Membership]) -> Formula:
    import sympy

    if found == sympy.true or found == sympy.false:
        return TRUE if found == sympy.true else FALSE
    if isinstance(found, sympy.Symbol):
        return by_name[found.name]
    parts = sorted((_read(part, by_name) for part in found.args), key=_order)
    if isinstance(found, sympy.Not):
        return negated(parts[0])
    return _joined("and" if isinstance(found, sympy.And) else "or", parts)


def _order(found: Formula) -> tuple[int, str]:
    """Tests first, by name: sympy's own order depends on the symbols."""
    return (0, text(found)) if isinstance(found, Membership) else (1, text(found))


# -- text ------------------------------------------------------------------------------------------


def text(found: Formula, names: frozenset[str] = frozenset()) -> str:
    """A formula in the language of model files; values that are among `names` are put in quotes."""
    match found:
        case Membership():
            return _test_text(found, names)
        case Negation():
            return f"not ({text(found.part, names)})"
        case Counting():
            return _counting_text(found, names)
        case Junction():
            if not found.parts:
                return "true" if found.operator == "and" else "false"
            return f" {found.operator} ".join(_part_text(found, part, names) for part in found.parts)


def _counting_text(found: Counting, names: frozenset[str]) -> str:
    """`exactly 3 of x_0 .. x_9 == on`: in words, as the language of model files can't count."""
    ends = f"{name_text(found.features[0].name)} .. {name_text(found.features[-1].name)}"
    said = []
    for value, (low, high) in found.bounds:
        what, n = _value_text(found.features[0].values[value], names), len(found.features)
        if low == high:
            many = {0: "none", n: f"all {n}"}.get(low, f"exactly {low}")
        elif low == 0:
            many = f"at most {high}"
        else:
            many = f"at least {low}" if high == n else f"{low} to {high}"
        said.append(f"{many} of {ends} == {what}")
    return " and ".join(said)


def _part_text(whole: Junction, part: Formula, names: frozenset[str]) -> str:
    inner = text(part, names)
    loose = isinstance(part, Junction) and len(part.parts) > 1 and whole.operator != part.operator
    return f"({inner})" if loose and whole.operator == "and" else inner


def _test_text(test: Membership, names: frozenset[str]) -> str:
    feature, name = test.feature, name_text(test.feature.name)
    count, inside = len(feature.values), sorted(test.values)
    outside = [k for k in range(count) if k not in test.values]
    if all(isinstance(v, bool) for v in feature.values) and len(inside) == len(outside) == 1:
        return name if feature.values[inside[0]] else f"not {name}"

    def show(k: int) -> str:
        return _value_text(feature.values[k], names)

    if len(inside) == 1:
        return f"{name} == {show(inside[0])}"
    if len(outside) == 1:
        return f"{name} != {show(outside[0])}"
    if _ascending(feature.values):
        for some, low, high in ((inside, ">=", "<="), (outside, "<", ">")):
            if some == list(range(some[0], some[-1] + 1)):
                if some[-1] == count - 1:
                    return f"{name} {low} {show(some[0])}"
                if some[0] == 0:
                    return f"{name} {high} {show(some[-1])}"
        if inside == list(range(inside[0], inside[-1] + 1)):
            return f"{show(inside[0])} <= {name} <= {show(inside[-1])}"
    some, word = (inside, "in") if len(inside) <= len(outside) else (outside, "not in")
    return f"{name} {word} {{{', '.join(map(show, some))}}}"


def _ascending(values: Sequence[Value]) -> bool:
    numbers = [v for v in values if isinstance(v, int) and not isinstance(v, bool)]
    return len(numbers) == len(values) and all(a < b for a, b in pairwise(numbers))


def _value_text(value: Value, names: frozenset[str]) -> str:
    plain = isinstance(value, str) and re.fullmatch(r"[A-Za-z_]\w*", value, re.ASCII) is not None
    if plain and value not in names and value not in KEYWORDS:
        return str(value)
    return quoted_value(value)


def names_of(symbolic: SymbolicModel) -> frozenset[str]:
    """The names that a value must be told from."""
    model = symbolic.model
    return frozenset(
        [f.name for f in model.features]
        + [o.name for o in model.observations]
        + [n for n, _ in model.parameters]
    )
