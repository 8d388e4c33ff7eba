"""Machines that fail unseen, and an administrator who pings or reboots one at a time.

From P. Poupart and C. Boutilier, "VDCBPI: an approximate scalable algorithm for large scale POMDPs"
(NIPS 17, 2004), and P. Poupart, "Exploiting structure to efficiently solve large scale partially
observable Markov decision processes" (PhD thesis, Toronto, 2005); the numbers are those of the
generator that comes with his Symbolic Perseus (2008).  There the problem has up to 25 machines.

n = `size` machines, each up or down, all up at the start; 2n + 1 actions.  Machine 0 is the server.

    itself    the machine it depends on    up next
    up        up                           0.9
    up        down                         0.667
    down      either                       0.01

    reboot_i  machine i is up next with probability 0.95, whatever it was; costs 2.5
    ping_i    tells whether machine i is up after the action, rightly with probability 0.95; costs 0.1
    noop      nothing

Each machine that is up brings 1 in each step, the server 2.  Actions other than ping_i observe nothing:
the one channel, `answer`, reports none (the generator lets it report a constant, which is the same).

`topology`: in a `cycle` machine i depends on i - 1 and the server on the last one; in `legs` (n = 3m + 1)
three chains of m machines hang on the server, which depends on none and stays up with 0.9.

`segment` s > 0: a hierarchy, ours.  Along the cycle, or along each leg, s machines after the other are a
segment, the last one what is left; the server of the legs is one of its own.

    Administer = {Segment_0, Segment_1, ...}      Segment_k = {noop, reboot_i, ping_i for its machines i}

A segment's own reward counts its machines and the costs of its actions alone.  In legs it needs to know its
leg up to its last machine, and the server: 2^(m+1) blocks for the last or only segment of a leg, whatever
the other legs.  In a cycle the machine that the first one depends on depends on all others: an exact
abstraction finds nothing to ignore, and only the policies of the segments are simpler.  Without `segment`
there is one task over all actions.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, choice, discount_factor, integer
from factored_polca.models import (
    FALSE,
    TRUE,
    Action,
    Expression,
    Feature,
    Model,
    ModelError,
    Observation,
    Task,
    TaskHierarchy,
    boolean,
    conditional,
    flat_task,
    lottery,
)

Size = Annotated[int, "number n of machines; 2^n states, 2n + 1 actions"]
Topology = Annotated[str, "who depends on whom: cycle or legs (for n = 4, 7, 10, ...)"]
Segment = Annotated[int, "machines s of a segment, each with a task of its own; 0: one task for all"]
Discount = Annotated[Number, "discount, from 0 to 1"]

_TOPOLOGIES = ("cycle", "legs")
_STAYS_UP = Fraction("0.9")
_STAYS_UP_ALONE = Fraction("0.667")  # where the machine it depends on is down
_COMES_UP = Fraction("0.01")
_REBOOTED = Fraction("0.95")
_ANSWERS_RIGHT = Fraction("0.95")
_REBOOT_COST = Fraction("2.5")
_PING_COST = Fraction("0.1")


def model(
    *,
    size: Size = 4,
    topology: Topology = "cycle",
    segment: Segment = 0,
    discount: Discount = Fraction(95, 100),
) -> Model:
    """The POMDP of `size` machines; all are up at the start.

    Raises:
        ModelError: a parameter out of its range.
    """
    n = _size(size, segment)
    upstream = _upstream(n, choice("topology", topology, _TOPOLOGIES))
    ups = [boolean(f"up_{i}") for i in range(n)]
    answer = Observation("answer", ["none", "up", "down"])
    drift = {up: _drift(up, None if j is None else ups[j]) for up, j in zip(ups, upstream, strict=True)}
    reboots = [
        Action(f"reboot_{i}", {**drift, up: _bernoulli(_REBOOTED)}, rewards=-_REBOOT_COST)
        for i, up in enumerate(ups)
    ]
    pings = [
        Action(f"ping_{i}", drift, rewards=-_PING_COST, senses={answer: _answer(up)})
        for i, up in enumerate(ups)
    ]
    return Model(
        "network",
        ups,
        [Action("noop", drift), *reboots, *pings],
        rewards=[_worth(i, up) for i, up in enumerate(ups)],
        initial=dict.fromkeys(ups, TRUE),
        discount=discount_factor(discount),
        observability="partial",
        observations=[answer],
        description="Machines that fail unseen; ping or reboot one a step.",
    )


def _upstream(n: int, topology: str) -> list[int | None]:
    """The machine that each machine depends on."""
    if topology == "cycle":
        return [(i - 1) % n for i in range(n)]
    if n % 3 != 1:
        raise ModelError(
            f"size is {n}: three legs of equal length and a server need 1, 4, 7, 10, ... machines"
        )
    length = n // 3
    return [None, *(0 if i % length == 0 else i for i in range(n - 1))]


def _drift(up: Feature, upstream: Feature | None) -> Expression:
    stays = _bernoulli(_STAYS_UP)
    if upstream is not None and upstream != up:
        stays = conditional(upstream, stays, _bernoulli(_STAYS_UP_ALONE))
    return conditional(up, stays, _bernoulli(_COMES_UP))


def _bernoulli(chance: Fraction) -> Expression:
    return lottery({TRUE: chance, FALSE: 1 - chance})


def _answer(up: Feature) -> Expression:
    right, wrong = _ANSWERS_RIGHT, 1 - _ANSWERS_RIGHT
    return conditional(
        up.next, lottery({"up": right, "down": wrong}), lottery({"up": wrong, "down": right})
    )


def _worth(i: int, up: Feature) -> Expression:
    return conditional(up, 2 if i == 0 else 1, 0)


def _size(size: int, segment: int) -> int:
    n = integer("size", size, 1, 128)
    integer("segment", segment, 0, n)
    return n


def _segments(upstream: list[int | None], length: int) -> list[list[int]]:
    """The machines of each segment of `length` machines along a chain."""
    n = len(upstream)
    chains = [range(n)]
    if None in upstream:
        leg = max(1, n // 3)
        chains = [range(1), *(range(i, i + leg) for i in range(1, n, leg))]
    return [list(chain[i : i + length]) for chain in chains for i in range(0, len(chain), length)]


def tasks(
    *,
    size: Size = 4,
    topology: Topology = "cycle",
    segment: Segment = 0,
    discount: Discount = Fraction(95, 100),
) -> TaskHierarchy:
    """One task over all actions, or Administer{Segment_0, ...} with a task for each segment.

    Raises:
        ModelError: a parameter out of its range.
    """
    whole = model(size=size, topology=topology, segment=segment, discount=discount)
    if segment == 0:
        return flat_task(whole)
    found = []
    for k, machines in enumerate(_segments(_upstream(size, topology), segment)):
        costs = {
            **{f"reboot_{i}": -_REBOOT_COST for i in machines},
            **{f"ping_{i}": -_PING_COST for i in machines},
        }
        found.append(
            Task(
                f"Segment_{k}",
                ["noop", *costs],
                pseudo_rewards=[_worth(i, whole.features[i]) for i in machines],
                pseudo_rewards_of=costs,
            )
        )
    return TaskHierarchy([Task("Administer", [task.name for task in found]), *found])
