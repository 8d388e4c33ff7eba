"""The parts of a model as decision graphs with decimal leaves, as SPUDD's language needs them.

Rewards and factors become graphs of numbers, distributions graphs whose leaves are lotteries over
all values of their variable.  Rows that have no exact decimals become whole-number weights, and
`unnormalised` is set; terminal states become absorbing with reward 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from math import lcm

from factored_polca.formats.spudd_rows import context, decimal
from factored_polca.formats.spudd_text import MAXIMUM_DIGITS, decimal_text
from factored_polca.formats.spudd_trees import Assignment, ExpansionLimit, Forest, reason
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import (
    FALSE,
    ZERO,
    Conditional,
    Constant,
    Expression,
    Lottery,
    Operation,
    Reference,
)
from factored_polca.models.features import Feature, position
from factored_polca.models.model import Action, InitialBelief, Model, Observation
from factored_polca.models.scalars import Value, describe, scalar

Path = tuple[str, ...]
Leaf = Callable[[Expression, Assignment], Expression]


@dataclass
class ActionTrees:
    """An action's distributions by variable, and its cost terms."""

    effects: dict[str, Expression]
    senses: dict[str, Expression]
    costs: list[Expression]


class ModelTrees:
    """The parts of a model as decision graphs with decimal leaves."""

    def __init__(self, model: Model) -> None:
        self.model = model
        variables: list[Feature | Observation] = [*model.features, *model.observations]
        self.values: dict[str, tuple[Value, ...]] = {v.name: v.values for v in variables}
        self.forest = Forest(self.values)
        self.ends = model.terminal != FALSE
        self.unnormalised = False
        self.actions = [self._action(action) for action in model.actions]
        self.rewards = [
            self._reward(term, ("reward", str(index)))
            for index, term in enumerate(sum_terms(model.rewards))
        ] or [self.forest.constant(Fraction(0))]
        self.initial = self._initial(model.initial)

    def _action(self, action: Action) -> ActionTrees:
        path: Path = ("actions", action.name)
        effects = {}
        for name, effect in action.effects:
            if self.ends:
                effect = Conditional(self.model.terminal, Reference(name), effect)
            effects[name] = self._rows(effect, name, (*path, "effects", name))
        sensed = dict(action.senses)
        senses = {}
        for channel in self.model.observations:
            expression = sensed.get(channel.name, Constant(scalar(channel.null)))
            senses[channel.name] = self._rows(expression, channel.name, (*path, "senses", channel.name))
        costs = [
            self._reward(Operation("negate", (term,)), (*path, "reward", str(index)))
            for index, term in enumerate(sum_terms(action.rewards))
        ]
        return ActionTrees(effects, senses, costs)

    def _expand(self, expression: Expression, leaf: Leaf, path: Path) -> Expression:
        node = self.forest.adopt(expression, dict(self.model.parameters))
        try:
            return self.forest.limited(partial(self.forest.expand, node, leaf))
        except ExpansionLimit:
            message = "the decision tree of this expression is too large"
            hint = "split a sum into terms, or use the native format"
            raise ModelError([Fault(message, path, hint)]) from None

    def _numbers(self, expression: Expression, path: Path) -> Expression:
        def leaf(rest: Expression, where: Assignment) -> Expression:
            if isinstance(rest, Constant) and isinstance(rest.value, Fraction):
                return rest
            raise ModelError([Fault(f"no number{_where(where)}: {reason(rest)}", path)])

        return self._expand(expression, leaf, path)

    def _reward(self, expression: Expression, path: Path) -> Expression:
        if self.ends:
            expression = Conditional(self.model.terminal, ZERO, expression)
        tree = self._numbers(expression, path)
        self.forest.map_leaves(tree, partial(self._decimal, path=path))
        return tree

    def _decimal(self, leaf: Expression, path: Path) -> Expression:
        assert isinstance(leaf, Constant)
        assert isinstance(leaf.value, Fraction)
        require_decimal(leaf.value, path)
        return leaf

    def _distribution(self, expression: Expression, name: str, path: Path) -> Expression:
        """A graph whose leaves are lotteries over all values of `name`, in their order."""
        values = self.values[name]

        def leaf(rest: Expression, where: Assignment) -> Expression:
            try:
                chances = row_chances(rest, values)
            except ValueError as problem:
                message = f"no distribution of {name}{_where(where)}: {problem}"
                raise ModelError([Fault(message, path)]) from None
            return self._lottery(values, chances)

        return self._expand(expression, leaf, path)

    def _lottery(self, values: Sequence[Value], chances: Sequence[Fraction]) -> Expression:
        constant = self.forest.constant
        return self.forest.lottery(
            [(constant(scalar(v)), constant(q)) for v, q in zip(values, chances, strict=True)]
        )

    def _rows(self, expression: Expression, name: str, path: Path) -> Expression:
        """A distribution for an action: rows without exact decimals become whole numbers."""

        def leaf(row: Expression) -> Expression:
            chances = _chances(row)
            if all(decimal_text(chance) is not None for chance in chances):
                return row
            self.unnormalised = True
            common = lcm(*(chance.denominator for chance in chances))
            for chance in chances:
                require_decimal(chance * common, path)
            return self._lottery(self.values[name], [chance * common for chance in chances])

        return self.forest.map_leaves(self._distribution(expression, name, path), leaf)

    def _initial(self, initial: InitialBelief) -> list[Expression]:
        """b0 as factors, each up to one constant, for the whole is divided by its sum."""
        trees = []
        for name, expression in initial.distributions:
            path: Path = ("initial", name)

            def function(row: Expression, name: str = name) -> Expression:
                chances = [self.forest.constant(chance) for chance in _chances(row)]
                return self.forest.switch(Reference(name), chances)

            tree = self.forest.map_leaves(self._distribution(expression, name, path), function)
            trees.append(self._scaled(tree, path))
        for index, factor in enumerate(initial.factors):
            path = ("initial", "factors", str(index))
            tree = self._numbers(factor, path)
            if not isinstance(tree, Constant):
                trees.append(self._scaled(tree, path))
        return trees

    def _scaled(self, tree: Expression, path: Path) -> Expression:
        """`tree` if its leaves are decimals, else its least multiple with whole numbers."""
        leaves: list[Fraction] = []

        def collect(leaf: Expression) -> Expression:
            assert isinstance(leaf, Constant)
            assert isinstance(leaf.value, Fraction)
            leaves.append(leaf.value)
            return leaf

        self.forest.map_leaves(tree, collect)
        if all(decimal_text(value) is not None for value in leaves):
            return tree
        common = 1
        for value in leaves:
            common = lcm(common, value.denominator)
            require_decimal(Fraction(common), path)
        factor = self.forest.constant(Fraction(common))
        scaled = self.forest.map_leaves(tree, lambda e: self.forest.operation("multiply", (factor, e)))
        self.forest.map_leaves(scaled, partial(self._decimal, path=path))
        return scaled


def sum_terms(terms: Iterable[Expression]) -> list[Expression]:
    """The terms of a sum, sums among them taken apart."""
    found: list[Expression] = []
    for term in terms:
        if isinstance(term, Operation) and term.operator == "add":
            found += term.arguments
        else:
            found.append(term)
    return found


def row_chances(node: Expression, values: tuple[Value, ...]) -> list[Fraction]:
    """The probabilities of `values` under a distribution that mentions no feature."""
    chances = [Fraction(0)] * len(values)
    outcomes = node.outcomes if isinstance(node, Lottery) else ((node, Constant(Fraction(1))),)
    for value, chance in outcomes:
        if not (isinstance(chance, Constant) and isinstance(chance.value, Fraction)):
            raise ValueError(f"a probability is undefined, {reason(chance)}")
        if chance.value < 0:
            raise ValueError("a probability is negative")
        if chance.value == 0:
            continue
        if not isinstance(value, Constant):
            raise ValueError(reason(value))
        index = position(values, value.value)
        if index is None:
            raise ValueError(f"{_shown(value)} is none of its values")
        chances[index] += chance.value
    total = sum(chances, Fraction(0))
    if total != 1:
        raise ValueError(f"the row sums to {decimal(total)}, not to exactly 1")
    return chances


def _shown(constant: Constant) -> str:
    value = constant.value
    return decimal(value) if isinstance(value, Fraction) else describe(value)


def _chances(row: Expression) -> list[Fraction]:
    assert isinstance(row, Lottery)
    return [q.value for _, q in row.outcomes if isinstance(q, Constant) and isinstance(q.value, Fraction)]


def _where(where: Assignment) -> str:
    return f" where {context(where)}" if where else ""


def require_decimal(value: Fraction, path: Path) -> str:
    """`value` as an exact decimal.

    Raises:
        ModelError: it has none that readers of the language take.
    """
    text = decimal_text(value)
    if text is None:
        bits = max(value.numerator.bit_length(), value.denominator.bit_length())
        shown = str(value) if bits < 100 else decimal(value)
        raise ModelError([Fault(f"{shown} is no decimal of at most {MAXIMUM_DIGITS} characters", path,
                                "the language has decimals only: scale or round it")])  # fmt: skip
    return text
