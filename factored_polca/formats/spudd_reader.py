"""Reader of SPUDD's language; the language is described in `factored_polca.formats.spudd`.

One pass from left to right.  Trees become nodes of a `Forest` as they are read, so that macros are
shared, never copied; `Rows` turns trees of weights into distributions.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

import networkx as nx

from factored_polca.formats.spudd_initial import initial_belief
from factored_polca.formats.spudd_rows import RowFaults
from factored_polca.formats.spudd_tokens import Token, Tokens
from factored_polca.formats.spudd_tree_reader import Place, TreeReader
from factored_polca.formats.spudd_trees import ExpansionLimit, TreeLimit
from factored_polca.models.check import MAXIMUM_FEATURES
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import Constant, Expression, Operation, Reference
from factored_polca.models.features import Feature
from factored_polca.models.model import Action, InitialBelief, Model, Observation, replace_fields

MAXIMUM_HORIZON: Final = 10**9

RESERVED: Final = frozenset(
    ["variables", "observations", "unnormalised", "unnormalized", "dd", "enddd", "action", "endaction"]
) | {"observe", "endobserve", "cost", "reward", "discount", "tolerance", "horizon", "init"}
"""Words that can't be the name of a variable or an observation."""

_PARTS: Final = (
    "'init', 'unnormalised', 'dd', 'action', 'reward', 'discount', 'tolerance', 'horizon', "
    "'(variables' and '(observations'"
)
_NOT_READ: Final = {
    "belief": "the initial belief is read from 'init' (Symbolic Perseus), not from 'belief'",
    "obsdd": "Gaussian observations are not read",
    "adjunct": "'adjunct' is not read: remove it",
}


@dataclass
class _Parts:
    """What has been read so far."""

    features: list[Feature] = field(default_factory=list)
    observations: list[Observation] = field(default_factory=list)
    partial: bool = False
    unnormalised: bool = False
    actions: list[Action] = field(default_factory=list)
    rewards: tuple[Expression, ...] = ()
    initial: InitialBelief = field(default_factory=InitialBelief)
    discount: Fraction | None = None
    horizon: int | None = None


def read_spudd_with_warnings(text: str, name: str) -> tuple[Model, tuple[Fault, ...]]:
    """The model that `text` describes, called `name`, and what a careful reader should know.

    Warnings tell of rows divided by sums near 1, of branches and transitions left out, and of an
    initial belief that was divided by its sum.

    Raises:
        ModelError: the text is not right, or asks for more work than the limits allow; every fault
            has a line and a column.
    """
    reader = _Reader(text)
    try:
        return reader.model(name), tuple(reader.warnings())
    except TreeLimit as limit:
        raise reader.tokens.error(str(limit)) from None
    except RowFaults:
        raise ModelError(reader.rows.faults) from None


class _Reader:
    def __init__(self, text: str) -> None:
        self.tokens = Tokens(text)
        self.parts = _Parts()
        self.trees = TreeReader(self.tokens)
        self.forest = self.trees.forest
        self.rows = self.trees.rows
        self.seen: set[str] = set()
        self.initial_warnings: list[Fault] = []

    # -- the file ----------------------------------------------------------------------------

    def model(self, name: str) -> Model:
        while self.tokens.token.kind != "end":
            self._section()
        parts = self.parts
        if not parts.features:
            raise self.tokens.error("the file has no '(variables ...)'")
        if not parts.actions:
            raise self.tokens.error("the file has no action", hint="action NAME ... endaction")
        if parts.discount is None:
            raise self.tokens.error("the file has no discount", hint="for example: discount 0.9")
        if self.rows.faults:
            raise ModelError(self.rows.faults)
        model = Model(
            name,
            parts.features,
            (),
            discount=parts.discount,
            observability="partial" if parts.partial else "full",
            observations=parts.observations,
            horizon=parts.horizon,
        )
        # names are resolved already; resolving them again would unfold what the trees share
        return replace_fields(
            model, actions=tuple(parts.actions), rewards=parts.rewards, initial=parts.initial
        )

    def warnings(self) -> list[Fault]:
        return [*self.rows.warnings(), *self.trees.absent.warnings(self.tokens), *self.initial_warnings]

    def _section(self) -> None:
        token = self.tokens.take()
        match token.text:
            case "(":
                self._declarations()
            case "unnormalised" | "unnormalized":
                self.parts.unnormalised = True
            case "dd":
                self.trees.macro()
            case "action":
                self._action()
            case "reward":
                self._once(token)
                self.parts.rewards = _terms(self.trees.tree(Place("the reward", None, True, True)))
            case "init":
                self._initial(token)
            case "discount":
                self._discount(token)
            case "tolerance":
                self._once(token)
                self.tokens.number("the tolerance")
            case "horizon":
                self._horizon(token)
            case other:
                hint = _NOT_READ.get(other, f"the parts of a file are {_PARTS}")
                raise self.tokens.error(f"unexpected {token}", token.start, hint)

    def _once(self, token: Token) -> None:
        if token.text in self.seen:
            raise self.tokens.error(f"a second {token}", token.start, "it may be given once")
        self.seen.add(token.text)

    def _declarations(self) -> None:
        token = self.tokens.token
        if not (self.tokens.accept("variables") or self.tokens.accept("observations")):
            raise self.tokens.error(f"expected 'variables' or 'observations' after '(', found {token}")
        self._once(token)
        if self.seen - {"variables", "observations"} or self.trees.macros:
            raise self.tokens.error(f"{token} must stand before actions, trees and numbers", token.start)
        hidden = token.text == "observations"
        self.parts.partial |= hidden
        while not self.tokens.accept(")"):
            self.tokens.expect("(", f"or ')' in the list of {token.text}")
            self._variable(hidden)

    def _variable(self, hidden: bool) -> None:
        tokens = self.tokens
        token = tokens.name("a name")
        name = token.text
        if name in RESERVED:
            raise tokens.error(f"{name!r} is a word of the language", token.start, "use another name")
        if name in self.trees.values:
            raise tokens.error(f"{name!r} is declared twice", token.start)
        values: dict[str, None] = {}
        while not tokens.accept(")"):
            value = tokens.name(f"a value of {name!r} or ')'", numeric=True)
            if value.text in values:
                raise tokens.error(f"{name!r} lists the value {value.text!r} twice", value.start)
            values[value.text] = None
        if len(self.trees.values) >= MAXIMUM_FEATURES:
            raise tokens.error(f"more than {MAXIMUM_FEATURES} variables", token.start)
        if not values:
            raise tokens.error(f"{name!r} has no values", token.start, f"({name} VALUE VALUE ...)")
        if hidden and len(values) == 1 and next(iter(values))[0].isdigit():
            raise tokens.error(f"{name!r} is a Gaussian observation, which is not read", token.start,
                               f"list its values: ({name} VALUE VALUE ...)")  # fmt: skip
        self.trees.declare(name, values, hidden)
        if hidden:
            self.parts.observations.append(Observation(name, values))
        else:
            self.parts.features.append(Feature(name, values))

    def _discount(self, token: Token) -> None:
        self._once(token)
        start = self.tokens.token.start
        tree = self.trees.tree(Place("the discount", None, False))
        if not (isinstance(tree, Constant) and isinstance(tree.value, Fraction)):
            raise self.tokens.error("a discount that depends on the state is not read", start)
        if not 0 <= tree.value <= 1:
            raise self.tokens.error("the discount is not between 0 and 1", start)
        self.parts.discount = tree.value

    def _horizon(self, token: Token) -> None:
        self._once(token)
        start = self.tokens.token.start
        horizon = self.tokens.number("the horizon")
        if horizon.denominator != 1 or not 1 <= horizon <= MAXIMUM_HORIZON:
            raise self.tokens.error("the horizon is a whole number of steps, at least 1", start)
        self.parts.horizon = int(horizon)

    def _initial(self, token: Token) -> None:
        self._once(token)
        tree = self.trees.tree(Place("init", None, False))
        try:
            self.parts.initial, off = initial_belief(self.forest, tree, self.parts.features, self.rows)
        except ExpansionLimit:
            raise self.tokens.error("init couples too many variables", token.start,
                                    "write it as a product [* ...] of small trees") from None  # fmt: skip
        except ValueError as problem:
            raise self.tokens.error(f"init: {problem}", token.start) from None
        if off:
            message = "init does not sum to 1; it was divided by its sum"
            self.initial_warnings.append(self.tokens.fault(message, token.start, severity="warning"))

    # -- actions -----------------------------------------------------------------------------

    def _action(self) -> None:
        tokens = self.tokens
        if not self.parts.features:
            raise tokens.error("'(variables ...)' must come first")
        token = tokens.name("the name of an action", numeric=True)
        name = token.text
        if f"action {name}" in self.seen:
            raise tokens.error(f"action {name!r} is defined twice", token.start)
        self.seen.add(f"action {name}")
        effects: dict[str, Expression] = {}
        starts: dict[str, int] = {}
        senses: dict[str, Expression] = {}
        rewards: tuple[Expression, ...] = ()
        if tokens.token.kind == "number":
            rewards = self._cost(name)
        while not tokens.accept("endaction"):
            if tokens.accept("observe"):
                self._observe(name, senses)
            elif tokens.at("cost"):
                if rewards:
                    raise tokens.error(f"action {name!r} has two costs", hint="add them up: [+ ... ...]")
                tokens.take()
                rewards = self._cost(name)
            else:
                self._transition(name, effects, starts)
        missing = [channel.name for channel in self.parts.observations if channel.name not in senses]
        if missing:
            raise tokens.error(
                f"action {name!r} has no observation function of {missing[0]!r}", token.start,
                f"observe {missing[0]} ({missing[0]}' (VALUE (p)) ...) endobserve",
            )  # fmt: skip
        self._refuse_circle(name, effects, starts)
        if len(effects) < len(self.parts.features):
            self.trees.absent.transitions_of(name, effects, self.parts.features, token.start)
        order = sorted(effects, key=self.trees.order.__getitem__)
        changed = [(x, effects[x]) for x in order if effects[x] != Reference(x)]
        observed = [(o.name, senses[o.name]) for o in self.parts.observations]
        self.parts.actions.append(Action(name, changed, rewards=rewards, senses=observed))

    def _cost(self, action: str) -> tuple[Expression, ...]:
        tree = self.trees.tree(Place(f"the cost of {action}", None, True, True))
        return tuple(self.forest.negate(term) for term in _terms(tree))

    def _transition(self, action: str, effects: dict[str, Expression], starts: dict[str, int]) -> None:
        token = self.tokens.name(f"a variable, 'observe', 'cost' or 'endaction' in action {action!r}")
        name = token.text
        if name not in self.trees.values or name in self.trees.channels:
            raise self.tokens.error(
                f"{name!r} is no variable", token.start,
                f"in action {action!r}, which ends with 'endaction'; "
                f"variables are {self.trees.known(hidden=False)}",
            )  # fmt: skip
        if name in effects:
            raise self.tokens.error(f"action {action!r} gives {name!r} twice", token.start)
        target = Reference(name, primed=True)
        weights = self.trees.tree(Place(f"{name}' in action {action}", target))
        starts[name] = token.start
        effects[name] = self.rows.distribution(
            weights,
            target,
            self.trees.values[name],
            what=f"{name}' in action {action}",
            start=token.start,
            unnormalised=self.parts.unnormalised,
            identity=Reference(name),
        )

    def _observe(self, action: str, senses: dict[str, Expression]) -> None:
        while not self.tokens.accept("endobserve"):
            token = self.tokens.name(f"an observation or 'endobserve' in action {action!r}")
            name = token.text
            if name not in self.trees.channels:
                raise self.tokens.error(f"{name!r} is no observation", token.start,
                                        f"observations are {self.trees.known(hidden=True)}")  # fmt: skip
            if name in senses:
                raise self.tokens.error(f"action {action!r} gives {name!r} twice", token.start)
            target = Reference(name)
            weights = self.trees.tree(Place(f"{name} in action {action}", target))
            senses[name] = self.rows.distribution(
                weights,
                target,
                self.trees.values[name],
                what=f"{name} in action {action}",
                start=token.start,
                unnormalised=self.parts.unnormalised,
            )

    def _refuse_circle(self, action: str, effects: dict[str, Expression], starts: dict[str, int]) -> None:
        graph = nx.DiGraph()
        for name, effect in effects.items():
            parents = self.forest.mentioned(self.forest.support(effect) & self.trees.next_bits)
            graph.add_edges_from((parent.name, name) for parent in parents)
        if nx.is_directed_acyclic_graph(graph):
            return
        cycle = [edge[0] for edge in nx.find_cycle(graph)]
        circle = " -> ".join(f"{name}'" for name in [*cycle, cycle[0]])
        raise self.tokens.error(
            f"in action {action!r} next values depend on each other in a circle: {circle}",
            max(starts[name] for name in cycle),
            "a next value may depend on other next values only acyclically",
        )


def _terms(tree: Expression) -> tuple[Expression, ...]:
    if isinstance(tree, Operation) and tree.operator == "add":
        return tree.arguments
    return () if isinstance(tree, Constant) and tree.value == 0 else (tree,)
