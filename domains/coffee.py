"""A robot brings coffee to its user and should neither get wet nor run out of battery.

The coffee robot of C. Boutilier, R. Dearden and M. Goldszmidt, "Exploiting structure in policy
construction" (IJCAI 1995), as the partially observable problem that comes with P. Poupart's Symbolic
Perseus and with libpomdp (coffee.90.SPUDD; 432 states, discount 0.9), whose numbers these are, the
unnormalised ones normalised.

    user_has_coffee        kept with probability 0.9 in each step
    wetness                of the robot: drenched, sprinkled or dry
    robot_has_coffee, umbrella, location (office or shop)
    rain                   heavy, light or none; from none and heavy it becomes light with probability
                           0.1, from light it becomes heavy or none with 0.1 each
    battery                high becomes low with 0.01, low becomes dead with 0.2

Nothing of this is seen.  After each action the `charge` of the battery is read: zero if it is dead; if
low, one (0.9) or zero (0.1); if high, two (0.8) or one (0.2).  And `measure` tells whether the pavement
is wet: surely in any rain, with probability 0.2 in none.  Other actions report none of the pavement; in
the source they report a fair coin, which tells as little.

    move           to the other place with 0.9 on a high battery, 19/30 on a low one, never on a dead one;
                   on the way the robot gets wet by `rain` and `umbrella` (see _SOAKED), and may dry if
                   sprinkled; costs 0.2 from the office (uphill), 0.1 from the shop
    deliver        gives its coffee to the user, who has it with 0.8, in the office, else loses it:
                   in the office it keeps it with 0.1, in the shop with 0.8
    get_umbrella   in the office, with 0.9; costs 1.6 there
    buy_carefully  in the shop, surely, for 0.3; a dry robot gets sprinkled with 0.1
    buy_fast       in the shop, with 0.9, for 0.1; a dry robot that got it is sprinkled with 0.3
    recharge       in the office the battery is high again
    dry_off        drenched: dry (0.7), sprinkled (0.2); sprinkled: dry (0.9)
    measure, wait

Rewards in each step: 5 while the user has coffee, -3 while the robot is drenched, -1.1 while sprinkled.
At the start nobody has coffee, the robot is dry in the office without umbrella, its battery is high, and
rain is heavy (0.33), light (0.33) or none (0.34).  There is no hierarchy.
"""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor
from factored_polca.models import (
    FALSE,
    TRUE,
    Action,
    Constant,
    Expression,
    Feature,
    Model,
    Observation,
    Switch,
    TaskHierarchy,
    boolean,
    conditional,
    flat_task,
    lottery,
)

Discount = Annotated[Number, "discount, from 0 to 1"]

_USER = boolean("user_has_coffee")
_WETNESS = Feature("wetness", ["drenched", "sprinkled", "dry"])
_ROBOT = boolean("robot_has_coffee")
_RAIN = Feature("rain", ["heavy", "light", "none"])
_UMBRELLA = boolean("umbrella")
_LOCATION = Feature("location", ["office", "shop"])
_BATTERY = Feature("battery", ["dead", "low", "high"])
_PAVEMENT = Observation("pavement", ["none", "wet", "dry"])
_CHARGE = Observation("charge", ["zero", "one", "two"])

# (wetness, rain, umbrella): the wetness after a move; a drenched robot stays so.
_SOAKED = {
    ("sprinkled", "heavy", True): {"drenched": "0.1", "sprinkled": "0.9"},
    ("sprinkled", "heavy", False): {"drenched": "0.9", "sprinkled": "0.1"},
    ("sprinkled", "light", True): {"drenched": "0.05", "sprinkled": "0.95"},
    ("sprinkled", "light", False): {"drenched": "0.3", "sprinkled": "0.7"},
    ("sprinkled", "none", True): {"sprinkled": "0.9", "dry": "0.1"},
    ("sprinkled", "none", False): {"sprinkled": "0.9", "dry": "0.1"},
    ("dry", "heavy", True): {"drenched": "0.1", "sprinkled": "0.1", "dry": "0.8"},
    ("dry", "heavy", False): {"drenched": "0.9", "sprinkled": "0.1"},
    ("dry", "light", True): {"sprinkled": "0.05", "dry": "0.95"},
    ("dry", "light", False): {"drenched": "0.2", "sprinkled": "0.7", "dry": "0.1"},
    ("dry", "none", True): {"sprinkled": "0.1", "dry": "0.9"},
    ("dry", "none", False): {"sprinkled": "0.1", "dry": "0.9"},
}

_IN_OFFICE = _LOCATION.is_("office")


def model(*, discount: Discount = Fraction(9, 10)) -> Model:
    """The POMDP of 432 states and 9 actions.

    Raises:
        ModelError: a parameter out of its range.
    """
    return Model(
        "coffee",
        [_USER, _WETNESS, _ROBOT, _RAIN, _UMBRELLA, _LOCATION, _BATTERY],
        [
            _action("wait"),
            _action("measure", senses={_PAVEMENT: _pavement()}),
            _action("move", {_WETNESS: _soaked(), _LOCATION: _moved()}, cost=_if_office("0.2", "0.1")),
            _action("deliver", {_USER: _delivered(), _ROBOT: _handed_over()}),
            _action(
                "get_umbrella",
                {_UMBRELLA: conditional(_UMBRELLA, TRUE, conditional(_IN_OFFICE, _chance("0.9"), FALSE))},
                cost=_if_office("1.6", "0"),
            ),
            _action("buy_carefully", _bought("1", "0.1"), cost=_if_office("0", "0.3")),
            _action("buy_fast", _bought("0.9", "0.3"), cost=_if_office("0", "0.1")),
            _action("recharge", {_BATTERY: conditional(_IN_OFFICE, Constant("high"), _discharged())}),
            _action("dry_off", {_WETNESS: _dried()}),
        ],
        rewards=[
            conditional(_USER, 5, 0),
            Switch(
                _WETNESS.now,
                (("drenched", Constant(Fraction(-3))), ("sprinkled", Constant(Fraction("-1.1")))),
                Constant(Fraction(0)),
            ),
        ],
        initial={
            _USER: FALSE,
            _WETNESS: Constant("dry"),
            _ROBOT: FALSE,
            _RAIN: _row({"heavy": "0.33", "light": "0.33", "none": "0.34"}),
            _UMBRELLA: FALSE,
            _LOCATION: Constant("office"),
            _BATTERY: Constant("high"),
        },
        discount=discount_factor(discount),
        observability="partial",
        observations=[_PAVEMENT, _CHARGE],
        description="A robot fetches coffee through rain that it can't see, on a battery it can't trust.",
    )


def _action(
    name: str,
    effects: dict[Feature, Expression] | None = None,
    *,
    senses: dict[Observation, Expression] | None = None,
    cost: Expression | None = None,
) -> Action:
    """An action with what happens beside it: rain, discharge, the user's drinking, the charge's reading."""
    always = {_USER: conditional(_USER, _chance("0.9"), FALSE), _RAIN: _weather(), _BATTERY: _discharged()}
    return Action(
        name,
        {**always, **(effects or {})},
        senses={**(senses or {}), _CHARGE: _charge()},
        rewards=() if cost is None else -cost,
    )


def _row(chances: dict[str, str]) -> Expression:
    return lottery({value: Fraction(chance) for value, chance in chances.items()})


def _chance(chance: str) -> Expression:
    return lottery({TRUE: Fraction(chance), FALSE: 1 - Fraction(chance)})


def _if_office(office: str, shop: str) -> Expression:
    return conditional(_IN_OFFICE, Fraction(office), Fraction(shop))


def _by(feature: Feature, rows: Mapping[str, Expression], primed: bool = False) -> Expression:
    return Switch(feature.next if primed else feature.now, tuple(rows.items()))


def _weather() -> Expression:
    return _by(
        _RAIN,
        {
            "heavy": _row({"heavy": "0.9", "light": "0.1"}),
            "light": _row({"heavy": "0.1", "light": "0.8", "none": "0.1"}),
            "none": _row({"light": "0.1", "none": "0.9"}),
        },
    )


def _discharged() -> Expression:
    return _by(
        _BATTERY,
        {
            "dead": Constant("dead"),
            "low": _row({"dead": "0.2", "low": "0.8"}),
            "high": _row({"low": "0.01", "high": "0.99"}),
        },
    )


def _charge() -> Expression:
    rows = {
        "dead": Constant("zero"),
        "low": _row({"zero": "0.1", "one": "0.9"}),
        "high": _row({"one": "0.2", "two": "0.8"}),
    }
    return _by(_BATTERY, rows, primed=True)


def _pavement() -> Expression:
    wet = Constant("wet")
    return _by(_RAIN, {"heavy": wet, "light": wet, "none": _row({"wet": "0.2", "dry": "0.8"})}, primed=True)


def _moved() -> Expression:
    def leaves(chance: Fraction) -> Expression:
        rows = {
            place: lottery({other: chance, place: 1 - chance})
            for place, other in (("office", "shop"), ("shop", "office"))
        }
        return _by(_LOCATION, rows)

    chances = {"low": leaves(Fraction(19, 30)), "high": leaves(Fraction(9, 10))}
    return _by(_BATTERY, {"dead": _LOCATION.now, **chances})


def _soaked() -> Expression:
    def row(wetness: str) -> Expression:
        return _by(
            _RAIN,
            {
                rain: conditional(
                    _UMBRELLA, _row(_SOAKED[wetness, rain, True]), _row(_SOAKED[wetness, rain, False])
                )
                for rain in ("heavy", "light", "none")
            },
        )

    return _by(
        _WETNESS, {"drenched": Constant("drenched"), "sprinkled": row("sprinkled"), "dry": row("dry")}
    )


def _delivered() -> Expression:
    return conditional(_USER, _chance("0.9"), conditional(_ROBOT.now & _IN_OFFICE, _chance("0.8"), FALSE))


def _handed_over() -> Expression:
    return conditional(_ROBOT, conditional(_IN_OFFICE, _chance("0.1"), _chance("0.8")), FALSE)


def _bought(success: str, spill: str) -> dict[Feature, Expression]:
    """Coffee for the robot; one that has just got it and is dry may get sprinkled."""
    got = conditional(_ROBOT, TRUE, conditional(_IN_OFFICE, FALSE, _chance(success)))
    spilt = _row({"sprinkled": spill, "dry": str(1 - Fraction(spill))})
    risk = ~_ROBOT.now & _ROBOT.next & _WETNESS.is_("dry")
    return {_ROBOT: got, _WETNESS: conditional(risk, spilt, _WETNESS)}


def _dried() -> Expression:
    return _by(
        _WETNESS,
        {
            "drenched": _row({"drenched": "0.1", "sprinkled": "0.2", "dry": "0.7"}),
            "sprinkled": _row({"sprinkled": "0.1", "dry": "0.9"}),
            "dry": Constant("dry"),
        },
    )


def tasks(*, discount: Discount = Fraction(9, 10)) -> TaskHierarchy:
    """One task over all actions.

    Raises:
        ModelError: a parameter out of its range.
    """
    return flat_task(model(discount=discount))
