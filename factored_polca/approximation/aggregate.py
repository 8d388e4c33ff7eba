"""Blocks of states whose values are near, found from the top: no finer partition is ever made.

Letters: P a partition that respects the masks, k its classes (`classes`), V the optimum of its aggregated
process, where a block does what its classes do on average, each by its number of states;

    Q_c(k) = R_c(k) + gamma sum_C T_c(k; C) V(C),    V(k) = max over c of Q_c(k).

Starting from the masks alone, blocks are split until the classes of each have near values, and a choice in
common that is near the best for all of them:

    max V(k) - min V(k) <= w,    some c:  Q_c(k) >= V(k) - w for all k of the block,    w = epsilon * span,

with span the largest difference of values V(k).  This is value iteration on diagrams whose leaves are
ranges (St-Aubin, Hoey & Boutilier 2000, APRICODD), the ranges being the states to be planned with.
States are merged as by Abel, Hershkowitz & Littman 2016, "Near optimal behavior via approximate state
abstraction". Choices that are not near the best may be worth anything: a good policy does not take them.
The process over blocks is no model of the dynamics but an approximation; what the policy that is found in
it is worth in the model itself is certified afterwards (`certificate`).

States that behave alike are never split, so there are at most as many blocks as exact minimisation finds.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.sparse import csr_array

from factored_polca.approximation.classes import Classes, find_classes
from factored_polca.diagrams import INDEX, pairs, relabel
from factored_polca.explicit.arrays import ArrayMDP, BoolArray, FloatArray, IntArray
from factored_polca.minimisation import DecisionProcess, Partition, partition_from
from factored_polca.minimisation.criterion import ProcessView
from factored_polca.solvers import solve_mdp
from factored_polca.symbolic import NumericView

PASSES: Final = 1_000
"""Passes after which splitting ends, blocks being as they are then."""

GAP: Final = 1e-7
"""Relative gap to which the aggregated process is solved between passes."""

ROUNDING: Final = 1e-9
"""Share of the span up to which values count as equal whatever epsilon is."""


@dataclass(frozen=True)
class Aggregation:
    """A partition, and its aggregated process."""

    partition: Partition
    mdp: ArrayMDP
    passes: int
    collision_bound: float
    seconds: float


def aggregate(
    process: DecisionProcess,
    epsilon: float,
    *,
    class_limit: int,
    seed: int = 0,
    deadline: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Aggregation:
    """Blocks of a fully observed process whose values are within `epsilon` of their span.

    Raises:
        LimitReached: more than `class_limit` classes, memory or time.
        ModelError: at discount 1, values that are not finite.
    """
    began = time.perf_counter()
    partition, chance, number = masks(process), 0.0, 0
    while True:
        classes = find_classes(process, partition, limit=class_limit, seed=seed + number)
        chance += classes.collision_bound
        number += 1
        if progress is not None:
            progress(number, partition.blocks)
        mdp = averaged(classes)
        solution = solve_mdp(mdp, epsilon=GAP, deadline=deadline)
        if solution.status == "interrupted":
            raise KeyboardInterrupt
        parts = near_parts(classes, solution.values, epsilon)
        if parts.max(initial=0) + 1 == partition.blocks or number == PASSES:
            return Aggregation(partition, mdp, number, chance, time.perf_counter() - began)
        partition = joined(classes, parts)


def masks(process: DecisionProcess) -> Partition:
    """The partition by the terminal set and by where each choice applies."""
    view = ProcessView(process, NumericView(process.symbolic))
    labels = process.terminal
    for choice in process.choices:
        labels, _, _ = pairs(labels, view.app(choice))
    return partition_from(process.symbolic, labels, process.reachable)


def averaged(classes: Classes) -> ArrayMDP:
    """The aggregated process: a block does what its classes do on average, each by its number of states."""
    counts = [classes.refined.sizes[i] for i in classes.order.tolist()]
    largest = max(counts)
    sizes = np.array([max(count / largest, 1e-12) for count in counts])  # counts may be beyond floats
    blocks = classes.partition.blocks
    weights = sizes / np.bincount(classes.block, sizes, blocks)[classes.block]
    mean = csr_array((weights, (classes.block, np.arange(classes.count))), shape=(blocks, classes.count))
    applicable = classes.applicable[:, classes.starts]
    rewards = np.zeros(applicable.shape)
    for row, gains in zip(rewards, classes.rewards, strict=True):  # equal ones stay what they are
        low = np.minimum.reduceat(gains, classes.starts)
        high = np.maximum.reduceat(gains, classes.starts)
        row[:] = np.clip(mean @ gains, low, high)
    return ArrayMDP(
        classes.process.names,
        tuple((mean @ matrix).tocsr() for matrix in classes.transitions),
        np.where(applicable, rewards, 0.0), applicable, classes.terminal,
        float(classes.process.symbolic.model.discount),
    )  # fmt: skip


def near_parts(classes: Classes, values: FloatArray, epsilon: float) -> IntArray:
    """Parts [class] of the blocks, numbered through, whose classes have near values and a near best choice.

    `values` [block] are the aggregated process's; classes are taken in ascending order of their own.
    """
    discount = float(classes.process.symbolic.model.discount)
    lost = np.isneginf(values)
    finite = np.where(lost, 0.0, values)
    q = np.full(classes.rewards.shape, -np.inf)
    for row, gains, matrix, applies in zip(
        q, classes.rewards, classes.transitions, classes.applicable, strict=True
    ):
        good = applies & ~((matrix @ lost.astype(np.float64)) > 0)
        row[good] = (gains + discount * (matrix @ finite))[good]
    terminal = classes.terminal[classes.block]
    best = np.where(terminal, 0.0, q.max(axis=0))
    seen = best[np.isfinite(best)]
    span = float(np.ptp(seen)) if len(seen) else 0.0
    width = epsilon * span + ROUNDING * float(np.abs(seen).max(initial=1.0))
    near = (q >= best - width) | terminal
    return _windows(classes.block, best, near, width)


def _windows(block: IntArray, best: FloatArray, near: BoolArray, width: float) -> IntArray:
    """Parts of blocks [class], each from the least value up as far as it goes."""
    parts = np.zeros(len(block), dtype=np.int64)
    number, current, low = -1, -1, 0.0
    common = np.zeros(len(near), dtype=np.bool_)
    for k in np.lexsort((best, block)).tolist():
        far = best[k] > low + width  # both may be -inf
        if block[k] != current or far or not (common & near[:, k]).any():
            number, current, low = number + 1, int(block[k]), float(best[k])
            common = near[:, k].copy()
        else:
            common &= near[:, k]
        parts[k] = number
    return parts


def joined(classes: Classes, parts: IntArray) -> Partition:
    """The partition whose blocks are parts [class], numbered through."""
    images = np.zeros(classes.count + 1, dtype=np.uint64)
    images[classes.order] = parts
    images[classes.count] = parts.max(initial=0) + 1
    labels = relabel(classes.refined.diagram, images, INDEX)
    return partition_from(classes.process.symbolic, labels, classes.process.reachable)
