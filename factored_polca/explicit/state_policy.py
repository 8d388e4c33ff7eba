"""Policies of processes whose state is seen: an action for each state, and perhaps for each step.

`actions[h, s]` is taken in state s with h + 1 steps to go; a policy without a horizon has one row.
-1 stands where there is nothing to do: the process has ended, or is in a dead end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factored_polca.explicit.arrays import IntArray


@dataclass(frozen=True)
class StatePolicy:
    """An action number for each state; `staged` says that the rows are stages of a finite horizon."""

    actions: IntArray  # [h, s], or [1, s]
    staged: bool = False

    @property
    def states(self) -> int:
        """The number of states."""
        return int(self.actions.shape[1])

    @property
    def horizon(self) -> int | None:
        """The number of steps; None: without end."""
        return len(self.actions) if self.staged else None

    def choose(self, states: IntArray, step: int = 0) -> IntArray:
        """The action [n], or -1, in states [n] after `step` steps.

        Raises:
            ValueError: no step is left.
        """
        row = 0
        if self.staged:
            if not 0 <= step < len(self.actions):
                raise ValueError(f"step {step} of a policy for {len(self.actions)} steps")
            row = len(self.actions) - 1 - step
        chosen: IntArray = self.actions[row, states].astype(np.int64)
        return chosen
