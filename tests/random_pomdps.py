"""Random partially observed models without symmetry, deterministic in their seed.

Dynamics are those of `random_models`.  Each channel is sensed by most actions, the others report its
null value; what is sensed depends on the next state and sometimes on the present one, by random
decision trees with tenths and thirds at their ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from itertools import pairwise
from random import Random

from changed_models import replace_action
from random_dynamics import NAMES, Domain, constant, random_domain
from random_models import DISCOUNTS, random_action, random_initial, random_term

from factored_polca.models import (
    FALSE,
    Action,
    Conditional,
    Constant,
    Expression,
    Feature,
    Model,
    Observation,
    Switch,
    conjunction,
    lottery,
)
from factored_polca.models.expressions import Reference


def random_pomdp(
    seed: int,
    *,
    features: tuple[int, int] = (1, 3),
    values: tuple[int, int] = (2, 3),
    actions: tuple[int, int] = (1, 3),
    channels: tuple[int, int] = (1, 3),
    synchronic: bool = True,
    terminal: bool = True,
    observed: bool = True,
    observed_rewards: bool = True,
    max_states: int = 12,
) -> Model:
    """A random partially observed model; ranges include both ends.

    Terminal states, observed features and rewards on observations each occur in some of the models
    for which they are allowed.  No channels, `channels=(0, 0)`, is a blind model.
    """
    random = Random(f"pomdp {seed}")
    domain = random_domain(random, random.randint(*features), values, max_states, parameters=False)
    if observed and random.random() < 0.4:
        flagged = [Feature(f.name, f.values, random.random() < 0.5) for f in domain.features]
        domain = replace(domain, features=tuple(flagged))
    made = [_random_channel(domain, f"o{i}") for i in range(random.randint(*channels))]
    acting = [
        _with_senses(domain, random_action(domain, f"a{i}", synchronic), made)
        for i in range(random.randint(*actions))
    ]
    core = sorted(domain.core)
    rewards = [random_term(domain, domain.pick(core, 1, 2))]
    if random.random() < 0.3:
        rewards.append(random_term(domain, domain.pick(core, 0, 1) + domain.pick(core, 1, 1, primed=True)))
    if made and observed_rewards and random.random() < 0.5:
        rewards.append(_observed_term(domain, random.sample(made, random.randint(1, min(2, len(made))))))
        acting[0] = replace_action(
            acting[0], rewards=[*acting[0].rewards, _observed_term(domain, [random.choice(made)])]
        )
    ending: Expression = FALSE
    if terminal and random.random() < 0.5:
        ending = conjunction([domain.core_reader.condition(r) for r in domain.pick(core, 1, 2)])
    return Model(
        f"random-pomdp-{seed}",
        domain.features,
        acting,
        rewards=rewards,
        terminal=ending,
        initial=random_initial(domain),
        discount=random.choice(DISCOUNTS),
        observability="partial",
        observations=made,
    )


def _chances(random: Random, count: int) -> list[Fraction]:
    """`count` probabilities that sum to exactly 1, in tenths or thirds; some may be 0."""
    parts = random.choice((10, 10, 3))
    cuts = [0, *sorted(random.randint(0, parts) for _ in range(count - 1)), parts]
    return [Fraction(b - a, parts) for a, b in pairwise(cuts)]


def _random_channel(domain: Domain, name: str) -> Observation:
    """Names or numbers, or a copy of a feature's values; null is one of them, or one more."""
    random = domain.random
    kind = random.random()
    if kind < 0.3:
        return Observation(name, (*random.choice(domain.features).values, "none"))
    if kind < 0.6:
        values = tuple(range(random.randint(2, 3)))
        return Observation(name, values, null=random.choice(values))
    names = random.sample(NAMES, random.randint(1, 3))
    return Observation(name, random.sample([*names, "none"], len(names) + 1))


def _with_senses(domain: Domain, action: Action, channels: Sequence[Observation]) -> Action:
    random = domain.random
    names = [feature.name for feature in domain.features]
    senses: list[tuple[str, Expression]] = []
    for channel in channels:
        if random.random() < 0.3:
            continue
        read = domain.pick(names, 1, 2, primed=True)
        read += domain.pick(names, 1, 1) if random.random() < 0.3 else []
        senses.append((channel.name, domain.any_reader.tree(read, partial(_leaf, domain, channel))))
    return replace_action(action, senses=senses)


def _leaf(domain: Domain, channel: Observation) -> Expression:
    """A distribution over a channel's values; of a copy, sometimes what the next value is."""
    random = domain.random
    copied = [f for f in domain.features if repr(f.values) == repr(channel.values[:-1])]  # True == 1
    if copied and random.random() < 0.5:
        return Reference(random.choice(copied).name, True)
    chances = _chances(random, len(channel.values))
    return lottery(list(zip(map(constant, channel.values), chances, strict=True)))


def _observed_term(domain: Domain, channels: Sequence[Observation]) -> Expression:
    """A reward over some channels' values and some features, now or next."""
    if not channels:
        names = sorted(domain.core)
        return random_term(domain, domain.pick(names, 0, 1) + domain.pick(names, 0, 1, primed=True))
    first, rest = channels[0], channels[1:]
    reference = Reference(first.name)
    if all(isinstance(value, str) for value in first.values) and domain.random.random() < 0.4:
        test = reference.is_(domain.random.choice(first.values))
        return Conditional(test, _observed_term(domain, rest), Constant(domain.amount()))
    cases = tuple((value, _observed_term(domain, rest)) for value in first.values)
    return Switch(reference, cases)
