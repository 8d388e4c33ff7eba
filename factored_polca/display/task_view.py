"""A solved task, or the policy of one: its figures, and its choices as a decision tree over features."""

from __future__ import annotations

from typing import Any

import numpy as np

from factored_polca.diagrams import INDEX, Diagram, relabel
from factored_polca.display.graphs import Graph
from factored_polca.display.policy_tree import policy_tree
from factored_polca.display.tables import drawing, heading, line, pairs, view
from factored_polca.display.words import count_text, number_text, plural, seconds_text, short
from factored_polca.hierarchy.executable import TaskPolicy
from factored_polca.hierarchy.solved import AnySolvedTask, SolvedTask
from factored_polca.minimisation import Partition


def html(task: AnySolvedTask | TaskPolicy) -> str:
    """Figures and the tree."""
    if isinstance(task, TaskPolicy):
        detail = plural(task.partition.blocks, "block")
        return view(heading(f"policy of task {short(task.name)}", detail), drawing(graph(task)))
    solution = task.solution
    rows: list[tuple[str, Any]] = [("value from the start", number_text(task.value, 9))]
    if isinstance(task, SolvedTask):
        rows += [("blocks", count_text(task.blocks))]
    rows += [("solver", f"{solution.method}: {solution.status}, gap {number_text(solution.gap, 2)}")]
    if isinstance(task, SolvedTask):
        rows += [
            ("Q-values, classes", f"{task.counts.q_values:,}, {task.counts.q_classes:,}"),
            ("blocks decided by a tie", f"{task.ties:,}"),
        ]
    else:
        rows += [("nodes of the value", count_text(task.solution.nodes))]
    rows += [("time", seconds_text(task.seconds))]
    return view(
        heading(f"task {short(task.task.name)}", solution.guarantee.text),
        pairs(rows),
        *(line(f"warning: {warning}") for warning in task.warnings[:5]),
        drawing(graph(task)),
    )


def graph(task: AnySolvedTask | TaskPolicy) -> Graph:
    """The decision tree of the task's choices."""
    if isinstance(task, TaskPolicy):
        choices = _choices(task.partition, np.asarray(task.choice), len(task.actions))
        return policy_tree(task.partition.symbolic, choices, task.actions)
    if isinstance(task, SolvedTask):
        choices = task.reduction.lift_choices(task.solution.policy)
    else:
        choices = task.solution.choices
    return policy_tree(task.process.symbolic, choices, task.process.names)


def _choices(partition: Partition, choice: np.typing.NDArray[Any], none: int) -> Diagram:
    images = np.where(choice < 0, none, choice).astype(np.uint64)
    return relabel(partition.diagram, np.append(images, np.uint64(none)), INDEX)
