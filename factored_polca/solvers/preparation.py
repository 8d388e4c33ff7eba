"""From an MDP to the pairs that solvers may iterate over: finite values, no end component in the way.

Dead ends.  A state that is neither terminal nor has an applicable action has the value minus
infinity; so has every action that may enter such a state, and so every state all of whose actions
may.  The least set closed under this is removed beforehand, so that no infinity enters arithmetic.

Discount 1.  A policy is *proper* from s if it reaches a terminal state, or a component where it
earns 0 for ever, with probability 1.  After the refusals of `end_components` every other way to go
on for ever loses reward without bound; so a state without a proper policy has the value minus
infinity under every policy, and it is a dead end too: the largest set is kept from which a target
can be reached by pairs that never leave the set (Puterman 1994, chapter 7; de Alfaro 1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factored_polca.explicit.arrays import ArrayMDP, BoolArray, FloatArray, IntArray
from factored_polca.solvers.end_components import (
    Describe,
    collapse,
    maximal_end_components,
    refuse_unbounded,
)
from factored_polca.solvers.graph import distance_order, prune
from factored_polca.solvers.pairs import STAY, Pairs, pairs_of


@dataclass(frozen=True)
class Prepared:
    """An MDP ready to be solved.

    `pairs` holds the pairs to choose among, over nodes; `node` [s] is each state's node; at discount
    1 a node can be a whole component.  `original` holds the same pairs, those inside components
    included, over states.
    """

    mdp: ArrayMDP
    pairs: Pairs
    node: IntArray  # [s]
    dead_ends: BoolArray  # [s]
    original: Pairs
    component: IntArray  # [s] number of the collapsed component, -1: none

    @property
    def has_fixed_nodes(self) -> bool:
        """Whether some node that pairs may enter has a fixed value (0)."""
        return len(self.pairs.free) < self.pairs.nodes

    def on_states(self, values: FloatArray) -> FloatArray:
        """Values of nodes as values of states, minus infinity at dead ends."""
        return np.where(self.dead_ends, -np.inf, values[self.node])


def prepare(mdp: ArrayMDP, describe: Describe | None = None) -> Prepared:
    """Check the arrays, remove dead ends and, at discount 1, collapse and check end components.

    Raises:
        ModelError: faulty arrays, or at discount 1 an end component without a finite value.
    """
    pairs = pairs_of(mdp)
    S = mdp.states
    stuck = (np.diff(pairs.start) == 0) & ~mdp.terminal
    dead = np.zeros(S, dtype=np.bool_)
    if np.any(stuck):
        dead, alive = prune(pairs, stuck, np.ones(pairs.count, dtype=np.bool_))
        pairs = pairs.keep(alive)
    none = np.full(S, -1, dtype=np.int64)
    if pairs.discount < 1:
        return Prepared(mdp, pairs, np.arange(S), dead, pairs, none)
    components = maximal_end_components(pairs, pairs.reward == 0)
    original, node = pairs, np.arange(S)
    if components.count:
        pairs, node = collapse(pairs, components)
    refuse_unbounded(pairs, describe)
    target = np.zeros(pairs.nodes, dtype=np.bool_)
    target[node[mdp.terminal]] = True
    target[pairs.owner[pairs.action == STAY]] = True
    improper, alive = _improper(
        pairs, target, dead_nodes=np.bincount(node[dead], minlength=pairs.nodes) > 0
    )
    dead = dead | improper[node]
    if np.any(dead):
        pairs = pairs.keep(alive)
        original = original.keep(~(original.touches(dead) | dead[original.owner]))
    return Prepared(mdp, pairs, node, dead, original, components.label)


def _improper(pairs: Pairs, target: BoolArray, dead_nodes: BoolArray) -> tuple[BoolArray, BoolArray]:
    """(nodes from which `target` can't be reached with probability 1, pairs that avoid them all)."""
    gone, alive = dead_nodes, np.ones(pairs.count, dtype=np.bool_)
    while True:
        reached = distance_order(pairs, target, alive) >= 0
        if np.all(reached | gone):
            return gone, alive
        lost, alive = prune(pairs, ~reached, alive)
        gone = gone | lost
