"""A fully observed problem over a finite number of steps, by backward induction (Bellman 1957).

    V_0 = 0,    V_h(s) = max over applicable a of R_a(s) + gamma * sum over t of P_a(s; t) V_{h-1}(t)

A state that is neither terminal nor has an applicable action has the value minus infinity while steps
are left, and so has an action that may lead there in time.  The discount may be 1.

Rounding: a backup of rows of n entries errs by at most (n + 3) u max |V|, u = 2^-53; what H of them add up
to is `error`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from factored_polca.explicit.arrays import ArrayMDP, FloatArray
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.models.errors import LimitReached, ModelError

MAXIMUM_CHOICES: Final = 200_000_000
"""Horizon times states; a choice takes two bytes for up to 32,767 actions."""


@dataclass(frozen=True)
class StagedValues:
    """V_H and the policy that earns it."""

    values: FloatArray  # [s], with all steps to go
    policy: StatePolicy
    error: float  # the values are off by at most this
    seconds: float  # wall clock


def backward_induction(
    mdp: ArrayMDP,
    horizon: int,
    *,
    deadline: float | None = None,
    progress: Callable[[int], None] | None = None,
) -> StagedValues:
    """The optimal values over `horizon` steps; the first of equally good actions is taken.

    `deadline` is a reading of `time.monotonic()`; `progress(stages done)` is called after each stage.

    Raises:
        ModelError: a horizon below 1.
        LimitReached: too many choices to keep, or the deadline has passed.
    """
    if horizon < 1:
        raise ModelError(f"the horizon is {horizon}: it must be at least 1 step")
    if horizon * mdp.states > MAXIMUM_CHOICES:
        raise LimitReached(
            f"{horizon} steps times {mdp.states} states are more than the {MAXIMUM_CHOICES} choices that "
            "are kept; take a shorter horizon"
        )
    began = time.perf_counter()
    kind = np.int16 if len(mdp.actions) < 2**15 else np.int64
    choices = np.empty((horizon, mdp.states), dtype=kind)
    values = np.zeros(mdp.states)
    entries = max((int(np.diff(matrix.indptr).max(initial=0)) for matrix in mdp.transitions), default=0)
    error, none = 0.0, ~mdp.applicable.any(axis=0)
    for stage in range(horizon):
        if deadline is not None and time.monotonic() >= deadline:
            raise LimitReached(f"time limit: {stage} of {horizon} steps of backward induction are done")
        q = _action_values(mdp, values)
        choices[stage] = np.where(none | (q.max(axis=0) == -np.inf), -1, q.argmax(axis=0))
        values = np.where(mdp.terminal, 0.0, q.max(axis=0))
        largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
        largest = max(largest, float(np.abs(mdp.rewards).max(initial=0.0)))
        error = mdp.discount * error + (entries + 3) * 2.0**-53 * largest * (1 + mdp.discount)
        if progress is not None:
            progress(stage + 1)
    policy = StatePolicy(choices, staged=True)
    return StagedValues(values, policy, error, time.perf_counter() - began)


def _action_values(mdp: ArrayMDP, values: FloatArray) -> FloatArray:
    """Q [a, s] one step ahead of `values`, minus infinity where not applicable or what may hit it."""
    lost = values == -np.inf
    safe = np.where(lost, 0.0, values)
    q = np.empty(mdp.rewards.shape)
    for action, matrix in enumerate(mdp.transitions):
        q[action] = mdp.rewards[action] + mdp.discount * (matrix @ safe)
        if lost.any():
            q[action, (matrix @ lost.astype(np.float64)) > 0] = -np.inf
    q[~mdp.applicable] = -np.inf
    return q
