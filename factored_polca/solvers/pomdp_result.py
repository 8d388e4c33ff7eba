"""What a POMDP solver is asked for, and what it returns.

Letters: b0 the initial belief, V* the optimal value, pi the returned policy, V_pi its value.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

from factored_polca.drawn import Drawn, Framed
from factored_polca.explicit.alpha_vectors import AlphaVectors, StagedVectors
from factored_polca.explicit.arrays import FloatArray
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.solvers.evaluation import TimeIsUp
from factored_polca.solvers.interrupts import raise_held_interrupt
from factored_polca.solvers.result import Guarantee, Status

Policy: TypeAlias = AlphaVectors | StagedVectors | PolicyGraph | EntropyPolicy


@dataclass(frozen=True)
class Demand:
    """When to stop: upper - lower <= `gap` at every root, or one of the limits.

    `deadline` is a reading of `time.monotonic()`; `iterations` counts what the method's docstring
    says; `progress(lower, upper)` is called now and then with the bounds at b0, and may raise
    KeyboardInterrupt.  Equal demands give equal results, but for `deadline`.
    """

    gap: float = 1e-6
    deadline: float | None = None
    iterations: int | None = None
    seed: int = 0
    progress: Callable[[float, float], None] | None = field(default=None, compare=False)

    def poll(self) -> None:
        """Raises `TimeIsUp` once the deadline has passed, KeyboardInterrupt where Ctrl-C waits."""
        raise_held_interrupt()
        if self.deadline is not None and time.monotonic() >= self.deadline:
            raise TimeIsUp

    @property
    def seconds_left(self) -> float:
        """Seconds until the deadline; infinite without one."""
        return float("inf") if self.deadline is None else max(0.0, self.deadline - time.monotonic())


@dataclass(frozen=True)
class Bounds:
    """The bounds at b0 after some seconds of a run."""

    seconds: float
    lower: float
    upper: float


@dataclass(frozen=True)
class POMDPSolution(Drawn, Framed):
    """Bounds on V*(b0), and a policy.

    `lower <= V*(b0) <= upper`, whatever the `status`, rounding included.  `lower` is also at most what
    the policy earns: lower <= V_pi(b0).  `value` is the method's estimate of V_pi(b0), between lower and
    upper.  `root_lower`, `root_upper` [r] are the bounds at each root of the problem that was solved
    (`factored_polca.solvers.pomdp_problem.Root`), the parts of b0 first.
    """

    lower: float
    upper: float
    value: float
    policy: Policy
    root_lower: FloatArray  # [root]
    root_upper: FloatArray  # [root]
    status: Status
    guarantee: Guarantee
    method: str
    vectors: int  # alpha-vectors, or nodes, of the policy
    iterations: int
    seconds: float  # wall clock
    history: tuple[Bounds, ...] = ()  # lower rises, upper falls
    note: str = ""  # what was done and why, for people

    @property
    def gap(self) -> float:
        """upper - lower at b0."""
        return self.upper - self.lower

    @property
    def converged(self) -> bool:
        """Whether the gap that was asked for was reached.

        Of QMDP, FIB, AMDP and blind policies, which close no gap: whether they came to their end.
        """
        return self.status == "converged"
