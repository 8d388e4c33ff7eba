"""The native format: what is written is read back, and every fault is named with its place."""

from __future__ import annotations

import json
import random
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_hierarchies import random_tasks
from random_models import random_model

from factored_polca.explicit.enumeration import enumerate_model
from factored_polca.formats import Document, read_native, template, write_native
from factored_polca.library import domains, load
from factored_polca.models import (
    FALSE,
    TRUE,
    Action,
    Conditional,
    Constant,
    Expression,
    Feature,
    InitialBelief,
    Lottery,
    Model,
    ModelError,
    Observation,
    Parameter,
    Reference,
    Switch,
    Task,
    TaskHierarchy,
    boolean,
    check,
    check_tasks,
    conjunction,
    disjunction,
    operation,
    parse,
    uniform,
)
from factored_polca.models.scalars import scalar

# --------------------------------------------------------------------------------------------
# Random models with everything in them
# --------------------------------------------------------------------------------------------

NAMES = [
    "x", "y", "if", "else", "true", "uniform", "factors", "two words", "0", "-1", "naïve", "a.b", "#", "x'",
    "values", "switch", "it's", "=", "[z]", "\\n", "日本", "reward", "{", "'''", "e1", "none", "a, b", "(",
]  # fmt: skip
WORDS = [
    "red",
    "if",
    "not",
    "true",
    "none",
    "two words",
    "x",
    "3",
    "it's",
    "\\",
    "ü",
    "a, b)",
    "{",
    "'''",
    "#",
]


def random_number(rng: random.Random) -> Fraction:
    kind = rng.randrange(6)
    if kind == 0:
        return Fraction(rng.randint(-9, 9), 3)
    if kind == 1:
        return Fraction(rng.randint(-(10**30), 10**30), rng.randint(1, 10**25))
    if kind == 2:
        return Fraction(rng.randint(-99, 99), 10 ** rng.randint(0, 22))
    if kind == 3:
        return Fraction(rng.choice([2**63, -(2**64), 10**40, 2**53, 2**53 - 1]))
    return Fraction(rng.randint(-3, 3))


def random_values(rng: random.Random) -> tuple[Any, ...]:
    kind = rng.randrange(6)
    if kind == 0:
        return (False, True)
    if kind == 1:
        low = rng.randint(-4, 3)
        return tuple(range(low, low + rng.randint(1, 5)))
    if kind == 2:
        return tuple(rng.sample(WORDS, rng.randint(1, 4)))
    if kind == 3:
        return tuple(rng.sample([0, 1, True, False, "true", "1", -7, 10**17, "x"], rng.randint(1, 6)))
    if kind == 4:
        return (True, False)
    return (0, 1)


class Writer:
    """Random expressions over the names of a model; the canonical constructors build them."""

    def __init__(self, rng: random.Random, features: list[Feature], channels: list[Observation]) -> None:
        self.rng = rng
        self.features = features
        self.channels = channels
        self.parameters: list[str] = []

    def leaf(self, primed: bool, observed: bool) -> Expression:
        rng = self.rng
        kind = rng.randrange(7)
        if kind == 0:
            return Constant(random_number(rng))
        if kind == 1:
            return rng.choice([TRUE, FALSE])
        if kind == 2:
            words = [v for f in self.features for v in f.values if isinstance(v, str)]
            return Constant(rng.choice(words)) if words else TRUE
        if kind == 3 and self.parameters:
            return Parameter(rng.choice(self.parameters))
        if kind == 4 and observed and self.channels:
            return Reference(rng.choice(self.channels).name)
        return Reference(rng.choice(self.features).name, primed and rng.random() < 0.5)

    def expression(self, levels: int, primed: bool = False, observed: bool = False) -> Expression:
        rng = self.rng
        if levels == 0 or rng.random() < 0.15:
            return self.leaf(primed, observed)

        def part() -> Expression:
            return self.expression(levels - 1, primed, observed)

        kind = rng.randrange(14)
        if kind == 0:
            return Conditional(part(), part(), part())
        if kind == 1:
            return self.switch(levels, primed, part)
        if kind in (2, 3):
            name = rng.choice(["add", "multiply", "minimum", "maximum"])
            return operation(name, *(part() for _ in range(rng.randint(2, 4))))
        if kind == 4:
            return operation(rng.choice(["negate", "absolute"]), part())
        if kind in (5, 6):
            name = rng.choice(["divide", "floor_divide", "modulo", "power"])
            return operation(name, part(), part())
        if kind == 7:
            return operation("not", part())
        if kind in (8, 9):
            join = rng.choice([conjunction, disjunction])
            return join([part() for _ in range(rng.randint(2, 3))])
        if kind == 10:
            return part() - part()
        names = ["equal", "not_equal", "less", "less_equal", "greater", "greater_equal"]
        return operation(rng.choice(names), part(), part())

    def switch(self, levels: int, primed: bool, part: Any) -> Expression:
        feature = self.rng.choice(self.features)
        reference = Reference(feature.name, primed and self.rng.random() < 0.3)
        listed = list(feature.values)
        self.rng.shuffle(listed)
        if self.rng.random() < 0.5:
            listed = listed[: self.rng.randint(0, len(listed))]
            return Switch(reference, tuple((value, part()) for value in listed), part())
        return Switch(reference, tuple((value, part()) for value in listed))

    def distribution(self, values: tuple[Any, ...], levels: int) -> Expression:
        rng = self.rng
        if levels and rng.random() < 0.5:
            test = self.expression(2)
            return Conditional(
                test, self.distribution(values, levels - 1), self.distribution(values, levels - 1)
            )
        if rng.random() < 0.3:
            return Constant(scalar(rng.choice(values)))
        pairs = [(Constant(scalar(v)), self.expression(1)) for v in values]
        return Lottery(tuple(pairs))


def random_document(seed: int) -> Document:
    rng = random.Random(seed)
    names = rng.sample(NAMES, 9)
    features = [
        Feature(name, random_values(rng), observed=rng.random() < 0.3)
        for name in names[: rng.randint(1, 4)]
    ]
    partial = rng.random() < 0.5
    channels = []
    if partial:
        for name in names[4 : 4 + rng.randint(0, 2)]:
            values = random_values(rng)
            null = rng.choice(values)
            channels.append(Observation(name, (*values, "none"), "none") if rng.random() < 0.5
                            and "none" not in values else Observation(name, values, null))  # fmt: skip
    writer = Writer(rng, features, channels)
    parameters = {name: random_number(rng) for name in names[6 : 6 + rng.randint(0, 3)]}
    writer.parameters = list(parameters)
    actions = [random_action(rng, writer, name, partial) for name in rng.sample(NAMES, rng.randint(1, 4))]
    initial = InitialBelief(
        {
            f.name: uniform(f) if rng.random() < 0.4 else lottery_of_numbers(rng, f.values)
            for f in features if rng.random() < 0.7
        },
        [writer.expression(2) for _ in range(rng.choice([0, 0, 1, 3]))],
    )  # fmt: skip
    model = Model(
        rng.choice(NAMES),
        features,
        actions,
        rewards=[writer.expression(4, True, True) for _ in range(rng.randint(0, 3))],
        terminal=writer.expression(3) if rng.random() < 0.7 else FALSE,
        initial=initial,
        discount=Fraction(rng.randint(0, 998), 999),
        observability="partial" if partial else "full",
        observations=channels,
        parameters=parameters,
        horizon=rng.choice([None, 1, 10**6]),
        description=rng.choice(
            ["", "one line", "two\nlines\n", 'a "quote" \\ and \t\r\x00', "'''", '\'\n"""']
        ),
    )
    return Document(model, tasks_over(rng, writer, model) if rng.random() < 0.6 else None)


def lottery_of_numbers(rng: random.Random, values: tuple[Any, ...]) -> Expression:
    return Lottery(tuple((Constant(scalar(value)), Constant(random_number(rng))) for value in values))


def random_action(rng: random.Random, writer: Writer, name: str, partial: bool) -> Action:
    effects = {f.name: writer.distribution(f.values, 2) for f in writer.features if rng.random() < 0.7}
    senses = {
        o.name: writer.distribution(o.values, 1)
        for o in writer.channels
        if rng.random() < 0.6 or o.null not in o.values
    }
    return Action(
        name,
        effects,
        applicable=TRUE if partial or rng.random() < 0.5 else writer.expression(2),
        rewards=[writer.expression(3, True, True) for _ in range(rng.choice([0, 0, 1, 2]))],
        senses=senses,
    )


def tasks_over(rng: random.Random, writer: Writer, model: Model) -> TaskHierarchy:
    primitive = [action.name for action in model.actions]
    children = ["Get it", "`Put".strip("`"), "Näher"][: rng.randint(0, 3)]
    tasks = [Task("Root", [*children, *primitive])]
    for name in children:
        single = [
            (rng.choice(primitive), [writer.expression(1, True) for _ in range(rng.randint(0, 2))])
            for _ in range(rng.choice([0, 0, 1, 3]))
        ]
        tasks.append(
            Task(
                name,
                rng.sample(primitive, rng.randint(1, len(primitive))),
                terminal=writer.expression(2) if rng.random() < 0.7 else FALSE,
                pseudo_rewards=[writer.expression(3, True) for _ in range(rng.choice([0, 1, 2]))],
                pseudo_rewards_of=single,
                adds_reward=rng.random() < 0.5,
                observes=rng.choice([None, (), tuple(o.name for o in writer.channels)]),
                solver=rng.choice([None, "HSVI2", 'a "b"']),
            )
        )
    rng.shuffle(tasks)
    return TaskHierarchy(tasks)


@pytest.mark.parametrize("first", range(0, 300, 50))
def test_what_is_written_is_read_back(first: int) -> None:
    for seed in range(first, first + 50):
        document = random_document(seed)
        assert not check(document.model), f"seed {seed}"
        text = write_native(document.model, document.tasks)
        back = read_native(text)
        assert back.model == document.model, f"seed {seed}"
        assert back.tasks == document.tasks, f"seed {seed}"
        # == takes True for 1, and so values (0, 1) for "boolean"; repr does not
        assert repr(back.model.features) == repr(document.model.features), f"seed {seed}"
        assert repr(back.model.observations) == repr(document.model.observations), f"seed {seed}"
        assert back.warnings == ()


@pytest.mark.parametrize("seed", range(8))
def test_the_random_hierarchical_models_are_read_back(seed: int) -> None:
    model = random_model(seed, parameters=seed % 2 == 0)
    tasks = random_tasks(seed, model)
    assert read_native(write_native(model, tasks)) == Document(model, tasks)


@pytest.mark.parametrize("name", domains())
def test_the_shipped_domains_are_read_back(name: str) -> None:
    domain = load(name)
    assert read_native(write_native(domain.model, domain.tasks)) == Document(domain.model, domain.tasks)


def test_every_key_of_the_format_means_what_its_description_says() -> None:
    text = """
        name = "errand"
        description = '''
    two
    lines'''
        discount = "19/20"
        horizon = 40
        observability = "partial"
        terminal = "place == home and full"
        reward = ["-1", 0.5, "10 if full' and light == on else 0"]
        initial_factors = ["2", "1 if height < 2 else 1/3"]

        [parameters]
        slip = 0.1
        third = "1/3"

        [features]
        full = "boolean"
        height = "-1..2"
        place = ["home", "the shop"]
        door = { values = ["open", "shut"], observed = true }
        mixed = [1, true, "1", "true", -3]
        factors = "boolean"

        [observations]
        light = ["on", "off", "none"]
        sound = { values = "0..2", null = 0 }

        [initial]
        height = "uniform"
        place = "{home: 3/4, \\"the shop\\": 0.25}"
        full = false
        factors = "bernoulli(1/7)"

        [actions.climb]
        effects.height = "{height + 1: 1 - slip, height: slip} if height < 2 else height"
        effects.place = "place if door' == open else home"
        senses.light = "{on: 0.9, off: 0.1} if full' else off"
        reward = "-height"

        [actions."do nothing"]

        [tasks.Root]
        actions = ["Up", "do nothing"]

        [tasks.Up]
        actions = ["climb", "do nothing"]
        terminal = "height == 2"
        pseudo_reward = ["-third", { climb = "-2", "do nothing" = [-2, "-height'"] }, "1", { climb = 3 }]
        adds_reward = true
        observes = ["light"]
        solver = "HSVI2"
    """
    full, height = boolean("full"), Feature("height", (-1, 0, 1, 2))
    place, door = Feature("place", ("home", "the shop")), Feature("door", ("open", "shut"), observed=True)
    mixed, factors = Feature("mixed", (1, True, "1", "true", -3)), boolean("factors")
    light, sound = Observation("light", ("on", "off", "none")), Observation("sound", (0, 1, 2), null=0)
    slip, third, tenth = Parameter("slip"), Parameter("third"), Fraction(1, 10)
    climb = Action(
        "climb",
        {
            "height": Conditional(
                height < 2, Lottery(((height + 1, 1 - slip), (height.now, slip))), height.now
            ),
            "place": Conditional(door.next.is_("open"), place.now, Constant("home")),
        },
        rewards=-height,
        senses={
            "light": Conditional(
                full.next,
                Lottery(((Constant("on"), Constant(1 - tenth)), (Constant("off"), Constant(tenth)))),
                Constant("off"),
            )
        },
    )
    quarter = Fraction(1, 4)
    model = Model(
        "errand",
        [full, height, place, door, mixed, factors],
        [climb, Action("do nothing")],
        rewards=[
            Constant(Fraction(-1)),
            Constant(Fraction(1, 2)),
            Conditional(
                full.next & Reference("light").is_("on"), Constant(Fraction(10)), Constant(Fraction(0))
            ),
        ],
        terminal=place.is_("home") & full.now,
        initial=InitialBelief(
            {
                "height": Lottery(tuple((Constant(Fraction(v)), Constant(quarter)) for v in (-1, 0, 1, 2))),
                "place": Lottery(
                    ((Constant("home"), Constant(3 * quarter)), (Constant("the shop"), Constant(quarter)))
                ),
                "full": FALSE,
                "factors": Lottery(((TRUE, Constant(Fraction(1, 7))), (FALSE, Constant(Fraction(6, 7))))),
            },
            [
                Constant(Fraction(2)),
                Conditional(height < 2, Constant(Fraction(1)), Constant(Fraction(1, 3))),
            ],
        ),
        discount=Fraction(19, 20),
        observability="partial",
        observations=[light, sound],
        parameters={"slip": tenth, "third": Fraction(1, 3)},
        horizon=40,
        description="    two\n    lines",
    )
    up = Task(
        "Up",
        ["climb", "do nothing"],
        terminal=height.is_(2),
        pseudo_rewards=[-third, Constant(Fraction(1))],
        pseudo_rewards_of=[("climb", [-2]), ("do nothing", [-2, -height.next]), ("climb", [3])],
        adds_reward=True,
        observes=["light"],
        solver="HSVI2",
    )
    document = read_native(text.replace("\n    two\n    lines", "\n    two\n    lines"))
    assert document.model == model
    assert [type(v) for v in document.model.features[4].values] == [int, bool, str, str, int]
    assert document.tasks == TaskHierarchy([Task("Root", ["Up", "do nothing"]), up])


SMALL = """
discount = 0.9
[features]
x = "boolean"
[actions.a]
"""


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.95", Fraction(19, 20)), ("9.5e-1", Fraction(19, 20)), ('"19/20"', Fraction(19, 20)),
        ("1", Fraction(1)),
        ("+0.5", Fraction(1, 2)), ("0.333_333", Fraction(333333, 10**6)), ('" 1 - 2/3 "', Fraction(1, 3)),
        ("0x0", Fraction(0)), ("0.1", Fraction(1, 10)), (f"0.{'0' * 60}1", Fraction(1, 10**61)),
    ],
)  # fmt: skip
def test_numbers_are_the_exact_rationals_that_were_written(text: str, value: Fraction) -> None:
    assert read_native(SMALL.replace("0.9", text)).model.discount == value


def test_numbers_and_truth_values_stand_wherever_an_expression_may() -> None:
    text = SMALL.replace("[features]", "reward = [-1, -0.25, 1e2]\nterminal = false\n[features]")
    model = read_native(text + "applicable = true\neffects.x = true\nreward = -0.1").model
    assert model.rewards == tuple(Constant(Fraction(v)) for v in ("-1", "-0.25", "100"))
    assert model.actions == (Action("a", {"x": TRUE}, rewards=Fraction(-1, 10)),)


def test_a_byte_order_mark_and_windows_line_ends_change_nothing() -> None:
    text = SMALL + 'reward = """\n  x ==\n    true"""\n'
    assert read_native("\ufeff" + text.replace("\n", "\r\n")) == read_native(text)


def test_the_file_gives_the_name_where_the_text_does_not() -> None:
    assert read_native(SMALL, name="corridor").model.name == "corridor"
    assert read_native('name = "mine"' + SMALL, name="corridor").model.name == "mine"


def test_overrides_set_parameters_and_are_checked() -> None:
    text = SMALL + "reward = 'p * q'\n[parameters]\np = 0.5\nq = 2\n"
    model = read_native(text, {"p": "1/3"}).model
    assert model.parameters == (("p", Fraction(1, 3)), ("q", Fraction(2)))
    with pytest.raises(ModelError) as caught:
        read_native(text, {"r": "1", "p": "1 +", "q": "x"})
    messages = [str(fault) for fault in caught.value.faults]
    assert "no parameter 'r' (its parameters are p, q)" in messages[0]
    assert "the value '1 +' for a parameter: the expression ends too early" in messages[1]
    assert "the value 'x' for a parameter: unknown name 'x'" in messages[2]
    assert all(fault.line == 0 for fault in caught.value.faults), "they stand in no file"


# --------------------------------------------------------------------------------------------
# Faults: "§" marks the place where each must be found
# --------------------------------------------------------------------------------------------

HEAD = """discount = 0.9
[parameters]
p = 0.5
[features]
x = "0..4"
c = ["red", "two words"]
[actions.A]
[actions.B]
"""

FAULTS = [
    # tables, keys and values
    ("§disount = 1\n" + HEAD, "unknown key 'disount'", "did you mean 'discount'?"),
    (HEAD + "§efects.x = 1\n", "unknown key 'efects'", "effects, applicable, reward, senses"),
    (HEAD + "[tasks.T]\nactions = ['A']\n'§pseudo reward' = 1\n", "key 'pseudo reward'", "observes"),
    (HEAD.replace("discount = 0.9\n", "") + "§", "no discount", "discount = 0.95"),
    (HEAD.replace("0.9", "§nan"), "nan is not a rational number", ""),
    (HEAD.replace("0.9", '"§high"'), "unknown name 'high'", ""),
    (HEAD.replace("0.9", '"§true"'), "'true' is not a number", "19/20"),
    (HEAD.replace("0.9", "§1.5"), "the discount is 3/2", "0 <= discount <= 1"),
    (HEAD.replace("0.9", "§2024-02-03"), "a date or time", ""),
    (HEAD.replace("0.9", "§[0.9]"), "found a list", ""),
    ("horizon = §true\n" + HEAD, "true is no number of steps", "whole number"),
    ("horizon = §0\n" + HEAD, "the horizon is 0", ""),
    ('observability = "§some"\n' + HEAD, "observability is 'some'", '"full" or "partial"'),
    ("name = §1\n" + HEAD, "expected a text in quotes, found an integer", ""),
    (HEAD.replace('"0..4"', '"§4..0"'), "the range '4..0' is empty", "0..4"),
    (HEAD.replace('"0..4"', '"§0..100000"'), "more than 100000 values", ""),
    (HEAD.replace('"0..4"', '"§bool"'), "'bool' gives no values", "boolean"),
    (HEAD.replace('"0..4"', "[0, 1, §0.5]"), "a number can't be a value", "integer"),
    (HEAD.replace('"0..4"', "[0, §1000000000000000000]"), "an integer can't be a value", "18 digits"),
    (HEAD.replace('"0..4"', "§[0, 0]"), "lists the value 0 2 times", ""),
    (HEAD.replace('"0..4"', "§[]"), "has no values", ""),
    (HEAD.replace('"0..4"', "{ values = '0..4', §watched = true }"), "unknown key 'watched'", "observed"),
    (HEAD.replace('"0..4"', "{ values = '0..4', observed = '§yes' }"), "expected true or false", ""),
    (HEAD.replace('"0..4"', "§{ observed = true }"), "feature 'x' has no values", ""),
    (HEAD + "[actions]\nC = §3\n", "expected a table, found an integer", ""),
    (HEAD + "effects = §['x']\n", "expected a table, found a list", ""),
    ("tasks = §1\n" + HEAD, "expected a table", ""),
    (HEAD.replace("p = 0.5", "p = '§x'"), "unknown name 'x'", ""),
    (HEAD.replace("p = 0.5", "p = 0.5\nc = §2"), "name 'c' is defined 2 times", ""),
    (HEAD + "[observations]\no = §['none']", "observation 'o' in a fully observed model", "partial"),
    (HEAD.replace("[features]", "[observations]\no = {values = ['none'], §nul = 1}\n[features]")
     .replace("discount", "observability = 'partial'\ndiscount"), "'nul'", "values, null"),
    # expressions
    (HEAD + "reward = 'x + §* 2'", "unexpected '*'", ""),
    (HEAD + 'reward = """\n  x +\n    §y"""', "unknown name 'y'", "known features: c, x"),
    (HEAD + "reward = '''\n  x +\n    §y'''", "unknown name 'y'", ""),
    (HEAD + 'reward = "x \\u002b \\t §y"', "unknown name 'y'", ""),
    (HEAD + 'reward = """x \\\n    + \\"red\\" * §y"""', "unknown name 'y'", ""),
    (HEAD + 'reward = ["1", # one\n  2, "x + §y"]', "unknown name 'y'", ""),
    (HEAD + "reward = §{ x = 1 }", "expected an expression", "found a table"),
    (HEAD + "reward = 'x == 1 and x = §2'".replace("= §2", "§= 2"), "unexpected character '='", "=="),
    (HEAD + 'effects.c = "{red: 1/2, §blue: 1/2}"', "unknown name 'blue'", "values: red, two words"),
    (HEAD + "effects.y = '§x'", "'y', which is no feature", "features are x, c"),
    (HEAD + "effects.x = \"§switch(x, 0: 1, 1: 2)\"", "no case for 2, 3, 4", "else"),
    (HEAD + "applicable = \"§x' == 1\"", "x' (the next state) can't be used here", ""),
    (HEAD + "applicable = '§{true: 1}'", "a distribution can't be used here", ""),
    (HEAD + "effects.x = \"§c'\"\neffects.c = \"red if x' == 1 else c\"", "in a circle", "acyclically"),
    (HEAD + "[actions.B.senses]\no = '§x'\n", "senses 'o', which is no observation", ""),
    (HEAD + "[initial]\nx = '{1: 1, §z: 0}'", "unknown name 'z'", ""),
    (HEAD + "[initial]\nz = '§uniform'", "'z', which is no feature", "features are x, c"),
    ("initial_factors = ['1', \"§x' + 1\"]\n" + HEAD, "x' (the next state) can't be used here", ""),
    ("terminal = 'x == §z'\n" + HEAD, "unknown name 'z'", ""),
    # tasks
    (HEAD + "[tasks.T]\nactions = '§A'\n", "expected a list of names", '["North", "South"]'),
    (HEAD + "[tasks.T]\nactions = ['A', §1]\n", "expected a text in quotes", ""),
    (HEAD + "[tasks.T]\nactions = §['A', 'C']\n", "'C' is neither an action nor a task", "A, B, T"),
    (HEAD + "[tasks.§A]\nactions = ['B']\n", "'A' is the name of a task and of an action", ""),
    (HEAD + "[tasks.T]\nactions = ['A']\npseudo_reward = [1, {A = ['1', 'x +§']}]", "ends too early", ""),
    (HEAD + "[tasks.T]\nactions = ['A']\npseudo_reward = [{A = 1}, '§{1: 1}']", "a distribution can't", ""),
    (HEAD + "[tasks.T]\nactions = ['A']\npseudo_reward = {C = §3}", "'C', which is no action", ""),
    (HEAD + "[tasks.T]\nactions = ['A']\n[tasks.T.pseudo_reward]\nA = '§z'", "unknown name 'z'", ""),
    (HEAD + "[tasks.T]\nactions = ['A']\nadds_reward = §1", "expected true or false", ""),
    (HEAD + "[tasks.T]\nactions = ['A']\nobserves = §['o']", "observes 'o', which is no observation", ""),
    (HEAD + "[tasks.T]\nactions = ['A']\n[tasks.§U]\nactions = ['B']", "2 tasks are nobody's child", ""),
    # TOML itself
    (HEAD + "x = §", "Invalid value", "texts stand in quotes"),
    (HEAD + "reward = §x + 1", "Invalid value", "texts stand in quotes"),
    (HEAD + "two §words = 1", "Expected '=' after a key", "quote a key"),
    (HEAD + "[actions.A§]", "Cannot declare", "opened only once"),
    (HEAD + "reward = 1\nreward = 2§", "Cannot overwrite a value", "only once"),
    (HEAD + "reward = '1§", "Expected \"'\"", ""),
    (HEAD + "reward = [1§", "Unclosed array", "]"),
    (HEAD + "reward = '\x00§'".replace("\x00§", "§\x00"), "Found invalid character", ""),
    (HEAD + "reward = " + "[" * 32 + "§" + "[" * 100_000, "deeper than 32 levels", ""),
    (HEAD + "reward = " + "{a=" * 32 + "§" + "{a=" * 1000, "deeper than 32 levels", ""),
    (HEAD + "a" + ".a" * 32 + "§" + ".a" * 100_000 + "=1", "deeper than 32 levels", ""),
    (HEAD + "reward = §" + "9" * 5000, "a number of more than 400 digits", ""),
    (HEAD + "reward = §0x" + "F" * 9000, "a number of more than 400 digits", ""),
    (HEAD + "reward = 'x + §" + "9" * 5000 + "'", "a number of more than 4000 digits", ""),
    (HEAD + "reward = §1e400000", "a decimal exponent beyond 400", ""),
    (HEAD + "reward = 'x ** §1e99999999'", "a decimal exponent beyond 400", ""),
    (HEAD + "reward = '§\ud800'", "surrogate", ""),
    (HEAD + "reward = '" + "(" * 5000 + "'", "nested", "switch"),
]  # fmt: skip


@pytest.mark.parametrize(("marked", "message", "hint"), FAULTS, ids=range(len(FAULTS)))
def test_a_fault_is_found_at_its_place(marked: str, message: str, hint: str) -> None:
    offset = marked.find("§")
    text = marked.replace("§", "")
    with pytest.raises(ModelError) as caught:
        read_native(text)
    (fault,) = caught.value.faults
    assert message in fault.message
    assert hint in fault.hint or hint in fault.message
    if offset >= 0 and "no discount" not in message:
        line = text.count("\n", 0, offset) + 1
        assert (fault.line, fault.column) == (line, offset - text.rfind("\n", 0, offset))


def test_all_faults_are_reported_at_once_in_the_order_of_the_text() -> None:
    text = """nam = 1
discount = 2
reward = ["x +", "y"]
[features]
x = "0..4"
[actions.A]
effects.x = "{x: 1"
effects.z = "1"
[tasks.T]
actions = ["B"]
terminal = "x' == 1"
"""
    with pytest.raises(ModelError) as caught:
        read_native(text)
    assert [(f.line, f.column) for f in caught.value.faults] == [
        (1, 1), (2, 12), (3, 15), (3, 19), (7, 19), (8, 14), (10, 11), (11, 13),
    ]  # fmt: skip


@pytest.mark.parametrize(
    "text",
    [
        HEAD.replace('x = "0..4"', "\n".join(f"x{i} = 'boolean'" for i in range(10_001))),
        HEAD.replace('x = "0..4"', "\n".join(f"x{i} = '1..100000'" for i in range(11))),
        HEAD + "\n".join(f"[actions.a{i}]" for i in range(100_001)),
    ],
    ids=["features", "values", "actions"],
)
def test_parts_beyond_the_caps_are_refused(text: str) -> None:
    with pytest.raises(ModelError, match=r"at most|in all"):
        read_native(text)


# --------------------------------------------------------------------------------------------
# Any text at all
# --------------------------------------------------------------------------------------------


def only_model_errors(text: str) -> bool:
    """Whether `text` is a model; any other exception than ModelError is a failure."""
    try:
        read_native(text)
    except ModelError as error:
        return not str(error)
    return True


PIECES = st.sampled_from([
    "[", "]", "{", "}", "=", ",", ".", "\n", " ", '"', "\'", '"""', "'''", "#", "\\", "\\u0000",
    "\x00", "0", "1e5", "inf", "nan", "-", "true", "1979-05-27", "discount", "features", "actions", "tasks",
    "reward", "x = 'boolean'\n", "reward = 'x'\n", "switch(x, else: 1)", "uniform", "pseudo_reward",
    "initial", "effects", "x", "x'", "values", "[features]\n", "[actions.a]\n", "[[tasks]]\n",
    "discount = 1\n", "(2**1000)**19", "0..4", "é",
])  # fmt: skip


@settings(max_examples=300, deadline=None, derandomize=True, database=None)
@given(st.one_of(st.text(max_size=200), st.lists(PIECES, max_size=40).map("".join)))
def test_no_text_raises_anything_but_a_model_error(text: str) -> None:
    only_model_errors(text)


def test_no_mutation_of_a_sound_file_raises_anything_but_a_model_error() -> None:
    rng = random.Random(20240607)
    sources = [template("t")]
    sources += [write_native(d.model, d.tasks) for d in map(random_document, range(1000, 1006))]
    sound = 0
    for _ in range(700):
        text = rng.choice(sources)
        for _ in range(rng.randint(1, 3)):
            i, j = sorted(rng.randrange(len(text) + 1) for _ in range(2))
            j = min(j, i + rng.randint(0, 30))
            new = rng.choice(["", text[j : j + 20], rng.choice("[]{}()=\"'\\\n,.0x#é\x00"), text[i:j] * 2])
            text = text[:i] + new + text[j:]
        sound += only_model_errors(text)
    assert 40 < sound < 600, "the mutations neither break all nor none"


KEYS = ["x", "a", "values", "null", "effects", "senses", "reward", "actions", "terminal"]
SECTIONS = [
    "name", "description", "discount", "horizon", "observability", "parameters", "features", "tasks",
    "observations", "initial", "initial_factors", "reward", "terminal", "actions", "tasks.a", "actions.a",
]  # fmt: skip
TEXTS = st.sampled_from(["x", "boolean", "0..4", "a", "{x: 1}"])
SHAPES = st.recursive(
    st.one_of(st.booleans(), st.integers(), st.floats(), TEXTS),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3), st.dictionaries(st.sampled_from(KEYS), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(SHAPES, st.sampled_from(SECTIONS))
def test_no_value_of_a_wrong_shape_raises_anything_but_a_model_error(value: Any, key: str) -> None:
    base = {"discount": "0.5", "features": "{x = 'boolean'}", "actions": "{a = {}}"}
    base.pop(key.partition(".")[0], None)
    lines = [f"{name} = {text}" for name, text in base.items()]
    only_model_errors("\n".join([*lines, f"{key} = {inline(value)}"]))


def inline(value: Any) -> str:
    """`value` as TOML on one line; JSON's strings are TOML's for plain texts."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {inline(part)}" for key, part in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(inline(part) for part in value) + "]"
    return str(value) if isinstance(value, float) else json.dumps(value)


# --------------------------------------------------------------------------------------------
# Writing
# --------------------------------------------------------------------------------------------


def simple(**changes: Any) -> Model:
    return Model("m", [Feature("x", range(3))], [Action("a")], discount="0.9", **changes)


def test_a_long_expression_is_broken_into_lines_and_stays_the_same() -> None:
    x = Feature("x", range(30))
    tree = Switch(x.now, tuple((v, parse(f"{{x: {v}/30, 0: 1 - {v}/30}}")) for v in range(30)))
    model = Model("m", [x], [Action("a", {x: tree})], discount="0.9")
    text = write_native(model)
    assert max(map(len, text.splitlines())) <= 100
    assert read_native(text).model == model


@pytest.mark.parametrize(
    ("model", "tasks", "message"),
    [
        (simple(rewards="y + 1"), None, "unknown name 'y'"),
        (simple(), TaskHierarchy([Task("T", ["b"])]), "'b' is neither an action nor a task"),
        (simple(description="\ud800"), None, "surrogate"),
        (simple(rewards=[Constant(Fraction(2**16000))]), None, "digits"),
        (Model("m", [Feature("x", (10**20, 1))], [Action("a")]), None, "18 digits"),
    ],
    ids=["unsound", "tasks", "surrogate", "digits", "value"],
)
def test_what_the_format_cannot_hold_is_refused(
    model: Model, tasks: TaskHierarchy | None, message: str
) -> None:
    with pytest.raises(ModelError, match=message):
        write_native(model, tasks)


def test_an_expression_too_large_to_write_out_is_refused_with_its_path() -> None:
    x = Feature("x", range(3))
    shared: Expression = x.now
    for _ in range(40):  # 2^40 leaves when written out
        shared = operation("divide", shared + 1, shared)
    model = Model("m", [x], [Action("a", {x: shared})], discount="0.9")
    with pytest.raises(ModelError, match="characters") as caught:
        write_native(model)
    assert caught.value.faults[0].path == ("actions", "a", "effects", "x")


def test_an_expression_nested_deeper_than_the_language_reads_is_refused() -> None:
    deep: Expression = Reference("x")
    for _ in range(200):
        deep = operation("absolute", operation("negate", deep))
    with pytest.raises(ModelError, match="deep"):
        write_native(simple(rewards=[deep]))


# --------------------------------------------------------------------------------------------
# The starter model
# --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["porter", 'my robot\'s "best"', "Übung\\1"])
def test_the_template_reads_and_checks_clean(name: str) -> None:
    document = read_native(template(name))
    assert document.model.name == name
    assert document.warnings == ()
    assert document.tasks is not None
    assert not check(document.model)
    assert not check_tasks(document.model, document.tasks)
    assert [task.name for task in document.tasks.roots()] == ["Deliver"]
    assert document.model.states == 15  # 5 cells x 3 places of the parcel
    mdp = enumerate_model(document.model)  # raises where a row does not sum to 1
    assert mdp.states == 15


def test_reading_stops_after_a_thousand_faults() -> None:
    text = "discount = 0.5\n[features]\nx = 'boolean'\n[actions.a]\n"
    text += "\n".join(f"[actions.b{k}]\nreward = 'y'" for k in range(3000))
    with pytest.raises(ModelError) as caught:
        read_native(text)
    faults = caught.value.faults
    assert len(faults) == 1001
    assert "reading stopped: there are 1000 faults" in faults[-1].message
    assert all(fault.line > 1 for fault in faults)


def test_what_is_missing_has_the_place_where_the_file_begins() -> None:
    with pytest.raises(ModelError) as caught:
        read_native("[features]\nx = 'boolean'\n")
    assert {(fault.line, fault.column) for fault in caught.value.faults} == {(1, 1)}


def test_a_switch_of_many_cases_is_read_in_time_that_grows_with_them() -> None:
    cases = ", ".join(f"{k}: {k}" for k in range(50_000))
    text = f"discount = 0.5\nreward = 'switch(x, {cases})'\n[features]\nx = '0..49999'\n[actions.a]\n"
    assert len(read_native(text).model.rewards) == 1
