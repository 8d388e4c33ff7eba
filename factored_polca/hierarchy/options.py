"""How to plan a hierarchy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from factored_polca.minimisation.pomdp_quotient import MAXIMUM_OBSERVATIONS
from factored_polca.solvers.protocol import MdpSolver, PomdpSolver

FLAT_BLOCK_LIMIT: Final = 100_000
"""Blocks up to which something flat is computed beside the hierarchical policy."""

STRUCTURED_BLOCKS: Final = 250_000
"""Blocks up to which a task whose state is seen is solved over blocks."""

SYMBOLIC_BLOCKS: Final = 10_000
"""Blocks up to which a task whose state is not seen is solved over blocks."""

TRIALS: Final = 100
"""Trials of the search that solves a task whose state is not seen, at most."""


@dataclass(frozen=True)
class Options:
    """How to plan.

    `flat_block_limit` None leaves out what is said about flat policies: the optimum of a fully observed
    model, an upper bound on it of a partially observed one.  `reachable` restricts every subtask to what
    the start can reach.  `solver` is for tasks that name none: the name of one of ours,
    "package.module:Name", or a solver itself (`factored_polca.solvers.protocol`).

    For models whose state is seen (PolCA) `epsilon` is the gap that solvers close, relative to the
    largest value.  Where the quotient of a task with the solver "auto" has more than `structured_blocks`
    blocks, or takes more memory than there is, the task is solved on diagrams: `solver` "structured".

    For those whose state is not (PolCA+) solvers stop where upper - lower <= `gap` at the initial belief,
    and for children at all corners, and after `trials` trials; `gap` None is a thousandth of the span of
    the task's rewards.  Where the quotient of a task with the solver "auto" has more than
    `symbolic_blocks` blocks, or takes more memory than there is, the task is solved on diagrams: `solver`
    "symbolic".  `maximum_observations` caps the joint observations of one action of a task.
    `assume_observed` plans a partially observed model as if the state were seen (PolCA).

    `interchangeable` tells actions by what they do and not by their names, where the state is seen.

    `merge_within` merges states that are near (`factored_polca.approximation`): rows of probabilities
    within this total variation, values within this share of their span; from 0 to below 1, a float as it
    is written.  None is exact abstraction.  Losses are bounded, and measured where the exact quotients have
    no more than `flat_block_limit` blocks.
    """

    seed: int = 0
    epsilon: float = 1e-9
    order: str | Sequence[str] = "auto"
    reachable: bool = False
    block_limit: int | None = None
    flat_block_limit: int | None = FLAT_BLOCK_LIMIT
    memory_limit: int | None = None
    deadline: float | None = None
    solver: str | PomdpSolver | MdpSolver = "auto"
    gap: float | None = None
    trials: int | None = TRIALS
    maximum_observations: int = MAXIMUM_OBSERVATIONS
    assume_observed: bool = False
    interchangeable: bool = False
    merge_within: Fraction | float | str | None = None
    structured_blocks: int | None = STRUCTURED_BLOCKS
    symbolic_blocks: int | None = SYMBOLIC_BLOCKS
