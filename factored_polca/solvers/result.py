"""What a solver of fully observed problems returns.

Letters: s a state, a an action, V* the optimal value, pi the returned policy, V_pi its value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from factored_polca.drawn import Drawn, Framed
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray

GuaranteeKind = Literal["exact", "bounds", "heuristic", "statistical"]
Status = Literal[
    "converged", "rounding limit", "time limit", "iteration limit", "memory limit", "interrupted"
]


@dataclass(frozen=True)
class Guarantee:
    """How far a number may be trusted, and in words why."""

    kind: GuaranteeKind
    text: str


@dataclass(frozen=True)
class MDPSolution(Drawn, Framed):
    """Bounds on the optimal value of every state, and a policy.

    `lower <= V* <= upper` holds in every state whatever the `status`, rounding included (see
    `factored_polca.solvers.bounds`).  Dead ends have minus infinity in `values`, `lower` and `upper`.

    `status` says why the solver stopped: "converged" (the gap is at most what was asked for),
    "rounding limit" (float64 cannot tighten the bounds further), "time limit", "iteration limit" or
    "interrupted" (Ctrl-C); in the last four the bounds are those reached so far.
    """

    values: FloatArray  # [s], between lower and upper (their middle, where both are finite)
    lower: FloatArray  # [s]
    upper: FloatArray  # [s]
    q_values: FloatArray  # [a, s] one step ahead of `values`; -inf: not applicable or hits a dead end
    policy: IntArray  # [s], -1 at terminal states and dead ends
    ties: int  # states in which more than one action was as good as the best, within the tolerance
    dead_ends: BoolArray  # [s], value minus infinity
    gap: float  # max over the other states of upper - lower
    residual: float  # max over the same states of |max_a Q(a, s) - values(s)|
    policy_loss_bound: float  # V* - V_pi is at most this in every state that is no dead end
    iterations: int  # backups of all states over all actions, and policy evaluations
    seconds: float  # wall clock, compiling included
    status: Status
    guarantee: Guarantee
    method: str

    @property
    def converged(self) -> bool:
        """Whether the gap that was asked for was reached."""
        return self.status == "converged"
