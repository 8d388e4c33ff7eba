"""The kinds of policies there are, for what stores or runs any of them."""

from __future__ import annotations

from typing import TypeAlias

from factored_polca.explicit.alpha_vectors import AlphaVectors, StagedVectors
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.state_policy import StatePolicy

AnyPolicy: TypeAlias = AlphaVectors | StagedVectors | PolicyGraph | EntropyPolicy | StatePolicy


def horizon_of(policy: AnyPolicy) -> int | None:
    """The number of steps that a policy is for; None: without end."""
    return policy.horizon if isinstance(policy, (StagedVectors, StatePolicy)) else None
