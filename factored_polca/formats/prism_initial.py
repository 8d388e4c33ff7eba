"""Where a PRISM program starts: one state, or all states of `init ... endinit`, each as likely.

PRISM's `init` names a set of states without probabilities; here it is read as the uniform distribution
over the set. A conjunction falls into parts that share no variables; each part is searched, within a
limit, for the values that satisfy it. A part over one variable is that variable's uniform distribution,
another one that has one solution is that, and what is left becomes a factor: 1/n where it holds, n being
the number of its solutions.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import product
from math import prod
from typing import Final

import networkx as nx

from factored_polca.formats.prism_program import Program
from factored_polca.formats.prism_text import Place
from factored_polca.formats.spudd_trees import Forest, TreeLimit
from factored_polca.models.errors import Fault, ModelError
from factored_polca.models.expressions import (
    TRUE,
    ZERO,
    Conditional,
    Constant,
    Expression,
    Operation,
    conjunction,
    lottery,
    references,
)
from factored_polca.models.features import Feature
from factored_polca.models.model import InitialBelief
from factored_polca.models.scalars import Value, scalar

MAXIMUM_SEARCH: Final = 100_000
"""Assignments that are tried for one part."""


def initial_belief(program: Program, place: Place) -> InitialBelief:
    """The initial belief of a program.

    Raises:
        ModelError: no state satisfies `init`, or it is too large to be searched.
    """
    if program.initial is None:
        return InitialBelief({name: Constant(scalar(value)) for name, value in program.first.items()})
    features = {feature.name: feature for feature in program.features}
    distributions: dict[str, Expression] = {}
    factors: list[Expression] = []
    for names, condition in _parts(program.initial):
        known = [features[name] for name in names]
        solutions = _solutions(condition, known, program, place)
        if len(known) == 1 or len(solutions) == 1:
            for index, name in enumerate(names):
                values = list(dict.fromkeys((type(s[index]), s[index]) for s in solutions))
                share = Fraction(1, len(values))
                distributions[name] = lottery([(Constant(scalar(value)), share) for _, value in values])
        else:
            factors.append(Conditional(condition, Constant(Fraction(1, len(solutions))), ZERO))
    mentioned = {name for names, _ in _parts(program.initial) for name in names}
    for feature in program.features:
        if feature.name not in mentioned:
            share = Fraction(1, len(feature.values))
            distributions[feature.name] = lottery([(Constant(scalar(v)), share) for v in feature.values])
    return InitialBelief(distributions, factors)


def _parts(condition: Expression) -> list[tuple[list[str], Expression]]:
    """A conjunction as parts that share no variables: their variables, and what must hold."""
    is_and = isinstance(condition, Operation) and condition.operator == "and"
    conjuncts = condition.arguments if is_and and isinstance(condition, Operation) else (condition,)
    graph = nx.Graph()
    of = [sorted({r.name for r in references(part)}) for part in conjuncts]
    for names in of:
        graph.add_nodes_from(names)
        nx.add_path(graph, names)
    groups = [sorted(group) for group in nx.connected_components(graph)]
    result = [
        (
            group,
            conjunction(
                [part for part, names in zip(conjuncts, of, strict=True) if set(names) & set(group)]
            ),
        )
        for group in groups
    ]
    constants = [part for part, names in zip(conjuncts, of, strict=True) if not names and part != TRUE]
    return [*result, *(([], part) for part in constants)]


def _solutions(
    condition: Expression, features: Sequence[Feature], program: Program, place: Place
) -> list[tuple[Value, ...]]:
    """The values of `features` that satisfy a condition over them."""
    line, column = place
    if prod(len(f.values) for f in features) > MAXIMUM_SEARCH:
        names = ", ".join(f.name for f in features)[:200]
        message = f"init ties the variables {names} together: more than {MAXIMUM_SEARCH:,} values to try"
        hint = "give each variable a first value, or write init as tests joined by &"
        raise ModelError([Fault(message, hint=hint, line=line, column=column)])
    forest = Forest({f.name: f.values for f in features})
    try:
        root = forest.adopt(condition, program.parameters)
        found = []
        for values in product(*(f.values for f in features)):
            node = root
            for feature, value in zip(features, values, strict=True):
                node = forest.restrict(node, feature.now, value)
            if node == TRUE:
                found.append(values)
    except TreeLimit as limit:
        raise ModelError([Fault(f"init is too large: {limit}", line=line, column=column)]) from None
    if not found:
        hint = "a program starts in one state at least"
        raise ModelError([Fault("no state satisfies init", hint=hint, line=line, column=column)])
    return found
