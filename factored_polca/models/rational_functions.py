"""Rational functions of parameters: the exact numbers of a model whose parameters stay symbols.

The rational functions over parameters t_1, .., t_k form a field Q(t_1, .., t_k): sums, differences,
products and quotients of them are rational functions again, and each has one *normal form*

    f = n / d,   n and d polynomials with integer coefficients, coprime, d's leading coefficient > 0,

so that two of them are equal, as functions, exactly where their normal forms are (von zur Gathen &
Gerhard, "Modern Computer Algebra", 2013, chapter 6).  Polynomials and their greatest common divisors are
sympy's (`sympy.polys.fields`); sympy is loaded when the first symbol is made.

A `RationalFunction` is a `Fraction` by type: what holds and adds up exact numbers, and asks for no more
than + - * / and equality, holds both.  A function that is constant *is* a Fraction.  What only a number
has (an order, a numerator and denominator that are integers, a nearest float) raises `SymbolUsed`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from typing import Any, Final, NoReturn, TypeAlias

from factored_polca.models.errors import LimitReached

MAXIMUM_DEGREE: Final = 64
"""Largest total degree of a numerator or denominator."""

MAXIMUM_TERMS: Final = 2_000
"""Most terms of a numerator or denominator."""

MAXIMUM_BITS: Final = 13_000
"""Largest coefficient, in bits; that of numbers, see `factored_polca.models.scalars`."""

MAXIMUM_PRODUCTS: Final = 200_000
"""Most products of terms in one multiplication."""

Polynomial: TypeAlias = tuple[tuple[tuple[int, ...], int], ...]
"""Terms (exponents by parameter, integer coefficient), those of the lowest degree first."""


class SymbolUsed(TypeError):
    """A number was needed, and there is a function of parameters that stay symbols."""


class FunctionField:
    """The rational functions over some named parameters.

    `divisors` holds, as polynomials by their text, what expressions have been divided by.
    """

    def __init__(self, names: Sequence[str]) -> None:
        from sympy import QQ, Symbol
        from sympy.polys.fields import FracField
        from sympy.polys.orderings import lex

        self.names = tuple(names)
        self.field: Any = FracField([Symbol(name) for name in self.names], QQ, lex)
        self.divisors: dict[str, RationalFunction] = {}

    def __repr__(self) -> str:
        return f"<FunctionField over {', '.join(self.names)}>"

    def symbol(self, name: str) -> RationalFunction:
        """The parameter itself, as a function.

        Raises:
            KeyError: no parameter of the field.
        """
        if name not in self.names:
            raise KeyError(f"no parameter {name!r}; there are {', '.join(self.names)}")
        return RationalFunction.of(self, self.field.gens[self.names.index(name)])

    def number(self, element: Any) -> Fraction:
        """An element of sympy's field as a RationalFunction, or as a Fraction where it is constant.

        Raises:
            LimitReached: more degrees, terms or digits than a function may have.
        """
        for polynomial in (element.numer, element.denom):
            self._check(polynomial)
        if element.numer.is_ground and element.denom.is_ground:
            top, bottom = element.numer.LC, element.denom.LC
            return Fraction(int(top.numerator), int(top.denominator)) / Fraction(
                int(bottom.numerator), int(bottom.denominator)
            )
        return RationalFunction.of(self, element)

    def _check(self, polynomial: Any) -> None:
        terms = polynomial.terms()
        if len(terms) > MAXIMUM_TERMS:
            raise too_large(f"more than {MAXIMUM_TERMS:,} terms")
        if max((sum(exponents) for exponents, _ in terms), default=0) > MAXIMUM_DEGREE:
            raise too_large(f"a degree beyond {MAXIMUM_DEGREE}")
        if any(int(c.numerator).bit_length() > MAXIMUM_BITS for _, c in terms):
            raise too_large(f"a coefficient of more than {MAXIMUM_BITS:,} bits")

    def divided_by(self, divisor: Fraction) -> None:
        """Remember that an expression divides by `divisor`, which must not be 0."""
        if isinstance(divisor, RationalFunction):
            self.divisors.setdefault(polynomial_text(self.names, divisor.over), divisor)


def too_large(what: str) -> LimitReached:
    """The error of a function that has grown too large."""
    return LimitReached(
        f"a function of the parameters has {what}: keep fewer parameters as symbols, or split the "
        "expression over more features",
        "computing with parameters",
    )


class RationalFunction(Fraction):
    """A function of parameters that is not constant; see the module's docstring."""

    __slots__ = ("_denominator_terms", "_element", "_hash", "_numerator_terms", "field")

    field: FunctionField
    _element: Any
    _hash: int
    _numerator_terms: Polynomial
    _denominator_terms: Polynomial

    @classmethod
    def of(cls, field: FunctionField, element: Any) -> RationalFunction:
        """The function that an element of sympy's field is; the element must not be constant."""
        self: RationalFunction = object.__new__(cls)
        self.field, self._element = field, element
        self._numerator_terms = _polynomial(element.numer)
        self._denominator_terms = _polynomial(element.denom)
        self._hash = hash((self._numerator_terms, self._denominator_terms))
        return self

    # -- what it is --------------------------------------------------------------------------

    @property
    def over(self) -> Polynomial:
        """The numerator of the normal form."""
        return self._numerator_terms

    @property
    def under(self) -> Polynomial:
        """The denominator of the normal form."""
        return self._denominator_terms

    @property
    def parameters(self) -> tuple[str, ...]:
        """The parameters that it depends on."""
        both = (*self.over, *self.under)
        return tuple(
            name for i, name in enumerate(self.field.names) if any(exponents[i] for exponents, _ in both)
        )

    @property
    def degree(self) -> int:
        """The larger of the total degrees of numerator and denominator."""
        return max(sum(exponents) for exponents, _ in (*self.over, *self.under))

    def at(self, values: Mapping[str, Fraction]) -> Fraction:
        """The exact value at values of the parameters.

        Raises:
            ZeroDivisionError: the denominator is 0 there.
        """
        point = [values[name] for name in self.field.names]
        below = _value(self.under, point)
        if below == 0:
            raise ZeroDivisionError(f"{polynomial_text(self.field.names, self.under)} is 0")
        return _value(self.over, point) / below

    def residue(self, point: Mapping[str, int], prime: int) -> int:
        """The value at residues of the parameters, modulo a prime.

        Raises:
            ZeroDivisionError: the denominator is 0 there.
        """
        place = [point[name] for name in self.field.names]
        below = _residue(self.under, place, prime)
        if below == 0:
            raise ZeroDivisionError(f"{self} at a point where its denominator vanishes")
        return _residue(self.over, place, prime) * pow(below, -1, prime) % prime

    def to_sympy(self) -> Any:
        """The function as a sympy expression, factored."""
        import sympy

        return sympy.factor(self._element.as_expr())

    def __str__(self) -> str:
        over, under = self.over, self.under
        if under[0][1] < 0:  # the sign of the term that is written first
            over, under = _negative(over), _negative(under)
        top = polynomial_text(self.field.names, over)
        if under == _one(len(self.field.names)):
            return top
        bottom = polynomial_text(self.field.names, under)
        top = f"({top})" if len(self.over) > 1 else top
        return f"{top}/{bottom}" if bottom.isidentifier() or bottom.isdigit() else f"{top}/({bottom})"

    def __repr__(self) -> str:
        return f"<RationalFunction {self}>"

    def __hash__(self) -> int:  # type: ignore[override]
        return self._hash

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, RationalFunction):
            return False  # a function that is not constant is no number
        same_field = self.field is other.field or self.field.names == other.field.names
        return same_field and self.over == other.over and self.under == other.under

    def __bool__(self) -> bool:
        return True

    def __copy__(self) -> RationalFunction:
        return self

    def __deepcopy__(self, memo: object) -> RationalFunction:
        return self

    # -- arithmetic --------------------------------------------------------------------------

    def _other(self, value: object) -> Any:
        """`value` as an element of the same field; None where it is no number."""
        if isinstance(value, RationalFunction):
            if value.field is not self.field:
                raise SymbolUsed(f"{self} and {value} are functions over different fields")
            return value._element
        if isinstance(value, Fraction):
            field = self.field.field
            return field.ground_new(field.domain(value.numerator, value.denominator))
        if isinstance(value, int):
            return self.field.field.ground_new(self.field.field.domain(value))
        return None

    def _check_product(self, value: object) -> None:
        if not isinstance(value, RationalFunction):
            return
        if self.degree + value.degree > 2 * MAXIMUM_DEGREE:
            raise too_large(f"a degree beyond {MAXIMUM_DEGREE}")
        sizes = max(len(self.over), len(self.under)) * max(len(value.over), len(value.under))
        if sizes > MAXIMUM_PRODUCTS:
            raise too_large(f"more than {MAXIMUM_TERMS:,} terms")

    def __add__(self, value: Any) -> Any:
        self._check_product(value)
        other = self._other(value)
        return NotImplemented if other is None else self.field.number(self._element + other)

    __radd__ = __add__

    def __sub__(self, value: Any) -> Any:
        self._check_product(value)
        other = self._other(value)
        return NotImplemented if other is None else self.field.number(self._element - other)

    def __rsub__(self, value: Any) -> Any:
        other = self._other(value)
        return NotImplemented if other is None else self.field.number(other - self._element)

    def __mul__(self, value: Any) -> Any:
        self._check_product(value)
        other = self._other(value)
        return NotImplemented if other is None else self.field.number(self._element * other)

    __rmul__ = __mul__

    def __truediv__(self, value: Any) -> Any:
        self._check_product(value)
        other = self._other(value)
        return NotImplemented if other is None else self.field.number(self._element / other)

    def __rtruediv__(self, value: Any) -> Any:
        other = self._other(value)
        return NotImplemented if other is None else self.field.number(other / self._element)

    def __neg__(self) -> Any:
        return RationalFunction.of(self.field, -self._element)

    def __pos__(self) -> Any:
        return self

    def __pow__(self, exponent: Any) -> Any:
        if isinstance(exponent, RationalFunction) or exponent != int(exponent):
            raise SymbolUsed(f"{self} to a power that is no integer")
        if self.degree * abs(int(exponent)) > MAXIMUM_DEGREE:
            raise too_large(f"a degree beyond {MAXIMUM_DEGREE}")
        result: Any = Fraction(1)
        for _ in range(abs(int(exponent))):
            result = result * self
        return result if exponent >= 0 else Fraction(1) / result

    # -- what only a number has --------------------------------------------------------------

    def _refuse(self, *_: object) -> NoReturn:
        raise SymbolUsed(f"{self} depends on a parameter that stays a symbol, and a number is needed")

    __rpow__ = __float__ = __int__ = __index__ = __trunc__ = __floor__ = __ceil__ = _refuse
    __abs__ = __lt__ = __le__ = __gt__ = __ge__ = __complex__ = _refuse
    __floordiv__ = __rfloordiv__ = __mod__ = __rmod__ = __divmod__ = __rdivmod__ = _refuse  # type: ignore[assignment]
    __round__ = _refuse  # type: ignore[assignment]

    @property
    def numerator(self) -> NoReturn:
        """A function has none that is an integer: see `over`."""
        self._refuse()

    @property
    def denominator(self) -> NoReturn:
        """A function has none that is an integer: see `under`."""
        self._refuse()


def _polynomial(polynomial: Any) -> Polynomial:
    """The terms of sympy's polynomial, whose coefficients are integers."""
    terms = [(tuple(map(int, exponents)), int(c.numerator)) for exponents, c in polynomial.terms()]
    return tuple(sorted(terms, key=lambda term: (sum(term[0]), tuple(-e for e in term[0]))))


def _one(parameters: int) -> Polynomial:
    return (((0,) * parameters, 1),)


def _negative(polynomial: Polynomial) -> Polynomial:
    return tuple((exponents, -coefficient) for exponents, coefficient in polynomial)


def _value(polynomial: Polynomial, point: Sequence[Fraction]) -> Fraction:
    total = Fraction(0)
    for exponents, coefficient in polynomial:
        term = Fraction(coefficient)
        for value, exponent in zip(point, exponents, strict=True):
            if exponent:
                term *= value**exponent
        total += term
    return total


def _residue(polynomial: Polynomial, point: Sequence[int], prime: int) -> int:
    total = 0
    for exponents, coefficient in polynomial:
        term = coefficient
        for value, exponent in zip(point, exponents, strict=True):
            if exponent:
                term = term * pow(value, exponent, prime) % prime
        total += term
    return total % prime


def polynomial_text(names: Sequence[str], polynomial: Polynomial) -> str:
    """A polynomial as the language of expressions writes it."""
    result = ""
    for exponents, coefficient in polynomial:
        powers = [
            name if exponent == 1 else f"{name}**{exponent}"
            for name, exponent in zip(names, exponents, strict=True)
            if exponent
        ]
        size = abs(coefficient)
        text = "*".join([str(size), *powers] if size != 1 or not powers else powers)
        sign = "-" if coefficient < 0 else "+"
        if result:
            result += f" {sign} {text}"
        else:
            result = f"-{text}" if sign == "-" else text
    return result or "0"


def functions_in(values: Iterable[object]) -> list[RationalFunction]:
    """The functions among some values, each once, in order."""
    return list(dict.fromkeys(value for value in values if isinstance(value, RationalFunction)))
