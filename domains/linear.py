"""The best case of structured planning: 2^size states whose optimum needs size + 1 values.

From C. Boutilier, R. Dearden and M. Goldszmidt, "Stochastic dynamic programming with factored
representations", Artificial Intelligence 121 (2000); the name is that of the file that comes with
SPUDD (Hoey, St-Aubin, Hu and Boutilier, 1999).  Our probabilities and the reading below are those
of this project; the sources report that the value function's tree grows linearly with the number
of features, against exponentially for its counterpart `expon`.

Truth values x_0 .. x_{n-1}, n = `size`, and actions a_0 .. a_{n-1}.  Action a_k makes x_k true with
probability `success`, else leaves it, if x_0 .. x_{k-1} are all true, and makes it false otherwise;
it makes all higher ones false and keeps the lower.  Reward 1 in each step that starts with all true.

What matters of a state is how long its unbroken run of true values from x_0 on is, so the flat
quotient has n + 1 blocks.  There is no hierarchy.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor, integer, probability
from factored_polca.models import (
    FALSE,
    TRUE,
    Action,
    Expression,
    Feature,
    Model,
    boolean,
    conditional,
    conjunction,
    lottery,
)

Size = Annotated[int, "number n of truth values and of actions; 2^n states, n + 1 blocks"]
Success = Annotated[Number, "probability that a_k makes x_k true where it can"]
Discount = Annotated[Number, "discount, from 0 to 1"]


def model(
    *, size: Size = 16, success: Success = Fraction(9, 10), discount: Discount = Fraction(95, 100)
) -> Model:
    """The MDP of `size` truth values.

    Raises:
        ModelError: a parameter out of its range.
    """
    n = integer("size", size, 1, 256)
    chance = probability("success", success)
    xs = [boolean(f"x_{i}") for i in range(n)]
    return Model(
        "linear",
        xs,
        [_action(k, xs, chance) for k in range(n)],
        rewards=conditional(conjunction(xs), 1, 0),
        initial=dict.fromkeys(xs, FALSE),
        discount=discount_factor(discount),
        description="Boutilier et al.'s best case: setting a bit clears the higher ones.",
    )


def _action(k: int, xs: list[Feature], chance: Fraction) -> Action:
    x = xs[k]
    made_true: Expression = conditional(x, TRUE, lottery({TRUE: chance, FALSE: 1 - chance}))
    effects = {x: conditional(conjunction(xs[:k]), made_true, FALSE)}
    effects.update(dict.fromkeys(xs[k + 1 :], FALSE))
    return Action(f"a_{k}", effects)


def tasks(
    *, size: Size = 16, success: Success = Fraction(9, 10), discount: Discount = Fraction(95, 100)
) -> None:
    """None: the domain has no hierarchy."""
