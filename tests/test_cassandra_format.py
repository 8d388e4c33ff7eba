"""Cassandra's format: what a text denotes, what is refused and where, and how much work it may ask for."""

from __future__ import annotations

import os
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import product
from pathlib import Path

import pytest

from factored_polca.explicit.evaluate import Distribution, distribution, evaluate
from factored_polca.explicit.exact_pomdp import enumerate_pomdp
from factored_polca.formats import cassandra_tables, files, read_native, write_native
from factored_polca.formats.cassandra import read_pomdp, read_pomdp_with_warnings
from factored_polca.formats.cassandra_layers import MAXIMUM_STEPS
from factored_polca.models import Fault, Model, ModelError, check
from factored_polca.models.expressions import Reference, Switch, references

F = Fraction
ANY = "*"

TIGER = """
# a comment with : and * and T: in it
discount: 0.95
values: reward
states: tiger-left tiger-right   # two of them
actions: listen open-left open-right
observations: hear-left hear-right
start: 0.25 .75
T:listen
identity
T: open-left
uniform
T: open-right : * reset
O: listen
0.85 0.15
0.15 0.85
O: open-left uniform
O : open-right : * uniform
R: * : * : * : * -1
R: open-left : tiger-left : * : * -100
R:open-left:1:*:*+10
R: open-right : tiger-left : * : *  1e1
R: open-right : tiger-right : * : * - 100
"""


def small(
    body: str = "",
    *,
    states: str = "a b c",
    actions: str = "x y",
    observations: str | None = "p q",
    head: str = "discount: 0.5",
    rest: str = "T: * identity\nO: * uniform\n",
) -> str:
    """A file; `rest` completes the tables before `body`."""
    lines = [head, f"states: {states}", f"actions: {actions}"]
    if observations is not None:
        lines.append(f"observations: {observations}")
    return "\n".join(lines) + f"\n{rest}{body}\n"


# -- reading a model back, value by value, from its expressions ----------------------------------


def transition(model: Model, a: int, s: int) -> tuple[Fraction, ...]:
    feature = model.features[0]
    effects = dict(model.actions[a].effects)
    effect = effects.get("state", Reference("state"))
    row = distribution(effect, feature.values, {("state", False): feature.values[s]})
    assert isinstance(row, tuple), row
    return row


def sensing(model: Model, a: int, t: int) -> tuple[Fraction, ...]:
    channel = model.observations[0]
    sensed = dict(model.actions[a].senses)["observation"]
    row = distribution(sensed, channel.values, {("state", True): model.features[0].values[t]})
    assert isinstance(row, tuple), row
    return row


def reward(model: Model, a: int, s: int, t: int, o: int | None) -> Fraction:
    values = model.features[0].values
    assignment = {("state", False): values[s], ("state", True): values[t]}
    if o is not None:
        assignment["observation", False] = model.observations[0].values[o]
    total = F(0)
    for term in (*model.rewards, *model.actions[a].rewards):
        value = evaluate(term, assignment)
        assert isinstance(value, Fraction), value
        total += value
    return total


def start(model: Model) -> tuple[Fraction, ...]:
    values = model.features[0].values
    given = dict(model.initial.distributions)
    if not given:  # uniform, by the definition of `InitialBelief`
        return tuple(F(1, len(values)) for _ in values)
    row = distribution(given["state"], values, {})
    assert isinstance(row, tuple), row
    return row


# -- random files beside what they mean, entry by entry on full tables ---------------------------


@dataclass
class Text:
    """A file in the making, and its tables as dictionaries with a key for each cell."""

    rng: random.Random
    sizes: dict[str, int]
    named: dict[str, bool]
    cost: bool
    lines: list[str] = field(default_factory=list)
    tables: dict[str, dict[tuple[int, ...], Fraction]] = field(default_factory=dict)
    start: list[Fraction] = field(default_factory=list)

    def spell(self, kind: str, number: int) -> str:
        if number < 0:
            return ANY
        name = f"{kind}-{'abcdefgh'[number]}"
        return name if self.named[kind] and self.rng.random() < 0.6 else str(number)

    def pick(self, kind: str) -> int:
        return -1 if self.rng.random() < 0.4 else self.rng.randrange(self.sizes[kind])

    def put(self, table: str, index: Sequence[int], value: Fraction) -> None:
        kinds = KINDS[table][: len(index)]
        ranges = [range(self.sizes[k]) if i < 0 else [i] for k, i in zip(kinds, index, strict=True)]
        for cell in product(*ranges):
            self.tables[table][cell] = value

    def entry(self, table: str, index: Sequence[int], content: str) -> None:
        kinds = KINDS[table]
        spelled = [self.spell(kind, i) for kind, i in zip(kinds, index, strict=False)]
        colon = self.rng.choice([":", " : ", ": ", "\n:\n"])
        end = self.rng.choice(["\n", "  # x\n", "\n\n"])
        self.lines.append(f"{table}{colon}{colon.join(spelled)} {content}{end}")


KINDS = {
    "T": ("action", "state", "state"),
    "O": ("action", "state", "observation"),
    "R": ("action", "state", "state", "observation"),
}


def spelled(rng: random.Random, value: Fraction) -> str:
    """A decimal for `value`, a multiple of 1/20, in one of several spellings."""
    plain = f"{float(value):.2f}"
    forms = [plain, f"{float(value * 100):.0f}e-2", f"{float(value):+.3f}", plain.replace("0.", ".", 1)]
    return rng.choice(forms)


def random_row(rng: random.Random, size: int) -> list[Fraction]:
    cuts = sorted(rng.choice([0, 5, 10, 20, rng.randrange(21)]) for _ in range(size - 1))
    return [F(b - a, 20) for a, b in zip([0, *cuts], [*cuts, 20], strict=True)]


def add_rewards(text: Text) -> None:
    rng = text.rng
    last = KINDS["R"] if text.sizes["observation"] else KINDS["R"][:3]
    for _ in range(rng.randrange(12)):
        given = len(last) - rng.choice([0, 0, 0, 1, 2])
        index = [text.pick(kind) for kind in last[:given]]
        shape = [range(text.sizes[kind]) for kind in last[given:]]
        amounts = [F(rng.choice([0, 0, 0, 1, rng.randrange(-30, 31)]), 20) for _ in product(*shape)]
        numbers = " ".join(spelled(rng, amount) for amount in amounts)
        star = " : *" if len(last) == 3 and given == 3 and rng.random() < 0.3 else ""
        text.entry("R", index, star + ("\n" if given < len(last) else " ") + numbers)
        for rest, amount in zip(product(*shape), amounts, strict=True):
            text.put("R", [*index, *rest], -amount if text.cost else amount)


def add_rows(text: Text, table: str) -> None:
    """Some entries of all kinds, then rows for all states that those leave without the sum 1."""
    rng = text.rng
    columns = text.sizes[KINDS[table][2]]
    square = columns == text.sizes["state"]
    even = [F(1, columns)] * columns
    for _ in range(rng.randrange(8)):
        given = rng.choice([1, 2, 3, 3])
        index = [text.pick(kind) for kind in KINDS[table][:given]]
        if given == 3:
            value = F(rng.randrange(0, 21), 20)
            text.entry(table, index, spelled(rng, value))
            text.put(table, index, value)
            continue
        height = text.sizes["state"] if given == 1 else 1
        rows = [random_row(rng, columns) for _ in range(height)]
        content = "\n".join(" ".join(spelled(rng, p) for p in row) for row in rows)
        match rng.randrange(5):
            case 0:
                content, rows = "uniform", [even] * height
            case 1 if table == "T":
                content, rows = "reset", [text.start] * height
            case 2 if given == 1 and square:
                content, rows = "identity", [[F(i == k) for k in range(columns)] for i in range(height)]
        text.entry(table, index, content)
        for state, row in enumerate(rows):
            for column, p in enumerate(row):
                text.put(table, [*index, *([state] if given == 1 else []), column], p)
    for a, s in product(range(text.sizes["action"]), range(text.sizes["state"])):
        now = [text.tables[table].get((a, s, k), F(0)) for k in range(columns)]
        if sum(now) == 1:
            continue
        row = random_row(rng, columns)
        single = rng.random() < 0.5
        if not single:
            text.entry(table, [a, s], " ".join(spelled(rng, p) for p in row))
        for column, p in enumerate(row):
            if single and p != now[column]:
                text.entry(table, [a, s, column], spelled(rng, p))
            text.put(table, [a, s, column], p)


def random_text(seed: int) -> Text:
    rng = random.Random(seed)
    sizes = {"state": rng.randint(1, 4), "action": rng.randint(1, 3)}
    sizes["observation"] = rng.choice([0, 1, 2, 3, sizes["state"]])
    named = {kind: rng.random() < 0.6 for kind in sizes}
    text = Text(rng, sizes, named, cost=rng.random() < 0.3)
    text.tables = {"T": {}, "O": {}, "R": {}}
    head = ["discount: 0.9"]
    if text.cost or rng.random() < 0.5:
        head.append(f"values: {'cost' if text.cost else 'reward'}")
    for kind, size in sizes.items():
        listed = " ".join(f"{kind}-{c}" for c in "abcdefgh"[:size]) if named[kind] else str(size)
        if size:
            head.append(f"{kind}s: {listed}")
    size = sizes["state"]
    text.start = random_row(rng, size)
    if rng.random() < 0.5:
        head.append("start: " + " ".join(spelled(rng, p) for p in text.start))
    elif rng.random() < 0.7:
        chosen = sorted(rng.sample(range(size), rng.randint(1, size)))
        form = rng.choice(["include", "exclude"]) if len(chosen) < size else "include"
        head.append(f"start {form}: " + " ".join(text.spell("state", s) for s in chosen))
        kept = [s for s in range(size) if (s in chosen) is (form == "include")]
        text.start = [F(s in kept, len(kept)) for s in range(size)]
    else:
        text.start = [F(1, size)] * size
    rng.shuffle(head)
    text.lines = [f"{line}\n" for line in head]
    add_rows(text, "T")
    if sizes["observation"]:
        add_rows(text, "O")
    add_rewards(text)
    return text


def told(text: Text, table: str, *cell: int) -> Fraction:
    return text.tables[table].get(cell, F(0))


@pytest.mark.parametrize("block", range(6))
def test_random_files_mean_what_their_entries_say_one_after_the_other(block: int) -> None:
    for seed in range(50 * block, 50 * block + 50):
        text = random_text(seed)
        n, actions, m = (text.sizes[k] for k in ("state", "action", "observation"))
        model, warnings = read_pomdp_with_warnings("".join(text.lines), "random")
        assert not warnings
        assert not check(model)
        assert (model.states, len(model.actions)) == (n, actions)
        assert model.observability == ("partial" if m else "full")
        assert list(start(model)) == text.start, seed
        for a, s in product(range(actions), range(n)):
            expected = tuple(told(text, "T", a, s, t) for t in range(n))
            assert transition(model, a, s) == expected, (seed, a, s)
            if m:
                assert sensing(model, a, s) == tuple(told(text, "O", a, s, o) for o in range(m)), (
                    seed,
                    a,
                    s,
                )
            for t, o in product(range(n), range(m) if m else [None]):
                cell = (a, s, t) if o is None else (a, s, t, o)
                assert reward(model, a, s, t, o) == told(text, "R", *cell), (seed, cell)


def test_rewards_decided_in_the_other_order_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cassandra_tables, "FIRST_TRY", 0)
    monkeypatch.setattr(cassandra_tables, "SECOND_TRY", 0)
    for seed in range(100):
        text = random_text(seed)
        n, actions, m = (text.sizes[k] for k in ("state", "action", "observation"))
        model = read_pomdp("".join(text.lines), "random")
        for cell in product(range(actions), range(n), range(n), range(m)):
            assert reward(model, *cell) == told(text, "R", *cell), (seed, cell)


def depends(text: Text, a: int, place: int, sizes: Sequence[int]) -> bool:
    """Whether R(a, ...) changes with its index number `place`, the others held."""
    for cell in product(*(range(size) for size in sizes)):
        changed = [(*cell[:place], v, *cell[place + 1 :]) for v in range(sizes[place])]
        if len({told(text, "R", a, *other) for other in changed}) > 1:
            return True
    return False


def test_rewards_mention_just_the_references_that_they_depend_on() -> None:
    named = [Reference("state"), Reference("state", primed=True), Reference("observation")]
    seen = set()
    for seed in range(150):
        text = random_text(seed)
        model = read_pomdp("".join(text.lines), "random")
        sizes = [text.sizes["state"]] * 2 + [text.sizes["observation"]] * (text.sizes["observation"] > 0)
        for a, action in enumerate(model.actions):
            expected = {named[k] for k in range(len(sizes)) if depends(text, a, k, sizes)}
            assert references(*model.rewards, *action.rewards) == expected, (seed, a)
            seen.add(frozenset(expected))
    assert len(seen) == 8  # all subsets of the three have been met


def test_the_joint_kernel_is_the_product_of_t_and_o_and_rewards_are_expectations() -> None:
    for seed in range(300, 340):
        text = random_text(seed)
        n, m = text.sizes["state"], text.sizes["observation"]
        if not m:
            continue
        pomdp = enumerate_pomdp(read_pomdp("".join(text.lines), "random"))
        labels = read_pomdp("".join(text.lines), "random").observations[0].values
        for a, s in product(range(text.sizes["action"]), range(n)):
            joint = {
                (t, labels[o]): told(text, "T", a, s, t) * told(text, "O", a, t, o)
                for t, o in product(range(n), range(m))
            }
            found = {(t, pomdp.observations[o][0]): p for (t, o), p in pomdp.kernel[a][s].items()}
            assert found == {key: p for key, p in joint.items() if p}
            expected = sum(
                (
                    told(text, "T", a, s, t) * told(text, "O", a, t, o) * told(text, "R", a, s, t, o)
                    for t, o in product(range(n), range(m))
                ),
                F(0),
            )
            assert pomdp.rewards[a][s] == expected


# -- what a text denotes --------------------------------------------------------------------------


def test_the_tiger_problem_is_what_it_says() -> None:
    model, warnings = read_pomdp_with_warnings(TIGER, "tiger")
    assert (model.name, warnings, check(model)) == ("tiger", (), [])
    assert model.discount == F(19, 20)
    assert model.features[0].values == ("tiger-left", "tiger-right")
    assert model.observations[0].values == ("hear-left", "hear-right")
    assert [action.name for action in model.actions] == ["listen", "open-left", "open-right"]
    assert start(model) == (F(1, 4), F(3, 4))
    assert model.actions[0].effects == ()  # it persists
    free = read_pomdp(TIGER + "R: listen : * : * : * 0", "tiger")
    assert [len(action.rewards) for action in free.actions] == [0, 1, 1]
    assert [transition(model, 1, s) for s in (0, 1)] == [(F(1, 2), F(1, 2))] * 2
    assert [transition(model, 2, s) for s in (0, 1)] == [(F(1, 4), F(3, 4))] * 2
    assert [sensing(model, 0, s) for s in (0, 1)] == [(F(17, 20), F(3, 20)), (F(3, 20), F(17, 20))]
    assert [sensing(model, a, 1) for a in (1, 2)] == [(F(1, 2), F(1, 2))] * 2
    table = [[reward(model, a, s, 0, 1) for s in (0, 1)] for a in range(3)]
    assert table == [[-1, -1], [-100, 10], [10, -100]]


def test_costs_are_negative_rewards() -> None:
    entries = "R: x : a : * : * 2.5\nR: y : b : c\n 1 -3\n"
    gains = read_pomdp(small(entries, head="discount: 0\nvalues: reward"), "m")
    costs = read_pomdp(small(entries, head="values: cost discount: 0"), "m")
    cells = list(product(range(2), range(3), range(3), range(2)))
    assert [reward(costs, *cell) for cell in cells] == [-reward(gains, *cell) for cell in cells]
    assert reward(costs, 1, 1, 2, 1) == 3


def test_counts_give_integers_and_numbered_actions() -> None:
    model = read_pomdp(small("R: 1 : 2 : 0 : 1 4", states="3", actions="2", observations="2"), "m")
    assert model.features[0].values == (0, 1, 2)
    assert model.observations[0].values == (0, 1)
    assert [action.name for action in model.actions] == ["0", "1"]
    assert reward(model, 1, 2, 0, 1) == 4
    spelled_out = read_pomdp(small(states="0 1 2"), "m")
    assert spelled_out.features[0].values == (0, 1, 2)


def test_a_file_without_observations_is_an_mdp() -> None:
    text = small(
        "R: x : a : b 1\nR: x : b\n 5 6 7\nR: y\n 1 2 3 4 5 6 7 8 9\nR: x : c : * : * 2",
        observations=None, rest="T: * identity\n",
    )  # fmt: skip
    model = read_pomdp(text, "m")
    assert (model.observability, model.observations) == ("full", ())
    assert [[reward(model, 0, s, t, None) for t in range(3)] for s in range(3)] == [
        [0, 1, 0], [5, 6, 7], [2, 2, 2],
    ]  # fmt: skip
    assert [reward(model, 1, s, t, None) for s in range(3) for t in range(3)] == list(range(1, 10))


@pytest.mark.parametrize(
    ("line", "belief"),
    [
        ("", (F(1, 3),) * 3),
        ("start: uniform", (F(1, 3),) * 3),
        ("start: b", (0, 1, 0)),
        ("start: 2", (0, 0, 1)),
        ("start: 0.5 0 .5", (F(1, 2), 0, F(1, 2))),
        ("start include: c a c", (F(1, 2), 0, F(1, 2))),
        ("start  include : 1", (0, 1, 0)),
        ("start exclude: a", (0, F(1, 2), F(1, 2))),
        ("start exclude: a 1", (0, 0, 1)),
    ],
)
def test_every_form_of_start_gives_its_belief(line: str, belief: tuple[Fraction, ...]) -> None:
    before = read_pomdp(small(head=f"discount: 0.5\n{line}"), "m")
    after = read_pomdp(small(rest=f"{line}\nT: * identity\nO: * uniform\n"), "m")
    assert start(before) == start(after) == belief
    reset = read_pomdp(small("T: y reset", head=f"discount: 0.5\n{line}"), "m")
    assert [transition(reset, 1, s) for s in range(3)] == [belief] * 3


@pytest.mark.parametrize(("line", "belief"), [("start: 1", 1), ("start: 1.0", 1), ("start: 0", 1)])
def test_one_state_starts_with_certainty(line: str, belief: int) -> None:
    text = small(states="1", head=f"discount: 0.5\n{line}", rest="T: * 1\nO: * uniform\n")
    assert start(read_pomdp(text, "m")) == (belief,)


def test_later_entries_override_earlier_ones_wildcard_or_not() -> None:
    body = (
        "T: x : a\n0.5 0.5 0\nT: * : * : c 1\nT: * : * : b 0\nT: * : * : a 0\n"
        "T: y : b : b 1\nT: y : b : c 0\n"
        "R: x : a : b : p 1\nR: * : a : * : * 2\nR: x : * : b : p 3\nR: * : * : * : q 4\n"
        "R: y : c : * : * 5\n"
    )
    model = read_pomdp(small(body), "m")
    assert [transition(model, 0, s) for s in range(3)] == [(0, 0, 1)] * 3
    assert [transition(model, 1, s) for s in range(3)] == [(0, 0, 1), (0, 1, 0), (0, 0, 1)]
    assert [[reward(model, 0, s, 1, o) for o in (0, 1)] for s in range(3)] == [[3, 4]] * 3
    assert [[reward(model, 0, s, 2, o) for o in (0, 1)] for s in range(3)] == [[2, 4], [0, 4], [0, 4]]
    assert [[reward(model, 1, s, 2, o) for o in (0, 1)] for s in range(3)] == [[2, 4], [0, 4], [5, 5]]


def test_words_of_the_format_may_be_names() -> None:
    text = small(
        "T: start : T : reward 1\nT: start : T : T 0\nO: T : reset\n 0.25 0.75",
        states="T reward reset", actions="start T", observations="none state",
    )  # fmt: skip
    model = read_pomdp(text, "m")
    assert transition(model, 0, 0) == (0, 1, 0)
    assert sensing(model, 1, 2) == (F(1, 4), F(3, 4))


def test_names_of_any_sort_survive_the_native_format() -> None:
    body = "T: state : if : 2nd 1\nT: state : if : if 0\nR: * : true : * : observation 0.1"
    names = "if true state none 2nd a.b x-1"
    model = read_pomdp(small(body, states=names, actions="state go", observations="observation state"), "m")
    again = read_native(write_native(model)).model
    for a, s in product(range(2), range(7)):
        assert transition(again, a, s) == transition(model, a, s)
        assert sensing(again, a, s) == sensing(model, a, s)
        assert reward(again, a, s, 0, 0) == reward(model, a, s, 0, 0) == (F(1, 10) if s == 1 else 0)
    assert transition(model, 0, 0) == (0, 0, 0, 0, 1, 0, 0)


def test_equal_rows_and_equal_tables_are_one_object() -> None:
    text = small(
        "T: x\n0.5 0.5 0\n.50 5e-1 0\n0 0 1\nT: y\n0.5 0.5 0\n.50 5e-1 0\n0 0 1\nR: * : * : c : * 7",
        rest="O: * uniform\n",
    )
    model = read_pomdp(text, "m")
    x, y = (dict(action.effects)["state"] for action in model.actions)
    assert x is y
    assert isinstance(x, Switch)
    assert [value for value, _ in x.cases] == ["c"]
    assert model.actions[0].senses[0][1] is model.actions[1].senses[0][1]
    assert [str(term) for term in model.rewards] == [str(model.rewards[0])]
    assert all(action.rewards == () for action in model.actions)


def test_a_table_in_which_most_states_persist_says_so_once() -> None:
    model = read_pomdp(small("T: y : a\n 0.5 0.5 0"), "m")
    ((_, effect),) = model.actions[1].effects
    assert isinstance(effect, Switch)
    assert effect.otherwise == Reference("state")
    assert [value for value, _ in effect.cases] == ["a"]


# -- rounded rows ---------------------------------------------------------------------------------


def test_rounded_rows_are_divided_by_their_sums_with_one_warning() -> None:
    text = small(
        "T: x : *\n0.33333 0.33333 0.33333\nO: y : b 0.50004 0.5",
        head="discount: 0.5\nstart: 0.3333 0.3333 0.33335",
    )
    model, warnings = read_pomdp_with_warnings(text, "m")
    assert transition(model, 0, 1) == (F(1, 3),) * 3
    assert sensing(model, 1, 1) == (F(50004, 100004), F(50000, 100004))
    assert start(model) == (F(6666, 19999), F(6666, 19999), F(6667, 19999))
    (warning,) = warnings
    assert warning.severity == "warning"
    # three transition rows, one observation row, the start, which misses most
    assert "5 rows miss the sum 1 by less than 1e-4" in warning.message
    assert "5e-05, in the start distribution" in warning.message
    assert (warning.line, warning.column) == (2, 1)


def test_rows_that_miss_by_more_are_named() -> None:
    told = refusal(small("T: x : b\n0.3 0.3 0.3999"))
    assert "line 7, column 1: transitions of action 'x' from state 'b': the row sums to 0.9999" in told


# -- what is refused ------------------------------------------------------------------------------


def refusal(text: str) -> str:
    with pytest.raises(ModelError) as caught:
        read_pomdp(text, "test")
    assert all(fault.line >= 1 and fault.column >= 1 for fault in caught.value.faults)
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "messages"),
    [
        ("", ["line 1, column 1", "no discount"]),
        (small(head=""), ["line 5, column 1", "no discount", "discount: 0.95"]),
        (small(head="discount: 1.01"), ["line 1, column 11", "0 <= discount <= 1"]),
        (small(head="discount: high"), ["line 1, column 11", "expected a number, found 'high'"]),
        (small(head="discount 0.5"), ["line 1, column 10", "expected ':' after 'discount'"]),
        (small(head="discount: 0.5 discount: 0.6"), ["line 1, column 15", "a second 'discount'"]),
        (small(head="discount: 0.5\nvalues: gain"), ["line 2, column 9", "'reward' or 'cost'"]),
        (small(head="discount: 0.5\nhorizon: 3"), ["line 2, column 1", "'horizon'", "'states:'"]),
        ("discount: 0.5 actions: 2", ["no states"]),
        ("discount: 0.5 states: 2", ["no actions"]),
        (small(states=""), ["line 2, column 1", "there are no states"]),
        (small(states="0"), ["line 2, column 9", "at least 1"]),
        (small(states="2.5"), ["line 2, column 9", "at least 1"]),
        (small(states="99999999999999999999"), ["line 2, column 9", "more than 100000 states"]),
        (small(actions="10001"), ["line 3, column 10", "more than 10000 actions"]),
        (small(states="a b a"), ["line 2, column 13", "lists 'a' twice"]),
        (small(states="a 7"), ["line 2, column 11", "'7' among the names of states"]),
        (small(states="a,b"), ["line 2, column 10", "unexpected character ','"]),
        (small(states="a" * 300), ["more than 255 characters"]),
        (small("T: z identity"), ["line 7, column 4", "'z' is no action", "x, y; or 0 to 1"]),
        (small("T: x : 3 : a 1"), ["line 7, column 8", "'3' is no state", "a, b, c; or 0 to 2"]),
        (small("T: x : -1 : a 1"), ["line 7, column 8", "'-1' is no state"]),
        (small("T: x : 1.0 : a 1"), ["line 7, column 8", "'1.0' is no state"]),
        (small("O: x : a : c 1"), ["line 7, column 12", "'c' is no observation", "p, q; or 0 to 1"]),
        (small("T: x : a : b : c 1"), ["line 7, column 14", "an index too many"]),
        (small("R: x : a : b : p : q 1"), ["line 7, column 18", "an index too many"]),
        (small("R: x 3"), ["line 7, column 6", "R has at least R: action : state"]),
        (small("T: x : a : b -0.5"), ["line 7, column 14", "'-0.5' is no probability"]),
        (small("T: x : a 0.5 2 0"), ["line 7, column 14", "'2' is no probability"]),
        (small("T: x : a 0.5 0.5"), ["line 8, column 1", "expected 3 numbers, found 2", "end of the file"]),
        (small("T: x : a 0.5 0.25 0.25 0"), ["line 7, column 24", "unexpected '0'", "is complete"]),
        (small("T: x\n1 0 0\n0 1 0\n0 1 O"), ["line 10, column 5", "row 3 of 3, found 2 and then 'O'"]),
        (small("T: x : a even"), ["line 7, column 10", "'uniform', 'identity' or 'reset'"]),
        (small("T: x : a : b uniform"), ["line 7, column 14", "expected a number"]),
        (small("T: x : a identity"), ["line 7, column 10", "found 0 and then 'identity'"]),
        (small("O: x reset"), ["line 7, column 6", "'reset'"]),
        (small("O: x identity"), ["line 7, column 6", "3 rows and 2 columns", "square"]),
        (small("R: x : a uniform"), ["line 7, column 10", "expected 2 numbers, row 1 of 3"]),
        (small("R: x : a : b : p 1/2"), ["line 7, column 19", "unexpected character '/'"]),
        (small("discount: 0.6"), ["line 7, column 1", "must stand before the first T, O or R"]),
        (small("Q: x identity"), ["line 7, column 1", "unexpected 'Q'", "'T:', 'O:' or 'R:'"]),
        (small("T x identity"), ["line 7, column 3", "expected ':'"]),
        (small("* 3"), ["line 7, column 1", "unexpected '*'"]),
        (small("O: x uniform", observations=None, rest="T: * identity\n"), ["line 5, column 1", "MDP"]),
        (small(head="discount: 0.5\nstart:"), ["line 2, column 1", "'start' says nothing"]),
        (small(head="discount: 0.5\nstart: 0.5 0.5"), ["line 2, column 12", "2 numbers for 3 states"]),
        (small(head="discount: 0.5\nstart: 0 0 0 1"), ["line 2, column 14", "4 numbers for 3 states"]),
        (small(head="discount: 0.5\nstart: 0 0 d"), ["line 2, column 12", "expected a number, found 'd'"]),
        (small(head="discount: 0.5\nstart: d"), ["line 2, column 8", "'d' is no state", "a, b, c"]),
        (small(head="discount: 0.5\nstart: *"), ["line 2, column 8", "start: uniform"]),
        (small(head="discount: 0.5\nstart: 0.5 0.4 0"), ["line 2, column 1", "the row sums to 0.9"]),
        (small(head="discount: 0.5\nstart exclude: a b c"), ["line 2, column 1", "leaves no state"]),
        (small(head="discount: 0.5\nstart include 1"), ["line 2, column 15", "expected ':'"]),
        (small(rest="O: * uniform\n"),
         ["transitions of action 'x' from state 'a' (and 5 more", "no entry sets the row"]),
        (small("T: x identity\nT: y : b reset", rest="O: * uniform\n"),
         ["transitions of action 'y' from state 'a' (and 1 more", "no entry sets the row"]),
        (small(rest="T: * identity\n"), ["observations of action 'x'", "no entry sets the row"]),
        (small("O: y : b : q 0"), ["line 7, column 1: observations of action 'y' at the next state 'b'",
                                   "the row sums to 0.5"]),
        (small("T: x\n0 1 0\n0.5 0.25 .25\n0 0 1\nT: x : a : * 0.25\nT: x : a : a 0.5\n"
               "T: x : c : * 0\nT: x : c : a 0.5"),
         ["line 14, column 1: transitions of action 'x' from state 'c': the row sums to 0.5"]),
        (small("T: * : b : b 0"), ["transitions of action 'x' from state 'b' (and 1 more", "sums to 0"]),
        ("\ufeffdiscount: 1e30000000", ["line 1, column 12", "exponent"]),
        ("discount: 0." + "3" * 100_000, ["line 1, column 11", "digits"]),
        (small("R: * : * : * : * 1e999999"), ["line 7, column 18", "exponent"]),
    ],
)  # fmt: skip
def test_a_wrong_text_is_refused_with_its_place_and_what_would_be_right(
    text: str, messages: Sequence[str]
) -> None:
    told = refusal(text)
    for message in messages:
        assert message in told


def test_all_faulty_rows_are_told_at_once_up_to_twenty() -> None:
    body = "".join(f"T: x : {s} : {s} 0.5\n" for s in range(50))
    text = small(body, states="50")
    assert len(refusal(text).splitlines()) == 20
    assert len(refusal(small("T: x : a : a 0.5\nO: y : b : p 0"))) > 1


# -- how much work a file may ask for -------------------------------------------------------------


def test_wildcards_over_many_states_are_not_expanded() -> None:
    text = small(
        "T: x : * : 7 1\nT: * : 5 : * 0\nT: * : 5 : 99999 1\nR: * : * : * : * -1\nR: * : 17 : * : q 3\n"
        "R: x : * : 99999 : * 4\nO: * : 3 : * 0\nO: * : 3 : 0 1\n",
        states="100000", rest="T: * : * : 0 0\nT: y identity\nO: * : * : p 0.5\nO: * : * : q 0.5\n",
    )  # fmt: skip
    model = read_pomdp(text, "m")
    effect = dict(model.actions[0].effects)["state"]
    assert isinstance(effect, Switch)
    assert len(effect.cases) == 1
    assert str(effect.otherwise) == "7"
    assert evaluate(effect, {("state", False): 5}) == 99_999
    assert evaluate(model.actions[0].rewards[0], {
        ("state", False): 17, ("state", True): 99_999, ("observation", False): "p"}) == 4  # fmt: skip
    assert reward(model, 1, 17, 99_999, 1) == 3
    sensed = evaluate(model.actions[1].senses[0][1], {("state", True): 2})
    assert isinstance(sensed, Distribution)
    assert sensed.probability("p") == F(1, 2)


def test_rewards_of_all_states_and_of_all_next_states_are_decided_in_the_shorter_order() -> None:
    n = 3000
    body = "".join(f"R: * : {s} : * : * 1\n" for s in range(n))
    body += "".join(f"R: * : * : {t} : * {t % 3}\n" for t in range(n))
    (term,) = read_pomdp(small(body, states=str(n)), "m").rewards
    assert references(term) == {Reference("state", primed=True)}
    assert [evaluate(term, {("state", True): t}) for t in range(6)] == [0, 1, 2, 0, 1, 2]


def test_tables_that_need_too_much_work_are_refused_by_a_count() -> None:
    n = 6000
    body = "".join(f"T: * : * : {t} {1 if t == 0 else 0}\n" for t in range(n))
    body += "".join(f"T: * : {s} : 1 0\n" for s in range(n))
    told = refusal(small(body, states=str(n), rest="O: * uniform\n"))
    assert f"more than {MAXIMUM_STEPS} steps" in told
    assert "whole rows" in told


def test_long_runs_of_anything_are_read_or_refused_in_time_that_grows_with_them() -> None:
    long = 200_000
    assert read_pomdp(small("R: * : * : * : *" + " " * long + "1"), "m").rewards
    assert read_pomdp(small("#" * long + "\n" + "\n" * long), "m").states == 3
    assert "unexpected" in refusal(small("1 " * long))
    assert "lists 'T' twice" in refusal(small(states="T" + " " * long + "x y T"))
    assert "unexpected character ','" in refusal(small(" " * long + ","))
    assert "unexpected character '+'" in refusal(small("+" * long))
    assert "an index too many" in refusal(small("T" + ":0" * long))
    assert "more than 255" in refusal(small("T: " + "x" * long))
    assert "digits" in refusal(small("R: * : * : * : * " + "1" * long))
    assert "a file of more than" in refusal("#" * 40_000_001)


def faults_of(text: str) -> tuple[Fault, ...]:
    try:
        read_pomdp(text, "fuzz")
    except ModelError as error:
        return error.faults
    return ()


def test_changed_files_raise_nothing_but_model_errors() -> None:
    rng = random.Random(20240)
    pieces = ["T:", "O:", "R:", ":", "*", "identity", "uniform", "reset", "0", "1", "-1", ".5", "1e-3"]
    pieces += ["states:", "start:", "start include:", "#", "x", "+", "1e99999", ",", "\n", "\x00", "\ufeff"]
    sources = [TIGER, *("".join(random_text(seed).lines) for seed in range(20))]
    refused = 0
    for _ in range(2500):
        text = rng.choice(sources)
        for _ in range(rng.randint(1, 4)):
            at = rng.randrange(len(text) + 1)
            end = min(len(text), at + rng.choice([0, 0, 1, 3, 20]))
            text = text[:at] + rng.choice([*pieces, "", text[end : end + 15]]) + text[end:]
        faults = faults_of(text)
        refused += bool(faults)
        assert all(fault.line >= 1 and fault.column >= 1 for fault in faults)
    assert 1000 < refused < 2500


# -- files ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["tiger.POMDP", "tiger.pomdp", "tiger.MDP"])
def test_the_extension_chooses_the_format(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_text(TIGER)
    assert files.read(path).model.states == 2
    path.write_text(TIGER.replace("identity", "idenity"))
    with pytest.raises(ModelError, match=rf"{name}:10:1: expected 2 numbers"):
        files.read(path)
    with pytest.raises(ModelError, match="no parameters to set"):
        files.read(path, {"p": "1"})


COUNTS: Mapping[str, tuple[int, int, int]] = {
    "tiger.95.POMDP": (2, 3, 2),
    "tiger.aaai.POMDP": (2, 3, 2),
    "cheese.95.POMDP": (11, 4, 7),
    "shuttle.95.POMDP": (8, 3, 5),
    "4x3.95.POMDP": (11, 4, 6),
}


@pytest.mark.data
@pytest.mark.parametrize("name", COUNTS)
def test_the_published_files_have_the_numbers_that_their_authors_give(name: str) -> None:
    # (S, A, O) as in Cassandra's and others' tables of these problems
    document = files.read(Path(os.environ["FACTORED_POLCA_DATA"]) / name)
    model = document.model
    assert (model.states, len(model.actions), len(model.observations[0].values)) == COUNTS[name]
    assert model.discount == (F(3, 4) if "aaai" in name else F(19, 20))
    assert document.warnings == ()
    assert not check(model)
    assert enumerate_pomdp(model).states == COUNTS[name][0]
