"""The simulation lemma: how far a policy's value in a snapped model can be from that in the model itself.

If the rewards of two processes differ by at most r and their rows by a total variation of at most d, then
for every policy, one with a memory included, and every start

    |V^pi - V^^pi| <= (r + gamma d span) / (1 - gamma)                                               (1)

with span the largest difference of values in one of the two, at most (R_max - R_min) / (1 - gamma)
(Kearns & Singh 2002; Even-Dar & Mansour 2003; Strehl, Li & Littman 2009).  A policy that is optimal in
the one loses at most twice that in the other.

*Where the state is not seen* the same holds with the joint rows over (x', o), for every policy from
histories to actions: what is unwound step by step, one policy being followed in both, is

    D(h, x) = V(h, x) - V^(h, x) = R - R^ + gamma sum_(x',o) [K(x; x', o) - K^(x; x', o)] V^(hao, x')
                                   + gamma sum_(x',o) K(x; x', o) D(hao, x').

Errors may depend on the state.  With r_c(C), d_c(C) the largest in block C (`errors`; channels included), E
the largest e(C) and K^_c(C, C') the quotient's rows with the state seen,

    e(C) <- max over c of  r_c + gamma d_c span + gamma min(E, sum_C' K^_c(C, C') e(C') + d_c E)         (2)

bounds |D| if it does so before; it is started from (1), and every step keeps it a bound.

*Alpha-vectors.*  Let V(b) = max of alpha . b be a lower bound that its own greedy policy improves on in
the snapped model, V(b) <= R^(b, c) + gamma sum_o V(K^_o b), as point-based methods keep it.  Then in the
model itself, tracked with its own rows, V(b) <= R(b, c) + sum_C b(C) [r_c(C) + gamma d_c(C) span] + gamma
sum_o V(K_o b), span being that of the vectors' entries: so the policy earns at least V(b0) - sum_C b0(C)
e(C), with e of (2) for this span.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import sparse

from factored_polca.approximation.errors import MARGIN, Errors
from factored_polca.approximation.extremes import Game, extreme_values
from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.arrays import ArrayMDP, FloatArray

STEPS: Final = 200
"""Steps of (2)."""


def uniform_error(errors: Errors, discount: float) -> float:
    """(1), with the largest r and d of all blocks; infinite at discount 1 unless there are no errors."""
    r, d = float(errors.rewards.max(initial=0.0)), float(errors.rows.max(initial=0.0))
    if r == 0 and d == 0:
        return 0.0
    if discount >= 1:
        return np.inf
    span = errors.reward_span / (1 - discount)
    return (r + discount * d * span) / (1 - discount) * (1 + MARGIN)


def value_span(mdp: ArrayMDP, features: int) -> tuple[float, float]:
    """The least and the largest value that any policy has in any state of `mdp`, having ended included."""
    game = Game(
        sparse.vstack(mdp.transitions, format="csr"), np.arange(mdp.states), np.arange(mdp.states),
        mdp.terminal, mdp.discount, features, lambda: None,
    )  # fmt: skip
    high = extreme_values(game, mdp.rewards, mdp.applicable, "upper")
    low = -extreme_values(game, -mdp.rewards, mdp.applicable, "upper")
    return float(low.min(initial=0.0)), float(high.max(initial=0.0))


def entry_span(policy: object) -> float | None:
    """The largest difference of entries of alpha-vectors, 0 included; None for other policies."""
    if not isinstance(policy, AlphaVectors) or policy.meaning == "heuristic":
        return None
    low = min((float(part.vectors.min(initial=0.0)) for part in policy.sets), default=0.0)
    return max((float(part.vectors.max(initial=0.0)) for part in policy.sets), default=0.0) - low


def block_errors(errors: Errors, mdp: ArrayMDP, span: float) -> FloatArray:
    """e [block] of (2) for the quotient `mdp` with the state seen; 0 where it has ended."""
    live = ~mdp.terminal
    if not (errors.rewards.any() or errors.rows.any()):
        return np.zeros(mdp.states)
    here = errors.rewards + mdp.discount * errors.rows * span
    result = np.where(live, float(here.max(initial=0.0)) / (1 - mdp.discount), 0.0) * (1 + MARGIN)
    for _ in range(STEPS):
        most = float(result.max(initial=0.0))
        ahead = np.stack([matrix @ result for matrix in mdp.transitions])
        further = np.minimum(most, ahead * (1 + MARGIN) + errors.rows * most)
        new = np.where(live, (here + mdp.discount * further).max(axis=0), 0.0) * (1 + MARGIN)
        new = np.minimum(new, result)
        if np.array_equal(new, result):
            break
        result = new
    return result


def start_error(initial: FloatArray, errors: FloatArray) -> float:
    """sum_C b0(C) e(C), rounded up."""
    return float(initial @ errors) * (1 + 1e-9)
