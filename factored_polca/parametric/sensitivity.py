"""How the value of a process depends on parameters: one quotient, solved at each of many settings.

Fully observed processes are solved by policy iteration that starts from the policy of the setting before
(neighbouring settings mostly share their policy: then one factorisation and one look at all actions are
enough), and each value comes with the bounds of its Bellman residual.  Settings at which probabilities
vanish, and undiscounted processes, are solved from scratch: there the states from which an end is certain,
and the policies that are proper, may be others.  Partially observed processes are solved from scratch.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Literal

import numpy as np

from factored_polca.explicit.arrays import FloatArray, IntArray
from factored_polca.parametric.quotient import ParametricQuotient
from factored_polca.solvers.choose import solve_mdp
from factored_polca.solvers.evaluation import FACTORISATION_LIMIT, StopRule, TimeIsUp
from factored_polca.solvers.pairs import Pairs
from factored_polca.solvers.policy_iteration import policy_iteration
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.solvers.preparation import prepare

Progress = Callable[[int, int], None]
"""Called after each setting with how many are done, and of how many."""


@dataclass(frozen=True)
class Point:
    """One setting: bounds on the optimal value at b0, and which of the study's policies is optimal.

    `refused` tells why there is no value; `policy` is -1 then, and where policies are not compared.
    Seconds are of the process' clock.
    """

    setting: Mapping[str, Fraction]
    lower: float
    upper: float
    policy: int
    refused: str
    instantiate_seconds: float
    solve_seconds: float
    warm: bool

    @property
    def value(self) -> float:
        """The middle of the bounds."""
        return self.lower if self.lower == self.upper else 0.5 * (self.lower + self.upper)


@dataclass(frozen=True)
class Sensitivity:
    """The points of a study in the order of the settings.

    `policies` are the different optimal policies [block] -> choice that were met, of fully observed
    processes.  `stopped` tells why settings are missing at the end.
    """

    quotient: ParametricQuotient
    parameters: tuple[str, ...]
    points: tuple[Point, ...]
    policies: tuple[IntArray, ...]
    stopped: Literal["", "time limit", "interrupted"] = ""

    @property
    def values(self) -> FloatArray:
        """The value at each setting, NaN where it was refused."""
        return np.array([point.value for point in self.points])

    @property
    def admissible(self) -> tuple[Point, ...]:
        """The points that have a value."""
        return tuple(point for point in self.points if not point.refused)

    def mean_microseconds(self) -> tuple[float, float]:
        """The mean time of an instantiation and of a solution."""
        good = self.admissible
        if not good:
            return float("nan"), float("nan")
        return (
            1e6 * sum(point.instantiate_seconds for point in good) / len(good),
            1e6 * sum(point.solve_seconds for point in good) / len(good),
        )


def grid(ranges: Mapping[str, Sequence[Fraction]]) -> list[dict[str, Fraction]]:
    """The settings with each combination of values, the last parameter changing fastest."""
    return [dict(zip(ranges, values, strict=True)) for values in itertools.product(*ranges.values())]


def spaced(low: Fraction, high: Fraction, count: int) -> list[Fraction]:
    """`count` equally spaced values from `low` to `high`, both included, exactly."""
    if count == 1:
        return [low]
    return [low + (high - low) * Fraction(number, count - 1) for number in range(count)]


def sensitivity(
    quotient: ParametricQuotient,
    settings: Iterable[Mapping[str, Fraction]],
    *,
    gap: float | None = None,
    method: str = "auto",
    deadline: float | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Sensitivity:
    """The optimal value at each setting.

    Args:
        settings: values of parameters; those not set keep the model's.
        gap: of the bounds; relative to the largest value for fully observed processes (1e-9), as it is
            for partially observed ones (1e-3).
        method: of `solve_pomdp`, for partially observed processes.
        deadline: a reading of `time.monotonic()`; what is done then is returned, as after Ctrl-C.
        progress: called after each setting.

    Raises:
        ModelError: at a setting where the value is infinite or undefined (discount 1).
    """
    listed = [dict(setting) for setting in settings]
    names = tuple(dict.fromkeys(name for setting in listed for name in setting))
    run = _Run(quotient, gap, method, deadline, seed)
    points: list[Point] = []
    stopped: Literal["", "time limit", "interrupted"] = ""
    try:
        for setting in listed:
            points.append(run.point(setting))
            if progress is not None:
                progress(len(points), len(listed))
    except TimeIsUp:
        stopped = "time limit"
    except KeyboardInterrupt:
        stopped = "interrupted"
    return Sensitivity(quotient, names, tuple(points), tuple(run.policies.values()), stopped)


class _Run:
    """The working state of a study: the last policy, and the policies met."""

    def __init__(
        self,
        quotient: ParametricQuotient,
        gap: float | None,
        method: str,
        deadline: float | None,
        seed: int,
    ) -> None:
        self.quotient, self.method, self.deadline, self.seed = quotient, method, deadline, seed
        self.gap = gap if gap is not None else (1e-3 if quotient.partial else 1e-9)
        self.warm: _Warm | None = None
        self.policies: dict[bytes, IntArray] = {}
        self.numbers: dict[bytes, int] = {}

    def point(self, setting: Mapping[str, Fraction]) -> Point:
        """Solve at a setting.

        Raises:
            TimeIsUp: the deadline has passed.
            KeyboardInterrupt: Ctrl-C.
        """
        StopRule(deadline=self.deadline).poll()
        quotient = self.quotient
        began = time.process_time()
        values = {**quotient.process.nominal, **setting}
        clear = quotient.run_if_clear(values)
        if clear is None:
            violated = quotient.process.violated(values)
            if violated:
                listed = "; ".join(f"{condition} does not hold" for condition in violated)
                return Point(values, np.nan, np.nan, -1, listed, 0.0, 0.0, False)
        registers = quotient.program.run(values) if clear is None else clear
        if quotient.partial:
            pomdp = quotient.pomdp_of(registers)
            middle = time.process_time()
            demand = Demand(self.gap, self.deadline, None, self.seed)
            found = solve_pomdp(pomdp, self.method, demand=demand)
            stop_unless_solved(found.status)
            spent = time.process_time() - middle
            return Point(values, found.lower, found.upper, -1, "", middle - began, spent, False)
        if self.warm is not None and self.warm.same_structure(registers):
            pairs = self.warm.pairs_of(registers)
            middle = time.process_time()
            lower, upper, policy = self.warm.solve(pairs, self.gap, self.deadline)
            warm = True
        else:
            mdp = quotient.mdp_of(registers)
            middle = time.process_time()
            solution = solve_mdp(mdp, epsilon=self.gap, deadline=self.deadline)
            stop_unless_solved(solution.status)
            lower, upper, policy = solution.lower, solution.upper, solution.policy
            warm = False
            if self.warm is None and _Warm.fits(quotient, registers):
                self.warm = _Warm(quotient, registers, policy)
        initial = registers[quotient.initial]
        bounds = [_expected(initial, side) for side in (lower, upper)]
        number = self.number(policy)
        spent = time.process_time() - middle
        return Point(values, bounds[0], bounds[1], number, "", middle - began, spent, warm)

    def number(self, policy: IntArray) -> int:
        """The number of a policy, a new one where it is met for the first time."""
        kept = np.ascontiguousarray(policy, dtype=np.int64)
        key = kept.tobytes()
        self.policies.setdefault(key, kept)
        return self.numbers.setdefault(key, len(self.numbers))


def stop_unless_solved(status: str) -> None:
    """Hand on what stopped a solver.

    Raises:
        TimeIsUp: the deadline.
        KeyboardInterrupt: Ctrl-C.
    """
    if status == "interrupted":
        raise KeyboardInterrupt
    if status == "time limit":
        raise TimeIsUp


def _expected(initial: FloatArray, values: FloatArray) -> float:
    """The mean of values that may be infinite where b0 is 0."""
    return float(initial @ np.where(initial > 0, values, 0.0))


class _Warm:
    """The pairs of a discounted MDP with registers for their numbers, and the last policy."""

    def __init__(self, quotient: ParametricQuotient, registers: FloatArray, policy: IntArray) -> None:
        prepared = prepare(quotient.mdp_of(registers))
        self.pairs, self.dead = prepared.pairs, prepared.dead_ends
        entries = []
        for action, state in zip(self.pairs.action.tolist(), self.pairs.state.tolist(), strict=True):
            matrix = quotient.kernel[action][0]
            entries.append(matrix.registers[matrix.pointers[state] : matrix.pointers[state + 1]])
        self.entries: IntArray = np.concatenate(entries) if entries else np.empty(0, dtype=np.int64)
        self.rewards: IntArray = quotient.rewards[self.pairs.action, self.pairs.state]
        self.all = _all_registers(quotient)
        self.choice: IntArray | None = None

    @staticmethod
    def fits(quotient: ParametricQuotient, registers: FloatArray) -> bool:
        """Whether settings like this one may start from the policy of another."""
        discount = quotient.process.process.symbolic.model.discount
        small = quotient.partition.blocks <= FACTORISATION_LIMIT
        return discount < 1 and small and bool((registers[_all_registers(quotient)] > 0).all())

    def same_structure(self, registers: FloatArray) -> bool:
        """Whether no probability vanishes."""
        return bool((registers[self.all] > 0).all())

    def pairs_of(self, registers: FloatArray) -> Pairs:
        """The pairs at a setting."""
        return replace(self.pairs, probability=registers[self.entries], reward=registers[self.rewards])

    def solve(
        self, pairs: Pairs, gap: float, deadline: float | None
    ) -> tuple[FloatArray, FloatArray, IntArray]:
        """Bounds on the values [block], and a policy [block] -> choice."""
        found = policy_iteration(pairs, StopRule(gap, deadline), self.choice)
        stop_unless_solved(found.status)
        self.choice = found.choice
        policy = np.full(pairs.nodes, -1, dtype=np.int64)
        policy[pairs.free] = pairs.action[found.choice[pairs.free]]
        lower, upper = (
            np.where(self.dead, -np.inf, side) for side in (found.interval.lower, found.interval.upper)
        )
        return lower, upper, policy


def _all_registers(quotient: ParametricQuotient) -> IntArray:
    """The registers of all probabilities of the kernel."""
    return np.unique(np.concatenate([m.registers for matrices in quotient.kernel for m in matrices]))
