"""Decision graphs made of expressions, each distinct node stored once.

A `Forest` interns expressions: equal ones built by it are the same object, so every computation can
be remembered by a node's identity and a graph that shares its parts is never unfolded.  On it rest

    restrict(e, x, v)   e with x = v, folded                              (the cofactor of e)
    expand(e)           switch x {v: expand(restrict(e, x, v)), ...}      (Shannon's expansion)

with x the first feature that deciding e needs; expansion ends at leaves without free features.
Trees come from strangers: depth, number of nodes and steps are counted against limits.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from factored_polca.models.expressions import (
    Conditional,
    Constant,
    Expression,
    Lottery,
    Operation,
    Parameter,
    Reference,
    Switch,
    children,
)
from factored_polca.models.scalars import (
    OPERATORS,
    Scalar,
    Undefined,
    Value,
    apply_operator,
    describe,
    scalar,
)

MAXIMUM_DEPTH: Final = 200
"""Levels of one expression, and of one expansion."""
MAXIMUM_NODES: Final = 1_000_000
"""Distinct nodes of one file."""
MAXIMUM_STEPS: Final = 5_000_000
"""Visits of nodes for one file; arithmetic on long numbers counts as several."""
MAXIMUM_EXPANSION: Final = 200_000
"""Visits of nodes for one expansion."""

Assignment = tuple[tuple[Reference, Value], ...]


class TreeLimit(Exception):
    """A limit of this module was reached; the message names it."""


class ExpansionLimit(Exception):
    """One expansion needs more than `MAXIMUM_EXPANSION` steps or `MAXIMUM_DEPTH` levels."""


@dataclass(frozen=True, slots=True)
class _Facts:
    support: int  # bit i: the node mentions reference i
    depth: int


class Forest:
    """Interned expressions over variables with the given values."""

    def __init__(self, values: Mapping[str, tuple[Value, ...]]) -> None:
        self._values = values
        self._nodes: dict[Hashable, Expression] = {}
        self._facts: dict[int, _Facts] = {}
        self._bits: dict[Reference, int] = {}
        self._references: list[Reference] = []
        self._cases: dict[int, dict[tuple[bool, Value], Expression]] = {}
        self._steps = 0
        self._deadline = MAXIMUM_STEPS

    @property
    def used(self) -> int:
        """The steps counted so far."""
        return self._steps

    # -- construction ------------------------------------------------------------------------

    def _intern(
        self, key: Hashable, make: Callable[[], Expression], parts: Sequence[Expression] = (), own: int = 0
    ) -> Expression:
        known = self._nodes.get(key)
        if known is not None:
            return known
        if len(self._nodes) >= MAXIMUM_NODES:
            raise TreeLimit(f"more than {MAXIMUM_NODES} distinct nodes")
        support, deepest = own, 0
        for part in parts:
            facts = self._facts[id(part)]
            support |= facts.support
            deepest = max(deepest, facts.depth)
        if deepest >= MAXIMUM_DEPTH:
            raise TreeLimit(f"trees nested deeper than {MAXIMUM_DEPTH} levels")
        self.count(support.bit_length() // 256)
        node = make()
        self._nodes[key] = node
        self._facts[id(node)] = _Facts(support, deepest + 1)
        return node

    def bit(self, reference: Reference) -> int:
        """The bit that stands for `reference` in a support."""
        known = self._bits.get(reference)
        if known is None:
            known = self._bits[reference] = 1 << len(self._references)
            self._references.append(reference)
        return known

    def mentioned(self, bits: int) -> list[Reference]:
        """The references that stand in `bits`."""
        found = []
        while bits:
            lowest = bits & -bits
            found.append(self._references[lowest.bit_length() - 1])
            bits ^= lowest
        return found

    def support(self, node: Expression) -> int:
        """The references that `node` mentions, as bits."""
        return self._facts[id(node)].support

    def size(self, reference: Reference) -> int:
        """The number of values of `reference`."""
        return len(self._values[reference.name])

    def values_of(self, reference: Reference) -> tuple[Value, ...]:
        """The values of `reference`."""
        return self._values[reference.name]

    def constant(self, value: Scalar) -> Expression:
        """The constant `value`."""
        key = ("constant", type(value), value)
        if isinstance(value, Fraction):
            self.count(max(value.numerator.bit_length(), value.denominator.bit_length()) // 100)
        return self._intern(key, lambda: Constant(value))

    def reference(self, reference: Reference) -> Expression:
        """The node that is `reference` itself."""
        return self._intern(("reference", reference), lambda: reference, (), self.bit(reference))

    def switch(self, reference: Reference, cases: Sequence[Expression]) -> Expression:
        """The decision over all values of `reference`; the case itself if all cases are the same."""
        first = cases[0]
        if all(case is first for case in cases):
            return first
        self.count(len(cases))
        key = ("switch", reference, *map(id, cases))

        def make() -> Expression:
            return Switch(reference, tuple(zip(self._values[reference.name], cases, strict=True)))

        return self._intern(key, make, cases, self.bit(reference))

    def operation(self, name: str, arguments: Sequence[Expression]) -> Expression:
        """Operator `name` on `arguments`, folded where that is possible, never flattened.

        Flattening would unfold a sum that shares its parts, such as s2 = s1 + s1, s1 = s0 + s0.
        """
        parts = tuple(arguments)
        if name in ("and", "or"):
            start = 0
            while start < len(parts):
                part = parts[start]
                if not (isinstance(part, Constant) and isinstance(part.value, bool)):
                    break
                if part.value is (name == "or"):
                    return part
                start += 1
            if start == len(parts):
                return self.constant(name == "and")
            parts = parts[start:]
            if len(parts) == 1:
                return parts[0]
        self.count(len(parts))
        if OPERATORS[name].associative:
            parts = self._start_folded(name, parts)
        values = [part.value for part in parts if isinstance(part, Constant)]
        if len(values) == len(parts):
            result = apply_operator(name, values)
            if not isinstance(result, Undefined):
                return self.constant(result)
        key = ("operation", name, *map(id, parts))
        return self._intern(key, lambda: Operation(name, parts), parts)

    def _start_folded(self, name: str, parts: tuple[Expression, ...]) -> tuple[Expression, ...]:
        """The constants at the start combined, as the native language reads them."""
        while len(parts) > 2 and isinstance(parts[0], Constant) and isinstance(parts[1], Constant):
            result = apply_operator(name, (parts[0].value, parts[1].value))
            if isinstance(result, Undefined):
                break
            parts = (self.constant(result), *parts[2:])
        return parts

    def conditional(self, condition: Expression, then: Expression, otherwise: Expression) -> Expression:
        """`then` where `condition` holds, `otherwise` elsewhere."""
        if isinstance(condition, Constant) and isinstance(condition.value, bool):
            return then if condition.value else otherwise
        parts = (condition, then, otherwise)
        key = ("conditional", *map(id, parts))
        return self._intern(key, lambda: Conditional(*parts), parts)

    def lottery(self, outcomes: Sequence[tuple[Expression, Expression]]) -> Expression:
        """The distribution with these (value, probability) pairs."""
        self.count(len(outcomes))
        parts = [part for pair in outcomes for part in pair]
        key = ("lottery", *map(id, parts))
        return self._intern(key, lambda: Lottery(tuple(outcomes)), parts)

    def map_leaves(self, node: Expression, leaf: Callable[[Expression], Expression]) -> Expression:
        """`node` with `leaf` applied to what its decisions lead to."""
        memo: dict[int, Expression] = {}

        def visit(e: Expression) -> Expression:
            known = memo.get(id(e))
            if known is None:
                self.count(1)
                if isinstance(e, Switch):
                    known = self.switch(e.reference, [visit(case) for _, case in e.cases])
                else:
                    known = leaf(e)
                memo[id(e)] = known
            return known

        return visit(node)

    def negate(self, node: Expression) -> Expression:
        """-e, with the sign moved into the leaves of decisions."""
        return self.map_leaves(node, lambda e: self.operation("negate", (e,)))

    def adopt(self, expression: Expression, parameters: Mapping[str, Fraction]) -> Expression:
        """`expression` as a node of this forest, its parameters replaced by their values."""
        done: dict[int, Expression] = {}
        stack: list[tuple[Expression, bool]] = [(expression, False)]
        while stack:
            e, ready = stack.pop()
            if id(e) in done:
                continue
            if not ready:
                self.count(1)
                stack.append((e, True))
                stack.extend((child, False) for child in children(e))
                continue
            done[id(e)] = self._rebuild(e, [done[id(child)] for child in children(e)], parameters)
        return done[id(expression)]

    def _rebuild(
        self, e: Expression, parts: list[Expression], parameters: Mapping[str, Fraction]
    ) -> Expression:
        match e:
            case Constant():
                return self.constant(e.value)
            case Reference():
                return self.reference(e)
            case Parameter():
                return self.constant(parameters[e.name])
            case Operation():
                return self.operation(e.operator, parts)
            case Conditional():
                return self.conditional(*parts)
            case Lottery():
                return self.lottery(list(zip(parts[::2], parts[1::2], strict=True)))
            case Switch():
                given = {
                    (isinstance(v, bool), v): part for (v, _), part in zip(e.cases, parts[1:], strict=False)
                }
                rest = parts[-1] if e.otherwise is not None else None
                cases = [given.get((isinstance(v, bool), v), rest) for v in self._values[e.reference.name]]
                assert all(case is not None for case in cases), "checked models have complete switches"
                return self.switch(e.reference, [case for case in cases if case is not None])
        raise AssertionError(f"no node class {type(e).__name__}")

    # -- computation -------------------------------------------------------------------------

    def count(self, steps: int) -> None:
        """Count `steps` against the limits.

        Raises:
            TreeLimit: the file needs more than `MAXIMUM_STEPS`.
            ExpansionLimit: the expansion under way needs more than `MAXIMUM_EXPANSION`.
        """
        self._steps += steps
        if self._steps > self._deadline:
            if self._steps > MAXIMUM_STEPS:
                raise TreeLimit(f"the decision trees need more than {MAXIMUM_STEPS} steps")
            raise ExpansionLimit

    def limited(self, work: Callable[[], Expression]) -> Expression:
        """`work()`, with at most `MAXIMUM_EXPANSION` steps.

        Raises:
            ExpansionLimit: it needs more.
        """
        self._deadline = min(MAXIMUM_STEPS, self._steps + MAXIMUM_EXPANSION)
        try:
            return work()
        finally:
            self._deadline = MAXIMUM_STEPS

    def restrict(self, node: Expression, reference: Reference, value: Value) -> Expression:
        """`node` where `reference` equals `value`."""
        bit = self.bit(reference)
        key = (isinstance(value, bool), value)
        memo: dict[int, Expression] = {}

        def visit(e: Expression) -> Expression:
            if not self._facts[id(e)].support & bit:
                return e
            known = memo.get(id(e))
            if known is not None:
                return known
            self.count(1)
            match e:
                case Switch():
                    if e.reference == reference:
                        result = visit(self._case(e, key))
                    else:
                        result = self.switch(e.reference, [visit(case) for _, case in e.cases])
                case Operation():
                    result = self.operation(e.operator, [visit(part) for part in e.arguments])
                case Conditional():
                    condition = visit(e.condition)
                    if isinstance(condition, Constant) and isinstance(condition.value, bool):
                        result = visit(e.then if condition.value else e.otherwise)
                    else:
                        result = self.conditional(condition, visit(e.then), visit(e.otherwise))
                case Lottery():
                    result = self.lottery([(visit(v), visit(q)) for v, q in e.outcomes])
                case _:
                    result = self.constant(scalar(value))
            memo[id(e)] = result
            return result

        return visit(node)

    def _case(self, switch: Switch, key: tuple[bool, Value]) -> Expression:
        cases = self._cases.get(id(switch))
        if cases is None:
            cases = {(isinstance(value, bool), value): case for value, case in switch.cases}
            self._cases[id(switch)] = cases
        return cases[key]

    def first_reference(self, node: Expression, keep: int = 0) -> Reference | None:
        """The first reference, not in the bits `keep`, that deciding `node` needs."""
        while self.support(node) & ~keep:
            if isinstance(node, Reference):
                return node
            if isinstance(node, Switch) and not self.bit(node.reference) & keep:
                return node.reference
            parts = children(node)[1:] if isinstance(node, Switch) else children(node)
            self.count(len(parts))
            node = next(part for part in parts if self.support(part) & ~keep)
        return None

    def expand(
        self,
        node: Expression,
        leaf: Callable[[Expression, Assignment], Expression],
        keep: int = 0,
        identity: Reference | None = None,
    ) -> Expression:
        """`node` as a decision graph whose leaves are `leaf(rest, assignment)`.

        `rest` mentions references of `keep` at most.  A decision over `identity` whose every leaf is
        the value just tested becomes `identity` itself.

        Raises:
            ExpansionLimit: the graph is deeper than `MAXIMUM_DEPTH`.
        """
        memo: dict[int, Expression] = {}

        def visit(e: Expression, path: Assignment) -> Expression:
            known = memo.get(id(e))
            if known is not None:
                return known
            reference = self.first_reference(e, keep)
            if reference is None:
                result = leaf(e, path)
            else:
                if len(path) >= MAXIMUM_DEPTH:
                    raise ExpansionLimit
                cases = []
                for value in self._values[reference.name]:
                    cases.append(visit(self.restrict(e, reference, value), (*path, (reference, value))))
                if reference == identity and all(
                    case is self.constant(scalar(v))
                    for v, case in zip(self._values[reference.name], cases, strict=True)
                ):
                    result = self.reference(reference)
                else:
                    result = self.switch(reference, cases)
            memo[id(e)] = result
            return result

        return visit(node, ())


def reason(node: Expression) -> str:
    """Why `node`, which mentions no feature, is not a constant."""
    if isinstance(node, Operation):
        values: list[Scalar | Undefined] = []
        for part in node.arguments:
            if not isinstance(part, Constant):
                return reason(part)
            values.append(part.value)
        result = apply_operator(node.operator, values)
        if isinstance(result, Undefined):
            return result.reason
        return f"'{OPERATORS[node.operator].symbol}' gives {_kind(result)}"
    if isinstance(node, Constant):
        return f"it is {_kind(node.value)}"
    return "it is a distribution" if isinstance(node, Lottery) else "its condition is no truth value"


def _kind(value: Scalar) -> str:
    if isinstance(value, Fraction):
        return "a number"
    return f"the {'truth value' if isinstance(value, bool) else 'name'} {describe(value)}"
