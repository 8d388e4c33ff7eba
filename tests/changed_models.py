"""Changes of a model that must not change what is planned with it: names, order, irrelevant features.

`relabel` works for any expression.  A feature x with new values is read through a *decoder*,
`switch(x, new_1: old_1, ...)`, and what an effect gives it is written through an *encoder*,
`new_1 if e == old_1 else ...`, so arithmetic on old values keeps its meaning.
"""

from __future__ import annotations

from collections.abc import Mapping
from random import Random

from random_dynamics import Reader, chances, constant, told_apart

from factored_polca.models import (
    Action,
    Conditional,
    Constant,
    Expression,
    Feature,
    InitialBelief,
    Lottery,
    Model,
    Operation,
    Switch,
    Value,
    lottery,
    operation,
    uniform,
)
from factored_polca.models.expressions import Reference
from factored_polca.models.model import replace_fields
from factored_polca.models.scalars import same, scalar


def replace_action(action: Action, **changes: object) -> Action:
    """A copy of `action` with some fields changed."""
    fields = {name: getattr(action, name) for name in ("applicable", "rewards", "senses")}
    effects = changes.pop("effects", action.effects)
    name = changes.pop("name", action.name)
    return Action(str(name), effects, **{**fields, **changes})  # type: ignore[arg-type]


class _Relabelling:
    """New names of features and values, and expressions rewritten to use them."""

    def __init__(self, random: Random, model: Model) -> None:
        numbers = random.sample(range(100, 1000), len(model.features))
        self.old = {feature.name: feature for feature in model.features}
        self.name = {f.name: f"feature_{n}" for f, n in zip(model.features, numbers, strict=True)}
        self.values = {f.name: _new_values(random, f) for f in model.features}

    def feature(self, feature: Feature) -> Feature:
        return Feature(self.name[feature.name], self.values[feature.name], feature.observed)

    def read(self, e: Expression) -> Expression:
        """`e` with the new names; its value is an old one where it had a value of a feature."""
        match e:
            case Reference():
                pairs = zip(self.values[e.name], self.old[e.name].values, strict=True)
                return Switch(self.reference(e), tuple((new, constant(old)) for new, old in pairs))
            case Switch():
                rename = self.rename(e.reference.name)
                cases = tuple((rename[type(v), v], self.read(case)) for v, case in e.cases)
                otherwise = None if e.otherwise is None else self.read(e.otherwise)
                return Switch(self.reference(e.reference), cases, otherwise)
            case Conditional():
                return Conditional(self.read(e.condition), self.read(e.then), self.read(e.otherwise))
            case Operation():
                return operation(e.operator, *(self.read(argument) for argument in e.arguments))
            case Lottery():
                return Lottery(tuple((self.read(v), self.read(q)) for v, q in e.outcomes))
        return e

    def write(self, name: str, e: Expression) -> Expression:
        """`e`, which gives feature `name` its value, with the new names and values."""
        match e:
            case Conditional():
                branches = self.write(name, e.then), self.write(name, e.otherwise)
                return Conditional(self.read(e.condition), *branches)
            case Switch():
                rename = self.rename(e.reference.name)
                cases = tuple((rename[type(v), v], self.write(name, case)) for v, case in e.cases)
                otherwise = None if e.otherwise is None else self.write(name, e.otherwise)
                return Switch(self.reference(e.reference), cases, otherwise)
            case Lottery():
                return Lottery(tuple((self.write(name, v), self.read(q)) for v, q in e.outcomes))
            case Constant():
                for new, old in zip(self.values[name], self.old[name].values, strict=True):
                    if same(scalar(old), e.value):
                        return constant(new)
                return e
        result = self.read(e)
        encoded = result  # no value of the feature: no new value either, since new and old are disjoint
        for new, old in zip(self.values[name], self.old[name].values, strict=True):
            encoded = Conditional(operation("equal", result, constant(old)), constant(new), encoded)
        return encoded

    def reference(self, reference: Reference) -> Reference:
        return Reference(self.name[reference.name], reference.primed)

    def rename(self, name: str) -> Mapping[tuple[type, Value], Value]:
        pairs = zip(self.old[name].values, self.values[name], strict=True)
        return {(type(old), old): new for old, new in pairs}


def _new_values(random: Random, feature: Feature) -> list[Value]:
    """New values, none of them an old one."""
    count = len(feature.values)
    if isinstance(feature.values[0], str) or random.random() < 0.5:
        return list(random.sample(range(100, 200), count))
    return [f"value_{n}" for n in random.sample(range(100), count)]


def relabel(model: Model, seed: int) -> Model:
    """`model` with other names of features, values and actions, everything in the same order."""
    random = Random(f"relabel {seed} {model.name}")
    new = _Relabelling(random, model)
    labels = random.sample(range(100), len(model.actions))
    initial = InitialBelief(
        [(new.name[name], new.write(name, e)) for name, e in model.initial.distributions],
        [new.read(factor) for factor in model.initial.factors],
    )
    return Model(
        f"{model.name}-relabelled",
        [new.feature(feature) for feature in model.features],
        [
            Action(
                f"action_{label}",
                [(new.name[name], new.write(name, effect)) for name, effect in action.effects],
                applicable=new.read(action.applicable),
                rewards=[new.read(term) for term in action.rewards],
            )
            for label, action in zip(labels, model.actions, strict=True)
        ],
        rewards=[new.read(term) for term in model.rewards],
        terminal=new.read(model.terminal),
        initial=initial,
        discount=model.discount,
        parameters=model.parameters,
    )


def reorder(model: Model, seed: int) -> Model:
    """`model` with its features, their values, its actions and their effects in another order."""
    random = Random(f"reorder {seed} {model.name}")

    def shuffled(items: tuple) -> list:  # type: ignore[type-arg]
        return random.sample(items, len(items))

    features = [Feature(f.name, shuffled(f.values), f.observed) for f in shuffled(model.features)]
    actions = [replace_action(a, effects=shuffled(a.effects)) for a in shuffled(model.actions)]
    initial = InitialBelief(shuffled(model.initial.distributions), shuffled(model.initial.factors))
    return replace_fields(
        model,
        name=f"{model.name}-reordered",
        features=tuple(features),
        actions=tuple(actions),
        initial=initial,
    )


def add_irrelevant_feature(model: Model, seed: int, name: str = "irrelevant") -> Model:
    """`model` with one more feature, which may read all others and which nothing reads."""
    random = Random(f"irrelevant {seed} {model.name}")
    feature = Feature(name, random.choice(((False, True), ("cat", "dog", "owl"), (0, 1))))
    others = list(model.features)
    features = [*others]
    features.insert(random.randint(0, len(others)), feature)
    reader = Reader(random, told_apart(features), {f.name: f for f in features})

    def row() -> Expression:
        shares = chances(random, len(feature.values))
        return lottery(list(zip(map(constant, feature.values), shares, strict=True)))

    actions = []
    for action in model.actions:
        if random.random() < 0.75:
            parents = [Reference(f.name) for f in random.sample(features, min(2, len(features)))]
            parents += [Reference(random.choice(others).name, primed=True)]
            effect = reader.tree(random.sample(parents, random.randint(0, 3)), row)
            action = replace_action(action, effects=[*action.effects, (name, effect)])
        actions.append(action)
    distributions = list(model.initial.distributions)
    if model.initial.factors or random.random() < 0.5:
        distributions.append((name, random.choice((row(), uniform(feature)))))
    return replace_fields(
        model,
        name=f"{model.name}-and-more",
        features=tuple(features),
        actions=tuple(actions),
        initial=InitialBelief(distributions, model.initial.factors),
    )
