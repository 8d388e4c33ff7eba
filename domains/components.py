"""Independent components that wear out: 3^size states, of which only the counts matter.

A benchmark of this project for exact minimisation; it has no outside source.  Symmetric independent
components are the classical example of lumpable Markov chains (J. G. Kemeny and J. L. Snell, "Finite
Markov Chains", 1960, chapter 6): by symmetry a state is known by how many components are in
each condition.

n = `size` components c_0 .. c_{n-1}, each ok, degraded or failed, all independent.  In a `noop` an
ok component stays so with probability 9/10, a degraded one with 8/10, else each goes one step down.
In a `fix` a degraded component is repaired with probability 1/2, a failed one becomes ok with 1/4
and degraded with 1/4, and all else stays.  Reward: the number ok minus twice the number failed.

The flat quotient has (n + 1)(n + 2)/2 blocks, the ways to share n components among three conditions:
3^40 states, about 1.2 * 10^19, become 861 blocks.  There is no hierarchy.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor, integer
from factored_polca.models import Action, Constant, Expression, Feature, Model, Switch, lottery

Size = Annotated[int, "number n of components; 3^n states, (n + 1)(n + 2)/2 blocks"]
Discount = Annotated[Number, "discount, from 0 to 1"]

_CONDITIONS = ("ok", "degraded", "failed")


def model(*, size: Size = 10, discount: Discount = Fraction(95, 100)) -> Model:
    """The MDP of `size` components; all are ok at the start.

    Raises:
        ModelError: a parameter out of its range.
    """
    n = integer("size", size, 1, 2000)
    parts = [Feature(f"c_{i}", _CONDITIONS) for i in range(n)]
    return Model(
        "components",
        parts,
        [
            Action("noop", {part: _worn(part) for part in parts}),
            Action("fix", {part: _fixed(part) for part in parts}),
        ],
        rewards=[_worth(part) for part in parts],
        initial={part: Constant("ok") for part in parts},
        discount=discount_factor(discount),
        description="Independent components that are ok, degraded or failed.",
    )


def _by_condition(part: Feature, ok: Expression, degraded: Expression, failed: Expression) -> Expression:
    return Switch(part.now, tuple(zip(_CONDITIONS, (ok, degraded, failed), strict=True)))


def _worn(part: Feature) -> Expression:
    return _by_condition(
        part,
        lottery({"ok": Fraction(9, 10), "degraded": Fraction(1, 10)}),
        lottery({"degraded": Fraction(8, 10), "failed": Fraction(2, 10)}),
        Constant("failed"),
    )


def _fixed(part: Feature) -> Expression:
    return _by_condition(
        part,
        Constant("ok"),
        lottery({"ok": Fraction(1, 2), "degraded": Fraction(1, 2)}),
        lottery({"ok": Fraction(1, 4), "degraded": Fraction(1, 4), "failed": Fraction(1, 2)}),
    )


def _worth(part: Feature) -> Expression:
    return _by_condition(part, Constant(Fraction(1)), Constant(Fraction(0)), Constant(Fraction(-2)))


def tasks(*, size: Size = 10, discount: Discount = Fraction(95, 100)) -> None:
    """None: the domain has no hierarchy."""
