"""The value of a solution at the initial belief, found over blocks or on diagrams."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from factored_polca.hierarchy.solved import AnySolvedTask, StructuredTask
from factored_polca.minimisation import Reduction
from factored_polca.solvers import Guarantee, MDPSolution
from factored_polca.structured.solution import StructuredSolution


@dataclass(frozen=True)
class Evaluation:
    """The value of something at the initial belief: bounds, and how it was found."""

    value: float
    lower: float
    upper: float
    blocks: int | None  # None: found on diagrams
    guarantee: Guarantee


def expectation(belief: np.typing.NDArray[np.float64], values: np.typing.NDArray[np.float64]) -> float:
    """sum_k b(k) V(k), where probability 0 times minus infinity is 0."""
    inside = belief > 0
    return float(belief[inside] @ values[inside])


def evaluate(reduction: Reduction, solution: MDPSolution) -> Evaluation:
    """The value of a solution at the initial belief."""
    belief = reduction.project_initial()
    return Evaluation(
        expectation(belief, solution.values),
        expectation(belief, solution.lower),
        expectation(belief, solution.upper),
        reduction.partition.blocks,
        solution.guarantee,
    )


def evaluate_structured(solution: StructuredSolution) -> Evaluation:
    """The value at the initial belief of what was solved on diagrams."""
    return Evaluation(solution.value, solution.lower, solution.upper, None, solution.guarantee)


def root_bounds(root: AnySolvedTask, reason: str) -> Evaluation:
    """Bounds on the value of the polled policy from those of the root, whose reward is the model's.

    The root's model is that of its children's policies, so its policy's value is the polled one's.
    `reason` says why the policy's own chain was not solved.
    """
    if isinstance(root, StructuredTask):
        low, high = root.solution.policy_lower, root.solution.upper
    else:
        with root.process.symbolic.manager.undisturbed():
            belief, solution = root.reduction.project_initial(), root.solution
        low = expectation(belief, solution.lower) - solution.policy_loss_bound
        high = expectation(belief, solution.upper)
    text = f"the root's bounds, as the chain of the polled policy was not solved: {reason}"
    return Evaluation(0.5 * (low + high), low, high, root.blocks, Guarantee("bounds", text))


def describe_block(reduction: Reduction, block: int) -> str:
    """A block by its first state."""
    partition = reduction.partition
    return partition.symbolic.state_text(partition.representatives[block].tolist())
