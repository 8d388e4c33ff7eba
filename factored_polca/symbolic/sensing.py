"""Regression with observations, for fingerprints (DESIGN 4; Eq. 13 of the paper).

For each channel j and each of its values v a random field element rho_jv is drawn.  With

    w_j(x, x') = sum over v of rho_jv P_a(o_j = v | x', x)

(w_j = rho_j,null where the action does not sense j) the *sensed regression* of V is

    f_a(x) = sum over x' of T(x, a, x') V(x') prod_j w_j(x, x').

With V = r o P this is the random multilinear form sum over k, o of r_k prod_j rho_j,o_j K_a(x; k, o): equal
for two states where their joint rows over (block, observation) are, and else different but with
probability (J + 1) / p.  Joint observations are never listed, and the product of the w_j is never built.

*One parent.*  If no next feature is a parent of another, and each w_j depends on at most one next
feature x_i', it is folded into that feature's weights:

    c_iv = P_a(x_i' = v | x) prod_j w_j(x, x_i' = v),   S_i = sum over v of c_iv,
    f_a = R[V] * prod_i S_i * (the w_j over x alone),

R being the node-by-node regression with the weights c_iv / S_i, which sum to 1.  Where the draw makes
some S_i vanish (its chance is some 1/p a state), others are drawn.

*Otherwise* next features are summed out one by one, children before parents, each with those factors
only that mention it: V and the w_j over it, each restricted to the value first.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np

from factored_polca.diagrams import (
    Diagram,
    Field,
    cofactors,
    leaves,
    relabel,
    substitute_leaves,
    support,
    weighted_sum,
)
from factored_polca.symbolic.regression import NumericView, Prepared

_numbers = itertools.count()


@dataclass(frozen=True)
class _Folded:
    """An action whose channels have one parent each: the regression, and what multiplies it."""

    prepared: Prepared | None  # None: nothing changes
    factor: Diagram


class Vanished(ArithmeticError):
    """A draw made a sum of weights 0 somewhere: draw again."""


class SensedRegression:
    """The sensed regressions of a model in one field, with one draw.

    Raises:
        Vanished: the draw can't be used (a chance of some 1/p for each state).
    """

    def __init__(
        self, numbers: NumericView, channels: Sequence[int], generator: np.random.Generator
    ) -> None:
        assert isinstance(numbers.leaf_type, Field)
        self.numbers, self.field = numbers, numbers.leaf_type
        self.channels = tuple(channels)
        observations = numbers.symbolic.model.observations
        self.draws = {
            j: [self.field.decode(int(e)) for e in self.field.draw(generator, len(observations[j].values))]
            for j in self.channels
        }
        self._name = next(_numbers)
        self._weights: dict[int, list[Diagram]] = {}
        self._folded: dict[int, _Folded] = {}

    def regress(self, action: int, value: Diagram) -> Diagram:
        """f_a for V over the present variables, with no regard to where the action applies."""
        if self._simple(action):
            folded = self._fold(action)
            result = value
            if folded.prepared is not None and not value.is_constant:
                result = self.numbers.regress_nodes(folded.prepared, value)
            return result * folded.factor
        return self._eliminate(action, value)

    # -- the channels' weights -----------------------------------------------------------------

    def weights(self, action: int) -> list[Diagram]:
        """w_j over (x, x') for each channel."""
        if action not in self._weights:
            self._weights[action] = [self._weight(action, j) for j in self.channels]
        return self._weights[action]

    def _weight(self, action: int, channel: int) -> Diagram:
        symbolic, prime = self.numbers.symbolic, self.field.prime
        draws = self.draws[channel]
        row = symbolic.actions[action].observations.get(channel)
        if row is None:
            observation = symbolic.model.observations[channel]
            null = observation.values.index(observation.null)
            return self.numbers.manager.constant(draws[null], self.field)
        sums = [
            sum(q.numerator * pow(q.denominator, -1, prime) * d for q, d in zip(r, draws, strict=True) if q)
            for r in row.rows
        ]
        stored = np.array([self.field.encode(total % prime) for total in sums], dtype=np.uint64)
        return relabel(row.diagram, stored, self.field)

    def _next_levels(self, diagram: Diagram) -> list[int]:
        """The next features that a diagram over (x, x') tests, as levels."""
        last = 2 * len(self.numbers.symbolic.order)
        return [level for level in support(diagram) if level % 2 and level < last]

    # -- one parent each -----------------------------------------------------------------------

    def _simple(self, action: int) -> bool:
        if self.numbers.symbolic.actions[action].synchronic:
            return False
        return all(len(self._next_levels(w)) <= 1 for w in self.weights(action))

    def _fold(self, action: int) -> _Folded:
        if action not in self._folded:
            self._folded[action] = self._folded_weights(action)
        return self._folded[action]

    def _folded_weights(self, action: int) -> _Folded:
        numbers, symbolic = self.numbers, self.numbers.symbolic
        by_level: dict[int, list[Diagram]] = {}
        factors: list[Diagram] = []
        for w in self.weights(action):
            levels = self._next_levels(w)
            if levels:
                by_level.setdefault(levels[0], []).append(w)
            else:
                factors.append(w)
        weights: list[list[Diagram]] = []
        for feature in range(len(symbolic.model.features)):
            parts = numbers.weights(action, feature)
            sensed = by_level.get(symbolic.next(feature))
            if sensed:
                parts, total = self._weighed(parts, sensed, symbolic.next(feature))
                factors.append(total)
                if feature not in symbolic.actions[action].rows:
                    parts = numbers.weights(action, feature)  # it persists: c_iv / S_i = [x_i = v]
            weights.append(parts)
        prepared = None
        if symbolic.actions[action].rows:
            prepared = numbers.prepare(action, weights, ("sensed", self._name, action))
        return _Folded(prepared, product(factors, numbers.one))

    def _weighed(
        self, parts: Sequence[Diagram], sensed: Sequence[Diagram], level: int
    ) -> tuple[list[Diagram], Diagram]:
        """c_iv / S_i for each v, and S_i."""
        seen = [cofactors(w, level) for w in sensed]
        c = [product([w[v] for w in seen], part) for v, part in enumerate(parts)]
        total = reduce(lambda a, b: a + b, c)
        if 0 in leaves(total):
            raise Vanished
        prime = self.field.prime
        inverse = substitute_leaves(total, lambda value: pow(value, -1, prime))
        return [part * inverse for part in c], total

    # -- the general case ----------------------------------------------------------------------

    def _eliminate(self, action: int, value: Diagram) -> Diagram:
        numbers, symbolic = self.numbers, self.numbers.symbolic
        live = [numbers.shift(value), *self.weights(action)]
        for feature in symbolic.actions[action].elimination:
            level = symbolic.next(feature)
            touched = [d for d in live if level in support(d)]
            if not touched:
                continue
            live = [d for d in live if level not in support(d)]
            seen = [cofactors(d, level) for d in touched]
            parts = [product(values, None) for values in zip(*seen, strict=True)]
            live.append(weighted_sum(numbers.weights(action, feature), parts, normalised=True))
        return product(live, None)


def product(factors: Sequence[Diagram], start: Diagram | None) -> Diagram:
    """The product of some diagrams, `start` among them; equal ones in any order give the same diagram."""
    rest = list(factors) if start is None else [start, *factors]
    result = rest[0]
    for factor in rest[1:]:
        result = result * factor
    return result
