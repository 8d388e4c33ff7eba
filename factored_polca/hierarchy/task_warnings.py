"""What a person should know of a task that was solved over blocks."""

from __future__ import annotations

import numpy as np

from factored_polca.minimisation import Reduction
from factored_polca.models import Task
from factored_polca.solvers import MDPSolution


def task_warnings(
    task: Task, reduction: Reduction, solution: MDPSolution, dead: int, *, is_child: bool
) -> tuple[str, ...]:
    """What a person should know of a solved task."""
    found = []
    if dead:
        found.append(
            f"task {task.name!r}: {dead:,} states can't avoid a state that is not terminal and has no "
            "applicable action; its policy is undefined there"
        )
    if not solution.converged:
        found.append(
            f"task {task.name!r}: the solver stopped early ({solution.status}), gap {solution.gap:.3g}"
        )
    if is_child and not task.has_pseudo_reward and equal_across_choices(reduction):
        found.append(
            f"task {task.name!r}: in each state its actions have equal rewards; a pseudo_reward would tell "
            "it what to aim for"
        )
    return tuple(found)


def equal_across_choices(reduction: Reduction) -> bool:
    """Whether several choices, wherever they are applicable in one block, have one reward."""
    mdp = reduction.mdp
    several = mdp.applicable.sum(axis=0) > 1
    if not several.any():
        return False
    high = np.where(mdp.applicable, mdp.rewards, -np.inf)[:, several].max(axis=0)
    low = np.where(mdp.applicable, mdp.rewards, np.inf)[:, several].min(axis=0)
    return bool((high <= low).all())
