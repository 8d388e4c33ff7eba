"""The quotient of a partially observed process: its joint kernel over blocks.

    K_c(C; C', o) = sum over x' in C' of T(x_C, p, x') P_p(o | x', x_C),      R_c(C) = R(x_C, p),

with x_C the representative of block C and p the primitive that choice c stands for there (Pineau, Gordon &
Thrun 2003, Eqs. 10-13).  Within a block Eq. 13 does not make P(o | x') a function of the block, so the
joint kernel is kept.  Terminal blocks have no successor and the reward 0.

Observations are merged without loss, for each choice on its own (`choice_kernel`); `observation_of` gives
the merged number of what was really observed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np

from factored_polca.diagrams import evaluate_states
from factored_polca.drawn import DrawnGraph, Framed
from factored_polca.explicit.arrays import ArrayMDP, BoolArray
from factored_polca.explicit.belief import ImpossibleObservation
from factored_polca.explicit.pomdp_arrays import ArrayPOMDP
from factored_polca.minimisation.choice_kernel import ChoiceKernel, KernelBuilder
from factored_polca.minimisation.criterion import Choice, DecisionProcess
from factored_polca.minimisation.joint_columns import Limits
from factored_polca.minimisation.observations import count_before
from factored_polca.minimisation.partition import Partition
from factored_polca.minimisation.push import FloatArray, Int32Array, Int64Array
from factored_polca.minimisation.quotient import (
    block_texts,
    distinct_rewards,
    exact_rewards,
    feature_states,
    initial_distribution,
    primitives_at,
)
from factored_polca.models import Fault, ModelError, Value
from factored_polca.models.features import position
from factored_polca.models.scalars import describe, scalar
from factored_polca.symbolic import SymbolicModel
from factored_polca.symbolic.floats import as_float

MAXIMUM_OBSERVATIONS: Final = 1_000
"""Largest number of joint observations of one choice, proportional columns not merged yet."""

MAXIMUM_ENTRIES: Final = 20_000_000
"""Largest number of entries (C, C', o) of all choices together."""


@dataclass(frozen=True)
class PomdpQuotient(DrawnGraph, Framed):
    """A POMDP over blocks, and what its exact rows are made from.

    `primitive[c, b]` is the primitive that choice c stands for in block b, -1 where b is terminal.
    `observations_before[c]` is the product of the numbers of values of the channels that the choice's
    primitives sense, `observations_after[c]` the number of observations left.
    """

    process: DecisionProcess
    partition: Partition
    pomdp: ArrayPOMDP
    primitive: Int32Array  # [choice, block]
    kernels: tuple[ChoiceKernel, ...] = field(repr=False)  # [choice]

    @property
    def observations_before(self) -> tuple[int, ...]:
        """Joint observations of each choice before merging."""
        return tuple(count_before(found.observations.channels) for found in self.kernels)

    @property
    def observations_after(self) -> tuple[int, ...]:
        """Observations of each choice that are left."""
        return tuple(len(labels) for labels in self.pomdp.observations)

    @cached_property
    def mdp(self) -> ArrayMDP:
        """The same blocks with the state seen."""
        return self.pomdp.to_mdp()

    def observation_of(self, choice: int, values: Mapping[str, Value]) -> int:
        """The merged number of a joint observation {channel: value} after a choice.

        Channels that the choice never senses may be left out.

        Raises:
            KeyError: a channel without a value.
            ValueError: a value that the channel does not have.
            ImpossibleObservation: it never occurs after this choice.
        """
        merging, name = self.kernels[choice].observations, self.process.names[choice]
        digits = {}
        for merged in merging.channels:
            channel = merged.definition
            if channel.name not in values:
                if merged.sensed:
                    raise KeyError(f"no value of {channel.name!r}, which {name!r} senses")
                continue
            value = values[channel.name]
            index = position(channel.values, value)
            if index is None:
                listed = ", ".join(describe(scalar(v)) for v in channel.values[:12])
                raise ValueError(f"{channel.name} has no value {value!r}; it has {listed}")
            if merged.image[index] < 0:
                raise ImpossibleObservation(
                    f"{channel.name}={describe(scalar(value))} never occurs after {name!r}"
                )
            digits[merged.channel] = merged.image[index]
        key = tuple(digits.get(merged.channel, 0) for merged in merging.left)
        if key not in merging.numbers:
            shown = ", ".join(merged.label(v) for merged, v in zip(merging.left, key, strict=True))
            raise ImpossibleObservation(f"{shown} never occurs after {name!r}")
        return merging.numbers[key]

    def exact_row(self, choice: int, block: int) -> dict[tuple[int, int], Fraction]:
        """The exact probability of each (next block, observation); empty for a terminal block."""
        primitive = int(self.primitive[choice, block])
        if primitive < 0:
            return {}
        state = feature_states(self.partition)[block : block + 1]
        return self.kernels[choice].exact_row(self.process.symbolic, primitive, state)

    def exact_reward(self, choice: int, block: int) -> Fraction:
        """The exact reward; 0 for a terminal block."""
        primitive = int(self.primitive[choice, block])
        if primitive < 0:
            return Fraction(0)
        state = feature_states(self.partition)[block : block + 1]
        return exact_rewards(self.process, primitive, state)[0]

    def to_arrays(self, *, dense: bool = False) -> dict[str, Any]:
        """The quotient as plain arrays by name; see `factored_polca.formats.array_fields`."""
        from factored_polca.formats.array_fields import pomdp_fields

        return pomdp_fields(self.pomdp, dense=dense)

    def to_npz(self, path: str | Path) -> None:
        """Write the arrays to a file in numpy's format .npz; it appears whole or not at all.

        Raises:
            ModelError: the file can't be written.
        """
        from factored_polca.formats.array_fields import pomdp_fields, write_npz

        write_npz(pomdp_fields(self.pomdp), path)

    def to_pomdp(self, path: str | Path, *, first_step: bool = False) -> None:
        """Write the quotient as a file in Cassandra's format; it appears whole or not at all.

        With `first_step` it begins a step earlier, which shows what is seen of the state at the start;
        all values there are then multiplied by the discount.

        Raises:
            ModelError: the format can't express it, or the file can't be written.
        """
        from factored_polca.formats.files import write_text

        write_text(path, lambda: self.to_pomdp_text(first_step=first_step))

    def to_pomdpx(self, path: str | Path, *, first_step: bool = False) -> None:
        """Write the quotient as a POMDPX file with one variable, the block; it appears whole or not at all.

        `first_step` is that of `to_pomdp`.

        Raises:
            ModelError: the format can't express it, or the file can't be written.
        """
        from factored_polca.formats.files import write_text

        write_text(path, lambda: self.to_pomdpx_text(first_step=first_step))

    def to_pomdpx_text(self, *, first_step: bool = False) -> str:
        """The text that `to_pomdpx` writes.

        Raises:
            ModelError: the format can't express it.
        """
        from factored_polca.formats.cassandra import read_pomdp
        from factored_polca.formats.pomdpx import write_pomdpx

        text = self.to_pomdp_text(first_step=first_step)
        return write_pomdpx(read_pomdp(text, self.process.symbolic.model.name))

    def to_pomdp_text(self, *, first_step: bool = False) -> str:
        """The text that `to_pomdp` writes.

        Raises:
            ModelError: the format can't express it.
        """
        from factored_polca.formats.cassandra import write_pomdp

        name, texts = self.process.symbolic.model.name, block_texts(self.partition)
        return write_pomdp(self.pomdp, name, texts, first_step=first_step)


def make_pomdp_quotient(
    process: DecisionProcess,
    partition: Partition,
    *,
    maximum_observations: int = MAXIMUM_OBSERVATIONS,
    maximum_entries: int = MAXIMUM_ENTRIES,
    seed: int = 0,
) -> PomdpQuotient:
    """The quotient of a partially observed process by a stable partition of it.

    Args:
        maximum_observations: joint observations that a choice may have, before joint columns are merged.
        maximum_entries: entries (C, C', o) of all choices together.
        seed: of the draws by which proportional joint columns are found.

    Raises:
        LimitReached: more than allowed; the message names the channels to blame.
        ModelError: a choice that does not apply at a state that is not terminal.
    """
    symbolic, states = process.symbolic, feature_states(partition)
    terminal = evaluate_states(process.terminal, states, symbolic.columns()).astype(np.bool_)
    primitive = np.stack([_primitives(choice, partition, states, terminal) for choice in process.choices])
    builder = KernelBuilder(process, partition, Limits(maximum_observations, maximum_entries), seed)
    kernels = tuple(map(builder.build, process.choices, primitive))
    pomdp = ArrayPOMDP(
        actions=process.names,
        observations=tuple(found.observations.labels for found in kernels),
        kernel=tuple(found.matrices for found in kernels),
        rewards=np.stack([_rewards(process, taken, states) for taken in primitive]),
        terminal=terminal,
        observed=seen_of_blocks(symbolic, states),
        initial=initial_distribution(partition),
        discount=float(symbolic.model.discount),
    )
    return PomdpQuotient(process, partition, pomdp, primitive, kernels)


def _primitives(
    choice: Choice, partition: Partition, states: Int32Array, terminal: BoolArray
) -> Int32Array:
    """The primitive of a choice in each block, -1 at terminal ones."""
    symbolic = partition.symbolic
    taken = primitives_at(choice, states, symbolic.columns())
    missing = np.flatnonzero((taken < 0) & ~terminal)
    if len(missing):
        state = symbolic.state_text(partition.representatives[missing[0]].tolist())
        fault = Fault(
            f"{choice.name!r} does not apply at {state}",
            ("actions", choice.name, "applicable"),
            "in a POMDP actions apply everywhere: state what happens where it has no effect",
        )
        raise ModelError([fault])
    return taken


def _rewards(process: DecisionProcess, taken: Int32Array, states: Int32Array) -> FloatArray:
    """The reward of a choice in each block, which stands for primitive `taken` [block]."""
    result = np.zeros(len(taken))
    for p in sorted({*taken.tolist()} - {-1}):
        mine = np.flatnonzero(taken == p)
        sums, place = distinct_rewards(process, p, states[mine])
        name = process.symbolic.actions[p].name
        result[mine] = np.array([as_float(value, name) for value in sums])[place]
    return result


def seen_of_blocks(symbolic: SymbolicModel, states: Int32Array) -> Int64Array:
    """What is seen of each block, from 0: the values of the observed features."""
    seen = [i for i, feature in enumerate(symbolic.model.features) if feature.observed]
    _, numbers = np.unique(states[:, seen], axis=0, return_inverse=True)
    return numbers.reshape(-1).astype(np.int64)
