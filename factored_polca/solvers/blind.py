"""Blind policies: one action for ever, whatever is observed (Hauskrecht 1997; Smith & Simmons 2005).

A policy that looks only at the class y (which is seen) takes one option c(y) in each.  Its value is
linear in the belief; by state it solves

    v(i) = r_c(i) + gamma * sum over branches k of c, i' of M_k(i, i') v(i')        (T v = v)

and v . b <= V*(b).  Blind policies are those with one action throughout; where an action has been
merged into another option of a class, that option is taken.  *Class-wise* policies go beyond: from the
best blind action of each class, policy iteration in which a class stands for its uniform belief; each
policy met on the way is kept, as each has a value that can be earned.

*Certificate.*  Let v be any approximation, T v computed with an error of at most e, and
c = (max(0, max(v - T v)) + e) / (1 - gamma rho), rho the largest sum of a row.  Then
T(v - c) >= T v - gamma rho c >= v - c, so v - c is at most the policy's value.

Letters as in `pomdp_problem`.
"""

from __future__ import annotations

import time
from typing import Final

import numpy as np
from scipy.sparse import csc_array, eye_array
from scipy.sparse.linalg import splu

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.solvers.evaluation import FACTORISATION_LIMIT, TimeIsUp
from factored_polca.solvers.fast_informed import fast_informed
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Bounds, Demand, POMDPSolution
from factored_polca.solvers.qmdp import UNIT, ObservedProcess, margin, observed_process, root_upper
from factored_polca.solvers.result import Guarantee, Status

SWEEPS: Final = 20_000
CLASS_POLICIES: Final = 5
"""Class-wise policies that are tried beyond the blind ones."""


def blind_vectors(
    problem: Problem, demand: Demand | None = None
) -> tuple[list[FloatArray], list[IntArray]]:
    """Vectors [n, n_y] of policies by class, with the option j [n] that each takes there; n >= 1.

    Vector m of all classes together is the value of policy m, from below.  Past the deadline values
    are only as good as by then; one policy at least is evaluated.

    Raises:
        ModelError: no discount below 1.
        KeyboardInterrupt: Ctrl-C.
    """
    process = observed_process(problem)
    if problem.classes == 0:
        return [], []
    demand = Demand() if demand is None else demand
    choices = _blind_choices(problem)
    values: list[FloatArray] = []
    known = {choice.tobytes() for choice in choices}
    try:
        for choice in choices:
            values.append(policy_value(problem, process, choice, demand))
            demand.poll()
        for _ in range(CLASS_POLICIES if problem.classes > 1 else 0):
            better = _improved(problem, process, np.array(values))
            if better.tobytes() in known:
                break
            known.add(better.tobytes())
            choices.append(better)
            values.append(policy_value(problem, process, better, demand))
            demand.poll()
    except TimeIsUp:
        choices = choices[: len(values)]
    table, taken = np.array(values), np.array(choices)
    offset = problem.arrays.offset
    parts = [np.ascontiguousarray(table[:, offset[y] : offset[y + 1]]) for y in range(problem.classes)]
    return parts, [np.ascontiguousarray(taken[:, y]) for y in range(problem.classes)]


def policy_value(
    problem: Problem, process: ObservedProcess, choice: IntArray, demand: Demand
) -> FloatArray:
    """[i] the value, from below, of the policy that takes option `choice[y]` in each class y."""
    a = problem.arrays
    sizes = np.diff(a.offset)
    pairs = np.repeat(a.reward_start[choice] - a.offset[:-1], sizes) + np.arange(len(problem.states))
    rows, rewards = process.rows[pairs], process.rewards[pairs]
    value = _start(process, rewards)
    if process.states <= FACTORISATION_LIMIT:
        system = csc_array(eye_array(process.states) - process.discount * rows)
        value = splu(system).solve(rewards)
    goal = 1e-11 * max(1.0, float(np.abs(value).max())) * process.rest
    for sweep in range(SWEEPS):
        backed_up = rewards + process.discount * (rows @ value)
        fall = float(np.max(value - backed_up))
        if float(np.max(backed_up - value)) + max(fall, 0.0) <= max(goal, 2 * process.error(value)):
            break
        if sweep % 64 == 63 and demand.seconds_left <= 0:
            break
        value = backed_up
    backed_up = rewards + process.discount * (rows @ value)
    fall = max(0.0, float(np.max(value - backed_up)))
    shift = (fall + process.error(value)) / process.rest
    lowered: FloatArray = value - shift * (1 + 8 * UNIT) - 4 * UNIT * np.abs(value)
    return lowered


def _start(process: ObservedProcess, rewards: FloatArray) -> FloatArray:
    """Where sweeps start that rise to the value: at what the least reward for ever is worth."""
    return np.full(process.states, min(0.0, float(rewards.min())) / process.rest)


def _blind_choices(problem: Problem) -> list[IntArray]:
    """For each action that is some option's, the option [y] that stands for it in each class."""
    actions = np.unique(problem.option_action).tolist()
    first = problem.arrays.first_option
    result = []
    known: set[bytes] = set()
    for action in actions:
        choice = first[:-1].copy()
        for y in range(problem.classes):
            mine = problem.option_action[first[y] : first[y + 1]]
            here = np.flatnonzero(mine == action)
            choice[y] += int(here[0]) if len(here) else _same(problem, y, action)
        if choice.tobytes() not in known:
            known.add(choice.tobytes())
            result.append(choice)
    return result


def _same(problem: Problem, y: int, action: int) -> int:
    """The option within class y that `action` was merged into: the first with its rewards and moves."""
    a, pomdp = problem.arrays, problem.original
    states = problem.states[a.offset[y] : a.offset[y + 1]]
    rewards = pomdp.rewards[action, states]
    moves = sum(matrix[states, :] for matrix in pomdp.kernel[action])
    for j in problem.option_range(y):
        if np.array_equal(problem.reward(j), rewards):
            other = sum(matrix[states, :] for matrix in pomdp.kernel[int(problem.option_action[j])])
            if abs(moves - other).max() <= 1e-12:
                return j - int(a.first_option[y])
    return 0


def _improved(problem: Problem, process: ObservedProcess, values: FloatArray) -> IntArray:
    """The option [y] that is best at the class's uniform belief if the best of `values` [n, i] follows."""
    a = problem.arrays
    sizes = np.diff(a.offset)
    worth = np.add.reduceat(values, a.offset[:-1], axis=1) / sizes
    follow = values[np.repeat(worth.argmax(axis=0), sizes), np.arange(process.states)]
    q = process.backup(follow)
    means = np.add.reduceat(q, a.reward_start) / sizes[problem.option_class]
    choice = a.first_option[:-1].copy()
    for y in range(problem.classes):
        choice[y] += int(means[a.first_option[y] : a.first_option[y + 1]].argmax())
    return choice


def solve_blind(problem: Problem, demand: Demand | None = None) -> POMDPSolution:
    """The best blind or class-wise policy at each root, from below; the fast informed bound above.

    The returned policy takes, at each step, the action of the best vector at the belief, which earns at
    least the maximum of the vectors.  "converged" says that all policies were evaluated in time and the
    upper bound reached its fixed point; `iterations` counts policies.

    Raises:
        ModelError: no discount below 1.
    """
    began = time.perf_counter()
    demand = Demand() if demand is None else demand
    try:
        parts, options = blind_vectors(problem, demand)
        found = fast_informed(problem, demand=demand)
        status: Status = found.status
    except KeyboardInterrupt:
        past = Demand(deadline=0.0)
        parts, options = blind_vectors(problem, past)
        found, status = fast_informed(problem, demand=past), "interrupted"
    below = max((margin(problem, part) for part in parts), default=0.0)
    lower = np.array([float((parts[r.y] @ r.belief).max()) - below for r in problem.roots])
    upper = root_upper(problem, found.vectors)
    low, high = problem.combine(lower), problem.combine(upper)
    seconds = time.perf_counter() - began
    count = max((len(part) for part in parts), default=0)
    return POMDPSolution(
        lower=low,
        upper=high,
        value=low,
        policy=problem.policy(parts, [problem.option_action[taken] for taken in options], "lower"),
        root_lower=lower,
        root_upper=upper,
        status=status,
        guarantee=Guarantee("bounds", "the policy earns at least `lower`; the optimum is at most `upper`"),
        method="blind",
        vectors=sum(len(part) for part in parts),
        iterations=count,
        seconds=seconds,
        history=(Bounds(seconds, low, high),),
        note=f"{count} policies that look at most at what is seen of the state; upper bound: FIB",
    )
