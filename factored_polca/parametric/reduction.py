"""Minimise a process with parameters once, and build the quotient whose rows are functions of them."""

from __future__ import annotations

import random
from dataclasses import dataclass

import numpy as np

from factored_polca.diagrams import evaluate_states
from factored_polca.minimisation import DecisionProcess, Minimisation, minimise
from factored_polca.minimisation.criterion import Choice
from factored_polca.minimisation.pomdp_quotient import seen_of_blocks
from factored_polca.minimisation.push import Int32Array, make_plan
from factored_polca.minimisation.quotient import distinct_rewards, feature_states, primitives_at
from factored_polca.minimisation.refine import Progress
from factored_polca.models import Fault, ModelError
from factored_polca.parametric.observations import JointKernel, joint_kernel, prepare_choice
from factored_polca.parametric.process import ParametricProcess
from factored_polca.parametric.program import ProgramBuilder, Unlucky
from factored_polca.parametric.push import push_all_registers, register_table
from factored_polca.parametric.quotient import ParametricQuotient, register_matrix
from factored_polca.parametric.substitution import used_primitives


def reduce_parametric(
    process: ParametricProcess,
    *,
    seed: int = 0,
    confirmations: int = 1,
    block_limit: int | None = None,
    progress: Progress | None = None,
) -> ParametricQuotient:
    """Minimise once, for all settings of the parameters; see `minimise` for the arguments.

    Raises:
        LimitReached: blocks, memory, time, observations, or operations of the rows.
        ModelError: an action of a partially observed process that does not apply everywhere.
    """
    found = minimise(
        process.process,
        seed=seed,
        confirmations=confirmations,
        block_limit=block_limit,
        progress=progress,
    )
    return make_parametric_quotient(process, found, seed=seed)


def make_parametric_quotient(
    process: ParametricProcess, found: Minimisation, *, seed: int = 0
) -> ParametricQuotient:
    """The quotient of a process with parameters by a stable partition of it.

    Raises:
        LimitReached: observations, or operations of the rows.
        ModelError: an action of a partially observed process that does not apply everywhere.
    """
    source = random.Random(seed)
    while True:
        try:
            return _Build(process, found, ProgramBuilder(process.field, source)).finish()
        except Unlucky:
            continue


@dataclass
class _Build:
    """The working state of building a quotient."""

    open: ParametricProcess
    found: Minimisation
    builder: ProgramBuilder

    @property
    def process(self) -> DecisionProcess:
        return self.open.process

    def finish(self) -> ParametricQuotient:
        process, partition, builder = self.process, self.found.partition, self.builder
        symbolic = process.symbolic
        states, columns = feature_states(partition), symbolic.columns()
        terminal = evaluate_states(process.terminal, states, columns).astype(np.bool_)
        primitive = np.stack([primitives_at(choice, states, columns) for choice in process.choices])
        if process.partial:
            self.refuse_partial(primitive, terminal)
        tables = {
            p: register_table(symbolic, symbolic.actions[p].rows, builder) for p in used_primitives(process)
        }
        first = register_table(symbolic, symbolic.initial, builder)
        rewards = np.full(primitive.shape, builder.zero, dtype=np.int64)
        for c, choice in enumerate(process.choices):
            here = np.flatnonzero(primitive[c] >= 0)
            sums, place = distinct_rewards(process, choice.primitives[0], states[here])
            rewards[c, here] = np.array([builder.number(value) for value in sums], dtype=np.int64)[place]
        prepared = [
            prepare_choice(process, partition, choice, taken, builder)
            for choice, taken in zip(process.choices, primitive, strict=True)
        ]
        conditions = [builder.number(condition.function) for condition in self.open.conditions]
        builder.finish_numbers()
        kernels: list[JointKernel] = []
        for choice, taken, ready in zip(process.choices, primitive, prepared, strict=True):
            p = choice.primitives[0]
            rows = symbolic.actions[p].rows
            here = np.flatnonzero(taken >= 0)
            plan = make_plan(symbolic, ready.diagram, rows)
            masses = push_all_registers(symbolic, plan, tables[p], rows, states[here], builder)
            kernels.append(joint_kernel(partition, ready, here, states[here], masses, builder))
        nowhere = np.zeros((1, len(symbolic.model.features)), dtype=np.int32)
        plan = make_plan(symbolic, partition.diagram, symbolic.initial)
        (start,) = push_all_registers(symbolic, plan, first, symbolic.initial, nowhere, builder)
        return ParametricQuotient(
            process=self.open,
            minimisation=self.found,
            program=builder.finish(),
            kernel=tuple(
                tuple(register_matrix(rows, partition.blocks) for rows in kernel.rows) for kernel in kernels
            ),
            rewards=rewards,
            initial=np.array([start.get(b, builder.zero) for b in range(partition.blocks)], dtype=np.int64),
            primitive=primitive,
            terminal=terminal,
            observed=seen_of_blocks(symbolic, states),
            observations=tuple(kernel.labels for kernel in kernels),
            conditions=np.array(conditions, dtype=np.int64),
            bounded=np.array([c.kind == "probability" for c in self.open.conditions], dtype=np.bool_),
        )

    def refuse_partial(
        self, primitive: Int32Array, terminal: np.ndarray[tuple[int], np.dtype[np.bool_]]
    ) -> None:
        """Under partial observability actions apply everywhere."""
        for choice, taken in zip(self.process.choices, primitive, strict=True):
            missing = np.flatnonzero((taken < 0) & ~terminal)
            if len(missing):
                raise ModelError([_partial(self.found, choice, int(missing[0]))])


def _partial(found: Minimisation, choice: Choice, block: int) -> Fault:
    partition = found.partition
    state = partition.symbolic.state_text(partition.representatives[block].tolist())
    return Fault(
        f"{choice.name!r} does not apply at {state}",
        ("actions", choice.name, "applicable"),
        "in a POMDP actions apply everywhere: state what happens where it has no effect",
    )


__all__ = ["make_parametric_quotient", "reduce_parametric"]
