"""The best and the worst that a process on blocks with classes can do, as sound bounds.

An adversary picks the class k in each block C, the planner a choice c among those allowed:

    (B V)(C) = ext over k in C of  max over c of  R_c(k) + gamma sum_C' T_c(k; C') V(C'),  ext = max or min.

B is monotone and a contraction by gamma (Givan, Leach & Dean 2000 for intervals; here with the rows that
occur).  With one choice allowed, the policy's, ext = min gives a lower bound on its value at every state
of a block and ext = max an upper one; with all choices ext = max bounds the optimum from above: the true
value at a state of class k satisfies its own equation, and B V is at least (most) its right-hand side.

The fixed point is approached by modified policy iteration, whatever it is: any V will do, since

    B V <= V + d   implies   V + d / (1 - gamma) >= the fixed point      (and likewise from below).

Rounding: a backup over a row of n entries, each a product and sum of rounded probabilities, is off by at
most  e = (n + 4 F + 64) 2^-53 (max |R| + gamma max |V|) + (largest miss of a row's sum) max |V|  with F
features (Higham 2002, section 3.1), which is added to d.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from scipy import sparse

from factored_polca.approximation.classes import Classes
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray

UNIT: Final = 2.0**-53
SWEEPS: Final = 40
"""Sweeps with classes and choices held between two choices of them."""
DENSE: Final = 300
"""Blocks up to which a linear system takes the place of these sweeps."""
SOLVED: Final = 30
"""Rounds in which it does: where choices and classes change in turn, they may go round in a circle."""
MAXIMUM_ROUNDS: Final = 10_000
CLOSE: Final = 1e-10
"""Relative change at which iteration ends; what is missing is added to the bound."""


@dataclass(frozen=True)
class Game:
    """Rows of all (choice, class) pairs one below the other, for bounds over blocks."""

    rows: Any  # CSR [choice * class, block]
    starts: IntArray  # [block] first class
    block: IntArray  # [class]
    terminal: BoolArray  # [block]
    discount: float
    features: int
    pause: Callable[[], None]

    @property
    def longest(self) -> int:
        """Entries of the longest row."""
        return int(np.diff(self.rows.indptr).max(initial=0))

    def miss(self) -> float:
        """What the sum of a row that is there misses 1 by, at most."""
        sums = np.asarray(self.rows.sum(axis=1)).reshape(-1)
        return float(np.abs(sums[sums > 0] - 1).max(initial=0.0))

    def rounding(self, rewards: FloatArray, values: FloatArray) -> float:
        """e of the module's docstring."""
        size = float(np.abs(values).max(initial=0.0))
        largest = float(np.abs(rewards).max(initial=0.0))
        entries = self.longest + 4 * self.features + 64
        return entries * UNIT * 1.001 * (largest + self.discount * size) + self.miss() * size


def game_of(classes: Classes) -> Game:
    """The game of some classes."""
    symbolic = classes.process.symbolic
    return Game(
        sparse.vstack(classes.transitions, format="csr"), classes.starts, classes.block, classes.terminal,
        float(symbolic.model.discount), len(symbolic.model.features), symbolic.manager.pause,
    )  # fmt: skip


def backups(game: Game, rewards: FloatArray, allowed: BoolArray, values: FloatArray) -> FloatArray:
    """[choice, class]: what each choice earns for the continuation `values`; -inf where not allowed, or
    where it may lead to a value of -inf."""
    lost = np.isneginf(values)
    backed = (game.rows @ np.where(lost, 0.0, values)).reshape(rewards.shape)
    q = np.where(allowed, rewards + game.discount * backed, -np.inf)
    if lost.any():
        q[(game.rows @ lost.astype(np.float64)).reshape(rewards.shape) > 0] = -np.inf
    return q


def extreme_values(
    game: Game,
    rewards: FloatArray,
    allowed: BoolArray,
    side: Literal["upper", "lower"],
    start: FloatArray | None = None,
) -> FloatArray:
    """A bound [block] on the fixed point of B with ext = max ("upper") or min ("lower"), from that side.

    Args:
        rewards, allowed: [choice, class].
        start: values [block] to begin with.

    Returns:
        -inf in blocks where (all, or some, classes) can't avoid a dead end; 0 in terminal ones.
    """
    blocks = len(game.starts)
    outer = np.maximum if side == "upper" else np.minimum
    live = ~game.terminal
    lost = _lost(game, allowed, side)
    values = np.zeros(blocks) if start is None else np.where(np.isfinite(start), start, 0.0)
    values[game.terminal] = 0.0
    values[lost] = -np.inf

    def backed(values: FloatArray) -> tuple[FloatArray, FloatArray]:
        q = backups(game, rewards, allowed, values)
        best = q.max(axis=0)
        return np.where(live, outer.reduceat(best, game.starts), 0.0), q

    kept = live & ~lost
    for number in range(MAXIMUM_ROUNDS):
        game.pause()
        new, q = backed(values)
        change = float(np.abs(new[kept] - values[kept]).max(initial=0.0))
        values = new
        if change <= CLOSE * max(1.0, float(np.abs(values[kept]).max(initial=0.0))):
            break
        values = _swept(game, rewards, q, values, kept, solve=number < SOLVED)
    new, _ = backed(values)
    error = game.rounding(np.where(allowed, rewards, 0.0), np.where(kept, values, 0.0))
    wrong = new[kept] - values[kept] if side == "upper" else values[kept] - new[kept]
    shift = (max(float(wrong.max(initial=0.0)), 0.0) + error) / (1 - game.discount)
    shift += 2 * UNIT * float(np.abs(values[kept]).max(initial=0.0))
    result: FloatArray = np.where(kept, values + (shift if side == "upper" else -shift), values)
    return result


def _swept(
    game: Game, rewards: FloatArray, q: FloatArray, values: FloatArray, kept: BoolArray, *, solve: bool
) -> FloatArray:
    """Sweeps over the class and choice that attain the extreme in each block, or what they lead to."""
    best, choice = q.max(axis=0), q.argmax(axis=0)
    attained = np.flatnonzero(best == values[game.block])
    chosen = np.full(len(values), -1, dtype=np.int64)
    chosen[game.block[attained[::-1]]] = attained[::-1]
    here = np.flatnonzero(kept & (chosen >= 0))
    picked = choice[chosen[here]] * q.shape[1] + chosen[here]
    rows, gains = game.rows[picked], rewards.reshape(-1)[picked]
    values = np.where(np.isneginf(values), 0.0, values)
    lost = ~kept & ~game.terminal
    if solve and 0 < len(here) <= DENSE and game.discount < 1:
        values[here] = 0.0
        system = np.eye(len(here)) - game.discount * rows[:, here].toarray()
        values[here] = np.linalg.solve(system, gains + game.discount * (rows @ values))
    else:
        for _ in range(SWEEPS):
            values[here] = gains + game.discount * (rows @ values)
    values[lost] = -np.inf
    return values


def _lost(game: Game, allowed: BoolArray, side: Literal["upper", "lower"]) -> BoolArray:
    """The blocks where all (upper), or some (lower), states can't avoid a dead end."""
    outer = np.logical_and if side == "upper" else np.logical_or
    lost: BoolArray = np.zeros(len(game.starts), dtype=np.bool_)
    while True:
        into = (game.rows @ lost.astype(np.float64)).reshape(allowed.shape) > 0
        stuck = ~(allowed & ~into).any(axis=0)
        grown: BoolArray = outer.reduceat(stuck, game.starts) & ~game.terminal
        if np.array_equal(grown, lost):
            return lost
        lost = grown
