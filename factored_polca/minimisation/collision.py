"""How likely a confirming pass lets a wrong partition pass: see `factored_polca.minimisation.refine`."""

from __future__ import annotations

from factored_polca.minimisation.criterion import (
    DecisionProcess,
    largest_reward,
    reward_denominator,
    row_denominator,
)

PRIMES_IN_RANGE = 2.7e16
"""A lower bound on the number of primes in [2^60, 2^61): 2^60 / ln(2^61) = 2.72e16 (Rosser &
Schoenfeld 1962 give pi(2x) - pi(x) > 0.6 x / ln x; the density at 2^61 is 1 / 42.3)."""


def collision_bound(process: DecisionProcess, interchangeable: bool) -> float:
    """The probability that one confirming round lets a wrong partition pass."""
    degree = 3 + len(process.channels or ())
    open_numbers = process.open_numbers
    if open_numbers is None:
        bits = difference_bits(process)
    else:
        degree, bits = degree + open_numbers.degree, open_numbers.bits
    if interchangeable:  # a product over the choices
        degree, bits = degree * len(process.choices), bits * len(process.choices)
    return bits / 60 / PRIMES_IN_RANGE + degree / 2**60


def difference_bits(process: DecisionProcess) -> int:
    """Bits of the largest cleared numerator of a difference of two entries of rows, or of two rewards.

    An entry of a row of primitive p is n / D_p with 0 <= n <= D_p, a reward n / C_p with |n| <= N_p.  In
    one block a choice may stand for different primitives p, q, so both denominators are cleared:
    |n_x D_q - n_y D_p| <= D_p D_q, and |n_x C_q - n_y C_p| <= N_p C_q + N_q C_p.
    """
    bits = 1
    for primitive in {p for choice in process.choices for p in choice.primitives}:
        common = reward_denominator(process, primitive)
        numerator = int(common * largest_reward(process, primitive))
        bits = max(
            bits, row_denominator(process, primitive).bit_length(), common.bit_length(),
            numerator.bit_length(),
        )  # fmt: skip
    return 2 * bits + 1
