"""Expressions of a model as PRISM text: names, values and formulas.

    feature                          variable
    integers a, a+1, ..., b          [a..b]
    false, true                      bool
    other values                     [0..n-1], numbered in their order

PRISM's numbers are exact where the program's reader is (Storm's exact engines): 1/3 is written `1/3`.
What has no direct counterpart, such as an order between named values, raises `NotDirect`; the caller then
expands the expression over its features.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from functools import partial
from itertools import count
from typing import Final

from factored_polca.formats.prism_cases import case_of
from factored_polca.formats.spudd_text import decimal_text
from factored_polca.models.expressions import (
    Conditional,
    Constant,
    Expression,
    Operation,
    Parameter,
    Reference,
    Switch,
)
from factored_polca.models.features import Feature
from factored_polca.models.model import Model
from factored_polca.models.scalars import Scalar, Value

RESERVED: Final = frozenset(
    """A bool clock const ctmc C csg ctmdp double dtmc E endinit endinvariant endmodule
    endobservables endplayer endrewards endsystem false formula filter func F global G idtmc imdp
    init invariant I int label ma max mdp min module X nondeterministic observable observables of
    Pmax Pmin P player pomdp popta probabilistic prob pta rate rewards Rmax Rmin R S smg stochastic
    system true tsg U W M T L LRA floor ceil round pow mod log exp sin cos tan multi discount
    terminal ended real discounted""".split()  # noqa: SIM905
)
"""Words of PRISM and of Storm's dialect, and names that the writer itself uses."""
_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,99}\Z")


class NotDirect(Exception):
    """PRISM has no direct counterpart of an expression."""


def distinct(names: Iterable[str], taken: set[str], prefix: str = "") -> dict[str, str]:
    """A spelling for each name, different from each other and from those taken, which they join."""
    result: dict[str, str] = {}
    for name in names:
        wanted = prefix + name
        stem = wanted if _NAME.match(wanted) else re.sub(r"[^A-Za-z0-9_]", "_", wanted)[:60]
        if not re.match(r"[A-Za-z_]", stem):
            stem = f"v_{stem}"
        options = (stem if number == 0 else f"{stem}_{number}" for number in count())
        result[name] = next(option for option in options if option not in taken)
        taken.add(result[name])
    return result


class Spelling:
    """How a model's names, values and expressions are written."""

    def __init__(self, model: Model) -> None:
        taken = set(RESERVED)
        self.features: Mapping[str, Feature] = {f.name: f for f in model.features}
        self.names = distinct(self.features, taken)
        self.parameters = distinct([name for name, _ in model.parameters], taken)
        self.actions = distinct([action.name for action in model.actions], taken)
        self.first = distinct(["actions"], taken)["actions"]
        self.modules = distinct(self.features, taken, "of_")
        self.plain = {f.name: _is_range(f) for f in model.features}
        self.truth = {f.name: _is_truth(f) for f in model.features}

    # -- values ----------------------------------------------------------------------------------

    def domain(self, feature: Feature) -> str:
        """The type of a variable."""
        if self.truth[feature.name]:
            return "bool"
        if self.plain[feature.name]:
            return f"[{feature.values[0]}..{feature.values[-1]}]"
        return f"[0..{len(feature.values) - 1}]"

    def code(self, feature: Feature, value: Scalar | Value) -> str:
        """A value of a feature.

        Raises:
            NotDirect: it is none of its values.
        """
        index = feature.index(value)
        if index is None:
            raise NotDirect
        if self.truth[feature.name]:
            return "true" if index else "false"
        return str(feature.values[index] if self.plain[feature.name] else index)

    def is_value(self, feature: Feature, value: Scalar | Value) -> str:
        """The test that a feature has a value."""
        if feature.index(value) is None:
            return "false"
        name = self.names[feature.name]
        if self.truth[feature.name]:
            return name if value is True else f"!{name}"
        return f"{name}={self.code(feature, value)}"

    def is_one_of(self, feature: Feature, values: Iterable[Value]) -> str:
        """The test that a feature has one of some values, in parentheses where needed."""
        indices = sorted(i for i in map(feature.index, values) if i is not None)
        if len(indices) == len(feature.values):
            return "true"
        if len(indices) == 1:
            return self.is_value(feature, feature.values[indices[0]])
        name = self.names[feature.name]
        parts, first = [], 0
        for k, index in enumerate(indices):
            if k + 1 < len(indices) and indices[k + 1] == index + 1:
                continue
            low, high = (self.code(feature, feature.values[i]) for i in (indices[first], index))
            parts.append(f"{name}={low}" if low == high else f"({name}>={low} & {name}<={high})")
            first = k + 1
        return parts[0] if len(parts) == 1 else f"({' | '.join(parts)})"

    def value(self, feature: Feature, e: Expression) -> str:
        """An expression as the next value of a feature."""
        match e:
            case Constant():
                return self.code(feature, e.value)
            case Reference():
                other = self.features[e.name]
                if e.primed or other.values != feature.values:
                    if self.plain[e.name] and self.plain[feature.name]:
                        return self.number(e)
                    raise NotDirect
                return self.names[e.name]
            case Conditional():
                then, otherwise = self.value(feature, e.then), self.value(feature, e.otherwise)
                return f"({self.condition(e.condition)} ? {then} : {otherwise})"
            case Switch() if not e.reference.primed:
                return self.choice(e, partial(self.value, feature))
        if self.truth[feature.name]:
            return self.condition(e)
        if self.plain[feature.name] and _is_whole(e):
            return self.number(e)
        raise NotDirect

    # -- conditions and numbers --------------------------------------------------------------------

    def condition(self, e: Expression) -> str:
        """A condition, in parentheses where needed."""
        match e:
            case Constant(value=bool()):
                return "true" if e.value else "false"
            case Reference() if not e.primed:
                feature = self.features[e.name]
                if set(feature.values) <= {False, True} and all(
                    isinstance(v, bool) for v in feature.values
                ):
                    return self.is_value(feature, True)
            case Operation(operator="and" | "or"):
                symbol = " & " if e.operator == "and" else " | "
                return f"({symbol.join(map(self.condition, e.arguments))})"
            case Operation(operator="not"):
                return f"!({self.condition(e.arguments[0])})"
            case Operation(operator="equal"):
                return self.equality(*e.arguments)
            case Operation(operator="not_equal"):
                return f"!({self.equality(*e.arguments)})"
            case Operation(operator="less" | "less_equal" | "greater" | "greater_equal"):
                a, b = map(self.number, e.arguments)
                return f"({a}{_ORDER[e.operator]}{b})"
            case Conditional():
                parts = map(self.condition, (e.condition, e.then, e.otherwise))
                return "({} ? {} : {})".format(*parts)
            case Switch() if not e.reference.primed:
                return self.choice(e, self.condition)
        raise NotDirect

    def equality(self, a: Expression, b: Expression) -> str:
        """The test that two expressions are equal."""
        for one, other in ((a, b), (b, a)):
            if isinstance(one, Reference) and not one.primed and isinstance(other, Constant):
                return self.is_value(self.features[one.name], other.value)
        if isinstance(a, Reference) and isinstance(b, Reference) and not a.primed and not b.primed:
            first, second = self.features[a.name], self.features[b.name]
            if first.values == second.values:
                return f"{self.names[a.name]}={self.names[b.name]}"
        try:
            return f"({self.number(a)}={self.number(b)})"
        except NotDirect:
            return f"({self.condition(a)}={self.condition(b)})"

    def number(self, e: Expression) -> str:
        """A number, in parentheses where needed."""
        match e:
            case Constant(value=Fraction() as value):
                return number_text(value)
            case Parameter():
                return self.parameters[e.name]
            case Reference() if not e.primed and self.plain[e.name]:
                return self.names[e.name]
            case Conditional():
                then, otherwise = self.number(e.then), self.number(e.otherwise)
                return f"({self.condition(e.condition)} ? {then} : {otherwise})"
            case Switch() if not e.reference.primed:
                return self.choice(e, self.number)
            case Operation(operator="add"):
                text = " + ".join(map(self.number, e.arguments))
                return "({})".format(text.replace(" + -", " - "))
            case Operation(operator="multiply"):
                return "({})".format("*".join(map(self.number, e.arguments)))
            case Operation(operator="negate"):
                return f"-({self.number(e.arguments[0])})"
            case Operation(operator="minimum" | "maximum"):
                word = e.operator[:3]
                return f"{word}({', '.join(map(self.number, e.arguments))})"
            case Operation(operator="absolute"):
                inner = self.number(e.arguments[0])
                return f"max({inner}, -({inner}))"
            case Operation(operator="divide" | "floor_divide" | "modulo" | "power"):
                a, b = map(self.number, e.arguments)
                if e.operator == "divide":
                    return f"({a}/{b})"
                if e.operator == "floor_divide":
                    return f"floor({a}/{b})"
                return f"({a} - {b}*floor({a}/{b}))" if e.operator == "modulo" else f"pow({a}, {b})"
        raise NotDirect

    def choice(self, e: Switch, text: Callable[[Expression], str]) -> str:
        """A decision over the values of a variable, as nested conditionals."""
        feature = self.features[e.reference.name]
        groups: dict[str, list[Value]] = {}
        for value in feature.values:
            groups.setdefault(text(case_of(e, value)), []).append(value)
        *cases, (result, _) = groups.items()
        for part, values in reversed(cases):
            result = f"({self.is_one_of(feature, values)} ? {part} : {result})"
        return result


_ORDER: Final = {"less": "<", "less_equal": "<=", "greater": ">", "greater_equal": ">="}


def number_text(value: Fraction) -> str:
    """An exact number."""
    if value.denominator == 1:
        return str(value.numerator)
    text = decimal_text(value)
    if text is not None and len(text) <= 12:
        return text
    return f"({value.numerator}/{value.denominator})"


def _is_range(feature: Feature) -> bool:
    values = feature.values
    if any(isinstance(v, bool) or not isinstance(v, int) for v in values):
        return False
    first = values[0]
    return isinstance(first, int) and values == tuple(range(first, first + len(values)))


def _is_whole(e: Expression) -> bool:
    """Whether PRISM sees that a number is an integer: no division and no fraction in it."""
    match e:
        case Constant(value=Fraction() as value):
            return value.denominator == 1
        case Reference():
            return True
        case Operation(operator="add" | "multiply" | "negate" | "minimum" | "maximum" | "absolute"):
            return all(map(_is_whole, e.arguments))
        case Conditional():
            return _is_whole(e.then) and _is_whole(e.otherwise)
    return False


def _is_truth(feature: Feature) -> bool:
    return feature.values == (False, True) and isinstance(feature.values[0], bool)
