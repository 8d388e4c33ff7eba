"""From a bare policy to a whole solution: for solvers that are not ours.

Alpha-vectors and policy graphs are taken as policies: what they earn is proved (`certified`), and an upper
bound is the fast informed one (Hauskrecht 2000).  A table of actions for an MDP is evaluated as the MDP in
which nothing else is applicable, and with V_pi its value and d the most that one better action gains

    V* <= V_pi + d / (1 - gamma),    d = max over s, a of R(a, s) + gamma sum_t P_a(s, t) V_pi(t) - V_pi(s)

(Puterman 1994, Proposition 6.3.1).
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array, diags_array

from factored_polca.explicit.alpha_vectors import AlphaSet, AlphaVectors
from factored_polca.explicit.arrays import ArrayMDP, FloatArray, IntArray
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.policy_graph import evaluate as graph_values
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.models.errors import ModelError
from factored_polca.solvers.certified import certified, upper_by_backup
from factored_polca.solvers.choose import solve_mdp
from factored_polca.solvers.fast_informed import solve_fib
from factored_polca.solvers.pomdp_problem import prepare
from factored_polca.solvers.pomdp_result import Bounds, Demand, POMDPSolution
from factored_polca.solvers.preparation import prepare as prepare_mdp
from factored_polca.solvers.result import Guarantee, MDPSolution, Status
from factored_polca.solvers.tree_search import nothing_to_gain
from factored_polca.solvers.verify import policy_faults

UNIT = 2.0**-52


def alpha_vectors(pomdp: ArrayPOMDP, vectors: FloatArray, actions: IntArray) -> AlphaVectors:
    """Vectors [n, s] over all states with their actions [n], as a policy: one set for each `observed`.

    What they are worth is not claimed (`meaning` "heuristic").

    Raises:
        ModelError: wrong shapes, numbers or actions.
    """
    table = np.atleast_2d(np.asarray(vectors, dtype=np.float64))
    numbers = np.asarray(actions, dtype=np.int64)
    if table.ndim != 2 or table.shape[1] != pomdp.states:
        raise ModelError(f"the vectors have the shape {table.shape}, not (n, {pomdp.states}) [n, s]")
    live = ~pomdp.terminal
    sets = []
    for seen in np.unique(pomdp.observed[live]):
        mine = np.flatnonzero(live & (pomdp.observed == seen))
        sets.append(AlphaSet(mine, np.ascontiguousarray(table[:, mine]), numbers))
    policy = AlphaVectors(pomdp.states, tuple(sets), "heuristic")
    faults = policy_faults(policy, pomdp)
    if faults:
        raise ModelError("; ".join(faults))
    return policy


def solution_of_policy(
    pomdp: ArrayPOMDP,
    policy: AlphaVectors | PolicyGraph,
    *,
    method: str,
    demand: Demand | None = None,
    roots: FloatArray | None = None,
    status: Status = "iteration limit",
    iterations: int = 0,
    seconds: float = 0.0,
    note: str = "",
) -> POMDPSolution:
    """The solution whose policy is `policy`, made no worse: its lower bound proved, an upper one added.

    `status` is what counts where the two bounds are further apart than the demand's gap; `seconds` are
    those spent so far.

    Raises:
        ModelError: a policy that does not fit, or no discount below 1.
    """
    began = time.perf_counter()
    demand = Demand() if demand is None else demand
    if not pomdp.discount < 1:
        raise ModelError("the value of a policy is bounded for a discount below 1 only")
    faults = policy_faults(policy, pomdp)
    if faults:
        raise ModelError("; ".join(faults))
    plain = prepare(pomdp, roots, merge=False)
    if plain.classes == 0:
        return nothing_to_gain(plain, method)
    if isinstance(policy, PolicyGraph):
        policy = alpha_vectors(pomdp, graph_values(policy, pomdp), policy.actions)
    proved, root_lower = certified(plain, policy, demand)
    above = solve_fib(prepare(pomdp, roots), replace(demand, progress=None, iterations=None))
    by_backup = upper_by_backup(plain, policy, demand)
    root_upper, source = above.root_upper, "fast informed"
    if by_backup is not None and plain.combine(by_backup) < above.upper:
        root_upper, source = np.minimum(root_upper, by_backup), "an exact backup of the vectors"
    root_upper = np.maximum(root_upper, root_lower)
    lower, upper = plain.combine(root_lower), plain.combine(root_upper)
    total = seconds + time.perf_counter() - began
    reached = bool(np.all(root_upper - root_lower <= demand.gap))
    return POMDPSolution(
        lower=lower,
        upper=upper,
        value=lower,
        policy=proved,
        root_lower=root_lower,
        root_upper=root_upper,
        status="converged" if reached else status,
        guarantee=Guarantee("bounds", f"the optimum lies in bounds {upper - lower:.3g} wide"),
        method=method,
        vectors=proved.count,
        iterations=iterations,
        seconds=total,
        history=(Bounds(total, lower, upper),),
        note="; ".join(filter(None, (note, f"the policy was evaluated here; upper bound: {source}"))),
    )


def solution_of_actions(
    mdp: ArrayMDP,
    policy: IntArray,
    *,
    method: str,
    demand: Demand | None = None,
    status: Status = "iteration limit",
    iterations: int = 0,
) -> MDPSolution:
    """The solution whose policy is `policy` [s], -1 where there is nothing to do.

    At discount 1 the upper bound is infinite unless no action improves on the policy.

    Raises:
        ModelError: an action that is not applicable, or none in a state that has some.
    """
    began = time.perf_counter()
    demand = Demand() if demand is None else demand
    taken = np.asarray(policy, dtype=np.int64)
    if taken.shape != (mdp.states,):
        raise ModelError(f"the policy has the shape {taken.shape}, not {(mdp.states,)} [s]")
    only = np.arange(len(mdp.actions))[:, None] == taken[None, :]
    missing = mdp.applicable.any(axis=0) & ~(only & mdp.applicable).any(axis=0) & ~mdp.terminal
    if missing.any():
        state = int(missing.argmax())
        raise ModelError(f"in state {state} the policy takes {int(taken[state])}, which is not applicable")
    rows = tuple(
        csr_array(diags_array((only & mdp.applicable)[a].astype(np.float64)) @ matrix)
        for a, matrix in enumerate(mdp.transitions)
    )
    rewards = np.where(only, mdp.rewards, 0.0)
    chain = ArrayMDP(mdp.actions, rows, rewards, only & mdp.applicable, mdp.terminal, mdp.discount)
    earned = solve_mdp(chain, epsilon=min(1e-9, demand.gap), deadline=demand.deadline)
    dead = prepare_mdp(mdp).dead_ends
    q = _one_step(mdp, earned.values)
    gain = _improvement(q, earned, dead)
    if mdp.discount < 1:
        upper = earned.upper + gain / (1 - mdp.discount)
    else:
        upper = earned.upper + (gain if gain <= 1e-9 else np.inf)
    upper = np.where(np.isneginf(earned.upper), np.inf, upper)
    upper = np.where(dead, -np.inf, upper)
    upper[mdp.terminal] = 0.0
    live = ~dead & np.isfinite(earned.lower)
    largest = max(1.0, float(np.abs(earned.values[live]).max(initial=0.0)))
    gap = float((upper - earned.lower)[live].max(initial=0.0)) if live.any() else 0.0
    return MDPSolution(
        values=earned.lower,
        lower=earned.lower,
        upper=upper,
        q_values=q,
        policy=np.where(dead, -1, earned.policy),
        ties=0,
        dead_ends=dead,
        gap=gap,
        residual=gain,
        policy_loss_bound=gap,
        iterations=iterations,
        seconds=time.perf_counter() - began,
        status="converged" if gap <= demand.gap * largest else status,
        guarantee=Guarantee("bounds" if mdp.discount < 1 else "heuristic", f"bounds {gap:.3g} wide"),
        method=method,
    )


def _one_step(mdp: ArrayMDP, values: FloatArray) -> FloatArray:
    """Q [a, s] one step ahead of `values` [s]; minus infinity where not applicable."""
    known = np.where(np.isfinite(values), values, 0.0)
    lost = np.isneginf(values).astype(np.float64)
    rows = []
    for number, matrix in enumerate(mdp.transitions):
        q = mdp.rewards[number] + mdp.discount * (matrix @ known)
        rows.append(np.where(mdp.applicable[number] & ~(matrix @ lost > 0), q, -np.inf))
    return np.array(rows)


def _improvement(q: FloatArray, earned: MDPSolution, dead: np.typing.NDArray[np.bool_]) -> float:
    """The most that one better action gains, in states that are no dead ends and have not ended."""
    best = q.max(axis=0)
    here = np.isfinite(best) & ~dead
    if np.isneginf(earned.values[here]).any():
        return float("inf")
    slack = 16 * UNIT * max(1.0, float(np.abs(earned.values[here]).max(initial=0.0)))
    return max(0.0, float((best - earned.values)[here].max(initial=0.0))) + slack + earned.gap
