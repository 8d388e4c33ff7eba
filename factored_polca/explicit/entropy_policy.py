"""Policies over (most likely state, how uncertain): what an augmented MDP yields.

    s*(b) = argmax over s of b(s), the first of equals,
    h(b)  = - sum over s of b(s) log b(s) / log S, in [0, 1], cut into bins of equal width

(Roy & Thrun, "Coastal navigation with mobile robots", NIPS 1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray


def entropy_bins(beliefs: FloatArray, bins: int) -> IntArray:
    """The bin [n], from 0 to bins - 1, of the normalised entropy of beliefs [n, s]."""
    states = beliefs.shape[1]
    if states < 2:
        return np.zeros(len(beliefs), dtype=np.int64)
    logs = np.log(beliefs, out=np.zeros_like(beliefs), where=beliefs > 0)
    entropy = -(beliefs * logs).sum(axis=1) / np.log(states)
    numbers: IntArray = np.clip((entropy * bins).astype(np.int64), 0, bins - 1)
    return numbers


@dataclass(frozen=True)
class EntropyPolicy:
    """An action for each most likely state and entropy bin."""

    actions: IntArray  # [s, bin]

    @property
    def bins(self) -> int:
        """The number of entropy bins."""
        return int(self.actions.shape[1])

    @property
    def count(self) -> int:
        """The number of augmented states."""
        return int(self.actions.size)

    def choose(self, beliefs: FloatArray, step: int = 0) -> IntArray:
        """The action [n] at beliefs [n, s]."""
        del step  # the policy does not depend on the time
        chosen: IntArray = self.actions[beliefs.argmax(axis=1), entropy_bins(beliefs, self.bins)]
        return chosen

    def action(self, belief: FloatArray) -> int:
        """The action at one belief [s]."""
        return int(self.choose(belief[None, :])[0])
