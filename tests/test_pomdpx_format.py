"""POMDPX: what a document denotes, read independently and densely here, and what is refused.

`Dense` interprets a document from its definition: every cell of every table, one walk through the
diagram for every assignment.  The reader never makes such tables.
"""

from __future__ import annotations

import os
import random
from collections.abc import Iterator, Mapping
from fractions import Fraction
from itertools import product
from pathlib import Path
from xml.etree import ElementTree

import pytest

from factored_polca.explicit.evaluate import Distribution, distribution, evaluate
from factored_polca.formats import spudd_trees
from factored_polca.formats.files import FORMATS, read, write
from factored_polca.formats.pomdpx import read_pomdpx, read_pomdpx_with_warnings
from factored_polca.models import Action, Model, ModelError, Reference, check
from factored_polca.models.expressions import Expression, Switch, parts_first

F = Fraction
Names = Mapping[str, str]  # a variable of the document -> one of its values


# -- an independent, dense reading -----------------------------------------------------------------


class Dense:
    """A document read by its definition, for small ones."""

    def __init__(self, text: str) -> None:
        self.root = ElementTree.fromstring(text.encode("iso-8859-1"))
        self.values: dict[str, list[str]] = {}
        self.kinds: dict[str, list[str]] = {"StateVar": [], "ObsVar": [], "ActionVar": [], "RewardVar": []}
        self.later: dict[str, str] = {}  # vnamePrev -> vnameCurr
        for element in self.root.find("Variable") or ():
            names = [element.get("vname", "")]
            if element.tag == "StateVar":
                names = [element.get("vnamePrev", ""), element.get("vnameCurr", "")]
                self.later[names[0]] = names[1]
            self.kinds[element.tag].append(names[0])
            listed, count = element.findtext("ValueEnum"), element.findtext("NumValues")
            letter = element.tag[0].lower()
            values = listed.split() if listed else [f"{letter}{i}" for i in range(int(count or 0))]
            self.values.update(dict.fromkeys(names, values))

    def functions(self, section: str) -> list[tuple[list[str], list[str], ElementTree.Element]]:
        """For each function: its variables, its parents, and its parameter."""
        found = []
        for element in self.root.find(section) or ():
            parents = (element.findtext("Parent") or "").split()
            found.append(((element.findtext("Var") or "").split(), [p for p in parents if p != "null"],
                          element.find("Parameter")))  # fmt: skip
        return found  # type: ignore[return-value]

    def cells(self, names: list[str], parameter: ElementTree.Element) -> dict[tuple[str, ...], Fraction]:
        """The value of every cell over the variables `names`."""
        everything = list(product(*(self.values[name] for name in names)))
        if parameter.get("type", "TBL") == "DD":
            templates = {t.get("id", ""): t[0] for t in parameter.findall("SubDAGTemplate")}
            top = parameter.find("DAG")
            assert top is not None
            return {cell: self.walk(top[0], dict(zip(names, cell, strict=True)), templates)
                    for cell in everything}  # fmt: skip
        cells = dict.fromkeys(everything, F(0))
        for entry in parameter:
            pattern = (entry.findtext("Instance") or "").split()
            words = (entry.findtext("ProbTable") or entry.findtext("ValueTable") or "").split()
            dashes = [i for i, word in enumerate(pattern) if word == "-"]
            for cell in everything:
                if all(word in ("*", "-", value) for word, value in zip(pattern, cell, strict=True)):
                    numbers = [self.values[names[i]].index(cell[i]) for i in dashes]
                    if words == ["identity"]:
                        cells[cell] = F(int(numbers[0] == numbers[1]))
                    elif words == ["uniform"]:
                        cells[cell] = F(1, len(self.values[names[-1]]))
                    else:
                        index = 0
                        for i, number in zip(dashes, numbers, strict=True):
                            index = index * len(self.values[names[i]]) + number
                        cells[cell] = F(words[index])
        return cells

    def walk(
        self, node: ElementTree.Element, x: Names, templates: Mapping[str, ElementTree.Element]
    ) -> Fraction:
        name = node.get("var", "")
        if node.tag == "Terminal":
            return F((node.text or "").strip())
        if node.tag == "Node":
            edges = {edge.get("val"): edge[0] for edge in node}
            return self.walk(edges[x[name]], x, templates) if x[name] in edges else F(0)
        match node.get("type"):
            case "deterministic":
                return F(int(x[name] == node.get("val")))
            case "uniform":
                return F(1, len(self.values[name]))
            case "persistent":
                earlier = next(now for now, later in self.later.items() if later == name)
                return F(int(x[name] == x[earlier]))
        return self.walk(templates[node.get("idref", "")], x, templates)


def agree(text: str, model: Model) -> None:
    """The model says what the document says, at every assignment."""
    dense = Dense(text)
    actions = {tuple(action.name.split(",")): action for action in model.actions}
    stems = dict(zip(dense.kinds["StateVar"], [feature.name for feature in model.features], strict=True))
    keys = {now: (stem, False) for now, stem in stems.items()}
    keys |= {dense.later[now]: (stem, True) for now, stem in stems.items()}
    keys |= {name: (name, False) for name in dense.kinds["ObsVar"]}
    assert list(actions) == list(product(*(dense.values[name] for name in dense.kinds["ActionVar"])))

    def effect(action: Action, name: str) -> Expression:
        return dict(action.effects).get(name, Reference(name))

    def compare(section: str, expression_of) -> None:  # type: ignore[no-untyped-def]
        for about, parents, parameter in dense.functions(section):
            names = [*parents, *about]
            cells = dense.cells(names, parameter)
            rest = [name for name in dense.kinds["ActionVar"] if name not in names]
            for given in product(*(dense.values[name] for name in parents)):
                own = list(product(*(dense.values[name] for name in about)))
                total = sum(cells[*given, *cell] for cell in own)
                for more in product(*(dense.values[name] for name in rest)):
                    known = dict(zip([*parents, *rest], [*given, *more], strict=True))
                    action = actions[tuple(known[name] for name in dense.kinds["ActionVar"])]
                    for cell in own:
                        known |= dict(zip(about, cell, strict=True))
                        x = {keys[name]: value for name, value in known.items() if name in keys}
                        probability = F(1)
                        for name in about:
                            row = distribution(expression_of(action, keys[name][0]), dense.values[name], x)
                            assert isinstance(row, tuple), row
                            probability *= row[dense.values[name].index(known[name])]
                        assert probability == cells[*given, *cell] / total

    compare("InitialStateBelief", lambda action, name: dict(model.initial.distributions)[name])
    compare("StateTransitionFunction", effect)
    compare("ObsFunction", lambda action, name: dict(action.senses)[name])
    agree_on_rewards(dense, model, actions, keys)


def agree_on_rewards(
    dense: Dense,
    model: Model,
    actions: Mapping[tuple[str, ...], Action],
    keys: Mapping[str, tuple[str, bool]],
) -> None:
    functions = [
        (parents, dense.cells(parents, parameter))
        for _, parents, parameter in dense.functions("RewardFunction")
    ]
    used = {name for parents, _ in functions for name in parents} | set(dense.kinds["ActionVar"])
    order = [name for name in dense.values if name in used]
    for values in product(*(dense.values[name] for name in order)):
        known = dict(zip(order, values, strict=True))
        action = actions[tuple(known[name] for name in dense.kinds["ActionVar"])]
        x = {keys[name]: value for name, value in known.items() if name in keys}
        found = F(0)
        for term in (*model.rewards, *action.rewards):
            value = evaluate(term, x)
            assert isinstance(value, Fraction)
            found += value
        assert found == sum(cells[tuple(known[p] for p in parents)] for parents, cells in functions)


# -- random documents ------------------------------------------------------------------------------


class Writer:
    """Writes a random small document, with every feature of the format somewhere."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        choose = self.random
        self.values: dict[str, list[str]] = {}
        self.states = [(f"x{i}_0", f"x{i}_1") for i in range(choose.randint(1, 3))]
        self.channels = [f"o{i}" for i in range(choose.randint(0, 2))]
        self.acting = [f"act{i}" for i in range(choose.choice((1, 1, 2)))]
        lines = []
        for now, later in self.states:
            flag = choose.choice(("", ' fullyObs="false"', ' fullyObs="true"'))
            lines.append(
                f'<StateVar vnamePrev="{now}" vnameCurr="{later}"{flag}>{self.declare(now)}</StateVar>'
            )
            self.values[later] = self.values[now]
        lines += [f'<ObsVar vname="{name}">{self.declare(name)}</ObsVar>' for name in self.channels]
        lines += [f'<ActionVar vname="{name}">{self.declare(name)}</ActionVar>' for name in self.acting]
        choose.shuffle(lines)
        rewards = [f"r{i}" for i in range(choose.randint(1, 2))]
        lines += [f'<RewardVar vname="{name}"/>' for name in rewards]
        now = [now for now, _ in self.states]
        self.sections = [
            ("Variable", lines),
            ("InitialStateBelief", list(self.beliefs(now))),
            ("StateTransitionFunction", list(self.transitions(now))),
            ("ObsFunction", [
                self.function([name], self.some([*self.acting, *now, *self.laters()]))
                for name in self.channels
            ]),
            ("RewardFunction", [
                self.reward(name, self.some([*self.acting, *now, *self.laters(), *self.channels]))
                for name in rewards
            ]),
        ]  # fmt: skip

    def laters(self) -> list[str]:
        return [later for _, later in self.states]

    def some(self, names: list[str]) -> list[str]:
        return self.random.sample(names, self.random.randint(0, min(3, len(names))))

    def declare(self, name: str) -> str:
        count = self.random.randint(1, 3)
        letter = {"x": "s", "o": "o", "a": "a"}[name[0]]
        self.values[name] = [f"{letter}{i}" for i in range(count)]
        if self.random.random() < 0.5:
            return f"<NumValues> {count} </NumValues>"
        self.values[name] = [f"{name}-{i}" for i in range(count)]
        return f"<ValueEnum>{' '.join(self.values[name])}</ValueEnum>"

    def beliefs(self, names: list[str]) -> Iterator[str]:
        names = self.random.sample(names, len(names))
        while names:
            count = min(len(names), self.random.choice((1, 1, 2)))
            about, names = names[:count], names[count:]
            yield self.function(about, self.some(names))

    def transitions(self, now: list[str]) -> Iterator[str]:
        names = self.random.sample(self.laters(), len(now))
        while names:
            count = min(len(names), self.random.choice((1, 1, 1, 2)))
            about, names = names[:count], names[count:]
            parents = self.some([*self.acting, *now, *names])
            earlier = about[0][:-1] + "0"
            if count == 1 and earlier not in parents and self.random.random() < 0.6:
                parents.append(earlier)
            yield self.function(about, parents)

    def row(self, size: int) -> list[str]:
        """Decimals that sum to 1, or to almost 1."""
        if size == 3 and self.random.random() < 0.1:
            return ["0.333333"] * 3
        cuts = sorted(self.random.choice((0, 0, 10, 25, 50, 100)) for _ in range(size - 1))
        shares = [b - a for a, b in zip([0, *cuts], [*cuts, 100], strict=True)]
        return [
            self.random.choice((f"{share / 100}", f"{share}e-2", f"+{share / 100}")) for share in shares
        ]

    def function(self, about: list[str], parents: list[str]) -> str:
        if self.random.random() < 0.4:
            return self.diagram(about, parents)
        names = [*parents, *about]
        sizes = [len(self.values[name]) for name in names]
        entries: list[tuple[list[str], list[str]]] = []
        for _ in range(self.random.randint(0, 4)):
            entries.append(self.entry(names, sizes, len(about)))
        kind = self.random.choice(("", ' type="TBL"', ' type = "TBL"'))
        while True:  # rows that the entries leave wrong are overridden
            text = self.condprob(
                "CondProb", about, parents, kind, [self.shown(e, "ProbTable") for e in entries]
            )
            wrong = self.wrong(text, names, len(about))
            if wrong is None:
                return text
            size = 1
            for name in about:
                size *= len(self.values[name])
            if len(about) > 1 or self.random.random() < 0.4:
                entries.append(([*wrong, *("-" for _ in about)], self.row(size)))
                continue
            cells = [([*wrong, v], [p]) for v, p in zip(self.values[about[0]], self.row(size), strict=True)]
            again = [self.random.choice(cells) for _ in range(self.random.randint(0, 2))]
            entries += [(pattern, ["0.125"]) for pattern, _ in again]
            entries += self.random.sample(cells, len(cells))

    def wrong(self, text: str, names: list[str], count: int) -> tuple[str, ...] | None:
        dense = Dense.__new__(Dense)
        dense.values = self.values
        parameter = ElementTree.fromstring(text).find("Parameter")
        assert parameter is not None
        cells = dense.cells(names, parameter)
        parents, about = names[:-count], names[-count:]
        for given in product(*(self.values[name] for name in parents)):
            total = sum(cells[*given, *own] for own in product(*(self.values[name] for name in about)))
            if abs(total - 1) >= F(1, 10_000):
                return given
        return None

    def entry(self, names: list[str], sizes: list[int], about: int) -> tuple[list[str], list[str]]:
        choose = self.random
        pattern = [choose.choice(("*", "-", "*", choose.choice(self.values[name]))) for name in names]
        if about == 1 and choose.random() < 0.3:
            equal = [i for i in range(len(names) - 1) if sizes[i] == sizes[-1]]
            if equal and choose.random() < 0.7:
                pattern = [word.replace("-", "*") if len(word) == 1 else word for word in pattern]
                pattern[choose.choice(equal)] = pattern[-1] = "-"
                return pattern, ["identity"]
            pattern[-1] = choose.choice("-*")
            return pattern, ["uniform"]
        count, own = 1, 1
        for i, word in enumerate(pattern):
            if word == "-":
                count, own = count * sizes[i], (own * sizes[i] if i >= len(names) - about else own)
        return pattern, [word for _ in range(count // own) for word in self.row(own)]

    @staticmethod
    def shown(entry: tuple[list[str], list[str]], title: str) -> str:
        pattern, numbers = " ".join(entry[0]), "\n ".join(entry[1])
        return f"<Entry><Instance> {pattern}\n</Instance><{title}>{numbers}</{title}></Entry>"

    @staticmethod
    def condprob(tag: str, about: list[str], parents: list[str], kind: str, body: list[str]) -> str:
        listed = " ".join(parents) or "null"
        return (
            f"<{tag}><Var>{' '.join(about)}</Var><Parent> {listed} </Parent><Parameter{kind}>\n"
            + "\n".join(body)
            + f"</Parameter></{tag}>"
        )

    def diagram(self, about: list[str], parents: list[str]) -> str:
        templates: list[str] = []
        tree = self.tree(about, parents, templates, 3)
        body = [f"<DAG>{tree}</DAG>"]
        body += [f'<SubDAGTemplate id="t{i}">{text}</SubDAGTemplate>' for i, text in enumerate(templates)]
        self.random.shuffle(body)
        return self.condprob("CondProb", about, parents, ' type="DD"', body)

    def tree(self, about: list[str], parents: list[str], templates: list[str], depth: int) -> str:
        choose = self.random
        if templates and choose.random() < 0.2:
            return f'<SubDAG type="template" idref="t{choose.randrange(len(templates))}"/>'
        if parents and depth and choose.random() < 0.7:
            name = choose.choice(parents)
            edges = [
                f'<Edge val="{value}">{self.tree(about, parents, templates, depth - 1)}</Edge>'
                for value in self.values[name]
            ]
            text = f'<Node var="{name}">{"".join(edges)}</Node>'
        else:
            text = self.leaf(about, parents)
        if choose.random() < 0.2:
            templates.append(text)
            return f'<SubDAG type="template" idref="t{len(templates) - 1}"/>'
        return text

    def leaf(self, about: list[str], parents: list[str]) -> str:
        """A diagram over `about` that sums to 1."""
        choose = self.random
        name, rest = about[0], about[1:]
        values = self.values[name]
        if not rest:
            kind = choose.choice(("deterministic", "uniform", "persistent", "row", "row"))
            earlier = name[:-1] + "0"
            if kind == "deterministic":
                return f'<SubDAG type="deterministic" var="{name}" val="{choose.choice(values)}"/>'
            if kind == "uniform" or (kind == "persistent" and earlier not in parents):
                return f'<SubDAG type="uniform" var="{name}"/>'
            if kind == "persistent" and name.endswith("_1"):
                return f'<SubDAG type="persistent" var="{name}"/>'
        if not rest:
            edges = [
                f'<Edge val="{value}"><Terminal> {number} </Terminal></Edge>'
                for value, number in zip(values, self.row(len(values)), strict=True)
                if F(number)
            ]
            return f'<Node var="{name}">{"".join(edges)}</Node>'
        chosen = choose.choice(values)
        other = choose.choice(values)
        if chosen == other:
            return f'<Node var="{name}"><Edge val="{chosen}">{self.leaf(rest, parents)}</Edge></Node>'
        size = len(self.values[rest[0]])
        flat = [
            f'<Edge val="{value}"><Terminal>{number}</Terminal></Edge>'
            for value, number in zip(self.values[rest[0]], ["0.5", *["0"] * (size - 1)], strict=True)
        ]
        below = f'<Node var="{rest[0]}">{"".join(flat)}</Node>'
        return "".join(
            [
                f'<Node var="{name}">',
                *(f'<Edge val="{v}">{below}</Edge>' for v in (chosen, other)),
                "</Node>",
            ]
        )

    def reward(self, name: str, parents: list[str]) -> str:
        choose = self.random
        if choose.random() < 0.4:
            body = f"<DAG>{self.values_tree(parents)}</DAG>"
            return self.condprob("Func", [name], parents, ' type="DD"', [body])
        entries = []
        for _ in range(choose.randint(0, 5)):
            pattern = [choose.choice(("*", "-", choose.choice(self.values[p]))) for p in parents]
            count = 1
            for word, parent in zip(pattern, parents, strict=True):
                count *= len(self.values[parent]) if word == "-" else 1
            entries.append((pattern, [str(choose.randint(-20, 20) / 4) for _ in range(count)]))
        return self.condprob("Func", [name], parents, "", [self.shown(e, "ValueTable") for e in entries])

    def values_tree(self, parents: list[str]) -> str:
        choose = self.random
        if not parents or choose.random() < 0.2:
            return f"<Terminal>{choose.randint(-9, 9)}</Terminal>"
        name = parents[0]
        if choose.random() < 0.15:
            return f'<SubDAG type="deterministic" var="{name}" val="{choose.choice(self.values[name])}"/>'
        edges = [f'<Edge val="{v}">{self.values_tree(parents[1:])}</Edge>' for v in self.values[name]]
        return (
            f'<Node var="{name}">{"".join(edges[choose.randint(0, 1) if len(edges) > 1 else 0 :])}</Node>'
        )

    def text(self) -> str:
        sections = [f"<{title}>\n{chr(10).join(body)}\n</{title}>" for title, body in self.sections if body]
        self.random.shuffle(sections)
        head = "<?xml version='1.0' encoding='ISO-8859-1'?>\n<pomdpx version='1.0' id='random'>\n"
        return f"{head}<Discount> 0.9 </Discount>{chr(10).join(sections)}</pomdpx>"


@pytest.mark.parametrize("block", range(8))
def test_random_documents_denote_what_a_dense_reading_says(block: int) -> None:
    for seed in range(25 * block, 25 * block + 25):
        text = Writer(seed).text()
        model, warnings = read_pomdpx_with_warnings(text, "random")
        errors = [fault for fault in check(model) if fault.severity == "error"]
        assert not errors, (seed, errors)
        assert len(warnings) <= 1
        assert bool(warnings) <= ("0.333333" in text)
        agree(text, model)


# -- what documents denote -------------------------------------------------------------------------

TIGER = """<?xml version="1.0" encoding="ISO-8859-1"?>
<pomdpx version="1.0" id="tiger" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance"
        xsi:noNamespaceSchemaLocation="pomdpx.xsd">
<Description>two doors,
  one tiger</Description>
<Discount>0.95</Discount>
<Variable>
<StateVar vnamePrev="tiger_0" vnameCurr="tiger_1"><ValueEnum>left right</ValueEnum></StateVar>
<ObsVar vname="heard"><ValueEnum>left right</ValueEnum></ObsVar>
<ActionVar vname="act"><ValueEnum>listen open-left open-right</ValueEnum></ActionVar>
<RewardVar vname="reward"/>
</Variable>
<InitialStateBelief>
<CondProb><Var>tiger_0</Var><Parent>null</Parent>
<Parameter><Entry><Instance>-</Instance><ProbTable>uniform</ProbTable></Entry></Parameter></CondProb>
</InitialStateBelief>
<StateTransitionFunction>
<CondProb><Var>tiger_1</Var><Parent>act tiger_0</Parent>
<Parameter type="TBL">
<Entry><Instance>* * -</Instance><ProbTable>uniform</ProbTable></Entry>
<Entry><Instance>listen - -</Instance><ProbTable>identity</ProbTable></Entry>
</Parameter></CondProb>
</StateTransitionFunction>
<ObsFunction>
<CondProb><Var>heard</Var><Parent>act tiger_1</Parent>
<Parameter>
<Entry><Instance>* * *</Instance><ProbTable>0.5</ProbTable></Entry>
<Entry><Instance>listen - -</Instance><ProbTable>0.85 0.15
  0.15 0.85</ProbTable></Entry>
</Parameter></CondProb>
</ObsFunction>
<RewardFunction>
<Func><Var>reward</Var><Parent>act tiger_0</Parent>
<Parameter>
<Entry><Instance>listen *</Instance><ValueTable>-1</ValueTable></Entry>
<Entry><Instance>open-left -</Instance><ValueTable>-100 10</ValueTable></Entry>
<Entry><Instance>open-right -</Instance><ValueTable>10 -100</ValueTable></Entry>
</Parameter></Func>
</RewardFunction>
</pomdpx>
"""


def test_the_tiger_is_the_tiger() -> None:
    model, warnings = read_pomdpx_with_warnings(TIGER, "tiger")
    assert warnings == ()
    assert check(model) == []
    assert model.name == "tiger"
    assert model.description == "two doors, one tiger"
    assert model.discount == F(19, 20)
    assert model.observability == "partial"
    assert [(f.name, f.values, f.observed) for f in model.features] == [("tiger", ("left", "right"), False)]
    assert [(o.name, o.values) for o in model.observations] == [("heard", ("left", "right"))]
    assert [action.name for action in model.actions] == ["listen", "open-left", "open-right"]
    assert [action.effects for action in model.actions[:1]] == [()]  # the tiger stays
    left = {("tiger", False): "left", ("tiger", True): "left"}
    assert distribution(model.actions[1].effects[0][1], ("left", "right"), left) == (F(1, 2), F(1, 2))
    assert distribution(model.actions[0].senses[0][1], ("left", "right"), left) == (F(17, 20), F(3, 20))
    assert [evaluate(a.rewards[0], left) for a in model.actions] == [F(-1), F(-100), F(10)]
    agree(TIGER, model)


def changed(*pairs: tuple[str, str]) -> str:
    text = TIGER
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


def test_all_observed_without_observations_is_an_mdp() -> None:
    start, end = TIGER.index("<ObsFunction>"), TIGER.index("<RewardFunction>")
    text = TIGER[:start] + TIGER[end:]
    text = text.replace(' vnameCurr="tiger_1">', ' vnameCurr="tiger_1" fullyObs="true">')
    text = text.replace('<ObsVar vname="heard"><ValueEnum>left right</ValueEnum></ObsVar>', "")
    model = read_pomdpx(text, "seen")
    assert model.observability == "full"
    assert not model.features[0].observed
    assert check(model) == []
    start, end = text.index("<InitialStateBelief>"), text.index("<StateTransitionFunction>")
    model, warnings = read_pomdpx_with_warnings(text[:start] + text[end:], "seen")
    assert model.initial.distributions == ()
    assert ["equally likely" in str(warning) for warning in warnings] == [True]


def test_an_observed_variable_beside_observations_is_flagged() -> None:
    model = read_pomdpx(changed(('vnameCurr="tiger_1"', 'vnameCurr="tiger_1" fullyObs=" 1 "')), "mixed")
    assert model.observability == "partial"
    assert model.features[0].observed


def test_a_hidden_state_without_observations_is_blind() -> None:
    start, end = TIGER.index("<ObsFunction>"), TIGER.index("<RewardFunction>")
    text = TIGER[:start] + TIGER[end:]
    text = text.replace('<ObsVar vname="heard"><ValueEnum>left right</ValueEnum></ObsVar>', "")
    model = read_pomdpx(text, "blind")
    assert (model.observability, model.observations) == ("partial", ())


def test_encodings_line_ends_and_comments_make_no_difference() -> None:
    plain = read_pomdpx(TIGER, "tiger")
    for text in (
        TIGER.replace("ISO-8859-1", "UTF-16"),
        TIGER.replace('<?xml version="1.0" encoding="ISO-8859-1"?>\n', ""),
        "\ufeff" + TIGER,
        TIGER.replace("\n", "\r\n"),
        TIGER.replace("0.85 0.15", "0.8<!-- 0.7 -->5 <![CDATA[0.15]]>"),
        TIGER.replace("<Var>heard", "<!-- &lt; --><Var>&#104;eard"),
    ):
        assert read_pomdpx(text, "tiger") == plain
    accented = read_pomdpx(TIGER.replace("left", "à-gauche"), "tiger")
    assert accented.features[0].values[0] == "à-gauche"


def test_a_horizon_is_kept() -> None:
    model = read_pomdpx(changed(("</Discount>", "</Discount><Horizon> 12 </Horizon>")), "tiger")
    assert model.horizon == 12


def test_a_feature_keeps_its_suffix_where_the_stem_is_taken() -> None:
    model = read_pomdpx(
        TIGER.replace('vname="heard"', 'vname="tiger"').replace("<Var>heard", "<Var>tiger"), "t"
    )
    assert [f.name for f in model.features] == ["tiger_0"]
    assert [o.name for o in model.observations] == ["tiger"]
    agree(TIGER.replace('vname="heard"', 'vname="tiger"').replace("<Var>heard", "<Var>tiger"), model)


def test_values_given_by_a_count_may_be_written_as_numbers() -> None:
    text = changed(
        ("<ValueEnum>listen open-left open-right</ValueEnum>", "<NumValues>3</NumValues>"),
        ("<Instance>listen - -</Instance><ProbTable>i", "<Instance>0 - -</Instance><ProbTable>i"),
        ("<Instance>listen - -</Instance>", "<Instance>a0 - -</Instance>"),
        ("listen *", "0 *"),
        ("open-left -", "a1 -"),
        ("open-right -", "2 -"),
    )
    model = read_pomdpx(text, "counted")
    assert [action.name for action in model.actions] == ["a0", "a1", "a2"]
    assert model.actions[0].effects == ()


def test_identities_stay_persistences_and_copies_stay_copies() -> None:
    text = two_flags(
        "y_0 x_0 x_1",
        "<Entry><Instance>* - -</Instance><ProbTable>identity</ProbTable></Entry>",
        "<Entry><Instance>- *</Instance><ProbTable>1</ProbTable></Entry>",
    )
    model = read_pomdpx(
        text.replace(
            "<Instance>- *</Instance><ProbTable>1<", "<Instance>- -</Instance><ProbTable>identity<"
        ),
        "flags",
    )
    assert [dict(action.effects) for action in model.actions] == [
        {"y": Reference("x")},
        {"y": Reference("x")},
    ]


def two_flags(x_names: str, x_entries: str, y_entries: str) -> str:
    """Two binary features, two actions; y's only parent is x before the step."""
    *parents, about = x_names.split()
    return f"""<pomdpx><Discount>0.5</Discount><Variable>
<StateVar vnamePrev="x_0" vnameCurr="x_1" fullyObs="true"><ValueEnum>off on</ValueEnum></StateVar>
<StateVar vnamePrev="y_0" vnameCurr="y_1" fullyObs="true"><ValueEnum>off on</ValueEnum></StateVar>
<ActionVar vname="a"><NumValues>2</NumValues></ActionVar><RewardVar vname="r"/></Variable>
<StateTransitionFunction>
<CondProb><Var>{about}</Var><Parent>{" ".join(parents) or "null"}</Parent>
<Parameter>{x_entries}</Parameter></CondProb>
<CondProb><Var>y_1</Var><Parent>x_0</Parent><Parameter>{y_entries}</Parameter></CondProb>
</StateTransitionFunction>
<RewardFunction><Func><Var>r</Var><Parent>null</Parent>
<Parameter type="DD"><DAG><Terminal>2</Terminal></DAG></Parameter></Func></RewardFunction></pomdpx>"""


UNIFORM = "<Entry><Instance>* *</Instance><ProbTable>0.5</ProbTable></Entry>"


def test_rewards_without_an_action_belong_to_the_model() -> None:
    entries = "<Entry><Instance>-</Instance><ProbTable>0.5 0.5</ProbTable></Entry>"
    model = read_pomdpx(two_flags("x_1", entries, UNIFORM), "flags")
    assert [evaluate(term, {}) for term in model.rewards] == [F(2)]
    assert [action.rewards for action in model.actions] == [(), ()]


def test_a_decision_is_made_only_where_entries_ask_for_it() -> None:
    entries = (
        "<Entry><Instance>* * -</Instance><ProbTable>1 0</ProbTable></Entry>"
        "<Entry><Instance>a1 on -</Instance><ProbTable>0.25 0.75</ProbTable></Entry>"
    )
    model = read_pomdpx(two_flags("a x_0 x_1", entries, UNIFORM), "flags")
    first, second = (dict(action.effects)["x"] for action in model.actions)
    assert evaluate(first, {}) == "off"  # no decision at all
    assert isinstance(second, Switch)
    assert second.reference == Reference("x")
    assert evaluate(second, {("x", False): "on"}) == Distribution((("off", F(1, 4)), ("on", F(3, 4))))


def test_what_was_decided_on_the_way_belongs_to_a_node() -> None:
    """The same entries agree with x_0 = on, y_0 = off and with y_0 = on, where x_0 is still open."""
    cells = [("* * off", "0.2"), ("* * on", "0.8"), ("* on off", "0.7"), ("* on on", "0.3")]
    entries = [entry(pattern.split(), number) for pattern, number in cells]
    entries.append(entry(["off", "off", "-"], "0.5 0.5"))
    text = two_flags("y_0 x_0 x_1", "".join(entries), UNIFORM)
    agree(text, read_pomdpx(text, "flags"))


def test_rounded_rows_give_one_warning_with_their_number_and_the_largest_miss() -> None:
    entries = (
        "<Entry><Instance>off -</Instance><ProbTable>0.33333 0.66666</ProbTable></Entry>\n"
        "<Entry><Instance>on -</Instance><ProbTable>0.50005 0.5</ProbTable></Entry>"
    )
    text = two_flags("x_0 x_1", entries, UNIFORM)
    model, warnings = read_pomdpx_with_warnings(text, "flags")
    rounded = [warning for warning in warnings if "miss" in warning.message]
    assert len(rounded) == 1
    assert rounded[0].severity == "warning"
    assert "2 rows miss" in rounded[0].message
    assert "5e-05" in rounded[0].message
    assert "x_0 = on" in rounded[0].message
    assert rounded[0].line == 1 + text[: text.index("0.50005")].count("\n")
    row = distribution(dict(model.actions[0].effects)["x"], ("off", "on"), {("x", False): "on"})
    assert row == (F(50005, 100005), F(50000, 100005))
    entries = entries.replace("0.50005", "0.5001")
    with pytest.raises(ModelError, match=r"'x_1' where x_0 = on sum to 1\.0001"):
        read_pomdpx(two_flags("x_0 x_1", entries, UNIFORM), "flags")


# -- many parents ----------------------------------------------------------------------------------


def many(count: int, parent_entries: str, type_: str = "TBL", persist: bool = True) -> str:
    """`count` binary features that persist, and one more that depends on all of them."""
    names = [f"b{i}" for i in range(count)]
    declared = "".join(
        f'<StateVar vnamePrev="{n}_0" vnameCurr="{n}_1" fullyObs="true"><NumValues>2</NumValues></StateVar>'
        for n in [*names, "sum"]
    )
    kept = "".join(
        f"<CondProb><Var>{n}_1</Var><Parent>{n}_0</Parent><Parameter><Entry><Instance>- -</Instance>"
        f"<ProbTable>identity</ProbTable></Entry></Parameter></CondProb>"
        for n in names
    )
    return f"""<pomdpx><Discount>0.5</Discount><Variable>{declared}
<ActionVar vname="a"><NumValues>1</NumValues></ActionVar><RewardVar vname="r"/></Variable>
<StateTransitionFunction>{kept}
<CondProb><Var>sum_1</Var><Parent>{" ".join(f"{n}_0" for n in names)}</Parent>
<Parameter type="{type_}">{parent_entries}</Parameter></CondProb></StateTransitionFunction>
<RewardFunction><Func><Var>r</Var><Parent>a</Parent><Parameter/></Func></RewardFunction></pomdpx>"""


def entry(pattern: list[str], numbers: str) -> str:
    return f"<Entry><Instance>{' '.join(pattern)}</Instance><ProbTable>{numbers}</ProbTable></Entry>"


def nodes(expression: Expression) -> int:
    return len(parts_first(expression))


def test_a_table_over_45_parents_is_as_large_as_its_entries() -> None:
    entries = [entry(["*"] * 45 + ["-"], "1 0")]
    for i in range(45):  # the last parent that is s1 decides
        pattern = ["*"] * 46
        pattern[i], pattern[45] = "s1", "-"
        entries.append(entry(pattern, f"0.{i + 10} 0.{90 - i}"))
    model = read_pomdpx(many(45, "".join(entries)), "many")
    (effect,) = (expression for name, expression in model.actions[0].effects if name == "sum")
    assert len(model.actions[0].effects) == 1  # all others persist
    assert nodes(effect) < 500
    choose = random.Random(1)
    for _ in range(50):
        bits = [choose.choice((0, 0, 0, 1)) for _ in range(45)]
        x = {(f"b{i}", False): f"s{bit}" for i, bit in enumerate(bits)}
        last = max((i for i, bit in enumerate(bits) if bit), default=None)
        expected = (F(1), F(0)) if last is None else (F(last + 10, 100), F(90 - last, 100))
        assert distribution(effect, ("s0", "s1"), x) == expected


def test_pairs_far_apart_in_the_order_of_parents_stay_small() -> None:
    entries = [entry(["*"] * 44 + ["-"], "1 0")]
    for i in range(22):  # in the order of the parents this tree would have 2^22 nodes
        pattern = ["*"] * 45
        pattern[i] = pattern[i + 22] = "s1"
        entries.append(entry([*pattern[:44], "-"], "0 1"))
    model = read_pomdpx(many(44, "".join(entries)), "pairs")
    assert nodes(dict(model.actions[0].effects)["sum"]) < 200


def test_a_parity_over_45_parents_is_read_from_templates() -> None:
    templates = []
    for i in range(45):
        for odd in (0, 1):
            below = [f"p{i + 1}{odd}", f"p{i + 1}{1 - odd}"]
            edges = "".join(
                f'<Edge val="s{v}"><SubDAG type="template" idref="{below[v]}"/></Edge>' for v in (0, 1)
            )
            templates.append(
                f'<SubDAGTemplate id="p{i}{odd}"><Node var="b{i}_0">{edges}</Node></SubDAGTemplate>'
            )
    for odd in (0, 1):
        leaf = f'<SubDAG type="deterministic" var="sum_1" val="s{odd}"/>'
        templates.append(f'<SubDAGTemplate id="p45{odd}">{leaf}</SubDAGTemplate>')
    start = '<DAG><SubDAG type="template" idref="p00"/></DAG>'
    model = read_pomdpx(many(45, start + "".join(templates), "DD"), "parity")
    effect = dict(model.actions[0].effects)["sum"]
    choose = random.Random(2)
    for _ in range(50):
        bits = [choose.randint(0, 1) for _ in range(45)]
        x = {(f"b{i}", False): f"s{bit}" for i, bit in enumerate(bits)}
        assert evaluate(effect, x) == f"s{sum(bits) % 2}"


def test_a_wide_identity_is_one_reference() -> None:
    text = two_flags(
        "x_0 x_1", "<Entry><Instance>- -</Instance><ProbTable>identity</ProbTable></Entry>", UNIFORM
    )
    for kind in ("TBL", "DD"):
        wide = text.replace("<ValueEnum>off on</ValueEnum>", "<NumValues>20000</NumValues>", 1)
        wide = wide.replace("<Entry><Instance>* *</Instance><ProbTable>0.5</ProbTable></Entry>", UNIFORM)
        if kind == "DD":
            wide = wide.replace(
                "<Parameter><Entry><Instance>- -</Instance><ProbTable>identity</ProbTable></Entry>",
                '<Parameter type="DD"><DAG><SubDAG type="persistent" var="x_1"/></DAG>',
            )
        assert "x" not in dict(read_pomdpx(wide, "wide").actions[0].effects)


def test_work_without_end_is_refused_by_a_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spudd_trees, "MAXIMUM_STEPS", 200_000)  # the same refusal, sooner
    choose = random.Random(3)
    entries = [entry(["*"] * 45 + ["-"], "1 0")]
    for i in range(400):
        pattern = ["*"] * 45 + ["-"]
        for j in choose.sample(range(45), 4):
            pattern[j] = choose.choice(("s0", "s1"))
        entries.append(entry(pattern, f"0.{i + 100} 0.{900 - i}"))
    with pytest.raises(ModelError, match="too much work") as caught:
        read_pomdpx(many(45, "".join(entries)), "hard")
    assert caught.value.faults[0].line > 1


# -- what is refused -------------------------------------------------------------------------------

OVERRIDE = "<Entry><Instance>open-left left right</Instance><ProbTable>0</ProbTable></Entry>"

BAD = [
    ("0.95</Discount>", "0.95</Discount", "no well-formed XML"),
    ("</pomdpx>", "", "no well-formed XML"),
    ("</pomdpx>", "</pomdpx><pomdpx/>", "no well-formed XML"),
    ("two doors", "&nbsp;", "undefined entity"),
    ("<Discount>0.95</Discount>", "", "there is no <Discount>"),
    ("0.95</Discount>", "0.95</Discount><Discount>1</Discount>", "a second <Discount>"),
    ("0.95</Discount>", "1.5</Discount>", "not between 0 and 1"),
    ("0.95</Discount>", "1/2</Discount>", "is no number"),
    ("0.95</Discount>", "NaN</Discount>", "is no number"),
    ("0.95</Discount>", "1e30000000</Discount>", "exponent"),
    ("0.95</Discount>", "0.9 5</Discount>", "holds one number"),
    ("0.95</Discount>", f"0.{'1' * 20_000}</Discount>", "digits"),
    ("</Discount>", "</Discount><Horizon>0.5</Horizon>", "whole number of steps"),
    ("<Discount>", "<Colour/><Discount>", "<Colour> inside <pomdpx>"),
    ("<Discount>", "stray<Discount>", "the text 'stray'"),
    ("<Discount>", '<Discount unit="s">', "no attribute 'unit'"),
    ("</Variable>", '<Thing vname="t"/></Variable>', "no kind of variable"),
    ("</Variable>", '<RewardVar vname="heard"/></Variable>', "'heard' is declared twice"),
    ("</Variable>", '<RewardVar vname="more"/></Variable>', "no function of 'more'"),
    ("</Variable>", '<RewardVar vname="null"/></Variable>', "called 'null'"),
    ("</Variable>", '<RewardVar vname="a b"/></Variable>', "has a space"),
    ("</Variable>", '<RewardVar vname=""/></Variable>', "an empty name"),
    ("</Variable>", '<ActionVar vname="x"><NumValues>9999</NumValues></ActionVar></Variable>', "joint"),
    ('<RewardVar vname="reward"/>', "", "there is no RewardVar"),
    ('vname="reward"/>', 'vname="reward"><NumValues>2</NumValues></RewardVar>', "has no values"),
    ('vnamePrev="tiger_0"', "", "lacks the attribute vnamePrev"),
    ('vnamePrev="tiger_0"', 'vnamePrev="tiger_0" fullyobs="true"', "no attribute 'fullyobs'"),
    ('vnamePrev="tiger_0"', 'vnamePrev="tiger_0" fullyObs="yes"', "fullyObs is 'yes'"),
    ('vnamePrev="tiger_0"', 'vnamePrev="tiger_1"', "'tiger_1' is declared twice"),
    ("<ValueEnum>left right</ValueEnum>", "<ValueEnum>left left</ValueEnum>", "'left' twice"),
    ("<ValueEnum>left right</ValueEnum>", "<ValueEnum>left *</ValueEnum>", "'*' can't be a value"),
    ("<ValueEnum>left right</ValueEnum>", "<ValueEnum> </ValueEnum>", "has no values"),
    ("<ValueEnum>left right</ValueEnum>", "", "has no values"),
    ("<ValueEnum>left right</ValueEnum>", "<NumValues>0</NumValues>", "NumValues is '0'"),
    ("<ValueEnum>left right</ValueEnum>", "<NumValues>1e9</NumValues>", "NumValues is '1e9'"),
    ("<ValueEnum>left right</ValueEnum>", f"<NumValues>{'9' * 5000}</NumValues>", "more than 100000"),
    ("<Var>tiger_0</Var>", "<Var>tiger_1</Var>", "'tiger_1' can't stand here"),
    ("<Var>tiger_0</Var>", "<Var>lion_0</Var>", "'lion_0' is no variable"),
    ("<Var>tiger_0</Var>", "<Var></Var>", "<Var> is empty"),
    ("<Var>tiger_0</Var>", "", "has one <Var>"),
    ("<Var>tiger_0</Var>", "<Var>tiger_0</Var><Var>tiger_0</Var>", "has one <Var>"),
    ("<Parent>null</Parent>", "<Parent>tiger_0</Parent>", "can't depend on itself"),
    ("<Parent>null</Parent>", "<Parent>null null</Parent>", "can't stand beside others"),
    ("<Parent>act tiger_0</Parent>", "<Parent>act act</Parent>", "listed twice"),
    ("<Parent>act tiger_0</Parent>", "<Parent>act heard</Parent>", "'heard' can't stand here"),
    ('<Parameter type="TBL">', '<Parameter type="CONT">', "type of <Parameter> is 'CONT'"),
    ('<Parameter type="TBL">', '<Parameter type="DD">', "<Entry> inside <Parameter>"),
    ("<ProbTable>uniform</ProbTable>", "<ProbTable>0.5</ProbTable>", "1 numbers; 2 are needed"),
    ("<ProbTable>uniform</ProbTable>", "<ProbTable>0.5 -0.5</ProbTable>", "'-0.5' is negative"),
    ("<ProbTable>uniform</ProbTable>", "<ProbTable>0.5 0.6</ProbTable>", "sum to 1.1"),
    ("<ProbTable>uniform</ProbTable>", "<ProbTable>0 0</ProbTable>", "'tiger_0' are 0"),
    ("<ProbTable>uniform</ProbTable>", "<ProbTable>0.5 1e99999999</ProbTable>", "exponent"),
    ("<ProbTable>uniform</ProbTable>", "<ProbTable>0.5 0_5</ProbTable>", "is no number"),
    ("<ProbTable>uniform</ProbTable>", "<ProbTable>0.5 uniform</ProbTable>", "'uniform' is no number"),
    ("<ProbTable>uniform</ProbTable>", "<ValueTable>0.5 0.5</ValueTable>", "<ValueTable> inside <Entry>"),
    ("<ProbTable>uniform</ProbTable>", "", "one <Instance> and one table"),
    ("<ProbTable>uniform</ProbTable>", "<ProbTable>identity</ProbTable>", "'identity' needs"),
    ("<Instance>-</Instance>", "<Instance>left</Instance>", "'uniform' for one value"),
    ("<Instance>-</Instance>", "<Instance>null -</Instance>", "2 values for 1 variables"),
    ("<Instance>listen - -</Instance>", "<Instance>listen * -</Instance>", "'identity' needs"),
    ("<Instance>listen - -</Instance>", "<Instance>- - -</Instance>", "'identity' needs"),
    ("<Instance>listen - -</Instance>", "<Instance>sleep - -</Instance>", "'sleep' is no value of 'act'"),
    ("<ProbTable>identity</ProbTable></Entry>", "<ProbTable>identity</ProbTable></Entry>" + OVERRIDE,
     "'tiger_1' where act = open-left, tiger_0 = left sum to 0.5"),
    ("<ValueTable>-1</ValueTable>", "<ValueTable>uniform</ValueTable>", "rewards are numbers"),
    ("<ValueTable>-1</ValueTable>", "<ValueTable>-1 -1</ValueTable>", "2 numbers; 1 are needed"),
    ("</ObsFunction>", "<CondProb/></ObsFunction>", "has one <Var>"),
    ("</StateTransitionFunction>", "</StateTransitionFunction><StateTransitionFunction/>", "a second"),
    ("TransitionFunction>\n<CondProb>", "TransitionFunction>\n<Func/><CondProb>", "<Func> inside"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), BAD)
def test_bad_documents_are_refused_with_line_and_column(old: str, new: str, message: str) -> None:
    with pytest.raises(ModelError) as caught:
        read_pomdpx(changed((old, new)), "bad")
    assert message in str(caught.value)
    assert len(str(caught.value)) < 2_000
    for fault in caught.value.faults:
        assert 1 <= fault.line <= TIGER.count("\n") + 2
        assert fault.column >= 1


USE = '<SubDAG type="template" idref="{}"/>'


def template(name: str, body: str) -> str:
    return f'<SubDAGTemplate id="{name}">{body}</SubDAGTemplate>'


DIAGRAM = (
    '<Parameter type="DD"><DAG><Node var="a"><Edge val="a0"><SubDAG type="persistent" var="x_1"/></Edge>'
    '<Edge val="a1"><SubDAG type="template" idref="t"/></Edge></Node></DAG>'
    '<SubDAGTemplate id="t"><SubDAG type="uniform" var="x_1"/></SubDAGTemplate>'
)


def with_diagram(*pairs: tuple[str, str]) -> str:
    text = two_flags("a x_0 x_1", "HERE", UNIFORM).replace("<Parameter>HERE", DIAGRAM)
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


BAD_DIAGRAMS = [
    ('idref="t"', 'idref="u"', "there is no template 'u'"),
    ('id="t"', "", "lacks the attribute id"),
    ('type="uniform" var="x_1"', 'type="template" idref="t"', "circle: 't' -> 't'"),
    ('<SubDAG type="uniform" var="x_1"/></SubDAGTemplate>', "</SubDAGTemplate>", "holds nothing"),
    ("</SubDAGTemplate>", f"</SubDAGTemplate>{template('t', '<Terminal>1</Terminal>')}", "two templates"),
    ("</SubDAGTemplate>", "</SubDAGTemplate><DAG><Terminal>1</Terminal></DAG>", "2 diagrams"),
    ('type="uniform"', 'type="unifrom"', "is 'unifrom'"),
    ('type="uniform" var="x_1"', 'type="uniform" var="x_0"', "says nothing of 'x_0'"),
    ('type="uniform" var="x_1"', 'type="uniform" var="y_1"', "'y_1' is not among the variables"),
    ('type="uniform" var="x_1"', 'type="deterministic" var="x_1"', "lacks the attribute val"),
    ('type="uniform" var="x_1"', 'type="deterministic" var="x_1" val="up"', "'up' is no value of 'x_1'"),
    ('type="uniform" var="x_1"', 'type="uniform" var="x_1" val="on"', "no attribute 'val'"),
    ('<SubDAG type="uniform" var="x_1"/>', "<Terminal>0.3</Terminal>", "'x_1' where a = a1 sum to 0.6"),
    ('<SubDAG type="uniform" var="x_1"/>', "<Terminal>-0.5</Terminal>", "negative"),
    ('<SubDAG type="uniform" var="x_1"/>', "<Terminal>1 2</Terminal>", "holds one number"),
    ('<SubDAG type="uniform" var="x_1"/>', '<Node var="x_1"/>', "has no <Edge>"),
    ('<SubDAG type="uniform" var="x_1"/>', '<Node var="x_1"><Edge val="on"/></Node>', "holds nothing"),
    ('<SubDAG type="uniform" var="x_1"/>', "<Edge/>", "<Edge> inside <SubDAGTemplate>"),
    ('<Edge val="a1">', '<Edge val="a0">', "a second edge for 'a0'"),
    ('<Edge val="a1">', '<Edge val="a7">', "'a7' is no value of 'a'"),
    ("<Parent>a x_0</Parent>", "<Parent>a y_0</Parent>", "'persistent' of 'x_1' without 'x_0'"),
    ('<Edge val="a1"><SubDAG type="template" idref="t"/></Edge>', "", "'x_1' where a = a1 are 0"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), BAD_DIAGRAMS)
def test_bad_diagrams_are_refused_with_line_and_column(old: str, new: str, message: str) -> None:
    read_pomdpx(with_diagram(), "good")
    with pytest.raises(ModelError) as caught:
        read_pomdpx(with_diagram((old, new)), "bad")
    assert message in str(caught.value)
    assert all(fault.line >= 1 and fault.column >= 1 for fault in caught.value.faults)


def test_a_variable_asked_twice_on_one_path_keeps_its_value() -> None:
    inner = (
        '<Node var="{0}"><Edge val="{1}"><Terminal>{2}</Terminal></Edge><Edge val="{3}">{4}</Edge></Node>'
    )
    zero = "<Terminal>0</Terminal>"
    child = inner.format("x_1", "on", "0.25", "off", inner.format("x_1", "off", "0.75", "on", zero))
    both = inner.format("x_0", "off", "0.5", "on", inner.format("x_0", "on", "0.5", "off", zero))
    for tree, row in ((child, (F(3, 4), F(1, 4))), (both, (F(1, 2), F(1, 2)))):
        text = with_diagram(('<SubDAG type="uniform" var="x_1"/>', tree))
        model = read_pomdpx(text, "twice")
        effect = dict(model.actions[1].effects)["x"]
        assert distribution(effect, ("off", "on"), {("x", False): "on"}) == row
        agree(text, model)


def test_longer_circles_are_refused() -> None:
    text = with_diagram(
        ('<SubDAG type="uniform" var="x_1"/>', USE.format("u")),
        ("</SubDAGTemplate>", f"</SubDAGTemplate>{template('u', USE.format('t'))}"),
    )
    with pytest.raises(ModelError, match="in a circle"):
        read_pomdpx(text, "bad")
    both = "<Entry><Instance>- -</Instance><ProbTable>identity</ProbTable></Entry>"
    text = two_flags("y_1 x_1", both, both).replace("<Parent>x_0</Parent>", "<Parent>x_1</Parent>")
    with pytest.raises(ModelError, match=r"in a circle: [xy]_1 -> [xy]_1 -> [xy]_1"):
        read_pomdpx(text, "bad")


def test_an_arc_may_turn_round_from_one_action_to_another() -> None:
    one = "<Entry><Instance>* * -</Instance><ProbTable>uniform</ProbTable></Entry>"
    copied = "<Entry><Instance>a{} - -</Instance><ProbTable>identity</ProbTable></Entry>"
    text = two_flags("a y_1 x_1", one + copied.format(0), one + copied.format(1))
    text = text.replace("<Parent>x_0</Parent>", "<Parent>a x_1</Parent>")
    model = read_pomdpx(text, "turning")
    assert dict(model.actions[0].effects)["x"] == Reference("y", primed=True)
    assert dict(model.actions[1].effects)["y"] == Reference("x", primed=True)
    assert check(model) == []
    agree(text, model)


def test_missing_parts_are_all_named() -> None:
    cut = TIGER
    for title in ("InitialStateBelief", "StateTransitionFunction", "ObsFunction", "RewardFunction"):
        start, end = cut.index(f"<{title}>"), cut.index(f"</{title}>") + len(title) + 3
        cut = cut[:start] + cut[end:]
    with pytest.raises(ModelError) as caught:
        read_pomdpx(cut, "empty")
    assert len(caught.value.faults) == 4


def test_several_faults_are_told_at_once_each_at_its_place() -> None:
    text = changed(
        ("-100 10<", "-100 ten<"), ("\n  0.15 0.85<", "\n  0.15 x.85<"), ("listen *<", "listen<")
    )
    with pytest.raises(ModelError) as caught:
        read_pomdpx(text, "bad")
    lines = text.split("\n")
    places = {}
    for fault in caught.value.faults:
        places[lines[fault.line - 1][fault.column - 1 :][:4]] = fault.message
    assert set(places) == {"ten<", "x.85", "<Ins"}


def test_bombs_are_refused() -> None:
    laughs = '<!DOCTYPE p [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;">]>'
    outside = '<!DOCTYPE p [<!ENTITY f SYSTEM "file:///etc/hostname">]>'
    elsewhere = '<!DOCTYPE p SYSTEM "http://example.invalid/p.dtd">'
    for kind in (laughs, outside, elsewhere):
        text = TIGER.replace("<pomdpx", f"{kind}\n<pomdpx", 1).replace("two doors", "&b;")
        with pytest.raises(ModelError, match="document type") as caught:
            read_pomdpx(text, "bomb")
        assert caught.value.faults[0].line == 2
    deep = 10**5
    nested = "<Node>" * deep + "</Node>" * deep
    with pytest.raises(ModelError, match="nested deeper"):
        read_pomdpx(TIGER.replace("two doors", nested), "bomb")
    with pytest.raises(ModelError, match="nested deeper"):
        read_pomdpx("<a>" * deep, "bomb")
    with pytest.raises(ModelError, match="half a surrogate"):
        read_pomdpx(TIGER.replace("two doors", "\ud800"), "bomb")
    with pytest.raises(ModelError, match="no well-formed XML"):
        read_pomdpx(TIGER.replace("two doors", "\x00"), "bomb")
    with pytest.raises(ModelError, match="the document is a <html>"):
        read_pomdpx("<html/>", "bomb")
    with pytest.raises(ModelError, match="no element found"):
        read_pomdpx("", "bomb")
    with pytest.raises(ModelError, match="characters"):
        read_pomdpx(" " * 20_000_001, "bomb")


def test_45_listed_parents_are_refused_by_counting() -> None:
    with pytest.raises(ModelError, match=r"more than 10\^9 are needed"):
        read_pomdpx(many(45, entry(["-"] * 46, "0.5 0.5")), "many")


def test_a_diagram_as_deep_as_the_document_may_be_is_read_or_refused() -> None:
    for levels in (150, 240):
        tree = "<Terminal>0.5</Terminal>"
        for i in reversed(range(levels)):
            other = '<Edge val="s1"><Terminal>0.5</Terminal></Edge>'
            tree = f'<Node var="b{i}_0"><Edge val="s0">{tree}</Edge>{other}</Node>'
        text = many(levels, f"<DAG>{tree}</DAG>", "DD")
        model = read_pomdpx(text, "deep")  # all leaves are equal: the tree is one row
        assert nodes(dict(model.actions[0].effects)["sum"]) < 10
        bent = tree.replace(
            "<Terminal>0.5", '<SubDAG type="deterministic" var="sum_1" val="s1"/><Terminal>', 1
        )
        bent = bent.replace("<Terminal></Terminal>", "", 1)
        text = many(levels, f"<DAG>{bent}</DAG>", "DD")
        if levels == 150:
            assert nodes(dict(read_pomdpx(text, "deep").actions[0].effects)["sum"]) > levels
        else:
            with pytest.raises(ModelError, match="nested deeper"):
                read_pomdpx(text, "deep")


def test_damaged_documents_raise_nothing_but_model_errors() -> None:
    choose = random.Random(4)
    sources = [TIGER, with_diagram(), *(Writer(seed).text() for seed in range(6))]
    words = ["*", "-", "identity", "1e999999999", "null", "<", ">", "&", '"', "9" * 30, "-1", "nan", "0"]
    words += [
        "<Entry>",
        "</Entry>",
        "Node",
        "Edge",
        "SubDAG",
        "DD",
        "template",
        "\x00",
        "\ufffe",
        "é" * 300,
    ]
    loaded, faults = 0, []
    for _ in range(1500):
        text = choose.choice(sources)
        for _ in range(choose.randint(1, 3)):
            start = choose.randrange(len(text))
            end = min(len(text), start + choose.choice((0, 1, 1, 5, 60)))
            match choose.randrange(3):
                case 0:
                    text = text[:start] + choose.choice(words) + text[end:]
                case 1:
                    pieces = text.split(" ")
                    pieces[choose.randrange(len(pieces))] = choose.choice(words)
                    text = " ".join(pieces)
                case 2:
                    pieces = text.split(">")
                    i, j = choose.randrange(len(pieces)), choose.randrange(len(pieces))
                    pieces[i], pieces[j] = pieces[j], pieces[i]
                    text = ">".join(pieces)
            text = text or "<"
        try:
            read_pomdpx(text, "damaged")
            loaded += 1
        except ModelError as error:
            faults += error.faults
    assert loaded > 0
    assert all(fault.line >= 1 and fault.column >= 1 for fault in faults)


# -- files -----------------------------------------------------------------------------------------


def test_files_are_read_and_written_by_extension(tmp_path: Path) -> None:
    path = tmp_path / "tiger.pomdpx"
    path.write_text(TIGER)
    document = read(path)
    assert document.model == read_pomdpx(TIGER, "tiger")
    write(document, tmp_path / "again.PomdpX")
    assert read(tmp_path / "again.PomdpX").model.states == 2
    write(document, tmp_path / "tiger.toml")
    assert read(tmp_path / "tiger.toml").model.states == 2
    with pytest.raises(ModelError, match="no parameters"):
        read(path, {"p": "1/2"})
    path.write_text(changed(("uniform", "0.5 0.6")))
    with pytest.raises(ModelError, match=r"tiger\.pomdpx:15:"):
        read(path)
    assert FORMATS[".pomdpx"].name == "POMDPX"


@pytest.fixture
def data() -> Path:
    folder = os.environ.get("FACTORED_POLCA_DATA", "")
    assert folder, "tests marked 'data' need the folder named by FACTORED_POLCA_DATA"
    return Path(folder)


@pytest.mark.data
def test_the_published_tiger_agrees_with_a_dense_reading(data: Path) -> None:
    model = read(data / "Tiger.pomdpx").model
    assert (model.states, len(model.actions), model.discount) == (2, 3, F(19, 20))
    agree((data / "Tiger.pomdpx").read_text("iso-8859-1"), model)


@pytest.mark.data
def test_the_published_hallway_agrees_with_a_dense_reading(data: Path) -> None:
    document = read(data / "Hallway.pomdpx")
    model = document.model
    assert (model.states, len(model.actions), len(model.observations[0].values)) == (60, 5, 21)
    assert model.features[0].name == "state"
    assert check(model) == []
    text = (data / "Hallway.pomdpx").read_text("iso-8859-1")
    agree_on_hallway(text, model)


def agree_on_hallway(text: str, model: Model) -> None:
    """Entry by entry, since the dense reading above walks through 60^2 cells for each of them."""
    states = [f"s{i}" for i in range(60)]
    tables: dict[str, dict[tuple[str, ...], Fraction]] = {}
    for part in ElementTree.fromstring(text.encode("iso-8859-1")).iter():
        if part.tag in ("CondProb", "Func"):
            table = tables.setdefault(part.findtext("Var") or "", {})
            for item in part.iter("Entry"):
                words = (item.findtext("Instance") or "").split()
                numbers = (item.findtext("ProbTable") or item.findtext("ValueTable") or "").split()
                last = [f"o{i}" for i in range(21)] if part.findtext("Var") == "obs_sensor" else states
                kinds = (
                    [[f"a{i}" for i in range(5)], states, last][-len(words) :]
                    if words != ["-"]
                    else [states]
                )
                if part.tag == "Func":
                    kinds = [[f"a{i}" for i in range(5)], *([states] * (len(words) - 1))]
                dashes = [i for i, word in enumerate(words) if word == "-"]
                options = [
                    kind if word in "*-" else [word] for word, kind in zip(words, kinds, strict=True)
                ]
                for cell in product(*options):
                    index = 0
                    for i in dashes:
                        index = index * len(kinds[i]) + kinds[i].index(cell[i])
                    table[cell] = F(numbers[index])
    zero = F(0)
    start = distribution(dict(model.initial.distributions)["state"], states, {})
    assert start == tuple(tables["state_0"].get((s,), zero) for s in states)
    seen = model.observations[0].values
    for action in model.actions:
        effect = dict(action.effects).get("state", Reference("state"))
        for s in states:
            here, next_ = {("state", False): s}, {("state", True): s}
            row = [tables["state_1"].get((action.name, s, t), zero) for t in states]
            assert distribution(effect, states, here) == tuple(p / sum(row) for p in row)
            row = [tables["obs_sensor"].get((action.name, s, o), zero) for o in seen]
            assert distribution(action.senses[0][1], seen, next_) == tuple(p / sum(row) for p in row)
            terms = [evaluate(term, {**here, **next_}) for term in (*model.rewards, *action.rewards)]
            assert sum(terms) == tables["reward_agent"].get((action.name, s), zero)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["\x9b2J", "\u200b", "\u202eb"])
def test_a_name_that_is_not_seen_is_refused(name: str) -> None:
    text = TIGER.replace("<ValueEnum>", f"<ValueEnum>{name} ", 1)
    with pytest.raises(ModelError, match="a character that can't be shown") as caught:
        read_pomdpx(text, "m")
    assert str(caught.value).isprintable()
