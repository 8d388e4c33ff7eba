"""A reduction and its way back.

`project` carries states and beliefs of the model to blocks; `lift` carries values and policies of
the quotient back to diagrams over states.  The lifted policy has, on the original model, the value
that it has on the quotient.

The quotient of a fully observed process is an MDP, that of a partially observed one a POMDP; there a map
block -> action is what a policy does where it is certain of the block.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from factored_polca.diagrams import FLOAT, INDEX, Diagram, at, choose, evaluate_states, relabel
from factored_polca.drawn import DrawnGraph, Framed
from factored_polca.explicit.arrays import ArrayMDP
from factored_polca.minimisation.criterion import DecisionProcess
from factored_polca.minimisation.interchangeable import InterchangeableQuotient, interchangeable_quotient
from factored_polca.minimisation.partition import Partition
from factored_polca.minimisation.pomdp_quotient import (
    MAXIMUM_OBSERVATIONS,
    PomdpQuotient,
    make_pomdp_quotient,
)
from factored_polca.minimisation.quotient import Quotient, initial_distribution, make_quotient
from factored_polca.minimisation.refine import Minimisation, Progress, minimise
from factored_polca.models import Value


@dataclass(frozen=True)
class Reduction(DrawnGraph, Framed):
    """A minimised decision process: the partition, the quotient, and how to get there and back."""

    minimisation: Minimisation
    quotient: Quotient | PomdpQuotient

    def __repr__(self) -> str:
        name, partition = self.process.symbolic.model.name, self.partition
        return f"<{type(self).__name__} of {name}: {partition.blocks:,} blocks>"

    @property
    def pomdp_quotient(self) -> PomdpQuotient:
        """The quotient of a partially observed process.

        Raises:
            TypeError: the process is fully observed.
        """
        if not isinstance(self.quotient, PomdpQuotient):
            raise TypeError("the process is fully observed; `quotient.mdp` is what it became")
        return self.quotient

    @property
    def mdp(self) -> ArrayMDP:
        """What is to be solved of a fully observed process.

        Raises:
            TypeError: the process is partially observed.
        """
        if isinstance(self.quotient, PomdpQuotient):
            raise TypeError("the process is partially observed; `pomdp_quotient` is what it became")
        return self.quotient.mdp

    @property
    def process(self) -> DecisionProcess:
        """What was minimised."""
        return self.minimisation.process

    @property
    def partition(self) -> Partition:
        """The blocks."""
        return self.minimisation.partition

    def block(self, state: Mapping[str, Value]) -> int | None:
        """The block of one state {feature: value}; None outside a restriction.

        Raises:
            KeyError: a feature without a value.
            ValueError: a value the feature does not have.
        """
        symbolic = self.process.symbolic
        levels: dict[int, int] = {}
        for number, feature in enumerate(symbolic.model.features):
            index = feature.index(state[feature.name])
            if index is None:
                listed = ", ".join(str(v) for v in feature.values[:12])
                raise ValueError(f"{feature.name} has no value {state[feature.name]!r}; it has {listed}")
            levels[symbolic.now(number)] = index
        found = int(at(self.partition.diagram, levels))
        return found if found < self.partition.blocks else None

    def project_states(self, states: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
        """The block of each state, value numbers [state, feature]."""
        symbolic = self.process.symbolic
        return evaluate_states(self.partition.diagram, states, symbolic.columns()).astype(np.int64)

    def project_initial(self) -> npt.NDArray[np.float64]:
        """b0 over blocks [block]."""
        return initial_distribution(self.partition)

    def project(self, belief: Sequence[tuple[npt.NDArray[Any], float]]) -> npt.NDArray[np.float64]:
        """A belief given as (state [feature], probability) pairs, over blocks [block]."""
        result = np.zeros(self.partition.blocks)
        states = np.array([state for state, _ in belief], dtype=np.int32)
        np.add.at(result, self.project_states(states), np.array([q for _, q in belief]))
        return result

    def lift_values(self, values: npt.NDArray[np.float64]) -> Diagram:
        """A function of blocks [block] as a float diagram over states; 0 outside a restriction."""
        padded = np.concatenate([values, [0.0]])
        return relabel(self.partition.diagram, padded, FLOAT)

    def lift_policy(self, policy: npt.NDArray[Any]) -> Diagram:
        """A policy [block] -> choice (-1: none) as a diagram of primitive action numbers.

        The leaf where there is no action is the number of the model's actions.
        """
        manager = self.process.symbolic.manager
        none = len(self.process.symbolic.actions)
        by_choice = self.lift_choices(policy)
        result = manager.constant(none)
        for number, choice in enumerate(self.process.choices):
            if not (policy == number).any():
                continue
            taken = by_choice.equals(manager.constant(number))
            primitive = choice.policy
            if primitive is None:
                primitive = manager.constant(choice.primitives[0])
            result = choose(taken, primitive, result)
        return result

    def lift_choices(self, policy: npt.NDArray[Any]) -> Diagram:
        """A policy [block] -> choice as an index diagram; no choice is the number of choices."""
        none = len(self.process.choices)
        images = np.where(policy < 0, none, policy).astype(np.uint64)
        return relabel(self.partition.diagram, np.append(images, np.uint64(none)), INDEX)


@dataclass(frozen=True, repr=False)
class InterchangeableReduction(Reduction):
    """A reduction by what actions do, whatever their names; a policy takes classes of equal signatures.

    The quotient is that of the named actions of representatives; `exchanged.mdp` is to be solved.
    """

    exchanged: InterchangeableQuotient

    @property
    def mdp(self) -> ArrayMDP:
        """The MDP whose actions are classes."""
        return self.exchanged.mdp

    def lift_policy(self, policy: npt.NDArray[Any]) -> Diagram:
        """A policy [block] -> class (-1: none) as a diagram of primitive action numbers."""
        return self.exchanged.lift_policy(policy)

    def lift_choices(self, policy: npt.NDArray[Any]) -> Diagram:
        """A policy [block] -> class as an index diagram; no choice is the number of choices."""
        return self.exchanged.lift_choices(policy)


def reduce(
    process: DecisionProcess,
    *,
    seed: int = 0,
    confirmations: int = 1,
    block_limit: int | None = None,
    progress: Progress | None = None,
    maximum_observations: int = MAXIMUM_OBSERVATIONS,
    interchangeable: bool = False,
) -> Reduction:
    """Minimise a decision process and build its quotient; see `minimise` and `make_pomdp_quotient`.

    With `interchangeable` the answer is an `InterchangeableReduction`.

    Raises:
        ModelError: interchangeable actions of a partially observed process.
        LimitReached: also where a choice of a partially observed process has more than
            `maximum_observations` joint observations.
    """
    found = minimise(
        process, seed=seed, confirmations=confirmations, block_limit=block_limit, progress=progress,
        interchangeable=interchangeable,
    )  # fmt: skip
    if interchangeable:
        exchanged = interchangeable_quotient(process, found.partition, seed=seed)
        return InterchangeableReduction(found, exchanged.named, exchanged)
    if process.partial:
        quotient = make_pomdp_quotient(
            process, found.partition, maximum_observations=maximum_observations, seed=seed
        )
        return Reduction(found, quotient)
    return Reduction(found, make_quotient(process, found.partition))
