"""Policy iteration (Howard 1960) with sparse factorisations.

    v = (I - discount * P_pi)^-1 R_pi;   pi'(i) = argmax_p Q(p), pi(i) itself unless beaten.

At discount 1 the first policy is proper (it makes for the nearest target) and an action is changed
only for a strictly better one; then all policies met are proper (Bertsekas & Tsitsiklis 1991,
proposition 3).  The bounds come from the Bellman residual of the last v, as in value iteration,
which also does the last few backups where rounding left something to gain.
"""

from __future__ import annotations

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.bounds import prior_interval
from factored_polca.solvers.evaluation import (
    StopRule,
    TimeIsUp,
    evaluate_by_factorisation,
    first_policy,
    greedy_choice,
)
from factored_polca.solvers.pairs import Pairs
from factored_polca.solvers.result import Status
from factored_polca.solvers.value_iteration import Iterate, value_iteration

SWITCH_MARGIN = 1e-12


def policy_iteration(pairs: Pairs, stop: StopRule, start: IntArray | None = None) -> Iterate:
    """Policy iteration until no action is beaten, then bounds.

    `start` [node] gives the pairs to begin with, such as those of a similar problem; at discount 1 they
    must make a proper policy.

    Never raises for a limit: `status` tells which stopped it, the bounds hold all the same.
    """
    values = np.zeros(pairs.nodes)
    policy = first_policy(pairs) if start is None else start.copy()
    steps = 0
    status: Status | None = None
    try:
        while True:
            if stop.progress is not None:
                stop.progress(steps, np.inf)
            stop.poll()
            if stop.iterations is not None and steps >= stop.iterations:
                status = "iteration limit"
                break
            found = evaluate_by_factorisation(pairs, policy, pairs.reward)
            if found is None:  # rounding made it singular: value iteration goes on from the last one
                break
            margin = SWITCH_MARGIN * max(1.0, float(np.abs(found).max(initial=0.0)))
            stalled = steps > 0 and float(np.max(found - values, initial=0.0)) <= margin
            values, steps = found, steps + 1
            if stalled:  # only rounding still tells the policies apart
                break
            new = greedy_choice(pairs, pairs.q_values(values), policy, margin)
            if np.array_equal(new, policy):
                break
            policy = new
    except TimeIsUp:
        status = "time limit"
    except KeyboardInterrupt:
        status = "interrupted"
    return _with_bounds(pairs, values, policy, steps, stop, status)


def _with_bounds(
    pairs: Pairs, values: FloatArray, policy: IntArray, steps: int, stop: StopRule, status: Status | None
) -> Iterate:
    if status is None:
        finish = stop
    elif pairs.discount < 1:  # one backup gives bounds; it is worth it even when time is up
        finish = StopRule(stop.epsilon, iterations=1)
    else:
        return Iterate(values, prior_interval(pairs), policy, steps, status)
    last = value_iteration(pairs, finish, values)
    if status is not None and last.status != "converged":
        return Iterate(last.values, last.interval, last.choice, steps + last.iterations, status)
    return Iterate(last.values, last.interval, last.choice, steps + last.iterations, last.status)
