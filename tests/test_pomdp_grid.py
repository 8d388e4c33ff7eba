"""Each solver on each small problem: bounds hold, policies earn what is promised, a status says why.

What is true of a problem comes from `small_pomdps`.  What a policy earns is found from the arrays of the
POMDP alone: by following all beliefs that it can lead to, and, where these are many, by simulation.
"""

from __future__ import annotations

import time
from contextlib import suppress
from functools import cache

import numpy as np
import pytest
from small_pomdps import (
    CASES,
    PUBLISHED,
    TOLERANCE,
    Case,
    different,
    extremes,
    horizon_values,
    random_pomdp,
    tiger,
)

from factored_polca.explicit.alpha_vectors import AlphaVectors, StagedVectors
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.explicit.policy_graph import PolicyGraph
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP, array_pomdp
from factored_polca.models.errors import ModelError
from factored_polca.solvers.pomdp_choose import POMDP_METHODS, solve_pomdp
from factored_polca.solvers.pomdp_problem import prepare
from factored_polca.solvers.pomdp_result import Demand, Policy, POMDPSolution

AIMING = ("auto", "exact", "pbvi", "perseus", "hsvi", "sarsop")
"""Methods that go on until the gap is what was asked for."""

PLAIN = ("qmdp", "fib", "blind", "amdp")
"""Methods whose gap is what it is."""

ITERATIONS = {"pbvi": 4, "perseus": 4, "hsvi": 1500, "sarsop": 1500}

GAP = 1e-5
BY_NAME = {case.name: case for case in CASES}
FEW = (
    "tiger.95",
    "4x3.95",
    "discount 0",
    "all terminal",
    "random 17",
    "random 52",
    "dense 323",
    "blind 216",
)

each_case = pytest.mark.parametrize("name", BY_NAME)
each_method = pytest.mark.parametrize("method", [*AIMING, *PLAIN])


def demand_of(name: str, method: str) -> Demand:
    """What a cell of the grid asks for; the 4x3 maze would take seconds to converge."""
    limit = ITERATIONS.get(method)
    if name == "4x3.95" and method in AIMING:
        limit = min(limit or 100, 100)
    return Demand(gap=GAP, iterations=limit, seed=7)


@cache
def solved(name: str, method: str) -> POMDPSolution:
    """One cell of the grid."""
    return solve_pomdp(BY_NAME[name].pomdp, method, demand=demand_of(name, method))


def rounding(case: Case) -> float:
    """How far apart sums over the same numbers in another order may be: some ulp of the largest value."""
    return 1e-12 * case.scale


# -- what a policy earns ---------------------------------------------------------------------------


Branch = tuple[int, int, np.ndarray]
"""What may follow an action: an observation, what is seen, the matrix [s, t]."""


def branches(pomdp: ArrayPOMDP, action: int) -> list[Branch]:
    """All that may follow an action."""
    live = [(y, (pomdp.observed == y) & ~pomdp.terminal) for y in np.unique(pomdp.observed).tolist()]
    parts = [
        (observation, seen, matrix.toarray() * mine)
        for observation, matrix in enumerate(pomdp.kernel[action])
        for seen, mine in live
    ]
    return [part for part in parts if part[2].any()]


def earned(pomdp: ArrayPOMDP, policy: Policy, *, most: int = 200, steps: int = 200) -> tuple[float, float]:
    """Bounds on what a policy earns from b0: its beliefs are followed, the `most` that weigh most.

    What is let go is worth what the worst and the best policy earn that see the state.
    """
    graph = policy if isinstance(policy, PolicyGraph) else None
    staged = isinstance(policy, StagedVectors)
    ends = np.zeros((2, pomdp.states)) if staged else np.array(extremes(pomdp))
    scale = max(1.0, float(np.abs(pomdp.rewards).max()))
    rows, weights = [], []
    for seen in np.unique(pomdp.observed):
        part = np.where((pomdp.observed == seen) & ~pomdp.terminal, pomdp.initial, 0.0)
        if part.sum() > 0:
            node = -1 if graph is None else int(graph.start[seen])
            rows.append(np.append(part / part.sum(), node))
            weights.append(part.sum())
    items, mass = np.array(rows).reshape(-1, pomdp.states + 1), np.array(weights)
    table = [branches(pomdp, action) for action in range(len(pomdp.actions))]
    total, rest = 0.0, np.zeros(2)
    for step in range(policy.horizon if isinstance(policy, StagedVectors) else steps):
        if len(items) == 0 or (not staged and mass.sum() * scale / (1 - pomdp.discount) < 1e-7):
            break
        beliefs, nodes = items[:, :-1], items[:, -1].astype(int)
        actions = policy.choose(beliefs, step) if graph is None else graph.actions[nodes]
        total += float(mass @ np.sum(beliefs * pomdp.rewards[actions], axis=1))
        items, mass = followed(table, graph, items, mass * pomdp.discount, actions)
        if len(mass) > most and not staged:
            order = np.argsort(-mass, kind="stable")
            dropped = order[most:]
            rest += ends @ (mass[dropped] @ items[dropped, :-1])
            items, mass = items[order[:most]], mass[order[:most]]
    if not staged and len(items):
        rest += ends @ (mass @ items[:, :-1])
    return total + rest[0] - TOLERANCE, total + rest[1] + TOLERANCE


def followed(
    table: list[list[Branch]],
    graph: PolicyGraph | None,
    items: np.ndarray,
    mass: np.ndarray,
    actions: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """The items (belief, node) after one step, equal ones as one, and their mass."""
    rows, weights = [np.zeros((0, items.shape[1]))], [np.zeros(0)]
    for action in np.unique(actions).tolist():
        mine = np.flatnonzero(actions == action)
        for observation, seen, matrix in table[action]:
            after = items[mine, :-1] @ matrix
            chance = after.sum(axis=1)
            here = chance > 0
            nodes = np.full(int(here.sum()), -1)
            if graph is not None:
                old = items[mine[here], -1].astype(int)
                nodes = np.array([graph.successors[n][observation, seen] for n in old], dtype=int)
                assert np.all(nodes >= 0), "a policy graph has no node for what may be observed"
            rows.append(np.column_stack([after[here] / chance[here, None], nodes]))
            weights.append(mass[mine[here]] * chance[here])
    found, numbers = different(np.concatenate(rows))
    return found, np.bincount(numbers, np.concatenate(weights), len(found))


def simulated(
    pomdp: ArrayPOMDP, policy: Policy, steps: int, runs: int, random: np.random.Generator
) -> np.ndarray:
    """The returns [run] of the first `steps` steps: all is drawn, and beliefs follow Bayes' rule."""
    graph = policy if isinstance(policy, PolicyGraph) else None
    states = random.choice(pomdp.states, size=runs, p=pomdp.initial)
    beliefs = pomdp.initial * (pomdp.observed[None, :] == pomdp.observed[states][:, None])
    nodes = np.zeros(runs, dtype=int) if graph is None else graph.start[pomdp.observed[states]]
    tables = [np.hstack([m.toarray() for m in row]) for row in pomdp.kernel]  # [s, (o, t)]
    returns, weight = np.zeros(runs), 1.0
    going = np.flatnonzero(~pomdp.terminal[states])
    for step in range(steps):
        beliefs[going] /= beliefs[going].sum(axis=1, keepdims=True)
        actions = policy.choose(beliefs[going], step) if graph is None else graph.actions[nodes[going]]
        returns[going] += weight * pomdp.rewards[actions, states[going]]
        for action in np.unique(actions).tolist():
            mine = going[actions == action]
            edges = np.cumsum(tables[action][states[mine]], axis=1)
            drawn = random.random(len(mine)) * edges[:, -1]
            place = (edges <= drawn[:, None]).sum(axis=1)
            observation, states[mine] = place // pomdp.states, place % pomdp.states
            for o in np.unique(observation).tolist():
                some = mine[observation == o]
                after = beliefs[some] @ pomdp.kernel[action][o].toarray()
                beliefs[some] = after * (pomdp.observed[None, :] == pomdp.observed[states[some]][:, None])
                if graph is not None:
                    pairs = zip(nodes[some], pomdp.observed[states[some]], strict=True)
                    nodes[some] = [graph.successors[n][o, y] for n, y in pairs]
        going = going[~pomdp.terminal[states[going]]]
        weight *= pomdp.discount
    return returns


# -- the grid --------------------------------------------------------------------------------------


def check(case: Case, found: POMDPSolution) -> None:
    """What holds of every solution, however it came to end."""
    low, high = case.truth
    near = rounding(case)
    assert found.lower <= high
    assert found.upper >= low
    assert found.lower <= found.value <= found.upper
    assert found.gap == found.upper - found.lower
    assert np.all(found.root_lower <= found.root_upper)
    problem = prepare(case.pomdp)
    assert len(found.root_lower) == len(found.root_upper) == len(problem.roots)
    assert abs(problem.combine(found.root_lower) - found.lower) <= near
    assert abs(problem.combine(found.root_upper) - found.upper) <= near
    lower, upper = [b.lower for b in found.history], [b.upper for b in found.history]
    assert lower == sorted(lower)
    assert upper == sorted(upper, reverse=True)
    assert (lower[-1], upper[-1]) == (found.lower, found.upper)
    seconds = [b.seconds for b in found.history]
    assert seconds == sorted(seconds)
    assert found.guarantee.text
    assert found.method


def check_policy(case: Case, found: POMDPSolution, most: int = 30, steps: int = 20) -> None:
    """The policy earns at least the lower bound, and no more than the optimum."""
    assert isinstance(found.policy, AlphaVectors | PolicyGraph | EntropyPolicy)
    low, high = earned(case.pomdp, found.policy, most=most, steps=steps)
    assert high >= found.lower
    assert low <= case.truth[1]
    size = found.policy.nodes if isinstance(found.policy, PolicyGraph) else found.policy.count
    assert found.vectors == size


@each_case
def test_the_problems_are_known_to_less_than_one_percent(name):
    pomdp, (low, high) = BY_NAME[name].pomdp, BY_NAME[name].truth
    assert 0 <= high - low <= 0.01 * float(np.ptp(pomdp.rewards)) / (1 - pomdp.discount)


@each_method
@each_case
def test_the_bounds_hold_and_tighten(name, method):
    check(BY_NAME[name], solved(name, method))


@each_method
@each_case
def test_the_policy_earns_the_lower_bound(name, method):
    check_policy(BY_NAME[name], solved(name, method), 200, 200)


@pytest.mark.parametrize("method", AIMING)
@each_case
def test_converged_says_that_the_gap_is_what_was_asked_for(name, method):
    found = solved(name, method)
    close = bool(np.all(found.root_upper - found.root_lower <= GAP))
    assert found.converged == close
    if not close:  # PBVI and Perseus may also have come to the end of their pool
        limit = demand_of(name, method).iterations
        assert limit is not None
        assert found.status == "iteration limit"
        assert found.iterations == limit or (method in ("pbvi", "perseus") and found.iterations < limit)


@pytest.mark.parametrize("method", ["auto", "exact", "hsvi", "sarsop"])
@pytest.mark.parametrize("name", [name for name in BY_NAME if name not in ("4x3.95",)])
def test_small_problems_are_solved_to_the_gap(name, method):
    assert solved(name, method).converged


@pytest.mark.parametrize("method", PLAIN)
@each_case
def test_methods_without_a_gap_end_when_they_are_done(name, method):
    assert solved(name, method).status == "converged"


@pytest.mark.parametrize("method", [*AIMING, "amdp"])
@each_case
def test_equal_demands_give_equal_results(name, method):
    one = solved(name, method)
    two = solve_pomdp(BY_NAME[name].pomdp, method, demand=demand_of(name, method))
    for field in (
        "lower",
        "upper",
        "value",
        "status",
        "guarantee",
        "method",
        "vectors",
        "iterations",
        "note",
    ):
        assert getattr(one, field) == getattr(two, field)
    assert np.array_equal(one.root_lower, two.root_lower)
    assert np.array_equal(one.root_upper, two.root_upper)
    assert [(b.lower, b.upper) for b in one.history] == [(b.lower, b.upper) for b in two.history]
    assert same_policy(one.policy, two.policy)


def same_policy(one: Policy, two: Policy) -> bool:
    """Whether two policies are the same arrays."""
    if isinstance(one, AlphaVectors) and isinstance(two, AlphaVectors):
        pairs = zip(one.sets, two.sets, strict=True)
        return all(
            np.array_equal(a.states, b.states)
            and np.array_equal(a.vectors, b.vectors)
            and np.array_equal(a.actions, b.actions)
            for a, b in pairs
        )
    if isinstance(one, PolicyGraph) and isinstance(two, PolicyGraph):
        same = np.array_equal(one.actions, two.actions) and np.array_equal(one.start, two.start)
        return same and all(map(np.array_equal, one.successors, two.successors))
    assert isinstance(one, EntropyPolicy)
    assert isinstance(two, EntropyPolicy)
    return np.array_equal(one.actions, two.actions)


@each_method
@pytest.mark.parametrize("name", [case.name for case in PUBLISHED] + ["random 17", "random 52"])
def test_the_lower_bound_is_achieved_in_simulation(name, method):
    pomdp, found = BY_NAME[name].pomdp, solved(name, method)
    steps = 30 if pomdp.discount <= 0.6 else 80
    returns = simulated(pomdp, found.policy, steps, 120, np.random.default_rng(3))
    rest = pomdp.discount**steps * float(np.abs(extremes(pomdp)).max())
    error = returns.std(ddof=1) / np.sqrt(len(returns))
    assert returns.mean() + 4 * error + rest >= found.lower
    assert returns.mean() - 4 * error - rest <= BY_NAME[name].truth[1]


# -- limits ----------------------------------------------------------------------------------------


@each_method
@pytest.mark.parametrize("name", FEW)
def test_an_expired_deadline_leaves_bounds_and_a_policy(name, method):
    demand = Demand(gap=GAP, deadline=time.monotonic() - 1)
    found = solve_pomdp(BY_NAME[name].pomdp, method, demand=demand)
    check(BY_NAME[name], found)
    check_policy(BY_NAME[name], found)
    if method in AIMING and np.any(found.root_upper - found.root_lower > GAP):
        assert found.status == "time limit"
    assert found.status in ("time limit", "converged")


@each_method
@pytest.mark.parametrize("name", FEW)
@pytest.mark.parametrize("limit", [0, 3])
def test_few_iterations_leave_bounds_and_a_policy(name, method, limit):
    found = solve_pomdp(BY_NAME[name].pomdp, method, demand=Demand(gap=GAP, iterations=limit))
    check(BY_NAME[name], found)
    check_policy(BY_NAME[name], found)
    assert found.status in ("iteration limit", "converged")
    if method in AIMING:
        assert found.converged == bool(np.all(found.root_upper - found.root_lower <= GAP))
        assert found.iterations <= limit or found.converged


class Interrupting:
    """Raises KeyboardInterrupt at some calls, and remembers whether it did."""

    def __init__(self, *calls: int) -> None:
        self.calls, self.count, self.raised = calls, 0, False
        self.bounds: list[tuple[float, float]] = []

    def __call__(self, lower: float, upper: float) -> None:
        self.count += 1
        self.bounds.append((lower, upper))
        if self.count in self.calls or not self.calls:
            self.raised = True
            raise KeyboardInterrupt


def uninterrupted(pomdp: ArrayPOMDP, method: str, demand: Demand) -> POMDPSolution:
    """`solve_pomdp`, which must not let the KeyboardInterrupt out (pytest would end)."""
    found = None
    with suppress(KeyboardInterrupt):
        found = solve_pomdp(pomdp, method, demand=demand)
    assert found is not None, "KeyboardInterrupt came out of the solver"
    return found


@each_method
@pytest.mark.parametrize("name", [name for name in FEW if name != "discount 0"])
@pytest.mark.parametrize("calls", [(), (2,)], ids=["all", "second"])
def test_an_interrupt_leaves_bounds_and_a_policy(name, method, calls):
    case, progress = BY_NAME[name], Interrupting(*calls)
    found = uninterrupted(case.pomdp, method, Demand(gap=GAP, iterations=20, progress=progress))
    check(case, found)
    check_policy(case, found)
    low, high = case.truth
    assert all(lower <= high and upper >= low for lower, upper in progress.bounds)
    if progress.raised:
        assert found.status == "interrupted" or (method in AIMING and found.gap <= GAP)


@pytest.mark.parametrize("method", ["pbvi", "perseus", "hsvi", "sarsop", "qmdp", "fib", "blind", "amdp"])
def test_progress_is_told_and_may_interrupt(method):
    progress = Interrupting()
    found = uninterrupted(tiger(0.95), method, Demand(progress=progress))
    assert progress.raised
    assert found.status == "interrupted"


# -- finite horizons -------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["auto", "exact", "witness"])
@each_case
def test_a_finite_horizon_is_solved_exactly(name, method):
    pomdp = BY_NAME[name].pomdp
    for horizon in {"exact": (1, 2, 3, 4), "witness": (1, 3), "auto": (2,)}[method]:
        if horizon == 4 and pomdp.states > 6:
            continue
        check_horizon(pomdp, method, horizon)


@pytest.mark.parametrize("method", ["exact", "witness"])
@pytest.mark.parametrize("seed", [4, 10, 17, 39])
def test_a_finite_horizon_needs_no_discount(seed, method):
    check_horizon(random_pomdp(seed, discount=1.0), method, 3)


def check_horizon(pomdp: ArrayPOMDP, method: str, horizon: int) -> None:
    """Bounds, value and policy at b0 and at corners agree with the expansion."""
    corners = np.eye(pomdp.states)[~pomdp.terminal]
    found = solve_pomdp(pomdp, method, horizon=horizon, demand=Demand(gap=1e-6), roots=corners)
    value, *others = horizon_values(pomdp, np.vstack([pomdp.initial, corners]), horizon)
    assert found.status == "converged"
    assert abs(found.value - value) <= TOLERANCE
    assert found.lower - 1e-12 <= value <= found.upper + 1e-12
    assert found.gap <= 1e-6
    assert isinstance(found.policy, StagedVectors)
    assert found.policy.horizon == horizon
    assert abs(found.policy.value(pomdp.initial) - value) <= TOLERANCE
    for corner, other in zip(corners, others, strict=True):
        assert abs(found.policy.value(corner) - other) <= TOLERANCE
    least, most = earned(pomdp, found.policy)
    assert least - TOLERANCE <= value <= most + TOLERANCE


# -- wrong use -------------------------------------------------------------------------------------

WRONG = {
    "discount 1": ({"method": "sarsop", "discount": 1.0}, r"--horizon.*--discount"),
    "discount 1, exact": ({"method": "exact", "discount": 1.0}, r"--horizon.*--discount"),
    "a horizon for sarsop": ({"method": "sarsop", "horizon": 3}, r"auto, exact, witness"),
    "a horizon for amdp": ({"method": "amdp", "horizon": 3}, r"auto, exact, witness"),
    "no horizon for witness": ({"method": "witness"}, r"--horizon"),
    "an unknown method": ({"method": "magic"}, "there are auto, exact"),
    "gap 0": ({"gap": 0.0}, "must be positive"),
    "a negative gap": ({"gap": -1.0}, "must be positive"),
    "a gap that is no number": ({"gap": float("nan")}, "must be positive"),
    "horizon 0": ({"method": "exact", "horizon": 0}, "at least 1"),
    "a negative horizon": ({"method": "exact", "horizon": -3}, "at least 1"),
    "a root of another length": ({"roots": np.full((1, 3), 1 / 3)}, "root belief"),
    "a root that is a number": ({"roots": np.array(1.0)}, "root belief"),
    "a root of mass 1.1": ({"roots": np.array([[0.5, 0.6]])}, "root belief"),
    "a negative root": ({"roots": np.array([[-0.5, 1.5]])}, "root belief"),
    "a root that is no number": ({"roots": np.array([[np.nan, 1.0]])}, "root belief"),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_use_is_refused_with_the_way_out(what):
    given, message = WRONG[what]
    given = dict(given)
    pomdp = tiger(given.pop("discount", 0.95))
    demand = Demand(gap=given.pop("gap", 1e-3))
    with pytest.raises(ModelError, match=message):
        solve_pomdp(pomdp, given.pop("method", "auto"), demand=demand, **given)


def test_every_method_is_in_the_grid():
    assert set(POMDP_METHODS) == {*AIMING, *PLAIN, "witness"}


@pytest.mark.parametrize("method", [*AIMING, *PLAIN])
def test_roots_are_solved_where_every_state_is_terminal(method):
    found = solve_pomdp(BY_NAME["all terminal"].pomdp, method, roots=np.eye(2))
    assert (found.lower, found.upper, found.status) == (0.0, 0.0, "converged")


@pytest.mark.parametrize("method", ["exact", "witness"])
@pytest.mark.parametrize("reward", [1.0, -1.0])
def test_a_rare_end_is_not_taken_for_rounding(method, reward):
    # Ends with the chance d at each step: the sum over k < 1000 of reward (1 - d)^k.
    d = 5e-10
    rows = [np.array([[a - d, 1 - a, d], [1 - a, a - d, d], [0, 0, 0]]) for a in (0.5, 0.25)]
    rewards = np.array([[reward, reward, 0.0]] * 2)
    pomdp = array_pomdp(
        [[row] for row in rows], rewards, np.array([0.5, 0.5, 0.0]), 1.0, terminal=np.arange(3) == 2
    )
    found = solve_pomdp(pomdp, method, horizon=1000, demand=Demand(iterations=1))
    value = reward * -np.expm1(1000 * np.log1p(-d)) / d
    assert found.lower <= value + 1e-9
    assert found.upper >= value - 1e-9
