"""Reads the trees of SPUDD's language into a forest; see `factored_polca.formats.spudd` for the grammar.

Every node is interned as it is read, so that named trees are shared, never copied.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice
from typing import Final

from factored_polca.formats.spudd_rows import Rows
from factored_polca.formats.spudd_tokens import Token, Tokens
from factored_polca.formats.spudd_trees import MAXIMUM_DEPTH, Forest
from factored_polca.models.errors import Fault
from factored_polca.models.expressions import Expression, Operation, Reference
from factored_polca.models.features import Feature
from factored_polca.models.scalars import Value

_OPERATORS: Final = {"+": "add", "*": "multiply", "-": "add", "/": "divide", "$": "divide"}


@dataclass(frozen=True, slots=True)
class Place:
    """What a tree may mention: `target` is the variable whose row a list of numbers is."""

    what: str
    target: Reference | None = None
    next_state: bool = True
    observations: bool = False


class TreeReader:
    """Reads trees from `tokens`; knows the variables, the named trees and what was left out."""

    def __init__(self, tokens: Tokens) -> None:
        self.tokens = tokens
        self.values: dict[str, tuple[Value, ...]] = {}
        self.index: dict[str, dict[str, int]] = {}  # the values of each variable and their numbers
        self.forest = Forest(self.values)
        self.rows = Rows(self.forest, tokens.fault)
        self.channels: set[str] = set()
        self.order: dict[str, int] = {}  # variables and their numbers
        self.next_bits = 0  # the next values of variables, as bits of the forest
        self.channel_bits = 0
        self.macros: dict[str, Expression] = {}
        self.implicit: dict[str, tuple[str, int]] = {}
        self.absent = Absent()

    def declare(self, name: str, values: Collection[str], hidden: bool) -> None:
        """A variable, or if `hidden` an observation, with its values."""
        self.values[name] = tuple(values)
        self.index[name] = {value: number for number, value in enumerate(values)}
        if hidden:
            self.channels.add(name)
            self.channel_bits |= self.forest.bit(Reference(name))
        else:
            self.order[name] = len(self.order)
            self.next_bits |= self.forest.bit(Reference(name, primed=True))

    def macro(self) -> None:
        """The next `NAME tree enddd`.

        Raises:
            ModelError: it is not right.
            TreeLimit: it is too deep or too large.
        """
        token = self.tokens.name("the name of a tree after 'dd'")
        if token.text in self.macros:
            raise self.tokens.error(f"dd {token.text!r} is defined twice", token.start)
        tree = self.tree(Place(f"dd {token.text}", None, True, True))
        self.tokens.expect("enddd", f"at the end of dd {token.text!r}")
        self.macros[token.text] = tree

    def known(self, *, hidden: bool) -> str:
        names = [name for name in self.values if (name in self.channels) is hidden]
        return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "") if names else "none"

    def tree(self, place: Place) -> Expression:
        """The next tree of the text, checked to mention only what it may.

        Raises:
            ModelError: it is not right.
            TreeLimit: it is too deep or too large.
        """
        if not self.order:
            raise self.tokens.error("'(variables ...)' must come first")
        if not self.implicit:
            self._name_implicit()
        start = self.tokens.token.start
        tree = self._tree(place, 0)
        forbidden = 0 if place.observations else self.channel_bits
        if not place.next_state:
            forbidden |= self.next_bits
        if place.target is not None:
            forbidden &= ~self.forest.bit(place.target)
        for reference in self.forest.mentioned(self.forest.support(tree) & forbidden):
            hint = f"write {reference.name}, without the prime" if reference.primed else ""
            raise self.tokens.error(f"{place.what} can't depend on {reference.name}'", start, hint)
        return tree

    def _tree(self, place: Place, depth: int) -> Expression:
        tokens = self.tokens
        if depth > MAXIMUM_DEPTH:
            raise tokens.error(f"a tree nested deeper than {MAXIMUM_DEPTH} levels")
        start = tokens.token.start
        if tokens.token.kind == "number":
            return self.forest.constant(tokens.number("a number"))
        if tokens.accept("["):
            return self._operation(place, depth, start)
        if not tokens.accept("("):
            raise tokens.error(f"expected a tree: '(', '[' or a number, found {tokens.token}",
                               hint=f"in {place.what}")  # fmt: skip
        if tokens.token.kind == "number":
            return self._row(place, start)
        token = tokens.name("a variable, the name of a dd or a number after '('")
        if tokens.accept(")"):
            return self._named(token)
        reference = self._tested(token, tokens.accept("'"))
        known = self.index[reference.name]
        cases: dict[str, Expression] = {}
        while not tokens.accept(")"):
            tokens.expect("(", f"before a value of {token.text!r}")
            value = tokens.name(f"a value of {token.text!r}", numeric=True)
            if value.text not in known:
                raise tokens.error(f"{value.text!r} is no value of {token.text!r}", value.start,
                                   f"its values are {_listed(known)}")  # fmt: skip
            if value.text in cases:
                raise tokens.error(f"a second branch for {token.text} = {value.text}", value.start)
            cases[value.text] = self._tree(place, depth + 1)
            tokens.expect(")", f"after the branch {token.text} = {value.text}")
        if not cases:
            raise tokens.error(f"{token.text!r} has no branches", token.start)
        if len(cases) < len(known):
            self.absent.branch(token.text, next(v for v in known if v not in cases), token.start)
        zero = self.forest.constant(Fraction(0))
        tree = self.forest.switch(reference, [cases.get(value, zero) for value in known])
        if reference == place.target:
            self.rows.places.setdefault(id(tree), start)
        return tree

    def _tested(self, token: Token, primed: bool) -> Reference:
        name = token.text
        if name not in self.values:
            raise self.tokens.error(
                f"{name!r} is no variable", token.start,
                f"variables are {self.known(hidden=False)}; observations are {self.known(hidden=True)}",
            )  # fmt: skip
        if name not in self.channels:
            return Reference(name, primed)
        if not primed:
            raise self.tokens.error(f"{name!r} is an observation, made after the action", token.start,
                                    f"write {name}'")  # fmt: skip
        return Reference(name)

    def _row(self, place: Place, start: int) -> Expression:
        numbers = []
        while not self.tokens.accept(")"):
            numbers.append(self.forest.constant(self.tokens.number("a number or ')'")))
        if len(numbers) == 1:
            return numbers[0]
        if place.target is None:
            raise self.tokens.error(f"{len(numbers)} numbers in {place.what}, where one is expected", start,
                                    "a list of probabilities stands only in an action's own trees; "
                                    "elsewhere write (x' (VALUE (p)) ...)")  # fmt: skip
        values = self.values[place.target.name]
        if len(numbers) != len(values):
            raise self.tokens.error(
                f"{len(numbers)} probabilities for {place.what}, which has {len(values)} values", start,
                f"in the order {_listed(self.index[place.target.name])}",
            )  # fmt: skip
        tree = self.forest.switch(place.target, numbers)
        self.rows.places.setdefault(id(tree), start)
        return tree

    def _operation(self, place: Place, depth: int, start: int) -> Expression:
        tokens = self.tokens
        symbol = tokens.take()
        forest = self.forest
        if symbol.text == "#":
            reference = self._tested(tokens.name("a variable after '[#'"), tokens.accept("'"))
            tree = self._tree(place, depth + 1)
            tokens.expect("]", "after the tree of '[#'")
            cases = [forest.restrict(tree, reference, value) for value in self.values[reference.name]]
            total = forest.operation("add", cases) if len(cases) > 1 else cases[0]
            return self._defined(forest.operation("divide", (tree, total)), start)
        if symbol.text not in _OPERATORS or symbol.kind != "symbol":
            raise tokens.error(f"{symbol} is no operator that is read here", symbol.start,
                               "operators are + * - / and #, for example [+ (a) (b)]")  # fmt: skip
        parts = []
        while not tokens.accept("]"):
            parts.append(self._tree(place, depth + 1))
        name = _OPERATORS[symbol.text]
        if len(parts) < (1 if symbol.text in "+*" else 2):
            raise tokens.error(f"too few arguments of {symbol}", symbol.start)
        if symbol.text == "-":
            parts = [parts[0], *(forest.negate(part) for part in parts[1:])]
        if name != "divide":
            return self._defined(forest.operation(name, parts) if len(parts) > 1 else parts[0], start)
        result = parts[0]
        for part in parts[1:]:
            result = self._defined(forest.operation("divide", (result, part)), start)
        return result

    def _defined(self, node: Expression, start: int) -> Expression:
        if isinstance(node, Operation) and not self.forest.support(node):
            raise self.tokens.error("division by zero, or a number with too many digits", start)
        return node

    # -- names of trees ----------------------------------------------------------------------

    def _name_implicit(self) -> None:
        """SAMEx (x' equals x) and xv (x' equals v); two readings of one name cancel each other."""
        for name, values in self.values.items():
            self.implicit[f"SAME{name}"] = (name, -1)
            for index, value in enumerate(values):
                text = f"{name}{value}"
                self.implicit[text] = ("", 0) if text in self.implicit else (name, index)

    def _named(self, token: Token) -> Expression:
        name = token.text
        if name in self.macros:
            return self.macros[name]
        if name not in self.implicit:
            what = "a variable without branches" if name in self.values else "no dd"
            raise self.tokens.error(
                f"{name!r} is {what}", token.start,
                "define it before with: dd NAME TREE enddd; SAMEx and xv (x' is v) are known for each x, v",
            )  # fmt: skip
        variable, index = self.implicit[name]
        if not variable:
            raise self.tokens.error(f"{name!r} can be read as a variable and its value in two ways",
                                    token.start, f"define it: dd {name} TREE enddd")  # fmt: skip
        forest = self.forest
        size = len(self.values[variable])
        one, zero = forest.constant(Fraction(1)), forest.constant(Fraction(0))
        after = Reference(variable, primed=variable not in self.channels)

        def indicator(chosen: int) -> Expression:
            return forest.switch(after, [one if i == chosen else zero for i in range(size)])

        if index >= 0:
            return indicator(index)
        if variable in self.channels:
            raise self.tokens.error(f"{name!r}: an observation has no value before the action", token.start)
        return forest.switch(Reference(variable), [indicator(i) for i in range(size)])


@dataclass
class Absent:
    """What the file leaves out; counted, to be told once."""

    branches: int = 0
    branch_place: tuple[str, str, int] = ("", "", 0)
    transitions: int = 0
    transition_place: tuple[str, str, int] = ("", "", 0)

    def branch(self, variable: str, value: str, start: int) -> None:
        """A decision over `variable` has no branch for `value`."""
        if not self.branches:
            self.branch_place = (variable, value, start)
        self.branches += 1

    def transitions_of(
        self, action: str, effects: Collection[str], features: Sequence[Feature], start: int
    ) -> None:
        """`action` gives the next values of `effects` only."""
        if not self.transitions:
            first = next(feature.name for feature in features if feature.name not in effects)
            self.transition_place = (action, first, start)
        self.transitions += len(features) - len(effects)

    def warnings(self, tokens: Tokens) -> list[Fault]:
        """At most two warnings."""
        found = []
        if self.branches:
            variable, value, start = self.branch_place
            message = (
                f"decisions without a branch for some value: {self.branches}; it is read as 0; "
                f"the first is {variable} = {value}"
            )
            found.append(tokens.fault(message, start, "", "warning"))
        if self.transitions:
            action, variable, start = self.transition_place
            message = (
                f"variables that an action does not mention: {self.transitions}; they persist; "
                f"the first is {variable!r} in action {action!r}"
            )
            found.append(tokens.fault(message, start, "", "warning"))
        return found


def _listed(values: Iterable[str]) -> str:
    return ", ".join(islice(values, 12))
