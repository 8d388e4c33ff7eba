"""The kit for other packages' tests: it passes what is right, and says what is wrong with the rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from random_models import random_model
from random_pomdps import random_pomdp

from factored_polca import library
from factored_polca.explicit.alpha_vectors import AlphaVectors
from factored_polca.explicit.arrays import ArrayMDP, FloatArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.hierarchy import plan_mdp, plan_pomdp
from factored_polca.minimisation import Reduction, flat_process, reduce
from factored_polca.minimisation.quotient import make_quotient
from factored_polca.models import Action, Model, boolean
from factored_polca.solvers import METHODS, MDPSolution, solve_mdp
from factored_polca.solvers.pomdp_choose import POMDP_METHODS, solve_pomdp
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.symbolic import compile_model
from factored_polca.testing import (
    check_mdp_solver,
    check_model,
    check_policy,
    check_reduction,
    check_solver,
    known_pomdps,
)

OURS = [method for method in POMDP_METHODS if method != "witness"]
CONVERGE = ("auto", "exact", "sarsop", "hsvi")
COARSE = ("qmdp", "fib", "blind", "amdp")
TIGER = [known for known in known_pomdps() if known.name.startswith("tiger, discount 0.75")]

Solver = Callable[[ArrayPOMDP, Demand, FloatArray | None], POMDPSolution]


def ours(method: str) -> Solver:
    def solver(pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None) -> POMDPSolution:
        return solve_pomdp(pomdp, method, demand=demand, roots=roots)

    return solver


@pytest.mark.parametrize("method", OURS)
def test_our_solvers_pass(method: str) -> None:
    converges = method in CONVERGE
    check_solver(
        ours(method), must_converge=converges, coarse=method in COARSE, iterations=None if converges else 60
    )


def changed(change: Callable[[POMDPSolution, ArrayPOMDP], dict[str, Any]]) -> Solver:
    def broken(pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None) -> POMDPSolution:
        found = solve_pomdp(pomdp, "sarsop", demand=demand, roots=roots)
        return replace(found, **change(found, pomdp))

    return broken


def worst_policy(found: POMDPSolution, pomdp: ArrayPOMDP) -> dict[str, Any]:
    assert isinstance(found.policy, AlphaVectors)
    sets = tuple(replace(part, actions=(part.actions + 1) % 3) for part in found.policy.sets)
    return {"policy": AlphaVectors(pomdp.states, sets)}


def drawn(found: POMDPSolution, pomdp: ArrayPOMDP) -> dict[str, Any]:
    return {"lower": found.lower - NOISE.random() * 1e-3}


NOISE = np.random.default_rng(0)  # drawn from anew by each run


def in_place(pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None) -> POMDPSolution:
    found = solve_pomdp(pomdp, "sarsop", demand=demand, roots=roots)
    pomdp.rewards[:] = pomdp.rewards - 1.0
    return found


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (changed(lambda f, p: {"lower": f.upper + 0.1, "value": f.upper + 0.1, "upper": f.upper + 1}),
         "lower bound .* is above the optimal value 1.933441"),
        (changed(lambda f, p: {"upper": f.lower - 0.1, "value": f.lower - 0.1, "lower": f.lower - 1}),
         "upper bound .* is below the optimal value 1.933437"),
        (changed(lambda f, p: {"root_upper": f.root_upper + 1, "status": "converged"}), "has converged to"),
        (changed(worst_policy), "less than its lower bound"),
        (changed(drawn), "with one seed the bounds were"),
        (in_place, "changed the problem's rewards"),
        (changed(lambda f, p: {"status": "memory limit"}), "not converged"),
        (changed(lambda f, p: {"root_lower": np.zeros(9)}), "root_lower is an array"),
        (lambda *given: None, "it is NoneType, not a POMDPSolution"),
        (lambda pomdp, demand: None, "failed: TypeError"),
    ],
)  # fmt: skip
def test_broken_solvers_do_not(broken: Any, said: str) -> None:
    problems = [replace(known, pomdp=copied(known.pomdp)) for known in TIGER]
    with pytest.raises(AssertionError, match=said):
        check_solver(broken, problems=problems, must_converge=True)


def copied(pomdp: ArrayPOMDP) -> ArrayPOMDP:
    return replace(pomdp, rewards=pomdp.rewards.copy())


def test_lower_bounds_at_roots_are_held_against_convexity() -> None:
    with pytest.raises(AssertionError, match="the mixture of the upper bounds at the corners"):
        check_solver(too_high_at_the_start, problems=TIGER)


def too_high_at_the_start(pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None) -> POMDPSolution:
    found = solve_pomdp(pomdp, "sarsop", demand=demand, roots=roots)
    first = np.arange(len(found.root_lower)) == 0
    return replace(
        found,
        root_lower=np.where(first, 500.0, found.root_lower),
        root_upper=np.where(first, 501.0, found.root_upper),
        status="iteration limit",
    )


# -- fully observed --------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["auto", *METHODS])
def test_our_solvers_of_mdps_pass(method: str) -> None:
    def solver(mdp: ArrayMDP, demand: Demand) -> MDPSolution:
        return solve_mdp(mdp, method, demand.gap)

    check_mdp_solver(solver, must_converge=True)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f, m: {k: raised(getattr(f, k), m) for k in ("lower", "values", "upper")}, "the value is"),
        (lambda f, m: {"upper": raised(f.upper, m)}, "it says that it has converged"),
        (lambda f, m: {"status": "time limit"}, "not converged"),
        (lambda f, m: {"policy": other_actions(f, m)}, "the policy earns"),
        (lambda f, m: {"dead_ends": f.dead_ends & False, "policy": np.where(f.dead_ends, 0, f.policy)},
         "not applicable|not a number|dead ends"),
        (lambda f, m: {"values": f.values + 1e-9 * NOISE.random()}, "two runs gave different values"),
    ],
)  # fmt: skip
def test_broken_solvers_of_mdps_do_not(change: Any, said: str) -> None:
    def broken(mdp: ArrayMDP, demand: Demand) -> MDPSolution:
        found = solve_mdp(mdp, epsilon=1e-12)
        if "different" in said:
            found = replace(found, lower=found.lower - 1e-8, upper=found.upper + 1e-8)
            found = replace(found, lower=np.where(mdp.terminal, 0, found.lower))
            found = replace(found, upper=np.where(mdp.terminal, 0, found.upper))
        return replace(found, **change(found, mdp))

    with pytest.raises(AssertionError, match=said):
        check_mdp_solver(broken, must_converge=True)


def raised(values: np.ndarray, mdp: ArrayMDP) -> np.ndarray:
    return np.where(mdp.terminal, 0.0, values + 1)


def other_actions(found: MDPSolution, mdp: ArrayMDP) -> np.ndarray:
    last = len(mdp.actions) - 1 - mdp.applicable[::-1].argmax(axis=0)
    return np.where(found.policy < 0, -1, last)


# -- policies --------------------------------------------------------------------------------------


def test_a_policy_earns_what_is_said_of_it() -> None:
    known = TIGER[0]
    found = solve_pomdp(known.pomdp, "sarsop", demand=Demand(gap=1e-3))
    assert abs(check_policy(known.pomdp, found.policy, lower=found.lower, upper=known.high) - 1.93) < 1.5
    with pytest.raises(AssertionError, match="less than its lower bound"):
        check_policy(known.pomdp, found.policy, lower=15.0)
    with pytest.raises(AssertionError, match="more than the upper bound"):
        check_policy(known.pomdp, found.policy, upper=-15.0)
    with pytest.raises(AssertionError, match="for 2 states, not for 11"):
        check_policy(next(k for k in known_pomdps() if "cheese" in k.name).pomdp, found.policy)


# -- models and reductions -------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["taxi", "coffee", "tiger", "toy", "cheese", "cheese_taxi", "meds"])
def test_shipped_domains_pass(name: str) -> None:
    domain = library.load(name)
    check_model(domain.model, domain.tasks)


@pytest.mark.parametrize("seed", range(12))
def test_random_models_pass(seed: int) -> None:
    check_model(random_model(seed))
    check_model(random_pomdp(seed))


def test_a_faulty_model_does_not() -> None:
    light = boolean("light")
    with pytest.raises(AssertionError, match=r"unsure: .*light"):
        check_model(Model("unsure", [light], [Action("flip", {"lights": True})], discount="9/10"))
    with pytest.raises(AssertionError, match="twice"):
        check_model(Model("twice", [light], [Action("flip", {light: "{true: 1/2, false: 1/3}"})]))


@pytest.mark.parametrize("name", ["taxi", "cheese_taxi"])
def test_reductions_of_subtasks_pass(name: str) -> None:
    domain = library.load(name)
    partial = domain.model.observability == "partial"
    found = (plan_pomdp if partial else plan_mdp)(domain.model, domain.tasks)
    for task in found.solved:
        check_reduction(task.reduction)


def tampered(reduction: Reduction, **changes: Any) -> Reduction:
    quotient: Any = reduction.quotient
    return replace(reduction, quotient=replace(quotient, **changes))


def test_broken_reductions_do_not_pass() -> None:
    right = reduce(flat_process(compile_model(library.load("taxi", {"size": 3}).model)))
    check_reduction(right)
    mdp = right.quotient.mdp
    raised = replace(mdp, rewards=mdp.rewards + mdp.applicable)
    with pytest.raises(AssertionError, match=r"earns .*, its block"):
        check_reduction(tampered(right, mdp=raised))
    turned = replace(mdp, transitions=mdp.transitions[::-1])
    with pytest.raises(AssertionError, match="with probability"):
        check_reduction(tampered(right, mdp=turned))
    with pytest.raises(AssertionError, match="terminal"):
        check_reduction(tampered(right, mdp=replace(mdp, terminal=~mdp.terminal)))


def test_a_partition_that_is_too_coarse_does_not_pass() -> None:
    model = library.load("taxi", {"size": 3}).model
    symbolic = compile_model(model)
    right, coarse = reduce(flat_process(symbolic)), reduce(flat_process(symbolic, actions=["North"]))
    assert coarse.partition.blocks < right.partition.blocks
    wrong = Reduction(
        replace(right.minimisation, partition=coarse.partition),
        make_quotient(right.process, coarse.partition),
    )
    with pytest.raises(AssertionError, match="in state"):
        check_reduction(wrong)
