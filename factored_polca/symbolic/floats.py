"""Exact rewards as floats, which hold less."""

from __future__ import annotations

from fractions import Fraction
from typing import Final

from factored_polca.models.errors import Fault, ModelError

LARGEST_REWARD_EXPONENT: Final = 200
LARGEST_REWARD: Final = 10**LARGEST_REWARD_EXPONENT


def as_float(reward: Fraction, action: str | None = None) -> float:
    """A reward, of an action if one is named, as a float.

    Raises:
        ModelError: so large that sums of it would leave the range of floats.
    """
    if abs(reward) > LARGEST_REWARD:
        whose = "there is" if action is None else f"action {action!r} has"
        message = f"{whose} a reward beyond 10^{LARGEST_REWARD_EXPONENT}"
        raise ModelError([Fault(message, ("reward",), "values are floats: scale the rewards down")])
    return float(reward)
