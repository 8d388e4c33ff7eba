"""PolCA: plan a task hierarchy bottom-up (Pineau, Gordon & Thrun 2003, section 4.2).

For each subtask, children first: parameterise (`subtask`), cluster (`minimisation`), solve the
quotient (`solvers`), and carry the policy back to the states as a diagram, which models the
abstract action of the parents.  A task whose quotient is too large is solved on diagrams instead
(`structured_task`).  The result is recursively optimal: each subtask's policy is optimal
given its children's.

The polled policy takes at each state the primitive that the root's policy leads to, so its value
under the model's reward is that of a Markov chain, computed on the quotient of the model under that
policy.  Beside it stands the flat optimum, over all primitive actions, where its quotient is within
a limit: the difference is what the hierarchy costs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from factored_polca.diagrams import INDEX, Aborted, Diagram, MemoryLimit, relabel
from factored_polca.drawn import DrawnGraph, Framed
from factored_polca.hierarchy.check import checked, custom_solver, named_solver, planning_order, solver_of
from factored_polca.hierarchy.counts import count_exchanged, count_q_values
from factored_polca.hierarchy.dead_ends import refuse_unavoidable_dead_ends
from factored_polca.hierarchy.evaluation import (
    Evaluation,
    describe_block,
    evaluate,
    evaluate_structured,
    expectation,
    root_bounds,
)
from factored_polca.hierarchy.merging import (
    CertifiedBounds,
    merging_for,
    policy_chain,
    seen_flat_process,
)
from factored_polca.hierarchy.options import Options
from factored_polca.hierarchy.pomdp_plan import PomdpPlan, plan_pomdp
from factored_polca.hierarchy.solved import AnySolvedTask, SolvedTask, StructuredTask
from factored_polca.hierarchy.structured_task import (
    ASKED_FOR,
    STRUCTURED,
    on_diagrams,
    reduction_or_reason,
    solve_on_diagrams,
)
from factored_polca.hierarchy.subtask import refuse_without_purpose, subtask_process
from factored_polca.hierarchy.task_warnings import task_warnings
from factored_polca.hierarchy.time_limit import PlanStatus, plan_status, search_deadline
from factored_polca.minimisation import DecisionProcess, Reduction, reduce
from factored_polca.minimisation.polynomial import interchangeable_fault
from factored_polca.minimisation.reduction import InterchangeableReduction
from factored_polca.models import (
    Fault,
    LimitReached,
    Model,
    ModelError,
    Task,
    TaskHierarchy,
    flat_task,
)
from factored_polca.solvers import MDPSolution, solve_mdp
from factored_polca.solvers.pomdp_result import Demand
from factored_polca.solvers.protocol import MdpSolver, call_mdp_solver
from factored_polca.symbolic import SymbolicModel, compile_model

Progress = Callable[[str, str, int, int], None]
"""Called with (task, stage, round, blocks)."""


@dataclass(frozen=True)
class HierarchicalPlan(DrawnGraph, Framed):
    """A solved hierarchy.

    `solved` lists the tasks children first, the root last.  `polled` is the value of the polled
    policy under the model's own reward; `flat` the optimum without hierarchy, None where it was
    left out, and `flat_note` says why.  Where near states were merged, `certified` bounds both without
    exact quotients.
    """

    symbolic: SymbolicModel
    tasks: TaskHierarchy
    solved: tuple[AnySolvedTask, ...]
    polled: Evaluation
    flat: Evaluation | None
    flat_note: str
    seconds: float
    warnings: tuple[str, ...] = field(default=())
    certified: CertifiedBounds | None = None

    def __repr__(self) -> str:
        tasks, worth = len(self.solved), self.polled.value
        return f"<HierarchicalPlan of {self.model.name}: {tasks} tasks, worth {worth:.6g}>"

    @property
    def root(self) -> AnySolvedTask:
        """The task at the top."""
        return self.solved[-1]

    @property
    def model(self) -> Model:
        """The model that was planned for."""
        return self.symbolic.model

    @property
    def status(self) -> PlanStatus:
        """Whether a limit cut the search of a task short."""
        return plan_status(solved.status for solved in self.solved)

    def task(self, name: str) -> AnySolvedTask:
        """The solved task called `name`.

        Raises:
            KeyError: there is none; the message lists those there are.
        """
        for solved in self.solved:
            if solved.task.name == name:
                return solved
        raise KeyError(f"no task {name!r}; there are {', '.join(s.task.name for s in self.solved)}")


def plan(
    model: Model,
    tasks: TaskHierarchy | None = None,
    options: Options | None = None,
    *,
    progress: Progress | None = None,
) -> HierarchicalPlan | PomdpPlan:
    """Plan a model with PolCA, or with PolCA+ where its state is not seen; without tasks, as one flat task.

    Raises:
        ModelError: the model or the hierarchy is not right, or a start state can't avoid a dead end.
        LimitReached: memory, blocks, observations or time.
    """
    options = options or Options()
    if isinstance(model, Model) and model.observability == "partial" and not options.assume_observed:
        if options.interchangeable:
            raise ModelError([interchangeable_fault()])
        return plan_pomdp(model, tasks, options, progress=progress)
    return plan_mdp(model, tasks, options, progress=progress)


def plan_mdp(
    model: Model,
    tasks: TaskHierarchy | None = None,
    options: Options | None = None,
    *,
    progress: Progress | None = None,
    symbolic: SymbolicModel | None = None,
) -> HierarchicalPlan:
    """Plan a model with PolCA; without tasks, as one flat task.

    A partially observed model is planned as if its state were seen where `options.assume_observed` says so:
    the paper's PolCA run on a POMDP.  All values are then those of seeing the state.

    `symbolic` is the model if it has been compiled already: plans that share it share their diagrams.

    Raises:
        ModelError: the model or the hierarchy is not right, or a start state can't avoid a dead end.
        LimitReached: memory, blocks or time.
    """
    if not isinstance(model, Model):
        raise TypeError(f"plan takes a Model, not {model!r}; load_domain(NAME).model is a shipped one")
    if tasks is not None and not isinstance(tasks, TaskHierarchy):
        raise TypeError(
            f"tasks are a TaskHierarchy, not {type(tasks).__name__}: TaskHierarchy([Task(...)])"
        )
    options = options or Options()
    began = time.perf_counter()
    if model.observability != "full" and not options.assume_observed:
        hint = "plan_pomdp plans it; with assume_observed it is planned as if the state were seen"
        raise ModelError([Fault("the model is partially observed", ("observability",), hint)])
    if model.horizon is not None:
        hint = "remove it and give a discount (plan --discount D), or use solve"
        raise ModelError([Fault("a finite horizon can't be planned for", ("horizon",), hint)])
    hierarchy = checked(model, tasks or flat_task(model), assume_observed=options.assume_observed)
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
    root = planner.solved[planning_order(hierarchy)[-1].name]
    refuse_unavoidable_dead_ends(root)
    certified = planner.certified(root)
    polled = planner.polled(root, certified)
    flat, note = planner.flat(root)
    warnings = tuple(w for solved in planner.solved.values() for w in solved.warnings)
    seconds = time.perf_counter() - began
    solved = tuple(planner.solved.values())
    if own:
        symbolic.manager.deadline = None  # of planning; the plan may be used for longer
    return HierarchicalPlan(symbolic, hierarchy, solved, polled, flat, note, seconds, warnings, certified)


def solved_tasks(
    symbolic: SymbolicModel, hierarchy: TaskHierarchy, options: Options, progress: Progress | None
) -> tuple[AnySolvedTask, ...]:
    """The tasks of a checked hierarchy solved, and no more than that; the root comes last."""
    planner = _Planner(symbolic, hierarchy, options, progress)
    for task in planning_order(hierarchy):
        planner.solve(task)
    return tuple(planner.solved.values())


class _Planner:
    """The working state of one call of `plan`."""

    def __init__(
        self,
        symbolic: SymbolicModel,
        hierarchy: TaskHierarchy,
        options: Options,
        progress: Progress | None,
    ) -> None:
        self.symbolic, self.hierarchy = symbolic, hierarchy
        self.options, self.progress = options, progress
        self.solved: dict[str, AnySolvedTask] = {}
        self.custom = None if options.assume_observed else custom_solver(options.solver)
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
            interchangeable=self.options.interchangeable and len(process.choices) > 1,
        )

    def merged(
        self, name: str, process: DecisionProcess, method: str, custom: MdpSolver | None
    ) -> Reduction | str:
        """A task's reduction: exact, or of a process near it; or why it is to be solved on diagrams."""
        if self.merging is None:
            return self.reduced(name, process, method, custom)
        if method == STRUCTURED:
            message = f"task {name!r}: merging near states needs blocks, and {STRUCTURED!r} makes none"
            raise ModelError([Fault(message, ("tasks", name, "solver"), "choose one of them")])
        return self.merging.reduce(
            process,
            self.options.block_limit,
            lambda number, blocks: self.tell(name, "merge", number, blocks),
        )

    def optimise(
        self,
        name: str,
        reduction: Reduction,
        method: str,
        custom: MdpSolver | None = None,
        *,
        search_until: float | None = None,
    ) -> MDPSolution:
        """A quotient solved; a search that is cut short at `search_until` is good enough."""
        self.tell(name, "solve", 0, reduction.partition.blocks)
        options = self.options
        deadline = options.deadline if search_until is None else search_until
        if custom is not None:
            demand = Demand(gap=options.epsilon, deadline=deadline, seed=options.seed)
            solution = call_mdp_solver(custom, reduction.mdp, demand)
        else:
            solution = solve_mdp(
                reduction.mdp,
                method,
                options.epsilon,
                deadline=deadline,
                describe=lambda block: describe_block(reduction, block),
            )
        if solution.status == "interrupted":
            raise KeyboardInterrupt
        if solution.status == "time limit" and search_until is None:
            raise LimitReached(
                f"task {name!r}: the time limit was reached while solving "
                f"{reduction.partition.blocks:,} blocks (gap {solution.gap:.3g})",
                "solve",
                solution,
            )
        return solution

    def solve(self, task: Task) -> None:
        """Steps 2 to 4 of PolCA for one task."""
        began = time.perf_counter()
        self.tell(task.name, "parameterise")
        method = (
            "auto" if self.options.assume_observed else solver_of(task, named_solver(self.options.solver))
        )
        process = subtask_process(self.symbolic, task, self.solved, self.reachable)
        custom = self.custom if task.solver is None else None
        reduction = self.merged(task.name, process, method, custom)
        if isinstance(reduction, str):
            self.solved[task.name] = self.on_diagrams(task, process, reduction)
            return
        if self.merging is None or not self.merging.has_purpose(process):
            refuse_without_purpose(task, reduction.mdp)
        until = search_deadline(self.options, is_root=task in self.hierarchy.roots())
        solution = self.optimise(task.name, reduction, method, custom, search_until=until)
        with self.symbolic.manager.undisturbed():  # a search may have ended late
            if isinstance(reduction, InterchangeableReduction):
                counts = count_exchanged(reduction.exchanged)
            else:
                counts = count_q_values(process, reduction.partition, self.options.seed)
            policy = reduction.lift_policy(solution.policy)
            chosen = np.append(solution.policy >= 0, False).astype(np.uint64)
            defined = relabel(reduction.partition.diagram, chosen, INDEX)
            dead = sum(reduction.partition.sizes[b] for b in np.flatnonzero(solution.dead_ends).tolist())
            value = expectation(reduction.project_initial(), solution.values)
        approximation = None
        if self.merging is not None:
            self.tell(task.name, "certify", 0, reduction.partition.blocks)
            approximation = self.merging.certify(reduction, solution, policy, defined)
        self.solved[task.name] = SolvedTask(
            task, reduction, solution, policy, defined, counts, value,
            time.perf_counter() - began, dead,
            task_warnings(task, reduction, solution, dead, is_child=task not in self.hierarchy.roots()),
            approximation,
        )  # fmt: skip
        self.tell(task.name, "done", 0, reduction.partition.blocks)

    def reduced(
        self, name: str, process: DecisionProcess, method: str, custom: MdpSolver | None = None
    ) -> Reduction | str:
        """The reduction of a process, or why it is to be solved on diagrams."""
        if method == STRUCTURED:
            return ASKED_FOR
        options = self.options
        falls_back = method == "auto" and custom is None and self.symbolic.model.discount != 1
        return reduction_or_reason(
            lambda limit: self.reduce(name, process, limit),
            falls_back, options.block_limit, options.structured_blocks,
        )  # fmt: skip

    def on_diagrams(self, task: Task, process: DecisionProcess, reason: str) -> StructuredTask:
        """Steps 3 and 4 of PolCA without a quotient."""

        def progress(sweeps: int, gap: float, nodes: int) -> None:
            self.tell(task.name, f"sweep {sweeps}, {nodes:,} nodes, gap {gap:.3g}")

        until = search_deadline(self.options, is_root=task in self.hierarchy.roots())
        solved = solve_on_diagrams(task, process, self.options, reason, progress, search_until=until)
        self.tell(task.name, "done")
        return solved

    def polled(self, root: AnySolvedTask, certified: CertifiedBounds | None) -> Evaluation:
        """The value of the polled policy under the model's reward; the root's bounds where a limit is met.

        Raises:
            LimitReached: and the root has a reward of its own.
        """
        try:
            return self.polled_chain(root, certified)
        except (LimitReached, MemoryLimit, Aborted) as error:
            if certified is not None or root.task.has_pseudo_reward:
                raise
            return root_bounds(root, str(error))

    def polled_chain(self, root: AnySolvedTask, certified: CertifiedBounds | None) -> Evaluation:
        """The value of the polled policy's Markov chain."""
        name, chain = "polled policy", self.chain(root)
        if certified is None:
            method = STRUCTURED if isinstance(root, StructuredTask) else "auto"
            return self.evaluated(name, chain, self.reduced(name, chain, method))
        try:
            reduction = self.reduce(name, chain, self.options.flat_block_limit or 1)
        except LimitReached:
            if certified.polled_lower is None:
                raise
            return certified.evaluation()
        return evaluate(reduction, self.optimise(name, reduction, "auto"))

    def chain(self, root: AnySolvedTask) -> DecisionProcess:
        """The Markov chain of the polled policy under the model's reward."""
        rewards = {p: action.rewards for p, action in enumerate(self.symbolic.actions)}
        process = replace(root.process, symbolic=self.symbolic, rewards=rewards)
        return policy_chain(process, root.policy, root.defined)

    def certified(self, root: AnySolvedTask) -> CertifiedBounds | None:
        """Bounds on the polled policy's value and on the flat optimum where near states were merged."""
        if self.merging is None:
            return None
        self.tell("bounds", "certify")
        flat = seen_flat_process(self.symbolic, root.process.terminal, self.flat_reachable())
        return self.merging.bounds(self.chain(root), flat)

    def flat_reachable(self) -> Diagram | None:
        """What the start can reach under all primitive actions, where that is asked for."""
        if not self.options.reachable:
            return None
        from factored_polca.symbolic.reach import reachable_states

        return reachable_states(self.symbolic).diagram

    def evaluated(self, name: str, process: DecisionProcess, reduction: Reduction | str) -> Evaluation:
        """The optimum of a process, over blocks or on diagrams."""
        if isinstance(reduction, Reduction):
            return evaluate(reduction, self.optimise(name, reduction, "auto"))
        self.tell(name, "structured value iteration")
        return evaluate_structured(on_diagrams(name, process, self.options))

    def flat(self, root: AnySolvedTask) -> tuple[Evaluation | None, str]:
        """The optimum over all primitive actions, or why it was left out."""
        limit = self.options.flat_block_limit
        if limit is None:
            return None, "not asked for"
        names = tuple(action.name for action in self.symbolic.actions)
        task = root.task
        flat_already = len(self.solved) == 1 and task.actions == names and not task.has_pseudo_reward
        if flat_already and self.merging is None:
            if isinstance(root, StructuredTask):
                return evaluate_structured(root.solution), "the plan is flat"
            return evaluate(root.reduction, root.solution), "the plan is flat"
        try:
            process = seen_flat_process(self.symbolic, root.process.terminal, self.flat_reachable())
            reduction: Reduction | str = ASKED_FOR
            if named_solver(self.options.solver) != STRUCTURED:
                reduction = self.reduce("flat optimum", process, limit)
            found = self.evaluated("flat optimum", process, reduction)
        except (LimitReached, MemoryLimit, Aborted) as error:
            return None, f"left out: {error}"
        return found, "solved over all primitive actions"
