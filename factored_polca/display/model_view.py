"""A model: its features and actions as tables, and its two-slice network.

The network has a node for each feature now (x) and next (x'), for each observation feature, and one for the
reward; an arc leads from each parent to its child, under any of the actions that are shown.  A dashed arc
says that a feature persists under some action.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

from factored_polca.display.graphs import Edge, Graph, Node, Stroke
from factored_polca.display.tables import drawing, heading, line, table, view
from factored_polca.display.words import count_text, listed, plural, short, value_text, values_text
from factored_polca.models import Action, Feature, Model
from factored_polca.models.expressions import Constant, Expression, Lottery, Reference, references
from factored_polca.models.printing import number_text

SHOWN_FEATURES: Final = 24
"""Features in the network; of a larger model those of the first ones."""

SHOWN_ROWS: Final = 16
LONGEST: Final = 60
"""Characters of an expression in a table."""


def html(model: Model) -> str:
    """Tables and the network."""
    seen = "state seen" if model.observability == "full" else "partially observed"
    detail = (
        f"{plural(model.states, 'state')}, {plural(len(model.actions), 'action')}, {seen}, "
        f"discount {number_text(model.discount)}"
    )
    parameters = ", ".join(f"{name} = {number_text(value)}" for name, value in model.parameters)
    return view(
        heading(short(model.name), detail),
        line(model.description.partition("\n")[0][:200]),
        line(f"parameters: {short(parameters, 200)}" if parameters else ""),
        _features(model),
        _actions(model),
        _observations(model),
        line(f"ends where {_text(model.terminal)}" if not _is(model.terminal, False) else "never ends"),
        drawing(graph(model)),
    )


def graph(model: Model, actions: Iterable[str] | None = None) -> Graph:
    """The two-slice network of some actions, all if none are named.

    Raises:
        KeyError: an unknown action; the message lists those there are.
    """
    chosen = model.actions if actions is None else tuple(model.action(name) for name in actions)
    shown = [f.name for f in model.features[:SHOWN_FEATURES]]
    arcs = _Arcs(shown)
    for action in chosen:
        _add_action(arcs, model.features[:SHOWN_FEATURES], action)
    arcs.parents(model.rewards, "reward", "every action")
    channels = [o.name for o in model.observations[:SHOWN_FEATURES]]
    nodes = [Node(f"now {name}", (short(name),), "feature", name, heading=False) for name in shown]
    changed = {target for _, target in arcs.actions}
    nodes += [
        Node(f"next {name}", (f"{short(name)}′",), "next", f"{name} in the next state", False, rank=1)
        for name in shown
    ]
    nodes += [
        Node(f"sees {name}", (short(name),), "observation", f"observation {name}", False, rank=2)
        for name in channels
        if f"sees {name}" in changed
    ]
    if "reward" in changed:
        nodes.append(Node("reward", ("reward",), "reward", "the reward of a step", False, rank=1))
    known = {node.key for node in nodes}
    edges = [arcs.edge(*pair) for pair in arcs.actions if pair[0] in known and pair[1] in known]
    names = "all actions together" if actions is None else listed([a.name for a in chosen])
    left = len(model.features) - len(shown)
    note = (
        f"shown: the first {len(shown)} of {len(model.features):,} features, and arcs among them"
        if left
        else ""
    )
    text = f"Two-slice network of {short(model.name)}, {names}: features now, next (′)"
    seen = ", observations" if any(node.kind == "observation" for node in nodes) else ""
    return Graph(tuple(nodes), tuple(edges), f"{text}{seen}, reward", "right", note)


class _Arcs:
    """Arcs as they are found, each with the actions that have it and whether it only says that x stays."""

    def __init__(self, shown: Sequence[str]) -> None:
        self.shown = set(shown)
        self.actions: dict[tuple[str, str], dict[str, None]] = {}
        self.changing: set[tuple[str, str]] = set()

    def add(self, source: str, target: str, action: str, persists: bool = False) -> None:
        self.actions.setdefault((source, target), {})[action] = None
        if not persists:
            self.changing.add((source, target))

    def parents(self, expressions: Iterable[Expression], target: str, action: str) -> None:
        for reference in sorted(references(*expressions), key=lambda r: (r.primed, r.name)):
            if reference.name in self.shown:
                self.add(f"{'next' if reference.primed else 'now'} {reference.name}", target, action)

    def edge(self, source: str, target: str) -> Edge:
        actions, persists = self.actions[source, target], (source, target) not in self.changing
        stroke: Stroke = "dashed" if persists else "faint" if target == "reward" else "solid"
        kept = "stays as it is under " if persists else "under "
        return Edge(source, target, "", stroke, kept + listed(actions, 8))


def _add_action(arcs: _Arcs, features: Sequence[Feature], action: Action) -> None:
    effects = dict(action.effects)
    for feature in features:
        effect = effects.get(feature.name)
        if effect is None or effect == Reference(feature.name):
            arcs.add(f"now {feature.name}", f"next {feature.name}", action.name, persists=True)
        else:
            arcs.parents([effect], f"next {feature.name}", action.name)
    for name, sensed in action.senses:
        arcs.parents([sensed], f"sees {name}", action.name)
    arcs.parents(action.rewards, "reward", action.name)


def _features(model: Model) -> str:
    begun = dict(model.initial.distributions)
    rows = [
        (
            short(f.name),
            values_text(f.values) + (" (seen)" if f.observed else ""),
            _text(begun[f.name]) if f.name in begun else "" if model.initial.factors else "uniform",
        )
        for f in model.features[:SHOWN_ROWS]
    ]
    left = len(model.features) - SHOWN_ROWS
    more = line(f"… {plural(left, 'more feature')}" if left > 0 else "")
    return table(["feature", "values", "at the start"], rows, left=(0, 1, 2)) + more


def _actions(model: Model) -> str:
    rows = []
    for action in model.actions[:SHOWN_ROWS]:
        applies = "" if _is(action.applicable, True) else _text(action.applicable)
        changes = listed([name for name, _ in action.effects], 5)
        senses = listed([name for name, _ in action.senses], 5)
        rows.append((short(action.name), changes, senses, applies))
    left = len(model.actions) - SHOWN_ROWS
    more = line(f"… {plural(left, 'more action')}" if left > 0 else "")
    keep = [0, 1, *([2] if model.observations else []), *([3] if any(row[3] for row in rows) else [])]
    names = ["action", "changes", "senses", "applies where"]
    shown = [[row[k] for k in keep] for row in rows]
    return table([names[k] for k in keep], shown, left=range(4)) + more


def _observations(model: Model) -> str:
    if not model.observations:
        return ""
    rows = [
        (short(o.name), values_text(o.values), value_text(o.null)) for o in model.observations[:SHOWN_ROWS]
    ]
    left = len(model.observations) - SHOWN_ROWS
    more = line(f"… {count_text(left)} more" if left > 0 else "")
    return table(["observation", "values", "if not sensed"], rows, left=(0, 1, 2)) + more


def _is(expression: Expression, value: bool) -> bool:
    return isinstance(expression, Constant) and expression.value is value


def _text(expression: Expression) -> str:
    if isinstance(expression, Lottery) and len(expression.outcomes) > 1:
        chances = {chance for _, chance in expression.outcomes}
        if len(chances) == 1:
            return short(
                f"uniform over {listed([_text(v).strip(chr(34)) for v, _ in expression.outcomes])}", LONGEST
            )
    return short(str(expression), LONGEST)
