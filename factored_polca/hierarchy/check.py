"""The order in which subtasks are planned, and checks that need the model compiled."""

from __future__ import annotations

import networkx as nx

from factored_polca.models import Fault, Model, ModelError, TaskHierarchy, check_tasks, resolve_tasks
from factored_polca.models.tasks import Task


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


def checked(model: Model, hierarchy: TaskHierarchy) -> TaskHierarchy:
    """`hierarchy` with its names resolved.

    Raises:
        ModelError: with every structural fault; warnings are left out.
    """
    resolved = resolve_tasks(model, hierarchy)
    faults: list[Fault] = check_tasks(model, resolved)
    if faults:
        raise ModelError(faults)
    return resolved
