"""A part is painted and shipped, or rejected if a noisy inspection finds it flawed.

From the part-painting example of N. Kushmerick, S. Hanks and D. Weld, "An algorithm for probabilistic
planning", Artificial Intelligence 76 (1995), in the form that comes with A. R. Cassandra's pomdp-solve as
paint.95, four states, four actions and two observations, whose numbers these are.  J. Pineau's thesis
"Tractable planning under uncertainty: exploiting structure" (Carnegie Mellon, 2004) takes part-painting as
a first test of hierarchical planning; her hierarchy was not at hand, and the one below is ours.

Two features, `flawed` and `painted`: of the file's states NFL-NBL-NPA is neither, NFL-NBL-PA painted,
FL-NBL-PA both, and FL-BL-NPA flawed.  Paint hides the blemish of a flawed part, and a flawed part without
paint is blemished, so that no third feature is needed.  At the start and after ship and reject there is
a new part, flawed with probability 1/2.

    paint      an unpainted part is painted with probability 9/10
    inspect    tells whether the part is blemished (BL) or not (NBL), rightly with probability 3/4
    ship       +1 for a part that is painted and not flawed, else -1
    reject     +1 for a flawed part without paint, 0 for a painted one, -1 if the part is not flawed

All but inspect report NBL.

    Work = {inspect, reject, Finish}      Finish = {paint, ship}

Finish knows what to do with a sound part.  For a flawed one it paints, and paints again, which costs
nothing and leads nowhere: when to give up is for Work to know.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor
from factored_polca.models import (
    FALSE,
    TRUE,
    Action,
    Feature,
    Model,
    Observation,
    Task,
    TaskHierarchy,
    boolean,
    conditional,
    lottery,
    uniform,
)

Discount = Annotated[Number, "discount, from 0 to 1"]

_PAINT_HOLDS = Fraction(9, 10)
_SEEN_RIGHT = Fraction(3, 4)


def model(*, discount: Discount = Fraction(95, 100)) -> Model:
    """The POMDP of four states, four actions and two observations.

    Raises:
        ModelError: a parameter out of its range.
    """
    flawed, painted = boolean("flawed"), boolean("painted")
    look = Observation("look", ["NBL", "BL"], null="NBL")
    coat = conditional(painted, TRUE, lottery({TRUE: _PAINT_HOLDS, FALSE: 1 - _PAINT_HOLDS}))
    seen = conditional(
        flawed.next & ~painted.next,
        lottery({"BL": _SEEN_RIGHT, "NBL": 1 - _SEEN_RIGHT}),
        lottery({"NBL": _SEEN_RIGHT, "BL": 1 - _SEEN_RIGHT}),
    )
    new_part: dict[Feature, object] = {flawed: uniform(flawed), painted: FALSE}
    rejected = conditional(flawed, conditional(painted, 0, 1), -1)
    return Model(
        "part_painting",
        [flawed, painted],
        [
            Action("paint", {painted: coat}),
            Action("inspect", senses={look: seen}),
            Action("ship", new_part, rewards=conditional(painted & ~flawed.now, 1, -1)),
            Action("reject", new_part, rewards=rejected),
        ],
        initial={flawed: uniform(flawed), painted: FALSE},
        discount=discount_factor(discount),
        observability="partial",
        observations=[look],
        description="Paint and ship sound parts, reject flawed ones, and inspect to tell them apart.",
    )


def tasks(*, discount: Discount = Fraction(95, 100)) -> TaskHierarchy:
    """Work{inspect, reject, Finish{paint, ship}}.

    No parameter changes anything here.
    """
    return TaskHierarchy([Task("Work", ["inspect", "reject", "Finish"]), Task("Finish", ["paint", "ship"])])
