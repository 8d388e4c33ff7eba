"""Approximate abstraction: minimise a process that is near the process itself, and say what that may cost.

1. *Snap* (`snap`): rows and rewards within epsilon become one.
2. *Merge*: where the state is seen, blocks of the snapped process are found from the top and split only
   where values differ by more than epsilon of their span (`aggregate`); where it is not seen, or telling
   classes apart takes too much, the snapped process is minimised exactly.
3. Solve what comes of it, and carry the policy back to the states.
4. *Certify* (`certificate`, `lemma`): bounds on what the policy is worth, and on the optimum, in the
   process itself.

Execution tracks with the model itself.  With epsilon 0 all of it is exact minimisation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.approximation.aggregate import Aggregation, aggregate
from factored_polca.approximation.certificate import (
    CLASS_LIMIT,
    STEPS,
    Certificate,
    bound_optimum,
    certify_by_errors,
    certify_policy,
)
from factored_polca.approximation.errors import Errors, process_errors
from factored_polca.approximation.lemma import (
    block_errors,
    entry_span,
    start_error,
    uniform_error,
    value_span,
)
from factored_polca.approximation.snap import Snapped
from factored_polca.explicit.arrays import IntArray
from factored_polca.minimisation import DecisionProcess, Minimisation, Reduction, make_quotient, reduce
from factored_polca.minimisation.pomdp_quotient import MAXIMUM_OBSERVATIONS
from factored_polca.models import LimitReached
from factored_polca.solvers.pomdp_result import POMDPSolution


@dataclass(frozen=True, repr=False)
class ApproximateReduction(Reduction):
    """A reduction of a process that is near `original`; `process` is the snapped one.

    `stable` says whether the partition is exact for the snapped process, or its blocks hold states of near
    values.
    """

    original: DecisionProcess
    snapped: Snapped
    stable: bool

    def errors(self) -> Errors:
        """How far the snapped process is from the original in each block."""
        return process_errors(self.original, self.process, self.partition)


@dataclass(frozen=True)
class Approximation:
    """What is certain of an approximate abstraction, at the initial belief.

    `lower` <= what the policy earns <= `upper`, what any policy earns <= `optimum`, and the policy earns
    at most `loss` less than the best.  `model_error` is the plain simulation lemma: no policy's value in
    the snapped process is further from that in the process itself.  `measured_loss` is the exact loss
    where it was computed as a check."""

    epsilon: Fraction
    lower: float
    upper: float
    optimum: float
    loss: float
    model_error: float
    classes: int | None
    collision_bound: float
    note: str
    measured_loss: float | None = None
    measured_note: str = "not asked for"

    @property
    def epsilon_text(self) -> str:
        """Epsilon as it may be read again: 0.05 or 1/3."""
        text = repr(float(self.epsilon))
        return text if Fraction(text) == self.epsilon else str(self.epsilon)


def approximate(
    process: DecisionProcess,
    snapped: Snapped,
    *,
    seed: int = 0,
    block_limit: int | None = None,
    class_limit: int = CLASS_LIMIT,
    deadline: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    maximum_observations: int = MAXIMUM_OBSERVATIONS,
) -> ApproximateReduction:
    """Steps 1 and 2 of the module's docstring for a process of the model that `snapped` was made from.

    Raises:
        LimitReached: more than `block_limit` blocks, memory, time or observations.
        ModelError: see `factored_polca.minimisation.make_pomdp_quotient`.
    """
    near = snapped.process(process)
    if snapped.epsilon and not process.partial and process.symbolic.model.discount < 1:
        try:
            found = aggregate(
                near, float(snapped.epsilon), class_limit=class_limit, seed=seed, deadline=deadline,
                progress=progress,
            )  # fmt: skip
        except LimitReached as error:
            if error.stage != "classes":
                raise
        else:
            return _aggregated(process, near, snapped, found, block_limit)
    exact = reduce(
        near,
        seed=seed,
        block_limit=block_limit,
        progress=progress,
        maximum_observations=maximum_observations,
    )
    partition = replace(exact.partition, symbolic=process.symbolic)  # what executes a plan reads this model
    return ApproximateReduction(
        replace(exact.minimisation, partition=partition), replace(exact.quotient, partition=partition),
        process, snapped, True,
    )  # fmt: skip


def _aggregated(
    process: DecisionProcess,
    near: DecisionProcess,
    snapped: Snapped,
    found: Aggregation,
    block_limit: int | None,
) -> ApproximateReduction:
    if block_limit is not None and found.partition.blocks > block_limit:
        raise LimitReached(f"more than {block_limit:,} blocks", "minimisation", found.partition)
    partition = replace(found.partition, symbolic=process.symbolic)
    quotient = replace(make_quotient(near, partition), mdp=found.mdp)
    minimisation = Minimisation(near, partition, found.passes, (), found.collision_bound, found.seconds)
    return ApproximateReduction(minimisation, quotient, process, snapped, False)


def certify_mdp(
    reduction: ApproximateReduction,
    policy: npt.NDArray[Any],
    *,
    steps: int = STEPS,
    class_limit: int = CLASS_LIMIT,
    seed: int = 0,
) -> Approximation:
    """What is certain of `policy` [block] (a choice's number, -1 for none), the state being seen.

    Raises:
        LimitReached: memory or time.
        ValueError: discount 1.
    """
    chosen: IntArray = np.asarray(policy, dtype=np.int64)
    errors = reduction.errors()
    try:
        found = certify_policy(
            reduction.original, reduction.partition, chosen, steps=steps, class_limit=class_limit, seed=seed
        )
    except LimitReached as error:
        if error.stage != "classes":
            raise
        found = certify_by_errors(reduction.process, reduction.partition, chosen, errors)
    return _approximation(reduction, errors, found)


def certify_pomdp(
    reduction: ApproximateReduction, solution: POMDPSolution, *, seed: int = 0
) -> Approximation:
    """What is certain of a solution of the quotient, the state not being seen.

    The bounds are those of the quotient's solver, moved outwards by what the snapped rows may cost; they
    are never wider than what the best and the worst policy earn that see the state.

    Raises:
        LimitReached: memory or time.
        ValueError: discount 1.
    """
    errors, quotient = reduction.errors(), reduction.pomdp_quotient
    mdp, initial = quotient.mdp, quotient.pomdp.initial
    low, high = value_span(mdp, len(reduction.process.symbolic.model.features))
    optimum = solution.upper + start_error(initial, block_errors(errors, mdp, high - low))
    span, lower = entry_span(solution.policy), -np.inf
    if span is not None:
        lower = solution.lower - start_error(initial, block_errors(errors, mdp, span))
    seen = replace(reduction.original, channels=None)
    try:
        optimum = min(optimum, bound_optimum(seen, reduction.partition, seed=seed))
        lower = max(lower, bound_optimum(seen, reduction.partition, seed=seed, worst=True))
    except LimitReached as error:
        if error.stage != "classes":
            raise
    note = f"the simulation lemma with the errors of each of {reduction.partition.blocks:,} blocks"
    loss = max(optimum - lower, 0.0)
    return _approximation(reduction, errors, Certificate(lower, optimum, optimum, loss, None, 0.0, note))


def _approximation(reduction: ApproximateReduction, errors: Errors, found: Certificate) -> Approximation:
    discount = float(reduction.process.symbolic.model.discount)
    return Approximation(
        reduction.snapped.epsilon, found.lower, found.upper, found.optimum, found.loss,
        uniform_error(errors, discount), found.classes, found.collision_bound, found.note,
    )  # fmt: skip


def bounded_optimum(
    reduction: ApproximateReduction,
    *,
    steps: int = STEPS,
    class_limit: int = CLASS_LIMIT,
    seed: int = 0,
) -> float:
    """What no policy of the original process can exceed at b0, the state being seen.

    Raises:
        LimitReached: memory or time.
        ValueError: discount 1.
    """
    try:
        return bound_optimum(
            reduction.original, reduction.partition, steps=steps, class_limit=class_limit, seed=seed
        )
    except LimitReached as error:
        if error.stage != "classes":
            raise
        nothing = np.full(reduction.partition.blocks, -1, dtype=np.int64)
        errors = reduction.errors()
        return certify_by_errors(reduction.process, reduction.partition, nothing, errors).optimum
