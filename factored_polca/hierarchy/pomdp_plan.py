"""PolCA+: plan a task hierarchy of a partially observed model (Pineau, Gordon & Thrun 2003, section 4.4).

For each subtask, children first:

1. *parameterise* (`subtask`): child c is one action with the joint kernel of pi_c(s), what it does at the
   belief corner b(s) = 1:  K_c(s; s', o) = T(s, pi_c(s), s') O(o | s', s, pi_c(s)),  R(s, pi_c(s));
2. *cluster* (`minimisation`): the coarsest partition that Eq. 13 allows, and the joint kernel over blocks,
   observations merged without loss;
3. *solve* (`solvers`): a child over the whole simplex, as its parents will ask at every corner: the search
   starts from all corners, the uniform belief and the initial one.  The root is asked from the initial
   belief only.
4. carry the policy at the corners back to the states: a diagram state -> primitive action.

At a corner nothing needs to be asked, so a parent may misjudge what a child is worth, as a rule
optimistically.  The bounds of a task are those of its own model, *given* that its children do what they
do at corners; what the polled policy earns is measured by simulation (`factored_polca.simulation.measure`).

Beside it stands an upper bound on what any policy can earn, hierarchical or not: the fast informed bound
(Hauskrecht 2000) on the flat quotient.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from factored_polca.approximation.approximate import certify_pomdp
from factored_polca.diagrams import Aborted, Diagram, MemoryLimit
from factored_polca.drawn import DrawnGraph, Framed
from factored_polca.hierarchy.check import (
    checked,
    custom_solver,
    named_solver,
    planning_order,
    pomdp_solver_of,
)
from factored_polca.hierarchy.merging import CertifiedBounds, limits_named, merging_for
from factored_polca.hierarchy.options import Options
from factored_polca.hierarchy.pomdp_solved import (
    RELATIVE_GAP,
    BeliefPolicy,
    SolvedPomdpTask,
    corner_choices,
    root_beliefs,
)
from factored_polca.hierarchy.structured_task import ASKED_FOR, reduction_or_reason
from factored_polca.hierarchy.subtask import planning_channels, refuse_without_purpose, subtask_process
from factored_polca.hierarchy.symbolic_task import (
    SYMBOLIC,
    AnySolvedPomdpTask,
    SymbolicPomdpTask,
    limits_of,
    solve_on_diagrams,
    upper_on_diagrams,
)
from factored_polca.hierarchy.time_limit import PlanStatus, cut_short_text, plan_status, search_deadline
from factored_polca.minimisation import DecisionProcess, Reduction, flat_process, reduce
from factored_polca.models import Fault, LimitReached, Model, ModelError, Task, TaskHierarchy, flat_task
from factored_polca.solvers.pomdp_choose import solve_pomdp
from factored_polca.solvers.pomdp_result import Demand, POMDPSolution
from factored_polca.solvers.protocol import call_pomdp_solver, name_of
from factored_polca.symbolic import SymbolicModel, compile_model

Progress = Callable[[str, str, int, int], None]
"""Called with (task, stage, round or trial, blocks)."""

SEARCHES: Final = ("auto", "exact", "sarsop", "hsvi", "pbvi", "perseus")
"""Methods that go on until a gap is reached, or for `Options.trials`."""


@dataclass(frozen=True)
class FlatBound:
    """What no policy can exceed at the initial belief, from the flat quotient; None: left out."""

    upper: float | None
    blocks: int | None
    note: str


@dataclass(frozen=True)
class PomdpPlan(DrawnGraph, Framed):
    """A hierarchy solved under partial observability; `solved` lists the tasks children first.

    Where near states were merged, `certified` bounds the optimum without an exact quotient;
    `factored_polca.control.certify.certify_plan` bounds what the polled policy earns too.
    """

    symbolic: SymbolicModel
    tasks: TaskHierarchy
    solved: tuple[AnySolvedPomdpTask, ...]
    flat: FlatBound
    seconds: float
    warnings: tuple[str, ...] = field(default=())
    certified: CertifiedBounds | None = None

    def __repr__(self) -> str:
        return f"<PomdpPlan of {self.model.name}: {len(self.solved)} tasks>"

    @property
    def root(self) -> AnySolvedPomdpTask:
        """The task at the top."""
        return self.solved[-1]

    @property
    def model(self) -> Model:
        """The model that was planned for."""
        return self.symbolic.model

    @property
    def status(self) -> PlanStatus:
        """Whether a limit cut the search of a task short."""
        return plan_status(solved.solution.status for solved in self.solved)

    def task(self, name: str) -> AnySolvedPomdpTask:
        """The solved task called `name`.

        Raises:
            KeyError: there is none; the message lists those there are.
        """
        for solved in self.solved:
            if solved.task.name == name:
                return solved
        raise KeyError(f"no task {name!r}; there are {', '.join(s.task.name for s in self.solved)}")


def plan_pomdp(
    model: Model,
    tasks: TaskHierarchy | None = None,
    options: Options | None = None,
    *,
    progress: Progress | None = None,
    symbolic: SymbolicModel | None = None,
) -> PomdpPlan:
    """Plan a partially observed model with PolCA+; without tasks, as one flat task.

    `symbolic` is the model if it has been compiled already: plans that share it share their diagrams.

    Raises:
        ModelError: the model or the hierarchy is not right; discount 1 or a finite horizon.
        LimitReached: memory, blocks, observations or time.
    """
    options = options or Options()
    began = time.perf_counter()
    refuse_unplannable(model)
    hierarchy = checked(model, tasks or flat_task(model))
    own = symbolic is None
    symbolic = symbolic or compile_model(
        model,
        order=options.order,
        tasks=hierarchy,
        memory_limit=options.memory_limit,
        deadline=options.deadline,
    )
    planner = _Planner(symbolic, hierarchy, options, progress)
    for task in planning_order(hierarchy):
        planner.solve(task)
    flat, certified = planner.flat(), planner.certified()
    solved = tuple(planner.solved.values())
    warnings = tuple(w for one in solved for w in one.warnings)
    seconds = time.perf_counter() - began
    if own:
        symbolic.manager.deadline = None  # of planning; the plan may be used for longer
    return PomdpPlan(symbolic, hierarchy, solved, flat, seconds, warnings, certified)


def solved_pomdp_tasks(
    symbolic: SymbolicModel, hierarchy: TaskHierarchy, options: Options, progress: Progress | None
) -> tuple[AnySolvedPomdpTask, ...]:
    """The tasks of a checked hierarchy solved, and no more than that; the root comes last."""
    planner = _Planner(symbolic, hierarchy, options, progress)
    for task in planning_order(hierarchy):
        planner.solve(task)
    return tuple(planner.solved.values())


def refuse_unplannable(model: Model) -> None:
    """Refuse what PolCA+ has no meaning for.

    Raises:
        ModelError: a fully observed model, a finite horizon, or no discount below 1.
    """
    faults = []
    if model.observability != "partial":
        faults.append(Fault("the model is fully observed", ("observability",), "plan it with PolCA"))
    if model.horizon is not None:
        message = "a finite horizon can't be planned for with tasks"
        faults.append(
            Fault(message, ("horizon",), "remove it and give a discount (plan --discount D), or use solve")
        )
    elif not model.discount < 1:
        message = "at discount 1 a partially observed model has no defined value without a horizon"
        faults.append(Fault(message, ("discount",), "give a discount below 1"))
    if faults:
        raise ModelError(faults)


class _Planner:
    """The working state of one call of `plan_pomdp`."""

    def __init__(
        self,
        symbolic: SymbolicModel,
        hierarchy: TaskHierarchy,
        options: Options,
        progress: Progress | None,
    ) -> None:
        self.symbolic, self.hierarchy = symbolic, hierarchy
        self.options, self.progress = options, progress
        self.solved: dict[str, AnySolvedPomdpTask] = {}
        self.custom = custom_solver(options.solver)
        self.merging = merging_for(symbolic, options)
        self.reachable: Diagram | None = None
        if options.reachable:
            from factored_polca.symbolic.reach import reachable_states

            names = {task.name for task in hierarchy.tasks}
            used = {a for task in hierarchy.tasks for a in task.actions} - names
            self.reachable = reachable_states(symbolic, sorted(used)).diagram

    def tell(self, task: str, stage: str, number: int = 0, blocks: int = 0) -> None:
        if self.progress is not None:
            self.progress(task, stage, number, blocks)

    def reduce(self, name: str, process: DecisionProcess, block_limit: int | None) -> Reduction:
        return reduce(
            process,
            seed=self.options.seed,
            block_limit=block_limit,
            progress=lambda number, blocks: self.tell(name, "minimise", number, blocks),
            maximum_observations=self.options.maximum_observations,
        )

    def merged(self, task: Task, process: DecisionProcess, method: str) -> Reduction | str:
        """A task's reduction: exact, or of a process near it; or why it is to be solved on diagrams."""
        name = task.name
        if self.merging is None:
            return self.reduced(task, process, method)
        if method == SYMBOLIC:
            message = f"task {name!r}: merging near states needs blocks, and {SYMBOLIC!r} makes none"
            raise ModelError([Fault(message, ("tasks", name, "solver"), "choose one of them")])
        return self.merging.reduce(
            process,
            self.options.block_limit,
            lambda number, blocks: self.tell(name, "merge", number, blocks),
        )

    def reduced(self, task: Task, process: DecisionProcess, method: str) -> Reduction | str:
        """The reduction of a process, or why it is to be solved on diagrams."""
        if method == SYMBOLIC:
            return ASKED_FOR
        options = self.options
        falls_back = method == "auto" and (self.custom is None or task.solver is not None)
        return reduction_or_reason(
            lambda limit: self.reduce(task.name, process, limit),
            falls_back, options.block_limit, options.symbolic_blocks,
        )  # fmt: skip

    def on_diagrams(self, task: Task, process: DecisionProcess, reason: str) -> AnySolvedPomdpTask:
        """Steps 2 to 4 without a quotient."""

        def progress(lower: float, upper: float) -> None:
            self.tell(task.name, f"the value lies in {lower:.6g} .. {upper:.6g}")

        left = len(self.hierarchy.tasks) - len(self.solved)
        is_root = task in self.hierarchy.roots()
        return solve_on_diagrams(
            task, process, self.options, reason, is_root=is_root, shares=left + 1, progress=progress
        )

    def solve(self, task: Task) -> None:
        """Steps 1 to 4 of the module's docstring for one task."""
        began = time.perf_counter()
        self.tell(task.name, "parameterise")
        method = pomdp_solver_of(task, named_solver(self.options.solver))
        channels = planning_channels(self.symbolic.model, task)
        process = subtask_process(self.symbolic, task, self.solved, self.reachable, channels)
        with limits_of(task.name):
            reduction = self.merged(task, process, method)
        if isinstance(reduction, str):
            self.solved[task.name] = self.on_diagrams(task, process, reduction)
            self.tell(task.name, "done")
            return
        quotient = reduction.pomdp_quotient
        if self.merging is None or not self.merging.has_purpose(process):
            refuse_without_purpose(task, quotient.mdp)
        minimised = time.perf_counter()
        is_root = task in self.hierarchy.roots()
        solution = self.optimise(task, reduction, method, is_root)
        policy = belief_policy(solution)
        corner, ties = corner_choices(policy, reduction.partition.blocks)
        with self.symbolic.manager.undisturbed():  # a search may have ended late
            lifted = reduction.lift_policy(corner)
        now = time.perf_counter()
        self.solved[task.name] = SolvedPomdpTask(
            task, reduction, solution, policy, corner, lifted,
            self.symbolic.manager.constant(1), ties, now - began, minimised - began,
            task_warnings(task, solution, is_child=not is_root),
            None if self.merging is None else self.merging.certify_pomdp(reduction, solution),
        )  # fmt: skip
        self.tell(task.name, "done", 0, reduction.partition.blocks)

    def optimise(self, task: Task, reduction: Reduction, method: str, is_root: bool) -> POMDPSolution:
        """The task's quotient solved: from the initial belief for the root, everywhere for a child."""
        pomdp, options = reduction.pomdp_quotient.pomdp, self.options
        blocks = reduction.partition.blocks
        self.tell(task.name, "solve", 0, blocks)
        roots = pomdp.initial[None, :] if is_root else root_beliefs(pomdp)
        span = float(np.ptp(np.append(pomdp.rewards[:, ~pomdp.terminal], 0.0)))
        demand = Demand(
            gap=options.gap if options.gap is not None else max(RELATIVE_GAP * span, 1e-12),
            deadline=search_deadline(options, is_root=is_root),
            iterations=options.trials if method in SEARCHES else None,
            seed=options.seed,
        )
        if self.custom is not None and task.solver is None:
            solution = call_pomdp_solver(self.custom, pomdp, demand, roots)
            refuse_memory(solution, name_of(self.custom))
        else:
            solution = solve_pomdp(pomdp, method, demand=demand, roots=roots)
        if solution.status == "interrupted":
            raise KeyboardInterrupt
        return solution

    def certified(self) -> CertifiedBounds | None:
        """What no policy can exceed, by the merged flat process; the polled policy is measured."""
        root = self.solved[planning_order(self.hierarchy)[-1].name]
        if self.merging is None:
            return None
        process = flat_process(self.symbolic, reachable=self.reachable, terminal=root.process.terminal)
        note = "what the polled policy earns is measured"
        try:
            reduction = self.merging.reduce(process, self.options.block_limit)
            pomdp = reduction.pomdp_quotient.pomdp
            found = solve_pomdp(pomdp, "fib", demand=Demand(deadline=self.options.deadline))
            if found.status == "interrupted":
                raise KeyboardInterrupt
            with limits_named():
                optimum = certify_pomdp(reduction, found).optimum
        except LimitReached as error:
            return CertifiedBounds(None, None, None, f"{note}; no bound on the optimum: {error}")
        return CertifiedBounds(None, None, optimum, note, pomdp.states)

    def flat(self) -> FlatBound:
        """What no policy can exceed, or why it was left out."""
        limit, root = self.options.flat_block_limit, self.solved[planning_order(self.hierarchy)[-1].name]
        if limit is None:
            return FlatBound(None, None, "not asked for")
        if root.task.has_pseudo_reward:
            return FlatBound(None, None, "the root has a reward of its own")
        self.tell("flat bound", "parameterise")
        try:
            process = flat_process(self.symbolic, reachable=self.reachable, terminal=root.process.terminal)
            if any(isinstance(solved, SymbolicPomdpTask) for solved in self.solved.values()):
                return self.flat_on_diagrams(process, root)
            with limits_of("flat bound"):
                reduction = self.reduce("flat bound", process, limit)
        except (LimitReached, MemoryLimit, Aborted) as error:
            return FlatBound(None, None, f"left out: {error}")
        pomdp = reduction.pomdp_quotient.pomdp
        self.tell("flat bound", "solve", 0, pomdp.states)
        found = solve_pomdp(pomdp, "fib", demand=Demand(deadline=self.options.deadline))
        if found.status == "interrupted":
            raise KeyboardInterrupt
        return FlatBound(found.upper, pomdp.states, "fast informed bound on the flat quotient")

    def flat_on_diagrams(self, process: DecisionProcess, root: AnySolvedPomdpTask) -> FlatBound:
        """The same without a quotient."""
        primitives = tuple(action.name for action in self.symbolic.actions)
        if root.task.actions == primitives:
            return FlatBound(root.upper, None, "the plan is flat")
        try:
            upper = upper_on_diagrams(process, self.options)
        except LimitReached as error:
            return FlatBound(None, None, f"left out: {error}")
        return FlatBound(upper, None, "fast informed bound on diagrams, without a quotient")


def refuse_memory(solution: POMDPSolution, name: str) -> None:
    """Refuse a policy that is no map from beliefs: polling keeps no memory for it.

    Raises:
        ModelError: naming the solver.
    """
    if not isinstance(solution.policy, BeliefPolicy):
        raise ModelError(
            f"the solver {name} returned {type(solution.policy).__name__}, which is no map from beliefs to "
            "actions: return AlphaVectors; solvers.proposal.solution_of_policy makes them of a policy graph"
        )


def belief_policy(solution: POMDPSolution) -> BeliefPolicy:
    """The policy of a solution as a map from beliefs.

    Raises:
        TypeError: a policy that needs a memory of its own, which polling does not keep.
    """
    if not isinstance(solution.policy, BeliefPolicy):
        raise TypeError(f"{type(solution.policy).__name__} is no map from beliefs to actions")
    return solution.policy


def task_warnings(task: Task, solution: POMDPSolution, *, is_child: bool) -> tuple[str, ...]:
    """What a person should know of a solved task."""
    found = []
    if solution.status in ("time limit", "memory limit"):
        found.append(cut_short_text(task.name, solution.status, solution.gap))
    if is_child and solution.guarantee.kind == "heuristic":
        found.append(
            f"task {task.name!r}: {solution.method} proves no lower bound; its parents take its word for "
            "what to do where it is certain"
        )
    if task.observes is not None:
        found.append(
            f"task {task.name!r} plans with {', '.join(task.observes) or 'no observation'} only: its value "
            "is a lower bound of what it can earn"
        )
    return tuple(found)
