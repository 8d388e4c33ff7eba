"""Policy graphs: finite-state controllers, and their exact value by one linear system.

A node n takes the action a_n and moves to succ(n, o, y) on the observation o and what is seen, y.
Its value in each state solves

    V_n(s) = R(a_n, s) + gamma * sum over o, t of K_{a_n}(s; t, o) V_{succ(n, o, y(t))}(t)

(Hansen 1998).  max over n of V_n(b) bounds the optimal value from below.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csc_array, eye_array
from scipy.sparse.linalg import splu

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.models.errors import ModelError


@dataclass(frozen=True)
class PolicyGraph:
    """A finite-state controller.

    `successors[n]` is [o, y]; an entry of -1 says that this pair can't be observed in a run from
    `start`.  `start` [y] is the first node for what is seen at the start, -1: not defined.
    """

    actions: IntArray  # [n]
    successors: tuple[IntArray, ...]  # [n] arrays [o, y], o over the action's own observations
    start: IntArray  # [y]

    @property
    def nodes(self) -> int:
        """The number of nodes."""
        return len(self.actions)


def evaluate(graph: PolicyGraph, pomdp: ArrayPOMDP) -> FloatArray:
    """V_n(s) [n, s], by a sparse factorisation; pairs without a successor count as the value 0.

    Raises:
        ModelError: discount 1, where the system may be singular.
    """
    if not pomdp.discount < 1:
        raise ModelError("a policy graph is evaluated for a discount below 1 only")
    states, nodes = pomdp.states, graph.nodes
    size = nodes * states
    moves = csc_array((size, size))
    for action in np.unique(graph.actions).tolist():
        mine = np.flatnonzero(graph.actions == action)
        successors = np.array([graph.successors[node] for node in mine])  # [n, o, y]
        for observation, matrix in enumerate(pomdp.kernel[action]):
            cells = matrix.tocoo()
            target = successors[:, observation, :][:, pomdp.observed[cells.col]]  # [n, cell]
            known = target >= 0
            rows = (mine[:, None] * states + cells.row)[known]
            columns = (target * states + cells.col)[known]
            chances = np.broadcast_to(cells.data, target.shape)[known]
            moves = moves + csc_array(coo_array((chances, (rows, columns)), shape=(size, size)))
    if nodes == 0:
        return np.zeros((0, states))
    rewards = pomdp.rewards[graph.actions].reshape(-1)
    system = csc_array(eye_array(size)) - pomdp.discount * moves
    values: FloatArray = splu(csc_array(system)).solve(rewards)
    return values.reshape(nodes, states)


def value(graph: PolicyGraph, pomdp: ArrayPOMDP, values: FloatArray, belief: FloatArray) -> float:
    """What the graph earns from `belief` [s], given `values` [n, s] from `evaluate`.

    Raises:
        ModelError: the start is not defined for something that may be seen.
    """
    start = graph.start[pomdp.observed]
    if np.any((start < 0) & (belief > 0) & ~pomdp.terminal):
        raise ModelError("the policy graph has no first node for something that may be seen at the start")
    known = start >= 0
    return float(np.sum(belief[known] * values[start[known], np.flatnonzero(known)]))
