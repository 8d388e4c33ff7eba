"""A partially observable Markov decision process as arrays: what the POMDP solvers take.

Axes are written a (action), s (state), o (observation), t (next state).  The model of the
observations is the *joint kernel*

    K_a(s; t, o) = P(s' = t, o' = o | s, a),

which need not factor into T and O (in a quotient it does not).  A terminal state has no successor,
the reward 0 and the value 0; its rows are empty.  Everywhere else an action is applicable and
sum over o, t of K_a(s; t, o) = 1.

Mixed observability: `observed[s]` numbers the part of a state that is seen at every step, at the
start included, and beside the observation (Ong, Png, Hsu & Lee 2010).  Equal everywhere means that
nothing but the observations is seen.  That the process has ended is seen too, though no solver needs
it: the value of a belief does not depend on its terminal states, whose value is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import ArrayMDP, BoolArray, FloatArray, IntArray, SparseMatrix
from factored_polca.models.errors import ModelError

ROW_TOLERANCE = 1e-9
"""How far a row of a float kernel may be from the sum 1."""


@dataclass(frozen=True)
class ArrayPOMDP:
    """A POMDP over S numbered states; see the module's docstring."""

    actions: tuple[str, ...]
    observations: tuple[tuple[str, ...], ...]  # [a][o], each action's own list
    kernel: tuple[tuple[SparseMatrix, ...], ...]  # [a][o] CSR [s, t], K_a(s; t, o)
    rewards: FloatArray  # [a, s], 0 at terminal states
    terminal: BoolArray  # [s]
    observed: IntArray  # [s], from 0: the number of what is seen of the state
    initial: FloatArray  # [s], b0
    discount: float

    @property
    def states(self) -> int:
        """S, the number of states."""
        return len(self.terminal)

    def to_mdp(self) -> ArrayMDP:
        """The same process with its state seen: its optimal value bounds the POMDP's from above."""
        live = ~self.terminal
        transitions = tuple(_sum(matrices, self.states) for matrices in self.kernel)
        applicable = np.tile(live, (len(self.actions), 1))
        return ArrayMDP(self.actions, transitions, self.rewards, applicable, self.terminal, self.discount)


def _sum(matrices: Sequence[SparseMatrix], states: int) -> SparseMatrix:
    total = csr_array((states, states))
    for matrix in matrices:
        total = total + matrix
    return csr_array(total)


def array_pomdp(
    kernel: Sequence[Sequence[SparseMatrix | FloatArray]],
    rewards: FloatArray,
    initial: FloatArray,
    discount: float,
    *,
    actions: Sequence[str] | None = None,
    observations: Sequence[Sequence[str]] | None = None,
    terminal: BoolArray | None = None,
    observed: IntArray | None = None,
) -> ArrayPOMDP:
    """A checked `ArrayPOMDP`; names default to a0, a1, ... and o0, o1, ...

    Raises:
        ModelError: wrong shapes, entries that are negative or not finite, rows that do not sum to 1
            within `ROW_TOLERANCE`, or a discount outside [0, 1]; all faults at once.
    """
    matrices = tuple(tuple(csr_array(m, dtype=np.float64) for m in row) for row in kernel)
    rewards = np.asarray(rewards, dtype=np.float64)
    initial = np.asarray(initial, dtype=np.float64)
    states = len(initial)
    if actions is None:
        actions = [f"a{number}" for number in range(len(matrices))]
    if observations is None:
        observations = [[f"o{number}" for number in range(len(row))] for row in matrices]
    if terminal is None:
        terminal = np.zeros(states, dtype=np.bool_)
    if observed is None:
        observed = np.zeros(states, dtype=np.int64)
    result = ArrayPOMDP(
        tuple(actions),
        tuple(tuple(names) for names in observations),
        matrices,
        rewards,
        np.asarray(terminal, dtype=np.bool_),
        np.asarray(observed, dtype=np.int64),
        initial,
        float(discount),
    )
    check_pomdp(result)
    return result


def check_pomdp(pomdp: ArrayPOMDP) -> None:
    """Refuse arrays that are no POMDP.

    Raises:
        ModelError: see `array_pomdp`.
    """
    faults = [*_wrong_shapes(pomdp)] or [*_wrong_numbers(pomdp)]
    if faults:
        raise ModelError("; ".join(faults))


def _wrong_shapes(pomdp: ArrayPOMDP) -> list[str]:
    count, states = len(pomdp.actions), pomdp.states
    faults = []
    if count == 0 or states == 0:
        faults.append("a POMDP needs at least one action and one state")
    if pomdp.rewards.shape != (count, states):
        faults.append(f"rewards have the shape {pomdp.rewards.shape}, not {(count, states)} [a, s]")
    for name, array in (("initial", pomdp.initial), ("observed", pomdp.observed)):
        if array.shape != (states,):
            faults.append(f"{name} has the shape {array.shape}, not {(states,)} [s]")
    if len(pomdp.kernel) != count or len(pomdp.observations) != count:
        faults.append(f"the kernel or the observations are not given for {count} actions")
    for name, row, names in zip(pomdp.actions, pomdp.kernel, pomdp.observations, strict=False):
        if len(row) != len(names) or not row:
            faults.append(f"action {name!r} has {len(row)} matrices for {len(names)} observations")
        if any(matrix.shape != (states, states) for matrix in row):
            faults.append(f"a matrix of action {name!r} is not {states} x {states} [s, t]")
    return faults


def _wrong_numbers(pomdp: ArrayPOMDP) -> list[str]:
    faults = []
    if not 0 <= pomdp.discount <= 1:
        faults.append(f"the discount is {pomdp.discount}, not between 0 and 1")
    if not np.all(np.isfinite(pomdp.rewards)):
        faults.append("a reward is not finite")
    if np.any(pomdp.rewards[:, pomdp.terminal] != 0):
        faults.append("a terminal state has a reward")
    if not (np.all(pomdp.initial >= 0) and abs(pomdp.initial.sum() - 1) <= ROW_TOLERANCE):
        faults.append("the initial belief is no distribution")
    if np.any(pomdp.observed < 0):
        faults.append("observed has a negative number")
    wanted = np.where(pomdp.terminal, 0.0, 1.0)
    for name, row in zip(pomdp.actions, pomdp.kernel, strict=True):
        if not all(np.all(np.isfinite(m.data)) and np.all(m.data >= 0) for m in row):
            faults.append(f"action {name!r} has a probability that is negative or not finite")
            continue
        off = np.abs(np.asarray(_sum(row, pomdp.states).sum(axis=1)) - wanted)
        if off.max() > ROW_TOLERANCE:
            state = int(off.argmax())
            faults.append(
                f"the probabilities of action {name!r} in state {state} miss the sum "
                f"{wanted[state]:g} by {off[state]:.3g}"
            )
    return faults
