"""Arithmetic in GF(p) against Python's integers."""

from __future__ import annotations

import itertools
import random
from fractions import Fraction

import numba
import numpy as np
import numpy.typing as npt
import pytest

from factored_polca.diagrams import MERSENNE_61, Field, is_prime, random_prime
from factored_polca.diagrams.field import field_add, field_multiply, field_subtract

PRIMES = [MERSENNE_61, *(random_prime(random.Random(seed)) for seed in range(4))]


@numba.njit
def sums(a: npt.NDArray[np.uint64], b: npt.NDArray[np.uint64], p: np.uint64) -> npt.NDArray[np.uint64]:
    """a + b and a - b, elementwise, as two rows."""
    result = np.empty((2, len(a)), np.uint64)
    for i in range(len(a)):
        result[0, i] = field_add(a[i], b[i], p)
        result[1, i] = field_subtract(a[i], b[i], p)
    return result


@numba.njit
def multiply_all(
    a: npt.NDArray[np.uint64], b: npt.NDArray[np.uint64], p: np.uint64, inverse: np.uint64
) -> npt.NDArray[np.uint64]:
    """Elementwise products of stored forms."""
    result = np.empty_like(a)
    for i in range(len(a)):
        result[i] = field_multiply(a[i], b[i], p, inverse)
    return result


def agree(p: int, a: list[int], b: list[int]) -> None:
    """Compare sums, differences and products of stored forms with Python's."""
    x, y = np.array(a, dtype=np.uint64), np.array(b, dtype=np.uint64)
    parameters = Field(p).parameters
    added, subtracted = sums(x, y, parameters[0]).tolist()
    assert added == [(i + j) % p for i, j in zip(a, b, strict=True)]
    assert subtracted == [(i - j) % p for i, j in zip(a, b, strict=True)]
    # Stored forms are x 2^64, so the stored product is (x 2^64)(y 2^64) / 2^64.
    unmount = pow(2**64, -1, p)
    products = multiply_all(x, y, parameters[0], parameters[1]).tolist()
    assert products == [i * j * unmount % p for i, j in zip(a, b, strict=True)]


@pytest.mark.parametrize("p", PRIMES)
def test_arithmetic_agrees_with_integers_at_the_edges(p: int) -> None:
    powers = [2**k + d for k in (1, 16, 31, 32, 33, 48, 59, 60) for d in (-1, 0, 1)]
    low_words = [(p >> 32 << 32) - 1, p >> 32 << 32, 0xFFFFFFFF, 0xFFFFFFFF << 28]
    edges = sorted(
        {n for n in [0, 1, 2, 3, p - 1, p - 2, p - 3, p // 2, p // 2 + 1, *powers, *low_words] if n < p}
    )
    pairs = list(itertools.product(edges, edges))
    agree(p, [a for a, _ in pairs], [b for _, b in pairs])


@pytest.mark.parametrize(("p", "count"), [(PRIMES[0], 10**6), *((p, 200_000) for p in PRIMES[1:])])
def test_arithmetic_agrees_with_integers_on_random_pairs(p: int, count: int) -> None:
    generator = np.random.default_rng(p % 1000)
    a, b = generator.integers(0, p, size=(2, count), dtype=np.uint64).tolist()
    agree(p, a, b)


@pytest.mark.parametrize("p", PRIMES)
def test_encode_and_decode_are_inverse_and_carry_products(p: int) -> None:
    field = Field(p)
    for value in (0, 1, 2, 12345, 2**32, p - 1):
        assert field.decode(field.encode(value)) == value
        assert 0 <= field.encode(value) < p
    assert field.encode(p) == field.encode(0) == 0
    assert field.decode(field.encode(-1)) == p - 1
    a, b = (np.array([field.encode(n)], dtype=np.uint64) for n in (p - 5, 7))
    product = multiply_all(a, b, field.parameters[0], field.parameters[1])
    assert field.decode(int(product[0])) == p - 35


def test_a_rational_times_its_denominator_is_its_numerator() -> None:
    for p in PRIMES:
        field = Field(p)
        for value in (Fraction(0), Fraction(1, 3), Fraction(-7, 10), Fraction(10**40, 3**50), Fraction(5)):
            assert field.decode(field.rational(value)) * value.denominator % p == value.numerator % p
        with pytest.raises(ZeroDivisionError, match="divisible by the prime"):
            field.rational(Fraction(1, 2 * p))


def test_draws_are_distinct_and_not_zero_and_repeat_with_the_seed() -> None:
    field = Field()
    drawn = field.draw(np.random.default_rng(1), 10_000)
    assert drawn.dtype == np.uint64
    assert len(set(drawn.tolist())) == 10_000
    assert min(drawn.tolist()) > 0
    assert max(drawn.tolist()) < MERSENNE_61
    assert (drawn == field.draw(np.random.default_rng(1), 10_000)).all()
    assert len(field.draw(np.random.default_rng(1), 0)) == 0


def test_primality_agrees_with_a_sieve_and_with_known_numbers() -> None:
    sieve = np.ones(20_000, dtype=bool)
    sieve[:2] = False
    for n in range(2, 142):
        sieve[n * n :: n] &= not sieve[n]
    assert [n for n in range(20_000) if is_prime(n)] == np.flatnonzero(sieve).tolist()
    # Mersenne exponents below 128 (OEIS A000043).
    mersenne = [q for q in range(2, 90) if is_prime(2**q - 1)]
    assert mersenne == [2, 3, 5, 7, 13, 17, 19, 31, 61, 89]
    # Strong pseudoprimes to the first bases (OEIS A014233), Carmichael numbers, a product near 2^61.
    composite = [2047, 1373653, 25326001, 3215031751, 3474749660383, 341550071728321, 3825123056546413051,
                 561, 1729, 825265, 1152921504606847009 * 3, (2**31 - 1) * (2**30 - 35)]  # fmt: skip
    assert not any(is_prime(n) for n in composite)
    assert is_prime(2**61 - 1)
    assert is_prime(18446744073709551557)  # the largest prime below 2^64
    assert not is_prime(-7)


def test_random_primes_lie_in_their_range_and_differ() -> None:
    generator = random.Random(5)
    drawn = {random_prime(generator) for _ in range(30)}
    assert len(drawn) == 30
    assert all(2**60 < p < 2**61 and pow(3, p - 1, p) == 1 for p in drawn)


@pytest.mark.parametrize("number", [7, 2**60 + 1, 2**61 + 15, 2**62 - 57, 2**61 - 3])
def test_a_field_refuses_what_its_arithmetic_is_not_made_for(number: int) -> None:
    with pytest.raises(ValueError, match="no prime in"):
        Field(number)
