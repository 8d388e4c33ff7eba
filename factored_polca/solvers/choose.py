"""`solve_mdp`: one entry to all algorithms for fully observed problems.

"auto" takes policy iteration up to `FACTORISATION_LIMIT` nodes (a handful of sparse factorisations,
whatever the discount), beyond it modified policy iteration: where errors die out slowly (grids with
separate regions, discounts near 1) it needs a fifth of value iteration's time or less.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np

from factored_polca.explicit.arrays import ArrayMDP
from factored_polca.models.errors import ModelError
from factored_polca.solvers.evaluation import FACTORISATION_LIMIT, StopRule
from factored_polca.solvers.greedy import greedy_policy, policy_loss_bound, q_table
from factored_polca.solvers.pairs import Pairs
from factored_polca.solvers.policy_iteration import policy_iteration
from factored_polca.solvers.preparation import Prepared, prepare
from factored_polca.solvers.result import Guarantee, MDPSolution
from factored_polca.solvers.value_iteration import Iterate, modified_policy_iteration, value_iteration

METHODS: Mapping[str, Callable[[Pairs, StopRule], Iterate]] = {
    "value iteration": value_iteration,
    "modified policy iteration": modified_policy_iteration,
    "policy iteration": policy_iteration,
}


def solve_mdp(
    mdp: ArrayMDP,
    method: str = "auto",
    epsilon: float = 1e-9,
    *,
    deadline: float | None = None,
    iterations: int | None = None,
    progress: Callable[[int, float], None] | None = None,
    describe: Callable[[int], str] | None = None,
) -> MDPSolution:
    """Bounds on the optimal values of `mdp`, and a policy.

    Stops when upper - lower <= `epsilon * max(1, max |value|)` in every state, at `deadline` (a reading
    of `time.monotonic()`), after `iterations`, or on Ctrl-C; the bounds hold in each case.
    `progress(iterations, gap)` is called between passes.  `describe(s)` names a state in errors.

    Raises:
        ModelError: unknown method, epsilon not positive, faulty arrays, or at discount 1 an end
            component whose value is infinite or undefined.
    """
    began = time.perf_counter()
    if method != "auto" and method not in METHODS:
        raise ModelError(f"no method {method!r} for MDPs; there are auto, {', '.join(METHODS)}")
    if not epsilon > 0:
        raise ModelError(f"epsilon is {epsilon}: it must be positive; 1e-9 is the default")
    prepared = prepare(mdp, describe)
    name = _automatic(prepared.pairs) if method == "auto" else method
    stop = StopRule(epsilon, deadline, iterations, progress)
    return _solution(prepared, METHODS[name](prepared.pairs, stop), stop, name, began)


def _automatic(pairs: Pairs) -> str:
    if len(pairs.free) <= FACTORISATION_LIMIT:
        return "policy iteration"
    return "modified policy iteration"


def _solution(prepared: Prepared, found: Iterate, stop: StopRule, method: str, began: float) -> MDPSolution:
    interval = found.interval
    values = found.middle
    gap = interval.gap
    q_values, q = q_table(prepared, values)
    greedy = greedy_policy(prepared, values, q, gap if found.status == "converged" else 0.0)
    loss = policy_loss_bound(prepared, values, interval.upper, greedy, stop)
    return MDPSolution(
        values=prepared.on_states(values),
        lower=prepared.on_states(interval.lower),
        upper=prepared.on_states(interval.upper),
        q_values=q_values,
        policy=greedy.policy,
        ties=greedy.ties,
        dead_ends=prepared.dead_ends,
        gap=gap,
        residual=greedy.residual,
        policy_loss_bound=loss,
        iterations=found.iterations,
        seconds=time.perf_counter() - began,
        status=found.status,
        guarantee=_guarantee(gap, found),
        method=method,
    )


def _guarantee(gap: float, found: Iterate) -> Guarantee:
    if np.isfinite(gap):
        where = "the optimal value of every state lies in [lower, upper]"
        return Guarantee("bounds", f"{where}, at most {gap:.3g} wide, rounding included")
    sides = [
        side
        for side, ends in (("lower", found.interval.lower), ("upper", found.interval.upper))
        if np.all(np.isfinite(ends))
    ]
    known = f"only the {sides[0]} bound is known" if sides else "no bound is known yet"
    return Guarantee("heuristic", f"stopped early ({found.status}): {known}")
