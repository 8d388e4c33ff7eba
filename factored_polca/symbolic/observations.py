"""Observations as row diagrams, and what they add to the rewards.

For each channel j that an action senses, a row diagram over (x, x') gives the row P_a(o_j | x', x).
The others report their null value and need no diagram.

A reward term may mention observations.  Each channel has a level of its own, below all features, and
is summed out as soon as the term is compiled:

    r(x, x') = sum over o of prod_j P_a(o_j | x', x) * r(x, x', o),

so no finished diagram tests these levels.  As everywhere, a term or row that means nothing is a fault
only where it can come about: at a state where the action applies, at next values and observations of
positive probability.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from factored_polca.diagrams import Diagram, cofactors, support
from factored_polca.models.features import position
from factored_polca.models.model import Action
from factored_polca.symbolic.rows import RowDiagram, Term, mean, possible

if TYPE_CHECKING:
    from factored_polca.symbolic.model import _Build


def compile_observations(
    build: _Build, action: Action, app: Diagram, effects: dict[int, RowDiagram]
) -> dict[int, RowDiagram]:
    """The row diagram of each channel that `action` senses; faults are recorded in `build`."""
    channels = {channel.name: number for number, channel in enumerate(build.model.observations)}
    rows: dict[int, RowDiagram] = {}
    for name, sensed in action.senses:
        number = channels[name]
        path = ("actions", action.name, "senses", name)
        rows[number] = build.rows(number, build.model.observations[number], sensed, path, app)
    build.settle_suspects(effects)
    return rows


def channel_level(build: _Build, channel: int) -> int:
    """The level of an observation: below all features."""
    return 2 * len(build.order) + channel


def null_value(build: _Build, channel: int) -> int:
    """The number of the value that a channel reports where it is not sensed."""
    definition = build.model.observations[channel]
    value = position(definition.values, definition.null)
    assert value is not None, "the check refuses channels that are not sensed and have no null value"
    return value


def restrict_to_possible(
    build: _Build, condition: Diagram, observations: Mapping[int, RowDiagram]
) -> Diagram:
    """The part of a condition over (x, x', o) where the observations that it tests are possible."""
    tested = set(support(condition))
    for channel in range(len(build.model.observations)):
        level = channel_level(build, channel)
        if level not in tested:
            continue
        if channel in observations:
            condition = condition & possible(observations[channel], level)
        else:
            condition = condition & build.manager.indicator(level, [null_value(build, channel)])
    return condition


def expect_observations(build: _Build, term: Term, observations: Mapping[int, RowDiagram]) -> Term:
    """A term over (x, x', o) with its expectation over o taken: a term over (x, x')."""
    for channel in reversed(range(len(build.model.observations))):
        level = channel_level(build, channel)
        if level not in support(term.diagram):
            continue
        if channel in observations:
            term = mean(term, level, observations[channel])
        else:
            seen = cofactors(term.diagram, level)[null_value(build, channel)]
            term = Term(seen, term.values)
    return term
