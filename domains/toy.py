"""Four states, two subtasks: the smallest problem in which a child's policy abstracts its parent.

After Figure 3 of J. Pineau, G. Gordon and S. Thrun, "Policy-contingent abstraction for robust robot
control" (2003), which shows PolCA on a deterministic MDP of four states and two subtasks.  The
figure itself was not at hand, so this problem is our own, in its manner; the paper reports no number
that it could be compared with.

A robot must pass a door that is locked red or locked blue.  The key of the right colour opens it,
the other does nothing; `walk` passes an open door.  Each step costs 1, passing brings `reward`.

    Pass = {Unlock, walk}       Unlock = {red_key, blue_key}, until the door is not locked

Flat, all four states differ: red_key acts on red alone, blue_key on blue alone.  `Unlock` has three
blocks (red, blue, ended).  Its policy opens the door from both colours in one step, so to `Pass`,
which sees that policy as one action, red and blue are alike: three blocks (locked, open, passed).
The optimum is found: -1 + discount * (reward - 1) from a locked door.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor, number
from factored_polca.models import (
    Action,
    Constant,
    Feature,
    Model,
    Task,
    TaskHierarchy,
    conditional,
    lottery,
)

Reward = Annotated[Number, "reward of passing the door"]
Discount = Annotated[Number, "discount, from 0 to 1"]

_OPEN = Constant("open")


def model(*, reward: Reward = 10, discount: Discount = Fraction(95, 100)) -> Model:
    """The four-state MDP.

    Raises:
        ModelError: a parameter out of its range.
    """
    door = Feature("door", ["red", "blue", "open", "passed"])
    prize = number("reward", reward)
    return Model(
        "toy",
        [door],
        [
            Action("red_key", {door: conditional(door.is_("red"), _OPEN, door)}),
            Action("blue_key", {door: conditional(door.is_("blue"), _OPEN, door)}),
            Action(
                "walk",
                {door: conditional(door.is_("open"), Constant("passed"), door)},
                rewards=conditional(door.is_("open"), prize, 0),
            ),
        ],
        rewards=-1,
        terminal=door.is_("passed"),
        initial={door: lottery({"red": Fraction(1, 2), "blue": Fraction(1, 2)})},
        discount=discount_factor(discount),
        description="A robot unlocks a red or blue door and passes it.",
    )


def tasks(*, reward: Reward = 10, discount: Discount = Fraction(95, 100)) -> TaskHierarchy:
    """`Pass` over `Unlock`; the parameters of the model change nothing here."""
    door = Feature("door", ["red", "blue", "open", "passed"])
    return TaskHierarchy(
        [
            Task("Pass", ["Unlock", "walk"]),
            Task(
                "Unlock",
                ["red_key", "blue_key"],
                terminal=door.is_in(["open", "passed"]),
                pseudo_rewards=-1,
            ),
        ]
    )
