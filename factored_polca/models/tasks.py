"""Task hierarchies: which subtask chooses among which actions, and what it wants.

A hierarchy is an acyclic graph.  A task's `actions` are primitive actions of the model or other
tasks; one task, the root, is nobody's child.  A task ends where its `terminal` condition or the
model's holds.  Its local reward (the paper's R-bar) is the model's, or its `pseudo_rewards` *in
place of* the model's, or both added where `adds_reward` is set (Pineau, Gordon & Thrun 2003, 4.1).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from factored_polca.drawn import DrawnGraph
from factored_polca.models.expressions import FALSE, Expression, ExpressionLike, as_expression
from factored_polca.models.model import Model, _terms, resolve


@dataclass(frozen=True)
class Task:
    """A subtask.

    `pseudo_rewards` are terms over x and optionally x'; `pseudo_rewards_of` are further terms of
    single primitive actions.  `observes` lists the observation features the task plans with (None:
    all).  `solver` names the solver of this task (None: the planner's choice).
    """

    name: str
    actions: tuple[str, ...]
    terminal: Expression = FALSE
    pseudo_rewards: tuple[Expression, ...] = ()
    pseudo_rewards_of: tuple[tuple[str, tuple[Expression, ...]], ...] = ()
    adds_reward: bool = False
    observes: tuple[str, ...] | None = None
    solver: str | None = None

    def __init__(
        self,
        name: str,
        actions: Iterable[str],
        *,
        terminal: ExpressionLike = FALSE,
        pseudo_rewards: ExpressionLike | Iterable[ExpressionLike] = (),
        pseudo_rewards_of: Mapping[str, Any] | Iterable[tuple[str, Any]] = (),
        adds_reward: bool = False,
        observes: Iterable[str] | None = None,
        solver: str | None = None,
    ) -> None:
        put = object.__setattr__
        put(self, "name", name)
        put(self, "actions", tuple(actions))
        put(self, "terminal", as_expression(terminal))
        put(self, "pseudo_rewards", _terms(pseudo_rewards))
        items = pseudo_rewards_of.items() if isinstance(pseudo_rewards_of, Mapping) else pseudo_rewards_of
        put(self, "pseudo_rewards_of", tuple((key, _terms(value)) for key, value in items))
        put(self, "adds_reward", adds_reward)
        put(self, "observes", None if observes is None else tuple(observes))
        put(self, "solver", solver)

    @property
    def has_pseudo_reward(self) -> bool:
        """Whether the task brings a reward of its own."""
        return bool(self.pseudo_rewards or self.pseudo_rewards_of)


@dataclass(frozen=True)
class TaskHierarchy(DrawnGraph):
    """The tasks of a hierarchy, in any order."""

    tasks: tuple[Task, ...]

    def __init__(self, tasks: Iterable[Task]) -> None:
        object.__setattr__(self, "tasks", tuple(tasks))

    def task(self, name: str) -> Task:
        """The task called `name`.

        Raises:
            KeyError: there is none; the message lists those there are.
        """
        for task in self.tasks:
            if task.name == name:
                return task
        raise KeyError(f"no task {name!r}; there are {', '.join(t.name for t in self.tasks)}")

    def roots(self) -> tuple[Task, ...]:
        """The tasks that are nobody's child; a sound hierarchy has one."""
        children = {action for task in self.tasks for action in task.actions}
        return tuple(task for task in self.tasks if task.name not in children)


def resolve_tasks(model: Model, tasks: TaskHierarchy) -> TaskHierarchy:
    """`tasks` with the names in their expressions resolved against `model`."""
    return TaskHierarchy(
        Task(
            task.name,
            task.actions,
            terminal=resolve(model, task.terminal),
            pseudo_rewards=[resolve(model, e) for e in task.pseudo_rewards],
            pseudo_rewards_of=[
                (name, [resolve(model, e) for e in terms]) for name, terms in task.pseudo_rewards_of
            ],
            adds_reward=task.adds_reward,
            observes=task.observes,
            solver=task.solver,
        )
        for task in tasks.tasks
    )


def flat_task(model: Model) -> TaskHierarchy:
    """The hierarchy of one task that holds every action of `model`."""
    return TaskHierarchy([Task("flat", [action.name for action in model.actions])])
