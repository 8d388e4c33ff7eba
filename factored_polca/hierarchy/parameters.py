"""How many numbers a plan's models have: the counts of the paper's Figure 4a.

    parameters = non-zero entries of all K_c(C; C', o) and of all R(C, c), c a choice of the task,

each task once.  Three readings of one hierarchy:

    none     states not merged, observations as they are sensed; counted where states can be listed
    PolCA    the quotients that suppose the state seen: T_c(C, C') and R(C, c), without observations
    PolCA+   the quotients that Eq. 13 allows, observations merged without loss

An abstract action has the entries of the primitive that its child takes at each state.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factored_polca.explicit.arrays import ArrayMDP, IntArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.minimisation import DecisionProcess
from factored_polca.minimisation.quotient import distinct_rewards, primitives_at
from factored_polca.minimisation.unreduced import unreduced
from factored_polca.models import LimitReached
from factored_polca.symbolic import SymbolicModel

LISTED_STATES = 20_000
"""States up to which parameters without abstraction are counted, by listing all."""


def pomdp_parameters(pomdp: ArrayPOMDP) -> int:
    """Non-zero entries of the joint kernel and the rewards."""
    kernel = sum(int((matrix.data != 0).sum()) for row in pomdp.kernel for matrix in row)
    return kernel + int(np.count_nonzero(pomdp.rewards))


def mdp_parameters(mdp: ArrayMDP) -> int:
    """Non-zero entries of the transitions and the rewards."""
    kernel = sum(int((matrix.data != 0).sum()) for matrix in mdp.transitions)
    return kernel + int(np.count_nonzero(mdp.rewards))


def unreduced_parameters(symbolic: SymbolicModel, processes: Sequence[DecisionProcess]) -> list[int] | None:
    """The parameters of each process without abstraction, None where its states are too many to list."""
    if symbolic.model.states > LISTED_STATES:
        return None
    try:
        listed = unreduced(symbolic, maximum_states=LISTED_STATES)
    except LimitReached:
        return None
    entries = np.array(  # [primitive, state]
        [sum(_row_lengths(matrix) for matrix in row) for row in listed.pomdp.kernel]
    )
    return [_counted(process, listed.states, entries) for process in processes]


def _row_lengths(matrix: object) -> IntArray:
    clean = matrix.copy()  # type: ignore[attr-defined]
    clean.eliminate_zeros()
    lengths: IntArray = np.diff(clean.indptr).astype(np.int64)
    return lengths


def _counted(process: DecisionProcess, states: np.typing.NDArray[np.int32], entries: IntArray) -> int:
    columns, total = process.symbolic.columns(), 0
    for choice in process.choices:
        taken = primitives_at(choice, states, columns)
        for p in sorted({*taken.tolist()} - {-1}):
            mine = np.flatnonzero(taken == p)
            total += int(entries[p, mine].sum())
            sums, place = distinct_rewards(process, p, states[mine])
            total += int(np.array([value != 0 for value in sums])[place].sum())
    return total
