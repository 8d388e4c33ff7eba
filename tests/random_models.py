"""Random factored models and task hierarchies without symmetry, deterministic in their seed.

Every part of a model is a random decision tree over few features, written in varying styles, with
rational numbers (tenths, hundredths, thirds, sevenths).  So that minimisation finds something to
do, most models have a *core*: rewards, conditions and the core's own dynamics read only the core,
the other features are irrelevant though they may read everything.  In some models a core feature
also has *twins*: values that no core reader tells apart, while which of them comes next may depend
on anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import partial
from random import Random

from changed_models import add_irrelevant_feature, relabel, reorder, replace_action
from random_dynamics import Domain, chances, constant, is_range, random_domain, random_effect
from random_hierarchies import random_tasks

from factored_polca.models import (
    FALSE,
    TRUE,
    Action,
    Constant,
    Expression,
    InitialBelief,
    Model,
    Switch,
    conjunction,
    disjunction,
    lottery,
)
from factored_polca.models.expressions import Reference

__all__ = ["add_irrelevant_feature", "random_model", "random_tasks", "relabel", "reorder"]

DISCOUNTS = (Fraction(9, 10), Fraction(95, 100), Fraction(3, 4), Fraction(2, 3), Fraction(99, 100))


def random_term(domain: Domain, references: Sequence[Reference]) -> Expression:
    """A reward term over some core references."""
    random, reader = domain.random, domain.core_reader
    numbers = [r for r in references if is_range(reader.features[r.name]) and reader.plain(r.name)]
    if numbers and random.random() < 0.3:
        return random.choice(numbers) * domain.amount() + domain.amount()
    first = list(domain.palette[:2])  # two leaves that differ, then any
    return reader.tree(references, lambda: Constant(first.pop() if first else domain.amount()))


def random_action(domain: Domain, name: str, synchronic: bool) -> Action:
    """An action that changes some features; its readers are those of the domain."""
    random = domain.random
    order = random.sample([f.name for f in domain.features], len(domain.features))
    effects: list[tuple[str, Expression]] = []
    for position, target in enumerate(order):
        if random.random() < 0.4 and (effects or position < len(order) - 1):
            continue  # it persists
        readable = domain.readable(target)
        parents = domain.pick(readable, 0, 2)
        if synchronic and random.random() < 0.6:
            parents += domain.pick([n for n in order[:position] if n in readable], 1, 2, primed=True)[:1]
        random.shuffle(parents)
        effects.append((target, random_effect(domain, target, parents)))
    random.shuffle(effects)
    rewards = []
    if random.random() < 0.5:
        core = sorted(domain.core)
        rewards.append(random_term(domain, domain.pick(core, 0, 1) + domain.pick(core, 0, 1, primed=True)))
    return Action(name, effects, rewards=rewards)


def _with_applicability(domain: Domain, actions: list[Action]) -> list[Action]:
    """The same actions, some of them not everywhere; one always steps in where no other applies."""
    random, core = domain.random, sorted(domain.core)
    fallback = random.randrange(len(actions))
    conditions: list[Expression] = []
    for index, action in enumerate(actions):
        condition: Expression = TRUE
        if index != fallback and random.random() < 0.7:
            condition = domain.core_reader.conditions(domain.pick(core, 1, 2))
            ranges = [
                n for n in core if is_range(domain.any_reader.features[n]) and domain.core_reader.plain(n)
            ]
            if ranges and random.random() < 0.4:
                # Undefined at the top, where the action does not apply.
                name = random.choice(ranges)
                now, top = Reference(name), max(map(int, domain.any_reader.features[name].values))
                share, rest = chances(random, 2)
                step = lottery([(now + 1, max(share, Fraction(1, 10))), (now, min(rest, Fraction(9, 10)))])
                effects = [(n, e) for n, e in action.effects if n != name]
                action = replace_action(action, effects=[*effects, (name, step)])
                condition = condition & (now < top)
        conditions.append(condition)
        actions[index] = action
    others = [condition for index, condition in enumerate(conditions) if index != fallback]
    if TRUE not in others and random.random() < 0.7:
        nothing_else = ~disjunction(others) if others else TRUE
        own = domain.core_reader.conditions(domain.pick(core, 1, 1))
        conditions[fallback] = own | nothing_else if others else TRUE
    return [
        replace_action(action, applicable=condition)
        for action, condition in zip(actions, conditions, strict=True)
    ]


def random_initial(domain: Domain) -> InitialBelief:
    """An initial belief of one of the four forms: none, a product, a network, with factors."""
    random = domain.random
    kind = random.choice(("none", "product", "network", "factors"))
    names = random.sample([f.name for f in domain.features], len(domain.features))
    reader = domain.any_reader

    def row(name: str) -> Expression:
        values = reader.features[name].values
        return lottery(list(zip(map(constant, values), chances(random, len(values)), strict=True)))

    if kind == "none":
        return InitialBelief()
    if kind == "product":
        return InitialBelief([(name, row(name)) for name in names if random.random() < 0.7])
    distributions: list[tuple[str, Expression]] = []
    factors: list[Expression] = []
    for position, name in enumerate(names):
        if kind == "factors" and random.random() < 0.6:
            values = reader.features[name].values
            weights = map(Constant, chances(random, len(values)))
            factors.append(Switch(Reference(name), tuple(zip(values, weights, strict=True))))
        elif kind == "factors" and random.random() < 0.3:
            # Without a distribution: 1 for each value, which a constant factor makes up for.
            factors.append(Constant(Fraction(1, len(reader.features[name].values))))
        else:
            parents = domain.pick(names[:position], 0, 2)
            distributions.append((name, reader.tree(parents, partial(row, name))))
    random.shuffle(distributions)
    return InitialBelief(distributions, factors)


def random_model(
    seed: int,
    *,
    features: tuple[int, int] = (2, 5),
    values: tuple[int, int] = (2, 4),
    actions: tuple[int, int] = (2, 4),
    synchronic: bool = True,
    terminal: bool = True,
    inapplicable: bool = True,
    parameters: bool = False,
    max_states: int = 256,
) -> Model:
    """A random fully observed model; ranges include both ends.

    Terminal states and actions that do not apply everywhere occur in about half of the models for
    which they are allowed; at least one action applies in each non-terminal state.
    """
    random = Random(f"model {seed}")
    domain = random_domain(random, random.randint(*features), values, max_states, parameters)
    made = [random_action(domain, f"a{i}", synchronic) for i in range(random.randint(*actions))]
    if inapplicable and random.random() < 0.5:
        made = _with_applicability(domain, made)
    core = sorted(domain.core)
    rewards = [random_term(domain, domain.pick(core, 1, random.choice((1, 2))))]
    if random.random() < 0.3:
        rewards.append(random_term(domain, domain.pick(core, 0, 1) + domain.pick(core, 1, 1, primed=True)))
    ending: Expression = FALSE
    if terminal and random.random() < 0.5:
        parts = [domain.core_reader.condition(r) for r in domain.pick(core, 1, 2)]
        ending = conjunction(parts)
    return Model(
        f"random-{seed}",
        domain.features,
        made,
        rewards=rewards,
        terminal=ending,
        initial=random_initial(domain),
        discount=random.choice(DISCOUNTS),
        parameters=domain.parameters,
    )
