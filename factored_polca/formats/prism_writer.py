"""Writer of PRISM's language, for fully observed models; `prism_spelling` has names, values, expressions.

An action is a label; the module `actions` has one command for each, whose guard says where it applies.
Each feature is a module of its own, and for each action that changes it has one command for each case of
its effect; features that read each other's next values share a module, whose commands have their joint
outcomes. So what runs together under one label is the product that the model's dynamic Bayesian network
stands for, and nothing is multiplied out that is independent.

    terminal                 a formula and the label "terminal"; nothing is enabled or earned there
    discount                 a constant `discount`, which PRISM does not use and our reader does
    parameters               constants of type double
    rewards                  one reward structure; what depends on the next state, as its expectation
    initial belief           first values, or `init` for a uniform distribution over a product of sets

A state without an applicable action is a dead end here; PRISM lets it stay as it is for ever.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction

import networkx as nx

from factored_polca.formats.prism_cases import Cases, Known, Outcome, next_values, substitute
from factored_polca.formats.prism_guards import Guards
from factored_polca.formats.prism_spelling import NotDirect, Spelling, number_text
from factored_polca.formats.spudd_trees import Assignment, ExpansionLimit, Forest, TreeLimit
from factored_polca.models.check import check
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import (
    FALSE,
    ONE,
    TRUE,
    ZERO,
    Constant,
    Expression,
    Lottery,
    Reference,
    disjunction,
    operation,
    references,
)
from factored_polca.models.features import Feature
from factored_polca.models.model import Action, Model
from factored_polca.models.scalars import Value, describe, scalar


def write_prism(model: Model) -> str:
    """`model` as a PRISM program.

    Raises:
        ModelError: the model is not right, or the language can't express it; every fault names the
            place in the model and the reason.
    """
    faults = [fault for fault in check(model) if fault.severity == "error"] or list(_refusals(model))
    if faults:
        raise ModelError(faults)
    try:
        return "\n".join(_Writer(model).lines()) + "\n"
    except (TreeLimit, ExpansionLimit) as limit:
        reason = f": {limit}" if str(limit) else ""
        raise ModelError(f"an expression is too large to be written as PRISM's commands{reason}") from None


def _refusals(model: Model) -> Iterator[Fault]:
    native = "use a .toml file"
    if model.observability != "full":
        yield Fault("PRISM's Markov decision processes are fully observed", ("observability",), native)
    if model.horizon is not None:
        yield Fault("PRISM's programs have no horizon", ("horizon",), f"leave it out, or {native}")
    if model.initial.factors:
        yield Fault("PRISM has no initial probabilities", ("initial", "factors"), native)
    for name, expression in model.initial.distributions:
        if references(expression) or _support(expression, model.feature(name)) is None:
            yield Fault(
                f"PRISM starts in states that are equally likely; {name} is distributed otherwise",
                ("initial", name),
                f"give it one value, or a uniform distribution, or {native}",
            )  # fmt: skip


def _support(expression: Expression, feature: Feature) -> list[Value] | None:
    """The values of a uniform distribution; None for others."""
    outcomes = expression.outcomes if isinstance(expression, Lottery) else ((expression, ONE),)
    chances: dict[int, Fraction] = {}
    for value, chance in outcomes:
        if not (isinstance(value, Constant) and isinstance(chance, Constant)):
            return None
        index = feature.index(value.value)
        if index is None or not isinstance(chance.value, Fraction):
            return None
        chances[index] = chances.get(index, Fraction(0)) + chance.value
    kept = [index for index, chance in chances.items() if chance]
    if len({chances[index] for index in kept}) != 1:
        return None
    return [feature.values[index] for index in sorted(kept)]


@dataclass(frozen=True)
class _Module:
    """Features that share a module, in the model's order."""

    name: str
    features: tuple[Feature, ...]


class _Writer:
    def __init__(self, model: Model) -> None:
        self.model = model
        self.spelling = Spelling(model)
        self.cases = Cases(model.features)
        self.forest = Forest({f.name: f.values for f in model.features})
        self.parameters = dict(model.parameters)
        self.ends = model.terminal != FALSE
        self.modules = self.partition()

    def partition(self) -> list[_Module]:
        graph = nx.Graph()
        graph.add_nodes_from(f.name for f in self.model.features)
        for action in self.model.actions:
            for name, effect in action.effects:
                graph.add_edges_from((r.name, name) for r in references(effect) if r.primed)
        where = {
            name: index for index, group in enumerate(nx.connected_components(graph)) for name in group
        }
        groups: dict[int, list[Feature]] = {}
        for feature in self.model.features:
            groups.setdefault(where[feature.name], []).append(feature)
        return [_Module(self.spelling.modules[group[0].name], tuple(group)) for group in groups.values()]

    # -- the text ----------------------------------------------------------------------------------

    def lines(self) -> Iterator[str]:
        model, spelling = self.model, self.spelling
        yield from self.head()
        yield "mdp"
        yield ""
        yield f"const double discount = {number_text(model.discount)};"
        for name, value in model.parameters:
            yield f"const double {spelling.parameters[name]} = {number_text(value)};"
        yield ""
        if self.ends:
            yield f"formula ended = {self.condition(model.terminal)};"
            yield ""
        yield f"module {spelling.first}"
        for action in model.actions:
            parts = [] if action.applicable == TRUE else [self.condition(action.applicable)]
            guard = " & ".join([*parts, "!ended"] if self.ends else parts) or "true"
            yield f"  [{spelling.actions[action.name]}] {guard} -> true;"
        yield "endmodule"
        begun = dict(model.initial.distributions)
        supports = {
            f.name: _support(begun[f.name], f) if f.name in begun else list(f.values)
            for f in model.features
        }
        single = all(values is not None and len(values) == 1 for values in supports.values())
        for module in self.modules:
            yield ""
            yield f"module {module.name}"
            for feature in module.features:
                values = supports[feature.name] or []
                first = f" init {spelling.code(feature, values[0])}" if single else ""
                yield f"  {spelling.names[feature.name]} : {spelling.domain(feature)}{first};"
            for action in model.actions:
                yield from self.commands(action, module)
            yield "endmodule"
        if not single:
            tests = [spelling.is_one_of(f, supports[f.name] or []) for f in model.features]
            yield ""
            yield f"init {' & '.join(t for t in tests if t != 'true') or 'true'} endinit"
        if self.ends:
            yield ""
            yield 'label "terminal" = ended;'
        yield ""
        yield 'rewards "reward"'
        yield from self.rewards()
        yield "endrewards"

    def head(self) -> Iterator[str]:
        model, spelling = self.model, self.spelling
        yield _comment(f"{model.name}: {model.description}" if model.description else model.name)
        for table in (spelling.names, spelling.actions, spelling.parameters):
            for name, text in table.items():
                if name != text:
                    yield _comment(f"{name} is written {text}")
        for feature in model.features:
            if not spelling.plain[feature.name] and not spelling.truth[feature.name]:
                listed = ", ".join(
                    f"{index} is {describe(scalar(value))}" for index, value in enumerate(feature.values)
                )
                yield _comment(f"{spelling.names[feature.name]}: {listed}")
        guards = Guards(model.features, self.parameters)
        stuck = [operation("not", disjunction([a.applicable for a in model.actions]))]
        stuck += [operation("not", model.terminal)] if self.ends else []
        if all(a.applicable != TRUE for a in model.actions) and guards.satisfiable(
            operation("and", *stuck, TRUE)
        ):
            yield _comment(
                "where no action is enabled, PRISM stays for ever; in the model that is a dead end"
            )

    # -- commands ------------------------------------------------------------------------------------

    def commands(self, action: Action, module: _Module) -> Iterator[str]:
        """The commands of an action in a module."""
        label = self.spelling.actions[action.name]
        effects = self.ordered(action, (feature.name for feature in module.features))
        for known, outcomes in self.cases.joint(effects, Known()) if effects else ():
            guard = " & ".join(self.tests(known)) or "true"
            yield f"  [{label}] {guard} -> {self.updates(outcomes)};"

    def ordered(self, action: Action, names: Iterable[str]) -> list[tuple[str, Expression]]:
        """The effects of an action on some features, each after those whose next values it reads."""
        wanted = set(names)
        effects = {name: effect for name, effect in action.effects if effect != Reference(name)}
        graph = nx.DiGraph()
        for name in (f.name for f in self.model.features if f.name in wanted and f.name in effects):
            graph.add_node(name)
            graph.add_edges_from((r.name, name) for r in references(effects[name]) if r.primed)
        place = {feature.name: index for index, feature in enumerate(self.model.features)}
        order = nx.lexicographical_topological_sort(graph, key=place.__getitem__)
        # a feature that persists, and whose next value is read, is what it is now
        return [(name, effects.get(name, Reference(name))) for name in order]

    def tests(self, known: Known) -> list[str]:
        features = self.cases.features
        tests = [self.spelling.is_one_of(features[name], values) for name, values in known.values]
        for condition, holds in known.conditions:
            text = self.condition(condition)
            tests.append(text if holds else f"!{text}" if text.startswith("(") else f"!({text})")
        return tests

    def updates(self, outcomes: Sequence[Outcome]) -> str:
        texts = []
        for chance, values in outcomes:
            changes = [
                f"({self.spelling.names[name]}'={self.value(self.cases.features[name], value)})"
                for name, value in values.items()
                if value != Reference(name)
            ]
            update = "&".join(changes) or "true"
            texts.append(update if chance == ONE else f"{self.number(chance)}:{update}")
        if len(texts) == 1 and outcomes[0][0] != ONE:
            return texts[0]
        return " + ".join(texts)

    # -- rewards -------------------------------------------------------------------------------------

    def rewards(self) -> Iterator[str]:
        alive = ["!ended"] if self.ends else []
        shared = [t for t in self.model.rewards if not any(r.primed for r in references(t))]
        for term in shared:
            yield from self.reward("", alive, term, Known())
        for action in self.model.actions:
            label = f"[{self.spelling.actions[action.name]}] "
            for term in (*(t for t in self.model.rewards if t not in shared), *action.rewards):
                primed = {r.name for r in references(term) if r.primed}
                if not primed:
                    yield from self.reward(label, [], term, Known())
                    continue
                effects = self.ordered(action, self.ancestors(action, primed))
                persisting = primed - {name for name, _ in effects}
                effects = [(name, Reference(name)) for name in sorted(persisting)] + effects
                for known, outcomes in self.cases.joint(effects, Known()):
                    for chance, values in outcomes:
                        yield from self.reward(
                            label, [], substitute(term, next_values(values)), known, chance
                        )

    def ancestors(self, action: Action, names: Iterable[str]) -> set[str]:
        """Features whose next values decide those of some."""
        effects = dict(action.effects)
        found: set[str] = set()
        waiting = list(names)
        while waiting:
            name = waiting.pop()
            if name not in found:
                found.add(name)
                waiting += [r.name for r in references(effects.get(name, ZERO)) if r.primed]
        return found

    def reward(
        self, label: str, base: list[str], term: Expression, known: Known, chance: Expression = ONE
    ) -> Iterator[str]:
        """The items of a term times a probability; where it is 0 there is none."""
        for below, end in self.cases.regions(term, known):
            if end in (ZERO, FALSE) or chance == ZERO:
                continue
            value = self.number(ONE if end == TRUE else end)
            if chance != ONE:
                value = value if end == TRUE else f"{self.number(chance)}*{value}"
                value = self.number(chance) if end in (TRUE, ONE) else value
            guard = " & ".join([*base, *self.tests(below)]) or "true"
            yield f"  {label}{guard} : {value};"

    # -- expressions ---------------------------------------------------------------------------------

    def condition(self, e: Expression) -> str:
        try:
            return self.spelling.condition(e)
        except NotDirect:
            return self.spelling.condition(self.expanded(e, FALSE))

    def number(self, e: Expression) -> str:
        try:
            return self.spelling.number(e)
        except NotDirect:
            pass
        try:
            return f"({self.spelling.condition(e)} ? 1 : 0)"
        except NotDirect:
            return self.spelling.number(self.expanded(e, ZERO))

    def value(self, feature: Feature, e: Expression) -> str:
        try:
            return self.spelling.value(feature, e)
        except NotDirect:
            pass
        rest = Constant(scalar(feature.values[0]))
        try:
            return self.spelling.value(feature, self.expanded(e, rest, feature))
        except NotDirect:
            raise ModelError(
                f"the next value {str(e)[:200]} of {feature.name} can't be written for PRISM"
            ) from None

    def expanded(self, e: Expression, rest: Expression, feature: Feature | None = None) -> Expression:
        """`e` as a decision over features; `rest` where it has no value, or none of the feature's."""

        def leaf(end: Expression, where: Assignment) -> Expression:
            if not isinstance(end, Constant):
                return self.forest.constant(rest.value) if isinstance(rest, Constant) else end
            if isinstance(end.value, bool) and rest == ZERO:
                return self.forest.constant(Fraction(end.value))
            if feature is not None and feature.index(end.value) is None:
                return self.forest.constant(scalar(feature.values[0]))
            return end

        node = self.forest.adopt(e, self.parameters)
        return self.forest.limited(lambda: self.forest.expand(node, leaf))


def _comment(text: str) -> str:
    return "// " + "".join(c if c.isprintable() else " " for c in text)[:500]
