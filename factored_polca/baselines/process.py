"""A model's MDP as arrays that steps are sampled from.

Axes are written a (primitive action), s (state), k (outcome).  The outcomes of a pair are listed with
their cumulative probabilities, so that one uniform number u in [0, 1) draws a step: the first outcome k
whose cumulative probability is above u.  Rewards are the expected ones R(s, a): a learner's mean is
the same, and a reward that hangs on the outcome is no noise of the comparison.

It is made from the model by enumeration (`factored_polca.explicit`), and so for small models.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from factored_polca.explicit.arrays import ArrayMDP, BoolArray, FloatArray, IntArray
from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.explicit.exact_mdp import ExactMDP
from factored_polca.models import Model, ModelError
from factored_polca.solvers.compiled import kernel

IndexArray = npt.NDArray[np.int32]

MAXIMUM_STATES: Final = 50_000
"""States up to which learners' tables are made."""


class ProcessArrays(NamedTuple):
    """What the kernels read of a process."""

    successors: IndexArray  # [a, s, k]
    cumulative: FloatArray  # [a, s, k], 1 at the last outcome of an applicable pair
    rewards: FloatArray  # [a, s]
    terminal: BoolArray  # [s]
    starts: IntArray  # [n], the states where an episode may begin
    start_cumulative: FloatArray  # [n], 1 at the last


@dataclass(frozen=True, eq=False)
class SampledProcess:
    """An MDP whose steps can be sampled."""

    exact: ExactMDP
    mdp: ArrayMDP
    applicable: BoolArray  # [a, s]
    arrays: ProcessArrays

    @property
    def actions(self) -> tuple[str, ...]:
        """The primitive actions, by number."""
        return self.exact.actions

    @property
    def states(self) -> int:
        """All states, terminal ones included."""
        return self.exact.states

    @property
    def live(self) -> BoolArray:
        """[s], the states that are not terminal."""
        found: BoolArray = ~self.arrays.terminal
        return found

    @property
    def initial(self) -> FloatArray:
        """[s], the probability that an episode begins in a state."""
        return np.array([float(chance) for chance in self.exact.initial])


def sampled_process(model: Model, *, maximum_states: int = MAXIMUM_STATES) -> SampledProcess:
    """The process of `model`, by listing its states.

    Raises:
        ModelError: faults of the model, or one whose state is not seen.
        LimitReached: more than `maximum_states` states.
    """
    if model.observability != "full":
        raise ModelError(f"{model.name}: learners see the state, and this model is partially observed")
    return process_of(enumerate_model(model, maximum_states=maximum_states))


def process_of(exact: ExactMDP) -> SampledProcess:
    """The process of an MDP in rationals."""
    actions, states = len(exact.actions), exact.states
    width = max((len(row) for rows in exact.rows for row in rows), default=1) or 1
    successors = np.zeros((actions, states, width), dtype=np.int32)
    cumulative = np.zeros((actions, states, width))
    for a, rows in enumerate(exact.rows):
        for s, row in enumerate(rows):
            for k, (t, chance) in enumerate(sorted(row.items())):
                successors[a, s, k:] = t
                cumulative[a, s, k] = float(chance)
            cumulative[a, s] = np.cumsum(cumulative[a, s])
            cumulative[a, s, max(len(row) - 1, 0) :] = 1.0  # where rounding left less
    mdp = exact.to_arrays()
    starts = [s for s, chance in enumerate(exact.initial) if chance and not exact.terminal[s]]
    shares = np.cumsum([float(exact.initial[s]) for s in starts])
    if not starts:
        raise ModelError("every start is terminal: there is nothing to learn")
    arrays = ProcessArrays(
        successors, cumulative, mdp.rewards, mdp.terminal, np.array(starts), shares / shares[-1]
    )
    return SampledProcess(exact, mdp, mdp.applicable, arrays)


@kernel
def draw_start(process: ProcessArrays, rng: Any) -> int:
    """A state where an episode begins."""
    place = np.searchsorted(process.start_cumulative, rng.random(), side="right")
    return process.starts[min(place, len(process.starts) - 1)]  # type: ignore[no-any-return]


@kernel
def draw_step(process: ProcessArrays, action: int, state: int, rng: Any) -> int:
    """The state after one step; a certain step takes no random number."""
    k = 0
    if process.cumulative[action, state, 0] < 1.0:
        u = rng.random()
        while process.cumulative[action, state, k] <= u:
            k += 1
    return process.successors[action, state, k]  # type: ignore[no-any-return]
