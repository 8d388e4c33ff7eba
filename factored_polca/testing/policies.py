"""`check_policy`: whether a policy fits its problem, and earns what is said of it."""

from __future__ import annotations

from factored_polca.explicit.policies import AnyPolicy
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.explicit.state_policy import StatePolicy
from factored_polca.simulation.pomdp import simulate_policy
from factored_polca.solvers.verify import policy_faults

ERRORS = 5.0
"""Standard errors that a mean may be off: with fixed seeds a matter of luck once, not each time."""


def check_policy(
    pomdp: ArrayPOMDP,
    policy: AnyPolicy,
    *,
    lower: float | None = None,
    upper: float | None = None,
    episodes: int = 400,
    seed: int = 0,
    name: str = "the policy",
) -> float:
    """What a policy earns from the initial belief, by simulation.

    `lower`, `upper`: bounds that its value is said to keep; the mean may be `ERRORS` standard errors off.

    Raises:
        AssertionError: a policy of no known kind, one that does not fit, or one that earns less than
            `lower` or more than `upper`.
    """
    if not isinstance(policy, StatePolicy):
        faults = policy_faults(policy, pomdp)
        assert not faults, f"{name}: {'; '.join(faults)}"
    elif policy.states != pomdp.states:
        raise AssertionError(f"{name} is for {policy.states} states, not for {pomdp.states}")
    found = simulate_policy(pomdp, policy, episodes=episodes, seed=seed)
    slack = ERRORS * found.standard_error + found.truncation + 1e-9 * max(1.0, abs(found.mean))
    said = f"{name} earns {found.mean:.6g} ± {found.standard_error:.2g} ({episodes} episodes)"
    assert lower is None or found.mean + slack >= lower, f"{said}, less than its lower bound {lower:.6g}"
    assert upper is None or found.mean - slack <= upper, f"{said}, more than the upper bound {upper:.6g}"
    return found.mean
