"""Decision processes whose numbers are rational functions of parameters that stay symbols.

Parameters t are kept as symbols when the model is compiled; its probabilities and rewards are then
elements of the field Q(t) (`factored_polca.models.rational_functions`), and rows sum to 1 as functions.
Minimisation draws, in each round anew, a random point t_0 modulo the round's prime, and works with the
residues f(t_0) (DESIGN 4, "Parameters").  Two rows that are equal as functions are equal at every point,
so the partition is stable for every admissible setting of the parameters.  Two that are not have, with
denominators cleared, a difference that is a polynomial of degree d in t and is 0 at a random point with
probability at most d / p (Schwartz 1980; Zippel 1979): the partition is the coarsest stable one for
all settings but those on the zeros of finitely many such polynomials, a set of measure zero.

*Bounds.*  Let row diagram i of a primitive have the entries n_v / d_v in its rows, D_i be the product of
its different denominators, and |.|_1 the sum of a polynomial's absolute coefficients, which is
submultiplicative.  An entry T(x, k) P(o | x', x), times prod_i D_i, is a polynomial of degree at most
sum_i (max deg n + deg D_i), and its |.|_1 is at most prod_i max over rows of sum_v |n_v|_1 |D_i|_1.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from math import gcd, lcm
from typing import Any

from factored_polca.minimisation import DecisionProcess, flat_process
from factored_polca.models import Fault, Model, ModelError
from factored_polca.models.rational_functions import (
    FunctionField,
    Polynomial,
    RationalFunction,
    functions_in,
)
from factored_polca.parametric.conditions import Condition, conditions_of
from factored_polca.parametric.substitution import Substitution, rows_of, used_primitives
from factored_polca.symbolic import SymbolicModel, compile_model
from factored_polca.symbolic.rows import Row


def kept_parameters(model: Model, names: Iterable[str] | None = None) -> tuple[str, ...]:
    """The parameters that shall stay symbols: those named, or all of the model's.

    Raises:
        ModelError: an unknown name, or no parameter; the message lists those there are.
    """
    known = [name for name, _ in model.parameters]
    asked = known if names is None else list(dict.fromkeys(names))
    listed = ", ".join(known) or "none"
    unknown = [name for name in asked if name not in known]
    if unknown or not asked:
        what = f"no parameter {unknown[0]!r}" if unknown else "no parameter to keep as a symbol"
        raise ModelError([Fault(what, ("parameters",), f"the model's parameters are {listed}")])
    return tuple(asked)


def compile_parametric(model: Model, names: Iterable[str] | None = None, **options: Any) -> SymbolicModel:
    """`compile_model` with some parameters kept as symbols; all of them if `names` is None.

    `options` are those of `compile_model`.

    Raises:
        ModelError: also where such a parameter stands in anything but + - * / and integer powers.
        LimitReached: functions of more degrees, terms or digits than allowed.
    """
    kept = kept_parameters(model, names)
    field = FunctionField(kept)
    return compile_model(model, parameters={name: field.symbol(name) for name in kept}, **options)


def field_of(symbolic: SymbolicModel) -> FunctionField:
    """The functions that the numbers of a model compiled with symbols are.

    Raises:
        ModelError: it was compiled without any.
    """
    for value in symbolic.compiler.parameters.values():
        if isinstance(value, RationalFunction):
            return value.field
    raise ModelError(f"{symbolic.model.name} was compiled without symbols: use compile_parametric")


@dataclass(frozen=True)
class DrawnNumbers:
    """The numbers of a process as the minimiser draws them; see the module's docstring."""

    process: DecisionProcess
    field: FunctionField

    def draw(self, source: random.Random, prime: int) -> DecisionProcess:
        """The process at a random point modulo `prime` where no denominator vanishes."""
        while True:
            point = {name: source.randrange(1, prime) for name in self.field.names}

            def residue(value: Fraction, point: Mapping[str, int] = point) -> Fraction:
                if isinstance(value, RationalFunction):
                    return Fraction(value.residue(point, prime))
                return value

            try:
                return Substitution(residue).process(self.process)
            except ZeroDivisionError:  # with a chance of degree / prime for each denominator
                continue

    @cached_property
    def _tables(self) -> list[list[list[Row]]]:
        """[primitive][row diagram][row] numbers."""
        result = []
        for primitive in used_primitives(self.process):
            tables = [list(row.rows) for p, row in rows_of(self.process) if p == primitive]
            result.append(tables)
        return result

    @cached_property
    def _terms(self) -> list[list[Sequence[Fraction]]]:
        """[primitive][reward term] values."""
        rewards = self.process.rewards
        return [[term.values for term in rewards[p]] for p in used_primitives(self.process)]

    @cached_property
    def degree(self) -> int:
        """Of entries and rewards in the parameters, denominators cleared; those count twice, since only
        points are used where they do not vanish."""
        rows = [
            sum(_top_degree(table) + 2 * _bottom_degree(table) for table in tables)
            for tables in self._tables
        ]
        rewards = [
            max((_top_degree([v]) for v in terms), default=0) + sum(2 * _bottom_degree([v]) for v in terms)
            for terms in self._terms
        ]
        return max((*rows, *rewards), default=0)

    @cached_property
    def bits(self) -> int:
        """Of the largest coefficient of a cleared difference of two entries, or of two rewards."""
        largest = 1
        for tables in self._tables:
            size = 1
            for table in tables:
                size *= max(sum(_norm(_over(q)) for q in row) for row in table) * _bottom_norm(table)
            largest = max(largest, size)
        for terms in self._terms:
            size = sum(max(_norm(_over(value)) for value in values) for values in terms)
            for values in terms:
                size *= _bottom_norm([values])
            largest = max(largest, size)
        return largest.bit_length() + 1

    @cached_property
    def denominator(self) -> int:
        """A multiple of all integers that denominators are divisible by."""
        numbers = {q for tables in self._tables for table in tables for row in table for q in row}
        numbers |= {q for terms in self._terms for values in terms for q in values}
        return lcm(*(gcd(*(c for _, c in _under(q))) for q in numbers))


@dataclass(frozen=True)
class ParametricProcess:
    """A decision process with numbers that are functions of parameters, and where these make sense.

    `conditions` describe the admissible settings: probabilities in [0, 1], no division by 0.
    """

    process: DecisionProcess
    field: FunctionField
    conditions: tuple[Condition, ...]

    @property
    def parameters(self) -> tuple[str, ...]:
        """The parameters that stay symbols."""
        return self.field.names

    @property
    def nominal(self) -> dict[str, Fraction]:
        """The values that the model itself gives them."""
        values = dict(self.process.symbolic.model.parameters)
        return {name: values[name] for name in self.parameters}

    def violated(self, values: Mapping[str, Fraction]) -> list[Condition]:
        """The conditions that a setting of all parameters does not meet."""
        return [condition for condition in self.conditions if not condition.holds(values)]

    def at(self, values: Mapping[str, Fraction]) -> DecisionProcess:
        """The process at a setting of the parameters; those that are not set keep the model's value.

        Raises:
            ModelError: a setting that is not admissible, or an unknown parameter.
        """
        setting = checked_setting(self, values)
        model = self.process.symbolic.model.with_parameters(setting)

        def value(number: Fraction) -> Fraction:
            return number.at(setting) if isinstance(number, RationalFunction) else number

        return Substitution(value).process(self.process, model)


def parametric_process(process: DecisionProcess) -> ParametricProcess:
    """A decision process over a model compiled with symbols, made ready for minimisation.

    It may be the flat process or a subtask whose children are primitive actions.

    Raises:
        ModelError: a choice that is a child's policy: which one is best depends on the parameters.
    """
    field = field_of(process.symbolic)
    children = [choice.name for choice in process.choices if choice.policy is not None]
    if children:
        raise ModelError(
            [
                Fault(
                    f"{children[0]!r} is the policy of a child, which depends on the parameters' values",
                    ("parameters",),
                    "keep parameters as symbols in flat models and in tasks whose children are primitive",
                )
            ]
        )
    opened = replace(process, open_numbers=DrawnNumbers(process, field))
    return ParametricProcess(opened, field, conditions_of(process, field))


def parametric_flat_process(
    model: Model, names: Iterable[str] | None = None, actions: Sequence[str] | None = None, **options: Any
) -> ParametricProcess:
    """The process of a model itself with parameters kept as symbols; see `compile_parametric`."""
    return parametric_process(flat_process(compile_parametric(model, names, **options), actions))


def checked_setting(process: ParametricProcess, values: Mapping[str, Fraction]) -> dict[str, Fraction]:
    """A value for every parameter: those of `values`, the model's for the others.

    Raises:
        ModelError: unknown parameters, or a setting that is not admissible; all violated conditions.
    """
    unknown = [name for name in values if name not in process.parameters]
    if unknown:
        listed = ", ".join(process.parameters)
        raise ModelError(
            [Fault(f"no parameter {unknown[0]!r} was kept", ("parameters",), f"kept are {listed}")]
        )
    setting = {**process.nominal, **values}
    violated = process.violated(setting)
    if violated:
        shown = ", ".join(f"{name} = {value}" for name, value in setting.items())
        raise ModelError(
            [
                Fault(f"at {shown} the condition {c} does not hold", c.path, "give an admissible setting")
                for c in violated
            ]
        )
    return setting


# -- degrees and sizes of numbers ------------------------------------------------------------------


def _over(value: Fraction) -> Polynomial:
    return value.over if isinstance(value, RationalFunction) else (((), value.numerator),)


def _under(value: Fraction) -> Polynomial:
    return value.under if isinstance(value, RationalFunction) else (((), value.denominator),)


def _norm(polynomial: Polynomial) -> int:
    return sum(abs(coefficient) for _, coefficient in polynomial)


def _top_degree(table: Sequence[Sequence[Fraction]]) -> int:
    found = functions_in(q for row in table for q in row)
    return max((sum(exponents) for f in found for exponents, _ in f.over), default=0)


def _denominators(table: Sequence[Sequence[Fraction]]) -> set[Polynomial]:
    return {_under(q) for row in table for q in row}


def _bottom_degree(table: Sequence[Sequence[Fraction]]) -> int:
    return sum(max(sum(exponents) for exponents, _ in d) for d in _denominators(table))


def _bottom_norm(table: Sequence[Sequence[Fraction]]) -> int:
    result = 1
    for d in _denominators(table):
        result *= _norm(d)
    return result
