"""The structural check of a model: everything that can be seen without its probabilities.

`check` returns all faults at once, each with the path of the place in the model, so that a reader
of a format can add file, line and column.  What needs the values of expressions (rows that sum to
1, values outside a feature) is checked by `factored_polca.symbolic.check`, on diagrams.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import networkx as nx

from factored_polca.models.errors import Fault
from factored_polca.models.expressions import (
    Expression,
    Lottery,
    Reference,
    Switch,
    children,
    references,
)
from factored_polca.models.features import Feature, position
from factored_polca.models.model import Action, Model, Observation
from factored_polca.models.scalars import scalar
from factored_polca.models.scope import Scope
from factored_polca.models.tasks import Task, TaskHierarchy

MAXIMUM_FEATURES = 10_000
MAXIMUM_VALUES = 100_000
MAXIMUM_EXPRESSION_DEPTH = 300

Path = tuple[str, ...]


@dataclass
class _Context:
    """What the expressions of a model are checked against, and what is known of them so far.

    Tables `depths`, `primed` and `sound` are by the identity of parts, which the model keeps alive:
    parts that expressions share are looked at once.
    """

    model: Model
    scope: Scope = field(init=False)
    features: Mapping[str, Feature] = field(init=False)
    depths: dict[int, int] = field(default_factory=dict)
    primed: dict[int, frozenset[str]] = field(
        default_factory=dict
    )  # features whose next value is mentioned
    sound: dict[tuple[bool, bool, bool], set[int]] = field(default_factory=dict)
    effects: set[Expression] = field(default_factory=set)  # without faults

    def __post_init__(self) -> None:
        self.scope = self.model.scope()
        self.features = {feature.name: feature for feature in self.model.features}

    def look(self, expression: Expression) -> None:
        """Fill `depths` and `primed` for an expression and its parts, without recursion."""
        stack = [(expression, False)]
        while stack:
            part, ready = stack.pop()
            if id(part) in self.depths:
                continue
            parts = children(part)
            if not ready:
                stack.append((part, True))
                stack.extend((child, False) for child in parts)
                continue
            self.depths[id(part)] = 1 + max((self.depths[id(child)] for child in parts), default=0)
            known = {id(names): names for child in parts if (names := self.primed[id(child)])}
            if isinstance(part, Reference) and part.primed:
                self.primed[id(part)] = frozenset([part.name])
            elif len(known) == 1:
                (self.primed[id(part)],) = known.values()
            else:
                self.primed[id(part)] = frozenset().union(*known.values())

    def unknown_parts(self, expression: Expression, sound: set[int]) -> Iterator[Expression]:
        """The parts of an expression that are not in `sound`, each once, parts after the whole."""
        seen: set[int] = set()
        stack = [expression]
        while stack:
            part = stack.pop()
            if id(part) in seen or id(part) in sound:
                continue
            seen.add(id(part))
            yield part
            stack.extend(reversed(children(part)))


def check(model: Model) -> list[Fault]:
    """All structural faults of `model`, in the order of the model's parts."""
    return list(model_faults(model))


def model_faults(model: Model) -> Iterator[Fault]:
    """The structural faults of `model`, one after the other."""
    context = _Context(model)
    if not model.name.isprintable():
        yield Fault(f"the model's name {model.name!r} has a character that can't be shown", ("name",))
    yield from _check_features(model)
    yield from _check_numbers(model)
    if not model.actions:
        yield Fault("the model has no action", ("actions",))
    names = [action.name for action in model.actions]
    yield from _duplicates("action", names, ("actions",))
    for action in model.actions:
        yield from _check_action(context, action)
    for index, term in enumerate(model.rewards):
        yield from _check_expression(context, term, ("reward", str(index)), primed=True, observed=True)
    yield from _check_expression(context, model.terminal, ("terminal",))
    yield from _check_initial(context)


def _duplicates(what: str, names: Iterable[str], path: Path) -> Iterator[Fault]:
    for name, count in Counter(names).items():
        if count > 1:
            yield Fault(f"{what} {name!r} is defined {count} times", (*path, name))
        if not is_name(name):
            message = f"{what} name {name!r} is empty, or has a quote or a character that can't be shown"
            yield Fault(message, (*path, name))


def is_name(text: str) -> bool:
    """Whether `text` can name something: not empty, no quote in it, all of it seen when it is shown.

    So no name clears a screen, hides characters or turns the direction of writing round.
    """
    return bool(text) and text.isprintable() and not any(c in '`"' for c in text)


def _check_features(model: Model) -> Iterator[Fault]:
    if not model.features:
        yield Fault("the model has no feature", ("features",))
    if len(model.features) > MAXIMUM_FEATURES:
        yield Fault(f"more than {MAXIMUM_FEATURES} features", ("features",))
    names = [feature.name for feature in model.features]
    names += [observation.name for observation in model.observations]
    names += [name for name, _ in model.parameters]
    yield from _duplicates("name", names, ("features",))
    variables: list[tuple[str, Feature | Observation]] = [("features", f) for f in model.features]
    variables += [("observations", o) for o in model.observations]
    for section, variable in variables:
        path = (section, variable.name)
        if not variable.values:
            yield Fault(f"{variable.name!r} has no values", path, "give at least one value")
        if len(variable.values) > MAXIMUM_VALUES:
            yield Fault(f"{variable.name!r} has more than {MAXIMUM_VALUES} values", path)
        keys = Counter((type(value), value) for value in variable.values)
        for (_, value), count in keys.items():
            if count > 1:
                yield Fault(f"{variable.name!r} lists the value {value!r} {count} times", path)
            if isinstance(value, str) and not is_name(value):
                message = (
                    f"{variable.name!r} has the value {value!r}: empty, or with a quote or a character"
                )
                yield Fault(f"{message} that can't be shown", path)


def _check_numbers(model: Model) -> Iterator[Fault]:
    if not 0 <= model.discount <= 1:
        yield Fault(f"the discount is {model.discount}", ("discount",), "0 <= discount <= 1")
    if model.observability not in ("full", "partial"):
        yield Fault(
            f"observability is {model.observability!r}", ("observability",), 'it is "full" or "partial"'
        )
    if model.horizon is not None and model.horizon < 1:
        yield Fault(f"the horizon is {model.horizon}", ("horizon",), "at least 1, or none")
    if model.discount == 1 and model.observability == "partial" and model.horizon is None:
        yield Fault(
            "a partially observed model with discount 1 and no horizon has no defined value",
            ("discount",),
            "give a discount below 1 or a horizon",
        )
    if model.observability == "full":
        for observation in model.observations:
            yield Fault(
                f"observation {observation.name!r} in a fully observed model",
                ("observations", observation.name),
                'set observability = "partial", or remove the observation',
            )


def _check_action(context: _Context, action: Action) -> Iterator[Fault]:
    path: Path = ("actions", action.name)
    model, features = context.model, context.features
    channels = {observation.name: observation for observation in model.observations}
    for name, count in Counter(name for name, _ in action.effects).items():
        if name not in features:
            yield Fault(
                f"an effect on {name!r}, which is no feature", (*path, "effects", name),
                f"features are {_names(features)}",
            )  # fmt: skip
        if count > 1:
            yield Fault(f"{count} effects on {name!r}", (*path, "effects", name))
    for name, effect in action.effects:
        if effect in context.effects:  # other actions have it, too
            continue
        faults = list(
            _check_expression(context, effect, (*path, "effects", name), primed=True, distribution=True)
        )
        yield from faults
        if not faults:
            context.effects.add(effect)
    yield from _check_cycle(context, action, path)
    yield from _check_expression(context, action.applicable, (*path, "applicable"))
    if model.observability == "partial" and action.applicable != _TRUE:
        yield Fault(
            f"action {action.name!r} is not applicable everywhere", (*path, "applicable"),
            "under partial observability actions are total: state what happens where it has no effect",
        )  # fmt: skip
    for index, term in enumerate(action.rewards):
        yield from _check_expression(
            context, term, (*path, "reward", str(index)), primed=True, observed=True
        )
    for name, sensed in action.senses:
        if name not in channels:
            yield Fault(
                f"senses {name!r}, which is no observation", (*path, "senses", name),
                f"observations are {_names(channels)}",
            )  # fmt: skip
        yield from _check_expression(
            context, sensed, (*path, "senses", name), primed=True, distribution=True
        )
    sensed_names = {name for name, _ in action.senses}
    for channel in model.observations:
        if channel.name not in sensed_names and position(channel.values, channel.null) is None:
            yield Fault(
                f"does not sense {channel.name!r}, whose values lack {channel.null!r}",
                (*path, "senses"),
                f"add {channel.null!r} to the values of {channel.name!r} or say what is sensed",
            )


def _check_cycle(context: _Context, action: Action, path: Path) -> Iterator[Fault]:
    graph = nx.DiGraph()
    for name, effect in action.effects:
        context.look(effect)
        graph.add_edges_from((parent, name) for parent in sorted(context.primed[id(effect)]))
    if not graph:
        return
    try:
        cycle = nx.find_cycle(graph)
    except nx.NetworkXNoCycle:
        return
    names = [f"{edge[0]}'" for edge in cycle]
    yield Fault(
        f"next values depend on each other in a circle: {' -> '.join([*names, names[0]])}",
        (*path, "effects", cycle[0][1]),
        "a next value may depend on other next values only acyclically",
    )


def _check_initial(context: _Context) -> Iterator[Fault]:
    model, features = context.model, context.features
    graph = nx.DiGraph()
    for name, expression in model.initial.distributions:
        path = ("initial", name)
        if name not in features:
            hint = f"features are {_names(features)}"
            yield Fault(f"initial belief of {name!r}, which is no feature", path, hint)
        yield from _check_expression(context, expression, path, distribution=True)
        graph.add_edges_from((reference.name, name) for reference in references(expression))
    yield from _duplicates(
        "initial distribution of", (n for n, _ in model.initial.distributions), ("initial",)
    )
    if not nx.is_directed_acyclic_graph(graph):
        yield Fault("the initial distributions depend on each other in a circle", ("initial",))
    for index, factor in enumerate(model.initial.factors):
        yield from _check_expression(context, factor, ("initial", "factors", str(index)))


def _check_expression(
    context: _Context,
    expression: Expression,
    path: Path,
    *,
    primed: bool = False,
    observed: bool = False,
    distribution: bool = False,
) -> Iterator[Fault]:
    context.look(expression)
    if context.depths[id(expression)] > MAXIMUM_EXPRESSION_DEPTH:
        yield Fault(f"nested deeper than {MAXIMUM_EXPRESSION_DEPTH} levels", path)
        return
    sound = context.sound.setdefault((primed, observed, distribution), set())
    parts = list(context.unknown_parts(expression, sound))
    faulty = False
    for fault in _part_faults(context, parts, path, primed, observed, distribution):
        faulty = True
        yield fault
    if not faulty:  # else a part is told of at each place
        sound.update(map(id, parts))


def _part_faults(
    context: _Context,
    parts: Iterable[Expression],
    path: Path,
    primed: bool,
    observed: bool,
    distribution: bool,
) -> Iterator[Fault]:
    scope, features = context.scope, context.features
    for part in parts:
        if isinstance(part, Reference):
            meaning = scope.resolve(part)
            if isinstance(meaning, str):
                yield Fault(meaning, path)
            elif part.primed and not primed:
                yield Fault(f"{part.name}' (the next state) can't be used here", path)
            elif part.name in scope.observations and not observed:
                yield Fault(f"the observation {part.name!r} can't be used here", path)
        elif isinstance(part, Switch) and part.reference.name in features:
            values = features[part.reference.name].values
            for value, _ in part.cases:
                if position(values, value) is None:
                    yield Fault(
                        f"{value!r} is no value of {part.reference.name!r}", path,
                        f"its values are {_listed(values)}",
                    )  # fmt: skip
            covered = {position(values, value) for value, _ in part.cases}
            if part.otherwise is None and len(covered - {None}) < len(values):
                missing = [v for i, v in enumerate(values) if i not in covered]
                yield Fault(
                    f"a switch over {part.reference.name!r} has no case for {_listed(missing)}", path,
                    "add the cases or an else",
                )  # fmt: skip
        elif isinstance(part, Lottery) and not distribution:
            yield Fault("a distribution can't be used here: a number or condition is expected", path)


def _names(names: Iterable[str]) -> str:
    """Some of `names`."""
    found = list(names)
    return ", ".join(found[:12]) + (", ..." if len(found) > 12 else "") or "none"


def _listed(values: Iterable[object]) -> str:
    shown = [str(scalar(v)) if not isinstance(v, bool) else str(v).lower() for v in values]  # type: ignore[arg-type]
    return ", ".join(shown[:12]) + (", ..." if len(shown) > 12 else "")


def check_tasks(model: Model, hierarchy: TaskHierarchy) -> list[Fault]:
    """All structural faults of `hierarchy` over `model`."""
    return list(task_faults(model, hierarchy))


def task_faults(model: Model, hierarchy: TaskHierarchy) -> Iterator[Fault]:
    """The structural faults of `hierarchy` over `model`, one after the other."""
    context = _Context(model)
    actions = {action.name for action in model.actions}
    tasks = {task.name: task for task in hierarchy.tasks}
    if not tasks:
        yield Fault("there is no task", ("tasks",), "add one [tasks.NAME] with actions = [...]")
        return
    yield from _duplicates("task", (task.name for task in hierarchy.tasks), ("tasks",))
    for name in actions & set(tasks):
        yield Fault(f"{name!r} is the name of a task and of an action", ("tasks", name))
    for task in hierarchy.tasks:
        yield from _check_task(context, task, actions, tasks)
    graph = nx.DiGraph()
    graph.add_nodes_from(tasks)
    graph.add_edges_from((t.name, a) for t in hierarchy.tasks for a in t.actions if a in tasks)
    if not nx.is_directed_acyclic_graph(graph):
        cycle = [edge[0] for edge in nx.find_cycle(graph)]
        circle = " -> ".join([*cycle, cycle[0]])
        yield Fault(f"tasks call each other in a circle: {circle}", ("tasks", cycle[0]))
        return
    roots = hierarchy.roots()
    if len(roots) > 1:
        names = ", ".join(task.name for task in roots)
        yield Fault(
            f"{len(roots)} tasks are nobody's child: {names}", ("tasks", roots[1].name),
            "exactly one task, the root, may stand at the top: every other must be reachable from it",
        )  # fmt: skip


def _check_task(
    context: _Context, task: Task, actions: set[str], tasks: dict[str, Task]
) -> Iterator[Fault]:
    path: Path = ("tasks", task.name)
    if not task.actions:
        yield Fault("the task has no action", (*path, "actions"))
    for name, count in Counter(task.actions).items():
        if name not in actions and name not in tasks:
            listed = f"{_names(sorted(actions))}, {_names(tasks)}"
            yield Fault(
                f"{name!r} is neither an action nor a task", (*path, "actions"), f"known are {listed}"
            )
        if count > 1:
            yield Fault(f"lists {name!r} {count} times", (*path, "actions"))
    yield from _check_expression(context, task.terminal, (*path, "terminal"))
    for index, term in enumerate(task.pseudo_rewards):
        yield from _check_expression(context, term, (*path, "pseudo_reward", str(index)), primed=True)
    for name, terms in task.pseudo_rewards_of:
        if name not in actions:
            yield Fault(f"a pseudo-reward for {name!r}, which is no action", (*path, "pseudo_reward", name))
        for term in terms:
            yield from _check_expression(context, term, (*path, "pseudo_reward", name), primed=True)
    channels = {observation.name for observation in context.model.observations}
    for name in task.observes or ():
        if name not in channels:
            listed = _names(sorted(channels))
            yield Fault(f"observes {name!r}, which is no observation: {listed}", (*path, "observes"))


_TRUE = Action("").applicable
