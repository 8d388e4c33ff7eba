"""The augmented MDP (AMDP; Roy & Thrun, "Coastal navigation with mobile robots", NIPS 1999).

A belief b is summarised by x = (s*, h): its most likely state and the bin of its normalised entropy
(`explicit.entropy_policy`).  The summaries are taken as the states of an MDP,

    R(x, j)     = mean over the sampled beliefs b in x of  b . r_j,
    P(x' | x, j) = mean over the same b of  sum over branches k of j with b M_k in x' of |b M_k|,

so that only the beliefs are sampled: over options and observations the sums are complete.

*Sampling.*  Runs start at the roots, in proportion to their weights (a root without weight as often as
one with the largest), and take half of their options at random, the other half greedily: by QMDP in the
first round, by the AMDP planned so far in the later ones.  Then beliefs are followed up until each
summary that can be reached has at least one sampled belief.

*What no belief falls into.*  Where that is cut short, a summary without a sample counts as if the state
were s* and seen from then on.  In the policy a summary without a sample takes the action of the nearest
bin of the same state that has one, the lower of two; without any, QMDP's action at that state; action 0
at states that have ended.  Mass that a row misses ends with the value 0.

The value in the AMDP proves nothing about the POMDP; the bounds come from elsewhere.

Letters as in `pomdp_problem`; x = i * bins + h numbers the summaries over the kept states.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from scipy.sparse import csr_array

from factored_polca.explicit.arrays import ArrayMDP, FloatArray, IntArray, SparseMatrix
from factored_polca.explicit.entropy_policy import EntropyPolicy
from factored_polca.models.errors import ModelError
from factored_polca.solvers.choose import solve_mdp
from factored_polca.solvers.evaluation import TimeIsUp
from factored_polca.solvers.fast_informed import fast_informed
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Bounds, Demand, POMDPSolution
from factored_polca.solvers.qmdp import (
    corner_values,
    option_vectors,
    qmdp_bound,
    root_upper,
    worst_at_roots,
)
from factored_polca.solvers.result import Guarantee, MDPSolution, Status

RANDOM: Final = 0.5
"""The share of options that runs take at random."""

SAMPLING: Final = 0.6
"""The share of the time left that is spent on sampling rather than planning."""

BATCH: Final = 256
"""Beliefs that are followed up at once."""


@dataclass(frozen=True)
class _Plan:
    """The AMDP solved: `best[x]` is the option within the class, -1 without a sample."""

    best: IntArray  # [x]
    values: FloatArray  # [x], 0 without a sample
    status: Status

    @staticmethod
    def none(summaries: int) -> _Plan:
        """No plan yet."""
        return _Plan(np.full(summaries, -1, dtype=np.int64), np.zeros(summaries), "converged")


@dataclass
class _Statistics:
    """Sums over the beliefs sampled so far; grows while sampling (a working state, not a value)."""

    problem: Problem
    bins: int
    turned: list[SparseMatrix] = field(init=False)  # [k] the transpose of M_k
    count: IntArray = field(init=False)  # [x] sampled beliefs
    rewards: FloatArray = field(init=False)  # [x, option within the class]
    moves: list[list[tuple[IntArray, IntArray, FloatArray]]] = field(init=False)  # by option: x, x', mass
    waiting: dict[int, tuple[int, FloatArray]] = field(default_factory=dict)  # x: (class, belief)

    def __post_init__(self) -> None:
        self.turned = [csr_array(matrix.T) for matrix in self.problem.matrices]
        summaries = len(self.problem.states) * self.bins
        options = int(np.diff(self.problem.arrays.first_option).max(initial=0))
        self.count = np.zeros(summaries, dtype=np.int64)
        self.rewards = np.zeros((summaries, options))
        self.moves = [[] for _ in range(options)]

    def summary(self, y: int, beliefs: FloatArray) -> IntArray:
        """x [n] of beliefs [n, n_y] over class y."""
        likeliest: IntArray = beliefs.argmax(axis=1) + int(self.problem.arrays.offset[y])
        states = self.problem.original.states
        if states < 2:
            likeliest *= self.bins
            return likeliest
        logs = np.log(beliefs, out=np.zeros_like(beliefs), where=beliefs > 0)
        entropy = -(beliefs * logs).sum(axis=1) / np.log(states)
        bin_number = np.clip((entropy * self.bins).astype(np.int64), 0, self.bins - 1)
        x: IntArray = likeliest * self.bins + bin_number
        return x

    def add(
        self, y: int, beliefs: FloatArray, chosen: IntArray, draw: FloatArray
    ) -> list[tuple[int, FloatArray]]:
        """Count beliefs [n, n_y] in, with every option and branch.

        Returns where the runs get to that take the options `chosen` [n] and whose branch is drawn by
        `draw` [n] in [0, 1); runs that end are left out.
        """
        problem = self.problem
        x = self.summary(y, beliefs)
        np.add.at(self.count, x, 1)
        for number in x.tolist():
            self.waiting.pop(number, None)
        left = draw.copy()
        reached: dict[int, tuple[int, FloatArray]] = {}
        for j in problem.option_range(y):
            option = j - problem.option_range(y).start
            np.add.at(self.rewards[:, option], x, beliefs @ problem.reward(j))
            for k in problem.branch_range(j):
                target = int(problem.arrays.branch_target[k])
                after = np.ascontiguousarray((self.turned[k] @ beliefs.T).T)
                mass = after.sum(axis=1)
                some = np.flatnonzero(mass > 0)
                after = after[some] / mass[some, None]
                to = self.summary(target, after)
                self.moves[option].append((x[some], to, mass[some]))
                self._wait(target, to, after)
                for place in np.flatnonzero((chosen[some] == j) & (left[some] >= 0)).tolist():
                    run = int(some[place])
                    left[run] -= mass[run]
                    if left[run] < 0:
                        reached[run] = (target, after[place])
        return [reached[run] for run in sorted(reached)]

    def _wait(self, y: int, numbers: IntArray, beliefs: FloatArray) -> None:
        new = np.flatnonzero(self.count[numbers] == 0)
        for place in new.tolist():
            self.waiting.setdefault(int(numbers[place]), (y, beliefs[place]))

    def follow_up(self, demand: Demand) -> None:
        """Sample the beliefs that wait until none does.

        Raises:
            TimeIsUp: the deadline has passed.
        """
        while self.waiting:
            classes: dict[int, list[FloatArray]] = {}
            for y, belief in self.waiting.values():
                classes.setdefault(y, []).append(belief)
            for y, beliefs in sorted(classes.items()):
                for start in range(0, len(beliefs), BATCH):
                    demand.poll()
                    part = np.array(beliefs[start : start + BATCH])
                    self.add(y, part, np.full(len(part), -1), np.zeros(len(part)))

    def transitions(
        self, option: int, rows: IntArray, number: IntArray
    ) -> tuple[SparseMatrix, SparseMatrix]:
        """(to summaries with a sample, to all) for the summaries `rows`, `number` [x] their new numbers."""
        mine, size = self.moves[option], len(self.count)
        if not mine:
            return csr_array((len(rows), len(rows))), csr_array((len(rows), size))
        x, to, mass = (np.concatenate(part) for part in zip(*mine, strict=True))
        table = csr_array((mass / self.count[x], (number[x], to)), shape=(len(rows), size))
        return csr_array(table[:, rows]), table


def _plan(statistics: _Statistics, corners: FloatArray, demand: Demand) -> _Plan:
    """Solve the AMDP; a summary without a sample is worth `corners` [i] of its state."""
    problem = statistics.problem
    rows = np.flatnonzero(statistics.count)
    n = len(rows)
    number = np.full(len(statistics.count), -1, dtype=np.int64)
    number[rows] = np.arange(n)
    state = rows // statistics.bins
    classes = np.searchsorted(problem.arrays.offset, state, side="right") - 1
    options = np.diff(problem.arrays.first_option)[classes]
    worth = np.where(statistics.count > 0, 0.0, np.repeat(corners, statistics.bins))
    L = int(options.max(initial=0))
    rewards, applicable = np.zeros((L, n + 1)), np.zeros((L, n + 1), dtype=np.bool_)
    transitions = []
    for option in range(L):
        inside, table = statistics.transitions(option, rows, number)
        mean = statistics.rewards[rows, option] / statistics.count[rows]
        mine = options > option
        rewards[option, :n] = np.where(mine, mean + problem.discount * np.asarray(table @ worth), 0.0)
        applicable[option, :n] = mine
        lost = np.where(mine, np.maximum(1.0 - np.asarray(inside.sum(axis=1)), 0.0), 0.0)
        transitions.append(_with_sink(inside, lost))
    names = tuple(f"option {option}" for option in range(L))
    mdp = ArrayMDP(names, tuple(transitions), rewards, applicable, np.arange(n + 1) == n, problem.discount)
    found: MDPSolution = solve_mdp(mdp, deadline=demand.deadline)
    best, values = np.full(len(number), -1, dtype=np.int64), np.zeros(len(number))
    best[rows], values[rows] = found.policy[:n], found.values[:n]
    return _Plan(best, values, found.status)


def _with_sink(inside: SparseMatrix, lost: FloatArray) -> SparseMatrix:
    n = len(lost)
    cells = inside.tocoo()
    ends = np.flatnonzero(lost > 0)
    entries = np.concatenate([cells.data, lost[ends]])
    place = (np.concatenate([cells.row, ends]), np.concatenate([cells.col, np.full(len(ends), n)]))
    return csr_array((entries, place), shape=(n + 1, n + 1))


@dataclass(frozen=True)
class _Runs:
    """How runs choose: `vectors` [p] are QMDP's, `plan` the AMDP's of the round before."""

    problem: Problem
    statistics: _Statistics
    vectors: FloatArray
    random: np.random.Generator
    plan: _Plan

    def choose(self, y: int, beliefs: FloatArray) -> IntArray:
        """Options j [n] at beliefs [n, n_y]: at random or greedy."""
        options = self.problem.option_range(y)
        greedy = (beliefs @ option_vectors(self.problem, self.vectors, y).T).argmax(axis=1)
        planned = self.plan.best[self.statistics.summary(y, beliefs)]
        greedy = np.where(planned >= 0, planned, greedy)
        drawn = self.random.integers(len(options), size=len(beliefs))
        picked: IntArray = np.where(self.random.random(len(beliefs)) < RANDOM, drawn, greedy)
        return picked + options.start

    def sample(self, runs: int, steps: int, demand: Demand, limit: float) -> int:
        """Follow `runs` runs for `steps` steps; returns the beliefs sampled, at most about `limit`.

        Raises:
            TimeIsUp: the deadline has passed.
        """
        roots = self.problem.roots
        weights = np.array([root.weight for root in roots])
        weights[weights == 0] = weights.max(initial=0.0) or 1.0
        drawn = self.random.choice(len(roots), size=runs, p=weights / weights.sum())
        now = [(roots[r].y, roots[r].belief) for r in [*range(len(roots)), *drawn.tolist()]]
        sampled = 0
        for _ in range(steps):
            classes: dict[int, list[FloatArray]] = {}
            for y, belief in now:
                classes.setdefault(y, []).append(belief)
            now = []
            for y, beliefs in sorted(classes.items()):
                demand.poll()
                if sampled >= limit:
                    return sampled
                part = np.array(beliefs)
                chosen = self.choose(y, part)
                now += self.statistics.add(y, part, chosen, self.random.random(len(part)))
                sampled += len(part)
            if not now:
                break
        return sampled


def solve_amdp(
    problem: Problem,
    demand: Demand | None = None,
    bins: int = 5,
    *,
    runs: int = 40,
    steps: int = 50,
    rounds: int = 2,
) -> POMDPSolution:
    """The augmented MDP with `bins` entropy bins, from `rounds` rounds of `runs` runs of `steps` steps.

    `demand.iterations` limits the beliefs sampled on runs, `iterations` counts them; `demand.seed` decides
    all draws.  Bounds: the fast informed bound from above, the worst policy from below; `value` is the
    AMDP's own, clipped into them.

    Raises:
        ModelError: no discount below 1, or a number of bins, runs, steps or rounds below 1.
    """
    began = time.perf_counter()
    if min(bins, runs, steps, rounds) < 1:
        raise ModelError(f"bins {bins}, runs {runs}, steps {steps}, rounds {rounds}: each is at least 1")
    demand = Demand() if demand is None else demand
    informed = fast_informed(problem, demand=demand)
    status = informed.status
    limits = Demand(deadline=0.0) if status == "interrupted" else demand
    lower, last = worst_at_roots(problem, limits)
    upper = root_upper(problem, informed.vectors)
    vectors = qmdp_bound(problem, limits).vectors
    statistics = _Statistics(problem, bins)
    corners = corner_values(problem, vectors)
    random = np.random.default_rng(demand.seed)
    plan = _Plan.none(len(statistics.count))
    status = last if status == "converged" else status
    sampled = 0
    try:
        for _ in range(rounds if problem.classes and status == "converged" else 0):
            if demand.progress is not None:
                demand.progress(problem.combine(lower), problem.combine(upper))
            left = np.inf if demand.iterations is None else demand.iterations - sampled
            if left <= 0:
                status = "iteration limit"
                break
            step = _Runs(problem, statistics, vectors, random, plan)
            part = _share_of_time(demand)
            try:
                sampled += step.sample(runs, steps, part, left)
                statistics.follow_up(part)
            finally:
                if statistics.count.any():
                    plan = _plan(statistics, corners, demand)
            if plan.status == "interrupted":
                raise KeyboardInterrupt
    except TimeIsUp:
        status = "time limit"
    except KeyboardInterrupt:
        status = "interrupted"
    if status == "converged":
        status = plan.status
    return _solution(statistics, plan, vectors, (lower, upper), status, sampled, began)


def _share_of_time(demand: Demand) -> Demand:
    """The demand for sampling, which leaves time to plan with what was sampled."""
    if demand.deadline is None:
        return demand
    return replace(demand, deadline=time.monotonic() + SAMPLING * demand.seconds_left)


def _solution(
    statistics: _Statistics,
    plan: _Plan,
    vectors: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    status: Status,
    sampled: int,
    began: float,
) -> POMDPSolution:
    problem = statistics.problem
    policy = _policy(statistics, plan, vectors)
    corners = corner_values(problem, vectors)
    worth = []
    for root in problem.roots:
        x = int(statistics.summary(root.y, root.belief[None, :])[0])
        worth.append(plan.values[x] if plan.best[x] >= 0 else corners[x // statistics.bins])
    low, high = problem.combine(bounds[0]), problem.combine(bounds[1])
    seconds = time.perf_counter() - began
    covered = int((plan.best >= 0).sum())
    note = f"{covered} of {len(plan.best)} pairs of most likely state and entropy bin were sampled"
    if covered == 0 and problem.classes:
        note += "; stopped before the first plan: the policy is QMDP's at the most likely state"
    return POMDPSolution(
        lower=low,
        upper=high,
        value=float(np.clip(problem.combine(worth), low, high)),
        policy=policy,
        root_lower=bounds[0],
        root_upper=bounds[1],
        status=status,
        guarantee=Guarantee(
            "heuristic",
            "the policy is optimal for sampled summaries of beliefs; what it earns is not known; "
            "at least `lower`, what the worst policy earns",
        ),
        method="AMDP",
        vectors=policy.count,
        iterations=sampled,
        seconds=seconds,
        history=(Bounds(seconds, low, high),),
        note=note + "; upper bound: FIB",
    )


def _policy(statistics: _Statistics, plan: _Plan, vectors: FloatArray) -> EntropyPolicy:
    """The plan's actions by original state and bin; see the module's docstring for the rest."""
    problem, bins = statistics.problem, statistics.bins
    actions = np.zeros((problem.original.states, bins), dtype=np.int64)
    if problem.classes == 0:
        return EntropyPolicy(actions)
    best = plan.best.reshape(-1, bins)
    far = np.abs(np.arange(bins)[:, None] - np.arange(bins)[None, :])
    distance = np.where((best >= 0)[:, None, :], far[None, :, :], bins)  # [i, bin, bin that has a sample]
    nearest = distance.argmin(axis=2)
    option = np.take_along_axis(best, nearest, axis=1)
    for y in range(problem.classes):
        here = slice(int(problem.arrays.offset[y]), int(problem.arrays.offset[y + 1]))
        greedy = option_vectors(problem, vectors, y).argmax(axis=0)
        local = np.where(option[here] >= 0, option[here], greedy[:, None])
        actions[problem.states[here]] = problem.option_action[problem.arrays.first_option[y] + local]
    return EntropyPolicy(actions)
