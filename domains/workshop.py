"""A workshop makes a product from parts: shaped, drilled, painted, joined, inspected, shipped.

A domain of this project, with no outside source: manufacturing in the spirit of the factory problems
that come with SPUDD (Hoey, St-Aubin, Hu and Boutilier, 1999; R. Dearden and C. Boutilier,
"Abstraction and approximate decision-theoretic planning", Artificial Intelligence 89, 1997), with
machines that wear and a hierarchy.  Nothing is reported elsewhere.

n = `size` parts part_0 .. part_{n-1}, each raw, shaped, drilled or painted; the product is open (loose
parts), joined, passed, failed or shipped.  One robot does all work with the `tool` it holds (press,
drill, sprayer or welder), whose `wear` is new, worn or broken.  4^n * 5 * 12 states.

    shape, drill, paint    the press, drill or sprayer takes the first part that is raw, shaped or
                           drilled one stage further, while the product is open
    join                   the welder joins the product once all parts are painted
    mount_TOOL             takes a new TOOL into the hand, dropping the old one
    inspect                a joined product is found passed or failed
    strip                  a failed product is taken apart, and all its parts lose their paint
    ship                   a passed product is shipped; a joined one too if it is sound, else it comes
                           back failed; an open or failed one stays

Work with a tool succeeds with probability 9/10 when it is new, 1/2 when worn, never when broken, else
nothing has changed; and each use in earnest makes it worse by one step with probability `decay`.  A
joined product is sound with probability 9/10.  An action that finds nothing to do changes nothing.
Each action costs 1, mounting a tool 3, shipping brings 100, a product that comes back costs 100.

    Produce = {Prepare, Assemble, Deliver}
    Prepare = {ShapeParts, DrillParts, PaintParts}, until no part lacks paint or the product is not open
    ShapeParts = {shape, mount_press}, while parts are raw       DrillParts, PaintParts likewise
    Assemble = {join, mount_welder}, while the product is open and all parts are painted
    Deliver = {inspect, strip, ship}, while the product is not open

What each should be able to ignore: ShapeParts needs the number of raw parts and the wear of the
press, not which parts they are or how far the others have come (3n + 1 blocks: a broken press and
any other tool are one case); DrillParts and PaintParts likewise; Assemble only the wear of the
welder (4 blocks); Deliver only the product, neither parts nor tool (4 blocks).  Prepare needs three
numbers of parts, with the wear of the tool held if there is work for it: at most
9n + 15 n(n-1)/2 + 7 n(n-1)(n-2)/6 + 1 blocks, 885 for n = 8.  Which part is where is never needed,
since the tools take the parts in turn.

The hierarchy costs a little from n = 3 on, where it is worth 57.115 and the flat optimum 57.137 (by
enumeration): each worker minds the cost of its own stage alone, which is recursive optimality.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Annotated

from factored_polca.library import Number, discount_factor, integer, probability
from factored_polca.models import (
    Action,
    Constant,
    Expression,
    Feature,
    Model,
    Switch,
    Task,
    TaskHierarchy,
    conditional,
    conjunction,
    disjunction,
    lottery,
)

Size = Annotated[int, "number n of parts; 4^n * 60 states"]
Decay = Annotated[Number, "probability that a use makes a tool worse by one step"]
Discount = Annotated[Number, "discount, from 0 to 1"]

_STAGES = ("raw", "shaped", "drilled", "painted")
_WORK = (("shape", "press"), ("drill", "drill"), ("paint", "sprayer"))  # from each stage to the next
_SUCCESS = {"new": Fraction(9, 10), "worn": Fraction(1, 2), "broken": Fraction(0)}
_SOUND = Fraction(9, 10)

_TOOL = Feature("tool", ["press", "drill", "sprayer", "welder"])
_WEAR = Feature("wear", list(_SUCCESS))
_PRODUCT = Feature("product", ["open", "joined", "passed", "failed", "shipped"])


def model(
    *, size: Size = 8, decay: Decay = Fraction(1, 5), discount: Discount = Fraction(99, 100)
) -> Model:
    """The MDP of a product of `size` parts; all are raw at the start, and a new tool is in the hand.

    Raises:
        ModelError: a parameter out of its range.
    """
    parts = _parts(size)
    wears = probability("decay", decay)
    return Model(
        "workshop",
        [_PRODUCT, _TOOL, _WEAR, *parts],
        [
            *(_work_on_parts(stage, parts, wears) for stage in range(len(_WORK))),
            _join(parts, wears),
            *(
                Action(f"mount_{tool}", {_TOOL: Constant(str(tool)), _WEAR: Constant("new")}, rewards=-2)
                for tool in _TOOL.values
            ),
            *_finishing(parts),
        ],
        rewards=-1,
        terminal=_PRODUCT.is_("shipped"),
        initial={
            _PRODUCT: Constant("open"),
            _TOOL: lottery([(str(tool), Fraction(1, 4)) for tool in _TOOL.values]),
            _WEAR: Constant("new"),
            **{part: Constant("raw") for part in parts},
        },
        discount=discount_factor(discount),
        description="Parts are shaped, drilled, painted, joined, inspected and shipped with wearing tools.",
    )


def tasks(
    *, size: Size = 8, decay: Decay = Fraction(1, 5), discount: Discount = Fraction(99, 100)
) -> TaskHierarchy:
    """Produce{Prepare{ShapeParts, DrillParts, PaintParts}, Assemble, Deliver}.

    Raises:
        ModelError: `size` is out of its range; the other parameters change nothing here.
    """
    parts = _parts(size)
    is_open = _PRODUCT.is_("open")
    painted = _all_painted(parts)
    workers = [
        Task(
            f"{verb.capitalize()}Parts", [verb, f"mount_{tool}"], terminal=~(is_open & _some(parts, stage))
        )
        for stage, (verb, tool) in enumerate(_WORK)
    ]
    return TaskHierarchy(
        [
            Task("Produce", ["Prepare", "Assemble", "Deliver"]),
            Task("Prepare", [task.name for task in workers], terminal=~is_open | painted),
            *workers,
            Task("Assemble", ["join", "mount_welder"], terminal=~(is_open & painted)),
            Task("Deliver", ["inspect", "strip", "ship"], terminal=is_open),
        ]
    )


def _parts(size: int) -> list[Feature]:
    return [Feature(f"part_{i}", _STAGES) for i in range(integer("size", size, 1, 200))]


def _all_painted(parts: list[Feature]) -> Expression:
    return conjunction(part.is_("painted") for part in parts)


def _some(parts: list[Feature], stage: int) -> Expression:
    return disjunction(part.is_(_STAGES[stage]) for part in parts)


def _by_wear(done: Expression, undone: Expression) -> Expression:
    """`done` with the probability that the tool's wear leaves, else `undone`."""
    cases = [(wear, lottery([(done, q), (undone, 1 - q)])) for wear, q in _SUCCESS.items()]
    return Switch(_WEAR.now, tuple(cases))


def _worn(in_use: Expression, decay: Fraction) -> Expression:
    """The next wear: one step worse with probability `decay` where the tool is in use."""

    def step(now: str, worse: str) -> Expression:
        return lottery({worse: decay, now: 1 - decay})

    cases = (("new", step("new", "worn")), ("worn", step("worn", "broken")))
    return conditional(in_use, Switch(_WEAR.now, cases, _WEAR.now), _WEAR)


def _work_on_parts(stage: int, parts: list[Feature], decay: Fraction) -> Action:
    """The action that takes the first part at `stage` one stage further."""
    verb, tool = _WORK[stage]
    ready = _PRODUCT.is_("open") & _TOOL.is_(tool)
    effects: dict[Feature, Expression] = {_WEAR: _worn(ready & _some(parts, stage), decay)}
    for i, part in enumerate(parts):
        none_before = [~earlier.is_(_STAGES[stage]) for earlier in parts[:i]]
        turn = conjunction([ready, part.is_(_STAGES[stage]), *none_before])
        effects[part] = conditional(turn, _by_wear(Constant(_STAGES[stage + 1]), part.now), part)
    return Action(verb, effects)


def _join(parts: list[Feature], decay: Fraction) -> Action:
    ready = conjunction([_PRODUCT.is_("open"), _TOOL.is_("welder"), _all_painted(parts)])
    return Action(
        "join",
        {
            _PRODUCT: conditional(ready, _by_wear(Constant("joined"), _PRODUCT.now), _PRODUCT),
            _WEAR: _worn(ready, decay),
        },
    )


def _finishing(parts: list[Feature]) -> list[Action]:
    joined, failed = _PRODUCT.is_("joined"), _PRODUCT.is_("failed")
    found = lottery({"passed": _SOUND, "failed": 1 - _SOUND})
    sent = lottery({"shipped": _SOUND, "failed": 1 - _SOUND})
    shipped_now, back_now = _PRODUCT.next.is_("shipped"), _PRODUCT.next.is_("failed")
    return [
        Action("inspect", {_PRODUCT: conditional(joined, found, _PRODUCT)}),
        Action(
            "strip",
            {
                _PRODUCT: conditional(failed, Constant("open"), _PRODUCT),
                **{part: conditional(failed, Constant("drilled"), part) for part in parts},
            },
        ),
        Action(
            "ship",
            {
                _PRODUCT: Switch(
                    _PRODUCT.now, (("passed", Constant("shipped")), ("joined", sent)), _PRODUCT.now
                )
            },
            rewards=[
                conditional(shipped_now, 100, 0),
                conditional(joined, conditional(back_now, -100, 0), 0),
            ],
        ),
    ]
