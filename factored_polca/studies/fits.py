"""How something grows: least squares on logarithms, with the uncertainty of what is fitted.

    power         y = c x^b      log y = log c + b log x      b the exponent
    exponential   y = c q^x      log y = log c + x log q      q the factor of one more

Letters: n points (u_i, v_i), u = log x or x, v = log y; m_u, m_v their means; S = sum (u_i - m_u)^2;

    b = sum (u_i - m_u)(v_i - m_v) / S,     e_i = v_i - m_v - b (u_i - m_u),
    standard error of b = sqrt( sum e_i^2 / (n - 2) / S ),

and b lies within t standard errors in 95 of 100 cases, t from Student's distribution with n - 2 degrees of
freedom, *if* the curve is right and the deviations are independent and normal (any textbook of linear
regression).  Neither need be: so both curves are fitted, and the one with the smaller residual is named the
better one; with equal numbers of parameters that is also the likelier one.

Runs with several seeds count once for each x, by their median: they are not independent of one another.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import Final, Literal

CONFIDENCE: Final = 0.95
FEWEST: Final = 3
"""Different x without which nothing is fitted."""


@dataclass(frozen=True)
class Fit:
    """One curve through points; `rate` is b, of an exponential one log q."""

    kind: Literal["power", "exponential"]
    rate: float
    standard_error: float
    margin: float  # half of the 95 % interval of the rate
    level: float  # log c
    residual: float  # root of the mean square of e_i

    def at(self, x: float) -> float:
        """The curve at `x`."""
        return math.exp(self.level + self.rate * (math.log(x) if self.kind == "power" else x))

    def text(self, name: str = "n") -> str:
        """The growth in words: `n^1.98 ± 0.05`, or `2.01^n (1.95 to 2.07)`, with 95 % intervals."""
        if self.kind == "power":
            return f"{name}^{self.rate:.2f} ± {rounded_up(self.margin)}"
        low, high = factor(self.rate - self.margin), factor(self.rate + self.margin)
        return f"{factor(self.rate):.3g}^{name} ({low:.3g} to {high:.3g})"


@dataclass(frozen=True)
class Growth:
    """Both curves through the same points."""

    points: tuple[tuple[float, float], ...]  # (x, median of y), ascending
    power: Fit
    exponential: Fit

    @property
    def better(self) -> Fit:
        """The curve with the smaller residual; the power where there is no difference."""
        apart = self.exponential.residual < self.power.residual - 1e-12
        return self.exponential if apart else self.power


def factor(rate: float) -> float:
    """The factor whose logarithm is `rate`; infinite beyond the numbers."""
    return math.exp(rate) if rate < 700 else math.inf


def rounded_up(margin: float) -> str:
    """A margin with two places, never as 0 where it isn't."""
    if not math.isfinite(margin):
        return "?"
    return f"{margin:.2f}" if margin >= 0.005 or margin < 1e-9 else f"{margin:.1g}"


def growth(points: Iterable[tuple[float, float]]) -> Growth | None:
    """The curves through points (x, y); None where fewer than three x > 0 have a y > 0."""
    by_x: dict[float, list[float]] = {}
    for x, y in points:
        if x > 0 and y > 0 and math.isfinite(x) and math.isfinite(y):
            by_x.setdefault(x, []).append(y)
    if len(by_x) < FEWEST:
        return None
    kept = tuple((x, median(by_x[x])) for x in sorted(by_x))
    return Growth(kept, _fit("power", kept), _fit("exponential", kept))


def _fit(kind: Literal["power", "exponential"], points: Sequence[tuple[float, float]]) -> Fit:
    from scipy.stats import t as student

    u = [math.log(x) if kind == "power" else x for x, _ in points]
    v = [math.log(y) for _, y in points]
    middle_u, middle_v = fmean(u), fmean(v)
    spread = math.fsum((one - middle_u) ** 2 for one in u)
    rate = math.fsum((a - middle_u) * (b - middle_v) for a, b in zip(u, v, strict=True)) / spread
    errors = [b - middle_v - rate * (a - middle_u) for a, b in zip(u, v, strict=True)]
    squares, freedom = math.fsum(e * e for e in errors), len(points) - 2
    standard_error = math.sqrt(squares / freedom / spread)
    margin = float(student.ppf((1 + CONFIDENCE) / 2, freedom)) * standard_error
    level = middle_v - rate * middle_u
    return Fit(kind, rate, standard_error, margin, level, math.sqrt(squares / len(points)))
