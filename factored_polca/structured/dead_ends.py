"""Dead ends on diagrams: where every choice may lead to a state without choices.

Letters: c a choice, app_c where it applies, L the states that are lost.

    L = the least set with: every state that has not ended lies in L if no choice that applies there keeps
        out of L with certainty (where no choice applies, none does).

The value there is minus infinity, as in `factored_polca.solvers.preparation`.  A choice is *safe* where it
applies and surely keeps out of L; where a state is not lost some choice is.

Whether a set can be entered at all is asked of weights that are 1 where a probability is positive: their
sums are at least 1, or infinite, where the probability is positive, however small, and 0 elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import FLOAT, INDEX, Diagram, apply, choose
from factored_polca.diagrams.operations import Walk
from factored_polca.minimisation.criterion import DecisionProcess
from factored_polca.symbolic import NumericView, SymbolicModel
from factored_polca.symbolic.regression import Prepared


class PossibleView(NumericView):
    """What can happen, whatever its probability: weights 1 and 0."""

    def __init__(self, symbolic: SymbolicModel) -> None:
        super().__init__(symbolic, FLOAT)

    def stored(self, values: tuple[Fraction, ...] | list[Fraction]) -> npt.NDArray[Any]:
        """1 for what is not 0."""
        return np.array([1.0 if value else 0.0 for value in values])

    def prepared(self, action: int) -> Prepared:
        """As for probabilities, and remembered apart from them."""
        if action not in self._prepared:
            features = range(len(self.symbolic.model.features))
            weights = [self.weights(action, i) for i in features]
            self._prepared[action] = self.prepare(action, weights, ("possible", action))
        return self._prepared[action]

    def may_enter(self, action: int, states: Diagram) -> Diagram:
        """Where the action leads into `states` with positive probability, with no regard to where it
        applies; both are conditions."""
        found = self.regress(action, choose(states, self.one, self.zero))
        found.manager.safe_point()
        walk = Walk(found)
        positive = walk.leaf_payloads().view(np.float64) > 0
        return walk.with_leaves(positive.astype(np.uint64), INDEX)


@dataclass(frozen=True)
class Safety:
    """`lost`: where the value is minus infinity; `free`: where there are safe choices; `safe[c]`: where
    choice c is one.  All are conditions within the process's reachable states."""

    lost: Diagram
    free: Diagram
    safe: tuple[Diagram, ...]


def find_safety(process: DecisionProcess) -> Safety:
    """The dead ends of a process, and the choices that keep out of them.

    Raises:
        MemoryLimit, Aborted: as the manager says.
    """
    manager = process.symbolic.manager
    nowhere = manager.constant(0)
    live = ~process.terminal
    if process.reachable is not None:
        live = live & process.reachable
    applicable = tuple(choice.app & live for choice in process.choices)
    safe = list(applicable)
    free = _union(safe, nowhere)
    lost = apply("difference", live, free)
    if lost == nowhere:
        return Safety(lost, free, tuple(safe))
    view = PossibleView(process.symbolic)
    while True:
        entered: dict[int, Diagram] = {}
        for number, choice in enumerate(process.choices):
            risky = nowhere
            for primitive in choice.primitives:
                if primitive not in entered:
                    entered[primitive] = view.may_enter(primitive, lost)
                risky = risky | (choice.where(primitive) & entered[primitive])
            safe[number] = apply("difference", applicable[number], risky)
        free = _union(safe, nowhere)
        grown = apply("difference", live, free)
        if grown == lost:
            return Safety(lost, free, tuple(safe))
        lost = grown


def _union(conditions: list[Diagram], nowhere: Diagram) -> Diagram:
    result = nowhere
    for condition in conditions:
        result = result | condition
    return result
