"""Grounding: lifted expressions become ground terms, non-fluents their values.

A lifted part is grounded once for each binding of the variables that it mentions, and remembered.  In a
conjunction or product the parts without fluents come first: where NEIGHBOR(?x, ?y) is false, nothing of the
rest is built.  Derived- and interm-fluents without draws are put in the place of their names; one with a
draw stays a name, as several places may ask for the same draw.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

from factored_polca.formats.rddl_choices import CHOICES
from factored_polca.formats.rddl_fault import GroundingFault
from factored_polca.formats.rddl_lifted import Args, Definition, Fluent, Lifted, Node, number
from factored_polca.formats.rddl_operators import OPERATORS
from factored_polca.formats.rddl_terms import BOOL, NUMBER, Term, Terms
from factored_polca.models.errors import ModelError
from factored_polca.models.scalars import Scalar

MAXIMUM_STEPS: Final = 10_000_000
"""Lifted parts that are grounded, each counted for each binding."""
MAXIMUM_CHAIN: Final = 40
"""Interm-fluents that hang on each other, by name."""

Binding = Mapping[str, str]


def ground_name(name: str, arguments: Args) -> str:
    """`robot-at(x1,y2)`."""
    return f"{name}({','.join(arguments)})" if arguments else name


@dataclass
class Grounder:
    """Grounds the expressions of one model."""

    lifted: Lifted
    terms: Terms = field(default_factory=Terms)
    steps: int = 0
    random: dict[str, Term] = field(default_factory=dict)  # ground interm-fluents with a draw -> their law
    _free: list[frozenset[str]] = field(default_factory=list)
    _bound_by: list[Args] = field(default_factory=list)  # [node] -> the variables it mentions, in order
    _static: list[bool] = field(default_factory=list)
    _memo: dict[tuple[int, Args], Term] = field(default_factory=dict)
    _inlined: dict[tuple[str, Args], Term | None] = field(default_factory=dict)
    _chain: int = 0

    def __post_init__(self) -> None:
        fluents = self.lifted.fluents
        for node in self.lifted.nodes:
            free: frozenset[str] = frozenset().union(*(self._free[part] for part in node.parts))
            static = all(self._static[part] for part in node.parts)
            if node.kind == "name" and node.text.startswith("?"):
                free = frozenset([node.text])
            free -= {variable for variable, _ in node.binders}
            if node.kind == "fluent":
                declared = fluents.get(node.text)
                static = static and (declared is None or declared.kind == "non-fluent")
            self._free.append(free)
            self._bound_by.append(tuple(sorted(free)))
            self._static.append(static and node.kind not in ("draw", "discrete", "discrete_over"))
        self._objects = self.lifted.objects

    def ground(self, root: int, binding: Binding) -> Term:
        """The term of a lifted expression, its variables bound to objects.

        Raises:
            GroundingFault: it is not right, or nothing that is read.
        """
        key = (root, tuple(binding.get(name, "") for name in self._bound_by[root]))
        found = self._memo.get(key)
        if found is None:
            self.steps += 1
            if self.steps > MAXIMUM_STEPS:
                raise ModelError(f"grounding takes more than {MAXIMUM_STEPS:,} steps: too many objects")
            found = self._ground(self.lifted.nodes[root], binding)
            self._memo[key] = found
        return found

    def instances(self, binders: tuple[tuple[str, str], ...], offset: int) -> Iterator[dict[str, str]]:
        """All bindings of typed variables."""
        values = [self.objects_of(kind, offset) for _, kind in binders]
        names = [name for name, _ in binders]
        for chosen in itertools.product(*values):
            yield dict(zip(names, chosen, strict=True))

    def objects_of(self, kind: str, offset: int) -> Args:
        """The objects or values of a type."""
        if kind not in self.lifted.types:
            listed = ", ".join(self.lifted.types) or "none"
            raise GroundingFault(f"unknown type {kind!r}", offset, f"types are {listed}")
        return self.lifted.types[kind]

    # -- kinds of parts ----------------------------------------------------------------------------

    def _ground(self, node: Node, binding: Binding) -> Term:
        match node.kind:
            case "number":
                try:
                    return self.terms.number(number(node.text))
                except ModelError as error:
                    raise self.fault(node, str(error)) from None
            case "boolean":
                return self.terms.truth(node.text == "true")
            case "name":
                return self._name(node, binding)
            case "fluent":
                return self._fluent(node, binding)
        if node.kind in OPERATORS:
            return OPERATORS[node.kind](self, node, binding)
        if node.kind in CHOICES:
            return CHOICES[node.kind](self, node, binding)
        raise self.fault(node, f"{node.text} is not read")

    def fault(self, node: Node, message: str, hint: str = "") -> GroundingFault:
        return GroundingFault(message, node.offset, hint)

    def _object(self, node: Node, name: str, binding: Binding) -> str:
        if name.startswith("?"):
            if name not in binding:
                raise self.fault(node, f"the variable {name} is not bound")
            return binding[name]
        value = name.removeprefix("@")
        if value not in self._objects:
            raise self.fault(node, f"{name!r} is no object and no value of a type")
        return value

    def _name(self, node: Node, binding: Binding) -> Term:
        value = self._object(node, node.text, binding)
        return self.terms.constant(value, self._objects[value])

    def _fluent(self, node: Node, binding: Binding) -> Term:
        name = node.text.removesuffix("'")
        fluent = self.lifted.fluents.get(name)
        if fluent is None:
            if not node.parts and name in self._objects:
                return self.terms.constant(name, self._objects[name])
            listed = ", ".join(self.lifted.fluents)
            raise self.fault(node, f"unknown fluent {name!r}", f"fluents are {listed[:400]}")
        if len(node.parts) != len(fluent.parameters):
            raise self.fault(
                node, f"{name!r} takes {len(fluent.parameters)} arguments, not {len(node.parts)}"
            )
        arguments = tuple(self._argument(part, binding, name) for part in node.parts)
        for argument, kind in zip(arguments, fluent.parameters, strict=True):
            if self._objects[argument] != kind:
                found = self._objects[argument]
                raise self.fault(node, f"{argument!r} is of type {found!r}; {name!r} needs {kind!r} there")
        return self.fluent(fluent, arguments, node.text.endswith("'"), node.offset)

    def _argument(self, part: int, binding: Binding, name: str) -> str:
        """The object that an argument stands for; one that a non-fluent gives is folded too."""
        value = self.terms.value(self.ground(part, binding))
        if not isinstance(value, str):
            raise self.fault(
                self.lifted.nodes[part],
                f"an argument of {name!r} is no object",
                "arguments are objects, variables and non-fluents whose values are objects",
            )
        return value

    def fluent(self, fluent: Fluent, arguments: Args, primed: bool, offset: int) -> Term:
        """The term that a ground fluent stands for."""
        name, kind = ground_name(fluent.name, arguments), self.kind(fluent)
        if primed and fluent.kind != "state-fluent":
            raise GroundingFault(
                f"{fluent.name}' : {fluent.name!r} is a {fluent.kind}, without a next", offset
            )
        match fluent.kind:
            case "non-fluent":
                value = self.lifted.non_fluents.get((fluent.name, arguments), fluent.default)
                if value is None:
                    raise GroundingFault(f"{name} has no value and no default", fluent.offset)
                return self.constant(value, kind, name, fluent.offset)
            case "state-fluent":
                return self.terms.reference("next" if primed else "now", name, kind)
            case "action-fluent":
                return self.terms.reference("act", name, kind)
            case "observ-fluent":
                raise GroundingFault(f"{name} is an observ-fluent: nothing may depend on it", offset)
        return self._intermediate(fluent, arguments, name, kind, offset)

    def kind(self, fluent: Fluent) -> str:
        """The kind of a fluent's terms."""
        if fluent.range in ("bool", "int", "real"):
            return BOOL if fluent.range == "bool" else NUMBER
        if fluent.range not in self.lifted.types:
            raise GroundingFault(f"{fluent.name!r} has the unknown type {fluent.range!r}", fluent.offset)
        return fluent.range

    def constant(self, value: Scalar, kind: str, name: str, offset: int) -> Term:
        """A declared value as a constant of that kind."""
        if kind == BOOL and isinstance(value, Fraction) and value in (0, 1):
            value = bool(value)
        elif kind == NUMBER and isinstance(value, bool):
            value = Fraction(int(value))
        fits = isinstance(value, {BOOL: bool, NUMBER: Fraction}.get(kind, str))
        if not fits or (isinstance(value, str) and value not in self.lifted.types[kind]):
            raise GroundingFault(f"{name} has the value {value}, which is no {kind}", offset)
        return self.terms.constant(value, kind)

    def _intermediate(self, fluent: Fluent, arguments: Args, name: str, kind: str, offset: int) -> Term:
        key = (fluent.name, arguments)
        if key not in self._inlined:
            self._inlined[key] = None
            self._chain += 1
            if self._chain > MAXIMUM_CHAIN:
                raise GroundingFault(f"more than {MAXIMUM_CHAIN} interm-fluents hang on each other", offset)
            term = self.defined(fluent, arguments)
            self._chain -= 1
            if not self.terms.fixed(term):
                self.random[name] = term
                term = self.terms.reference("random", name, kind)
            self._inlined[key] = term
        found = self._inlined[key]
        if found is None:
            raise GroundingFault(f"{name} depends on itself", offset)
        return found

    def defined(self, fluent: Fluent, arguments: Args) -> Term:
        """The right side of the definition of a ground fluent, of the fluent's kind."""
        primed = f"{fluent.name}'" if fluent.kind == "state-fluent" else fluent.name
        definition: Definition | None = self.lifted.definitions.get(primed)
        if definition is None:
            raise GroundingFault(f"{primed} is not defined in cpfs", fluent.offset)
        if len(definition.variables) != len(arguments):
            raise GroundingFault(f"{primed} is defined with another number of arguments", definition.offset)
        if len(set(definition.variables)) != len(definition.variables):
            raise GroundingFault(f"{primed} is defined with one variable twice", definition.offset)
        term = self.ground(definition.root, dict(zip(definition.variables, arguments, strict=True)))
        return self.cast(term, self.kind(fluent), primed, definition.offset)

    def cast(self, term: Term, kind: str, what: str, offset: int) -> Term:
        """`term` as a term of that kind: a number may stand for a truth value and the other way round."""
        found = self.terms[term].kind
        if found == kind:
            return term
        if kind == NUMBER and found == BOOL:
            return self.terms.as_number(term)
        if kind == BOOL and found == NUMBER and self.terms.fixed(term):
            one, zero = (self.terms.operator("equal", (term, self.terms.number(v))) for v in (1, 0))
            wrong = self.terms.undefined("a number other than 0 and 1 for a truth value", BOOL)
            return self.terms.choice(one, one, self.terms.choice(zero, self.terms.negation(zero), wrong))
        raise GroundingFault(f"{what} is a {kind}, and its definition gives a {found}", offset)

    def condition(self, part: int, binding: Binding) -> Term:
        """A part that must be a truth value."""
        term = self.ground(part, binding)
        if self.terms[term].kind != BOOL:
            node = self.lifted.nodes[part]
            raise self.fault(node, f"a truth value is needed, not a {self.terms[term].kind}")
        return term

    def numeric(self, part: int, binding: Binding) -> Term:
        """A part that must be a number; a truth value counts as 0 or 1."""
        term = self.terms.as_number(self.ground(part, binding))
        if self.terms[term].kind != NUMBER:
            node = self.lifted.nodes[part]
            raise self.fault(node, f"a number is needed, not a {self.terms[term].kind}")
        return term

    def static_first(self, parts: tuple[int, ...]) -> list[int]:
        """`parts`, those without fluents first."""
        return sorted(parts, key=lambda part: not self._static[part])
