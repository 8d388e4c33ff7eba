"""What the value function of a policy over beliefs promises too much in another process.

Let V(b) = max of alpha . b over vectors with actions, the policy taking the action of the best, and let the
process have the joint kernel K and rewards R.  For each alpha with action a, and for each o (and each thing
seen of the state), choose any mixture g_o of vectors.  With

    D_alpha(s) = alpha(s) - R(s, a) - gamma * sum over o, s' of K_a(s; s', o) g_o(s'),                  (1)

V(b) <= R(b, a) + gamma * sum_o V(b K_a^o) + b . D_alpha  at every belief b where alpha is the best, since a
maximum is no less than a mixture.  So the policy earns at least V(b) - b . e, for any e with

    e(s) >= max over alpha of  D_alpha(s) + gamma * sum_s' K_a(s, s') e(s'),                            (2)

which is approached from above: e = max D / (1 - gamma) holds, and a step of (2) keeps what holds.  Unlike
the simulation lemma (`lemma`) this takes the differences of the two processes as they are.

*The choice of g.*  For weights w(s) the best g_o maximises sum_s w(s) sum_s' K_a(s; s', o) g_o(s').  A game
between these and w, which grows where D is large (multiplicative weights; Freund & Schapire 1999), brings
the mixture of all g so far near the one with the least max D.  The first round, whose weights are uniform,
gives an e of its own, as the sums of (2) may prefer it.

*Rounding* adds (n + 64) 2^-53 (max |R| + gamma max |V|), rows of n entries, and what rows miss 1 by (Higham
2002, section 3.1); ties of the policy add what `AlphaVectors` lets pass as equal.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from factored_polca.explicit.alpha_vectors import TIE, AlphaVectors
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.solvers.bounds import UNIT

ROUNDS: Final = 20
"""Rounds of the game."""

RATE: Final = 2.0
"""How fast weights grow, for values of the range 1."""

STEPS: Final = 500
"""Steps of (2)."""

LARGEST: Final = 1 << 24
"""Entries of all vectors beyond which nothing is computed."""


def overestimate(
    pomdp: ArrayPOMDP, policy: AlphaVectors, block: IntArray, pause: Callable[[], None]
) -> FloatArray | None:
    """Some e [k, s] of (2) for a policy over blocks that is followed in `pomdp`; None: it takes too much.

    `block` [s] is the policy's block of each state; `pause` is called now and then and may raise.
    """
    live = ~pomdp.terminal & reached(pomdp)
    if not live.any():
        return np.zeros((1, pomdp.states))
    vectors, actions, members = spread(pomdp, policy, block, live)
    if vectors.size > LARGEST:
        return None
    size = max(float(np.abs(vectors).max(initial=0.0)), float(np.abs(pomdp.rewards).max(initial=0.0)))
    slack = rounding(pomdp, size) + TIE * max(1.0, size)
    worst = np.full((2, len(pomdp.actions), pomdp.states), -np.inf)
    for action in np.unique(actions).tolist():
        mine = np.flatnonzero(actions == action)
        for start in range(0, len(mine), 256):
            part = mine[start : start + 256]
            defects = least_defects(pomdp, vectors, members, part, action, pause)
            defects = np.where(members[part], defects + slack, -np.inf)
            worst[:, action] = np.maximum(worst[:, action], defects.max(axis=1))
    return np.stack([accumulated(pomdp, one, live, slack) for one in worst])


def spread(
    pomdp: ArrayPOMDP, policy: AlphaVectors, block: IntArray, live: BoolArray
) -> tuple[FloatArray, IntArray, BoolArray]:
    """The vectors over states [n, s], 0 where they don't count, their actions [n], and where they count.

    States that a solver has left out, as it could not reach them, are worth 0 to each vector over what
    looks like them; a belief over nothing else gets action 0.
    """
    vectors, actions, members = [], [], []
    left_out = live.copy()
    for part in policy.sets:
        place = np.full(policy.states, -1, dtype=np.int64)
        place[part.states] = np.arange(len(part.states))
        inside = (place[block] >= 0) & live
        left_out &= ~inside
        if not inside.any():
            continue
        alike = np.isin(pomdp.observed, pomdp.observed[inside]) & live
        vectors.append(np.where(inside, part.vectors[:, place[block]], 0.0))
        actions.append(part.actions)
        members.append(np.broadcast_to(alike, vectors[-1].shape))
    for seen in np.unique(pomdp.observed[left_out]).tolist():
        vectors.append(np.zeros((1, pomdp.states)))
        actions.append(np.zeros(1, dtype=np.int64))
        members.append((left_out & (pomdp.observed == seen))[None, :])
    return np.concatenate(vectors), np.concatenate(actions), np.concatenate(members)


def reached(pomdp: ArrayPOMDP) -> BoolArray:
    """The states [s] that b0 may lead to, whatever is done."""
    rows = sum(matrix for row in pomdp.kernel for matrix in row)
    known: BoolArray = pomdp.initial > 0
    while True:
        grown = known | ((known.astype(np.float64) @ rows) > 0)
        if np.array_equal(grown, known):
            return known
        known = grown


def least_defects(
    pomdp: ArrayPOMDP,
    vectors: FloatArray,
    members: BoolArray,
    mine: IntArray,
    action: int,
    pause: Callable[[], None],
) -> FloatArray:
    """D [2, n, s] of (1) for the vectors numbered `mine`, of one action: at first, and after the game."""
    own, inside = vectors[mine], members[mine]
    sets = [np.flatnonzero(where.all(axis=1)) for where in _classes(members)]
    columns = [np.flatnonzero(members[numbers[0]]) for numbers in sets]
    growth = np.where(inside, 0.0, -np.inf)
    total, first = np.zeros_like(own), own
    best = np.full(own.shape, np.inf)
    scale = max(float(np.ptp(vectors)), 1e-300)
    for number in range(ROUNDS):
        pause()
        weights = np.exp(growth - growth.max(axis=1, keepdims=True))
        weights /= weights.sum(axis=1, keepdims=True)
        ahead = np.zeros_like(own)
        for matrix in pomdp.kernel[action]:
            reached = weights @ matrix
            chosen = np.zeros_like(own)
            for numbers, places in zip(sets, columns, strict=True):
                part = vectors[np.ix_(numbers, places)]
                picked = (reached[:, places] @ part.T).argmax(axis=1)
                chosen[:, places] = part[picked]
            ahead += (matrix @ chosen.T).T
        defects = own - pomdp.rewards[action] - pomdp.discount * ahead
        first = first if number else defects
        total += defects
        mean = total / (number + 1)
        for candidate in (defects, mean):
            high = np.where(inside, candidate, -np.inf).max(axis=1)
            better = high < np.where(inside, best, -np.inf).max(axis=1)
            best[better] = candidate[better]
        growth = np.where(inside, growth + RATE * defects / scale * np.sqrt(ROUNDS), -np.inf)
    return np.stack([first, best])


def _classes(members: BoolArray) -> list[BoolArray]:
    """For each distinct set of states, which vectors are over it [n, 1]."""
    _, place = np.unique(members, axis=0, return_inverse=True)
    place = place.reshape(-1)
    return [(place == k)[:, None] for k in range(int(place.max()) + 1)]


def accumulated(pomdp: ArrayPOMDP, worst: FloatArray, live: BoolArray, slack: float) -> FloatArray:
    """e [s] of (2), D_alpha being at most `worst` [a, s], -inf where no vector has the action."""
    highest = float(worst[:, live].max(initial=0.0))
    result = np.where(live, max(highest, 0.0) / (1 - pomdp.discount), 0.0)
    rows = [sum(row) for row in pomdp.kernel]
    for _ in range(STEPS):
        ahead = np.stack([matrix @ result for matrix in rows])
        new = np.where(live, (worst + pomdp.discount * ahead).max(axis=0) + slack, 0.0)
        new = np.minimum(np.where(np.isneginf(new), 0.0, new), result)
        if np.abs(new - result).max(initial=0.0) <= 1e-12 * max(1.0, highest):
            return new
        result = new
    return result


def rounding(pomdp: ArrayPOMDP, size: float) -> float:
    """The error of a backup of values up to `size`."""
    live = ~pomdp.terminal
    longest = max(sum(int(np.diff(m.indptr).max(initial=0)) for m in row) for row in pomdp.kernel)
    sums = [np.asarray(sum(m.sum(axis=1) for m in row))[live] for row in pomdp.kernel]
    miss = max(float(np.abs(part - 1).max(initial=0.0)) for part in sums)
    return (longest + ROUNDS + 128) * UNIT * 1.01 * 2 * size + miss * size
