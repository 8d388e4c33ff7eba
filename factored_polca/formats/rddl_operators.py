"""Grounding of RDDL's operators and aggregations.

`^` and `&` are the conjunction, `|` the disjunction, `~` the negation; `forall`, `exists`, `sum`, `prod`,
`avg`, `min` and `max` go over all objects of the types of their variables.  What has no fluent is grounded
first, and where it decides, nothing else is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from fractions import Fraction
from typing import TYPE_CHECKING, Final

from factored_polca.formats.rddl_lifted import Node
from factored_polca.formats.rddl_terms import BOOL, NUMBER, Term

if TYPE_CHECKING:
    from factored_polca.formats.rddl_grounding import Binding, Grounder

_ORDERS: Final = {"<": "less", "<=": "less_equal", ">": "less", ">=": "less_equal"}


def ground_operator(grounder: Grounder, node: Node, binding: Binding) -> Term:
    """A logical, relational or arithmetic operator."""
    terms, parts = grounder.terms, node.parts
    match node.text:
        case "^" | "&" | "|":
            conditions = (grounder.condition(part, binding) for part in grounder.static_first(parts))
            return _decided(grounder, conditions, some=node.text == "|")
        case "~":
            return terms.negation(grounder.condition(parts[0], binding))
        case "=>":
            first = terms.negation(grounder.condition(parts[0], binding))
            if terms.value(first) is True:
                return first
            return terms.disjunction([first, grounder.condition(parts[1], binding)])
        case "<=>":
            first, second = (grounder.condition(part, binding) for part in parts)
            return terms.operator("equal", (first, second))
        case "==" | "~=":
            first, second = (grounder.ground(part, binding) for part in parts)
            same = _equal(grounder, node, first, second)
            return same if node.text == "==" else terms.negation(same)
        case "+":
            return terms.sum([grounder.numeric(part, binding) for part in parts])
        case "negate":
            return terms.negative(grounder.numeric(parts[0], binding))
        case "plus":
            return grounder.numeric(parts[0], binding)
        case "*":
            return _product(grounder, parts, [binding])
        case "/":
            first, second = (grounder.numeric(part, binding) for part in parts)
            return terms.operator("divide", (first, second))
    if node.text not in _ORDERS:
        raise grounder.fault(node, f"the operator {node.text!r} is not read")
    left, right = (grounder.numeric(part, binding) for part in parts)
    pair = (right, left) if node.text in (">", ">=") else (left, right)
    return terms.operator(_ORDERS[node.text], pair)


def _decided(grounder: Grounder, conditions: Iterable[Term], *, some: bool) -> Term:
    """All of the conditions, or `some` of them; the rest is not looked at once that is decided."""
    decides, found = grounder.terms.truth(some), list[Term]()
    for condition in conditions:
        found.append(condition)
        if condition == decides:
            return decides
    return grounder.terms.disjunction(found) if some else grounder.terms.conjunction(found)


def _equal(grounder: Grounder, node: Node, a: Term, b: Term) -> Term:
    terms = grounder.terms
    kinds = {terms[a].kind, terms[b].kind}
    if kinds == {BOOL, NUMBER}:
        a, b = terms.as_number(a), terms.as_number(b)
    elif len(kinds) > 1:
        raise grounder.fault(node, f"{node.text!r} compares a {terms[a].kind} with a {terms[b].kind}")
    return terms.operator("equal", (a, b))


def _product(grounder: Grounder, parts: tuple[int, ...], bindings: Iterable[Binding]) -> Term:
    zero, found = grounder.terms.number(0), list[Term]()
    for binding in bindings:
        for part in grounder.static_first(parts):
            found.append(grounder.numeric(part, binding))
            if found[-1] == zero:
                return zero
    return grounder.terms.product(found)


def ground_aggregate(grounder: Grounder, node: Node, binding: Binding) -> Term:
    """An aggregation over objects."""
    terms, body = grounder.terms, node.parts[0]
    bindings = ({**binding, **inner} for inner in grounder.instances(node.binders, node.offset))
    match node.text:
        case "forall" | "exists":
            conditions = (grounder.condition(body, inner) for inner in bindings)
            return _decided(grounder, conditions, some=node.text == "exists")
        case "prod":
            return _product(grounder, (body,), bindings)
        case "sum" | "avg" | "min" | "max":
            found = [grounder.numeric(body, inner) for inner in bindings]
            if node.text == "sum":
                return terms.sum(found)
            if not found:
                raise grounder.fault(node, f"{node.text} over no objects")
            if node.text == "avg":
                return terms.product([terms.number(Fraction(1, len(found))), terms.sum(found)])
            if len(found) == 1:
                return found[0]
            return terms.operator("minimum" if node.text == "min" else "maximum", tuple(found))
    hint = "forall, exists, sum, prod, avg, min and max are"
    raise grounder.fault(node, f"the aggregation {node.text!r} is not read", hint)


OPERATORS: Final[Mapping[str, Callable[[Grounder, Node, Binding], Term]]] = {
    "operator": ground_operator,
    "aggregate": ground_aggregate,
}
"""Kind of part -> how it is grounded."""
