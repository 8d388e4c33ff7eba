"""`check_solver`, `check_mdp_solver`: solvers on problems whose values are known.

What a solver may leave undone is to converge: a coarse one passes if its bounds hold, and it does not say
that it has converged.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from factored_polca.explicit.arrays import FloatArray
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.models.errors import ModelError
from factored_polca.solvers.pomdp_problem import prepare
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.protocol import (
    MdpSolver,
    PomdpSolver,
    call_mdp_solver,
    call_pomdp_solver,
    name_of,
)
from factored_polca.testing.policies import check_policy
from factored_polca.testing.problems import KnownMDP, KnownPOMDP, known_mdps, known_pomdps


def check_solver(
    solver: PomdpSolver,
    *,
    problems: Sequence[KnownPOMDP] | None = None,
    gap: float = 1e-2,
    iterations: int | None = 200,
    must_converge: bool = False,
    coarse: bool = False,
    episodes: int = 400,
) -> None:
    """Whether a solver of partially observed problems keeps what `PomdpSolver` says.

    On each problem (`known_pomdps` if none are given), from the initial belief alone and with all corners:
    the solution is well formed; the known value lies within the bounds, at b0 and, for the roots, the
    bounds at a mixture keep convexity; "converged" means that the gap was reached; the policy earns its
    lower bound; equal demands give equal results; the problem is left as it was.

    Of a `coarse` solver, as QMDP, "converged" may mean that there is no more to do: its gap does not count.

    Raises:
        AssertionError: naming the solver, the problem, and what is wrong.
    """
    for known in known_pomdps() if problems is None else problems:
        where = f"{name_of(solver)} on {known.name!r}"
        demand = Demand(gap=gap, iterations=iterations)
        for roots in (None, _corners(known.pomdp)):
            before = copy.deepcopy(known.pomdp)
            found = _solved(solver, known.pomdp, demand, roots, where)
            changed = _different(before, known.pomdp)
            assert not changed, f"{where}: it changed the problem's {changed}"
            _check_bounds(found, known, float("inf") if coarse else gap, where)
            assert not must_converge or found.converged, f"{where}: not converged ({found.status})"
            if roots is not None:
                _check_roots(found, known.pomdp, roots, where)
            again = _solved(solver, known.pomdp, demand, roots, where)
            assert (found.lower, found.upper) == (again.lower, again.upper), (
                f"{where}: with one seed the bounds were [{found.lower!r}, {found.upper!r}], then "
                f"[{again.lower!r}, {again.upper!r}]"
            )
            check_policy(
                known.pomdp, found.policy, lower=found.lower, upper=known.high, episodes=episodes,
                name=f"{where}: the policy",
            )  # fmt: skip


def check_mdp_solver(
    solver: MdpSolver,
    *,
    problems: Sequence[KnownMDP] | None = None,
    gap: float = 1e-6,
    must_converge: bool = False,
) -> None:
    """Whether a solver of fully observed problems keeps what `MdpSolver` says.

    On each problem (`known_mdps` if none are given): the solution is well formed, the known value of
    each state lies within its bounds, dead ends are told, the policy is one that attains its own lower
    bounds, "converged" means that the gap was reached, and equal demands give equal results.

    Raises:
        AssertionError: naming the solver, the problem, and what is wrong.
    """
    for known in known_mdps() if problems is None else problems:
        where = f"{name_of(solver)} on {known.name!r}"
        demand = Demand(gap=gap)
        try:
            found = call_mdp_solver(solver, known.mdp, demand)
            again = call_mdp_solver(solver, known.mdp, demand)
        except ModelError as error:
            raise AssertionError(f"{where}: {error}") from error
        dead = np.isneginf(known.values)
        assert (found.dead_ends == dead).all(), (
            f"{where}: dead ends are the states {np.flatnonzero(dead).tolist()}, not "
            f"{np.flatnonzero(found.dead_ends).tolist()}"
        )
        live = np.flatnonzero(~dead)
        slack = 1e-9 * max(1.0, float(np.abs(known.values[live]).max()))
        for state in live.tolist():
            value, low, high = known.values[state], found.lower[state], found.upper[state]
            assert low - slack <= value <= high + slack, (
                f"{where}: in state {state} the value is {value:.9g} ({known.source}), outside "
                f"[{low:.9g}, {high:.9g}]"
            )
        widths = found.upper[live] - found.lower[live]
        width = float(widths.max())
        largest = max(1.0, float(np.abs(known.values[live]).max()))
        assert not found.converged or width <= gap * largest + slack, (
            f"{where}: it says that it has converged, and its bounds are {width:.3g} wide"
        )
        assert not must_converge or found.converged, f"{where}: not converged ({found.status})"
        earned = _policy_values(known, found.policy)
        least = found.values[live] - found.policy_loss_bound - widths
        worst = int((earned[live] - least).argmin())
        assert earned[live][worst] >= least[worst] - max(slack, gap * largest), (
            f"{where}: in state {live[worst]} the policy earns {earned[live][worst]:.9g}, and its values "
            f"promise {least[worst]:.9g}"
        )
        assert np.array_equal(found.values, again.values), f"{where}: two runs gave different values"
        assert np.array_equal(found.policy, again.policy), f"{where}: two runs gave different policies"


def _solved(
    solver: PomdpSolver, pomdp: ArrayPOMDP, demand: Demand, roots: FloatArray | None, where: str
) -> POMDPSolution:
    try:
        return call_pomdp_solver(solver, pomdp, demand, roots)
    except ModelError as error:
        raise AssertionError(f"{where}: {error}") from error


def _check_bounds(found: POMDPSolution, known: KnownPOMDP, gap: float, where: str) -> None:
    assert found.lower <= known.high, (
        f"{where}: the lower bound {found.lower:.9g} is above the optimal value {known.high:.9g} "
        f"({known.source})"
    )
    assert found.upper >= known.low, (
        f"{where}: the upper bound {found.upper:.9g} is below the optimal value {known.low:.9g} "
        f"({known.source})"
    )
    width = float((found.root_upper - found.root_lower).max(initial=0.0))
    assert not found.converged or max(width, found.gap) <= gap * (1 + 1e-6), (
        f"{where}: it says that it has converged to {gap:g}, and its bounds are {width:.3g} wide"
    )


def _check_roots(found: POMDPSolution, pomdp: ArrayPOMDP, roots: FloatArray, where: str) -> None:
    """V* is convex (Sondik 1971), so V*(b0) <= sum_s b0(s) V*(corner s)."""
    parts = prepare(pomdp, roots).roots
    upper = {}
    for root, value in zip(parts, found.root_upper.tolist(), strict=True):
        if root.belief.max() == 1.0:
            upper[root.y, int(root.belief.argmax())] = value
    for number, root in enumerate(parts):
        corners = [upper.get((root.y, i)) for i in range(len(root.belief))]
        mixture = sum(b * v for b, v in zip(root.belief.tolist(), corners, strict=True) if v is not None)
        complete = all(v is not None for b, v in zip(root.belief, corners, strict=True) if b > 0)
        lower = float(found.root_lower[number])
        assert not complete or lower <= mixture + 1e-9 * max(1.0, abs(mixture)), (
            f"{where}: at root {number} the lower bound {lower:.9g} is above {mixture:.9g}, the mixture of "
            "the upper bounds at the corners"
        )


def _corners(pomdp: ArrayPOMDP) -> FloatArray:
    """All corners that are not terminal, as children of a task are asked for."""
    live = np.flatnonzero(~pomdp.terminal)
    if len(live) == 0:
        return pomdp.initial[None, :]
    corners: FloatArray = np.eye(pomdp.states)[live]
    return corners


def _different(one: ArrayPOMDP, other: ArrayPOMDP) -> str:
    """The name of a field in which two problems differ; empty: none."""
    for entry in fields(ArrayPOMDP):
        left: Any = getattr(one, entry.name)
        right: Any = getattr(other, entry.name)
        if entry.name == "kernel":
            pairs = [(m, n) for a, b in zip(left, right, strict=True) for m, n in zip(a, b, strict=True)]
            same = all(np.array_equal(m.toarray(), n.toarray()) for m, n in pairs)
        else:
            same = bool(np.all(left == right))
        if not same:
            return entry.name
    return ""


def _policy_values(known: KnownMDP, policy: np.typing.NDArray[np.int64]) -> FloatArray:
    """V_pi [s] by a dense solve over the states that go on; minus infinity where it never ends."""
    mdp = known.mdp
    going = np.flatnonzero(policy >= 0)
    rows = np.array([mdp.transitions[policy[s]][[s]].toarray()[0] for s in going]).reshape(-1, mdp.states)
    values = np.where(np.isneginf(known.values), -np.inf, 0.0)
    lost = rows @ np.isneginf(values).astype(float) > 0
    system = np.eye(len(going)) - mdp.discount * rows[:, going]
    try:
        values[going] = np.linalg.solve(system, mdp.rewards[policy[going], going])
    except np.linalg.LinAlgError:  # at discount 1, a policy that never ends
        values[going] = -np.inf
    values[going[lost]] = -np.inf
    return values
