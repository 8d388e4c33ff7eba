"""Grounding of what RDDL chooses: `if`, `switch`, functions and draws.

    Bernoulli(p)                    true with probability p
    KronDelta(e), DiracDelta(e)     e itself
    Discrete(type, @a: p, @b: q)    each value with its probability
    UnnormDiscrete(...)             the same, weights divided by their sum
    Discrete_{?x: type} p(?x)       a value of `type`, each with the probability given for it

Only the branch that a known condition chooses is grounded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Final

from factored_polca.formats.rddl_functions import FUNCTIONS
from factored_polca.formats.rddl_lifted import Node
from factored_polca.formats.rddl_terms import BOOL, NUMBER, Term

if TYPE_CHECKING:
    from factored_polca.formats.rddl_grounding import Binding, Grounder

_READ: Final = "Bernoulli, KronDelta, DiracDelta, Discrete and UnnormDiscrete are"
_INFINITE: Final = frozenset(["Poisson", "Geometric", "NegativeBinomial"])


def ground_if(grounder: Grounder, node: Node, binding: Binding) -> Term:
    """if (condition) then ... else ..."""
    condition = grounder.condition(node.parts[0], binding)
    value = grounder.terms.value(condition)
    if value is not None:
        return grounder.ground(node.parts[1 if value else 2], binding)
    then, otherwise = (grounder.ground(part, binding) for part in node.parts[1:])
    return _joined(grounder, node, condition, then, otherwise)


def _joined(grounder: Grounder, node: Node, condition: Term, then: Term, otherwise: Term) -> Term:
    terms = grounder.terms
    first, second = terms[then].kind, terms[otherwise].kind
    if {first, second} == {BOOL, NUMBER}:
        then, otherwise = terms.as_number(then), terms.as_number(otherwise)
    elif first != second:
        raise grounder.fault(node, f"one branch gives a {first}, another a {second}")
    return terms.choice(condition, then, otherwise)


def ground_switch(grounder: Grounder, node: Node, binding: Binding) -> Term:
    """switch (e) { case v: ..., default: ... }: the first case that e equals."""
    terms = grounder.terms
    subject = grounder.ground(node.parts[0], binding)
    if not terms.fixed(subject):
        raise grounder.fault(
            node, "a switch over a draw is not read", "give the draw a name: an interm-fluent"
        )
    cases: list[tuple[Term, int]] = []
    default: int | None = None
    parts = iter(node.parts[1:])
    for label in node.labels:
        if label == "default":
            default = next(parts)
            continue
        chosen = grounder.ground(next(parts), binding)
        if terms[chosen].kind != terms[subject].kind:
            found, wanted = terms[chosen].kind, terms[subject].kind
            raise grounder.fault(node, f"a switch over a {wanted} has a case of a {found}")
        same, body = terms.operator("equal", (subject, chosen)), next(parts)
        if terms.value(same) is True:
            default = body
            break
        if terms.value(same) is None:
            cases.append((same, body))
    if default is None and cases and _covered(grounder, subject, len(cases)):
        default = cases.pop()[1]
    if default is None:
        raise grounder.fault(
            node, "a switch without a default does not cover all values", "add default: ..."
        )
    result = grounder.ground(default, binding)
    for same, body in reversed(cases):
        result = _joined(grounder, node, same, grounder.ground(body, binding), result)
    return result


def _covered(grounder: Grounder, subject: Term, cases: int) -> bool:
    """Whether so many different cases are all values of what is switched over."""
    kind = grounder.terms[subject].kind
    values = {BOOL: 2, NUMBER: 0}.get(kind)
    return cases == (len(grounder.lifted.types[kind]) if values is None else values)


def ground_function(grounder: Grounder, node: Node, binding: Binding) -> Term:
    """A function such as `exp[x]`."""
    name, count = node.text, len(node.parts)
    if name in ("min", "max"):
        if count < 2:
            raise grounder.fault(node, f"{name} takes two arguments or more, not {count}")
        found = tuple(grounder.numeric(part, binding) for part in node.parts)
        return grounder.terms.operator("minimum" if name == "min" else "maximum", found)
    if name not in FUNCTIONS:
        listed = ", ".join(["min", "max", *FUNCTIONS])
        raise grounder.fault(node, f"the function {name!r} is not read", f"{listed} are")
    if FUNCTIONS[name][0] != count:
        raise grounder.fault(node, f"{name} takes {FUNCTIONS[name][0]} arguments, not {count}")
    return grounder.terms.function(name, tuple(grounder.numeric(part, binding) for part in node.parts))


def ground_draw(grounder: Grounder, node: Node, binding: Binding) -> Term:
    """Bernoulli, KronDelta and DiracDelta."""
    if node.text == "Bernoulli":
        chance = grounder.numeric(node.parts[0], binding)
        _refuse_nested(grounder, node, chance)
        return grounder.terms.bernoulli(chance)
    if node.text in ("KronDelta", "DiracDelta"):
        return grounder.ground(node.parts[0], binding)
    reason = "has infinitely many values" if node.text in _INFINITE else "is continuous"
    if node.text == "Binomial":
        reason = "is not read: sum Bernoullis, or list the values with Discrete"
    raise grounder.fault(node, f"the distribution {node.text} {reason}", _READ)


def _refuse_nested(grounder: Grounder, node: Node, chance: Term) -> None:
    if not grounder.terms.fixed(chance):
        raise grounder.fault(node, f"a probability of {node.text} that is drawn itself is not read")


def ground_discrete(grounder: Grounder, node: Node, binding: Binding) -> Term:
    """Discrete and UnnormDiscrete over listed values of a type."""
    kind = node.binders[0][1]
    values = grounder.objects_of(kind, node.offset)
    unknown = [label for label in node.labels if label.removeprefix("@") not in values]
    if unknown:
        listed = ", ".join(values)
        raise grounder.fault(node, f"{unknown[0]!r} is no value of {kind!r}", f"its values are {listed}")
    labels = tuple(label.removeprefix("@") for label in node.labels)
    if len(set(labels)) != len(labels):
        raise grounder.fault(node, f"{node.text} lists a value twice")
    chances = [grounder.numeric(part, binding) for part in node.parts]
    return _discrete(grounder, node, labels, chances, kind)


def ground_discrete_over(grounder: Grounder, node: Node, binding: Binding) -> Term:
    """Discrete_{?x: type} p(?x)."""
    if len(node.binders) != 1:
        raise grounder.fault(node, f"{node.text} over {len(node.binders)} variables is not read: one is")
    variable, kind = node.binders[0]
    labels = grounder.objects_of(kind, node.offset)
    chances = [grounder.numeric(node.parts[0], {**binding, variable: label}) for label in labels]
    return _discrete(grounder, node, labels, chances, kind)


def _discrete(
    grounder: Grounder, node: Node, labels: tuple[str, ...], chances: list[Term], kind: str
) -> Term:
    terms = grounder.terms
    for chance in chances:
        _refuse_nested(grounder, node, chance)
    if node.text == "UnnormDiscrete":
        total = terms.sum(chances)
        chances = [terms.operator("divide", (chance, total)) for chance in chances]
    return terms.discrete(labels, tuple(chances), kind)


CHOICES: Final[Mapping[str, Callable[[Grounder, Node, Binding], Term]]] = {
    "if": ground_if,
    "switch": ground_switch,
    "function": ground_function,
    "draw": ground_draw,
    "discrete": ground_discrete,
    "discrete_over": ground_discrete_over,
}
"""Kind of part -> how it is grounded."""
