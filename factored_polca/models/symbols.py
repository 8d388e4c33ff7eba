"""Expressions to and from sympy, for people who write models in Python.

A feature x is the symbol `x`, its next value the symbol `x'`; the name of a value is a symbol in
double quotes.  sympy is imported only here and only when used.  Lotteries and switches have no
sympy form on the way out, except that a switch becomes a `Piecewise`.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from factored_polca.models.expressions import (
    Conditional,
    Constant,
    Expression,
    Lottery,
    Operation,
    Parameter,
    Reference,
    Switch,
    operation,
)

_FROM = {
    "Add": "add",
    "Mul": "multiply",
    "Pow": "power",
    "Mod": "modulo",
    "Abs": "absolute",
    "Min": "minimum",
    "Max": "maximum",
    "Equality": "equal",
    "Unequality": "not_equal",
    "StrictLessThan": "less",
    "LessThan": "less_equal",
    "StrictGreaterThan": "greater",
    "GreaterThan": "greater_equal",
    "And": "and",
    "Or": "or",
    "Not": "not",
}


def from_sympy(thing: Any) -> Expression:
    """The expression that a sympy expression over feature symbols denotes.

    Floats mean their shortest decimal.  `Piecewise` becomes nested conditionals and must end with
    a `True` case.

    Raises:
        TypeError: a sympy construct that has no counterpart; the message lists those that have.
    """
    import sympy

    if isinstance(thing, sympy.Symbol):
        name = thing.name
        if len(name) > 1 and name[0] == name[-1] == '"':
            return Constant(name[1:-1])
        return Reference(name[:-1], True) if name.endswith("'") else Reference(name)
    if thing is sympy.true or thing is sympy.false:
        return Constant(bool(thing))
    if isinstance(thing, sympy.Rational):
        return Constant(Fraction(int(thing.p), int(thing.q)))
    if isinstance(thing, sympy.Float):
        return Constant(Fraction(repr(float(thing))))
    if isinstance(thing, sympy.Piecewise):
        *cases, (last, condition) = thing.args
        if condition != sympy.true:
            raise TypeError(f"{thing}: the last case of a Piecewise must be (value, True)")
        result = from_sympy(last)
        for value, test in reversed(cases):
            result = Conditional(from_sympy(test), from_sympy(value), result)
        return result
    kind = type(thing).__name__
    if kind == "ITE":
        condition, then, otherwise = thing.args
        return Conditional(from_sympy(condition), from_sympy(then), from_sympy(otherwise))
    if kind in _FROM:
        return operation(_FROM[kind], *(from_sympy(argument) for argument in thing.args))
    listed = ", ".join([*_FROM, "Piecewise", "ITE"])
    raise TypeError(f"sympy's {kind} can't be used in a model; allowed are {listed}, symbols and rationals")


def to_sympy(expression: Expression) -> Any:
    """The sympy expression of `expression`.

    Raises:
        TypeError: `expression` holds a lottery, which sympy can't express.
    """
    import sympy

    functions: dict[str, Any] = {
        "add": sympy.Add,
        "multiply": sympy.Mul,
        "divide": lambda a, b: a / b,
        "floor_divide": lambda a, b: sympy.floor(a / b),
        "modulo": sympy.Mod,
        "power": sympy.Pow,
        "negate": lambda a: -a,
        "absolute": sympy.Abs,
        "minimum": sympy.Min,
        "maximum": sympy.Max,
        "equal": sympy.Eq,
        "not_equal": sympy.Ne,
        "less": sympy.Lt,
        "less_equal": sympy.Le,
        "greater": sympy.Gt,
        "greater_equal": sympy.Ge,
        "and": sympy.And,
        "or": sympy.Or,
        "not": sympy.Not,
    }

    def visit(e: Expression) -> Any:
        match e:
            case Constant():
                if isinstance(e.value, bool):
                    return sympy.true if e.value else sympy.false
                if isinstance(e.value, str):
                    return sympy.Symbol(f'"{e.value}"')
                return sympy.Rational(e.value.numerator, e.value.denominator)
            case Reference():
                return sympy.Symbol(e.name + "'" if e.primed else e.name)
            case Parameter():
                return sympy.Symbol(e.name)
            case Operation():
                return functions[e.operator](*(visit(a) for a in e.arguments))
            case Conditional():
                return sympy.Piecewise((visit(e.then), visit(e.condition)), (visit(e.otherwise), True))
            case Switch():
                pairs = [(visit(case), visit(e.reference.is_(value))) for value, case in e.cases]
                if e.otherwise is not None:
                    pairs.append((visit(e.otherwise), sympy.true))
                return sympy.Piecewise(*pairs)
            case Lottery():
                raise TypeError("a distribution with several outcomes has no sympy form")
        raise TypeError(f"{type(e).__name__} is no expression")

    return visit(expression)
