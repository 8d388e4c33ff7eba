"""A ground RDDL instance as a model.

    state-fluent f             a feature; f in the text is the feature now, f' the feature next
    interm-fluent with a draw  a feature too, read where it is next only (a synchronic arc)
    action-fluents             joint actions, listed (`rddl_actions`)
    observ-fluent o            an observation feature, sensed by every action
    preconditions, constraints on actions: where an action is applicable
    termination                the terminal predicate: the disjunction of its conditions
    reward                     terms over few features each

Every fluent's definition is bound to each action's values and folded again, so that only true parents stay.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from factored_polca.formats.rddl_actions import (
    ActionFluent,
    Joint,
    integer_values,
    joint_actions,
    joint_name,
)
from factored_polca.formats.rddl_fault import GroundingFault
from factored_polca.formats.rddl_grounding import Grounder, ground_name
from factored_polca.formats.rddl_laws import mean
from factored_polca.formats.rddl_lifted import Args, Fluent, Lifted
from factored_polca.formats.rddl_ranges import (
    MAXIMUM_VALUES,
    Ranges,
    Unbounded,
    Unknown,
    Values,
    closed,
    possible,
)
from factored_polca.formats.rddl_rewards import reward_terms
from factored_polca.formats.rddl_terms import ACTS, Term, Terms
from factored_polca.formats.rddl_translation import Translator
from factored_polca.models.check import MAXIMUM_FEATURES
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import Constant, Expression, Reference
from factored_polca.models.features import Feature
from factored_polca.models.model import Action, InitialBelief, Model, Observation, replace_fields
from factored_polca.models.scalars import Scalar, Value

_BOTH: Final = frozenset[Scalar]([False, True])


@dataclass(frozen=True)
class Ground:
    """A ground fluent with its law."""

    name: str
    fluent: Fluent
    arguments: Args
    law: Term


@dataclass
class Builder:
    """Builds the model of one instance."""

    lifted: Lifted
    grounder: Grounder
    notes: list[str] = field(default_factory=list)

    @property
    def terms(self) -> Terms:
        """The terms of the grounder."""
        return self.grounder.terms

    def model(self) -> Model:
        """The model.

        Raises:
            GroundingFault, ModelError: the instance is not right, or nothing that is read.
        """
        lifted = self.lifted
        states = list(self.fluents("state-fluent"))
        channels = list(self.fluents("observ-fluent"))
        conditions = [*self.conditions(lifted.preconditions), *self.conditions(lifted.constraints)]
        terminal = self.terms.disjunction(
            self.checked(lifted.terminals, {"now"}, "a termination condition")
        )
        reward = self.grounder.numeric(lifted.reward, {})
        actions = self.action_fluents(conditions)
        self.check_initial(states, conditions)
        ranges = self.ranges(states, actions)
        random = sorted(self.grounder.random.items())
        translator = Translator(self.terms, ranges)
        features = [Feature(g.name, self.values(g.fluent, ranges, "now", g.name)) for g in states]
        features += [
            Feature(name, self.values(self.declared(name), ranges, "random", name)) for name, _ in random
        ]
        laws = [(ground.name, ground.law) for ground in states] + random
        partial = bool(channels) or "partially-observed" in lifted.requirements
        build = _Actions(self, translator, actions, laws, channels, conditions)
        shared, own = build.rewards(reward)
        listed = list(build.listed(own, partial))
        if not listed:
            raise ModelError("no action meets the preconditions and constraints anywhere")
        initial: list[tuple[str, Expression]] = [(g.name, Constant(self.initial(g))) for g in states]
        initial += [(f.name, _constant(f.values[0])) for f in features[len(states) :]]
        model = Model(
            lifted.instance,
            features,
            (),
            terminal=translator.expression(terminal),
            initial=InitialBelief(initial),
            discount=lifted.discount,
            observability="partial" if partial else "full",
            observations=[self.channel(ground, ranges) for ground in channels],
            horizon=lifted.horizon,
            description=f"the instance {lifted.instance} of the RDDL domain {lifted.domain}",
        )
        # names are resolved already; resolving them again would unfold what is shared
        return replace_fields(model, actions=tuple(listed), rewards=tuple(shared))

    # -- fluents -----------------------------------------------------------------------------------

    def fluents(self, kind: str) -> Iterator[Ground]:
        """The ground fluents of a kind, with their laws."""
        number = 0
        for fluent in self.lifted.fluents.values():
            if fluent.kind != kind:
                continue
            self.refuse_real(fluent)
            for binding in self.instances(fluent):
                number += 1
                if number > MAXIMUM_FEATURES:
                    raise ModelError(f"more than {MAXIMUM_FEATURES:,} ground {kind}s")
                law = self.grounder.defined(fluent, binding)
                yield Ground(ground_name(fluent.name, binding), fluent, binding, law)

    def instances(self, fluent: Fluent) -> Iterator[Args]:
        """All arguments of a fluent."""
        binders = tuple((str(i), kind) for i, kind in enumerate(fluent.parameters))
        for binding in self.grounder.instances(binders, fluent.offset):
            yield tuple(binding.values())

    def refuse_real(self, fluent: Fluent) -> None:
        """Refuse continuous fluents."""
        if fluent.range == "real":
            raise GroundingFault(
                f"{fluent.name!r} is a real {fluent.kind}: continuous fluents are not read", fluent.offset,
                "bool, int with a finite range and enumerated types are",
            )  # fmt: skip

    def declared(self, name: str) -> Fluent:
        """The fluent of a ground name."""
        return self.lifted.fluents[name.partition("(")[0]]

    def initial(self, ground: Ground) -> Scalar:
        """The value of a state-fluent at the start."""
        fluent = ground.fluent
        value = self.lifted.initial.get((fluent.name, ground.arguments), fluent.default)
        if value is None:
            raise GroundingFault(f"{ground.name} has neither a default nor an initial value", fluent.offset)
        kind = self.grounder.kind(fluent)
        constant = self.terms.value(self.grounder.constant(value, kind, ground.name, fluent.offset))
        assert constant is not None
        return constant

    def values(self, fluent: Fluent, ranges: Ranges, op: str, name: str) -> tuple[Value, ...]:
        """The values of a feature."""
        if fluent.range == "bool":
            return (False, True)
        if fluent.range == "int":
            return tuple(sorted(int(Fraction(value)) for value in ranges[op, name]))
        self.refuse_real(fluent)
        return self.grounder.objects_of(fluent.range, fluent.offset)

    def channel(self, ground: Ground, ranges: Ranges) -> Observation:
        """The observation feature of an observ-fluent."""
        if ground.fluent.range != "int":
            return Observation(ground.name, self.values(ground.fluent, ranges, "", ground.name))
        try:
            found = possible(self.terms, ground.law, ranges)
        except Unbounded:
            found = frozenset()
        if not 0 < len(found) <= MAXIMUM_VALUES or any(Fraction(v).denominator != 1 for v in found):
            raise ModelError(f"the int observ-fluent {ground.name} has no finite range of integers")
        return Observation(ground.name, sorted(int(Fraction(value)) for value in found))

    def ranges(self, states: Sequence[Ground], actions: Sequence[ActionFluent]) -> Ranges:
        """The values of every reference that terms have."""
        result: dict[tuple[str, str], Values] = {}
        unknown: list[Unknown] = []
        laws: list[tuple[str, Fluent, Term, tuple[str, ...]]]
        laws = [(g.name, g.fluent, g.law, ("now", "next")) for g in states]
        laws += [(n, self.declared(n), law, ("random",)) for n, law in self.grounder.random.items()]
        for name, fluent, law, ops in laws:
            if fluent.range == "int":
                ground = next((g for g in states if g.name == name), None)
                first = frozenset() if ground is None else frozenset([self.initial(ground)])
                unknown.append(Unknown(name, ops, first, law))
                continue
            values = _BOTH
            if fluent.range != "bool":
                self.refuse_real(fluent)
                values = frozenset(self.grounder.objects_of(fluent.range, fluent.offset))
            result |= {(op, name): values for op in ops}
        result |= {("act", action.name): frozenset(action.values) for action in actions}
        return closed(self.terms, result, unknown)

    # -- conditions --------------------------------------------------------------------------------

    def checked(self, roots: Sequence[int], allowed: set[str], what: str) -> Iterator[Term]:
        """Conditions that may only mention references of some kinds."""
        words = {"now": "", "act": "an action", "next": "the next state", "random": "a draw"}
        for root in roots:
            term = self.grounder.condition(root, {})
            found = {op for op, _ in self.terms.mentioned([term])}
            wrong = sorted(found - allowed) or ([] if self.terms.fixed(term) else ["random"])
            if wrong:
                offset = self.lifted.nodes[root].offset
                raise GroundingFault(f"{what} depends on {words[wrong[0]]}", offset)
            yield term

    def conditions(self, roots: Sequence[int]) -> Iterator[Term]:
        """Preconditions or constraints, one at a time."""
        what = "a precondition or constraint"
        for term in self.checked(roots, {"now", "act"}, what):
            row = self.terms[term]
            yield from row.parts if row.op == "and" else (term,)

    def check_initial(self, states: Sequence[Ground], conditions: Sequence[Term]) -> None:
        """What must hold of states alone: it is checked at the start, and a promise elsewhere."""
        values = {
            g.name: self.terms.constant(self.initial(g), self.grounder.kind(g.fluent)) for g in states
        }
        pure = [c for c in conditions if not self.terms[c].flags & ACTS]
        pure += self.checked(self.lifted.invariants, {"now"}, "a state-invariant")
        for condition in pure:
            if self.terms.value(self.terms.replaced(condition, values, "now")) is not True:
                raise ModelError("the initial state does not meet the constraints or invariants on states")
        if any(self.terms.value(condition) is None for condition in pure):
            self.notes.append(
                "constraints and invariants that mention no action are checked at the start only; they "
                "leave no state out"
            )

    def action_fluents(self, conditions: Sequence[Term]) -> list[ActionFluent]:
        """The ground action-fluents with their values, the default first."""
        found: list[ActionFluent] = []
        for fluent in self.lifted.fluents.values():
            if fluent.kind != "action-fluent":
                continue
            self.refuse_real(fluent)
            kind = self.grounder.kind(fluent)
            if fluent.default is None:
                raise GroundingFault(f"the action-fluent {fluent.name!r} has no default", fluent.offset)
            constant = self.grounder.constant(fluent.default, kind, fluent.name, fluent.offset)
            default = self.terms.value(constant)
            assert default is not None
            for arguments in self.instances(fluent):
                name = ground_name(fluent.name, arguments)
                if fluent.range == "bool":
                    values: tuple[Scalar, ...] = (default, not default)
                elif fluent.range == "int":
                    values = integer_values(self.terms, name, Fraction(default), conditions, MAXIMUM_VALUES)
                else:
                    others = self.grounder.objects_of(fluent.range, fluent.offset)
                    values = (default, *(value for value in others if value != default))
                found.append(ActionFluent(name, kind, values))
        return found


def _constant(value: Value) -> Expression:
    return Constant(value) if isinstance(value, (bool, str)) else Constant(Fraction(value))


@dataclass
class _Actions:
    """Binds laws, rewards and conditions to joint actions; what an action does not touch is done once."""

    builder: Builder
    translator: Translator
    fluents: Sequence[ActionFluent]
    laws: Sequence[tuple[str, Term]]
    channels: Sequence[Ground]
    conditions: Sequence[Term]
    _memo: dict[tuple[Term, tuple[tuple[str, Scalar], ...]], Term] = field(default_factory=dict)

    def __post_init__(self) -> None:
        terms = self.builder.terms
        self.affected: dict[str, list[int]] = {}
        for index, (_, law) in enumerate(self.laws):
            for name in terms.acts(law):
                self.affected.setdefault(name, []).append(index)
        self.kinds = {fluent.name: fluent.kind for fluent in self.fluents}
        self.defaults = {fluent.name: fluent.values[0] for fluent in self.fluents}

    def bound(self, term: Term, joint: Joint) -> Term:
        """`term` with the action-fluents' values put in."""
        terms = self.builder.terms
        names = terms.acts(term)
        if not names:
            return term
        key = (term, tuple((name, value) for name, value in joint.items() if name in names))
        if key not in self._memo:
            values = {name: joint.get(name, self.defaults[name]) for name in names}
            leaves = {name: terms.constant(value, self.kinds[name]) for name, value in values.items()}
            self._memo[key] = terms.replaced(term, leaves, "act", ACTS)
        return self._memo[key]

    def rewards(self, reward: Term) -> tuple[list[Expression], list[Term]]:
        """The reward's terms that hold for all actions, and those that depend on the action."""
        terms = self.builder.terms
        parts = [mean(terms, part) for part in reward_terms(terms, reward)]
        shared = [part for part in parts if not terms[part].flags & ACTS]
        own = [part for part in parts if terms[part].flags & ACTS]
        zero = terms.number(0)
        return [self.translator.expression(part) for part in shared if part != zero], own

    def effect(self, name: str, law: Term, joint: Joint) -> tuple[str, Expression] | None:
        """What a joint action does to a feature; None where it stays as it is."""
        found = self.translator.law(self.bound(law, joint))
        return None if found == Reference(name) else (name, found)

    def listed(self, own: Sequence[Term], partial: bool) -> Iterator[Action]:
        """The actions that apply somewhere."""
        terms, concurrent = self.builder.terms, self.builder.lifted.concurrent
        on_actions = [c for c in self.conditions if terms[c].flags & ACTS]
        zero = terms.number(0)
        usual = [self.effect(x, law, {}) for x, law in self.laws]
        for joint in joint_actions(terms, self.fluents, concurrent, on_actions):
            applicable = terms.conjunction([self.bound(condition, joint) for condition in on_actions])
            if terms.value(applicable) is False:
                continue
            name = joint_name(joint)
            if partial and terms.value(applicable) is not True:
                raise _partly_applicable(name)
            effects = list(usual)
            for index in {index for name in joint for index in self.affected.get(name, ())}:
                effects[index] = self.effect(*self.laws[index], joint)
            rewards = [self.bound(part, joint) for part in own]
            yield Action(
                name,
                [effect for effect in effects if effect is not None],
                applicable=self.translator.expression(applicable),
                rewards=[self.translator.expression(part) for part in rewards if part != zero],
                senses=[
                    (g.name, self.translator.law(self.bound(g.law, joint))) for g in self.channels
                ],
            )  # fmt: skip


def _partly_applicable(name: str) -> ModelError:
    return ModelError(
        [
            Fault(
                f"preconditions or constraints let the action {name} apply in some states only, and the "
                "state is not seen",
                hint="under partial observability actions are total: say in cpfs what it does elsewhere",
            )
        ]
    )
