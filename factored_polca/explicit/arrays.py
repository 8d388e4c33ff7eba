"""A Markov decision process as arrays: what the solvers take, whatever it was made from.

Axes are written a (action), s (state), t (next state).  A terminal state has no applicable action
and the value 0.  A state that is neither terminal nor has an applicable action is a dead end, with
the value minus infinity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

FloatArray: TypeAlias = npt.NDArray[np.float64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
IntArray: TypeAlias = npt.NDArray[np.int64]
SparseMatrix: TypeAlias = Any
"""A `scipy.sparse.csr_array` of float64."""


@dataclass(frozen=True)
class ArrayMDP:
    """An MDP over S numbered states.

    `transitions[a]` is a CSR array [s, t]: the row of an applicable pair sums to 1 within rounding,
    the row of an inapplicable one is empty.
    """

    actions: tuple[str, ...]
    transitions: tuple[SparseMatrix, ...]
    rewards: FloatArray  # [a, s], 0 where not applicable
    applicable: BoolArray  # [a, s], False everywhere at terminal states
    terminal: BoolArray  # [s]
    discount: float

    @property
    def states(self) -> int:
        """S, the number of states."""
        return len(self.terminal)
