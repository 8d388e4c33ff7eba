"""Partitions that are stable because they tell all states apart that could differ.

A feature is *relevant* to a partition P of a process if P tests it, if it tells where choices apply or what
they stand for, or if a row of one of their primitives reads it that gives a relevant feature its next value
or, under partial observability, is of a channel.  Two states that agree on the relevant features send the
same to all blocks, whatever the rest, since rows sum to exactly 1.  So P is stable and agrees on rewards if

    each block in which some choice applies has one combination of values of all relevant features,
    those that rewards read among them,

and as refining never splits a block that need not be split, P is then the coarsest such partition, with
certainty.  Where no choice applies nothing is earned and nothing sent.  A block has choices that apply in
all of its states or in none.
"""

from __future__ import annotations

from collections.abc import Iterable

from factored_polca.diagrams import Diagram, choose, leaves, states_of_leaves, support
from factored_polca.minimisation.criterion import ProcessView


def relevant_features(view: ProcessView, labels: Diagram, others: Iterable[Diagram] = ()) -> list[int]:
    """The features relevant to the partition `labels`, by level, with those that `others` test."""
    process = view.process
    symbolic = process.symbolic
    count = len(symbolic.model.features)
    feature_at = {level: i for i in range(count) for level in (symbolic.now(i), symbolic.next(i))}
    actions = [symbolic.actions[p] for p in {p for choice in process.choices for p in choice.primitives}]
    read = {id(diagram): diagram for diagram in (labels, *others)}
    for choice in process.choices:
        app = view.app(choice)
        read[id(app)] = app
        if choice.policy is not None:
            read[id(choice.policy)] = choice.policy
    for action in actions:
        for j in process.channels or ():
            if j in action.observations:
                read[id(action.observations[j].diagram)] = action.observations[j].diagram
    waiting = {
        feature_at[level] for diagram in read.values() for level in support(diagram) if level in feature_at
    }
    relevant: set[int] = set()
    seen: dict[int, Diagram] = {}
    while waiting:
        feature = waiting.pop()
        relevant.add(feature)
        for action in actions:
            if feature in action.rows:
                diagram = action.rows[feature].diagram  # actions share them
                if id(diagram) not in seen:
                    seen[id(diagram)] = diagram
                    waiting |= {feature_at[level] for level in support(diagram)} - relevant
    return sorted(relevant, key=symbolic.now)


def all_apart(view: ProcessView, labels: Diagram, blocks: int) -> bool:
    """Whether a partition, an index diagram onto 0 .. blocks - 1, is stable as is said above.

    Different masks and terminal flags must have been told apart.
    """
    process, manager = view.process, labels.manager
    live = manager.constant(0)
    for choice in process.choices:
        live = live | view.app(choice)
    if _count(live, {*support(labels), *support(live)}) > blocks:
        return False
    terms = [term.diagram for p in process.rewards for term in process.rewards[p]]
    features = relevant_features(view, labels, terms)
    states = _count(live, {process.symbolic.now(feature) for feature in features})
    if states > blocks:
        return False
    elsewhere = choose(live, manager.constant(blocks), labels)
    return blocks - sum(int(leaf) != blocks for leaf in leaves(elsewhere)) == states


def _count(condition: Diagram, levels: set[int]) -> int:
    """The combinations of values at `levels` for which the condition holds."""
    counts = states_of_leaves(condition, sorted(levels))
    return sum(count for count, leaf in zip(counts, leaves(condition), strict=True) if int(leaf) == 1)
