"""How many Q-values a subtask needs: the counts of the paper's Figure 4c.

    q_values          blocks times actions
    q_applicable      the pairs (block, action) where the action is applicable, at non-terminal blocks
    q_classes         classes of such pairs of one action with the same reward and the same row over
                      blocks, summed over the actions
    q_classes_shared  classes of such pairs of any actions of the subtask

Two pairs in one class have the same Q-value whatever the values of the blocks.  Rows are compared
by the fingerprint sum_k r_k T(x, k) in GF(p) with p and r drawn at random, never by floats.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from factored_polca.diagrams import Diagram, Field, evaluate_states, random_prime, relabel
from factored_polca.minimisation import Partition
from factored_polca.minimisation.criterion import DecisionProcess, ProcessView
from factored_polca.minimisation.interchangeable import InterchangeableQuotient
from factored_polca.minimisation.quotient import feature_states
from factored_polca.symbolic import NumericView


@dataclass(frozen=True)
class QValueCounts:
    """The counts of the module's docstring."""

    q_values: int
    q_applicable: int
    q_classes: int
    q_classes_shared: int


class Counted(Protocol):
    """A solved task; None where it was solved without blocks."""

    @property
    def counts(self) -> QValueCounts | None:
        """The counts of the task."""


def total_counts(solved: Mapping[str, Counted] | Sequence[Counted]) -> QValueCounts:
    """The counts of all subtasks together that were solved over blocks."""
    tasks = list(solved.values()) if isinstance(solved, Mapping) else list(solved)
    counts = [task.counts for task in tasks if task.counts is not None]
    return QValueCounts(
        sum(count.q_values for count in counts),
        sum(count.q_applicable for count in counts),
        sum(count.q_classes for count in counts),
        sum(count.q_classes_shared for count in counts),
    )


def count_q_values(process: DecisionProcess, partition: Partition, seed: int = 0) -> QValueCounts:
    """Count the Q-values of a stable partition of `process`."""
    symbolic = process.symbolic
    generator = random.Random(seed)
    field = Field(random_prime(generator))
    view = ProcessView(process, NumericView(symbolic, field))
    elements = field.draw(np.random.default_rng(seed), partition.blocks + 1)
    value = relabel(partition.diagram, elements, field)
    states, columns = feature_states(partition), symbolic.columns()
    memo: dict[int, Diagram] = {}
    total = by_action = 0
    shared: set[tuple[int, int]] = set()
    for choice in process.choices:
        app = evaluate_states(view.app(choice), states, columns).astype(bool)
        rows = evaluate_states(view.regress(choice, value, memo), states, columns)
        gains = evaluate_states(view.reward(choice), states, columns)
        classes = set(zip(rows[app].tolist(), gains[app].tolist(), strict=True))
        total += int(app.sum())
        by_action += len(classes)
        shared |= classes
    return QValueCounts(partition.blocks * len(process.choices), total, by_action, len(shared))


def count_exchanged(quotient: InterchangeableQuotient) -> QValueCounts:
    """Count the Q-values of a quotient whose actions are classes: a pair for each class of each block.

    Blocks times the classes of the block that has most; pairs of equal signatures are one class.
    """
    there = quotient.first >= 0
    classes, blocks = there.shape
    by_class = sum(len(set(r[t].tolist())) for r, t in zip(quotient.residues, there, strict=True))
    shared = len(set(quotient.residues[there].tolist()))
    return QValueCounts(classes * blocks, int(there.sum()), by_class, shared)
