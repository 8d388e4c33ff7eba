"""Models whose constants are functions of parameters, written out as expressions over these.

A model may be built in Python from symbols of a `FunctionField` in place of numbers: arithmetic on them
leaves `Constant`s that hold rational functions.  Here each becomes an expression with `Parameter`s, so that
the model can be written, enumerated and set to other values like one that was written with parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction

from factored_polca.models.expressions import (
    ONE,
    Constant,
    Expression,
    Parameter,
    operation,
    rewrite,
)
from factored_polca.models.model import Action, InitialBelief, Model, replace_fields
from factored_polca.models.rational_functions import Polynomial, RationalFunction


def function_expression(function: RationalFunction) -> Expression:
    """A function as an expression over its parameters."""
    names = function.field.names
    top, bottom = _polynomial(names, function.over), _polynomial(names, function.under)
    return top if bottom == ONE else operation("divide", top, bottom)


def _polynomial(names: Sequence[str], polynomial: Polynomial) -> Expression:
    terms: list[Expression] = []
    for exponents, coefficient in polynomial:
        factors: list[Expression] = [
            Parameter(name) if exponent == 1 else operation("power", Parameter(name), exponent)
            for name, exponent in zip(names, exponents, strict=True)
            if exponent
        ]
        if abs(coefficient) != 1 or not factors:
            factors.insert(0, Constant(Fraction(abs(coefficient))))
        term = factors[0] if len(factors) == 1 else operation("multiply", *factors)
        terms.append(operation("negate", term) if coefficient < 0 else term)
    return terms[0] if len(terms) == 1 else operation("add", *terms)


def with_parameters_written_out(model: Model, values: Mapping[str, Fraction]) -> Model:
    """`model` with functions written out, and with the parameters that they are of, set to `values`."""

    def leaf(e: Expression) -> Expression:
        if isinstance(e, Constant) and isinstance(e.value, RationalFunction):
            return function_expression(e.value)
        return e

    def out(e: Expression) -> Expression:
        return rewrite(e, leaf)

    def action(a: Action) -> Action:
        return Action(
            a.name,
            [(name, out(e)) for name, e in a.effects],
            applicable=out(a.applicable),
            rewards=[out(e) for e in a.rewards],
            senses=[(name, out(e)) for name, e in a.senses],
        )

    initial = InitialBelief(
        [(name, out(e)) for name, e in model.initial.distributions],
        [out(e) for e in model.initial.factors],
    )
    return replace_fields(
        model,
        actions=tuple(map(action, model.actions)),
        rewards=tuple(map(out, model.rewards)),
        terminal=out(model.terminal),
        initial=initial,
        parameters=(*model.parameters, *values.items()),
    )
