"""What a policy of alpha-vectors does, and how good it is, where it is sure of the state.

At the corner b(x) = 1 the value of the policy is at least the largest alpha(x), and its action that of the
first alpha-vector that is the largest: both are diagrams over x, made pointwise, and no state is listed.
With base bounds Q_a (`pomdp_upper`) and the values u of corners that were searched,

    max over alpha of alpha(x)  <=  V*(x)  <=  min(max over a of Q_a(x), u(x)),

and the largest difference of the two is found among the leaves of one more diagram, with a state where it
is: the corner that the search goes to next.

Ties: the first action whose value is within 1e-9 of the best, relative to it where it exceeds 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import TYPE_CHECKING

import numpy as np

from factored_polca.diagrams import FLOAT, Diagram, apply, choose, leaves, states_for_leaves
from factored_polca.structured.bellman import first_best
from factored_polca.structured.pomdp_lower import AlphaSet
from factored_polca.structured.pomdp_model import FactoredPOMDP, Seen
from factored_polca.structured.pomdp_search import Node, Search

if TYPE_CHECKING:
    from factored_polca.structured.pomdp_solution import AlphaDiagrams


def largest_of(diagrams: Sequence[Diagram]) -> Diagram:
    """The pointwise maximum."""
    return reduce(lambda a, b: apply("maximum", a, b), diagrams)


def where_seen(pomdp: FactoredPOMDP, seen: Seen) -> Diagram:
    """The condition that the observed features have the values y."""
    manager, symbolic = pomdp.manager, pomdp.symbolic
    result = manager.constant(1)
    for i, value in zip(pomdp.observed, seen, strict=True):
        result = result & manager.indicator(symbolic.now(i), [value])
    return result


def corner_policy(policy: AlphaDiagrams) -> tuple[Diagram, Diagram]:
    """The value of a policy at each corner, at least, and the number of its action there, by state.

    Where the process has ended, the value is 0 and the action the first.
    """
    pomdp = policy.space.pomdp
    value, action = _greedy(policy.blind)
    for seen in policy.slices:
        here = where_seen(pomdp, seen)
        best, chosen = _greedy([(alpha.action, alpha.diagram) for alpha in policy.at(seen).alphas])
        value, action = choose(here, best, value), choose(here, chosen, action)
    ended = pomdp.symbolic.terminal
    return choose(ended, pomdp.zero, value), choose(ended, pomdp.manager.constant(0), action)


def _greedy(alphas: Sequence[tuple[int, Diagram]]) -> tuple[Diagram, Diagram]:
    """The largest value by state, and the first action that has it."""
    actions = sorted({action for action, _ in alphas})
    by_action = [(a, largest_of([diagram for b, diagram in alphas if b == a])) for a in actions]
    best = largest_of([value for _, value in by_action])
    return best, first_best(by_action, best, best.manager.constant(actions[0]))


class Corners:
    """Bounds at all corners, and the one that is known worst."""

    def __init__(self, search: Search) -> None:
        self.search, self.pomdp = search, search.space.pomdp
        self.upper = largest_of(search.upper.quality)
        for seen in search.upper.informed.q if search.upper.informed is not None else ():
            better = apply("minimum", self.upper, largest_of(search.upper.base(seen)))
            self.upper = choose(where_seen(self.pomdp, seen), better, self.upper)
        self.lower = largest_of([diagram for _, diagram in search.lower.blind])
        self.open = choose(self.pomdp.symbolic.terminal, self.pomdp.zero, self.pomdp.one)
        self._known: dict[Seen, tuple[int, int]] = {}

    def worst(self) -> tuple[float, Node | None]:
        """The largest upper - lower of the corners that are not given up, and a node where it is."""
        self._refresh()
        difference = (self.upper - self.lower) * self.open
        values = np.array(leaves(difference), dtype=np.float64)
        place = int(values.argmax())
        if not values[place] > 0.0:
            return 0.0, None
        state = states_for_leaves(difference)[place].tolist()
        return float(values[place]), self.search.node(self.search.space.corner(state))

    def _refresh(self) -> None:
        """The lower bound from the alpha-vectors that are new."""
        for seen, known in self.search.lower.sets.items():
            since = self._since(seen, known)
            self._known[seen] = (known.version, len(known.alphas))
            if since < len(known.alphas):
                part = largest_of([alpha.diagram for alpha in known.alphas[since:]])
                better = apply("maximum", self.lower, part)
                self.lower = choose(where_seen(self.pomdp, seen), better, self.lower)

    def _since(self, seen: Seen, known: AlphaSet) -> int:
        version, count = self._known.get(seen, (-1, 0))
        return count if version == known.version else 0

    def learn(self, node: Node) -> None:
        """The upper bound at the corner of a node."""
        bound = self.pomdp.manager.constant(node.upper, FLOAT)
        better = apply("minimum", self.upper, bound)
        self.upper = choose(self._at(node), better, self.upper)

    def give_up(self, node: Node) -> None:
        """Look for no better bounds at the corner of a node."""
        self.open = choose(self._at(node), self.pomdp.zero, self.open)

    def _at(self, node: Node) -> Diagram:
        space, manager = self.search.space, self.pomdp.manager
        result = where_seen(self.pomdp, node.belief.seen)
        for level in space.levels.tolist():
            begin = int(space.offset[level])
            value = int(node.belief.marginals[begin : begin + manager.sizes[level]].argmax())
            result = result & manager.indicator(level, [value])
        return result

    def gap(self, policy: AlphaDiagrams) -> float:
        """The largest upper - lower at any corner, the lower one being what the policy earns there."""
        difference = self.upper - corner_policy(policy)[0]
        ended = self.pomdp.symbolic.terminal
        return max(float(v) for v in leaves(choose(ended, self.pomdp.zero, difference)))
