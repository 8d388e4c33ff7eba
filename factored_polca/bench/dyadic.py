"""Models with dyadic probabilities, so that what runs on doubles loses no lumps to rounding.

A product of n probabilities k / 2^b is exact in a double where n times the bits of the k is at most 53.
"""

from __future__ import annotations

from fractions import Fraction

from factored_polca.models import Action, Model
from factored_polca.models.expressions import Conditional, Constant, Expression, Lottery, Switch
from factored_polca.models.model import replace_fields


def dyadic(model: Model, denominator: int) -> Model:
    """The model with constant probabilities rounded to fractions of `denominator`, none of them to 0.

    With denominator 0 it is the least power of two that gives each outcome a share.

    Raises:
        ValueError: a probability that is no constant.
    """
    actions = tuple(
        Action(
            action.name,
            [(name, _rounded(effect, denominator)) for name, effect in action.effects],
            applicable=action.applicable,
            rewards=action.rewards,
        )
        for action in model.actions
    )
    return replace_fields(model, actions=actions)


def _rounded(e: Expression, denominator: int) -> Expression:
    if isinstance(e, Conditional):
        return Conditional(e.condition, _rounded(e.then, denominator), _rounded(e.otherwise, denominator))
    if isinstance(e, Switch):
        otherwise = None if e.otherwise is None else _rounded(e.otherwise, denominator)
        return Switch(e.reference, tuple((v, _rounded(c, denominator)) for v, c in e.cases), otherwise)
    if not isinstance(e, Lottery) or len(e.outcomes) == 1:
        return e
    chances: list[Fraction] = []
    for _, chance in e.outcomes:
        if not isinstance(chance, Constant) or not isinstance(chance.value, Fraction):
            raise ValueError("a probability that is no constant")
        chances.append(chance.value)
    whole = denominator or 1 << (len(chances) - 1).bit_length()
    parts = [max(1, round(chance * whole)) for chance in chances]
    parts[parts.index(max(parts))] += whole - sum(parts)
    pairs = zip(e.outcomes, parts, strict=True)
    return Lottery(tuple((value, Constant(Fraction(k, whole))) for (value, _), k in pairs))
