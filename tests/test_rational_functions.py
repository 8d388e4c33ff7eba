"""Rational functions of parameters: a field, held against evaluation at random points; and its limits."""

from __future__ import annotations

import operator
from fractions import Fraction
from random import Random

import pytest
import sympy

from factored_polca.models import LimitReached, Parameter, parse
from factored_polca.models.rational_functions import (
    FunctionField,
    RationalFunction,
    SymbolUsed,
)
from factored_polca.models.scope import Scope
from factored_polca.models.written_out import function_expression

NAMES = ("p", "q")
FIELD = FunctionField(NAMES)
P, Q = FIELD.symbol("p"), FIELD.symbol("q")
OPERATORS = (operator.add, operator.sub, operator.mul, operator.truediv)


def random_value(random: Random) -> Fraction:
    return Fraction(random.randint(-9, 9), random.randint(1, 7))


def random_tree(random: Random, depth: int) -> tuple[Fraction, list[object]]:
    """A function, and the same thing as a list of (operator, left, right) or a leaf."""
    if depth == 0:
        leaf = random.choice([P, Q, random_value(random)])
        return leaf, [leaf]
    left, right = random_tree(random, depth - 1), random_tree(random, depth - 1)
    function = random.choice(OPERATORS)
    if function is operator.truediv and right[0] == 0:
        function = operator.add
    return function(left[0], right[0]), [function, left[1], right[1]]


def evaluate(tree: list[object], point: dict[str, Fraction]) -> Fraction:
    if len(tree) == 1:
        leaf = tree[0]
        return point["p"] if leaf is P else point["q"] if leaf is Q else leaf
    return tree[0](evaluate(tree[1], point), evaluate(tree[2], point))


@pytest.mark.parametrize("seed", range(200))
def test_arithmetic_is_that_of_values(seed: int) -> None:
    random = Random(seed)
    function, tree = random_tree(random, random.randint(1, 4))
    for _ in range(5):
        point = {name: random_value(random) for name in NAMES}
        try:
            expected = evaluate(tree, point)
        except ZeroDivisionError:
            continue
        found = function.at(point) if isinstance(function, RationalFunction) else function
        assert found == expected


@pytest.mark.parametrize("seed", range(40))
def test_residues_are_those_of_values(seed: int) -> None:
    random, prime = Random(seed), 2**61 - 1
    function, tree = random_tree(random, 3)
    point = {name: random.randrange(prime) for name in NAMES}
    if isinstance(function, RationalFunction):
        exact = evaluate(tree, {name: Fraction(value) for name, value in point.items()})
        expected = exact.numerator * pow(exact.denominator, -1, prime) % prime
        assert function.residue(point, prime) == expected


def test_equal_functions_are_equal_however_they_were_made() -> None:
    assert (P * P - 1) / (P - 1) == P + 1
    assert hash((P * P - 1) / (P - 1)) == hash(P + 1)
    assert (P + Q) ** 2 == P**2 + 2 * P * Q + Q**2
    assert P / Q != Q / P
    assert Fraction(1, 2) not in (P, Q)
    assert P not in (Fraction(1, 2), Fraction(0))
    assert FIELD.symbol("p") == P


def test_a_constant_function_is_a_fraction() -> None:
    for value in (P - P + Fraction(1, 3), P / (3 * P), sum([P / 3, (1 - P) / 3], Fraction(0))):
        assert type(value) is Fraction
        assert value == Fraction(1, 3)


def test_numbers_on_either_side() -> None:
    point = {"p": Fraction(2, 5), "q": Fraction(1)}
    cases = [
        (Fraction(1) - P, Fraction(3, 5)), (1 - P, Fraction(3, 5)), (Fraction(2) / P, Fraction(5)),
        (3 * P, Fraction(6, 5)), (P / 2, Fraction(1, 5)), (-P, Fraction(-2, 5)), (P**-2, Fraction(25, 4)),
        (P**0, Fraction(1)),
    ]  # fmt: skip
    for function, expected in cases:
        assert (function.at(point) if isinstance(function, RationalFunction) else function) == expected


@pytest.mark.parametrize(
    "use",
    [
        lambda: P < 1, lambda: P >= 0, lambda: Fraction(0) > P, lambda: float(P), lambda: int(P),
        lambda: P.numerator, lambda: P.denominator, lambda: max(P, Q), lambda: abs(P), lambda: P // 2,
        lambda: Fraction(1) // P, lambda: P % 2, lambda: P ** Fraction(1, 2), lambda: Fraction(2) ** P,
        lambda: round(P), lambda: P**Q, lambda: P + FunctionField(["p"]).symbol("p"),
    ],
)  # fmt: skip
def test_what_only_a_number_has_is_refused(use) -> None:
    with pytest.raises(SymbolUsed):
        use()


def test_limits_on_degrees_and_terms() -> None:
    with pytest.raises(LimitReached, match="degree beyond 64"):
        (P + Q) ** 65
    with pytest.raises(LimitReached, match="degree beyond 64"):
        P**40 * P**40
    wide = FunctionField([f"t{i}" for i in range(12)])
    total = sum((wide.symbol(name) for name in wide.names), Fraction(1))
    with pytest.raises(LimitReached, match="more than 2,000 terms"):
        total**6
    with pytest.raises(LimitReached, match="a coefficient of more than"):
        (P + 2**7_000) ** 2


def test_division_by_zero_is_named() -> None:
    with pytest.raises(ZeroDivisionError, match=r"-1 \+ p is 0"):
        (1 / (P - 1)).at({"p": Fraction(1), "q": Fraction(0)})


@pytest.mark.parametrize(
    ("function", "text"),
    [
        (1 - P, "1 - p"), ((1 - P) / 2, "(1 - p)/2"), (P / (2 - P), "p/(2 - p)"),
        (3 * P**2 * Q, "3*p**2*q"),
        (-P, "-p"), (1 / (P * Q), "1/(p*q)"), (P - Q, "p - q"), (1 / P, "1/p"),
    ],
)  # fmt: skip
def test_text_is_in_the_language_of_expressions(function: RationalFunction, text: str) -> None:
    assert str(function) == text
    scope = Scope(parameters=frozenset(NAMES))
    assert isinstance(parse(text, scope), type(function_expression(function)))


def test_the_sympy_form_is_the_function() -> None:
    p, q = sympy.symbols("p q")
    assert sympy.simplify((P**2 / (1 + Q)).to_sympy() - p**2 / (1 + q)) == 0


def test_a_function_written_out_is_an_expression_over_parameters() -> None:
    assert function_expression(P) == Parameter("p")
    assert str(function_expression((1 - P) / (2 + Q))) == "(1 - p) / (2 + q)"
    assert str(function_expression(-3 * P**2 * Q + 1)) == "1 - (3 * p ** 2 * q)"


def test_names_that_sympy_would_read_otherwise() -> None:
    odd = FunctionField(["a:3", "x y", "S", "a chance"])
    assert [str(odd.symbol(name)) for name in odd.names] == list(odd.names)
