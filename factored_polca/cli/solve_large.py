"""`solve` for fully observed models with too many states to list: over blocks, or on diagrams.

With the solver "auto" first the quotient is tried, up to a limit of blocks and for half of the time there
is, then structured value iteration.  The policy is written as a plan of one flat task, which is what holds
policies over blocks and on diagrams.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from factored_polca.cli.output import Output
from factored_polca.cli.solve_report import conclude, described, print_solution, shown
from factored_polca.cli.source import Source
from factored_polca.models import LimitReached

if TYPE_CHECKING:
    from factored_polca.cli.solve import Task
    from factored_polca.hierarchy.executable import ExecutablePlan, TaskPolicy
    from factored_polca.minimisation import DecisionProcess
    from factored_polca.minimisation.flat_model import FlatModel
    from factored_polca.solvers.result import Guarantee, Status
    from factored_polca.symbolic import SymbolicModel


@dataclass(frozen=True)
class LargeSolution:
    """What was found without listing states; `blocks` and `nodes` are of the quotient, or of the value."""

    lower: float
    upper: float
    value: float
    status: Status
    guarantee: Guarantee
    method: str
    iterations: int
    seconds: float
    note: str
    blocks: int | None
    policy: Callable[[str, tuple[str, ...]], TaskPolicy]  # made of a task's name and actions

    @property
    def gap(self) -> float:
        """upper - lower; 0 where both are the same infinity."""
        return 0.0 if self.lower == self.upper else self.upper - self.lower


def listed_unless_large(symbolic: SymbolicModel, task: Task) -> FlatModel | str:
    """The model as arrays, or why it is solved without listing its states.

    Raises:
        LimitReached: too many states for a solver that needs them listed.
    """
    from factored_polca.cli.solve import listed

    if task.solver == "structured":
        return ""
    if task.solver != "auto" or task.model.horizon is not None:
        return listed(symbolic, task)
    reason = too_many(symbolic, task)
    if reason:
        return reason
    try:
        return listed(symbolic, task)
    except LimitReached as error:
        return str(error)


def too_many(symbolic: SymbolicModel, task: Task) -> str:
    """Why listing the states need not be tried; empty where it may be worth it.

    The reachable states are counted on diagrams, without listing them, for a quarter of the time there is.
    """
    from factored_polca.diagrams import Aborted, MemoryLimit
    from factored_polca.minimisation.unreduced import MAXIMUM_STATES
    from factored_polca.symbolic import reachable_states

    if task.model.states <= MAXIMUM_STATES:
        return ""
    deadline = task.deadline()
    if deadline is not None:
        now = time.monotonic()
        symbolic.manager.deadline = now + (deadline - now) / 4
    try:
        count = reachable_states(symbolic).states
    except (Aborted, MemoryLimit) as error:
        return f"counting the states that can be reached: {error}"
    finally:
        symbolic.manager.deadline = None
    if count <= MAXIMUM_STATES:
        return ""
    return f"{count:,} states can be reached, more than the {MAXIMUM_STATES:,} that may be listed"


def solve_large(
    symbolic: SymbolicModel,
    task: Task,
    reason: str,
    source: Source,
    arguments: argparse.Namespace,
    output: Output,
    compile_seconds: float,
) -> int:
    """Solve without listing states, print bounds and what they mean, write the policy; the exit status."""
    with source.located(), output.progress(f"solving {source.name}"):
        found = work(symbolic, task, reason, shown(source, output))
    data = described(task, found, task.gap, found.value) | {
        "blocks": found.blocks,
        "compile_seconds": compile_seconds,
    }

    def save(kept: dict[str, Any], path: str) -> None:
        from factored_polca.hierarchy.plan_file import save_plan

        save_plan(one_task_plan(symbolic, found, kept), path)

    return conclude(data, save, source, arguments, output, print_solution)


def one_task_plan(symbolic: SymbolicModel, found: LargeSolution, report: dict[str, Any]) -> ExecutablePlan:
    """The policy as a plan of one task with all actions."""
    from factored_polca.hierarchy.check import checked
    from factored_polca.hierarchy.executable import ExecutablePlan, composed_policy
    from factored_polca.models import flat_task

    tasks = checked(symbolic.model, flat_task(symbolic.model))
    (root,) = tasks.roots()
    policies = {root.name: found.policy(root.name, root.actions)}
    whole = composed_policy(symbolic, tasks, policies)
    return ExecutablePlan(symbolic, tasks, root.name, policies, whole, report)


def work(symbolic: SymbolicModel, task: Task, reason: str, show: Callable[[str], None]) -> LargeSolution:
    """Over blocks where the solver is "auto" and they are not too many; else on diagrams."""
    from factored_polca.minimisation import flat_process

    process = flat_process(symbolic)
    deadline = task.deadline()
    if task.solver == "structured":
        return on_diagrams(process, task, deadline, show)
    try:
        found = over_blocks(process, task, deadline, show)
        return replace(found, note=" · ".join(text for text in (reason, found.note) if text))
    except LimitReached as error:
        if task.model.discount == 1 or "aborted" in str(error):
            raise
        why = f"{reason}; no quotient ({error})"
    found = on_diagrams(process, task, deadline, show)
    return replace(found, note=f"{why}; {found.note}")


def over_blocks(
    process: DecisionProcess, task: Task, deadline: float | None, show: Callable[[str], None]
) -> LargeSolution:
    """The optimum over the blocks of the quotient.

    Raises:
        LimitReached: too many blocks, memory, or half of the time.
    """
    from factored_polca.cli.solve import MDP_EPSILON
    from factored_polca.diagrams import MemoryLimit
    from factored_polca.hierarchy.evaluation import describe_block, expectation
    from factored_polca.hierarchy.options import STRUCTURED_BLOCKS
    from factored_polca.minimisation import reduce
    from factored_polca.solvers import solve_mdp

    began = time.perf_counter()
    manager = process.symbolic.manager
    if deadline is not None:
        now = time.monotonic()
        manager.deadline = now + (deadline - now) / 2
    try:
        reduction = reduce(
            process,
            seed=task.seed,
            block_limit=STRUCTURED_BLOCKS,
            progress=lambda number, blocks: show(f"minimising, round {number}, {blocks:,} blocks"),
        )
        initial = reduction.project_initial()
    except MemoryLimit as error:
        raise LimitReached(str(error), "quotient") from None
    finally:
        manager.deadline = None
    blocks = reduction.partition.blocks
    epsilon = MDP_EPSILON if task.gap is None else task.gap
    for _ in range(2):  # `solve_mdp` takes its epsilon relative to the largest value
        solution = solve_mdp(
            reduction.mdp, "auto", epsilon, deadline=deadline, iterations=task.iterations,
            progress=lambda n, gap: show(f"{blocks:,} blocks, {n} iterations, gap {gap:.3g}"),
            describe=lambda block: describe_block(reduction, block),
        )  # fmt: skip
        largest = float(np.abs(solution.values[np.isfinite(solution.values)]).max(initial=0.0))
        margin = (np.count_nonzero(initial) + 4) * 2.0**-52 * largest
        lower = expectation(initial, solution.lower) - margin
        upper = expectation(initial, solution.upper) + margin
        if task.gap is None or solution.status != "converged" or not upper - lower > task.gap:
            break
        epsilon = task.gap / max(1.0, largest) / 2
    chance = reduction.minimisation.collision_bound
    dead = int(solution.dead_ends.sum())

    def policy(name: str, actions: tuple[str, ...]) -> TaskPolicy:
        from factored_polca.hierarchy.executable import TaskPolicy

        choice = solution.policy.astype(np.int32)
        terminal = reduction.mdp.terminal
        return TaskPolicy(name, actions, reduction.partition, choice, solution.values, terminal)

    return LargeSolution(
        lower, upper, min(max(expectation(initial, solution.values), lower), upper), solution.status,
        solution.guarantee, f"{solution.method} over blocks", solution.iterations,
        time.perf_counter() - began,
        f"solved over {blocks:,} blocks, exact but for a chance below {max(chance, 1e-300):.1g}"
        + (f"; {dead} blocks of dead ends, where every policy has lost" if dead else ""),
        blocks, policy,
    )  # fmt: skip


def on_diagrams(
    process: DecisionProcess, task: Task, deadline: float | None, show: Callable[[str], None]
) -> LargeSolution:
    """The optimum by structured value iteration."""
    from factored_polca.cli.solve import MDP_EPSILON
    from factored_polca.diagrams import states_of_leaves
    from factored_polca.diagrams.queries import leaves
    from factored_polca.hierarchy.structured_task import policy_partition
    from factored_polca.structured.value_iteration import structured_value_iteration

    found = structured_value_iteration(
        process,
        epsilon=MDP_EPSILON if task.gap is None else task.gap,
        absolute=task.gap is not None,
        deadline=deadline,
        iterations=task.iterations,
        progress=lambda sweeps, gap, nodes: show(f"{sweeps} sweeps, {nodes:,} nodes, gap {gap:.3g}"),
    )
    counts = states_of_leaves(found.lost, process.symbolic.now_levels)
    dead = dict(zip(leaves(found.lost), counts, strict=True)).get(1, 0)

    def policy(name: str, actions: tuple[str, ...]) -> TaskPolicy:
        from factored_polca.hierarchy.executable import TaskPolicy

        return TaskPolicy(name, actions, *policy_partition(found))

    return LargeSolution(
        found.lower, found.upper, found.value, found.status, found.guarantee, found.method,
        found.iterations, found.seconds,
        found.note + (f"; {dead:,} dead ends, where every policy has lost" if dead else ""), None, policy,
    )  # fmt: skip
