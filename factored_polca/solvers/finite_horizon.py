"""Exact solution of a POMDP over a finite number of steps, on the whole simplex.

    V_0 = 0,    V_h = the exact backup of V_{h-1},    h = 1 .. H

(Smallwood & Sondik 1973).  After H steps nothing is earned; the discount may be 1.

Letters: H the horizon, h steps to go, G(m) = 1 + gamma + ... + gamma^(m-1).

What is known about a value V_h as computed:

- it is below the true one by at most the errors of pruning, E_h = error + gamma E_{h-1}, and off by at
  most the rounding R_h either way;
- the staged policy takes the lowest action within `alpha_vectors.TIE` of the best, which may cost
  T_h = TIE * max(1, |V|) + gamma T_{h-1} (nothing in a stage with one action).

So V_h - R_h - T_h <= V_pi <= V* <= V_h + E_h + R_h.  Where a limit stops the work after h < H stages, with
least and largest reward r, r' (0 included where the process may end),

    V_h + gamma^h G(H - h) r  <=  V_H  <=  V_h + gamma^h G(H - h) r',

the left side earned by the policy that follows the h stages and then the last one for ever.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from factored_polca.explicit.alpha_vectors import TIE, AlphaVectors, StagedVectors
from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.models.errors import LimitReached, ModelError
from factored_polca.solvers.evaluation import TimeIsUp
from factored_polca.solvers.exact_backup import Backup, backup
from factored_polca.solvers.pomdp_problem import Problem
from factored_polca.solvers.pomdp_result import Bounds, Demand, POMDPSolution
from factored_polca.solvers.result import Guarantee, Status
from factored_polca.solvers.witness import witness_backup

Method = Literal["incremental pruning", "witness"]

METHODS: Final[tuple[Method, ...]] = ("incremental pruning", "witness")


def solve_finite_horizon(
    problem: Problem, horizon: int, demand: Demand, *, method: Method = "incremental pruning"
) -> POMDPSolution:
    """V* over `horizon` steps, with a `StagedVectors` policy; iterations count backups.

    All stages are computed, whatever `demand.gap` says, unless a limit stops the work; sets too large
    to prune count as an iteration limit, and the note says so.

    Raises:
        ModelError: a horizon below 1, or an unknown method.
    """
    if horizon < 1:
        raise ModelError(f"the horizon is {horizon}: it must be at least 1 step")
    if method not in METHODS:
        raise ModelError(f"{method!r} is no exact method; there are {', '.join(METHODS)}")
    run = _Run(problem, horizon, demand, method)
    status: Status = "converged"
    try:
        while len(run.stages) < horizon:
            if demand.iterations is not None and run.iterations >= demand.iterations:
                status = "iteration limit"
                break
            run.step()
    except TimeIsUp:
        status = "time limit"
    except KeyboardInterrupt:
        status = "interrupted"
    except LimitReached as limit:
        status, run.trouble = "iteration limit", f"; stopped, as {limit}"
    return run.solution(status)


@dataclass(frozen=True)
class _Stage:
    """V_h with the errors of the module's docstring."""

    vectors: list[FloatArray]  # [y] [n, n_y]
    actions: list[IntArray]  # [y] [n]
    pruning: float = 0.0  # E_h
    rounding: float = 0.0  # R_h
    ties: float = 0.0  # T_h

    @property
    def largest(self) -> float:
        return max((float(np.abs(part).max(initial=0.0)) for part in self.vectors), default=0.0)


class _Run:
    """The working state: the stages so far."""

    def __init__(self, problem: Problem, horizon: int, demand: Demand, method: Method) -> None:
        self.problem, self.horizon, self.demand, self.method = problem, horizon, demand, method
        self.begin = time.monotonic()
        self.stages: list[_Stage] = []
        self.iterations = 0
        self.programs = 0
        self.witnesses: list[FloatArray] | None = None
        self.history: list[Bounds] = []
        self.trouble = ""

    def step(self) -> None:
        """One more stage."""
        self.demand.poll()
        classes = range(self.problem.classes)
        nothing = _Stage([np.zeros((1, self.problem.size(y))) for y in classes], [])
        last = self.stages[-1] if self.stages else nothing
        found = self._backup(last.vectors, self.demand.poll)
        actions = [self.problem.option_action[part.options] for part in found.classes]
        self.stages.append(self._stage(last, found.sets, actions, found.error))
        self.iterations += 1
        self.programs += found.programs
        self.witnesses = found.witnesses
        self._note()

    def _backup(self, sets: list[FloatArray], poll: Callable[[], None]) -> Backup:
        if self.method == "witness":
            return witness_backup(self.problem, sets, poll=poll)
        return backup(self.problem, sets, witnesses=self.witnesses, poll=poll)

    def _stage(self, last: _Stage, sets: list[FloatArray], actions: list[IntArray], error: float) -> _Stage:
        gamma = self.problem.discount
        largest = max(_Stage(sets, actions).largest, last.largest)
        choice = any(len(np.unique(part)) > 1 for part in actions)
        return _Stage(
            sets,
            actions,
            pruning=error + gamma * last.pruning,
            rounding=self._terms() * 2.0**-52 * largest + gamma * last.rounding,
            ties=(TIE * max(1.0, largest) if choice else 0.0) + gamma * last.ties,
        )

    def _terms(self) -> int:
        """How many terms of a backup, and of a product with a belief, are summed at most."""
        problem = self.problem
        branches = max((len(problem.branch_range(j)) for j in range(problem.options)), default=0)
        return 3 * int(np.diff(problem.arrays.offset).max(initial=0)) + 2 * branches + 8

    def _known(self) -> _Stage:
        """The last stage; without any the rewards themselves, which are V_1 with nothing pruned."""
        if self.stages:
            return self.stages[-1]
        problem = self.problem
        options = [np.array(problem.option_range(y), dtype=np.int64) for y in range(problem.classes)]
        sets = [np.array([problem.reward(int(j)) for j in part]) for part in options]
        nothing = _Stage([np.zeros((1, problem.size(y))) for y in range(problem.classes)], [])
        return self._stage(nothing, sets, [problem.option_action[part] for part in options], 0.0)

    def _rest(self, start: int, steps: int) -> tuple[float, float]:
        """What `steps` steps after `start` others earn at least and at most."""
        gamma = self.problem.discount
        if gamma == 1:
            total = float(steps)
        elif gamma == 0:
            total = float(min(steps, 1))
        else:
            total = -math.expm1(steps * math.log(gamma)) / (1 - gamma)
        least, largest = self.problem.reward_range
        return gamma**start * total * least, gamma**start * total * largest

    def _bounds(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(lower, value, upper) at each root."""
        stage, problem = self._known(), self.problem
        done = max(1, len(self.stages))
        values = np.array([float((stage.vectors[r.y] @ r.belief).max()) for r in problem.roots])
        least, largest = self._rest(done, self.horizon - done)
        spare = 1e-15 * (abs(least) + abs(largest)) * self.horizon + stage.rounding
        value = values + least
        ties = stage.ties * (1 + abs(least))  # what a stage adds for later steps widens its ties
        return value - spare - ties, value, values + largest + stage.pruning + spare

    def _note(self) -> None:
        """Write the bounds at b0 down, and tell them."""
        lower, _, upper = (self.problem.combine(part) for part in self._bounds())
        if self.history:
            lower, upper = max(lower, self.history[-1].lower), min(upper, self.history[-1].upper)
        self.history.append(Bounds(time.monotonic() - self.begin, lower, upper))
        if self.demand.progress is not None:
            self.demand.progress(lower, upper)

    def _policy(self) -> StagedVectors:
        """The stages; short ones are used first and filled up behind with the last step's."""
        stages = self.stages or [self._known()]
        done = len(stages)
        filled: list[AlphaVectors] = []
        for left in range(1, self.horizon + 1):
            used = max(1, done - (self.horizon - left))
            stage = stages[used - 1]
            least, _ = self._rest(used, left - used)
            whole = left == used
            vectors = stage.vectors if whole else [part + least for part in stage.vectors]
            meaning: Literal["exact", "lower"] = "exact" if whole else "lower"
            filled.append(self.problem.policy(vectors, stage.actions, meaning))
        return StagedVectors(tuple(filled))

    def solution(self, status: Status) -> POMDPSolution:
        """What is known now."""
        lower, value, upper = self._bounds()
        combine = self.problem.combine
        policy = self._policy()
        stage = self._known()
        if len(self.stages) == self.horizon:
            kind = Guarantee(
                "exact",
                f"V* over {self.horizon} steps for every belief; pruning may have cost "
                f"{stage.pruning:.1e}, rounding {stage.rounding:.1e}, the policy's ties {stage.ties:.1e}",
            )
        else:
            kind = Guarantee(
                "bounds",
                f"{max(1, len(self.stages))} of {self.horizon} steps are exact; the others count with the "
                f"least and the largest reward",
            )
        if status == "converged" and combine(upper) - combine(lower) > self.demand.gap:
            status = "rounding limit"
        return POMDPSolution(
            lower=combine(lower),
            upper=combine(upper),
            value=combine(value),
            policy=policy,
            root_lower=lower,
            root_upper=upper,
            status=status,
            guarantee=kind,
            method=self.method,
            vectors=policy.count,
            iterations=self.iterations,
            seconds=time.monotonic() - self.begin,
            history=tuple(self.history),
            note=f"{self.iterations} backups, {self.programs} linear programs{self.trouble}",
        )
