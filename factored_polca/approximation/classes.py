"""Classes: what the states of one block may do in the unsnapped model, as arrays.

P is any partition of a fully observed process that respects its masks (the terminal set and where each
choice applies), such as the one that is stable for the snapped process.  Two states of a block are in one
*class* where each choice earns the same in both and sends the same probability to each block of P:

    R_c(k),    T_c(k; C) = sum over x' in C of T_c(x, x')    for any state x of class k.

Classes are the next partition of Dean & Givan's refinement, started from P, and are found like it: f_c(x) =
sum_C r_C T_c(x, C) in GF(p) with r and p drawn at random tells rows apart.  Two rounds with primes of their
own are run, so that of K classes two that differ are taken for one with a chance below

    K^2 / 2 (B / 60 / 2.7e16 + 2 / 2^60)^2        (B as in `factored_polca.minimisation.refine`).

A partition that only a policy is planned on, and no bound rests on, is found with one round.

A block with its classes is what Givan, Leach & Dean 2000 ("Bounded-parameter Markov decision processes")
bound by intervals; the classes are the exact set of rows that occur.
"""

from __future__ import annotations

import random
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from factored_polca.diagrams import (
    Aborted,
    Diagram,
    Field,
    MemoryLimit,
    evaluate_states,
    pairs,
    random_prime,
    relabel,
)
from factored_polca.explicit.arrays import BoolArray, FloatArray, IntArray, SparseMatrix
from factored_polca.minimisation import DecisionProcess, Partition, make_quotient, partition_from
from factored_polca.minimisation.collision import PRIMES_IN_RANGE, difference_bits
from factored_polca.minimisation.criterion import ProcessView, common_denominator
from factored_polca.minimisation.quotient import feature_states
from factored_polca.models import LimitReached
from factored_polca.symbolic import NumericView

ROUNDS = 2
"""Rounds with a prime of their own, where bounds rest on them."""


@dataclass(frozen=True)
class Classes:
    """The classes of a partition; they are sorted by their block.

    `partition` is what rows lead to, `refined` has the classes as its blocks (in an order of its own:
    class i is its block `order[i]`).  `collision_bound` bounds the chance that two classes that differ
    were taken for one.
    """

    process: DecisionProcess
    partition: Partition
    refined: Partition
    order: IntArray  # [class]
    block: IntArray  # [class], ascending
    rewards: FloatArray  # [choice, class]
    transitions: tuple[SparseMatrix, ...]  # [choice] CSR [class, block]
    applicable: BoolArray  # [choice, class]
    terminal: BoolArray  # [block]
    collision_bound: float

    @property
    def count(self) -> int:
        """K, the number of classes."""
        return len(self.block)

    @property
    def starts(self) -> IntArray:
        """The first class of each block [block]."""
        return np.searchsorted(self.block, np.arange(self.partition.blocks))

    @property
    def initial(self) -> FloatArray:
        """b0 over classes [class]."""
        from factored_polca.minimisation.quotient import initial_distribution

        return initial_distribution(self.refined)[self.order]


def refine_once(
    process: DecisionProcess, partition: Partition, *, limit: int, seed: int = 0, rounds: int = ROUNDS
) -> Partition:
    """The states of each block told apart by what each choice earns and where it leads, among blocks.

    Raises:
        LimitReached: more than `limit` parts or no memory left (stage "classes"), or no time.
    """
    randoms, generator = random.Random(seed), np.random.default_rng(seed)
    denominator = common_denominator(process)
    labels = partition.diagram
    try:
        for number in range(rounds):
            prime = random_prime(randoms)
            while denominator % prime == 0:
                prime = random_prime(randoms)
            field = Field(prime)
            view = ProcessView(process, NumericView(process.symbolic, field))
            value = relabel(partition.diagram, field.draw(generator, partition.blocks + 1), field)
            memo: dict[int, Diagram] = {}
            if number == 0:
                labels = _split(labels, process.terminal, limit)
                for choice in process.choices:
                    labels = _split(labels, view.app(choice), limit)
            for choice in process.choices:
                labels = _split(labels, view.reward(choice), limit)
                labels = _split(labels, view.regress(choice, value, memo), limit)
    except MemoryLimit as error:
        raise LimitReached(f"telling the states of blocks apart: {error}", "classes") from None
    except Aborted as error:
        raise LimitReached(f"telling the states of blocks apart: {error}", "minimisation") from None
    return partition_from(process.symbolic, labels, process.reachable)


def _split(labels: Diagram, by: Diagram, limit: int) -> Diagram:
    if by.is_constant:
        return labels
    numbered, first, _ = pairs(labels, by)
    if len(first) > limit + 1:
        raise LimitReached(f"more than {limit:,} classes of states in the unsnapped model", "classes")
    return numbered


def find_classes(
    process: DecisionProcess, partition: Partition, *, limit: int, seed: int = 0, rounds: int = ROUNDS
) -> Classes:
    """The classes of `partition` under `process`, both over the unsnapped model.

    Raises:
        LimitReached: more than `limit` classes, memory or time.
    """
    refined = refine_once(process, partition, limit=limit, seed=seed, rounds=rounds)
    quotient = make_quotient(process, refined)
    states, columns = feature_states(refined), process.symbolic.columns()
    block = evaluate_states(partition.diagram, states, columns).astype(np.int64)
    order = np.argsort(block, kind="stable")
    member = csr_array(
        (np.ones(len(block)), block, np.arange(len(block) + 1)), shape=(len(block), partition.blocks)
    )
    transitions = tuple((matrix[order] @ member).tocsr() for matrix in quotient.mdp.transitions)
    terminal: npt.NDArray[np.bool_] = np.zeros(partition.blocks, dtype=np.bool_)
    terminal[block] = quotient.mdp.terminal
    one = difference_bits(process) / 60 / PRIMES_IN_RANGE + 2 / 2**60
    return Classes(
        process, partition, refined, order, block[order], quotient.mdp.rewards[:, order], transitions,
        quotient.mdp.applicable[:, order], terminal, len(block) ** 2 / 2 * one**rounds,
    )  # fmt: skip
