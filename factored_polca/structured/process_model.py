"""A partially observed decision process, one subtask of a model say, as a model of its own.

The solver on diagrams (`pomdp_solution`) reads a `SymbolicModel`.  That of a process has one action for
each choice, the process's terminal set, its rewards, and of the channels only those that count.  A choice c
that stands for primitives, by the policy pi_c of a child, has for each feature the rows of pi_c(x),

    P_c(x_i' | x, x') = P_{pi_c(x)}(x_i' | x, x'),

features that pi_c(x) leaves alone keeping their value, and channels that it does not sense reporting their
null value: the joint kernel of pi_c(x) (`hierarchy.pomdp_plan`), in factors.  No state is listed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

import networkx as nx
import numpy as np

from factored_polca.diagrams import INDEX, Diagram, choose, relabel
from factored_polca.minimisation.criterion import Choice, DecisionProcess
from factored_polca.models import LimitReached
from factored_polca.models.features import position
from factored_polca.symbolic import RowDiagram, SymbolicModel, Term
from factored_polca.symbolic.model import SymbolicAction
from factored_polca.symbolic.rows import Row, elimination_order
from factored_polca.symbolic.variants import fresh_variant


def process_model(process: DecisionProcess) -> SymbolicModel:
    """The process as a compiled model; its actions are the choices, over the same manager.

    `model` stays that of which the process is a part: features, channels and discount are its own.

    Raises:
        LimitReached: a child's primitives need next values of features in each other's order.
    """
    symbolic = process.symbolic
    actions = tuple(_action(process, choice) for choice in process.choices)
    return replace(symbolic, actions=actions, terminal=process.terminal, variant=fresh_variant())


def _action(process: DecisionProcess, choice: Choice) -> SymbolicAction:
    symbolic = process.symbolic
    parts = [(choice.where(p), p) for p in choice.primitives]
    if len(parts) == 1:
        (_, p), compiled = parts[0], symbolic.actions[parts[0][1]]
        observations = {j: row for j, row in compiled.observations.items() if j in (process.channels or ())}
        return replace(
            compiled, name=choice.name, app=choice.app, rewards=process.rewards[p],
            sampled_rewards=process.rewards[p], observations=observations,
        )  # fmt: skip
    acting = [(where, symbolic.actions[p]) for where, p in parts]
    rows = {
        i: _selected(i, [(w, a.rows.get(i) or persisting(symbolic, i)) for w, a in acting])
        for i in sorted({i for _, a in acting for i in a.rows})
    }
    sensed = {j for _, a in acting for j in a.observations if j in (process.channels or ())}
    observations = {
        j: _selected(j, [(w, a.observations.get(j) or silent(symbolic, j)) for w, a in acting])
        for j in sorted(sensed)
    }
    rewards = _rewards(process, parts)
    elimination = _elimination(symbolic, choice.name, rows)
    return SymbolicAction(choice.name, rows, elimination, choice.app, rewards, rewards, observations)


def _selected(number: int, parts: Sequence[tuple[Diagram, RowDiagram]]) -> RowDiagram:
    """The row diagram that is one of several, by conditions of which one holds wherever it counts."""
    numbers: dict[Row, int] = {}
    parents: set[int] = set()
    result: Diagram | None = None
    for where, row in reversed(parts):
        images = np.array([numbers.setdefault(r, len(numbers)) for r in row.rows], dtype=np.uint64)
        diagram = relabel(row.diagram, images, INDEX)
        result = diagram if result is None else choose(where, diagram, result)
        parents.update(row.parents_next)
    assert result is not None, "a choice stands for some primitive"
    return RowDiagram(number, result, tuple(numbers), tuple(sorted(parents)))


def persisting(symbolic: SymbolicModel, feature: int) -> RowDiagram:
    """The rows of a feature that stays what it is."""
    manager, level = symbolic.manager, symbolic.now(feature)
    size = len(symbolic.model.features[feature].values)
    rows = tuple(tuple(Fraction(int(v == w)) for w in range(size)) for v in range(size))
    return RowDiagram(feature, manager.variable(level, [manager.constant(v) for v in range(size)]), rows)


def silent(symbolic: SymbolicModel, channel: int) -> RowDiagram:
    """The row of a channel that is not sensed: its null value."""
    described = symbolic.model.observations[channel]
    null = position(described.values, described.null)
    row = tuple(Fraction(int(v == null)) for v in range(len(described.values)))
    return RowDiagram(channel, symbolic.manager.constant(0), (row,))


def _rewards(process: DecisionProcess, parts: Sequence[tuple[Diagram, int]]) -> tuple[Term, ...]:
    """The terms of the primitive that is taken; those that all have stay as they are."""
    manager = process.symbolic.manager
    lists = [list(process.rewards[p]) for _, p in parts]
    shared = []
    for term in list(lists[0]):
        if all(term in terms for terms in lists):
            shared.append(term)
            for terms in lists:
                terms.remove(term)
    found = list(shared)
    nothing = manager.constant(0)
    for (where, _), terms in zip(parts, lists, strict=True):
        for term in terms:
            images = np.arange(1, len(term.values) + 1, dtype=np.uint64)
            diagram = choose(where, relabel(term.diagram, images, INDEX), nothing)
            found.append(Term(diagram, (Fraction(0), *term.values)))
    return tuple(found)


def _elimination(symbolic: SymbolicModel, name: str, rows: dict[int, RowDiagram]) -> tuple[int, ...]:
    """The order in which next values are summed out."""
    try:
        return elimination_order(symbolic.positions, rows)
    except nx.NetworkXUnfeasible:
        raise LimitReached(
            f"the actions that task {name!r} takes read next values of features in each other's order; "
            "solving its parent on diagrams needs one order for all: use a solver over blocks there",
            "synchronic arcs",
        ) from None
