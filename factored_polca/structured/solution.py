"""What structured value iteration returns: values and a policy as diagrams, with bounds that hold."""

from __future__ import annotations

from dataclasses import dataclass

from factored_polca.diagrams import Diagram
from factored_polca.minimisation.criterion import DecisionProcess
from factored_polca.solvers.result import Guarantee, Status


@dataclass(frozen=True)
class StructuredSolution:
    """Bounds on the optimal value of every state of a process, and a policy.

    Where a state has a choice, `values - radius <= V* <= values + radius`, and the policy earns at least
    `values - radius - policy_loss`, rounding included, whatever the `status`.  `values` is 0 where the
    process has ended and outside a restriction, minus infinity at dead ends.

    `choices` maps states to the number of the choice taken, `policy` to that of the model's action; where
    there is none the leaf is the number of choices, or of actions.  `lower`, `value` and `upper` are at the
    initial belief, `policy_lower` what the policy earns there at least.
    """

    process: DecisionProcess
    values: Diagram
    radius: float
    policy_loss: float
    choices: Diagram
    policy: Diagram
    lost: Diagram
    lower: float
    value: float
    upper: float
    policy_lower: float
    largest: float  # the largest finite |value|
    leaves: int  # of `values`
    nodes: int
    merged: float  # the width within which leaves were merged at last
    iterations: int
    seconds: float
    status: Status
    guarantee: Guarantee
    method: str
    note: str

    @property
    def gap(self) -> float:
        """upper - lower at every state with a choice."""
        return 2 * self.radius

    @property
    def converged(self) -> bool:
        """Whether the gap that was asked for was reached."""
        return self.status == "converged"

    @property
    def defined(self) -> Diagram:
        """The condition that the policy takes a choice."""
        return ~self.choices.equals(self.choices.manager.constant(len(self.process.choices)))
