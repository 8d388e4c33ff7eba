"""Texts in POMDPX, from its grammar (`factored_polca.formats.pomdpx`)."""

from __future__ import annotations

from .choices import Choices
from .pieces import chances, discount, name, number

STATES = ("x", "y")
VALUES = ("on", "off", "mid")
ACTIONS = ("go", "stay")

_BOMB = (
    '<!DOCTYPE l [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">'
    '<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">'
    '<!ENTITY d "&c;&c;&c;&c;&c;&c;&c;&c;">]>'
)
WORDS = tuple(
    text.encode()
    for text in (
        "<", ">", "/>", "</", "&", "&lt;", "&amp;", "&#0;", "&#x1b;", "&#xD800;", "&a;", "&d;",
        _BOMB, "<!--", "-->",
        '<!ENTITY x SYSTEM "file:///etc/passwd">', '<!DOCTYPE x SYSTEM "http://localhost/x">', "<![CDATA[",
        "]]>",
        '<?xml version="1.0" encoding="UTF-16"?>', '<?xml version="1.1"?>', "<?php x ?>", 'xmlns:a="b"',
        "a:", "*", "-",
        "<Entry>", "</Entry>", "<Instance>", "<ProbTable>", "<ValueTable>", "uniform", "identity", "null",
        "<DAG>",
        "<Node var='x_0'>", "<Edge val='on'>", "<Terminal>1</Terminal>",
        "<SubDAG type='uniform' var='x_1'/>",
        "<SubDAG type='persistent' var='x_1'/>", "<SubDAG type='template' idref='t'/>",
        "<SubDAGTemplate id='t'>",
        "<NumValues>100000</NumValues>", "<NumValues>999999999</NumValues>", "<ValueEnum>",
        "fullyObs='true'", "x_0",
        "x_1", "<Parent>", "<Var>", "<Parameter type='DD'>", "<Discount>", "<Horizon>5</Horizon>",
        "<a>" * 510,
        "<Instance>- - - - - - - -</Instance>", "<Instance>* * * *</Instance>",
    )
)  # fmt: skip


def pomdpx_text(c: Choices) -> bytes:
    """A file."""
    states = STATES[: 1 + c.below(2)]
    values = {word: VALUES[: 3 if c.rarely(8) else 2] for word in states}
    seen = c.below(2) == 1
    lines = ["<pomdpx>", f"<Discount>{discount(c)}</Discount>", "<Variable>"]
    for word in states:
        listed = _values(c, values[word])
        flag = ' fullyObs="true"' if seen else ""
        lines.append(f'<StateVar vnamePrev="{word}_0" vnameCurr="{word}_1"{flag}>{listed}</StateVar>')
    channel = not seen or c.below(2)
    if channel:
        lines.append(f'<ObsVar vname="o">{_values(c, VALUES[:2])}</ObsVar>')
    lines.append(
        f'<ActionVar vname="act">{_values(c, ACTIONS)}</ActionVar><RewardVar vname="r"/></Variable>'
    )
    if not c.rarely(12):
        lines.append("<InitialStateBelief>")
        for word in states:
            lines.append(_function(c, f"{word}_0", (), values[word], ()))
        lines.append("</InitialStateBelief>")
    if not c.rarely(30):
        lines.append("<StateTransitionFunction>")
        for word in states:
            parent = c.one((f"act {word}_0", f"act {states[0]}_0", f"act {word}_0"))
            if c.rarely(10):
                parent = c.one(("act", f"act {states[-1]}_1", "null"))
            lines.append(
                _function(c, f"{word}_1", tuple(parent.split()), values[word], (ACTIONS, values[word]))
            )
        lines.append("</StateTransitionFunction>")
    if channel and not c.rarely(30):
        given = c.one(("act x_1", "act", "act x_0", "x_1"))
        lines.append("<ObsFunction>")
        lines.append(_function(c, "o", tuple(given.split()), VALUES[:2], (ACTIONS, values["x"])))
        lines.append("</ObsFunction>")
    if not c.rarely(30):
        given = c.one(("act x_0", "x_0", "act", "act x_0 x_1", "act x_1 o", "null"))
        lines.append("<RewardFunction>")
        lines.append(_function(c, "r", tuple(given.split()), (), (ACTIONS, values["x"], values["x"])))
        lines.append("</RewardFunction>")
    lines.append("</pomdpx>")
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def _values(c: Choices, values: tuple[str, ...]) -> str:
    if c.rarely(6):
        return f"<NumValues>{len(values) if c.below(4) else number(c)}</NumValues>"
    return f"<ValueEnum>{' '.join(name(c, (value,)) for value in values)}</ValueEnum>"


def _function(
    c: Choices,
    about: str,
    given: tuple[str, ...],
    own: tuple[str, ...],
    ranges: tuple[tuple[str, ...], ...],
) -> str:
    outer = "Func" if about == "r" else "CondProb"
    if c.rarely(5):
        parameter = f'<Parameter type="DD"><DAG>{_tree(c, about, given, own, 3)}</DAG></Parameter>'
    else:
        entries = [_entry(c, given, own, ranges, whole=k == 0 and not c.rarely()) for k in c.some(1, 3)]
        parameter = f'<Parameter type="TBL">{"".join(entries)}</Parameter>'
    listed = " ".join(name(c, (word,)) for word in given) or "null"
    return f"<{outer}><Var>{about}</Var><Parent>{listed}</Parent>{parameter}</{outer}>"


def _entry(
    c: Choices,
    given: tuple[str, ...],
    own: tuple[str, ...],
    ranges: tuple[tuple[str, ...], ...],
    whole: bool,
) -> str:
    words = []
    for word in given if given != ("null",) else ():
        values = ACTIONS if word == "act" else VALUES
        words.append("*" if whole or c.below(2) else name(c, values[:2]))
        if c.rarely(24):
            words[-1] = "-"
    numbers = number(c)
    if own:
        match c.below(5):
            case 0:
                words.append(name(c, own) if not whole else "-")
                numbers = "uniform" if whole else number(c)
            case 1:
                words.append("-")
                numbers = c.one(("uniform", "identity")) if c.rarely(6) else "uniform"
            case _:
                words.append("-")
                numbers = " ".join(chances(c, len(own)))
    table = "ProbTable" if own or c.rarely(6) else "ValueTable"
    return f"<Entry><Instance>{' '.join(words)}</Instance><{table}>{numbers}</{table}></Entry>"


def _tree(c: Choices, about: str, given: tuple[str, ...], own: tuple[str, ...], depth: int) -> str:
    if not depth or c.ended or c.below(3) == 0:
        match c.below(5):
            case 0:
                return f'<SubDAG type="uniform" var="{about}"/>'
            case 1 if about[-1] == "1":
                return f'<SubDAG type="persistent" var="{about}"/>'
            case 2:
                return f'<SubDAG type="deterministic" var="{about}" val="{c.one(own or VALUES)}"/>'
            case 3 if own and not c.rarely(4):
                row = zip(own, chances(c, len(own)), strict=True)
                edges = "".join(f'<Edge val="{value}"><Terminal>{q}</Terminal></Edge>' for value, q in row)
                return f'<Node var="{about}">{edges}</Node>'
            case _ if own and not c.rarely(6):
                return f'<SubDAG type="uniform" var="{about}"/>'
            case _:
                return f"<Terminal>{number(c)}</Terminal>"
    tested = name(c, given or (about,))
    values = ACTIONS if tested == "act" else VALUES[:2]
    edges = []
    for value in values:
        label, below = value if not c.rarely() else name(c), _tree(c, about, given, own, depth - 1)
        edges.append(f'<Edge val="{label}">{below}</Edge>')
    return f'<Node var="{tested}">{"".join(edges)}</Node>'
