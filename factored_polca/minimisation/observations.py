"""Observations merged without loss, channel by channel, for one choice at a time (DESIGN 4).

A choice c may stand for several primitives p.  Write P_p(o_j = v | x', x) for the rows of channel j; of a
primitive that does not sense j it is one row, certain of the null value.  Over all rows of all primitives
of c, as far as they occur where c stands for them,

    a value whose column is 0 never occurs and is dropped;
    values v, w whose columns are proportional, P(v) = l P(w), are merged into one;
    a channel with one value left, above all one whose row is the same everywhere, tells nothing.

No belief changes by that: a joint column is the product of its channels' columns times T(x, p, x'), so
K_c(.; ., v, rest) = l K_c(.; ., w, rest), and after either observation Bayes' rule gives the same belief.
Columns are compared exactly, as rationals.

*Noise.*  Where the partition is known, a next feature that it does not test, that only one channel reads
and on which no other feature that matters depends, is summed out of that channel's rows first:

    P(o_j | rest) = sum over v of P_p(x_i' = v | x, parents) P_p(o_j | x_i' = v, rest).

No state is enumerated and no quotient needed, so joint observations are counted for any number of channels.
What the probabilities of the next states make proportional besides is found on the quotient
(`factored_polca.minimisation.joint_columns`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from math import prod

from factored_polca.diagrams import choose, cofactors, combine, leaves, support
from factored_polca.minimisation.criterion import Choice, DecisionProcess
from factored_polca.minimisation.partition import Partition
from factored_polca.models import Observation
from factored_polca.models.features import position
from factored_polca.models.scalars import describe, scalar
from factored_polca.symbolic import RowDiagram, SymbolicModel
from factored_polca.symbolic.rows import Row


@dataclass(frozen=True)
class MergedChannel:
    """What is left of the values of one channel for one choice.

    `image[v]` is the merged value that v belongs to, -1 where v never occurs; merged values are numbered
    by their first member.  `sensed` tells whether a primitive of the choice senses the channel.
    """

    channel: int
    definition: Observation
    image: tuple[int, ...]  # [value]
    sensed: bool

    @property
    def values(self) -> int:
        """The number of merged values."""
        return max(self.image) + 1

    def row(self, row: Row) -> Row:
        """The probability of each merged value."""
        result = [Fraction(0)] * self.values
        for value, chance in enumerate(row):
            if chance:
                result[self.image[value]] += chance
        return tuple(result)

    def label(self, merged: int) -> str:
        """A merged value as `channel=value`, or `channel=value / other`."""
        members = [
            describe(scalar(value))
            for value, image in zip(self.definition.values, self.image, strict=True)
            if image == merged
        ]
        return f"{self.definition.name}={' / '.join(members)}"


@dataclass(frozen=True)
class ObservationCount:
    """Joint observations of one choice.

    `before` is the product of the numbers of values of the channels that its primitives sense, `after`
    that of their merged values.
    """

    choice: str
    before: int
    after: int


@dataclass(frozen=True)
class Sensed:
    """What a choice senses: the rows of channels by primitive, noise summed out, and the merged values.

    `rows[p]` holds the channels that primitive p senses and whose values are not all merged into one.
    """

    channels: tuple[MergedChannel, ...]  # all of the process
    rows: dict[int, dict[int, RowDiagram]]

    @property
    def left(self) -> tuple[MergedChannel, ...]:
        """The channels that tell something."""
        return tuple(channel for channel in self.channels if channel.values > 1)


def sense(process: DecisionProcess, choice: Choice, partition: Partition | None = None) -> Sensed:
    """What a choice of a partially observed process senses; without a `partition` noise stays in."""
    actions = process.symbolic.actions
    telling, found = process.channels or (), dict[int, MergedChannel]()
    while True:
        rows = {
            p: {j: row for j, row in actions[p].observations.items() if j in telling}
            for p in choice.primitives
        }
        if partition is not None:
            rows = {p: without_noise(partition, p, sensed) for p, sensed in rows.items()}
        found |= {j: _merged(process, choice, rows, j) for j in telling}
        left = tuple(j for j in telling if found[j].values > 1)
        if left == telling or partition is None:
            rows = {p: {j: row for j, row in sensed.items() if j in left} for p, sensed in rows.items()}
            return Sensed(tuple(found[j] for j in process.channels or ()), rows)
        telling = left  # what only the other channels read is noise


def _merged(
    process: DecisionProcess, choice: Choice, rows: Mapping[int, Mapping[int, RowDiagram]], channel: int
) -> MergedChannel:
    """The merged values of a channel whose rows are `rows[primitive][channel]`."""
    definition = process.symbolic.model.observations[channel]
    met: set[Row] = set()
    for primitive in choice.primitives:
        if channel in rows[primitive]:
            met |= set(occurring_rows(process, choice, primitive, rows[primitive][channel]).values())
        else:
            met.add(unsensed_row(definition))
    image = merge_values(met, len(definition.values))
    sensed = any(channel in process.symbolic.actions[p].observations for p in choice.primitives)
    return MergedChannel(channel, definition, image, sensed)


def unsensed_row(definition: Observation) -> Row:
    """What a channel reports where it is not sensed: certainly its null value."""
    null = position(definition.values, definition.null)
    return tuple(Fraction(int(v == null)) for v in range(len(definition.values)))


def without_noise(
    partition: Partition, primitive: int, rows: Mapping[int, RowDiagram]
) -> dict[int, RowDiagram]:
    """The rows of channels, with the next features summed out that one of them reads and nothing else."""
    symbolic = partition.symbolic
    action, result = symbolic.actions[primitive], dict(rows)
    tested = set(support(partition.diagram))
    kept: set[int] = set()
    for feature in action.elimination:  # children of synchronic arcs before their parents
        level = symbolic.next(feature)
        readers = [j for j, row in result.items() if level in support(row.diagram)]
        parent = any(feature in action.rows[child].parents_next for child in kept if child in action.rows)
        if symbolic.now(feature) in tested or parent or len(readers) > 1:
            kept.add(feature)
        elif readers:
            result[readers[0]] = _summed_out(
                symbolic, result[readers[0]], feature, action.rows.get(feature)
            )
    return result


def _summed_out(
    symbolic: SymbolicModel, row: RowDiagram, feature: int, drawn: RowDiagram | None
) -> RowDiagram:
    """A channel's rows with a next feature summed out that is distributed as `drawn`; None: it persists."""
    parts = cofactors(row.diagram, symbolic.next(feature))
    if drawn is None:
        result = parts[-1]
        for value, part in enumerate(parts[:-1]):
            result = choose(symbolic.manager.indicator(symbolic.now(feature), [value]), part, result)
        return replace(row, diagram=result)

    def mixed(number: int, *entries: int) -> Row:
        weighed = [(q, row.rows[e]) for q, e in zip(drawn.rows[number], entries, strict=True) if q]
        if all(other is weighed[0][1] for _, other in weighed):
            return weighed[0][1]
        return tuple(sum((q * r[v] for q, r in weighed), Fraction(0)) for v in range(len(row.rows[0])))

    diagram, rows = combine([drawn.diagram, *parts], mixed)
    return replace(row, diagram=diagram, rows=tuple(rows))


def occurring_rows(
    process: DecisionProcess, choice: Choice, primitive: int, row: RowDiagram
) -> dict[int, Row]:
    """The rows of a channel that occur where `choice` stands for `primitive`, by number."""
    where = choice.app & choice.where(primitive)
    if process.reachable is not None:
        where = where & process.reachable
    nowhere = len(row.rows)
    met = leaves(choose(where, row.diagram, process.symbolic.manager.constant(nowhere)))
    return {int(number): row.rows[int(number)] for number in sorted(met) if number != nowhere}


def merge_values(rows: set[Row], values: int) -> tuple[int, ...]:
    """The merged value of each value [value], -1 for one that has probability 0 in all `rows`."""
    columns: list[list[tuple[int, Fraction]]] = [[] for _ in range(values)]
    for number, row in enumerate(rows):
        for value, chance in enumerate(row):
            if chance:
                columns[value].append((number, chance))
    numbers: dict[tuple[tuple[int, Fraction], ...], int] = {}
    image = []
    for column in columns:
        if not column:
            image.append(-1)
            continue
        first = column[0][1]
        direction = tuple((number, chance / first) for number, chance in column)
        image.append(numbers.setdefault(direction, len(numbers)))
    return tuple(image)


def count_before(channels: Sequence[MergedChannel]) -> int:
    """The joint values of the channels that are sensed, unmerged."""
    return prod(len(channel.definition.values) for channel in channels if channel.sensed)


def observation_counts(
    process: DecisionProcess, partition: Partition | None = None
) -> tuple[ObservationCount, ...]:
    """Joint observations of each choice, before and after merging the values of single channels.

    Exact integers, however many channels there are; nothing joint is listed.  With a stable `partition`
    noise is left out first.  A quotient may be left with fewer: it lists the joint observations that occur,
    and merges proportional columns of its kernel.
    """
    result = []
    for choice in process.choices:
        sensed = sense(process, choice, partition)
        after = prod(channel.values for channel in sensed.left)
        result.append(ObservationCount(choice.name, count_before(sensed.channels), after))
    return tuple(result)
