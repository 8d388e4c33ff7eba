"""Value functions that are maxima of linear functions of the belief, and the policies they carry.

    V(b) = sum over y of max over alpha in Gamma_y of sum over s in y of alpha(s) b(s)

where y runs over what is seen of the state (`ArrayPOMDP.observed`; one y where nothing is), each
alpha has an action, and the policy takes the action of the maximum (Smallwood & Sondik 1973; kept
apart by y: Ong, Png, Hsu & Lee 2010).  States in no set have the value 0.

Ties: of the vectors within `TIE` * max(1, |V|) of the best, which is rounding, the lowest action number
is taken; over all steps that may cost TIE * max(1, |V|) / (1 - gamma).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray

TIE: Final = 1e-13

Meaning = Literal["exact", "lower", "heuristic"]
"""What the maximum is: the value itself, what the policy earns at least, or only a preference."""


@dataclass(frozen=True)
class AlphaSet:
    """The vectors for one y."""

    states: IntArray  # [i] the states with this y, ascending
    vectors: FloatArray  # [n, i]
    actions: IntArray  # [n]

    @cached_property
    def by_action(self) -> tuple[FloatArray, IntArray, IntArray]:
        """The vectors [i, n] in the order of their actions, the actions [k], each one's first vector."""
        order = np.argsort(self.actions, kind="stable")
        actions, first = np.unique(self.actions[order], return_index=True)
        return np.ascontiguousarray(self.vectors[order].T), actions, first.astype(np.int64)

    def choose(self, beliefs: FloatArray) -> IntArray:
        """The lowest action [n] among those with a vector as good as the best, at beliefs [n, i]."""
        vectors, actions, first = self.by_action
        worth = np.maximum.reduceat(beliefs @ vectors, first, axis=1)  # [n, k]
        best = worth.max(axis=1, keepdims=True)
        close = worth >= best - TIE * np.maximum(1.0, np.abs(best))
        chosen: IntArray = actions[close.argmax(axis=1)]
        return chosen


@dataclass(frozen=True)
class AlphaVectors:
    """A value function over beliefs and its policy; `sets` is by y."""

    states: int
    sets: tuple[AlphaSet, ...]
    meaning: Meaning = "lower"

    @property
    def count(self) -> int:
        """The number of vectors."""
        return sum(len(part.vectors) for part in self.sets)

    def values(self, beliefs: FloatArray) -> FloatArray:
        """V [n] at beliefs [n, s]; a belief over several y is worth the sum over its parts."""
        total = np.zeros(len(beliefs))
        for part in self.sets:
            total += (beliefs[:, part.states] @ part.vectors.T).max(axis=1)
        return total

    def value(self, belief: FloatArray) -> float:
        """V at one belief [s]."""
        return float(self.values(belief[None, :])[0])

    def choose(self, beliefs: FloatArray, step: int = 0) -> IntArray:
        """The action [n] at beliefs [n, s], each over states of one y (of several, the likeliest counts).

        A belief all over states without a set (they have ended) gets action 0.
        """
        del step  # the policy does not depend on the time
        actions = np.zeros(len(beliefs), dtype=np.int64)
        best = np.zeros(len(beliefs))
        for part in self.sets:
            here = beliefs if len(part.states) == self.states else beliefs[:, part.states]
            mass = here.sum(axis=1)
            mine = np.flatnonzero(mass > best)
            best[mine] = mass[mine]
            if len(mine):
                actions[mine] = part.choose(here if len(mine) == len(here) else here[mine])
        return actions

    def action(self, belief: FloatArray) -> int:
        """The action at one belief [s]."""
        return int(self.choose(belief[None, :])[0])


@dataclass(frozen=True)
class StagedVectors:
    """A policy for a finite horizon: `stages[h]` holds the value function with h + 1 steps to go."""

    stages: tuple[AlphaVectors, ...]

    @property
    def horizon(self) -> int:
        """The number of steps."""
        return len(self.stages)

    @property
    def count(self) -> int:
        """The number of vectors with all steps to go."""
        return self.stages[-1].count

    def value(self, belief: FloatArray) -> float:
        """The expected return of all steps from a belief [s]."""
        return self.stages[-1].value(belief)

    def choose(self, beliefs: FloatArray, step: int = 0) -> IntArray:
        """The action [n] at beliefs [n, s] after `step` steps.

        Raises:
            ValueError: no step is left.
        """
        if not 0 <= step < self.horizon:
            raise ValueError(f"step {step} of a policy for {self.horizon} steps")
        return self.stages[self.horizon - 1 - step].choose(beliefs)
