"""The quotient of a process whose actions may be exchanged, and the way back to named actions.

In block C the actions of the quotient are the classes of equal signatures (`polynomial`) of the choices
applicable at its representative x_C, numbered by their first members; class k stands for that choice,

    T_k(C, C') = T(x_C, a, C')        R_k(C) = R(x_C, a),        a the first member of class k at x_C.

*The way back.*  A policy takes class k in C.  At a state x of C it takes the first applicable choice a with
sigma_a(x) = sigma_k(C): an equality of diagrams, tested in a field of its own with fresh draws.
"""

from __future__ import annotations

import random
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from factored_polca.diagrams import INDEX, Diagram, Field, choose, evaluate_states, random_prime, relabel
from factored_polca.explicit.arrays import ArrayMDP, FloatArray, IntArray
from factored_polca.minimisation.criterion import Choice, DecisionProcess, ProcessView, common_denominator
from factored_polca.minimisation.partition import Partition
from factored_polca.minimisation.polynomial import Polynomial, refuse_partial
from factored_polca.minimisation.quotient import (
    Quotient,
    feature_states,
    initial_distribution,
    make_quotient,
)
from factored_polca.symbolic import NumericView


@dataclass(frozen=True)
class InterchangeableQuotient:
    """An MDP over blocks whose actions are classes of equal signatures.

    `named` is the quotient whose actions are the choices, each as at the representatives.
    `first[k, b]` is the first choice of class k in block b, -1 where the block has fewer classes;
    `signatures` [choice] are diagrams of sigma_a, `residues[k, b]` the value that class k has in b.
    """

    process: DecisionProcess
    partition: Partition
    named: Quotient
    mdp: ArrayMDP
    first: IntArray
    signatures: tuple[Diagram, ...]
    residues: np.typing.NDArray[np.uint64]

    def project_initial(self) -> FloatArray:
        """b0 over blocks [block]."""
        return initial_distribution(self.partition)

    def lift_policy(self, policy: IntArray) -> Diagram:
        """A policy [block] -> class (-1: none) as a diagram of primitive action numbers.

        The leaf where there is no action is the number of the model's actions.
        """
        manager = self.process.symbolic.manager
        result = manager.constant(len(self.process.symbolic.actions))
        for choice, fits in reversed(self._fits(policy)):
            taken = choice.policy
            if taken is None:
                taken = manager.constant(choice.primitives[0])
            result = choose(fits, taken, result)
        return result

    def lift_choices(self, policy: IntArray) -> Diagram:
        """A policy [block] -> class as a diagram of choices; no choice is the number of choices."""
        manager = self.process.symbolic.manager
        fitting = self._fits(policy)
        result = manager.constant(len(fitting))
        for number, (_, fits) in reversed(list(enumerate(fitting))):
            result = choose(fits, manager.constant(number), result)
        return result

    def _fits(self, policy: IntArray) -> list[tuple[Choice, Diagram]]:
        """For each choice where it has the signature of the class that the policy takes."""
        blocks = np.arange(self.partition.blocks)
        defined = policy >= 0
        wanted = np.where(defined, self.residues[np.maximum(policy, 0), blocks], 0).astype(np.uint64)
        leaf_type = self.signatures[0].leaf_type
        target = relabel(self.partition.diagram, np.append(wanted, np.uint64(0)), leaf_type)
        has_one = relabel(self.partition.diagram, np.append(defined, False).astype(np.uint64), INDEX)
        return [
            (choice, has_one & choice.app & signature.equals(target))
            for choice, signature in zip(self.process.choices, self.signatures, strict=True)
        ]


def interchangeable_quotient(
    process: DecisionProcess, partition: Partition, *, seed: int = 0
) -> InterchangeableQuotient:
    """The quotient of `process` by a partition that was minimised with `interchangeable=True`.

    Raises:
        ModelError: a partially observed process.
    """
    refuse_partial(process)
    source = random.Random(seed)
    field, denominator = Field(random_prime(source)), common_denominator(process)
    while denominator % field.prime == 0:
        field = Field(random_prime(source))
    generator = np.random.default_rng(seed)
    view = ProcessView(process, NumericView(process.symbolic, field))
    polynomial = Polynomial(view, field, generator)
    value = relabel(partition.diagram, field.draw(generator, partition.blocks + 1), field)
    memo: dict[int, Diagram] = {}
    signatures = tuple(polynomial.signature(choice, value, memo) for choice in process.choices)
    states, columns = feature_states(partition), process.symbolic.columns()
    quotient = make_quotient(process, partition)
    named = quotient.mdp
    values = np.stack([evaluate_states(s, states, columns) for s in signatures]).astype(np.uint64)
    first, residues = _classes(values, named.applicable)
    return InterchangeableQuotient(
        process, partition, quotient, _exchanged(named, first), first, signatures, residues
    )


def _classes(
    values: np.typing.NDArray[np.uint64], applicable: np.typing.NDArray[np.bool_]
) -> tuple[IntArray, np.typing.NDArray[np.uint64]]:
    """The first choice and the signature of each class, [class, block], from those of choices."""
    blocks = values.shape[1]
    listed: list[dict[int, int]] = []
    for block in range(blocks):
        known: dict[int, int] = {}
        for choice in np.flatnonzero(applicable[:, block]).tolist():
            known.setdefault(int(values[choice, block]), choice)
        listed.append(known)
    count = max(1, *(len(known) for known in listed))
    first = np.full((count, blocks), -1, dtype=np.int64)
    residues = np.zeros((count, blocks), dtype=np.uint64)
    for block, known in enumerate(listed):
        for k, (value, choice) in enumerate(known.items()):
            first[k, block], residues[k, block] = choice, value
    return first, residues


def _exchanged(named: ArrayMDP, first: IntArray) -> ArrayMDP:
    """The MDP whose action k in block b is the named action `first[k, b]`."""
    count, blocks = first.shape
    stacked = sparse.vstack(named.transitions, format="csr")
    everywhere = np.arange(blocks)
    transitions = []
    for k in range(count):
        rows = np.maximum(first[k], 0) * blocks + everywhere
        keep = sparse.diags_array((first[k] >= 0).astype(np.float64), format="csr")
        matrix = sparse.csr_array(keep @ stacked[rows])
        matrix.eliminate_zeros()
        transitions.append(matrix)
    rewards = np.where(first >= 0, named.rewards[np.maximum(first, 0), everywhere[None, :]], 0.0)
    names = tuple(f"class {k}" for k in range(count))
    return ArrayMDP(names, tuple(transitions), rewards, first >= 0, named.terminal, named.discount)
