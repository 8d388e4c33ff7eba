"""A network of machines that fail, and a system administrator who reboots one at a time.

From C. Guestrin, D. Koller, R. Parr and S. Venkataraman, "Efficient solution algorithms for
factored MDPs", Journal of Artificial Intelligence Research 19 (2003), where it is the running
example; the source solves it approximately and reports problems of more than 10^40 states.

n = `size` machines, each up or down; reward 1 for each that is up; one action `noop` and one
`reboot_i` for each machine.  A machine that is rebooted is up next.  Any other is up next with a
probability that depends on itself and on the one machine it listens to (the numbers are those of the
source's conditional probability table for the ring, 0.95 halved where the neighbour is down, and
divided by 20 where the machine is down, as printed there):

    itself    neighbour up    neighbour down
    up        0.95            0.475
    down      0.0475          0.0238

`topology`: in a `ring` machine i listens to i - 1 (machine 0 to the last); in a `star` all listen to
machine 0, the server, which listens to none; in `independent` none listens.  A machine that listens
to none behaves as with its neighbour up, our choice.  The `cost` of a reboot is ours too: the source
has none.

Named reboots keep all 2^n states apart; machines are interchangeable only up to their names.  There
is no hierarchy.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, choice, discount_factor, integer, number
from factored_polca.models import (
    FALSE,
    TRUE,
    Action,
    Expression,
    Feature,
    Model,
    boolean,
    conditional,
    lottery,
)

Size = Annotated[int, "number n of machines; 2^n states"]
Topology = Annotated[str, "who listens to whom: ring, star or independent"]
Cost = Annotated[Number, "cost of a reboot"]
Discount = Annotated[Number, "discount, from 0 to 1"]

_TOPOLOGIES = ("ring", "star", "independent")

# P(up next | itself, neighbour), Guestrin et al. (2003).
_UP = {
    (True, True): Fraction("0.95"),
    (True, False): Fraction("0.475"),
    (False, True): Fraction("0.0475"),
    (False, False): Fraction("0.0238"),
}


def model(
    *,
    size: Size = 8,
    topology: Topology = "ring",
    cost: Cost = Fraction(3, 4),
    discount: Discount = Fraction(95, 100),
) -> Model:
    """The MDP of `size` machines; all are up at the start.

    Raises:
        ModelError: a parameter out of its range.
    """
    n = integer("size", size, 1, 256)
    shape = choice("topology", topology, _TOPOLOGIES)
    price = number("cost", cost)
    ups = [boolean(f"up_{i}") for i in range(n)]
    drift = {up: _next(up, _neighbour(i, ups, shape)) for i, up in enumerate(ups)}
    reboots = [Action(f"reboot_{i}", {**drift, up: TRUE}, rewards=-price) for i, up in enumerate(ups)]
    return Model(
        "sysadmin",
        ups,
        [Action("noop", drift), *reboots],
        rewards=[conditional(up, 1, 0) for up in ups],
        initial=dict.fromkeys(ups, TRUE),
        discount=discount_factor(discount),
        description="Machines that fail, more often when their neighbour is down; reboot one a step.",
    )


def _neighbour(i: int, ups: list[Feature], topology: str) -> Feature | None:
    """The machine that machine i listens to."""
    if topology == "ring" and len(ups) > 1:
        return ups[i - 1]
    if topology == "star" and i > 0:
        return ups[0]
    return None


def _next(up: Feature, neighbour: Feature | None) -> Expression:
    def row(itself: bool) -> Expression:
        heard, alone = (_bernoulli(_UP[itself, known]) for known in (True, False))
        return heard if neighbour is None else conditional(neighbour, heard, alone)

    return conditional(up, row(True), row(False))


def _bernoulli(chance: Fraction) -> Expression:
    return lottery({TRUE: chance, FALSE: 1 - chance})


def tasks(
    *,
    size: Size = 8,
    topology: Topology = "ring",
    cost: Cost = Fraction(3, 4),
    discount: Discount = Fraction(95, 100),
) -> None:
    """None: the domain has no hierarchy."""
