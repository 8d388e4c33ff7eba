"""A task hierarchy: a box for each task with its primitive actions, and its figures if it is solved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from factored_polca.display.graphs import Edge, Graph, Node
from factored_polca.display.tables import drawing, heading, line, table, view
from factored_polca.display.words import (
    count_text,
    listed,
    number_text,
    plural,
    printable,
    seconds_text,
    short,
    wrapped,
)
from factored_polca.models import TaskHierarchy
from factored_polca.models.expressions import FALSE

SHOWN_TASKS: Final = 60
SHOWN_ACTIONS: Final = 16
LONGEST: Final = 40


def html(tasks: TaskHierarchy) -> str:
    """The graph, and what each task wants."""
    rows = []
    for task in tasks.tasks[:SHOWN_TASKS]:
        own = [str(term) for term in task.pseudo_rewards]
        own += [f"{name}: {term}" for name, terms in task.pseudo_rewards_of for term in terms]
        reward = " + ".join(own) or "the model's"
        if own and task.adds_reward:
            reward = f"the model's + {reward}"
        ends = "with the model" if task.terminal == FALSE else str(task.terminal)
        rows.append((short(task.name), listed(task.actions, 8), short(ends, 60), short(reward, 60)))
    columns = ["task", "chooses among", "ends where", "reward"]
    return view(
        heading("task hierarchy", plural(len(tasks.tasks), "task")),
        drawing(graph(tasks)),
        table(columns, rows, left=range(4)),
    )


def graph(tasks: TaskHierarchy, facts: Mapping[str, Sequence[str]] | None = None) -> Graph:
    """Tasks from the root down; `facts` are lines about each, as of a plan."""
    names = {task.name for task in tasks.tasks}
    ordered = _root_first(tasks)[:SHOWN_TASKS]
    kept = {task.name for task in ordered}
    nodes, edges = [], []
    for task in ordered:
        primitive = [short(a, 24) for a in task.actions if a not in names]
        extra = [f"… {len(primitive) - SHOWN_ACTIONS} more"] if len(primitive) > SHOWN_ACTIONS else []
        lines = [short(task.name), *wrapped([*primitive[:SHOWN_ACTIONS], *extra])]
        if facts is not None:
            lines += facts[task.name]
        else:
            if task.terminal != FALSE:
                lines.append(short(f"until {task.terminal}", LONGEST))
            if task.solver is not None:
                lines.append(f"solver {short(task.solver)}")
        title = f"{task.name}: {listed(task.actions, 30)}"
        nodes.append(Node(task.name, tuple(lines), "task", printable(title)))
        children = dict.fromkeys(a for a in task.actions if a in kept)
        edges += [Edge(task.name, child) for child in children]
    left = len(tasks.tasks) - len(ordered)
    note = f"shown: {SHOWN_TASKS} of {len(tasks.tasks):,} tasks" if left else ""
    return Graph(
        tuple(nodes), tuple(edges), "Task hierarchy: each task and its primitive actions", "auto", note
    )


def _root_first(tasks: TaskHierarchy) -> list[Any]:
    """Tasks, parents' before children's where that is possible, by breadth from the roots."""
    by_name = {task.name: task for task in tasks.tasks}
    queue = [task.name for task in tasks.roots()] or list(by_name)
    seen = dict.fromkeys(queue)
    for name in queue:
        for child in by_name[name].actions:
            if child in by_name and child not in seen:
                seen[child] = None
                queue.append(child)
    return [by_name[name] for name in [*seen, *(n for n in by_name if n not in seen)]]


# -- plans -------------------------------------------------------------------------------------------


def plan_graph(plan: Any) -> Graph:
    """The hierarchy of a plan, with the figures of each task."""
    return graph(plan.tasks, {row["name"]: facts(row) for row in task_rows(plan)})


def facts(row: Mapping[str, Any]) -> list[str]:
    """What is known of a solved task, for its box."""
    size = "no blocks" if row["blocks"] is None else plural(row["blocks"], "block")
    lines = [f"{size}, {row['solver']}"]
    if "lower" in row:
        lines.append(f"value {number_text(row['lower'])} .. {number_text(row['upper'])}")
    else:
        lines.append(f"value {number_text(row['value'])}")
    return lines


def task_rows(plan: Any) -> list[dict[str, Any]]:
    """A row for each task of a plan, children first: the keys of its report."""
    from factored_polca.hierarchy import HierarchicalPlan, PomdpPlan
    from factored_polca.hierarchy.pomdp_report import task_report
    from factored_polca.hierarchy.report import plan_report

    if isinstance(plan, HierarchicalPlan):
        return list(plan_report(plan)["tasks"])
    if isinstance(plan, PomdpPlan):
        return [task_report(solved) for solved in plan.solved]
    by_name = {row["name"]: row for row in plan.report.get("tasks", ())}
    return [by_name.get(name) or _bare(plan, name) for name in plan.policies]


def _bare(plan: Any, name: str) -> dict[str, Any]:
    """What an executable plan without a report knows of a task."""
    policy = plan.policies[name]
    return {
        "name": name,
        "actions": list(policy.actions),
        "blocks": policy.partition.blocks,
        "solver": "not told",
        "value": float("nan"),
    }


def plan_html(plan: Any) -> str:
    """A plan: the hierarchy with its figures, and what the whole is worth."""
    rows = task_rows(plan)
    model = plan.model
    detail = f"{plural(model.states, 'state')}, {plural(len(rows), 'task')}"
    return view(
        heading(f"plan of {short(model.name)}", detail),
        *(line(text) for text in _worth(plan)),
        drawing(plan_graph(plan)),
        _table(rows),
    )


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    partial = any("lower" in row for row in rows)
    columns = ["task", "actions", "blocks", "solver"]
    columns += ["value as planned", "corner gap"] if partial else ["Q-values", "classes", "value"]
    cells = []
    for row in rows[:SHOWN_TASKS]:
        blocks = "–" if row["blocks"] is None else count_text(row["blocks"])
        cell = [short(row["name"]), len(row["actions"]), blocks, row["solver"]]
        if partial:
            cell += [
                f"{number_text(row['lower'])} .. {number_text(row['upper'])}",
                number_text(row["corner_gap"], 2),
            ]
        else:
            counts = ["–" if row.get(key) is None else row[key] for key in ("q_values", "q_classes")]
            cell += [*counts, number_text(row["value"])]
        cells.append([*cell, seconds_text(row["seconds"]) if "seconds" in row else "–"])
    return table([*columns, "time"], cells, left=(0, 3))


def _worth(plan: Any) -> list[str]:
    """Lines about the value of a whole plan."""
    from factored_polca.hierarchy import HierarchicalPlan, PomdpPlan
    from factored_polca.hierarchy.pomdp_report import guarantee as partial_guarantee
    from factored_polca.hierarchy.report import guarantee

    if isinstance(plan, HierarchicalPlan):
        flat = f"left out ({plan.flat_note})" if plan.flat is None else number_text(plan.flat.value, 9)
        return [
            f"the polled policy is worth {number_text(plan.polled.value, 9)} from the start",
            f"the flat optimum: {flat}",
            guarantee(plan),
        ]
    if isinstance(plan, PomdpPlan):
        upper = plan.flat.upper
        most = (
            "" if upper is None else f"no policy earns more than {number_text(upper, 6)} ({plan.flat.note})"
        )
        return [most, partial_guarantee(plan)]
    report = plan.report
    value, error = report.get("value"), report.get("standard_error")
    said = "" if value is None else f"value {number_text(float(value), 9)}"
    if error is not None:
        said += f" ± {number_text(float(error), 2)} (measured)"
    return [said, str(report.get("guarantee", ""))]
