"""What a policy planned in a snapped model is worth in the model itself, with certainty.

Letters: P the blocks planned with, pi the policy [block], k classes of the model's own behaviour within
blocks (`classes`), V^pi and V* the value of pi and the optimum in the model itself.

    lower <= V^pi(b0) <= upper,    V*(b0) <= optimum,    V*(b0) - V^pi(b0) <= loss

All come from bounds that are constant on blocks (`extremes`), and b0 is looked ahead of by one exact step.
The loss is the smaller of  optimum - lower  and of W(b0), which bounds the loss along the optimal policy
step by step (the performance difference lemma; Kakade & Langford 2002):

    V*(x) - V^pi(x) = sup over policies of the expected sum of gamma^t A(x_t, c_t),
    A(x, c) = Q^pi(x, c) - V^pi(x)  <=  A_c(k) = [R_c(k) + gamma T_c(k) U] - [R_pi(k) + gamma T_pi(k) L],

and A(x, pi(x)) = 0: where no other choice can be better than pi's, nothing is lost, however little is known
of the values themselves.

*Looking further.*  P may first be refined by some steps of the model's own dynamics: bounds are then
constant on smaller parts.  Each step multiplies the parts, and what is not known of the values shrinks.

*Too many classes.*  Then those of the snapped process take their place, and every reward may be wrong by

    r_c(C) + gamma d_c(C) span,

with r, d the largest errors in block C (`errors`) and span the largest difference of true values, first
(R_max - R_min) / (1 - gamma), then what the bounds themselves leave of it.  This is the simulation lemma
(`lemma`) with errors that depend on the state.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Final, Literal

import numpy as np

from factored_polca.approximation.classes import Classes, find_classes
from factored_polca.approximation.errors import Errors
from factored_polca.approximation.extremes import UNIT, Game, backups, extreme_values, game_of
from factored_polca.diagrams import evaluate_states
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray
from factored_polca.minimisation import DecisionProcess, Partition
from factored_polca.minimisation.quotient import feature_states
from factored_polca.models import LimitReached

CLASS_LIMIT: Final = 100_000
"""Classes of states beyond which those of the snapped process take their place."""

ANY_NUMBER: Final = 1 << 40

STEPS: Final = 8
"""Steps of the model's own dynamics that classes are told apart by, at most."""

FURTHER: Final = 20_000
"""Classes beyond which no further step is taken."""

NARROW: Final = 1e-3
"""Relative width of bounds that are narrow enough."""

TIGHTENINGS: Final = 3
"""How often the span of values is taken anew from the bounds that it led to."""


@dataclass(frozen=True)
class Certificate:
    """Bounds at the initial belief; see the module's docstring.

    `classes` is how many classes of states the bounds rest on, None where they rest on the errors of rows
    alone; `collision_bound` the chance that two classes were taken for one.
    """

    lower: float
    upper: float
    optimum: float
    loss: float
    classes: int | None
    collision_bound: float
    note: str


@dataclass(frozen=True)
class Evidence:
    """Classes, the policy on the blocks that they lead to, and by how much rewards may be wrong.

    With `errors` the classes are those of a snapped process: what rewards may be wrong by is added to them
    for upper bounds and taken off for lower ones.
    """

    classes: Classes
    policy: IntArray
    errors: Errors | None = None
    game: Game = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "game", game_of(self.classes))

    def slack(self, span: float) -> FloatArray:
        """By how much rewards [choice, class] may be wrong."""
        if self.errors is None:
            return np.zeros_like(self.classes.rewards)
        with np.errstate(invalid="ignore"):
            lost = self.game.discount * self.errors.rows * span
        return (self.errors.rewards + np.where(self.errors.rows > 0, lost, 0.0))[:, self.classes.block]

    @property
    def hides_dead_ends(self) -> bool:
        """Whether rows may be wrong, and so where they lead."""
        return self.errors is not None and bool(self.errors.rows.any())

    @property
    def chosen(self) -> BoolArray:
        """What the policy allows [choice, class]."""
        numbers = np.arange(len(self.classes.rewards))[:, None]
        allowed: BoolArray = numbers == self.policy[self.classes.block][None, :]
        return allowed & self.classes.applicable

    def values(
        self, allowed: BoolArray, side: Literal["upper", "lower"], span: float
    ) -> tuple[FloatArray, FloatArray]:
        """Bounds [block], and the rewards [choice, class] that they rest on."""
        sign = 1.0 if side == "upper" else -1.0
        rewards = self.classes.rewards + sign * self.slack(span)
        return extreme_values(self.game, rewards, allowed, side), rewards


def certify_policy(
    process: DecisionProcess,
    partition: Partition,
    policy: IntArray,
    *,
    steps: int = STEPS,
    class_limit: int = CLASS_LIMIT,
    seed: int = 0,
) -> Certificate:
    """Bounds on what `policy` [block] (a choice's number, -1 for none) is worth and loses in `process`.

    Args:
        process: of the unsnapped model, with the choices, masks and channels of the snapped one.
        partition: any that respects the masks.
        steps: by how many steps of the model's dynamics states of a block are told apart, from 1 on; fewer
            where the bounds are narrow before or there are more than `FURTHER` classes.

    Raises:
        LimitReached: more than `class_limit` classes, memory or time.
        ValueError: discount 1, where a contraction is missing.
    """
    best: Certificate | None = None
    for evidence in looking_further(process, partition, policy, steps, class_limit, seed):
        found = certificate_of(evidence)
        best = found if best is None else tightened(best, found)
        width = max(best.loss, best.upper - best.lower)
        if width <= NARROW * max(1.0, abs(best.lower)):
            break
    assert best is not None
    return best


def tightened(before: Certificate, after: Certificate) -> Certificate:
    """What two certificates know together."""
    lower, upper = max(before.lower, after.lower), min(before.upper, after.upper)
    return replace(
        after, lower=lower, upper=upper, optimum=min(before.optimum, after.optimum),
        loss=min(before.loss, after.loss), collision_bound=before.collision_bound + after.collision_bound,
    )  # fmt: skip


def certify_by_errors(
    snapped: DecisionProcess, partition: Partition, policy: IntArray, errors: Errors
) -> Certificate:
    """The same from the classes of the snapped process, and the errors of rows and rewards in each block.

    Raises:
        LimitReached: memory or time.
        ValueError: discount 1.
    """
    (evidence,) = looking_further(snapped, partition, policy, 1, ANY_NUMBER, 0)
    return certificate_of(replace(evidence, errors=errors))


def looking_further(
    process: DecisionProcess,
    partition: Partition,
    policy: IntArray,
    steps: int,
    class_limit: int,
    seed: int,
) -> Iterator[Evidence]:
    """The classes after one step of the process's dynamics, after two, and so on.

    Raises:
        LimitReached: after one step already; further steps are left out where they take too much.
        ValueError: discount 1.
    """
    if not process.symbolic.model.discount < 1:
        raise ValueError("bounds on the loss need a discount below 1")
    found, chosen = find_classes(process, partition, limit=class_limit, seed=seed), policy
    yield Evidence(found, chosen)
    for number in range(1, steps):
        if found.count == found.partition.blocks or found.count > FURTHER:
            return
        try:
            after = find_classes(process, found.refined, limit=class_limit, seed=seed + number)
        except LimitReached:
            return
        states = feature_states(found.refined)
        before = evaluate_states(found.partition.diagram, states, process.symbolic.columns())
        chosen, found = chosen[before.astype(np.int64)], after
        yield Evidence(found, chosen)


def certificate_of(evidence: Evidence) -> Certificate:
    """The bounds of the module's docstring."""
    classes, chosen = evidence.classes, evidence.chosen
    span = 0.0
    if evidence.errors is not None:
        span = evidence.errors.reward_span / (1 - evidence.game.discount)
    for number in range(1 if evidence.errors is None else TIGHTENINGS):
        below, low_rewards = evidence.values(chosen, "lower", span)
        above, high_rewards = evidence.values(chosen, "upper", span)
        best, best_rewards = evidence.values(classes.applicable, "upper", span)
        dead = evidence.hides_dead_ends and not bool(np.isfinite(np.append(below, best)).all())
        if dead or number == TIGHTENINGS - 1:
            break
        span = min(span, float(finite(best).max(initial=0.0) - finite(below).min(initial=0.0)))
    # a row that is wrong may hide that it leads to a dead end
    lower = -np.inf if dead else at_start(evidence, low_rewards, chosen, below, "lower")
    upper = at_start(evidence, high_rewards, chosen, above, "upper")
    optimum = max(at_start(evidence, best_rewards, classes.applicable, best, "upper"), lower)
    loss = np.inf
    if np.isfinite(lower):
        loss = optimum - lower
        if evidence.errors is None:
            loss = min(loss, _loss(evidence, below, above))
    count = None if evidence.errors is not None else classes.count
    return Certificate(
        lower, upper, optimum, max(loss, 0.0), count, classes.collision_bound, _note(evidence)
    )


def _note(evidence: Evidence) -> str:
    blocks, classes = evidence.classes.partition.blocks, evidence.classes.count
    if evidence.errors is None:
        return f"bounds constant on {blocks:,} blocks, with {classes:,} classes of states"
    return (
        f"the simulation lemma with the errors of each of {blocks:,} blocks: telling states apart in the "
        "model itself takes too much"
    )


def _loss(evidence: Evidence, below: FloatArray, above: FloatArray) -> float:
    """W(b0), from bounds [block] on the policy's value."""
    game, classes, chosen = evidence.game, evidence.classes, evidence.chosen
    low = backups(game, classes.rewards, chosen, below).max(axis=0)
    high = backups(game, classes.rewards, classes.applicable, above)
    with np.errstate(invalid="ignore"):
        gains = np.where(chosen, 0.0, np.where(np.isneginf(high), -np.inf, high - low[None, :]))
    if np.isposinf(gains).any() or np.isnan(gains).any():
        return np.inf
    allowed = classes.applicable & (chosen | np.isfinite(gains))
    error = game.rounding(classes.rewards, finite(above)) + game.rounding(classes.rewards, finite(below))
    gains = np.where(allowed & ~chosen, gains + error, 0.0)
    losses = extreme_values(game, gains, allowed, "upper")
    return at_start(evidence, gains, allowed, losses, "upper")


def at_start(
    evidence: Evidence, rewards: FloatArray, allowed: BoolArray, values: FloatArray, side: str
) -> float:
    """A bound at b0 from values [block] looked ahead of by one step, moved outwards by its rounding."""
    game, classes = evidence.game, evidence.classes
    q = backups(game, rewards, allowed, values).max(axis=0)
    belief = classes.initial
    here = belief > 0
    at_classes = np.where(game.terminal[classes.block], 0.0, q)
    total = float(belief[here] @ at_classes[here])
    if not np.isfinite(total):
        return total
    size = float(np.abs(at_classes[here]).max(initial=0.0))
    miss = abs(float(belief.sum()) - 1) + (len(belief) + 4 * game.features + 64) * UNIT
    error = game.rounding(np.where(allowed, rewards, 0.0), finite(values)) + miss * size
    return total + error if side == "upper" else total - error


def finite(values: FloatArray) -> FloatArray:
    """Values with 0 for what is not finite."""
    return np.where(np.isfinite(values), values, 0.0)


def bound_optimum(
    process: DecisionProcess,
    partition: Partition,
    *,
    steps: int = STEPS,
    class_limit: int = CLASS_LIMIT,
    seed: int = 0,
    worst: bool = False,
) -> float:
    """An upper bound on the best value at b0 of `process`, from any partition that respects its masks.

    With `worst` a lower bound on what the worst policy earns.

    Raises:
        LimitReached, ValueError: see `certify_policy`.
    """
    nothing = np.full(partition.blocks, -1, dtype=np.int64)
    sign, found = -1.0 if worst else 1.0, np.inf
    for evidence in looking_further(process, partition, nothing, steps, class_limit, seed):
        classes = evidence.classes
        rewards = sign * classes.rewards
        best = extreme_values(evidence.game, rewards, classes.applicable, "upper")
        before, new = found, at_start(evidence, rewards, classes.applicable, best, "upper")
        found = min(before, new)
        if before - found <= NARROW * max(1.0, abs(found)):
            break
    return sign * found
