"""The value of a finite horizon by brute force: what exact solvers are checked against.

Two independent ways, both from the definition, nothing pruned:

- `forward_value`: the expectation over the tree of actions and observations from one belief,

      V_0(m) = 0,
      V_h(m) = sum over y of max over a of ( m_y . R_a + gamma * sum over o of V_{h-1}(m_y K_a(.; ., o)) )

  where m is a belief, or a part of one that is not normalised (V_h scales with it), and m_y its part at
  states that look like y (`ArrayPOMDP.observed`), terminal states left out, as they are worth 0.

- `enumerate_vectors`: all vectors of all policy trees (Sondik 1971; Monahan, "A survey of partially
  observable Markov decision processes", Management Science 1982): for each y and a, every way to choose
  a vector of the shorter horizon for each (o, y') that a can lead to.  Equal vectors are kept once.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from factored_polca.explicit.alpha_vectors import AlphaSet, AlphaVectors
from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.models.errors import LimitReached


def forward_value(pomdp: ArrayPOMDP, belief: FloatArray, horizon: int) -> float:
    """V_horizon at a belief [s]."""
    return float(forward_values(pomdp, np.asarray(belief, dtype=np.float64)[None, :], horizon)[0])


def forward_values(pomdp: ArrayPOMDP, beliefs: FloatArray, horizon: int) -> FloatArray:
    """V_horizon [n] at beliefs [n, s]; the time grows like (actions * observations) ** horizon."""
    kernel = [[matrix.toarray() for matrix in row] for row in pomdp.kernel]
    looks = np.unique(pomdp.observed[~pomdp.terminal]).tolist()
    parts = [(pomdp.observed == y) & ~pomdp.terminal for y in looks]

    def value(masses: FloatArray, steps: int) -> FloatArray:
        total = np.zeros(len(masses))
        if steps == 0:
            return total
        for part in parts:
            here = np.where(part, masses, 0.0)
            if not here.any():
                continue
            worth = np.full(len(masses), -np.inf)
            for rewards, row in zip(pomdp.rewards, kernel, strict=True):
                later = sum((value(here @ matrix, steps - 1) for matrix in row), np.zeros(len(masses)))
                worth = np.maximum(worth, here @ rewards + pomdp.discount * later)
            total += worth
        return total

    return value(beliefs, horizon)


def enumerate_vectors(pomdp: ArrayPOMDP, horizon: int, limit: int = 100_000) -> AlphaVectors:
    """Every vector of every policy tree of `horizon` steps, with the action at the root of the tree.

    Raises:
        LimitReached: more than `limit` vectors for one y.
    """
    looks = np.unique(pomdp.observed[~pomdp.terminal]).tolist()
    states = [np.flatnonzero((pomdp.observed == y) & ~pomdp.terminal) for y in looks]
    sets = [AlphaSet(mine, np.zeros((1, len(mine))), np.zeros(1, dtype=np.int64)) for mine in states]
    for _ in range(horizon):
        sets = [_expanded(pomdp, mine, sets, limit) for mine in states]
    return AlphaVectors(pomdp.states, tuple(sets), "exact")


def _expanded(pomdp: ArrayPOMDP, mine: IntArray, sets: list[AlphaSet], limit: int) -> AlphaSet:
    """The vectors over the states `mine`, for one step more than those of `sets`."""
    vectors: list[FloatArray] = []
    actions: list[int] = []
    for action, row in enumerate(pomdp.kernel):
        known = set()
        branches = []
        for matrix in row:
            for part in sets:
                block = matrix[mine, :][:, part.states].toarray()
                if block.any():
                    branches.append(pomdp.discount * part.vectors @ block.T)
        for choice in product(*branches):
            vector = pomdp.rewards[action, mine] + sum(choice, np.zeros(len(mine)))
            if vector.tobytes() not in known:
                known.add(vector.tobytes())
                vectors.append(vector)
                actions.append(action)
            if len(vectors) > limit:
                raise LimitReached(f"more than {limit} vectors: take a shorter horizon", "enumeration")
    return AlphaSet(mine, np.array(vectors), np.array(actions, dtype=np.int64))
