"""Arithmetic in GF(p), p a prime in [2^60, 2^61), on uint64, for use inside kernels and outside.

Numbers are kept in Montgomery form: x is stored as x R mod p with R = 2^64 (Montgomery, 1985), so a
product is

    redc(a b) = (hi(a b) - hi((lo(a b) p^-1 mod R) p)) mod p

with the high half of a 64 x 64 bit product made from 32-bit halves: numba has no 128-bit integers
and mixes signed and unsigned ones silently, so everything here is uint64, constants included.
Sums and equality are the same in Montgomery form.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams.jit import inline

MERSENNE_61 = 2**61 - 1
"""The first prime of every computation."""

UInt64Array = npt.NDArray[np.uint64]

_MASK = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)


@inline
def high_product(a: np.uint64, b: np.uint64) -> np.uint64:
    """The upper 64 bits of a b."""
    a0 = a & _MASK
    a1 = a >> _HALF
    b0 = b & _MASK
    b1 = b >> _HALF
    low = a0 * b0
    middle = a1 * b0 + (low >> _HALF)
    other = a0 * b1 + (middle & _MASK)
    return a1 * b1 + (middle >> _HALF) + (other >> _HALF)


@inline
def field_multiply(a: np.uint64, b: np.uint64, prime: np.uint64, inverse: np.uint64) -> np.uint64:
    """a b R^-1 mod p: the product of two numbers in Montgomery form."""
    high = high_product(a, b)
    borrow = high_product(a * b * inverse, prime)
    if high >= borrow:
        return high - borrow
    return high + prime - borrow


@inline
def field_add(a: np.uint64, b: np.uint64, prime: np.uint64) -> np.uint64:
    """a + b mod p."""
    total = a + b
    if total >= prime:
        return total - prime
    return total


@inline
def field_subtract(a: np.uint64, b: np.uint64, prime: np.uint64) -> np.uint64:
    """a - b mod p."""
    if a >= b:
        return a - b
    return a + prime - b


def is_prime(n: int) -> bool:
    """Miller-Rabin with the bases that decide every n below 3.3 * 10^24 (Sorenson & Webster 2015)."""
    bases = (2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41)
    if n < 2:
        return False
    for base in bases:
        if n % base == 0:
            return n == base
    odd, twos = n - 1, 0
    while odd % 2 == 0:
        odd, twos = odd // 2, twos + 1
    for base in bases:
        x = pow(base, odd, n)
        if x in (1, n - 1):
            continue
        for _ in range(twos - 1):
            x = x * x % n
            if x == n - 1:
                break
        else:
            return False
    return True


def random_prime(generator: random.Random) -> int:
    """A prime drawn uniformly from [2^60, 2^61)."""
    while True:
        candidate = generator.randrange(2**60 + 1, 2**61, 2)
        if is_prime(candidate):
            return candidate


@dataclass(frozen=True)
class Field:
    """GF(p).  `encode` and `decode` go between integers mod p and their stored form.

    Raises:
        ValueError: `prime` is no prime in [2^60, 2^61).
    """

    prime: int = MERSENNE_61

    def __post_init__(self) -> None:
        if not 2**60 < self.prime < 2**61 or not is_prime(self.prime):
            raise ValueError(f"{self.prime} is no prime in [2^60, 2^61); use MERSENNE_61 or random_prime")

    @cached_property
    def parameters(self) -> UInt64Array:
        """What kernels need: p and p^-1 mod 2^64."""
        return np.array([self.prime, pow(self.prime, -1, 2**64)], dtype=np.uint64)

    @cached_property
    def _unmount(self) -> int:
        return pow(2**64, -1, self.prime)

    def encode(self, value: int) -> int:
        """The stored form of an integer."""
        return (value << 64) % self.prime

    def decode(self, stored: int) -> int:
        """The integer in [0, p) whose stored form is `stored`."""
        return stored * self._unmount % self.prime

    def rational(self, value: Fraction) -> int:
        """The stored form of a rational.

        Raises:
            ZeroDivisionError: the denominator is divisible by p.
        """
        if value.denominator == 1:
            return self.encode(value.numerator)
        denominator = value.denominator % self.prime
        if denominator == 0:
            raise ZeroDivisionError(f"the denominator of {value} is divisible by the prime {self.prime}")
        return self.encode(value.numerator % self.prime * pow(denominator, -1, self.prime))

    def draw(self, generator: np.random.Generator, count: int) -> UInt64Array:
        """`count` distinct random non-zero elements in stored form [count]."""
        drawn = generator.integers(1, self.prime, size=count, dtype=np.uint64)
        while (np.diff(np.sort(drawn)) == 0).any():
            drawn = generator.integers(1, self.prime, size=count, dtype=np.uint64)
        return drawn
