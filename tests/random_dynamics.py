"""Random decision trees, conditional distributions and numbers, the parts of random models.

A *core* of features matters: its readers read only the core.  They may be blind to the difference
between some values of a feature (its *groups*); which value of a group comes next may depend on
anything.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from random import Random

from factored_polca.models import (
    FALSE,
    TRUE,
    Conditional,
    Constant,
    Expression,
    Feature,
    Parameter,
    Switch,
    Value,
    conjunction,
    disjunction,
    lottery,
    operation,
)
from factored_polca.models.expressions import Reference
from factored_polca.models.scalars import scalar

NAMES = ("red", "green", "blue", "grey", "low", "high", "open", "shut")
Leaf = Callable[[], Expression]
Groups = dict[str, tuple[tuple[Value, ...], ...]]


def constant(value: Value) -> Constant:
    """The expression of a feature's value."""
    return Constant(scalar(value))


def chances(random: Random, count: int) -> list[Fraction]:
    """`count` probabilities that sum to exactly 1; some may be 0."""
    parts = random.choice((10, 10, 100, 100, 3, 7))
    cuts = [0, *sorted(random.randint(0, parts) for _ in range(count - 1)), parts]
    return [Fraction(b - a, parts) for a, b in pairwise(cuts)]


def amount(random: Random) -> Fraction:
    """A reward: an integer, a decimal or a number of thirds."""
    parts = random.choice((1, 1, 10, 100, 3))
    return Fraction(random.randint(-6 * parts, 9 * parts), parts)


def is_range(feature: Feature) -> bool:
    """Whether the values are consecutive integers, in any order."""
    values = [value for value in feature.values if type(value) is int]
    return len(values) == len(feature.values) and max(values) - min(values) == len(values) - 1


@dataclass(frozen=True)
class Reader:
    """What an expression may read: features by name, and the groups of values it tells apart."""

    random: Random
    groups: Groups
    features: dict[str, Feature]

    def plain(self, name: str) -> bool:
        """Whether every value of the feature is told apart."""
        return len(self.groups[name]) == len(self.features[name].values)

    def condition(self, reference: Reference) -> Expression:
        """A condition on one reference that holds for some values and not for all."""
        random, feature, groups = self.random, self.features[reference.name], self.groups[reference.name]
        if not self.plain(feature.name) or (feature.values[0] != False and random.random() < 0.4):  # noqa: E712
            chosen = random.sample(groups, random.randint(1, len(groups) - 1))
            return reference.is_in([value for group in chosen for value in group])
        value = random.choice(feature.values)
        if isinstance(value, bool):
            return random.choice((reference, ~reference, reference.is_(value)))
        if isinstance(value, str):
            test = reference.is_(value)
            return random.choice((test, ~test, operation("not_equal", reference, constant(value))))
        middle = sorted(feature.values, key=int)[random.randint(1, len(feature.values) - 1)]
        return random.choice(
            (reference < middle, reference >= middle, operation("not_equal", reference, value))
        )

    def conditions(self, references: Sequence[Reference]) -> Expression:
        """A condition on some of `references`."""
        chosen = self.random.sample(list(references), min(len(references), self.random.randint(1, 2)))
        parts = [self.condition(reference) for reference in chosen]
        return self.random.choice((conjunction, disjunction))(parts)

    def tree(self, references: Sequence[Reference], leaf: Leaf) -> Expression:
        """A decision tree over `references` with a new leaf at each end."""
        if not references:
            return leaf()
        first, rest = references[0], references[1:]
        if self.random.random() < 0.4:
            return Conditional(self.condition(first), self.tree(rest, leaf), self.tree(rest, leaf))
        groups = list(self.groups[first.name])
        self.random.shuffle(groups)
        branches = [self.tree(rest, leaf) for _ in groups]
        otherwise = branches.pop() if len(groups) > 1 and self.random.random() < 0.4 else None
        pairs = zip(groups, branches, strict=False)
        cases = tuple((value, branch) for group, branch in pairs for value in group)
        return Switch(first, cases, otherwise)


@dataclass(frozen=True)
class Domain:
    """The features of a model to be, which of them are its core, and the two kinds of readers."""

    random: Random
    features: tuple[Feature, ...]
    core: frozenset[str]
    core_reader: Reader
    any_reader: Reader
    parameters: tuple[tuple[str, Fraction], ...]
    palette: tuple[Fraction, ...]

    def amount(self) -> Fraction:
        """A reward; few different ones in some models, so that rewards alone split little."""
        return self.random.choice(self.palette)

    def reader_of(self, name: str) -> Reader:
        """The reader that the dynamics of feature `name` may use."""
        return self.core_reader if name in self.core else self.any_reader

    def readable(self, name: str) -> list[str]:
        """The features that the dynamics of feature `name` may read."""
        return [f.name for f in self.features if name not in self.core or f.name in self.core]

    def pick(self, names: Sequence[str], least: int, most: int, primed: bool = False) -> list[Reference]:
        """Between `least` and `most` references to some of `names`."""
        count = min(len(names), self.random.randint(least, most))
        return [Reference(name, primed) for name in self.random.sample(list(names), count)]


def told_apart(features: Sequence[Feature]) -> Groups:
    """The groups of a reader that tells every value apart."""
    return {f.name: tuple((value,) for value in f.values) for f in features}


def random_domain(
    random: Random, features: int, sizes: tuple[int, int], limit: int, parameters: bool
) -> Domain:
    """Features of several kinds, at most `limit` states, with a core and perhaps twins."""
    counts = [random.randint(*sizes) for _ in range(features)]
    while _product(counts) > limit:
        counts[counts.index(max(counts))] -= 1
    made = tuple(_random_feature(random, f"x{i}", count) for i, count in enumerate(counts) if count > 1)
    made = made or (Feature("x0", (False, True)),)
    names = [feature.name for feature in made]
    core = frozenset(names)
    if len(names) > 1 and random.random() < 0.6:
        core = frozenset(random.sample(names, random.randint(1, len(names) - 1)))
    apart = told_apart(made)
    groups = dict(apart)
    for feature in made:
        if len(feature.values) > 2 and random.random() < 0.3:
            values = random.sample(feature.values, len(feature.values))
            groups[feature.name] = ((values[0], values[1]), *((value,) for value in values[2:]))
    given = (("p", Fraction(1, 7)), ("q", Fraction(3, 10))) if parameters else ()
    by_name = {feature.name: feature for feature in made}
    low = amount(random)
    palette = (
        low,
        low + abs(amount(random)) + 1,
        *(amount(random) for _ in range(random.choice((0, 0, 1, 20)))),
    )
    readers = Reader(random, groups, by_name), Reader(random, apart, by_name)
    return Domain(random, made, core, *readers, given, palette)


def _product(counts: Sequence[int]) -> int:
    total = 1
    for count in counts:
        total *= count
    return total


def _random_feature(random: Random, name: str, count: int) -> Feature:
    if count == 2 and random.random() < 0.6:
        return Feature(name, random.sample((False, True), 2))
    if random.random() < 0.4:
        return Feature(name, random.sample(NAMES, count) if count <= len(NAMES) else _words(count))
    if random.random() < 0.2:
        return Feature(name, [3 * i * i - 1 for i in range(count)])
    start = random.choice((0, 0, 1, -1))
    return Feature(name, range(start, start + count))


def _words(count: int) -> list[str]:
    return [f"{NAMES[i % len(NAMES)]}{i}" for i in range(count)]


# -- effects -----------------------------------------------------------------------------------


def random_effect(domain: Domain, name: str, parents: Sequence[Reference]) -> Expression:
    """A conditional distribution of feature `name` given `parents` (and sometimes itself)."""
    reader = domain.reader_of(name)
    return reader.tree(parents, lambda: _leaf(domain, reader, name, parents))


def _leaf(domain: Domain, reader: Reader, name: str, parents: Sequence[Reference]) -> Expression:
    random, feature, now = domain.random, reader.features[name], Reference(name)
    styles: list[Leaf] = [lambda: _constants(domain, reader, name)] * 3
    styles.append(lambda: now)
    styles.append(lambda: constant(random.choice(feature.values)))
    styles.append(lambda: _stay_or(random, now, feature))
    if is_range(feature) and reader.plain(name):
        numbers = [r for r in parents if is_range(reader.features[r.name]) and reader.plain(r.name)]
        styles += [lambda: _arithmetic(random, now, feature, numbers)] * 3
    if isinstance(feature.values[0], bool):
        styles.append(lambda: _bernoulli(domain, reader, parents))
        if parents:
            styles.append(lambda: reader.condition(random.choice(list(parents))))
    return random.choice(styles)()


def _constants(domain: Domain, reader: Reader, name: str) -> Expression:
    """A lottery over groups of values; which value of a group comes may depend on any feature."""
    random = domain.random
    groups = list(reader.groups[name])
    random.shuffle(groups)
    pairs = []
    for group, chance in zip(groups, chances(random, len(groups)), strict=True):
        outcome: Expression = constant(random.choice(group))
        if len(group) > 1:
            test = domain.any_reader.condition(Reference(random.choice(domain.features).name))
            outcome = Conditional(test, constant(group[0]), constant(group[1]))
        if chance or random.random() < 0.3:
            pairs.append((outcome, chance))
    return lottery(pairs)


def _stay_or(random: Random, now: Reference, feature: Feature) -> Expression:
    share, rest = chances(random, 2)
    return lottery([(now, share), (constant(random.choice(feature.values)), rest)])


def _arithmetic(
    random: Random, now: Reference, feature: Feature, others: Sequence[Reference]
) -> Expression:
    low, high = min(map(int, feature.values)), max(map(int, feature.values))
    share, rest = chances(random, 2)
    up, down = operation("minimum", now + 1, high), operation("maximum", now - 1, low)
    inside = now < high
    other = random.choice(list(others)) if others else now
    return random.choice(
        (
            up,
            lottery([(up, share), (down, rest)]),
            lottery([(up, share), (now, rest)]),
            Conditional(inside, lottery([(now + 1, share), (now, rest)]), now),
            # Out of range at the top, where its probability is 0.
            lottery(
                [
                    (now + 1, Conditional(inside, Constant(share), Constant(Fraction(0)))),
                    (now, Conditional(inside, Constant(rest), Constant(Fraction(1)))),
                ]
            ),
            (now + other * 2) % (high - low + 1) + low,
            operation("minimum", operation("maximum", abs(other - now), low), high),
        )
    )


def _bernoulli(domain: Domain, reader: Reader, parents: Sequence[Reference]) -> Expression:
    random = domain.random
    numbers = [r for r in parents if is_range(reader.features[r.name]) and reader.plain(r.name)]
    chance: Expression = Constant(chances(random, 2)[0])
    if domain.parameters and random.random() < 0.5:
        chance = Parameter(random.choice(domain.parameters)[0])
    elif numbers:
        other = random.choice(numbers)
        low = min(map(int, reader.features[other.name].values))
        chance = (other - low + 1) / 10 + Fraction(1, random.choice((3, 7, 20)))
    return lottery([(TRUE, chance), (FALSE, 1 - chance)])
