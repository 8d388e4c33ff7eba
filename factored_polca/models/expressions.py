"""Expressions over features: the one language in which every part of a model is written.

An expression is a finite tree, immutable and compared by structure:

    e ::= c                          a constant: a rational, a truth value or the name of a value
        | x | x' | o                 a feature now, the same feature next, an observation feature
        | p                          a named parameter of the model
        | op(e_1, ..., e_n)          an operator of `factored_polca.models.scalars.OPERATORS`
        | if e_0 then e_1 else e_2   only the chosen branch counts
        | switch x {v: e_v, ..., e}  a decision-tree node; `e` for the values not listed
        | {e_1: q_1, ..., e_n: q_n}  a *lottery*: value e_i with probability q_i (equal values add up)

A conditional distribution is an expression whose chosen branch is a lottery, or a plain value
(probability 1).  Evaluation is partial: `1/x` at x = 0, or `x + 1` where x + 1 is no value of the
feature it is assigned to, is `Undefined` with a reason; an undefined part in a branch that is not
taken, or behind a deciding `and`/`or`, is harmless.  All numbers are rationals.
"""

from __future__ import annotations

import numbers
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Any, Final

from factored_polca.models.rational_functions import RationalFunction
from factored_polca.models.scalars import OPERATORS, Scalar, Undefined, Value, apply_operator


class Operators:
    """Python operators that build expressions; `==` stays equality of structure, see `is_`."""

    __slots__ = ()

    def __add__(self, other: ExpressionLike) -> Expression:
        return operation("add", self, other)

    def __radd__(self, other: ExpressionLike) -> Expression:
        return operation("add", other, self)

    def __sub__(self, other: ExpressionLike) -> Expression:
        return operation("add", self, operation("negate", other))

    def __rsub__(self, other: ExpressionLike) -> Expression:
        return operation("add", other, operation("negate", self))

    def __mul__(self, other: ExpressionLike) -> Expression:
        return operation("multiply", self, other)

    def __rmul__(self, other: ExpressionLike) -> Expression:
        return operation("multiply", other, self)

    def __truediv__(self, other: ExpressionLike) -> Expression:
        return operation("divide", self, other)

    def __rtruediv__(self, other: ExpressionLike) -> Expression:
        return operation("divide", other, self)

    def __floordiv__(self, other: ExpressionLike) -> Expression:
        return operation("floor_divide", self, other)

    def __mod__(self, other: ExpressionLike) -> Expression:
        return operation("modulo", self, other)

    def __pow__(self, other: ExpressionLike) -> Expression:
        return operation("power", self, other)

    def __neg__(self) -> Expression:
        return operation("negate", self)

    def __abs__(self) -> Expression:
        return operation("absolute", self)

    def __lt__(self, other: ExpressionLike) -> Expression:
        return operation("less", self, other)

    def __le__(self, other: ExpressionLike) -> Expression:
        return operation("less_equal", self, other)

    def __gt__(self, other: ExpressionLike) -> Expression:
        return operation("greater", self, other)

    def __ge__(self, other: ExpressionLike) -> Expression:
        return operation("greater_equal", self, other)

    def __and__(self, other: ExpressionLike) -> Expression:
        return operation("and", self, other)

    def __rand__(self, other: ExpressionLike) -> Expression:
        return operation("and", other, self)

    def __or__(self, other: ExpressionLike) -> Expression:
        return operation("or", self, other)

    def __ror__(self, other: ExpressionLike) -> Expression:
        return operation("or", other, self)

    def __invert__(self) -> Expression:
        return operation("not", self)

    def is_(self, other: Expression | Value) -> Expression:
        """The condition that this equals `other`; a `str` is a value's name, not a text to parse."""
        constant = Constant(other) if isinstance(other, str) else other
        return operation("equal", self, constant)

    def is_in(self, values: Iterable[Value]) -> Expression:
        """The condition that this equals one of `values`."""
        tests = [self.is_(value) for value in values]
        return tests[0] if len(tests) == 1 else disjunction(tests)

    def _sympy_(self) -> Any:
        from factored_polca.models.symbols import to_sympy

        return to_sympy(as_expression(self))


class Expression(Operators):
    """Base of the seven node classes below, which are final."""

    __slots__ = ("_hash",)
    _hash: int

    def _key(self) -> tuple[object, ...]:
        raise AssertionError("every node class defines its key")

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if self is other:
            return True
        if type(self) is not type(other):
            return False
        assert isinstance(other, Expression)
        return self._hash == other._hash and self._key() == other._key()

    def _seal(self) -> None:
        object.__setattr__(self, "_hash", hash((type(self).__name__, self._key())))

    def __str__(self) -> str:
        from factored_polca.models.printing import to_text

        return to_text(self)

    def __reduce__(self) -> tuple[object, ...]:
        values = tuple(getattr(self, name) for name in self.__match_args__)  # type: ignore[attr-defined]
        return type(self), values

    def __bool__(self) -> bool:
        raise TypeError(
            "an expression has no truth value in Python: combine conditions with & | ~ and "
            "write one comparison at a time"
        )


@dataclass(frozen=True, eq=False, slots=True)
class Constant(Expression):
    """A rational, a truth value or the name of a value."""

    value: Scalar

    def __post_init__(self) -> None:
        if isinstance(self.value, int) and not isinstance(self.value, bool):
            object.__setattr__(self, "value", Fraction(self.value))
        self._seal()

    def _key(self) -> tuple[object, ...]:
        return (type(self.value), self.value)


@dataclass(frozen=True, eq=False, slots=True)
class Reference(Expression):
    """A feature now, a feature next (`primed`) or an observation feature."""

    name: str
    primed: bool = False

    def __post_init__(self) -> None:
        self._seal()

    def _key(self) -> tuple[object, ...]:
        return (self.name, self.primed)


@dataclass(frozen=True, eq=False, slots=True)
class Parameter(Expression):
    """A named number of the model."""

    name: str

    def __post_init__(self) -> None:
        self._seal()

    def _key(self) -> tuple[object, ...]:
        return (self.name,)


@dataclass(frozen=True, eq=False, slots=True)
class Operation(Expression):
    """Operator `operator` of `OPERATORS` on `arguments`; build it with `operation`."""

    operator: str
    arguments: tuple[Expression, ...]

    def __post_init__(self) -> None:
        self._seal()

    def _key(self) -> tuple[object, ...]:
        return (self.operator, self.arguments)


@dataclass(frozen=True, eq=False, slots=True)
class Conditional(Expression):
    """`then` where `condition` holds, `otherwise` elsewhere."""

    condition: Expression
    then: Expression
    otherwise: Expression

    def __post_init__(self) -> None:
        self._seal()

    def _key(self) -> tuple[object, ...]:
        return (self.condition, self.then, self.otherwise)


@dataclass(frozen=True, eq=False, slots=True)
class Switch(Expression):
    """A decision-tree node: the case of the reference's value, or `otherwise`."""

    reference: Reference
    cases: tuple[tuple[Value, Expression], ...]
    otherwise: Expression | None = None

    def __post_init__(self) -> None:
        self._seal()

    def _key(self) -> tuple[object, ...]:
        typed = tuple((type(value), value, case) for value, case in self.cases)
        return (self.reference, typed, self.otherwise)


@dataclass(frozen=True, eq=False, slots=True)
class Lottery(Expression):
    """A distribution: pairs (value, probability)."""

    outcomes: tuple[tuple[Expression, Expression], ...]

    def __post_init__(self) -> None:
        self._seal()

    def _key(self) -> tuple[object, ...]:
        return (self.outcomes,)


ExpressionLike = Any
"""What `as_expression` takes: an expression, a feature, a number, a truth value, a text, or sympy."""

TRUE: Final = Constant(True)
FALSE: Final = Constant(False)
ZERO: Final = Constant(Fraction(0))
ONE: Final = Constant(Fraction(1))


def as_expression(thing: ExpressionLike) -> Expression:
    """`thing` as an expression.

    A `str` is read in the expression language; a `float` means its shortest decimal (0.1 is 1/10).

    Raises:
        TypeError: `thing` is none of these.
        ModelError: a text that is no expression.
    """
    if isinstance(thing, Expression):
        return thing
    if isinstance(thing, bool):
        return Constant(thing)
    if isinstance(thing, RationalFunction):
        return Constant(thing)
    if isinstance(thing, numbers.Rational):
        return Constant(Fraction(int(thing.numerator), int(thing.denominator)))
    if isinstance(thing, float):
        if thing != thing or thing in (float("inf"), float("-inf")):
            raise TypeError(f"{thing} is not a rational number")
        return Constant(Fraction(repr(thing)))
    if isinstance(thing, Decimal):
        return Constant(Fraction(thing))
    if isinstance(thing, str):
        from factored_polca.models.language import parse

        return parse(thing)
    if isinstance(thing, Operators):
        return Reference(thing.name)  # type: ignore[attr-defined]
    if type(thing).__module__.partition(".")[0] == "sympy":
        from factored_polca.models.symbols import from_sympy

        return from_sympy(thing)
    if isinstance(thing, Mapping):
        return lottery(thing)
    raise TypeError(
        f"{thing!r} is no expression: give an expression, a feature, a number, a truth value, "
        "a text in the expression language, a mapping {value: probability} or a sympy expression"
    )


def operation(name: str, *arguments: ExpressionLike) -> Expression:
    """Operator `name` on `arguments`: nested associative operators are flattened, constants folded."""
    parts = [as_expression(argument) for argument in arguments]
    if OPERATORS[name].associative:
        flat: list[Expression] = []
        for part in parts:
            if isinstance(part, Operation) and part.operator == name:
                flat.extend(part.arguments)
            else:
                flat.append(part)
        parts = flat
    return grouped(name, parts)


def grouped(name: str, parts: Sequence[Expression]) -> Expression:
    """Operator `name` on `parts` as they are bracketed; constants are folded."""
    if OPERATORS[name].associative:
        parts = _fold_start(name, parts)
        if len(parts) == 1:
            return parts[0]
    constants = [part.value for part in parts if isinstance(part, Constant)]
    if len(constants) == len(parts):
        result = apply_operator(name, constants)
        if not isinstance(result, Undefined):
            return Constant(result)
    return Operation(name, tuple(parts))


def _fold_start(name: str, parts: Sequence[Expression]) -> list[Expression]:
    """`parts` with the constants at its start combined, as reading from left to right does."""
    first, rest = parts[0], 1
    while rest < len(parts):
        second = parts[rest]
        if not (isinstance(first, Constant) and isinstance(second, Constant)):
            break
        result = apply_operator(name, (first.value, second.value))
        if isinstance(result, Undefined):
            break
        first, rest = Constant(result), rest + 1
    return [first, *parts[rest:]]


def conjunction(conditions: Iterable[ExpressionLike]) -> Expression:
    """All of `conditions`; true if there are none."""
    parts = list(conditions)
    return operation("and", *parts) if parts else TRUE


def disjunction(conditions: Iterable[ExpressionLike]) -> Expression:
    """At least one of `conditions`; false if there are none."""
    parts = list(conditions)
    return operation("or", *parts) if parts else FALSE


def conditional(condition: ExpressionLike, then: ExpressionLike, otherwise: ExpressionLike) -> Expression:
    """`then` where `condition` holds, `otherwise` elsewhere."""
    return Conditional(as_expression(condition), as_expression(then), as_expression(otherwise))


def named(value: ExpressionLike) -> Expression:
    """A feature value or an expression; here a `str` is the name of a value."""
    return Constant(value) if isinstance(value, str) else as_expression(value)


def lottery(outcomes: Mapping[Any, ExpressionLike] | Iterable[tuple[Any, ExpressionLike]]) -> Lottery:
    """The distribution with the given (value, probability) pairs; a `str` key names a value."""
    pairs = outcomes.items() if isinstance(outcomes, Mapping) else outcomes
    return Lottery(tuple((named(value), as_expression(chance)) for value, chance in pairs))


def children(expression: Expression) -> tuple[Expression, ...]:
    """The direct parts of `expression`."""
    match expression:
        case Operation():
            return expression.arguments
        case Conditional():
            return (expression.condition, expression.then, expression.otherwise)
        case Switch():
            parts = tuple(case for _, case in expression.cases)
            tail = () if expression.otherwise is None else (expression.otherwise,)
            return (expression.reference, *parts, *tail)
        case Lottery():
            return tuple(part for pair in expression.outcomes for part in pair)
    return ()


def subexpressions(*roots: Expression) -> Iterator[Expression]:
    """Every distinct part of `roots`, each once, parts after the whole."""
    seen: set[Expression] = set()
    stack = list(reversed(roots))
    while stack:
        expression = stack.pop()
        if expression in seen:
            continue
        seen.add(expression)
        yield expression
        stack.extend(reversed(children(expression)))


def references(*roots: Expression) -> set[Reference]:
    """The references in `roots`."""
    return {part for part in subexpressions(*roots) if isinstance(part, Reference)}


def rewrite(expression: Expression, leaf: Callable[[Expression], Expression]) -> Expression:
    """`expression` with `leaf` applied to each reference, parameter and constant.

    Parts in which nothing changes stay the same objects, and nothing is flattened anew: a shared
    part is visited once, however often it occurs.
    """
    new: dict[Expression, Expression] = {}
    for e in parts_first(expression):
        parts = children(e)
        if parts and all(new[part] is part for part in parts):
            new[e] = e
            continue
        result: Expression
        match e:
            case Operation():
                result = Operation(e.operator, tuple(new[a] for a in e.arguments))
            case Conditional():
                result = Conditional(new[e.condition], new[e.then], new[e.otherwise])
            case Switch():
                reference = new[e.reference]
                if not isinstance(reference, Reference):
                    reference = e.reference
                otherwise = None if e.otherwise is None else new[e.otherwise]
                cases = tuple((value, new[case]) for value, case in e.cases)
                result = Switch(reference, cases, otherwise)
            case Lottery():
                result = Lottery(tuple((new[v], new[q]) for v, q in e.outcomes))
            case _:
                result = leaf(e)
        new[e] = result
    return new[expression]


def depth(expression: Expression) -> int:
    """Length of the longest path from `expression` to a leaf; computed without recursion."""
    deepest: dict[Expression, int] = {}
    for part in parts_first(expression):
        deepest[part] = 1 + max((deepest[child] for child in children(part)), default=0)
    return deepest[expression]


def parts_first(root: Expression) -> list[Expression]:
    """The parts of `root`, each once, every part before its whole; without recursion."""
    state: dict[Expression, bool] = {}
    order: list[Expression] = []
    stack: list[tuple[Expression, bool]] = [(root, False)]
    while stack:
        part, done = stack.pop()
        if done:
            order.append(part)
            continue
        if part in state:
            continue
        state[part] = True
        stack.append((part, True))
        stack.extend((child, False) for child in children(part))
    return order
