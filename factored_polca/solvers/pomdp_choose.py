"""`solve_pomdp`: one entry to all algorithms for partially observed problems.

"auto" tries what is cheap and exact first and says what it did:

1. where everything is seen, the MDP's solver;
2. unfolding the beliefs that b0 can reach, up to `FEW_BELIEFS`: where they close, the belief MDP is an
   ordinary one (not where roots are given: the policy is wanted on the whole simplex then);
3. with more than `FEW_STATES` states, trials of SARSOP and HSVI2 in turns: each alone stalls somewhere;
4. else SARSOP; where `STALLED` trials were not enough, policy iteration on policy graphs for some exact
   backups, then SARSOP again.  Bounds are joined, and the policy with the better lower bound is returned.

"exact" does the same, but goes on to policy iteration after a fifth of those trials.  (Policy iteration
first would be quicker on some problems of two states; on one of three its exact backups took minutes where
SARSOP took 0.04 s.)

With a horizon both are value iteration over vectors with incremental pruning; "witness" is that with
the witness algorithm.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from factored_polca.explicit.arrays import FloatArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.models.errors import ModelError
from factored_polca.solvers.augmented_mdp import solve_amdp
from factored_polca.solvers.blind import solve_blind
from factored_polca.solvers.choose import solve_mdp
from factored_polca.solvers.fast_informed import solve_fib
from factored_polca.solvers.finite_horizon import Method, solve_finite_horizon
from factored_polca.solvers.graph_iteration import solve_by_graph_iteration
from factored_polca.solvers.hsvi import solve_hsvi
from factored_polca.solvers.interrupts import held_interrupt, interrupts_at_polls
from factored_polca.solvers.pbvi import solve_pbvi
from factored_polca.solvers.perseus import solve_perseus
from factored_polca.solvers.pomdp_problem import Problem, prepare
from factored_polca.solvers.pomdp_result import Bounds, Demand, POMDPSolution
from factored_polca.solvers.qmdp import solve_qmdp
from factored_polca.solvers.result import Guarantee
from factored_polca.solvers.sarsop import STYLE, solve_sarsop
from factored_polca.solvers.tree_search import MEMORY_LIMIT, begun, nothing_to_gain
from factored_polca.solvers.unfolding import solve_by_unfolding

TURNS: Final = replace(STYLE, name="SARSOP and HSVI2 in turns", turns=True)
FEW_BELIEFS: Final = 400
STALLED: Final = 1000
FEW_STATES: Final = 12
FEW_BACKUPS: Final = 30

_SINGLE: Final[Mapping[str, Callable[[Problem, Demand], POMDPSolution]]] = {
    "pbvi": solve_pbvi,
    "perseus": solve_perseus,
    "hsvi": solve_hsvi,
    "sarsop": solve_sarsop,
    "qmdp": solve_qmdp,
    "fib": solve_fib,
    "blind": solve_blind,
    "amdp": solve_amdp,
}

POMDP_METHODS: Final = ("auto", "exact", "witness", *_SINGLE)

WITH_HORIZON: Final = ("auto", "exact", "witness")


def solve_pomdp(
    pomdp: ArrayPOMDP,
    method: str = "auto",
    *,
    demand: Demand | None = None,
    horizon: int | None = None,
    roots: FloatArray | None = None,
) -> POMDPSolution:
    """Bounds on the optimal value at b0, and a policy.

    `roots` [r, s] are further beliefs at which the policy is wanted good, such as corners; the gap is
    asked for at each.  With a `horizon` the process ends after that many steps.

    Raises:
        ModelError: an unknown method, discount 1 without a horizon, a horizon for a method that has
            none, or faulty roots.
    """
    demand = Demand() if demand is None else demand
    _check(pomdp, method, horizon, demand)
    began = time.perf_counter()
    with interrupts_at_polls():
        problem = prepare(pomdp, roots)
        if horizon is not None:
            algorithm: Method = "witness" if method == "witness" else "incremental pruning"
            found = solve_finite_horizon(problem, horizon, demand, method=algorithm)
        elif method in _SINGLE:
            found = _SINGLE[method](problem, demand)
        else:
            found = _automatic(problem, demand, method == "exact", roots is not None)
        if held_interrupt() and not found.converged:
            found = replace(found, status="interrupted")
    return replace(found, seconds=time.perf_counter() - began)


def _check(pomdp: ArrayPOMDP, method: str, horizon: int | None, demand: Demand) -> None:
    if method not in POMDP_METHODS:
        raise ModelError(f"no method {method!r} for POMDPs; there are {', '.join(POMDP_METHODS)}")
    if not demand.gap > 0:
        raise ModelError(f"the gap is {demand.gap}: it must be positive; 1e-3 is a common choice")
    if horizon is not None and method not in WITH_HORIZON:
        raise ModelError(
            f"{method} solves for an infinite horizon only; for {horizon} steps use "
            f"{', '.join(WITH_HORIZON)}, or leave the horizon out (--horizon infinite)"
        )
    if horizon is None and method == "witness":
        raise ModelError("witness needs a horizon (--horizon H); for an infinite one use exact")
    if horizon is None and not pomdp.discount < 1:
        raise ModelError(
            "at discount 1 an infinite horizon has no defined value for a POMDP: give a horizon "
            "(--horizon H) or a discount below 1 (--discount D)"
        )


def _automatic(problem: Problem, demand: Demand, exact: bool, everywhere: bool) -> POMDPSolution:
    """See the module's docstring."""
    if problem.classes == 0:
        return nothing_to_gain(problem, "exact" if exact else "auto")
    if int(np.diff(problem.arrays.offset).max()) == 1:
        return _all_seen(problem, demand)
    notes: list[str] = []
    if not everywhere:
        found = solve_by_unfolding(problem, replace(demand, progress=None), beliefs=FEW_BELIEFS)
        if found.converged or found.status in ("interrupted", "rounding limit"):
            return replace(found, note=_joined(["few beliefs can be reached", found.note]))
        notes.append(f"more than {FEW_BELIEFS} beliefs can be reached, so unfolding was left")
    small = len(problem.states) <= FEW_STATES
    return _search(problem, demand, notes, STALLED // 5 if exact else STALLED, try_graph=small)


def _search(
    problem: Problem, demand: Demand, notes: list[str], stalled: int, *, try_graph: bool
) -> POMDPSolution:
    """Trials; where policy iteration is tried, in between after `stalled` of them."""
    style = STYLE if len(problem.states) <= FEW_STATES else TURNS
    run, other = begun(problem, demand, style, MEMORY_LIMIT), None
    status = run.run(stalled if try_graph and demand.iterations is None else None)
    if try_graph and status == "iteration limit" and demand.iterations is None:
        notes.append(f"SARSOP: gap {run.widest_gap:.3g} after {stalled} trials")
        other = solve_by_graph_iteration(problem, _limited(demand, FEW_BACKUPS), everywhere=False)
        notes.append(f"policy iteration: {other.iterations} exact backups, gap {other.gap:.3g}")
        if other.status in ("interrupted", "time limit"):
            status = other.status
        elif not other.converged:
            status = run.run()
    found = run.solution(status)
    return replace(_better(found, other, demand), note=_joined([*notes, found.note]))


def _limited(demand: Demand, iterations: int) -> Demand:
    limit = iterations if demand.iterations is None else min(iterations, demand.iterations)
    return replace(demand, iterations=limit, progress=None)


def _better(one: POMDPSolution, other: POMDPSolution | None, demand: Demand) -> POMDPSolution:
    """The policy with the higher lower bound, with the tighter bounds of both."""
    if other is None:
        return one
    best = one if one.lower >= other.lower else other
    upper = min(one.upper, other.upper)
    root_upper = np.minimum(one.root_upper, other.root_upper)
    reached = bool(np.all(root_upper - best.root_lower <= demand.gap))
    return replace(
        best,
        upper=upper,
        root_upper=root_upper,
        status="converged" if reached else one.status,
        method=best.method if best.upper == upper else f"{best.method}, upper bound by another",
        history=(*best.history, Bounds(max(one.seconds, other.seconds), best.lower, upper)),
    )


def _joined(parts: list[str]) -> str:
    return "; ".join(part for part in parts if part)


def _all_seen(problem: Problem, demand: Demand) -> POMDPSolution:
    """Every state is seen: an MDP."""
    began = time.perf_counter()
    original = problem.original
    limits = {"deadline": demand.deadline, "iterations": demand.iterations}
    scale = max(1.0, problem.value_span)
    found = solve_mdp(original.to_mdp(), epsilon=demand.gap / (4 * scale), **limits)  # type: ignore[arg-type]
    values, states = found.lower - found.policy_loss_bound, problem.states
    vectors = [values[states[y]].reshape(1, 1) for y in range(problem.classes)]
    actions = [found.policy[states[y]].reshape(1) for y in range(problem.classes)]
    lower = np.array([values[states[root.y]] for root in problem.roots])
    upper = np.array([found.upper[states[root.y]] for root in problem.roots])
    below, above = problem.combine(lower), problem.combine(upper)
    return POMDPSolution(
        lower=below,
        upper=above,
        value=below,
        policy=problem.policy(vectors, actions, "lower"),
        root_lower=lower,
        root_upper=upper,
        status="converged" if bool(np.all(upper - lower <= demand.gap)) else found.status,
        guarantee=Guarantee("bounds", f"the optimum lies in bounds {above - below:.3g} wide"),
        method=f"{found.method} (every state is seen)",
        vectors=problem.classes,
        iterations=found.iterations,
        seconds=time.perf_counter() - began,
        history=(Bounds(time.perf_counter() - began, below, above),),
        note="every state is seen: an MDP",
    )
