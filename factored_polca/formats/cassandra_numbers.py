"""Numbers of one file in Cassandra's format: exact rationals, each different one made once."""

from __future__ import annotations

from fractions import Fraction

from factored_polca.formats.cassandra_tokens import Token, Tokens
from factored_polca.formats.spudd_rows import TOLERANCE
from factored_polca.models.expressions import ZERO, Constant
from factored_polca.models.language import number


class Numbers:
    """The numbers of a file; equal ones are one object."""

    def __init__(self, tokens: Tokens) -> None:
        self.tokens = tokens
        self.cost = False
        self._pool: dict[Fraction, Constant] = {Fraction(0): ZERO}
        self._probabilities: dict[str, Constant] = {}
        self._rewards: dict[str, Constant] = {}

    def constant(self, value: Fraction) -> Constant:
        """The one constant with this value."""
        return self._pool.setdefault(value, Constant(value))

    def value(self, token: Token) -> Fraction:
        """The exact rational that `token` denotes.

        Raises:
            ModelError: it is no number, or has too many digits.
        """
        if token.kind != "number":
            raise self.tokens.error(f"expected a number, found {token}", token.start)
        try:
            return number("".join(token.text.split()))
        except ValueError as problem:
            raise self.tokens.error(str(problem), token.start) from None

    def probability(self, token: Token) -> Constant:
        """The constant that `token`, a probability, stands for.

        Raises:
            ModelError: it is no number between 0 and 1.
        """
        value = self.value(token)
        if not 0 <= value < 1 + TOLERANCE:
            message = f"{token} is no probability"
            raise self.tokens.error(message, token.start, "a probability is between 0 and 1")
        result = self._probabilities[token.text] = self.constant(value)
        return result

    def reward(self, token: Token) -> Constant:
        """The constant for the reward that `token` stands for, the negative of a cost.

        Raises:
            ModelError: it is no number.
        """
        value = self.value(token)
        result = self._rewards[token.text] = self.constant(-value if self.cost else value)
        return result

    def probabilities(self, count: int) -> list[Constant]:
        """The next `count` probabilities, or fewer where something else follows.

        Raises:
            ModelError: a number that is no probability.
        """
        return self.tokens.numbers(count, self._probabilities, self.probability)

    def rewards(self, count: int) -> list[Constant]:
        """The next `count` rewards, or fewer where something else follows.

        Raises:
            ModelError: a number with too many digits.
        """
        return self.tokens.numbers(count, self._rewards, self.reward)
