"""The state variables that a written POMDPX file has, and its names.

The format's own program, `pomdpsol`, reads a network of two time slices with these arcs only:

    x_0 observed   depends, in the initial belief, on observed variables;
    x_1 observed   depends on the action and variables of the slice before;
    x_1 hidden     also on *observed* variables of its own slice;
    o              on the action and variables of the slice after the action.

What a model has beyond that is brought in without changing its meaning:

- *Clusters.*  Features whose next values are linked in another way are put together, and what is written
  are at most two variables for each cluster, the joint value X of its observed features and that of its
  hidden ones, H: P(X, H | a, before) = P(X | a, before) P(H | X, a, before).
- *Memories.*  Where an observation depends on a feature x before the action, a variable before_x, whose
  next value is x, carries x to the slice after it.
- Terminal states are absorbing, with reward 0 for every action.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod
from typing import Final

from factored_polca.formats.spudd_names import distinct_names
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import (
    FALSE,
    ZERO,
    Conditional,
    Constant,
    Expression,
    Reference,
    references,
    rewrite,
)
from factored_polca.models.features import Feature
from factored_polca.models.model import Action, InitialBelief, Model, replace_fields
from factored_polca.models.scalars import Value, describe, scalar

MAXIMUM_JOINT: Final = 10_000
"""Joint values of the features of one cluster."""

_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_.\-]*\Z")
_VALUE: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_+.\-]*\Z|[+\-][0-9]+\Z")
_TAKEN: Final = {"null", "identity", "uniform"}

Joint = tuple[Value, ...]


@dataclass(frozen=True)
class Column:
    """A state variable of the file: the features whose joint value it is, and its spellings."""

    now: str
    next: str
    members: tuple[Feature, ...]
    observed: bool
    labels: tuple[str, ...]  # of the joint values, the last member running fastest

    @property
    def joints(self) -> list[Joint]:
        """Its joint values."""
        return list(product(*(feature.values for feature in self.members)))


@dataclass(frozen=True)
class Cluster:
    """Features whose next values are written together: observed ones, hidden ones, or both."""

    columns: tuple[Column, ...]  # the observed one first

    @property
    def members(self) -> tuple[Feature, ...]:
        """Its features, in the order of the columns."""
        return tuple(feature for column in self.columns for feature in column.members)


@dataclass(frozen=True)
class Names:
    """The spellings of a file; `changed` tells of new ones."""

    channels: dict[str, str]
    values: dict[str, tuple[str, ...]]  # of channels
    actions: dict[str, str]
    acting: str  # the action variable
    rewards: Callable[[int], str]
    changed: tuple[str, ...]


# -- what the format lacks -------------------------------------------------------------------------


def without_ends(model: Model) -> Model:
    """`model` with its terminal states absorbing and worth nothing."""
    if model.terminal == FALSE:
        return model
    end = model.terminal

    def term(e: Expression) -> Expression:
        return Conditional(end, ZERO, e)

    actions = [
        Action(
            a.name,
            [(name, Conditional(end, Reference(name), e)) for name, e in a.effects],
            applicable=a.applicable,
            rewards=[term(e) for e in a.rewards],
            senses=a.senses,
        )
        for a in model.actions
    ]
    rewards = tuple(term(e) for e in model.rewards)
    return replace_fields(model, actions=tuple(actions), rewards=rewards, terminal=FALSE)


def with_memories(model: Model) -> Model:
    """`model` with a feature before_x for each feature x that an observation depends on before it."""
    read = references(*(e for action in model.actions for _, e in action.senses))
    remembered = [f for f in model.features if Reference(f.name) in read]
    if not remembered:
        return model
    taken = {f.name for f in model.features} | {o.name for o in model.observations}
    taken |= {name for name, _ in model.parameters}
    names: dict[str, str] = {}
    for feature in remembered:
        name = f"before_{feature.name}"
        while name in taken:
            name += "_"
        taken.add(name)
        names[feature.name] = name
    memories = [Feature(names[f.name], f.values, f.observed) for f in remembered]

    def leaf(e: Expression) -> Expression:
        if isinstance(e, Reference) and not e.primed and e.name in names:
            return Reference(names[e.name], primed=True)
        return e

    actions = [
        Action(
            a.name,
            [*a.effects, *((names[f.name], Reference(f.name)) for f in remembered)],
            applicable=a.applicable,
            rewards=a.rewards,
            senses=[(name, rewrite(e, leaf)) for name, e in a.senses],
        )
        for a in model.actions
    ]
    start: list[tuple[str, Expression]] = [(m.name, Constant(scalar(m.values[0]))) for m in memories]
    initial = InitialBelief([*model.initial.distributions, *start], model.initial.factors)
    features = (*model.features, *memories)
    return replace_fields(model, features=features, actions=tuple(actions), initial=initial)


# -- clusters --------------------------------------------------------------------------------------


def clusters_of(model: Model) -> list[list[Feature]]:
    """The features in clusters, in the order of the model."""
    features = {f.name: f for f in model.features}
    arcs = {
        (parent.name, name)
        for action in model.actions
        for name, e in action.effects
        for parent in references(e)
        if parent.primed and parent.name in features
    }
    root = {name: name for name in features}

    def find(name: str) -> str:
        while root[name] != name:
            name = root[name]
        return name

    def with_observed(name: str) -> bool:
        return any(f.observed and find(f.name) == name for f in model.features)

    merged = True
    while merged:
        merged = False
        for parent, child in sorted(arcs):
            one, other = find(parent), find(child)
            if one != other and (not features[parent].observed or with_observed(other)):
                root[other] = one
                merged = True
    found: dict[str, list[Feature]] = {}
    for feature in model.features:
        found.setdefault(find(feature.name), []).append(feature)
    return list(found.values())


# -- names -----------------------------------------------------------------------------------------


def spell(model: Model) -> tuple[list[Cluster], Names]:
    """The columns in their clusters, and the names of everything else.

    Raises:
        ModelError: a cluster with too many joint values.
    """
    groups: list[list[tuple[Feature, ...]]] = []
    for members in clusters_of(model):
        seen = tuple(f for f in members if f.observed)
        hidden = tuple(f for f in members if not f.observed)
        groups.append([part for part in (seen, hidden) if part])
        if prod(len(f.values) for f in members) > MAXIMUM_JOINT:
            listed = ", ".join(f.name for f in members)
            raise ModelError([Fault(
                f"the next values of {listed} depend on each other: their joint values, more than "
                f"{MAXIMUM_JOINT}, would be one variable", ("features", members[0].name),
                "the format has no such arcs: use the native one",
            )])  # fmt: skip
    parts = [part for group in groups for part in group]
    bases = distinct_names([".".join(f.name for f in part) for part in parts], _NAME, set(_TAKEN))
    wanted = [*bases, *(o.name for o in model.observations), "action", "reward"]
    taken = {f"{base}_{i}" for base in bases for i in (0, 1)} | _TAKEN
    spelled = distinct_names(wanted, _NAME, taken)
    if len({*taken, *spelled}) != len(taken) + len(spelled) or len(taken) != 2 * len(bases) + len(_TAKEN):
        bases = [f"x{k}" for k in range(len(bases))]  # names such as x and x_0 beside each other
        taken = {f"{base}_{i}" for base in bases for i in (0, 1)} | _TAKEN
        spelled = distinct_names([*bases, *wanted[len(bases) :]], _NAME, taken)
    others = iter(spelled[len(bases) :])
    changed: list[str] = []
    columns = iter([
        _column(part, base, changed) for part, base in zip(parts, bases, strict=True)
    ])  # fmt: skip
    clusters = [Cluster(tuple(next(columns) for _ in group)) for group in groups]
    channels = {o.name: next(others) for o in model.observations}
    values = {}
    for o in model.observations:
        values[o.name] = _labels([(v,) for v in o.values], channels[o.name], changed)
        _tell(o.name, channels[o.name], changed)
    acting, reward = next(others), next(others)
    actions = [a.name for a in model.actions]
    named = dict(zip(actions, distinct_names(actions, _VALUE, set(_TAKEN)), strict=True))
    for old, new in named.items():
        _tell(f"action {old}", f"action {new}", changed)
    used = {*spelled, *taken}

    def reward_name(number: int) -> str:
        name = reward if number == 0 else f"{reward}_{number + 1}"
        while number and name in used:
            name += "_"
        return name

    return clusters, Names(channels, values, named, acting, reward_name, tuple(changed))


def _column(members: tuple[Feature, ...], base: str, changed: list[str]) -> Column:
    _tell(", ".join(f.name for f in members), base, changed)
    joints = list(product(*(f.values for f in members)))
    labels = _labels(joints, base, changed)
    return Column(f"{base}_0", f"{base}_1", members, members[0].observed, labels)


def _labels(joints: Sequence[Joint], name: str, changed: list[str]) -> tuple[str, ...]:
    old = [".".join(describe(scalar(v)) for v in joint) for joint in joints]
    new = distinct_names(old, _VALUE, set(_TAKEN))
    told = [f"{b} is {a}" for b, a in zip(old, new, strict=True) if a != b]
    if told:
        changed.append(f"values of {name}: {', '.join(told[:50])}")
    return tuple(new)


def _tell(old: str, new: str, changed: list[str]) -> None:
    if old != new:
        changed.append(f"{old} is {new}")
