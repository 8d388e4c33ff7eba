"""Value iteration on diagrams, without a quotient: SPUDD with APRICODD's merging of leaves, two-sided.

Letters: V the present function, T the Bellman operator (`bellman`), W the computed T V, delta the bound on
its rounding error, d = W - V, g = gamma / (1 - gamma), gamma < 1.

**Bounds** (MacQueen 1966; Puterman 1994, theorem 6.6.3).  V may be any function at all, so that nothing of
how it came about, merged leaves and rounding included, needs to be accounted for: every sweep proves anew

    W - delta + g min(d - delta)  <=  V*  <=  W + delta + g max(d + delta),

the extremes being taken over the states that have a choice, and over 0 too where some state's value is
fixed, for it can't be shifted.  The narrowest such interval is kept.  A greedy policy pi that loses at most
t against the best choice anywhere has T_pi V >= T V - t, hence by the same theorem

    V_pi  >=  W - delta + g min(d - delta) - t / (1 - gamma).

**Merging** (APRICODD; St-Aubin, Hoey & Boutilier 2000).  Before the next sweep leaves of V within a width
are merged (`rounding`).  The width is a share of the interval that is still open, so that early sweeps run
on small diagrams; where the interval does not shrink the share does.  It never falls below the rounding
error, so that equal values which floats split are one leaf again.  Under a limit of nodes, or where memory
is short, the width is what brings the diagram down to size: then the interval stays as wide as that makes
it.

Between two sweeps come some of the greedy policy alone (`policy_sweeps`).  Where no state's value is fixed
V is moved to the middle of the interval while it pays (Porteus 1975).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Final

import numpy as np

from factored_polca.diagrams import Aborted, Diagram, MemoryLimit, choose, node_count
from factored_polca.minimisation.criterion import DecisionProcess
from factored_polca.models import Fault, LimitReached, ModelError
from factored_polca.solvers.result import Guarantee, Status
from factored_polca.structured.bellman import TIE_TOLERANCE, UNIT, Bellman, leaf_values, map_leaves
from factored_polca.structured.policy_sweeps import PolicySweep
from factored_polca.structured.rounding import round_leaves, round_to_size
from factored_polca.structured.solution import StructuredSolution
from factored_polca.structured.start import expected_at_start

METHOD: Final = "structured value iteration"

SHARE: Final = 0.25
"""The width of merging at first, as a share of (1 - gamma) times half the open interval."""
SHIFT_PROGRESS: Final = 0.9
"""V is moved to the middle where the interval is at most this share of what it was at the last move."""
FLOOR: Final = 0.1
"""The least width of merging, as a share of (1 - gamma) times half the interval that is asked for."""
SLOW_SWEEPS: Final = 3
"""Slow sweeps in a row before leaves are merged less."""
PATIENCE: Final = 20
"""Sweeps that gain nothing, with leaves merged as little as may be, before giving up."""
FEWEST_NODES: Final = 64
"""A diagram is not made smaller than that to fit into memory."""
POLICY_SWEEPS: Final = 8
MOST_POLICY_SWEEPS: Final = 128
SETTLED: Final = 0.02
"""Sweeps of the policy alone end where what they still may gain is this share of the interval's half."""
DEAR: Final = 0.7
"""No more sweeps of the policy alone where one takes more than this share of a whole sweep's work."""

Progress = Callable[[int, float, int], None]
"""Called after each sweep with the sweeps so far, upper - lower, and the nodes of V."""


@dataclass(frozen=True)
class Known:
    """What has been proved: |V* - values| <= radius where there is a choice; of `choices` that they earn at
    least values - radius - loss."""

    values: Diagram
    radius: float
    choices: Diagram
    loss: float


def structured_value_iteration(
    process: DecisionProcess,
    *,
    epsilon: float = 1e-9,
    absolute: bool = False,
    deadline: float | None = None,
    iterations: int | None = None,
    node_limit: int | None = None,
    progress: Progress | None = None,
) -> StructuredSolution:
    """Bounds on the optimal values of a fully observed process, and a policy, as diagrams.

    Stops when upper - lower <= `epsilon` * max(1, max |value|) everywhere (with `absolute`, <= `epsilon`),
    at `deadline` (a reading of `time.monotonic()`), after `iterations` sweeps, at Ctrl-C, or where memory
    allows no better; the bounds hold in each case.  `node_limit` caps the nodes of V between sweeps.

    Raises:
        ModelError: a partially observed process, a finite horizon, discount 1, or a reward beyond the
            range of floats.
        LimitReached: memory or time for not even the rewards as diagrams.
    """
    began = time.perf_counter()
    refuse_unfit(process)
    if not epsilon > 0:
        raise ModelError(f"epsilon is {epsilon}: it must be positive; 1e-9 is the default")
    manager = process.symbolic.manager
    before = manager.deadline
    if deadline is not None:
        manager.deadline = deadline if before is None else min(before, deadline)
    try:
        try:
            bellman = Bellman(process)
        except (MemoryLimit, Aborted) as error:
            raise LimitReached(
                f"structured value iteration stopped before its first sweep: {error}", "solve"
            ) from None
        run = _Run(bellman, epsilon, absolute, iterations, node_limit, progress)
        run.run()
        manager.deadline = None
        return run.solution(began)
    finally:
        manager.deadline = before


def refuse_unfit(process: DecisionProcess) -> None:
    """Refuse what structured value iteration has no bounds for.

    Raises:
        ModelError: with the reason.
    """
    model = process.symbolic.model
    if process.partial:
        raise ModelError(
            [Fault("structured value iteration is for models whose state is seen", ("observability",))]
        )
    if model.horizon is not None:
        hint = "remove it and give a discount, or solve with vi"
        raise ModelError([Fault("structured value iteration has no finite horizon", ("horizon",), hint)])
    if model.discount == 1:
        hint = "give a discount below 1, or solve over blocks or states: vi, pi, mpi"
        message = (
            "structured value iteration has no bounds at discount 1: whether a policy ends is asked of "
            "states one by one"
        )
        raise ModelError([Fault(message, ("discount",), hint)])


class _Run:
    """The working state of one run.  `known` is replaced, never changed: it holds at any time."""

    def __init__(
        self,
        bellman: Bellman,
        epsilon: float,
        absolute: bool,
        iterations: int | None,
        node_limit: int | None,
        progress: Progress | None,
    ) -> None:
        self.bellman, self.manager = bellman, bellman.manager
        self.epsilon, self.absolute = epsilon, absolute
        self.limit, self.progress = iterations, progress
        self.node_limit = node_limit
        discount = Fraction(bellman.process.symbolic.model.discount)
        self.discount = float(discount)
        self.g = float(np.nextafter(float(discount / (1 - discount)), np.inf))  # rounded up
        self.fixed = bellman.has_fixed
        self.values = bellman.zero  # V
        self.largest = 0.0
        self.width = 0.0
        self.share = SHARE
        self.iterations = 0
        self.slow = self.idle = 0
        self.shifted = np.inf
        self.policy_sweeps = POLICY_SWEEPS
        self.sweep: PolicySweep | None = None
        self.squeezed = False  # whether memory or the limit of nodes decides how leaves are merged
        self.status: Status | None = None
        self.known = self.prior()

    def prior(self) -> Known:
        """What holds before any sweep: rewards without end, and the first choice there is."""
        bound = self.bellman.largest_reward / float(1 - Fraction(self.discount)) * (1 + 1e-9)
        none = len(self.bellman.process.choices)
        first = self.manager.constant(none)
        for number in range(none - 1, -1, -1):
            first = choose(self.bellman.safety.safe[number], self.manager.constant(number), first)
        return Known(self.bellman.zero, bound, first, 0.0)

    # -- the loop --------------------------------------------------------------------------

    def run(self) -> None:
        """Sweep until something says stop."""
        try:
            while self.status is None:
                if self.limit is not None and self.iterations >= self.limit:
                    self.status = "iteration limit"
                    return
                try:
                    self.step()
                except MemoryLimit:
                    self.shrink()
        except Aborted:
            self.status = "time limit"
        except KeyboardInterrupt:
            self.status = "interrupted"

    def target(self) -> float:
        """The half of upper - lower that was asked for."""
        scale = 1.0 if self.absolute else max(1.0, self.largest)
        return 0.5 * self.epsilon * scale

    def step(self) -> None:
        """One sweep, what it proves, and the next V."""
        bellman = self.bellman
        work = self.work
        q_values = bellman.q_values(self.values)
        best = bellman.best(q_values)
        choices = bellman.greedy(q_values, best)
        low, high = bellman.extremes(best - self.values)
        work = self.work - work
        error = bellman.error(self.largest)
        found = self.proved(best, choices, low, high, error)
        self.iterations += 1
        before = self.known.radius
        if found.radius <= before:
            self.known = found
        if self.progress is not None:
            self.progress(self.iterations, 2 * self.known.radius, node_count(self.values))
        if self.known.radius <= self.target():
            self.status = "converged"
            if self.known is found:
                self.finish(q_values, best)
            return
        self.adapt(found.radius, before)
        if self.status is not None:
            return
        moved = best
        if not self.fixed and found.radius <= SHIFT_PROGRESS * self.shifted:
            self.shifted = found.radius
            moved = found.values
        del q_values, found, best
        self.next_values(moved, choices, work)

    @property
    def work(self) -> int:
        """Steps of the diagram kernels so far."""
        return int(self.manager.head[2])

    def proved(self, best: Diagram, choices: Diagram, low: float, high: float, error: float) -> Known:
        """What d in [low, high] proves."""
        slack = error + 2 * UNIT * max(abs(low), abs(high))
        low, high = low - slack, high + slack
        if self.fixed:
            low, high = min(low, 0.0), max(high, 0.0)
        below, above = self.g * low, self.g * high
        below -= 4 * UNIT * abs(below)  # g is rounded up: outwards where the sign is negative
        above += 4 * UNIT * abs(above)
        shift = below + (above - below) / 2
        values = self.moved(best, shift)
        largest = float(np.abs(leaf_values(best)).max()) + abs(shift)
        radius = (above - below) / 2 + error + 8 * UNIT * largest
        tie = TIE_TOLERANCE * max(1.0, largest) + 2 * error
        loss = tie * (1 + self.g) * (1 + 1e-9)
        return Known(values, radius, choices, loss)

    def moved(self, best: Diagram, shift: float) -> Diagram:
        """`best` + `shift` where there are choices."""
        return self.bellman.masked(map_leaves(best, lambda v: v + shift))

    def adapt(self, radius: float, before: float) -> None:
        """Merge less where the interval shrinks slowly, or give up."""
        error_of_floats = self.bellman.float_error(self.largest)
        self.slow = self.slow + 1 if radius > (1 + self.discount) / 2 * before else 0
        floor = max(2 * error_of_floats, FLOOR * (1 - self.discount) * self.target())
        if self.slow >= SLOW_SWEEPS and self.width > floor and not self.squeezed:
            self.share /= 4
            self.slow = 0
        self.idle = 0 if radius < (1 - 1e-3) * before else self.idle + 1
        if self.idle >= PATIENCE and (self.width <= floor or self.squeezed):
            self.status = "memory limit" if self.squeezed else "rounding limit"
        self.width = max(self.share * (1 - self.discount) * self.known.radius, floor)
        self.bellman.numbers.use_step(self.width / max(1, self.bellman.steps()))

    def next_values(self, value: Diagram, choices: Diagram, work: int) -> None:
        """V for the next sweep: `value` after some sweeps of the policy, with leaves merged."""
        value = self.merged(value)
        policy = self.bellman.primitive_policy(choices)
        sweep = self.sweep
        if sweep is not None and sweep.policy == policy:
            self.policy_sweeps = min(2 * self.policy_sweeps, MOST_POLICY_SWEEPS)
        else:
            sweep = self.sweep = PolicySweep(self.bellman, policy)
            self.policy_sweeps = POLICY_SWEEPS
        settled = self.policy_sweeps > POLICY_SWEEPS
        for number in range(self.policy_sweeps):
            start = self.work
            following = self.merged(sweep.apply(value, may_merge=settled))
            if settled:
                low, high = self.bellman.extremes(following - value)
            value, before = following, value
            if value == before or (settled and self.g * max(-low, high) <= SETTLED * self.known.radius):
                break
            if not settled and number and self.work - start > DEAR * work:
                break
        self.use(value)

    def use(self, value: Diagram) -> None:
        self.values = value
        self.largest = float(np.abs(leaf_values(value)).max())

    def merged(self, value: Diagram) -> Diagram:
        """`value` with leaves merged as much as is wanted now."""
        rounded = round_leaves(value, self.width).diagram
        if self.node_limit is not None and node_count(rounded) > self.node_limit:
            self.squeezed = True
            rounded = round_to_size(rounded, nodes=self.node_limit, width=self.width).diagram
        return self.bellman.masked(rounded)

    def shrink(self) -> None:
        """After a sweep for which memory was short: go on with half the nodes, or give up."""
        self.sweep = None
        self.manager.collect_garbage()
        nodes = node_count(self.values)
        if nodes <= FEWEST_NODES:
            self.status = "memory limit"
            return
        self.node_limit = nodes // 2 if self.node_limit is None else min(self.node_limit, nodes) // 2
        self.squeezed = True
        try:
            self.use(self.bellman.masked(round_to_size(self.values, nodes=self.node_limit).diagram))
        except MemoryLimit:
            self.status = "memory limit"

    # -- the end ---------------------------------------------------------------------------

    def finish(self, q_values: list[Diagram], best: Diagram) -> None:
        """The policy by the tie rule, its loss measured."""
        bellman, known = self.bellman, self.known
        try:
            gap = min(2 * known.radius, TIE_TOLERANCE * max(1.0, self.largest))  # a wide one would cost
            choices = bellman.greedy(q_values, best, gap)
            drop, _ = bellman.extremes(bellman.chosen(choices, q_values) - best)
        except MemoryLimit:
            return
        tie = max(0.0, -drop) + 2 * bellman.error(self.largest)
        self.known = replace(known, choices=choices, loss=tie * (1 + self.g) * (1 + 1e-9))

    def solution(self, began: float) -> StructuredSolution:
        """What is returned."""
        with self.manager.undisturbed():
            return self._solution(began)

    def _solution(self, began: float) -> StructuredSolution:
        bellman, known = self.bellman, self.known
        lost = bellman.safety.lost
        values = known.values
        if lost != self.manager.constant(0):
            values = choose(lost, bellman.lowest, values)
        finite = leaf_values(values)
        finite = finite[np.isfinite(finite)]
        largest = float(np.abs(finite).max(initial=0.0))
        value, error = expected_at_start(bellman.numbers, values, largest)
        if np.isnan(value):  # not even that fits
            lowest = -np.inf if lost != self.manager.constant(0) else float(finite.min(initial=0.0))
            lower, upper = lowest - known.radius, float(finite.max(initial=0.0)) + known.radius
            value = lower + (upper - lower) / 2 if lowest > -np.inf else lower
        else:
            lower, upper = value - known.radius - error, value + known.radius + error
        size = node_count(values)
        assert self.status is not None
        return StructuredSolution(
            process=bellman.process,
            values=values,
            radius=known.radius,
            policy_loss=known.loss,
            choices=known.choices,
            policy=bellman.primitive_policy(known.choices),
            lost=lost,
            lower=lower,
            value=value,
            upper=upper,
            policy_lower=lower - known.loss,
            largest=largest,
            leaves=len(leaf_values(values)),
            nodes=size,
            merged=self.width,
            iterations=self.iterations,
            seconds=time.perf_counter() - began,
            status=self.status,
            guarantee=Guarantee(
                "bounds",
                f"the optimal value of every state lies within {known.radius:.3g} of the value diagram, "
                f"and the policy loses at most {2 * known.radius + known.loss:.3g}, rounding and merged "
                "leaves included",
            ),
            method=METHOD,
            note=self.note(size),
        )

    def note(self, size: int) -> str:
        """What was done to the diagrams."""
        squeezed = ""
        if self.squeezed:
            squeezed = f", kept to {self.node_limit:,} nodes between sweeps"
        return f"a value diagram of {size:,} nodes, leaves merged within {self.width:.2g}{squeezed}"
