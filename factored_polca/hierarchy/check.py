"""The order in which subtasks are planned, and checks that need the model compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import networkx as nx
import numpy as np

from factored_polca.minimisation import flat_process, reduce
from factored_polca.models import Fault, Model, ModelError, TaskHierarchy, check_tasks, resolve_tasks
from factored_polca.models.tasks import Task
from factored_polca.solvers import METHODS, solve_mdp
from factored_polca.solvers.pomdp_choose import POMDP_METHODS
from factored_polca.solvers.protocol import load_solver
from factored_polca.symbolic import SymbolicModel

TASK_METHODS: Final = (*(method for method in POMDP_METHODS if method != "witness"), "symbolic")
"""Solvers of a task whose state is not seen; the witness algorithm needs a horizon, which tasks lack."""


def task_graph(hierarchy: TaskHierarchy) -> nx.DiGraph:
    """The graph whose edges lead from a task to its children, actions included.

    Tasks carry `kind="task"`, primitive actions `kind="action"`.
    """
    graph = nx.DiGraph()
    names = {task.name for task in hierarchy.tasks}
    for task in hierarchy.tasks:
        graph.add_node(task.name, kind="task")
        for name in task.actions:
            if name not in names:
                graph.add_node(name, kind="action")
            graph.add_edge(task.name, name)
    return graph


def planning_order(hierarchy: TaskHierarchy) -> list[Task]:
    """The tasks, children before parents; otherwise in the hierarchy's order."""
    place = {task.name: index for index, task in enumerate(hierarchy.tasks)}
    graph = nx.DiGraph()
    graph.add_nodes_from(place)
    graph.add_edges_from((c, t.name) for t in hierarchy.tasks for c in t.actions if c in place)
    ordered = nx.lexicographical_topological_sort(graph, key=place.__getitem__)
    return [hierarchy.task(name) for name in ordered]


def checked(model: Model, hierarchy: TaskHierarchy, *, assume_observed: bool = False) -> TaskHierarchy:
    """`hierarchy` with its names resolved; `assume_observed`: without its solvers of POMDPs being checked.

    Raises:
        ModelError: with every structural fault; warnings are left out.
    """
    resolved = resolve_tasks(model, hierarchy)
    faults: list[Fault] = check_tasks(model, resolved)
    solver = solver_of if model.observability == "full" else pomdp_solver_of
    for task in () if assume_observed else resolved.tasks:
        try:
            solver(task)
        except ModelError as error:
            faults += error.faults
    if faults:
        raise ModelError(faults)
    return resolved


def refuse_imports(task: Task) -> None:
    """Refuse a task that names a module to import: model files are not trusted to run programs.

    Raises:
        ModelError: it does.
    """
    if task.solver is not None and ":" in task.solver:
        fault = Fault(
            f"the solver {task.solver!r} would import a module, which a model may not ask for",
            ("tasks", task.name, "solver"),
            f"leave it out, and give --solver {task.solver} or Options(solver=...) yourself",
        )
        raise ModelError([fault])


def custom_solver(solver: str | Callable[..., Any]) -> Callable[..., Any] | None:
    """The solver that is not ours which `Options.solver` gives or names; None: the name of one of ours.

    Raises:
        ModelError: it can't be imported or called.
    """
    if not isinstance(solver, str):
        if not callable(solver):
            raise ModelError(f"the solver is {type(solver).__name__}: give a name, or something to call")
        return solver
    return load_solver(solver) if ":" in solver else None


def named_solver(solver: str | Callable[..., Any]) -> str:
    """The name of ours that `Options.solver` gives; "auto" where it gives a solver that is not ours."""
    return solver if isinstance(solver, str) and ":" not in solver else "auto"


def solver_of(task: Task, default: str = "auto") -> str:
    """The solver of a task, `default` where it names none.

    Raises:
        ModelError: unknown; the message lists those there are.
    """
    refuse_imports(task)
    method = (task.solver or default).replace("_", " ").replace("-", " ")
    short = {"vi": "value iteration", "pi": "policy iteration", "mpi": "modified policy iteration"}
    method = short.get(method, method)
    if method not in ("auto", "structured") and method not in METHODS:
        listed = ", ".join(["auto", *short, *METHODS, "structured"])
        raise ModelError(
            [Fault(f"no solver {method!r} for MDPs", ("tasks", task.name, "solver"), f"there are {listed}")]
        )
    return method


def pomdp_solver_of(task: Task, default: str = "auto") -> str:
    """The solver of a task whose state is not seen, `default` where it names none.

    Raises:
        ModelError: unknown; the message lists those there are.
    """
    refuse_imports(task)
    method = task.solver or default
    if method not in TASK_METHODS:
        listed = ", ".join(TASK_METHODS)
        raise ModelError(
            [
                Fault(
                    f"no solver {method!r} for tasks of POMDPs",
                    ("tasks", task.name, "solver"),
                    f"there are {listed}",
                )
            ]
        )
    return method


def check_undiscounted(symbolic: SymbolicModel, *, block_limit: int = 100_000) -> list[Fault]:
    """Faults of a model with discount 1: an infinite value, or a start without a proper policy.

    It takes the quotient of the model to see: end components with rewards, and states from which no
    policy is sure to end.

    Raises:
        LimitReached: more than `block_limit` blocks.
    """
    if symbolic.model.discount != 1 or symbolic.model.horizon is not None:
        return []
    reduction = reduce(flat_process(symbolic), block_limit=block_limit)
    partition = reduction.partition

    def describe(block: int) -> str:
        return symbolic.state_text(partition.representatives[block].tolist())

    try:
        solution = solve_mdp(reduction.mdp, describe=describe)
    except ModelError as error:
        return list(error.faults)
    lost = np.flatnonzero((reduction.project_initial() > 0) & solution.dead_ends)
    if not len(lost):
        return []
    return [
        Fault(
            f"with discount 1 no policy is sure to end from a start state like {describe(int(lost[0]))}",
            ("discount",),
            "give a discount below 1, or make the end reachable",
        )
    ]
