"""What a policy over beliefs on the blocks of a partition earns in the model itself, by following beliefs.

The partition must be stable for all actions of the model, its rewards included, and tell apart what the
policy does.  Then its quotient is the model, as far as the policy's value is concerned.
"""

from __future__ import annotations

from factored_polca.minimisation import DecisionProcess, Partition, make_pomdp_quotient
from factored_polca.solvers.policy_bounds import BELIEFS, Choose, PolicyBounds, bound_policy

__all__ = ["BELIEFS", "Choose", "PolicyBounds", "bound_on_blocks"]


def bound_on_blocks(
    process: DecisionProcess,
    partition: Partition,
    choose: Choose,
    *,
    beliefs: int = BELIEFS,
    deadline: float | None = None,
    seed: int = 0,
) -> PolicyBounds:
    """Bounds on what a policy earns that chooses among the process's actions at beliefs [n, block].

    Raises:
        LimitReached: too many observations or entries.
        ModelError: discount 1, or the policy has no action at a belief that it meets.
    """
    quotient = make_pomdp_quotient(process, partition, seed=seed)
    return bound_policy(quotient.pomdp, choose, beliefs=beliefs, deadline=deadline)
