"""A whole model as arrays, whatever its observability: what flat solvers take and policies are run on.

A partially observed model is `factored_polca.minimisation.unreduced`.  A fully observed one is the same
kind of arrays with every state told apart; where its actions do not apply everywhere, their rows there
are empty, which POMDP solvers refuse and `to_mdp` reads as *not applicable*.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order

from factored_polca.explicit.arrays import ArrayMDP, FloatArray, IntArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.minimisation.outcomes import Int32Array, Numbering, make_draw, outcomes, parents_first
from factored_polca.minimisation.unreduced import unreduced, unreduced_mdp
from factored_polca.symbolic import SymbolicModel


@dataclass(frozen=True)
class FlatModel:
    """Arrays over listed states; `partial_action` names an action that does not apply everywhere."""

    symbolic: SymbolicModel
    pomdp: ArrayPOMDP
    states: Int32Array  # [s, feature] value numbers
    reachable: bool  # whether only states that the start can reach are listed
    partial_action: str | None = None

    @property
    def fully_observed(self) -> bool:
        """Whether the model says that its state is seen."""
        return self.symbolic.model.observability == "full"

    def to_mdp(self) -> ArrayMDP:
        """The process with its state seen; an action applies where its row is not empty."""
        mdp = self.pomdp.to_mdp()
        applicable = np.array([np.diff(matrix.indptr) > 0 for matrix in mdp.transitions])
        return ArrayMDP(mdp.actions, mdp.transitions, mdp.rewards, applicable, mdp.terminal, mdp.discount)

    def state_text(self, state: int) -> str:
        """State number `state` as `x=3, y=on`."""
        features = self.symbolic.model.features
        values = [f.values[v] for f, v in zip(features, self.states[state].tolist(), strict=True)]
        shown = [str(v).lower() if isinstance(v, bool) else str(v) for v in values]
        return ", ".join(f"{f.name}={text}" for f, text in zip(features, shown, strict=True))

    def digest(self) -> str:
        """A hash of the list of states: equal digests mean equal state numbers."""
        sizes = [len(feature.values) for feature in self.symbolic.model.features]
        content = np.ascontiguousarray(self.states, dtype="<i4").tobytes()
        return hashlib.sha256(f"{sizes} {len(self.states)} ".encode() + content).hexdigest()


def flat_model(symbolic: SymbolicModel, *, reachable: bool = True) -> FlatModel:
    """The arrays of a compiled model, over the states that the start can reach or over all.

    Raises:
        LimitReached: more states, observations or transitions than may be listed.
    """
    live = ~symbolic.terminal
    partial = next((action.name for action in symbolic.actions if action.app != live), None)
    if symbolic.model.observability == "partial" or partial is None:
        found = unreduced(symbolic, reachable=reachable)
        return FlatModel(symbolic, found.pomdp, found.states, reachable)
    mdp = unreduced_mdp(symbolic)
    sizes = [len(feature.values) for feature in symbolic.model.features]
    states = Numbering(sizes).decode(np.arange(mdp.states)[:, None])
    initial = _initial(symbolic, sizes)
    kept = _reached(mdp, initial) if reachable else np.arange(mdp.states)
    pomdp = ArrayPOMDP(
        actions=mdp.actions,
        observations=(("nothing",),) * len(mdp.actions),
        kernel=tuple((csr_array(matrix[kept][:, kept]),) for matrix in mdp.transitions),
        rewards=mdp.rewards[:, kept],
        terminal=mdp.terminal[kept],
        observed=np.arange(len(kept)),
        initial=initial[kept],
        discount=mdp.discount,
    )
    return FlatModel(symbolic, pomdp, states[kept], reachable, partial)


def _initial(symbolic: SymbolicModel, sizes: list[int]) -> FloatArray:
    """b0 over all states of the product."""
    n, rows = len(sizes), symbolic.initial
    draws = [make_draw(rows[i], n + i) for i in parents_first(rows)]
    result = np.zeros(Numbering(sizes).count)
    for _, table, chance in outcomes(draws, symbolic.columns(), np.zeros((1, 2 * n), dtype=np.int32)):
        np.add.at(result, Numbering(sizes).encode(table[:, n:])[:, 0], chance)
    return result


def _reached(mdp: ArrayMDP, initial: FloatArray) -> IntArray:
    """The states that the support of b0 leads to, ascending."""
    count = mdp.states
    pieces = [matrix.tocoo() for matrix in mdp.transitions]
    start = np.flatnonzero(initial)
    row = np.concatenate([*(piece.row for piece in pieces), np.full(len(start), count)])
    column = np.concatenate([*(piece.col for piece in pieces), start])
    shape = (count + 1, count + 1)
    graph = csr_array(coo_array((np.ones(len(row)), (row, column)), shape=shape))
    found = breadth_first_order(graph, count, return_predecessors=False)
    return np.sort(found[found < count]).astype(np.int64)
