"""Straight-line programs: many functions of the parameters, evaluated together in one pass.

A program is a list of registers in postfix order; register k holds a constant, a parameter, or the sum,
product or quotient of two registers before it, and what two functions share is computed once.  So no
product is ever multiplied out: an entry of a quotient's row is a sum of products of up to as many
probabilities as there are features, and as such it stays.

*Equal functions share a register.*  While a program is built each register carries the residues of its
function at two random points, modulo two random primes from [2^60, 2^61); a function whose residues are
known is not computed again.  Equal functions always have equal residues; different ones of degree d have
them with probability at most (d / 2^60)^2 (Schwartz 1980; Zippel 1979).

*Accuracy.*  The registers of the model's own numbers come first.  Each is evaluated in floats together
with a running error bound (Higham, "Accuracy and Stability of Numerical Algorithms", 2002, section 3.3):
s(a + b) = s(a) + s(b), s(a b) = s(a) s(b).  Where s is more than `CANCELLED` times the value, it is
evaluated anew in rationals and rounded once.  All other registers are sums and products of these, which at
an admissible setting are probabilities: nothing is subtracted, so their relative error is some 1e-16
times the number of factors and sums.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import random_prime
from factored_polca.models import LimitReached
from factored_polca.models.rational_functions import FunctionField, Polynomial, RationalFunction

FloatArray = npt.NDArray[np.float64]
Int32Array = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]

CONSTANT, PARAMETER, ADD, MULTIPLY, DIVIDE = range(5)

MAXIMUM_REGISTERS: Final = 5_000_000

CANCELLED: Final = 1e3
"""Ratio of a running error bound to the value from which a number is evaluated in rationals."""


@dataclass(frozen=True)
class Program:
    """A finished program; see the module's docstring.

    `numbers` are the model's own functions with their registers, all below `numbers_end`.
    """

    field: FunctionField
    operation: npt.NDArray[np.int8]  # [register]
    left: Int32Array  # [register] of a constant or parameter its number
    right: Int32Array  # [register]
    constants: tuple[Fraction, ...]
    numbers: tuple[tuple[int, RationalFunction], ...]
    numbers_end: int
    float_constants: FloatArray

    @cached_property
    def places(self) -> Int64Array:
        """The registers of `numbers`."""
        return np.array([register for register, _ in self.numbers], dtype=np.int64)

    @property
    def registers(self) -> int:
        """Their number."""
        return len(self.operation)

    def run(self, values: Mapping[str, Fraction]) -> FloatArray:
        """Every register as a float [register], at a setting of all parameters.

        Raises:
            ZeroDivisionError: a denominator is 0 there.
        """
        from factored_polca.parametric.program_kernel import run_masses, run_numbers

        setting = np.array([float(values[name]) for name in self.field.names])
        result, sizes = np.empty(self.registers), np.empty(self.numbers_end)
        run_numbers(
            self.operation, self.left, self.right, self.float_constants, setting, result, sizes,
            self.numbers_end,
        )  # fmt: skip
        places = self.places
        lost = ~(sizes[places] <= CANCELLED * np.abs(result[places]))  # NaN is lost, too
        for index in np.flatnonzero(lost).tolist():
            register, function = self.numbers[index]
            result[register] = float(function.at(values))
        run_masses(self.operation, self.left, self.right, result, self.numbers_end)
        return result

    def run_exactly(self, values: Mapping[str, Fraction], wanted: npt.NDArray[Any]) -> dict[int, Fraction]:
        """The exact values of some registers, and of what they are made from."""
        return self._evaluate([values[name] for name in self.field.names], wanted)

    def functions(self, wanted: npt.NDArray[Any]) -> dict[int, Fraction]:
        """Some registers as functions of the parameters, in normal form.

        Raises:
            LimitReached: larger ones than allowed.
        """
        return self._evaluate([self.field.symbol(name) for name in self.field.names], wanted)

    def _evaluate(self, setting: Sequence[Fraction], wanted: npt.NDArray[Any]) -> dict[int, Fraction]:
        needed = np.zeros(self.registers, dtype=np.bool_)
        needed[wanted] = True
        for k in range(self.registers - 1, -1, -1):
            if needed[k] and self.operation[k] >= ADD:
                needed[self.left[k]] = needed[self.right[k]] = True
        result: dict[int, Fraction] = {}
        for k in np.flatnonzero(needed).tolist():
            code, i, j = int(self.operation[k]), int(self.left[k]), int(self.right[k])
            if code == CONSTANT:
                result[k] = self.constants[i]
            elif code == PARAMETER:
                result[k] = setting[i]
            elif code == ADD:
                result[k] = result[i] + result[j]
            elif code == MULTIPLY:
                result[k] = result[i] * result[j]
            else:
                result[k] = result[i] / result[j]
        return result


class Unlucky(ArithmeticError):
    """A random point where a denominator vanishes: draw another."""


class ProgramBuilder:
    """Builds a program; registers are ints.  First all `number`s, then `finish_numbers`, then the rest.

    Raises (also from its methods):
        Unlucky: with a chance of some degree / 2^60 for each number.
        LimitReached: more than `MAXIMUM_REGISTERS`.
    """

    def __init__(self, field: FunctionField, source: random.Random) -> None:
        self.field = field
        self.primes = (random_prime(source), random_prime(source))
        self.points = [[source.randrange(1, prime) for _ in field.names] for prime in self.primes]
        self.operation: list[int] = []
        self.left: list[int] = []
        self.right: list[int] = []
        self.constants: list[Fraction] = []
        self.residues: list[tuple[int, int]] = []
        self.numbers: dict[RationalFunction, int] = {}
        self.numbers_end = -1
        self._constants: dict[Fraction, int] = {}
        self._known: dict[tuple[int, int], int] = {}
        self._sums: dict[tuple[int, int], int] = {}
        self._products: dict[tuple[int, int], int] = {}
        self.zero = self.constant(Fraction(0))
        self.one = self.constant(Fraction(1))

    def _register(self, code: int, left: int, right: int, residues: tuple[int, int]) -> int:
        known = self._known.get(residues)
        if known is not None:
            return known
        if len(self.operation) >= MAXIMUM_REGISTERS:
            raise LimitReached(
                f"the quotient's rows take more than {MAXIMUM_REGISTERS:,} operations as functions of the "
                "parameters; make the quotient at one setting instead",
                "quotient",
            )
        self.operation.append(code)
        self.left.append(left)
        self.right.append(right)
        self.residues.append(residues)
        self._known[residues] = len(self.operation) - 1
        return self._known[residues]

    def constant(self, value: Fraction) -> int:
        """The register of a rational."""
        if value in self._constants:
            return self._constants[value]
        residues = []
        for prime in self.primes:
            if value.denominator % prime == 0:
                raise Unlucky
            residues.append(value.numerator * pow(value.denominator, -1, prime) % prime)
        self.constants.append(value)
        register = self._register(CONSTANT, len(self.constants) - 1, 0, (residues[0], residues[1]))
        self._constants[value] = register
        return register

    def parameter(self, number: int) -> int:
        """The register of a parameter."""
        return self._register(PARAMETER, number, 0, (self.points[0][number], self.points[1][number]))

    def add(self, a: int, b: int) -> int:
        """The register of a sum."""
        if a == self.zero:
            return b
        if b == self.zero:
            return a
        key = (a, b)
        found = self._sums.get(key)
        if found is None:
            (u0, u1), (v0, v1), (p, q) = self.residues[a], self.residues[b], self.primes
            found = self._sums[key] = self._register(ADD, a, b, ((u0 + v0) % p, (u1 + v1) % q))
        return found

    def multiply(self, a: int, b: int) -> int:
        """The register of a product."""
        if a == self.one:
            return b
        if b == self.one:
            return a
        key = (a, b)
        found = self._products.get(key)
        if found is None:
            (u0, u1), (v0, v1), (p, q) = self.residues[a], self.residues[b], self.primes
            found = self._products[key] = self._register(MULTIPLY, a, b, (u0 * v0 % p, u1 * v1 % q))
        return found

    def divide(self, a: int, b: int) -> int:
        """The register of a quotient."""
        (u0, u1), (v0, v1), (p, q) = self.residues[a], self.residues[b], self.primes
        if v0 == 0 or v1 == 0:
            raise Unlucky
        return self._register(DIVIDE, a, b, (u0 * pow(v0, -1, p) % p, u1 * pow(v1, -1, q) % q))

    def number(self, value: Fraction) -> int:
        """The register of one of the model's numbers."""
        if not isinstance(value, RationalFunction):
            return self.constant(value)
        known = self.numbers.get(value)
        if known is None:
            assert self.numbers_end < 0, "numbers come first"
            known = self._polynomial(value.over)
            below = self._polynomial(value.under)
            if below != self.one:
                known = self.divide(known, below)
            self.numbers[value] = known
        return known

    def _polynomial(self, polynomial: Polynomial) -> int:
        total = self.zero
        for exponents, coefficient in polynomial:
            term = self.constant(Fraction(coefficient))
            for number, exponent in enumerate(exponents):
                if exponent:
                    term = self.multiply(term, self._power(self.parameter(number), exponent))
            total = self.add(total, term)
        return total

    def _power(self, base: int, exponent: int) -> int:
        result = self.one
        while exponent:
            if exponent % 2:
                result = self.multiply(result, base)
            base, exponent = self.multiply(base, base), exponent // 2
        return result

    def finish_numbers(self) -> None:
        """Say that all the model's numbers are in: from now on only sums and products.

        Of their registers only the last ones, which are made accurate, may be used again.
        """
        self.numbers_end = len(self.operation)
        kept = {*self._constants.values(), *self.numbers.values()}
        kept |= {k for k, code in enumerate(self.operation) if code == PARAMETER}
        self._known = {self.residues[k]: k for k in sorted(kept)}
        self._sums.clear()
        self._products.clear()

    def finish(self) -> Program:
        """The program."""
        return Program(
            self.field,
            np.array(self.operation, dtype=np.int8),
            np.array(self.left, dtype=np.int32),
            np.array(self.right, dtype=np.int32),
            tuple(self.constants),
            tuple((register, function) for function, register in self.numbers.items()),
            self.numbers_end,
            np.array([float(value) for value in self.constants]),
        )
